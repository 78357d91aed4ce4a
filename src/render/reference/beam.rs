//! Area densities to what the detector sees, every energy bin by itself (DESIGN §6).

use glam::{DVec2, DVec3};

use super::tube::left_of;
use crate::geometry::View;
use crate::render::RenderError;
use crate::scene::model::{Formation, Response, Scene};
use crate::scene::optics::BeamShape;

/// One energy bin.
struct Bin {
    /// φ, Σφ = 1.
    fraction: f64,
    energy_kev: f64,
    /// r: E for energy, 1 for counting, times the scintillator's absorption.
    response: f64,
    /// μ/ρ by scene material; κ for all in a naive scene.
    cm2_per_g: Vec<f64>,
}

/// The beam and what the scene's materials do to it.
pub(super) struct Beam {
    bins: Vec<Bin>,
    shape: BeamShape,
    /// Share of primary photons that the grid lets pass.
    grid: f64,
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
            let mut response = match scene.detector.response {
                Response::Energy => bin.energy_kev,
                Response::Counting => 1.0,
            };
            if let Some(layer) = &scene.detector.panel.scintillator {
                let mu_per_mm = 0.1 * layer.density_g_per_cm3 * layer.material.attenuation(bin.energy_kev)?.total_cm2_per_g;
                response *= 1.0 - (-mu_per_mm * layer.thickness_mm).exp();
            }
            bins.push(Bin { fraction: bin.fluence / total, energy_kev: bin.energy_kev, response, cm2_per_g });
        }
        if scene.model.formation == Formation::Naive {
            // Eq. 8: κ = mean over the materials of Σ φ (μ/ρ); with every bin attenuated alike the sums below collapse to exp(−κ Σ L̃).
            let of_material = |m: usize| bins.iter().map(|bin| bin.fraction * bin.cm2_per_g[m]).sum::<f64>();
            let count = scene.materials.len();
            let kappa = (0..count).map(of_material).sum::<f64>() / count.max(1) as f64;
            bins.iter_mut().for_each(|bin| bin.cm2_per_g.fill(kappa));
        }
        let detector = &scene.detector;
        Ok(Self {
            bins,
            shape: scene.beam.shape.clone(),
            grid: detector.panel.grid.map_or(1.0, |grid| grid.primary_transmission),
            photons_per_pixel: scene.beam.photons_per_pixel,
            gain: detector.gain,
            offset: detector.offset,
        })
    }

    /// −ln(Σ φ r T / Σ φ r) where the spectrum is that of the principal ray without bow-tie, by log-sum-exp: no floor.
    pub(super) fn line_integral(&self, areas_g_per_cm2: &[f64]) -> f64 {
        self.line_integral_of(areas_g_per_cm2, &vec![1.0; self.bins.len()])
    }

    /// −ln(Σ φ r b T / Σ φ r b) in pixel (u, v), b what heel and bow-tie leave there; +∞ where that is nothing.
    ///
    /// # Errors
    /// When attenuation is not tabulated.
    pub(super) fn line_integral_at(&self, areas_g_per_cm2: &[f64], view: &View, pixel: [f64; 2]) -> Result<f64, RenderError> {
        if !self.shape.varies() {
            return Ok(self.line_integral(areas_g_per_cm2));
        }
        let left = self.left(view.intrinsics.unproject(DVec2::from_array(pixel)))?;
        if left.iter().all(|left| *left == 0.0) {
            return Ok(f64::INFINITY);
        }
        Ok(self.line_integral_of(areas_g_per_cm2, &left))
    }

    fn left(&self, ray: DVec3) -> Result<Vec<f64>, RenderError> {
        let energies_kev: Vec<f64> = self.bins.iter().map(|bin| bin.energy_kev).collect();
        left_of(&self.shape, &energies_kev, ray)
    }

    fn line_integral_of(&self, areas_g_per_cm2: &[f64], left: &[f64]) -> f64 {
        let depth = |bin: &Bin| bin.cm2_per_g.iter().zip(areas_g_per_cm2).map(|(mu, area)| mu * area).sum::<f64>();
        let weight = |bin: &Bin, left: &f64| bin.fraction * bin.response * left;
        let with_left = || self.bins.iter().zip(left);
        // The least depth is that among energies of which anything is left.
        let least = with_left().filter(|(_, left)| **left > 0.0).map(|(bin, _)| depth(bin)).fold(f64::INFINITY, f64::min);
        let sum: f64 = with_left().map(|(bin, left)| weight(bin, left) * (least - depth(bin)).min(0.0).exp()).sum();
        let air: f64 = with_left().map(|(bin, left)| weight(bin, left)).sum();
        least - (sum / air).ln()
    }

    /// Σ φ r b T / Σ φ r b in pixel (u, v): 1 in air, 0 where the heel lets nothing pass.
    ///
    /// # Errors
    /// When attenuation is not tabulated.
    pub(super) fn intensity_at(&self, areas_g_per_cm2: &[f64], view: &View, pixel: [f64; 2]) -> Result<f64, RenderError> {
        let line = self.line_integral_at(areas_g_per_cm2, view, pixel)?;
        let empty = areas_g_per_cm2.iter().all(|area| *area == 0.0);
        Ok(if empty && line.is_finite() { 1.0 } else { (-line).exp() })
    }

    /// gain · N₀(u) Σ φ r b T / Σ φ b(0) + offset in pixel (u, v) at distance d: N₀(u) = N₀ (SDD/d)³, times what the grid lets pass; 0 is
    /// the principal ray.
    ///
    /// # Errors
    /// When attenuation is not tabulated.
    pub(super) fn counts_at(&self, areas_g_per_cm2: &[f64], view: &View, pixel: [f64; 2]) -> Result<f64, RenderError> {
        let ray = view.intrinsics.unproject(DVec2::from_array(pixel));
        let (here, principal) = (self.left(ray)?, self.left(DVec3::Z)?);
        let air: f64 = self.bins.iter().zip(&here).map(|(bin, left)| bin.fraction * bin.response * left).sum();
        let photons: f64 = self.bins.iter().zip(&principal).map(|(bin, left)| bin.fraction * left).sum();
        let flood = self.photons_per_pixel * self.grid * ray.length().powi(-3) * air / photons;
        Ok(self.gain * flood * self.intensity_at(areas_g_per_cm2, view, pixel)? + self.offset)
    }
}
