//! Pictures that came before, whatever file they were in.

use std::collections::BTreeMap;

use serde::{Deserialize, Serialize};

use crate::acquire::Frame;

/// What tells a picture from others: its size, the sum of its pixels' bits as numbers, and their checksum. Two exposures of one scene differ
/// in their quanta.
#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
pub struct PictureDigest([usize; 2], u64, u32);

impl PictureDigest {
    /// Of a frame with its pixels. Images of a run are told by their file, and blank pictures are all alike: these have none.
    #[must_use]
    pub fn of(frame: &Frame) -> Option<Self> {
        let pixels = &frame.pixels.pixels;
        let is_blank = pixels.windows(2).all(|pair| pair[0].to_bits() == pair[1].to_bits());
        if frame.image_of_file[1] > 1 || is_blank {
            return None;
        }
        let mut checksum = crc32fast::Hasher::new();
        let mut sum = 0u64;
        for row in pixels.chunks(4096) {
            checksum.update(bytemuck::cast_slice(row));
            sum = row.iter().fold(sum, |sum, pixel| sum.wrapping_add(u64::from(pixel.to_bits())));
        }
        Some(Self(frame.size_px, sum, checksum.finalize()))
    }
}

/// The content that first showed each picture.
#[derive(Clone, Debug, Default)]
pub(super) struct Pictures {
    first: BTreeMap<PictureDigest, String>,
}

impl Pictures {
    /// The content that `frame`, whose picture this is, is a copy of, or its own.
    pub(super) fn first_of(&mut self, frame: &Frame, picture: Option<PictureDigest>) -> String {
        match picture {
            Some(picture) => self.first.entry(picture).or_insert_with(|| frame.sha256.clone()).clone(),
            None => frame.sha256.clone(),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::acquire::Domain;
    use crate::image::Image;

    fn frame(pixels: &[f32], sha256: &str) -> Frame {
        let image = Image { width: 2, height: 2, pixels: pixels.to_vec() };
        let frame = Frame::from_pixels("a", image, Domain::Linear).expect("a frame");
        Frame { sha256: sha256.to_owned(), ..frame }
    }

    #[test]
    fn the_same_picture_in_another_file_is_a_copy_and_a_blank_one_is_not() {
        let mut pictures = Pictures::default();
        let mut first_of = |frame: &Frame| pictures.first_of(frame, PictureDigest::of(frame));
        assert_eq!(first_of(&frame(&[1.0, 2.0, 3.0, 4.0], "a")), "a");
        assert_eq!(first_of(&frame(&[1.0, 2.0, 4.0, 3.0], "b")), "b");
        assert_eq!(first_of(&frame(&[1.0, 2.0, 3.0, 4.0], "c")), "a");
        assert_eq!(first_of(&frame(&[0.0; 4], "d")), "d");
        assert_eq!(first_of(&frame(&[0.0; 4], "e")), "e");
        let run = Frame { image_of_file: [1, 3], ..frame(&[1.0, 2.0, 3.0, 4.0], "f") };
        assert_eq!(first_of(&run), "f");
    }
}
