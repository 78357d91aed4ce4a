//! A file without a name in which pictures lie for the time being, beside the log that must not run out of disk.

use std::fs::File;
use std::io::{Error, ErrorKind};
use std::path::{Path, PathBuf};

use super::crosscheck::free_bytes;
use crate::image::Image;

/// Where a picture lies in the file.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Slot {
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

/// So much of the disk is left to the log. Tests run where less is free.
const LEFT_BYTES: u64 = if cfg!(test) { 1 << 20 } else { 2 << 30 };

/// The file, and what of it is free again.
pub(super) struct Yard {
    folder: PathBuf,
    file: Option<File>,
    end_byte: u64,
    /// The file grows no further.
    most_bytes: u64,
    free: Vec<Slot>,
    taken: usize,
}

impl Yard {
    /// In a file of `folder` without a name, which is gone when the program is. Nothing is written before the first picture.
    pub(super) fn in_folder(folder: &Path) -> Self {
        Self { folder: folder.to_owned(), file: None, end_byte: 0, most_bytes: u64::MAX, free: Vec::new(), taken: 0 }
    }

    /// The same in a file of at most so many bytes.
    pub(super) fn of_at_most(self, most_bytes: u64) -> Self {
        Self { most_bytes, ..self }
    }

    /// Takes a picture.
    pub(super) fn put(&mut self, image: &Image<f32>) -> std::io::Result<Slot> {
        let size_px = [image.width, image.height];
        if free_bytes(&self.folder).is_some_and(|free| free < LEFT_BYTES) {
            return Err(Error::new(ErrorKind::StorageFull, "less than 2 GB are free"));
        }
        let reused = self.free.iter().position(|slot| slot.size_px == size_px);
        let bytes: &[u8] = bytemuck::cast_slice(&image.pixels);
        if reused.is_none() && self.end_byte + bytes.len() as u64 > self.most_bytes {
            let words = format!("their {:.1} GB are full", self.most_bytes as f64 * 1e-9);
            return Err(Error::new(ErrorKind::StorageFull, words));
        }
        let file = match &mut self.file {
            Some(file) => file,
            none => none.insert(tempfile::tempfile_in(&self.folder)?),
        };
        let at_byte = reused.map_or(self.end_byte, |place| self.free[place].at_byte);
        write_at(file, bytes, at_byte)?;
        let slot = Slot { at_byte, size_px, sum: crc32fast::hash(bytes) };
        match reused {
            Some(place) => drop(self.free.swap_remove(place)),
            None => self.end_byte += slot.bytes(),
        }
        self.taken += 1;
        Ok(slot)
    }

    /// Gives a picture back, bit for bit. Its place is free then, readable or not.
    pub(super) fn take(&mut self, slot: Slot) -> std::io::Result<Image<f32>> {
        let read = self.read(slot);
        self.let_go(slot);
        read
    }

    /// A picture, bit for bit; it stays where it is.
    pub(super) fn read(&mut self, slot: Slot) -> std::io::Result<Image<f32>> {
        let [width, height] = slot.size_px;
        let file = self.file.as_mut().ok_or_else(|| Error::from(ErrorKind::NotFound))?;
        let mut image = Image::filled(width, height, 0.0f32);
        read_at(file, bytemuck::cast_slice_mut(&mut image.pixels), slot.at_byte)?;
        match crc32fast::hash(bytemuck::cast_slice(&image.pixels)) == slot.sum {
            true => Ok(image),
            false => Err(Error::new(ErrorKind::InvalidData, "it is not what was written")),
        }
    }

    /// What lies there is not wanted any more.
    pub(super) fn let_go(&mut self, slot: Slot) {
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

/// Whether pictures that go would leave room for those that were not taken.
pub(super) fn is_for_want_of_room(error: &Error) -> bool {
    matches!(error.kind(), ErrorKind::StorageFull | ErrorKind::QuotaExceeded)
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

/// Pictures that tell whether they came back.
#[cfg(test)]
pub(super) mod example {
    use super::*;

    /// Its pixels are of arbitrary bits, others for each `first`.
    pub(crate) fn image(size_px: [usize; 2], first: u32) -> Image<f32> {
        let pixels = (0..size_px[0] * size_px[1]).map(|n| f32::from_bits(first.wrapping_mul(2_654_435_761) ^ n as u32)).collect();
        Image { width: size_px[0], height: size_px[1], pixels }
    }

    pub(crate) fn bits(image: &Image<f32>) -> Vec<u32> {
        image.pixels.iter().map(|value| value.to_bits()).collect()
    }
}

#[cfg(test)]
mod tests {
    use super::example::{bits, image};
    use super::*;

    #[test]
    fn pictures_come_back_bit_for_bit_and_places_are_used_again() {
        let folder = tempfile::tempdir().expect("a folder");
        let mut yard = Yard::in_folder(folder.path());
        let images = [image([7, 5], 1), image([3, 4], 2), image([7, 5], 3)];
        let slots = images.each_ref().map(|image| yard.put(image).expect("written"));
        let back = yard.take(slots[0]).expect("read");
        assert_eq!(([back.width, back.height], bits(&back)), ([7, 5], bits(&images[0])));
        let end_byte = yard.end_byte;
        yard = yard.of_at_most(end_byte);
        assert!(yard.put(&image([2, 1], 5)).is_err(), "the file grows no further");
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
}
