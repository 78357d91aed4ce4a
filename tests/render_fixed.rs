//! Crossing in 16-bit fixed point: kinds of lanes against each other bit for bit, sums against the field itself, images against the
//! yardstick.

use std::sync::Arc;

use glam::{DAffine3, DQuat, DVec3};
use sidecarm::geometry::Intrinsics;
use sidecarm::gpu::DeviceChoice;
use sidecarm::random::{Purpose, Stream};
use sidecarm::render::achieved::Achieved;
use sidecarm::render::cells::Cells;
use sidecarm::render::cpu::cross_fixed::cross_fixed;
use sidecarm::render::cpu::edges::{Bundle, BundleSums, Corners, Layers};
use sidecarm::render::cpu::fixed_lanes::{FixedLanes, WORDS};
use sidecarm::render::cpu::fixed_windows::BROAD_ROWS;
use sidecarm::render::cpu::lanes::{LANES, Portable};
use sidecarm::render::cpu::window_places::{Fit, fit};
use sidecarm::render::pilot::words_off;
use sidecarm::render::plan::Sampling;
use sidecarm::render::slabs::{MOST_MATERIALS, SlabGrid, Slabs};
use sidecarm::render::{Goal, Options, Quantity, Rendered, Renderer};
use sidecarm::reporter::Reporter;
use sidecarm::scene::model::{Matter, Scene, Volume};

use crate::render_scenes::{With, empty, placed, solids, sphere, volume};
use crate::render_slabs::{filled_bricks, finely, layered, lumpy};

/// Thirty-two rays: eight columns `apart[0]` voxels from each other, four rows `apart[1]`, all with one slope but for a little.
fn pair(centre: [f64; 2], apart: [f64; 2], slope: [f64; 2], voxels: [i32; 3]) -> ([Bundle; 2], Corners) {
    let middle = 0.5 * f64::from(voxels[2]);
    let place =
        |x: usize, column: usize, row: usize| centre[x] + apart[x] * if x == 0 { column as f64 - 3.5 } else { row as f64 - 1.5 };
    let tilt = |x: usize, column: usize, row: usize| slope[x] * (1.0 - 1e-4 * if x == 0 { column as f64 } else { row as f64 });
    let ends = [(0, 0), (7, 0), (0, 3), (7, 3)];
    let corners = Corners {
        at: std::array::from_fn(|x| ends.map(|(column, row)| place(x, column, row))),
        slope: std::array::from_fn(|x| ends.map(|(column, row)| tilt(x, column, row))),
    };
    let bundle = |half: usize| {
        let (column, row) = (|lane: usize| lane % 8, |lane: usize| 2 * half + lane / 8);
        // Inside the grid, and not from slice to slice.
        let end = |l: usize, forward: f64| {
            let mut end = forward * (0.5 * f64::from(voxels[2]) - 0.7 - 0.05 * l as f64);
            for (x, voxels) in voxels.into_iter().enumerate().take(2) {
                let (at, slope) = (place(x, column(l), row(l)), tilt(x, column(l), row(l)));
                let face = if forward * slope > 0.0 { f64::from(voxels) } else { 1.0 };
                if slope != 0.0 && (face - at) / slope * forward < end * forward {
                    end = (face - at) / slope;
                }
            }
            middle + end
        };
        Bundle {
            at: std::array::from_fn(|x| std::array::from_fn(|l| place(x, column(l), row(l)))),
            slope: std::array::from_fn(|x| std::array::from_fn(|l| tilt(x, column(l), row(l)))),
            c_reference: middle,
            from: std::array::from_fn(|l| end(l, -1.0)),
            to: std::array::from_fn(|l| end(l, 1.0)),
            corners,
        }
    };
    ([bundle(0), bundle(1)], corners)
}

fn crossed<S: FixedLanes>(s: S, grid: &SlabGrid, (bundles, corners): &([Bundle; 2], Corners)) -> [BundleSums; 2] {
    let mut layers = Layers::default();
    layers.fill(grid, corners, bundles[0].c_reference);
    let mut sums = [[[0.0f32; LANES]; MOST_MATERIALS]; 2];
    let [first, second] = &mut sums;
    let [upper, lower] = bundles;
    cross_fixed(s, grid, [upper, lower], corners, &layers, [first, second]);
    sums
}

/// Compares some lanes with the field itself, and all lanes with those that this processor has. Returns the worst error over what plans take it to be.
fn check(volume: &Volume, slabs: &Slabs, axis: usize, rays: &([Bundle; 2], Corners), what: &str) -> f64 {
    let grid = slabs.rounded_grid(axis).expect("rounded");
    let portable = crossed(Portable, &grid, rays);
    let mut worst = 0.0f64;
    for (half, lane) in [(0, 0), (0, 7), (1, 3), (1, 15)] {
        let bundle = &rays.0[half];
        let length = bundle.to[lane] - bundle.from[lane];
        for (material, (found, word)) in portable[half].iter().zip(grid.word_g_per_cm3).enumerate() {
            let word = f64::from(word);
            if word == 0.0 {
                continue;
            }
            let expected = finely(volume, axis, bundle, lane, material as u8 + 1);
            let error = (f64::from(found[lane]) - expected).abs() / (word * words_off(length));
            worst = worst.max(error);
            assert!(error < 1.0, "{what}, axis {axis}, lane {half} {lane}, material {material}: {error} of what is stated");
        }
    }
    #[cfg(target_arch = "x86_64")]
    {
        let same = |kind: &str, sums: &[BundleSums; 2]| {
            for (a, b) in sums.iter().flatten().flatten().zip(portable.iter().flatten().flatten()) {
                // Where groups begin is a sum of f32, fused or not.
                assert!((a - b).abs() <= 1e-4 * b.max(1.0), "{kind}, {what}, axis {axis}: {a} {b}");
            }
        };
        if let Some(avx512) = pulp::x86::V4::try_new() {
            same("AVX-512", &crossed(avx512, &grid, rays));
        }
        if let Some(avx2) = pulp::x86::V3::try_new() {
            same("AVX2", &crossed(avx2, &grid, rays));
        }
    }
    worst
}

fn rounded(volume: &Volume) -> (Cells, Slabs) {
    let cells = Cells::new(volume, None).expect("few materials");
    let slabs = Slabs::new(volume, &cells).expect("small");
    (0..3).for_each(|axis| slabs.round(axis, volume, &cells));
    (cells, slabs)
}

#[test]
fn fixed_point_sums_the_field_in_every_window_and_at_every_slope() {
    let mut stream = Stream::new(21, 0, 0, Purpose::Evaluation);
    let mut fits = Vec::new();
    for (name, volume) in [("lumpy", lumpy()), ("layered", layered()), ("filled bricks", filled_bricks([36, 36, 40]))] {
        let (_, slabs) = rounded(&volume);
        let mut worst = 0.0f64;
        for axis in 0..3 {
            let grid = slabs.rounded_grid(axis).expect("rounded");
            let centre = [0.5 * f64::from(grid.voxels[0]), 0.5 * f64::from(grid.voxels[1])];
            // As steep as rays are, along the faces, barely off them, and nodes met exactly.
            let slopes = [[1.0, 0.9], [-1.0, -1.0], [0.0, 0.0], [1e-6, -3e-5], [0.5, -0.5], [-0.37, 0.21]];
            for (apart, wanted) in [
                ([0.1, 0.1], Fit::Small),
                ([1.0, 0.2], Fit::Wide),
                ([0.5, 1.0], Fit::Square),
                ([1.3, 1.2], Fit::Broad),
                ([2.5, 2.5], Fit::Memory),
            ] {
                for slope in slopes {
                    let shift = [stream.uniform() - 0.5, if slope[1] == 0.0 { 0.0 } else { stream.uniform() - 0.5 }];
                    let rays = pair([centre[0] + shift[0], centre[1].round() + shift[1]], apart, slope, grid.voxels);
                    let spread = |x: usize| apart[x] * [7.0, 3.0][x] + slope[x].abs();
                    fits.push((wanted, fit([spread(0), spread(1)], BROAD_ROWS)));
                    worst = worst.max(check(&volume, &slabs, axis, &rays, &format!("{name}, {apart:?} apart, slope {slope:?}")));
                }
            }
        }
        println!("{name}: at most {worst:.2} of what is stated");
    }
    for wanted in [Fit::Small, Fit::Wide, Fit::Square, Fit::Broad, Fit::Memory] {
        assert!(fits.iter().any(|(_, fit)| *fit == wanted), "{wanted:?} was not tried");
    }
    assert_eq!(fit([f64::NAN, 1.0], BROAD_ROWS), Fit::Memory);
}

#[test]
fn the_comparison_with_the_field_sees_a_thousandth() {
    let volume = lumpy();
    let (cells, _) = rounded(&volume);
    let mut denser = volume.clone();
    denser.density_g_per_cm3.iter_mut().for_each(|rho| *rho *= 1.001);
    let slabs = Slabs::new(&denser, &cells).expect("small");
    slabs.round(2, &denser, &cells);
    let grid = slabs.rounded_grid(2).expect("rounded");
    let rays = pair([10.0, 12.0], [0.1, 0.1], [0.2, 0.1], grid.voxels);
    let sums = crossed(Portable, &grid, &rays);
    let expected = finely(&volume, 2, &rays.0[0], 4, 1);
    let length = rays.0[0].to[4] - rays.0[0].from[4];
    assert!((f64::from(sums[0][0][4]) - expected).abs() > f64::from(grid.word_g_per_cm3[0]) * words_off(length));
}

#[cfg(target_arch = "x86_64")]
#[test]
fn words_are_the_same_bits_on_all_lanes() {
    let (Some(wide), other) = (pulp::x86::V4::try_new(), Portable) else { return };
    let mut stream = Stream::new(8, 0, 0, Purpose::Evaluation);
    let extremes = [0u16, 1, 2, 32_766, 32_767, 32_768, 32_769, 65_534, 65_535];
    for round in 0..200 {
        let mut draw = || -> [u16; WORDS] {
            std::array::from_fn(|_| match stream.next_u32() {
                n if n % 3 == 0 => extremes[(n / 3) as usize % extremes.len()],
                n => (n >> 8) as u16,
            })
        };
        let (x, y, z, t) = (draw(), draw(), draw(), draw());
        let (a, b) = (wide.words(&x), wide.words(&y));
        let same = |what: &str, found: core::arch::x86_64::__m512i, expected: [u16; WORDS]| {
            assert_eq!(wide.to_words(found), expected, "{what}, round {round}: {x:?} {y:?}");
        };
        same("add", wide.w_add(a, b), other.w_add(x, y));
        same("sub", wide.w_sub(a, b), other.w_sub(x, y));
        same("less", wide.w_less(a, b), other.w_less(x, y));
        same("min", wide.w_min(a, b), other.w_min(x, y));
        same("max", wide.w_max(a, b), other.w_max(x, y));
        same("half", wide.w_half(a), other.w_half(x));
        same("scale", wide.w_scale(a, b), other.w_scale(x, y));
        let few = y.map(|n| n & 15);
        same("shift", wide.w_shift(a, wide.words(&few)), other.w_shift(x, few));
        let (k, l) = (wide.w_below(a, b), other.w_below(x, y));
        let (m, n) = (wide.w_below(wide.words(&z), wide.words(&t)), other.w_below(z, t));
        same("choose", wide.w_choose(k, a, b), other.w_choose(l, x, y));
        same("and", wide.w_keep(wide.k_and(k, m), a), other.w_keep(other.k_and(l, n), x));
        same("or", wide.w_keep(wide.k_or(k, m), a), other.w_keep(other.k_or(l, n), x));
        assert_eq!(wide.k_any(k), other.k_any(l));
        let table = [a, b, wide.words(&z), wide.words(&t)];
        same("32", wide.look_32(a, b), other.look_32(x, y));
        same("64", wide.look_64([a, b], table[2]), other.look_64([x, y], z));
        same("128", wide.look_128(table, b), other.look_128([x, y, z, t], y));
    }
}

fn render(scene: &Scene, sampling: Option<Sampling>) -> Rendered {
    let mut renderer = Renderer::new(DeviceChoice::Cpu, &Reporter::silent()).expect("cpu");
    let goal = sampling.map(|sampling| Goal::Explicit { sampling, energies: None, step_px: 1 });
    let options = Options { quantity: Quantity::LineIntegral, goal, reference: sampling.is_none(), ..Options::default() };
    renderer.render(scene, &options).expect("renders")
}

/// A grid of two materials, turned, with a hollow tool through it and a ball that overlaps both.
fn with_tools(density_of_second: f32) -> Scene {
    let size = [40, 36, 44];
    let turn = DQuat::from_rotation_y(0.6) * DQuat::from_rotation_x(-0.3);
    let affine = placed(size, DVec3::new(0.0, 0.0, 600.0), DVec3::new(1.5, 1.2, 1.4), turn);
    let filled = |[i, j, k]: [usize; 3]| match (i * 31 + j * 17 + k * 7) % 13 {
        n if n < 4 => (0, 0.0),
        n if n < 10 => (1, 0.8 + n as f32 * 0.05),
        n => (2, density_of_second + n as f32 * 0.01),
    };
    let mut scene = empty(&["water", "bone_cortical", "titanium"]);
    scene = scene.with(Matter::Volume(Arc::new(volume(size, affine, &[0, 1], filled))));
    scene.with(solids(&[sphere(DVec3::new(8.0, -4.0, 600.0), 7.0, 2, 4.5), sphere(DVec3::new(10.0, 0.0, 590.0), 6.0, 1, 1.9)]))
}

#[test]
fn images_in_fixed_point_stay_within_what_they_state() {
    for (what, scene) in [("bone", with_tools(1.5)), ("dense", with_tools(8.0))] {
        let (fixed, truth) = (render(&scene, Some(Sampling::FixedSlabs)), render(&scene, None));
        assert_eq!(fixed.plan["sampling"].as_str(), Some("fixed_slabs"));
        let achieved = Achieved::of(&fixed.pages[0].pixels, &truth.pages[0].pixels, 0.0);
        println!("{what}: stated {:.1e}, achieved {achieved:?}", fixed.stated_error);
        assert!(achieved.error <= fixed.stated_error && achieved.worst < 3.0 * fixed.stated_error, "{what}: {achieved:?}");
        let other = render(&with_tools(if what == "bone" { 1.53 } else { 8.2 }), None);
        let achieved = Achieved::of(&fixed.pages[0].pixels, &other.pages[0].pixels, 0.0);
        assert!(achieved.error > fixed.stated_error, "the control: {what}, {achieved:?}");
    }
}

#[test]
fn what_cannot_be_rounded_is_crossed_exactly() {
    let sampling = |scene: &Scene| render(scene, Some(Sampling::FixedSlabs)).plan["sampling"].clone();
    let five = volume(
        [20, 20, 20],
        placed([20; 3], DVec3::new(0.0, 0.0, 600.0), DVec3::ONE, DQuat::IDENTITY),
        &[0, 1, 2, 3, 4],
        |[i, ..]| ((i % 5 + 1) as u8, 1.0),
    );
    let materials = ["water", "bone_cortical", "titanium", "adipose", "aluminium"];
    assert_eq!(
        sampling(&empty(&materials).with(Matter::Volume(Arc::new(five)))),
        "exact_cells",
        "more materials than slabs take"
    );
    let mut coarse = with_tools(1.5);
    if let Some(view) = &mut coarse.view {
        // Pixels of several voxels.
        view.intrinsics = Intrinsics { fx: 200.0, fy: 200.0, ..view.intrinsics };
    }
    coarse.detector.pitch_mm *= 10.0;
    assert_eq!(sampling(&coarse), "exact_cells", "no window holds the bundles");
    let mut grid = volume([8, 8, 8], DAffine3::IDENTITY, &[0], |_| (1, 1.0));
    grid.density_g_per_cm3[77] = f32::NAN;
    let cells = Cells::new(&grid, None).expect("one material");
    let slabs = Slabs::new(&grid, &cells).expect("small");
    slabs.round(0, &grid, &cells);
    assert!(!slabs.rounds() && slabs.rounded_grid(0).is_none(), "a word cannot be NaN");
}
