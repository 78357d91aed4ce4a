//! The system's own word that a file is being written, was closed or moved into the folder. A file that is complete is opened at once, so
//! that it can be read even if it is deleted a moment later. Polling sees what the system does not tell (network shares).

use std::ffi::OsString;
use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};
use std::sync::mpsc::{Receiver, channel};

use crate::foreign::{OpenFile, open_regular};

/// Files that are held open at once; more wait by name only. A process has 1024 descriptors.
const MAX_HELD: usize = 200;

/// Counts the files that are held open.
#[derive(Clone, Debug, Default)]
pub(super) struct HeldCount(Arc<AtomicUsize>);

/// A file that is kept open until it is read.
#[derive(Debug)]
pub(super) struct Held {
    pub(super) open: OpenFile,
    count: HeldCount,
}

impl Drop for Held {
    fn drop(&mut self) {
        self.count.0.fetch_sub(1, Ordering::Relaxed);
    }
}

impl HeldCount {
    /// Opens `path` and keeps it; `None` when it is no readable file, or too many are held.
    pub(super) fn hold(&self, path: &Path) -> Option<Held> {
        if self.0.fetch_add(1, Ordering::Relaxed) >= MAX_HELD {
            self.0.fetch_sub(1, Ordering::Relaxed);
            return None;
        }
        match open_regular(path, u64::MAX) {
            Ok(open) => Some(Held { open, count: self.clone() }),
            Err(_) => {
                self.0.fetch_sub(1, Ordering::Relaxed);
                None
            }
        }
    }
}

/// What happened to a file.
#[derive(Debug)]
pub(super) enum What {
    /// Its writer has closed it, or it was moved into the folder. `None` when it was gone again, or could not be opened.
    Completed(Option<Held>),
    /// Somebody has it open and has written to it.
    Written,
    /// It has another name in this folder, of which the next notice is.
    Renamed,
    /// More happened than the system could tell.
    Untold,
}

/// Of which file.
#[derive(Debug)]
pub(super) struct Notice {
    /// Nothing for [`What::Untold`].
    pub(super) name: OsString,
    pub(super) what: What,
}

/// The thread that listens; it ends when this is dropped.
#[derive(Debug)]
pub(super) struct Notices {
    notices: Receiver<Vec<Notice>>,
    stop: Arc<AtomicBool>,
}

impl Drop for Notices {
    fn drop(&mut self) {
        self.stop.store(true, Ordering::Relaxed);
    }
}

impl Notices {
    /// Listens to `folder` as far as the system can; names for which `wanted` is false are passed over.
    pub(super) fn of(folder: &Path, held: &HeldCount, wanted: fn(&std::ffi::OsStr) -> bool) -> Self {
        let (sender, notices) = channel();
        let stop = Arc::new(AtomicBool::new(false));
        #[cfg(target_os = "linux")]
        {
            // From now on, not from when the thread comes to run.
            let inotify = linux::watch(folder);
            let (folder, held, stop) = (folder.to_owned(), held.clone(), stop.clone());
            // Without the thread there is still polling.
            let _ = std::thread::Builder::new()
                .name("folder notices".into())
                .spawn(move || linux::listen(inotify, &folder, &held, wanted, &sender, &stop));
        }
        #[cfg(not(target_os = "linux"))]
        {
            let _ = (folder, held, wanted, sender);
        }
        Self { notices, stop }
    }

    /// What has come since the last call.
    pub(super) fn take(&self) -> Vec<Notice> {
        self.notices.try_iter().flatten().collect()
    }
}

#[cfg(target_os = "linux")]
mod linux {
    use std::ffi::{OsStr, OsString};
    use std::mem::MaybeUninit;
    use std::os::fd::OwnedFd;
    use std::os::unix::ffi::OsStrExt;
    use std::path::Path;
    use std::sync::atomic::{AtomicBool, Ordering};
    use std::sync::mpsc::Sender;
    use std::time::Duration;

    use rustix::event::{PollFd, PollFlags, Timespec, poll};
    use rustix::fs::inotify::{CreateFlags, ReadFlags, Reader, WatchFlags, add_watch, init};

    use super::{HeldCount, Notice, What};

    /// How often the thread looks whether it should end, and whether a folder that was gone is back.
    const WAKE_MS: u64 = 100;

    /// Until told to stop.
    pub(super) fn listen(
        mut inotify: Option<OwnedFd>,
        folder: &Path,
        held: &HeldCount,
        wanted: fn(&OsStr) -> bool,
        sender: &Sender<Vec<Notice>>,
        stop: &AtomicBool,
    ) {
        while !stop.load(Ordering::Relaxed) {
            if let Some(inotify) = inotify.take().or_else(|| watch(folder)) {
                follow(&inotify, folder, held, wanted, sender, stop);
            }
            std::thread::sleep(Duration::from_millis(WAKE_MS));
        }
    }

    pub(super) fn watch(folder: &Path) -> Option<OwnedFd> {
        let inotify = init(CreateFlags::NONBLOCK | CreateFlags::CLOEXEC).ok()?;
        let of_files = WatchFlags::MODIFY | WatchFlags::CLOSE_WRITE | WatchFlags::MOVED_FROM | WatchFlags::MOVED_TO;
        let flags = of_files | WatchFlags::DELETE_SELF | WatchFlags::MOVE_SELF;
        add_watch(&inotify, folder, flags | WatchFlags::ONLYDIR).ok()?;
        Some(inotify)
    }

    /// Until the folder itself goes, or told to stop.
    fn follow(
        inotify: &OwnedFd,
        folder: &Path,
        held: &HeldCount,
        wanted: fn(&OsStr) -> bool,
        sender: &Sender<Vec<Notice>>,
        stop: &AtomicBool,
    ) {
        let wake = Timespec { tv_sec: 0, tv_nsec: WAKE_MS as i64 * 1_000_000 };
        let mut written_last = OsString::new();
        // The two halves of a renaming have one cookie.
        let mut former: Option<(u32, OsString)> = None;
        while !stop.load(Ordering::Relaxed) {
            if !matches!(poll(&mut [PollFd::new(inotify, PollFlags::IN)], Some(&wake)), Ok(1..)) {
                continue;
            }
            let mut buffer = [MaybeUninit::uninit(); 1 << 14];
            let mut reader = Reader::new(inotify, &mut buffer);
            let mut batch = Vec::new();
            while let Ok(event) = reader.next() {
                if event.events().intersects(ReadFlags::DELETE_SELF | ReadFlags::MOVE_SELF | ReadFlags::IGNORED) {
                    return;
                }
                let name: OsString =
                    event.file_name().map(|name| OsStr::from_bytes(name.to_bytes()).to_owned()).unwrap_or_default();
                let what = if event.events().contains(ReadFlags::QUEUE_OVERFLOW) {
                    What::Untold
                } else if !wanted(&name) {
                    continue;
                } else if event.events().contains(ReadFlags::MOVED_FROM) {
                    former = Some((event.cookie(), name));
                    continue;
                } else if !event.events().contains(ReadFlags::MODIFY) {
                    let renamed = former.take_if(|(cookie, _)| *cookie == event.cookie());
                    batch.extend(renamed.map(|(_, name)| Notice { name, what: What::Renamed }));
                    What::Completed(held.hold(&folder.join(&name)))
                } else if written_last == name {
                    // A large file is written in many pieces.
                    continue;
                } else {
                    What::Written
                };
                written_last = if matches!(what, What::Written) { name.clone() } else { OsString::new() };
                batch.push(Notice { name, what });
            }
            // Together, so that nobody hears of the writing and not yet of the end.
            if sender.send(batch).is_err() {
                return;
            }
        }
    }
}
