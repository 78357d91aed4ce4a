//! How much of each material a scene holds, and how much of all in each voxel: what turns absorbed energy into dose.

use glam::DVec3;
use rayon::prelude::*;

use super::cells::CellBox;
use super::contents::{Content, Mixture};
use super::flight::Space;
use super::matter::{Body, Mix, draw_at};
use super::stream::Stream;
use super::tally::Estimate;
use crate::geometry::VoxelGrid;

/// Strata along each edge of a cell that volumes share, and of one that the surface of a shape or mesh crosses: those may be as small as beads.
const OF_VOLUMES: u16 = 4;
const OF_SHAPES: u16 = 12;
/// Along each edge of a voxel of a dose map.
const OF_VOXELS: u16 = 4;
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

/// Grams in each voxel of `grid`, in its order, with the standard error of [`masses`]; exact where a voxel holds one density.
#[must_use]
pub fn masses_by_voxel(space: &Space, grid: &VoxelGrid) -> Vec<Estimate> {
    let strata = usize::from(OF_VOXELS);
    let points = strata.pow(3) as f64;
    let voxel_cm3 = 1e-3 * grid.lps_from_voxel.matrix3.determinant().abs();
    let of_voxel = |voxel: usize| {
        let (mut stream, mut mix) = (Stream::new(SEED, voxel as u64), Mix::default());
        let corner = DVec3::from_array(grid.coordinates(voxel).map(|n| n as f64)) - 0.5;
        let (mut sum, mut squares) = (0.0, 0.0);
        for stratum in 0..strata.pow(3) {
            let place = [stratum % strata, stratum / strata % strata, stratum / (strata * strata)];
            let within = DVec3::from_array(place.map(|n| (n as f64 + stream.uniform()) / strata as f64));
            draw_anywhere(space, grid.lps_from_voxel.transform_point3(corner + within), &mut stream, &mut mix);
            let density: f64 = mix.parts.iter().map(|(_, density)| density).sum();
            (sum, squares) = (sum + density, squares + density * density);
        }
        let mean = sum / points;
        let variance = (squares / points - mean * mean).max(0.0) / points;
        Estimate { mean: mean * voxel_cm3, standard_error: variance.sqrt() * voxel_cm3 }
    };
    (0..grid.voxels()).into_par_iter().map(of_voxel).collect()
}

/// Draws what is at a point, nothing beyond the scene's bounds.
fn draw_anywhere(space: &Space, point: DVec3, stream: &mut Stream, mix: &mut Mix) {
    mix.parts.clear();
    let (cells, bounds) = (&space.cells, space.cells.bounds());
    if !(point.cmpge(bounds.low).all() && point.cmple(bounds.high).all()) {
        return;
    }
    let cell = std::array::from_fn(|axis| cells.planes[axis].cell(point[axis]));
    match &cells.contents[cells.boxes[cells.box_of(cell) as usize].content as usize] {
        Content::Empty => {}
        Content::Uniform { material, density } => mix.parts.push((*material, *density)),
        Content::Mixed(mixture) => draw_at(&space.things, &mixture.things, mixture.keeps_air, point, stream, mix),
    }
}

/// Dose after `histories` where each leaves so much energy on average; what has no mass has none.
// Of 1 keV in 1 g: 1.602e-16 J in 1e-3 kg.
#[must_use]
pub fn dose_gy(absorbed_kev: Estimate, mass_g: Estimate, histories: f64) -> Estimate {
    const GY_OF_KEV_PER_G: f64 = 1.602_176_634e-13;
    if !(mass_g.mean > 0.0) {
        // What absorbs and was met by no point has a dose that nobody knows.
        let unknown = if absorbed_kev.mean > 0.0 { f64::NAN } else { 0.0 };
        return Estimate { mean: unknown, standard_error: unknown };
    }
    let scale = GY_OF_KEV_PER_G * histories / mass_g.mean;
    let of_mass = absorbed_kev.mean * mass_g.standard_error / mass_g.mean;
    Estimate { mean: scale * absorbed_kev.mean, standard_error: scale * absorbed_kev.standard_error.hypot(of_mass) }
}
