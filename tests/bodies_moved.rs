//! A labelled body of a CT that has moved since the scan: where its shadow falls, what fills its place, what is called a guess.

use std::path::Path;
use std::sync::{Arc, OnceLock};

use glam::DVec3;
use sidecarm::geometry::{Rigid, View};
use sidecarm::gpu::DeviceChoice;
use sidecarm::render::{LEAST_GUESSED_MM, Options, Quantity, Rendered, Renderer, guessed, guessed_share};
use sidecarm::reporter::Reporter;
use sidecarm::scene::model::{LabelledBody, Matter, Object, Scene, Shape, Solid};
use sidecarm::scene::{SceneError, load_text};

use crate::render_scenes::worst;
use crate::scene_support::{NiftiFile, solid};

/// Voxels along an edge of the CT: 1 mm each, the middle one at the origin.
const EDGE: i16 = 65;
/// By the density curve.
const BONE_OVER_WATER_G_PER_CM3: f64 = 1.06 + (1000.0 - 55.0) / (1700.0 - 55.0) * (1.92 - 1.06) - 1.0;
const SEMI_AXES_MM: DVec3 = DVec3::new(13.0, 9.0, 7.0);

/// The bone as it was scanned: no axis along the grid's.
pub fn lps_from_bone() -> Rigid {
    Rigid::translation(DVec3::new(2.3, -1.6, 0.7)) * Rigid::exp(DVec3::new(0.4, -0.2, 0.7), DVec3::ZERO)
}

/// 3° about an axis through the bone's middle, and 4 mm.
pub fn motion() -> Rigid {
    let middle = lps_from_bone().translation_mm;
    let turn = Rigid::exp(DVec3::new(1.0, -2.0, 2.0) / 3.0 * 3f64.to_radians(), DVec3::ZERO);
    Rigid::translation(middle + DVec3::new(2.4, 3.2, 0.0)) * turn * Rigid::translation(-middle)
}

/// Share of a voxel that lies in the ellipsoid.
fn share(bone_from_lps: &Rigid, centre: DVec3) -> f64 {
    let offset = |n: i32| (f64::from(n) + 0.5) / 5.0 - 0.5;
    let inside = (0..125).filter(|n| {
        let p = centre + DVec3::new(offset(n % 5), offset(n / 5 % 5), offset(n / 25));
        (bone_from_lps.transform_point(p) / SEMI_AXES_MM).length() <= 1.0
    });
    inside.count() as f64 / 125.0
}

/// A box of water in air with a bone at `lps_from_bone`, and its labels: 5 where a voxel has a share of it.
pub fn write_ct(folder: &Path, name: &str, lps_from_bone: Option<Rigid>) {
    let bone_from_lps = lps_from_bone.map(Rigid::inverse);
    let (half, count) = (f64::from(EDGE / 2), i32::from(EDGE).pow(3));
    let edge = i32::from(EDGE);
    let voxels = (0..count).map(|n| {
        let at = DVec3::new(f64::from(n % edge), f64::from(n / edge % edge), f64::from(n / edge / edge)) - half;
        if at.abs().max_element() > half - 2.0 {
            return (-1000, 0);
        }
        let near = |bone: &Rigid| (bone.transform_point(at) / SEMI_AXES_MM).length() < 1.5;
        let share = bone_from_lps.filter(near).map_or(0.0, |bone| share(&bone, at));
        // Density is linear in HU above 55 only: a mixture has the HU of its density.
        let over = share * BONE_OVER_WATER_G_PER_CM3;
        let hu = if over <= 0.06 { over / 0.06 * 55.0 } else { 55.0 + (over - 0.06) / (1.92 - 1.06) * (1700.0 - 55.0) };
        (hu.round() as i16, if share > 0.0 { 5 } else { 1 })
    });
    let (hu, labels): (Vec<i16>, Vec<i16>) = voxels.unzip();
    let half = half as f32;
    for (file, values) in [(format!("{name}.nii"), hu), (format!("{name}-labels.nii"), labels)] {
        let mut nifti = NiftiFile::int16([EDGE; 3], &values);
        nifti.sform = Some([[-1.0, 0.0, 0.0, half], [0.0, -1.0, 0.0, half], [0.0, 0.0, 1.0, -half]]);
        nifti.write(&folder.join(file));
    }
}

/// The scene file of a CT, with `before` and `after` it.
pub fn scene_text(name: &str, before: &str, after: &str) -> String {
    format!(
        r#"{{"objects": [{before}{{"ct": {{"path": "{name}.nii", "body": "pelvis", "materials": {{"labels": "{name}-labels.nii",
            "default": "water", "map": {{"5": "bone_cortical"}}, "bodies": {{"femur": [5, 77]}}}}}}}}{after}],
          "view": {{"size_px": [96, 80], "intrinsics": [[1000, 0, 47.5], [0, 1000, 39.5], [0, 0, 1]],
                    "camera_from_lps": [[1, 0, 0, 0], [0, 0, -1, 0], [0, 1, 0, 600], [0, 0, 0, 1]]}},
          "beam": {{"mono_kev": 60, "photons_per_pixel": 1e5}}, "detector": {{"pitch_mm": 1.0}}}}"#
    )
}

fn load(folder: &Path, text: &str) -> Result<Scene, SceneError> {
    load_text(text, &folder.join("scene.json"), true, &Reporter::silent())
}

/// The CT with the bone where it was scanned.
fn scanned(before: &str, after: &str) -> Scene {
    let folder = tempfile::tempdir().expect("folder");
    write_ct(folder.path(), "ct", Some(lps_from_bone()));
    load(folder.path(), &scene_text("ct", before, after)).expect("loads")
}

/// The water alone.
fn without_bone() -> Scene {
    let folder = tempfile::tempdir().expect("folder");
    write_ct(folder.path(), "empty", None);
    let text = scene_text("empty", "", "").replace(r#", "bodies": {"femur": [5, 77]}"#, "");
    load(folder.path(), &text).expect("loads")
}

fn render(device: DeviceChoice, scene: &Scene, options: Options) -> Rendered {
    let mut renderer = Renderer::new(device, &Reporter::silent()).expect("a device");
    renderer.render(scene, &Options { guessed: true, ..options }).expect("renders")
}

/// g/cm² of all materials together.
fn mass(scene: &Scene) -> Vec<f64> {
    let rendered = render(DeviceChoice::Cpu, scene, Options { quantity: Quantity::AreaDensity, ..Options::default() });
    let mut sums = vec![0.0; rendered.valid.pixels.len()];
    for page in &rendered.pages {
        sums.iter_mut().zip(&page.pixels).for_each(|(sum, value)| *sum += f64::from(*value));
    }
    sums
}

/// Chord of every pixel's ray in the bone at `lps_from_bone`, mm.
fn chords_mm(view: &View, lps_from_bone: Rigid, grown_mm: f64) -> Vec<f64> {
    let bone = solid(Shape::Ellipsoid { semi_axes_mm: SEMI_AXES_MM + grown_mm }, lps_from_bone, 0);
    let scene = crate::scene_support::scene(&["water"], vec![Matter::Solids(vec![bone])]);
    let mut scene = scene.with_view(*view);
    scene.detector.pitch_mm = 1.0;
    mass(&scene).into_iter().map(|g_per_cm2| 10.0 * g_per_cm2).collect()
}

/// A body's shadow lies where the body is. The voxels blur an ellipsoid by their own width (variance h²/12) and by interpolation (h²/6),
/// which shortens a chord L by σ²/2·|∇²L| with σ² = h²/4: below 0.2 mm well inside the outline. The share of each point that the water
/// keeps is interpolated on the CT's grid: where labels end in steps it is off by up to a quarter of a voxel of water at either side, up or
/// down alike. A seam without water would take half a voxel at either side, always down: the mean tells.
#[test]
fn a_moved_bone_has_the_shadow_of_an_ellipsoid_that_has_moved() {
    let scene = scanned("", "");
    let view = scene.view.expect("its own");
    let moved = scene.with_bodies(&[("femur", motion()), ("pelvis", Rigid::IDENTITY)]).expect("known");
    let water = mass(&without_bone());
    let place = motion() * lps_from_bone();
    let (chords, grown) = (chords_mm(&view, place, 0.0), chords_mm(&view, place, 2.0));
    let longest = chords.iter().copied().fold(0.0, f64::max);
    let (found, unmoved) = (mass(&moved), mass(&scene));
    let limit = 0.1 * 0.2 * BONE_OVER_WATER_G_PER_CM3 + 2.0 * 0.1 * 0.25;
    let (mut inside, mut outline, mut off_unmoved) = (Vec::new(), Vec::new(), 0.0f64);
    for pixel in 0..found.len() {
        let expected = water[pixel] + 0.1 * chords[pixel] * BONE_OVER_WATER_G_PER_CM3;
        let off = found[pixel] - expected;
        off_unmoved = off_unmoved.max((unmoved[pixel] - expected).abs());
        if chords[pixel] > 0.6 * longest {
            inside.push(off);
        } else if grown[pixel] > 0.0 {
            outline.push(off);
        } else {
            assert!(off.abs() < 0.01, "pixel {pixel} beside the bone: off by {off} g/cm2");
        }
    }
    assert!(inside.len() > 300 && outline.len() > 300, "{} {}", inside.len(), outline.len());
    let worst = |off: &[f64]| off.iter().map(|off| off.abs()).fold(0.0, f64::max);
    let mean = |off: &[f64]| off.iter().sum::<f64>() / off.len() as f64;
    assert!(worst(&inside) <= limit && mean(&inside).abs() < 0.003, "{} {}", worst(&inside), mean(&inside));
    // Rays along the surface run through many steps.
    assert!(worst(&outline) < 0.3 && mean(&outline).abs() < 0.01, "{} {}", worst(&outline), mean(&outline));
    assert!(off_unmoved > 0.5, "the control: the scan as it was is off by {off_unmoved}");
}

/// The same bone drawn by the scanner where it has moved to. Both are voxels of one ellipsoid on grids that lie differently.
#[test]
fn a_moved_bone_looks_like_one_that_was_scanned_there() {
    let moved = scanned("", "").with_bodies(&[("femur", motion())]).expect("known");
    let folder = tempfile::tempdir().expect("folder");
    write_ct(folder.path(), "ct", Some(motion() * lps_from_bone()));
    let drawn = load(folder.path(), &scene_text("ct", "", "")).expect("loads");
    let (found, expected, before) = (mass(&moved), mass(&drawn), mass(&scanned("", "")));
    let rms = |a: &[f64], b: &[f64]| (a.iter().zip(b).map(|(a, b)| (a - b).powi(2)).sum::<f64>() / a.len() as f64).sqrt();
    let (off, control) = (rms(&found, &expected), rms(&before, &expected));
    assert!(off < 0.016 && control > 5.0 * off, "{off} g/cm2, unmoved {control}");
    let sum = |values: &[f64]| values.iter().sum::<f64>();
    assert!((sum(&found) / sum(&expected) - 1.0).abs() < 2e-4, "{} {}", sum(&found), sum(&expected));
}

#[test]
fn without_motion_nothing_changes_and_nothing_is_split() {
    let scene = scanned("", "");
    let still = scene.with_bodies(&[("femur", Rigid::IDENTITY), ("stranger", Rigid::IDENTITY)]).expect("nothing to know");
    let (Matter::Volume(a), Matter::Volume(b)) = (&scene.objects[0].matter, &still.objects[0].matter) else { panic!("split") };
    assert!(Arc::ptr_eq(a, b));
    let line = Options { quantity: Quantity::LineIntegral, ..Options::default() };
    let (before, after) = (render(DeviceChoice::Cpu, &scene, line.clone()), render(DeviceChoice::Cpu, &still, line));
    let bits = |rendered: &Rendered| rendered.pages[0].pixels.iter().map(|value| value.to_bits()).collect::<Vec<_>>();
    assert_eq!(bits(&before), bits(&after));
    assert!(after.guessed.is_none() && guessed(&still).expect("a view").is_none());
    let said = after.plan["choices"].as_array().expect("choices").iter().find(|choice| choice["what"] == "bodies").cloned();
    assert_eq!(said.expect("said")["why"], "pelvis unmoved; femur unmoved");
    // A motion of the whole CT is no split either.
    let whole = Rigid::translation(DVec3::new(1.0, 2.0, 3.0));
    let carried = scene.with_bodies(&[("pelvis", whole), ("femur", whole)]).expect("known");
    let Matter::Volume(c) = &carried.objects[0].matter else { panic!("split") };
    assert!((c.lps_from_voxel.translation - a.lps_from_voxel.translation).distance(whole.translation_mm) < 1e-9);
}

/// The bone has left the field altogether: where it lay there is water as around it, no hole, and all of it is a guess.
#[test]
fn what_a_body_left_is_filled_and_called_a_guess() {
    let scene = scanned("", "");
    let away = Rigid::translation(DVec3::new(0.0, 0.0, 500.0));
    let moved = scene.with_bodies(&[("femur", away)]).expect("known");
    let water = mass(&without_bone());
    let worst_off = mass(&moved).iter().zip(&water).map(|(a, b)| (a - b).abs()).fold(0.0, f64::max);
    assert!(worst_off < 1e-4, "{worst_off} g/cm2");
    let Matter::Parts(parts) = &moved.objects[0].matter else { panic!("parts") };
    let Matter::Volume(before) = &scene.objects[0].matter else { panic!("a volume") };
    let air = |volume: &sidecarm::scene::model::Volume| volume.class.iter().filter(|class| **class == 0).count();
    assert_eq!((parts.len(), air(&parts[0])), (2, air(before)), "no air where there was none");
    // All voxels with a share of the bone: an ellipsoid grown by about half a voxel.
    let mask = guessed(&moved).expect("a view").expect("something moved");
    let share_of = |grown_mm: f64| {
        let chords = chords_mm(&moved.view.expect("its own"), lps_from_bone(), grown_mm);
        chords.iter().filter(|mm| **mm > LEAST_GUESSED_MM).count() as f64 / chords.len() as f64
    };
    let (least, found, most) = (share_of(0.0), guessed_share(&mask), share_of(1.0));
    assert!(least > 0.05 && least <= found && found <= most, "{least} {found} {most}");
    let filled = moved.bodies.motions.iter().find(|motion| motion.body == "femur").expect("listed");
    let labelled = scene.bodies.labelled[0].voxels.len() as f64 * 1e-3;
    assert!((filled.filled_cm3 - labelled).abs() < 1e-6 && (filled.shift_mm - 500.0).abs() < 1e-9, "{filled:?}");
    // A motion of a tenth of a voxel leaves nothing that an image shows.
    let nearly = scene.with_bodies(&[("femur", Rigid::translation(DVec3::new(0.1, 0.1, 0.1)))]).expect("known");
    assert_eq!(guessed_share(&guessed(&nearly).expect("a view").expect("moved")), 0.0);
}

/// In mere air nothing flows in behind a bone.
#[test]
fn a_dry_bone_leaves_air() {
    let folder = tempfile::tempdir().expect("folder");
    write_ct(folder.path(), "ct", Some(lps_from_bone()));
    let text = scene_text("ct", "", "").replace(r#""map": {"5""#, r#""map": {"1": "air", "5""#);
    let moved = load(folder.path(), &text).expect("loads").with_bodies(&[("femur", motion())]).expect("known");
    let Matter::Parts(parts) = &moved.objects[0].matter else { panic!("parts") };
    assert!(parts[0].class.iter().all(|class| *class == 0) && parts[1].class.iter().any(|class| *class > 0));
    assert_eq!(guessed_share(&guessed(&moved).expect("a view").expect("moved")), 0.0, "air is no guess");
}

#[test]
fn shapes_meshes_voxels_and_robot_move_with_their_body() {
    let after = r#", {"sphere": {"centre_lps_mm": [5, 6, 7], "radius_mm": 1, "material": "steel_316l", "body": "femur"}},
        {"cylinder": {"from_lps_mm": [0, 0, 0], "to_lps_mm": [0, 9, 0], "radius_mm": 1, "material": "titanium"}},
        {"robot": {"model": "calibration/robot/cdm.json", "body": "femur"}}"#;
    let scene = scanned("", after);
    let moved = scene.with_bodies(&[("femur", motion())]).expect("known");
    let solids = |object: &Object| match &object.matter {
        Matter::Solids(solids) => solids.clone(),
        _ => panic!("shapes"),
    };
    let mut cases = 0;
    for (object, motion) in [(1, motion()), (2, Rigid::IDENTITY), (3, motion())] {
        let (before, now): (Vec<Solid>, Vec<Solid>) = (solids(&scene.objects[object]), solids(&moved.objects[object]));
        for (before, now) in before.iter().zip(&now) {
            for p in [DVec3::ZERO, DVec3::new(3.0, -4.0, 5.0)] {
                let there = motion.transform_point(before.lps_from_local.transform_point(p));
                assert!(now.lps_from_local.transform_point(p).distance(there) < 1e-9, "object {object}");
                cases += 1;
            }
        }
    }
    assert!(cases > 20);
    let base = moved.robot.as_ref().expect("a robot").lps_from_base;
    assert!(base.translation_mm.distance(motion().translation_mm) < 1e-9);
    // Bending it leaves it where it is; a tracked base is where the tracker has it.
    let bent = moved.with_robot([1.0, 2.0, 0.0, 0.0, 0.0], None).expect("bends");
    assert!(bent.robot.expect("a robot").lps_from_base.translation_mm.distance(base.translation_mm) < 1e-12);
}

#[test]
fn a_body_that_the_scene_does_not_know_is_an_error_that_names_it() {
    let scene = scanned("", "");
    assert_eq!(scene.body_names(), ["pelvis", "femur"]);
    let error = scene.with_bodies(&[("tibia", motion())]).expect_err("unknown").to_string();
    assert!(error.contains("'tibia'") && error.contains("3.00 deg") && error.contains("pelvis, femur"), "{error}");
    let nan = Rigid::translation(DVec3::splat(f64::NAN));
    assert!(scene.with_bodies(&[("tibia", nan)]).is_err(), "NaN is no rest");
}

#[test]
fn wrong_bodies_in_a_scene_are_errors_that_name_the_place() {
    let folder = tempfile::tempdir().expect("folder");
    write_ct(folder.path(), "ct", Some(lps_from_bone()));
    let right = scene_text("ct", "", "");
    let bodies = r#""femur": [5, 77]"#;
    let cases = [
        (r#""femur": [6]"#, "without any voxel"),
        (r#""femur": [5], "tibia": [7, 5]"#, "label 5, which femur has"),
        (r#""pelvis": [5]"#, "another name"),
        (r#""femur": ["five"]"#, "objects[0].ct"),
    ];
    for (wrong, words) in cases {
        let error = load(folder.path(), &right.replace(bodies, wrong)).expect_err(wrong).to_string();
        assert!(error.contains(words) && error.contains("objects[0].ct"), "{error}");
    }
    assert!(load(folder.path(), &right).is_ok());
}

/// Parts of a CT on grids that lie across each other, over an earlier box and under a later rod, against the literal equations; where there
/// is a device for the shaders, on it too.
#[test]
fn executors_agree_with_the_reference_about_moved_bodies() {
    let rod =
        r#", {"cylinder": {"from_lps_mm": [-20, 0, 0], "to_lps_mm": [20, 4, 2], "radius_mm": 1.5, "material": "titanium"}}"#;
    let slab = r#"{"box": {"centre_lps_mm": [20, 0, 0], "size_mm": [40, 90, 90], "material": "pmma"}}, "#;
    let whole = Rigid::exp(DVec3::new(0.02, 0.01, -0.03), DVec3::new(1.0, 0.5, -0.7));
    let mut cases = 0;
    for (before, devices) in [("", vec![DeviceChoice::Cpu, DeviceChoice::SoftwareVulkan]), (slab, vec![DeviceChoice::Cpu])] {
        let scene = scanned(before, rod).with_bodies(&[("femur", motion()), ("pelvis", whole)]).expect("known");
        let line = Options { quantity: Quantity::LineIntegral, ..Options::default() };
        let slow = render(DeviceChoice::Cpu, &scene, Options { reference: true, ..line.clone() });
        for device in devices {
            if Renderer::new(device, &Reporter::silent()).is_err() {
                eprintln!("skipped: {device:?} is not there");
                continue;
            }
            let fast = render(device, &scene, line.clone());
            let expected = if device == DeviceChoice::Cpu { "cpu" } else { "wgsl" };
            assert_eq!(fast.plan["executor"], expected);
            let off = worst(&fast.pages[0].pixels, &slow.pages[0].pixels);
            assert!(off <= fast.stated_error, "{device:?}: {off}, stated {}", fast.stated_error);
            assert_eq!(fast.valid.pixels, slow.valid.pixels, "{device:?}");
            cases += 1;
        }
    }
    assert!(cases >= 2);
}

/// A body that reaches the scan's end is cut off wherever it goes.
#[test]
fn a_body_that_the_scan_cut_off_stays_invalid_where_it_goes() {
    let folder = tempfile::tempdir().expect("folder");
    write_ct(folder.path(), "ct", Some(Rigid::translation(DVec3::new(0.0, 0.0, 27.0))));
    let text = scene_text("ct", "", "").replace("[96, 80]", "[96, 160]").replace("39.5", "79.5");
    let mut scene = load(folder.path(), &text).expect("loads");
    let Matter::Volume(ct) = &scene.objects[0].matter else { panic!("a volume") };
    // The bone alone up to the last slice, as the slice below the air has it.
    let mut ct = (**ct).clone();
    let slice = ct.size[0] * ct.size[1];
    let labelled = &scene.bodies.labelled[0];
    let last = |n: &&usize| **n / slice == 62;
    let more: Vec<usize> = [1, 2].iter().flat_map(|k| labelled.voxels.iter().filter(last).map(move |n| n + k * slice)).collect();
    for n in &more {
        (ct.class[*n], ct.density_g_per_cm3[*n]) = (ct.class[n % slice + 62 * slice], 1.5);
    }
    assert!(more.len() > 100);
    let voxels = labelled.voxels.iter().copied().chain(more).collect();
    let body = LabelledBody { name: "femur".to_owned(), object: labelled.object.clone(), voxels, filling: OnceLock::new() };
    scene.bodies.labelled = vec![Arc::new(body)];
    scene.objects[0].matter = Matter::Volume(Arc::new(ct));
    let moved = scene.with_bodies(&[("femur", Rigid::translation(DVec3::new(20.0, 0.0, 0.0)))]).expect("known");
    let line = Options { quantity: Quantity::LineIntegral, ..Options::default() };
    let (before, after) = (render(DeviceChoice::Cpu, &scene, line.clone()), render(DeviceChoice::Cpu, &moved, line));
    let invalid = |rendered: &Rendered| -> Vec<usize> {
        (0..96 * 160).filter(|pixel| rendered.valid.pixels[*pixel] == 0).map(|pixel| pixel % 96).collect()
    };
    let (before, after) = (invalid(&before), invalid(&after));
    assert!(before.len() > 100 && after.len() > before.len(), "{} {}", before.len(), after.len());
    let reach = |columns: &[usize]| columns.iter().copied().max().expect("some");
    assert!(reach(&after) > reach(&before) + 20, "{} {}", reach(&after), reach(&before));
}
