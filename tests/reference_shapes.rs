//! The reference against chords that can be checked by hand, and against the definition of displacement by bisection.

use glam::{DMat3, DVec3};
use sidecarm::geometry::Rigid;
use sidecarm::render::reference::Reference;
use sidecarm::scene::Scene;
use sidecarm::scene::model::{Matter, Mesh, Shape, Solid};

use super::scene_support::{Dice, ball, contains, scene, solid, view};

/// Lengths in mm of matter of density 1 g/cm³ along the ray through `pixel`, by material.
fn lengths_mm(scene: &Scene, distance_mm: f64, pixel: [f64; 2]) -> Vec<f64> {
    let view = view(distance_mm);
    let reference = Reference::new(scene, &view).expect("a good view");
    reference.area_densities(pixel).iter().map(|area| area * 10.0).collect()
}

/// Source and unit direction of the ray through `pixel`, from K by hand.
fn ray(distance_mm: f64, [u, v]: [f64; 2]) -> (DVec3, DVec3) {
    (DVec3::new(0.0, 0.0, -distance_mm), DVec3::new((u - 31.5) / 5000.0, (v - 23.5) / 5000.0, 1.0).normalize())
}

fn one(shape: Shape, pose: Rigid) -> Scene {
    scene(&["water"], vec![Matter::Solids(vec![solid(shape, pose, 0)])])
}

#[test]
fn a_ball_gives_its_chord_within_1e_9_of_its_diameter() {
    let mut dice = Dice::new(1);
    let mut hits = 0;
    for _ in 0..400 {
        let radius_mm = 10f64.powf(dice.between(-0.5, 2.0));
        let centre = DVec3::new(dice.between(-4.0, 4.0), dice.between(-3.0, 3.0), dice.between(-150.0, 150.0));
        let pixel = [dice.between(-20.0, 84.0), dice.between(-20.0, 68.0)];
        let found = lengths_mm(&scene(&["water"], vec![Matter::Solids(vec![ball(centre, radius_mm, 0)])]), 600.0, pixel)[0];
        let (source, direction) = ray(600.0, pixel);
        let apart_mm = (centre - source).cross(direction).length();
        let expected = if apart_mm < radius_mm { 2.0 * ((radius_mm - apart_mm) * (radius_mm + apart_mm)).sqrt() } else { 0.0 };
        let limit = if (apart_mm / radius_mm - 1.0).abs() < 1e-6 { 1e-6 } else { 1e-9 };
        assert!((found - expected).abs() <= limit * 2.0 * radius_mm, "{found} {expected} radius {radius_mm}");
        hits += usize::from(expected > 0.0);
    }
    assert!(hits > 100, "{hits}");
}

#[test]
fn an_ellipsoid_and_a_box_give_their_chords_in_any_pose() {
    let mut dice = Dice::new(2);
    let mut hits = [0; 2];
    for _ in 0..300 {
        let half = DVec3::new(dice.between(1.0, 20.0), dice.between(1.0, 20.0), dice.between(1.0, 20.0));
        let pose = Rigid { rotation: dice.rotation(), translation_mm: dice.vector(4.0) };
        let pixel = [dice.between(0.0, 63.0), dice.between(0.0, 47.0)];
        let (source, direction) = ray(500.0, pixel);
        let axes = DMat3::from_quat(pose.rotation).transpose();
        let (o, d) = (axes * (source - pose.translation_mm), axes * direction);
        // Ellipsoid: squeezed to a unit ball, the chord is 2 √(1 − h²), stretched back along the ray.
        let (so, sd) = (o / half, d / half);
        let h = so.cross(sd).length() / sd.length();
        let expected = if h < 1.0 { 2.0 * (1.0 - h * h).sqrt() / sd.length() } else { 0.0 };
        let found = lengths_mm(&one(Shape::Ellipsoid { semi_axes_mm: half }, pose), 500.0, pixel)[0];
        assert!((found - expected).abs() <= 1e-9 * 2.0 * half.max_element(), "{found} {expected}");
        hits[0] += usize::from(expected > 0.0);
        // Box: what six half spaces leave of the line.
        let (mut from, mut to) = (f64::NEG_INFINITY, f64::INFINITY);
        for normal in [DVec3::X, DVec3::Y, DVec3::Z].into_iter().flat_map(|n| [n, -n]) {
            let (height, slope) = (normal.abs().dot(half) - normal.dot(o), normal.dot(d));
            if slope > 0.0 { to = to.min(height / slope) } else { from = from.max(height / slope) }
        }
        let expected = (to - from).max(0.0);
        let found = lengths_mm(&one(Shape::Cuboid { half_size_mm: half }, pose), 500.0, pixel)[0];
        assert!((found - expected).abs() <= 1e-9 * 2.0 * half.length(), "{found} {expected}");
        hits[1] += usize::from(expected > 0.0);
    }
    assert!(hits[0] > 100 && hits[1] > 100, "{hits:?}");
}

#[test]
fn a_tube_gives_its_wall_across_and_along() {
    let shape = Shape::Cylinder { length_mm: 30.0, radius_mm: 3.0, inner_radius_mm: 2.0 };
    // Along the optical axis: nothing through the lumen, the length in the wall, with the cone beam's 1/cos.
    let along = one(shape, Rigid::translation(DVec3::new(0.0, 0.0, -15.0)));
    assert_eq!(lengths_mm(&along, 600.0, [31.5, 23.5])[0], 0.0);
    let x_mm = 2.5 / 585.0;
    let in_wall = lengths_mm(&along, 600.0, [31.5 + 5000.0 * x_mm, 23.5])[0];
    assert!((in_wall - 30.0 * (1.0 + x_mm * x_mm).sqrt()).abs() < 1e-9, "{in_wall}");
    // Across: axis along y, the chord of the annulus at offset a from the axis.
    let across = one(
        shape,
        Rigid {
            rotation: glam::DQuat::from_rotation_x(-std::f64::consts::FRAC_PI_2),
            translation_mm: DVec3::new(0.0, -15.0, 0.0),
        },
    );
    let mut cases = 0;
    for u in [31.5, 36.0, 45.0, 50.0, 54.0] {
        let slope = (u - 31.5) / 5000.0;
        let a = 600.0 * slope / (1.0f64 + slope * slope).sqrt();
        let chord = |r: f64| if a < r { 2.0 * (r * r - a * a).sqrt() } else { 0.0 };
        let found = lengths_mm(&across, 600.0, [u, 23.5])[0];
        assert!((found - (chord(3.0) - chord(2.0))).abs() < 6e-9, "{u}: {found}");
        cases += 1;
    }
    assert_eq!(cases, 5);
    // Parallel to a box's faces, on its face, and just outside it.
    let cuboid = one(Shape::Cuboid { half_size_mm: DVec3::new(2.0, 2.0, 5.0) }, Rigid::translation(DVec3::new(2.0, 0.0, 0.0)));
    assert_eq!(lengths_mm(&cuboid, 600.0, [31.5, 23.5])[0], 10.0, "on the face");
    assert_eq!(lengths_mm(&cuboid, 600.0, [31.5 - 1e-6, 23.5])[0], 0.0, "outside");
}

#[test]
fn matter_starts_at_the_source_and_ends_at_the_detector() {
    let long = one(Shape::Cuboid { half_size_mm: DVec3::new(50.0, 50.0, 700.0) }, Rigid::IDENTITY);
    // The source is inside, 600 mm before the middle; the detector 1000 mm from the source is inside too.
    assert!((lengths_mm(&long, 600.0, [31.5, 23.5])[0] - 1000.0).abs() < 1e-9);
    let near = one(Shape::Cuboid { half_size_mm: DVec3::new(50.0, 50.0, 10.0) }, Rigid::IDENTITY);
    for (distance_mm, expected) in [(600.0, 20.0), (1000.0, 10.0), (995.0, 15.0), (1010.0, 0.0), (0.0, 10.0), (-11.0, 0.0)] {
        let found = lengths_mm(&near, distance_mm, [31.5, 23.5])[0];
        assert!((found - expected).abs() < 1e-9, "{distance_mm}: {found}");
    }
}

/// Path lengths by material from membership alone: transitions found by bisection between 20 000 samples.
fn by_bisection(solids: &[Solid], source: DVec3, direction: DVec3, materials: usize) -> Vec<f64> {
    let owner = |t: f64| solids.iter().rposition(|solid| contains(solid, source + direction * t));
    let (mut sums, (first, last), steps) = (vec![0.0; materials], (500.0, 700.0), 20_000);
    let step = (last - first) / f64::from(steps);
    for index in 0..steps {
        let (mut from, to) = (first + step * f64::from(index), first + step * f64::from(index + 1));
        while from < to {
            let here = owner(from);
            let (mut low, mut high) = (from, to);
            if owner(to) == here {
                low = to;
            } else {
                while high - low > 1e-11 {
                    let middle = 0.5 * (low + high);
                    if owner(middle) == here { low = middle } else { high = middle }
                }
            }
            if let Some(index) = here {
                sums[solids[index].material] += low - from;
            }
            from = if low == to { to } else { high };
        }
    }
    sums
}

#[test]
fn later_solids_displace_earlier_ones_and_lumens_displace_nothing() {
    let mut dice = Dice::new(3);
    let mut shared = 0;
    for _ in 0..12 {
        let mut solids = vec![ball(dice.vector(1.0), 9.0, 0)];
        let pose = |dice: &mut Dice| Rigid { rotation: dice.rotation(), translation_mm: dice.vector(3.0) };
        solids.push(solid(Shape::Cuboid { half_size_mm: DVec3::new(6.0, 2.0, 4.0) }, pose(&mut dice), 1));
        solids.push(solid(Shape::Cylinder { length_mm: 12.0, radius_mm: 4.0, inner_radius_mm: 3.0 }, pose(&mut dice), 2));
        solids.push(solid(Shape::Cylinder { length_mm: 15.0, radius_mm: 1.5, inner_radius_mm: 0.0 }, pose(&mut dice), 3));
        let all = scene(&["water", "bone_cortical", "nitinol", "steel_316l"], vec![Matter::Solids(solids.clone())]);
        let apart = scene(
            &["water", "bone_cortical", "nitinol", "steel_316l"],
            solids.iter().map(|solid| Matter::Solids(vec![solid.clone()])).collect(),
        );
        let pixel = [dice.between(10.0, 50.0), dice.between(10.0, 40.0)];
        let (source, direction) = ray(600.0, pixel);
        let expected = by_bisection(&solids, source, direction, 4);
        let found = lengths_mm(&all, 600.0, pixel);
        assert_eq!(found, lengths_mm(&apart, 600.0, pixel), "one object of many solids, or many objects");
        for (found, expected) in found.iter().zip(&expected) {
            assert!((found - expected).abs() < 1e-8, "{found} {expected}");
        }
        shared += usize::from(expected.iter().filter(|length| **length > 0.0).count() > 2);
    }
    assert!(shared > 4, "{shared} rays cross more than two materials");
    // Control: without displacement a rod inside a ball would be counted twice.
    let nested =
        scene(&["water", "steel_316l"], vec![Matter::Solids(vec![ball(DVec3::ZERO, 9.0, 0), ball(DVec3::ZERO, 2.0, 1)])]);
    let found = lengths_mm(&nested, 600.0, [31.5, 23.5]);
    assert!((found[0] - 14.0).abs() < 1e-9 && (found[1] - 4.0).abs() < 1e-9 && (found[0] - 18.0).abs() > 1.0);
}

#[test]
fn air_displaces_nothing() {
    let solids = vec![ball(DVec3::ZERO, 9.0, 0), ball(DVec3::ZERO, 12.0, 1)];
    let found = lengths_mm(&scene(&["water", "air"], vec![Matter::Solids(solids)]), 600.0, [31.5, 23.5]);
    assert!((found[0] - 18.0).abs() < 1e-9 && (found[1] - 6.0).abs() < 1e-9, "{found:?}");
}

/// A box of 12 triangles with outward normals.
fn box_mesh(half: DVec3, pose: Rigid) -> Mesh {
    let corner =
        |bits: u32| DVec3::from_array(std::array::from_fn(|axis| if bits >> axis & 1 == 1 { half[axis] } else { -half[axis] }));
    let quads = [[0, 2, 3, 1], [4, 5, 7, 6], [0, 1, 5, 4], [2, 6, 7, 3], [0, 4, 6, 2], [1, 3, 7, 5]];
    Mesh {
        vertices_lps_mm: (0..8).map(|bits| pose.transform_point(corner(bits))).collect(),
        triangles: quads.iter().flat_map(|[a, b, c, d]| [[*a, *b, *c], [*a, *c, *d]]).collect(),
        material: 0,
        density_g_per_cm3: 1.0,
    }
}

#[test]
fn a_mesh_of_a_box_is_that_box_even_along_its_edges() {
    let mut dice = Dice::new(4);
    let mut hits = 0;
    for case in 0..300 {
        let half = DVec3::new(dice.between(1.0, 8.0), dice.between(1.0, 8.0), dice.between(1.0, 8.0));
        let pose = Rigid { rotation: dice.rotation(), translation_mm: dice.vector(1.0) };
        let mesh = box_mesh(half, pose);
        // Every third ray aims at a vertex, an edge or the diagonal of a face.
        let pixel = if case % 3 == 0 {
            let (a, b) = (mesh.vertices_lps_mm[case % 8], mesh.vertices_lps_mm[case / 8 % 8]);
            let (image, _) = view(600.0).projection().project(a.lerp(b, 0.5));
            [image.x, image.y]
        } else {
            [dice.between(0.0, 63.0), dice.between(0.0, 47.0)]
        };
        let expected = lengths_mm(&one(Shape::Cuboid { half_size_mm: half }, pose), 600.0, pixel)[0];
        let found = lengths_mm(&scene(&["water"], vec![Matter::Mesh(mesh.into())]), 600.0, pixel)[0];
        // A ray within rounding of an edge may or may not graze: the chord there is as good as none.
        assert!((found - expected).abs() < 1e-6, "{case}: {found} {expected}");
        hits += usize::from(expected > 0.0);
    }
    assert!(hits > 100, "{hits}");
    // Straight through the vertices and edges of an axis-parallel box, with exact numbers.
    let mesh = box_mesh(DVec3::splat(2.0), Rigid::IDENTITY);
    let through = lengths_mm(&scene(&["water"], vec![Matter::Mesh(mesh.into())]), 600.0, [31.5, 23.5])[0];
    assert!((through - 4.0).abs() < 1e-12, "the diagonals of both faces cross there: {through}");
}
