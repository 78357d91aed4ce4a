//! The newest frames of a session's folder, read before the session as the session would read them.

use std::cmp::Reverse;
use std::time::Duration;

use super::SessionError;
use super::file::Setup;
use super::sources::frame_source;
use crate::acquire::{AcquireError, Arrival, Fault, Frame, FrameSource, Reading, Sighting, Trouble};
use crate::reporter::Reporter;
use crate::time::{Stopwatch, host_now_us};

/// So many files are read until one is a frame.
const FEW: usize = 3;
/// How often the folder is looked at.
const LOOK: Duration = Duration::from_millis(25);
/// What lies still is offered within the first of these; what comes of none until the second is being written.
const STILL_MS: f64 = 250.0;
const LAST_MS: f64 = 2000.0;
/// A file that is not whole, or ends in zeros, is waited for no longer than this after it was last written to: here that is over.
const LATER_US: i64 = 11_000_000;
/// Looks until what is taken as it is has been offered again.
const LATER_LOOKS: usize = 3;

/// What lies in the folder.
#[derive(Debug)]
pub(super) enum Found {
    /// The first image of a file.
    Frame(Box<Frame>),
    /// What no frame will come of, in words.
    Unreadable(String),
}

/// The newest files until one is a frame; files of another kind are no fault.
///
/// # Errors
/// When the folder cannot be watched.
pub(super) fn newest_files(setup: &Setup, reporter: &Reporter) -> Result<Vec<Found>, SessionError> {
    let mut source = frame_source(setup, true, reporter)?;
    let (mut found, mut ready) = (Vec::new(), Vec::new());
    let watch = Stopwatch::start();
    loop {
        take(source.look(host_now_us()), &mut found, &mut ready);
        let limit_ms = if ready.is_empty() { LAST_MS } else { STILL_MS };
        if !source.is_expecting() || watch.ms() > limit_ms {
            break;
        }
        std::thread::sleep(LOOK);
    }
    ready.sort_by_key(|arrival| Reverse((arrival.modified_us(), arrival.label().to_owned())));
    for arrival in ready.into_iter().take(FEW) {
        match read(source.as_mut(), arrival) {
            Ok(Some(frame)) => {
                found.push(Found::Frame(frame));
                break;
            }
            Ok(None) => {}
            Err(words) => found.push(Found::Unreadable(words)),
        }
    }
    Ok(found)
}

fn take(sightings: Vec<Sighting>, found: &mut Vec<Found>, ready: &mut Vec<Arrival>) {
    for sighting in sightings {
        match sighting {
            Sighting::Ready(arrival) => ready.push(arrival),
            Sighting::Trouble(trouble) => found.push(Found::Unreadable(trouble.to_string())),
            // That the folder is not there is another check.
            Sighting::FolderLost { .. } | Sighting::FolderBack | Sighting::Said { .. } => {}
        }
    }
}

/// The first image of a file; `None` where it is of another kind, or gone.
fn read(source: &mut dyn FrameSource, arrival: Arrival) -> Result<Option<Box<Frame>>, String> {
    let label = arrival.label().to_owned();
    let mut reading = arrival.read();
    for _ in 0..LATER_LOOKS {
        if !matches!(reading, Reading::Later) {
            break;
        }
        for sighting in source.look(host_now_us() + LATER_US) {
            match sighting {
                Sighting::Ready(again) if again.label() == label => reading = again.read(),
                Sighting::Trouble(Trouble::Unfinished { fault: Fault::NotAnImage { .. }, .. }) => return Ok(None),
                Sighting::Trouble(trouble @ Trouble::Unfinished { .. }) => return Err(trouble.to_string()),
                _ => {}
            }
        }
    }
    match reading {
        Reading::Frames { frames, .. } => Ok(frames.into_iter().next().map(Box::new)),
        Reading::Refused(AcquireError::Refused { fault: Fault::NotAnImage { .. }, .. }) => Ok(None),
        Reading::Refused(error) => Err(error.to_string()),
        Reading::Same { .. } | Reading::Later => Ok(None),
    }
}
