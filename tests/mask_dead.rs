//! Dead pixels that nobody has measured: a frame shows them by itself, and nothing that stands before the panel is taken for one.

use glam::DVec2;
use sidecarm::acquire::{Domain, Frame};
use sidecarm::beads::{Expectation, detect};
use sidecarm::image::Image;
use sidecarm::mask::{Cause, of_frame};
use sidecarm::random::{Purpose, Stream};

use crate::beads_drawn::{Sphere, shade, steel_passes};
use crate::mask_pelvis::exposed;

const SIZE: [usize; 2] = [640, 512];
/// From a bead's centre no pixel is killed this far: whether its edge is one is not asked.
const BESIDE_BEAD_PX: f64 = 16.0;

/// Beads of `radius_px` on a wide grid.
fn beads(radius_px: f64) -> Vec<Sphere> {
    let place = |n: usize| Sphere { u_px: 80.3 + 121.7 * (n % 5) as f64, v_px: 90.6 + 111.2 * (n / 5) as f64, radius_px };
    (0..20).map(place).collect()
}

/// A pelvis with beads, and two Kirschner wires of 0.8 mm, one of them along the rows.
fn drawn(quanta: f64, radius_px: f64, seed: u64) -> Image<f32> {
    let [width, height] = SIZE;
    let shade = shade(width, height, &beads(radius_px), 0.6);
    let sharp = |off_px: f64| steel_passes(0.8 * (1.0 - (off_px / 3.3).powi(2)).max(0.0).sqrt());
    // Spread by half a pixel.
    let weights: [f64; 7] = [1.0, 6.0, 15.0, 20.0, 15.0, 6.0, 1.0];
    let wire = |off_px: f64| {
        weights.iter().enumerate().map(|(n, weight)| weight / 64.0 * sharp(off_px + 0.4 * (n as f64 - 3.0))).sum::<f64>()
    };
    exposed(SIZE, quanta, seed, |x| {
        let bead = shade.at(x.x as usize, x.y as usize);
        bead * wire(x.y - 260.2) * wire((x.x - x.y * 0.11 - 255.0) * 0.994)
    })
}

/// As a console or the light in the scintillator smooths it.
fn smoothed(image: &Image<f32>) -> Image<f32> {
    let along = |image: &Image<f32>, step: [usize; 2]| {
        let value = |at: usize| {
            let (u, v) = (at % image.width, at / image.width);
            let before = image.at(u.saturating_sub(step[0]), v.saturating_sub(step[1]));
            let after = image.at((u + step[0]).min(image.width - 1), (v + step[1]).min(image.height - 1));
            0.25 * before + 0.5 * image.pixels[at] + 0.25 * after
        };
        Image { pixels: (0..image.pixels.len()).map(value).collect(), ..*image }
    };
    along(&along(image, [1, 0]), [0, 1])
}

fn frame(pixels: Image<f32>, domain: Domain) -> Frame {
    Frame::from_pixels("drawn", pixels, domain).expect("a frame")
}

/// What is masked as dead.
fn dead(pixels: &Image<f32>, domain: Domain) -> Image<bool> {
    let masks = of_frame(&frame(pixels.clone(), domain));
    masks.layer(Cause::DeadPixels).cloned().unwrap_or_else(|| pixels.map(|_| false))
}

fn count(mask: &Image<bool>) -> usize {
    mask.pixels.iter().filter(|here| **here).count()
}

/// `pixels` with dead and hot ones, single and in clusters of up to three by three, and where they are.
fn killed(pixels: &Image<f32>, radius_px: f64) -> (Image<f32>, Image<bool>) {
    let (mut spoilt, mut truth) = (pixels.clone(), pixels.map(|_| false));
    let mut random = Stream::new(5, 61, 0, Purpose::Evaluation);
    for n in 0..144 {
        let place = DVec2::new(25.0 + 48.0 * (n % 12) as f64, 20.0 + 39.0 * (n / 12) as f64);
        let is_free = beads(radius_px).iter().all(|bead| DVec2::new(bead.u_px, bead.v_px).distance(place) > BESIDE_BEAD_PX);
        let is_beside_wire = (place.y - 260.2).abs() < 12.0 || (place.x - place.y * 0.11 - 255.0).abs() < 12.0;
        if !is_free || is_beside_wire {
            continue;
        }
        let mut side = || if n % 2 == 0 { 1 } else { 1 + (random.uniform() * 3.0) as usize };
        let (columns, rows) = (side(), side());
        for row in place.y as usize..place.y as usize + rows {
            for column in place.x as usize..place.x as usize + columns {
                let value = spoilt.at_mut(column, row);
                *value = if n % 3 == 0 { 3.0 * *value + 50.0 } else { 0.0 };
                *truth.at_mut(column, row) = true;
            }
        }
    }
    (spoilt, truth)
}

#[test]
fn pixels_that_do_not_answer_are_found_without_a_calibration() {
    for (quanta, radius_px) in [(2000.0, 2.0), (4000.0, 6.2), (2e5, 6.2)] {
        let clean = drawn(quanta, radius_px, 3);
        let (spoilt, truth) = killed(&clean, radius_px);
        let found = dead(&spoilt, Domain::Linear);
        let right = found.pixels.iter().zip(&truth.pixels).filter(|(found, truth)| **found && **truth).count();
        let (all, wrong) = (count(&truth), count(&found) - right);
        assert!(all > 150 && 100 * right >= 95 * all, "{quanta}: {right} of {all}");
        assert!(wrong <= 1, "{quanta}: {wrong} wrong");
        // Of values that a console has made nothing is known.
        assert_eq!(count(&dead(&spoilt, Domain::Display)), 0);
        // The logarithm says the same.
        let mut nepers = frame(spoilt.map(|value| -(value.max(0.5) / 1e4).ln()), Domain::Log);
        nepers.unit = Some("neper".to_owned());
        let of_logarithm = of_frame(&nepers);
        let found = of_logarithm.layer(Cause::DeadPixels).map_or(0, count);
        assert!(10 * found >= 9 * all, "{quanta}: {found} of {all} in the logarithm");
    }
}

/// Beads from a pixel's radius on keep their shadows, and wires as thin, unless they run along a row from side to side.
#[test]
fn thin_shadows_are_no_dead_pixels() {
    let [width, height] = SIZE;
    let (mut all, mut hit) = (0, 0);
    for (radius_px, seed) in [(1.2, 11), (1.2, 12), (1.5, 13), (1.5, 14)] {
        let shade = shade(width, height, &beads(radius_px), 0.4);
        let clean = exposed(SIZE, 1000.0, seed, |x| *shade.at(x.x as usize, x.y as usize));
        let found = dead(&clean, Domain::Linear);
        let is_hit = |bead: &Sphere| {
            let near =
                |at: usize| DVec2::new((at % width) as f64, (at / width) as f64).distance(DVec2::new(bead.u_px, bead.v_px)) < 3.0;
            (0..found.pixels.len()).any(|at| found.pixels[at] && near(at))
        };
        all += beads(radius_px).len();
        hit += beads(radius_px).iter().filter(|bead| is_hit(bead)).count();
    }
    assert!(all == 80 && hit <= 2, "{hit} of {all}");
    for slope in [0.0, 0.002, 0.02] {
        // A thin wire that ends within the frame.
        let wire = |x: DVec2| {
            let off_px = x.y - 256.3 - slope * x.x;
            let is_there = (100.0..540.0).contains(&x.x);
            if is_there { 1.0 - 0.4 * (-0.5 * (off_px / 0.6).powi(2)).exp() } else { 1.0 }
        };
        let clean = exposed(SIZE, 3000.0, 15, wire);
        assert_eq!(count(&dead(&clean, Domain::Linear)), 0, "slope {slope}");
    }
}

/// Air at the end of the scale, columns that are read out in turns, a grid's lines and values in steps have dead pixels as other frames have.
#[test]
fn what_a_panel_does_to_all_pixels_hides_no_dead_ones_and_makes_none() {
    type Spoil = fn(usize, f32) -> f32;
    let spoils: [(&str, Spoil); 4] = [
        ("air at the end of the scale", |_, value| value.min(1890.0).round()),
        ("read out in turns", |column, value| value * (1.0 + 0.02 * (column % 2) as f32)),
        ("a grid", |column, value| value * (1.0 + 0.04 * (column as f32 * 1.46).sin())),
        ("steps", |_, value| (value / 200.0).round() / 4095.0),
    ];
    for (what, spoil) in spoils {
        let of = |pixels: &Image<f32>| {
            let value = |(at, value): (usize, &f32)| spoil(at % pixels.width, *value);
            Image { pixels: pixels.pixels.iter().enumerate().map(value).collect(), ..*pixels }
        };
        let clean = drawn(2000.0, 6.2, 3);
        let (spoilt, truth) = killed(&clean, 6.2);
        assert!(count(&dead(&of(&clean), Domain::Linear)) <= 2, "{what}: {} of none", count(&dead(&of(&clean), Domain::Linear)));
        let found = dead(&of(&spoilt), Domain::Linear);
        let right = found.pixels.iter().zip(&truth.pixels).filter(|(found, truth)| **found && **truth).count();
        assert!(2 * right >= count(&truth), "{what}: {right} of {}", count(&truth));
    }
}

/// Beads of two pixels, wires, bones and the tails of six quanta are none, nor is anything that a console has smoothed.
#[test]
fn what_stands_before_the_panel_is_no_dead_pixel() {
    let mut wrong = Vec::new();
    for (quanta, radius_px, seed) in
        [(6.0, 6.2, 1), (60.0, 2.0, 2), (2000.0, 2.0, 3), (2000.0, 6.2, 4), (1e6, 2.0, 5), (1e6, 6.2, 6)]
    {
        let clean = drawn(quanta, radius_px, seed);
        wrong.push(count(&dead(&clean, Domain::Linear)));
        wrong.push(count(&dead(&smoothed(&clean), Domain::Linear)));
        // As a panel of few steps stores it.
        wrong.push(count(&dead(&clean.map(|value| (100.0 + 900.0 * f64::from(*value) / quanta).round() as f32), Domain::Linear)));
    }
    assert!(wrong.len() == 18 && wrong.iter().sum::<usize>() <= 1, "{wrong:?}");
}

#[test]
fn beads_are_found_beside_dead_pixels_as_well_as_without() {
    let radius_px = 6.2;
    let clean = drawn(4000.0, radius_px, 3);
    let (mut spoilt, _) = killed(&clean, radius_px);
    // A hot cluster in every bead, and a dead pixel beside it.
    for bead in beads(radius_px) {
        let (column, row) = (bead.u_px as usize, bead.v_px as usize);
        *spoilt.at_mut(column + 14, row) = 0.0;
        for (right, down) in [(0, 0), (1, 0), (0, 1), (1, 1)] {
            *spoilt.at_mut(column + right, row + down) = 12_000.0;
        }
    }
    let found = |pixels: &Image<f32>, with_masks: bool| {
        let frame = frame(pixels.clone(), Domain::Linear);
        let usable = of_frame(&frame).usable(SIZE[0], SIZE[1], &[Cause::Saturation, Cause::BurnedIn]);
        let shadows = detect(&frame, with_masks.then_some(&usable), &Expectation::default()).found;
        let is_seen =
            |bead: &Sphere| shadows.iter().any(|shadow| shadow.image_px.distance(DVec2::new(bead.u_px, bead.v_px)) < 0.4);
        beads(radius_px).iter().filter(|bead| is_seen(bead)).count()
    };
    let (sound, masked) = (found(&clean, true), found(&spoilt, true));
    assert!(sound >= 16 && masked + 1 >= sound, "{masked} of {sound}");
    assert!(found(&spoilt, false) < masked, "the control: hot clusters in beads cost some");
}

#[test]
fn lines_that_do_not_answer_are_found_along_their_length() {
    let clean = drawn(2000.0, 6.2, 3);
    let [width, height] = SIZE;
    let mut spoilt = clean.clone();
    let mut truth = clean.map(|_| false);
    let mut kill = |column: usize, row: usize, value: &dyn Fn(f32) -> f32| {
        *spoilt.at_mut(column, row) = value(*clean.at(column, row));
        *truth.at_mut(column, row) = true;
    };
    // A column, half of another, and two rows beside each other.
    for row in 0..height {
        kill(140, row, &|_| 0.0);
        if row < height / 2 {
            kill(501, row, &|value| 1.5 * value);
        }
    }
    for column in 0..width {
        kill(column, 170, &|value| 0.3 * value);
        kill(column, 171, &|value| 0.3 * value);
    }
    let found = dead(&spoilt, Domain::Linear);
    let right = found.pixels.iter().zip(&truth.pixels).filter(|(found, truth)| **found && **truth).count();
    let (all, wrong) = (count(&truth), count(&found) - right);
    assert!(10 * right >= 9 * all && 50 * wrong <= all, "{right} of {all}, {wrong} wrong");
    assert_eq!(count(&dead(&clean, Domain::Linear)), 0, "the control");
}
