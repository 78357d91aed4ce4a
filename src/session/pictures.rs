//! Pictures that came before, whatever file they were in and in whatever grey scale.

use std::collections::BTreeMap;

use serde::{Deserialize, Serialize};

use crate::acquire::Frame;
use crate::image::Image;

/// Places of a picture at which its quanta are looked at.
const SITES: usize = 16_384;
/// Two pictures are compared where both rise or fall at so many places at least.
const LEAST_DECIDED: u32 = 1024;
/// Parts of a picture, and the least places in one that count.
const BANDS: usize = 16;
const LEAST_IN_BAND: u32 = 64;
/// Share of the places at which one picture in two grey scales may differ: writing comes into a corner. The signs of two exposures agree so well
/// only where a pattern of the panel is 45 times as strong as the quanta (disagreement is arccos ρ / π).
const DIFFERING_SHARE: f64 = 0.01;
/// Least share of the places in which a picture with quanta turns from rising to falling within five pixels. White noise turns in two
/// thirds of them, a picture without noise at its edges only.
const TURNING_SHARE: f64 = 0.15;

/// Size of a picture, the sum of its pixels' bits as numbers, and their checksum. Two exposures of one scene differ in their quanta.
type Digest = ([usize; 2], u64, u32);

/// What tells a picture from others, without its pixels.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct PictureDigest {
    digest: Digest,
    /// `None` for a picture without noise.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    grain: Option<Grain>,
    /// The content of which it is a copy, where its grain was taken out: that alone would tell too much of the picture.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    copy_of: Option<String>,
}

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
        Some(Self { digest: (frame.size_px, sum, checksum.finalize()), grain: Grain::of(&frame.pixels), copy_of: None })
    }
}

/// The content that first showed each picture.
#[derive(Clone, Debug, Default)]
pub(super) struct Pictures {
    first: BTreeMap<Digest, First>,
    grains: Vec<Known>,
    /// By content that says of which exposure it is: the one that showed the same picture before, and does not.
    copied_before: BTreeMap<String, String>,
}

/// What showed a picture first.
#[derive(Clone, Debug)]
struct First {
    content: String,
    /// It says which exposure it is of.
    told: bool,
}

/// A picture that is no copy.
#[derive(Clone, Debug)]
struct Known {
    size_px: [usize; 2],
    grain: Grain,
    content: String,
    /// It says which exposure it is of.
    told: bool,
}

impl Pictures {
    /// The content that `frame`, whose picture this is, is a copy of, or its own. What says of which exposure it is, is no copy of a picture
    /// that does not.
    pub(super) fn first_of(&mut self, frame: &Frame, picture: Option<PictureDigest>) -> String {
        let Some(PictureDigest { digest, grain, copy_of }) = picture else { return frame.sha256.clone() };
        let told = frame.tags.names_exposure();
        // The whole picture takes the place of the unfinished one.
        let copies = |known_told: bool| known_told || !told || frame.completes.is_some();
        match self.first.get(&digest) {
            Some(First { content, told }) if copies(*told) => return content.clone(),
            Some(First { content, .. }) => drop(self.copied_before.insert(frame.sha256.clone(), content.clone())),
            None => {}
        }
        let alike = |known: &&Known| {
            known.size_px == frame.size_px
                // The whole picture takes the place of the unfinished one, however little of that was missing.
                && frame.completes.is_none()
                && grain.as_ref().is_some_and(|grain| grain.is_of_one_exposure(&known.grain))
        };
        let alike: Vec<&Known> = self.grains.iter().filter(alike).collect();
        let before = alike.first().map(|known| known.content.clone());
        let same = alike.iter().find(|known| copies(known.told)).map(|known| known.content.clone());
        let content = copy_of.or(same).unwrap_or_else(|| {
            let content = frame.sha256.clone();
            if let Some(before) = before {
                self.copied_before.entry(content.clone()).or_insert(before);
            }
            let known = |grain| Known { size_px: frame.size_px, grain, content: content.clone(), told };
            self.grains.extend(grain.map(known));
            content
        });
        self.first.insert(digest, First { content: content.clone(), told });
        content
    }

    /// The content that showed the picture of `content` before, without a word of its exposure. It is told once: later pictures of `content`
    /// are copies themselves.
    pub(super) fn take_copied_before(&mut self, content: &str) -> Option<String> {
        self.copied_before.remove(content)
    }

    /// What is left of the picture of `frame` where its pixels are not to be guessed at: only whether it is a copy.
    pub(super) fn told_without_grain(&mut self, frame: &Frame, picture: Option<PictureDigest>) -> Option<PictureDigest> {
        let first = self.first_of(frame, picture.clone());
        let copy_of = (first != frame.sha256).then_some(first);
        picture.map(|picture| PictureDigest { grain: None, copy_of, ..picture })
    }
}

/// Where a picture rises and where it falls from one pixel to the next but one (odd and even columns may be read out apart): its quanta decide
/// that, and no grey scale changes it but to turn all round or to make neighbours equal.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
struct Grain {
    rising: Vec<u64>,
    falling: Vec<u64>,
}

impl Grain {
    /// `None` for a picture without noise: two exposures of one scene look alike there.
    fn of(image: &Image<f32>) -> Option<Self> {
        let within = image.width.checked_sub(4).filter(|within| *within > 0)?;
        let places = within * image.height;
        let sites = SITES.min(places);
        let mut grain = Self { rising: vec![0; sites.div_ceil(64)], falling: vec![0; sites.div_ceil(64)] };
        let (mut decided, mut turning) = (0u32, 0u32);
        for site in 0..sites {
            let place = (site as u128 * places as u128 / sites as u128) as usize;
            let at = place / within * image.width + place % within;
            let [first, second, third] = [0, 2, 4].map(|n| image.pixels[at + n]);
            let bit = 1u64 << (site % 64);
            if second > first {
                grain.rising[site / 64] |= bit;
            } else if second < first {
                grain.falling[site / 64] |= bit;
            }
            let (one, other) = (second - first, third - second);
            // Not a number is neither.
            decided += u32::from(one.abs() > 0.0 && other.abs() > 0.0);
            turning += u32::from(one > 0.0 && other < 0.0 || one < 0.0 && other > 0.0);
        }
        (decided >= LEAST_DECIDED && f64::from(turning) >= TURNING_SHARE * f64::from(decided)).then_some(grain)
    }

    fn is_of_one_exposure(&self, other: &Self) -> bool {
        // A log may say anything.
        let words = self.rising.len();
        if [&self.falling, &other.rising, &other.falling].iter().any(|signs| signs.len() != words) {
            return false;
        }
        let common = |a: &[u64], b: &[u64]| a.iter().zip(b).map(|(a, b)| (a & b).count_ones()).sum::<u32>();
        let alike = common(&self.rising, &other.rising) + common(&self.falling, &other.falling);
        let opposed = common(&self.rising, &other.falling) + common(&self.falling, &other.rising);
        let decided = alike + opposed;
        decided >= LEAST_DECIDED
            && f64::from(alike.min(opposed)) <= DIFFERING_SHARE * f64::from(decided)
            && self.has_quanta_where(other)
    }

    /// Whether both have quanta in the same parts of the picture, from top to bottom: else one is torn, or shuttered by the console.
    fn has_quanta_where(&self, other: &Self) -> bool {
        let words = self.rising.len();
        let step = words.div_ceil(BANDS).max(1);
        (0..words).step_by(step).all(|start| {
            let (mut mine, mut theirs, mut both) = (0, 0, 0);
            for word in start..(start + step).min(words) {
                let [a, b] = [self, other].map(|grain| grain.rising[word] | grain.falling[word]);
                mine += a.count_ones();
                theirs += b.count_ones();
                both += (a & b).count_ones();
            }
            mine.max(theirs) < LEAST_IN_BAND || 4 * both >= mine.max(theirs)
        })
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

    fn first_of(pictures: &mut Pictures, frame: &Frame) -> String {
        pictures.first_of(frame, PictureDigest::of(frame))
    }

    #[test]
    fn the_same_picture_in_another_file_is_a_copy_and_a_blank_one_is_not() {
        let mut pictures = Pictures::default();
        let mut first_of = |frame: &Frame| first_of(&mut pictures, frame);
        assert_eq!(first_of(&frame(&[1.0, 2.0, 3.0, 4.0], "a")), "a");
        assert_eq!(first_of(&frame(&[1.0, 2.0, 4.0, 3.0], "b")), "b");
        assert_eq!(first_of(&frame(&[1.0, 2.0, 3.0, 4.0], "c")), "a");
        assert_eq!(first_of(&frame(&[0.0; 4], "d")), "d");
        assert_eq!(first_of(&frame(&[0.0; 4], "e")), "e");
        let run = Frame { image_of_file: [1, 3], ..frame(&[1.0, 2.0, 3.0, 4.0], "f") };
        assert_eq!(first_of(&run), "f");
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
            assert_eq!(first_of(&mut pictures, &framed(acquired.clone(), "a")), "a");
            let eight_bits = acquired.map(|p| (255.0 * (p / 1800.0).powf(0.7)).round());
            assert_eq!(first_of(&mut pictures, &framed(eight_bits, "b")), "a");
            assert_eq!(first_of(&mut pictures, &framed(acquired.map(|p| -(p / 2000.0).ln()), "c")), "a");
            assert_eq!(first_of(&mut pictures, &framed(scene(2, 12.0, smoothed), "d")), "d");
            // Little noise on steep ground.
            assert_eq!(first_of(&mut pictures, &framed(scene(3, 2.0, smoothed), "e")), "e");
            assert_eq!(first_of(&mut pictures, &framed(scene(4, 2.0, smoothed), "f")), "f");
        }
        // A picture that is torn is not the whole one, and the whole one no copy of it.
        let mut torn = scene(9, 12.0, false);
        torn.pixels[160 * 70..].fill(0.0);
        let mut pictures = Pictures::default();
        assert_eq!(first_of(&mut pictures, &framed(torn, "t")), "t");
        assert_eq!(first_of(&mut pictures, &framed(scene(9, 12.0, false), "w")), "w");
        // Odd and even columns are read out apart.
        let uneven = |seed: u64| {
            let mut image = scene(seed, 12.0, false);
            image.pixels.iter_mut().enumerate().filter(|(n, _)| n % 2 == 1).for_each(|(_, pixel)| *pixel += 100.0);
            image
        };
        let mut pictures = Pictures::default();
        assert_eq!(first_of(&mut pictures, &framed(uneven(6), "i")), "i");
        assert_eq!(first_of(&mut pictures, &framed(uneven(7), "j")), "j");
        assert_eq!(first_of(&mut pictures, &framed(uneven(6).map(|p| p.sqrt()), "k")), "i");
        // A preview that says nothing of its exposure does not swallow the frame that does; the other way round it is a copy.
        let told = |image: Image<f32>, sha256: &str| {
            let mut frame = framed(image, sha256);
            frame.tags.exposure_counter = Some(3);
            frame
        };
        let mut pictures = Pictures::default();
        assert_eq!(first_of(&mut pictures, &framed(scene(8, 12.0, false), "l")), "l");
        assert_eq!(first_of(&mut pictures, &told(scene(8, 12.0, false).map(|p| p.sqrt()), "m")), "m");
        assert_eq!(first_of(&mut pictures, &framed(scene(8, 12.0, false).map(|p| p * p), "n")), "l");
        assert_eq!(first_of(&mut pictures, &told(scene(8, 12.0, false).map(|p| p * p * p), "o")), "m");
        // The same pixels, exported without a word of their exposure before the file that says it.
        let mut pictures = Pictures::default();
        assert_eq!(first_of(&mut pictures, &framed(scene(8, 12.0, false), "p")), "p");
        assert_eq!(first_of(&mut pictures, &told(scene(8, 12.0, false), "q")), "q");
        assert_eq!((pictures.take_copied_before("q").as_deref(), pictures.take_copied_before("p")), (Some("p"), None));
        assert_eq!(first_of(&mut pictures, &framed(scene(8, 12.0, false), "r")), "q");
        assert_eq!(first_of(&mut pictures, &told(scene(8, 12.0, false), "s")), "q");
        assert_eq!(["q", "r", "s"].map(|content| pictures.take_copied_before(content)), [None, None, None]);
        // Nothing tells two exposures without noise from one in two grey scales.
        let mut pictures = Pictures::default();
        assert_eq!(first_of(&mut pictures, &framed(scene(5, 0.0, false), "g")), "g");
        assert_eq!(first_of(&mut pictures, &framed(scene(5, 0.0, false).map(|p| 0.5 * p), "h")), "h");
    }

    /// As a log keeps pictures whose pixels it has not: with their grain where other pictures are compared with them, else with the copy named.
    #[test]
    fn copies_are_recognised_without_pixels_as_well() {
        let acquired = framed(scene(1, 12.0, false), "a");
        let archived = framed(acquired.pixels.map(|p| (255.0 * (p / 1800.0).powf(0.7)).round()), "b");
        let kept = |picture: Option<PictureDigest>| -> Option<PictureDigest> {
            serde_json::from_str(&serde_json::to_string(&picture).expect("JSON")).expect("the same")
        };
        let mut pictures = Pictures::default();
        assert_eq!(pictures.first_of(&acquired, kept(PictureDigest::of(&acquired))), "a");
        assert_eq!(first_of(&mut pictures, &archived), "a");
        assert_eq!(first_of(&mut pictures, &framed(scene(2, 12.0, false), "c")), "c");

        let mut pictures = Pictures::default();
        let told = [&acquired, &archived].map(|frame| kept(pictures.told_without_grain(frame, PictureDigest::of(frame))));
        assert!(told.iter().flatten().all(|picture| picture.grain.is_none()) && told.iter().all(Option::is_some));
        let mut pictures = Pictures::default();
        let firsts = [&acquired, &archived].into_iter().zip(told).map(|(frame, told)| pictures.first_of(frame, told));
        assert_eq!(firsts.collect::<Vec<_>>(), ["a", "a"]);
        // The control: neither grain nor word.
        let mut pictures = Pictures::default();
        let bare =
            [&acquired, &archived].map(|frame| PictureDigest::of(frame).map(|picture| PictureDigest { grain: None, ..picture }));
        let firsts = [&acquired, &archived].into_iter().zip(bare).map(|(frame, bare)| pictures.first_of(frame, bare));
        assert_eq!(firsts.collect::<Vec<_>>(), ["a", "b"]);
    }

    #[test]
    fn a_grain_of_another_length_is_no_copy_and_no_fault() {
        let frame = framed(scene(1, 12.0, false), "a");
        let whole = PictureDigest::of(&frame).expect("a picture");
        for length in [0, 1, 300] {
            let mut other = whole.clone();
            other.digest.1 += 1;
            other.grain.iter_mut().for_each(|grain| grain.falling.resize(length, 0));
            for pair in [[&whole, &other], [&other, &whole]] {
                let mut pictures = Pictures::default();
                let frames = ["a", "b"].map(|sha256| Frame { sha256: sha256.to_owned(), ..frame.clone() });
                let firsts = frames.iter().zip(pair).map(|(frame, picture)| pictures.first_of(frame, Some(picture.clone())));
                assert_eq!(firsts.collect::<Vec<_>>(), ["a", "b"], "{length}");
            }
        }
    }
}
