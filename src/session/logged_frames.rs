//! The frames of a log as its session registered them: read from the log, the console's doing undone, the panel calibrated.

use std::path::Path;
use std::sync::Arc;

use super::SessionError;
use super::import::Import;
use super::log_inputs::LogInputs;
use super::recorded::Recorded;
use crate::acquire::Frame;
use crate::record::LogReader;

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
    let mut inputs = LogInputs::default();
    for entry in LogReader::open(log)? {
        if let Some(frame) = inputs.frame(&entry).filter(|frame| wanted(frame.number)) {
            take(frame.number, import.frame(&frame, None).frame);
        }
    }
    Ok(inputs.tolerance.losses())
}
