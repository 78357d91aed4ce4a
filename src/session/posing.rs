//! From a bound frame to a posed one: what telemetry says about it, its registration, and which pose is used.

use std::sync::Arc;

use super::edit::again;
use super::file::Setup;
use super::import::Imported;
use super::intensifier::seen_through;
use super::robot_state::{BoundRobot, MAX_GAP_US, RobotState};
use super::shown::Shown;
use super::tie::Disagreement;
use super::told_field::told_field;
use crate::acquire::Frame;
use crate::beads::tags::TagLayout;
use crate::beads::{BeadLayout, Landmark};
use crate::geometry::{CarmJoints, Intensifier, Intrinsics, Rigid, View};
use crate::image::Image;
use crate::mask::{self, Masks};
use crate::pose::{self, Pose, Prior, Refusal, Registration};
use crate::report::PoseSource;
use crate::reporter::Reporter;
use crate::telemetry::{CarmSample, DeviceKind};
use crate::time::{StageTimes, Stopwatch};
use crate::timeline::{Binding, BindingFlag, Gap, Support, Timeline};

/// A frame with everything known about when and where it was taken.
#[derive(Clone, Debug)]
pub struct Posed {
    /// Counts frames of the session from 1, in order of arrival.
    pub number: u32,
    /// How often the frame was posed before: 0, or more where its exposure became clear only later, or where its beads were edited.
    pub development: u32,
    /// The frame.
    pub frame: Arc<Frame>,
    /// When in its exposure it was taken, or the arrival where it is not bound; host time.
    pub time_us: i64,
    /// Which exposure, and why.
    pub binding: Binding,
    /// What registration said.
    pub pose: Pose,
    /// Which of the frame's pixels mean nothing.
    pub masks: Arc<Masks>,
    /// What the import had to say about the frame.
    pub warnings: Vec<String>,
    /// What the image intensifier did to the frame; all places of the pose are those of the undistorted picture.
    pub intensifier: Option<Arc<Intensifier>>,
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
    /// Camera in the specimen by telemetry, as registration was given it as a prior.
    pub nominal: Option<Rigid>,
    /// The C-arm's sample nearest the middle of the exposure: beam, field, joints.
    pub beam: Option<Box<CarmSample>>,
    /// How far beads and telemetry are apart, where they contradict each other.
    pub telemetry_disagreement: Option<Disagreement>,
    /// Wall time of detection and pose.
    pub stages: StageTimes,
}

impl Posed {
    /// How people are told of the frame.
    #[must_use]
    pub fn label(&self) -> String {
        let again = again(self.pose.edited.is_some(), self.development);
        format!("frame {} ({}){again}", self.number, self.frame.name)
    }

    /// What became of its registration, in a line.
    #[must_use]
    pub fn announcement(&self) -> String {
        let outcome = match &self.pose.reason {
            Some(reason) if matches!(self.pose.refusal, Some(Refusal::Layout { .. })) => format!("not registered, {reason}"),
            Some(reason) => format!("refused, {reason}"),
            None => {
                let unseen = self.pose.unseen.as_ref().map(|unseen| format!(", unseen beads {:.3} px", unseen.rms_px));
                format!("accepted, rms {:.3} px{}", self.pose.rms_px.unwrap_or(f64::NAN), unseen.unwrap_or_default())
            }
        };
        format!("{}: {outcome}", self.label())
    }

    pub(super) fn with_telemetry_disagreement(self, telemetry_disagreement: Option<Disagreement>) -> Self {
        Self { telemetry_disagreement, ..self }
    }
}

/// A frame with what telemetry says about it, fixed when it was bound.
#[derive(Clone, Debug)]
pub struct Bound {
    frame: Arc<Frame>,
    time_us: i64,
    binding: Binding,
    joints: Option<CarmJoints>,
    carm_gap_us: Option<i64>,
    robot: Option<BoundRobot>,
    beam: Option<Box<CarmSample>>,
}

impl Bound {
    /// What `timeline`, or the exposure itself where the samples are gone, says about a frame that arrived at `arrival_us`.
    #[must_use]
    pub fn new(frame: Arc<Frame>, arrival_us: i64, binding: Binding, timeline: &Timeline) -> Self {
        let exposure = binding.exposure.as_ref();
        let mid_us = binding.time_us.or_else(|| exposure.map(|exposure| exposure.mid_us()));
        let joints_at =
            |us: i64| timeline.joints_at(us).filter(|answer| answer.gap_us <= MAX_GAP_US && answer.support == Support::Between);
        let joints = mid_us
            .and_then(joints_at)
            .or_else(|| exposure.and_then(|exposure| exposure.joints).filter(|answer| answer.gap_us <= MAX_GAP_US));
        let robot = mid_us.and_then(|mid_us| BoundRobot::at(timeline, mid_us, &binding));
        // Of an image of a run, and of the last one held: the joints at its beginning, in its middle, and at its end.
        let within: Option<Vec<CarmJoints>> = mid_us.zip(binding.half_image_us()).and_then(|(mid_us, half_us)| {
            let times_us = [mid_us.saturating_sub(half_us), mid_us, mid_us.saturating_add(half_us)];
            times_us.into_iter().map(|us| joints_at(us).map(|answer| answer.value)).collect()
        });
        Self {
            frame,
            time_us: mid_us.unwrap_or(arrival_us),
            joints: joints.as_ref().map(|answer| answer.value),
            carm_gap_us: joints.as_ref().map(|answer| answer.gap_us),
            beam: mid_us
                .and_then(|mid_us| timeline.beam_at(mid_us).map(Box::new))
                .or_else(|| exposure.and_then(|exposure| exposure.beam.clone())),
            binding: match within {
                Some(joints) => binding.moved_within(&joints),
                None => binding,
            }
            .across(joints.as_ref().and(mid_us).and_then(|mid_us| Gap::around(timeline, mid_us))),
            robot,
        }
    }
}

impl Bound {
    /// The frame as it was read.
    #[must_use]
    pub fn frame(&self) -> &Arc<Frame> {
        &self.frame
    }

    /// The C-arm's sample nearest the middle of its exposure.
    #[must_use]
    pub fn beam(&self) -> Option<&CarmSample> {
        self.beam.as_deref()
    }

    /// Gives the frame other pixels and those that it had back; whoever else holds it keeps them too.
    pub(super) fn replace_pixels(&mut self, pixels: Image<f32>) -> Image<f32> {
        std::mem::replace(&mut Arc::make_mut(&mut self.frame).pixels, pixels)
    }

    /// Number of its exposure.
    #[must_use]
    pub fn exposure_index(&self) -> Option<u64> {
        self.binding.exposure.as_ref().map(|exposure| exposure.index)
    }

    /// Whether this device's telemetry says how it stood at the exposure.
    #[must_use]
    pub fn is_known_to(&self, device: DeviceKind) -> bool {
        match device {
            DeviceKind::Carm => self.joints.is_some(),
            DeviceKind::Robot => self.robot.is_some(),
        }
    }
}

/// What is known about a session when a frame is registered.
#[derive(Clone, Debug)]
pub struct Known {
    /// Everything declared.
    pub setup: Arc<Setup>,
    /// The specimen's beads.
    pub layout: Option<Arc<BeadLayout>>,
    /// The specimen's tags.
    pub tags: Option<Arc<TagLayout>>,
    /// Where uncertainty is wanted.
    pub landmarks: Arc<[Landmark]>,
    /// Where the specimen lies in the room.
    pub world_from_lps: Option<Rigid>,
    /// The latest frame with beads contradicts that.
    pub tie_disputed: bool,
}

/// A registration with all that it rests on; it may run on any thread.
#[derive(Clone, Debug)]
pub struct PoseJob {
    bound: Bound,
    development: u32,
    known: Known,
    warnings: Vec<String>,
    /// What the intensifier did to the frame, or why that is not known.
    intensifier: Option<Result<Arc<Intensifier>, String>>,
    pitch_mm: Option<f64>,
    intrinsics: Option<Intrinsics>,
    /// K is that of the frame's header: what was assumed.
    header: Option<String>,
    /// K is that of no calibration, because the frame's size does not fit it: in words.
    unfit: Option<String>,
    camera_from_world: Option<Rigid>,
}

impl PoseJob {
    /// `imported` is the bound frame as it lies on the panel; `development` counts from 0.
    #[must_use]
    pub fn new(bound: Bound, imported: Imported, known: Known, development: u32, reporter: &Reporter) -> Self {
        let Imported { frame, carm: sized, doubt: unfit, warnings } = imported;
        // Of the frame where it fits the calibration: its columns may be turned against the panel's.
        let carm = sized.as_ref().or(known.setup.carm.as_ref());
        let camera_from_world = bound.joints.zip(carm).and_then(|(joints, carm)| {
            carm.world_from_camera(&joints).map(Rigid::inverse).map_err(|error| reporter.warn("carm", error)).ok()
        });
        let at_zero = CarmJoints { source_to_detector_mm: f64::NAN, ..CarmJoints::ZERO };
        let intrinsics = sized.as_ref().and_then(|carm| {
            carm.intrinsics(&bound.joints.unwrap_or(at_zero)).map_err(|error| reporter.warn("carm", error)).ok()
        });
        // Nobody calibrated the C-arm: what the frame's header says of it.
        let header = pose::intrinsics_of(&frame).filter(|_| known.setup.carm.is_none());
        let mut warnings: Vec<String> = warnings.into_iter().map(|(_, detail)| detail).collect();
        let calibration = known.setup.intensifier.as_deref();
        let intensifier = calibration.map(|calibration| seen_through(calibration, &frame, bound.joints.as_ref()));
        let note = match &intensifier {
            Some(Err(reason)) => Some(format!("{}: {reason}", frame.name)),
            Some(Ok(intensifier)) => intensifier.note.as_ref().map(|note| format!("{}: {note}", frame.name)),
            None => None,
        };
        if let Some(note) = note {
            reporter.warn("distortion", &note);
            warnings.push(note);
        }
        let (intrinsics, pitch_mm, header) = match header {
            Some((k, pitch_mm, words)) => (Some(k), Some(pitch_mm), Some(words)),
            None => (intrinsics, sized.map(|carm| carm.pitch_mm), None),
        };
        let bound = Bound { frame, ..bound };
        Self { bound, development, known, warnings, intensifier, pitch_mm, intrinsics, header, unfit, camera_from_world }
    }

    /// Which frame.
    #[must_use]
    pub fn number(&self) -> u32 {
        self.bound.frame.number
    }

    /// How often the frame was posed before.
    #[must_use]
    pub fn development(&self) -> u32 {
        self.development
    }

    /// Finds the beads and the pose. Takes from a tenth of a second to seconds.
    #[must_use]
    pub fn run(self) -> Registered {
        let watch = Stopwatch::start();
        let told = self.bound.beam.as_deref().zip(self.known.setup.carm.as_ref());
        let told = told.map(|(beam, carm)| told_field(beam.field_mm, carm, &self.bound.frame)).unwrap_or_default();
        let masks = mask::of_told_frame(&self.bound.frame, &told);
        self.register(masks, &watch)
    }

    fn register(self, masks: Masks, watch: &Stopwatch) -> Registered {
        let (mut pose, shown) = self.asking(|registration| {
            let shown = self.shown(registration, &masks);
            (self.posed(registration, &masks, Some(&shown)), shown)
        });
        pose.notes.extend(self.header.clone());
        let mut stages = StageTimes::default();
        stages.add("register", watch.ms());
        Registered { job: self, pose, shown: Some(Arc::new(shown)), masks: Arc::new(masks), stages }
    }

    /// What everything that is known of the frame comes to when it is asked of a registration.
    pub(super) fn asking<T>(&self, ask: impl FnOnce(&Registration) -> T) -> T {
        let none = BeadLayout::none();
        let layout = self.known.layout.as_deref().unwrap_or(&none);
        let prior = self.nominal().map(|camera_from_lps| Prior { camera_from_lps, covariance: None });
        let size_px = self.bound.frame.size_px.map(|n| n as u32);
        let registration = Registration {
            intrinsics: self.intrinsics,
            pitch_mm: self.pitch_mm,
            prior: prior.as_ref(),
            landmarks: &self.known.landmarks,
            bead_radius_mm: self.known.setup.session.bead_radius_mm,
            distortion: self.intensifier.iter().flatten().next().map(|intensifier| &intensifier.distortion),
            ..Registration::new(size_px, layout)
        };
        ask(&registration)
    }

    fn shown(&self, registration: &Registration, masks: &Masks) -> Shown {
        let Known { tags, layout, .. } = &self.known;
        Shown::in_frame(&self.bound.frame, masks, tags.as_ref(), layout.is_some(), registration)
    }

    /// By the beads and tags that the session names; `shown` is what the frame shows of them, if that is known.
    pub(super) fn posed(&self, registration: &Registration, masks: &Masks, shown: Option<&Shown>) -> Pose {
        let anew;
        let shown = match shown {
            Some(shown) => shown,
            None => {
                anew = self.shown(registration, masks);
                &anew
            }
        };
        let register = |registration: &Registration| shown.register(registration, &self.bound.frame, masks);
        let pose = register(registration);
        let pose = match self.measured() {
            Some(measured) => pose::fuse(pose, &measured, &|measured| {
                register(&Registration { prior: Some(measured), fuse: true, ..*registration })
            }),
            None => pose,
        };
        let mut pose = match &self.intensifier {
            Some(Err(detail)) => pose.refused_for(Refusal::Distortion { detail: detail.clone() }),
            _ => pose,
        };
        pose.prior_from("by telemetry");
        if let Some(words) = self.unfit.as_ref().filter(|_| pose.is_accepted()) {
            pose.doubt(words.clone());
        }
        pose.hear_header(&self.bound.frame, self.intensifier.is_some());
        pose
    }

    /// Camera in the specimen by telemetry alone, where the joints are no mere guess.
    fn nominal(&self) -> Option<Rigid> {
        let told = self.camera_from_world.filter(|_| !self.bound.binding.is_no_prior());
        told.zip(self.known.world_from_lps).map(|(camera, world)| camera * world)
    }

    /// Telemetry as a measurement, where the session fuses it and it is as good as the arm's calibration says: the joints are those of the
    /// picture, nothing contradicts where the specimen lies, and the beads are solved with the arm's own K.
    fn measured(&self) -> Option<Prior> {
        let setup = &self.known.setup;
        let fuses = setup.session.carm.as_ref().is_some_and(|line| line.fuse);
        let unsure = |flag: &BindingFlag| {
            matches!(flag, BindingFlag::Moved { .. } | BindingFlag::TelemetryGap { .. } | BindingFlag::Unseen { .. })
        };
        if !fuses
            || self.known.tie_disputed
            || self.intrinsics.is_none()
            || matches!(self.intensifier, Some(Err(_)))
            || self.bound.binding.is_guessed()
            || self.bound.binding.flags.iter().any(unsure)
        {
            return None;
        }
        Prior::by_joints(setup.carm.as_ref()?, self.bound.joints.as_ref()?, self.nominal()?)
    }

    /// What a pose of the frame comes to.
    pub(super) fn used(&self, pose: &Pose) -> Used {
        let (pose_source, camera) = match (pose.camera(), self.intrinsics.zip(self.nominal())) {
            (Some(camera), _) => (PoseSource::Beads, Some(camera)),
            (None, Some(camera)) => (PoseSource::Telemetry, Some(camera)),
            (None, None) => (PoseSource::None, None),
        };
        // world_from_lps = world_from_camera · camera_from_lps.
        let world_from_lps = match (pose_source, camera, self.camera_from_world) {
            (PoseSource::Beads, Some((_, camera_from_lps)), Some(camera_from_world)) if !self.bound.binding.is_guessed() => {
                // A pose that telemetry has drawn to itself would agree with it ever after.
                let by_beads = pose.innovation.map_or(camera_from_lps, |innovation| innovation.camera_from_lps);
                Some(camera_from_world.inverse() * by_beads)
            }
            _ => None,
        };
        let pixels = &self.bound.frame.pixels;
        let size_px = [pixels.width as u32, pixels.height as u32];
        let view = camera.map(|(intrinsics, camera_from_lps)| View { size_px, intrinsics, camera_from_lps });
        Used { pose_source, view, world_from_lps }
    }

    /// What was known of the session.
    pub(super) fn known(&self) -> &Known {
        &self.known
    }
}

/// Which pose of a frame is used, and what it says.
pub(super) struct Used {
    pub(super) pose_source: PoseSource,
    /// The view to render; absent without a pose.
    pub(super) view: Option<View>,
    /// Where the beads put the specimen in the room.
    pub(super) world_from_lps: Option<Rigid>,
}

/// The outcome of a [`PoseJob`].
#[derive(Clone, Debug)]
pub struct Registered {
    job: PoseJob,
    pose: Pose,
    /// What the frame shows, where it was looked at.
    shown: Option<Arc<Shown>>,
    masks: Arc<Masks>,
    stages: StageTimes,
}

impl Registered {
    /// Which frame.
    #[must_use]
    pub fn number(&self) -> u32 {
        self.job.bound.frame.number
    }

    /// A refusal in place of a result: running the job failed.
    #[must_use]
    pub fn failed(job: PoseJob, reason: &str) -> Self {
        let refusal = Refusal::Fault { detail: reason.to_owned() };
        // A picture by telemetry's pose shows the beads all the same.
        let beads = job.asking(|registration| registration.refuse(&refusal).beads);
        let known = Known { layout: None, tags: None, ..job.known };
        // Without beads, tags and masks nothing is looked at again: whatever failed does not fail a second time.
        let mut refused = PoseJob { known, ..job }.register(Masks::default(), &Stopwatch::start());
        refused.pose = Pose { beads, ..refused.pose.refused_for(refusal) };
        refused
    }

    /// The result that a log has: nothing is computed.
    pub(super) fn recorded(job: PoseJob, pose: Pose) -> Self {
        Self { job, pose, shown: None, masks: Arc::default(), stages: StageTimes::default() }
    }

    /// What its pose rests on: the job, and what the frame shows.
    pub(super) fn rests_on(&self) -> (&PoseJob, Option<&Arc<Shown>>) {
        (&self.job, self.shown.as_ref())
    }

    /// The frame with its pose, and where its beads put the specimen in the room, if both are known.
    pub(super) fn into_posed(self, world_from_tracker: Option<Rigid>) -> (Posed, Option<Rigid>) {
        let Self { mut job, pose, masks, stages, .. } = self;
        let Used { pose_source, view, world_from_lps: seen } = job.used(&pose);
        if pose_source == PoseSource::Telemetry && job.known.tie_disputed {
            let words = "the pose is telemetry's alone, and the latest frame with beads contradicts where that has the specimen";
            job.warnings.push(words.to_owned());
        }
        let nominal = job.nominal();
        let Bound { frame, time_us, binding, joints, carm_gap_us, robot, beam } = job.bound;
        let robot = robot.map(|robot| robot.in_lps(world_from_tracker, job.known.world_from_lps));
        let posed = Posed {
            number: frame.number,
            development: job.development,
            frame,
            time_us,
            binding,
            pose,
            masks,
            warnings: job.warnings,
            intensifier: job.intensifier.and_then(Result::ok),
            pose_source,
            view,
            robot,
            joints,
            carm_gap_us,
            nominal,
            beam,
            telemetry_disagreement: None,
            stages,
        };
        (posed, seen)
    }
}

#[cfg(test)]
impl Posed {
    /// A small frame of which nothing is known, for tests of what is done with pairs.
    pub(super) fn bare(number: u32) -> Self {
        use crate::acquire::Domain;
        use crate::image::Image;
        let mut frame = Frame::from_pixels("a", Image::filled(4, 3, 1.0f32), Domain::Linear).expect("a frame");
        frame.number = number;
        Self {
            number,
            development: 0,
            frame: Arc::new(frame),
            time_us: 0,
            binding: Binding::default(),
            pose: Pose::default(),
            masks: Arc::default(),
            warnings: Vec::new(),
            intensifier: None,
            pose_source: PoseSource::Beads,
            view: None,
            robot: None,
            joints: None,
            carm_gap_us: None,
            nominal: None,
            beam: None,
            telemetry_disagreement: None,
            stages: StageTimes::default(),
        }
    }
}
