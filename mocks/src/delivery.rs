//! How frames reach the receiver: as files of the watched folder, over DICOM, on a monitor.

use std::path::{Path, PathBuf};
use std::time::Duration;

use serde_json::{Value, json};

use crate::MockError;
use crate::dicom::{Drawn, FrameTags, deliver, encode};
use crate::kit::arm;
use crate::monitor::{Monitor, Screen};
use crate::script::Script;
use crate::storescu::Console;

/// How frames reach the receiver.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub enum Way {
    /// Files of the watched folder.
    #[default]
    Folder,
    /// C-STORE to this port of this machine.
    Dicom(u16),
    /// A monitor whose pictures come through the pipe at this path.
    Monitor(PathBuf),
    /// A recording of the monitor, which was made beforehand.
    Recording(PathBuf),
}

impl Way {
    /// The folder in the kit's in which the files of frames appear: but for the watched one nobody looks there, and they tell what was shown
    /// or sent.
    #[must_use]
    pub fn folder(&self) -> &'static str {
        if *self == Self::Folder { "frames" } else { "exported" }
    }
}

/// The frame of this exposure (from 0) arrives in two halves, as over a slow share or a slow line.
const HALVED: usize = 1;
/// Pause between the halves.
const HALF_PAUSE_S: f64 = 0.4;

/// Where a frame goes besides its file.
enum Wire {
    Folder,
    Console(Console),
    Monitor(Monitor),
    Recording,
}

/// Frames that wait for their exposures.
pub struct Delivery<'a> {
    script: &'a Script<'a>,
    frames: &'a [Drawn],
    delivered: usize,
    half: Option<(PathBuf, Vec<u8>, f64)>,
    started_us: i64,
    wire: Wire,
}

impl<'a> Delivery<'a> {
    /// `frames` are those of the script's exposures, in order.
    ///
    /// # Errors
    /// When the lab says nothing of the frames' size.
    pub fn new(script: &'a Script<'a>, frames: &'a [Drawn], way: &Way) -> Result<Self, MockError> {
        let wire = match way {
            Way::Folder => Wire::Folder,
            Way::Dicom(port) => Wire::Console(Console::to_port(*port)),
            Way::Monitor(pipe) => Wire::Monitor(Monitor::on(pipe, arm(script.lab)?.size_px)),
            Way::Recording(_) => Wire::Recording,
        };
        Ok(Self { script, frames, delivered: 0, half: None, started_us: 0, wire })
    }

    /// Whether whoever takes the frames is there, as far as that can be seen: a monitor is looked at.
    #[must_use]
    pub fn is_awaited(&self) -> bool {
        match &self.wire {
            Wire::Monitor(monitor) => monitor.is_seen(),
            Wire::Folder | Wire::Console(_) | Wire::Recording => true,
        }
    }

    /// The script begins now, by the host's clock.
    pub fn start(&mut self, now_us: i64) {
        self.started_us = now_us;
    }

    /// Delivers what is due at `now_s` of the script.
    ///
    /// # Errors
    /// When a file cannot be written.
    pub fn advance(&mut self, now_s: f64, tell: &mut dyn FnMut(Value)) -> Result<(), MockError> {
        if let Some((path, rest, _)) = self.half.take_if(|(_, _, at_s)| now_s >= *at_s) {
            append(&path, &rest)?;
        }
        if let Wire::Console(console) = &self.wire {
            console.events().for_each(&mut *tell);
        }
        let index = self.delivered;
        let due = index < self.script.count() && now_s >= self.script.frame_s(index);
        let Some(frame) = self.frames.get(index).filter(|_| due) else { return Ok(()) };
        let acquired_us = self.started_us + (self.script.start_s(index) * 1e6) as i64;
        let bytes = encode(&FrameTags { acquired_us: Some(acquired_us), ..frame.tags }, &frame.values)?;
        let path = &frame.path;
        let mut halved = false;
        match &self.wire {
            Wire::Folder if index == HALVED => {
                let (first, rest) = bytes.split_at(bytes.len() / 2);
                std::fs::write(path, first).map_err(MockError::io(path.display()))?;
                self.half = Some((path.clone(), rest.to_vec(), now_s + HALF_PAUSE_S));
                halved = true;
            }
            Wire::Folder | Wire::Recording => deliver(path, &bytes)?,
            Wire::Monitor(monitor) => {
                deliver(path, &bytes)?;
                monitor.show(Screen::of(&frame.values, frame.tags.size_px));
            }
            Wire::Console(console) => {
                deliver(path, &bytes)?;
                halved = index == HALVED;
                console.send(path, bytes, Duration::from_secs_f64(if halved { HALF_PAUSE_S } else { 0.0 }))?;
            }
        }
        self.delivered += 1;
        tell(json!({"event": "frame", "file": path, "halved": halved, "at_s": now_s}));
        Ok(())
    }

    /// Waits until what was handed over is on its way no more; how many frames there were.
    pub fn finish(&mut self, tell: &mut dyn FnMut(Value)) -> usize {
        if let Wire::Console(console) = &mut self.wire {
            console.finish(tell);
        }
        self.delivered
    }
}

fn append(path: &Path, bytes: &[u8]) -> Result<(), MockError> {
    use std::io::Write;
    let mut file = std::fs::OpenOptions::new().append(true).open(path).map_err(MockError::io(path.display()))?;
    file.write_all(bytes).map_err(MockError::io(path.display()))
}
