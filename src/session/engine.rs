//! The deterministic heart of a session: inputs in order in, bound and posed frames out. Live and replay run this same code; it reads
//! no clock and no device, so the same inputs give the same poses, byte for byte.

use std::collections::BTreeMap;
use std::sync::Arc;

use super::crosscheck::beam_at;
use super::file::Setup;
use crate::acquire::Frame;
use crate::beads::BeadLayout;
use crate::geometry::{CarmJoints, Intrinsics, Rigid, View};
use crate::pose::{self, Pose, Prior, Registration};
use crate::reporter::Reporter;
use crate::telemetry::{AngleSource, CarmSample, DeviceKind, Event, Health, Link, Sample};
use crate::time::{StageTimes, Stopwatch};
use crate::timeline::{Binding, FrameStamp, Support, Timeline};

/// One thing that happened, with its host time.
#[derive(Clone, Debug)]
pub enum Input {
    /// Bytes from a serial line.
    Bytes {
        /// Which line.
        device: DeviceKind,
        /// Increases with every opening of the port.
        epoch: u32,
        /// Arrival.
        host_us: i64,
        /// As read.
        bytes: Vec<u8>,
    },
    /// A frame was found in the folder.
    Frame {
        /// Its pixels and tags.
        frame: Arc<Frame>,
        /// Arrival.
        host_us: i64,
    },
    /// Time passes while nothing happens.
    Tick {
        /// Now.
        host_us: i64,
    },
}

/// Where the pose of a pair came from.
#[derive(Clone, Copy, Debug, PartialEq, Eq, serde::Serialize, serde::Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum PoseSource {
    /// Beads in the frame.
    Beads,
    /// C-arm telemetry: the beads were refused.
    Telemetry,
    /// There is none.
    None,
}

/// The robot's shape at the exposure.
#[derive(Clone, Debug, PartialEq)]
pub struct RobotState {
    /// The five control angles, degrees.
    pub control_angles_deg: [f64; 5],
    /// Pose of the robot's base, when it is tracked and the tracker is tied to the specimen.
    pub lps_from_base: Option<Rigid>,
    /// `sensed` or `commanded`.
    pub source: String,
    /// Span of the samples that were interpolated.
    pub gap_us: i64,
    /// Too old to be trusted at the exposure.
    pub stale: bool,
}

/// A frame with everything known about when and where it was taken.
#[derive(Clone, Debug)]
pub struct Posed {
    /// Counts frames from 0, in order of processing.
    pub index: u32,
    /// The frame.
    pub frame: Arc<Frame>,
    /// Middle of the exposure, or the arrival where it is not bound; host time.
    pub time_us: i64,
    /// Which exposure, and why.
    pub binding: Binding,
    /// What registration said.
    pub pose: Pose,
    /// Which pose is used.
    pub pose_source: PoseSource,
    /// The view to render; absent without a pose.
    pub view: Option<View>,
    /// The robot, when telemetry covers the exposure.
    pub robot: Option<RobotState>,
    /// C-arm joints at the exposure.
    pub joints: Option<CarmJoints>,
    /// Span of the C-arm samples that were interpolated.
    pub carm_gap_us: Option<i64>,
    /// camera_from_lps by telemetry, as registration had it for a prior.
    pub nominal: Option<Rigid>,
    /// The C-arm's sample nearest the middle of the exposure.
    pub beam: Option<Box<CarmSample>>,
    /// Wall time of detection and pose.
    pub stages: StageTimes,
}

/// What came out of an input.
#[derive(Clone, Debug)]
pub enum Output {
    /// A decoded sample.
    Sample {
        /// Which line.
        device: DeviceKind,
        /// Arrival of the bytes that completed it.
        host_us: i64,
        /// The sample.
        sample: Box<Sample>,
    },
    /// A fault in the byte stream.
    Fault {
        /// Which line.
        device: DeviceKind,
        /// Arrival.
        host_us: i64,
        /// In words.
        detail: String,
    },
    /// A frame is ready to be rendered and compared.
    Posed(Box<Posed>),
}

/// A frame that waits for the telemetry of its exposure.
struct Pending {
    frame: Arc<Frame>,
    host_us: i64,
}

/// How long a frame waits for telemetry that would bind it.
const BIND_PATIENCE_US: i64 = 1_000_000;
/// Robot or C-arm samples further apart than this around an exposure are stale.
const MAX_GAP_US: i64 = 500_000;

/// See the module.
pub struct Engine {
    setup: Setup,
    layout: Option<BeadLayout>,
    links: BTreeMap<DeviceKind, Link>,
    timeline: Timeline,
    world_from_lps: Option<Rigid>,
    world_from_tracker: Option<Rigid>,
    pending: Vec<Pending>,
    frames: u32,
    reporter: Reporter,
}

impl Engine {
    /// `layout` holds the specimen's beads; without them every frame falls back to telemetry.
    #[must_use]
    pub fn new(setup: Setup, layout: Option<BeadLayout>, reporter: Reporter) -> Self {
        let rigid = |rows: Option<[[f64; 4]; 4]>| rows.and_then(|rows| Rigid::from_rows(&rows).ok());
        let world_from_lps = rigid(setup.session.world_from_lps);
        let world_from_tracker = rigid(setup.session.world_from_tracker);
        let present = [(DeviceKind::Carm, setup.carm.is_some()), (DeviceKind::Robot, setup.robot.is_some())];
        let links = present.into_iter().filter(|(_, there)| *there).map(|(device, _)| (device, Link::new(device))).collect();
        Self {
            setup,
            layout,
            links,
            timeline: Timeline::new(),
            world_from_lps,
            world_from_tracker,
            pending: Vec::new(),
            frames: 0,
            reporter,
        }
    }

    /// Counters of a line.
    #[must_use]
    pub fn health(&self, device: DeviceKind) -> Option<Health> {
        self.links.get(&device).map(|link| *link.health())
    }

    /// The timeline, for plots and states.
    #[must_use]
    pub fn timeline(&self) -> &Timeline {
        &self.timeline
    }

    /// Frames that wait for telemetry.
    #[must_use]
    pub fn waiting(&self) -> usize {
        self.pending.len()
    }

    /// Takes one input; `sink` gets what came of it, in order.
    pub fn push(&mut self, input: Input, sink: &mut dyn FnMut(Output)) {
        let now_us = match input {
            Input::Bytes { device, epoch, host_us, bytes } => {
                self.take_bytes(device, epoch, host_us, &bytes, sink);
                host_us
            }
            Input::Frame { frame, host_us } => {
                self.pending.push(Pending { frame, host_us });
                host_us
            }
            Input::Tick { host_us } => host_us,
        };
        self.settle(now_us, false, sink);
    }

    /// No more telemetry will come: binds what waits with what there is.
    pub fn finish(&mut self, now_us: i64, sink: &mut dyn FnMut(Output)) {
        self.settle(now_us, true, sink);
    }

    fn take_bytes(&mut self, device: DeviceKind, epoch: u32, host_us: i64, bytes: &[u8], sink: &mut dyn FnMut(Output)) {
        let Some(link) = self.links.get_mut(&device) else { return };
        let timeline = &mut self.timeline;
        link.feed(host_us, epoch, bytes, &mut |received| match received.event {
            Event::Sample(sample) => {
                timeline.push_sample(device, host_us, epoch, sample.clone());
                sink(Output::Sample { device, host_us, sample: Box::new(sample) });
            }
            Event::Fault(fault) => sink(Output::Fault { device, host_us, detail: fault.to_string() }),
        });
    }

    /// Processes, in order of arrival, the frames that are bound or have waited long enough.
    fn settle(&mut self, now_us: i64, at_end: bool, sink: &mut dyn FnMut(Output)) {
        while let Some(first) = self.pending.first() {
            let stamp = FrameStamp {
                exposure_counter: first.frame.tags.exposure_counter,
                host_arrival_us: first.host_us,
                acquired_us: first.frame.tags.acquired_us(),
            };
            let binding = self.timeline.bind(&stamp);
            let waited = now_us - first.host_us;
            let patient = self.setup.carm.is_some() && !at_end && waited < BIND_PATIENCE_US;
            if !binding.settled && patient {
                return;
            }
            let pending = self.pending.remove(0);
            let posed = self.pose_frame(pending, binding);
            sink(Output::Posed(Box::new(posed)));
        }
    }

    fn pose_frame(&mut self, pending: Pending, binding: Binding) -> Posed {
        let index = self.frames;
        self.frames += 1;
        let frame = pending.frame;
        let mut stages = StageTimes::default();
        let watch = Stopwatch::start();
        let exposed = binding.exposure.as_ref().map(|exposure| exposure.mid_us());
        let time_us = exposed.unwrap_or(pending.host_us);
        let joints = exposed
            .and_then(|mid_us| self.timeline.joints_at(mid_us))
            .filter(|answer| answer.gap_us <= MAX_GAP_US && answer.support == Support::Between);
        let robot = exposed.and_then(|mid_us| self.robot_state(mid_us));
        let size_px = [frame.pixels.width as u32, frame.pixels.height as u32];

        let carm = self.setup.carm.as_ref();
        let camera_from_world = joints.as_ref().zip(carm).and_then(|(answer, carm)| {
            carm.world_from_camera(&answer.value).map(Rigid::inverse).map_err(|error| self.reporter.warn("carm", error)).ok()
        });
        let at_zero = CarmJoints { source_to_detector_mm: f64::NAN, ..CarmJoints::ZERO };
        let sized = carm.filter(|carm| [carm.columns_px, carm.rows_px] == size_px);
        if carm.is_some() && sized.is_none() {
            self.reporter.warn("frame size", format!("{}: {size_px:?} px is not the size of the C-arm calibration", frame.name));
        }
        let intrinsics = sized.and_then(|carm| {
            let joints = joints.as_ref().map_or(at_zero, |answer| answer.value);
            carm.intrinsics(&joints).map_err(|error| self.reporter.warn("carm", error)).ok()
        });
        let nominal = camera_from_world.zip(self.world_from_lps).map(|(camera, world)| camera * world);
        stages.add("bind", watch.ms());

        let watch = Stopwatch::start();
        let pose = self.register(&frame, intrinsics, nominal);
        stages.add("register", watch.ms());

        let (pose_source, camera) = match (pose.camera(), intrinsics.zip(nominal)) {
            (Some(camera), _) => (PoseSource::Beads, Some(camera)),
            (None, Some(camera)) => (PoseSource::Telemetry, Some(camera)),
            (None, None) => (PoseSource::None, None),
        };
        // The first accepted frame ties the specimen to the room: world_from_lps = world_from_camera · camera_from_lps.
        if let (None, PoseSource::Beads, Some((_, camera_from_lps)), Some(camera_from_world)) =
            (self.world_from_lps, pose_source, camera, camera_from_world)
        {
            self.world_from_lps = Some(camera_from_world.inverse() * camera_from_lps);
            self.reporter.note(format!("{}: specimen tied to the room by this frame", frame.name));
        }
        let view = camera.map(|(intrinsics, camera_from_lps)| View { size_px, intrinsics, camera_from_lps });
        let carm_gap_us = joints.as_ref().map(|answer| answer.gap_us);
        let joints = joints.map(|answer| answer.value);
        let beam = exposed.and_then(|mid_us| beam_at(&self.timeline, mid_us)).map(Box::new);
        Posed { index, frame, time_us, binding, pose, pose_source, view, robot, joints, carm_gap_us, nominal, beam, stages }
    }

    fn register(&self, frame: &Frame, intrinsics: Option<Intrinsics>, nominal: Option<Rigid>) -> Pose {
        let none = BeadLayout::none();
        let layout = self.layout.as_ref().unwrap_or(&none);
        let prior = nominal.map(|camera_from_lps| Prior { camera_from_lps, covariance: None });
        let mut pose = pose::register(&Registration {
            frame,
            layout,
            intrinsics,
            pitch_mm: self.setup.carm.as_ref().map(|carm| carm.pitch_mm),
            prior: prior.as_ref(),
            fuse: false,
            landmarks: &[],
            bead_radius_mm: None,
        });
        if self.layout.is_none() {
            pose.reason = Some("the session names no beads".to_owned());
        }
        pose
    }

    fn robot_state(&self, mid_us: i64) -> Option<RobotState> {
        let (answer, source) = self.timeline.robot_and_source_at(mid_us)?;
        if !answer.value.iter().all(|angle| angle.is_finite()) {
            return None;
        }
        let tracked = self.timeline.tracker_from_base_at(mid_us).filter(|answer| answer.gap_us <= MAX_GAP_US);
        let lps_from_base = match (tracked, self.world_from_tracker, self.world_from_lps) {
            (Some(base), Some(world_from_tracker), Some(world_from_lps)) => {
                Some(world_from_lps.inverse() * world_from_tracker * base.value)
            }
            _ => None,
        };
        let stale = !(answer.gap_us <= MAX_GAP_US && answer.support == Support::Between);
        let source = match source {
            AngleSource::Sensed => "sensed",
            AngleSource::Commanded => "commanded",
        };
        let source = source.to_owned();
        Some(RobotState { control_angles_deg: answer.value, lps_from_base, source, gap_us: answer.gap_us, stale })
    }
}
