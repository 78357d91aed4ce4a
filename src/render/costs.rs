//! What the parts of rendering cost on this machine: measured once in a fraction of a second, kept in the user's cache folder.

use std::sync::Arc;

use serde::{Deserialize, Serialize};

use super::cells::Cells;
use super::chain;
use super::cpu::add_noise::add_noise;
use super::cpu::attenuate_spectrum::{Signal, attenuate_spectrum};
use super::cpu::enlarge_density::enlarge_density;
use super::cpu::fixed_lanes::is_fast;
use super::cpu::integrate_density::{Density, integrate_density};
use super::cut_faces;
use super::meshes::MadeMesh;
use super::plan::{Executor, Sampling};
use super::prepared::Prepared;
use super::slabs::Slabs;
use super::spectrum::{Bins, LANES};
use crate::geometry::{Intrinsics, Rigid, View};
use crate::gpu::cpu_name;
use crate::image::{cache_file, write_atomically};
use crate::random::{Purpose, Stream};
use crate::reporter::Reporter;
use crate::scene::model::{Matter, Mesh, Object, Scene, Shape, Solid, Volume};
use crate::time::Stopwatch;

/// Goes up whenever an executor becomes faster or slower, so that no one trusts costs of the one before.
const METHOD: u32 = 7;

/// Nanoseconds of one core.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Costs {
    /// Machine and version that they hold for.
    pub machine: String,
    /// How many times they were measured; each is the least of all.
    pub rounds: u32,
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
    /// A ray against a mesh, for each doubling of its triangles.
    pub mesh_level_ns: f64,
    /// A pixel and a material, interpolated.
    pub between_ns: f64,
    /// A pixel and eight energies.
    pub energies_ns: f64,
    /// A pixel and eight energies behind a heel: with and without the object.
    pub shaped_ns: f64,
    /// A ray against a face where a scan was cut off.
    pub face_ns: f64,
    /// A pixel's noise.
    pub noise_ns: f64,
    /// A pixel in which nothing is seen.
    pub pixel_ns: f64,
    /// An image, however small: cores are woken, memory is fetched.
    pub image_ms: f64,
}

impl Default for Costs {
    /// Of one 4 GHz core with AVX-512; ranks plans where nothing was measured.
    fn default() -> Self {
        Self {
            machine: "typical".to_owned(),
            rounds: 0,
            threads: 1,
            exact_slab_ns: [1.3, 2.0, 3.4],
            fixed_slab_ns: [0.7, 1.3, 2.5],
            walked_slab_ns: 28.0,
            solid_ns: 12.0,
            mesh_level_ns: 40.0,
            between_ns: 3.0,
            energies_ns: 12.0,
            shaped_ns: 60.0,
            face_ns: 40.0,
            noise_ns: 60.0,
            pixel_ns: 10.0,
            image_ms: 0.1,
        }
    }
}

/// What a plan does, in the units of [`Costs`].
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Work {
    /// Pixels of the image.
    pub pixels: f64,
    /// Bands of its rows, of which cores take one at a time to cast.
    pub bands: f64,
    /// Rays that are cast.
    pub rays: f64,
    /// Slabs that an average ray crosses.
    pub slabs_per_ray: f64,
    /// Those among them that lie in bricks filled with one density.
    pub filled_per_ray: f64,
    /// Share of the rays through volumes that are walked cell by cell although others are crossed in slabs.
    pub walked_share: f64,
    /// Slabs of an average ray that are looked at cell by cell for what the volume displaces there.
    pub displacing_per_ray: f64,
    /// Shapes an average ray is tried against.
    pub solids_per_ray: f64,
    /// Doublings of triangles in the meshes that an average ray is tried against.
    pub mesh_levels_per_ray: f64,
    /// Pixels that are interpolated.
    pub interpolated: f64,
    /// Materials of the volume.
    pub materials: usize,
    /// Energies at which every pixel is evaluated.
    pub energies: usize,
    /// Part of [`Costs::shaped_ns`] that beam shapes ask for at all energies of the spectrum; 0 where none varies from pixel to pixel.
    pub shaped: f64,
    /// Energies of the beam, at which its shapes are evaluated.
    pub shaped_energies: usize,
    /// How many times a ray is tried against a face where a scan was cut off.
    pub face_tests: f64,
    /// Whether noise is drawn.
    pub noise: bool,
}

/// Costs are measured so many times.
const ROUNDS: u32 = 3;

/// Pixels that a core takes at a time once rays are cast.
const CHUNK_PX: f64 = 512.0;

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
        let volume = match sampling {
            Sampling::ExactSlabs | Sampling::FixedSlabs => {
                let in_slabs =
                    slab * (work.slabs_per_ray - 0.7 * work.filled_per_ray) + self.walked_slab_ns * work.displacing_per_ray;
                (1.0 - work.walked_share) * in_slabs + work.walked_share * self.walked_slab_ns * work.slabs_per_ray
            }
            _ => slab * work.slabs_per_ray,
        };
        let ray = volume + self.solid_ns * work.solids_per_ray + self.mesh_level_ns * work.mesh_levels_per_ray;
        let [blocks, shaped_blocks] = [work.energies, work.shaped_energies].map(|energies| energies.div_ceil(LANES) as f64);
        let pixel = self.pixel_ns
            + self.energies_ns * blocks
            + work.shaped * self.shaped_ns * shaped_blocks
            + if work.noise { self.noise_ns } else { 0.0 };
        let between = work.interpolated * self.between_ns * work.materials.max(1) as f64;
        // The last round leaves cores idle; what comes in one piece has one core.
        let cores = |pieces: f64| pieces / (pieces / self.threads as f64).ceil();
        let cast = (work.rays * ray + work.face_tests * self.face_ns) / cores(work.bands.max(1.0));
        let rest = (work.pixels * pixel + between) / cores((work.pixels / CHUNK_PX).ceil().max(1.0));
        (cast + rest) * 1e-6 + self.image_ms
    }

    /// The costs of this machine: from the cache, else measured and cached. The first few programs that ask measure again, because others may
    /// have used the machine at the first time. A cache that cannot be written is no error.
    #[must_use]
    pub fn of_this_machine() -> Self {
        let version = env!("CARGO_PKG_VERSION");
        let machine = format!("{}, version {version}, method {METHOD}, debug {}", cpu_name(), cfg!(debug_assertions));
        let path = cache_file("costs.json");
        let cached =
            path.as_ref().and_then(|path| std::fs::read(path).ok()).and_then(|text| serde_json::from_slice::<Self>(&text).ok());
        let cached = cached.filter(|costs| costs.machine == machine && costs.is_sound());
        if let Some(costs) = cached.as_ref().filter(|costs| costs.rounds >= ROUNDS) {
            return costs.clone();
        }
        let measured = Self { machine, rounds: 1, ..measure() };
        let measured = cached.map_or(measured.clone(), |cached| measured.least(&cached));
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

    fn all_mut(&mut self) -> impl Iterator<Item = &mut f64> {
        let rays =
            [&mut self.walked_slab_ns, &mut self.solid_ns, &mut self.mesh_level_ns, &mut self.between_ns, &mut self.face_ns];
        let pixels = [&mut self.energies_ns, &mut self.shaped_ns, &mut self.noise_ns, &mut self.pixel_ns, &mut self.image_ms];
        rays.into_iter().chain(pixels).chain(&mut self.exact_slab_ns).chain(&mut self.fixed_slab_ns)
    }

    /// Whatever of the two is less, cost by cost.
    fn least(mut self, other: &Self) -> Self {
        self.rounds += other.rounds;
        self.all_mut().zip(other.clone().all_mut()).for_each(|(mine, other)| *mine = mine.min(*other));
        self
    }

    fn is_sound(&self) -> bool {
        self.threads > 0 && self.clone().all_mut().all(|cost| *cost > 0.0 && cost.is_finite())
    }
}

/// Voxels along the edge of the volume that is timed, and pixels along the edge of its image.
const EDGE: usize = 96;

fn measure() -> Costs {
    let threads = rayon::current_num_threads();
    let mut costs = Costs { threads, ..Costs::default() };
    let per = |ms: f64, count: f64| (ms * 1e6 * threads as f64 / count).max(1e-3);
    let Some(scene) = test_scene("") else { return costs };
    let crossed = (EDGE * EDGE) as f64 * EDGE as f64;
    let time = |volume: Volume, sampling: Sampling| {
        let ms = with_volume(&scene, volume, |prepared| {
            prepared.make_slabs(sampling == Sampling::FixedSlabs);
            fastest(|| drop(integrate_density(prepared, sampling)))
        });
        Some(per(ms?, crossed))
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
    let faces = with_volume(&scene, cut_volume(), |prepared| {
        let ms = fastest(|| {
            std::hint::black_box(cut_faces::mark(prepared, &mut [1; EDGE * EDGE]));
        });
        per(ms, cut_faces::tests(prepared) as f64)
    });
    let Some(ns) = faces else { return costs };
    costs.face_ns = ns;
    let pixels = 1 << 16;
    let nodes = super::spectrum::whole_spectrum(&scene);
    if let Ok(bins) = Bins::new(&scene, &nodes) {
        let count = scene.materials.len();
        let g_per_cm2 = (0..pixels * count).map(|i| 0.5 + (i % 97) as f32 * 0.2).collect();
        let density = Density { material_count: count, g_per_cm2, valid: vec![1; pixels], unscanned_mm: 0.0 };
        let blocks = (bins.padded / LANES) as f64;
        costs.energies_ns = per(fastest(|| drop(attenuate_spectrum(&density, &bins, false))), pixels as f64 * blocks);
        if let (Some(heeled), Some(view)) = (test_scene(r#""heel": {"anode_towards": "+column"},"#), scene.view) {
            let seen = EDGE * EDGE;
            let (g_per_cm2, valid) = (density.g_per_cm2[..seen * count].to_vec(), vec![1; seen]);
            let density = Density { g_per_cm2, valid, ..density };
            let made_by = (nodes.as_slice(), Executor::Cpu);
            let shape = || drop(chain::shape(&heeled, &view, made_by, &density, &bins, &mut Signal::default(), false));
            costs.shaped_ns = per(fastest(shape), seen as f64 * blocks);
        }
    }
    if let Some(ns) = time_objects(&scene, timed_tubes(), threads) {
        costs.solid_ns = ns / TUBES as f64;
    }
    let mesh = timed_mesh();
    let levels = (1.0 + mesh.triangles.len() as f64).log2();
    if let Some(ns) = time_objects(&scene, Matter::Mesh(Arc::new(mesh)), threads) {
        costs.mesh_level_ns = ns / levels;
    }
    let coarse = Density { material_count: 1, g_per_cm2: vec![1.0; 129 * 129], valid: vec![1; 129 * 129], unscanned_mm: 0.0 };
    costs.between_ns = per(fastest(|| drop(enlarge_density(&coarse, [129, 129], [256, 256], 2))), pixels as f64);
    let empty_ms = |view: View| {
        let scene = Scene { view: Some(view), ..scene.clone() };
        Some(
            time_objects(&scene, Matter::Solids(Vec::new()), 1)?
                * view.size_px.iter().map(|n| f64::from(*n)).product::<f64>()
                * 1e-6,
        )
    };
    if let Some(view) = scene.view
        && let Some((whole_ms, small_ms)) = empty_ms(view).zip(empty_ms(View { size_px: [8; 2], ..view }))
    {
        costs.pixel_ns = per((whole_ms - small_ms).max(0.0), (EDGE * EDGE) as f64);
        // The cores are woken for next to nothing, in each of three steps.
        costs.image_ms = (3.0 * small_ms).max(1e-3);
    }
    let expected: Vec<f32> = (0..pixels).map(|i| 10.0 + (i % 4096) as f32).collect();
    costs.noise_ns = per(fastest(|| drop(add_noise(&expected, 1, 0))), pixels as f64);
    costs
}

/// What `time` says of the scene with `volume` as all that is in it.
fn with_volume<T>(scene: &Scene, volume: Volume, time: impl Fn(&Prepared) -> T) -> Option<T> {
    let object = Object { name: "timed".to_owned(), body: String::new(), matter: Matter::Volume(Arc::new(volume)) };
    let scene = Scene { objects: vec![object], ..scene.clone() };
    let prepared = Prepared::new(
        &scene,
        scene.view?,
        |volume, name| {
            let none = || super::RenderError::Volume { name: name.to_owned(), detail: "no cells".to_owned() };
            let cells = Arc::new(Cells::new(volume).ok_or_else(none)?);
            let slabs = Slabs::new(volume, &cells).map(Arc::new);
            Ok((cells, slabs))
        },
        |mesh| Arc::new(MadeMesh::new(mesh)),
    );
    prepared.ok().as_ref().map(time)
}

/// The shortest of at least three, ms; of more as long as they are short, because others use the machine as well.
fn fastest(work: impl Fn()) -> f64 {
    let all = Stopwatch::start();
    let mut best = f64::INFINITY;
    for round in 0..40 {
        if round >= 3 && all.ms() > 60.0 {
            break;
        }
        let watch = Stopwatch::start();
        work();
        best = best.min(watch.ms());
    }
    best
}

/// Tubes that every ray is tried against when shapes are timed.
const TUBES: usize = 16;

fn timed_tubes() -> Matter {
    let tube = |index: usize| Solid {
        shape: Shape::Cylinder { length_mm: 200.0, radius_mm: 60.0, inner_radius_mm: 55.0 },
        lps_from_local: Rigid {
            rotation: glam::DQuat::from_rotation_x(0.3 + 0.1 * index as f64),
            translation_mm: glam::DVec3::new(0.0, 0.0, -100.0 + 10.0 * index as f64),
        },
        material: 0,
        density_g_per_cm3: 1.0,
    };
    Matter::Solids((0..TUBES).map(tube).collect())
}

/// A ball of some thousand triangles.
fn timed_mesh() -> Mesh {
    const ROUND: u32 = 96;
    const RINGS: u32 = 48;
    let point = |index: u32| {
        let (polar, azimuth) = (
            std::f64::consts::PI * (0.5 + f64::from(index / ROUND)) / f64::from(RINGS),
            std::f64::consts::TAU * f64::from(index % ROUND) / f64::from(ROUND),
        );
        60.0 * glam::DVec3::new(polar.sin() * azimuth.cos(), polar.sin() * azimuth.sin(), polar.cos())
    };
    let square = |index: u32| {
        let (ring, place) = (index / ROUND, index % ROUND);
        let next = (place + 1) % ROUND;
        let [a, b, c, d] = [ring * ROUND + place, ring * ROUND + next, (ring + 1) * ROUND + next, (ring + 1) * ROUND + place];
        [[a, c, b], [a, d, c]]
    };
    // The two holes at the poles are never looked through.
    let triangles = (0..ROUND * (RINGS - 1)).flat_map(square).collect();
    Mesh { vertices_lps_mm: (0..ROUND * RINGS).map(point).collect(), triangles, material: 0, density_g_per_cm3: 1.0 }
}

/// Nanoseconds of one core that a ray takes through `matter` alone.
fn time_objects(scene: &Scene, matter: Matter, threads: usize) -> Option<f64> {
    let object = Object { name: "timed".to_owned(), body: String::new(), matter };
    let scene = Scene { objects: vec![object], ..scene.clone() };
    let no_volume = |_: &Arc<Volume>, name: &str| {
        Err(super::RenderError::Volume { name: name.to_owned(), detail: "there is none to time".to_owned() })
    };
    let prepared = Prepared::new(&scene, scene.view?, no_volume, |mesh| Arc::new(MadeMesh::new(mesh))).ok()?;
    let ms = fastest(|| drop(integrate_density(&prepared, Sampling::None)));
    let pixels: f64 = scene.view?.size_px.iter().map(|n| f64::from(*n)).product();
    Some((ms * 1e6 * threads as f64 / pixels).max(1e-9))
}

/// Everything but the volume; `beam` is added to the beam's keys.
fn test_scene(beam: &str) -> Option<Scene> {
    let text = r#"{ "objects": [
        {"sphere": {"centre_lps_mm": [0,0,0], "radius_mm": 1, "material": "water"}},
        {"sphere": {"centre_lps_mm": [0,0,0], "radius_mm": 1, "material": "bone_cortical"}},
        {"sphere": {"centre_lps_mm": [0,0,0], "radius_mm": 1, "material": "adipose"}},
        {"sphere": {"centre_lps_mm": [0,0,0], "radius_mm": 1, "material": "titanium"}} ],
        "beam": {BEAM "tube_kvp": 120, "anode_angle_deg": 12, "filtration_mm": {"aluminium": 4.3}, "photons_per_pixel": 1e5},
        "detector": {"response": "energy", "pitch_mm": 2.0}, "model": {"formation": "deepdrr"} }"#;
    let mut scene =
        crate::scene::load_text(&text.replace("BEAM", beam), std::path::Path::new("timing"), false, &Reporter::silent()).ok()?;
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

/// A body from face to face.
fn cut_volume() -> Volume {
    let mut volume = test_volume(1, 1);
    let from_middle = |index: usize| (index as f64 + 0.5) / EDGE as f64 - 0.5;
    for (voxel, density) in volume.density_g_per_cm3.iter_mut().enumerate() {
        let place = glam::DVec3::from_array([voxel % EDGE, voxel / EDGE % EDGE, voxel / (EDGE * EDGE)].map(from_middle));
        if place.truncate().length() > 0.46 {
            *density = 0.0;
        }
    }
    Volume { truncated_at_faces: true, ..volume }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn costs_measured_here_are_sound_and_nan_is_not() {
        let costs = measure();
        assert!(costs.is_sound(), "{costs:?}");
        assert!(!Costs { noise_ns: f64::NAN, ..costs.clone() }.is_sound());
        assert!(!Costs { threads: 0, ..costs.clone() }.is_sound());
        let crowded = Costs { solid_ns: 9.0 * costs.solid_ns, noise_ns: 0.5 * costs.noise_ns, rounds: 1, ..costs.clone() };
        let least = costs.clone().least(&crowded);
        assert_eq!((least.solid_ns, least.noise_ns, least.rounds), (costs.solid_ns, crowded.noise_ns, costs.rounds + 1));
    }

    // With written costs: what a crowded machine measures may say anything of one part against another.
    #[test]
    fn more_work_costs_more() {
        let costs = Costs { threads: 2, ..Costs::default() };
        let work = Work { pixels: 1e5, rays: 1e5, slabs_per_ray: 100.0, materials: 2, energies: 8, ..Work::default() };
        let ms = costs.predict_ms(&work, Sampling::ExactSlabs);
        assert!(ms > 0.0);
        assert!(costs.predict_ms(&Work { energies: 120, ..work }, Sampling::ExactSlabs) > ms);
        assert!(costs.predict_ms(&Work { noise: true, ..work }, Sampling::ExactSlabs) > ms);
        assert!(costs.predict_ms(&Work { shaped: 1.0, shaped_energies: 8, ..work }, Sampling::ExactSlabs) > ms);
        // A piece more than the cores take at a time: a second round.
        let chunks = |count: f64| costs.predict_ms(&Work { pixels: count * CHUNK_PX, rays: 0.0, ..work }, Sampling::ExactSlabs);
        let threads = costs.threads as f64;
        assert!(chunks(threads + 1.0) - costs.image_ms > 1.2 * (chunks(threads) - costs.image_ms));
        assert!(costs.predict_ms(&Work { bands: 2.0, ..work }, Sampling::ExactSlabs) < 0.6 * ms);
        assert!(costs.predict_ms(&Work { filled_per_ray: 80.0, ..work }, Sampling::ExactSlabs) < ms);
        assert!(costs.predict_ms(&Work { rays: 2.5e4, ..work }, Sampling::ExactSlabs) < ms);
        assert!(costs.predict_ms(&Work { walked_share: 0.5, ..work }, Sampling::ExactSlabs) > 2.0 * ms);
        assert!(costs.predict_ms(&Work { displacing_per_ray: 50.0, ..work }, Sampling::ExactSlabs) > ms);
        assert!(costs.predict_ms(&Work { mesh_levels_per_ray: 16.0, ..work }, Sampling::ExactSlabs) > ms);
        assert!(costs.predict_ms(&Work { face_tests: 1e5, ..work }, Sampling::ExactSlabs) > ms);
        assert!(costs.predict_ms(&Work { interpolated: 1e6, ..work }, Sampling::ExactSlabs) > ms);
    }
}
