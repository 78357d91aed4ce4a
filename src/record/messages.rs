//! Foxglove's well-known messages, made from our own types.

use foxglove::Encode;
use foxglove::messages as fg;
use glam::DVec2;

use crate::acquire::{Frame, Samples};
use crate::geometry::{Rigid, View};
use crate::image::Image;

/// How much an event matters.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Level {
    /// Worth knowing.
    Info,
    /// Less well than it should be.
    Warning,
    /// Something failed.
    Error,
}

/// A bead as drawn over the acquired frame.
#[derive(Clone, Debug, PartialEq)]
pub struct BeadMark {
    /// Its name.
    pub name: String,
    /// Where it was detected, if it was.
    pub detected_px: Option<DVec2>,
    /// Where the pose puts it.
    pub projected_px: DVec2,
    /// Radius of its shadow.
    pub radius_px: f64,
}

/// The tags of a frame, and the hash of the message with its pixels, which follows: what the file held is gone when the log is read.
#[derive(serde::Serialize)]
pub(super) struct TagsOf<'a> {
    #[serde(flatten)]
    pub frame: &'a Frame,
    /// SHA-256 of that message, lower-case hexadecimal.
    pub message_sha256: String,
}

pub(super) fn encoded<M: Encode>(message: &M) -> Vec<u8> {
    let mut bytes = Vec::with_capacity(message.encoded_len().unwrap_or(0));
    // A growing vector has room for everything, so encoding cannot fail.
    let outcome = message.encode(&mut bytes);
    debug_assert!(outcome.is_ok(), "protobuf encoding into a vector");
    bytes
}

pub(super) fn timestamp(host_us: i64) -> Option<fg::Timestamp> {
    let since = host_us.max(0) as u64;
    let seconds = u32::try_from(since / 1_000_000).ok()?;
    fg::Timestamp::new_checked(seconds, (since % 1_000_000) as u32 * 1000)
}

pub(super) fn raw_image(samples: &Samples, width: usize, height: usize, frame_id: &str, host_us: i64) -> fg::RawImage {
    fg::RawImage {
        timestamp: timestamp(host_us),
        frame_id: frame_id.into(),
        width: width as u32,
        height: height as u32,
        encoding: samples.encoding().into(),
        step: (width * samples.stride_bytes()) as u32,
        data: samples.to_bytes().into(),
    }
}

pub(super) fn log(level: Level, text: &str, host_us: i64) -> fg::Log {
    let level = match level {
        Level::Info => fg::log::Level::Info,
        Level::Warning => fg::log::Level::Warning,
        Level::Error => fg::log::Level::Error,
    };
    fg::Log {
        timestamp: timestamp(host_us),
        level: level as i32,
        message: text.into(),
        name: "sidecarm".into(),
        file: String::new(),
        line: 0,
    }
}

pub(super) fn joint_states(joints: &[(&str, f64)], host_us: i64) -> fg::JointStates {
    let joint = |&(name, position): &(&str, f64)| fg::JointState {
        name: name.into(),
        position: position.is_finite().then_some(position),
        ..fg::JointState::default()
    };
    fg::JointStates { timestamp: timestamp(host_us), joints: joints.iter().map(joint).collect() }
}

/// Foxglove's P maps the camera frame, ours maps `lps`: here it is K \[I|0\].
pub(super) fn calibration(view: &View, host_us: i64) -> fg::CameraCalibration {
    let k = view.intrinsics.to_rows();
    let [r0, r1, r2] = k;
    fg::CameraCalibration {
        timestamp: timestamp(host_us),
        frame_id: "camera".into(),
        width: view.size_px[0],
        height: view.size_px[1],
        distortion_model: String::new(),
        d: Vec::new(),
        k: k.as_flattened().to_vec(),
        r: vec![1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0],
        p: [[r0[0], r0[1], r0[2], 0.0], [r1[0], r1[1], r1[2], 0.0], [r2[0], r2[1], r2[2], 0.0]].concat(),
    }
}

/// A frame of the tree in its parent.
#[derive(Clone, Debug, PartialEq)]
pub struct Placed {
    /// `world`, `carm`, `base` …
    pub parent: String,
    /// Its name.
    pub child: String,
    /// Where it is, mm.
    pub parent_from_child: Rigid,
}

impl Placed {
    /// `child` in `parent`.
    #[must_use]
    pub fn new(parent: impl Into<String>, child: impl Into<String>, parent_from_child: Rigid) -> Self {
        Self { parent: parent.into(), child: child.into(), parent_from_child }
    }
}

/// The C-arm in the room.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ArmInRoom {
    /// By its joints: the focal spot, with the axes of the panel.
    pub world_from_carm: Rigid,
    /// Where the specimen lies; `None` where that is not known.
    pub world_from_lps: Option<Rigid>,
}

impl ArmInRoom {
    /// The camera of a pose in the arm: where joints and pose differ, and how the console turned the picture. Without the specimen's place
    /// in the room nothing tells it.
    #[must_use]
    pub fn carm_from_camera(&self, camera_from_lps: Rigid) -> Option<Rigid> {
        let world_from_camera = self.world_from_lps? * camera_from_lps.inverse();
        Some(self.world_from_carm.inverse() * world_from_camera)
    }
}

/// C-arm, camera and specimen, each in the one before. What is not known is left out, and the tree falls into parts there: no frame has
/// another parent instead.
#[must_use]
pub fn placed_in_room(arm: Option<ArmInRoom>, camera_from_lps: Option<Rigid>) -> Vec<Placed> {
    let world_from_carm = arm.map(|arm| Placed::new("world", "carm", arm.world_from_carm));
    let link = arm.zip(camera_from_lps).and_then(|(arm, camera_from_lps)| arm.carm_from_camera(camera_from_lps));
    let carm_from_camera = link.map(|link| Placed::new("carm", "camera", link));
    let specimen = camera_from_lps.map(|camera_from_lps| Placed::new("camera", "lps", camera_from_lps));
    [world_from_carm, carm_from_camera, specimen].into_iter().flatten().collect()
}

/// Foxglove wants the pose of the child in its parent, in metres.
pub(super) fn transforms(placed: &[Placed], host_us: i64) -> fg::FrameTransforms {
    let transform = |placed: &Placed| {
        let (at, turn) = (placed.parent_from_child.translation_mm / 1000.0, placed.parent_from_child.rotation);
        fg::FrameTransform {
            timestamp: timestamp(host_us),
            parent_frame_id: placed.parent.clone(),
            child_frame_id: placed.child.clone(),
            translation: Some(fg::Vector3 { x: at.x, y: at.y, z: at.z }),
            rotation: Some(fg::Quaternion { x: turn.x, y: turn.y, z: turn.z, w: turn.w }),
        }
    };
    fg::FrameTransforms { transforms: placed.iter().map(transform).collect() }
}

/// A picture for the eye, row by row.
pub(super) fn gray_image(image: &Image<u8>, frame_id: &str, host_us: i64) -> fg::RawImage {
    fg::RawImage {
        timestamp: timestamp(host_us),
        frame_id: frame_id.into(),
        width: image.width as u32,
        height: image.height as u32,
        encoding: "mono8".into(),
        step: image.width as u32,
        data: image.pixels.clone().into(),
    }
}

pub(super) fn annotations(beads: &[BeadMark], host_us: i64) -> fg::ImageAnnotations {
    const GREEN: fg::Color = fg::Color { r: 0.1, g: 0.8, b: 0.2, a: 1.0 };
    const RED: fg::Color = fg::Color { r: 0.9, g: 0.1, b: 0.1, a: 1.0 };
    // Foxglove counts from the corner of the first pixel, we count from its centre.
    let point = |at: DVec2| Some(fg::Point2 { x: at.x + 0.5, y: at.y + 0.5 });
    let circle = |at: DVec2, radius_px: f64, colour: fg::Color| fg::CircleAnnotation {
        timestamp: timestamp(host_us),
        position: point(at),
        diameter: 2.0 * radius_px,
        thickness: 1.0,
        fill_color: None,
        outline_color: Some(colour),
        metadata: Vec::new(),
    };
    let detected = beads.iter().filter_map(|bead| Some(circle(bead.detected_px?, 1.5 * bead.radius_px, GREEN)));
    let projected = beads.iter().map(|bead| circle(bead.projected_px, bead.radius_px, RED));
    let label = |bead: &BeadMark| fg::TextAnnotation {
        timestamp: timestamp(host_us),
        position: point(bead.projected_px + DVec2::splat(bead.radius_px)),
        text: bead.name.clone(),
        font_size: 12.0,
        text_color: Some(RED),
        background_color: None,
        metadata: Vec::new(),
    };
    fg::ImageAnnotations {
        timestamp: timestamp(host_us),
        circles: detected.chain(projected).collect(),
        points: Vec::new(),
        texts: beads.iter().map(label).collect(),
        metadata: Vec::new(),
    }
}
