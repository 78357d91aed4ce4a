//! Where a scan was cut off: pixels that look past a face through which tissue would go on.

use std::sync::Arc;

use glam::{DQuat, DVec3};
use sidecarm::geometry::{Intrinsics, Rigid, View};
use sidecarm::gpu::DeviceChoice;
use sidecarm::render::Quantity;
use sidecarm::render::reference;
use sidecarm::scene::Scene;
use sidecarm::scene::model::{Matter, Volume};

use crate::evaluate::Draw;
use crate::render_scenes::{With, empty, placed, render_on, volume};
use sidecarm::random::{Purpose, Stream};

fn scene_of(volume: Volume, view: View) -> Scene {
    let mut scene = empty(&["water"]).with(Matter::Volume(Arc::new(Volume { truncated_at_faces: true, ..volume })));
    scene.view = Some(view);
    scene
}

/// A volume with blobs, sheets and specks that reach some of its faces, and a camera anywhere about it, inside it too.
fn drawn(seed: u64) -> Scene {
    let mut draw = Draw(Stream::new(seed, 31, 0, Purpose::Evaluation));
    let size = [0; 3].map(|_: usize| draw.between(1.0, 24.0) as usize);
    let spacing = DVec3::new(draw.log(0.3, 6.0), draw.log(0.3, 6.0) * draw.pick(&[1.0, -1.0]), draw.log(0.3, 12.0));
    let axis = (draw.point(1.0) + DVec3::splat(1e-3)).normalize();
    // Along the grid as well, where rays run in faces.
    let turn = DQuat::from_axis_angle(axis, draw.pick(&[0.0, 0.0, 1.0]) * draw.between(-3.0, 3.0));
    let extent = (spacing.abs() * DVec3::from_array(size.map(|n| n as f64))).length();
    let blobs: Vec<(DVec3, f64)> = (0..3)
        .map(|_| {
            let at = DVec3::from_array(size.map(|n| draw.between(0.0, n as f64 - 1.0)));
            (at, draw.between(0.3, 0.6 * size.into_iter().max().unwrap_or(1) as f64))
        })
        .collect();
    let sheet = draw.between(0.0, size[1] as f64) as usize;
    let matter = |voxel: [usize; 3]| {
        let at = DVec3::from_array(voxel.map(|n| n as f64));
        let inside = blobs.iter().any(|(centre, radius)| at.distance(*centre) < *radius) || voxel[1] == sheet;
        (u8::from(inside), f32::from(u8::from(inside)))
    };
    let grid = volume(size, placed(size, DVec3::ZERO, spacing, turn), &[0], matter);
    let distance = draw.pick(&[0.2, 0.6, 1.0, 3.0]) * extent;
    let look = DQuat::from_axis_angle(
        (draw.point(1.0) + DVec3::splat(1e-3)).normalize(),
        draw.pick(&[0.0, 1.0]) * draw.between(-3.0, 3.0),
    );
    let fx = draw.log(20.0, 200.0);
    let view = View {
        size_px: [45, 33],
        intrinsics: Intrinsics { fx, fy: fx, skew: 0.0, cx: draw.between(0.0, 44.0), cy: draw.between(0.0, 32.0) },
        camera_from_lps: Rigid { rotation: look, translation_mm: DVec3::new(0.0, 0.0, distance) },
    };
    let mut scene = scene_of(grid, view);
    // Before, in or behind the volume.
    scene.detector.pitch_mm = distance * draw.pick(&[0.5, 1.0, 2.0, 6.0]) / fx;
    scene
}

/// Seeds with as many pixels that differ from the reference; all, and those that are invalid.
fn compared(seeds: std::ops::Range<u64>) -> (usize, usize, usize) {
    let (mut differ, mut all, mut invalid) = (0, 0, 0);
    for seed in seeds {
        let scene = drawn(seed);
        let fast = render_on(DeviceChoice::Cpu, &scene, Quantity::LineIntegral);
        let slow = reference::valid(&scene, &scene.view.expect("a view")).expect("good");
        let here = fast.valid.pixels.iter().zip(&slow.pixels).filter(|(a, b)| a != b).count();
        if here > 0 {
            println!("seed {seed}: {here} pixels differ, size {:?}", scene.view.map(|view| view.size_px));
        }
        differ += here;
        all += slow.pixels.len();
        invalid += slow.pixels.iter().filter(|valid| **valid == 0).count();
    }
    (differ, all, invalid)
}

#[test]
fn the_fast_mask_is_the_reference_s_ray_by_ray() {
    let (differ, all, invalid) = compared(0..60);
    assert!(invalid > all / 10 && invalid < 9 * all / 10, "{invalid} of {all} are invalid");
    // Rays that touch a border between cells may fall on either side.
    assert!(differ as f64 <= 1e-3 * all as f64, "{differ} of {all}");
}

#[test]
#[ignore = "a minute long: scripts/evaluate faces runs it"]
fn many() {
    let (differ, all, invalid) = compared(1_000..5_000);
    println!("{differ} of {all} pixels differ, {invalid} are invalid");
    assert!(differ as f64 <= 1e-3 * all as f64);
}

/// A column of tissue cut at the top: half of the frame looks past it. One surrounded by air is cut nowhere.
#[test]
fn a_frame_that_looks_past_the_scan_says_so() {
    let size = [40, 30, 20];
    let view = View {
        size_px: [80, 60],
        intrinsics: Intrinsics { fx: 500.0, fy: 500.0, skew: 0.0, cx: 39.5, cy: 29.5 },
        // The patient's z runs along −rows, y along the beam.
        camera_from_lps: Rigid::from_rows(&[
            [1.0, 0.0, 0.0, 0.0],
            [0.0, 0.0, -1.0, 0.0],
            [0.0, 1.0, 0.0, 500.0],
            [0.0, 0.0, 0.0, 1.0],
        ])
        .expect("a rotation"),
    };
    let column = |top: usize| {
        move |[i, j, k]: [usize; 3]| {
            let inside = (8..32).contains(&i) && (8..22).contains(&j) && k >= 3 && k < top;
            (u8::from(inside), f32::from(u8::from(inside)))
        }
    };
    let invalid = |top: usize| {
        // The top face lies on the principal ray.
        let grid = volume(size, placed(size, DVec3::new(0.0, 0.0, -10.0), DVec3::ONE, DQuat::IDENTITY), &[0], column(top));
        let mut scene = scene_of(grid, view);
        scene.detector.pitch_mm = 2.0;
        render_on(DeviceChoice::Cpu, &scene, Quantity::LineIntegral)
    };
    let whole = invalid(17);
    assert!(whole.valid.pixels.iter().all(|valid| *valid == 1), "surrounded by air");
    let cut = invalid(20);
    assert_eq!(*cut.valid.at(40, 2), 0, "far above the scan, where the column goes on");
    assert_eq!(*cut.valid.at(40, 50), 1, "through the scan's tissue, below its top");
    assert_eq!(*cut.valid.at(4, 2), 1, "above the scan, beside the column");
    // 24 mm wide (and half a voxel on either side, where the field is interpolated) at 493 mm from the source, above row 29.5.
    let share = cut.valid.pixels.iter().filter(|valid| **valid == 0).count() as f64 / 4800.0;
    let expected = 0.5 * (25.0 * 500.0 / 493.0) / 80.0;
    assert!((share / expected - 1.0).abs() < 0.12, "{share} and {expected}");
    assert!(cut.notes.iter().any(|note| note.contains("scan cut off")), "{:?}", cut.notes);
}
