//! A session's engine taken through its log with the poses that the log has: nothing is registered, and its state is known at each frame.

use std::collections::{BTreeMap, VecDeque};
use std::path::Path;
use std::sync::Arc;

use super::super::edit::EDIT_TOPIC;
use super::super::engine::Engine;
use super::super::file::Setup;
use super::super::input::{Input, Output};
use super::super::log::{END_TOPIC, ORDER_TOPIC, PoseRecord, SETUP_TOPIC};
use super::super::log_inputs::LogInputs;
use super::super::posing::Registered;
use super::super::recorded::Development;
use super::super::records::RESTART_TOPIC;
use super::LogbookError;
use super::inventory::Reading;
use crate::beads::parse_markups;
use crate::pose::Pose;
use crate::record::{LogReader, Tolerance, topic};
use crate::reporter::Reporter;

/// What the tie of the specimen rested on when each frame was registered, by number.
pub(super) type TieAt = BTreeMap<u32, Vec<u32>>;

/// The poses of a log.
#[derive(Default)]
struct Poses {
    setup: Option<Setup>,
    has_order: bool,
    has_edits: bool,
    by_frame: BTreeMap<Development, Pose>,
}

impl Poses {
    fn read(log: &Path) -> Result<Self, LogbookError> {
        let (mut found, mut tolerance) = (Self::default(), Tolerance::default());
        for entry in LogReader::open(log)? {
            match &*entry.topic {
                SETUP_TOPIC if found.setup.is_none() => found.setup = tolerance.take(entry.json()),
                ORDER_TOPIC => found.has_order = true,
                EDIT_TOPIC => found.has_edits = true,
                topic::POSE => {
                    let record: Option<PoseRecord> = tolerance.take(entry.json());
                    let pose = record.and_then(|record| {
                        let pose = serde_json::from_value(record.pose).ok()?;
                        Some(((record.number, record.development), pose))
                    });
                    found.by_frame.extend(pose);
                }
                _ => {}
            }
        }
        Ok(found)
    }
}

/// Goes through `log`; `None` where it holds no session. Pictures of frames that wait are parked in `folder`.
///
/// # Errors
/// When the log cannot be read.
pub(super) fn retrace(log: &Path, folder: &Path, reporter: &Reporter) -> Result<Option<TieAt>, LogbookError> {
    let Poses { setup, has_order, has_edits, by_frame } = Poses::read(log)?;
    let Some(setup) = setup.map(Arc::new) else { return Ok(None) };
    let layout = setup.beads.as_ref().and_then(|(path, text)| parse_markups(path, text.as_bytes()).ok()).map(Arc::new);
    // What there was to say was said when it was recorded.
    let engine = || {
        let mut engine = Engine::new(Arc::clone(&setup), layout.clone(), Reporter::silent());
        engine.park_in(folder);
        // How often a frame was posed before counts edits.
        if has_edits {
            engine.keep_for_edits();
        }
        engine
    };
    let mut trace = Trace { engine: engine(), by_frame, has_order, tie_at: TieAt::new() };
    let mut inputs = LogInputs::default();
    let mut reader = LogReader::open(log)?;
    let mut reading = Reading::new("following the session", &reader, reporter);
    while let Some(entry) = reader.next() {
        reading.at(&reader);
        if &*entry.topic == END_TOPIC {
            trace.drive(|engine, sink| engine.finish(entry.host_us, sink));
        } else if &*entry.topic == RESTART_TOPIC {
            trace.engine = engine();
        } else if let Some(input) = inputs.of(&entry) {
            trace.drive(|engine, sink| engine.push(input, sink));
        }
    }
    Ok(Some(trace.tie_at))
}

struct Trace {
    engine: Engine,
    by_frame: BTreeMap<Development, Pose>,
    has_order: bool,
    tie_at: TieAt,
}

impl Trace {
    fn drive(&mut self, drive: impl FnOnce(&mut Engine, &mut dyn FnMut(Output))) {
        let mut outputs = VecDeque::new();
        drive(&mut self.engine, &mut |output| outputs.push_back(output));
        while let Some(output) = outputs.pop_front() {
            let mut sink = |output| outputs.push_back(output);
            match output {
                // A log that keeps no order registered each frame when it was bound.
                Output::Bound { number } if !self.has_order => self.engine.push(Input::Develop { number }, &mut sink),
                // The pose is the log's; the picture is not looked at.
                Output::Job(job) | Output::PictureLost { job, .. } => {
                    let number = job.number();
                    let before = self.tie_at.entry(number).or_default();
                    before.extend(self.engine.tie_rests_on());
                    let pose = self.by_frame.get(&(number, job.development())).cloned().unwrap_or_default();
                    self.engine.registered(Registered::recorded(*job, pose), &mut sink);
                }
                Output::Sample { .. }
                | Output::Fault { .. }
                | Output::Bound { .. }
                | Output::BoundLate { .. }
                | Output::Edit(_)
                | Output::NotEdited { .. }
                | Output::Noted { .. }
                | Output::Posed(_) => {}
            }
        }
    }
}
