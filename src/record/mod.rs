//! Logs: everything a session saw, in MCAP files that Foxglove opens without plug-ins.
//!
//! | topic | message | content |
//! |---|---|---|
//! | `/carm/raw`, `/robot/raw` | `sidecarm.RawBytes` | bytes as they came from the serial line, one message a read |
//! | `/carm/joints`, `/robot/joints` | JSON | decoded samples |
//! | `/frames/tags` | JSON | an acquired [`Frame`](crate::acquire::Frame) without its pixels; directly before … |
//! | `/frames/acquired` | `foxglove.RawImage` | … its pixels, `mono16` when that is lossless, else `32FC1` |
//! | `/frames/drr` | `foxglove.RawImage` | the matched DRR, `32FC1`; `frame_id` is `camera` |
//! | `/pose`, `/plan`, `/scores`, `/provenance` | JSON | results as they were used |
//! | `/camera/calibration` | `foxglove.CameraCalibration` | K, and P = K \[I\|0\] of the camera frame (`/pose` has P of `lps`) |
//! | `/camera/image` | `foxglove.RawImage` | the acquired frame for the eye, `mono8`, at the time of its exposure, as the annotations are |
//! | `/tf` | `foxglove.FrameTransforms` | `carm` in `world`, `camera` in `carm`, `lps` in `camera`, each where it is known, in metres; at each exposure |
//! | `/carm/tf`, `/robot/tf` | `foxglove.FrameTransforms` | the same, with the `camera` where the last exposure left it in the arm; `base` in `lps`, each piece in the one before, `tip` in the last; ten times a second |
//! | `/carm/joint_states`, `/robot/joint_states` | `foxglove.JointStates` | rad and m, ten times a second |
//! | `/camera/annotations` | `foxglove.ImageAnnotations` | beads detected (green) and projected (red) |
//! | `/events` | `foxglove.Log` | what was told to the person |
//!
//! Other JSON topics may be added by whoever records. Log times are host microseconds × 1000. `sidecarm.RawBytes` is a little-endian u32
//! epoch followed by the bytes.
//!
//! Chunks are compressed (zstd), checked (CRC-32) and handed over in one piece within 100 ms: a killed program loses no more than that,
//! and a log cut at any byte still reads up to the cut ([`LogReader`]). Pixels have chunks of their own, compressed by whoever records
//! them.
//!
//! ```text
//! whoever records ─ queue ─ writer ─┬─ shared memory ─ keeper (a process of its own) ─ file     a session, on Linux
//!                                   └─ file                                                     elsewhere, and where no keeper starts
//! ```
//! A keeper ([`keep`]) survives a kill −9 of the program and what ends its terminal, and writes what was handed over, also while the disk
//! stands still. What it has not written counts as memory of the recorder: beyond 24 MB producers of large messages wait, beyond 512 MB
//! messages are refused and counted. A log that lost its program has no summary and reads as one that was not closed, because it is. A
//! keeper that is killed is replaced; what it had not written is still in the shared memory, so only a kill of both loses it. Without a
//! keeper a kill loses what came while a write was under way, which on a busy disk is up to some hundred milliseconds.

mod announced;
mod channel;
mod chunk;
mod compression;
mod copy;
mod decode;
mod error;
mod file;
#[cfg(target_os = "linux")]
mod handover;
#[cfg(target_os = "linux")]
mod keeper;
mod messages;
mod place;
mod queue;
mod reader;
mod recorder;
mod resync;
mod sink;
mod sums;
mod tolerance;
mod unpack;
mod writer;

pub use copy::LogCopy;
pub use decode::{FrameAssembler, RawBytes};
pub use error::RecordError;
#[cfg(target_os = "linux")]
pub use keeper::keep;
pub use messages::{ArmInRoom, BeadMark, Level, Placed, placed_in_room};
pub use queue::RecorderHealth;
pub use reader::{Attachment, LogContents, LogEntry, LogLoss, LogReader, read_log};
pub use recorder::{Prepared, Recorder};
pub use sink::LogTarget;
pub use sums::wrong_sums;
pub use tolerance::Tolerance;
pub use writer::Summary;

/// Topic names.
pub mod topic {
    /// Serial bytes of the C-arm.
    pub const CARM_RAW: &str = "/carm/raw";
    /// Serial bytes of the robot.
    pub const ROBOT_RAW: &str = "/robot/raw";
    /// Decoded samples of the C-arm.
    pub const CARM_JOINTS: &str = "/carm/joints";
    /// Decoded samples of the robot.
    pub const ROBOT_JOINTS: &str = "/robot/joints";
    /// Acquired frames without pixels.
    pub const FRAME_TAGS: &str = "/frames/tags";
    /// Pixels of acquired frames.
    pub const FRAME_PIXELS: &str = "/frames/acquired";
    /// Matched DRRs.
    pub const DRR: &str = "/frames/drr";
    /// Poses.
    pub const POSE: &str = "/pose";
    /// Executed plans.
    pub const PLAN: &str = "/plan";
    /// Scores.
    pub const SCORES: &str = "/scores";
    /// Where everything came from.
    pub const PROVENANCE: &str = "/provenance";
    /// What was told to the person.
    pub const EVENTS: &str = "/events";
    /// Intrinsics.
    pub const CALIBRATION: &str = "/camera/calibration";
    /// The acquired frame for the eye, at the time of its exposure.
    pub const SHOWN: &str = "/camera/image";
    /// Frames.
    pub const TRANSFORMS: &str = "/tf";
    /// Where telemetry puts the C-arm.
    pub const CARM_TRANSFORMS: &str = "/carm/tf";
    /// Where telemetry puts the robot.
    pub const ROBOT_TRANSFORMS: &str = "/robot/tf";
    /// The C-arm's joints by name.
    pub const CARM_JOINT_STATES: &str = "/carm/joint_states";
    /// The robot's control angles by name.
    pub const ROBOT_JOINT_STATES: &str = "/robot/joint_states";
    /// Beads.
    pub const ANNOTATIONS: &str = "/camera/annotations";
}

/// Where a log came from; the first message of every log.
#[derive(Clone, Debug, Default, PartialEq, serde::Serialize, serde::Deserialize)]
pub struct Provenance {
    /// `sidecarm`.
    pub program: String,
    /// Version of the program.
    pub version: String,
    /// Host time at the start, microseconds since the Unix epoch.
    pub started_us: i64,
    /// Operating system and processor.
    pub host: String,
    /// Whatever else decides the results: adapter, driver, device choice, input files with their SHA-256.
    pub details: serde_json::Value,
}

impl Provenance {
    /// This program on this machine.
    #[must_use]
    pub fn of_this_program(started_us: i64, details: serde_json::Value) -> Self {
        Self {
            program: env!("CARGO_PKG_NAME").into(),
            version: env!("CARGO_PKG_VERSION").into(),
            started_us,
            host: format!("{} {}", std::env::consts::OS, std::env::consts::ARCH),
            details,
        }
    }
}
