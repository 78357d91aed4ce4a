//! What tells the size of the cloud, and how well.

use glam::DVec3;
use nalgebra::DMatrix;
use serde::{Deserialize, Serialize};

use super::shot::PhantomShot;
use super::structure::Structure;
use crate::estimate::{Loss, Numeric, PoseBlock, Problem, State, VectorBlock};

/// A distance between two beads, measured otherwise.
#[derive(Clone, Debug, PartialEq)]
pub struct Distance {
    /// The beads' names, as an earlier run gave them.
    pub beads: [String; 2],
    /// Between their centres.
    pub mm: f64,
    /// Standard deviation.
    pub sigma_mm: f64,
}

/// The size of the cloud.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Scale {
    /// Standard deviation as a share: 0.01 is a millimetre in a hundred.
    pub sigma: f64,
    /// What it rests on, the surest first.
    pub sources: Vec<ScaleSource>,
}

/// Something that tells the size.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct ScaleSource {
    /// What, in words.
    pub source: String,
    /// Standard deviation of the size by this alone, as a share.
    pub sigma: f64,
    /// By how much of itself it would have the cloud larger than the cameras' places have it; absent for these.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub larger_by: Option<f64>,
}

/// Share to which radii are known whatever the number of shadows: beams harden, and blur is no Gaussian.
const RADIUS_SIGMA: f64 = 0.03;

/// Evidence of the size as the problem takes it.
#[derive(Clone, Debug, Default, PartialEq)]
pub(super) struct Measured {
    /// Two beads, mm and its standard deviation.
    pub distances: Vec<([usize; 2], f64, f64)>,
    /// Radii of shadows, if they tell anything.
    pub radii: Option<Radii>,
}

/// Radii of shadows: each tells the depth of its bead.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct Radii {
    /// Mean of ln(radius / focal length), less that of the beads' radius.
    mean: f64,
    /// Its standard deviation.
    sigma: f64,
    /// Which: bead and shot.
    of: Vec<(usize, usize)>,
}

impl Measured {
    pub fn is_empty(&self) -> bool {
        self.distances.is_empty() && self.radii.is_none()
    }

    /// The shadows' radii against beads of `radius_mm`: each tells the depth of its bead, r = f R / z.
    pub fn by_radii(shots: &[PhantomShot], structure: &Structure, radius_mm: f64) -> Self {
        let (mut logs, mut of) = (Vec::new(), Vec::new());
        for bead in 0..structure.points.len() {
            for (shot, shadow) in structure.shadows_of(bead) {
                let Some(radius_px) = shots[shot].shadows[shadow].radius_px.filter(|radius| *radius > 0.0) else { continue };
                logs.push((radius_px / (shots[shot].intrinsics.fx * radius_mm)).ln());
                of.push((bead, shot));
            }
        }
        if of.is_empty() {
            return Self::default();
        }
        let count = logs.len() as f64;
        let mean = logs.iter().sum::<f64>() / count;
        let scatter = (logs.iter().map(|log| (log - mean).powi(2)).sum::<f64>() / count).sqrt();
        let sigma = RADIUS_SIGMA.hypot(scatter / count.sqrt());
        Self { radii: Some(Radii { mean, sigma, of }), ..Self::default() }
    }

    /// Adds what was measured of beads at `points`, seen by `cameras`, shot by shot.
    pub fn add_to(&self, problem: &mut Problem<'_>, points: &[VectorBlock], cameras: &[Option<PoseBlock>]) {
        for ([a, b], mm, sigma_mm) in &self.distances {
            let (a, b) = (points[*a], points[*b]);
            let predict = move |state: &State, out: &mut [f64]| {
                out[0] = state.point(a).distance(state.point(b));
                true
            };
            let information = DMatrix::from_element(1, 1, sigma_mm.powi(-2));
            let distance = Numeric::new(problem, &[a.id(), b.id()], &[*mm], information, predict);
            problem.add(distance, Loss::None);
        }
        let Some(Radii { mean, sigma, of }) = &self.radii else { return };
        let pairs: Vec<_> = of.iter().filter_map(|(bead, shot)| Some((points[*bead], cameras[*shot]?))).collect();
        let mut ids: Vec<_> = pairs.iter().flat_map(|(point, camera)| [point.id(), camera.id()]).collect();
        ids.sort_unstable();
        ids.dedup();
        let predict = move |state: &State, out: &mut [f64]| {
            let depth = |(point, camera): &(VectorBlock, _)| state.pose(*camera).transform_point(state.point(*point)).z;
            out[0] = -pairs.iter().map(|pair| depth(pair).max(1.0).ln()).sum::<f64>() / pairs.len() as f64;
            true
        };
        let information = DMatrix::from_element(1, 1, sigma.powi(-2));
        problem.add(Numeric::new(problem, &ids, &[*mean], information, predict), Loss::None);
    }

    /// What each alone would have: its words, its standard deviation as a share, and by how much of itself larger than `structure` is.
    pub fn against(&self, structure: &Structure, names: &[String]) -> Vec<ScaleSource> {
        let mut sources = Vec::new();
        for ([a, b], mm, sigma_mm) in &self.distances {
            let found = structure.points[*a].distance(structure.points[*b]);
            sources.push(ScaleSource {
                source: format!("distance of {} and {}, {mm} ± {sigma_mm} mm", names[*a], names[*b]),
                sigma: sigma_mm / mm,
                larger_by: Some(mm / found - 1.0),
            });
        }
        if let Some(Radii { mean, sigma, of }) = &self.radii {
            let depth = |(bead, shot): &(usize, usize)| -> f64 {
                let point: DVec3 = structure.points[*bead];
                structure.cameras[*shot].map_or(1.0, |camera| camera.transform_point(point).z.max(1.0)).ln()
            };
            let found = of.iter().map(depth).sum::<f64>() / of.len().max(1) as f64;
            sources.push(ScaleSource {
                source: format!("radii of {} shadows", of.len()),
                sigma: *sigma,
                larger_by: Some((-mean - found).exp() - 1.0),
            });
        }
        sources
    }
}
