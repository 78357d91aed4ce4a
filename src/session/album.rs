//! Whole pictures of exposures that were looked at long ago, on the disk of the session's folder, and back from there: memory does not grow with
//! a session, and each exposure can be seen as it was compared. A thread of its own writes and reads them, so that a disk that stands still
//! holds up neither the window nor those who record.

use std::collections::{BTreeMap, BTreeSet, VecDeque};
use std::path::Path;
use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError};

use super::background::stand_back;
use super::crosscheck::free_bytes;
use super::pair_pictures::{Pages, PairPictures};
use super::yard::{Slot, Yard, is_for_want_of_room};
use crate::image::Image;
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
/// The file is no larger, and no larger than a tenth of what is free when it is begun: the disk is the log's.
const MOST_BYTES: u64 = 2 << 30;

#[derive(Default)]
struct Queue {
    leaving: VecDeque<Leaving>,
    /// What somebody looks at. Who looks at another meanwhile does not wait for it any more.
    wanted: Option<Key>,
    /// What is being read.
    fetching: Option<Key>,
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
        let mut queue = self.shared.lock();
        // Each look asks; what is being read comes without.
        queue.wanted = (queue.fetching != Some(key)).then_some(key);
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
    queue.fetching = None;
    loop {
        if queue.closed {
            return Next::End;
        }
        if let Some(leaving) = queue.leaving.pop_front() {
            return Next::Put(leaving);
        }
        if let Some(key) = queue.wanted.take() {
            queue.fetching = Some(key);
            return Next::Fetch(key);
        }
        queue = shared.changed.wait(queue).unwrap_or_else(PoisonError::into_inner);
    }
}

fn serve(mut shelf: Shelf, shared: &Shared, deliver: &dyn Fn(Key, Option<PairPictures>), reporter: &Reporter) {
    let mut said = BTreeSet::new();
    loop {
        match next(shared) {
            Next::Put(leaving) => {
                let mut dropped = Vec::new();
                let why = match shelf.put(&leaving, &mut dropped) {
                    Ok(()) if dropped.is_empty() => continue,
                    Ok(()) => "has no room for more of their pictures".to_owned(),
                    Err(error) => {
                        dropped.push(leaving.key);
                        format!("does not take their pictures ({error})")
                    }
                };
                let words = format!("the window shows older exposures small: the session's folder {why}; the log has them");
                if said.insert(why) {
                    reporter.note(words);
                }
                for key in dropped {
                    // Those that leave once more may be taken then.
                    let leaves_again = shared.lock().leaving.iter().any(|leaving| leaving.key == key);
                    if !leaves_again {
                        deliver(key, None);
                    }
                }
            }
            Next::Fetch(key) => deliver(key, shelf.fetch(key)),
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
        let most_bytes = free_bytes(folder).map_or(MOST_BYTES, |free| MOST_BYTES.min(free / 10));
        Self { yard: Yard::in_folder(folder).of_at_most(most_bytes), kept: BTreeMap::new() }
    }

    /// Takes pictures; those of the oldest exposures go where there is no room, and for no other reason, which adds them to `dropped`.
    fn put(&mut self, leaving: &Leaving, dropped: &mut Vec<Key>) -> std::io::Result<()> {
        let (number, development) = leaving.key;
        // What was read back is still here.
        let is_kept = self.kept.get(&number).is_some_and(|kept| kept.development == development);
        if is_kept && leaving.whole.is_read_back() {
            return Ok(());
        }
        // A frame that was posed again shows its latest DRR.
        if let Some(before) = self.kept.remove(&number) {
            self.let_go(before.pages);
        }
        let Pages { values, meanings } = leaving.whole.pages();
        let images: Vec<&Image<f32>> = values.into_iter().chain([&meanings]).collect();
        let pages = loop {
            match self.write(&images) {
                Ok(pages) => break pages,
                Err(error) if !is_for_want_of_room(&error) => return Err(error),
                Err(error) => {
                    let Some((oldest, kept)) = self.kept.pop_first() else { return Err(error) };
                    self.let_go(kept.pages);
                    dropped.push((oldest, kept.development));
                }
            }
        };
        self.kept.insert(number, Kept { development, small: Arc::clone(&leaving.small), pages });
        Ok(())
    }

    /// All of them or none.
    fn write(&mut self, images: &[&Image<f32>]) -> std::io::Result<Vec<Slot>> {
        let mut pages = Vec::new();
        for image in images {
            match self.yard.put(image) {
                Ok(slot) => pages.push(slot),
                Err(error) => {
                    self.let_go(pages);
                    return Err(error);
                }
            }
        }
        Ok(pages)
    }

    fn let_go(&mut self, pages: Vec<Slot>) {
        pages.into_iter().for_each(|slot| self.yard.let_go(slot));
    }

    /// They stay here as well, so that they are not written again; what cannot be read goes.
    fn fetch(&mut self, (number, development): Key) -> Option<PairPictures> {
        let kept = self.kept.get(&number).filter(|kept| kept.development == development)?;
        let read: std::io::Result<Vec<_>> = kept.pages.iter().map(|slot| self.yard.read(*slot)).collect();
        let whole = read.ok().and_then(|mut values| {
            let meanings = values.pop()?;
            kept.small.whole(values, &meanings)
        });
        if whole.is_none()
            && let Some(unreadable) = self.kept.remove(&number)
        {
            self.let_go(unreadable.pages);
        }
        whole
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::acquire::{Domain, Frame};
    use crate::mask::Masks;

    fn leaving(key: Key) -> Leaving {
        let pixels = (0..620 * 4).map(|at| 1.0 + ((at * (key.0 as usize + 1)) % 13) as f32).collect();
        let frame = Frame::from_pixels("a", Image { width: 620, height: 4, pixels }, Domain::Linear).expect("a frame");
        let whole = Arc::new(PairPictures::alone(&frame, &Masks::default()));
        Leaving { key, small: Arc::clone(whole.small().expect("made with it")), whole }
    }

    fn put(shelf: &mut Shelf, leaving: &Leaving) -> Vec<Key> {
        let mut dropped = Vec::new();
        shelf.put(leaving, &mut dropped).expect("written");
        dropped
    }

    #[test]
    fn pictures_are_read_back_only_as_they_were_posed_last_and_not_written_again() {
        let folder = tempfile::tempdir().expect("a folder");
        let mut shelf = Shelf::in_folder(folder.path());
        let [one, two, again] = [leaving((1, 0)), leaving((2, 0)), leaving((2, 1))];
        assert!([&one, &two, &again].into_iter().all(|leaving| put(&mut shelf, leaving).is_empty()));
        assert!(shelf.fetch((2, 0)).is_none(), "it was posed again");
        let back = shelf.fetch((2, 1)).expect("there");
        assert_eq!(back.acquired(), again.whole.acquired());
        let other = shelf.fetch((1, 0)).expect("there");
        assert_eq!(other.acquired(), one.whole.acquired());
        assert_ne!(back.acquired(), other.acquired(), "the control");
        assert!(!back.is_small() && back.is_read_back());
        // A file that may not grow has them all the same; what is new takes the place of the oldest.
        shelf.yard = shelf.yard.of_at_most(0);
        let back = Leaving { whole: Arc::new(back), ..leaving((2, 1)) };
        assert!(put(&mut shelf, &back).is_empty() && shelf.fetch((2, 1)).is_some());
        let mut dropped = Vec::new();
        assert!(shelf.put(&leaving((3, 0)), &mut dropped).is_ok());
        assert_eq!((dropped, shelf.kept.len()), (vec![(1, 0)], 2));
    }

    /// The pictures of a long session took the log's disk.
    #[test]
    fn pictures_of_the_oldest_exposures_go_where_there_is_no_room() {
        let folder = tempfile::tempdir().expect("a folder");
        let mut shelf = Shelf::in_folder(folder.path());
        let of_one: usize = {
            let leaving = leaving((1, 0));
            let Pages { values, meanings } = leaving.whole.pages();
            values.into_iter().chain([&meanings]).map(|image| image.pixels.len() * size_of::<f32>()).sum()
        };
        shelf.yard = shelf.yard.of_at_most(2 * of_one as u64);
        let dropped: Vec<Vec<Key>> = (1..=4).map(|number| put(&mut shelf, &leaving((number, 0)))).collect();
        let expected: [Vec<Key>; 4] = [vec![], vec![], vec![(1, 0)], vec![(2, 0)]];
        assert_eq!(dropped, expected);
        assert!(shelf.fetch((2, 0)).is_none());
        for number in [3, 4] {
            let back = shelf.fetch((number, 0)).expect("there");
            assert_eq!(back.acquired(), leaving((number, 0)).whole.acquired());
        }
    }

    /// All pictures went, one after the other, for a disk that had failed.
    #[test]
    fn pictures_stay_where_it_is_not_room_that_is_wanting() {
        let folder = tempfile::tempdir().expect("a folder");
        let mut shelf = Shelf::in_folder(folder.path());
        assert!((1..=2).all(|number| put(&mut shelf, &leaving((number, 0))).is_empty()));
        shelf.yard = Yard::in_folder(&folder.path().join("none"));
        let mut dropped = Vec::new();
        let refused = shelf.put(&leaving((3, 0)), &mut dropped).expect_err("no folder");
        assert_eq!((refused.kind(), dropped, shelf.kept.len()), (std::io::ErrorKind::NotFound, vec![], 2));
        assert!(!is_for_want_of_room(&refused) && is_for_want_of_room(&std::io::ErrorKind::QuotaExceeded.into()));
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
        album.fetch((5, 0));
        assert_eq!(shared.lock().wanted, None, "it is being read");
        album.fetch((1, 0));
        assert_eq!(shared.lock().wanted, Some((1, 0)), "the control");
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
