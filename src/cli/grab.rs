//! `sidecarm grab`: radiographs off a video output, as files.

use std::io::Read;
use std::path::PathBuf;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

use crate::acquire::video::{GrabError, GrabOptions, Grabbed, Rectangle, VideoSettings, grab};
use crate::reporter::{Reporter, to_stdout};

/// Grab radiographs off a video output: each picture that stands still becomes a DICOM file.
///
/// A session does the same by itself with "video": {"from": "/dev/video0"} under its "frames"; this command finds out which crop and masks it
/// needs.
#[derive(Clone, Debug, clap::Args)]
#[command(after_help = "Examples:
  sidecarm grab /dev/video0 --into trial --seconds 30 --crop 420,0,1080,1080 --mask 420,0,1080,40
  sidecarm grab recording.avi --into frames --at-once

A monitor shows a picture until the next one. What does not change for --still-s is a frame, at the time at which it began to stand; an
empty screen, a picture that comes back unchanged and what stands there at the beginning are none. Clocks and cursors that never
stand still are named with their place: mask them.

Exit code 0: ended; 1: no video, or nothing in it stood still (said why).")]
pub struct GrabArgs {
    /// A capture device (/dev/video0, or its number) or a video file
    pub from: String,
    /// Folder for the pictures, which must be there
    #[arg(long, value_name = "FOLDER")]
    pub into: PathBuf,
    /// The radiograph within the video: columns from the left, rows from the top, width, height
    #[arg(long, value_name = "L,T,W,H", value_parser = rectangle)]
    pub crop: Option<Rectangle>,
    /// A part of the video that changes while the picture stands (clock, cursor); may be given several times
    #[arg(long, value_name = "L,T,W,H", value_parser = rectangle)]
    pub mask: Vec<Rectangle>,
    /// Signal = (grey/255)^gamma, for consoles that apply nothing else; frames are then linear
    #[arg(long)]
    pub gamma: Option<f64>,
    /// Metal is shown white
    #[arg(long)]
    pub metal_white: bool,
    /// A picture that does not change for so long stands still
    #[arg(long, value_name = "S")]
    pub still_s: Option<f64>,
    /// Mean change of a block of 16 x 16 pixels up to which a picture stands still, grey values; learnt when absent
    #[arg(long, value_name = "GREY")]
    pub change: Option<f64>,
    /// End after so many seconds of the video
    #[arg(long, value_name = "S")]
    pub seconds: Option<f64>,
    /// Read a file as fast as it goes, not at its own pace
    #[arg(long)]
    pub at_once: bool,
    /// Also take the picture that stands there at the beginning
    #[arg(long)]
    pub include_first: bool,
    /// Print a line of JSON for each event
    #[arg(long)]
    pub json: bool,
    /// All of this as a session says it
    #[arg(long, hide = true)]
    pub settings: Option<String>,
    /// Started by a session: ends with standard input, and waits for a device that is not there
    #[arg(long, hide = true)]
    pub attended: bool,
}

fn rectangle(text: &str) -> Result<Rectangle, String> {
    let numbers: Option<Vec<u32>> = text.split(',').map(|number| number.trim().parse().ok()).collect();
    let four = numbers.and_then(|numbers| <Rectangle>::try_from(numbers).ok());
    four.ok_or_else(|| "expected four whole numbers: columns from the left, rows from the top, width, height".to_owned())
}

/// Why nothing was grabbed.
#[derive(Debug, thiserror::Error)]
pub enum GrabCommandError {
    /// A setting that cannot be.
    #[error("{key} is {found}, expected {expected}")]
    Setting {
        /// Which.
        key: &'static str,
        /// As given.
        found: String,
        /// What would be right.
        expected: &'static str,
    },
    /// The folder.
    #[error("{}: there is no such folder; make it first", .0.display())]
    Folder(PathBuf),
    /// Settings of a session, from another version.
    #[error("the session's settings are not understood ({0})")]
    Settings(#[from] serde_json::Error),
    /// No video.
    #[error(transparent)]
    Video(#[from] GrabError),
}

/// Grabs until the end; the exit code.
///
/// # Errors
/// When there is no video, or a setting is wrong.
pub fn run(args: &GrabArgs, reporter: &Reporter) -> Result<u8, GrabCommandError> {
    let settings = match &args.settings {
        Some(text) => serde_json::from_str(text)?,
        None => typed(args),
    };
    if let Some((key, found, expected)) = settings.wrong() {
        return Err(GrabCommandError::Setting { key, found, expected });
    }
    if !args.into.is_dir() {
        return Err(GrabCommandError::Folder(args.into.clone()));
    }
    let stop = Arc::new(AtomicBool::new(false));
    if args.attended {
        let stop = Arc::clone(&stop);
        std::thread::spawn(move || {
            let _ = std::io::stdin().lock().read_to_end(&mut Vec::new());
            stop.store(true, Ordering::Relaxed);
        });
    }
    let options =
        GrabOptions { seconds: args.seconds, at_once: args.at_once, include_first: args.include_first, wait: args.attended };
    let mut none = false;
    grab(&settings, &args.into, options, &stop, &mut |event| {
        none |= matches!(event, Grabbed::Ended { pictures: 0, .. });
        match (args.json, &event) {
            (true, _) => to_stdout(&serde_json::to_string(&event).unwrap_or_default()),
            (false, Grabbed::Picture { .. }) => to_stdout(&event.to_string()),
            (false, Grabbed::Restless { .. } | Grabbed::Ticking { .. } | Grabbed::Lost { .. } | Grabbed::Unwritten { .. }) => {
                reporter.warn("video", &event)
            }
            (false, Grabbed::Opened { .. } | Grabbed::First { .. } | Grabbed::Back | Grabbed::Ended { .. }) => {
                reporter.note(&event)
            }
        }
    })?;
    Ok(u8::from(none && !args.attended))
}

fn typed(args: &GrabArgs) -> VideoSettings {
    let usual = VideoSettings::of(&args.from);
    VideoSettings {
        crop_px: args.crop,
        masks_px: args.mask.clone(),
        gamma: args.gamma,
        metal_white: args.metal_white,
        still_s: args.still_s.unwrap_or(usual.still_s),
        change: args.change,
        ..usual
    }
}
