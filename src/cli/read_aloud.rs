//! Acquired frames that a command names: read, and what was masked or moved in them is said.

use std::path::Path;

use crate::acquire::{AcquireError, Domain, Frame, read_frame, read_frames};
use crate::reporter::Reporter;

/// [`read_frame`], aloud.
pub(super) fn frame_aloud(path: &Path, domain: Option<Domain>, reporter: &Reporter) -> Result<Frame, AcquireError> {
    let frame = read_frame(path, domain)?;
    say(path, &frame, reporter);
    Ok(frame)
}

/// [`read_frames`], aloud.
pub(super) fn frames_aloud(path: &Path, domain: Option<Domain>, reporter: &Reporter) -> Result<Vec<Frame>, AcquireError> {
    let frames = read_frames(path, domain)?;
    frames.iter().for_each(|frame| say(path, frame, reporter));
    Ok(frames)
}

fn say(path: &Path, frame: &Frame, reporter: &Reporter) {
    for words in &frame.altered {
        reporter.warn("frame altered", format_args!("{}: {words}", path.display()));
    }
}
