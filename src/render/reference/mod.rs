//! The yardstick: independent f64 code that takes the equations literally (Eq. 1, 5, 6, 8; DESIGN §5, §6), for judging the fast path.
//! It shares only tables and geometry with it.
//!
//! Along the ray from the focal spot through a pixel's centre to the detector plane (depth fx · pitch; matter beyond is not seen):
//! 1. from the last object to the first, the depths at which an object has matter (more than air) are found exactly, and what later
//!    objects cover is taken off: matter at a point is that of the last object that has any there. Lumens cover nothing.
//! 2. Kept air comes after all other matter, again the last object first.
//! 3. ρ is integrated over what is left: shapes and meshes by length, volumes by the trilinear field, a cubic in each cell, or, where the
//!    scene names them, by piecewise-constant voxels.
//! 4. Every energy bin attenuates by itself, behind what heel and bow-tie leave of it in the pixel.
//!
//! Collimation, blur, noise, saturation and digits are none of its business: they act on its result as on that of the executors.

mod beam;
mod intervals;
mod mesh;
mod shapes;
mod tube;
mod volume;

pub use intervals::Intervals;
pub use shapes::Ray;
pub use tube::left_of;

use glam::DVec2;
use rayon::prelude::*;

use self::beam::Beam;
use self::mesh::Tree;
use self::volume::{Grid, Part};
use super::{Quantity, RenderError};
use crate::geometry::View;
use crate::image::Image;
use crate::scene::model::{Matter, Mesh, Scene, Solid};

/// One thing that has matter of its own; a robot has many.
enum Thing<'a> {
    Solid(&'a Solid),
    Mesh(&'a Mesh, Tree<'a>),
    Volume(Grid<'a>),
}

/// A scene and a view, ready for rays.
pub struct Reference<'a> {
    view: &'a View,
    /// Each with the number of what it displaces others with: that of its own, or its object's where densities add up.
    things: Vec<(usize, Thing<'a>)>,
    is_air: Vec<bool>,
    end_mm: f64,
}

impl<'a> Reference<'a> {
    /// Looks at `scene` from `view`.
    ///
    /// # Errors
    /// When fx · pitch is no distance or the image has no pixels.
    pub fn new(scene: &'a Scene, view: &'a View) -> Result<Self, RenderError> {
        let end_mm = view.intrinsics.source_to_detector_mm(scene.detector.pitch_mm);
        if !(end_mm > 0.0 && end_mm.is_finite()) {
            return Err(RenderError::DetectorDistance { fx: view.intrinsics.fx, pitch_mm: scene.detector.pitch_mm });
        }
        let [width, height] = view.size_px;
        if width == 0 || height == 0 {
            return Err(RenderError::EmptyView { width, height });
        }
        let mut things = Vec::new();
        for object in &scene.objects {
            let first = things.len();
            match &object.matter {
                Matter::Solids(solids) => things.extend(solids.iter().zip(first..).map(|(s, own)| (own, Thing::Solid(s)))),
                Matter::Mesh(mesh) => things.push((first, Thing::Mesh(mesh, Tree::new(mesh)))),
                Matter::Volume(_) | Matter::Parts(_) => {
                    things.extend(object.matter.volumes().iter().map(|part| (first, Thing::Volume(Grid::new(part, scene)))));
                }
            }
        }
        let is_air = (0..scene.materials.len()).map(|material| scene.is_air(material)).collect();
        Ok(Self { view, things, is_air, end_mm })
    }

    /// The ray through continuous pixel (u, v).
    #[must_use]
    pub fn ray(&self, [u, v]: [f64; 2]) -> Ray {
        Ray { origin: self.view.source_in_lps(), direction: self.view.ray_in_lps(DVec2::new(u, v)), end_mm: self.end_mm }
    }

    /// ∫ρ ds along the ray through pixel (u, v), g/cm² by scene material.
    #[must_use]
    pub fn area_densities(&self, pixel: [f64; 2]) -> Vec<f64> {
        let ray = self.ray(pixel);
        let mut sums = vec![0.0; self.is_air.len()];
        let mut taken = Intervals::default();
        for part in [Part::Matter, Part::Air] {
            let (mut pending, mut present) = (Intervals::default(), usize::MAX);
            for (own, thing) in self.things.iter().rev() {
                if *own != present {
                    taken = taken.union(&pending);
                    (pending, present) = (Intervals::default(), *own);
                }
                let covered = self.covered(thing, &ray, part);
                if covered.is_empty() {
                    continue;
                }
                let free = covered.without(&taken);
                match thing {
                    Thing::Solid(solid) => sums[solid.material] += solid.density_g_per_cm3 * free.length(),
                    Thing::Mesh(mesh, _) => sums[mesh.material] += mesh.density_g_per_cm3 * free.length(),
                    Thing::Volume(grid) => grid.integrate(&ray, part, &free, &mut sums),
                }
                pending = pending.union(&covered);
            }
            taken = taken.union(&pending);
        }
        // Depth to path length, and mm to cm.
        let cm_per_mm_of_depth = 0.1 * ray.direction.length();
        sums.iter_mut().for_each(|sum| *sum *= cm_per_mm_of_depth);
        sums
    }

    fn covered(&self, thing: &Thing, ray: &Ray, part: Part) -> Intervals {
        let wanted = |material: usize, density: f64| density > 0.0 && self.is_air[material] == (part == Part::Air);
        match thing {
            Thing::Solid(solid) if wanted(solid.material, solid.density_g_per_cm3) => shapes::inside(solid, ray),
            Thing::Mesh(mesh, tree) if wanted(mesh.material, mesh.density_g_per_cm3) => tree.inside(ray),
            Thing::Volume(grid) if part == Part::Matter || grid.keeps_air() => grid.covered(ray, part),
            _ => Intervals::default(),
        }
    }

    /// Whether all matter along the ray through pixel (u, v) was scanned: false when it enters or leaves a CT through a border voxel that is
    /// not air, or passes a cell in which matter meets padding.
    #[must_use]
    pub fn is_valid(&self, pixel: [f64; 2]) -> bool {
        let ray = self.ray(pixel);
        self.things.iter().all(|(_, thing)| match thing {
            Thing::Volume(grid) => grid.is_complete(&ray),
            _ => true,
        })
    }
}

/// ∫ρ ds along the ray through pixel (u, v), g/cm² by scene material.
///
/// # Errors
/// When fx · pitch is no distance or the image has no pixels.
pub fn area_densities(scene: &Scene, view: &View, pixel: [f64; 2]) -> Result<Vec<f64>, RenderError> {
    Ok(Reference::new(scene, view)?.area_densities(pixel))
}

/// Renders every pixel, noise-free, without collimation, blur or digits, in f64: one page, or one per scene material for [`Quantity::AreaDensity`].
///
/// # Errors
/// When fx · pitch is no distance, the image has no pixels, or attenuation is not tabulated.
pub fn render(scene: &Scene, view: &View, quantity: Quantity) -> Result<Vec<Image<f64>>, RenderError> {
    let reference = Reference::new(scene, view)?;
    let [width, height] = view.size_px.map(|n| n as usize);
    let pixel = |index: usize| [(index % width) as f64, (index / width) as f64];
    let image = |pixels: Vec<f64>| Image { width, height, pixels };
    if quantity == Quantity::AreaDensity {
        let areas: Vec<Vec<f64>> =
            (0..width * height).into_par_iter().map(|index| reference.area_densities(pixel(index))).collect();
        let page = |material: usize| image(areas.iter().map(|areas| areas[material]).collect());
        return Ok((0..scene.materials.len()).map(page).collect());
    }
    let beam = Beam::new(scene)?;
    let value = |index: usize| {
        let areas = reference.area_densities(pixel(index));
        match quantity {
            Quantity::Intensity => beam.intensity_at(&areas, view, pixel(index)),
            Quantity::Counts => beam.counts_at(&areas, view, pixel(index)),
            Quantity::LineIntegral | Quantity::AreaDensity => beam.line_integral_at(&areas, view, pixel(index)),
        }
    };
    let values: Result<Vec<f64>, RenderError> = (0..width * height).into_par_iter().map(value).collect();
    Ok(vec![image(values?)])
}

/// All of an image that the executors give too, from one pass over the rays.
#[derive(Clone, Debug)]
pub struct Traced {
    /// g/cm² by pixel (row-major), then by scene material.
    pub g_per_cm2: Vec<f64>,
    /// 1 where [`Reference::is_valid`], 0 elsewhere.
    pub valid: Vec<u8>,
    /// −ln intensity by pixel; empty unless asked for.
    pub line_integral: Vec<f64>,
}

/// Traces every pixel once, on all cores: area densities, validity, and line integrals where `attenuate` asks for them.
///
/// # Errors
/// When fx · pitch is no distance, the image has no pixels, or attenuation is not tabulated.
pub fn trace(scene: &Scene, view: &View, attenuate: bool) -> Result<Traced, RenderError> {
    let reference = Reference::new(scene, view)?;
    let beam = attenuate.then(|| Beam::new(scene)).transpose()?;
    let [width, height] = view.size_px.map(|n| n as usize);
    let ray = |index: usize| {
        let pixel = [(index % width) as f64, (index / width) as f64];
        let areas = reference.area_densities(pixel);
        let line = beam.as_ref().map(|beam| beam.line_integral_at(&areas, view, pixel)).transpose()?;
        Ok((areas, u8::from(reference.is_valid(pixel)), line))
    };
    let rays = (0..width * height).into_par_iter().map(ray).collect::<Result<Vec<_>, RenderError>>()?;
    Ok(Traced {
        g_per_cm2: rays.iter().flat_map(|(areas, ..)| areas).copied().collect(),
        valid: rays.iter().map(|(_, valid, _)| *valid).collect(),
        line_integral: rays.iter().filter_map(|(.., line)| *line).collect(),
    })
}

/// 1 where [`Reference::is_valid`], 0 elsewhere.
///
/// # Errors
/// When fx · pitch is no distance or the image has no pixels.
pub fn valid(scene: &Scene, view: &View) -> Result<Image<u8>, RenderError> {
    let reference = Reference::new(scene, view)?;
    let [width, height] = view.size_px.map(|n| n as usize);
    let valid = |index: usize| u8::from(reference.is_valid([(index % width) as f64, (index / width) as f64]));
    Ok(Image { width, height, pixels: (0..width * height).into_par_iter().map(valid).collect() })
}

/// −ln of the intensity behind given area densities (g/cm² by scene material): Eq. 6, or Eq. 8 for naive scenes.
///
/// # Errors
/// When attenuation is not tabulated at an energy of the beam.
pub fn line_integral(scene: &Scene, areas_g_per_cm2: &[f64]) -> Result<f64, RenderError> {
    Ok(Beam::new(scene)?.line_integral(areas_g_per_cm2))
}
