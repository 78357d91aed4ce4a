//! The live pipeline and its replay.
//!
//! ```text
//! ports, folder, DICOM,
//! edits in the window ── live ─── log (first) ─ engine ─ workshop ─ folder: strips, DRRs, pairs, report
//! log ────────── replay ──────────────── engine ─ workshop ─ folder
//!                                       └─────────┴─ broadcast: OpenIGTLink
//! ```
//! Before a session, [`newest`] and [`rehearsal`] send what is there, and what is made up, the same way. [`logbook`] is what is done with a
//! log afterwards: told, checked, cut, joined, tabulated, redacted.
//! The [`engine`] reads no clock and no device, so a replay computes what the session computed.

pub mod attach;
pub mod board;
pub mod crosscheck;
pub mod declared;
pub mod edit;
pub mod engine;
pub mod file;
pub mod folder;
mod hearing;
pub mod import;
mod input;
pub mod inputs;
pub mod live;
pub mod logbook;
pub mod newest;
pub mod rehearsal;
pub mod replay;
pub mod servers;
mod replay_board;
mod replay_report;

mod adapters;
mod album;
mod against_log;
mod air_word;
mod as_recorded;
mod at_exposure;
mod background;
mod basis;
mod bell;
mod board_state;
mod bound;
mod broadcast;
mod busy;
mod chime;
mod chosen_k;
mod depth_jump;
mod develop;
mod developed;
mod editing;
mod editor;
mod event;
mod fault;
mod file_error;
mod image_difference;
mod intake;
mod intensifier;
mod jobs;
mod left_out;
mod lines;
mod link_view;
mod log;
mod log_inputs;
mod logged_frames;
mod losses;
mod named_files;
mod newest_files;
mod onlooker;
mod pace;
mod pair_marks;
mod pair_pictures;
mod pair_view;
mod park;
mod phase;
mod pictures;
mod places;
mod posed;
mod posing;
mod recorded;
mod records;
mod registrar;
mod remedy;
mod robot_state;
mod scribe;
mod shown;
mod sources;
mod stand;
mod standstill;
mod stated_k;
mod stop;
mod studies;
mod tie;
mod told_field;
mod told_twice;
mod tracks;
mod unwritten;
mod waiting;
mod warm;
mod whereabouts;
mod workshop;
mod yard;

pub use adapters::Adapters;
pub use developed::Developed;
pub use editing::EditJob;
pub use jobs::Order;
pub use logged_frames::logged_frames;
pub use posed::Posed;
pub use posing::{PoseJob, Registered};
pub use robot_state::{RobotCaution, RobotState};
pub use stop::Stop;
pub use tie::Disagreement;
pub use workshop::Workshop;

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
    /// The network that the scene asks for its scatter.
    #[error(transparent)]
    Scatter(#[from] crate::transport::NetworkError),
    /// The bead layout.
    #[error("{path}: {detail}")]
    Beads {
        /// The file.
        path: String,
        /// What is wrong.
        detail: String,
    },
    /// What is written would be taken for frames.
    #[error("{detail}; choose another --out")]
    AmongFrames {
        /// Which folder, and what it is.
        detail: String,
    },
    /// The log.
    #[error(transparent)]
    Record(#[from] crate::record::RecordError),
    /// OpenIGTLink.
    #[error(transparent)]
    Igtl(#[from] crate::igtl::IgtlError),
    /// Frames over DICOM.
    #[error(transparent)]
    Receiver(#[from] crate::acquire::ReceiverError),
    /// Frames off a video output.
    #[error(transparent)]
    Grab(#[from] crate::acquire::video::GrabError),
    /// Report, strips or DRRs.
    #[error(transparent)]
    Report(#[from] crate::report::ReportError),
    /// Several files of the session's folder.
    #[error("{0}")]
    Unwritten(String),
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
    /// The system gives no thread.
    #[error("cannot start a thread: {source}; too many processes run, or memory is short")]
    Thread {
        /// What the system said.
        source: std::io::Error,
    },
    /// Ended before anything was recorded.
    #[error("ended before the session began: folder and scene were still being opened, and nothing was recorded")]
    NotBegun,
    /// What is opened before a session died of a fault of this program.
    #[error("opening the {what} failed (a fault of this program); the session did not begin, and nothing was recorded")]
    OpeningDied {
        /// The frame folder, or the scene.
        what: &'static str,
    },
    /// A thread died.
    #[error("the rendering thread ended unexpectedly; the log up to now is complete")]
    WorkshopDied,
    /// A replay would replace what the session wrote.
    #[error("{path}: holds a session's own files, which a replay never replaces; choose another --out")]
    OwnFolder {
        /// The folder.
        path: String,
    },
    /// A file that the logged session read is nowhere.
    #[error(
        "{label} (SHA-256 {sha256}), which the session read, is neither where this machine last had it{there} nor near the log; name its folder with --data"
    )]
    InputMissing {
        /// Its name in the log.
        label: String,
        /// Its hash.
        sha256: String,
        /// What is there instead, in words that follow; empty where nothing is.
        there: &'static str,
    },
    /// The log is not one of a session.
    #[error("{path}: no session in this log ({detail})")]
    NoSession {
        /// The log.
        path: String,
        /// What is missing.
        detail: String,
    },
}
