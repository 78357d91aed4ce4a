//! From a bound frame to a posed one: its registration, and which pose is used.

use std::sync::Arc;

use super::bound::Bound;
use super::chosen_k::{ChosenK, KnownK};
use super::file::Setup;
use super::import::Imported;
use super::intensifier::seen_through;
use super::posed::Posed;
use super::remedy::{K_REMEDY, no_joints};
use super::shown::Shown;
use super::told_field::told_field;
use crate::beads::tags::TagLayout;
use crate::beads::{BeadLayout, Landmark};
use crate::geometry::{CarmJoints, Intensifier, Intrinsics, Rigid, View};
use crate::mask::{self, Masks};
use crate::pose::{self, IntrinsicsPrior, Pose, Prior, Refusal, Registration};
use crate::report::{KSource, PoseSource};
use crate::reporter::Reporter;
use crate::time::{StageTimes, Stopwatch};
use crate::timeline::BindingFlag;

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
    source_to_isocentre_mm: Option<f64>,
    intrinsics: Option<Intrinsics>,
    /// How sure K is; `None`: it is known, or solved.
    intrinsics_prior: Option<IntrinsicsPrior>,
    /// Where K comes from, if it is known before the beads are looked at.
    k_source: Option<KSource>,
    /// The session states K, and nothing that is for frames of this size: in words.
    misfit: Option<String>,
    /// K is that of the frame's header, or that of another binning: what was assumed.
    header: Option<String>,
    /// K is that of no calibration, because the frame's size does not fit it, or is not the header's: in words.
    unfit: Option<String>,
    camera_from_world: Option<Rigid>,
}

impl PoseJob {
    /// `imported` is the bound frame as it lies on the panel; `development` counts from 0.
    #[must_use]
    pub fn new(bound: Bound, imported: Imported, known: Known, development: u32, reporter: &Reporter) -> Self {
        let Imported { frame, carm: sized, doubt: unfit, stated, warnings } = imported;
        // Of the frame where it fits the calibration: its columns may be turned against the panel's.
        let carm = sized.as_ref().or(known.setup.carm.as_ref());
        let camera_from_world = bound.joints.zip(carm).and_then(|(joints, carm)| {
            carm.world_from_camera(&joints).map(Rigid::inverse).map_err(|error| reporter.warn("carm", no_joints(&error))).ok()
        });
        let at_zero = CarmJoints { source_to_detector_mm: f64::NAN, ..CarmJoints::ZERO };
        let source_to_isocentre_mm = carm.map(|carm| carm.source_to_isocentre_mm).or_else(|| pose::isocentre_of(&frame.tags));
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
        // Telemetry knows how far the detector was; what is stated stands for frames of which it tells nothing.
        let stated = stated.filter(|_| bound.joints.is_none() || sized.is_none());
        let is_measured = bound.joints.is_some_and(|joints| joints.source_to_detector_mm.is_finite());
        let arm_pitch_mm = sized.map(|carm| carm.pitch_mm);
        let ChosenK {
            intrinsics,
            prior: intrinsics_prior,
            pitch_mm,
            source: k_source,
            note: header,
            warning,
            misfit,
            off_header,
        } = KnownK { of_arm: intrinsics, arm_pitch_mm, is_measured, stated, header }.choose(&frame);
        if let Some(words) = warning {
            reporter.warn("intrinsics", &words);
            warnings.push(words);
        }
        // Where the session states K, it is known after all.
        let unfit = off_header.or(unfit.filter(|_| k_source.is_none()));
        let bound = Bound { frame, ..bound };
        Self {
            bound,
            development,
            known,
            warnings,
            intensifier,
            pitch_mm,
            source_to_isocentre_mm,
            intrinsics,
            intrinsics_prior,
            k_source,
            misfit,
            header,
            unfit,
            camera_from_world,
        }
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
            is_k_of_header: self.k_source == Some(KSource::Header),
            intrinsics_prior: self.intrinsics_prior,
            pitch_mm: self.pitch_mm,
            source_to_isocentre_mm: self.source_to_isocentre_mm,
            prior: prior.as_ref(),
            landmarks: &self.known.landmarks,
            bead_radius_mm: self.known.setup.session.bead_radius_mm,
            distortion: self.intensifier.iter().flatten().next().map(|intensifier| &intensifier.distortion),
            is_flat: self.known.setup.session.is_flat(),
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
        if let Some(detail) = &self.misfit {
            pose = pose.refused_for(Refusal::OtherSize { detail: detail.clone() });
        }
        pose.prior_from("by telemetry");
        if let Some(words) = self.unfit.as_ref().filter(|_| pose.is_accepted()) {
            pose.doubt(words.clone());
            pose.cautions.extend(pose.solved_k());
        } else if let Some(words) = pose.solved_k() {
            pose.doubt(format!("{words}, and depth is as uncertain as f is: {K_REMEDY}"));
        }
        let focal_sigma_px = IntrinsicsPrior::stated_focal_sigma_px(self.intrinsics_prior.as_ref());
        pose.hear_header(&self.bound.frame, self.intensifier.is_some(), focal_sigma_px);
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
            || self.k_source != Some(KSource::Carm)
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
            k_source: job.k_source,
            view,
            robot,
            joints,
            carm_gap_us,
            nominal,
            beam,
            telemetry_disagreement: None,
            other_depth: None,
            stages,
        };
        (posed, seen)
    }
}
