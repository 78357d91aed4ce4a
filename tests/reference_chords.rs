//! Chords of every shape in cone-beam geometry. Each case starts from a ray in the shape's own frame whose chord is a formula, and is
//! then moved to a random pixel, distance and roll; sources and detectors inside the shape cut the chord.

use glam::{DQuat, DVec3};
use sidecarm::geometry::Rigid;
use sidecarm::render::reference::Reference;
use sidecarm::scene::Scene;
use sidecarm::scene::model::{Matter, Shape};

use super::scene_support::{Dice, scene, solid, view};

/// A ray in a shape's frame: lengths (mm) from `point` along the unit `direction` at which it is inside.
struct Known {
    shape: Shape,
    point: DVec3,
    direction: DVec3,
    spans: Vec<[f64; 2]>,
    diameter_mm: f64,
    /// Least |distance / radius − 1| from a curved surface.
    tangency: f64,
}

/// A unit vector and one across it.
fn across(dice: &mut Dice) -> (DVec3, DVec3) {
    let turn = dice.rotation();
    (turn * DVec3::Z, turn * DVec3::X)
}

/// Distance from the axis in radii: anything, or within 1e-6 of tangency on either side.
fn impact(dice: &mut Dice) -> f64 {
    match (dice.unit() * 4.0) as u32 {
        0 => 1.0 - 10f64.powf(dice.between(-12.0, -6.0)),
        1 => 1.0 + 10f64.powf(dice.between(-12.0, -6.0)),
        _ => dice.between(0.0, 1.1),
    }
}

/// ½ chord of a unit circle.
fn half_chord(h: f64) -> Option<f64> {
    (h < 1.0).then(|| ((1.0 - h) * (1.0 + h)).sqrt())
}

fn ellipsoid(dice: &mut Dice, ball: bool) -> Known {
    let size = |dice: &mut Dice| 10f64.powf(dice.between(0.0, 1.6));
    let axes = if ball { DVec3::splat(size(dice)) } else { DVec3::new(size(dice), size(dice), size(dice)) };
    // In the space where it is a unit ball.
    let (along, aside) = across(dice);
    let h = impact(dice);
    let length = (axes * along).length();
    Known {
        shape: Shape::Ellipsoid { semi_axes_mm: axes },
        point: axes * aside * h,
        direction: axes * along / length,
        spans: half_chord(h).map(|half| [-half * length, half * length]).into_iter().collect(),
        diameter_mm: 2.0 * axes.max_element(),
        tangency: (h - 1.0).abs(),
    }
}

fn cuboid(dice: &mut Dice) -> Known {
    let half = DVec3::new(dice.between(1.0, 30.0), dice.between(1.0, 30.0), dice.between(1.0, 30.0));
    let point = half * DVec3::new(dice.between(-1.2, 1.2), dice.between(-1.2, 1.2), dice.between(-1.2, 1.2));
    let axes = [DVec3::X, DVec3::Y, DVec3::Z];
    let direction = match (dice.unit() * 3.0) as usize {
        // Parallel to an edge, or to a face.
        0 => axes[(dice.unit() * 3.0) as usize],
        1 => {
            let (sine, cosine) = dice.between(0.1, 1.4).sin_cos();
            DVec3::new(sine, cosine, 0.0)
        }
        _ => across(dice).0,
    };
    let (mut from, mut to) = (f64::NEG_INFINITY, f64::INFINITY);
    for axis in 0..3 {
        let (p, d) = (point[axis], direction[axis]);
        if d != 0.0 {
            from = from.max((-half[axis] * d.signum() - p) / d);
            to = to.min((half[axis] * d.signum() - p) / d);
        } else if p.abs() > half[axis] {
            to = f64::NEG_INFINITY;
        }
    }
    let spans = if from < to { vec![[from, to]] } else { Vec::new() };
    Known {
        shape: Shape::Cuboid { half_size_mm: half },
        point,
        direction,
        spans,
        diameter_mm: 2.0 * half.length(),
        tangency: 1.0,
    }
}

/// A rod, or a tube whose lumen has `hollow` of the radius.
fn cylinder(dice: &mut Dice, hollow: f64) -> Known {
    let (radius_mm, length_mm) = (10f64.powf(dice.between(0.0, 1.0)), dice.between(5.0, 60.0));
    let inner_radius_mm = hollow * radius_mm;
    let (aside, along) = {
        let (sine, cosine) = dice.between(0.0, std::f64::consts::TAU).sin_cos();
        (DVec3::new(-sine, cosine, 0.0), DVec3::new(cosine, sine, 0.0))
    };
    let oblique = |dice: &mut Dice| if dice.unit() < 0.5 { std::f64::consts::FRAC_PI_2 } else { dice.between(0.05, 1.5) };
    let (angle, h, m) = match (dice.unit() * 3.0) as u32 {
        // Along the axis: in the lumen, in the wall, beside it.
        0 => (0.0, dice.between(0.0, 1.3) * radius_mm, 0.0),
        1 => (10f64.powf(dice.between(-12.0, -3.0)), dice.between(0.0, 1.3) * radius_mm, dice.between(-0.1, 0.1) * radius_mm),
        _ => {
            let circle = if hollow > 0.0 && dice.unit() < 0.5 { inner_radius_mm } else { radius_mm };
            (oblique(dice), impact(dice) * circle, dice.between(-1.0, 1.0) * radius_mm)
        }
    };
    let (sine, cosine) = angle.sin_cos();
    let z = dice.between(0.1, 0.9) * length_mm;
    let cosine = if angle == std::f64::consts::FRAC_PI_2 { 0.0 } else { cosine };
    let caps = if cosine == 0.0 { [f64::NEG_INFINITY, f64::INFINITY] } else { [-z / cosine, (length_mm - z) / cosine] };
    let in_circle = |radius: f64| -> Option<[f64; 2]> {
        if sine == 0.0 {
            return (h.hypot(m) < radius).then_some(caps);
        }
        let half = radius * half_chord(h / radius)?;
        let (from, to) = (((-m - half) / sine).max(caps[0]), ((half - m) / sine).min(caps[1]));
        (from < to).then_some([from, to])
    };
    let mut spans = Vec::new();
    if let Some([from, to]) = in_circle(radius_mm) {
        match Some(inner_radius_mm).filter(|radius| *radius > 0.0).and_then(in_circle) {
            Some([hole_from, hole_to]) => spans.extend([[from, hole_from], [hole_to, to]]),
            None => spans.push([from, to]),
        }
    }
    let tangency = [radius_mm, inner_radius_mm].into_iter().filter(|r| *r > 0.0).map(|r| (h / r - 1.0).abs());
    Known {
        shape: Shape::Cylinder { length_mm, radius_mm, inner_radius_mm },
        point: aside * h + along * m + DVec3::Z * z,
        direction: along * sine + DVec3::Z * cosine,
        spans,
        diameter_mm: 2.0 * radius_mm,
        tangency: if angle == 0.0 { 1.0 } else { tangency.fold(1.0, f64::min) },
    }
}

/// Where along the ray the point of the case lies: well in front, near the source, near the detector.
fn distance_mm(dice: &mut Dice, known: &Known, end_mm: f64) -> f64 {
    let near = dice.between(-0.5, 0.5) * known.diameter_mm;
    match (dice.unit() * 4.0) as u32 {
        0 => near,
        1 => end_mm + near,
        _ => dice.between(150.0, 850.0),
    }
}

#[derive(Default, Debug)]
struct Tally {
    cases: usize,
    hits: usize,
    cut: usize,
    tangent: usize,
    worst: f64,
    worst_tangent: f64,
}

fn check(mut case: impl FnMut(&mut Dice) -> Known, seed: u64, grow: f64) -> Tally {
    let mut dice = Dice::new(seed);
    let mut tally = Tally::default();
    let view = view(600.0);
    let mut scene: Scene = scene(&["water"], vec![Matter::Solids(Vec::new())]);
    for _ in 0..3000 {
        let known = case(&mut dice);
        let pixel = [dice.between(0.0, 63.0), dice.between(0.0, 47.0)];
        let per_depth = DVec3::new((pixel[0] - 31.5) / 5000.0, (pixel[1] - 23.5) / 5000.0, 1.0);
        let (unit, end_mm) = (per_depth.normalize(), 1000.0 * per_depth.length());
        let at_mm = distance_mm(&mut dice, &known, end_mm);
        let roll = DQuat::from_axis_angle(unit, dice.between(-3.0, 3.0));
        let rotation = (roll * DQuat::from_rotation_arc(known.direction, unit)).normalize();
        let place = DVec3::new(0.0, 0.0, -600.0) + unit * at_mm;
        let pose = Rigid { rotation, translation_mm: place - rotation * known.point };
        scene.objects[0].matter = Matter::Solids(vec![solid(known.shape, pose, 0)]);
        let found = 10.0 * Reference::new(&scene, &view).expect("a good view").area_densities(pixel)[0];
        let length = |[from, to]: &[f64; 2]| (to.min(end_mm - at_mm) - from.max(-at_mm)).max(0.0);
        let expected = grow * known.spans.iter().map(length).sum::<f64>();
        let whole: f64 = known.spans.iter().map(|[from, to]| to - from).sum();
        let error = (found - expected).abs() / known.diameter_mm;
        tally.cases += 1;
        tally.hits += usize::from(expected > 0.0);
        tally.cut += usize::from(expected > 0.0 && expected < 0.999 * whole);
        if known.tangency < 1.001e-6 {
            tally.tangent += 1;
            tally.worst_tangent = tally.worst_tangent.max(error);
        } else {
            tally.worst = tally.worst.max(error);
        }
    }
    tally
}

fn judge(what: &str, tally: &Tally, curved: bool) {
    println!("{what}: {tally:?}");
    assert!(tally.cases == 3000 && tally.hits > 800 && tally.cut > 100, "{what}: {tally:?}");
    assert!(tally.worst <= 1e-9, "{what}: {:e} of the diameter", tally.worst);
    assert!(tally.worst_tangent <= 1e-6, "{what}: {:e} of the diameter at tangency", tally.worst_tangent);
    assert!(!curved || tally.tangent > 300, "{what}: {tally:?}");
}

#[test]
fn chords_are_within_1e_9_of_the_diameter_in_any_pose() {
    judge("sphere", &check(|dice| ellipsoid(dice, true), 21, 1.0), true);
    judge("ellipsoid", &check(|dice| ellipsoid(dice, false), 22, 1.0), true);
    judge("box", &check(cuboid, 23, 1.0), false);
    judge("rod", &check(|dice| cylinder(dice, 0.0), 24, 1.0), true);
    judge(
        "tube",
        &check(
            |dice| {
                let hollow = dice.between(0.3, 0.95);
                cylinder(dice, hollow)
            },
            25,
            1.0,
        ),
        true,
    );
}

/// The control: chords that are one part in 10⁸ longer are told from the right ones.
#[test]
fn one_part_in_a_hundred_million_is_seen() {
    let mut cases = 0;
    for (seed, case) in
        [(21, (|dice| ellipsoid(dice, true)) as fn(&mut Dice) -> Known), (23, cuboid), (24, |dice| cylinder(dice, 0.0))]
    {
        let tally = check(case, seed, 1.0 + 1e-8);
        assert!(tally.worst > 2e-9, "{tally:?}");
        cases += 1;
    }
    assert_eq!(cases, 3);
}
