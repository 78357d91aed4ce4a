//! Meshes: no line slips through their surface in f32, and photons meet in them what they meet in shapes, and on the processor.

use std::sync::Arc;

use glam::{DAffine3, DQuat, DVec3};

use super::kernel::Kernel;
use super::layout::Job;
use super::tests::{apart, balance, run, software};
use super::{BATCHES, SOFTWARE_BATCH};
use crate::geometry::{Intrinsics, Rigid, View};
use crate::gpu::Gpu;
use crate::render::mesh_tree::MeshTree;
use crate::render::wgsl::layout::nodes_of;
use crate::scene::model::{Matter, Mesh, Scene, Shape, Volume};
use crate::transport::fixture::{block, scene, solid};
use crate::transport::stream::Stream;
use crate::transport::{Histories, Simulation, Tally};

/// Lines of each kind.
const LINES: usize = 8192;

/// Along each line: how often the mesh winds around it at its far beginning, at its place, and whether the place is inside. Lines lie in the
/// numbers from where the first history is.
const KERNEL: &str = "
@compute @workgroup_size(64)
fn look_along_lines(@builtin(global_invocation_id) id: vec3<u32>) {
    let at = job.first.x + 6u * id.x;
    let place = vec3<f32>(numbers[at], numbers[at + 1u], numbers[at + 2u]);
    let direction = vec3<f32>(numbers[at + 3u], numbers[at + 4u], numbers[at + 5u]);
    look_along(0u, place, direction, -FAR_MM);
    atomicStore(&sums[3u * id.x], bitcast<u32>(winding));
    look_along(0u, place, direction, 0.0);
    atomicStore(&sums[3u * id.x + 1u], bitcast<u32>(winding));
    atomicStore(&sums[3u * id.x + 2u], select(0u, 1u, winds_around(0u, place)));
}
";

/// A rod along its z with so many threads, closed by flat ends.
fn screw(threads: u32, lps_from_local: &Rigid, material: usize, density_g_per_cm3: f64) -> Mesh {
    const AROUND: u32 = 12;
    let (pitch_mm, rings) = (60.0 / f64::from(threads), 2 * threads + 1);
    let ring = |n: u32| (if n.is_multiple_of(2) { 9.0 } else { 12.0 }, 0.5 * pitch_mm * f64::from(n));
    let on_ring = |n: u32, step: u32| {
        let ((radius_mm, z), angle) = (ring(n), std::f64::consts::TAU * f64::from(step) / f64::from(AROUND));
        DVec3::new(radius_mm * angle.cos(), radius_mm * angle.sin(), z)
    };
    let ends = [DVec3::ZERO, DVec3::new(0.0, 0.0, 60.0)];
    let places = ends.into_iter().chain((0..rings).flat_map(|n| (0..AROUND).map(move |step| on_ring(n, step))));
    let index = |n: u32, step: u32| 2 + n * AROUND + step % AROUND;
    let mut triangles = Vec::new();
    for step in 0..AROUND {
        triangles.extend([[0, index(0, step + 1), index(0, step)], [1, index(rings - 1, step), index(rings - 1, step + 1)]]);
        for n in 0..rings - 1 {
            let [a, b, c, d] = [index(n, step), index(n, step + 1), index(n + 1, step + 1), index(n + 1, step)];
            triangles.extend([[a, b, c], [a, c, d]]);
        }
    }
    let vertices_lps_mm = places.map(|place| lps_from_local.transform_point(place)).collect();
    Mesh { vertices_lps_mm, triangles, material, density_g_per_cm3 }
}

/// Lines through places about a mesh: any, at its corners, at its edges, and at its corners along the axes.
fn lines(mesh: &Mesh, stream: &mut Stream) -> Vec<[f32; 6]> {
    let corners = mesh.vertices_lps_mm.iter();
    let (low, high) = corners.fold((DVec3::INFINITY, DVec3::NEG_INFINITY), |(low, high), v| (low.min(*v), high.max(*v)));
    (0..4 * LINES)
        .map(|n| {
            let triangle = mesh.triangles[(stream.uniform() * mesh.triangles.len() as f64) as usize];
            // As the shader has them.
            let [a, b, _] = triangle.map(|corner| mesh.vertices_lps_mm[corner as usize].as_vec3().as_dvec3());
            let share = DVec3::new(stream.uniform(), stream.uniform(), stream.uniform());
            let place = (low - 3.0 + (high - low + 6.0) * share).as_vec3().as_dvec3();
            let (place, way) = match n / LINES {
                0 => (place, share - 0.5),
                1 => (place, a - place),
                2 => (place, a.lerp(b, stream.uniform()) - place),
                _ => {
                    let way = [DVec3::X, DVec3::NEG_Y, DVec3::Z][n % 3];
                    (a + way * (80.0 * stream.uniform() - 40.0), way)
                }
            };
            let (place, way) = (place.as_vec3(), way.normalize().as_vec3());
            [place.x, place.y, place.z, way.x, way.y, way.z]
        })
        .collect()
}

/// Whether a place is inside; `None` within rounding of the surface.
fn is_inside(tree: &MeshTree, place: DVec3) -> Option<bool> {
    let at = |place: DVec3| {
        let mut spans = Vec::new();
        tree.inside(place, DVec3::new(0.3, -0.7, 0.6), &mut spans);
        spans.iter().any(|(from, to)| *from <= 0.0 && *to > 0.0)
    };
    let here = at(place);
    // All round, so that no place on an edge looks as if it were beside it.
    let around = (0..8).map(|n| DVec3::from_array([1, 2, 4].map(|bit| if n & bit == 0 { -1.0 } else { 1.0 })));
    let axes = DVec3::AXES.iter().flat_map(|axis| [*axis, -*axis]);
    around.chain(axes).all(|way| at(place + 2e-3 * way) == here).then_some(here)
}

/// Lines that are aimed at corners and edges of meshes that lie straight and turned: all come out again.
#[test]
fn no_line_slips_through_the_surface_of_a_mesh() {
    let Some(kernel) = Kernel::new("look_along_lines", KERNEL) else { return };
    let turned =
        Rigid { rotation: DQuat::from_scaled_axis(DVec3::new(0.3, 0.5, -0.2)), translation_mm: DVec3::new(120.3, -33.1, 57.7) };
    let half = DVec3::new(14.0, 9.0, 11.0);
    let meshes = [
        ("straight box", block(half, DVec3::new(4.0, 2.0, -6.0), DVec3::ZERO, 0, 1.0)),
        ("turned box", block(half, turned.translation_mm, DVec3::new(0.3, 0.5, -0.2), 0, 1.0)),
        ("straight screw", screw(24, &Rigid::IDENTITY, 0, 1.0)),
        ("turned screw", screw(24, &turned, 0, 1.0)),
    ];
    let mut stream = Stream::new(12, 0);
    for (name, mesh) in &meshes {
        let tree = MeshTree::new(&mesh.vertices_lps_mm, &mesh.triangles);
        let nodes: Vec<_> = nodes_of(&tree, 0, 0, DVec3::ZERO).collect();
        let mut numbers: Vec<f32> = tree.triangles().iter().flatten().flat_map(|corner| corner.as_vec3().to_array()).collect();
        let job = Job { first: [numbers.len() as u32, 0], ..Job::default() };
        let lines = lines(mesh, &mut stream);
        numbers.extend(lines.iter().flatten());
        let inputs: [(u32, &[u8]); 3] =
            [(0, bytemuck::bytes_of(&job)), (1, bytemuck::cast_slice(&numbers)), (6, bytemuck::cast_slice(&nodes))];
        let found = kernel.run(&inputs, &[(7, 12 * lines.len() as u64)], (lines.len() / 64) as u32);
        let (mut slipped, mut wrong, mut told, mut inside) = (0, 0, 0, 0);
        for (line, [begins, here, by_place]) in lines.iter().zip(found.as_chunks::<3>().0) {
            slipped += usize::from(f32::from_bits(*begins) != 0.0);
            let place = DVec3::new(f64::from(line[0]), f64::from(line[1]), f64::from(line[2]));
            let Some(expected) = is_inside(&tree, place) else { continue };
            wrong += usize::from((f32::from_bits(*here) != 0.0) != expected || (*by_place == 1) != expected);
            (told, inside) = (told + 1, inside + usize::from(expected));
        }
        println!("{name}: {slipped} of {} lines slip through, {wrong} of {told} places are wrong", lines.len());
        assert!(slipped == 0 && wrong == 0, "{name}: {slipped} slip through, {wrong} are wrong");
        assert!(told > 2 * LINES && inside > LINES / 8, "{name}: {told} {inside}");
    }
}

fn view() -> View {
    let intrinsics = Intrinsics { fx: 1000.0, fy: 1000.0, skew: 0.0, cx: 99.5, cy: 74.5 };
    View { size_px: [200, 150], intrinsics, camera_from_lps: Rigid::IDENTITY }
}

fn asked() -> Histories {
    Histories { count: BATCHES * SOFTWARE_BATCH, seed: 3, grid_px: [8, 6], ..Histories::default() }
}

/// Water and aluminium: a software device ends the loops of histories that are long.
fn lit(matters: Vec<Matter>) -> Scene {
    let mut scene = scene(&["water", "aluminium"], matters);
    scene.detector.pitch_mm = 1.0;
    scene
}

fn on_cpu(scene: &Scene) -> Tally {
    let simulation = Simulation::new(scene, &view(), asked()).expect("good");
    let mut tally = simulation.tally();
    let Ok(()) = simulation.run(&mut tally, |_| Ok::<(), std::convert::Infallible>(()));
    tally
}

fn on_gpu(gpu: &Gpu, scene: &Scene) -> Tally {
    let tally = run(gpu, scene, &view(), asked());
    let balance = balance(&tally, 2);
    assert!((balance - 1.0).abs() < 1e-4, "{balance}");
    tally
}

/// A box in a bath, out of which its corners stick: as a mesh, as a shape, and a fifth denser.
#[test]
fn a_mesh_is_the_shape_that_it_is_of() {
    let Some(gpu) = software() else { return };
    let (half, centre, turn) = (DVec3::new(30.0, 25.0, 12.0), DVec3::new(5.0, -3.0, 700.0), DVec3::new(0.1, 0.2, 0.3));
    let bath = || {
        let shape = Shape::Cuboid { half_size_mm: DVec3::new(45.0, 40.0, 15.0) };
        Matter::Solids(vec![solid(shape, DVec3::new(0.0, 0.0, 700.0), DVec3::ZERO, 0, 1.0)])
    };
    let as_mesh = |density: f64| lit(vec![bath(), Matter::Mesh(Arc::new(block(half, centre, turn, 1, density)))]);
    let shape = solid(Shape::Cuboid { half_size_mm: half }, centre, turn, 1, 2.7);
    let as_shape = on_gpu(&gpu, &lit(vec![bath(), Matter::Solids(vec![shape])]));
    let cpu = on_cpu(&as_mesh(2.7));
    let mesh = on_gpu(&gpu, &as_mesh(2.7));
    for (name, other) in [("the shape", &as_shape), ("the processor", &cpu)] {
        let (square, largest) = apart(&mesh, other, 48, 2);
        println!("mesh and {name}: mean square of z {square:.2}, largest of sums {largest:.2}");
        assert!(square < 1.6 && largest < 4.5, "{name}: {square} {largest}");
    }
    let (square, _) = apart(&on_gpu(&gpu, &as_mesh(1.2 * 2.7)), &cpu, 48, 2);
    println!("control: {square:.2}");
    assert!(square > 2.0, "the control: {square}");
}

/// A CT, a screw through it and a ball in both, the later one displacing the earlier: each order is that of the processor, and no other.
#[test]
fn a_mesh_displaces_what_is_before_it_and_nothing_else() {
    let Some(gpu) = software() else { return };
    let mut stream = Stream::new(8, 0);
    let size = [16, 14, 6];
    let count: usize = size.iter().product();
    let ct = Arc::new(Volume {
        size,
        lps_from_voxel: DAffine3 { translation: DVec3::new(-37.5, -32.5, 687.5), ..DAffine3::from_scale(DVec3::splat(5.0)) },
        density_g_per_cm3: (0..count).map(|_| (0.9 + 0.2 * stream.uniform()) as f32).collect(),
        class: vec![1; count],
        class_materials: vec![0],
        truncated_at_faces: false,
        unknown: Vec::new(),
    });
    let across =
        Rigid { rotation: DQuat::from_scaled_axis(DVec3::new(0.1, 1.4, 0.2)), translation_mm: DVec3::new(-28.0, 3.0, 694.0) };
    let tool = Arc::new(screw(4, &across, 1, 2.7));
    let ball =
        solid(Shape::Ellipsoid { semi_axes_mm: DVec3::new(14.0, 15.0, 13.0) }, DVec3::new(0.0, 0.0, 700.0), DVec3::ZERO, 0, 1.0);
    let [ct, tool, ball] = [Matter::Volume(ct), Matter::Mesh(tool), Matter::Solids(vec![ball])];
    let orders = [
        ("screw in CT, ball in screw", [&ct, &tool, &ball]),
        ("screw in ball", [&ct, &ball, &tool]),
        ("CT in screw", [&tool, &ct, &ball]),
    ];
    let scenes = orders.map(|(name, matters)| (name, lit(matters.map(Matter::clone).into())));
    let [of_cpu, of_gpu] =
        [scenes.each_ref().map(|(_, scene)| on_cpu(scene)), scenes.each_ref().map(|(_, scene)| on_gpu(&gpu, scene))];
    for (n, (name, _)) in scenes.iter().enumerate() {
        for (m, (other, _)) in scenes.iter().enumerate() {
            let (square, largest) = apart(&of_gpu[n], &of_cpu[m], 48, 2);
            println!("{name} on the GPU, {other} on the processor: mean square of z {square:.2}, largest of sums {largest:.2}");
            match n == m {
                true => assert!(square < 1.6 && largest < 4.5, "{name}: {square} {largest}"),
                false => assert!(square > 2.0, "the control, {name} and {other}: {square}"),
            }
        }
    }
}
