//! Super-voxels: boxes of space that say what may be inside them, so that a photon in tissue does not pay for a screw elsewhere.
//!
//! Planes parallel to the axes cut the scene's bounds into cells a few millimetres wide; faces of boxes and volumes that lie parallel to
//! the axes are planes too. Each cell knows whether it is empty, holds one material of one density, or a mixture with a majorant and a
//! minorant per material; neighbours with equal contents are merged into boxes, so that a slab of water is one box.

use std::collections::HashMap;

use glam::DVec3;
use rayon::prelude::*;

use super::bounds::Region;
use super::contents::{Content, content};
use super::matter::{Body, Thing, bounds_of};
use super::planes::{Planes, cut};

/// Cells from one plane to another along each axis.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct CellBox {
    /// Lower corner, lps mm.
    pub low: DVec3,
    /// Upper corner.
    pub high: DVec3,
    /// First plane by axis.
    pub low_cell: [u16; 3],
    /// Last plane by axis.
    pub high_cell: [u16; 3],
    /// Index of its contents.
    pub content: u32,
    /// By axis the box across the lower and the upper face, or [`OUTSIDE`], or [`SEVERAL`].
    pub neighbours: [[u32; 2]; 3],
}

/// No box: beyond the scene's bounds.
pub const OUTSIDE: u32 = u32::MAX;

/// More than one box.
pub const SEVERAL: u32 = u32::MAX - 1;

/// The scene in boxes.
pub struct Cells {
    /// Planes by axis.
    pub planes: [Planes; 3],
    /// Boxes; together they fill the scene's bounds.
    pub boxes: Vec<CellBox>,
    /// Contents.
    pub contents: Vec<Content>,
    /// Box of each cell.
    pub(super) box_of_cell: Vec<u32>,
}

impl Cells {
    /// Cuts the space of `things`, seen along `beam`; `None` where there is nothing at all.
    #[must_use]
    pub fn new(things: &[Thing], beam: DVec3) -> Option<Self> {
        let bounds: Vec<(DVec3, DVec3)> = things.iter().map(|thing| bounds_of(&thing.body)).collect();
        let low = bounds.iter().fold(DVec3::INFINITY, |low, bound| low.min(bound.0));
        let high = bounds.iter().fold(DVec3::NEG_INFINITY, |high, bound| high.max(bound.1));
        if !low.cmplt(high).all() {
            return None;
        }
        let planes: [Planes; 3] = std::array::from_fn(|axis| {
            let faces = things.iter().zip(&bounds).filter(|(thing, _)| has_flat_faces(&thing.body));
            Planes::new(cut(low[axis], high[axis], faces.flat_map(|(_, bound)| [bound.0[axis], bound.1[axis]]).collect()))
        });
        let size: [usize; 3] = std::array::from_fn(|axis| planes[axis].cells());
        let mut contents = vec![Content::Empty];
        let mut known: HashMap<Vec<u64>, u32> = HashMap::new();
        let mut content_of_cell = Vec::with_capacity(size.iter().product());
        for k in 0..size[2] {
            let slab: Vec<Content> = (0..size[0] * size[1])
                .into_par_iter()
                .map(|cell| content(things, &bounds, &region(&planes, [cell % size[0], cell / size[0], k])))
                .collect();
            for content in slab {
                let index = match content {
                    Content::Empty => 0,
                    content => *known.entry(content.key()).or_insert_with(|| {
                        contents.push(content);
                        contents.len() as u32 - 1
                    }),
                };
                content_of_cell.push(index);
            }
        }
        let mut order = [0, 1, 2];
        order.sort_by(|a, b| beam[*b].abs().total_cmp(&beam[*a].abs()));
        let (boxes, box_of_cell) = merge(&content_of_cell, &planes, order);
        Some(Self { planes, boxes, contents, box_of_cell })
    }

    /// The box of cell (i, j, k).
    #[inline]
    #[must_use]
    pub fn box_of(&self, [i, j, k]: [usize; 3]) -> u32 {
        self.box_of_cell[i + self.planes[0].cells() * (j + self.planes[1].cells() * k)]
    }

    /// Bounds of the scene.
    #[must_use]
    pub fn bounds(&self) -> Region {
        let at = |pick: fn(&Planes) -> f64| DVec3::from_array(std::array::from_fn(|axis| pick(&self.planes[axis])));
        Region { low: at(|planes| planes.at[0]), high: at(|planes| planes.at[planes.at.len() - 1]) }
    }
}

/// Whether its bounds are faces of it: boxes and volumes whose axes are those of the room.
fn has_flat_faces(body: &Body) -> bool {
    let matrix = match body {
        Body::Solid(body) => match body.solid.shape {
            crate::scene::model::Shape::Cuboid { .. } => body.local_from_lps.matrix3,
            _ => return false,
        },
        Body::Mesh(_) => return false,
        Body::Volume(grid) => grid.voxel_from_lps.matrix3,
    };
    (0..3).all(|n| {
        let axis = matrix.col(n).abs();
        axis.max_element() > (1.0 - 1e-9) * axis.element_sum()
    })
}

fn region(planes: &[Planes; 3], cell: [usize; 3]) -> Region {
    let at = |step: usize| DVec3::from_array(std::array::from_fn(|axis| planes[axis].at[cell[axis] + step]));
    Region { low: at(0), high: at(1) }
}

/// Boxes of cells with equal contents: each grows along the axes in this order as far as it finds nothing else. Long boxes along the beam
/// are crossed by few faces.
fn merge(content_of_cell: &[u32], planes: &[Planes; 3], order: [usize; 3]) -> (Vec<CellBox>, Vec<u32>) {
    const NONE: u32 = u32::MAX;
    let size: [usize; 3] = std::array::from_fn(|axis| planes[axis].cells());
    let index = |cell: [usize; 3]| cell[0] + size[0] * (cell[1] + size[1] * cell[2]);
    let mut box_of_cell = vec![NONE; content_of_cell.len()];
    let mut boxes = Vec::new();
    for first in cells_between([0; 3], size) {
        if box_of_cell[index(first)] != NONE {
            continue;
        }
        let content = content_of_cell[index(first)];
        let mut end = first.map(|n| n + 1);
        for axis in order {
            while end[axis] < size[axis] {
                // The next layer of cells along this axis.
                let (mut from, mut to) = (first, end);
                (from[axis], to[axis]) = (end[axis], end[axis] + 1);
                let is_free = |cell| content_of_cell[index(cell)] == content && box_of_cell[index(cell)] == NONE;
                if !cells_between(from, to).all(is_free) {
                    break;
                }
                end[axis] += 1;
            }
        }
        cells_between(first, end).for_each(|cell| box_of_cell[index(cell)] = boxes.len() as u32);
        let place = |cell: [usize; 3]| DVec3::from_array(std::array::from_fn(|axis| planes[axis].at[cell[axis]]));
        let [low_cell, high_cell] = [first, end].map(|cell| cell.map(|n| n as u16));
        boxes.push(CellBox { low: place(first), high: place(end), low_cell, high_cell, content, neighbours: [[OUTSIDE; 2]; 3] });
    }
    for cell_box in &mut boxes {
        for (axis, upper) in (0..3).flat_map(|axis| [(axis, 0), (axis, 1)]) {
            let (mut from, mut to) = (cell_box.low_cell.map(usize::from), cell_box.high_cell.map(usize::from));
            let layer = if upper == 1 { to[axis] } else { from[axis].wrapping_sub(1) };
            if layer >= size[axis] {
                continue;
            }
            (from[axis], to[axis]) = (layer, layer + 1);
            let one = box_of_cell[index(from)];
            let is_one = cells_between(from, to).all(|cell| box_of_cell[index(cell)] == one);
            cell_box.neighbours[axis][upper] = if is_one { one } else { SEVERAL };
        }
    }
    (boxes, box_of_cell)
}

fn cells_between(from: [usize; 3], to: [usize; 3]) -> impl Iterator<Item = [usize; 3]> {
    (from[2]..to[2]).flat_map(move |k| (from[1]..to[1]).flat_map(move |j| (from[0]..to[0]).map(move |i| [i, j, k])))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::transport::contents::Mixture;
    use crate::transport::fixture::everything;
    use crate::transport::matter::{Mix, draw_at, things_of};
    use crate::transport::stream::Stream;

    /// Points drawn in the scene's bounds: what a box says of them is what the whole scene has there.
    #[test]
    fn a_box_knows_everything_in_it_and_bounds_it() {
        let scene = everything();
        let things = things_of(&scene);
        let all: Vec<u32> = (0..things.len() as u32).collect();
        let cells = Cells::new(&things, DVec3::Z).expect("there is matter");
        let (bounds, mut stream, mut mix, mut here) = (cells.bounds(), Stream::new(1, 0), Mix::default(), Mix::default());
        // μ/ρ by scene material, any numbers.
        let per_mm = [0.02, 0.03, 0.12, 0.028, 0.07, 0.018];
        let mu = |mix: &Mix| mix.parts.iter().map(|(material, density)| density * per_mm[*material as usize]).sum::<f64>();
        let (mut kinds, mut tight, mut beside) = ([0; 3], 0, [0_usize; 2]);
        for _ in 0..200_000 {
            let share = DVec3::new(stream.uniform(), stream.uniform(), stream.uniform());
            let point = bounds.low + (bounds.high - bounds.low) * share;
            let cell = std::array::from_fn(|axis| cells.planes[axis].cell(point[axis]));
            let cell_box = &cells.boxes[cells.box_of(cell) as usize];
            assert!(point.cmpge(cell_box.low).all() && point.cmple(cell_box.high).all());
            let mut again = stream.clone();
            draw_at(&things, &all, true, point, &mut stream, &mut mix);
            match &cells.contents[cell_box.content as usize] {
                Content::Empty => {
                    assert!(mix.parts.is_empty(), "{point}");
                    kinds[0] += 1;
                }
                Content::Uniform { material, density } => {
                    assert_eq!(mix.parts, [(*material, *density)], "{point}");
                    kinds[1] += 1;
                }
                Content::Mixed(mixture) => {
                    draw_at(&things, &mixture.things, mixture.keeps_air, point, &mut again.clone(), &mut here);
                    assert_eq!(mu(&mix), mu(&here), "{point}");
                    let is_within = |mixture: &Mixture| {
                        let to = mixture.ranges.iter().map(|range| range.to * per_mm[range.material as usize]);
                        let from = mixture.ranges.iter().map(|range| range.from * per_mm[range.material as usize]);
                        let least = if mixture.is_full { from.fold(f64::INFINITY, f64::min) } else { 0.0 };
                        let most = to.fold(0.0, f64::max);
                        assert!(mu(&mix) <= most && mu(&mix) >= least, "{point}: {least} {} {most}", mu(&mix));
                        // The control: bounds a fifth narrower are overstepped somewhere.
                        usize::from(mu(&mix) > 0.8 * most && most > 0.0)
                    };
                    tight += is_within(mixture);
                    kinds[2] += 1;
                    // Where none of the dense shapes is, there is the rest; kept air is drawn twice, and not alike.
                    let Some(dense) = mixture.dense.as_deref().filter(|_| !mixture.keeps_air) else { continue };
                    draw_at(&things, &dense.shapes, false, point, &mut again.clone(), &mut here);
                    if here.parts.is_empty() {
                        draw_at(&things, &dense.rest.things, dense.rest.keeps_air, point, &mut again, &mut here);
                        assert_eq!(mu(&mix), mu(&here), "{point}, beside");
                        beside[is_within(&dense.rest)] += 1;
                    }
                }
            }
        }
        assert!(kinds.iter().all(|count| *count > 1000) && tight > 1000, "{kinds:?} {tight}");
        assert!(beside.iter().sum::<usize>() > 100 && beside[1] > 10, "{beside:?}");
    }

    #[test]
    fn boxes_fill_the_scene_once_and_know_their_neighbours() {
        let scene = everything();
        let cells = Cells::new(&things_of(&scene), DVec3::new(0.1, 0.9, 0.2)).expect("there is matter");
        let bounds = cells.bounds();
        let volume = |low: DVec3, high: DVec3| (high - low).element_product();
        let sum: f64 = cells.boxes.iter().map(|one| volume(one.low, one.high)).sum();
        assert!((sum / volume(bounds.low, bounds.high) - 1.0).abs() < 1e-9);
        let cell_count: usize = cells.planes.iter().map(Planes::cells).product();
        assert!(cells.boxes.len() < cell_count, "some are merged");
        let (mut outer, mut single) = (0, 0);
        for (index, one) in cells.boxes.iter().enumerate() {
            for (axis, upper) in (0..3).flat_map(|axis| [(axis, 0), (axis, 1)]) {
                match one.neighbours[axis][upper] {
                    OUTSIDE => outer += 1,
                    SEVERAL => {}
                    other => {
                        let there = &cells.boxes[other as usize];
                        let (here, faces) = ([one.low, one.high][upper][axis], [there.high, there.low][upper][axis]);
                        assert!(here == faces && other as usize != index);
                        single += 1;
                    }
                }
            }
        }
        assert!(outer > 6 && single > 100, "{outer} {single}");
    }

    /// A slab, and one with air around it, are one box each: nothing slows a flight through them.
    #[test]
    fn what_is_the_same_is_one_box() {
        use crate::scene::model::{Matter, Shape};
        use crate::transport::fixture::{scene, solid};
        let slab = |half: DVec3, material| solid(Shape::Cuboid { half_size_mm: half }, DVec3::ZERO, DVec3::ZERO, material, 1.0);
        let half = DVec3::new(200.0, 200.0, 100.0);
        let water = scene(&["water", "air"], vec![Matter::Solids(vec![slab(half, 0)])]);
        assert_eq!(Cells::new(&things_of(&water), DVec3::Z).expect("matter").boxes.len(), 1);
        let around = scene(&["water", "air"], vec![Matter::Solids(vec![slab(half * 2.0, 1), slab(half, 0)])]);
        let cells = Cells::new(&things_of(&around), DVec3::Z).expect("matter");
        let uniform = cells.boxes.iter().filter(|one| matches!(cells.contents[one.content as usize], Content::Uniform { .. }));
        assert!(cells.boxes.len() <= 7 && uniform.count() == cells.boxes.len(), "{}", cells.boxes.len());
    }
}
