//! One version of a file, offered for reading; how that ended is told to the folder it came from.

use std::ffi::OsString;
use std::path::PathBuf;
use std::sync::mpsc::Sender;

use super::notices::Held;
use super::source::{Arrival, Reading};
use super::{AcquireError, Domain, Fault, read_open};
use crate::foreign::{self, FileStamp, ForeignReader, Kind, OpenFault, OpenFile};

/// How reading ended.
#[derive(Debug)]
pub(super) enum Outcome {
    /// Delivered; the file's hash.
    Frames(String),
    /// The content that was delivered before.
    Same(String),
    /// Cannot be used.
    Refused,
    /// Not whole.
    Unfinished(Fault),
    /// Grew, or changed while it was read.
    Changed,
    /// Rewritten before it was read.
    Overwritten,
    /// Gone before it was opened.
    Missing,
    /// Dropped without being read.
    Unread,
}

/// What the folder is told.
#[derive(Debug)]
pub(super) struct Told {
    pub(super) offer: u64,
    pub(super) name: OsString,
    pub(super) label: String,
    /// The name had no such file any more when the offer was made.
    pub(super) gone: bool,
    pub(super) outcome: Outcome,
}

/// One version of one file.
pub(super) struct Offer {
    pub(super) id: u64,
    pub(super) name: OsString,
    pub(super) path: PathBuf,
    pub(super) label: String,
    pub(super) stamp: FileStamp,
    pub(super) held: Option<Held>,
    pub(super) earlier: Option<String>,
    pub(super) gone: bool,
    pub(super) take_holes: bool,
    pub(super) domain: Option<Domain>,
    pub(super) reader: ForeignReader,
    pub(super) told: Sender<Told>,
}

/// Tells how the reading ended, also when it never began.
struct Teller {
    offer: u64,
    name: OsString,
    label: String,
    gone: bool,
    told: Sender<Told>,
    outcome: Outcome,
}

impl Teller {
    fn tell(mut self, outcome: Outcome) {
        self.outcome = outcome;
    }
}

impl Drop for Teller {
    fn drop(&mut self) {
        let outcome = std::mem::replace(&mut self.outcome, Outcome::Unread);
        let (name, label) = (std::mem::take(&mut self.name), std::mem::take(&mut self.label));
        // A folder that is no longer watched does not need to know.
        let _ = self.told.send(Told { offer: self.offer, name, label, gone: self.gone, outcome });
    }
}

impl Offer {
    pub(super) fn into_arrival(self, seen_us: i64) -> Arrival {
        let (label, modified_us, bytes) = (self.label.clone(), (self.stamp.modified_ns / 1000) as i64, self.stamp.bytes);
        let teller = Teller {
            offer: self.id,
            name: self.name.clone(),
            label: self.label.clone(),
            gone: self.gone,
            told: self.told.clone(),
            outcome: Outcome::Unread,
        };
        Arrival::new(label, seen_us, modified_us, bytes, move || {
            let (outcome, reading) = self.read();
            teller.tell(outcome);
            reading
        })
    }

    fn read(self) -> (Outcome, Reading) {
        let Self { path, label, stamp, held, earlier, take_holes, domain, reader, .. } = self;
        let refused = |fault: Fault| (Outcome::Refused, Reading::Refused(AcquireError::Refused { file: label.clone(), fault }));
        let limit = reader.limits(Kind::Frames).file_bytes;
        let opened = match &held {
            Some(held) => held.open.file.try_clone().map(|file| OpenFile { file, stamp: held.open.stamp }).map_err(OpenFault::Io),
            None => foreign::open_regular(&path, u64::MAX),
        };
        let open = match opened {
            Ok(open) => open,
            Err(OpenFault::Io(error)) if error.kind() == std::io::ErrorKind::NotFound => {
                return (Outcome::Missing, Reading::Later);
            }
            Err(fault) => return (Outcome::Refused, Reading::Refused(AcquireError::from_open(label, fault))),
        };
        if stamp.bytes > limit {
            return refused(Fault::FileSize { bytes: stamp.bytes, limit });
        }
        let Ok(watched) = open.file.try_clone() else { return (Outcome::Changed, Reading::Later) };
        // A version that lay still and gave way to one that is no larger is lost; a larger one may be the same copy going on.
        let changed = || match watched.metadata().map(|metadata| FileStamp::of(&metadata)) {
            Ok(now) if now == stamp => None,
            Ok(now) if now.bytes <= stamp.bytes => Some(Outcome::Overwritten),
            _ => Some(Outcome::Changed),
        };
        if let Some(outcome) = changed() {
            return (outcome, Reading::Later);
        }
        let holes = foreign::has_hole(&watched, stamp.bytes);
        if holes && !take_holes {
            return (Outcome::Unfinished(Fault::Unwritten), Reading::Later);
        }
        let read = read_open(&reader, open, &path, domain);
        if let Some(outcome) = changed() {
            return (outcome, Reading::Later);
        }
        match read {
            Ok(mut frames) => {
                let sha256 = frames.first().map(|frame| frame.sha256.clone()).unwrap_or_default();
                if earlier.as_deref() == Some(sha256.as_str()) {
                    return (Outcome::Same(sha256.clone()), Reading::Same { sha256 });
                }
                if holes {
                    let note = "parts of the file were never written and are read as zeros";
                    frames.iter_mut().for_each(|frame| frame.notes.push(note.to_owned()));
                }
                (Outcome::Frames(sha256), Reading::Frames { frames, earlier })
            }
            Err(fault) if fault.may_be_unfinished() => (Outcome::Unfinished(fault), Reading::Later),
            Err(fault) => refused(fault),
        }
    }
}
