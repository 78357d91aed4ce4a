//! Is the shut part of a frame found, whatever the blades and the domain, and open anatomy never taken for it?

use std::collections::BTreeMap;

use sidecarm::acquire::{CollimatorShape, CollimatorTags, Domain, Frame};
use sidecarm::image::Image;
use sidecarm::mask::{Cause, Field, FieldShape, HalfPlane, find_field, find_told_field, of_frame};

use crate::mask_draw::{Drawn, draw_frame, frame_size};

/// A field is wrong where it lies this far inside the end of the penumbra.
const ALLOWED_PX: f64 = 2.0;

/// One drawn frame's result.
pub struct Score {
    pub drawn: Drawn,
    pub field: Option<Field>,
    /// Share of the shut pixels that are flagged; 1 without blades.
    pub shut_flagged: f64,
    /// Share of the open pixels beyond the penumbra that are flagged.
    pub open_flagged: f64,
    /// Share of the pixels in the penumbra that are flagged.
    pub penumbra_flagged: f64,
}

impl Score {
    /// Thousands of scores must not keep their frames.
    pub fn without_pixels(mut self) -> Self {
        self.drawn.pixels = Image::filled(1, 1, 0.0);
        self.drawn.depth_px = self.drawn.depth_px.map(|_| Image::filled(1, 1, 0.0));
        if let Some(field) = &mut self.field {
            field.outside = Image::filled(1, 1, false);
        }
        self
    }
}

pub fn score(seed: u64, collimated: bool) -> Score {
    let drawn = draw_frame(seed, collimated);
    let field = find_field(&drawn.pixels, drawn.larger_is_more_attenuation, drawn.domain == "display");
    let shares = marked(&drawn, field.as_ref());
    Score {
        drawn,
        field,
        shut_flagged: shares.shut_flagged,
        open_flagged: shares.open_flagged,
        penumbra_flagged: shares.penumbra_flagged,
    }
}

/// Shares of what is flagged.
struct Shares {
    shut_flagged: f64,
    open_flagged: f64,
    penumbra_flagged: f64,
}

fn marked(drawn: &Drawn, field: Option<&Field>) -> Shares {
    let nothing = Image::filled(drawn.pixels.width, drawn.pixels.height, false);
    let outside = field.map_or(&nothing, |field| &field.outside);
    let open_depth = Image::filled(1, 1, 0.0_f32);
    let depths = drawn.depth_px.as_ref().unwrap_or(&open_depth);
    let mut counts = [[0usize; 2]; 3];
    for (index, &flagged) in outside.pixels.iter().enumerate() {
        let depth = if drawn.depth_px.is_some() { f64::from(depths.pixels[index]) } else { f64::INFINITY };
        let half = drawn.penumbra_px / 2.0;
        let part = if depth < -half {
            0
        } else if depth > half + ALLOWED_PX {
            2
        } else {
            1
        };
        counts[part][usize::from(flagged)] += 1;
    }
    let share = |part: usize, empty: f64| {
        let all = counts[part][0] + counts[part][1];
        if all == 0 { empty } else { counts[part][1] as f64 / all as f64 }
    };
    Shares { shut_flagged: share(0, 1.0), open_flagged: share(2, 0.0), penumbra_flagged: share(1, 1.0) }
}

/// What happened to one class of frames.
#[derive(Default)]
struct Tally {
    frames: usize,
    none: usize,
    /// At least 99.5 % of the shut area flagged.
    whole: usize,
    /// At least 2 % of the shut area missed.
    missed: usize,
    /// At least 2 % of the open field flagged.
    wrong: usize,
    shut: f64,
    open: f64,
    penumbra: f64,
}

impl Tally {
    fn add(&mut self, score: &Score) {
        self.frames += 1;
        self.none += usize::from(score.field.is_none());
        self.whole += usize::from(score.shut_flagged >= 0.995);
        self.missed += usize::from(score.shut_flagged < 0.98);
        self.wrong += usize::from(score.open_flagged >= 0.02);
        self.shut += score.shut_flagged;
        self.open += score.open_flagged;
        self.penumbra += score.penumbra_flagged;
    }
}

pub fn table(scores: &[Score]) {
    let mut tallies: BTreeMap<String, Tally> = BTreeMap::new();
    for score in scores {
        let blades = if score.drawn.depth_px.is_none() { "open" } else { "shut" };
        let known = match (blades, score.drawn.faint) {
            ("open", _) => "open frames",
            (_, true) => "faint",
            _ => "clear",
        };
        for class in [known.to_owned(), format!("{known} / {}", score.drawn.domain), format!("{known} / {}", score.drawn.shape)] {
            tallies.entry(class).or_default().add(score);
        }
    }
    println!("{:42} frames  none  ≥99.5%  missed≥2%  wrong≥2%  shut%   open%  penumbra%", "class");
    for (class, tally) in &tallies {
        let mean = |sum: f64| 100.0 * sum / tally.frames as f64;
        println!(
            "{class:42} {:6} {:5} {:7} {:10} {:9} {:7.2} {:7.3} {:7.1}",
            tally.frames,
            tally.none,
            tally.whole,
            tally.missed,
            tally.wrong,
            mean(tally.shut),
            mean(tally.open),
            mean(tally.penumbra)
        );
    }
}

fn of(name: &str, fallback: u64) -> u64 {
    std::env::var(name).ok().and_then(|text| text.parse().ok()).unwrap_or(fallback)
}

/// Small frames are looked through quickly in a test build.
fn is_small(seed: u64, collimated: bool, most_px: usize) -> bool {
    let (width, height) = frame_size(seed, collimated);
    width * height < most_px
}

/// Few enough for every run; `many` draws until it is tired.
#[test]
fn what_is_shut_is_flagged_and_what_is_open_is_not() {
    let some = |collimated: bool| -> Vec<Score> {
        (5000..).filter(|seed| is_small(*seed, collimated, 120_000)).take(16).map(|seed| score(seed, collimated)).collect()
    };
    let (shut, open) = (some(true), some(false));
    let clear: Vec<&Score> = shut.iter().filter(|score| !score.drawn.faint).collect();
    assert!(clear.len() >= 12, "{} of 16 drawings show their field", clear.len());
    for score in shut.iter().chain(&open) {
        assert!(score.open_flagged < 0.02, "{:.3} of the open field flagged: {}", score.open_flagged, score.drawn.note);
    }
    assert!(open.iter().all(|score| score.field.is_none()), "a field where there is none");
    let whole = clear.iter().filter(|score| score.shut_flagged >= 0.995).count();
    assert!(4 * whole >= 3 * clear.len(), "{whole} of {} shut areas flagged", clear.len());
    let penumbra = clear.iter().filter(|score| score.shut_flagged >= 0.995).map(|score| score.penumbra_flagged);
    let penumbra = penumbra.sum::<f64>() / whole as f64;
    assert!(penumbra > 0.5, "{penumbra:.2} of the penumbra flagged");
}

/// The control of the scores: the field of a frame, moved, is wrong.
#[test]
fn a_moved_field_scores_badly() {
    let drawn = draw_frame(5001, true);
    let field = find_field(&drawn.pixels, drawn.larger_is_more_attenuation, drawn.domain == "display").expect("a field");
    let mut moved = field.clone();
    moved.outside.pixels.rotate_right(drawn.pixels.width / 8);
    let (right, wrong) = (marked(&drawn, Some(&field)), marked(&drawn, Some(&moved)));
    assert!(right.open_flagged < 0.01 && wrong.open_flagged > 0.02, "{} and {}", right.open_flagged, wrong.open_flagged);
    assert!(right.shut_flagged > 0.99 && wrong.shut_flagged < 0.98, "{} and {}", right.shut_flagged, wrong.shut_flagged);
}

#[test]
fn frames_without_a_picture_have_no_field() {
    let values = [0.0, 1.0, f32::NAN, f32::INFINITY, f32::NEG_INFINITY, f32::MAX, f32::MIN_POSITIVE];
    let mut frames = 0;
    for (width, height) in [(0, 0), (0, 9), (1, 1), (1, 400), (400, 1), (31, 31), (32, 32), (33, 300), (300, 33)] {
        for larger_is_more_attenuation in [false, true] {
            for value in values {
                let flat = Image::filled(width, height, value);
                assert_eq!(find_field(&flat, larger_is_more_attenuation, true), None, "{width} × {height} of {value}");
                // Every value beside every other: no picture, but nothing may panic.
                let pixels = (0..width * height).map(|index| if index % 3 == 0 { value } else { values[index % 7] }).collect();
                let mixed = Image::from_pixels(width, height, pixels).expect("as many pixels");
                let found = find_field(&mixed, larger_is_more_attenuation, true);
                assert!(found.is_none_or(|field| field.outside.same_size(&mixed)));
                frames += 1;
            }
        }
    }
    assert!(frames > 100);
}

#[test]
fn the_same_frame_gives_the_same_field() {
    let drawn = draw_frame(5001, true);
    let first = find_field(&drawn.pixels, drawn.larger_is_more_attenuation, drawn.domain == "display");
    assert!(first.is_some());
    for _ in 0..3 {
        assert_eq!(first, find_field(&drawn.pixels, drawn.larger_is_more_attenuation, drawn.domain == "display"));
    }
}

/// Real fluoroscopy: an intensifier's disc, painted black outside, in all six frames.
#[test]
fn the_intensifier_s_disc_is_found_in_real_frames() {
    const SIDE: usize = 1024;
    let folder = std::path::Path::new(env!("CARGO_MANIFEST_DIR")).join("../shared/data/fluoroscopy-hip");
    if !folder.is_dir() {
        println!("skipped: {} is absent", folder.display());
        return;
    }
    for number in 1..=6 {
        let bytes = std::fs::read(folder.join(format!("frame-0{number}.dcm"))).expect("frame is readable");
        // Uncompressed words at the end of the file.
        let words = bytes[bytes.len() - 2 * SIDE * SIDE..].chunks_exact(2);
        let pixels = words.map(|word| f32::from(u16::from_le_bytes([word[0], word[1]]))).collect();
        let frame = Image::from_pixels(SIDE, SIDE, pixels).expect("as many words");
        let field = find_field(&frame, false, true).expect("a disc");
        let disc = field.shape.disc.expect("a disc");
        println!("frame {number}: {}", field.description);
        assert!((disc.radius_px - 481.0).abs() < 4.0, "frame {number}: {disc:?}");
        let shut = field.outside.pixels.iter().filter(|outside| **outside).count() as f64 / (SIDE * SIDE) as f64;
        // The disc leaves 0.69 of the frame open; the shutters of frames 3 and 4 may take their part.
        assert!((0.30..0.42).contains(&shut), "frame {number}: {shut:.3} of the frame is outside");
    }
}

#[test]
#[ignore = "minutes long: scripts/evaluate field runs it"]
fn many() {
    let (first, frames) = (of("SIDECARM_FIRST_SEED", 100_000), of("SIDECARM_FRAMES", 1000));
    let mut scores = Vec::new();
    for seed in first..first + frames {
        for collimated in [true, false] {
            let score = score(seed, collimated).without_pixels();
            let bad = score.open_flagged >= 0.02 || !score.drawn.faint && score.shut_flagged < 0.98;
            if bad {
                let found = score.field.as_ref().map_or("no field", |field| &field.description);
                println!(
                    "seed {seed}: shut {:.4}, open {:.4}: {}: {found}",
                    score.shut_flagged, score.open_flagged, score.drawn.note
                );
            }
            scores.push(score);
        }
    }
    table(&scores);
    let wrong = scores.iter().filter(|score| score.open_flagged >= 0.02).count();
    // Target: no blade is missed, which faint ones can hardly meet. Reached over four hundred frames with blades, faint ones among them: the
    // shut area flagged whole (99.5 % of it) in 60.5 %.
    let shut: Vec<&Score> = scores.iter().filter(|score| score.drawn.depth_px.is_some()).collect();
    let whole = shut.iter().filter(|score| score.shut_flagged >= 0.995).count();
    let clear: Vec<&&Score> = shut.iter().filter(|score| !score.drawn.faint).collect();
    let missed = clear.iter().filter(|score| score.shut_flagged < 0.98).count();
    println!("blades flagged whole in {whole} of {}; of clear ones missed in {missed} of {}", shut.len(), clear.len());
    assert!(wrong as f64 <= 0.01 * scores.len() as f64, "{wrong} of {} frames lose open anatomy", scores.len());
    assert!(whole as f64 >= 0.55 * shut.len() as f64, "{whole} of {} shut areas flagged", shut.len());
}

/// What all of `planes` leave open of a square far beyond the frame: corners in their order.
fn corners_of(planes: &[HalfPlane]) -> Vec<glam::DVec2> {
    let far = 1e4;
    let mut corners = [[-far, -far], [far, -far], [far, far], [-far, far]].map(glam::DVec2::from_array).to_vec();
    for plane in planes {
        let depth = |x: glam::DVec2| plane.limit_px - plane.normal.dot(x);
        let mut left = Vec::new();
        for (n, from) in corners.iter().enumerate() {
            let to = corners[(n + 1) % corners.len()];
            let (here, there) = (depth(*from), depth(to));
            left.extend((here >= 0.0).then_some(*from));
            left.extend((here * there < 0.0).then(|| *from + (to - *from) * here / (here - there)));
        }
        corners = left;
    }
    corners
}

/// The polygon of a display shutter was no evidence: of the frame whose blade the picture alone does not suggest, too.
#[test]
fn a_polygon_of_the_header_is_looked_at_and_one_that_the_picture_does_not_show_masks_nothing() {
    let masked = |drawn: &Drawn, planes: Option<&[HalfPlane]>| {
        let (domain, pixels) = match (drawn.domain, drawn.larger_is_more_attenuation) {
            ("display", true) => (Domain::Display, drawn.pixels.map(|value| 255.0 - *value)),
            ("display", false) => (Domain::Display, drawn.pixels.clone()),
            (_, true) => (Domain::Log, drawn.pixels.clone()),
            (_, false) => (Domain::Linear, drawn.pixels.clone()),
        };
        let mut frame = Frame::from_pixels("drawn", pixels, domain).expect("a frame");
        frame.tags.display_shutter = planes.map(|planes| CollimatorTags {
            shapes: vec![CollimatorShape::Polygonal],
            corners_px: corners_of(planes).into_iter().map(|corner| (corner + 1.0).to_array()).collect(),
            ..CollimatorTags::default()
        });
        let shares = of_frame(&frame).shares(frame.size_px[0], frame.size_px[1]);
        shares.causes.get(&Cause::Collimation).copied().unwrap_or(0.0)
    };
    let drawn = draw_frame(3206, true);
    let depths = drawn.depth_px.as_ref().expect("blades");
    let shut = depths.pixels.iter().filter(|depth| **depth < 0.0).count() as f64 / depths.pixels.len() as f64;
    let (alone, told) = (masked(&drawn, None), masked(&drawn, Some(drawn.told.half_planes.as_slice())));
    assert!(told >= 0.98 * shut && told > alone, "{shut} is shut, {alone} masked alone, {told} with the header's polygon");
    let open = draw_frame(3000, false);
    let planes = [HalfPlane { normal: glam::DVec2::NEG_X, limit_px: -0.15 * open.pixels.width as f64 }];
    let (alone, invented) = (masked(&open, None), masked(&open, Some(&planes[..])));
    assert!((invented - alone).abs() < 0.02, "{alone} alone, {invented} with an invented polygon");
}

/// Blades that telemetry tells of are looked at where the picture alone suggests none; what it tells of an open frame is not believed.
#[test]
fn blades_that_somebody_tells_of_are_found_and_invented_ones_are_not() {
    let found = |seed: u64, is_told: bool| {
        let drawn = draw_frame(seed, true);
        let told = if is_told { drawn.told.clone() } else { FieldShape::default() };
        let field = find_told_field(&drawn.pixels, drawn.larger_is_more_attenuation, drawn.domain == "display", &told);
        let shares = marked(&drawn, field.as_ref());
        (shares.shut_flagged >= 0.98, shares.open_flagged < 0.02)
    };
    // Of 400 frames (seeds 3000 to 3399) the one whose blade the picture alone does not suggest.
    assert_eq!((found(3206, false).0, found(3206, true)), (false, (true, true)));
    for seed in (3000..3016).filter(|seed| is_small(*seed, true, 350_000)) {
        let (alone, told) = (found(seed, false), found(seed, true));
        assert!(told.0 >= alone.0 && told.1 >= alone.1, "seed {seed}: {alone:?}, told {told:?}");
    }
    for seed in (3000..3012).filter(|seed| is_small(*seed, false, 350_000)) {
        let drawn = draw_frame(seed, false);
        let size = glam::DVec2::new(drawn.pixels.width as f64, drawn.pixels.height as f64);
        let half_planes = vec![
            HalfPlane { normal: glam::DVec2::NEG_X, limit_px: -0.15 * size.x },
            HalfPlane { normal: glam::DVec2::Y, limit_px: 0.8 * size.y },
        ];
        let invented = FieldShape { half_planes, ..FieldShape::default() };
        let field = find_told_field(&drawn.pixels, drawn.larger_is_more_attenuation, drawn.domain == "display", &invented);
        let shares = marked(&drawn, field.as_ref());
        assert!(shares.open_flagged < 0.02, "seed {seed}: {:?}", field.map(|field| field.description));
    }
}
