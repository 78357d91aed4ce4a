//! What a scan cut off: tissue that reaches a face of the grid goes on beyond it, and a ray that passes there does not see all matter.
//!
//! Each face's tissue is extruded along the face's normal (DESIGN §5, truncated CT). A ray is beyond a face along a stretch of depths; seen
//! along the normal that stretch is a straight line, and the ray is incomplete when the line meets the face's tissue.

use glam::{DVec2, DVec3};
use rayon::prelude::*;

use super::face_sums::{CutFace, across};
use super::prepared::{Prepared, SeenVolume};

/// Pixels along the side of a block of rays that is looked at as one.
const BLOCK: usize = 16;

/// A face before a camera.
struct Seen<'a> {
    face: &'a CutFace,
    /// Where the face is, in `cell` coordinates along its axis, and how far tissue may go on beyond it.
    plane: [f64; 2],
    /// The focal spot in `cell` coordinates.
    p: DVec3,
    cell_from_camera: glam::DMat3,
    detector_mm: f64,
}

impl Seen<'_> {
    fn flat(&self, x: DVec3) -> DVec2 {
        let [b, c] = across(self.face.axis);
        DVec2::new(x[b], x[c])
    }

    /// Depth that the ray spends beyond the face and over its tissue's bounding rectangle, if it meets tissue there.
    fn missed(&self, direction: DVec3) -> Option<f64> {
        let q = self.cell_from_camera * direction;
        let axis = self.face.axis;
        let (from, to) = self.face.beyond(self.plane, self.p[axis], q[axis], 0.0, self.detector_mm)?;
        let (a, d) = (self.flat(self.p), self.flat(q));
        let (from, to) = self.face.over_bounds(a, d, from, to)?;
        self.face.meets(a + d * from, a + d * to).then_some(to - from)
    }

    /// Whether any ray between those in `corners` may meet the extruded tissue.
    fn may_meet(&self, corners: &[DVec3]) -> bool {
        let q: Vec<DVec3> = corners.iter().map(|direction| self.cell_from_camera * *direction).collect();
        let (low, high) = q.iter().fold((q[0], q[0]), |(low, high), q| (low.min(*q), high.max(*q)));
        let axis = self.face.axis;
        let beyond = |q: f64| self.face.beyond(self.plane, self.p[axis], q, 0.0, self.detector_mm);
        // The stretches of the rays between lie between those of the two that leave the face fastest and slowest; where some go one way
        // and some the other, those that run along the face have stretches as late as there are.
        let stretches = [beyond(low[axis]), beyond(high[axis])];
        let Some((from, to)) = stretches.into_iter().flatten().reduce(|a, b| (a.0.min(b.0), a.1.max(b.1))) else {
            return false;
        };
        let to = if low[axis] < 0.0 && high[axis] > 0.0 { self.detector_mm } else { to };
        let (a, low, high) = (self.flat(self.p), self.flat(low), self.flat(high));
        let least = (a + low * from).min(a + low * to);
        let most = (a + high * from).max(a + high * to);
        self.face.count(least, most).0 > 0
    }
}

/// The faces of the truncated volumes that hold tissue, before the camera.
fn faces<'p>(prepared: &'p Prepared) -> Vec<Seen<'p>> {
    let truncated = prepared.volumes.iter().filter(|seen| seen.volume.truncated_at_faces);
    let of_volume = |seen: &'p SeenVolume| {
        seen.cells.cut_faces(seen.air_kind).iter().map(|face| Seen {
            face,
            plane: [
                if face.high { seen.volume.size[face.axis] as f64 + 0.5 } else { 0.5 },
                seen.volume.beyond_face_mm(face.axis) / seen.volume.lps_from_voxel.matrix3.col(face.axis).length(),
            ],
            p: seen.cell_from_camera.translation,
            cell_from_camera: seen.cell_from_camera.matrix3,
            detector_mm: prepared.detector_mm,
        })
    };
    truncated.flat_map(of_volume).collect()
}

/// Rays of a camera in blocks.
struct Blocks<'p> {
    prepared: &'p Prepared<'p>,
    size: [usize; 2],
}

impl<'p> Blocks<'p> {
    fn new(prepared: &'p Prepared<'p>) -> Self {
        Self { prepared, size: prepared.view.size_px.map(|n| n as usize) }
    }

    fn direction(&self, u: usize, v: usize) -> DVec3 {
        self.prepared.view.intrinsics.unproject(DVec2::new(u as f64, v as f64))
    }

    /// First and last column and row of each block in one row of them.
    fn of_row(&self, row: usize) -> impl Iterator<Item = [usize; 4]> {
        let [width, height] = self.size;
        let (v0, v1) = (row * BLOCK, (row * BLOCK + BLOCK).min(height) - 1);
        (0..width).step_by(BLOCK).map(move |u0| [u0, (u0 + BLOCK).min(width) - 1, v0, v1])
    }

    fn corners(&self, [u0, u1, v0, v1]: [usize; 4]) -> [DVec3; 4] {
        [(u0, v0), (u1, v0), (u0, v1), (u1, v1)].map(|(u, v)| self.direction(u, v))
    }
}

/// How many times a ray is tried against a face by [`mark`].
#[must_use]
pub fn tests(prepared: &Prepared) -> usize {
    let seen = faces(prepared);
    let blocks = Blocks::new(prepared);
    let in_block = |block: [usize; 4]| {
        let corners = blocks.corners(block);
        let [u0, u1, v0, v1] = block;
        seen.iter().filter(|face| face.may_meet(&corners)).count() * (u1 + 1 - u0) * (v1 + 1 - v0)
    };
    if seen.is_empty() { 0 } else { (0..blocks.size[1].div_ceil(BLOCK)).flat_map(|row| blocks.of_row(row)).map(in_block).sum() }
}

/// Marks the pixels whose rays pass where a scan was cut off: `valid` becomes 0. Returns the longest unscanned path, mm (at most what the
/// rays spend over the tissue's bounding rectangle).
pub fn mark(prepared: &Prepared, valid: &mut [u8]) -> f32 {
    let seen = faces(prepared);
    if seen.is_empty() {
        return 0.0;
    }
    let blocks = Blocks::new(prepared);
    let width = blocks.size[0];
    let rows_of_blocks = valid.par_chunks_mut(BLOCK * width).enumerate();
    let longest = rows_of_blocks.map(|(block_row, rows)| {
        let mut longest = 0.0f64;
        for block in blocks.of_row(block_row) {
            let [u0, u1, v0, v1] = block;
            let corners = blocks.corners(block);
            for face in seen.iter().filter(|face| face.may_meet(&corners)) {
                for v in v0..=v1 {
                    for u in u0..=u1 {
                        let ray = blocks.direction(u, v);
                        if let Some(depth_mm) = face.missed(ray) {
                            rows[(v - v0) * width + u] = 0;
                            longest = longest.max(depth_mm * ray.length());
                        }
                    }
                }
            }
        }
        longest
    });
    longest.reduce(|| 0.0, f64::max) as f32
}
