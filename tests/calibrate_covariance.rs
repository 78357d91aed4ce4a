//! Covariances of shadows and of bead places on their way into calibrations: from layouts through pose files into shots of an arm, and
//! from shots of a phantom into its beads.

use glam::{DMat3, DVec2, DVec3};
use serde_json::{Value, json};
use sidecarm::beads::{DEFAULT_SIGMA_MM, PlaceCovariance};
use sidecarm::calibrate::carm::{Shot, calibrate};
use sidecarm::calibrate::phantom::PhantomShot;
use sidecarm::geometry::CarmJoints;
use sidecarm::pose::{Pose, Prior, Registration, register_shadows};
use sidecarm::random::{Purpose, Stream};

use crate::calibrate_carm::{GOOD, GOOD_LAB, Lab, nominal, pose_of};
use crate::carm_arm::{Arm, Bed};
use crate::phantom_lab::{Compared, Lab as PhantomLab};
use crate::pose_registration::{matching, shadows};
use crate::pose_synthetic as synthetic;

/// Of beads in a CT of thick slices: σ 0.05 mm in their plane, 0.8 mm across.
const THICK_SLICES_MM2: [[f64; 3]; 3] = [[0.0025, 0.0, 0.0], [0.0, 0.0025, 0.0], [0.0, 0.0, 0.64]];

fn covariance() -> PlaceCovariance {
    PlaceCovariance::new(THICK_SLICES_MM2).expect("a covariance")
}

fn read(value: &Value) -> Result<Pose, serde_json::Error> {
    serde_json::from_value(value.clone())
}

fn shots(seed: u64) -> Vec<Shot> {
    Lab { seed, ..GOOD_LAB }.shots(&Arm::drawn(seed), &Bed::drawn(seed))
}

/// What the layout states of a place, and the frame of a centre, stand in the pose's file and come into the shot.
#[test]
fn covariances_go_from_the_layout_through_the_pose_into_the_shot() {
    let posed = |seed: u64| {
        let (view, mut layout) = (synthetic::view(1024, 1024, seed), synthetic::layout(8, 0.75, seed));
        let found = shadows(&view, &layout, 0.05, 0.02, seed);
        // Of the last but one only a standard deviation is stated, of the last nothing.
        layout.beads.iter_mut().take(6).for_each(|bead| bead.covariance_mm2 = Some(covariance()));
        layout.beads[6].sigma_mm = Some(0.3);
        let prior = Prior { camera_from_lps: view.camera_from_lps, covariance: None };
        let pose = register_shadows(&Registration { prior: Some(&prior), ..matching(&view, &layout) }, &found);
        let is_whole = pose.is_accepted() && pose.beads.iter().all(|bead| bead.used);
        is_whole.then_some((pose, layout))
    };
    let (pose, layout) = (0..40).find_map(posed).expect("a frame with all beads");
    let written = serde_json::to_value(&pose).expect("JSON");
    assert_eq!(written["beads"][0]["covariance_mm2"], json!(THICK_SLICES_MM2));
    assert_eq!(written["beads"][7].get("covariance_mm2"), None, "what is not stated is not written");
    let again = read(&written).expect("reads");
    assert_eq!(again.beads, pose.beads);
    let shot = Shot::of("a", &again, CarmJoints::ZERO).expect("a shot");
    assert_eq!(shot.beads.len(), layout.beads.len());
    for (n, (own, row)) in shot.beads.iter().zip(&pose.beads).enumerate() {
        let alike = |sigma_mm: f64| DMat3::from_diagonal(DVec3::splat(sigma_mm * sigma_mm));
        let stated = match n {
            6 => alike(0.3),
            7 => alike(DEFAULT_SIGMA_MM),
            _ => covariance().mm2(),
        };
        assert_eq!(own.place_mm2, stated);
        let [[uu, uv], [_, vv]] = row.covariance_px2.expect("of each shadow");
        assert!(own.noise_px2.iter().zip([uu, uv, vv]).all(|(own, stated)| (own - stated).abs() <= 1e-12 * (uu + vv)));
    }
    // What is no covariance is no pose file.
    let mut wrong = written.clone();
    wrong["beads"][0]["covariance_mm2"][1][1] = json!(-1.0);
    assert!(read(&wrong).expect_err("refused").to_string().contains("is not positive"));
    for list in ["beads", "shadows"] {
        let mut wrong = written.clone();
        wrong[list][0]["covariance_px2"] = json!([[0.04, 0.06], [0.06, 0.04]]);
        let words = read(&wrong).expect_err("refused").to_string();
        assert!(words.contains("is no covariance"), "{list}: {words}");
    }
}

/// A console turned the picture by 13 degrees and binned it: in the panel's picture the ellipse is turned back, and twice as large.
#[test]
fn a_shadow_s_covariance_turns_with_the_picture() {
    let shot = &shots(3)[0];
    // 0.2 px along a way at so many radians, 0.03 px across it.
    let ellipse = |angle: f64| {
        let along = DVec2::from_angle(angle);
        let (wide, least) = (0.04 - 0.0009, 0.0009);
        [least + wide * along.x * along.x, wide * along.x * along.y, least + wide * along.y * along.y]
    };
    let turn = 13f64.to_radians();
    let [uu, uv, vv] = ellipse(0.5 + turn);
    let mut value = pose_of(shot);
    for row in value["beads"].as_array_mut().expect("a list") {
        row["covariance_px2"] = json!([[uu, uv], [uv, vv]]);
    }
    let is_seen_as = |value: &Value, truth: [f64; 3]| {
        let found = Shot::of("a", &read(value).expect("reads"), shot.joints).expect("a shot").beads[0].noise_px2;
        assert!(found.iter().zip(truth).all(|(found, truth)| (found - truth).abs() < 1e-12), "{found:?} {truth:?}");
    };
    is_seen_as(&value, [uu, uv, vv]);
    value["console"] = json!({"rotation_deg": 13.0, "binning": 2});
    value["detector"] = json!({"detector_from_image": [[2, 0, 0.5], [0, 2, 0.5], [0, 0, 1]], "size_px": [1536, 1536],
        "camera_from_lps": shot.camera_from_lps});
    value["size_px"] = json!([768, 768]);
    is_seen_as(&value, ellipse(0.5).map(|variance| 4.0 * variance));
}

/// Files that state σ alone, and files that state the same as a covariance, give one arm; another covariance gives another.
#[test]
fn a_file_without_covariances_gives_what_one_with_round_ones_gives() {
    let own = shots(5);
    let fitted = |of: &dyn Fn(&mut Value)| {
        let shot = |shot: &Shot| {
            let mut value = pose_of(shot);
            value["beads"].as_array_mut().expect("a list").iter_mut().for_each(of);
            Shot::of(&shot.name, &read(&value).expect("reads"), shot.joints).expect("a shot")
        };
        let shots: Vec<Shot> = own.iter().map(shot).collect();
        let fit = calibrate(&shots, &nominal(), &GOOD).expect("calibrates");
        fit.parameters.iter().map(|(own, sigma)| [own.value(&fit.calibration), *sigma]).collect::<Vec<[f64; 2]>>()
    };
    let round = |row: &mut Value| {
        let variance = row["sigma_px"].as_f64().expect("a number").powi(2);
        row["covariance_px2"] = json!([[variance, 0.0], [0.0, variance]]);
        row["covariance_mm2"] = json!([[0.01, 0.0, 0.0], [0.0, 0.01, 0.0], [0.0, 0.0, 0.01]]);
    };
    let (plain, round) = (fitted(&|_| ()), fitted(&round));
    // Where the solver stops lies within 1e-5 standard deviations.
    for ([plain, sigma], [round, round_sigma]) in plain.iter().zip(&round) {
        assert!((plain - round).abs() < 1e-3 * sigma && (round_sigma / sigma - 1.0).abs() < 1e-3, "{plain} ± {sigma}: {round}");
    }
    let sliced = fitted(&|row: &mut Value| row["covariance_mm2"] = json!(THICK_SLICES_MM2));
    let is_other = |([plain, sigma], [sliced, sliced_sigma]): (&[f64; 2], &[f64; 2])| {
        (plain - sliced).abs() > 1e-2 * sigma || (sliced_sigma / sigma - 1.0).abs() > 1e-2
    };
    assert!(plain.iter().zip(&sliced).any(is_other), "the control");
}

/// Every shot's shadows blurred along a way of its own, as where something moved while the beam was on.
fn blurred(lab: &PhantomLab) -> Vec<PhantomShot> {
    const ALONG_PX: f64 = 0.3;
    let mut random = Stream::new(lab.seed, 63, 0, Purpose::Evaluation);
    let mut shots = lab.all();
    for (n, shot) in shots.iter_mut().enumerate() {
        let along = DVec2::from_angle(1.1 * n as f64);
        for shadow in &mut shot.shadows {
            shadow.image_px += along * (ALONG_PX * random.normal());
            let more = ALONG_PX * ALONG_PX * along;
            let [uu, uv, vv] = shadow.noise_px2;
            shadow.noise_px2 = [uu + more.x * along.x, uv + more.x * along.y, vv + more.y * along.y];
        }
    }
    shots
}

#[test]
fn beads_of_a_phantom_lie_where_stated_when_shadows_are_blurred_one_way() {
    let (mut pulls, mut own_mm2, mut alike_mm2) = (0.0, 0.0, 0.0);
    let seeds = 300..308;
    let count = (seeds.end - seeds.start) as f64;
    for seed in seeds {
        let lab = PhantomLab { false_shadows: 0, missing: 0.0, ..PhantomLab::new(seed) };
        let shots = blurred(&lab);
        let compared = |shots: &[PhantomShot]| {
            let phantom = lab.measured(shots).unwrap_or_else(|refusal| panic!("phantom {seed}: {refusal}"));
            Compared::new(&phantom, &lab.beads)
        };
        let own = compared(&shots);
        pulls += own.shape_pull.powi(2) / count;
        own_mm2 += own.shape_mm.powi(2) / count;
        let mut alike = shots.clone();
        for shadow in alike.iter_mut().flat_map(|shot| &mut shot.shadows) {
            let variance = 0.5 * (shadow.noise_px2[0] + shadow.noise_px2[2]);
            shadow.noise_px2 = [variance, 0.0, variance];
        }
        alike_mm2 += compared(&alike).shape_mm.powi(2) / count;
    }
    // Eight phantoms of ten beads: 184 numbers besides motion and scale, whose mean square scatters by √(2 / 184) about 1; 4.5 times that.
    assert!((0.53..1.47).contains(&pulls), "{pulls}");
    // The control: round covariances of the same size place the beads worse.
    assert!(own_mm2 < 0.7 * alike_mm2, "{} of {} mm", own_mm2.sqrt(), alike_mm2.sqrt());
}
