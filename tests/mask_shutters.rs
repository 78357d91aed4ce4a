//! One frame of a pelvis behind each kind of shutter: is the kind recognised, and is as much of the frame flagged as is shut?

use glam::DVec2;
use sidecarm::mask::{Field, find_field};

use crate::mask_blades::{Blades, polygon};
use crate::mask_pelvis::exposed;

const SIZE_PX: [usize; 2] = [400, 320];
const MIDDLE: DVec2 = DVec2::new(199.5, 159.5);
const QUANTA: f64 = 5000.0;
/// What blades let through, and of an open frame as it is.
const LEAK: f64 = 1e-3;

/// Blades about the middle: normal's angle, distance.
fn planes(sides: impl IntoIterator<Item = (f64, f64)>) -> Blades {
    let plane = |(angle, distance): (f64, f64)| {
        let normal = DVec2::from_angle(angle);
        (normal, normal.dot(MIDDLE) + distance)
    };
    Blades { planes: sides.into_iter().map(plane).collect(), ..Blades::none() }
}

/// What is found of a frame behind `blades`; shares of what is shut and of what is open beyond the penumbra that are flagged, and of the
/// whole frame by how much more or less is flagged than does not get the whole beam.
fn found(blades: &Blades, penumbra_px: f64) -> (Option<Field>, [f64; 3]) {
    let open = |x: DVec2| {
        let depth = blades.depth_px(x);
        let share = if penumbra_px > 0.0 { (depth / penumbra_px + 0.5).clamp(0.0, 1.0) } else { f64::from(depth >= 0.0) };
        let share = share * share * (3.0 - 2.0 * share);
        share + LEAK * (1.0 - share)
    };
    let frame = exposed(SIZE_PX, QUANTA, 9, open);
    let field = find_field(&frame, false, false);
    let (mut counts, mut shut) = ([[0usize; 2]; 3], 0usize);
    for at in 0..frame.pixels.len() {
        let depth = blades.depth_px(DVec2::new((at % frame.width) as f64, (at / frame.width) as f64));
        let flagged = field.as_ref().is_some_and(|field| field.outside.pixels[at]);
        let half = 0.5 * penumbra_px;
        let part = if depth < -half { 0 } else { 1 + usize::from(depth > half + 2.0) };
        counts[part][usize::from(flagged)] += 1;
        shut += usize::from(depth < half);
    }
    let share = |[not, flagged]: [usize; 2]| flagged as f64 / (not + flagged).max(1) as f64;
    let flagged: usize = counts.iter().map(|count| count[1]).sum();
    let area = (flagged as f64 - shut as f64) / frame.pixels.len() as f64;
    (field, [share(counts[0]), share(counts[2]), area])
}

#[test]
fn each_kind_of_shutter_is_recognised_and_its_area_is_right() {
    use std::f64::consts::{FRAC_PI_2, PI};
    let sides = [(0.0, 150.0), (PI, 160.0), (FRAC_PI_2, 130.0), (-FRAC_PI_2, 135.0)];
    let turned = [(0.3, 130.0), (0.3 + PI, 130.0), (0.3 + FRAC_PI_2, 100.0), (0.3 - FRAC_PI_2, 100.0)];
    let leaves = |sides: usize, inradius: f64| Blades { planes: polygon(MIDDLE, sides, inradius, 0.1), ..Blades::none() };
    let round = Blades { disc: Some((MIDDLE + DVec2::new(6.0, -3.0), 138.0)), ..Blades::none() };
    // The kind, its blades, its penumbra, and how many straight edges and discs it has.
    let kinds: [(&str, Blades, f64, [usize; 2]); 7] = [
        ("round", round, 2.0, [0, 1]),
        ("rectangular", planes(sides), 2.0, [4, 0]),
        ("rotated", planes(turned), 2.0, [4, 0]),
        ("octagonal", leaves(8, 140.0), 2.0, [8, 0]),
        ("iris with penumbra", leaves(6, 130.0), 12.0, [6, 0]),
        ("one blade 47 % in", planes([(PI, 0.03 * SIZE_PX[0] as f64)]), 3.0, [1, 0]),
        ("half closed", planes([(FRAC_PI_2, 0.0)]), 3.0, [1, 0]),
    ];
    let mut failed = Vec::new();
    for (kind, blades, penumbra_px, edges) in &kinds {
        let (field, [shut, open, area]) = found(blades, *penumbra_px);
        let Some(Field { shape, penumbra_px: seen_px, description, .. }) = field else {
            failed.push(format!("{kind}: no field"));
            continue;
        };
        let recognised = [shape.half_planes.len(), usize::from(shape.disc.is_some())];
        let mut wrong = recognised != *edges || !(shut >= 0.99 && open <= 0.01 && area.abs() <= 0.02);
        if *kind == "round" {
            wrong |= shape.disc.is_none_or(|disc| !(disc.centre.distance(MIDDLE + DVec2::new(6.0, -3.0)) < 1.5));
            wrong |= shape.disc.is_none_or(|disc| !((disc.radius_px - 138.0).abs() < 1.5));
        }
        if *kind == "iris with penumbra" {
            wrong |= !((6.0..=18.0).contains(&seen_px));
        }
        if wrong {
            failed.push(format!(
                "{kind}: {recognised:?} edges and discs, expected {edges:?}; {:.2} % of what is shut and {:.2} % of what is open flagged, \
                 area {:+.2} %: {description}",
                100.0 * shut,
                100.0 * open,
                100.0 * area
            ));
        }
    }
    assert!(failed.is_empty(), "{}", failed.join("\n"));
    let (none, _) = found(&Blades::none(), 0.0);
    assert!(none.is_none(), "the control, an open frame: {none:?}");
}
