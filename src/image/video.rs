//! A video of pictures, as Motion-JPEG in AVI: no codec that a player may lack.
//!
//! RIFF of lists and chunks, each a name of four letters and its length: the headers (`hdrl`), the pictures (`movi`), where each of them lies
//! (`idx1`). Lengths and counts that only the end knows are written there.

use std::fs::File;
use std::io::{BufWriter, Seek, SeekFrom, Write};
use std::path::Path;

use image::codecs::jpeg::JpegEncoder;

use super::Image;

/// As good as one looks at still pictures.
const QUALITY: u8 = 95;
/// Offsets of the index have 32 bits, and players count with a sign.
const MOST_BYTES: u64 = i32::MAX as u64;
/// Where the length of the file, the number of pictures (twice) and the length of `movi` stand.
const RIFF_BYTES: u64 = 4;
const PICTURES: [u64; 2] = [48, 140];
const MOVI_BYTES: u64 = 216;
/// What `movi` begins with; offsets of the index count from there.
const MOVI: u64 = 220;
/// `idx1`: every picture stands by itself.
const KEY_FRAME: u32 = 0x10;

/// Writes pictures one after the other; those of another size than the first stand in its upper left corner, cut where they are larger.
pub struct VideoFile {
    file: BufWriter<File>,
    size: [u16; 2],
    /// Offset and length of each picture.
    index: Vec<[u32; 2]>,
    bytes: u64,
}

fn words(error: std::io::Error) -> String {
    format!("it cannot be written as a video ({})", error.kind())
}

impl VideoFile {
    /// Begins a video of `per_s` pictures of `size` (columns, rows) a second at `path`, which is written as it goes.
    ///
    /// # Errors
    /// One sentence, when it cannot be written.
    pub fn create(path: &Path, size: [usize; 2], per_s: f64) -> Result<Self, String> {
        let edge = |n: usize| u16::try_from(n).ok().filter(|n| *n > 0);
        let (Some(width), Some(height)) = (edge(size[0]), edge(size[1])) else {
            return Err(format!("a video of {} x {} pixels cannot be written: expected 1 to 65535 each way", size[0], size[1]));
        };
        if !(0.001..=1000.0).contains(&per_s) {
            return Err(format!("a video of {per_s} pictures a second cannot be written: expected 0.001 to 1000"));
        }
        let file = File::create(path).map_err(|error| format!("{}; is the folder there, and writable?", words(error)))?;
        let mut video = Self { file: BufWriter::new(file), size: [width, height], index: Vec::new(), bytes: 0 };
        video.file.write_all(&header([width, height], per_s)).map_err(words)?;
        video.bytes = MOVI + 4;
        Ok(video)
    }

    /// Adds a picture, `times` over.
    ///
    /// # Errors
    /// One sentence, when it cannot be written.
    pub fn add(&mut self, picture: &Image<[u8; 3]>, times: u32) -> Result<(), String> {
        let [columns, rows] = self.size.map(usize::from);
        let mut canvas = vec![0; 3 * columns * rows];
        for (row, line) in canvas.chunks_exact_mut(3 * columns).take(picture.height).enumerate() {
            for (column, pixel) in line.chunks_exact_mut(3).take(picture.width).enumerate() {
                pixel.copy_from_slice(picture.at(column, row));
            }
        }
        let mut jpeg = Vec::new();
        let encoded = JpegEncoder::new_with_quality(&mut jpeg, QUALITY).encode(
            &canvas,
            u32::from(self.size[0]),
            u32::from(self.size[1]),
            image::ExtendedColorType::Rgb8,
        );
        encoded.map_err(|error| format!("a picture of it cannot be written ({error})"))?;
        let length = jpeg.len();
        if length % 2 == 1 {
            jpeg.push(0);
        }
        for _ in 0..times {
            let after = self.bytes + 8 + jpeg.len() as u64;
            // With an entry in the index for each.
            if after + 16 * (self.index.len() as u64 + 2) > MOST_BYTES {
                return Err(
                    "it would be larger than 2 GiB, which is the most that a video of this kind holds: choose fewer".to_owned()
                );
            }
            self.index.push([(self.bytes - MOVI) as u32, length as u32]);
            let written = self.file.write_all(b"00dc").and_then(|()| self.file.write_all(&(length as u32).to_le_bytes()));
            written.and_then(|()| self.file.write_all(&jpeg)).map_err(words)?;
            self.bytes = after;
        }
        Ok(())
    }

    /// Closes the file, once it is on the disk.
    ///
    /// # Errors
    /// One sentence, when it cannot be written.
    pub fn finish(mut self) -> Result<(), String> {
        self.write_end().map_err(words)
    }

    fn write_end(&mut self) -> std::io::Result<()> {
        let pictures = self.index.len() as u32;
        self.file.write_all(&chunk(b"idx1", &self.index.iter().flat_map(entry).collect::<Vec<u8>>()))?;
        let all = self.bytes + 8 + 16 * u64::from(pictures);
        let patches = [(RIFF_BYTES, (all - 8) as u32), (MOVI_BYTES, (self.bytes - MOVI) as u32)];
        for (at, value) in patches.into_iter().chain(PICTURES.map(|at| (at, pictures))) {
            self.file.seek(SeekFrom::Start(at))?;
            self.file.write_all(&value.to_le_bytes())?;
        }
        self.file.flush()?;
        self.file.get_ref().sync_all()
    }
}

fn entry([offset, length]: &[u32; 2]) -> Vec<u8> {
    let numbers = [KEY_FRAME, *offset, *length].map(u32::to_le_bytes).concat();
    [b"00dc".as_slice(), &numbers].concat()
}

fn chunk(name: &[u8; 4], content: &[u8]) -> Vec<u8> {
    [name.as_slice(), &(content.len() as u32).to_le_bytes(), content].concat()
}

/// Everything before the first picture.
fn header([width, height]: [u16; 2], per_s: f64) -> Vec<u8> {
    let [columns, rows] = [width, height].map(u32::from);
    // Pictures a second, as a ratio.
    let (scale, rate) = (1000u32, (1000.0 * per_s).round() as u32);
    let us_per_picture = (1e6 / per_s).round() as u32;
    let has_index = 0x10u32;
    let numbers = |values: &[u32]| values.iter().flat_map(|value| value.to_le_bytes()).collect::<Vec<u8>>();
    let avih = numbers(&[us_per_picture, 0, 0, has_index, 0, 0, 1, 0, columns, rows, 0, 0, 0, 0]);
    let rectangle = [0, 0, width, height].map(u16::to_le_bytes).concat();
    let best = u32::MAX;
    let strh = [b"vidsMJPG".as_slice(), &numbers(&[0, 0, 0, scale, rate, 0, 0, 0, best, 0]), &rectangle].concat();
    let planes_and_bits = (24 << 16) | 1;
    let jpeg = u32::from_le_bytes(*b"MJPG");
    let strf = numbers(&[40, columns, rows, planes_and_bits, jpeg, columns.saturating_mul(rows).saturating_mul(3), 0, 0, 0, 0]);
    let stream = [b"strl".as_slice(), &chunk(b"strh", &strh), &chunk(b"strf", &strf)].concat();
    let lists = [b"hdrl".as_slice(), &chunk(b"avih", &avih), &chunk(b"LIST", &stream)].concat();
    [b"RIFF\0\0\0\0AVI ".as_slice(), &chunk(b"LIST", &lists), b"LIST\0\0\0\0movi"].concat()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn number(bytes: &[u8], at: usize) -> u32 {
        u32::from_le_bytes(bytes[at..at + 4].try_into().expect("four bytes"))
    }

    #[test]
    fn lengths_add_up_and_the_index_points_at_pictures() {
        let file = tempfile::NamedTempFile::new().expect("a file");
        let mut video = VideoFile::create(file.path(), [20, 12], 2.0).expect("begun");
        video.add(&Image::filled(20, 12, [200, 30, 30]), 2).expect("added");
        video.add(&Image::filled(9, 40, [10, 90, 250]), 1).expect("added");
        video.finish().expect("closed");
        let bytes = std::fs::read(file.path()).expect("read");
        assert_eq!((&bytes[..4], number(&bytes, 4) as usize), (b"RIFF".as_slice(), bytes.len() - 8));
        assert_eq!(PICTURES.map(|at| number(&bytes, at as usize)), [3, 3]);
        let movi = MOVI as usize;
        assert_eq!(&bytes[movi - 8..movi - 4], b"LIST");
        assert_eq!(&bytes[movi..movi + 4], b"movi");
        let index = movi + number(&bytes, MOVI_BYTES as usize) as usize;
        assert_eq!((&bytes[index..index + 4], number(&bytes, index + 4)), (b"idx1".as_slice(), 3 * 16));
        assert_eq!(index + 8 + 3 * 16, bytes.len());
        for (n, colour) in [[200, 30, 30], [200, 30, 30], [10, 90, 250]].into_iter().enumerate() {
            let entry = index + 8 + 16 * n;
            let [offset, length] = [8, 12].map(|at| number(&bytes, entry + at) as usize);
            assert_eq!((&bytes[movi + offset..][..4], number(&bytes, movi + offset + 4) as usize), (b"00dc".as_slice(), length));
            let jpeg = &bytes[movi + offset + 8..][..length];
            let picture = image::load_from_memory_with_format(jpeg, image::ImageFormat::Jpeg).expect("a picture").to_rgb8();
            assert_eq!(picture.dimensions(), (20, 12));
            let close = picture.get_pixel(4, 4).0.iter().zip(colour).all(|(a, b)| a.abs_diff(b) <= 6);
            assert!(close, "{:?}, expected {colour:?}", picture.get_pixel(4, 4));
        }
        assert_eq!(number(&bytes, 128), 1000, "scale");
        assert_eq!(number(&bytes, 132), 2000, "rate");
    }

    #[test]
    fn what_no_video_has_is_refused() {
        let file = tempfile::NamedTempFile::new().expect("a file");
        assert!(VideoFile::create(file.path(), [0, 12], 2.0).is_err_and(|words| words.contains("0 x 12")));
        assert!(VideoFile::create(file.path(), [70_000, 12], 2.0).is_err());
        assert!(VideoFile::create(file.path(), [65_535, 65_535], 2.0).is_ok(), "the largest");
        for per_s in [0.0, -1.0, f64::NAN] {
            assert!(VideoFile::create(file.path(), [20, 12], per_s).is_err_and(|words| words.contains("pictures a second")));
        }
    }
}
