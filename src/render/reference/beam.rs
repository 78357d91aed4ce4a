//! Area densities to what the detector sees, every energy bin by itself (DESIGN §6).

use glam::DVec2;

use crate::geometry::View;
use crate::render::RenderError;
use crate::scene::model::{Formation, Response, Scene};

/// One energy bin.
struct Bin {
    /// φ, Σφ = 1.
    fraction: f64,
    /// r: E for energy, 1 for counting.
    response: f64,
    /// μ/ρ by scene material; κ for all in a naive scene.
    cm2_per_g: Vec<f64>,
}

/// The beam and what the scene's materials do to it.
pub(super) struct Beam {
    bins: Vec<Bin>,
    /// Σ φ r.
    mean_response: f64,
    photons_per_pixel: f64,
    gain: f64,
    offset: f64,
}

impl Beam {
    pub(super) fn new(scene: &Scene) -> Result<Self, RenderError> {
        let spectrum = &scene.beam.spectrum.bins;
        let total: f64 = spectrum.iter().map(|bin| bin.fluence).sum();
        if !(total > 0.0 && total.is_finite()) {
            return Err(RenderError::NoPhotons);
        }
        let mut bins = Vec::with_capacity(spectrum.len());
        for bin in spectrum.iter().filter(|bin| bin.fluence > 0.0) {
            let mut cm2_per_g = Vec::with_capacity(scene.materials.len());
            for material in &scene.materials {
                cm2_per_g.push(material.attenuation(bin.energy_kev)?.total_cm2_per_g);
            }
            let response = match scene.detector.response {
                Response::Energy => bin.energy_kev,
                Response::Counting => 1.0,
            };
            bins.push(Bin { fraction: bin.fluence / total, response, cm2_per_g });
        }
        if scene.model.formation == Formation::Naive {
            // Eq. 8: κ = mean over the materials of Σ φ (μ/ρ); with every bin attenuated alike the sums below collapse to exp(−κ Σ L̃).
            let of_material = |m: usize| bins.iter().map(|bin| bin.fraction * bin.cm2_per_g[m]).sum::<f64>();
            let count = scene.materials.len();
            let kappa = (0..count).map(of_material).sum::<f64>() / count.max(1) as f64;
            bins.iter_mut().for_each(|bin| bin.cm2_per_g.fill(kappa));
        }
        let mean_response = bins.iter().map(|bin| bin.fraction * bin.response).sum();
        let detector = &scene.detector;
        Ok(Self {
            bins,
            mean_response,
            photons_per_pixel: scene.beam.photons_per_pixel,
            gain: detector.gain,
            offset: detector.offset,
        })
    }

    /// −ln(Σ φ r T / Σ φ r), by log-sum-exp: no floor.
    pub(super) fn line_integral(&self, areas_g_per_cm2: &[f64]) -> f64 {
        let depth = |bin: &Bin| bin.cm2_per_g.iter().zip(areas_g_per_cm2).map(|(mu, area)| mu * area).sum::<f64>();
        let least = self.bins.iter().map(depth).fold(f64::INFINITY, f64::min);
        let sum: f64 = self.bins.iter().map(|bin| bin.fraction * bin.response * (least - depth(bin)).exp()).sum();
        least - (sum / self.mean_response).ln()
    }

    /// Σ φ r T / Σ φ r: 1 in air.
    pub(super) fn intensity(&self, areas_g_per_cm2: &[f64]) -> f64 {
        if areas_g_per_cm2.iter().all(|area| *area == 0.0) {
            return 1.0;
        }
        (-self.line_integral(areas_g_per_cm2)).exp()
    }

    /// gain · N₀(u) Σ φ r T + offset, N₀(u) = N₀ (SDD/d)³ for a pixel at distance d.
    pub(super) fn counts(&self, areas_g_per_cm2: &[f64], view: &View, [u, v]: [f64; 2]) -> f64 {
        let obliquity = view.intrinsics.unproject(DVec2::new(u, v)).length().powi(-3);
        let signal = self.photons_per_pixel * obliquity * self.mean_response * self.intensity(areas_g_per_cm2);
        self.gain * signal + self.offset
    }
}
