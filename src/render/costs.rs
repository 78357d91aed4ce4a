//! What the parts of rendering cost on this machine: measured once in a fraction of a second, kept in the user's cache folder.

use std::path::PathBuf;
use std::sync::Arc;

use serde::{Deserialize, Serialize};

use super::cells::Cells;
use super::cpu::add_noise::add_noise;
use super::cpu::attenuate_spectrum::attenuate_spectrum;
use super::cpu::fixed_lanes::is_fast;
use super::cpu::integrate_density::{Density, integrate_density};
use super::plan::Sampling;
use super::prepared::Prepared;
use super::slabs::Slabs;
use super::spectrum::{Bins, LANES};
use crate::geometry::{Intrinsics, Rigid, View};
use crate::gpu::cpu_name;
use crate::image::write_atomically;
use crate::random::{Purpose, Stream};
use crate::reporter::Reporter;
use crate::scene::model::{Matter, Object, Scene, Volume};
use crate::time::Stopwatch;

/// Goes up whenever an executor becomes faster or slower, so that no one trusts costs of the one before.
const METHOD: u32 = 4;

/// Nanoseconds of one core.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Costs {
    /// Machine and version that they hold for.
    pub machine: String,
    /// Cores that work at once.
    pub threads: usize,
    /// A ray and a slab, exact, for 1, 2 and up to 4 materials.
    pub exact_slab_ns: [f64; 3],
    /// The same in fixed point.
    pub fixed_slab_ns: [f64; 3],
    /// A ray and a slab, walked cell by cell.
    pub walked_slab_ns: f64,
    /// A ray against a shape.
    pub solid_ns: f64,
    /// A pixel and eight energies.
    pub energies_ns: f64,
    /// A pixel's noise.
    pub noise_ns: f64,
}

impl Default for Costs {
    /// Of one 4 GHz core with AVX-512; ranks plans where nothing was measured.
    fn default() -> Self {
        Self {
            machine: "typical".to_owned(),
            threads: 1,
            exact_slab_ns: [1.3, 2.0, 3.4],
            fixed_slab_ns: [0.7, 1.3, 2.5],
            walked_slab_ns: 28.0,
            solid_ns: 12.0,
            energies_ns: 12.0,
            noise_ns: 60.0,
        }
    }
}

/// What a plan does, in the units of [`Costs`].
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Work {
    /// Pixels of the image.
    pub pixels: f64,
    /// Rays that are cast.
    pub rays: f64,
    /// Slabs that an average ray crosses.
    pub slabs_per_ray: f64,
    /// Those among them that lie in bricks filled with one density.
    pub filled_per_ray: f64,
    /// Shapes an average ray is tried against.
    pub solids_per_ray: f64,
    /// Materials of the volume.
    pub materials: usize,
    /// Energies at which every pixel is evaluated.
    pub energies: usize,
    /// Whether noise is drawn.
    pub noise: bool,
}

impl Costs {
    /// Milliseconds that `work` takes with `sampling`.
    #[must_use]
    pub fn predict_ms(&self, work: &Work, sampling: Sampling) -> f64 {
        let column = match work.materials {
            0 | 1 => 0,
            2 => 1,
            _ => 2,
        };
        let slab = match sampling {
            Sampling::ExactSlabs => self.exact_slab_ns[column],
            Sampling::FixedSlabs => self.fixed_slab_ns[column],
            Sampling::ExactCells | Sampling::PiecewiseConstant => self.walked_slab_ns,
            Sampling::None => 0.0,
        };
        // Where a block of pixels meets other bricks as well, filled ones gain nothing.
        let slabs = match sampling {
            Sampling::ExactSlabs | Sampling::FixedSlabs => work.slabs_per_ray - 0.7 * work.filled_per_ray,
            _ => work.slabs_per_ray,
        };
        let ray = slab * slabs + self.solid_ns * work.solids_per_ray;
        let blocks = work.energies.div_ceil(LANES) as f64;
        let pixel = self.energies_ns * blocks + if work.noise { self.noise_ns } else { 0.0 };
        (work.rays * ray + work.pixels * pixel) * 1e-6 / self.threads as f64
    }

    /// The costs of this machine: from the cache, else measured and cached. A cache that cannot be written is no error.
    #[must_use]
    pub fn of_this_machine() -> Self {
        let version = env!("CARGO_PKG_VERSION");
        let machine = format!("{}, version {version}, method {METHOD}, debug {}", cpu_name(), cfg!(debug_assertions));
        let path = cache_file();
        let cached =
            path.as_ref().and_then(|path| std::fs::read(path).ok()).and_then(|text| serde_json::from_slice::<Self>(&text).ok());
        if let Some(costs) = cached.filter(|costs| costs.machine == machine && costs.is_sound()) {
            return costs;
        }
        let measured = Self { machine, ..measure() };
        if let Some(path) = path
            && let Some(folder) = path.parent()
            && std::fs::create_dir_all(folder).is_ok()
            && let Ok(text) = serde_json::to_vec_pretty(&measured)
        {
            // Without the file it is measured again next time.
            let _ = write_atomically(&path, |file| file.write_all(&text));
        }
        measured
    }

    fn is_sound(&self) -> bool {
        let all = [self.walked_slab_ns, self.solid_ns, self.energies_ns, self.noise_ns];
        let all = all.iter().chain(&self.exact_slab_ns).chain(&self.fixed_slab_ns);
        self.threads > 0 && all.into_iter().all(|ns| *ns > 0.0 && ns.is_finite())
    }
}

fn cache_file() -> Option<PathBuf> {
    let set = |name: &str| std::env::var_os(name).filter(|value| !value.is_empty()).map(PathBuf::from);
    let folder = set("XDG_CACHE_HOME").or_else(|| Some(set("HOME")?.join(".cache")))?;
    Some(folder.join("sidecarm").join("costs.json"))
}

/// Voxels along the edge of the volume that is timed, and pixels along the edge of its image.
const EDGE: usize = 96;

fn measure() -> Costs {
    let threads = rayon::current_num_threads();
    let mut costs = Costs { threads, ..Costs::default() };
    let per = |ms: f64, count: f64| (ms * 1e6 * threads as f64 / count).max(1e-3);
    let Some(scene) = test_scene() else { return costs };
    let crossed = (EDGE * EDGE) as f64 * EDGE as f64;
    let time = |volume: Volume, sampling: Sampling| {
        let volume = Arc::new(volume);
        let object = Object { name: "timed".to_owned(), body: String::new(), matter: Matter::Volume(volume) };
        let scene = Scene { objects: vec![object], ..scene.clone() };
        let prepared = Prepared::new(&scene, scene.view?, |volume, name| {
            let none = || super::RenderError::Volume { name: name.to_owned(), detail: "no cells".to_owned() };
            let cells = Arc::new(Cells::new(volume).ok_or_else(none)?);
            let slabs = Slabs::new(volume, &cells).map(Arc::new);
            Ok((cells, slabs))
        });
        let prepared = prepared.ok()?;
        prepared.make_slabs(sampling == Sampling::FixedSlabs);
        Some(per(fastest(|| drop(integrate_density(&prepared, sampling))), crossed))
    };
    for (column, materials) in [1, 2, 4].into_iter().enumerate() {
        let Some(ns) = time(test_volume(materials, 1), Sampling::ExactSlabs) else { return costs };
        costs.exact_slab_ns[column] = ns;
        // Where it is not fast, no plan takes it, and to time it would take a minute.
        if is_fast() {
            let Some(ns) = time(test_volume(materials, 1), Sampling::FixedSlabs) else { return costs };
            costs.fixed_slab_ns[column] = ns;
        }
    }
    // Most cells of a scan hold one material.
    let Some(ns) = time(test_volume(2, 12), Sampling::ExactCells) else { return costs };
    costs.walked_slab_ns = ns;
    let pixels = 1 << 16;
    let nodes = super::spectrum::whole_spectrum(&scene);
    if let Ok(bins) = Bins::new(&scene, &nodes) {
        let count = scene.materials.len();
        let g_per_cm2 = (0..pixels * count).map(|i| 0.5 + (i % 97) as f32 * 0.2).collect();
        let density = Density { material_count: count, g_per_cm2, valid: vec![1; pixels], unscanned_mm: 0.0 };
        let blocks = (bins.padded / LANES) as f64;
        costs.energies_ns = per(fastest(|| drop(attenuate_spectrum(&density, &bins, false))), pixels as f64 * blocks);
    }
    let expected: Vec<f32> = (0..pixels).map(|i| 10.0 + (i % 4096) as f32).collect();
    costs.noise_ns = per(fastest(|| drop(add_noise(&expected, 1, 0))), pixels as f64);
    costs
}

/// The shortest of seven, ms.
fn fastest(work: impl Fn()) -> f64 {
    let time = |_| {
        let watch = Stopwatch::start();
        work();
        watch.ms()
    };
    (0..7).map(time).fold(f64::INFINITY, f64::min)
}

/// Everything but the volume.
fn test_scene() -> Option<Scene> {
    let text = r#"{ "objects": [
        {"sphere": {"centre_lps_mm": [0,0,0], "radius_mm": 1, "material": "water"}},
        {"sphere": {"centre_lps_mm": [0,0,0], "radius_mm": 1, "material": "bone_cortical"}},
        {"sphere": {"centre_lps_mm": [0,0,0], "radius_mm": 1, "material": "adipose"}},
        {"sphere": {"centre_lps_mm": [0,0,0], "radius_mm": 1, "material": "titanium"}} ],
        "beam": {"tube_kvp": 120, "anode_angle_deg": 12, "filtration_mm": {"aluminium": 4.3}, "photons_per_pixel": 1e5},
        "detector": {"response": "energy", "pitch_mm": 2.0}, "model": {"formation": "deepdrr"} }"#;
    let mut scene = crate::scene::load_text(text, std::path::Path::new("timing"), false, &Reporter::silent()).ok()?;
    let middle = 0.5 * (EDGE as f64 - 1.0);
    // Half a voxel a pixel.
    let intrinsics = Intrinsics { fx: 2000.0, fy: 2000.0, cx: middle, cy: middle, skew: 0.0 };
    // A slanted look: axis-aligned rays flatter every rule.
    let turn = glam::DQuat::from_rotation_y(0.3) * glam::DQuat::from_rotation_x(0.2);
    let camera_from_lps = Rigid { rotation: turn, translation_mm: glam::DVec3::new(0.0, 0.0, 1000.0) };
    scene.view = Some(View { size_px: [EDGE as u32; 2], intrinsics, camera_from_lps });
    Some(scene)
}

/// Noise of so many materials, each in blocks of `block`³ voxels.
fn test_volume(materials: usize, block: usize) -> Volume {
    let mut stream = Stream::new(1, 0, 0, Purpose::Evaluation);
    let voxels = EDGE * EDGE * EDGE;
    let (mut density, mut class) = (Vec::with_capacity(voxels), Vec::with_capacity(voxels));
    let mut of_block = std::collections::HashMap::new();
    for voxel in 0..voxels {
        let random = stream.next_u32();
        density.push(0.5 + (random % 1000) as f32 * 1e-3);
        let drawn = (random / 1000 % materials as u32) as u8 + 1;
        let at = [voxel % EDGE, voxel / EDGE % EDGE, voxel / (EDGE * EDGE)].map(|n| n / block);
        class.push(*of_block.entry(at).or_insert(drawn));
    }
    let centre = glam::DVec3::splat(-0.5 * (EDGE as f64 - 1.0));
    Volume {
        size: [EDGE; 3],
        lps_from_voxel: glam::DAffine3::from_translation(centre),
        density_g_per_cm3: density,
        class,
        class_materials: (0..materials).collect(),
        truncated_at_faces: false,
        unknown: Vec::new(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn costs_are_sound_and_more_work_costs_more() {
        let costs = measure();
        assert!(costs.is_sound(), "{costs:?}");
        assert!(!Costs { noise_ns: f64::NAN, ..costs.clone() }.is_sound());
        let work = Work { pixels: 1e5, rays: 1e5, slabs_per_ray: 100.0, materials: 2, energies: 8, ..Work::default() };
        let ms = costs.predict_ms(&work, Sampling::ExactSlabs);
        assert!(ms > 0.0);
        assert!(costs.predict_ms(&Work { energies: 120, ..work }, Sampling::ExactSlabs) > ms);
        assert!(costs.predict_ms(&Work { noise: true, ..work }, Sampling::ExactSlabs) > ms);
        assert!(costs.predict_ms(&Work { filled_per_ray: 80.0, ..work }, Sampling::ExactSlabs) < ms);
        assert!(costs.predict_ms(&Work { rays: 2.5e4, ..work }, Sampling::ExactSlabs) < ms);
    }
}
