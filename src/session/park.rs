//! Pictures of frames that wait, on the disk of the session's folder: a burst of hundreds of frames does not fill the memory. A thread of its
//! own writes and reads them, so that a disk that stands still holds up nobody else.

use std::path::Path;
use std::sync::mpsc::{Receiver, Sender, channel};
use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError};

use super::yard::{Slot, Yard};
use crate::image::Image;
use crate::reporter::Reporter;

/// Where a picture is.
#[derive(Debug)]
enum Place {
    /// In memory, to be written.
    Leaving(Arc<Image<f32>>),
    OnDisk(Slot),
    /// Asked for.
    Returning(Slot),
    /// In memory, and it stays there.
    Here(Arc<Image<f32>>),
    /// It cannot be read back.
    Lost(String),
}

/// A picture that was given away.
#[derive(Clone, Debug)]
pub(super) struct Parked {
    place: Arc<(Mutex<Place>, Condvar)>,
    requests: Sender<Parked>,
}

impl Parked {
    fn lock(&self) -> MutexGuard<'_, Place> {
        self.place.0.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Whether it is back; it is fetched where it is not.
    pub(super) fn is_here(&self) -> bool {
        let mut place = self.lock();
        let next = match &*place {
            Place::Leaving(image) => Some(Place::Here(Arc::clone(image))),
            Place::OnDisk(slot) => Some(match self.requests.send(self.clone()) {
                Ok(()) => Place::Returning(*slot),
                Err(_) => Place::Lost("the thread that reads it has ended".to_owned()),
            }),
            Place::Returning(_) | Place::Here(_) | Place::Lost(_) => None,
        };
        if let Some(next) = next {
            *place = next;
        }
        matches!(*place, Place::Here(_) | Place::Lost(_))
    }

    /// The picture, bit for bit; waits for it.
    ///
    /// # Errors
    /// Why it cannot be read back.
    pub(super) fn take(self) -> Result<Arc<Image<f32>>, String> {
        self.is_here();
        let mut place = self.lock();
        loop {
            match &*place {
                Place::Here(image) => return Ok(Arc::clone(image)),
                Place::Lost(reason) => return Err(reason.clone()),
                Place::Leaving(_) | Place::OnDisk(_) | Place::Returning(_) => {}
            }
            place = self.place.1.wait(place).unwrap_or_else(PoisonError::into_inner);
        }
    }
}

/// Takes pictures; its thread ends with it and with the last of them.
#[derive(Debug)]
pub(super) struct Park {
    requests: Sender<Parked>,
}

impl Park {
    /// In a file of `folder` without a name, which is gone when the program is. Nothing is written before the first picture.
    ///
    /// # Errors
    /// When the system gives no thread.
    pub(super) fn start(folder: &Path, reporter: &Reporter) -> std::io::Result<Self> {
        let (requests, inbox) = channel();
        let (yard, reporter) = (Yard::in_folder(folder), reporter.clone());
        std::thread::Builder::new().name("park".to_owned()).spawn(move || serve(yard, &inbox, &reporter))?;
        Ok(Self { requests })
    }

    /// Gives a picture away; it stays in memory where the disk does not take it, which is said.
    pub(super) fn put(&self, image: Image<f32>) -> Parked {
        let place = Arc::new((Mutex::new(Place::Leaving(Arc::new(image))), Condvar::new()));
        let parked = Parked { place, requests: self.requests.clone() };
        // Without the thread it stays where it is.
        let _ = self.requests.send(parked.clone());
        parked
    }
}

fn serve(mut yard: Yard, inbox: &Receiver<Parked>, reporter: &Reporter) {
    for parked in inbox {
        let leaving = match &*parked.lock() {
            Place::Leaving(image) => Ok(Arc::clone(image)),
            Place::Returning(slot) => Err(*slot),
            Place::OnDisk(_) | Place::Here(_) | Place::Lost(_) => continue,
        };
        // Nobody waits for the lock while the disk works.
        match leaving {
            Ok(image) => match yard.put(&image) {
                Ok(slot) => {
                    let mut place = parked.lock();
                    match &*place {
                        Place::Leaving(_) => *place = Place::OnDisk(slot),
                        _ => yard.let_go(slot),
                    }
                }
                Err(error) => {
                    let words = format!("frames that wait stay in memory, the session's folder does not take them: {error}");
                    reporter.warn("many frames wait", words);
                }
            },
            Err(slot) => {
                let read = yard.take(slot);
                *parked.lock() = match read {
                    Ok(image) => Place::Here(Arc::new(image)),
                    Err(error) => Place::Lost(error.to_string()),
                };
                parked.place.1.notify_all();
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::super::yard::example::{bits, image};
    use super::*;

    /// The thread is played by hand, so that what is asked for comes at any moment of its work.
    #[test]
    fn a_picture_is_there_at_once_while_the_disk_stands_still_and_comes_back_or_is_lost_afterwards() {
        let folder = tempfile::tempdir().expect("a folder");
        let yard = || Yard::in_folder(folder.path());
        let (requests, inbox) = channel();
        let park = Park { requests };
        let picture = image([4, 3], 7);
        let early = park.put(picture.clone());
        assert!(early.is_here(), "it has not left the memory");
        assert_eq!(bits(&early.take().expect("there")), bits(&picture));
        let [late, unreadable] = [park.put(picture.clone()), park.put(picture.clone())];
        let served: Vec<Parked> = inbox.try_iter().collect();
        let (again, wanted) = channel();
        served.into_iter().for_each(|parked| again.send(parked).expect("sent"));
        drop(again);
        serve(yard(), &wanted, &Reporter::silent());
        assert!(matches!(*late.lock(), Place::OnDisk(_)) && !late.is_here(), "asked for, not there");
        assert!(!unreadable.is_here());
        // Another file holds nothing.
        let [first, second] = [inbox.recv().expect("asked"), inbox.recv().expect("asked")];
        *first.lock() = Place::Here(Arc::new(picture.clone()));
        first.place.1.notify_all();
        let (again, wanted) = channel();
        again.send(second).expect("sent");
        drop(again);
        serve(yard(), &wanted, &Reporter::silent());
        assert_eq!(bits(&late.take().expect("there")), bits(&picture));
        assert!(unreadable.is_here() && unreadable.take().is_err());
    }
}
