//! Why nothing could be done with a log.

use std::path::PathBuf;

use crate::image::ImageFileError;
use crate::record::RecordError;

/// Why nothing could be done with a log. What is damaged in one that can be read is told beside the result.
#[derive(Debug, thiserror::Error)]
pub enum LogbookError {
    /// The log, or the one that is written.
    #[error(transparent)]
    Record(#[from] RecordError),
    /// An output is an input.
    #[error(transparent)]
    Overwrites(#[from] ImageFileError),
    /// A file or folder that is written.
    #[error("{path}: {source}", path = path.display())]
    Out {
        /// The file or folder.
        path: PathBuf,
        /// What the system said.
        source: std::io::Error,
    },
    /// A table would replace a file.
    #[error("{path}: exists already, and tables are not written over; choose another --out", path = path.display())]
    TableExists {
        /// The file.
        path: PathBuf,
    },
    /// A video of a session's pairs.
    #[error("{path}: {detail}", path = path.display())]
    Video {
        /// The file.
        path: PathBuf,
        /// What is wrong with it.
        detail: String,
    },
    /// Nothing was recorded between the two times.
    #[error(
        "{path}: nothing lies between --from {from_s:.3} s and --to {to_s:.3} s of the log, which is {length_s:.3} s long",
        path = path.display()
    )]
    NothingWithin {
        /// The log.
        path: PathBuf,
        /// From its start.
        from_s: f64,
        /// From its start.
        to_s: f64,
        /// Of the log.
        length_s: f64,
    },
    /// A log that holds no session.
    #[error("{path}: no session in this log (no session setup in it), so there is nothing that could be {todo}", path = path.display())]
    NoSession {
        /// The log.
        path: PathBuf,
        /// What was asked for.
        todo: &'static str,
    },
    /// Two logs are not of one session.
    #[error(
        "{first} and {second} are not of one session: {what} differs; a replay goes by one session, scene and calibration, so keep them apart",
        first = first.display(),
        second = second.display()
    )]
    Differ {
        /// One log.
        first: PathBuf,
        /// The other.
        second: PathBuf,
        /// In what.
        what: String,
    },
    /// Two logs were recorded at one time.
    #[error(
        "{first} ends {overlap_s:.3} s after {second} begins: logs of one session follow each other, and the bytes of devices that two programs \
         read at once cannot be put in order; are these two copies of one log?",
        first = first.display(),
        second = second.display()
    )]
    Overlap {
        /// The log that begins first.
        first: PathBuf,
        /// The log that begins next.
        second: PathBuf,
        /// By how much.
        overlap_s: f64,
    },
    /// A log of an earlier version.
    #[error(
        "{path}: its frames have no numbers (a log of an earlier version): nothing says for certain which pose is of which frame, so it can be \
         told and checked, and not be {todo}",
        path = path.display()
    )]
    WithoutNumbers {
        /// The log.
        path: PathBuf,
        /// What was asked for.
        todo: &'static str,
    },
}
