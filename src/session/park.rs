//! Pictures of frames that wait, on the disk of the session's folder: a burst of hundreds of frames does not fill the memory.

use std::fs::File;
use std::io::{Error, ErrorKind};
use std::path::{Path, PathBuf};

use super::crosscheck::free_bytes;
use crate::image::Image;

/// Where a picture lies.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Slot {
    at_byte: u64,
    size_px: [usize; 2],
}

impl Slot {
    fn bytes(&self) -> u64 {
        (self.size_px[0] * self.size_px[1] * size_of::<f32>()) as u64
    }
}

/// A file without a name, which is gone when the program is, and what of it is free again.
#[derive(Debug)]
pub(super) struct Park {
    folder: PathBuf,
    file: Option<File>,
    end_byte: u64,
    free: Vec<Slot>,
    taken: usize,
}

/// So much of the disk is left to the log.
const LEFT_BYTES: u64 = 2 << 30;

impl Park {
    /// Nothing is written before the first picture.
    pub(super) fn new(folder: &Path) -> Self {
        Self { folder: folder.to_owned(), file: None, end_byte: 0, free: Vec::new(), taken: 0 }
    }

    /// Writes a picture.
    ///
    /// # Errors
    /// When the file cannot be made or written; nothing is taken then.
    pub(super) fn put(&mut self, image: &Image<f32>) -> std::io::Result<Slot> {
        let size_px = [image.width, image.height];
        if free_bytes(&self.folder).is_some_and(|free| free < LEFT_BYTES) {
            return Err(Error::other("less than 2 GB are free"));
        }
        let file = match &mut self.file {
            Some(file) => file,
            none => none.insert(tempfile::tempfile_in(&self.folder)?),
        };
        let reused = self.free.iter().position(|slot| slot.size_px == size_px);
        let slot = reused.map_or(Slot { at_byte: self.end_byte, size_px }, |place| self.free[place]);
        write_at(file, bytemuck::cast_slice(&image.pixels), slot.at_byte)?;
        match reused {
            Some(place) => drop(self.free.swap_remove(place)),
            None => self.end_byte += slot.bytes(),
        }
        self.taken += 1;
        Ok(slot)
    }

    /// Reads a picture back, bit for bit; its place is free then, readable or not.
    ///
    /// # Errors
    /// When the file cannot be read.
    pub(super) fn take(&mut self, slot: Slot) -> std::io::Result<Image<f32>> {
        let [width, height] = slot.size_px;
        let file = self.file.as_mut().ok_or_else(|| Error::from(ErrorKind::NotFound))?;
        let mut image = Image::filled(width, height, 0.0f32);
        let read = read_at(file, bytemuck::cast_slice_mut(&mut image.pixels), slot.at_byte);
        self.free.push(slot);
        self.taken = self.taken.saturating_sub(1);
        if self.taken == 0 {
            // The disk has it back; where it cannot, the places are used again.
            self.free.clear();
            self.end_byte = 0;
            file.set_len(0)?;
        }
        read.map(|()| image)
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
        let mut park = Park::new(folder.path());
        let images = [image([7, 5], 1), image([3, 4], 2), image([7, 5], 3)];
        let slots = images.each_ref().map(|image| park.put(image).expect("written"));
        let back = park.take(slots[0]).expect("read");
        assert_eq!(([back.width, back.height], bits(&back)), ([7, 5], bits(&images[0])));
        let end_byte = park.end_byte;
        let again = park.put(&image([7, 5], 4)).expect("written");
        assert_eq!((again, park.end_byte), (slots[0], end_byte));
        for (slot, expected) in [(slots[1], &images[1]), (slots[2], &images[2]), (again, &image([7, 5], 4))] {
            assert_eq!(bits(&park.take(slot).expect("read")), bits(expected));
        }
        assert_eq!(park.file.as_ref().expect("a file").metadata().expect("metadata").len(), 0, "nothing waits");
        assert_eq!(std::fs::read_dir(folder.path()).expect("a folder").count(), 0, "the file has no name");
        let gone = folder.path().join("none");
        assert!(Park::new(&gone).put(&images[0]).is_err());
    }
}
