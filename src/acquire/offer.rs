//! One version of a file, offered for reading; how that ended is told to the folder it came from.

use std::ffi::OsString;
use std::path::PathBuf;
use std::sync::mpsc::Sender;

use super::notices::Held;
use super::source::{Arrival, Earlier, Reading, Trouble};
use super::{AcquireError, Domain, Fault, read_open};
use crate::foreign::{self, FileStamp, ForeignReader, Kind, OpenFault, OpenFile, Written};

/// A version that became frames.
#[derive(Clone, Debug)]
pub(super) struct Delivered {
    sha256: String,
    /// What comes before the zeros at its end.
    written: Option<Written>,
}

/// A trouble that was reported and may turn out to be none: the file may come whole after all.
#[derive(Clone, Debug)]
pub(super) struct Reported {
    pub(super) trouble: Trouble,
    /// What there was of the file: one with the same content and more is the same file. `None` where only this very version is.
    pub(super) written: Option<Written>,
}

/// What zeros may be.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Zeros {
    /// Holes in the file and zeros at its end may yet be written.
    Unwritten,
    /// Only holes.
    HolesUnwritten,
    /// All are content.
    Content,
}

/// How reading ended.
#[derive(Debug)]
pub(super) enum Outcome {
    /// Delivered.
    Frames(Delivered),
    /// The content that was delivered before.
    Same(Delivered),
    /// Whole, but it ends in zeros that may yet be written.
    Blank,
    /// Cannot be used.
    Refused,
    /// Not whole, and what there is of it.
    Unfinished(Fault, Option<Written>),
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
    pub(super) earlier: Option<Delivered>,
    pub(super) reported: Vec<Reported>,
    pub(super) gone: bool,
    pub(super) zeros: Zeros,
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
            let mut mended = Vec::new();
            let (outcome, reading) = self.read(&mut mended);
            teller.tell(outcome);
            (reading, mended)
        })
    }

    /// `mended` gets what was reported of the file and is no trouble any more, now that it was read.
    fn read(self, mended: &mut Vec<Trouble>) -> (Outcome, Reading) {
        let Self { path, label, stamp, held, earlier, reported, zeros, domain, reader, .. } = self;
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
        if holes && zeros != Zeros::Content {
            return (Outcome::Unfinished(Fault::Unwritten, Written::so_far(&watched, stamp.bytes)), Reading::Later);
        }
        if zeros == Zeros::Unwritten && foreign::ends_in_zeros(&watched, stamp.bytes) {
            return (Outcome::Blank, Reading::Later);
        }
        let written = Written::around_zeros(&watched, stamp.bytes);
        let goes_on =
            |earlier: &Delivered| earlier.written.as_ref().is_some_and(|before| before.goes_on_in(&watched, stamp.bytes));
        let earlier = earlier.map(|earlier| Earlier { was_unfinished: goes_on(&earlier), sha256: earlier.sha256 });
        let is_of_it =
            |reported: &Reported| reported.written.as_ref().is_none_or(|before| before.is_kept_in(&watched, stamp.bytes));
        let of_it: Vec<Trouble> = reported.into_iter().filter(is_of_it).map(|reported| reported.trouble).collect();
        let read = read_open(&reader, open, &path, domain);
        if let Some(outcome) = changed() {
            return (outcome, Reading::Later);
        }
        match read {
            Ok(mut frames) => {
                let sha256 = frames.first().map(|frame| frame.sha256.clone()).unwrap_or_default();
                let delivered = Delivered { sha256: sha256.clone(), written };
                *mended = of_it;
                if earlier.as_ref().is_some_and(|earlier| earlier.sha256 == sha256) {
                    return (Outcome::Same(delivered), Reading::Same { sha256 });
                }
                if holes {
                    let note = "parts of the file were never written and are read as zeros";
                    frames.iter_mut().for_each(|frame| frame.notes.push(note.to_owned()));
                }
                (Outcome::Frames(delivered), Reading::Frames { frames, earlier })
            }
            Err(fault) if fault.may_be_unfinished() => {
                (Outcome::Unfinished(fault, Written::so_far(&watched, stamp.bytes)), Reading::Later)
            }
            Err(fault) => refused(fault),
        }
    }
}
