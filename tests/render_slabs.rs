//! Crossing slab by slab: portable code against AVX-512 and against the field itself, summed up finely.

use std::sync::Arc;

use glam::{DAffine3, DQuat, DVec3};
use sidecarm::gpu::DeviceChoice;
use sidecarm::random::{Purpose, Stream};
use sidecarm::render::cells::Cells;
use sidecarm::render::cpu::cross_slabs::cross;
use sidecarm::render::cpu::edges::{Bundle, BundleSums, Corners, Layers};
use sidecarm::render::cpu::lanes::{LANES, Portable};
use sidecarm::render::cpu::window_places::{Fit, fit};
use sidecarm::render::cpu::windows::BROAD_ROWS;
use sidecarm::render::plan::Sampling;
use sidecarm::render::slabs::{AXES, MOST_MATERIALS, SlabGrid, Slabs};
use sidecarm::render::{Goal, Options, Quantity, Renderer};
use sidecarm::reporter::Reporter;
use sidecarm::scene::model::{Matter, Volume};

use crate::render_scenes::{With, empty, placed, solids, sphere, volume, worst};

pub fn lumpy() -> Volume {
    let filled = |[i, j, k]: [usize; 3]| match (i * 31 + j * 17 + k * 7) % 13 {
        n if n < 3 => (0, 0.0),
        n if n < 9 => (1, 0.8 + n as f32 * 0.05),
        n => (2, 1.5 + n as f32 * 0.05),
    };
    volume([21, 24, 27], DAffine3::IDENTITY, &[0, 1], filled)
}

/// Four materials: each alone in places, two to four of them meeting in others.
pub fn layered() -> Volume {
    let filled = |[i, j, k]: [usize; 3]| match (i < 9, j < 11, k % 5) {
        (true, true, _) => (1, 0.9 + 0.01 * k as f32),
        (true, false, _) => (2, 1.1 + 0.01 * i as f32),
        (false, true, 0 | 1) => (3, 1.4),
        (false, true, _) => (4, 1.0 + 0.02 * j as f32),
        (false, false, n) => [(0, 0.0), (1, 1.0), (2, 1.2), (3, 1.3), (4, 1.5)][n],
    };
    volume([21, 24, 27], DAffine3::IDENTITY, &[0, 1, 2, 3], filled)
}

/// Rays in a 4 × 4 block `apart` voxels from each other that cross from c = 1 to `to`.
fn bundle(stream: &mut Stream, apart: f64, voxels: [i32; 3]) -> Bundle {
    let mut between = |low: f64, high: f64| low + (high - low) * stream.uniform();
    let centre = 0.5 * f64::from(voxels[2]);
    let slope = [between(-0.4, 0.4), between(-0.4, 0.4)];
    let start = [0.5 * f64::from(voxels[0]) + between(-2.0, 2.0), 0.5 * f64::from(voxels[1]) + between(-2.0, 2.0)];
    let (from, to) = (between(1.0, 6.0), f64::from(voxels[2]) - between(0.0, 6.0));
    let place = |axis: usize, lane: usize| {
        let step = if axis == 0 { lane % 4 } else { lane / 4 } as f64 - 1.5;
        start[axis] + apart * step
    };
    let at = std::array::from_fn(|axis| std::array::from_fn(|lane| place(axis, lane)));
    let corners = Corners {
        at: std::array::from_fn(|axis| [0, 3, 12, 15].map(|lane| place(axis, lane))),
        slope: slope.map(|slope| [slope; 4]),
    };
    Bundle {
        at,
        slope: slope.map(|slope| [slope; LANES]),
        c_reference: centre,
        from: std::array::from_fn(|lane| from + 0.01 * lane as f64),
        to: [to; LANES],
        corners,
    }
}

/// ∫ρ dc of one class along a ray, by many midpoints of the trilinear field.
pub fn finely(volume: &Volume, axis: usize, bundle: &Bundle, lane: usize, class: u8) -> f64 {
    let steps = 20_000;
    let length = bundle.to[lane] - bundle.from[lane];
    let mut sum = 0.0;
    for step in 0..steps {
        let c = bundle.from[lane] + length * (f64::from(step) + 0.5) / f64::from(steps);
        let across: [f64; 2] = std::array::from_fn(|x| bundle.at[x][lane] + bundle.slope[x][lane] * (c - bundle.c_reference));
        let mut x = [0.0; 3];
        for (place, value) in AXES[axis].into_iter().zip([across[0], across[1], c]) {
            // Cells are numbered from voxel + 1.
            x[place] = (value - 1.0).clamp(0.0, volume.size[place] as f64 - 1.0);
        }
        for corner in 0..8usize {
            let (mut weight, mut at) = (1.0, [0usize; 3]);
            for place in 0..3 {
                let low = (x[place].floor() as usize).min(volume.size[place] - 2);
                let upper = corner >> place & 1;
                let f = x[place] - low as f64;
                weight *= if upper == 1 { f } else { 1.0 - f };
                at[place] = low + upper;
            }
            let index = volume.index(at[0], at[1], at[2]);
            if volume.class[index] == class {
                sum += weight * f64::from(volume.density_g_per_cm3[index]);
            }
        }
    }
    sum * length / f64::from(steps)
}

/// Compares the lanes that this processor has with the portable ones.
#[cfg(target_arch = "x86_64")]
fn every_kind_of_lanes_agrees(grid: &SlabGrid, bundle: &Bundle, layers: &Layers, portable: &BundleSums, what: &str) {
    let compare = |kind: &str, sums: BundleSums| {
        for (a, b) in sums.iter().flatten().zip(portable.iter().flatten()) {
            assert!((a - b).abs() <= 3e-6 * b.max(1.0), "{kind}, {what}: {a} {b}");
        }
    };
    let mut sums = [[0.0f32; LANES]; MOST_MATERIALS];
    if let Some(avx512) = pulp::x86::V4::try_new() {
        cross(avx512, grid, bundle, layers, &mut sums);
        compare("AVX-512", std::mem::take(&mut sums));
    }
    if let Some(avx2) = pulp::x86::V3::try_new() {
        cross(avx2, grid, bundle, layers, &mut sums);
        compare("AVX2", sums);
    }
}

#[cfg(not(target_arch = "x86_64"))]
fn every_kind_of_lanes_agrees(_: &SlabGrid, _: &Bundle, _: &Layers, _: &BundleSums, _: &str) {}

#[test]
fn portable_lanes_wide_lanes_and_the_field_agree() {
    let mut stream = Stream::new(5, 0, 0, Purpose::Evaluation);
    let mut fits = Vec::new();
    for (name, volume) in [("lumpy", lumpy()), ("layered", layered())] {
        let cells = Cells::new(&volume, None).expect("few materials");
        let slabs = Slabs::new(&volume, &cells).expect("small");
        let mut worst = 0.0f64;
        for axis in 0..3 {
            slabs.prepare(axis, &volume, &cells);
            let grid = slabs.grid(axis).expect("prepared");
            for apart in [0.05, 0.3, 0.9, 1.1, 1.3, 2.0] {
                let bundle = bundle(&mut stream, apart, grid.voxels);
                let spread = |axis: usize| 3.0 * apart + bundle.slope[axis][0].abs();
                fits.push(fit([spread(0), spread(1)], BROAD_ROWS));
                let mut layers = Layers::default();
                layers.fill(&grid, &bundle.corners, bundle.c_reference);
                let mut portable = [[0.0f32; LANES]; MOST_MATERIALS];
                assert_ne!(cross(Portable, &grid, &bundle, &layers, &mut portable), 0, "something was met");
                for lane in [0, 5, 15] {
                    for (class, sums) in portable.iter().enumerate() {
                        let expected = finely(&volume, axis, &bundle, lane, class as u8 + 1);
                        let error = (f64::from(sums[lane]) - expected).abs() / expected.max(1.0);
                        worst = worst.max(error);
                        assert!(error < 2e-5, "{name}, axis {axis}, {apart} apart, lane {lane}, class {class}: {error:e}");
                    }
                }
                let swapped = (f64::from(portable[1][0]) - finely(&volume, axis, &bundle, 0, 1)).abs();
                assert!(swapped > 1e-2, "the control: the other material differs");
                every_kind_of_lanes_agrees(&grid, &bundle, &layers, &portable, &format!("{name}, axis {axis}, {apart} apart"));
            }
        }
        println!("{name}: worst error {worst:.1e}");
    }
    for wanted in [Fit::Small, Fit::Square, Fit::Memory] {
        assert!(fits.contains(&wanted), "{wanted:?} was not tried");
    }
}

#[test]
fn windows_of_sixteen_columns_hold_what_is_wide_and_flat() {
    let volume = layered();
    let cells = Cells::new(&volume, None).expect("few materials");
    let slabs = Slabs::new(&volume, &cells).expect("small");
    for axis in 0..3 {
        slabs.prepare(axis, &volume, &cells);
        let grid = slabs.grid(axis).expect("prepared");
        for (flat, wanted) in [(0.1, Fit::Wide), (0.8, Fit::Broad)] {
            let mut stream = Stream::new(9, 0, axis as u32, Purpose::Evaluation);
            let mut bundle = bundle(&mut stream, 1.0, grid.voxels);
            // Flat along b: rows `flat` apart, columns 2 apart.
            let middle = [0.5 * f64::from(grid.voxels[0]), 0.5 * f64::from(grid.voxels[1])];
            let place =
                |x: usize, lane: usize| middle[x] + [2.0, flat][x] * (if x == 0 { lane % 4 } else { lane / 4 } as f64 - 1.5);
            bundle.at = std::array::from_fn(|x| std::array::from_fn(|lane| place(x, lane)));
            bundle.corners.at = std::array::from_fn(|x| [0, 3, 12, 15].map(|lane| place(x, lane)));
            let spread = [6.0 + bundle.slope[0][0].abs(), 3.0 * flat + bundle.slope[1][0].abs()];
            assert_eq!(fit(spread, BROAD_ROWS), wanted, "{spread:?}");
            let mut layers = Layers::default();
            layers.fill(&grid, &bundle.corners, bundle.c_reference);
            let mut portable = [[0.0f32; LANES]; MOST_MATERIALS];
            cross(Portable, &grid, &bundle, &layers, &mut portable);
            let expected = finely(&volume, axis, &bundle, 6, 1);
            assert!((f64::from(portable[0][6]) - expected).abs() < 2e-5 * expected.max(1.0), "{} {expected}", portable[0][6]);
            every_kind_of_lanes_agrees(&grid, &bundle, &layers, &portable, &format!("axis {axis}, {wanted:?}"));
        }
    }
}

/// Every other brick along each axis is filled with a density of its own; between them it varies.
pub fn filled_bricks(size: [usize; 3]) -> Volume {
    let filled = |at: [usize; 3]| {
        // Cells n and n + 1 share voxel n.
        let brick = at.map(|n| (n + 1) / 8);
        let within = at.map(|n| (n + 1) % 8);
        let even = (0..3).all(|axis| brick[axis] % 2 == 0 || within[axis] == 0 && brick[axis] % 2 == 1);
        // A voxel on the upper face of an even brick belongs to the odd one as well.
        let own: [usize; 3] =
            std::array::from_fn(|axis| if within[axis] == 0 && brick[axis] % 2 == 1 { brick[axis] - 1 } else { brick[axis] });
        match even {
            true => (1, 1.0 + 1e-3 * (own[0] + 20 * own[1] + 400 * own[2]) as f32),
            false => (1, 0.5 + 0.01 * ((at[0] * 31 + at[1] * 17 + at[2] * 7) % 13) as f32),
        }
    };
    volume(size, DAffine3::IDENTITY, &[0], filled)
}

#[test]
fn what_is_filled_with_one_density_is_crossed_at_once_and_right() {
    let mut stream = Stream::new(11, 0, 0, Purpose::Evaluation);
    for size in [[36, 36, 40], [120, 120, 112]] {
        let volume = filled_bricks(size);
        let cells = Cells::new(&volume, None).expect("one material");
        let slabs = Slabs::new(&volume, &cells).expect("small");
        let mut at_once = 0;
        for axis in 0..3 {
            slabs.prepare(axis, &volume, &cells);
            let grid = slabs.grid(axis).expect("prepared");
            let even: usize = size.map(|n| (n + 1).div_ceil(8).div_ceil(2)).iter().product();
            assert_eq!(grid.fillings.len(), even.min(255), "one each, as far as the numbers go");
            for round in 0..20 {
                let mut bundle = bundle(&mut stream, 0.3, grid.voxels);
                for x in 0..2 {
                    let shift = f64::from(grid.voxels[x]) * 0.7 * (stream.uniform() - 0.5);
                    bundle.at[x].iter_mut().chain(&mut bundle.corners.at[x]).for_each(|at| *at += shift);
                    bundle.slope[x] = bundle.slope[x].map(|slope| 0.2 * slope);
                    bundle.corners.slope[x] = bundle.corners.slope[x].map(|slope| 0.2 * slope);
                }
                let mut layers = Layers::default();
                layers.fill(&grid, &bundle.corners, bundle.c_reference);
                let layers_of_bricks = (0..grid.voxels[2]).step_by(8);
                at_once += layers_of_bricks.filter(|slab| layers.filling(*slab) != 0).count();
                let mut portable = [[0.0f32; LANES]; MOST_MATERIALS];
                cross(Portable, &grid, &bundle, &layers, &mut portable);
                for lane in [0, 9] {
                    let expected = finely(&volume, axis, &bundle, lane, 1);
                    let error = (f64::from(portable[0][lane]) - expected).abs() / expected;
                    assert!(error < 2e-5, "{size:?}, axis {axis}, round {round}, lane {lane}: {error:e}");
                }
                every_kind_of_lanes_agrees(&grid, &bundle, &layers, &portable, &format!("{size:?}, axis {axis}, round {round}"));
            }
        }
        assert!(at_once > 10, "{at_once} layers");
    }
}

#[test]
fn sixteen_columns_and_four_rows_are_a_window_of_their_own() {
    assert_eq!(fit([8.0, 1.5], BROAD_ROWS), Fit::Wide);
    assert_eq!(fit([5.0, 1.5], BROAD_ROWS), Fit::Small);
    assert_eq!(fit([5.0, 5.0], BROAD_ROWS), Fit::Square);
    assert_eq!(fit([7.1, 2.5], BROAD_ROWS), Fit::Broad);
    assert_eq!(fit([f64::NAN, 1.0], BROAD_ROWS), Fit::Memory);
}

#[test]
fn validity_is_that_of_the_cell_walker() {
    let size = [30, 26, 34];
    let mut scene = empty(&["water", "bone_cortical"]);
    let turn = DQuat::from_rotation_y(0.5) * DQuat::from_rotation_x(0.2);
    let affine = placed(size, DVec3::new(0.0, 0.0, 600.0), DVec3::new(1.5, 1.2, 1.4), turn);
    let mut grid = volume(size, affine, &[0, 1], |[i, j, k]| match (i + 2 * j + 3 * k) % 40 {
        n if n < 22 => (0, 0.0),
        n if n < 34 => (1, 1.0),
        _ => (2, 1.8),
    });
    grid.truncated_at_faces = true;
    // Nothing is known outside a cylinder.
    let outside = |index: usize| (index % 30) as f64 - 15.0;
    grid.unknown = (0..grid.class.len()).map(|index| outside(index).hypot((index / 30 % 26) as f64 - 13.0) > 14.5).collect();
    for (voxel, unknown) in grid.unknown.iter().enumerate() {
        if *unknown {
            (grid.class[voxel], grid.density_g_per_cm3[voxel]) = (0, 0.0);
        }
    }
    scene = scene.with(Matter::Volume(Arc::new(grid))).with(solids(&[sphere(DVec3::new(5.0, 3.0, 600.0), 6.0, 1, 1.9)]));
    let mut renderer = Renderer::new(DeviceChoice::Cpu, &Reporter::silent()).expect("cpu");
    let mut render = |sampling| {
        let goal = Some(Goal::Explicit { sampling, energies: None, step_px: 1 });
        let options = Options { quantity: Quantity::LineIntegral, goal, ..Options::default() };
        renderer.render(&scene, &options).expect("renders")
    };
    let (slabs, cells) = (render(Sampling::ExactSlabs), render(Sampling::ExactCells));
    assert_eq!((slabs.plan["sampling"].as_str(), cells.plan["sampling"].as_str()), (Some("exact_slabs"), Some("exact_cells")));
    let differ = slabs.valid.pixels.iter().zip(&cells.valid.pixels).filter(|(a, b)| a != b).count();
    let valid = cells.valid.pixels.iter().filter(|valid| **valid == 1).count();
    assert!(valid > 500 && valid < 96 * 96 - 500, "{valid}");
    // A ray along an edge between cells may be told either way by rounding.
    assert!(differ <= 2, "{differ} pixels");
    assert!(worst(&slabs.pages[0].pixels, &cells.pages[0].pixels) < 5e-6);
    let fixed = render(Sampling::FixedSlabs);
    assert_eq!(fixed.plan["sampling"].as_str(), Some("fixed_slabs"));
    assert_eq!(fixed.valid.pixels, slabs.valid.pixels, "rounding decides nothing about validity");
}
