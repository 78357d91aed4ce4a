//! The frames of a log as its session registered them: the log is taken through the session's own engine, so that each frame is imported with
//! what telemetry told of its exposure, by the code that imported it then. Nothing is registered again.

use std::collections::{BTreeMap, BTreeSet, VecDeque};
use std::path::Path;
use std::sync::Arc;

use super::SessionError;
use super::engine::Engine;
use super::input::{Input, Output};
use super::log::END_TOPIC;
use super::log_inputs::LogInputs;
use super::posed::Posed;
use super::posing::Registered;
use super::recorded::Recorded;
use super::records::RESTART_TOPIC;
use crate::acquire::Frame;
use crate::image::temporary_folder;
use crate::pose::Pose;
use crate::record::LogReader;
use crate::reporter::Reporter;

/// Takes a frame with its number, and what its import had to say of it.
type TakeFrame<'a> = dyn FnMut(u32, Arc<Frame>, &[String]) + 'a;

/// Gives the frames of `log` whose number is `wanted` to `take`, each once, in the order in which they were registered, with what the import had
/// to say of it. A frame that was posed again, because its exposure became clear late, comes last and as it was then. All frames are imported, wanted
/// or not, since any may tell of the others. Returns what of its inputs could not be read; frames of which no picture is in the log do not come.
///
/// # Errors
/// When the file cannot be read, is no log, or holds no session.
pub fn logged_frames(log: &Path, wanted: &dyn Fn(u32) -> bool, take: &mut TakeFrame) -> Result<Vec<String>, SessionError> {
    let no_session = || SessionError::NoSession { path: log.display().to_string(), detail: "no session setup".to_owned() };
    let mut recorded = Recorded::read(log)?;
    let setup = Arc::new(recorded.setup.take().ok_or_else(no_session)?);
    // Pixels of frames that wait are put away there, as in the session; where there is no folder they stay in memory.
    let parked = temporary_folder(&std::env::temp_dir()).ok();
    // Beads are not looked for. What there was to say of the session was said when it was recorded.
    let engine = || {
        let mut engine = Engine::new(Arc::clone(&setup), None, Reporter::silent());
        parked.iter().for_each(|folder| engine.park_in(folder.path()));
        engine
    };
    let mut retaken = Retaken {
        engine: engine(),
        recorded: &recorded,
        wanted,
        take,
        has_end: false,
        held: BTreeMap::new(),
        given: BTreeSet::new(),
        losses: Vec::new(),
    };
    let mut inputs = LogInputs::default();
    for entry in LogReader::open(log)? {
        if &*entry.topic == END_TOPIC {
            retaken.has_end = true;
            retaken.drive(|engine, sink| engine.finish(entry.host_us, sink));
        } else if &*entry.topic == RESTART_TOPIC {
            retaken.end();
            retaken.engine = engine();
        } else if let Some(input) = inputs.of(&entry) {
            retaken.drive(|engine, sink| engine.push(input, sink));
        }
    }
    retaken.end();
    let lost = std::mem::take(&mut retaken.losses);
    Ok(inputs.tolerance.losses().into_iter().chain(lost).collect())
}

/// An engine that is given the inputs of a log again.
struct Retaken<'a> {
    engine: Engine,
    recorded: &'a Recorded,
    wanted: &'a dyn Fn(u32) -> bool,
    take: &'a mut TakeFrame<'a>,
    /// The inputs of the session, or of this part of it, came to their end.
    has_end: bool,
    /// Frames that were posed again, as they were last.
    held: BTreeMap<u32, Posed>,
    given: BTreeSet<u32>,
    /// Pictures that were put away and did not come back.
    losses: Vec<String>,
}

impl Retaken<'_> {
    fn drive(&mut self, drive: impl FnOnce(&mut Engine, &mut dyn FnMut(Output))) {
        let mut outputs = VecDeque::new();
        drive(&mut self.engine, &mut |output| outputs.push_back(output));
        while let Some(output) = outputs.pop_front() {
            let mut sink = |output| outputs.push_back(output);
            match output {
                // A log that keeps no order registered each frame when it was bound.
                Output::Bound { number } if !self.recorded.has_order => self.engine.push(Input::Develop { number }, &mut sink),
                // Where the specimen lies in the room changes nothing of a picture.
                Output::Job(job) => self.engine.registered(Registered::recorded(*job, Pose::default()), &mut sink),
                Output::Posed(posed) => self.pass_on(*posed),
                Output::PictureLost { job, words } => {
                    self.losses.push(format!("frame {}: {words}", job.number()));
                    self.engine.registered(Registered::failed(*job, &words), &mut sink);
                }
                // The engine keeps nothing for edits.
                Output::Edit(_)
                | Output::Sample { .. }
                | Output::Fault { .. }
                | Output::Bound { .. }
                | Output::BoundLate { .. }
                | Output::NotEdited { .. }
                | Output::Noted { .. } => {}
            }
        }
    }

    fn pass_on(&mut self, posed: Posed) {
        let number = posed.number;
        if !(self.wanted)(number) {
            return;
        }
        match self.recorded.times_registered(number) {
            0 | 1 => self.give(posed),
            _ => _ = self.held.insert(number, posed),
        }
    }

    fn give(&mut self, posed: Posed) {
        if self.given.insert(posed.number) {
            (self.take)(posed.number, posed.frame, &posed.warnings);
        }
    }

    /// The inputs of a session, or of one of the logs that were joined, are over: what it did not come to follows in the order of arrival.
    fn end(&mut self) {
        if !std::mem::take(&mut self.has_end) {
            // No time but that of the last input.
            self.drive(|engine, sink| engine.finish(i64::MIN, sink));
        }
        let left: Vec<u32> = self.engine.bound().collect();
        for number in left {
            self.drive(|engine, sink| engine.push(Input::Develop { number }, sink));
        }
        for (_, posed) in std::mem::take(&mut self.held) {
            self.give(posed);
        }
    }
}

#[cfg(test)]
mod tests {
    use std::path::PathBuf;

    use serde_json::{Value, json};

    use super::super::file::Setup;
    use super::super::log::{ORDER_TOPIC, SETUP_TOPIC};
    use super::*;
    use crate::acquire::{AirBeam, DetectorCalibration, DetectorRecord, Domain};
    use crate::image::Image;
    use crate::record::{Provenance, Recorder};
    use crate::telemetry::{CarmSample, carm_packet};

    const BEGUN_US: i64 = 1_700_000_000_000_000;
    const STEP_US: i64 = 20_000;
    const LAST_US: i64 = 2_000_000;
    /// Exposure 8, and its frame.
    const BEAM_US: std::ops::Range<i64> = 800_000..1_100_000;
    const FRAME_US: i64 = 1_400_000;
    const COUNTER: u32 = 8;

    /// An arm, and a panel that was calibrated with two filters; gains tell the air maps apart.
    fn setup() -> Setup {
        let carm: Value = serde_json::from_str(include_str!("../../calibration/carm/live-620x480.json")).expect("a calibration");
        let mut setup: Setup = serde_json::from_value(json!({
            "session": {
                "carm": {"port": "/dev/carm", "calibration": "carm.json"}, "frames": {"folder": "frames"}, "scene": "scene.json"
            },
            "carm": carm, "robot": null, "beads": null, "scene_json": "{}", "scene_path": "scene.json"
        }))
        .expect("a setup");
        let beam = |filter: &str, gain: f64| AirBeam {
            tube_kvp: Some(90.0),
            added_filter: filter.parse().ok(),
            gain_value_per_quantum: Some(gain),
            ..AirBeam::default()
        };
        let mut record: DetectorRecord =
            serde_json::from_value(json!({"origin": "test", "columns_px": 620, "rows_px": 480})).expect("a record");
        record.beams = vec![beam("none", 2.0), beam("copper=0.2", 3.0)];
        setup.detector = Some(Box::new(DetectorCalibration { record, maps: Default::default() }));
        setup
    }

    fn told(us: i64) -> CarmSample {
        CarmSample {
            device_us: us.unsigned_abs(),
            sequence: (us / STEP_US) as u32,
            tube_kvp: 90.0,
            filter_mm_cu: 0.2,
            xray_on: BEAM_US.contains(&us),
            exposure_counter: Some(if us < BEAM_US.start { COUNTER - 1 } else { COUNTER }),
            ..CarmSample::UNTOLD
        }
    }

    /// The log of a session with one frame, whose file says nothing of the beam; `tells` whether the arm's packets are in it.
    fn log(folder: &Path, tells: bool) -> PathBuf {
        let path = folder.join(format!("{tells}.mcap"));
        let recorder = Recorder::create(&path, &Provenance::of_this_program(BEGUN_US, Value::Null)).expect("a log");
        recorder.json(SETUP_TOPIC, BEGUN_US, &setup()).expect("recorded");
        let pixels = (0..620 * 480).map(|index| 100.0 + (index % 977) as f32).collect();
        let picture = Image { width: 620, height: 480, pixels };
        let mut frame = Frame::from_pixels("f", picture, Domain::Linear).expect("a frame");
        (frame.number, frame.tags.exposure_counter) = (1, Some(COUNTER));
        for us in (0..LAST_US).step_by(STEP_US as usize) {
            if tells {
                recorder.raw_bytes("carm", 0, BEGUN_US + us, &carm_packet(&told(us))).expect("recorded");
            }
            if us == FRAME_US {
                recorder.frame(&frame, BEGUN_US + us).expect("recorded");
            }
        }
        recorder.json(END_TOPIC, BEGUN_US + LAST_US, &json!({"host_us": BEGUN_US + LAST_US})).expect("recorded");
        recorder.json(ORDER_TOPIC, BEGUN_US + LAST_US, &json!({"number": 1})).expect("recorded");
        recorder.finish().expect("finished");
        path
    }

    /// The air map was chosen without a word of telemetry: a calibration from a log saw other pictures than the session had.
    #[test]
    fn a_frame_of_a_log_is_corrected_by_the_beam_that_its_telemetry_tells() {
        let folder = tempfile::tempdir().expect("a folder");
        let taken = |tells: bool| {
            let mut frames = Vec::new();
            let mut take = |number: u32, frame: Arc<Frame>, said: &[String]| {
                let gain = frame.correction.as_ref().and_then(|correction| correction.gain_value_per_quantum);
                frames.push((number, gain, said.concat()));
            };
            let losses = logged_frames(&log(folder.path(), tells), &|number| number == 1, &mut take).expect("a session's log");
            assert_eq!(losses, Vec::<String>::new());
            frames
        };
        assert_eq!(taken(true), [(1, Some(3.0), String::new())]);
        let untold = taken(false);
        assert_eq!(untold.len(), 1, "the control");
        assert!(untold[0].2.contains("does not say which was in"), "the control: {untold:?}");
    }
}
