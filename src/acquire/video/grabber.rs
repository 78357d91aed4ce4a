//! From a video to files: one for each picture that stands still and is new.

use std::path::Path;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::{Receiver, RecvTimeoutError, sync_channel};
use std::time::Duration;

use serde::{Deserialize, Serialize};

use super::super::spool::Spool;
use super::capture::{Capture, CaptureError, Opening};
use super::picture::write_picture;
use super::settings::VideoSettings;
use super::stillness::{Leftover, Noted, Stillness};
use crate::image::Image;
use crate::time::{Stopwatch, host_now_us};

/// A device that gives nothing is asked again so often.
const AGAIN: Duration = Duration::from_millis(500);
/// A device that has given no picture for so long is silent, though its driver still waits for one.
const SILENT: Duration = Duration::from_secs(3);
/// What has not opened after so long is opened anew, or given up: longer than a stream's own patience with its server, 30 s.
const OPENS_WITHIN: Duration = Duration::from_secs(40);
/// How often is looked whether it is all over.
const LOOK: Duration = Duration::from_millis(200);
/// Pictures that wait.
const AHEAD: usize = 2;

/// How long, and from when on.
#[derive(Clone, Copy, Debug, Default)]
pub struct GrabOptions {
    /// End after so many seconds of the video.
    pub seconds: Option<f64>,
    /// A file is not played at its own pace, but as fast as it can be read.
    pub at_once: bool,
    /// The picture that stands there at the beginning is taken as well.
    pub include_first: bool,
    /// A device that is not there is waited for.
    pub wait: bool,
}

/// What happens while a video is grabbed.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case", tag = "event")]
pub enum Grabbed {
    /// Pictures come.
    Opened {
        /// Columns and rows of the video.
        size_px: [usize; 2],
        /// Pictures a second, as it says.
        per_s: f64,
    },
    /// A picture was written into the folder.
    Picture {
        /// Columns and rows.
        size_px: [usize; 2],
        /// Seconds from the start of the video at which it began to stand.
        at_s: f64,
    },
    /// What stands there was there at the beginning, and is not taken.
    First {
        /// Seconds from the start of the video at which it began to stand.
        at_s: f64,
    },
    /// Nothing stands still.
    Restless {
        /// For so long.
        for_s: f64,
        /// First pixel of the 16 x 16 block that changes most often.
        at_px: [u32; 2],
        /// By how much, grey values.
        change: f64,
        /// Up to which it would stand still.
        limit: f64,
    },
    /// Pictures follow each other that differ in one place alone: none of them is taken.
    Ticking {
        /// First pixel of the block that changes most.
        at_px: [u32; 2],
        /// By how much, grey values.
        change: f64,
    },
    /// The device gives no pictures.
    Lost {
        /// Why.
        detail: String,
    },
    /// It gives some again.
    Back,
    /// A picture could not be written.
    Unwritten {
        /// Why.
        detail: String,
    },
    /// The file is at its end, or the time is over.
    Ended {
        /// Pictures that were written.
        pictures: u32,
        /// Seconds of the video.
        after_s: f64,
    },
}

impl std::fmt::Display for Grabbed {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self {
            Self::Opened { size_px: [columns, rows], per_s } => {
                write!(f, "video of {columns} x {rows}, {per_s:.0} pictures a second")
            }
            Self::Picture { size_px: [columns, rows], at_s } => {
                write!(f, "picture of {columns} x {rows}, standing since {at_s:.2} s")
            }
            Self::First { at_s } => write!(
                f,
                "what stands in the video since {at_s:.2} s was there at the start, and is not taken: `grab --include-first` and a \
                 session's --include-existing take it"
            ),
            Self::Ticking { at_px: [column, row], change } => write!(
                f,
                "the video changes again and again around column {column}, row {row} alone, by {change:.1} grey values: that is taken for a \
                 clock or a cursor, and for no picture; name the place in masks_px"
            ),
            Self::Restless { for_s, at_px: [column, row], change, limit } => write!(
                f,
                "no picture of the video stood still for {for_s:.0} s: around column {column}, row {row} of the video it changes by up to \
                 {change:.1} grey values, {limit:.1} would be still; if that is a clock or a cursor, name the place in masks_px, else give \
                 change"
            ),
            Self::Lost { detail } => write!(f, "no video: {detail}; it is tried again"),
            Self::Back => f.write_str("the video is back"),
            Self::Unwritten { detail } => write!(f, "a picture of the video is lost: {detail}"),
            Self::Ended { pictures: 0, after_s } => {
                write!(
                    f,
                    "the video ended after {after_s:.1} s, and no picture in it stood still that was not there at its start"
                )
            }
            Self::Ended { pictures, after_s } => write!(f, "the video ended after {after_s:.1} s: {pictures} pictures"),
        }
    }
}

/// Why nothing can be grabbed.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum GrabError {
    /// There is no video.
    #[error("{from}: {detail}")]
    Video {
        /// As it was named.
        from: String,
        /// Why.
        detail: String,
    },
    /// The radiograph lies outside.
    #[error("crop_px {crop_px:?} does not lie within the video of {} x {} pixels", .size_px[0], .size_px[1])]
    Crop {
        /// As given.
        crop_px: [u32; 4],
        /// Columns and rows.
        size_px: [usize; 2],
    },
    /// The process that grabs.
    #[error("the process that grabs video cannot be started ({detail})")]
    Start {
        /// What the system said.
        detail: String,
    },
}

/// Grabs until the file or the time is at its end, or `stop` is set. Pictures become files of `folder` that appear whole.
///
/// # Errors
/// When there is no video (unless it is waited for), or no such part of it.
pub fn grab(
    settings: &VideoSettings,
    folder: &Path,
    options: GrabOptions,
    stop: &AtomicBool,
    tell: &mut dyn FnMut(Grabbed),
) -> Result<(), GrabError> {
    let mut grabbing = Grabbing {
        settings,
        options,
        stop,
        tell,
        spool: Spool::named(folder, "video"),
        stillness: Stillness::new(settings, !options.include_first),
        clock: Stopwatch::start(),
        started_us: host_now_us(),
        pictures: 0,
        is_lost: false,
    };
    grabbing.run()
}

struct Grabbing<'a> {
    settings: &'a VideoSettings,
    options: GrabOptions,
    stop: &'a AtomicBool,
    tell: &'a mut dyn FnMut(Grabbed),
    spool: Spool,
    stillness: Stillness,
    clock: Stopwatch,
    started_us: i64,
    pictures: u32,
    is_lost: bool,
}

impl Grabbing<'_> {
    fn run(&mut self) -> Result<(), GrabError> {
        let failed = |error: &CaptureError| GrabError::Video { from: self.settings.from.clone(), detail: error.to_string() };
        loop {
            match self.open() {
                Ok(Some(capture)) => {
                    if self.follow(capture)? {
                        return Ok(());
                    }
                }
                Ok(None) => {
                    self.end(self.elapsed_s());
                    return Ok(());
                }
                Err(error) if !self.options.wait || is_final(&error) => return Err(failed(&error)),
                Err(error) => self.lose(error.to_string()),
            }
            std::thread::sleep(AGAIN);
            if self.is_over(self.elapsed_s()) {
                self.end(self.elapsed_s());
                return Ok(());
            }
        }
    }

    /// Opens the video; `None` when it is all over before that.
    fn open(&self) -> Result<Option<Capture>, CaptureError> {
        let mut opening = Opening::of(&self.settings.from)?;
        let is_recording = Path::new(&self.settings.from).is_file();
        let watch = Stopwatch::start();
        loop {
            if let Some(capture) = opening.wait(LOOK)? {
                return Ok(Some(capture));
            }
            // The seconds of a recording are its own.
            let at_s = if is_recording { 0.0 } else { self.elapsed_s() };
            if self.is_over(at_s) {
                return Ok(None);
            }
            if !(watch.ms() < 1e3 * OPENS_WITHIN.as_secs_f64()) {
                return Err(CaptureError::Late { limit_s: OPENS_WITHIN.as_secs() });
            }
        }
    }

    /// Follows the video; whether that is all of it.
    fn follow(&mut self, capture: Capture) -> Result<bool, GrabError> {
        let (is_live, per_s) = (capture.is_live(), capture.per_s());
        self.stillness.expect(if capture.is_of_differences() { Leftover::DIFFERENCES } else { Leftover::EACH });
        let pictures = read_on(capture);
        let (mut number, mut size_px, mut silent_s) = (0u64, [0; 2], 0.0);
        loop {
            let at_s = if is_live { self.elapsed_s() } else { number as f64 / per_s };
            if self.is_over(at_s) {
                self.end(at_s);
                return Ok(true);
            }
            let picture = match pictures.recv_timeout(LOOK) {
                Ok(Ok(picture)) => picture,
                Ok(Err(error)) => {
                    return Err(GrabError::Video { from: self.settings.from.clone(), detail: error.to_string() });
                }
                Err(RecvTimeoutError::Timeout) => {
                    silent_s += LOOK.as_secs_f64();
                    if silent_s >= SILENT.as_secs_f64() {
                        self.lose(format!("no picture has come for {} s", SILENT.as_secs()));
                    }
                    continue;
                }
                Err(RecvTimeoutError::Disconnected) if is_live => {
                    self.lose("it gives no pictures".to_owned());
                    return Ok(false);
                }
                Err(RecvTimeoutError::Disconnected) => {
                    self.end(at_s);
                    return Ok(true);
                }
            };
            silent_s = 0.0;
            let at_s = if is_live { self.elapsed_s() } else { at_s };
            if size_px != [picture.width, picture.height] {
                size_px = [picture.width, picture.height];
                (self.tell)(Grabbed::Opened { size_px, per_s });
            }
            if std::mem::take(&mut self.is_lost) {
                (self.tell)(Grabbed::Back);
            }
            let picture = self.cropped(picture)?;
            let noted = self.stillness.take(picture, at_s);
            self.told(noted);
            number += 1;
            if !is_live && !self.options.at_once {
                let early_s = number as f64 / per_s - self.elapsed_s();
                std::thread::sleep(Duration::try_from_secs_f64(early_s).unwrap_or_default());
            }
        }
    }

    fn told(&mut self, noted: Noted) {
        match noted {
            Noted::Nothing => {}
            Noted::First { since_s } => (self.tell)(Grabbed::First { at_s: since_s }),
            Noted::Restless { for_s, at_px, change, limit } => (self.tell)(Grabbed::Restless { for_s, at_px, change, limit }),
            Noted::Ticking { at_px, change } => (self.tell)(Grabbed::Ticking { at_px, change }),
            Noted::Still(still) => {
                let size_px = [still.picture.width, still.picture.height];
                let since_us = self.started_us + (still.since_s * 1e6) as i64;
                match write_picture(&still.picture, since_us, self.settings, &self.spool) {
                    Ok(()) => {
                        self.pictures += 1;
                        (self.tell)(Grabbed::Picture { size_px, at_s: still.since_s });
                    }
                    Err(error) => (self.tell)(Grabbed::Unwritten { detail: error.to_string() }),
                }
            }
        }
    }

    fn cropped(&self, picture: Image<u8>) -> Result<Image<u8>, GrabError> {
        let Some(crop_px) = self.settings.crop_px else { return Ok(picture) };
        let [left, top, width, height] = crop_px.map(|n| n as usize);
        if left + width > picture.width || top + height > picture.height {
            return Err(GrabError::Crop { crop_px, size_px: [picture.width, picture.height] });
        }
        Ok(picture.part(&[left..left + width, top..top + height]))
    }

    fn lose(&mut self, detail: String) {
        if !std::mem::replace(&mut self.is_lost, true) {
            (self.tell)(Grabbed::Lost { detail });
        }
    }

    fn elapsed_s(&self) -> f64 {
        self.clock.ms() * 1e-3
    }

    fn is_over(&self, at_s: f64) -> bool {
        self.stop.load(Ordering::Relaxed) || self.options.seconds.is_some_and(|seconds| !(at_s < seconds))
    }

    fn end(&mut self, after_s: f64) {
        (self.tell)(Grabbed::Ended { pictures: self.pictures, after_s });
    }
}

/// The pictures of a video, read on a thread of their own: a driver may wait for one without end. Over when the channel is.
fn read_on(mut capture: Capture) -> Receiver<Result<Image<u8>, CaptureError>> {
    let (sender, pictures) = sync_channel(AHEAD);
    std::thread::spawn(move || {
        while let Some(picture) = capture.next().transpose() {
            let is_last = picture.is_err();
            if sender.send(picture).is_err() || is_last {
                return;
            }
        }
    });
    pictures
}

/// Waiting does not help.
fn is_final(error: &CaptureError) -> bool {
    matches!(error, CaptureError::Program { .. } | CaptureError::Channels { .. } | CaptureError::Size { .. })
}
