//! What a scan cut off: tissue that reaches a face of the grid goes on beyond it, and a ray that passes there does not see all matter.
//!
//! Each face's tissue is extruded along the face's normal (DESIGN §5, truncated CT). A ray is beyond a face along a stretch of depths; seen
//! along the normal that stretch is a straight line, and the ray is incomplete when the line meets the face's tissue.

use glam::{DVec2, DVec3};
use rayon::prelude::*;

use super::face_sums::{CutFace, across};
use super::prepared::Prepared;

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

/// Marks the pixels whose rays pass where a scan was cut off: `valid` becomes 0. Returns the longest unscanned path, mm (at most what the
/// rays spend over the tissue's bounding rectangle).
pub fn mark(prepared: &Prepared, valid: &mut [u8]) -> f32 {
    let seen: Vec<Seen> = prepared
        .volumes
        .iter()
        .filter(|seen| seen.volume.truncated_at_faces)
        .flat_map(|seen| {
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
        })
        .collect();
    if seen.is_empty() {
        return 0.0;
    }
    let [width, height] = prepared.view.size_px.map(|n| n as usize);
    let direction = |u: f64, v: f64| prepared.view.intrinsics.unproject(DVec2::new(u, v));
    let rows_of_blocks = valid.par_chunks_mut(BLOCK * width).enumerate();
    let longest = rows_of_blocks.map(|(block_row, rows)| {
        let v0 = block_row * BLOCK;
        let v1 = (v0 + BLOCK).min(height) - 1;
        let mut longest = 0.0f64;
        for u0 in (0..width).step_by(BLOCK) {
            let u1 = (u0 + BLOCK).min(width) - 1;
            let corners = [(u0, v0), (u1, v0), (u0, v1), (u1, v1)].map(|(u, v)| direction(u as f64, v as f64));
            for face in seen.iter().filter(|face| face.may_meet(&corners)) {
                for v in v0..=v1 {
                    for u in u0..=u1 {
                        let ray = direction(u as f64, v as f64);
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
