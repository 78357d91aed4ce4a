//! How much of each material a scene holds: what turns absorbed energy into dose.

use glam::DVec3;
use rayon::prelude::*;

use super::cells::{CellBox, Content, Mixture};
use super::flight::Space;
use super::matter::{Body, Mix, draw_at};
use super::stream::Stream;
use super::tally::Estimate;

/// Strata along each edge of a cell that volumes share, and of one that the surface of a shape or mesh crosses: those may be as small as beads.
const OF_VOLUMES: u16 = 4;
const OF_SHAPES: u16 = 12;
/// Seed of the points.
const SEED: u64 = 1;

/// Sums over the points of a box.
#[derive(Clone, Copy, Debug, Default)]
struct Sums {
    mass: f64,
    variance: f64,
}

/// Grams of each of `materials` scene materials: exact where a box of space holds one density, else by points drawn one to a stratum, with the
/// standard error that as many independent points would have, which is larger than theirs. What is displaced does not count.
#[must_use]
pub fn masses(space: &Space, materials: usize) -> Vec<Estimate> {
    let of_box = |(number, cell_box): (usize, &CellBox)| {
        let volume_cm3 = 1e-3 * (cell_box.high - cell_box.low).element_product();
        let mut found = vec![Sums::default(); materials];
        match &space.cells.contents[cell_box.content as usize] {
            Content::Empty => {}
            Content::Uniform { material, density } => found[*material as usize].mass = density * volume_cm3,
            Content::Mixed(mixture) => draw(space, (number, cell_box), mixture, volume_cm3, &mut found),
        }
        found
    };
    let of_boxes: Vec<Vec<Sums>> = space.cells.boxes.par_iter().enumerate().map(of_box).collect();
    let of_material = |material: usize| {
        let each = || of_boxes.iter().map(|sums| sums[material]);
        let variance: f64 = each().map(|sums| sums.variance).sum();
        Estimate { mean: each().map(|sums| sums.mass).sum(), standard_error: variance.sqrt() }
    };
    (0..materials).map(of_material).collect()
}

/// Adds what points in a box find.
fn draw(space: &Space, (number, cell_box): (usize, &CellBox), mixture: &Mixture, volume_cm3: f64, found: &mut [Sums]) {
    let holds_shape =
        mixture.things.iter().any(|thing| matches!(space.things[*thing as usize].body, Body::Solid(_) | Body::Mesh(_)));
    let strata = u32::from(if holds_shape { OF_SHAPES } else { OF_VOLUMES });
    let steps: [u32; 3] = std::array::from_fn(|axis| strata * u32::from(cell_box.high_cell[axis] - cell_box.low_cell[axis]));
    let stratum = (cell_box.high - cell_box.low) / DVec3::from_array(steps.map(f64::from));
    let (mut stream, mut mix) = (Stream::new(SEED, number as u64), Mix::default());
    for k in 0..steps[2] {
        for j in 0..steps[1] {
            for i in 0..steps[0] {
                let inner = DVec3::new(stream.uniform(), stream.uniform(), stream.uniform());
                let corner = DVec3::new(f64::from(i), f64::from(j), f64::from(k));
                let point = cell_box.low + stratum * (corner + inner);
                draw_at(&space.things, &mixture.things, mixture.keeps_air, point, &mut stream, &mut mix);
                for (material, density) in &mix.parts {
                    let sums = &mut found[*material as usize];
                    sums.mass += density;
                    sums.variance += density * density;
                }
            }
        }
    }
    let points = steps.map(f64::from).iter().product::<f64>();
    for sums in found {
        let mean = sums.mass / points;
        let variance = (sums.variance / points - mean * mean).max(0.0) / points;
        *sums = Sums { mass: mean * volume_cm3, variance: variance * volume_cm3 * volume_cm3 };
    }
}
