//! Beads are found in drawn radiographs of every dose, size and sense, and their centres are good to a known fraction of a pixel.

use std::time::Instant;

use sidecarm::beads::{Detections, Expectation, Signal, detect_image};

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
        let inside = centre.x > margin && centre.y > margin && centre.x < f64::from(size[0]) - margin && centre.y < f64::from(size[1]) - margin;
        if !inside {
            continue;
        }
        result.visible += 1;
        let nearest = detections.found.iter().enumerate().min_by(|a, b| a.1.image_px.distance(*centre).total_cmp(&b.1.image_px.distance(*centre)));
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

/// Prints the table of the closing note: `cargo test --workspace -- beads_detection::figures --ignored --nocapture`.
#[test]
#[ignore = "prints figures; the fixed subset is tested below"]
fn figures() {
    for (width, height) in [(480u32, 480u32), (620, 480), (1024, 1024), (1536, 1536)] {
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
                        let start = Instant::now();
                        let detections = detect_image(&image, signal, None, &Expectation::default());
                        time += start.elapsed().as_secs_f64();
                        let one = outcome(&detections, &drawn.centres(), [width, height]);
                        let other_way = kind != "linear" && (detections.polarity == sidecarm::beads::Polarity::Bright) != (kind == "inverted");
                        wrong_way += usize::from(other_way);
                        found += one.found;
                        visible += one.visible;
                        extra += one.extra;
                        errors.extend(one.errors_px);
                        pulls.extend(one.pulls);
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
}
