//! Boards for the window's tests: exposures of closed-form pictures in every state, and lines that live or are silent.
#![cfg(feature = "viewer")]

use std::sync::{Arc, OnceLock};

use glam::DVec3;
use sidecarm::compare::{CompareInput, Compared, compare};
use sidecarm::geometry::{CarmJoints, View};
use sidecarm::mask::Masks;
use sidecarm::pose::{Pose, Refusal};
use sidecarm::report::{Pair, PairStatus, PoseSource, ShadowMark};
use sidecarm::session::board::{BeadMark, BoardState, LandmarkMark, Link, PairMarks, PairPictures, PairView, RobotMark};
use sidecarm::telemetry::{CarmSample, DeviceKind, Sample};

use crate::compare_synthetic::{acquired, line_integral, pose, view};

/// The time of every board.
pub const NOW_US: i64 = 1_795_000_010_000_000;

/// A frame, and its DRR with the null of its scores.
fn compared() -> &'static (sidecarm::acquire::Frame, Compared) {
    static COMPARED: OnceLock<(sidecarm::acquire::Frame, Compared)> = OnceLock::new();
    COMPARED.get_or_init(|| {
        let truth = View { camera_from_lps: pose(DVec3::new(0.2, 0.3, 0.1)), ..view() };
        let frame = acquired(&line_integral(&truth), 0.02);
        let simulated = line_integral(&truth);
        let input =
            CompareInput { view: Some(&truth), centre_lps_mm: Some(DVec3::ZERO), ..CompareInput::new(&frame, &simulated) };
        let mut compared = compare(&input).expect("comparable");
        compared.add_null(&mut |small| Ok(line_integral(small)), &|| false).expect("null");
        (frame, compared)
    })
}

/// Where things are marked in the frame.
pub const FOUND_PX: [f64; 2] = [120.0, 90.0];
pub const RESIDUAL_PX: [f64; 2] = [1.0, 0.5];
pub const TIP_PX: [f64; 2] = [220.0, 170.0];
pub const LANDMARK_PX: [f64; 2] = [160.0, 60.0];
/// It is known best across the diagonal that falls to the right.
pub const LANDMARK_PX2: [[f64; 2]; 2] = [[0.36, 0.30], [0.30, 0.36]];

fn marks() -> PairMarks {
    let bead = |name: &str, at: [f64; 2], used| BeadMark {
        name: name.to_owned(),
        found_px: Some(at),
        radius_px: Some(5.0),
        predicted_px: Some([at[0] - RESIDUAL_PX[0], at[1] - RESIDUAL_PX[1]]),
        residual_px: Some(RESIDUAL_PX),
        used,
        by_hand: false,
    };
    PairMarks {
        beads: vec![bead("B1", FOUND_PX, true), bead("B2", [60.0, 150.0], false)],
        shadows: vec![ShadowMark { rank: 3, image_px: [30.0, 30.0], radius_px: 4.0, snr: 6.0, flagged: false, bead: None }],
        landmarks: vec![LandmarkMark {
            name: "acetabulum".to_owned(),
            image_px: Some(LANDMARK_PX),
            covariance_px2: Some(LANDMARK_PX2),
            sigma_mm: [0.05, 0.04, 1.2],
        }],
        robot: Some(RobotMark { centreline_px: vec![[150.0, 200.0], [180.0, 190.0], [200.0, 180.0]], tip_px: TIP_PX }),
    }
}

/// A frame with its DRR, accepted.
pub fn accepted(number: u32) -> PairView {
    let (frame, compared) = compared();
    let mut pair = Pair { number, ..Pair::unmatched(&format!("frame-{number:03}"), "") };
    pair.set_comparison(&compared.comparison);
    (pair.reason, pair.binding) = (None, "counter".to_owned());
    (pair.status, pair.pose_source) = (PairStatus::Accepted, PoseSource::Beads);
    (pair.rms_px, pair.rms_mm) = (Some(0.21), Some(0.05));
    pair.stages_ms.add("register", 180.0);
    pair.stages_ms.add("render", 240.0);
    PairView {
        pair: Arc::new(pair),
        pose: Arc::new(Pose { rms_px: Some(0.21), rms_mm: Some(0.05), detections: 9, ..Pose::default() }),
        time_us: NOW_US - 5_000_000 + 1_000_000 * i64::from(number),
        development: 0,
        replaces: None,
        complete: true,
        mm_per_px: Some(0.2),
        remedy: None,
        marks: Arc::new(marks()),
        seen_robot: None,
        devices: Arc::default(),
        pictures: Arc::new(PairPictures::compared(frame.size_px, &compared.pictures)),
        latency_ms: Some(820.0),
    }
}

/// Doubted by its image.
pub fn amber(number: u32) -> PairView {
    let mut view = accepted(number);
    let pair = Arc::make_mut(&mut view.pair);
    pair.status = PairStatus::AcceptedImageDisagrees;
    pair.reason = Some("image disagrees: 3 of 4 scores prefer 'turn about v +3 deg' to the pose of the beads".to_owned());
    view.remedy = Some("expose once more with nothing moving".to_owned());
    view
}

/// Without a pose.
pub fn refused(number: u32) -> PairView {
    let mut view = accepted(number);
    let few = Refusal::TooFewShadows { found: 2, required: 4, prior_puts_into_frame: None, hidden_by: Vec::new() };
    let pair = Arc::make_mut(&mut view.pair);
    (pair.status, pair.pose_source, pair.reason) = (PairStatus::Refused, PoseSource::None, Some(few.to_string()));
    (pair.scores, pair.null, pair.rms_px, pair.rms_mm) = Default::default();
    view.pose = Arc::new(Pose { detections: 2, ..Pose::default() }.refused_for(few));
    view.remedy = Some("bring more beads into the open field".to_owned());
    view.marks = Arc::new(PairMarks { beads: Vec::new(), robot: None, landmarks: Vec::new(), ..marks() });
    view.pictures = Arc::new(PairPictures::alone(&compared().0, &Masks::default()));
    view
}

/// A line whose latest byte came so long ago.
pub fn line(age_us: i64) -> Link {
    let joints = CarmJoints { orbital_rad: 0.5, source_to_detector_mm: 1020.0, ..CarmJoints::ZERO };
    let sample = CarmSample {
        device_us: 1,
        sequence: 7,
        joints,
        tube_kvp: 90.0,
        tube_ma: 3.0,
        pulse_width_ms: 8.0,
        filter_mm_al: 4.3,
        filter_mm_cu: 0.0,
        field_mm: [f64::NAN; 4],
        xray_on: false,
        exposure_counter: Some(3),
        status: 0,
    };
    Link {
        open: true,
        last_sample_us: Some(NOW_US - age_us),
        rate_hz: Some(50.0),
        latest: Some(Sample::Carm(sample)),
        ..Link::new(DeviceKind::Carm)
    }
}

/// A board that shows `pairs` beside a line that lives.
pub fn board(pairs: Vec<PairView>) -> BoardState {
    let frames_seen = pairs.len();
    let pairs = pairs.into_iter().map(Arc::new).collect();
    BoardState { links: vec![line(20_000)], pairs, frames_seen, now_us: NOW_US, ..BoardState::default() }
}
