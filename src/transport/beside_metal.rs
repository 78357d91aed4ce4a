//! Flights beside metal and through it: what they cost, and that they are those of a scene in which every flight knew the metal everywhere.

use std::sync::Arc;

use glam::{DAffine3, DVec3};

use super::contents::Content;
use super::fixture::{scene, solid};
use super::flight::{End, Medium, Ray, Space};
use super::matter::{Mix, draw_at, things_of};
use super::stream::Stream;
use crate::scene::model::{Matter, Scene, Shape, Volume};

/// 20 cm of tissue as a CT has it, from −5 to 195 mm each way.
fn ct() -> Matter {
    let mut stream = Stream::new(5, 0);
    Matter::Volume(Arc::new(Volume {
        size: [20; 3],
        lps_from_voxel: DAffine3::from_scale(DVec3::splat(10.0)),
        density_g_per_cm3: (0..8000).map(|_| (0.9 + 0.2 * stream.uniform()) as f32).collect(),
        class: vec![1; 8000],
        class_materials: vec![0],
        truncated_at_faces: false,
        unknown: Vec::new(),
    }))
}

/// A steel rod that lies across, and a tube that crosses it: 6 and 10 mm thick, times `scale`.
fn with_metal(scale: f64) -> Scene {
    let rod = Shape::Cylinder { length_mm: 120.0, radius_mm: 3.0 * scale, inner_radius_mm: 0.0 };
    let tube = Shape::Cylinder { length_mm: 100.0, radius_mm: 5.0 * scale, inner_radius_mm: 3.5 * scale };
    // Turned from +z to about +x, and to −y.
    let rod = solid(rod, DVec3::new(35.0, 95.0, 95.0), DVec3::new(0.0, 1.4, 0.0), 1, 8.0);
    let tube = solid(tube, DVec3::new(95.0, 150.0, 110.0), DVec3::new(1.5, 0.1, 0.0), 1, 8.0);
    scene(&["water", "steel_316l"], vec![ct(), Matter::Solids(vec![rod, tube])])
}

/// The same space, in which every flight past metal is told of it.
fn blunt(mut space: Space) -> (Space, usize) {
    let mut dulled = 0;
    for content in &mut space.cells.contents {
        if let Content::Mixed(mixture) = content {
            dulled += usize::from(mixture.dense.take().is_some());
        }
    }
    (space, dulled)
}

/// Random numbers that `work` takes: a measure of what it tries.
fn numbers(stream: &mut Stream, work: impl FnOnce(&mut Stream)) -> usize {
    let mut before = stream.clone();
    work(stream);
    let end = stream.clone().next_u64();
    for count in 0..1_000_000 {
        if before.clone().next_u64() == end {
            return count;
        }
        before.next_u64();
    }
    panic!("it took other numbers");
}

/// A ray along the beam, about +z, that starts over (x, y).
fn down(space: &Space, x: f64, y: f64) -> Ray {
    space.enter(DVec3::new(x, y, -50.0), DVec3::new(0.02, 0.01, 1.0).normalize()).expect("meets the CT").0
}

/// The same ray in another space: its boxes have other numbers.
fn ray_in(space: &Space, ray: Ray) -> Ray {
    space.enter(ray.position, ray.direction).expect("the same bounds").0
}

/// Beside a wire a flight tried its collisions at steel's density, forty times as often as tissue asks for.
#[test]
fn what_flies_past_metal_pays_nothing_for_it() {
    let (plain, metal) = (scene(&["water", "steel_316l"], vec![ct()]), with_metal(0.3));
    let space = |scene| Space::new(things_of(scene), DVec3::Z).expect("matter");
    let (without, with) = (space(&plain), space(&metal));
    let (told, dulled) = blunt(space(&metal));
    assert!(dulled > 2, "{dulled}");
    // Thin tissue, so that flights come as far as the metal.
    let mut medium = Medium { per_mm: vec![0.005, 0.12], ..Medium::default() };
    let (mut past, mut through, mut draw) = (0, 0, Stream::new(7, 0));
    let mut sums = [[0_usize; 2]; 3];
    for number in 0..4000 {
        let (x, y) = (40.0 + 100.0 * draw.uniform(), 90.0 + 10.0 * draw.uniform());
        let ray = down(&with, x, y);
        if with.things.iter().any(|thing| thing.body.next_stretch(ray.position, ray.direction, 0.0).is_some()) {
            through += 1;
            continue;
        }
        past += 1;
        for (space, sums) in [&without, &with, &told].into_iter().zip(&mut sums) {
            let mut stream = Stream::new(8, number);
            sums[0] += numbers(&mut stream, |stream| {
                space.transmission(ray_in(space, ray), 300.0, &mut medium, stream);
            });
            sums[1] += numbers(&mut stream, |stream| {
                space.fly(&mut ray_in(space, ray), 300.0, &mut medium, stream);
            });
        }
    }
    assert!(past > 1000 && through > 100, "{past} {through}");
    let [without, with, told] = sums.map(|sums| sums.map(|sum| sum as f64));
    for kind in 0..2 {
        assert!(with[kind] < 1.05 * without[kind], "{kind}: {with:?} {without:?}");
        assert!(told[kind] > 2.0 * without[kind], "the control, {kind}: {told:?} {without:?}");
    }
}

/// Where flights end, by the integral of what they meet; and what they end in. The control: told of 4 % more.
#[test]
fn flights_through_metal_end_where_the_integral_says() {
    let scene = with_metal(1.0);
    let space = Space::new(things_of(&scene), DVec3::Z).expect("matter");
    let (told, _) = blunt(Space::new(things_of(&scene), DVec3::Z).expect("matter"));
    let mut medium = Medium { per_mm: vec![0.005, 0.03], ..Medium::default() };
    let things = things_of(&scene);
    let (length_mm, steps, flights) = (210.0, 600_000_u32, 60_000_u32);
    let step_mm = length_mm / f64::from(steps);
    // Through rod and tube; through the tube's lumen; past both, within the boxes that hold the rod.
    let mut struck_any = 0;
    for (number, (x, y)) in [(95.0, 95.0), (93.5, 100.0), (70.0, 97.0)].into_iter().enumerate() {
        let ray = down(&space, x, y);
        let (mut stream, mut mix) = (Stream::new(13, number as u64), Mix::default());
        let (mut depths, mut depth, mut in_steel) = (vec![0.0], 0.0_f64, 0.0);
        for step in 0..steps {
            let point = ray.position + ray.direction * (step_mm * (f64::from(step) + 0.5));
            draw_at(&things, &[0, 1, 2], false, point, &mut stream, &mut mix);
            let per_mm: f64 = mix.parts.iter().map(|(material, density)| density * medium.per_mm[*material as usize]).sum();
            if mix.parts.iter().any(|(material, _)| *material == 1) {
                in_steel += (-depth).exp() * per_mm * step_mm;
            }
            depth += per_mm * step_mm;
            depths.push(depth);
        }
        // Largest distance of the distribution of where flights end from the exponential one of the depth there.
        let distance = |ends_mm: &[f64], scale: f64| {
            let count = f64::from(flights);
            let off = |(n, end_mm): (usize, &f64)| {
                let share = 1.0 - (-scale * depths[((end_mm / step_mm) as usize).min(depths.len() - 1)]).exp();
                (share - n as f64 / count).abs().max((share - (n + 1) as f64 / count).abs())
            };
            ends_mm.iter().enumerate().map(off).fold(0.0, f64::max)
        };
        let bound = 1.95 / f64::from(flights).sqrt();
        for (name, space) in [("apart", &space), ("told", &told)] {
            let (mut ends_mm, mut struck) = (Vec::new(), 0);
            for _ in 0..flights {
                let mut flown = ray_in(space, ray);
                if let End::Collision(material) = space.fly(&mut flown, length_mm, &mut medium, &mut stream) {
                    ends_mm.push(flown.position.distance(ray.position));
                    struck += u32::from(material == 1);
                }
            }
            ends_mm.sort_unstable_by(f64::total_cmp);
            let (right, off) = (distance(&ends_mm, 1.0), distance(&ends_mm, 1.04));
            assert!(right < bound, "ray {number}, {name}: {right}, bound {bound}");
            assert!(off > bound, "the control, ray {number}, {name}: {off}, bound {bound}");
            let share = f64::from(struck) / f64::from(flights);
            let sigma = (in_steel * (1.0 - in_steel) / f64::from(flights)).sqrt();
            assert!((share - in_steel).abs() < 4.5 * sigma + 1e-4, "ray {number}, {name}: {share} in steel, {in_steel}");
            struck_any += struck;
        }
        let arrives = (-depth).exp();
        let beams = (0..flights).map(|_| space.transmission(ray, length_mm, &mut medium, &mut stream));
        let mean = beams.sum::<f64>() / f64::from(flights);
        let most = 4.5 * (arrives / f64::from(flights)).sqrt() + 1e-3 * arrives;
        assert!((mean - arrives).abs() < most, "ray {number}: {mean} arrives, {arrives}");
    }
    assert!(struck_any > 10_000, "{struck_any}");
}
