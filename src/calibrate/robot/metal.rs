//! What the robot alone would cast: paths through its rods, and their attenuation of the scene's spectrum.

use glam::DVec3;

use crate::geometry::Rigid;
use crate::scene::Scene;
use crate::scene::model::{Response, Robot, Shape, Solid};
use crate::scene::physics::PhysicsError;

/// Body, shaft and drill.
const PARTS: usize = 3;
/// Bins of the spectrum that are taken as one.
const BINS_AS_ONE: usize = 4;

/// Attenuation of the robot's metals.
pub(super) struct Metal {
    /// Share of the detected signal, and attenuation of body, shaft and drill per mm.
    bins: Vec<(f64, [f64; PARTS])>,
}

impl Metal {
    pub fn of(scene: &Scene, robot: &Robot) -> Result<Self, PhysicsError> {
        let mut bins = Vec::new();
        for some in scene.beam.spectrum.bins.chunks(BINS_AS_ONE) {
            let fluence: f64 = some.iter().map(|bin| bin.fluence).sum();
            let energy_kev = some.iter().map(|bin| bin.fluence * bin.energy_kev).sum::<f64>() / fluence;
            if !(fluence > 0.0) {
                continue;
            }
            let signal = match scene.detector.response {
                Response::Energy => fluence * energy_kev,
                Response::Counting => fluence,
            };
            let mut per_mm = [0.0; PARTS];
            for (part, out) in per_mm.iter_mut().enumerate() {
                let found = scene.materials[robot.materials[part]].attenuation(energy_kev)?;
                *out = 0.1 * found.total_cm2_per_g * robot.densities_g_per_cm3[part];
            }
            bins.push((signal, per_mm));
        }
        let total: f64 = bins.iter().map(|(signal, _)| signal).sum();
        bins.iter_mut().for_each(|(signal, _)| *signal /= total);
        Ok(Self { bins })
    }

    /// Line integral of paths in body, shaft and drill.
    pub fn nepers(&self, paths_mm: [f64; PARTS]) -> f64 {
        if paths_mm == [0.0; PARTS] {
            return 0.0;
        }
        let depth = |per_mm: &[f64; PARTS]| per_mm.iter().zip(&paths_mm).map(|(mu, mm)| mu * mm).sum::<f64>();
        -self.bins.iter().map(|(signal, per_mm)| signal * (-depth(per_mm)).exp()).sum::<f64>().ln()
    }
}

struct Rod {
    local_from_lps: Rigid,
    middle_in_lps: DVec3,
    reach_mm: f64,
    length_mm: f64,
    outer_mm: f64,
    inner_mm: f64,
    part: usize,
}

/// The robot's rods at one pose and shape.
pub(super) struct Rods(Vec<Rod>);

impl Rods {
    pub fn of(robot: &Robot, solids: &[Solid]) -> Self {
        let rod = |solid: &Solid| {
            let Shape::Cylinder { length_mm, radius_mm, inner_radius_mm } = solid.shape else { return None };
            let is_part = |part: &usize| {
                robot.materials[*part] == solid.material && robot.densities_g_per_cm3[*part] == solid.density_g_per_cm3
            };
            Some(Rod {
                local_from_lps: solid.lps_from_local.inverse(),
                middle_in_lps: solid.lps_from_local.transform_point(DVec3::new(0.0, 0.0, 0.5 * length_mm)),
                reach_mm: radius_mm.hypot(0.5 * length_mm),
                length_mm,
                outer_mm: radius_mm,
                inner_mm: inner_radius_mm,
                part: (0..PARTS).find(is_part)?,
            })
        };
        Self(solids.iter().filter_map(rod).collect())
    }

    /// Path in each part's metal along a ray; pieces of one part that overlap at a bend count once. `scratch` is overwritten.
    pub fn paths_mm(&self, origin: DVec3, direction: DVec3, scratch: &mut Vec<(usize, f64, f64)>) -> [f64; PARTS] {
        scratch.clear();
        for rod in &self.0 {
            let to_middle = rod.middle_in_lps - origin;
            let aside = to_middle - direction * to_middle.dot(direction);
            if aside.length_squared() > rod.reach_mm * rod.reach_mm {
                continue;
            }
            let (o, d) = (rod.local_from_lps.transform_point(origin), rod.local_from_lps.transform_vector(direction));
            let Some((enter, leave)) = within(o, d, rod.length_mm, rod.outer_mm) else { continue };
            match within(o, d, rod.length_mm, rod.inner_mm) {
                Some((into, out)) => scratch.extend([(rod.part, enter, into), (rod.part, out, leave)]),
                None => scratch.push((rod.part, enter, leave)),
            }
        }
        scratch.sort_by(|a, b| a.0.cmp(&b.0).then(a.1.total_cmp(&b.1)));
        let mut paths = [0.0; PARTS];
        let mut reached = (PARTS, 0.0);
        for (part, enter, leave) in scratch.iter() {
            let from = if reached.0 == *part { enter.max(reached.1) } else { *enter };
            if *leave > from {
                paths[*part] += leave - from;
                reached = (*part, *leave);
            }
        }
        paths
    }
}

/// Where a ray is inside a rod along +z from the origin.
fn within(o: DVec3, d: DVec3, length_mm: f64, radius_mm: f64) -> Option<(f64, f64)> {
    // |o + t d|² = r² across the axis: a t² + 2 b t + c = 0.
    let (a, b) = (d.x * d.x + d.y * d.y, o.x * d.x + o.y * d.y);
    let c = o.x * o.x + o.y * o.y - radius_mm * radius_mm;
    let across = if a > 1e-18 {
        let root = b * b - a * c;
        if !(root > 0.0) {
            return None;
        }
        ((-b - root.sqrt()) / a, (-b + root.sqrt()) / a)
    } else if c < 0.0 {
        (f64::NEG_INFINITY, f64::INFINITY)
    } else {
        return None;
    };
    let along = if d.z.abs() > 1e-12 {
        let (low, high) = (-o.z / d.z, (length_mm - o.z) / d.z);
        (low.min(high), low.max(high))
    } else if o.z > 0.0 && o.z < length_mm {
        (f64::NEG_INFINITY, f64::INFINITY)
    } else {
        return None;
    };
    let (enter, leave) = (across.0.max(along.0), across.1.min(along.1));
    (leave > enter).then_some((enter, leave))
}
