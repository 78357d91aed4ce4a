//! A folder that frames arrive in: looked at by polling, and helped by the system's notices.
//!
//! A file is known by its name, and each version of it by size, time of change and inode. A version that has lain still is offered once; how
//! reading it ended comes back through a channel. What changes is a new version, and is offered again.

use std::collections::{BTreeMap, BTreeSet};
use std::ffi::{OsStr, OsString};
use std::path::{Path, PathBuf};
use std::sync::mpsc::{Receiver, Sender, channel};

use super::departed::Departed;
use super::entry::{Entry, PATIENCE_US, State};
use super::label;
use super::listing::{Listing, is_wanted, list};
use super::notices::{Held, HeldCount, Notice, Notices, What};
use super::offer::{Delivered, Offer, Outcome, Reported, Told, Zeros};
use super::passed_over::PassedOver;
use super::same_folder::SameFolder;
use super::source::{FrameSource, Sighting, Trouble};
use super::{Domain, Fault};
use crate::foreign::{FileStamp, ForeignReader};

/// Where a folder stands among those that are watched.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(super) struct Place {
    /// Others watch the folders below it: that something comes into them needs no word.
    pub(super) reads_below: bool,
    /// It lies below another one, and may go.
    pub(super) may_go: bool,
}

/// Watches one folder, not those below it: that something came into one is said. Hidden files and names that end in `.tmp`, `.part`, `.partial`, `.json`
/// are passed over; that a picture stays under such a name is said.
#[derive(Debug)]
pub struct FolderSource {
    folder: PathBuf,
    domain: Option<Domain>,
    reader: ForeignReader,
    /// Files that the first look passes over; all that it finds where the folder could not be read when the watch began.
    existing: Option<BTreeMap<OsString, FileStamp>>,
    lost: bool,
    itself: SameFolder,
    entries: BTreeMap<OsString, Entry>,
    /// Files that somebody has begun to write and not closed yet, as far as the system tells.
    being_written: BTreeSet<OsString>,
    passed_over: PassedOver,
    departed: Departed,
    place: Place,
    held: HeldCount,
    notices: Notices,
    told: (Sender<Told>, Receiver<Told>),
    offers: u64,
    seen: u64,
}

impl FolderSource {
    /// Watches `folder` from now on and reads through `reader`. `domain` is the person's word on what the values mean. Files that are there
    /// already are delivered only with `include_existing`; what comes before the first look is new.
    #[must_use]
    pub fn new(folder: &Path, domain: Option<Domain>, include_existing: bool, reader: ForeignReader) -> Self {
        let held = HeldCount::default();
        let there = if include_existing { Some(Listing::default()) } else { list(folder).ok() };
        let (existing, hidden) = there.map(|listing| (listing.files, listing.hidden)).unzip();
        Self {
            folder: folder.to_owned(),
            domain,
            reader,
            existing,
            lost: false,
            itself: SameFolder::of(folder),
            entries: BTreeMap::new(),
            being_written: BTreeSet::new(),
            passed_over: PassedOver::of_old(hidden),
            departed: Departed::default(),
            notices: Notices::of(folder, &held, is_wanted),
            place: Place::default(),
            held,
            told: channel(),
            offers: 0,
            seen: 0,
        }
    }

    /// The same as one of several, each of which watches a folder of a tree.
    #[must_use]
    pub(super) fn in_tree(self, place: Place) -> Self {
        Self { place, ..self }
    }

    fn label(&self, name: &OsStr, number: u64) -> String {
        label::of_unread(Path::new(name), number)
    }

    /// What readers have said since the last look.
    fn hear(&mut self, now_us: i64, found: &mut Vec<Sighting>) {
        let told: Vec<Told> = self.told.1.try_iter().collect();
        for Told { offer, name, label, gone, outcome } in told {
            let trouble = match (&outcome, gone) {
                (Outcome::Missing, _) | (Outcome::Unfinished(..) | Outcome::Blank, true) => Some(Trouble::Vanished { label }),
                (Outcome::Overwritten, _) => Some(Trouble::Overwritten { label }),
                _ => None,
            };
            found.extend(trouble.clone().map(Sighting::Trouble));
            // By the offer: the file may have been renamed meanwhile, or be away.
            let offered =
                self.entries.values_mut().chain(self.departed.entries_mut()).find(|entry| entry.state == State::Offered(offer));
            let delivered = match &outcome {
                Outcome::Frames(delivered) | Outcome::Same(delivered) => Some(delivered.clone()),
                _ => None,
            };
            let Some(entry) = offered else {
                // A later version has taken its place.
                if let Some(entry) = self.entries.get_mut(&name) {
                    entry.was_read(delivered);
                }
                continue;
            };
            entry.was_read(delivered);
            entry.written = match &outcome {
                Outcome::Unfinished(_, written) => written.clone(),
                _ => None,
            };
            // Whatever takes the place of an overwritten version is another.
            trouble.filter(|trouble| matches!(trouble, Trouble::Vanished { .. })).into_iter().for_each(|gone| entry.note(gone));
            entry.state = match outcome {
                // With a share that was away it may be back: once more.
                Outcome::Missing if !std::mem::replace(&mut entry.said_gone, true) => {
                    entry.since_us = now_us;
                    State::Settling
                }
                // Whatever takes the place of an overwritten version is a new one.
                Outcome::Frames(_) | Outcome::Same(_) | Outcome::Refused | Outcome::Missing | Outcome::Overwritten => State::Done,
                Outcome::Unfinished(fault, _) => State::Unfinished(fault),
                Outcome::Blank => State::Blank,
                Outcome::Changed => {
                    entry.closed = None;
                    entry.since_us = now_us;
                    State::Settling
                }
                Outcome::Unread => State::Settling,
            };
        }
    }

    /// A version that its writer has completed.
    fn notice(&mut self, mut name: OsString, held: Held, now_us: i64, found: &mut Vec<Sighting>) {
        let stamp = held.open.stamp;
        if let Some(entry) = self.entries.get_mut(&name) {
            let rewritten = |before: &FileStamp| before.inode == stamp.inode && *before != stamp && stamp.bytes <= before.bytes;
            let lost = entry.state == State::Settling && entry.closed.as_ref().is_some_and(rewritten);
            entry.closed = Some(stamp);
            if lost {
                (entry.stamp, entry.since_us) = (stamp, now_us);
                let number = entry.number;
                let label = self.label(&name, number);
                found.push(Sighting::Trouble(Trouble::Overwritten { label }));
            } else if entry.stamp != stamp {
                self.replace(&name, stamp, now_us, found);
            }
        } else {
            let leads_to_it =
                |name: &OsStr| std::fs::metadata(self.folder.join(name)).is_ok_and(|metadata| FileStamp::of(&metadata) == stamp);
            match self.known_as(stamp) {
                // It was renamed, and the notice of the name before comes late.
                Some(known) if !leads_to_it(&name) => name = known,
                // It was renamed to this.
                Some(known) if !leads_to_it(&known) => {
                    if let Some(mut entry) = self.entries.remove(&known) {
                        entry.held = None;
                        self.entries.insert(name.clone(), entry);
                    }
                }
                _ => self.add(name.clone(), stamp, now_us),
            }
        }
        if let Some(entry) = self.entries.get_mut(&name) {
            entry.closed = Some(stamp);
            // Zeros at its end are content after all.
            if entry.state == State::Blank {
                (entry.state, entry.since_us) = (State::Settling, now_us);
            }
            if entry.state == State::Settling {
                entry.held = Some(held);
            }
        }
    }

    /// The name under which this very version is known.
    fn known_as(&self, stamp: FileStamp) -> Option<OsString> {
        let known = self.entries.iter().find(|(_, entry)| entry.stamp == stamp && stamp.inode != (0, 0))?.0;
        Some(known.clone())
    }

    fn add(&mut self, name: OsString, stamp: FileStamp, now_us: i64) {
        self.seen += 1;
        // It is back, or a notice of it comes late.
        let mut entry = match self.departed.take(stamp) {
            Some(known) if matches!(known.state, State::Done | State::Offered(_)) => known,
            Some(known) => Entry { said_gone: known.said_gone, reported: known.reported, ..Entry::new(stamp, now_us, self.seen) },
            // Copied once more, perhaps.
            None => Entry { reported: self.departed.reported_of(&name), ..Entry::new(stamp, now_us, self.seen) },
        };
        entry.reported.extend(self.passed_over.renamed(stamp));
        self.entries.insert(name, entry);
    }

    /// The file `name` has a new version. The one before is read if it is held open, and reported if it is lost.
    fn replace(&mut self, name: &OsStr, stamp: FileStamp, now_us: i64, found: &mut Vec<Sighting>) {
        let Some(entry) = self.entries.get_mut(name) else { return };
        let before = entry.stamp;
        let unread = matches!(entry.state, State::Settling) && before.bytes > 0;
        let same_file = before.inode == stamp.inode;
        entry.stamp = stamp;
        entry.since_us = now_us;
        entry.take_zeros = false;
        entry.said_gone = false;
        let reported = entry.reported.clone();
        entry.reported.retain(|reported| reported.written.is_some());
        entry.written = None;
        // That a version which was read has been completed says nothing about the next one.
        if !same_file || stamp.bytes != before.bytes || !matches!(entry.state, State::Settling) {
            entry.closed = None;
        }
        let held = if same_file { None } else { entry.held.take() };
        entry.state = State::Settling;
        let (number, earlier) = (entry.number, entry.earlier.clone());
        if !unread {
            return;
        }
        let label = self.label(name, number);
        match held {
            // The old content is still there behind its own inode.
            Some(held) => {
                let known = (earlier, reported);
                let offer = self.offer(name, before, now_us, Some(held), known, label, true, Zeros::HolesUnwritten);
                found.push(offer);
            }
            // A file that grew is a copy that goes on; one whose time alone changed, may be.
            None if !same_file || stamp.bytes < before.bytes => {
                found.push(Sighting::Trouble(Trouble::Overwritten { label }));
            }
            None => {}
        }
    }

    #[expect(clippy::too_many_arguments, reason = "one version of one file, spelled out")]
    fn offer(
        &mut self,
        name: &OsStr,
        stamp: FileStamp,
        since_us: i64,
        held: Option<Held>,
        (earlier, reported): (Option<Delivered>, Vec<Reported>),
        label: String,
        gone: bool,
        zeros: Zeros,
    ) -> Sighting {
        self.offers += 1;
        let offer = Offer {
            id: self.offers,
            name: name.to_owned(),
            path: self.folder.join(name),
            label,
            stamp,
            held,
            earlier,
            reported,
            gone,
            zeros,
            domain: self.domain,
            reader: self.reader.clone(),
            told: self.told.0.clone(),
        };
        Sighting::Ready(offer.into_arrival(since_us))
    }

    /// Offers what lies still, and reports what has not become whole.
    fn settle(&mut self, name: &OsStr, now_us: i64, found: &mut Vec<Sighting>) {
        let label = match self.entries.get(name) {
            Some(entry) => self.label(name, entry.number),
            None => return,
        };
        let next = self.offers + 1;
        let Some(entry) = self.entries.get_mut(name) else { return };
        let is_written = self.being_written.contains(name);
        let waited_us = entry.waited_us(now_us);
        match &entry.state {
            State::Settling if now_us - entry.since_us >= entry.settle_us(is_written) => {
                entry.state = State::Offered(next);
                let (stamp, since_us, held) = (entry.stamp, entry.since_us, entry.held.take());
                let (known, zeros) = (entry.known(), entry.zeros(is_written));
                let offer = self.offer(name, stamp, since_us, held, known, label, false, zeros);
                found.push(offer);
            }
            State::Blank if waited_us >= entry.blank_patience_us(is_written) => {
                entry.take_zeros = true;
                entry.state = State::Settling;
            }
            State::Unfinished(Fault::Unwritten) if waited_us >= PATIENCE_US => {
                // Written by a program that leaves holes where all is zero.
                entry.take_zeros = true;
                entry.state = State::Settling;
            }
            State::Unfinished(fault) if waited_us >= PATIENCE_US => {
                let trouble = Trouble::Unfinished { label, fault: fault.clone() };
                entry.note(trouble.clone());
                entry.state = State::Done;
                found.push(Sighting::Trouble(trouble));
            }
            _ => {}
        }
    }

    /// A file was completed and is gone: whether that was a version which has its word, or gets it when it departs.
    fn is_of_known(&mut self, name: &OsStr, now_us: i64) -> bool {
        if self.entries.get(name).is_some_and(|entry| entry.state != State::Done) {
            return true;
        }
        let Some(entry) = self.entries.get_mut(name).or_else(|| self.departed.named_mut(name)) else { return false };
        // The notice that completed the version that has its word already comes late.
        entry.closed.replace(entry.stamp) != Some(entry.stamp) && now_us - entry.since_us < PATIENCE_US
    }

    /// Names that are gone: their unread versions are read from the open file, or reported.
    fn depart(&mut self, listed: &BTreeMap<OsString, FileStamp>, now_us: i64, found: &mut Vec<Sighting>) {
        let gone: Vec<OsString> = self.entries.keys().filter(|name| !listed.contains_key(*name)).cloned().collect();
        for name in gone {
            let Some(mut entry) = self.entries.remove(&name) else { continue };
            // Renamed: the same file with the same content under a name that is new.
            let renamed = listed.iter().find(|(other, stamp)| **stamp == entry.stamp && !self.entries.contains_key(*other));
            if let Some((other, _)) = renamed.filter(|_| entry.stamp.inode != (0, 0)) {
                let other = other.clone();
                self.entries.insert(other, entry);
                continue;
            }
            let label = self.label(&name, entry.number);
            let held = entry.held.take();
            if let Some(held) = held.filter(|_| entry.state == State::Settling) {
                entry.stamp = held.open.file.metadata().map_or(entry.stamp, |metadata| FileStamp::of(&metadata));
                // What is gone is not written any further.
                let zeros = if entry.take_zeros { Zeros::Content } else { Zeros::HolesUnwritten };
                let (known, gone) = (entry.known(), !entry.said_gone);
                let offer = self.offer(&name, entry.stamp, now_us, Some(held), known, label, gone, zeros);
                found.push(offer);
                entry.state = State::Offered(self.offers);
            } else if matches!(entry.state, State::Settling | State::Unfinished(_) | State::Blank)
                && !std::mem::replace(&mut entry.said_gone, true)
            {
                let trouble = Trouble::Vanished { label };
                entry.note(trouble.clone());
                found.push(Sighting::Trouble(trouble));
            }
            self.departed.push(name, entry);
        }
    }
}

impl FrameSource for FolderSource {
    fn look(&mut self, now_us: i64) -> Vec<Sighting> {
        let mut found = Vec::new();
        self.hear(now_us, &mut found);
        let mut missed = BTreeSet::new();
        for Notice { name, what } in self.notices.take() {
            match what {
                What::Written => {
                    self.being_written.insert(name);
                    continue;
                }
                What::Untold => {
                    self.being_written.clear();
                    continue;
                }
                // What was completed under that name and could not be opened any more is not gone.
                What::Renamed => {
                    missed.remove(&name);
                    continue;
                }
                What::Completed(_) => self.being_written.remove(&name),
            };
            match what {
                What::Completed(Some(held)) => self.notice(name, held, now_us, &mut found),
                _ => drop(missed.insert(name)),
            }
        }
        let listing = match list(&self.folder) {
            Ok(listing) => listing,
            // It is gone with all that lay in it.
            Err(error) if self.place.may_go && error.kind() == std::io::ErrorKind::NotFound => Listing::default(),
            Err(error) => {
                if !std::mem::replace(&mut self.lost, true) {
                    found.push(Sighting::FolderLost { detail: error.to_string() });
                }
                return found;
            }
        };
        if std::mem::take(&mut self.lost) {
            found.push(Sighting::FolderBack);
        }
        // Folders come and go below the watched one.
        found.extend(self.itself.look(&self.folder).filter(|_| !self.place.may_go));
        // Completed, and gone before it could be opened. What was seen settling is reported when it departs.
        missed.retain(|name| !listing.files.contains_key(name) && !listing.others.contains_key(name));
        missed.retain(|name| !self.is_of_known(name, now_us));
        let seen = &mut self.seen;
        let mut label = |name: &OsStr| {
            *seen += 1;
            label::of_unread(Path::new(name), *seen)
        };
        let passed_over = self.passed_over.look(&self.folder, self.place.reads_below, listing.others, &mut label);
        let hidden = self.passed_over.look_at_hidden(&self.folder, now_us, listing.hidden, &mut label);
        found.extend(passed_over.into_iter().chain(hidden).map(Sighting::Trouble));
        for name in missed {
            self.seen += 1;
            found.push(Sighting::Trouble(Trouble::Vanished { label: self.label(&name, self.seen) }));
        }
        self.being_written.retain(|name| listing.files.contains_key(name));
        self.depart(&listing.files, now_us, &mut found);
        let existing = self.existing.replace(BTreeMap::new());
        for (name, stamp) in listing.files {
            match self.entries.get_mut(&name) {
                None => {
                    self.add(name.clone(), stamp, now_us);
                    let skip = existing.as_ref().is_none_or(|files| files.get(&name) == Some(&stamp));
                    if skip && let Some(entry) = self.entries.get_mut(&name) {
                        (entry.state, entry.closed) = (State::Done, Some(stamp));
                    }
                }
                Some(entry) if entry.stamp != stamp => self.replace(&name, stamp, now_us, &mut found),
                // What was delivered is looked at again; the same content is no new frame.
                Some(entry)
                    if entry.stamp.touched_ns != stamp.touched_ns && entry.earlier.is_some() && entry.state == State::Done =>
                {
                    entry.look_again(stamp, now_us);
                }
                Some(_) => {}
            }
            if let Some(entry) = self.entries.get_mut(&name)
                && entry.state == State::Settling
                && entry.held.is_none()
            {
                entry.held = self.held.hold(&self.folder.join(&name)).filter(|held| held.open.stamp.inode == stamp.inode);
            }
            self.settle(&name, now_us, &mut found);
        }
        found
    }

    fn is_expecting(&self) -> bool {
        self.entries.values().any(Entry::is_expected)
    }

    fn give_up(&mut self) -> Vec<Sighting> {
        let reported = self
            .entries
            .iter_mut()
            .filter_map(|(name, entry)| entry.give_up(|number| label::of_unread(Path::new(name), number)).map(Sighting::Trouble));
        reported.collect()
    }
}
