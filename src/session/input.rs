//! What a session takes in, and what comes of it.

use std::sync::Arc;

use super::edit::BeadEdit;
use super::editing::EditJob;
use super::pictures::PictureDigest;
use super::posed::Posed;
use super::posing::PoseJob;
use crate::acquire::Frame;
use crate::telemetry::{DeviceKind, Sample};

/// One thing that happened, with its host time.
#[derive(Clone, Debug)]
pub enum Input {
    /// Bytes from a serial line.
    Bytes {
        /// Which line.
        device: DeviceKind,
        /// Increases with every opening of the port.
        epoch: u32,
        /// Arrival.
        host_us: i64,
        /// As read.
        bytes: Vec<u8>,
    },
    /// A frame was found in the folder.
    Frame {
        /// Its pixels and tags; [`Frame::number`] is given.
        frame: Arc<Frame>,
        /// Arrival.
        host_us: i64,
    },
    /// A frame came whose pixels are not in the log any more: it is bound as all are, and nothing is made of it.
    Seen {
        /// Without pixels; [`Frame::number`] is given.
        frame: Box<Frame>,
        /// What tells its picture from others.
        picture: Option<PictureDigest>,
        /// Arrival.
        host_us: i64,
    },
    /// Time passes while nothing happens.
    Tick {
        /// Now.
        host_us: i64,
    },
    /// A frame that was announced with [`Output::Bound`] is registered now.
    Develop {
        /// Which.
        number: u32,
    },
    /// A person has edited the beads of a frame.
    Edit {
        /// Which.
        number: u32,
        /// How.
        edit: BeadEdit,
        /// When it was asked for.
        host_us: i64,
    },
    /// A person has noted something of a frame.
    Note {
        /// Which.
        number: u32,
        /// What; nothing takes back what was noted before.
        words: String,
        /// When it was written.
        host_us: i64,
    },
    /// The image of an accepted frame prefers another pose: it says nothing about where the specimen lies.
    ImageDisagrees {
        /// Which.
        number: u32,
    },
}

/// What came out of an input.
#[derive(Clone, Debug)]
pub enum Output {
    /// A decoded sample.
    Sample {
        /// Which line.
        device: DeviceKind,
        /// Arrival of the bytes that completed it.
        host_us: i64,
        /// The sample.
        sample: Box<Sample>,
    },
    /// A fault in the byte stream.
    Fault {
        /// Which line.
        device: DeviceKind,
        /// Arrival.
        host_us: i64,
        /// In words.
        detail: String,
    },
    /// All that telemetry will say about a frame is known: it can be registered.
    Bound {
        /// Which.
        number: u32,
    },
    /// A frame that was handed on without an exposure has got one; where its pixels are still there, [`Output::Bound`] follows and it is
    /// developed again.
    BoundLate {
        /// Which.
        number: u32,
        /// For a person.
        words: String,
    },
    /// A registration to be run; its result goes to [`Engine::registered`] before the next [`Input::Develop`].
    Job(Box<PoseJob>),
    /// One that cannot be run, for the frame's picture is gone; it goes to [`Engine::registered`] as one that failed.
    PictureLost {
        /// Without the picture.
        job: Box<PoseJob>,
        /// Why, for a person.
        words: String,
    },
    /// An edited frame to be posed again; its result is ready to be rendered and compared.
    Edit(Box<EditJob>),
    /// An edit that comes to nothing.
    NotEdited {
        /// The frame that it was of.
        number: u32,
        /// Why, for a person.
        words: String,
    },
    /// A note.
    Noted {
        /// The frame that it is of.
        number: u32,
        /// What it says.
        words: String,
    },
    /// A frame is ready to be rendered and compared.
    Posed(Box<Posed>),
}
