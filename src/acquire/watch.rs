//! A folder that frames arrive in, looked at by polling.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::time::UNIX_EPOCH;

use super::{AcquireError, Domain, Frame, read_frames};

/// A file is complete when its size and time of change were the same in two polls at least this far apart.
const SETTLE_US: i64 = 100_000;
/// A file that does not parse may still be being written for this long after its last change.
const UNFINISHED_US: i64 = 2_000_000;

/// What a poll found.
#[derive(Debug)]
pub enum WatchEvent {
    /// A complete frame. Files with several images give several of these.
    Frame {
        /// The frame.
        frame: Box<Frame>,
        /// Its file.
        path: PathBuf,
    },
    /// The file is there but not complete yet.
    Waiting {
        /// The file.
        path: PathBuf,
    },
    /// The file cannot be read; said once, and the file stays where it is. It is tried again when it changes. When the folder itself
    /// cannot be listed, `path` is the folder; that is said once until it can be again.
    Unreadable {
        /// The file.
        path: PathBuf,
        /// Why.
        error: AcquireError,
    },
}

/// Size and time of change of a file.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
struct Stamp {
    bytes: u64,
    modified_us: i64,
}

#[derive(Clone, Copy, Debug)]
enum State {
    /// First seen with this stamp at this time.
    Settling { stamp: Stamp, since_us: i64 },
    /// Delivered, refused or there from the start; tried again only when the stamp changes and it was not delivered.
    Done { stamp: Stamp, delivered: bool },
}

/// Watches one folder (not those below it). Call [`FolderWatch::poll`] every 100 ms or so.
#[derive(Debug)]
pub struct FolderWatch {
    folder: PathBuf,
    domain: Option<Domain>,
    include_existing: bool,
    first_poll: bool,
    lost: bool,
    states: BTreeMap<PathBuf, State>,
}

impl FolderWatch {
    /// Watches `folder`. `domain` is the person's word on what the values mean. Files that are there at the first poll are delivered only
    /// with `include_existing`.
    #[must_use]
    pub fn new(folder: &Path, domain: Option<Domain>, include_existing: bool) -> Self {
        Self { folder: folder.to_owned(), domain, include_existing, first_poll: true, lost: false, states: BTreeMap::new() }
    }

    /// Looks once; `now_us` is the host clock. Events come in order of file name, then time of change. Hidden files, folders and names
    /// that end in `.tmp`, `.part`, `.partial`, `.json` are passed over.
    pub fn poll(&mut self, now_us: i64) -> Vec<WatchEvent> {
        let mut events = Vec::new();
        let files = match list(&self.folder) {
            Ok(files) => files,
            Err(error) => {
                if !self.lost {
                    self.lost = true;
                    let error = AcquireError::Io { path: self.folder.clone(), source: error };
                    events.push(WatchEvent::Unreadable { path: self.folder.clone(), error });
                }
                return events;
            }
        };
        self.lost = false;
        let skip = std::mem::take(&mut self.first_poll) && !self.include_existing;
        self.states.retain(|path, _| files.iter().any(|(known, _)| known == path));
        for (path, stamp) in files {
            let state = match self.states.get(&path) {
                None if skip => State::Done { stamp, delivered: true },
                None => State::Settling { stamp, since_us: now_us },
                Some(State::Settling { stamp: before, since_us }) if *before == stamp => {
                    if now_us - since_us >= SETTLE_US {
                        deliver(&path, self.domain, stamp, now_us, &mut events)
                            .unwrap_or(State::Settling { stamp, since_us: *since_us })
                    } else {
                        State::Settling { stamp, since_us: *since_us }
                    }
                }
                Some(State::Done { stamp: before, delivered }) if *delivered || *before == stamp => {
                    State::Done { stamp, delivered: *delivered }
                }
                Some(_) => State::Settling { stamp, since_us: now_us },
            };
            if matches!(state, State::Settling { .. }) {
                events.push(WatchEvent::Waiting { path: path.clone() });
            }
            self.states.insert(path, state);
        }
        events
    }
}

/// Reads a settled file; `None` while it may still be unfinished.
fn deliver(path: &Path, domain: Option<Domain>, stamp: Stamp, now_us: i64, events: &mut Vec<WatchEvent>) -> Option<State> {
    match read_frames(path, domain) {
        Ok(frames) => {
            events.extend(frames.into_iter().map(|frame| WatchEvent::Frame { frame: Box::new(frame), path: path.to_owned() }));
            Some(State::Done { stamp, delivered: true })
        }
        Err(error) if error.may_be_unfinished() && now_us - stamp.modified_us < UNFINISHED_US => None,
        Err(error) => {
            events.push(WatchEvent::Unreadable { path: path.to_owned(), error });
            Some(State::Done { stamp, delivered: false })
        }
    }
}

/// The files that matter, by name, then time of change.
fn list(folder: &Path) -> std::io::Result<Vec<(PathBuf, Stamp)>> {
    let mut files = Vec::new();
    for entry in std::fs::read_dir(folder)? {
        let Ok(entry) = entry else { continue };
        let name = entry.file_name().to_string_lossy().to_lowercase();
        let passed_over = [".tmp", ".part", ".partial", ".json"].iter().any(|ending| name.ends_with(ending));
        if name.starts_with('.') || name.starts_with('~') || passed_over {
            continue;
        }
        // A file that vanishes between listing and looking was renamed; the next poll sees its new name.
        let Ok(metadata) = std::fs::metadata(entry.path()) else { continue };
        if !metadata.is_file() {
            continue;
        }
        let modified_us = metadata
            .modified()
            .ok()
            .and_then(|time| time.duration_since(UNIX_EPOCH).ok())
            .map_or(0, |since| since.as_micros() as i64);
        files.push((entry.path(), Stamp { bytes: metadata.len(), modified_us }));
    }
    files.sort_by(|(a, x), (b, y)| a.file_name().cmp(&b.file_name()).then(x.modified_us.cmp(&y.modified_us)));
    Ok(files)
}
