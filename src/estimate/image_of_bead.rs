//! A bead's image: u = K · lens(camera_from_lps · lps_from_body · place).
//!
//! The bead's place is known with a covariance Σ_b, or is a block of its own with a prior. In the first case the image's covariance is
//! inflated, Σ = Σ_px + (∂u/∂place) Σ_b (∂u/∂place)ᵀ: what eliminating the block gives to first order in the bead's displacement.

use glam::{DMat3, DVec2, DVec3};

use super::block::{BlockId, PoseBlock, State, VectorBlock};
use super::motion::turned;
use super::residual::{Evaluation, Residual};

/// Where a bead is in its body.
#[derive(Clone, Copy, Debug)]
pub enum Place {
    /// Known, with its covariance in mm².
    Known {
        /// In `body`.
        body_mm: DVec3,
        /// 3×3, symmetric.
        covariance_mm2: DMat3,
        /// The weights take this share of the standard deviation; the covariance of the estimate always takes all of it.
        share: f64,
    },
    /// Solved: three numbers in mm, in `body`.
    Solved(VectorBlock),
}

/// A bead's image.
#[derive(Clone, Debug)]
pub struct BeadImage {
    ids: [BlockId; 5],
    count: usize,
    camera: PoseBlock,
    /// fx, fy, skew, cx, cy in px.
    intrinsics: VectorBlock,
    body: Option<PoseBlock>,
    lens: Option<VectorBlock>,
    place: Place,
    image_px: DVec2,
    /// uu, uv, vv.
    covariance_px2: [f64; 3],
}

impl BeadImage {
    /// `camera` is `camera_from_lps`; `intrinsics` holds fx, fy, skew, cx, cy in px; `covariance_px2` is (uu, uv, vv).
    #[must_use]
    pub fn new(camera: PoseBlock, intrinsics: VectorBlock, place: Place, image_px: DVec2, covariance_px2: [f64; 3]) -> Self {
        let mut bead =
            Self { ids: [camera.id; 5], count: 1, camera, intrinsics, body: None, lens: None, place, image_px, covariance_px2 };
        bead.push(intrinsics.id);
        if let Place::Solved(block) = place {
            bead.push(block.id);
        }
        bead
    }

    /// The bead is fixed to a body that is placed by `lps_from_body`.
    #[must_use]
    pub fn on_body(mut self, lps_from_body: PoseBlock) -> Self {
        self.body = Some(lps_from_body);
        self.push(lps_from_body.id);
        self
    }

    /// The lens distorts: k1, k2, p1, p2 of Brown (1971), "Close-range camera calibration", and s, an S distortion, on the plane z = 1:
    /// x ← x (1 + k1 r² + k2 r⁴) + 2 p1 x y + p2 (r² + 2 x²) − s r² y, y likewise with p1 and p2 exchanged, and + s r² x.
    #[must_use]
    pub fn through(mut self, lens: VectorBlock) -> Self {
        self.lens = Some(lens);
        self.push(lens.id);
        self
    }

    fn push(&mut self, id: BlockId) {
        self.ids[self.count] = id;
        self.count += 1;
    }

    fn place_of(&self, id: BlockId) -> usize {
        self.ids[..self.count].iter().position(|own| *own == id).unwrap_or(0)
    }
}

/// A point through the lens: where it goes, the 2×2 derivative by the point, rows, and by k1, k2, p1, p2, s.
struct Bent {
    at: DVec2,
    by_point: [[f64; 2]; 2],
    by_lens: [[f64; 5]; 2],
}

fn bend(p: DVec2, lens: Option<&[f64]>) -> Bent {
    let Some(&[k1, k2, p1, p2, s]) = lens.and_then(|numbers| numbers.first_chunk()) else {
        return Bent { at: p, by_point: [[1.0, 0.0], [0.0, 1.0]], by_lens: [[0.0; 5]; 2] };
    };
    let DVec2 { x, y } = p;
    let r2 = x * x + y * y;
    let (radial, slope) = (1.0 + (k1 + k2 * r2) * r2, 2.0 * k1 + 4.0 * k2 * r2);
    let at = DVec2::new(
        x * radial + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x) - s * r2 * y,
        y * radial + p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y + s * r2 * x,
    );
    let mixed = slope * x * y + 2.0 * p1 * x + 2.0 * p2 * y;
    let by_point = [
        [radial + slope * x * x + 2.0 * p1 * y + 6.0 * p2 * x - 2.0 * s * x * y, mixed - s * (r2 + 2.0 * y * y)],
        [mixed + s * (r2 + 2.0 * x * x), radial + slope * y * y + 6.0 * p1 * y + 2.0 * p2 * x + 2.0 * s * x * y],
    ];
    Bent { at, by_point, by_lens: plane_by_lens(p) }
}

/// Rows of ∂/∂(k1, k2, p1, p2, s) of where the lens of [`BeadImage::through`] takes a place of the plane z = 1.
#[must_use]
pub fn plane_by_lens(p: DVec2) -> [[f64; 5]; 2] {
    let DVec2 { x, y } = p;
    let r2 = x * x + y * y;
    [[x * r2, x * r2 * r2, 2.0 * x * y, r2 + 2.0 * x * x, -y * r2], [y * r2, y * r2 * r2, r2 + 2.0 * y * y, 2.0 * x * y, x * r2]]
}

impl Residual for BeadImage {
    fn dimension(&self) -> usize {
        2
    }

    fn blocks(&self) -> &[BlockId] {
        &self.ids[..self.count]
    }

    fn evaluate(&self, state: &State, out: &mut Evaluation) -> bool {
        let in_body = match self.place {
            Place::Known { body_mm, .. } => body_mm,
            Place::Solved(block) => state.point(block),
        };
        let in_lps = self.body.map_or(in_body, |body| state.pose(body).transform_point(in_body));
        let camera = state.motion(self.camera);
        let p = camera.pose.transform_point(in_lps);
        let &[fx, fy, skew, cx, cy, ..] = state.vector(self.intrinsics) else { return false };
        if !(p.z > 1.0 && fx > 1.0 && fy > 1.0) {
            return false;
        }
        let bent = bend(p.truncate() / p.z, self.lens.map(|lens| state.vector(lens)));
        let predicted = DVec2::new(fx * bent.at.x + skew * bent.at.y + cx, fy * bent.at.y + cy);
        out.offset().copy_from_slice(&(self.image_px - predicted).to_array());

        // Rows of ∂(u, v)/∂p: K · lens · (1/z)[1 0 −x; 0 1 −y].
        let [bu, bv] = bent.by_point;
        let by_plane = [[fx * bu[0] + skew * bv[0], fx * bu[1] + skew * bv[1]], [fy * bv[0], fy * bv[1]]];
        let by_camera = by_plane.map(|[a, b]| DVec3::new(a, b, -(a * p.x + b * p.y) / p.z) / p.z);
        let to_lps = camera.pose.rotation.conjugate();
        let by_lps = by_camera.map(|row| to_lps * row);
        let by_body = match self.body {
            Some(body) => {
                let to_body = state.pose(body).rotation.conjugate();
                by_lps.map(|row| to_body * row)
            }
            None => by_lps,
        };

        let [uu, uv, vv] = self.covariance_px2;
        let (mut full, mut used) = ([uu, uv, vv], [uu, uv, vv]);
        if let Place::Known { covariance_mm2, share, .. } = self.place {
            let spread = by_body.map(|row| covariance_mm2 * row);
            let [u, v] = by_body;
            for (n, add) in [u.dot(spread[0]), u.dot(spread[1]), v.dot(spread[1])].into_iter().enumerate() {
                full[n] += add;
                used[n] += add * share * share;
            }
            if share != 1.0 {
                out.noise().copy_from_slice(&[full[0], full[1], full[1], full[2]]);
            }
        }
        let determinant = used[0] * used[2] - used[1] * used[1];
        if !(determinant > 0.0) {
            return false;
        }
        let off_diagonal = -used[1] / determinant;
        out.information().copy_from_slice(&[used[2] / determinant, off_diagonal, off_diagonal, used[0] / determinant]);

        let mut rows = |place: usize, values: [&[f64]; 2]| {
            if let Some(jacobian) = out.jacobian(place) {
                for ((column, u), v) in jacobian.chunks_exact_mut(2).zip(values[0]).zip(values[1]) {
                    (column[0], column[1]) = (*u, *v);
                }
            }
        };
        let arm = p - camera.centre_mm();
        let [u, v] = by_camera.map(|row| turned(row, arm));
        rows(0, [&u, &v]);
        rows(1, [&[bent.at.x, 0.0, bent.at.y, 1.0, 0.0], &[0.0, bent.at.y, 0.0, 0.0, 1.0]]);
        if let Place::Solved(block) = self.place {
            let [u, v] = by_body;
            rows(self.place_of(block.id), [&u.to_array(), &v.to_array()]);
        }
        if let Some(body) = self.body {
            let arm = in_lps - state.motion(body).centre_mm();
            let [u, v] = by_lps.map(|row| turned(row, arm));
            rows(self.place_of(body.id), [&u, &v]);
        }
        if let Some(lens) = self.lens {
            let [x, y] = bent.by_lens;
            let along = |row: [f64; 2]| -> [f64; 5] { std::array::from_fn(|n| row[0] * x[n] + row[1] * y[n]) };
            let (u, v) = (along([fx, skew]), along([0.0, fy]));
            rows(self.place_of(lens.id), [&u, &v]);
        }
        true
    }
}
