//! `sidecarm calibrate carm` against simulated arms that bend (`carm_arm`, which shares no code with the program).

use std::path::{Path, PathBuf};
use std::process::Command;

use glam::{DMat3, DQuat, DVec2, DVec3};
use sidecarm::beads::DEFAULT_SIGMA_MM;
use sidecarm::calibrate::carm::{CarmFit, CarmFitError, CarmReport, Sensors, Shot, ShotBead, calibrate};
use sidecarm::geometry::{CarmCalibration, CarmJoints, Rigid};
use sidecarm::random::{Purpose, Stream};

use crate::calibrate_carm_sigma::over_stated;
use crate::carm_arm::{Arm, Bed, Joints, Posture, TURNS_DEG, V, WANDERS_MM, angle_deg, sub};

pub fn nominal() -> CarmCalibration {
    let text = include_str!("../calibration/carm/nominal-mobile.json");
    serde_json::from_str(text).expect("a calibration of the project")
}

/// What a simulated lab has.
#[derive(Clone, Copy, Debug)]
pub struct Lab {
    pub seed: u64,
    pub shots: usize,
    pub sensors: Sensors,
    /// The column turns too, by up to 8 degrees either way.
    pub wig_wags: bool,
}

pub const GOOD: Sensors = Sensors { sigma_deg: 0.02, sigma_mm: 0.1 };
const BEAD_NOISE_PX: f64 = 0.05;

impl Lab {
    pub fn random(&self, what: u32) -> Stream {
        Stream::new(self.seed, 2, what, Purpose::Evaluation)
    }

    /// True joints: over the orbit evenly, the angulation in turns; shots jitter.
    pub fn joints(&self, random: &mut Stream, n: usize, count: usize) -> Joints {
        let mut within = |half: f64| half * (2.0 * random.uniform() - 1.0);
        let orbital = -90.0 + 180.0 * (n as f64 + 0.5) / count as f64 + within(6.0);
        let angulation = [-25.0, 25.0, 0.0][n % 3] + within(5.0);
        let wig_wag = if self.wig_wags { within(8.0) } else { 3.0 };
        [20.0 + within(20.0), wig_wag, within(30.0), angulation, orbital, within(15.0), 1020.0]
    }

    pub fn read(&self, random: &mut Stream, joints: Joints) -> CarmJoints {
        let Sensors { sigma_deg, sigma_mm } = self.sensors;
        let sigmas = [sigma_mm, if self.wig_wags { sigma_deg } else { 0.0 }, sigma_mm, sigma_deg, sigma_deg, sigma_deg, 0.0];
        let mut read: [f64; 7] = std::array::from_fn(|n| joints[n] + sigmas[n] * random.normal());
        [1, 3, 4, 5].into_iter().for_each(|n| read[n] = read[n].to_radians());
        CarmJoints::from_array(read)
    }

    /// On a shell that is in view from all sides.
    pub fn beads(&self) -> Vec<V> {
        let mut random = self.random(1);
        let count = 8 + (self.seed % 5) as usize;
        let bead = |_| {
            let way = DVec3::new(random.normal(), random.normal(), random.normal());
            (way.normalize() * (60.0 + 10.0 * random.uniform())).to_array()
        };
        (0..count).map(bead).collect()
    }

    pub fn shots(&self, arm: &Arm, bed: &Bed) -> Vec<Shot> {
        let (mut random, beads) = (self.random(2), self.beads());
        let shot = |n: usize| {
            let joints = self.joints(&mut random, n, self.shots);
            let posture = arm.posture(joints);
            let bead = |(b, at): (usize, &V)| {
                let [u, v] = posture.shadow(bed.room_from_lps(*at), arm);
                let image_px = DVec2::new(u + BEAD_NOISE_PX * random.normal(), v + BEAD_NOISE_PX * random.normal());
                ShotBead {
                    name: format!("bead-{b:02}"),
                    lps_mm: DVec3::from_array(*at),
                    image_px,
                    noise_px2: [BEAD_NOISE_PX.powi(2), 0.0, BEAD_NOISE_PX.powi(2)],
                    place_mm2: DMat3::from_diagonal(DVec3::splat(DEFAULT_SIGMA_MM.powi(2))),
                }
            };
            let beads = beads.iter().enumerate().map(bead).collect();
            let joints = self.read(&mut random, joints);
            Shot {
                name: format!("shot-{n:02}"),
                size_px: [1536, 1536],
                joints,
                beads,
                camera_from_lps: camera_from_lps(&posture, bed),
            }
        };
        (0..self.shots).map(shot).collect()
    }

    pub fn fit(&self, arm: &Arm, bed: &Bed) -> Result<CarmFit, CarmFitError> {
        calibrate(&self.shots(arm, bed), &nominal(), &self.sensors)
    }

    /// Piercing point (mm on the panel), ray (degrees) and the piercing point at the isocentre (mm) of held-out shots, by their readings and
    /// by true joints.
    fn held_out(&self, arm: &Arm, bed: &Bed, fit: &CarmFit) -> Vec<[[f64; 3]; 2]> {
        let mut random = self.random(3);
        let shot = |n: usize| {
            let joints = self.joints(&mut random, n, 12);
            let posture = arm.posture(joints);
            let reading = self.read(&mut random, joints);
            let exact = Self { sensors: Sensors { sigma_deg: 0.0, sigma_mm: 0.0 }, ..*self }.read(&mut random, joints);
            [reading, exact].map(|joints| errors(&posture, arm, bed, fit, &joints))
        };
        (0..12).map(shot).collect()
    }
}

/// The camera as its own definition has it: axes of the panel, origin in the focal spot.
pub fn camera_from_lps(posture: &Posture, bed: &Bed) -> Rigid {
    let rows = [posture.columns, posture.rows, posture.normal()].map(DVec3::from_array);
    let room = Rigid {
        rotation: DQuat::from_mat3(&DMat3::from_cols(rows[0], rows[1], rows[2])),
        translation_mm: DVec3::from_array(posture.source),
    };
    let axes = [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]];
    let turned = axes.map(|axis| DVec3::from_array(sub(bed.room_from_lps(axis), bed.at)));
    let rotation = DQuat::from_mat3(&DMat3::from_cols(turned[0], turned[1], turned[2]));
    room.inverse() * Rigid { rotation, translation_mm: DVec3::from_array(bed.at) }
}

fn errors(posture: &Posture, arm: &Arm, bed: &Bed, fit: &CarmFit, joints: &CarmJoints) -> [f64; 3] {
    let isocentre = bed.lps_from_room(posture.isocentre);
    let world_from_camera = fit.calibration.world_from_camera(joints).expect("measured");
    let camera_from_lps = world_from_camera.inverse() * fit.world_from_lps;
    let k = fit.calibration.intrinsics(joints).expect("measured");
    let predicted = k.project(camera_from_lps.transform_point(DVec3::from_array(isocentre)));
    let [u, v] = posture.shadow(posture.isocentre, arm);
    let source = camera_from_lps.inverse().translation_mm.to_array();
    let true_source = bed.lps_from_room(posture.source);
    let ray = angle_deg(sub(isocentre, source), sub(isocentre, true_source));
    let off_px = predicted.distance(DVec2::new(u, v));
    [off_px * arm.pitch_mm, ray, off_px * fit.calibration.source_to_isocentre_mm / k.fx]
}

/// Median, 95 % and largest of a list.
fn spread(mut values: Vec<f64>) -> [f64; 3] {
    values.sort_by(f64::total_cmp);
    let at = |share: f64| values[((values.len() - 1) as f64 * share).round() as usize];
    [at(0.5), at(0.95), at(1.0)]
}

/// Spreads over all held-out shots of `count` arms from `first`: piercing point, ray and isocentre by readings, the same by true joints.
fn many(first: u64, count: u64, shots: usize, sensors: Sensors, wig_wags: bool) -> [[f64; 3]; 6] {
    let mut all: [Vec<f64>; 6] = Default::default();
    for seed in first..first + count {
        let (arm, bed) = (Arm::drawn(seed), Bed::drawn(seed));
        let lab = Lab { seed, shots, sensors, wig_wags };
        let fit = lab.fit(&arm, &bed).unwrap_or_else(|error| panic!("arm {seed}: {error}"));
        assert!(fit.left_out.is_empty(), "arm {seed}: {:?}", fit.left_out);
        for [by_reading, exactly] in lab.held_out(&arm, &bed, &fit) {
            by_reading.into_iter().chain(exactly).zip(&mut all).for_each(|(error, all)| all.push(error));
        }
    }
    all.map(spread)
}

/// Targets for good encoders: mm of the piercing point on the panel, degrees.
const TARGET_MM: f64 = 0.3;
const TARGET_DEG: f64 = 0.05;

/// A figure as docs/figures.md has it, with what became of its target.
fn figure([median, most, _]: [f64; 3], unit: &str, target: Option<f64>) -> String {
    let digits = if unit == "°" { 3 } else { 2 };
    let target = target.map_or(String::new(), |target| match (median <= target, most <= target) {
        (true, true) => format!(" (target {target})"),
        (true, false) => format!(" (target {target}, met by the median alone)"),
        _ => format!(" (target {target}, missed)"),
    });
    format!("median {median:.digits$}{unit}, 95 % within {most:.digits$}{unit}{target}")
}

/// Rows of docs/figures.md; the first states what was drawn and how.
fn rows(
    drawn: &str,
    count: u64,
    [piercing, ray, isocentre, exact_piercing, exact_ray, exact_isocentre]: [[f64; 3]; 6],
    is_held: bool,
) -> Vec<String> {
    let target = |of: f64| Some(of).filter(|_| is_held);
    let figures = [
        format!("held-out piercing point: {}", figure(piercing, " mm", target(TARGET_MM))),
        format!("the same at the isocentre: {}", figure(isocentre, " mm", None)),
        format!("angle: {}", figure(ray, "°", target(TARGET_DEG))),
        format!("with true joints, piercing point: {}", figure(exact_piercing, " mm", None)),
        format!("with true joints, at the isocentre: {}", figure(exact_isocentre, " mm", None)),
        format!("with true joints, angle: {}", figure(exact_ray, "°", None)),
    ];
    let row = |(n, figure): (usize, String)| match n {
        0 => format!("| C-arm, `calibrate carm` | {drawn} | {figure} | `scripts/evaluate carm {count}` | 0–{} |", count - 1),
        _ => format!("| | | {figure} | | |"),
    };
    figures.into_iter().enumerate().map(row).collect()
}

#[test]
fn figures_say_what_became_of_their_target() {
    assert_eq!(figure([0.354, 0.84, 2.0], " mm", Some(0.3)), "median 0.35 mm, 95 % within 0.84 mm (target 0.3, missed)");
    assert_eq!(
        figure([0.033, 0.075, 0.2], "°", Some(0.05)),
        "median 0.033°, 95 % within 0.075° (target 0.05, met by the median alone)"
    );
    assert_eq!(figure([0.1, 0.2, 0.4], " mm", Some(0.3)), "median 0.10 mm, 95 % within 0.20 mm (target 0.3)");
    let rows = rows("ten arms", 10, [[0.1, 0.2, 0.3]; 6], false);
    let cells = |row: &String| row.matches('|').count();
    assert!(rows.len() == 6 && rows.iter().all(|row| cells(row) == 6 && !row.contains("target")), "{rows:#?}");
}

#[test]
#[ignore = "minutes long: scripts/evaluate carm runs it"]
fn many_arms() {
    let count = std::env::var("SIDECARM_ARMS").ok().and_then(|count| count.parse().ok()).unwrap_or(100u64);
    let poor = Sensors { sigma_deg: 0.2 / 3f64.sqrt(), sigma_mm: 0.1 };
    let (mut reached, mut lines) = (Vec::new(), Vec::new());
    for (encoders, sensors, wig_wags, shots) in [
        ("encoders 0.02° and 0.1 mm", GOOD, false, 10),
        ("encoders 0.02° and 0.1 mm, the column turning", GOOD, true, 10),
        ("sensors of ±0.2° (standard deviation 0.115°) and 0.1 mm", poor, false, 10),
        ("encoders 0.02° and 0.1 mm", GOOD, false, 8),
    ] {
        let all = many(0, count, shots, sensors, wig_wags);
        let [piercing, ray, isocentre, exact_piercing, exact_ray, exact_isocentre] = all;
        println!(
            "{count} arms, seeds from 0, {shots} shots, {encoders}: median, 95 %, largest: piercing point {piercing:.3?} mm, at the isocentre \
             {isocentre:.3?} mm, ray {ray:.4?} degrees; with true joints {exact_piercing:.3?} mm, {exact_isocentre:.3?} mm, {exact_ray:.4?} degrees"
        );
        let drawn = format!("{count} arms that sag by up to 16 mm and 3°, {shots} shots, {encoders}");
        lines.extend(rows(&drawn, count, all, reached.is_empty()));
        reached.push((piercing, ray));
    }
    println!("for docs/figures.md:");
    lines.iter().for_each(|line| println!("{line}"));
    // Targets, for good encoders and ten shots: 0.3 mm and 0.05 degrees. Reached over a hundred arms, median and 95 %: 0.35 and 0.85 mm on the
    // panel, which at the isocentre is 0.21 and 0.5 mm, and 0.032 and 0.071 degrees: medians meet them there, the 95 % do not.
    let (piercing, ray) = reached[0];
    assert!(piercing[0] <= 0.42 && piercing[1] <= 1.0, "good encoders: piercing point {piercing:?} mm");
    assert!(ray[0] <= 0.04 && ray[1] <= 0.085, "good encoders: ray {ray:?} degrees");
    // With sensors of ±0.2 degrees no target is set; reached: 0.56 and 1.50 mm, 0.14 and 0.31 degrees.
    let (piercing, ray) = reached[2];
    assert!(piercing[0] <= 0.67 && piercing[1] <= 1.8, "poor encoders: piercing point {piercing:?} mm");
    assert!(ray[0] <= 0.17 && ray[1] <= 0.37, "poor encoders: ray {ray:?} degrees");
    // Of the column that turns and of eight shots no figure is stated: they are printed.
    assert_eq!(reached.len(), 4);
    let over = over_stated(0..count);
    println!("{count} arms: held-out cameras over what the arm states, mm and degrees: {over:.2?}");
    over.assert_holds(1.0);
}

pub const GOOD_LAB: Lab = Lab { seed: 0, shots: 10, sensors: GOOD, wig_wags: false };

#[test]
fn ten_shots_calibrate_arms_that_sag() {
    let [piercing, ray, ..] = many(0, 3, 10, GOOD, false);
    // Half a millimetre on the detector is 0.3 mm at the isocentre.
    assert!(piercing[0] < 0.45 && piercing[2] < 1.5, "piercing point, mm: {piercing:?}");
    assert!(ray[0] < 0.05 && ray[2] < 0.15, "ray, degrees: {ray:?}");
    // Control: the arm as drawn errs by its sag.
    let (arm, bed) = (Arm::drawn(1), Bed::drawn(1));
    let lab = Lab { seed: 1, ..GOOD_LAB };
    let fit = lab.fit(&arm, &bed).expect("calibrates");
    let drawn = CarmFit { calibration: nominal(), ..fit };
    let off = lab.held_out(&arm, &bed, &drawn).into_iter().map(|[[piercing, ..], _]| piercing).collect();
    assert!(spread(off)[0] > 3.0, "the nominal arm");
}

#[test]
fn the_simulated_arm_sags_as_published() {
    let (mm, deg) = Arm::drawn(4).wanders();
    assert!((mm - WANDERS_MM).abs() < 1.0 && (deg - TURNS_DEG).abs() < 0.1, "{mm} mm, {deg} degrees");
}

#[test]
fn what_the_shots_cannot_tell_is_said() {
    let (arm, bed) = (Arm::drawn(5), Bed::drawn(5));
    let fit = Lab { seed: 5, ..GOOD_LAB }.fit(&arm, &bed).expect("calibrates");
    let relative = |key: &str| {
        let (parameter, sigma) = fit.parameters.iter().find(|(parameter, _)| parameter.key == key).expect("fitted");
        sigma / parameter.prior_sigma
    };
    assert!(relative("source_to_isocentre_mm") < 0.2, "{}", relative("source_to_isocentre_mm"));
    // The column never turned.
    assert!(relative("column_to_isocentre_mm[1]") > 0.9, "{}", relative("column_to_isocentre_mm[1]"));

    let mut shots = Lab { seed: 5, ..GOOD_LAB }.shots(&arm, &bed);
    let one = shots[4].clone();
    shots.iter_mut().for_each(|shot| *shot = Shot { name: shot.name.clone(), ..one.clone() });
    match calibrate(&shots, &nominal(), &GOOD) {
        Err(CarmFitError::OneAngle { orbital_deg, parameters, .. }) => {
            assert!(orbital_deg < 1e-9 && parameters.iter().any(|key| key == "source_to_isocentre_mm"), "{parameters:?}");
        }
        other => panic!("{:?}", other.map(|fit| fit.chi2_per_dof)),
    }
    assert!(matches!(calibrate(&shots[..3], &nominal(), &GOOD), Err(CarmFitError::TooFewShots { found: 3, .. })));
}

#[test]
fn a_shot_with_the_joints_of_another_moment_is_named() {
    let (arm, bed) = (Arm::drawn(6), Bed::drawn(6));
    let mut shots = Lab { seed: 6, ..GOOD_LAB }.shots(&arm, &bed);
    shots[3].joints.orbital_rad += 8f64.to_radians();
    let fit = calibrate(&shots, &nominal(), &GOOD).expect("calibrates without it");
    let named: Vec<&str> = fit.left_out.iter().map(|left_out| left_out.shot.as_str()).collect();
    assert_eq!(named, ["shot-03"]);
    assert!(fit.left_out[0].off.attitude_deg > 4.0, "{:?}", fit.left_out[0].off);
}

/// A pose as `register` writes it.
pub fn pose_of(shot: &Shot) -> serde_json::Value {
    let bead = |bead: &ShotBead| {
        serde_json::json!({"name": bead.name, "body": "specimen", "lps_mm": bead.lps_mm.to_array(), "image_px": bead.image_px.to_array(),
            "predicted_px": null, "residual_px": null, "sigma_px": bead.noise_px2[0].sqrt(), "left_out_px": null, "used": true, "reason": null})
    };
    let beads: Vec<_> = shot.beads.iter().map(bead).collect();
    serde_json::json!({"status": "accepted", "size_px": shot.size_px, "beads": beads,
        "intrinsics": [[5257.0, 0.0, 767.5], [0.0, 5257.0, 767.5], [0.0, 0.0, 1.0]], "camera_from_lps": shot.camera_from_lps})
}

/// Pose files and their table of joints, as `register` and a person write them.
fn write_shots(folder: &Path, shots: &[Shot]) -> Vec<PathBuf> {
    let mut table = "frame,lift_mm,wig_wag_deg,longitudinal_mm,angulation_deg,orbital_deg,detector_rotation_deg\n".to_owned();
    let write = |shot: &Shot| {
        let path = folder.join(format!("{}.json", shot.name));
        std::fs::write(&path, pose_of(shot).to_string()).expect("written");
        let [lift, wig_wag, longitudinal, angulation, orbital, rotation, _] = shot.joints.to_array();
        let [wig_wag, angulation, orbital, rotation] = [wig_wag, angulation, orbital, rotation].map(f64::to_degrees);
        table += &format!("{},{lift},{wig_wag},{longitudinal},{angulation},{orbital},{rotation}\n", shot.name);
        path
    };
    let paths = shots.iter().map(write).collect();
    std::fs::write(folder.join("joints.csv"), table).expect("written");
    paths
}

#[test]
fn the_command_writes_a_calibration_that_predicts_the_shots() {
    let folder = tempfile::tempdir().expect("scratch");
    let (arm, bed) = (Arm::drawn(7), Bed::drawn(7));
    let lab = Lab { seed: 7, ..GOOD_LAB };
    let paths = write_shots(folder.path(), &lab.shots(&arm, &bed));
    let out = folder.path().join("lab.json");
    let run = |paths: &[PathBuf]| {
        let mut command = Command::new(env!("CARGO_BIN_EXE_sidecarm"));
        command.args(["calibrate", "carm"]).args(paths).arg("--joints").arg(folder.path().join("joints.csv"));
        command.args([
            "--calibration",
            "calibration/carm/nominal-mobile.json",
            "--encoder-sigma-deg",
            "0.02",
            "--encoder-sigma-mm",
            "0.1",
        ]);
        command.args(["--origin", "a test", "--json", "--out"]).arg(&out).current_dir(env!("CARGO_MANIFEST_DIR"));
        command.output().expect("sidecarm runs")
    };
    let stray = folder.path().join("stray.json");
    std::fs::copy(&paths[0], &stray).expect("copied");
    let refused = run(&[stray]);
    assert_eq!(refused.status.code(), Some(1));
    assert!(String::from_utf8_lossy(&refused.stderr).contains("add a line `stray,"), "{refused:?}");
    assert!(!out.exists(), "nothing half-written");

    let done = run(&paths);
    assert_eq!(done.status.code(), Some(0), "{}", String::from_utf8_lossy(&done.stderr));
    let report: CarmReport = serde_json::from_slice(&done.stdout).expect("the report");
    assert!(report.shots.len() == 10 && report.held_out_piercing_mm < 2.0 && report.held_out_ray_deg < 0.2, "{report:?}");
    assert_eq!(std::fs::read(folder.path().join("lab.report.json")).expect("beside it"), done.stdout);
    assert!(std::fs::read_to_string(folder.path().join("lab.svg")).expect("plot").starts_with("<svg"));
    let calibration: CarmCalibration = serde_json::from_slice(&std::fs::read(&out).expect("written")).expect("reads");
    assert!(calibration.origin.contains("a test; 10 bead shots"), "{}", calibration.origin);
    assert!(calibration.camera_sigma_mm.is_some_and(|mm| mm > 0.0 && mm < 2.0), "{:?}", calibration.camera_sigma_mm);
    let fit = CarmFit { calibration, ..lab.fit(&arm, &bed).expect("calibrates") };
    let off = lab.held_out(&arm, &bed, &fit).into_iter().map(|[[piercing, ..], _]| piercing).collect();
    assert!(spread(off)[0] < 0.6, "the file predicts held-out shots");
}
