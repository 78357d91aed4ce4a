//! What a thing can have inside a box: nothing, something, or all of it, between which densities.

use glam::DVec3;

use super::matter::{Body, Grid, SolidBody, around, contains, local_bounds};
use crate::scene::model::Shape;

/// A box with faces parallel to the axes, lps mm.
#[derive(Clone, Copy, Debug)]
pub struct Region {
    /// Lower corner.
    pub low: DVec3,
    /// Upper corner.
    pub high: DVec3,
}

impl Region {
    fn corners(&self) -> impl Iterator<Item = DVec3> + '_ {
        (0..8u32).map(|bits| {
            let pick = |axis: usize| if bits >> axis & 1 == 1 { self.high[axis] } else { self.low[axis] };
            DVec3::new(pick(0), pick(1), pick(2))
        })
    }
}

/// Densities of one scene material, g/cm³: no less than the first at any point where the thing has only this material.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Range {
    /// Scene material.
    pub material: u32,
    /// Smallest.
    pub from: f64,
    /// Largest.
    pub to: f64,
}

/// What a thing has inside a region.
#[derive(Clone, Debug, Default)]
pub struct Held {
    /// By material; none where the thing is not there at all.
    pub ranges: Vec<Range>,
    /// Whether every point has matter of it that is not air, so that what it displaces is not seen.
    pub is_full: bool,
    /// Whether it may have air there.
    pub holds_air: bool,
    /// Whether its density may fall to nothing within the region, as between a voxel with matter and one without.
    pub fades: bool,
}

/// Bounds what `body` has inside `region`; what is uncertain counts as there and not full.
#[must_use]
pub fn held(body: &Body, region: &Region) -> Held {
    match body {
        Body::Solid(body) => {
            let Some(is_inside) = inside(body, region) else { return Held::default() };
            let density = body.solid.density_g_per_cm3;
            let ranges = vec![Range { material: body.solid.material as u32, from: density, to: density }];
            Held { ranges, is_full: is_inside && !body.is_air, holds_air: body.is_air, fades: false }
        }
        Body::Mesh(body) => {
            let touches = body.touches(region.low, region.high);
            if !touches && !body.contains(0.5 * (region.low + region.high), &mut Vec::new()) {
                return Held::default();
            }
            let density = body.mesh.density_g_per_cm3;
            let ranges = vec![Range { material: body.mesh.material as u32, from: density, to: density }];
            Held { ranges, is_full: !touches && !body.is_air, holds_air: body.is_air, fades: false }
        }
        Body::Volume(grid) => held_by_grid(grid, region),
    }
}

/// Whether a region is wholly in a shape; `None` where it is wholly outside.
// All shapes are convex but for the lumen of a tube: a box is inside when its corners are.
#[must_use]
pub fn inside(body: &SolidBody, region: &Region) -> Option<bool> {
    let (low, high) = around(&body.local_from_lps, region.low, region.high);
    let (shape_low, shape_high) = local_bounds(&body.solid.shape);
    // What only touches, as cells do whose planes are the shape's faces, is outside, however it was rounded.
    let touch = 1e-9 * (shape_high - shape_low).max_element();
    if low.cmpge(shape_high - touch).any() || high.cmple(shape_low + touch).any() {
        return None;
    }
    // Nearest and farthest from the axes or the centre, of the box around the region in the shape's frame.
    let nearest = DVec3::ZERO.clamp(low, high);
    let farthest = low.abs().max(high.abs());
    let mut shape = body.solid.shape;
    let mut clear_of_lumen = true;
    match &mut shape {
        Shape::Ellipsoid { semi_axes_mm } => {
            if (nearest / *semi_axes_mm).length_squared() > 1.0 {
                return None;
            }
        }
        Shape::Cuboid { .. } => {}
        Shape::Cylinder { radius_mm, inner_radius_mm, .. } => {
            if nearest.truncate().length() > *radius_mm || farthest.truncate().length() < *inner_radius_mm {
                return None;
            }
            clear_of_lumen = nearest.truncate().length() >= *inner_radius_mm;
            *inner_radius_mm = 0.0;
        }
    }
    // A face that lies on the shape's own is inside it, however it was rounded.
    let shrunk = |corner: DVec3| corner + (0.5 * (region.low + region.high) - corner) * 1e-9;
    let corners_inside = region.corners().all(|corner| contains(&shape, body.local_from_lps.transform_point3(shrunk(corner))));
    Some(clear_of_lumen && corners_inside)
}

fn held_by_grid(grid: &Grid, region: &Region) -> Held {
    let volume = grid.volume;
    let (low, high) = around(&grid.voxel_from_lps, region.low, region.high);
    let mut places = [[0; 2]; 3];
    let mut within = true;
    for axis in 0..3 {
        let last = volume.size[axis] - 1;
        if high[axis] < -0.5 || low[axis] > last as f64 + 0.5 {
            return Held::default();
        }
        within &= low[axis] >= -0.5 - 1e-9 && high[axis] <= last as f64 + 0.5 + 1e-9;
        // Rounding must not leave out a voxel.
        let (from, to) = match grid.is_piecewise_constant() {
            true => ((low[axis] + 0.5 - 1e-9).floor(), (high[axis] + 0.5 + 1e-9).floor()),
            false => ((low[axis] - 1e-9).floor(), (high[axis] + 1e-9).ceil()),
        };
        places[axis] = [from, to].map(|place| place.clamp(0.0, last as f64) as usize);
    }
    let mut found = Held { ranges: Vec::new(), is_full: within, holds_air: false, fades: false };
    for k in places[2][0]..=places[2][1] {
        for j in places[1][0]..=places[1][1] {
            for i in places[0][0]..=places[0][1] {
                let Some((material, density, air)) = grid.voxel(volume.index(i, j, k)) else {
                    (found.is_full, found.fades) = (false, true);
                    continue;
                };
                found.holds_air |= air;
                found.is_full &= !air;
                match found.ranges.iter_mut().find(|range| range.material == material) {
                    Some(range) => (range.from, range.to) = (range.from.min(density), range.to.max(density)),
                    None => found.ranges.push(Range { material, from: density, to: density }),
                }
            }
        }
    }
    found
}
