//! The specimen as closed-form shapes, and the intervals in which a ray is inside each of them; the last shape wins.

use serde::Deserialize;

use crate::MockError;
use crate::kinematics::{BODY_RADII_MM, DRILL_LENGTH_MM, DRILL_RADIUS_MM, SHAFT_RADIUS_MM};
use crate::lab::parse;
use crate::matrix::{Mat4, Vec3, along, direction, dot, frame_along, inverse, mul, point, sub, translation};

/// `phantom.json`.
#[derive(Clone, Debug, Deserialize)]
pub struct Phantom {
    /// Tissue, in order.
    pub shapes: Vec<TissueShape>,
    /// Beads.
    pub beads: Vec<Bead>,
    /// Radius of every bead.
    pub bead_radius_mm: f64,
    /// Anatomical points at which errors are stated.
    pub landmarks: Vec<Bead>,
    /// Grid of the CT.
    pub ct: CtGrid,
    /// Where the robot's base stands.
    pub lps_from_base: Mat4,
    /// Knots of the curve from HU to g/cm³.
    pub hu_to_density: Vec<[f64; 2]>,
    /// HU of bone.
    pub bone_above_hu: f64,
    /// HU of air.
    pub air_below_hu: f64,
    /// Nominal densities.
    pub density_g_per_cm3: Metals,
}

/// Densities of the metals.
#[derive(Clone, Copy, Debug, Deserialize)]
pub struct Metals {
    /// g/cm³.
    pub nitinol: f64,
    /// g/cm³.
    pub steel_316l: f64,
}

/// A named point.
#[derive(Clone, Debug, Deserialize)]
pub struct Bead {
    /// Label.
    pub name: String,
    /// Where.
    pub lps_mm: Vec3,
}

/// The CT's grid, centred on the origin.
#[derive(Clone, Copy, Debug, Deserialize)]
pub struct CtGrid {
    /// Voxel size.
    pub spacing_mm: Vec3,
    /// Half the size of the grid.
    pub half_extent_mm: Vec3,
}

/// A shape of `phantom.json`.
#[derive(Clone, Debug, Deserialize)]
pub struct TissueShape {
    /// For people.
    pub name: String,
    /// An ellipsoid along the axes …
    pub ellipsoid: Option<Ellipsoid>,
    /// … or a rod.
    pub cylinder: Option<Cylinder>,
    /// What a CT would show.
    pub hu: f64,
}

/// See [`TissueShape`].
#[derive(Clone, Copy, Debug, Deserialize)]
pub struct Ellipsoid {
    /// Centre.
    pub centre_lps_mm: Vec3,
    /// Half axes.
    pub semi_axes_mm: Vec3,
}

/// See [`TissueShape`].
#[derive(Clone, Copy, Debug, Deserialize)]
pub struct Cylinder {
    /// One end.
    pub from_lps_mm: Vec3,
    /// Other end.
    pub to_lps_mm: Vec3,
    /// Radius.
    pub radius_mm: f64,
}

/// Columns of `attenuation.csv`.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Matter {
    /// Nothing that attenuates.
    Air,
    /// Column 0.
    SoftTissue,
    /// Column 1.
    Bone,
    /// Column 2.
    Nitinol,
    /// Column 3.
    Steel,
}

/// A convex body, or a tube, with its matter.
#[derive(Clone, Copy, Debug)]
pub struct Body {
    /// Unit sphere scaled by `semi_axes_mm`, or a cylinder along +z.
    pub form: Form,
    local_from_lps: Mat4,
    bound_centre: Vec3,
    bound_radius_mm: f64,
    /// What it is made of.
    pub matter: Matter,
    /// Its density.
    pub density_g_per_cm3: f64,
}

/// Forms in their own frame.
#[derive(Clone, Copy, Debug)]
pub enum Form {
    /// Centre at the origin.
    Ellipsoid {
        /// Half axes.
        semi_axes_mm: Vec3,
    },
    /// From z = 0 to `length_mm`; hollow inside `inner_mm`.
    Tube {
        /// Length.
        length_mm: f64,
        /// Outer radius.
        outer_mm: f64,
        /// Inner radius, 0 for a rod.
        inner_mm: f64,
    },
}

/// At most two stretches of the ray parameter.
pub type Stretches = [Option<[f64; 2]>; 2];

impl Body {
    /// A body at `lps_from_local`.
    #[must_use]
    pub fn new(form: Form, lps_from_local: &Mat4, matter: Matter, density_g_per_cm3: f64) -> Self {
        let (centre, bound_radius_mm) = match form {
            Form::Ellipsoid { semi_axes_mm } => ([0.0; 3], semi_axes_mm.iter().fold(0.0f64, |a, b| a.max(*b))),
            Form::Tube { length_mm, outer_mm, .. } => {
                ([0.0, 0.0, 0.5 * length_mm], (0.25 * length_mm * length_mm + outer_mm * outer_mm).sqrt())
            }
        };
        let bound_centre = point(lps_from_local, centre);
        Self { form, local_from_lps: inverse(lps_from_local), bound_centre, bound_radius_mm, matter, density_g_per_cm3 }
    }

    /// Whether the line `origin + t · toward` passes the body's bounding sphere within `margin_mm`.
    #[must_use]
    pub fn is_near(&self, origin: Vec3, toward: Vec3, margin_mm: f64) -> bool {
        let to_centre = sub(self.bound_centre, origin);
        let squared_mm2 = dot(to_centre, to_centre) - dot(to_centre, toward).powi(2) / dot(toward, toward);
        squared_mm2 <= (self.bound_radius_mm + margin_mm).powi(2)
    }

    /// Where the ray `origin + t · toward` is inside.
    #[must_use]
    pub fn stretches(&self, origin: Vec3, toward: Vec3) -> Stretches {
        if !self.is_near(origin, toward, 0.0) {
            return [None, None];
        }
        let (o, d) = (point(&self.local_from_lps, origin), direction(&self.local_from_lps, toward));
        match self.form {
            Form::Ellipsoid { semi_axes_mm: s } => {
                let scale = |v: Vec3| std::array::from_fn(|i| v[i] / s[i]);
                let (o, d): (Vec3, Vec3) = (scale(o), scale(d));
                [quadratic(dot(d, d), dot(o, d), dot(o, o) - 1.0), None]
            }
            Form::Tube { length_mm, outer_mm, inner_mm } => {
                let Some(slab) = slab(o[2], d[2], length_mm) else { return [None, None] };
                let round = |r: f64| {
                    let a = d[0] * d[0] + d[1] * d[1];
                    quadratic(a, o[0] * d[0] + o[1] * d[1], o[0] * o[0] + o[1] * o[1] - r * r)
                };
                let Some(outer) = round(outer_mm).and_then(|outer| meet(outer, slab)) else { return [None, None] };
                match (inner_mm > 0.0).then(|| round(inner_mm)).flatten() {
                    None => [Some(outer), None],
                    Some([a, b]) => [meet(outer, [f64::MIN, a]), meet(outer, [b, f64::MAX])],
                }
            }
        }
    }
}

/// Roots of `a t² + 2 b t + c < 0`; everything when `a` is 0 and c < 0.
fn quadratic(a: f64, b: f64, c: f64) -> Option<[f64; 2]> {
    if a < 1e-30 {
        return (c < 0.0).then_some([f64::MIN, f64::MAX]);
    }
    let discriminant = b * b - a * c;
    if discriminant <= 0.0 {
        return None;
    }
    let root = discriminant.sqrt();
    Some([(-b - root) / a, (-b + root) / a])
}

fn slab(o: f64, d: f64, length: f64) -> Option<[f64; 2]> {
    if d.abs() < 1e-30 {
        return (o >= 0.0 && o <= length).then_some([f64::MIN, f64::MAX]);
    }
    let (a, b) = (-o / d, (length - o) / d);
    Some([a.min(b), a.max(b)])
}

fn meet(a: [f64; 2], b: [f64; 2]) -> Option<[f64; 2]> {
    let both = [a[0].max(b[0]), a[1].min(b[1])];
    (both[0] < both[1]).then_some(both)
}

impl Phantom {
    /// The embedded specimen.
    ///
    /// # Errors
    /// When the embedded data are wrong.
    pub fn embedded() -> Result<Self, MockError> {
        parse("mocks/data/phantom.json", include_str!("../data/phantom.json"))
    }

    /// Density of a voxel of `hu`.
    #[must_use]
    pub fn density_of_hu(&self, hu: f64) -> f64 {
        let knots = &self.hu_to_density;
        let above = knots.partition_point(|knot| knot[0] <= hu).clamp(1, knots.len() - 1);
        let ([x0, y0], [x1, y1]) = (knots[above - 1], knots[above]);
        y0 + (y1 - y0) * (hu.max(-1000.0) - x0) / (x1 - x0)
    }

    /// HU of a density: the inverse of [`Phantom::density_of_hu`].
    #[must_use]
    pub fn hu_of_density(&self, density: f64) -> f64 {
        let knots = &self.hu_to_density;
        let above = knots.partition_point(|knot| knot[1] <= density).clamp(1, knots.len() - 1);
        let ([x0, y0], [x1, y1]) = (knots[above - 1], knots[above]);
        x0 + (x1 - x0) * (density - y0) / (y1 - y0)
    }

    fn matter_of_hu(&self, hu: f64) -> (Matter, f64) {
        if hu < self.air_below_hu {
            (Matter::Air, 0.0)
        } else if hu <= self.bone_above_hu {
            (Matter::SoftTissue, self.density_of_hu(hu))
        } else {
            (Matter::Bone, self.density_of_hu(hu))
        }
    }

    /// The tissue, in order.
    #[must_use]
    pub fn tissue(&self) -> Vec<Body> {
        let body = |shape: &TissueShape| {
            let (matter, density) = self.matter_of_hu(shape.hu);
            if let Some(e) = shape.ellipsoid {
                let [x, y, z] = e.centre_lps_mm;
                return Some(Body::new(Form::Ellipsoid { semi_axes_mm: e.semi_axes_mm }, &translation(x, y, z), matter, density));
            }
            let rod = shape.cylinder?;
            let axis = sub(rod.to_lps_mm, rod.from_lps_mm);
            let form = Form::Tube { length_mm: dot(axis, axis).sqrt(), outer_mm: rod.radius_mm, inner_mm: 0.0 };
            Some(Body::new(form, &frame_along(rod.from_lps_mm, axis), matter, density))
        };
        self.shapes.iter().filter_map(body).collect()
    }

    /// The robot (body, core, drill) and then the beads, which are in the scene in that order.
    #[must_use]
    pub fn metal(&self, control_deg: &[f64; 5]) -> Vec<Body> {
        let (pieces, end) = crate::kinematics::pieces(control_deg);
        let metals = self.density_g_per_cm3;
        let [body_mm, lumen_mm] = BODY_RADII_MM;
        let mut out = Vec::new();
        for (outer_mm, inner_mm, matter, density) in
            [(body_mm, lumen_mm, Matter::Nitinol, metals.nitinol), (SHAFT_RADIUS_MM, 0.0, Matter::Steel, metals.steel_316l)]
        {
            for (frame, length_mm) in &pieces {
                let form = Form::Tube { length_mm: *length_mm, outer_mm, inner_mm };
                out.push(Body::new(form, &mul(&self.lps_from_base, frame), matter, density));
            }
        }
        let drill = Form::Tube { length_mm: DRILL_LENGTH_MM, outer_mm: DRILL_RADIUS_MM, inner_mm: 0.0 };
        out.push(Body::new(drill, &mul(&self.lps_from_base, &end), Matter::Steel, metals.steel_316l));
        for bead in &self.beads {
            let [x, y, z] = bead.lps_mm;
            let form = Form::Ellipsoid { semi_axes_mm: [self.bead_radius_mm; 3] };
            out.push(Body::new(form, &translation(x, y, z), Matter::Steel, metals.steel_316l));
        }
        out
    }
}

/// Area densities (g/cm²) of soft tissue, bone, nitinol and steel along the ray from `origin` through `target`; where bodies overlap
/// the last one counts. `found` is scratch space.
#[must_use]
pub fn area_densities(bodies: &[Body], origin: Vec3, target: Vec3, found: &mut Vec<(f64, f64, usize)>) -> [f64; 4] {
    let toward = sub(target, origin);
    let length_cm = dot(toward, toward).sqrt() * 0.1;
    found.clear();
    for (index, body) in bodies.iter().enumerate() {
        for [from, to] in body.stretches(origin, toward).into_iter().flatten() {
            let (from, to) = (from.max(0.0), to.min(1.0));
            if from < to {
                found.push((from, to, index));
            }
        }
    }
    let mut sums = [0.0; 4];
    if let [(from, to, index)] = found[..] {
        add(&mut sums, &bodies[index], (to - from) * length_cm);
        return sums;
    }
    let mut cuts: Vec<f64> = found.iter().flat_map(|(from, to, _)| [*from, *to]).collect();
    cuts.sort_unstable_by(f64::total_cmp);
    for pair in cuts.windows(2) {
        let middle = 0.5 * (pair[0] + pair[1]);
        let last = found.iter().filter(|(from, to, _)| *from <= middle && middle <= *to).map(|(_, _, index)| *index).max();
        if let Some(index) = last {
            add(&mut sums, &bodies[index], (pair[1] - pair[0]) * length_cm);
        }
    }
    sums
}

/// A path through a body, into the column of its matter.
fn add(sums: &mut [f64; 4], body: &Body, path_cm: f64) {
    let column = match body.matter {
        Matter::Air => return,
        Matter::SoftTissue => 0,
        Matter::Bone => 1,
        Matter::Nitinol => 2,
        Matter::Steel => 3,
    };
    sums[column] += path_cm * body.density_g_per_cm3;
}

/// The tissue density (g/cm³) at a point.
#[must_use]
pub fn tissue_density_at(tissue: &[Body], p: Vec3) -> f64 {
    let inside = |body: &&Body| {
        let up = along(p, [0.0, 0.0, 1.0], 1.0);
        body.stretches(p, sub(up, p)).into_iter().flatten().any(|[from, to]| from <= 0.0 && to >= 0.0)
    };
    tissue.iter().rev().find(inside).map_or(0.0, |body| body.density_g_per_cm3)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_sphere_has_its_chord_and_the_last_body_wins() {
        let sphere = |radius: f64, matter, density| {
            Body::new(Form::Ellipsoid { semi_axes_mm: [radius; 3] }, &translation(0.0, 0.0, 0.0), matter, density)
        };
        let bodies = [sphere(20.0, Matter::SoftTissue, 1.0), sphere(5.0, Matter::Steel, 8.0)];
        let through = |y: f64| area_densities(&bodies, [-1000.0, y, 0.0], [1000.0, y, 0.0], &mut Vec::new());
        let chord_cm = 2.0 * (400.0f64 - 144.0).sqrt() * 0.1;
        assert!((through(12.0)[0] - chord_cm).abs() < 1e-9 && through(12.0)[3] == 0.0);
        let middle = through(0.0);
        assert!((middle[0] - 3.0).abs() < 1e-9 && (middle[3] - 8.0).abs() < 1e-9, "{middle:?}");
        assert!(through(20.1).iter().all(|sum| *sum == 0.0));
    }

    #[test]
    fn hu_and_density_are_inverse() {
        let phantom = Phantom::embedded().expect("embedded");
        for hu in [-1000.0, -500.0, -40.0, 50.0, 700.0, 1500.0] {
            assert!((phantom.hu_of_density(phantom.density_of_hu(hu)) - hu).abs() < 1e-9);
        }
    }
}
