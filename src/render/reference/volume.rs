//! The field of a volume along a ray: trilinear, cell by cell; or piecewise constant, voxel by voxel.

use glam::{DAffine3, DVec3};

use super::intervals::Intervals;
use super::shapes::Ray;
use crate::scene::model::{Scene, Volume, Voxels};

/// A stretch beyond a face that is no longer than this is a touch: a ray that begins on a plane of voxel centres passes one side of it.
const TOUCH_MM: f64 = 1e-9;

/// A volume with what a ray asks of it.
#[derive(Clone, Debug)]
pub struct Grid<'a> {
    volume: &'a Volume,
    voxel_from_lps: DAffine3,
    /// Scene material, and whether it is air, by class − 1.
    classes: Vec<(usize, bool)>,
    voxels: Voxels,
}

/// A stretch of the ray in one cell of the lattice of voxel centres, or in one voxel.
#[derive(Clone, Copy, Debug)]
struct Piece {
    from: f64,
    to: f64,
    /// Voxels on either side along each axis; equal where the field does not change along it.
    between: [[usize; 2]; 3],
}

/// Which matter of a volume.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Part {
    /// Cells that hold anything but air, with the air in them.
    Matter,
    /// Cells that hold nothing but air.
    Air,
}

impl<'a> Grid<'a> {
    /// Looks at `volume` of `scene`.
    #[must_use]
    pub fn new(volume: &'a Volume, scene: &Scene) -> Self {
        let classes = volume.class_materials.iter().map(|material| (*material, scene.is_air(*material))).collect();
        Self { volume, voxel_from_lps: volume.lps_from_voxel.inverse(), classes, voxels: scene.model.voxels }
    }

    /// Whether any voxel can be air that is kept.
    #[must_use]
    pub fn keeps_air(&self) -> bool {
        self.classes.iter().any(|(_, air)| *air)
    }

    /// Depths at which the volume has matter of `part`. A cell is covered where the field is positive in it: where any voxel that
    /// contributes has density.
    #[must_use]
    pub fn covered(&self, ray: &Ray, part: Part) -> Intervals {
        let (origin, direction) = self.in_voxels(ray);
        let mut covered = Vec::new();
        for piece in self.pieces(origin, direction, ray.end_mm) {
            if self.part(&piece) == Some(part) {
                covered.push([piece.from, piece.to]);
            }
        }
        Intervals::of(covered)
    }

    /// Adds ∫ρ_m over the depths `free`, in g/cm³ · mm of depth, to `sums[m]`, in the cells of `part`.
    pub fn integrate(&self, ray: &Ray, part: Part, free: &Intervals, sums: &mut [f64]) {
        let (origin, direction) = self.in_voxels(ray);
        for piece in self.pieces(origin, direction, ray.end_mm) {
            if self.part(&piece) != Some(part) {
                continue;
            }
            for [from, to] in free.intersection(&Intervals::between(piece.from, piece.to)).iter() {
                self.integrate_cubic(&piece, origin, direction, [from, to], sums);
            }
        }
    }

    /// Whether the ray saw all the matter there was: false when it enters or leaves a CT through a border voxel that is not air, passes
    /// where that voxel's matter would go on beyond its face, or passes a cell in which matter meets padding outside the field of view.
    #[must_use]
    pub fn is_complete(&self, ray: &Ray) -> bool {
        if !self.volume.truncated_at_faces && self.volume.unknown.is_empty() {
            return true;
        }
        let (origin, direction) = self.in_voxels(ray);
        let has_matter = |piece: &Piece| self.part(piece) == Some(Part::Matter);
        if self.volume.truncated_at_faces {
            for (axis, high) in (0..3).flat_map(|axis| [(axis, false), (axis, true)]) {
                if self.beyond(axis, high, origin, direction, ray.end_mm).iter().any(has_matter) {
                    return false;
                }
            }
        }
        let pieces = self.pieces(origin, direction, ray.end_mm);
        let unknown = |piece: &Piece| corners(piece).any(|[i, j, k]| self.volume.unknown[self.volume.index(i, j, k)]);
        self.volume.unknown.is_empty() || !pieces.iter().any(|piece| has_matter(piece) && unknown(piece))
    }

    /// Stretches of the ray beyond a face, moved onto the face's outermost voxels along its normal.
    fn beyond(&self, axis: usize, high: bool, origin: DVec3, direction: DVec3, end_mm: f64) -> Vec<Piece> {
        let last = self.volume.size[axis] - 1;
        let (plane, border) = if high { (last as f64 + 0.5, last) } else { (-0.5, 0) };
        let away = if high { 1.0 } else { -1.0 };
        let step_mm = self.volume.lps_from_voxel.matrix3.col(axis).length();
        let end = plane + away * self.volume.beyond_face_mm(axis) / step_mm;
        let is_beyond = |t: f64| {
            let x = origin[axis] + direction[axis] * t;
            away * (x - plane) > 0.0 && away * (x - end) <= 0.0
        };
        let mut depths = vec![0.0, end_mm];
        depths.extend([plane, end].map(|place| (place - origin[axis]) / direction[axis]));
        for other in (0..3).filter(|other| *other != axis) {
            let end = self.volume.size[other] as f64 - 0.5;
            let centres = (0..self.volume.size[other]).map(|n| n as f64);
            let places = centres.chain([-0.5, end]).map(|place| (place - origin[other]) / direction[other]);
            depths.extend(places);
        }
        depths.retain(|depth| (0.0..=end_mm).contains(depth));
        depths.sort_unstable_by(f64::total_cmp);
        let inside =
            |point: DVec3| (0..3).all(|n| n == axis || (point[n] >= -0.5 && point[n] <= self.volume.size[n] as f64 - 0.5));
        let piece = |pair: &[f64]| {
            let middle = 0.5 * (pair[0] + pair[1]);
            let point = origin + direction * middle;
            let between = |n: usize| match n == axis {
                true => [border; 2],
                false => self.neighbours(n, point[n], direction[n] == 0.0),
            };
            (is_beyond(middle) && inside(point)).then(|| Piece {
                from: pair[0],
                to: pair[1],
                between: std::array::from_fn(between),
            })
        };
        depths.windows(2).filter(|pair| pair[1] - pair[0] > TOUCH_MM).filter_map(piece).collect()
    }

    fn in_voxels(&self, ray: &Ray) -> (DVec3, DVec3) {
        (self.voxel_from_lps.transform_point3(ray.origin), self.voxel_from_lps.transform_vector3(ray.direction))
    }

    /// Depths at which the ray enters and leaves [−½, n−½] (unclipped).
    fn domain(&self, origin: DVec3, direction: DVec3) -> Option<[f64; 2]> {
        let mut range = [f64::NEG_INFINITY, f64::INFINITY];
        for axis in 0..3 {
            let (o, d, high) = (origin[axis], direction[axis], self.volume.size[axis] as f64 - 0.5);
            if d == 0.0 {
                if !(o >= -0.5 && o <= high) {
                    return None;
                }
                continue;
            }
            let (a, b) = ((-0.5 - o) / d, (high - o) / d);
            range = [range[0].max(a.min(b)), range[1].min(a.max(b))];
        }
        (range[0] < range[1]).then_some(range)
    }

    /// Every stretch between planes through voxel centres (or faces) and the outer faces, from the source to `end_mm`.
    fn pieces(&self, origin: DVec3, direction: DVec3, end_mm: f64) -> Vec<Piece> {
        let Some([enters, leaves]) = self.domain(origin, direction) else { return Vec::new() };
        let (from, to) = (enters.max(0.0), leaves.min(end_mm));
        if !(from < to) {
            return Vec::new();
        }
        let mut depths = vec![from, to];
        for axis in 0..3 {
            let (o, d) = (origin[axis], direction[axis]);
            if d != 0.0 {
                let first = if self.voxels == Voxels::Trilinear { 0.0 } else { 0.5 };
                let depth_of = |plane: usize| (plane as f64 + first - o) / d;
                depths.extend((0..self.volume.size[axis]).map(depth_of).filter(|depth| *depth > from && *depth < to));
            }
        }
        depths.sort_unstable_by(f64::total_cmp);
        let piece = |pair: &[f64]| {
            let middle = origin + direction * (0.5 * (pair[0] + pair[1]));
            let between = std::array::from_fn(|axis| self.neighbours(axis, middle[axis], direction[axis] == 0.0));
            Piece { from: pair[0], to: pair[1], between }
        };
        depths.windows(2).filter(|pair| pair[0] < pair[1]).map(piece).collect()
    }

    /// Voxels whose values the field interpolates at coordinate `x` of `axis`.
    fn neighbours(&self, axis: usize, x: f64, parallel: bool) -> [usize; 2] {
        let last = self.volume.size[axis] - 1;
        if self.voxels == Voxels::PiecewiseConstant {
            // A cast saturates at 0; rounding may put a point of the last voxel on its far face.
            let own = ((x + 0.5).floor() as usize).min(last);
            return [own, own];
        }
        if !(x > 0.0) {
            return [0, 0];
        }
        if x >= last as f64 {
            return [last, last];
        }
        let low = x as usize;
        // On a plane of centres, and staying there, the next plane has no weight.
        if parallel && x == low as f64 { [low, low] } else { [low, low + 1] }
    }

    fn part(&self, piece: &Piece) -> Option<Part> {
        let mut found = None;
        for [i, j, k] in corners(piece) {
            let index = self.volume.index(i, j, k);
            let class = usize::from(self.volume.class[index]);
            if class == 0 || !(self.volume.density_g_per_cm3[index] > 0.0) {
                continue;
            }
            if !self.classes[class - 1].1 {
                return Some(Part::Matter);
            }
            found = Some(Part::Air);
        }
        found
    }

    /// Along the ray each of the three weights is linear, so the field is a cubic in depth: two-point Gauss–Legendre is exact.
    fn integrate_cubic(&self, piece: &Piece, origin: DVec3, direction: DVec3, [from, to]: [f64; 2], sums: &mut [f64]) {
        let (middle, half) = (0.5 * (from + to), 0.5 * (to - from));
        for node in [-1.0, 1.0] {
            let point = origin + direction * (middle + node * half / 3f64.sqrt());
            let weights: [[f64; 2]; 3] = std::array::from_fn(|axis| {
                let [low, high] = piece.between[axis];
                let upper = if low == high { 0.0 } else { (point[axis] - low as f64).clamp(0.0, 1.0) };
                [1.0 - upper, upper]
            });
            for bits in 0..8usize {
                let side = [bits & 1, bits >> 1 & 1, bits >> 2];
                let weight = weights[0][side[0]] * weights[1][side[1]] * weights[2][side[2]];
                if weight == 0.0 {
                    continue;
                }
                let [i, j, k] = std::array::from_fn(|axis| piece.between[axis][side[axis]]);
                let index = self.volume.index(i, j, k);
                let class = usize::from(self.volume.class[index]);
                if class > 0 {
                    sums[self.classes[class - 1].0] += half * weight * f64::from(self.volume.density_g_per_cm3[index]);
                }
            }
        }
    }
}

/// The distinct voxels around a piece.
fn corners(piece: &Piece) -> impl Iterator<Item = [usize; 3]> {
    let [x, y, z] = piece.between;
    let sides = |[low, high]: [usize; 2]| if low == high { 1 } else { 2 };
    let count = [sides(x), sides(y), sides(z)];
    (0..count[0] * count[1] * count[2])
        .map(move |index| [x[index % count[0]], y[index / count[0] % count[1]], z[index / (count[0] * count[1])]])
}
