//! What the parts of rendering cost on this machine: measured in a second or two, kept in the user's cache folder.

use std::path::PathBuf;
use std::sync::Arc;
use std::sync::atomic::{AtomicU32, Ordering};
use std::time::Duration;

use rayon::prelude::*;

use super::cells::Cells;
use super::costs::Costs;
use super::cpu::attenuate_spectrum::attenuate_spectrum;
use super::cpu::enlarge_density::enlarge_density;
use super::cpu::fixed_lanes::is_fast;
use super::cpu::integrate_density::{Density, integrate_density};
use super::cut_faces;
use super::flood::{self, Weights};
use super::meshes::MadeMesh;
use super::plan::{Node, Sampling};
use super::prepared::Prepared;
use super::ray_counts::{RayCounts, SlabsOfRay};
use super::slabs::Slabs;
use super::spectrum::{Bins, LANES};
use super::timed_panel;
use super::timed_scenes::{
    EDGE, FAR_EDGE, cells_per_slab, cut_volume, seen_from_afar, test_scene, test_volume, timed_mesh, timed_tubes,
};
use crate::estimate::median;
use crate::geometry::View;
use crate::gpu::cpu_name_with_threads;
use crate::image::{cache_file, write_atomically};
use crate::random::{Purpose, Stream};
use crate::regular;
use crate::scene::model::{Matter, Object, Scene, Volume};
use crate::time::Stopwatch;

/// Goes up whenever an executor becomes faster or slower, so that no one trusts costs of the one before.
const METHOD: u32 = 13;

/// Costs are measured once more when the last time is so long ago, and twice as long after each time: others may have used the machine
/// before, for a minute or for an hour.
const AGAIN: Duration = Duration::from_secs(10);
/// At the most.
const AT_LAST: Duration = Duration::from_secs(3600);

/// The costs of this machine: from the cache, else measured and cached, the least of all times. A cache that cannot be written is no error.
#[must_use]
pub fn of_this_machine() -> Costs {
    // Two builds of the program beside each other do not forget what the other one knows.
    let name = if cfg!(debug_assertions) { "costs-debug.json" } else { "costs.json" };
    kept_in(cache_file(name), measure)
}

fn kept_in(path: Option<PathBuf>, measure: impl Fn() -> Costs) -> Costs {
    let version = env!("CARGO_PKG_VERSION");
    let machine = format!("{}, version {version}, method {METHOD}, debug {}", cpu_name_with_threads(), cfg!(debug_assertions));
    let cached =
        path.as_ref().and_then(|path| regular::read(path).ok()).and_then(|text| serde_json::from_slice::<Costs>(&text).ok());
    let cached = cached.filter(|costs| costs.machine == machine && costs.is_sound());
    let age = path.as_ref().and_then(|path| path.metadata().ok()?.modified().ok()?.elapsed().ok());
    let is_recent = |costs: &&Costs| age.is_none_or(|age| age <= AT_LAST.min(AGAIN * (1 << (costs.rounds.clamp(1, 10) - 1))));
    if let Some(costs) = cached.as_ref().filter(is_recent) {
        return costs.clone();
    }
    let measured = Costs { machine, rounds: 1, ..measure() };
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

/// Voxels along the edge of a volume that hardly takes longer than to enter it.
const FEW: usize = super::costs::FEW_SLABS as usize;

fn measure() -> Costs {
    let threads = rayon::current_num_threads();
    let mut costs = Costs { threads, ..Costs::default() };
    let per = |ms: f64, count: f64| (ms * 1e6 * threads as f64 / count).max(1e-3);
    let Some(scene) = test_scene("") else { return costs };
    let rays = (EDGE * EDGE) as f64;
    let time = |volume: Volume, sampling: Sampling| {
        let ms = with_volume(&scene, volume, |prepared| {
            prepared.make_slabs(sampling == Sampling::FixedSlabs);
            fastest(|| drop(integrate_density(prepared, sampling)))
        });
        Some(per(ms?, rays))
    };
    let far_scene = seen_from_afar(&scene);
    let time_far = |materials: usize, block: usize, sampling: Sampling| {
        let few_ns = time(test_volume(FEW, materials, block.min(FEW)), sampling)?;
        let (ms, slabs) = with_volume(&far_scene, test_volume(EDGE, materials, block), |prepared| {
            prepared.make_slabs(sampling == Sampling::FixedSlabs);
            let drawn = drawn(prepared);
            let slabs = drawn.iter().map(|ray| ray.slabs).sum::<f64>() / drawn.len() as f64;
            (fastest(|| drop(integrate_density(prepared, sampling))), slabs)
        })?;
        Some(((per(ms, (FAR_EDGE * FAR_EDGE) as f64) - few_ns) / (slabs - FEW as f64).max(1.0)).max(1e-3))
    };
    // Of what a ray takes through many and through few slabs, what they do not account for.
    let time_both = |materials: usize, block: usize, sampling: Sampling| {
        let [many, few] = [EDGE, FEW];
        let ns = time(test_volume(many, materials, block), sampling)?;
        let few_ns = time(test_volume(few, materials, block.min(few)), sampling)?;
        let slab_ns = ((ns - few_ns) / (many - few) as f64).max(1e-3);
        Some([slab_ns, few_ns - slab_ns * few as f64])
    };
    for (column, materials) in [1, 2, 4].into_iter().enumerate() {
        let Some([slab_ns, volume_ns]) = time_both(materials, 1, Sampling::ExactSlabs) else { return costs };
        costs.exact_slab_ns[column] = slab_ns;
        if column == 0 {
            costs.volume_ns[0] = volume_ns;
        }
        // Where it is not fast, no plan takes it, and to time it would take a minute.
        if is_fast() {
            let Some([slab_ns, volume_ns]) = time_both(materials, 1, Sampling::FixedSlabs) else { return costs };
            costs.fixed_slab_ns[column] = slab_ns;
            if column == 0 {
                costs.volume_ns[1] = volume_ns;
            }
        }
    }
    costs.far_slab_ns[0] = time_far(1, 1, Sampling::ExactSlabs).unwrap_or(costs.exact_slab_ns[0]);
    if is_fast() {
        costs.far_slab_ns[1] = time_far(1, 1, Sampling::FixedSlabs).unwrap_or(costs.fixed_slab_ns[0]);
    }
    // Most cells of a scan hold one material.
    let Some([slab_ns, volume_ns]) = time_both(2, 12, Sampling::ExactCells) else { return costs };
    (costs.walked_cell_ns, costs.volume_ns[2]) = (slab_ns / cells_per_slab(), volume_ns);
    costs.far_cell_ns = time_far(2, 12, Sampling::ExactCells).map_or(costs.walked_cell_ns, |ns| ns / cells_per_slab());
    costs.line_ns = line_ns(threads);
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
    let count = scene.materials.len();
    if let Ok(bins) = Bins::new(&scene, &nodes) {
        let g_per_cm2 = (0..pixels * count).map(|i| 0.5 + (i % 97) as f32 * 0.2).collect();
        let density = Density { material_count: count, g_per_cm2, valid: vec![1; pixels] };
        let blocks = (bins.padded / LANES) as f64;
        let attenuated =
            |moments: bool| per(fastest(|| drop(attenuate_spectrum(&density, &bins, moments))), pixels as f64 * blocks);
        (costs.energies_ns, costs.moments_ns) = (attenuated(false), attenuated(true));
        if let Some([alone_ms, seen_ms, tables_ms]) = heel_ms(&nodes, &bins, &density) {
            costs.shaped_ns = [alone_ms, seen_ms].map(|ms| per(ms, rays * (blocks + 1.0)));
            costs.heel_ms = tables_ms;
        }
        if let Ok(panel) = timed_panel::measure((&scene, &nodes, &bins), threads, |work| fastest(work)) {
            costs.panel = panel;
        }
    }
    let of_tubes = |are_met: bool| {
        let (ns, drawn) = time_objects(&scene, timed_tubes(are_met), threads)?;
        let mean = |of: usize| drawn.iter().map(|ray| ray.solids[of]).sum::<f64>() / drawn.len() as f64;
        Some((ns, mean(0), mean(1)))
    };
    if let (Some((passed_ns, tried, _)), Some((ns, all_tried, met))) = (of_tubes(false), of_tubes(true)) {
        let pass_ns = passed_ns / tried.max(1.0);
        costs.solid_ns = [pass_ns, ((ns - pass_ns * (all_tried - met)) / met.max(1.0)).max(pass_ns)];
    }
    if let Some((ns, drawn)) = time_objects(&scene, Matter::Mesh(Arc::new(timed_mesh())), threads) {
        costs.mesh_test_ns = ns * drawn.len() as f64 / drawn.iter().map(|ray| ray.mesh_tests).sum::<f64>();
    }
    let coarse = Density { material_count: count, g_per_cm2: vec![1.0; 129 * 129 * count], valid: vec![1; 129 * 129] };
    costs.between_ns = per(fastest(|| drop(enlarge_density(&coarse, [129, 129], [256, 256], 2))), (pixels * count) as f64);
    let empty_ms = |view: View, time: fn(&dyn Fn()) -> f64| {
        let scene = Scene { view: Some(view), ..scene.clone() };
        time_objects_by(&scene, Matter::Solids(Vec::new()), time).map(|(ms, _)| ms)
    };
    if let Some(view) = scene.view {
        let small = View { size_px: [8; 2], ..view };
        if let (Some(whole_ms), Some(small_ms)) = (empty_ms(view, |work| fastest(work)), empty_ms(small, |work| fastest(work))) {
            costs.pixel_ns = per((whole_ms - small_ms).max(0.0), rays);
            costs.volume_ns = costs.volume_ns.map(|ns| (ns - costs.pixel_ns).max(1e-3));
        }
        let shared = View { size_px: [32; 2], ..view };
        if let Some(woken_ms) = empty_ms(shared, after_a_rest) {
            costs.image_ms = WAKES * woken_ms;
        }
    }
    costs
}

/// Milliseconds that a beam behind a heel takes without an object and behind the first pixels of `density`, and its tables.
fn heel_ms(nodes: &[Node], bins: &Bins, density: &Density) -> Option<[f64; 3]> {
    let scene = test_scene(r#""heel": {"anode_towards": "+column"},"#)?;
    let view = scene.view?;
    let pixels = view.size_px.iter().map(|n| *n as usize).product::<usize>();
    let g_per_cm2 = density.g_per_cm2[..pixels * density.material_count].to_vec();
    let density = Density { g_per_cm2, valid: vec![1; pixels], ..*density };
    let weights = Weights::new(&scene, nodes, bins).ok()?;
    let alone_ms = fastest(|| drop(flood::flood(&scene, &view, &weights, true)));
    let seen_ms = fastest(|| drop(flood::attenuate(&view, &density, bins, &weights, false)));
    Some([alone_ms, seen_ms, fastest(|| drop(Weights::new(&scene, nodes, bins)))])
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
            let cells = Arc::new(Cells::new(volume, None).ok_or_else(none)?);
            let slabs = Slabs::new(volume, &cells).map(Arc::new);
            Ok((cells, slabs))
        },
        |mesh| Arc::new(MadeMesh::new(mesh)),
    );
    prepared.ok().as_ref().map(time)
}

/// Nanoseconds of one core for a line of memory from anywhere in more than caches hold, all cores at once.
fn line_ns(threads: usize) -> f64 {
    const LINE: usize = 8;
    const READS: usize = 20_000;
    let memory = vec![1u64; 1 << 24];
    // Others each time: those of the time before are in the caches.
    let round = AtomicU32::new(0);
    let read = |thread: usize| {
        let mut stream = Stream::new(thread as u64, round.load(Ordering::Relaxed), 0, Purpose::Evaluation);
        (0..READS).map(|_| memory[stream.next_u32() as usize % (memory.len() / LINE) * LINE]).fold(0u64, u64::wrapping_add)
    };
    let ms = fastest(|| {
        round.fetch_add(1, Ordering::Relaxed);
        drop(std::hint::black_box((0..threads).into_par_iter().map(read).collect::<Vec<u64>>()));
    });
    (ms * 1e6 / READS as f64).max(1e-3)
}

/// The shortest of at least three, ms; of more as long as they are short, because others use the machine as well.
fn fastest(work: impl Fn()) -> f64 {
    let all = Stopwatch::start();
    let mut best = f64::INFINITY;
    for round in 0..40 {
        if round >= 3 && all.ms() > 20.0 {
            break;
        }
        let watch = Stopwatch::start();
        work();
        best = best.min(watch.ms());
    }
    best
}

/// The median when cores have slept before, as they do between images, ms.
fn after_a_rest(work: &dyn Fn()) -> f64 {
    let once = |_| {
        std::thread::sleep(std::time::Duration::from_millis(3));
        let watch = Stopwatch::start();
        work();
        watch.ms()
    };
    median((0..9).map(once)).unwrap_or(f64::NAN)
}

/// Times that cores are woken for an image: to cast, to attenuate, to mark cut faces, to detect.
const WAKES: f64 = 4.0;

/// Nanoseconds of one core that a ray takes through `matter` alone, and what the rays of some pixels meet.
fn time_objects(scene: &Scene, matter: Matter, threads: usize) -> Option<(f64, Vec<RayCounts>)> {
    let [width, height] = scene.view?.size_px;
    let (ms, drawn) = time_objects_by(scene, matter, |work| fastest(work))?;
    Some(((ms * 1e6 * threads as f64 / (f64::from(width) * f64::from(height))).max(1e-9), drawn))
}

/// What the rays of some pixels meet.
fn drawn(prepared: &Prepared) -> Vec<RayCounts> {
    let [width, height] = prepared.view.size_px;
    let places = (0..height).step_by(7).flat_map(|v| (0..width).step_by(7).map(move |u| [u, v]));
    places.map(|pixel| RayCounts::of(prepared, pixel, &SlabsOfRay::all(prepared, pixel))).collect()
}

/// Milliseconds that casting `matter` alone takes, and what the rays of some pixels meet.
fn time_objects_by(scene: &Scene, matter: Matter, time: fn(&dyn Fn()) -> f64) -> Option<(f64, Vec<RayCounts>)> {
    let object = Object { name: "timed".to_owned(), body: String::new(), matter };
    let scene = Scene { objects: vec![object], ..scene.clone() };
    let no_volume = |_: &Arc<Volume>, name: &str| {
        Err(super::RenderError::Volume { name: name.to_owned(), detail: "there is none to time".to_owned() })
    };
    let prepared = Prepared::new(&scene, scene.view?, no_volume, |mesh| Arc::new(MadeMesh::new(mesh))).ok()?;
    Some((time(&|| drop(integrate_density(&prepared, Sampling::None))), drawn(&prepared)))
}

#[cfg(test)]
mod tests {
    use super::super::panel_costs::PanelCosts;
    use super::*;

    #[test]
    fn costs_of_a_crowded_hour_do_not_stay() {
        let folder = tempfile::tempdir().expect("temporary folder");
        let path = folder.path().join("costs.json");
        let now = || Costs { threads: 2, ..Costs::default() };
        let measured = kept_in(Some(path.clone()), now);
        assert_eq!(measured.rounds, 1);
        let keep = |rounds: u32, age_s: u64| {
            let crowded = Costs { face_ns: 1e6 * measured.face_ns, rounds, ..measured.clone() };
            let file = std::fs::File::create(&path).expect("written");
            serde_json::to_writer(&file, &crowded).expect("written");
            let written = file.metadata().and_then(|metadata| metadata.modified()).expect("a time");
            file.set_modified(written - Duration::from_secs(age_s)).expect("a time");
            (crowded.face_ns, kept_in(Some(path.clone()), now))
        };
        for (rounds, age_s) in [(1, 1), (4, 70), (30, 3000)] {
            let (crowded_ns, taken) = keep(rounds, age_s);
            assert_eq!(taken.face_ns, crowded_ns, "what was measured {age_s} s ago is taken as it is");
        }
        for (rounds, age_s) in [(1, 20), (4, 100), (30, 4000)] {
            let (crowded_ns, again) = keep(rounds, age_s);
            assert!(again.face_ns < 1e-2 * crowded_ns && again.rounds == rounds + 1, "{again:?}");
        }
    }

    #[test]
    fn costs_measured_here_are_sound_and_nan_is_not() {
        let costs = measure();
        assert!(costs.is_sound(), "{costs:?}");
        assert!(!Costs { moments_ns: f64::NAN, ..costs.clone() }.is_sound());
        let panel = |drawn_ns: f64| PanelCosts { drawn_ns, ..costs.panel.clone() };
        assert!(!Costs { panel: panel(f64::NAN), ..costs.clone() }.is_sound());
        assert!(!Costs { threads: 0, ..costs.clone() }.is_sound());
        let panel = panel(0.5 * costs.panel.drawn_ns);
        let crowded = Costs { face_ns: 9.0 * costs.face_ns, panel, rounds: 1, ..costs.clone() };
        let least = costs.clone().least(&crowded);
        let found = (least.face_ns, least.panel.drawn_ns, least.rounds);
        assert_eq!(found, (costs.face_ns, crowded.panel.drawn_ns, costs.rounds + 1));
    }
}
