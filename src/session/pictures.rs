//! Pictures that came before, whatever file they were in and in whatever grey scale.

use std::collections::BTreeMap;

use crate::acquire::Frame;
use crate::image::Image;

/// What tells a picture from others: its size, the sum of its pixels' bits as numbers, and their checksum. Two exposures of one scene differ
/// in their quanta.
type Digest = ([usize; 2], u64, u32);

/// Places of a picture at which its quanta are looked at.
const SITES: usize = 16_384;
/// Two pictures are compared where both rise or fall at so many places at least.
const LEAST_DECIDED: u32 = 1024;
/// Share of the places at which one picture in two grey scales may differ: writing comes into a corner. The signs of two exposures agree so well
/// only where a pattern of the panel is 45 times as strong as the quanta (disagreement is arccos ρ / π).
const DIFFERING_SHARE: f64 = 0.01;
/// Least share of the places in which a picture with quanta turns from rising to falling within three pixels. White noise turns in two
/// thirds of them, noise that was smoothed over a pixel in a third, a picture without noise at its edges only.
const TURNING_SHARE: f64 = 0.15;

/// The content that first showed each picture.
#[derive(Clone, Debug, Default)]
pub(super) struct Pictures {
    first: BTreeMap<Digest, String>,
    grains: Vec<([usize; 2], Grain, String)>,
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
        let digest = (frame.size_px, sum, checksum.finalize());
        if let Some(first) = self.first.get(&digest) {
            return first.clone();
        }
        let grain = Grain::of(&frame.pixels);
        let same = |(size_px, other, _): &&([usize; 2], Grain, String)| {
            *size_px == frame.size_px && grain.as_ref().is_some_and(|grain| grain.is_of_one_exposure(other))
        };
        let first = self.grains.iter().find(same).map_or_else(|| frame.sha256.clone(), |(_, _, first)| first.clone());
        self.first.insert(digest, first.clone());
        self.grains.extend(grain.map(|grain| (frame.size_px, grain, first.clone())));
        first
    }
}

/// Where a picture rises and where it falls from one pixel to the next: its quanta decide that, and no grey scale changes it but to turn all
/// round or to make neighbours equal.
#[derive(Clone, Debug)]
struct Grain {
    rising: Vec<u64>,
    falling: Vec<u64>,
}

impl Grain {
    /// `None` for a picture without noise: two exposures of one scene look alike there.
    fn of(image: &Image<f32>) -> Option<Self> {
        let within = image.width.checked_sub(2).filter(|within| *within > 0)?;
        let places = within * image.height;
        let sites = SITES.min(places);
        let mut grain = Self { rising: vec![0; sites.div_ceil(64)], falling: vec![0; sites.div_ceil(64)] };
        let (mut decided, mut turning) = (0u32, 0u32);
        for site in 0..sites {
            let place = (site as u128 * places as u128 / sites as u128) as usize;
            let at = place / within * image.width + place % within;
            let [first, second, third] = [0, 1, 2].map(|n| image.pixels[at + n]);
            let bit = 1u64 << (site % 64);
            if second > first {
                grain.rising[site / 64] |= bit;
            } else if second < first {
                grain.falling[site / 64] |= bit;
            }
            let (one, other) = (second - first, third - second);
            // Not a number is neither.
            decided += u32::from(one * one > 0.0 && other * other > 0.0);
            turning += u32::from(one > 0.0 && other < 0.0 || one < 0.0 && other > 0.0);
        }
        (decided >= LEAST_DECIDED && f64::from(turning) >= TURNING_SHARE * f64::from(decided)).then_some(grain)
    }

    fn is_of_one_exposure(&self, other: &Self) -> bool {
        let common = |a: &[u64], b: &[u64]| a.iter().zip(b).map(|(a, b)| (a & b).count_ones()).sum::<u32>();
        let alike = common(&self.rising, &other.rising) + common(&self.falling, &other.falling);
        let opposed = common(&self.rising, &other.falling) + common(&self.falling, &other.rising);
        let decided = alike + opposed;
        decided >= LEAST_DECIDED && f64::from(alike.min(opposed)) <= DIFFERING_SHARE * f64::from(decided)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::acquire::Domain;
    use crate::random::{Purpose, Stream};

    fn frame(pixels: &[f32], sha256: &str) -> Frame {
        framed(Image { width: 2, height: 2, pixels: pixels.to_vec() }, sha256)
    }

    fn framed(image: Image<f32>, sha256: &str) -> Frame {
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

    /// A ramp with a dark disc and so much noise; `smoothed` over the next pixel, as consoles do.
    fn scene(seed: u64, sigma: f64, smoothed: bool) -> Image<f32> {
        let mut random = Stream::new(seed, 0, 0, Purpose::Evaluation);
        let (width, height) = (160, 120);
        let value = |n: usize| {
            let (x, y) = ((n % width) as f64, (n / width) as f64);
            1000.0 + 3.0 * x + y - if (x - 80.0).hypot(y - 60.0) < 30.0 { 400.0 } else { 0.0 }
        };
        let noisy: Vec<f32> = (0..width * height).map(|n| (value(n) + sigma * random.normal()) as f32).collect();
        let smooth = |n: usize| 0.5 * (noisy[n] + noisy[(n + 1).min(noisy.len() - 1)]);
        let pixels = if smoothed { (0..noisy.len()).map(smooth).collect() } else { noisy };
        Image { width, height, pixels }
    }

    #[test]
    fn one_exposure_in_another_grey_scale_is_a_copy_and_another_exposure_of_the_scene_is_not() {
        for smoothed in [false, true] {
            let mut pictures = Pictures::default();
            let acquired = scene(1, 12.0, smoothed);
            assert_eq!(pictures.first_of(&framed(acquired.clone(), "a")), "a");
            let eight_bits = acquired.map(|p| (255.0 * (p / 1800.0).powf(0.7)).round());
            assert_eq!(pictures.first_of(&framed(eight_bits, "b")), "a");
            assert_eq!(pictures.first_of(&framed(acquired.map(|p| -(p / 2000.0).ln()), "c")), "a");
            assert_eq!(pictures.first_of(&framed(scene(2, 12.0, smoothed), "d")), "d");
            // Little noise on steep ground.
            assert_eq!(pictures.first_of(&framed(scene(3, 2.0, smoothed), "e")), "e");
            assert_eq!(pictures.first_of(&framed(scene(4, 2.0, smoothed), "f")), "f");
        }
        // Nothing tells two exposures without noise from one in two grey scales.
        let mut pictures = Pictures::default();
        assert_eq!(pictures.first_of(&framed(scene(5, 0.0, false), "g")), "g");
        assert_eq!(pictures.first_of(&framed(scene(5, 0.0, false).map(|p| 0.5 * p), "h")), "h");
    }
}
