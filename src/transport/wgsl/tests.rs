//! The transport on software Vulkan against the processor's.

use glam::{DQuat, DVec2, DVec3};

use super::*;
use crate::geometry::{Intrinsics, Rigid, View};
use crate::gpu::{Device, DeviceChoice};
use crate::reporter::Reporter;
use crate::scene::model::{Matter, Scene, Shape, Voxels};
use crate::scene::optics::{Axis, BowTie, Field, Grid, Heel, Strips, Towards};
use crate::scene::physics::{Material, Spectrum};
use crate::transport::fixture::{everything, solid};
use crate::transport::{Estimator, Histories, Page};

/// Everything but meshes, 600 mm from the source.
fn lab() -> (Scene, View) {
    let mut scene = everything();
    scene.objects.retain(|object| !matches!(object.matter, Matter::Mesh(_)));
    let aluminium = Material::parse("aluminium").expect("known");
    scene.beam.spectrum = Spectrum::tungsten(90.0, 12.0, &[(aluminium, 3.0)]).expect("inside");
    scene.detector.pitch_mm = 1.0;
    let intrinsics = Intrinsics { fx: 1000.0, fy: 990.0, skew: 3.0, cx: 165.0, cy: 118.0 };
    let camera_from_lps = Rigid { rotation: DQuat::from_rotation_x(0.4), translation_mm: DVec3::new(5.0, -10.0, 600.0) };
    (scene, View { size_px: [320, 240], intrinsics, camera_from_lps })
}

/// Software Vulkan, or `None` with the reason printed.
pub(super) fn software() -> Option<Box<Gpu>> {
    match Device::open(DeviceChoice::SoftwareVulkan, &Reporter::silent()) {
        Ok(Device::Gpu(gpu)) => Some(gpu),
        Ok(Device::Cpu) => None,
        Err(error) => {
            println!("skipped: {error}");
            None
        }
    }
}

/// All that `asked` asks for.
pub(super) fn run(gpu: &Gpu, scene: &Scene, view: &View, asked: Histories) -> Tally {
    let simulation = Simulation::new(scene, view, asked).expect("good");
    let mut transport = GpuTransport::new(gpu, &simulation).expect("the shader takes it");
    let mut tally = transport.tally();
    transport.run(&simulation, &mut tally, |_| Ok::<(), GpuTransportError>(())).expect("runs");
    tally
}

/// Mean of the squares of z over pixels and pages, and the largest |z| of whole pages, of what materials absorb, and of fates.
pub(super) fn apart(gpu: &Tally, cpu: &Tally, pixels: usize, materials: usize) -> (f64, f64) {
    let z = |a: crate::transport::Estimate, b: crate::transport::Estimate| {
        // Where hardly a photon comes, errors are no better known than themselves.
        (a.mean - b.mean) / (a.standard_error.hypot(b.standard_error) + 1e-4 * a.mean.abs() + 1e-12)
    };
    let pages = Page::ALL.iter().flat_map(|page| (0..pixels).map(move |pixel| (*page, pixel)));
    let squares: Vec<f64> = pages.map(|(page, pixel)| z(gpu.signal(page, pixel), cpu.signal(page, pixel)).powi(2)).collect();
    let whole = |page: Page| {
        let sum = |tally: &Tally| (0..pixels).map(|pixel| tally.signal(page, pixel).mean).sum::<f64>();
        let variance = |tally: &Tally| (0..pixels).map(|pixel| tally.signal(page, pixel).standard_error.powi(2)).sum::<f64>();
        (sum(gpu) - sum(cpu)) / ((variance(gpu) + variance(cpu)).sqrt() + 1e-4 * sum(gpu) + 1e-12)
    };
    let whole = Page::ALL.into_iter().map(whole);
    let sums = (0..materials).map(|n| z(gpu.absorbed(n), cpu.absorbed(n)));
    let fates = (0..FATES).map(|n| z(gpu.fate(n), cpu.fate(n)));
    (squares.iter().sum::<f64>() / squares.len() as f64, whole.chain(sums).chain(fates).map(f64::abs).fold(0.0, f64::max))
}

/// Share of the energy that starts which ends somewhere.
pub(super) fn balance(tally: &Tally, materials: usize) -> f64 {
    let absorbed: f64 = (0..materials).map(|n| tally.absorbed(n).mean).sum();
    (absorbed + tally.fate(1).mean + tally.fate(2).mean) / tally.fate(0).mean
}

/// Scenes with every kind of field, grid and estimator: page by page, pixel by pixel, and in energy.
#[test]
fn a_gpu_finds_what_the_processor_finds() {
    let Some(gpu) = software() else { return };
    let (plain, view) = lab();
    let mut shaped = plain.clone();
    shaped.beam.shape.heel = Some(Heel { tube_kvp: 90.0, anode_angle_deg: 12.0, anode_towards: Towards::PlusRow });
    shaped.beam.shape.field =
        Some(Field::Rectangle { size_mm: DVec2::new(180.0, 150.0), centre_mm: DVec2::new(10.0, -8.0), rotation_deg: 20.0 });
    let thickness_mm = vec![[-8.0, 15.0], [0.5, 0.5], [8.0, 12.0]];
    let material = Material::parse("aluminium").expect("known");
    shaped.beam.shape.bowtie = Some(BowTie { material, density_g_per_cm3: 2.7, axis: Axis::Column, thickness_mm });
    shaped.beam.shape.focal_spot_mm = [0.8, 1.2];
    let strips = Strips { ratio: 6.0, across: Axis::Row };
    shaped.detector.panel.grid = Some(Grid { primary_transmission: 0.7, strips: Some(strips) });
    let mut round = plain.clone();
    round.beam.shape.field = Some(Field::Circle { diameter_mm: 200.0, centre_mm: DVec2::new(-6.0, 4.0) });
    round.model.voxels = Voxels::PiecewiseConstant;
    let mut cut = plain;
    let corners_mm = [[-90.0, -60.0], [80.0, -70.0], [60.0, 75.0], [-20.0, 20.0]].map(DVec2::from_array).to_vec();
    cut.beam.shape.field = Some(Field::Polygon { corners_mm });
    // One round of batches: what software follows at once.
    let asked = Histories { count: BATCHES * SOFTWARE_BATCH, seed: 3, grid_px: [8, 6], ..Histories::default() };
    let mut first = None;
    for (name, scene, estimator) in
        [("round", &round, Estimator::Expected), ("shaped", &shaped, Estimator::Expected), ("cut", &cut, Estimator::Analogue)]
    {
        let asked = Histories { estimator, ..asked };
        let tally = run(&gpu, scene, &view, asked);
        let simulation = Simulation::new(scene, &view, Histories { count: 150_000, ..asked }).expect("good");
        let mut cpu = simulation.tally();
        let Ok(()) = simulation.run(&mut cpu, |_| Ok::<(), std::convert::Infallible>(()));
        let (square, largest) = apart(&tally, &cpu, 48, simulation.materials());
        println!("{name}: mean square of z {square:.2}, largest of sums {largest:.2}");
        // 192 squares of z: a standard deviation of 0.1 about 1, and what empty pixels leave.
        assert!(square < 1.6 && largest < 4.5, "{name}: {square} {largest}");
        let balance = balance(&tally, simulation.materials());
        assert!((balance - 1.0).abs() < 1e-4, "{name}: {balance}");
        first.get_or_insert(tally);
    }
    let first = first.expect("the round one");
    // The control: a fifth more density is seen, and another seed is another image.
    let mut denser = round.clone();
    for object in &mut denser.objects {
        if let Matter::Solids(solids) = &mut object.matter {
            solids.iter_mut().for_each(|solid| solid.density_g_per_cm3 *= 1.2);
        }
    }
    assert!(first == run(&gpu, &round, &view, asked), "the same bits");
    let other = run(&gpu, &round, &view, Histories { seed: 4, ..asked });
    assert!(other != first && apart(&other, &first, 48, 6).0 < 1.6);
    let (square, _) = apart(&run(&gpu, &denser, &view, asked), &first, 48, 6);
    assert!(square > 3.0, "{square}");
}

/// Nothing in the beam: the flood, and no buffer is empty. Matter down to the detector: nothing beyond it counts.
#[test]
fn an_empty_scene_and_one_on_the_detector_are_followed() {
    let Some(gpu) = software() else { return };
    let (mut scene, view) = lab();
    scene.objects.clear();
    scene.materials.clear();
    let asked = Histories { count: BATCHES * SOFTWARE_BATCH, seed: 3, grid_px: [4, 3], ..Histories::default() };
    let tally = run(&gpu, &scene, &view, asked);
    let simulation = Simulation::new(&scene, &view, asked).expect("good");
    for (pixel, unattenuated) in simulation.unattenuated().iter().enumerate() {
        let found = tally.signal(Page::Primary, pixel);
        assert!((found.mean - unattenuated).abs() < 5.0 * found.standard_error + 1e-3 * unattenuated, "{pixel}: {found:?}");
    }
    assert!(tally.fate(1).mean > 0.0 && (tally.fate(1).mean / tally.fate(0).mean - 1.0).abs() < 1e-5);
    let slab = Shape::Cuboid { half_size_mm: DVec3::new(200.0, 200.0, 60.0) };
    let behind = view.camera_from_lps.inverse();
    let mut lying = solid(slab, DVec3::ZERO, DVec3::ZERO, 0, 1.0);
    lying.lps_from_local = Rigid { translation_mm: behind.transform_point(DVec3::new(0.0, 0.0, 990.0)), ..behind };
    let mut on_panel = crate::transport::fixture::scene(&["water"], vec![Matter::Solids(vec![lying])]);
    (on_panel.beam, on_panel.detector) = (scene.beam, scene.detector);
    let tally = run(&gpu, &on_panel, &view, asked);
    assert!(tally.scatter(5).mean > 0.0);
}

/// Water that is one box, so that nothing of its primary is left to chance but where photons start: three per cent more of it are told.
#[test]
fn three_per_cent_more_water_is_told() {
    let Some(gpu) = software() else { return };
    let slab = |density_g_per_cm3: f64| {
        let shape = Shape::Cuboid { half_size_mm: DVec3::new(200.0, 200.0, 50.0) };
        let body = solid(shape, DVec3::new(0.0, 0.0, 700.0), DVec3::ZERO, 0, density_g_per_cm3);
        let mut scene = crate::transport::fixture::scene(&["water"], vec![Matter::Solids(vec![body])]);
        scene.detector.pitch_mm = 1.0;
        scene
    };
    let intrinsics = Intrinsics { fx: 1000.0, fy: 1000.0, skew: 0.0, cx: 99.5, cy: 74.5 };
    let view = View { size_px: [200, 150], intrinsics, camera_from_lps: Rigid::IDENTITY };
    let asked = Histories { count: BATCHES * SOFTWARE_BATCH, seed: 3, grid_px: [8, 6], ..Histories::default() };
    let water = slab(1.0);
    let simulation = Simulation::new(&water, &view, asked).expect("good");
    let mut cpu = simulation.tally();
    let Ok(()) = simulation.run(&mut cpu, |_| Ok::<(), std::convert::Infallible>(()));
    let [(square, right), (_, denser)] = [1.0, 1.03].map(|density| apart(&run(&gpu, &slab(density), &view, asked), &cpu, 48, 1));
    println!("mean square of z {square:.2}, largest of sums {right:.2}; of denser water {denser:.2}");
    assert!(square < 1.6 && right < 4.5, "{square} {right}");
    assert!(denser > 2.0 * 4.5, "the control: {denser}");
}

/// Mesa's software Vulkan ends the loops of an invocation that has more to do: its sums are not taken for whole ones.
#[test]
fn what_a_driver_cuts_short_is_told() {
    let Some(gpu) = software() else { return };
    let (scene, view) = lab();
    let simulation = Simulation::new(&scene, &view, Histories::default()).expect("good");
    let mut transport = GpuTransport::new(&gpu, &simulation).expect("the shader takes it");
    // As many histories, a few invocations.
    (transport.job.each, transport.job.groups_per_batch) = ((SOFTWARE_BATCH / GROUP) as u32, 1);
    let mut tally = transport.tally();
    match transport.advance(&mut tally) {
        Err(error) => assert!(error.to_string().contains("loops that the driver ended"), "{error}"),
        // On one that does not, nothing is lost.
        Ok(()) => assert!((balance(&tally, simulation.materials()) - 1.0).abs() < 1e-4),
    }
}

#[test]
fn what_has_no_shader_is_said() {
    let Some(gpu) = software() else { return };
    let (mut dense, view) = lab();
    for object in &mut dense.objects {
        if let Matter::Parts(parts) = &mut object.matter {
            std::sync::Arc::make_mut(&mut parts[0]).density_g_per_cm3[7] = 42.0;
        }
    }
    let simulation = Simulation::new(&dense, &view, Histories::default()).expect("good");
    let said = GpuTransport::new(&gpu, &simulation).err().expect("refused").to_string();
    assert!(said.contains("42.0 g/cm3"), "{said}");
    let (scene, _) = lab();
    let simulation = Simulation::new(&scene, &view, Histories::default()).expect("good").with_dose(&scene, 1000);
    let said = GpuTransport::new(&gpu, &simulation).err().expect("refused").to_string();
    assert!(said.contains("map of the dose") && said.contains("--device cpu"), "{said}");
}
