//! Beads are found in drawn radiographs of every dose, size and sense, and their centres are good to a known fraction of a pixel.

use glam::DVec3;
use sidecarm::beads::{Detections, Expectation, Polarity, Signal, detect_image};
use sidecarm::image::Image;
use sidecarm::random::{Purpose, Stream};

use crate::pose_synthetic as synthetic;

struct Outcome {
    found: usize,
    visible: usize,
    extra: usize,
    errors_px: Vec<f64>,
    /// Error over the stated standard deviation, per axis.
    pulls: Vec<f64>,
}

fn outcome(detections: &Detections, centres: &[glam::DVec2], size: [u32; 2]) -> Outcome {
    let mut result = Outcome { found: 0, visible: 0, extra: 0, errors_px: Vec::new(), pulls: Vec::new() };
    let mut used = std::collections::BTreeSet::new();
    for centre in centres {
        let margin = 15.0;
        let inside = centre.x > margin
            && centre.y > margin
            && centre.x < f64::from(size[0]) - margin
            && centre.y < f64::from(size[1]) - margin;
        if !inside {
            continue;
        }
        result.visible += 1;
        let nearest = detections
            .found
            .iter()
            .enumerate()
            .min_by(|a, b| a.1.image_px.distance(*centre).total_cmp(&b.1.image_px.distance(*centre)));
        if let Some((n, d)) = nearest
            && d.image_px.distance(*centre) < 2.0
        {
            result.found += 1;
            used.insert(n);
            result.errors_px.push(d.image_px.distance(*centre));
            let off = (d.image_px - *centre) / d.sigma_px;
            result.pulls.extend([off.x, off.y]);
        }
    }
    result.extra = detections.found.len() - used.len();
    result
}

fn median(values: &mut [f64]) -> f64 {
    values.sort_by(f64::total_cmp);
    values.get(values.len() / 2).copied().unwrap_or(f64::NAN)
}

fn drawn(seed: u64, radius_mm: f64, photons: f64) -> synthetic::Radiograph {
    synthetic::radiograph(synthetic::view(620, 480, seed), &synthetic::layout(8, radius_mm, seed), photons, seed)
}

#[test]
fn centres_are_found_to_a_fraction_of_a_pixel_and_their_uncertainty_is_honest() {
    let (mut errors, mut pulls) = (Vec::new(), Vec::new());
    let (mut found, mut visible) = (0, 0);
    for seed in 0..3 {
        let frame = drawn(seed, 1.0, 20000.0);
        let detections = detect_image(&frame.draw(), Signal::Transmission, None, &Expectation::default());
        let one = outcome(&detections, &frame.centres(), [620, 480]);
        found += one.found;
        visible += one.visible;
        errors.extend(one.errors_px);
        pulls.extend(one.pulls);
    }
    assert!(visible >= 18 && 10 * found >= 9 * visible, "{found} of {visible}");
    let pull = (pulls.iter().map(|p| p * p).sum::<f64>() / pulls.len() as f64).sqrt();
    assert!(median(&mut errors) < 0.06, "{errors:?}");
    assert!((0.6..1.6).contains(&pull), "rms error over stated deviation is {pull}");
}

/// What a JPEG of that quality gives back of a display frame.
fn jpeg(display: &Image<f32>, quality: u8) -> Image<f32> {
    let greys: Vec<u8> = display.pixels.iter().map(|value| *value as u8).collect();
    let mut stored = Vec::new();
    image::codecs::jpeg::JpegEncoder::new_with_quality(&mut stored, quality)
        .encode(&greys, display.width as u32, display.height as u32, image::ExtendedColorType::L8)
        .expect("greys are stored");
    let read = image::load_from_memory(&stored).expect("they are read").into_luma8();
    Image { width: display.width, height: display.height, pixels: read.into_raw().into_iter().map(f32::from).collect() }
}

/// The smooth blocks of a JPEG of low quality had no noise at all by second differences: fits stopped short, and up to half of the clear beads
/// were not found.
#[test]
fn a_jpeg_of_low_quality_keeps_clear_beads_and_adds_none() {
    let (mut plain_found, mut plain_extra, mut visible) = (0, 0, 0);
    let (mut found, mut extra) = (0, 0);
    for seed in 0..4 {
        let frame = drawn(seed, 2.0, 2000.0);
        let (display, centres) = (synthetic::display(&frame.draw(), 2000.0, false), frame.centres());
        let of = |image: &Image<f32>| {
            outcome(&detect_image(image, Signal::Unknown, None, &Expectation::default()), &centres, [620, 480])
        };
        let plain = of(&display);
        visible += plain.visible;
        (plain_found, plain_extra) = (plain_found + plain.found, plain_extra + plain.extra);
        for quality in [40, 25] {
            let one = of(&jpeg(&display, quality));
            (found, extra) = (found + one.found, extra + one.extra);
        }
    }
    println!("{found} and {extra} others of twice {visible}; {plain_found} and {plain_extra} in the plain frames");
    assert!(visible >= 20 && 10 * plain_found >= 9 * visible, "the control: {plain_found} of {visible}");
    assert!(10 * found >= 9 * 2 * plain_found, "{found} of twice {plain_found}");
    assert!(extra <= 2 * plain_extra + 8, "{extra} that are no beads, {plain_extra} in the plain frames");
}

#[test]
fn display_frames_of_either_sense_and_logarithms_give_the_same_beads() {
    let frame = drawn(4, 1.0, 20000.0);
    let (transmission, centres) = (frame.draw(), frame.centres());
    let log = transmission.map(|value| -(value / 20000.0).max(1e-5).ln());
    let mut cases = 0;
    for (image, signal, bright) in [
        (synthetic::display(&transmission, 20000.0, false), Signal::Unknown, false),
        (synthetic::display(&transmission, 20000.0, true), Signal::Unknown, true),
        (log.clone(), Signal::LineIntegral, true),
        (log.map(|value| 500.0 * value + 30.0), Signal::Attenuation, true),
    ] {
        let detections =
            detect_image(&image, signal, None, &Expectation { radius_px: Some((2.0, 6.0)), ..Expectation::default() });
        let one = outcome(&detections, &centres, [620, 480]);
        assert!(10 * one.found >= 8 * one.visible, "{signal:?}: {} of {}", one.found, one.visible);
        assert_eq!(detections.polarity == Polarity::Bright, bright, "{signal:?}: {}", detections.evidence);
        cases += 1;
    }
    assert_eq!(cases, 4);
}

#[test]
fn a_frame_of_noise_or_nothing_has_no_beads() {
    let mut random = sidecarm::random::Stream::new(1, 0, 0, sidecarm::random::Purpose::Evaluation);
    let noise = sidecarm::image::Image::filled(300, 200, 0.0f32).map(|_| (100.0 + 10.0 * random.normal()) as f32);
    let mut cases = 0;
    for image in [
        noise,
        sidecarm::image::Image::filled(64, 64, 1.0f32),
        sidecarm::image::Image::filled(64, 64, f32::NAN),
        sidecarm::image::Image::filled(3, 2, 1.0f32),
    ] {
        for signal in [Signal::Transmission, Signal::LineIntegral, Signal::Unknown] {
            let found = detect_image(&image, signal, None, &Expectation::default()).found.len();
            assert!(found <= 1, "{found} beads in nothing ({signal:?})");
            cases += 1;
        }
    }
    assert_eq!(cases, 12);
}

#[test]
fn touching_beads_are_told_apart() {
    let view = synthetic::view(620, 480, 2);
    let into = view.camera_from_lps.inverse();
    let places = [-2.0, 0.9].map(|x| into.transform_point(glam::DVec3::new(x, 3.0, 680.0)));
    let layout = synthetic::layout_of(&places, 1.25);
    let mut frame = synthetic::radiograph(view, &layout, 50000.0, 3);
    (frame.anatomy, frame.metal) = (false, false);
    let one =
        outcome(&detect_image(&frame.draw(), Signal::Transmission, None, &Expectation::default()), &frame.centres(), [620, 480]);
    assert_eq!((one.found, one.visible), (2, 2));
    assert!(one.errors_px.iter().all(|error| *error < 0.15), "{:?}", one.errors_px);
}

/// What is found, missed and invented, and how far centres are off, by size, quanta and kind of frame.
#[test]
#[ignore = "prints figures: scripts/evaluate beads runs it"]
fn figures() {
    let (mut seen, mut all, mut all_errors) = (0, 0, Vec::new());
    for (width, height) in [(620u32, 480u32), (1024, 1024), (1536, 1536)] {
        for radius_mm in [0.75, 2.0] {
            for photons in [300.0, 2000.0, 20000.0, 1e6] {
                for kind in ["linear", "display", "inverted"] {
                    let (mut errors, mut pulls) = (Vec::new(), Vec::new());
                    let (mut found, mut visible, mut extra, mut wrong_way) = (0, 0, 0, 0);
                    let mut time = 0.0;
                    let repeats = if width > 700 { 1 } else { 3 };
                    for seed in 0..repeats {
                        let layout = synthetic::layout(8, radius_mm, seed);
                        let drawn = synthetic::radiograph(synthetic::view(width, height, seed), &layout, photons, seed);
                        let image = drawn.draw();
                        let (image, signal) = match kind {
                            "linear" => (image, Signal::Transmission),
                            "display" => (synthetic::display(&image, photons, false), Signal::Unknown),
                            _ => (synthetic::display(&image, photons, true), Signal::Unknown),
                        };
                        let start = sidecarm::time::Stopwatch::start();
                        let detections = detect_image(&image, signal, None, &Expectation::default());
                        time += 1e-3 * start.ms();
                        let one = outcome(&detections, &drawn.centres(), [width, height]);
                        let other_way = kind != "linear" && (detections.polarity == Polarity::Bright) != (kind == "inverted");
                        wrong_way += usize::from(other_way);
                        found += one.found;
                        visible += one.visible;
                        extra += one.extra;
                        errors.extend(one.errors_px);
                        pulls.extend(one.pulls);
                    }
                    if kind == "linear" && photons >= 20000.0 {
                        seen += found;
                        all += visible;
                        all_errors.extend_from_slice(&errors);
                    }
                    let pull = (pulls.iter().map(|p| p * p).sum::<f64>() / pulls.len().max(1) as f64).sqrt();
                    let worst = errors.iter().copied().fold(0.0, f64::max);
                    println!(
                        "{width}x{height} r {radius_mm} N {photons:>9} {kind:9} found {found}/{visible} extra {extra:3} wrong way {wrong_way} error median {:.4} worst {worst:.4} px, rms pull {pull:.2}, {:.2} s",
                        median(&mut errors),
                        time / repeats as f64
                    );
                }
            }
        }
    }
    // Recall of 99.5 % and 0.02 px rms are targets for clear beads beside clutter, which `scripts/evaluate varied` counts. Here beads lie over
    // bone edges and metal too, and no figure is stated: what the small test of the hardest size holds, holds for all sizes.
    println!("linear, 20000 quanta and more: found {seen} of {all}, median error {:.4} px", median(&mut all_errors));
    assert!(all >= 60 && 10 * seen >= 9 * all, "{seen} of {all}");
    assert!(median(&mut all_errors) < 0.06, "{} px", median(&mut all_errors));
}

/// Writing and dead pixels are hundreds of strong blobs; beads that were far clearer than they had to be were not looked at.
#[test]
fn hundreds_of_dead_pixels_do_not_crowd_out_the_beads() {
    let frame = drawn(4, 0.75, 2000.0);
    let centres = frame.centres();
    let mut image = frame.draw();
    let seen = |image: &Image<f32>| {
        let found = detect_image(image, Signal::Transmission, None, &Expectation::default()).found;
        centres.iter().filter(|centre| found.iter().any(|shadow| shadow.image_px.distance(**centre) < 0.5)).count()
    };
    let sound = seen(&image);
    let mut random = Stream::new(4, 77, 0, Purpose::Evaluation);
    let mut dead = 0;
    while dead < 400 {
        let (column, row) = ((random.uniform() * 600.0) as usize + 10, (random.uniform() * 460.0) as usize + 10);
        let place = glam::DVec2::new(column as f64, row as f64);
        if centres.iter().all(|centre| centre.distance(place) > 14.0) {
            *image.at_mut(column, row) = 0.0;
            dead += 1;
        }
    }
    let crowded = seen(&image);
    assert!(sound >= 7 && crowded + 1 >= sound, "{crowded} of {sound}");
}

/// Centres of shadows at one radius from each other were stated ten times too well.
#[test]
fn shadows_that_lie_over_each_other_state_a_larger_uncertainty() {
    let view = synthetic::view(620, 480, 3);
    let middle = DVec3::new(3.0, -4.0, 0.0);
    let toward = view.camera_from_lps.inverse().transform_vector(DVec3::X);
    let sigma = |places: &[DVec3]| {
        let frame = synthetic::radiograph(view, &synthetic::layout_of(places, 1.5), 5000.0, 3);
        let found = detect_image(&frame.draw(), Signal::Transmission, None, &Expectation::default()).found;
        let (at, _) = view.projection().project(middle);
        let own = found.iter().min_by(|a, b| a.image_px.distance(at).total_cmp(&b.image_px.distance(at))).expect("found");
        (own.sigma_px, own.radius_px, own.image_px.distance(at))
    };
    let far = [DVec3::new(40.0, 0.0, 10.0), DVec3::new(-40.0, 10.0, -10.0), DVec3::new(0.0, 40.0, 0.0)];
    let (alone_px, ..) = sigma(&[&[middle][..], &far].concat());
    let (beside_px, radius_px, off_px) = sigma(&[&[middle, middle + toward * 2.2][..], &far].concat());
    assert!(alone_px < 0.02 * radius_px && beside_px > 0.05 * radius_px, "{alone_px} {beside_px} {radius_px}");
    assert!(off_px < 4.0 * beside_px, "{off_px} at {beside_px}");
}
