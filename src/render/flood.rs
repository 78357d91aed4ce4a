//! What arrives in each pixel with no object in the beam: obliquity, heel, bow-tie, collimation, scintillator and grid.
//!
//! With b_k(u) the share of energy k that heel and bow-tie leave in pixel u, T_k(u) that of the object:
//! `intensity(u) = open(u) · Σ φ r b T / Σ φ r b`, so that heel and bow-tie cancel in air and collimation does not;
//! `N(u) = N₀ · (SDD/d)³ · Σ φ b T / Σ φ b(0)` with 0 the principal ray. φ are shares of the photons that the panel detects.

use glam::{DVec2, DVec3};
use rayon::prelude::*;

use super::RenderError;
use super::cpu::attenuate_spectrum::{Arriving, Signal, exp_of_negative};
use super::cpu::integrate_density::Density;
use super::heel_table::HeelTable;
use super::plan_parts::{Node, response};
pub use super::spectrum::detected_bins;
use super::spectrum::{Bins, LANES};
use crate::geometry::View;
use crate::scene::model::{Formation, Scene};
use crate::scene::optics::BowTie;

/// Pixels are sampled this often along each side where the edge of the field crosses them.
const SAMPLES: i32 = 8;

/// A core takes at least so many pixels at a time where all energies are summed.
const FEWEST_PX: usize = 128;

/// What the heel leaves of the photons is none at all below this share.
const DARK: f32 = 1e-12;

/// The beam with no object in it, by pixel.
#[derive(Clone, Debug, Default)]
pub struct Flood {
    /// Detected photons on the principal ray.
    pub photons_per_pixel: f64,
    /// Detected photons of a fully open pixel over those on the principal ray; empty where nobody asked.
    pub photons: Vec<f32>,
    /// Their mean response (keV or 1); empty where it is the same in every pixel.
    responses: Vec<f32>,
    /// Mean response on the principal ray.
    pub principal_response: f64,
    /// Share of the pixel that collimator and heel leave open; empty where all is open.
    pub open: Vec<f32>,
    /// Pixels whose take-off angle lies outside the tungsten tables.
    pub extrapolated: usize,
}

impl Flood {
    /// Mean response of the photons that `pixel` detects with no object in the beam, keV or 1.
    #[must_use]
    pub fn response(&self, pixel: usize) -> f64 {
        self.responses.get(pixel).map_or(self.principal_response, |response| f64::from(*response))
    }

    /// Signal of a fully open pixel with no object in the beam, over that on the principal ray.
    #[must_use]
    pub fn relative_signal(&self, pixel: usize) -> f64 {
        f64::from(self.photons[pixel]) * self.response(pixel) / self.principal_response
    }

    /// Puts every map on another raster.
    pub(super) fn resample(&mut self, onto: impl Fn(&[f32]) -> Vec<f32>) {
        for map in [&mut self.photons, &mut self.responses, &mut self.open] {
            if !map.is_empty() {
                *map = onto(map);
            }
        }
    }

    /// Makes `pixel` brighter by `factor`.
    pub(super) fn brighten(&mut self, pixel: usize, factor: f64) {
        self.photons[pixel] = (f64::from(self.photons[pixel]) * factor) as f32;
    }

    /// Share of `pixel` that is open.
    #[must_use]
    pub fn open(&self, pixel: usize) -> f64 {
        self.open.get(pixel).map_or(1.0, |open| f64::from(*open))
    }
}

/// Whether the shaders' own N₀(u) (obliquity alone) is right for this scene.
#[must_use]
pub fn is_plain(scene: &Scene) -> bool {
    let (shape, panel) = (&scene.beam.shape, &scene.detector.panel);
    !shape.varies()
        && shape.field.is_none()
        && shape.focal_spot_mm == [0.0; 2]
        && panel.scintillator.is_none()
        && panel.grid.is_none()
        && panel.intensifier.is_none()
}

/// Whether heel or bow-tie change the spectrum from pixel to pixel, so that [`attenuate`] says what arrives.
#[must_use]
pub fn shapes_spectrum(scene: &Scene) -> bool {
    scene.beam.shape.varies() && scene.model.formation == Formation::Deepdrr
}

/// Weights by energy of the detected photons, and what heel and bow-tie do to them.
pub struct Weights<'a> {
    padded: usize,
    photons: Vec<f32>,
    signal: Vec<f32>,
    squares: Vec<f32>,
    bowtie: Option<(&'a BowTie, Vec<f32>)>,
    heel: Option<HeelTable>,
}

/// Σ over the energies, up to exp(−least).
struct Sums {
    least: f32,
    photons: f32,
    signal: f32,
    squares: f32,
}

/// Scratch of one thread.
struct Scratch {
    heel: Vec<f32>,
    bowtie: Vec<f32>,
    depth: Vec<f32>,
}

impl<'a> Weights<'a> {
    /// Tabulates heel, bow-tie and panel at the plan's energies.
    ///
    /// # Errors
    /// When an energy is outside the tables.
    pub fn new(scene: &'a Scene, nodes: &[Node], bins: &Bins) -> Result<Self, RenderError> {
        let padded = nodes.len().div_ceil(LANES) * LANES;
        let [photons, signal, squares] = match scene.model.formation {
            Formation::Deepdrr => {
                let mean = bins.mean_response as f32;
                let signal = bins.signal_weight.iter().map(|weight| weight * mean).collect();
                [bins.photon_weight.clone(), signal, bins.square_weight.clone()]
            }
            Formation::Naive => {
                let mut columns = [vec![0.0; padded], vec![0.0; padded], vec![0.0; padded]];
                for (k, node) in nodes.iter().enumerate() {
                    let absorbed = match &scene.detector.panel.scintillator {
                        Some(scintillator) => scintillator.absorption(node.energy_kev)?,
                        None => 1.0,
                    };
                    for (power, column) in (0..).zip(&mut columns) {
                        column[k] = (node.fraction * absorbed * response(scene, node).powi(power)) as f32;
                    }
                }
                columns
            }
        };
        let bowtie = match &scene.beam.shape.bowtie {
            Some(bowtie) => {
                let mut table = Vec::with_capacity(padded);
                for node in nodes {
                    table.push(bowtie.material.attenuation(node.energy_kev)?.total_cm2_per_g as f32);
                }
                // Padding has no weight, and must not become the smallest depth.
                table.resize(padded, table.last().copied().unwrap_or(0.0));
                Some((bowtie, table))
            }
            None => None,
        };
        let heel = scene.beam.shape.heel.map(|heel| HeelTable::new(heel, nodes, padded)).transpose()?;
        Ok(Self { padded, photons, signal, squares, bowtie, heel })
    }

    fn scratch(&self) -> Scratch {
        let row = vec![0.0f32; self.padded];
        Scratch { heel: vec![1.0; self.padded], bowtie: row.clone(), depth: row }
    }

    /// Fills heel factors and bow-tie depths for a ray of the camera; false where the heel lets nothing out.
    fn shape(&self, ray: DVec3, scratch: &mut Scratch) -> bool {
        if let Some((bowtie, table)) = &self.bowtie {
            let area = bowtie.area_density(ray) as f32;
            scratch.bowtie.iter_mut().zip(table).for_each(|(depth, mu)| *depth = mu * area);
        }
        self.heel.as_ref().is_none_or(|table| table.fill(ray, &mut scratch.heel))
    }

    /// Sums behind the bow-tie and further depths.
    fn sums(&self, scratch: &Scratch, depth: &[f32]) -> Sums {
        let mut least = [f32::INFINITY; LANES];
        for lanes in depth.chunks_exact(LANES) {
            least.iter_mut().zip(lanes).for_each(|(least, depth)| *least = if depth < least { *depth } else { *least });
        }
        let least = least.into_iter().fold(f32::INFINITY, f32::min);
        let columns = self.photons.chunks_exact(LANES).zip(self.signal.chunks_exact(LANES)).zip(self.squares.chunks_exact(LANES));
        let passing = scratch.heel.chunks_exact(LANES).zip(depth.chunks_exact(LANES));
        let mut lanes = [[0.0f32; LANES]; 3];
        for (((photons, signal), squares), (heel, depth)) in columns.zip(passing) {
            for lane in 0..LANES {
                let passed = heel[lane] * exp_of_negative(least - depth[lane]);
                lanes[0][lane] += photons[lane] * passed;
                lanes[1][lane] += signal[lane] * passed;
                lanes[2][lane] += squares[lane] * passed;
            }
        }
        let [photons, signal, squares] = lanes.map(|lanes| lanes.iter().sum());
        Sums { least, photons, signal, squares }
    }
}

fn ray_of(view: &View, pixel: usize) -> DVec3 {
    let width = view.size_px[0] as usize;
    view.intrinsics.unproject(DVec2::new((pixel % width) as f64, (pixel / width) as f64))
}

/// Photons per area of a flat detector along a ray with depth 1, relative to the principal ray: 1 / r² for the distance and 1 / r for
/// the slant.
fn fall_off(ray: DVec3) -> f32 {
    let square = ray.length_squared();
    (1.0 / (square * square.sqrt())) as f32
}

/// The beam of `scene` with no object in it; `photons` asks for N₀(u), which noise and counts need.
///
/// # Errors
/// When an energy is outside the tables.
pub fn flood(scene: &Scene, view: &View, weights: &Weights, photons: bool) -> Result<Flood, RenderError> {
    let pixels = view.size_px.iter().map(|n| *n as usize).product::<usize>();
    let mut scratch = weights.scratch();
    let lit = weights.shape(DVec3::Z, &mut scratch);
    let principal = weights.sums(&scratch, &scratch.bowtie);
    if !(lit && principal.photons > 0.0) {
        return Err(RenderError::NoPhotons);
    }
    let detected = scene.beam.photons_per_pixel * detected_share(scene)?;
    let principal_response = f64::from(principal.signal) / f64::from(principal.photons);
    let mut flood = Flood { photons_per_pixel: detected, principal_response, ..Flood::default() };
    let shape = &scene.beam.shape;
    if !(photons || shape.heel.is_some() || shape.field.is_some()) {
        return Ok(flood);
    }
    if !shape.varies() && shape.field.is_none() {
        flood.photons =
            (0..pixels).into_par_iter().with_min_len(super::blur::FEWEST_PX).map(|pixel| fall_off(ray_of(view, pixel))).collect();
        return Ok(flood);
    }
    struct Pixel {
        photons: f32,
        response: f32,
        open: f32,
        outside: bool,
    }
    let pixel = |scratch: &mut Scratch, pixel: usize| {
        let ray = ray_of(view, pixel);
        let obliquity = fall_off(ray);
        let open = shape.field.as_ref().map_or(1.0, |_| open_share(scene, view, pixel));
        let dark = Pixel { photons: obliquity, response: principal_response as f32, open: 0.0, outside: false };
        if !shape.varies() {
            return Pixel { open, ..dark };
        }
        let outside = weights.heel.as_ref().is_some_and(|table| table.is_beyond(ray));
        if !weights.shape(ray, scratch) {
            return Pixel { outside, ..dark };
        }
        let sums = weights.sums(scratch, &scratch.bowtie);
        let photons = obliquity * sums.photons / principal.photons * (principal.least - sums.least).exp();
        if !(sums.photons > DARK) {
            return Pixel { outside, ..dark };
        }
        Pixel { photons: photons.max(f32::MIN_POSITIVE), response: sums.signal / sums.photons, open, outside }
    };
    let found: Vec<Pixel> = (0..pixels)
        .into_par_iter()
        .with_min_len(FEWEST_PX)
        .map_init(|| weights.scratch(), |scratch, index| pixel(scratch, index))
        .collect();
    flood.photons = found.iter().map(|pixel| pixel.photons).collect();
    flood.extrapolated = found.iter().filter(|pixel| pixel.outside).count();
    if shape.varies() {
        flood.responses = found.iter().map(|pixel| pixel.response).collect();
    }
    if found.iter().any(|pixel| pixel.open < 1.0) {
        flood.open = found.iter().map(|pixel| pixel.open).collect();
    }
    Ok(flood)
}

/// Share of the photons on the principal ray that grid and scintillator leave to be detected.
fn detected_share(scene: &Scene) -> Result<f64, RenderError> {
    let grid = scene.detector.panel.grid.map_or(1.0, |grid| grid.primary_transmission);
    let Some(scintillator) = &scene.detector.panel.scintillator else { return Ok(grid) };
    let (mut arriving, mut absorbed) = (0.0, 0.0);
    for bin in scene.beam.spectrum.bins.iter().filter(|bin| bin.fluence > 0.0) {
        let depth = match &scene.beam.shape.bowtie {
            Some(bowtie) => bowtie.material.attenuation(bin.energy_kev)?.total_cm2_per_g * bowtie.area_density(DVec3::Z),
            None => 0.0,
        };
        let photons = bin.fluence * (-depth).exp();
        arriving += photons;
        absorbed += photons * scintillator.absorption(bin.energy_kev)?;
    }
    if arriving > 0.0 { Ok(grid * absorbed / arriving) } else { Err(RenderError::NoPhotons) }
}

/// Share of a pixel inside the field: one sample where its neighbourhood is all in or all out, a grid of samples at the edge.
fn open_share(scene: &Scene, view: &View, pixel: usize) -> f32 {
    let Some(field) = &scene.beam.shape.field else { return 1.0 };
    let sdd_mm = view.intrinsics.source_to_detector_mm(scene.detector.pitch_mm);
    let width = view.size_px[0] as usize;
    let centre = DVec2::new((pixel % width) as f64, (pixel / width) as f64);
    let inside = |offset: DVec2| field.contains(view.intrinsics.unproject(centre + offset).truncate() * sdd_mm);
    let corners = [(-0.5, -0.5), (0.5, -0.5), (-0.5, 0.5), (0.5, 0.5), (0.0, 0.0)].map(|(x, y)| inside(DVec2::new(x, y)));
    if corners.iter().all(|inside| *inside == corners[0]) {
        return if corners[0] { 1.0 } else { 0.0 };
    }
    let at = |i: i32| (f64::from(i) + 0.5) / f64::from(SAMPLES) - 0.5;
    let samples = (0..SAMPLES).flat_map(|row| (0..SAMPLES).map(move |column| DVec2::new(at(column), at(row))));
    samples.filter(|offset| inside(*offset)).count() as f32 / (SAMPLES * SAMPLES) as f32
}

/// Attenuates every pixel behind heel and bow-tie; `moments` asks for what noise needs. Of [`Arriving`], photons are counted in units of
/// those that arrive in the same pixel with no object in the beam.
#[must_use]
pub fn attenuate(view: &View, density: &Density, bins: &Bins, weights: &Weights, moments: bool) -> Signal {
    let materials = density.material_count;
    let pixel = |scratch: &mut Scratch, pixel: usize| {
        let nothing = Arriving { photon_fraction: 0.0, mean_response: 1.0, mean_square_response: 1.0 };
        if !weights.shape(ray_of(view, pixel), scratch) {
            return (0.0, nothing);
        }
        let air = weights.sums(scratch, &scratch.bowtie);
        if !(air.photons > DARK) {
            return (0.0, nothing);
        }
        let moments_of = |sums: &Sums, photon_fraction: f32| Arriving {
            photon_fraction,
            mean_response: sums.signal / sums.photons,
            mean_square_response: sums.squares / sums.photons,
        };
        let paths = &density.g_per_cm2[pixel * materials..(pixel + 1) * materials];
        if paths.iter().all(|path| *path == 0.0) {
            return (0.0, moments_of(&air, 1.0));
        }
        let mut depth = std::mem::take(&mut scratch.depth);
        depth.copy_from_slice(&scratch.bowtie);
        for (path, attenuation) in paths.iter().zip(bins.cm2_per_g.chunks_exact(bins.padded)) {
            depth.iter_mut().zip(attenuation).for_each(|(depth, mu)| *depth += mu * path);
        }
        let seen = weights.sums(scratch, &depth);
        scratch.depth = depth;
        let change = seen.least - air.least;
        (change - (seen.signal / air.signal).ln(), moments_of(&seen, seen.photons / air.photons * (-change).exp()))
    };
    let (line_integral, arriving): (Vec<f32>, Vec<Arriving>) = (0..density.valid.len())
        .into_par_iter()
        .with_min_len(FEWEST_PX)
        .map_init(|| weights.scratch(), |scratch, index| pixel(scratch, index))
        .unzip();
    Signal { line_integral, arriving: if moments { arriving } else { Vec::new() } }
}
