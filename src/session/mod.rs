//! The live pipeline and its replay.
//!
//! ```text
//! ports, folder ─ live ─┬─ journal (log first) ─┐
//!                       └─ engine ─ workshop ───┴─ folder: strips, DRRs, pairs, report
//! log ────────── replay ─── engine ─ workshop ───┘
//! ```
//! The [`engine`] reads no clock and no device, so a replay computes what the session computed.

pub mod board;
pub mod crosscheck;
pub mod engine;
pub mod file;
pub mod folder;
pub mod live;
pub mod replay;

mod develop;
mod journal;

pub use develop::{Developed, Workshop};

/// Why a session or its replay failed.
#[derive(Debug, thiserror::Error)]
pub enum SessionError {
    /// The session file, or one that it names.
    #[error(transparent)]
    File(#[from] file::SessionFileError),
    /// The scene.
    #[error(transparent)]
    Scene(#[from] crate::scene::SceneError),
    /// The renderer.
    #[error(transparent)]
    Render(#[from] crate::render::RenderError),
    /// The bead layout.
    #[error("{path}: {detail}")]
    Beads {
        /// The file.
        path: String,
        /// What is wrong.
        detail: String,
    },
    /// The log.
    #[error(transparent)]
    Record(#[from] crate::record::RecordError),
    /// Report, strips or DRRs.
    #[error(transparent)]
    Report(#[from] crate::report::ReportError),
    /// An image file.
    #[error(transparent)]
    Image(#[from] crate::image::ImageFileError),
    /// The session's folder.
    #[error("{path}: {source}")]
    Folder {
        /// The folder.
        path: String,
        /// What the system said.
        source: std::io::Error,
    },
    /// The session's folder holds a log already.
    #[error("{path}: there is a session in this folder already; choose another --out, logs are never written over")]
    Occupied {
        /// The log found.
        path: String,
    },
    /// Threads of the serial ports.
    #[error("cannot start the serial ports' threads: {source}")]
    Runtime {
        /// What the system said.
        source: std::io::Error,
    },
    /// A thread died.
    #[error("the rendering thread ended unexpectedly; the log up to now is complete")]
    WorkshopDied,
    /// The log is not one of a session.
    #[error("{path}: no session in this log ({detail})")]
    NoSession {
        /// The log.
        path: String,
        /// What is missing.
        detail: String,
    },
}
