//! The reference's volumes against adaptive quadrature of the field as DESIGN §5 defines it.

use glam::{DAffine3, DMat3, DVec3};
use sidecarm::geometry::{Rigid, View};
use sidecarm::render::Quantity;
use sidecarm::render::reference::{self, Reference};
use sidecarm::scene::Scene;
use sidecarm::scene::model::{Matter, Shape, Volume};

use super::scene_support::{Dice, ball, contains, field, random_volume, scene, solid, view, volume};

/// ∫ f over [a, b] by adaptive Simpson's rule.
fn quadrature(f: &dyn Fn(f64) -> f64, a: f64, b: f64) -> f64 {
    #[expect(clippy::too_many_arguments, reason = "the values at three points are passed on to halves")]
    fn refine(f: &dyn Fn(f64) -> f64, a: f64, b: f64, fa: f64, fm: f64, fb: f64, whole: f64, depth: u32) -> f64 {
        let m = 0.5 * (a + b);
        let (l, r) = (f(0.5 * (a + m)), f(0.5 * (m + b)));
        let (left, right) = ((m - a) / 6.0 * (fa + 4.0 * l + fm), (b - m) / 6.0 * (fm + 4.0 * r + fb));
        if depth == 0 || (left + right - whole).abs() < 1e-13 * (b - a).max(1e-3) {
            return left + right;
        }
        refine(f, a, m, fa, l, fm, left, depth - 1) + refine(f, m, b, fm, r, fb, right, depth - 1)
    }
    // A first division that no symmetry of the field fits.
    let cuts = 9973;
    let at = |i: u32| a + (b - a) * f64::from(i) / f64::from(cuts);
    (0..cuts)
        .map(|i| {
            let (x, y) = (at(i), at(i + 1));
            let (fx, fm, fy) = (f(x), f(0.5 * (x + y)), f(y));
            refine(f, x, y, fx, fm, fy, (y - x) / 6.0 * (fx + 4.0 * fm + fy), 34)
        })
        .sum()
}

fn affine(dice: &mut Dice, spacing_mm: DVec3, size: [usize; 3], left_handed: bool) -> DAffine3 {
    let mirror = if left_handed { DVec3::new(1.0, -1.0, 1.0) } else { DVec3::ONE };
    let matrix3 = DMat3::from_quat(dice.rotation()) * DMat3::from_diagonal(spacing_mm * mirror);
    let middle = DVec3::from_array(size.map(|n| 0.5 * (n as f64 - 1.0)));
    DAffine3 { matrix3, translation: dice.vector(1.0) - matrix3 * middle }
}

/// Area densities by quadrature of the definition; volumes and solids in order, the last with matter at a point owns it.
fn expected(scene: &Scene, view: &View, pixel: [f64; 2], materials: usize) -> Vec<f64> {
    let (source, direction) = (view.source_in_lps(), view.ray_in_lps(pixel.into()));
    let at = |depth: f64| {
        let point = source + direction * depth;
        for object in scene.objects.iter().rev() {
            match &object.matter {
                Matter::Volume(volume) => {
                    let sums = field(volume, volume.lps_from_voxel.inverse().transform_point3(point), materials);
                    if sums.iter().any(|density| *density > 0.0) {
                        return sums;
                    }
                }
                Matter::Solids(solids) => {
                    if let Some(solid) = solids.iter().rev().find(|solid| contains(solid, point)) {
                        let mut sums = vec![0.0; materials];
                        sums[solid.material] = solid.density_g_per_cm3;
                        return sums;
                    }
                }
                Matter::Mesh(_) | Matter::Parts(_) => {}
            }
        }
        vec![0.0; materials]
    };
    let end_mm = view.intrinsics.fx * scene.detector.pitch_mm;
    let (low, high) = scene.bounds().map_or((0.0, end_mm), |(centre, radius_mm)| {
        let middle = view.camera_from_lps.transform_point(centre).z;
        ((middle - radius_mm).max(0.0), (middle + radius_mm).min(end_mm))
    });
    (0..materials).map(|m| 0.1 * direction.length() * quadrature(&|depth| at(depth)[m], low, high.max(low))).collect()
}

fn compare(scene: &Scene, view: &View, pixel: [f64; 2], materials: usize, limit: f64, what: &str) -> f64 {
    let found = Reference::new(scene, view).expect("a good view").area_densities(pixel);
    let expected = expected(scene, view, pixel, materials);
    for (found, expected) in found.iter().zip(&expected) {
        assert!((found - expected).abs() <= limit, "{what}: {found} against {expected}");
    }
    expected.iter().sum()
}

#[test]
fn any_affine_gives_the_integral_of_the_trilinear_field() {
    let cases: [(&str, [usize; 3], DVec3, bool); 6] = [
        ("plain", [5, 4, 3], DVec3::splat(3.0), false),
        ("left-handed", [4, 5, 3], DVec3::new(2.0, 3.0, 4.0), true),
        ("anisotropic 1:20", [3, 4, 5], DVec3::new(0.5, 10.0, 1.0), false),
        ("tiny voxels", [4, 4, 4], DVec3::splat(0.01), true),
        ("one voxel", [1, 1, 1], DVec3::new(4.0, 5.0, 6.0), false),
        ("a line of voxels", [1, 7, 1], DVec3::splat(2.0), true),
    ];
    let mut dice = Dice::new(5);
    let (mut rays, mut hits) = (0, 0);
    for (what, size, spacing, left_handed) in cases {
        for _ in 0..6 {
            let lps_from_voxel = affine(&mut dice, spacing, size, left_handed);
            let scene = scene(&["water", "bone_cortical"], vec![volume(random_volume(&mut dice, size, lps_from_voxel))]);
            let extent_px = 5000.0 * spacing.max_element() * 2.0 / 600.0;
            let pixel = [31.5 + dice.between(-0.3, 0.3) * extent_px, 23.5 + dice.between(-0.3, 0.3) * extent_px];
            hits += usize::from(compare(&scene, &view(600.0), pixel, 2, 2e-9, what) > 0.0);
            rays += 1;
        }
    }
    assert!(rays == 36 && hits > 15, "{hits}");
}

#[test]
fn rays_along_faces_edges_and_corners_are_right() {
    let mut dice = Dice::new(6);
    // Voxel k lies at z = k in camera depth, the optical axis runs exactly along voxel (1, 1, ·), its plane or its face.
    let mut cases = 0;
    for (x, y) in [(1.0, 1.0), (0.5, 1.0), (0.5, 0.5), (-0.5, 1.0), (0.0, 0.0), (2.0, 2.25), (-0.5, -0.5)] {
        let lps_from_voxel = DAffine3::from_translation(DVec3::new(-x, -y, -1.0));
        let made = random_volume(&mut dice, [3, 4, 4], lps_from_voxel);
        let by_hand: f64 = {
            let at = |z: f64| field(&made, DVec3::new(x, y, z), 2).iter().sum::<f64>();
            // Linear between centres, constant in the outer halves: the trapezium rule with its ends is exact.
            0.5 * at(0.0) + (0..3).map(|k| 0.5 * (at(f64::from(k)) + at(f64::from(k + 1)))).sum::<f64>() + 0.5 * at(3.0)
        };
        let scene = scene(&["water", "bone_cortical"], vec![volume(made)]);
        let areas = Reference::new(&scene, &view(600.0)).expect("a good view").area_densities([31.5, 23.5]);
        assert!((areas.iter().sum::<f64>() - 0.1 * by_hand).abs() < 1e-12, "({x}, {y}): {areas:?} {by_hand}");
        cases += 1;
    }
    assert_eq!(cases, 7);
    // Through corners: a ray that passes (0,0,0), (1,1,1), (2,2,2).
    let diagonal = DMat3::from_quat(glam::DQuat::from_rotation_arc(DVec3::ONE.normalize(), DVec3::Z));
    let scene = scene(
        &["water", "bone_cortical"],
        vec![volume(random_volume(&mut dice, [3, 3, 3], DAffine3 { matrix3: diagonal, translation: -(diagonal * DVec3::ONE) }))],
    );
    compare(&scene, &view(600.0), [31.5, 23.5], 2, 2e-9, "corners");
}

#[test]
fn the_field_starts_at_the_source_and_ends_at_the_detector() {
    let mut dice = Dice::new(7);
    let lps_from_voxel =
        DAffine3 { matrix3: DMat3::from_diagonal(DVec3::splat(4.0)), translation: DVec3::new(-6.0, -6.0, -10.0) };
    let made = random_volume(&mut dice, [4, 4, 6], lps_from_voxel);
    let scene = scene(&["water", "bone_cortical"], vec![volume(made)]);
    let mut cases = 0;
    for distance_mm in [600.0, 3.0, -2.0, 1001.0, 990.0, -13.0, 1013.0] {
        compare(&scene, &view(distance_mm), [33.0, 22.0], 2, 2e-9, &distance_mm.to_string());
        cases += 1;
    }
    assert_eq!(cases, 7);
    let total =
        |distance_mm| Reference::new(&scene, &view(distance_mm)).expect("good").area_densities([33.0, 22.0]).iter().sum::<f64>();
    assert_eq!(total(1013.0), 0.0, "behind the detector");
    assert_eq!(total(-13.0), 0.0, "behind the source");
    assert!(total(3.0) > 0.0 && total(3.0) < total(600.0), "the source is inside");
}

#[test]
fn tools_and_volumes_displace_in_order() {
    let mut dice = Dice::new(8);
    let mut cases = 0;
    for _ in 0..6 {
        let size = [4, 4, 4];
        let first = affine(&mut dice, DVec3::splat(3.0), size, false);
        let second = affine(&mut dice, DVec3::new(2.0, 3.0, 2.5), [3, 3, 3], true);
        let tube = solid(
            Shape::Cylinder { length_mm: 9.0, radius_mm: 3.0, inner_radius_mm: 2.0 },
            Rigid { rotation: dice.rotation(), translation_mm: dice.vector(2.0) },
            2,
        );
        let mut other = random_volume(&mut dice, [3, 3, 3], second);
        other.class_materials = vec![1, 2];
        let matters = vec![
            volume(random_volume(&mut dice, size, first)),
            Matter::Solids(vec![tube]),
            volume(other),
            Matter::Solids(vec![ball(dice.vector(3.0), 2.0, 3)]),
        ];
        let scene = scene(&["water", "bone_cortical", "nitinol", "steel_316l"], matters);
        // Where matter changes at once, adaptive quadrature stops at 2^-34 of a hundredth of the path.
        compare(&scene, &view(600.0), [31.5 + dice.between(-20.0, 20.0), 23.5 + dice.between(-20.0, 20.0)], 4, 1e-7, "mixed");
        cases += 1;
    }
    assert_eq!(cases, 6);
}

/// The control of these tests: a density changed by 1e-6 is seen.
#[test]
fn a_small_change_of_one_voxel_is_seen() {
    let mut dice = Dice::new(9);
    let lps_from_voxel = DAffine3::from_translation(DVec3::splat(-1.0));
    let mut made = random_volume(&mut dice, [3, 3, 3], lps_from_voxel);
    made.class.fill(1);
    made.density_g_per_cm3.fill(1.0);
    let areas = |made: &Volume| {
        let scene = scene(&["water", "bone_cortical"], vec![volume(made.clone())]);
        Reference::new(&scene, &view(600.0)).expect("good").area_densities([31.5, 23.5])[0]
    };
    let before = areas(&made);
    assert!((before - 0.3).abs() < 1e-12, "3 mm of 1 g/cm3: {before}");
    made.density_g_per_cm3[13] *= 1.0 + 1e-6;
    assert!((areas(&made) - before).abs() > 1e-8);
}

#[test]
fn rays_that_lose_tissue_at_a_face_or_at_padding_are_invalid() {
    let made = |class: fn(usize, usize, usize) -> u8, unknown: Vec<bool>| {
        let size = [5usize, 5, 5];
        let class: Vec<u8> = (0..125).map(|index| class(index % 5, index / 5 % 5, index / 25)).collect();
        Volume {
            size,
            lps_from_voxel: DAffine3::from_translation(DVec3::splat(-2.0)),
            density_g_per_cm3: class.iter().map(|class| f32::from(*class)).collect(),
            class,
            class_materials: vec![0],
            truncated_at_faces: true,
            unknown,
        }
    };
    let centre_is_valid = |volume_: Volume| {
        let scene = scene(&["water"], vec![volume(volume_)]);
        Reference::new(&scene, &view(600.0)).expect("good").is_valid([31.5, 23.5])
    };
    let core = |i: usize, j: usize, k: usize| u8::from([i, j, k].iter().all(|x| (1..4).contains(x)));
    assert!(centre_is_valid(made(core, Vec::new())), "tissue wholly inside");
    assert!(!centre_is_valid(made(|_, _, k| u8::from(k < 4), Vec::new())), "tissue at the face towards the source");
    assert!(!centre_is_valid(made(|_, _, k| u8::from(k > 0), Vec::new())), "tissue at the face towards the detector");
    assert!(centre_is_valid(made(|i, _, _| u8::from(i == 0), Vec::new())), "tissue at a face that the ray does not cross");
    let padding: Vec<bool> = (0..125).map(|index| index / 25 == 0).collect();
    assert!(!centre_is_valid(made(core, padding)), "padding beside tissue");
    let far: Vec<bool> = (0..125).map(|index| index % 5 == 0).collect();
    assert!(centre_is_valid(made(core, far)), "padding elsewhere");
    let scene = scene(&["water"], vec![volume(made(|_, _, k| u8::from(k > 0), Vec::new()))]);
    let valid = reference::valid(&scene, &view(600.0)).expect("good");
    assert_eq!((valid.pixels[24 * 64 + 32], valid.pixels[0]), (0, 1));
}

#[test]
fn a_page_per_material_and_no_nan_anywhere() {
    let mut dice = Dice::new(10);
    let lps_from_voxel = affine(&mut dice, DVec3::splat(2.0), [4, 4, 4], false);
    let scene = scene(&["water", "bone_cortical"], vec![volume(random_volume(&mut dice, [4, 4, 4], lps_from_voxel))]);
    let mut pages = 0;
    for quantity in [Quantity::AreaDensity, Quantity::Intensity, Quantity::LineIntegral, Quantity::Counts] {
        let images = reference::render(&scene, &view(600.0), quantity).expect("good");
        assert_eq!(images.len(), if quantity == Quantity::AreaDensity { 2 } else { 1 });
        assert!(images.iter().all(|image| image.width == 64 && image.height == 48 && image.pixels.iter().all(|x| x.is_finite())));
        pages += images.len();
    }
    assert_eq!(pages, 5);
}
