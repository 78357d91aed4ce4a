//! Metal beads in CTs that `ct_phantom` draws: found, told apart from other metal, written for Slicer, and taken out of the CT where
//! the scene draws them itself.

use std::path::Path;

use glam::{DAffine3, DMat3, DVec3};
use sidecarm::beads::{parse_markups, read_markups};
use sidecarm::calibrate::beads::{BeadsInCtError, CtBead, CtBeads, Known, NotBead, find_beads, markups};
use sidecarm::cli::calibrate_beads::{BeadsArgs, run};
use sidecarm::geometry::VoxelGrid;
use sidecarm::reporter::Reporter;
use sidecarm::scene;
use sidecarm::scene::model::{Matter, Scene, Volume};

use crate::ct_phantom::{Luck, Phantom};
use crate::scene_support::NiftiFile;

const CLIP_HU: f64 = 3071.0;

/// Upright or oblique, isotropic or in slices, right- or left-handed.
fn placed(kind: usize, luck: &mut Luck) -> (DAffine3, [usize; 3]) {
    let (spacing, size) = [
        (DVec3::splat(0.7), [60, 60, 60]),
        (DVec3::new(0.8, 0.8, 1.25), [56, 56, 36]),
        (DVec3::new(-0.6, 0.6, 1.5), [74, 74, 30]),
        (DVec3::new(0.5, 0.5, 0.6), [86, 86, 72]),
    ][kind % 4];
    let turn = if kind.is_multiple_of(2) { DMat3::IDENTITY } else { DMat3::from_rotation_z(0.3) * DMat3::from_rotation_x(-0.2) };
    (DAffine3 { matrix3: turn * DMat3::from_diagonal(spacing), translation: luck.vector(100.0) }, size)
}

/// Muscle, with the shaft of a bone (walls of 3 mm, marrow) along the slices' axis at one side.
fn thigh(size: [usize; 3], lps_from_voxel: DAffine3, blur_mm: f64) -> Phantom {
    let (axis, across) = (lps_from_voxel.matrix3.z_axis.normalize(), lps_from_voxel.matrix3.x_axis.normalize());
    let bone = Phantom::new(size, lps_from_voxel, blur_mm, |_| 0.0).middle() + 10.0 * across;
    let edge = |mm: f64| 0.5 * (1.0 + (1.2 * mm / blur_mm).tanh());
    Phantom::new(size, lps_from_voxel, blur_mm, |place| {
        let away = place - bone;
        let radius = (away - axis * away.dot(axis)).length();
        45.0 + 1200.0 * edge(7.0 - radius) - 1100.0 * edge(4.0 - radius)
    })
}

fn find(phantom: &Phantom, hu: &[f32], known: &Known) -> Result<CtBeads, BeadsInCtError> {
    find_beads(&VoxelGrid { size: phantom.size, lps_from_voxel: phantom.lps_from_voxel }, hu, known, &|_| {})
}

fn nearest(found: &CtBeads, place: DVec3) -> &CtBead {
    found.beads.iter().min_by(|a, b| a.centre().distance(place).total_cmp(&b.centre().distance(place))).expect("beads")
}

/// Errors in units of the σ that was stated for them.
fn spread(pulls: &[f64]) -> f64 {
    (pulls.iter().map(|pull| pull * pull).sum::<f64>() / pulls.len() as f64).sqrt()
}

#[test]
fn centres_are_as_good_as_their_covariance_says() {
    let (mut pulls, mut in_muscle) = (Vec::new(), Vec::new());
    for kind in 0..8 {
        let mut luck = Luck::new(40 + kind as u64);
        let (lps_from_voxel, size) = placed(kind, &mut luck);
        let blur_mm = luck.between(0.25, 0.6);
        let mut phantom = thigh(size, lps_from_voxel, blur_mm);
        let mut truth: Vec<DVec3> = Vec::new();
        while truth.len() < 8 {
            let place = phantom.middle() + luck.vector(16.0);
            let voxel = lps_from_voxel.inverse().transform_point3(place);
            let inside = (0..3).all(|axis| voxel[axis] > 2.0 && voxel[axis] < size[axis] as f64 - 3.0);
            if inside && truth.iter().all(|other| other.distance(place) >= 4.0) {
                phantom.ball(place, luck.between(0.6, 1.25), luck.between(12_000.0, 22_000.0));
                truth.push(place);
            }
        }
        let clip_hu = if kind % 3 == 2 { 30_000.0 } else { CLIP_HU };
        let hu = phantom.stored(luck.between(20.0, 50.0), clip_hu, &mut luck);
        let found = find(&phantom, &hu, &Known::default()).expect("beads");
        assert_eq!(found.beads.len(), truth.len(), "{kind}: {:?}", found.not_beads);
        assert_eq!(found.clip_hu, (clip_hu == CLIP_HU).then_some(CLIP_HU));
        let bone = phantom.middle() + 10.0 * lps_from_voxel.matrix3.x_axis.normalize();
        let axis = lps_from_voxel.matrix3.z_axis.normalize();
        for place in truth {
            let bead = nearest(&found, place);
            let error = bead.centre() - place;
            assert!(error.length() < 0.35, "{kind}: {} mm off, {:?}", error.length(), bead);
            let from_bone = (place - bone).reject_from(axis).length();
            for n in 0..3 {
                let pull = error[n] / bead.covariance_mm2[n][n].sqrt();
                pulls.push(pull);
                if from_bone > 11.0 {
                    in_muscle.push((error[n], pull));
                }
            }
        }
    }
    // An rms of 192 is good to 5 %.
    assert_eq!(pulls.len(), 192);
    assert!((0.8..=1.2).contains(&spread(&pulls)), "{}", spread(&pulls));
    let (errors, muscle_pulls): (Vec<f64>, Vec<f64>) = in_muscle.into_iter().unzip();
    assert!(errors.len() > 60 && spread(&errors) < 0.02, "{} mm in muscle", spread(&errors));
    // It is 0.79: where nothing but the slices' profile is in doubt, what that doubt adds makes a sigma a little wide. An rms of so few is good
    // to 9 %.
    assert!((0.75..=1.2).contains(&spread(&muscle_pulls)), "{}", spread(&muscle_pulls));
}

/// Slices of 2 and 3 mm that overlap, leave gaps or blur as a helical scan does: centres were 0.3 to 2.9 mm off across the slices, with
/// stated σ of 0.006 to 0.2 mm, because slices were taken for boxes.
#[test]
fn thick_slices_of_any_profile_give_centres_within_their_covariance() {
    let even = |width: f64| (0..12).map(|n| width * ((f64::from(n) + 0.5) / 12.0 - 0.5)).collect::<Vec<f64>>();
    // Sums of three even widths: near enough to a Gaussian of σ = w/2.
    let bell = |w: f64| {
        let at = |n: i32| w * (f64::from(n) / 5.0 - 0.4);
        (0..125).map(|n| at(n % 5) + at(n / 5 % 5) + at(n / 25)).collect::<Vec<f64>>()
    };
    let mut pulls = Vec::new();
    let mut errors = Vec::new();
    for (case, profile, thick_mm, clip_hu) in
        [(2, even(0.6), 3.0, CLIP_HU), (3, even(1.6), 2.0, 30_000.0), (5, bell(0.9), 3.0, 30_000.0)]
    {
        let mut luck = Luck::new(900 + case);
        let lps_from_voxel = DAffine3::from_scale(DVec3::new(0.6, 0.6, thick_mm));
        let size = [80, 80, (48.0 / thick_mm) as usize];
        let mut phantom = Phantom::new(size, lps_from_voxel, 0.38, |_| 45.0);
        phantom.slice_profile = profile;
        let mut truth: Vec<DVec3> = Vec::new();
        while truth.len() < 7 {
            let place = phantom.middle() + luck.vector(17.0);
            if truth.iter().all(|other| other.distance(place) >= 9.0) {
                phantom.ball(place, 0.75, 15_000.0);
                truth.push(place);
            }
        }
        let hu = phantom.stored(25.0, clip_hu, &mut luck);
        let found = find(&phantom, &hu, &Known::default()).expect("beads");
        for bead in &found.beads {
            let place =
                truth.iter().min_by(|a, b| a.distance(bead.centre()).total_cmp(&b.distance(bead.centre()))).expect("beads");
            let off = bead.centre() - place;
            assert!(off.length() < 0.5 * thick_mm, "case {case}: {off} mm, {bead:?}");
            errors.push(off.z);
            pulls.push(off.z / bead.covariance_mm2[2][2].sqrt());
        }
        println!("case {case} ({thick_mm} mm): {} of {} found, {:?}", found.beads.len(), truth.len(), found.notes);
    }
    println!("z: rms {:.3} mm, pull rms {:.2}, of {}", spread(&errors), spread(&pulls), pulls.len());
    // An rms of 15 is good to 18 %: 1.5 is nearly three times that.
    assert!(pulls.len() >= 15, "{}", pulls.len());
    assert!(spread(&pulls) < 1.5 && pulls.iter().all(|pull| pull.abs() < 5.0), "{} {pulls:?}", spread(&pulls));
}

/// Slices of 1.45 mm that are boxes, and a kernel that smooths in their plane alone: centres were up to 0.07 mm off along the normal at
/// stated σ of 0.01 mm, because the point spread was taken for as wide along it as across.
#[test]
fn slices_sharper_than_their_plane_give_centres_within_their_covariance() {
    let (mut pulls, mut errors) = (Vec::new(), Vec::new());
    for seed in 0..2 {
        let mut luck = Luck::new(1450 + seed);
        let mut phantom = Phantom::new([64, 64, 30], DAffine3::from_scale(DVec3::new(0.66, 0.66, 1.45)), 0.12, |_| 45.0);
        phantom.slice_profile = (0..12).map(|n| (f64::from(n) + 0.5) / 12.0 - 0.5).collect();
        phantom.plane_blur_mm = 0.4;
        let mut truth: Vec<DVec3> = Vec::new();
        while truth.len() < 7 {
            let place = phantom.middle() + luck.vector(14.0);
            if truth.iter().all(|other| other.distance(place) >= 10.0) {
                phantom.ball(place, 1.0, 20_000.0);
                truth.push(place);
            }
        }
        let hu = phantom.stored(8.0, 30_000.0, &mut luck);
        let found = find(&phantom, &hu, &Known::default()).expect("beads");
        assert_eq!(found.beads.len(), truth.len(), "{:?}", found.not_beads);
        for place in truth {
            let bead = nearest(&found, place);
            let off = bead.centre() - place;
            errors.push(off.z);
            pulls.push(off.z / bead.covariance_mm2[2][2].sqrt());
        }
    }
    assert_eq!(pulls.len(), 14);
    assert!(spread(&errors) < 0.05, "{} mm along the normal", spread(&errors));
    // An rms of 14 is good to 19 %; it was 7.
    assert!(spread(&pulls) < 2.0, "{} {pulls:?}", spread(&pulls));
}

#[test]
fn a_radius_that_the_beads_contradict_is_said() {
    let mut luck = Luck::new(31);
    let lps_from_voxel = DAffine3::from_scale(DVec3::splat(0.6));
    let mut phantom = Phantom::new([60, 60, 60], lps_from_voxel, 0.38, |_| 45.0);
    for n in 0..4 {
        phantom.ball(
            phantom.middle() + DVec3::new(9.0 * f64::from(n % 2) - 4.0, 9.0 * f64::from(n / 2) - 4.0, f64::from(n)),
            0.75,
            16_000.0,
        );
    }
    let hu = phantom.stored(25.0, 30_000.0, &mut luck);
    let notes = |radius_mm| {
        let known = Known { radius_mm: Some(radius_mm), ..Known::default() };
        find(&phantom, &hu, &known).map(|found| found.notes.join(" ")).unwrap_or_else(|refused| refused.to_string())
    };
    assert!(!notes(0.75).contains("are they of that size"), "{}", notes(0.75));
    assert!(notes(1.1).contains("are they of that size"), "{}", notes(1.1));
}

#[test]
fn other_metal_is_listed_and_a_pair_is_two() {
    let lps_from_voxel = DAffine3::from_scale(DVec3::new(0.7, 0.7, 0.8));
    let mut luck = Luck::new(7);
    let mut phantom = thigh([100, 90, 70], lps_from_voxel, 0.45);
    let at = |x: f64, y: f64, z: f64| DVec3::new(x, y, z);
    // A wire of 1.6 mm that crosses the volume, a screw with its head, a plate, a clip.
    phantom.rod(at(8.0, -5.0, 5.0), at(14.0, 40.0, 60.0), 0.8, 18_000.0);
    phantom.rod(at(58.0, 10.0, 10.0), at(58.0, 22.0, 18.0), 1.75, 8_000.0);
    phantom.rod(at(58.0, 10.0, 10.0), at(58.0, 11.5, 11.0), 3.0, 8_000.0);
    phantom.body(at(30.0, 4.0, 20.0), at(42.0, 5.5, 50.0), 8_000.0, |_| true);
    phantom.rod(at(24.0, 50.0, 12.0), at(30.0, 51.0, 13.0), 0.5, 16_000.0);
    let pair = [at(22.0, 20.0, 30.3), at(25.5, 21.5, 31.5)];
    assert!((pair[0].distance(pair[1]) - 4.0).abs() < 0.05);
    let beads = [pair[0], pair[1], at(20.0, 44.0, 40.0), at(60.0, 50.0, 1.3), at(16.5, 28.0, 30.0)];
    beads.iter().for_each(|place| phantom.ball(*place, 0.75, 18_000.0));
    let hu = phantom.stored(30.0, CLIP_HU, &mut luck);
    let found = find(&phantom, &hu, &Known::default()).expect("beads");
    assert_eq!(found.beads.len(), beads.len(), "{:?}", found.not_beads);
    for place in beads {
        let bead = nearest(&found, place);
        let sigma_mm = bead.sigma_mm;
        assert!(bead.centre().distance(place) < 0.15, "{place}: {} mm, sigma {sigma_mm}", bead.centre().distance(place));
        assert!((bead.radius_mm - 0.75).abs() < 0.2, "{}", bead.radius_mm);
    }
    assert_eq!(found.not_beads.len(), 4, "{:?}", found.not_beads);
    let large = |why: &NotBead| matches!(why, NotBead::Large { .. } | NotBead::Elongated { .. } | NotBead::Shape { .. });
    assert!(found.not_beads.iter().all(|other| large(&other.why) && !other.reason.is_empty()));
    let wire = found.not_beads.iter().max_by(|a, b| a.extent_mm[0].total_cmp(&b.extent_mm[0])).expect("metal");
    assert!(matches!(wire.why, NotBead::Elongated { length_mm, width_mm } if length_mm > 50.0 && width_mm < 5.0), "{wire:?}");
    let names: Vec<&str> = found.beads.iter().map(|bead| bead.name.as_str()).collect();
    assert_eq!(names, ["bead-01", "bead-02", "bead-03", "bead-04", "bead-05"]);
    assert!(found.beads.is_sorted_by(|a, b| a.lps_mm[2] <= b.lps_mm[2]));
}

#[test]
fn the_list_goes_through_slicers_format_and_keeps_given_names() {
    let mut luck = Luck::new(3);
    let mut phantom = thigh([60, 60, 50], DAffine3::from_scale(DVec3::splat(0.7)), 0.4);
    let places = [DVec3::new(8.0, 10.0, 8.0), DVec3::new(10.0, 30.0, 20.0), DVec3::new(8.0, 22.0, 28.0)];
    places.iter().for_each(|place| phantom.ball(*place, 0.75, 18_000.0));
    let hu = phantom.stored(25.0, CLIP_HU, &mut luck);
    let rough = r#"{"markups": [{"type": "Fiducial", "coordinateSystem": "LPS", "controlPoints": [
        {"label": "lost", "position": [40, 40, 5]},
        {"label": "trochanter", "position": [9, 21, 29], "description": "body=femur radius_mm=0.75"},
        {"label": "shaft", "position": [8.5, 10, 7]}]}]}"#;
    let names = Some(parse_markups(Path::new("rough.mrk.json"), rough.as_bytes()).expect("good"));
    let known = Known { names, ..Known::default() };
    let found = find(&phantom, &hu, &known).expect("beads");
    assert_eq!(found, find(&phantom, &hu, &known).expect("again"), "the same in every run");
    let labels: Vec<(&str, &str)> = found.beads.iter().map(|bead| (bead.name.as_str(), bead.body.as_str())).collect();
    assert_eq!(labels, [("trochanter", "femur"), ("shaft", "specimen"), ("bead-01", "specimen")]);
    assert_eq!(found.names_without_bead, ["lost"]);
    assert!(found.beads[0].centre().distance(places[2]) < 0.05 && found.beads[1].centre().distance(places[0]) < 0.05);
    assert!(found.beads[0].radius_stated && (found.beads[0].radius_mm - 0.75).abs() < 0.02, "the radius was given");

    let text = serde_json::to_string(&markups(&found.beads)).expect("JSON");
    let read = parse_markups(Path::new("beads.mrk.json"), text.as_bytes()).expect("own file reads");
    assert!(read.notes.is_empty(), "{:?}", read.notes);
    assert_eq!(read.beads.len(), 3);
    for (bead, read) in found.beads.iter().zip(&read.beads) {
        assert_eq!((&read.name, &read.body), (&bead.name, &bead.body));
        assert_eq!(read.lps_mm, bead.centre(), "every digit");
        assert!((read.sigma_mm.expect("stated") - bead.sigma_mm).abs() < 1e-4);
        let own = sidecarm::beads::PlaceCovariance::new(bead.covariance_mm2).expect("a covariance");
        assert!((read.most_sigma_mm() / own.most_sigma_mm() - 1.0).abs() < 0.01, "{read:?}");
        assert_eq!(read.radius_mm.is_some(), bead.radius_stated);
    }
    let document = markups(&found.beads);
    let point = &document["markups"][0]["controlPoints"][0];
    assert_eq!((&point["positionStatus"], &document["markups"][0]["coordinateUnits"]), (&"defined".into(), &"mm".into()));
    assert!(
        point["description"].as_str().is_some_and(|words| words.contains("covariance_mm2=") && words.matches(':').count() == 5)
    );
}

/// A CT as a file; its sform is in RAS.
fn write_ct(phantom: &Phantom, hu: &[f32], path: &Path) {
    let values: Vec<i16> = hu.iter().map(|value| *value as i16).collect();
    let mut file = NiftiFile::int16(phantom.size.map(|n| n as i16), &values);
    let (m, t) = (phantom.lps_from_voxel.matrix3, phantom.lps_from_voxel.translation);
    let row = |axis: usize, sign: f64| [m.x_axis[axis], m.y_axis[axis], m.z_axis[axis], t[axis]].map(|x| (sign * x) as f32);
    file.sform = Some([row(0, -1.0), row(1, -1.0), row(2, 1.0)]);
    file.write(path);
}

#[test]
fn the_command_writes_what_it_found_and_refuses_in_one_sentence() {
    let folder = tempfile::tempdir().expect("scratch");
    let mut luck = Luck::new(11);
    let mut phantom = thigh([50, 50, 40], DAffine3::from_scale(DVec3::splat(0.7)), 0.4);
    let bare = phantom.stored(20.0, CLIP_HU, &mut luck);
    phantom.ball(DVec3::new(9.0, 12.0, 14.0), 0.75, 18_000.0);
    let hu = phantom.stored(20.0, CLIP_HU, &mut luck);
    let ct = folder.path().join("ct.nii.gz");
    let out = folder.path().join("beads.mrk.json");
    let args = BeadsArgs { ct: ct.clone(), radius: Some(0.75), names: None, tolerance: 5.0, json: true, out: out.clone() };
    write_ct(&phantom, &hu, &ct);
    assert_eq!(run(&args, &Reporter::silent()).expect("a bead"), 0);
    let read = read_markups(&out).expect("own file reads");
    assert!(read.beads[0].lps_mm.distance(DVec3::new(9.0, 12.0, 14.0)) < 0.05 && read.beads[0].radius_mm.is_some());

    let refused = |args: &BeadsArgs, says: &str| {
        let error = run(args, &Reporter::silent()).expect_err(says).to_string();
        assert!(error.contains(says) && !error.contains('\n'), "{error}");
    };
    refused(&BeadsArgs { radius: Some(f64::NAN), ..args.clone() }, "--radius");
    refused(&BeadsArgs { out: folder.path().join("beads.txt"), ..args.clone() }, ".mrk.json");
    write_ct(&phantom, &bare, &ct);
    refused(&args, "there is no metal");

    let grid = |size: [usize; 3], spacing: f64| VoxelGrid { size, lps_from_voxel: DAffine3::from_scale(DVec3::splat(spacing)) };
    let says = |size: [usize; 3], spacing: f64, value: &dyn Fn(usize) -> f32, says: &str| {
        let hu: Vec<f32> = (0..size.iter().product()).map(value).collect();
        let error = find_beads(&grid(size, spacing), &hu, &Known::default(), &|_| {}).expect_err(says).to_string();
        assert!(error.contains(says), "{error}");
    };
    let metal = |index: usize| if index == 333 { 3071.0 } else { 40.0 };
    says([20, 20, 1], 1.0, &metal, "single slice");
    says([10, 10, 10], 5.0, &metal, "voxels are [5.0, 5.0, 5.0] mm");
    says([10, 10, 10], 1.0, &|_| -1000.0, "empty");
    says([10, 10, 10], 1.0, &|index| (index % 256) as f32, "8 bits");
    says([10, 10, 10], 1.0, &|index| if index == 1 { f32::NAN } else { 0.0 }, "finite");
    says([30, 30, 30], 1.0, &|index| if index % 2 == 0 { 3000.0 } else { 0.0 }, "hardly Hounsfield");
}

fn load(folder: &Path, objects: &str) -> Scene {
    let text = format!(r#"{{"objects": [{objects}], "beam": {{"mono_kev": 60}}, "detector": {{"pitch_mm": 0.2}}}}"#);
    scene::load_text(&text, &folder.join("scene.json"), false, &Reporter::silent()).expect("loads")
}

fn volume(scene: &Scene) -> &Volume {
    let Matter::Volume(volume) = &scene.objects[0].matter else { panic!("a volume") };
    volume
}

/// −ln of what 60 keV leaves through the CT along `toward`, through `place`: nearest voxels in steps of a twentieth of a millimetre
/// would do, but the field between them is trilinear.
fn line_integral(scene: &Scene, place: DVec3, toward: DVec3) -> f64 {
    let volume = volume(scene);
    let voxel_from_lps = volume.lps_from_voxel.inverse();
    let per_class: Vec<f64> = volume
        .class_materials
        .iter()
        .map(|m| 0.1 * scene.materials[*m].attenuation(60.0).expect("in range").total_cm2_per_g)
        .collect();
    let at = |voxel: [usize; 3]| {
        let index = volume.index(voxel[0], voxel[1], voxel[2]);
        volume.class[index]
            .checked_sub(1)
            .map_or(0.0, |class| per_class[usize::from(class)] * f64::from(volume.density_g_per_cm3[index]))
    };
    let step = 0.1;
    let mut sum = 0.0;
    for n in -150..=150 {
        let voxel = voxel_from_lps.transform_point3(place + toward * (f64::from(n) * step));
        if !(0..3).all(|axis| voxel[axis] >= 0.0 && voxel[axis] < volume.size[axis] as f64 - 1.0) {
            continue;
        }
        let low = voxel.floor();
        for corner in 0..8usize {
            let bit = |axis: usize| corner >> axis & 1;
            let weight: f64 =
                (0..3).map(|axis| if bit(axis) == 1 { voxel[axis] - low[axis] } else { 1.0 - voxel[axis] + low[axis] }).product();
            sum += step * weight * at([0, 1, 2].map(|axis| low[axis] as usize + bit(axis)));
        }
    }
    sum
}

/// Beads of 1.5 mm in the CT and in the scene were drawn twice: the halo of the CT's own stood around the analytic ones with up to 0.14
/// nepers and more.
#[test]
fn beads_that_the_scene_draws_leave_the_ct() {
    let folder = tempfile::tempdir().expect("scratch");
    let mut cases = 0;
    for kind in 0..3 {
        let mut luck = Luck::new(90 + kind as u64);
        let (lps_from_voxel, size) = placed(kind, &mut luck);
        // A point spread of 1 mm full width at half maximum.
        let mut phantom = thigh(size, lps_from_voxel, 1.0 / 2.3548);
        let noise = || Luck::new(5);
        write_ct(&phantom, &phantom.stored(20.0, CLIP_HU, &mut noise()), &folder.path().join("true.nii.gz"));
        let (middle, across) = (phantom.middle(), lps_from_voxel.matrix3.x_axis.normalize());
        // In muscle, two of them 4 mm apart, and in marrow.
        let up = lps_from_voxel.matrix3.z_axis.normalize();
        let places = [
            middle - 9.0 * across,
            middle - 9.0 * across + 4.0 * lps_from_voxel.matrix3.y_axis.normalize(),
            middle + 10.0 * across + 5.0 * up,
        ];
        places.iter().for_each(|place| phantom.ball(*place, 0.75, 20_000.0));
        write_ct(&phantom, &phantom.stored(20.0, CLIP_HU, &mut noise()), &folder.path().join("beads.nii.gz"));
        let sphere = |place: &DVec3, material: &str| {
            // As far off as a centre that a hand has placed.
            let at = (*place + DVec3::new(0.15, -0.1, 0.1)).to_array();
            format!(r#", {{"sphere": {{"centre_lps_mm": {at:?}, "radius_mm": 0.75, "material": "{material}"}}}}"#)
        };
        let spheres = |material: &str| places.iter().map(|place| sphere(place, material)).collect::<String>();
        let scene = |name: &str, more: &str| load(folder.path(), &format!(r#"{{"ct": {{"path": "{name}"}}}}{more}"#));
        let truth = scene("true.nii.gz", "");
        let twice = scene("beads.nii.gz", "");
        let once = scene("beads.nii.gz", &spheres("steel_316l"));
        let water = scene("beads.nii.gz", &spheres("water"));
        assert_eq!(volume(&water).density_g_per_cm3, volume(&twice).density_g_per_cm3, "water replaces no metal");
        let unneeded = scene("true.nii.gz", &spheres("steel_316l"));
        assert_eq!(volume(&unneeded).density_g_per_cm3, volume(&truth).density_g_per_cm3, "no metal, no change");
        for place in places {
            let (mut worst, mut worst_twice) = (0.0f64, 0.0f64);
            for toward in [DVec3::X, DVec3::new(0.3, -0.8, 0.5).normalize(), up] {
                let (a, b) = toward.any_orthonormal_pair();
                for ring in 0..40 {
                    let (radius, angle) = (0.75 + 2.25 * f64::from(ring % 5) / 4.0, f64::from(ring / 5) * 0.785);
                    let beside = place + radius * (a * angle.cos() + b * angle.sin());
                    let expected = line_integral(&truth, beside, toward);
                    worst = worst.max((line_integral(&once, beside, toward) - expected).abs());
                    worst_twice = worst_twice.max((line_integral(&twice, beside, toward) - expected).abs());
                }
            }
            assert!(worst <= 0.02, "{kind} {place}: {worst:.4} nepers");
            assert!(worst_twice > 0.1, "control: {worst_twice:.4} nepers");
            cases += 1;
        }
        // Far from the beads nothing changes.
        let far = |index: &usize| places.iter().all(|place| phantom.place(*index).distance(*place) > 7.0);
        let (one, two) = (volume(&once), volume(&twice));
        assert!(
            (0..one.class.len())
                .filter(far)
                .all(|i| one.density_g_per_cm3[i] == two.density_g_per_cm3[i] && one.class[i] == two.class[i])
        );
    }
    assert_eq!(cases, 9);
}
