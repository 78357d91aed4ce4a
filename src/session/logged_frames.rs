//! The frames of a log as its session registered them: read from the log, the console's doing undone, the panel calibrated.

use std::path::Path;
use std::sync::Arc;

use super::SessionError;
use super::import::Import;
use super::recorded::Recorded;
use crate::acquire::Frame;
use crate::record::{FrameAssembler, LogReader, Tolerance};

/// Gives the frames of `log` whose number is `wanted` to `take`, one after the other, and returns what of the log could not be read.
///
/// # Errors
/// When the file cannot be read, is no log, or holds no session.
pub fn logged_frames(
    log: &Path,
    wanted: &dyn Fn(u32) -> bool,
    take: &mut dyn FnMut(u32, Arc<Frame>),
) -> Result<Vec<String>, SessionError> {
    let no_session = || SessionError::NoSession { path: log.display().to_string(), detail: "no session setup".to_owned() };
    let import = Import::of(&Recorded::read(log)?.setup.ok_or_else(no_session)?);
    let mut assembler = FrameAssembler::default();
    let mut tolerance = Tolerance::default();
    let mut numbered = 0;
    for entry in LogReader::open(log)? {
        let Some(Some(frame)) = tolerance.take(assembler.push(&entry)) else { continue };
        // Logs without numbers count by order.
        numbered = if frame.number > 0 { frame.number } else { numbered + 1 };
        if wanted(numbered) {
            take(numbered, import.frame(&Arc::new(frame)).frame);
        }
    }
    Ok(tolerance.losses())
}
