//! `sidecarm calibrate carm` against simulated arms that bend (`carm_arm`, which shares no code with the program).

use glam::{DMat3, DQuat, DVec2, DVec3};
use sidecarm::calibrate::carm::{CarmFit, CarmFitError, Sensors, Shot, ShotBead, calibrate};
use sidecarm::geometry::{CarmCalibration, CarmJoints, Rigid};
use sidecarm::random::{Purpose, Stream};

use crate::carm_arm::{Arm, Bed, Joints, Posture, V, angle_deg, sub};

fn nominal() -> CarmCalibration {
    let text = include_str!("../calibration/carm/live-620x480.json");
    serde_json::from_str(text).expect("a calibration of the project")
}

/// What a simulated lab has.
#[derive(Clone, Copy, Debug)]
struct Lab {
    seed: u64,
    shots: usize,
    sensors: Sensors,
    /// The column turns too, by up to 8 degrees either way.
    wig_wags: bool,
}

const GOOD: Sensors = Sensors { sigma_deg: 0.02, sigma_mm: 0.1 };
const BEAD_NOISE_PX: f64 = 0.05;

impl Lab {
    fn random(&self, what: u32) -> Stream {
        Stream::new(self.seed, 2, what, Purpose::Evaluation)
    }

    /// True joints: over the orbit evenly, the angulation in turns; shots jitter.
    fn joints(&self, random: &mut Stream, n: usize, count: usize) -> Joints {
        let mut within = |half: f64| half * (2.0 * random.uniform() - 1.0);
        let orbital = -90.0 + 180.0 * (n as f64 + 0.5) / count as f64 + within(6.0);
        let angulation = [-25.0, 10.0, 25.0, -10.0][n % 4] + within(5.0);
        let wig_wag = if self.wig_wags { within(8.0) } else { 3.0 };
        [20.0 + within(20.0), wig_wag, within(30.0), angulation, orbital, within(15.0), 1020.0]
    }

    fn read(&self, random: &mut Stream, joints: Joints) -> CarmJoints {
        let Sensors { sigma_deg, sigma_mm } = self.sensors;
        let sigmas = [sigma_mm, if self.wig_wags { sigma_deg } else { 0.0 }, sigma_mm, sigma_deg, sigma_deg, sigma_deg, 0.0];
        let mut read: [f64; 7] = std::array::from_fn(|n| joints[n] + sigmas[n] * random.normal());
        [1, 3, 4, 5].into_iter().for_each(|n| read[n] = read[n].to_radians());
        CarmJoints::from_array(read)
    }

    fn beads(&self) -> Vec<V> {
        let mut random = self.random(1);
        let count = 8 + (self.seed % 5) as usize;
        (0..count).map(|_| std::array::from_fn(|_| 40.0 * (2.0 * random.uniform() - 1.0))).collect()
    }

    fn shots(&self, arm: &Arm, bed: &Bed) -> Vec<Shot> {
        let (mut random, beads) = (self.random(2), self.beads());
        let shot = |n: usize| {
            let joints = self.joints(&mut random, n, self.shots);
            let posture = arm.posture(joints);
            let bead = |(b, at): (usize, &V)| {
                let [u, v] = posture.shadow(bed.room_from_lps(*at), arm);
                let image_px = DVec2::new(u + BEAD_NOISE_PX * random.normal(), v + BEAD_NOISE_PX * random.normal());
                ShotBead { name: format!("bead-{b:02}"), lps_mm: DVec3::from_array(*at), image_px, sigma_px: BEAD_NOISE_PX }
            };
            let beads = beads.iter().enumerate().map(bead).collect();
            let joints = self.read(&mut random, joints);
            Shot { name: format!("shot-{n:02}"), size_px: [620, 480], joints, beads, camera_from_lps: camera_from_lps(&posture, bed) }
        };
        (0..self.shots).map(shot).collect()
    }

    fn fit(&self, arm: &Arm, bed: &Bed) -> Result<CarmFit, CarmFitError> {
        calibrate(&self.shots(arm, bed), &nominal(), &self.sensors)
    }

    /// Piercing point (mm on the panel) and ray (degrees) of held-out shots, by their readings and by true joints.
    fn held_out(&self, arm: &Arm, bed: &Bed, fit: &CarmFit) -> Vec<[[f64; 2]; 2]> {
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
fn camera_from_lps(posture: &Posture, bed: &Bed) -> Rigid {
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

fn errors(posture: &Posture, arm: &Arm, bed: &Bed, fit: &CarmFit, joints: &CarmJoints) -> [f64; 2] {
    let isocentre = bed.lps_from_room(posture.isocentre);
    let world_from_camera = fit.calibration.world_from_camera(joints).expect("measured");
    let camera_from_lps = world_from_camera.inverse() * fit.world_from_lps;
    let k = fit.calibration.intrinsics(joints).expect("measured");
    let predicted = k.project(camera_from_lps.transform_point(DVec3::from_array(isocentre)));
    let [u, v] = posture.shadow(posture.isocentre, arm);
    let source = camera_from_lps.inverse().translation_mm.to_array();
    let true_source = bed.lps_from_room(posture.source);
    let ray = angle_deg(sub(isocentre, source), sub(isocentre, true_source));
    [predicted.distance(DVec2::new(u, v)) * arm.pitch_mm, ray]
}

/// Median, 95 % and largest of a list.
fn spread(mut values: Vec<f64>) -> [f64; 3] {
    values.sort_by(f64::total_cmp);
    let at = |share: f64| values[((values.len() - 1) as f64 * share).round() as usize];
    [at(0.5), at(0.95), at(1.0)]
}

/// Spreads over all held-out shots of `count` arms from `first`: piercing point and ray by readings, the same by true joints.
fn many(first: u64, count: u64, shots: usize, sensors: Sensors, wig_wags: bool) -> [[f64; 3]; 4] {
    let mut all: [Vec<f64>; 4] = Default::default();
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

#[test]
#[ignore = "long: a hundred arms a sensor; run by scripts/evaluate"]
fn many_arms() {
    let count = std::env::var("SIDECARM_ARMS").ok().and_then(|count| count.parse().ok()).unwrap_or(100u64);
    let poor = Sensors { sigma_deg: 0.2 / 3f64.sqrt(), sigma_mm: 0.1 };
    for (sensors, wig_wags, shots) in [(GOOD, false, 10), (GOOD, true, 10), (poor, false, 10), (GOOD, false, 8)] {
        let [piercing, ray, exact_piercing, exact_ray] = many(0, count, shots, sensors, wig_wags);
        println!(
            "{count} arms, seeds from 0, {shots} shots, {:.3} degrees and {} mm{}: median, 95 %, largest: piercing point {piercing:.3?} mm, ray \
             {ray:.4?} degrees; with true joints {exact_piercing:.3?} mm, {exact_ray:.4?} degrees",
            sensors.sigma_deg,
            sensors.sigma_mm,
            if wig_wags { ", the column turning" } else { "" }
        );
    }
}
