//! Whole pictures of exposures that were looked at long ago, on the disk of the session's folder, and back from there: memory does not grow with
//! a session, and each exposure can be seen as it was compared. A thread of its own writes and reads them, so that a disk that stands still
//! holds up neither the window nor those who record.

use std::collections::{BTreeMap, VecDeque};
use std::path::Path;
use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError};

use super::background::stand_back;
use super::pair_pictures::{Pages, PairPictures};
use super::yard::{Slot, Yard};
use crate::reporter::Reporter;

/// Number of a frame, and how often it was posed before.
pub type Key = (u32, u32);

/// Pictures that leave the memory.
#[derive(Debug)]
pub struct Leaving {
    /// Whose they are.
    pub(super) key: Key,
    /// As they were compared.
    pub(super) whole: Arc<PairPictures>,
    /// What is shown until they are back.
    pub(super) small: Arc<PairPictures>,
}

/// So many wait in memory for a disk that is slow.
const MOST_LEAVING: usize = 4;

#[derive(Default)]
struct Queue {
    leaving: VecDeque<Leaving>,
    /// What somebody looks at. Who looks at another meanwhile does not wait for it any more.
    wanted: Option<Key>,
    closed: bool,
}

#[derive(Default)]
struct Shared {
    queue: Mutex<Queue>,
    changed: Condvar,
}

impl Shared {
    fn lock(&self) -> MutexGuard<'_, Queue> {
        self.queue.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

/// See the module; its thread ends with it.
pub(super) struct Album {
    shared: Arc<Shared>,
}

impl Album {
    /// In a file of `folder` without a name. `deliver` gets what was fetched, and `None` where whole pictures cannot be had any more.
    ///
    /// # Errors
    /// When the system gives no thread.
    pub(super) fn start(
        folder: &Path,
        reporter: &Reporter,
        deliver: impl Fn(Key, Option<PairPictures>) + Send + 'static,
    ) -> std::io::Result<Self> {
        let shared = Arc::<Shared>::default();
        let (of_thread, shelf, reporter) = (Arc::clone(&shared), Shelf::in_folder(folder), reporter.clone());
        std::thread::Builder::new().name("album".to_owned()).spawn(move || {
            stand_back();
            serve(shelf, &of_thread, &deliver, &reporter);
        })?;
        Ok(Self { shared })
    }

    /// Whether it takes these pictures; it does not where the disk is far behind.
    pub(super) fn put(&self, leaving: Leaving) -> bool {
        let mut queue = self.shared.lock();
        let takes = queue.leaving.len() < MOST_LEAVING;
        if takes {
            queue.leaving.push_back(leaving);
            self.shared.changed.notify_all();
        }
        takes
    }

    /// Whether all that it took is written, or being written.
    #[cfg(test)]
    pub(super) fn is_idle(&self) -> bool {
        self.shared.lock().leaving.is_empty()
    }

    /// Asks for pictures that it took, instead of those that were asked for before.
    pub(super) fn fetch(&self, key: Key) {
        self.shared.lock().wanted = Some(key);
        self.shared.changed.notify_all();
    }
}

impl Drop for Album {
    fn drop(&mut self) {
        self.shared.lock().closed = true;
        self.shared.changed.notify_all();
    }
}

enum Next {
    Put(Leaving),
    Fetch(Key),
    End,
}

/// What leaves comes first: it may be what is wanted.
fn next(shared: &Shared) -> Next {
    let mut queue = shared.lock();
    loop {
        if queue.closed {
            return Next::End;
        }
        if let Some(leaving) = queue.leaving.pop_front() {
            return Next::Put(leaving);
        }
        if let Some(key) = queue.wanted.take() {
            return Next::Fetch(key);
        }
        queue = shared.changed.wait(queue).unwrap_or_else(PoisonError::into_inner);
    }
}

fn serve(mut shelf: Shelf, shared: &Shared, deliver: &dyn Fn(Key, Option<PairPictures>), reporter: &Reporter) {
    let mut is_said = false;
    loop {
        match next(shared) {
            Next::Put(leaving) => {
                let Err(error) = shelf.put(&leaving) else { continue };
                if !std::mem::replace(&mut is_said, true) {
                    reporter.note(format!(
                        "the window shows older exposures small: the session's folder does not take their pictures ({error}); the log has them"
                    ));
                }
                deliver(leaving.key, None);
            }
            Next::Fetch(key) => deliver(key, shelf.take(key)),
            Next::End => return,
        }
    }
}

/// What lies in the file.
struct Shelf {
    yard: Yard,
    /// By the frame's number.
    kept: BTreeMap<u32, Kept>,
}

struct Kept {
    development: u32,
    small: Arc<PairPictures>,
    /// Values, and meanings as the last.
    pages: Vec<Slot>,
}

impl Shelf {
    fn in_folder(folder: &Path) -> Self {
        Self { yard: Yard::in_folder(folder), kept: BTreeMap::new() }
    }

    fn put(&mut self, leaving: &Leaving) -> std::io::Result<()> {
        let (number, development) = leaving.key;
        // A frame that was posed again shows its latest DRR.
        let before = self.kept.remove(&number);
        before.into_iter().flat_map(|kept| kept.pages).for_each(|slot| self.yard.let_go(slot));
        let Pages { values, meanings } = leaving.whole.pages();
        let mut pages = Vec::new();
        for page in values.into_iter().chain([&meanings]) {
            match self.yard.put(page) {
                Ok(slot) => pages.push(slot),
                Err(error) => {
                    pages.into_iter().for_each(|slot| self.yard.let_go(slot));
                    return Err(error);
                }
            }
        }
        self.kept.insert(number, Kept { development, small: Arc::clone(&leaving.small), pages });
        Ok(())
    }

    /// They are in memory then, and no more here.
    fn take(&mut self, (number, development): Key) -> Option<PairPictures> {
        self.kept.get(&number).filter(|kept| kept.development == development)?;
        let Kept { small, pages, .. } = self.kept.remove(&number)?;
        // Each place is free then, whether it can be read or not.
        let read: Vec<_> = pages.into_iter().map(|slot| self.yard.take(slot)).collect();
        let mut values = read.into_iter().collect::<std::io::Result<Vec<_>>>().ok()?;
        let meanings = values.pop()?;
        small.whole(values, &meanings)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::acquire::{Domain, Frame};
    use crate::image::Image;
    use crate::mask::Masks;

    fn leaving(key: Key) -> Leaving {
        let pixels = (0..620 * 4).map(|at| 1.0 + ((at * (key.0 as usize + 1)) % 13) as f32).collect();
        let frame = Frame::from_pixels("a", Image { width: 620, height: 4, pixels }, Domain::Linear).expect("a frame");
        let whole = Arc::new(PairPictures::alone(&frame, &Masks::default()));
        Leaving { key, small: Arc::new(whole.small()), whole }
    }

    #[test]
    fn pictures_are_taken_back_once_and_only_as_they_were_posed_last() {
        let folder = tempfile::tempdir().expect("a folder");
        let mut shelf = Shelf::in_folder(folder.path());
        let [one, two, again] = [leaving((1, 0)), leaving((2, 0)), leaving((2, 1))];
        [&one, &two, &again].into_iter().for_each(|leaving| shelf.put(leaving).expect("written"));
        assert!(shelf.take((2, 0)).is_none(), "it was posed again");
        let back = shelf.take((2, 1)).expect("there");
        assert_eq!(back.acquired(), again.whole.acquired());
        let other = shelf.take((1, 0)).expect("there");
        assert_eq!(other.acquired(), one.whole.acquired());
        assert_ne!(back.acquired(), other.acquired(), "the control");
        assert!(!back.is_small() && shelf.take((2, 1)).is_none() && shelf.kept.is_empty());
    }

    #[test]
    fn a_disk_that_stands_still_fills_no_memory_and_what_it_does_not_take_is_told() {
        // Nobody serves.
        let album = Album { shared: Arc::default() };
        let taken: Vec<bool> = (0..6).map(|number| album.put(leaving((number, 0)))).collect();
        assert_eq!(taken, [true, true, true, true, false, false]);
        album.fetch((0, 0));
        album.fetch((5, 0));
        let shared = Arc::clone(&album.shared);
        assert!((0..4).all(|number| matches!(next(&shared), Next::Put(leaving) if leaving.key == (number, 0))));
        assert!(matches!(next(&shared), Next::Fetch((5, 0))), "who looks at another does not wait for the first");
        drop(album);
        assert!(matches!(next(&shared), Next::End));

        let (told, heard) = std::sync::mpsc::channel();
        let deliver = move |key, back: Option<PairPictures>| told.send((key, back.is_some())).expect("somebody hears");
        let nowhere = std::path::Path::new("/nonexistent/folder");
        let album = Album::start(nowhere, &Reporter::silent(), deliver).expect("a thread");
        assert!(album.put(leaving((7, 0))));
        assert_eq!(heard.recv(), Ok(((7, 0), false)));
    }
}
