//! What is known of one name in the watched folder, and how long its version is given.

use super::Fault;
use super::notices::Held;
use super::offer::{Delivered, Reported, Zeros};
use super::source::Trouble;
use crate::foreign::{FileStamp, Written};

/// A file lies still when its stamp was the same for this long.
const SETTLE_US: i64 = 100_000;
/// The same for one that its writer has not closed.
const SETTLE_OPEN_US: i64 = 500_000;
/// A file that is not whole may still be being written for this long after its last growth.
pub(super) const PATIENCE_US: i64 = 10_000_000;
/// The same for one that is whole but ends in zeros, where nothing tells whether its writer has closed it: the lower border of a picture
/// may be black.
const BLANK_PATIENCE_US: i64 = 2_000_000;

/// Where a version stands.
#[derive(Debug, PartialEq)]
pub(super) enum State {
    /// Not still for long enough.
    Settling,
    /// Offered; the outcome of this offer is awaited.
    Offered(u64),
    /// Read, and not whole.
    Unfinished(Fault),
    /// It ends in zeros, and its writer has not closed it.
    Blank,
    /// Delivered, refused, reported, or there from the start.
    Done,
}

/// What is known of a name.
#[derive(Debug)]
pub(super) struct Entry {
    /// This version was said to have vanished.
    pub(super) said_gone: bool,
    /// The version.
    pub(super) stamp: FileStamp,
    /// Host clock when this version was first seen.
    pub(super) since_us: i64,
    pub(super) state: State,
    /// The version that its writer completed: closed or moved into place.
    pub(super) closed: Option<FileStamp>,
    pub(super) held: Option<Held>,
    /// The version delivered before.
    pub(super) earlier: Option<Delivered>,
    /// What there is of a version that was read and is not whole.
    pub(super) written: Option<Written>,
    /// What was said to be lost of this file and would not be, should it come whole.
    pub(super) reported: Vec<Reported>,
    /// The how-manieth file that was seen, for a label that gives nothing away.
    pub(super) number: u64,
    /// Patience is over: holes in the file, and zeros at its end, are content.
    pub(super) take_zeros: bool,
}

impl Entry {
    pub(super) fn new(stamp: FileStamp, now_us: i64, number: u64) -> Self {
        Self {
            said_gone: false,
            stamp,
            since_us: now_us,
            state: State::Settling,
            closed: None,
            held: None,
            earlier: None,
            written: None,
            reported: Vec::new(),
            number,
            take_zeros: false,
        }
    }

    /// How long the version must lie still.
    pub(super) fn settle_us(&self, is_being_written: bool) -> i64 {
        if is_being_written { SETTLE_OPEN_US } else { SETTLE_US }
    }

    /// How long a version that ends in zeros is waited for.
    pub(super) fn blank_patience_us(&self, is_being_written: bool) -> i64 {
        if is_being_written { PATIENCE_US } else { BLANK_PATIENCE_US }
    }

    /// How long nothing has come to this version, by the host's clock alone: the clock of the share that a file lies on, and this one after
    /// someone has set it, may be hours from that.
    pub(super) fn waited_us(&self, now_us: i64) -> i64 {
        now_us - self.since_us
    }

    /// What zeros in this version are.
    pub(super) fn zeros(&self, is_being_written: bool) -> Zeros {
        match (self.take_zeros, self.closed == Some(self.stamp) && !is_being_written) {
            (true, _) => Zeros::Content,
            (false, true) => Zeros::HolesUnwritten,
            (false, false) => Zeros::Unwritten,
        }
    }

    /// Whether it is on its way still.
    pub(super) fn is_expected(&self) -> bool {
        self.state != State::Done
    }

    /// What a reader must know of earlier versions.
    pub(super) fn known(&self) -> (Option<Delivered>, Vec<Reported>) {
        (self.earlier.clone(), self.reported.clone())
    }

    /// A version was read: `delivered` if it gave frames, and then nothing that was reported before is lost, or it was another file.
    pub(super) fn was_read(&mut self, delivered: Option<Delivered>) {
        if delivered.is_some() {
            (self.earlier, self.reported) = (delivered, Vec::new());
        }
    }

    /// Notes that `trouble` was reported of it.
    pub(super) fn note(&mut self, trouble: Trouble) {
        self.reported.push(Reported { trouble, written: self.written.clone() });
    }

    /// Nobody waits for it any longer: what is to be said of it, if it was on its way.
    pub(super) fn give_up(&mut self, label: impl FnOnce(u64) -> String) -> Option<Trouble> {
        match std::mem::replace(&mut self.state, State::Done) {
            State::Done => None,
            State::Unfinished(fault) => Some(Trouble::Unfinished { label: label(self.number), fault }),
            State::Settling | State::Offered(_) | State::Blank => Some(Trouble::StillWritten { label: label(self.number) }),
        }
    }

    /// This version is looked at anew: it was rewritten and its time set back.
    pub(super) fn look_again(&mut self, stamp: FileStamp, now_us: i64) {
        (self.stamp, self.since_us, self.state, self.take_zeros) = (stamp, now_us, State::Settling, false);
    }
}
