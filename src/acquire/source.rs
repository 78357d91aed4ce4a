//! The seam through which a session's frames come: a watched folder or a tree of them, and what a DICOM receiver or a video grabber puts
//! into one. Seeing is cheap and reading is slow, so they are apart: whoever reads decides the order and the thread. A replay takes its
//! frames from the log, and not through here: which files became frames, under which number and after which bytes of the lines, was decided
//! when they came through here, and the engine takes them as that was decided.

use super::{AcquireError, Fault, Frame};
use crate::foreign::NotRegular;

/// Where frames come from.
pub trait FrameSource: Send {
    /// What is new. Decodes nothing and waits for nothing; call it every 20 to 100 ms. `now_us` is the host clock.
    fn look(&mut self, now_us: i64) -> Vec<Sighting>;

    /// Nothing new is let in from now on; what is there is still seen by a few looks.
    fn close(&mut self) {}

    /// Whether something that was seen is on its way still: a file that is being written, or lies still for too short a time.
    fn is_expecting(&self) -> bool {
        false
    }

    /// What is on its way still will not be waited for any longer: each is reported.
    fn give_up(&mut self) -> Vec<Sighting> {
        Vec::new()
    }
}

/// What a look found.
#[derive(Debug)]
pub enum Sighting {
    /// Something lies still and can be read.
    Ready(Arrival),
    /// Something a person must hear of.
    Trouble(Trouble),
    /// The folder cannot be listed; said once.
    FolderLost {
        /// What the system said.
        detail: String,
    },
    /// The folder can be listed again; said once.
    FolderBack,
    /// Something that a person should know, and that costs no frame.
    Said {
        /// The kind of warning that this is.
        kind: &'static str,
        /// In words.
        words: String,
    },
}

/// A file from which no frame came, or not every version of which became one.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum Trouble {
    /// Deleted before it could be read.
    #[error("{label}: the file was deleted before it could be read; let the console keep its files")]
    Vanished {
        /// The file.
        label: String,
    },
    /// Rewritten before it could be read: one frame is lost.
    #[error("{label}: the file was overwritten before it was read; let the console give every frame its own file")]
    Overwritten {
        /// The file.
        label: String,
    },
    /// A pipe, socket, device or folder that is named like an image.
    #[error("{label}: it is {}, expected a file; it was not opened", .kind.words())]
    NotAFile {
        /// The file.
        label: String,
        /// What it is.
        kind: NotRegular,
    },
    /// A picture whose name says that it is hidden, or on its way still, lies there and does not change.
    #[error(
        "{label}: a picture lies still under a name that begins with a dot or ends as that of a copy on its way, and those are not read; let the console write it under another name, or rename it"
    )]
    Hidden {
        /// The file.
        label: String,
    },
    /// Something came into a folder below the watched one.
    #[error(
        "{label}: something came into this sub-folder of the watched folder, and sub-folders are not read; let the console write into the watched folder itself, or set \"sub_folders\": true under \"frames\" in the session"
    )]
    SubFolder {
        /// The folder.
        label: String,
    },
    /// More folders than are watched.
    #[error(
        "more than {most} folders lie below the frame folder: what comes into the oldest of them is not read; move old ones away, and start the session again"
    )]
    TooManyFolders {
        /// So many are.
        most: usize,
    },
    /// Did not become whole for a long time. Should it be completed later, it becomes a frame.
    #[error("{label}: the file has not been completed: {fault}")]
    Unfinished {
        /// The file.
        label: String,
        /// What is missing.
        fault: Fault,
    },
    /// The session ended before the file lay still.
    #[error(
        "{label}: the file was still being written when the session ended, and is not part of it; tie it to its exposure with `sidecarm attach`"
    )]
    StillWritten {
        /// The file.
        label: String,
    },
    /// A sender went away in the middle of an object.
    #[error(
        "half a DICOM object: its sender went away after {bytes} bytes (association {association}); nothing of it is taken, send it again"
    )]
    HalfReceived {
        /// The sender's connection, counted from 1.
        association: u64,
        /// What had come of it.
        bytes: u64,
    },
    /// Nothing comes of the video; what it shows meanwhile is lost.
    #[error("no frames come of the video: {detail}")]
    NoVideo {
        /// Why.
        detail: String,
    },
    /// An object that came over DICOM was refused, and its sender was told so.
    #[error("an object that came over DICOM is not taken: {detail} (association {association})")]
    NotReceived {
        /// The sender's connection, counted from 1.
        association: u64,
        /// Why.
        detail: String,
    },
}

impl Trouble {
    /// The kind of warning that this is.
    #[must_use]
    pub fn kind(&self) -> &'static str {
        match self {
            Self::Vanished { .. } => "frame deleted before it was read",
            Self::Overwritten { .. } => "frame overwritten before it was read",
            Self::NotAFile { .. } => "not a file",
            Self::SubFolder { .. } => "sub-folder not read",
            Self::Hidden { .. } => "hidden file not read",
            Self::TooManyFolders { .. } => "too many sub-folders",
            Self::Unfinished { .. } => "unfinished frame",
            Self::StillWritten { .. } => "frame still being written",
            Self::HalfReceived { .. } => "half a DICOM object",
            Self::NotReceived { .. } => "DICOM object not taken",
            Self::NoVideo { .. } => "no video",
        }
    }

    /// In words, that it was none: the file came whole after all.
    #[must_use]
    pub fn mended(&self) -> String {
        match self {
            Self::Unfinished { label, .. } => format!("{label}: the file has been completed after all, and is not lost"),
            Self::Vanished { label } => format!("{label}: the file is back, and is not lost"),
            Self::Hidden { label } => format!("{label}: the file has another name now, and is not lost"),
            other => format!("not lost after all: {other}"),
        }
    }
}

/// A version of a file that was delivered before another.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Earlier {
    /// SHA-256 of its content.
    pub sha256: String,
    /// It ended in zeros where the later version goes on: it was delivered unfinished.
    pub was_unfinished: bool,
}

/// How reading ended.
#[derive(Debug)]
pub enum Reading {
    /// Whole, stable, decoded.
    Frames {
        /// The images of the file, in order.
        frames: Vec<Frame>,
        /// The version of this file that was delivered before.
        earlier: Option<Earlier>,
    },
    /// Rewritten with the content that was delivered before: no new frame.
    Same {
        /// Its hash.
        sha256: String,
    },
    /// Not whole yet, changed meanwhile, or gone. The source offers it again or reports it.
    Later,
    /// One refused file; not tried again until it changes.
    Refused(AcquireError),
}

/// Something that can be read. Dropped unread, it is offered again by a folder.
pub struct Arrival {
    label: String,
    seen_us: i64,
    modified_us: i64,
    bytes: u64,
    read: Box<dyn FnOnce() -> (Reading, Vec<Trouble>) + Send>,
}

impl std::fmt::Debug for Arrival {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "Arrival({}, {} bytes)", self.label, self.bytes)
    }
}

impl Arrival {
    pub(super) fn new(
        label: String,
        seen_us: i64,
        modified_us: i64,
        bytes: u64,
        read: impl FnOnce() -> (Reading, Vec<Trouble>) + Send + 'static,
    ) -> Self {
        Self { label, seen_us, modified_us, bytes, read: Box::new(read) }
    }

    /// What it may be called before it is read.
    #[must_use]
    pub fn label(&self) -> &str {
        &self.label
    }

    /// Host clock of the look that first saw this version.
    #[must_use]
    pub fn seen_us(&self) -> i64 {
        self.seen_us
    }

    /// When the file was changed, by the clock of its file system: the order within a burst.
    #[must_use]
    pub fn modified_us(&self) -> i64 {
        self.modified_us
    }

    /// Size of the file.
    #[must_use]
    pub fn bytes(&self) -> u64 {
        self.bytes
    }

    /// Reads it: slow, on any thread.
    #[must_use]
    pub fn read(self) -> Reading {
        self.read_and_mend().0
    }

    /// The same, with the troubles that were reported of this file and have turned out to be none: what was lost then is here.
    #[must_use]
    pub fn read_and_mend(self) -> (Reading, Vec<Trouble>) {
        (self.read)()
    }
}
