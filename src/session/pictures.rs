//! Pictures that came before, whatever file they were in.

use std::collections::BTreeMap;

use crate::acquire::Frame;

/// What tells a picture from others: its size, the sum of its pixels' bits as numbers, and their checksum. Two exposures of one scene differ
/// in their quanta.
type Digest = ([usize; 2], u64, u32);

/// The content that first showed each picture.
#[derive(Clone, Debug, Default)]
pub(super) struct Pictures {
    first: BTreeMap<Digest, String>,
}

impl Pictures {
    /// The content that `frame` is a copy of, or its own. Images of a run are told by their file; blank pictures are all alike.
    pub(super) fn first_of(&mut self, frame: &Frame) -> String {
        let pixels = &frame.pixels.pixels;
        let is_blank = pixels.windows(2).all(|pair| pair[0].to_bits() == pair[1].to_bits());
        if frame.image_of_file[1] > 1 || is_blank {
            return frame.sha256.clone();
        }
        let mut checksum = crc32fast::Hasher::new();
        let mut sum = 0u64;
        for row in pixels.chunks(4096) {
            checksum.update(bytemuck::cast_slice(row));
            sum = row.iter().fold(sum, |sum, pixel| sum.wrapping_add(u64::from(pixel.to_bits())));
        }
        self.first.entry((frame.size_px, sum, checksum.finalize())).or_insert_with(|| frame.sha256.clone()).clone()
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
        assert_eq!(pictures.first_of(&frame(&[1.0, 2.0, 3.0, 4.0], "a")), "a");
        assert_eq!(pictures.first_of(&frame(&[1.0, 2.0, 4.0, 3.0], "b")), "b");
        assert_eq!(pictures.first_of(&frame(&[1.0, 2.0, 3.0, 4.0], "c")), "a");
        assert_eq!(pictures.first_of(&frame(&[0.0; 4], "d")), "d");
        assert_eq!(pictures.first_of(&frame(&[0.0; 4], "e")), "e");
        let run = Frame { image_of_file: [1, 3], ..frame(&[1.0, 2.0, 3.0, 4.0], "f") };
        assert_eq!(pictures.first_of(&run), "f");
    }
}
