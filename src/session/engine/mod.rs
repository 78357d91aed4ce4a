//! The deterministic heart of a session: inputs in order in, bound and posed frames out. Live and replay run this same code; it reads
//! no clock and no device, so the same inputs give the same poses, byte for byte.
//!
//! Whatever telemetry says about a frame is fixed when the frame is bound ([`Bound`]). Registration takes long and runs elsewhere, one
//! frame at a time, in an order that whoever drives the engine chooses ([`Input::Develop`]) and a log keeps: the state that it rests on,
//! where the specimen lies in the room, changes only with [`Engine::registered`].

mod accounts;
mod binding;
mod counted_on;

use std::collections::{BTreeMap, BTreeSet};
use std::path::Path;
use std::sync::Arc;

use super::basis::Basis;
use super::bound::Bound;
use super::crosscheck::{DriftWatch, LineWatch};
use super::edit::BeadEdit;
use super::editing::Editing;
use super::file::Setup;
use super::hearing::Hearing;
use super::import::Import;
use super::input::{Input, Output};
use super::losses::line_losses;
use super::pictures::{PictureDigest, Pictures};
use super::posing::{Known, PoseJob, Registered};
use super::standstill::{Contradiction, Standstill};
use super::studies::Studies;
use super::tie::SpecimenTie;
use super::waiting::Waiting;
use crate::acquire::Frame;
use crate::beads::tags::TagLayout;
use crate::beads::{BeadLayout, Landmark};
use crate::geometry::Rigid;
use crate::pose::Refusal;
use crate::reporter::Reporter;
use crate::telemetry::{DeviceKind, Event, Health, Link, Sequenced};
use crate::timeline::{Binder, ConsoleZone, FrameEvidence, Timeline};

/// A frame that waits for the telemetry of its exposure.
struct Pending {
    frame: Arc<Frame>,
    host_us: i64,
}

/// A frame that was developed without an exposure and may yet get one.
struct Unbound {
    /// Let go where others need the memory.
    frame: Option<Arc<Frame>>,
    host_us: i64,
}

/// See the module.
pub struct Engine {
    setup: Arc<Setup>,
    import: Import,
    landmarks: Arc<[Landmark]>,
    layout: Option<Arc<BeadLayout>>,
    tags: Option<Arc<TagLayout>>,
    links: BTreeMap<DeviceKind, Link>,
    line_watch: LineWatch,
    hearing: Hearing,
    timeline: Timeline,
    tie: SpecimenTie,
    standstill: Standstill,
    drift: DriftWatch,
    world_from_tracker: Option<Rigid>,
    binder: Binder,
    pending: BTreeMap<u32, Pending>,
    unbound: BTreeMap<u32, Unbound>,
    /// What each frame counts, and when it came.
    counts: BTreeMap<u32, (u32, i64)>,
    /// It was said that frames count on where the C-arm's counter stands still.
    told_of_counts: bool,
    /// Frames without pixels.
    seen: BTreeSet<u32>,
    /// How often each frame that was posed again was handed on before.
    developments: BTreeMap<u32, u32>,
    /// Exposures of which a frame came.
    shown: BTreeSet<u64>,
    /// Frames that have one.
    tied: BTreeSet<u32>,
    /// When the telemetry ended.
    ended_us: Option<i64>,
    /// Latest host time of any input.
    now_us: i64,
    bound: Waiting,
    /// Frames of unfinished files, whose whole pictures came later.
    replaced: BTreeSet<u32>,
    pictures: Pictures,
    zone: ConsoleZone,
    studies: Studies,
    editing: Editing,
    /// Frames that are being registered, and whether it was known by then that their files were not finished.
    registering: BTreeMap<u32, bool>,
    /// Frames that turned out to be wrong, and why, while one is being registered: a replay, which registers at once, hears of it after that.
    retractions: Vec<(u32, &'static str)>,
    reporter: Reporter,
}

impl Engine {
    /// `layout` holds the specimen's beads; without them and without tags every frame falls back to telemetry.
    #[must_use]
    pub fn new(setup: Arc<Setup>, layout: Option<Arc<BeadLayout>>, reporter: Reporter) -> Self {
        let rigid = |rows: Option<[[f64; 4]; 4]>| rows.and_then(|rows| Rigid::from_rows(&rows).ok());
        let tags = setup.tag_layout().map(Arc::new);
        let of_tags = tags.as_ref().map(|tags| tags.centre_lps_mm());
        let centre = layout.as_ref().map(|layout| layout.centroid_lps_mm()).or(of_tags).unwrap_or_default();
        let declared = rigid(setup.session.world_from_lps);
        let tie = SpecimenTie::new(declared, centre);
        let world_from_tracker = rigid(setup.session.world_from_tracker);
        let present: Vec<DeviceKind> = setup.devices().collect();
        let links = present.iter().map(|device| (*device, setup.link(*device))).collect();
        let timeline = setup.adapters.timeline();
        Self {
            import: Import::of(&setup),
            landmarks: setup.landmark_points().into(),
            setup,
            layout,
            tags,
            links,
            line_watch: LineWatch::default(),
            hearing: Hearing::new(present),
            timeline,
            tie,
            standstill: Standstill::new(centre, declared),
            drift: DriftWatch::default(),
            world_from_tracker,
            binder: Binder::default(),
            pending: BTreeMap::new(),
            unbound: BTreeMap::new(),
            counts: BTreeMap::new(),
            told_of_counts: false,
            seen: BTreeSet::new(),
            developments: BTreeMap::new(),
            shown: BTreeSet::new(),
            tied: BTreeSet::new(),
            ended_us: None,
            now_us: i64::MIN,
            bound: Waiting::new(reporter.clone()),
            replaced: BTreeSet::new(),
            pictures: Pictures::default(),
            zone: ConsoleZone::default(),
            studies: Studies::default(),
            editing: Editing::default(),
            registering: BTreeMap::new(),
            retractions: Vec::new(),
            reporter,
        }
    }

    /// Pictures of the many frames of a burst wait in `folder` from now on.
    pub fn park_in(&mut self, folder: &Path) {
        self.bound.park_in(folder);
    }

    /// From now on the beads of posed frames may be edited ([`Input::Edit`]): what their poses rest on is kept.
    pub fn keep_for_edits(&mut self) {
        self.editing.begin();
    }

    /// Counters of a line.
    #[must_use]
    pub fn health(&self, device: DeviceKind) -> Option<Health> {
        self.links.get(&device).map(|link| *link.health())
    }

    /// What a device's line has lost so far, in words; `None` when nothing.
    pub(super) fn losses_of(&self, device: DeviceKind) -> Option<String> {
        self.links.get(&device).and_then(line_losses)
    }

    /// The timeline, for plots and states.
    #[must_use]
    pub fn timeline(&self) -> &Timeline {
        &self.timeline
    }

    /// Where the specimen lies in the room, as far as it is known now.
    #[must_use]
    pub fn world_from_lps(&self) -> Option<Rigid> {
        self.tie.world_from_lps()
    }

    /// Frames on which rests where the specimen lies in the room, or may come to rest with the next frame.
    pub(super) fn tie_rests_on(&self) -> impl Iterator<Item = u32> + '_ {
        self.tie.rests_on()
    }

    /// Frames that wait for telemetry.
    #[must_use]
    pub fn waiting(&self) -> usize {
        self.pending.len()
    }

    /// Frames that wait for telemetry, by number.
    pub fn awaiting(&self) -> impl Iterator<Item = u32> + '_ {
        self.pending.keys().copied()
    }

    /// Whether a frame that waits can be registered at once; where its picture is on the disk it is fetched.
    #[must_use]
    pub fn is_ready(&self, number: u32) -> bool {
        self.bound.is_ready(number)
    }

    /// Frames that wait to be registered, by number.
    pub fn bound(&self) -> impl DoubleEndedIterator<Item = u32> + '_ {
        self.bound.numbers()
    }

    /// Lines that have fallen silent since this was last asked, a sentence each.
    pub fn silent_lines(&mut self) -> Vec<(DeviceKind, String)> {
        let Self { hearing, links, now_us, .. } = self;
        hearing.look(*now_us, |device| links.get(&device).map(|link| *link.health()))
    }

    /// Takes one input; `sink` gets what came of it, in order.
    pub fn push(&mut self, input: Input, sink: &mut dyn FnMut(Output)) {
        let now_us = match input {
            Input::Bytes { device, epoch, host_us, bytes } => {
                self.take_bytes(device, epoch, host_us, &bytes, sink);
                host_us
            }
            Input::Frame { frame, host_us } => {
                self.meet(&frame, PictureDigest::of(&frame), host_us);
                self.pending.insert(frame.number, Pending { frame, host_us });
                host_us
            }
            Input::Seen { frame, picture, host_us } => {
                self.meet(&frame, picture, host_us);
                self.seen.insert(frame.number);
                host_us
            }
            Input::Tick { host_us } => host_us,
            Input::ImageDisagrees { number } => {
                return self.retract(number, "the image of this frame, on which the tie rested, prefers another pose");
            }
            Input::Edit { number, edit, .. } => return self.edit(number, &edit, sink),
            Input::Note { number, words, .. } => return sink(Output::Noted { number, words }),
            Input::Develop { number } => {
                let lost_edits = self.editing.forget(number);
                if lost_edits > 0 {
                    let words = format!(
                        "frame {number} is posed anew, as its exposure has become clear: {lost_edits} edits of its beads are to be made again"
                    );
                    self.reporter.warn("edits lost", words);
                }
                if let Some((bound, lost)) = self.bound.take(number) {
                    self.registering.insert(number, self.replaced.contains(&number));
                    let job = Box::new(self.job(bound));
                    sink(match lost {
                        Some(words) => Output::PictureLost { job, words },
                        None => Output::Job(job),
                    });
                }
                return;
            }
        };
        self.now_us = self.now_us.max(now_us);
        self.hearing.advance(self.now_us);
        self.settle(sink);
    }

    /// Notes when a frame came, and what it says of its exposure.
    fn meet(&mut self, frame: &Frame, picture: Option<PictureDigest>, host_us: i64) {
        let image = frame.image_of_file.map(|n| n as u32);
        // The same picture in another file, with other identifiers and stamps, is no other exposure.
        let content = self.pictures.first_of(frame, picture);
        self.counts.extend(frame.tags.exposure_counter.map(|counter| (frame.number, (counter, host_us))));
        let evidence = FrameEvidence::of(frame.number, &frame.tags, &content, image, Some(host_us));
        let evidence = FrameEvidence { completes: frame.completes, ..self.zone.steady(&frame.tags, evidence) };
        self.binder.note_zone(self.zone.minutes());
        self.binder.push_of(frame.tags.study.as_deref(), evidence);
        if let Some(before) = self.pictures.take_copied_before(&content) {
            self.binder.was_copied_by(&before, frame.number);
        }
        if let Some(words) = self.studies.meet(frame.number, frame.tags.study.as_deref()) {
            self.reporter.warn("another study", words);
        }
        if let Some(before) = frame.completes {
            self.replaced.insert(before);
            self.retract(before, "the file of this frame, on which the tie rested, was written on or anew");
        }
    }

    /// No more telemetry will come: binds what waits, and frames that still come, with what there is.
    pub fn finish(&mut self, now_us: i64, sink: &mut dyn FnMut(Output)) {
        self.now_us = self.now_us.max(now_us);
        self.ended_us.get_or_insert(self.now_us);
        self.timeline.finish();
        self.settle(sink);
    }

    /// Takes the result of a job: ties the specimen to the room, chooses the pose that is used.
    pub fn registered(&mut self, registered: Registered, sink: &mut dyn FnMut(Output)) {
        let number = registered.number();
        let basis = self.editing.keeps().then(|| Basis::of(&registered));
        let (mut posed, world_from_lps) = registered.into_posed(self.world_from_tracker);
        // A picture that was torn says nothing of where the specimen lies.
        let was_replaced = self.registering.remove(&number).unwrap_or(false);
        let world_from_lps = world_from_lps.filter(|_| !was_replaced);
        posed.warnings.extend(self.studies.of(number));
        if let Some(found) = posed.pose.innovation.as_ref().filter(|_| !was_replaced).and_then(|off| self.drift.take(off)) {
            self.reporter.warn("check: telemetry and beads", format!("{}: {found}", posed.label()));
            posed.warnings.push(found.to_string());
        }
        if let Some(Contradiction { words, of_its_depth }) = self.standstill.observe(&posed, world_from_lps) {
            self.reporter.warn("specimen moved", format!("{}: {words}", posed.label()));
            posed.other_depth = of_its_depth.then(|| words.clone());
            posed.warnings.push(words);
        }
        let posed = match world_from_lps {
            Some(world_from_lps) => {
                let jumps = posed.pose.innovation.is_some_and(|off| off.is_jump());
                let in_doubt = posed.pose.may_be_another();
                let verdict = self.tie.observe(number, &posed.frame.sha256, world_from_lps, in_doubt, jumps);
                if let Some(words) = verdict.words {
                    self.reporter.warn("specimen in the room", format!("frame {number}: {words}"));
                    // What only says that nothing is tied yet is no fault of the frame.
                    posed.warnings.extend(verdict.disagreement.map(|_| words));
                }
                posed.with_telemetry_disagreement(verdict.disagreement)
            }
            None => {
                let contradicts = matches!(posed.pose.refusal, Some(Refusal::PriorContradicted { .. })) && !was_replaced;
                if let Some(words) = contradicts.then(|| self.tie.contradict(number, &posed.frame.sha256)).flatten() {
                    self.reporter.warn("specimen in the room", format!("frame {number}: {words}"));
                    posed.warnings.push(words);
                }
                posed
            }
        };
        if let Some(basis) = basis {
            self.editing.keep(basis, posed.clone());
        }
        sink(Output::Posed(Box::new(posed)));
        if self.registering.is_empty() {
            std::mem::take(&mut self.retractions).into_iter().for_each(|(number, because)| self.retract(number, because));
        }
    }

    /// A person's edit of a frame's beads.
    fn edit(&mut self, number: u32, edit: &BeadEdit, sink: &mut dyn FnMut(Output)) {
        let development = self.developments.get(&number).copied().unwrap_or(0) + 1;
        let job = if self.replaced.contains(&number) {
            Err("its file was written on or anew, and another frame is the whole picture".to_owned())
        } else if self.bound.numbers().any(|waiting| waiting == number) {
            Err("its exposure has become clear only now, and it is about to be posed again".to_owned())
        } else {
            self.editing.edit(number, edit, development)
        };
        match job {
            Ok(job) => {
                self.developments.insert(number, development);
                sink(Output::Edit(Box::new(job)));
            }
            Err(why) => sink(Output::NotEdited { number, words: format!("frame {number} is not edited: {why}") }),
        }
    }

    /// The frame says nothing about where the specimen lies.
    fn retract(&mut self, number: u32, because: &'static str) {
        if !self.registering.is_empty() {
            return self.retractions.push((number, because));
        }
        if let Some(words) = self.tie.retract(number, because) {
            self.reporter.warn("specimen in the room", format!("frame {number}: {words}"));
        }
    }

    fn take_bytes(&mut self, device: DeviceKind, epoch: u32, host_us: i64, bytes: &[u8], sink: &mut dyn FnMut(Output)) {
        let Self { links, timeline, line_watch, hearing, setup, reporter, .. } = self;
        let Some(link) = links.get_mut(&device) else { return };
        link.feed(host_us, epoch, bytes, &mut |received| match received.event {
            Event::Sample(sample, sequenced) => {
                line_watch.take(setup, &sample, reporter);
                if sequenced == Sequenced::Reset {
                    let words = format!(
                        "the {device} began anew, with its clock and all that it counts: exposures before and after may have the same number"
                    );
                    reporter.warn("device restarted", words);
                }
                if let Some(words) = hearing.sample(device, host_us, &sample) {
                    reporter.warn("device clock", words);
                }
                timeline.push_sample(device, host_us, epoch, sequenced, sample.clone());
                if let Some(words) = hearing.clock(device, timeline.clock_stretch(device)) {
                    reporter.warn("device clock", words);
                }
                if let Some(words) = hearing.rate(device, timeline.wrong_clock_rate(device)) {
                    reporter.warn("device clock rate", words);
                }
                sink(Output::Sample { device, host_us, sample: Box::new(sample) });
            }
            Event::Fault(fault) => sink(Output::Fault { device, host_us, detail: fault.to_string() }),
        });
    }

    fn job(&self, bound: Bound) -> PoseJob {
        let imported = self.import.frame(bound.frame(), bound.beam());
        imported.warnings.iter().for_each(|(kind, detail)| self.reporter.warn(kind, detail));
        let known = Known {
            setup: Arc::clone(&self.setup),
            layout: self.layout.clone(),
            tags: self.tags.clone(),
            landmarks: Arc::clone(&self.landmarks),
            world_from_lps: self.tie.world_from_lps(),
            tie_disputed: self.tie.is_disputed(),
        };
        let development = self.developments.get(&bound.frame().number).copied().unwrap_or(0);
        PoseJob::new(bound, imported, known, development, &self.reporter)
    }
}
