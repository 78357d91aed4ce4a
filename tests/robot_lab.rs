//! A simulated lab in which a snake robot is shot from several sides, for the tests of `calibrate robot`.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::sync::Mutex;

use glam::{DMat3, DQuat, DVec3};
use sidecarm::acquire::{Domain, Frame};
use sidecarm::calibrate::robot::{Assumed, RobotFit, RobotFitError, Shot, calibrate};
use sidecarm::geometry::Rigid;
use sidecarm::image::Image;
use sidecarm::pose::Pose;
use sidecarm::reporter::Reporter;
use sidecarm::scene::{Scene, load_text};

use crate::robot_drawn::rand_free::Noise;
use crate::robot_drawn::{Ball, Eye, Place, Snake, V, draw};

pub const SIZE_PX: [usize; 2] = [620, 480];
const FOCAL_PX: f64 = 2629.0;

/// What is simulated.
#[derive(Clone, Copy, Debug)]
pub struct Lab {
    pub seed: u64,
    /// Orbital angle of each shot, degrees.
    pub directions_deg: &'static [f64],
    /// How far the scene's guess is off, mm and degrees.
    pub guess: [f64; 2],
    /// Offsets are drawn within ± this.
    pub offset_deg: f64,
    /// Shapes are drawn within ± this.
    pub bend_deg: f64,
    /// Of readings and of poses (degrees, mm).
    pub reading_sigma_deg: f64,
    pub pose_sigma: [f64; 2],
    /// In air; 0 for frames without noise.
    pub photons: f64,
    /// A load at every notch of one shot: which, and degrees in the plane and across it.
    pub load: Option<(usize, [f64; 2])>,
}

pub const SIX: Lab = Lab {
    seed: 1,
    directions_deg: &[-40.0, -20.0, 0.0, 20.0, 45.0, 70.0],
    guess: [10.0, 5.0],
    offset_deg: 1.5,
    bend_deg: 4.0,
    reading_sigma_deg: 0.02,
    pose_sigma: [0.01, 0.03],
    photons: 5e5,
    load: None,
};

/// Everything that was drawn.
pub struct Drawn {
    pub base: Place,
    pub offsets_deg: [f64; 5],
    pub eyes: Vec<Eye>,
    pub snakes: Vec<Snake>,
    pub readings_deg: Vec<[f64; 5]>,
    pub balls: Vec<Ball>,
    /// Of each shot, as a registration would give it.
    pub poses: Vec<Pose>,
    pub guess: Rigid,
}

pub fn rigid(place: &Place) -> Rigid {
    let axes = place.axes.map(DVec3::from_array);
    Rigid {
        rotation: DQuat::from_mat3(&DMat3::from_cols(axes[0], axes[1], axes[2])),
        translation_mm: DVec3::from_array(place.origin),
    }
}

const UPRIGHT: Place = Place { axes: [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]], origin: [0.0; 3] };

impl Lab {
    pub fn drawn(&self) -> Drawn {
        let mut random = Noise::new(self.seed.wrapping_mul(31).wrapping_add(7));
        let around = |random: &mut Noise, half: f64| -> V { std::array::from_fn(|_| random.within(half)) };
        // The shaft lies about along the orbit's axis, as an instrument does in a patient.
        let base = Place { origin: around(&mut random, 8.0), ..UPRIGHT };
        let base =
            base.turned(0, random.within(15.0)).turned(1, random.within(15.0)).turned(2, random.within(180.0)).along(-20.0);
        let offsets_deg = std::array::from_fn(|_| random.within(self.offset_deg));
        let mut balls = vec![([random.within(5.0), random.within(5.0), 0.0], 90.0, 0.02)];
        for _ in 0..4 {
            balls.push((around(&mut random, 30.0), 12.0 + random.within(5.0), 0.02 + 0.01 * random.uniform()));
        }
        for _ in 0..8 {
            balls.push((around(&mut random, 35.0), 0.75, 0.75));
        }
        let (mut eyes, mut snakes, mut readings, mut poses) = (Vec::new(), Vec::new(), Vec::new(), Vec::new());
        for (n, direction_deg) in self.directions_deg.iter().enumerate() {
            let place = UPRIGHT.turned(2, direction_deg + random.within(1.0)).turned(0, 90.0 + random.within(8.0));
            let place = place.turned(2, random.within(20.0)).along(-630.0 + random.within(10.0));
            let eye = Eye { place, focal_px: FOCAL_PX, principal_px: [309.5, 239.5], size_px: SIZE_PX };
            let common = random.within(0.5 * self.bend_deg);
            let readings_deg: [f64; 5] = std::array::from_fn(|_| common + random.within(0.5 * self.bend_deg));
            let mut angle = |k: usize| readings_deg[k] + offsets_deg[k] + self.reading_sigma_deg * random.normal();
            let angles_deg = std::array::from_fn(&mut angle);
            let load_deg = self.load.filter(|(shot, _)| *shot == n).map_or([0.0; 2], |(_, load)| load);
            let off = [self.pose_sigma[0].to_radians(), self.pose_sigma[1]];
            let turn = DVec3::from_array(std::array::from_fn(|_| off[0] * random.normal()));
            let shift = DVec3::from_array(std::array::from_fn(|_| off[1] * random.normal()));
            poses.push(pose(&eye, turn, shift, off));
            eyes.push(eye);
            snakes.push(Snake { base, angles_deg, load_deg });
            readings.push(readings_deg);
        }
        let truth = rigid(&base);
        let middle = DVec3::new(0.0, 0.0, 19.5);
        let about = Rigid::translation(truth.transform_point(middle));
        let turn = DQuat::from_axis_angle(DVec3::from_array(random.way()), self.guess[1].to_radians());
        let shift = Rigid::translation(DVec3::from_array(random.way()) * self.guess[0]);
        let guess = shift * about * Rigid::rotation(turn) * about.inverse() * truth;
        Drawn { base, offsets_deg, eyes, snakes, readings_deg: readings, balls, poses, guess }
    }
}

/// What `drawing` gives, or gave for this key: most tests have the six frames of one lab.
fn once(key: &str, drawing: impl FnOnce() -> Vec<f32>) -> Vec<f32> {
    static DRAWN: Mutex<BTreeMap<String, Vec<f32>>> = Mutex::new(BTreeMap::new());
    let kept = || DRAWN.lock().expect("not poisoned");
    if let Some(pixels) = kept().get(key) {
        return pixels.clone();
    }
    let pixels = drawing();
    kept().insert(key.to_owned(), pixels.clone());
    pixels
}

/// The pose of a registration that erred by `turn` about the specimen's middle and `shift`, with its covariance.
fn pose(eye: &Eye, turn: DVec3, shift: DVec3, sigmas: [f64; 2]) -> Pose {
    let camera_from_lps = rigid(&eye.place).inverse();
    let middle = Rigid::translation(camera_from_lps.translation_mm);
    let erred = middle * Rigid::exp(turn, shift) * middle.inverse() * camera_from_lps;
    // ξ about the middle c to ξ about the focal spot: (ω, v + c × ω) = (ω, v − ω × c).
    let c = camera_from_lps.translation_mm;
    let cross = [[0.0, -c.z, c.y], [c.z, 0.0, -c.x], [-c.y, c.x, 0.0]];
    let turn_variance = sigmas[0].powi(2);
    let entry = |i: usize, j: usize| {
        let same = if i == j { 1.0 } else { 0.0 };
        match (i < 3, j < 3) {
            (true, true) => same * turn_variance,
            (true, false) => cross[j - 3][i] * turn_variance,
            (false, true) => cross[i - 3][j] * turn_variance,
            (false, false) => {
                let levers: f64 = cross[i - 3].iter().zip(&cross[j - 3]).map(|(a, b)| a * b).sum();
                same * sigmas[1].powi(2) + levers * turn_variance
            }
        }
    };
    let covariance: [[f64; 6]; 6] = std::array::from_fn(|i| std::array::from_fn(|j| entry(i, j)));
    let [cx, cy] = eye.principal_px;
    serde_json::from_value(serde_json::json!({"status": "accepted", "size_px": eye.size_px,
        "intrinsics": [[eye.focal_px, 0.0, cx], [0.0, eye.focal_px, cy], [0.0, 0.0, 1.0]], "camera_from_lps": erred,
        "covariance": covariance}))
    .expect("a pose")
}

impl Drawn {
    /// The scene with the robot where it is guessed to be.
    pub fn scene_json(&self) -> serde_json::Value {
        serde_json::json!({
            "objects": [{"robot": {"model": "calibration/robot/cdm.json", "lps_from_base": self.guess, "control_angles_deg": [0, 0, 0, 0, 0]}}],
            "beam": {"tube_kvp": 90, "anode_angle_deg": 12, "filtration_mm": {"aluminium": 4.3}, "photons_per_pixel": 5e5},
            "detector": {"response": "energy", "pitch_mm": 0.388},
            "model": {"formation": "deepdrr", "scatter": "off", "noise": false, "seed": 1}
        })
    }

    pub fn scene(&self) -> Scene {
        load_text(&self.scene_json().to_string(), Path::new("scene.json"), false, &Reporter::silent()).expect("a scene")
    }

    /// The `n`th frame by the tests' own drawing; without the robot where `seen` is false.
    pub fn frame(&self, lab: &Lab, n: usize, seen: bool) -> Frame {
        let (eye, snake) = (&self.eyes[n], self.snakes[n]);
        let drawing = || draw(eye, seen.then_some(&snake), &self.balls, lab.photons, 1000 * lab.seed + n as u64);
        let is_of_six = format!("{lab:?}") == format!("{SIX:?}");
        let pixels = if is_of_six { once(&format!("{eye:?} {snake:?} {seen} {n} {:?}", self.balls), drawing) } else { drawing() };
        let image = Image::from_pixels(SIZE_PX[0], SIZE_PX[1], pixels).expect("as many");
        Frame::from_pixels(&format!("shot-{n}"), image, Domain::Linear).expect("a frame")
    }

    pub fn shot(&self, frame: &Frame, n: usize) -> Shot {
        Shot::of(&format!("shot-{n}"), frame, &self.poses[n], self.readings_deg[n], Rigid::IDENTITY).expect("a shot")
    }

    pub fn shots(&self, lab: &Lab) -> Vec<Shot> {
        (0..self.eyes.len()).map(|n| self.shot(&self.frame(lab, n, true), n)).collect()
    }

    /// Errors of the base's origin (mm) and turn (degrees), and the largest of offsets (degrees).
    pub fn errors(&self, fit: &RobotFit) -> [f64; 3] {
        let truth = rigid(&self.base);
        let found = fit.calibration.lps_from_base.expect("in the specimen");
        let offsets = fit.calibration.control_angle_offsets_deg.iter().zip(&self.offsets_deg).map(|(a, b)| (a - b).abs());
        [
            found.translation_mm.distance(truth.translation_mm),
            found.angle_to_rad(&truth).to_degrees(),
            offsets.fold(0.0, f64::max),
        ]
    }

    /// How far a load moves the tip of the `n`th shot in the plane of its image, columns and rows, mm.
    pub fn bent_mm(&self, n: usize) -> [f64; 2] {
        let eye = &self.eyes[n];
        let seen = |snake: &Snake| {
            let from: V = std::array::from_fn(|k| snake.tip()[k] - eye.place.origin[k]);
            eye.place.axes.map(|axis| crate::robot_drawn::dot(axis, from))
        };
        let (bent, free) = (seen(&self.snakes[n]), seen(&Snake { load_deg: [0.0; 2], ..self.snakes[n] }));
        std::array::from_fn(|k| (bent[k] / bent[2] - free[k] / free[2]) * free[2])
    }
}

pub fn fit(lab: &Lab) -> (Drawn, Result<RobotFit, RobotFitError>) {
    let drawn = lab.drawn();
    let found = calibrate(&drawn.shots(lab), &drawn.scene(), &Assumed::default());
    (drawn, found)
}

/// Frames, poses, the table of angles and the scene as files; returns the pose files.
pub fn write(folder: &Path, lab: &Lab, drawn: &Drawn) -> Vec<PathBuf> {
    std::fs::write(folder.join("scene.json"), drawn.scene_json().to_string()).expect("written");
    let mut table = "frame,image,angle_1_deg,angle_2_deg,angle_3_deg,angle_4_deg,angle_5_deg\n".to_owned();
    let paths = (0..drawn.eyes.len()).map(|n| {
        let frame = drawn.frame(lab, n, true);
        let image = format!("frame-{n}.tif");
        sidecarm::image::write_tiff_f32(&folder.join(&image), std::slice::from_ref(&frame.pixels)).expect("written");
        let path = folder.join(format!("pose-{n}.json"));
        drawn.poses[n].write(&path).expect("written");
        let angles = drawn.readings_deg[n].map(|angle| angle.to_string()).join(",");
        table += &format!("pose-{n},{image},{angles}\n");
        path
    });
    let paths = paths.collect();
    std::fs::write(folder.join("angles.csv"), table).expect("written");
    paths
}
