//! Pictures of frames that wait, on the disk of the session's folder: a burst of hundreds of frames does not fill the memory. A thread of its
//! own writes and reads them, so that a disk that stands still holds up nobody else.

use std::fs::File;
use std::io::{Error, ErrorKind};
use std::path::{Path, PathBuf};
use std::sync::mpsc::{Receiver, Sender, channel};
use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError};

use super::crosscheck::free_bytes;
use crate::image::Image;
use crate::reporter::Reporter;

/// Where a picture lies in the file.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
struct Slot {
    at_byte: u64,
    size_px: [usize; 2],
    /// CRC-32 of what lies there.
    sum: u32,
}

impl Slot {
    fn bytes(&self) -> u64 {
        (self.size_px[0] * self.size_px[1] * size_of::<f32>()) as u64
    }
}

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
        let yard = Yard { folder: folder.to_owned(), file: None, end_byte: 0, free: Vec::new(), taken: 0 };
        let reporter = reporter.clone();
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

/// So much of the disk is left to the log.
const LEFT_BYTES: u64 = 2 << 30;

/// The file, and what of it is free again.
struct Yard {
    folder: PathBuf,
    file: Option<File>,
    end_byte: u64,
    free: Vec<Slot>,
    taken: usize,
}

impl Yard {
    fn put(&mut self, image: &Image<f32>) -> std::io::Result<Slot> {
        let size_px = [image.width, image.height];
        if free_bytes(&self.folder).is_some_and(|free| free < LEFT_BYTES) {
            return Err(Error::other("less than 2 GB are free"));
        }
        let file = match &mut self.file {
            Some(file) => file,
            none => none.insert(tempfile::tempfile_in(&self.folder)?),
        };
        let reused = self.free.iter().position(|slot| slot.size_px == size_px);
        let at_byte = reused.map_or(self.end_byte, |place| self.free[place].at_byte);
        let bytes = bytemuck::cast_slice(&image.pixels);
        write_at(file, bytes, at_byte)?;
        let slot = Slot { at_byte, size_px, sum: crc32fast::hash(bytes) };
        match reused {
            Some(place) => drop(self.free.swap_remove(place)),
            None => self.end_byte += slot.bytes(),
        }
        self.taken += 1;
        Ok(slot)
    }

    /// Its place is free then, readable or not.
    fn take(&mut self, slot: Slot) -> std::io::Result<Image<f32>> {
        let [width, height] = slot.size_px;
        let file = self.file.as_mut().ok_or_else(|| Error::from(ErrorKind::NotFound))?;
        let mut image = Image::filled(width, height, 0.0f32);
        let read = read_at(file, bytemuck::cast_slice_mut(&mut image.pixels), slot.at_byte);
        self.let_go(slot);
        read?;
        match crc32fast::hash(bytemuck::cast_slice(&image.pixels)) == slot.sum {
            true => Ok(image),
            false => Err(Error::new(ErrorKind::InvalidData, "it is not what was written")),
        }
    }

    fn let_go(&mut self, slot: Slot) {
        self.free.push(slot);
        self.taken = self.taken.saturating_sub(1);
        if self.taken == 0 {
            self.free.clear();
            self.end_byte = 0;
            // The disk has it back; where it cannot, the places are used again.
            let _ = self.file.as_mut().map(|file| file.set_len(0));
        }
    }
}

fn write_at(file: &mut File, bytes: &[u8], at_byte: u64) -> std::io::Result<()> {
    use std::io::{Seek, SeekFrom, Write};
    file.seek(SeekFrom::Start(at_byte))?;
    file.write_all(bytes)
}

fn read_at(file: &mut File, bytes: &mut [u8], at_byte: u64) -> std::io::Result<()> {
    use std::io::{Read, Seek, SeekFrom};
    file.seek(SeekFrom::Start(at_byte))?;
    file.read_exact(bytes)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn image(size_px: [usize; 2], first: u32) -> Image<f32> {
        let pixels = (0..size_px[0] * size_px[1]).map(|n| f32::from_bits(first.wrapping_mul(2_654_435_761) ^ n as u32)).collect();
        Image { width: size_px[0], height: size_px[1], pixels }
    }

    fn bits(image: &Image<f32>) -> Vec<u32> {
        image.pixels.iter().map(|value| value.to_bits()).collect()
    }

    #[test]
    fn pictures_come_back_bit_for_bit_and_places_are_used_again() {
        let folder = tempfile::tempdir().expect("a folder");
        let mut yard = Yard { folder: folder.path().to_owned(), file: None, end_byte: 0, free: Vec::new(), taken: 0 };
        let images = [image([7, 5], 1), image([3, 4], 2), image([7, 5], 3)];
        let slots = images.each_ref().map(|image| yard.put(image).expect("written"));
        let back = yard.take(slots[0]).expect("read");
        assert_eq!(([back.width, back.height], bits(&back)), ([7, 5], bits(&images[0])));
        let end_byte = yard.end_byte;
        let again = yard.put(&image([7, 5], 4)).expect("written");
        assert_eq!((again.at_byte, yard.end_byte), (slots[0].at_byte, end_byte));
        for (slot, expected) in [(slots[1], &images[1]), (slots[2], &images[2]), (again, &image([7, 5], 4))] {
            assert_eq!(bits(&yard.take(slot).expect("read")), bits(expected));
        }
        assert_eq!(yard.file.as_ref().expect("a file").metadata().expect("metadata").len(), 0, "nothing waits");
        assert_eq!(std::fs::read_dir(folder.path()).expect("a folder").count(), 0, "the file has no name");
        let altered = yard.put(&images[1]).expect("written");
        write_at(yard.file.as_mut().expect("a file"), &[0xff], 5).expect("written");
        assert!(yard.take(altered).is_err(), "not what was written");
        yard.folder = folder.path().join("none");
        yard.file = None;
        assert!(yard.put(&images[0]).is_err());
    }

    /// The thread is played by hand, so that what is asked for comes at any moment of its work.
    #[test]
    fn a_picture_is_there_at_once_while_the_disk_stands_still_and_comes_back_or_is_lost_afterwards() {
        let folder = tempfile::tempdir().expect("a folder");
        let yard = || Yard { folder: folder.path().to_owned(), file: None, end_byte: 0, free: Vec::new(), taken: 0 };
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
