//! Devices that send lines of text: what is read of them, what is refused, and that nothing else is taken for a sample.

use std::path::Path;

use serde_json::{Value, json};
use sidecarm::telemetry::lines::MAX_LINE_BYTES;
use sidecarm::telemetry::{CarmSample, DeviceKind, Event, Health, LineAdapter, Link, RobotSample, Sample, Sequenced};
use sidecarm::timeline::Timeline;

/// A sample adapter of `calibration/telemetry/`.
pub fn shipped(name: &str) -> Value {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("calibration/telemetry").join(name);
    serde_json::from_str(&std::fs::read_to_string(path).expect("the file is there")).expect("JSON")
}

pub fn adapter(declaration: &Value) -> LineAdapter {
    serde_json::from_value(declaration.clone()).expect("a declaration that holds")
}

/// Five columns of degrees, and nothing else.
pub fn plain() -> Value {
    let angles = ["a", "b", "c", "d", "e"].map(|column| json!({"from": column, "unit": "deg"}));
    json!({
        "origin": "these tests",
        "format": {"csv": {"columns": ["a", "b", "c", "d", "e"]}},
        "robot": {"sensed_angles": angles}
    })
}

/// The same with a clock in ms and a number in front.
pub fn clocked() -> Value {
    let mut declaration = plain();
    declaration["format"]["csv"]["columns"] = json!(["t", "n", "a", "b", "c", "d", "e"]);
    declaration["device_time"] = json!({"from": "t", "unit": "ms", "wraps_at": 65536});
    declaration["sequence"] = json!({"from": "n", "wraps_at": 256});
    declaration
}

/// What a link makes of `bytes` that come at one time.
pub struct Heard {
    samples: Vec<(Sample, Sequenced)>,
    pub faults: Vec<String>,
    link: Link,
}

impl Heard {
    fn new(declaration: &Value, begins_whole: bool) -> Self {
        Self { samples: Vec::new(), faults: Vec::new(), link: Link::of_lines(&adapter(declaration), begins_whole) }
    }

    fn feed(&mut self, host_us: i64, epoch: u32, bytes: &[u8]) {
        let Self { samples, faults, link } = self;
        link.feed(host_us, epoch, bytes, &mut |received| match received.event {
            Event::Sample(sample, sequenced) => samples.push((sample, sequenced)),
            Event::Fault(fault) => faults.push(fault.to_string()),
        });
    }

    pub fn of(declaration: &Value, text: &[u8]) -> Self {
        let mut heard = Self::new(declaration, true);
        heard.feed(1_000_000, 0, text);
        heard
    }

    pub fn health(&self) -> Health {
        *self.link.health()
    }

    pub fn robots(&self) -> Vec<RobotSample> {
        let robot =
            |(sample, _): &(Sample, Sequenced)| if let Sample::Robot(robot) = sample { Some(robot.clone()) } else { None };
        self.samples.iter().filter_map(robot).collect()
    }

    pub fn robot(&self) -> RobotSample {
        let robots = self.robots();
        assert_eq!(robots.len(), 1, "{:?}", self.faults);
        robots[0].clone()
    }

    pub fn carms(&self) -> Vec<CarmSample> {
        let carm = |(sample, _): &(Sample, Sequenced)| if let Sample::Carm(carm) = sample { Some(carm.clone()) } else { None };
        self.samples.iter().filter_map(carm).collect()
    }
}

#[test]
fn a_robot_of_columns_has_its_values() {
    let declaration = shipped("generic-robot-csv.json");
    let line = "# a comment\r\n1500,65535,100,200,50,-100,0,112.5,225,,-125,6.25,3500,-3500,100,home\r\n";
    let heard = Heard::of(&declaration, line.as_bytes());
    let robot = heard.robot();
    assert_eq!((robot.device_us, robot.sequence, robot.status), (1_500_000, 65_535, 4), "homing is bit 2");
    assert_eq!(robot.commanded_deg, [1.0, 2.0, 0.5, -1.0, 0.0]);
    let sensed = robot.sensed_deg.expect("declared");
    assert_eq!([sensed[0], sensed[1], sensed[3], sensed[4]], [1.125, 2.25, -1.25, 0.0625]);
    assert!(sensed[2].is_nan(), "not measured, and need not be");
    assert_eq!([robot.tendons[0].position_mm, robot.tendons[1].position_mm], [3.5, -3.5]);
    assert!(robot.tendons[0].tension_n.is_nan(), "nobody says");
    assert_eq!(robot.drill_rpm, 6000.0);
    assert_eq!(robot.tracker_from_base, None);
    assert_eq!((heard.health().frames, heard.health().corrupt), (1, 0));
}

#[test]
fn a_robot_of_objects_has_its_values_and_the_time_of_its_arrival() {
    let declaration = shipped("generic-robot-json.json");
    let object = json!({"joints": [0.1, -0.2, "0.05", 1e-3, 0], "stopped": true,
        "base": {"x": 0.1005, "y": -0.02025, "z": 1.5, "qx": 0, "qy": 0, "qz": 0.6, "qw": 0.8}, "operator": "nobody"});
    let robot = Heard::of(&declaration, format!("{object}\n").as_bytes()).robot();
    let sensed = robot.sensed_deg.expect("declared");
    for (found, expected_rad) in sensed.iter().zip([0.1f64, -0.2, 0.05, 1e-3, 0.0]) {
        assert!((found - expected_rad.to_degrees()).abs() < 1e-12, "{sensed:?}");
    }
    assert!(robot.commanded_deg.iter().all(|angle| angle.is_nan()), "nobody says");
    let base = robot.tracker_from_base.expect("seen");
    assert!((base.translation_mm - glam::DVec3::new(100.5, -20.25, 1500.0)).length() < 1e-9);
    assert!((base.rotation.to_array()[2] - 0.6).abs() < 1e-12);
    assert_eq!(robot.status, 2, "emergency stop is bit 1");
    // It arrived at 1 s, and was measured 5 ms before on the average.
    assert_eq!((robot.device_us, robot.sequence), (995_000, 1));
    let unseen = json!({"joints": [0, 0, 0, 0, 0], "stopped": false, "base": null});
    assert_eq!(Heard::of(&declaration, format!("{unseen}\n").as_bytes()).robot().tracker_from_base, None);
    let mut other_way = declaration;
    other_way["robot"]["base"]["holds"] = json!("base_from_tracker");
    let inverse = Heard::of(&other_way, format!("{object}\n").as_bytes()).robot().tracker_from_base.expect("seen");
    assert!((inverse * base).translation_mm.length() < 1e-9);
}

#[test]
fn a_carm_of_words_has_its_values() {
    let declaration = shipped("generic-carm-regex.json");
    let lines = "INFO ready\nt=123456 orb=120.25 ang=12.5 lift=12.05cm sid=40in kV=74 x=ON exp=17\n---\n\
                 t=223456 orb=120 ang=12 lift=12cm sid=40in kV=74 x=ON exp=4294967295\n\
                 t=4294967295 orb=90 ang=-1 lift=0cm sid=40in kV=0 x=OFF exp=-\n";
    let heard = Heard::of(&declaration, lines.as_bytes());
    let carms = heard.carms();
    assert_eq!((carms.len(), heard.health().corrupt), (3, 0), "{:?}", heard.faults);
    let (first, joints) = (&carms[0], carms[0].joints);
    // The arm counts the other way, from 90 degrees.
    assert!((joints.orbital_rad.to_degrees() + 30.25).abs() < 1e-12 && (joints.angulation_rad.to_degrees() - 12.5).abs() < 1e-12);
    assert!((joints.lift_mm - 120.5).abs() < 1e-9 && joints.source_to_detector_mm == 1016.0 && joints.wig_wag_rad.is_nan());
    assert_eq!((first.tube_kvp, first.xray_on, first.exposure_counter, first.device_us), (74.0, true, Some(17), 123_456));
    assert_eq!((carms[1].xray_on, carms[1].exposure_counter), (true, None), "as in packets");
    assert_eq!((carms[2].xray_on, carms[2].exposure_counter), (false, None));
}

/// An arm whose distance is fixed and that has no encoder for it had a prior without one.
#[test]
fn what_no_line_says_and_stands_still_may_be_declared() {
    let mut declaration = shipped("generic-carm-regex.json");
    declaration["carm"]["wig_wag"] = json!({"constant": -0.25, "unit": "rad"});
    declaration["carm"]["source_to_detector"] = json!({"constant": 40, "unit": "in"});
    let heard = Heard::of(&declaration, b"t=123456 orb=120.25 ang=12.5 lift=12.05cm sid=39in kV=74 x=ON exp=17\n");
    let joints = heard.carms()[0].joints;
    assert_eq!((joints.wig_wag_rad, joints.source_to_detector_mm), (-0.25, 1016.0));
    let unknowns = adapter(&declaration).unknowns();
    let said = unknowns.iter().find(|(kind, _)| *kind == "constants").map(|(_, words)| words.as_str());
    let expected =
        "the C-arm's lines do not say carm.wig_wag (-0.25 rad), carm.source_to_detector (40 in): taken as its adapter declares";
    assert_eq!(said, Some(expected), "it is said of a session that they are nobody's measurement");
    assert!(adapter(&shipped("generic-carm-regex.json")).unknowns().iter().all(|(kind, _)| *kind != "constants"), "the control");
    // A log that is given away reads its lines as before.
    let nameless = adapter(&declaration).nameless("nobody").expect("without names");
    assert_eq!(
        nameless.declaration().carm.as_ref().map(|carm| carm.wig_wag.clone()),
        Some(adapter(&declaration).declaration().carm.as_ref().expect("an arm").wig_wag.clone())
    );
}

#[test]
fn a_constant_is_the_value_itself_and_no_telemetry_alone() {
    let refused = |place: &str, source: Value| {
        let mut declaration = clocked();
        *declaration.pointer_mut(place).expect("a place") = source;
        serde_json::from_value::<LineAdapter>(declaration).expect_err("refused").to_string()
    };
    let first = "/robot/sensed_angles/0";
    let words = refused(first, json!({"constant": 3.0, "unit": "deg", "scale": 0.1}));
    assert!(words.contains("robot.sensed_angles[0].constant") && words.contains("leave out scale"), "{words}");
    assert!(refused(first, json!({"constant": 3.0, "from": "a", "unit": "deg"})).contains("one of the keys from and constant"));
    assert!(refused(first, json!({"unit": "deg"})).contains("one of the keys from and constant"));
    assert!(refused(first, json!({"constant": 3.0})).contains("no unit is stated"));
    let all = json!([1.0, 2.0, 3.0, 4.0, 5.0].map(|angle| json!({"constant": angle, "unit": "deg"})));
    assert!(refused("/robot/sensed_angles", all).contains("constants alone"));
}

/// Lines that are none, of the columns `t n a b c d e`, and what is said of each.
const BAD: [(&[u8], &str); 16] = [
    (b"100,1,1,2,3,4", "6 columns, expected 7"),
    (b"100,1,1,2,3,4,5,6", "8 columns, expected 7"),
    (b"100,1,1,2,3,4,nan", "robot.sensed_angles[4] is 'nan', expected a finite number"),
    (b"100,1,inf,2,3,4,5", "expected a finite number"),
    (b"100,1,-Infinity,2,3,4,5", "expected a finite number"),
    (b"100,1,1e999,2,3,4,5", "expected a finite number"),
    (b"100,1,1,2,,4,5", "robot.sensed_angles[2] is missing ('c')"),
    (b"100,1,1,2,3 4,4,5", "expected a finite number"),
    (b"100,1,1,2,0x3,4,5", "expected a finite number"),
    (b"-100,1,1,2,3,4,5", "device_time is '-100'"),
    (b"65536,1,1,2,3,4,5", "less than where it wraps"),
    (b"100,1.5,1,2,3,4,5", "sequence is '1.5', expected a whole number"),
    (b"100,256,1,2,3,4,5", "sequence is '256'"),
    (b"100,1,1,2,3,4,5\0", "hold a zero"),
    (b"100,1,1,2,3,4,\xff5", "not UTF-8"),
    (b"\x1b[31mboom", "1 columns, expected 7"),
];

#[test]
fn a_line_that_does_not_parse_is_counted_and_said_and_gives_no_sample() {
    let declaration = clocked();
    for (bad, words) in BAD {
        let mut heard = Heard::new(&declaration, true);
        let text = [b"100,1,1,2,3,4,5\n", bad, b"\n110,2,1,2,3,4,5\n"].concat();
        heard.feed(1_000_000, 0, &text);
        let name = String::from_utf8_lossy(bad);
        assert_eq!((heard.health().frames, heard.health().corrupt), (2, 1), "{name}");
        assert!(heard.faults.len() == 1 && heard.faults[0].contains(words), "{name}: {:?}", heard.faults);
        assert!(!heard.faults[0].contains('\x1b'), "what a device sends is no command to a terminal");
        assert_eq!(heard.link.latest_fault(), Some(heard.faults[0].as_str()));
        // It leaves no trace in what follows.
        assert_eq!(heard.robots().iter().map(|robot| robot.device_us).collect::<Vec<_>>(), [100_000, 110_000], "{name}");
        assert!(heard.samples.iter().all(|(_, sequenced)| *sequenced == Sequenced::Next), "{name}");
    }
}

#[test]
fn a_line_without_end_is_dropped_and_bounded() {
    let mut heard = Heard::new(&plain(), true);
    for _ in 0..40 {
        heard.feed(1_000_000, 0, &[b'1'; 8192]);
    }
    heard.feed(1_000_000, 0, b"\n1,2,3,4,5\n");
    assert_eq!((heard.health().overlong, heard.health().corrupt, heard.health().frames), (1, 0, 1));
    assert!(heard.faults[0].contains(&MAX_LINE_BYTES.to_string()), "{:?}", heard.faults);
    // The longest line that is one.
    let mut long = "1,2,3,4,".to_owned();
    long.push_str(&"0".repeat(MAX_LINE_BYTES - long.len() - 1));
    long.push('5');
    assert_eq!(long.len(), MAX_LINE_BYTES);
    assert_eq!(Heard::of(&plain(), format!("{long}\n").as_bytes()).robot().sensed_deg.expect("declared")[4], 5.0);
    long.insert(8, '0');
    assert_eq!(Heard::of(&plain(), format!("{long}\n").as_bytes()).health().frames, 0, "one byte more");
}

#[test]
fn ends_of_lines_and_chunks_do_not_matter() {
    let lines = ["1,2,3,4,5", " 2 ,3,\t4,5,6 ", "", "\"3\",4,5,6,7"];
    let whole = Heard::of(&plain(), (lines.join("\n") + "\n").as_bytes());
    assert_eq!(whole.robots().len(), 3, "{:?}", whole.faults);
    for end in ["\n", "\r\n", "\r"] {
        let text = lines.join(end) + end;
        for chunk in [1, 2, 3, 7, 64] {
            let mut heard = Heard::new(&plain(), true);
            text.as_bytes().chunks(chunk).for_each(|part| heard.feed(1_000_000, 0, part));
            let angles = |heard: &Heard| heard.robots().iter().map(|robot| robot.sensed_deg).collect::<Vec<_>>();
            assert_eq!(angles(&heard), angles(&whole), "{end:?} in chunks of {chunk}");
            assert_eq!(heard.health().corrupt, 0);
        }
    }
    // What is not ended yet is no line.
    assert_eq!(Heard::of(&plain(), b"1,2,3,4,5\n1,2,3,4,5").robots().len(), 1);
}

/// A serial port is opened within a line, and the rest of a number is a number.
#[test]
fn the_rest_of_a_line_is_no_line() {
    let line = b"100,7,11.5,-12.5,13.5,-14.5,15.5\n";
    let mut cases = 0;
    for cut in 1..line.len() {
        let mut heard = Heard::new(&clocked(), false);
        heard.feed(1_000_000, 0, &[&line[cut..], b"110,8,1,2,3,4,5\n"].concat());
        let sensed: Vec<f64> = heard.robots().iter().map(|robot| robot.sensed_deg.expect("declared")[0]).collect();
        assert_eq!(sensed, [1.0], "cut at {cut}");
        assert_eq!(heard.health().corrupt, 0, "opening a port is no fault of the line");
        cases += 1;
    }
    assert!(cases > 30);
    // The port closes within a line, and opens within another one.
    let mut heard = Heard::new(&clocked(), false);
    heard.feed(1_000_000, 0, b"\n100,7,1,2,3,4,5\n110,8,11.5");
    heard.feed(2_000_000, 1, b"5,2,3,4,5\n120,9,1,2,3,4,5\n");
    assert_eq!(heard.robots().iter().map(|robot| robot.device_us).collect::<Vec<_>>(), [100_000, 120_000]);
    assert_eq!((heard.health().corrupt, heard.health().partial_at_open, heard.health().epochs), (1, 1, 2));
    assert!(heard.link.latest_fault().is_some_and(|fault| fault.contains("cut")), "{:?}", heard.link.latest_fault());
}

#[test]
fn a_header_names_the_columns_and_may_come_again() {
    let mut declaration = plain();
    declaration["format"]["csv"] = json!({"separator": ";", "decimal": ",", "header": true});
    let text = b"1;2;3;4;5;6\nx;e;d;c;b;a\n9;5,5;4;3;2;1\n9;5;4;3;2\na;b;c;d;e\n1;2;3;4;6,25\n";
    let heard = Heard::of(&declaration, text);
    let sensed: Vec<[f64; 5]> = heard.robots().iter().map(|robot| robot.sensed_deg.expect("declared")).collect();
    assert_eq!(sensed, [[1.0, 2.0, 3.0, 4.0, 5.5], [1.0, 2.0, 3.0, 4.0, 6.25]]);
    assert!(heard.faults.len() == 2 && heard.faults[0].contains("no header yet"), "{:?}", heard.faults);
    // Where a comma is the point of a number, a point is none: it may group thousands.
    let heard = Heard::of(&declaration, b"a;b;c;d;e\n1;2;3;4;90.000\n1;2;3;4;90,5\n");
    let last: Vec<f64> = heard.robots().iter().map(|robot| robot.sensed_deg.expect("declared")[4]).collect();
    assert_eq!((last, heard.health().corrupt), (vec![90.5], 1), "{:?}", heard.faults);
    // A device that is reset by opening its port begins with its header; columns are kept when the port comes back.
    let mut heard = Heard::new(&declaration, false);
    heard.feed(1_000_000, 0, b"a;b;c;d;e\n1;2;3;4;5\n");
    heard.feed(2_000_000, 1, b"2;3;4;5\n2;2;3;4;5\n");
    assert_eq!(heard.robots().iter().map(|robot| robot.sensed_deg.expect("declared")[0]).collect::<Vec<_>>(), [1.0, 2.0]);
    // Half a header fits no line.
    let mut heard = Heard::new(&declaration, false);
    heard.feed(1_000_000, 0, b"x;a;b;c;d;e\n9;9;1;2;3;4;5\n");
    assert_eq!((heard.robots().len(), heard.health().corrupt), (0, 1));
}

/// An empty column at an end of a line with tabs was trimmed away, and every such line was corrupt.
#[test]
fn a_column_may_be_empty_at_either_end() {
    let mut declaration = plain();
    declaration["format"]["csv"] = json!({"separator": "\t", "columns": ["note", "a", "b", "c", "d", "e", "more"]});
    let heard = Heard::of(&declaration, b"\t1\t2\t3\t4\t5\t\nx\t6\t7\t8\t9\t10\ty\r\n");
    let first: Vec<f64> = heard.robots().iter().map(|robot| robot.sensed_deg.expect("declared")[0]).collect();
    assert_eq!(first, [1.0, 6.0], "{:?}", heard.faults);
}

#[test]
fn blanks_may_separate_columns() {
    let mut declaration = plain();
    declaration["format"]["csv"]["separator"] = json!("whitespace");
    declaration["ignore"] = json!(["ok.*"]);
    let heard = Heard::of(&declaration, b"ok\n 1  2\t3 4   5 \nok then\n");
    assert_eq!(heard.robot().sensed_deg, Some([1.0, 2.0, 3.0, 4.0, 5.0]));
    assert_eq!(heard.health().corrupt, 0, "{:?}", heard.faults);
}

/// Bytes of no sense, and lines with one byte changed: no panic, and the counters tell of every line.
#[test]
fn whatever_comes_every_line_is_counted() {
    let mut state = 1u64;
    let mut random = || {
        state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        (state >> 33) as u8
    };
    let alphabet = b"0123456789,.-+eEnaif{}[]\":\"\\\n\r\t \x00\xff\xc3\xa4";
    for name in ["generic-robot-csv.json", "generic-robot-json.json", "generic-carm-regex.json"] {
        let mut heard = Heard::new(&shipped(name), true);
        for _ in 0..20_000 {
            let byte = if random() < 200 { alphabet[usize::from(random()) % alphabet.len()] } else { random() };
            heard.feed(1_000_000, 0, &[byte]);
        }
        let health = heard.health();
        assert!(health.corrupt > 300 && health.bytes == 20_000, "{name}: {health}");
        assert_eq!(health.frames as usize, heard.samples.len());
    }
    let line = b"100,7,1,2,3,4,5";
    let mut heard = Heard::new(&clocked(), true);
    let mut fed = 0;
    for at in 0..line.len() {
        for byte in 0..=255u8 {
            let mut changed = line.to_vec();
            changed[at] = byte;
            changed.push(b'\n');
            // An end of a line within it makes two.
            if !matches!(byte, b'\n' | b'\r') {
                heard.feed(1_000_000, fed, &changed);
                fed += 1;
            }
        }
    }
    let health = heard.health();
    let told = health.frames + health.corrupt + health.duplicate;
    assert_eq!(told, u64::from(fed), "{health}");
}

/// Samples of a robot whose clock begins anew every 65.5 s and whose number every 256 lines.
#[test]
fn clock_and_number_go_on_over_their_ends() {
    let mut heard = Heard::new(&clocked(), true);
    let mut timeline = Timeline::new();
    for at in 0..12_000i64 {
        // Lines 700 to 709 are lost.
        if (700..710).contains(&at) {
            continue;
        }
        let line = format!("{},{},1,2,3,4,5\n", (60_000 + at * 20) % 65_536, (200 + at) % 256);
        heard.feed(5_000_000_000 + at * 20_000 + at % 7 * 300, 0, line.as_bytes());
        let (sample, sequenced) = heard.samples.last().expect("a sample").clone();
        let host_us = 5_000_000_000 + at * 20_000 + at % 7 * 300;
        timeline.push_sample(DeviceKind::Robot, host_us, 0, sequenced, sample);
    }
    assert_eq!((heard.health().lost, heard.health().resets, heard.health().corrupt), (10, 0, 0));
    let last = heard.robots().pop().expect("samples");
    assert_eq!((last.device_us, last.sequence), ((60_000 + 11_999 * 20) * 1000, 200 + 11_999));
    let [_, robot] = timeline.summaries();
    assert_eq!((robot.clock_steps, robot.resets, robot.segments.len(), robot.unusable), (0, 0, 1, 0));
    let clock = robot.segments[0].clock;
    assert!(clock.drift_ppm.abs() < 5.0 && robot.host_time_sigma_us.is_none(), "{clock:?}");
}

/// A robot without a clock has no drift, however its lines come.
#[test]
fn without_a_clock_arrival_is_the_time_and_nothing_is_learnt_of_it() {
    let mut declaration = plain();
    declaration["host_time_sigma_ms"] = json!(15);
    declaration["host_time_delay_ms"] = json!(5);
    let adapter = adapter(&declaration);
    assert_eq!(adapter.host_time_sigma_us(), Some(15_000.0));
    let mut link = Link::of_lines(&adapter, true);
    let mut timeline = Timeline::new();
    timeline.keep_host_time(DeviceKind::Robot, 15_000.0);
    for at in 0..2_000i64 {
        // Delayed by up to 190 ms, in bunches.
        let host_us = 1_000_000_000 + at * 20_000 + at % 20 * 10_000 - at % 20 * 20_000 + 200_000;
        let host_us = host_us.max(1_000_000_000 + (at - 1) * 20_000);
        let line = format!("{at},2,3,4,5\n");
        link.feed(host_us, 0, line.as_bytes(), &mut |received| {
            if let Event::Sample(sample, sequenced) = received.event {
                let stamps = timeline.push_sample(DeviceKind::Robot, received.host_us, 0, sequenced, sample);
                if let Some(stamps) = stamps {
                    assert_eq!((stamps.mapped_us, stamps.uncertainty_us), (host_us - 5_000, 15_000.0));
                }
            }
        });
    }
    let [_, robot] = timeline.summaries();
    let clock = robot.segments[0].clock;
    assert_eq!((clock.drift_ppm, clock.drift_sigma_ppm, clock.offset_us, clock.uncertainty_us), (0.0, 0.0, 0.0, 15_000.0));
    assert_eq!((robot.segments.len(), robot.clock_steps, robot.host_time_sigma_us), (1, 0, Some(15_000.0)));
    let answer = timeline.robot_at(1_020_000_000).expect("samples around");
    assert_eq!(answer.uncertainty_us, 15_000.0);
    let words = adapter.unknowns();
    assert!(words.len() == 2 && words[0].1.contains("±15 ms") && words[1].1.contains("cannot be known"), "{words:?}");
    // The control: a clock that is declared is learnt.
    assert!(self::adapter(&clocked()).unknowns().is_empty() && self::adapter(&clocked()).host_time_sigma_us().is_none());
    assert_eq!(self::adapter(&plain()).host_time_sigma_us(), Some(20_000.0));
}

/// Over UDP lines come twice, or in disorder; their arrival must not make a restart of it.
#[test]
fn a_line_that_comes_twice_or_late_is_no_restart() {
    let mut declaration = clocked();
    declaration.as_object_mut().expect("an object").remove("device_time");
    let mut heard = Heard::new(&declaration, true);
    for (at, number) in [10, 11, 11, 13, 12, 14].iter().enumerate() {
        heard.feed(1_000_000 + at as i64 * 10_000, 0, format!("0,{number},1,2,3,4,5\n").as_bytes());
    }
    use Sequenced::{Gap, Next, Reordered};
    let verdicts: Vec<Sequenced> = heard.samples.iter().map(|(_, sequenced)| *sequenced).collect();
    assert_eq!(verdicts, [Next, Next, Gap(1), Reordered, Next]);
    assert_eq!((heard.health().duplicate, heard.health().reordered, heard.health().lost, heard.health().resets), (1, 1, 0, 0));
    // When the late one was measured nobody knows: it is no sample of the timeline.
    let mut timeline = Timeline::new();
    timeline.keep_host_time(DeviceKind::Robot, 20_000.0);
    for (at, (sample, sequenced)) in heard.samples.iter().enumerate() {
        timeline.push_sample(DeviceKind::Robot, 1_000_000 + at as i64 * 10_000, 0, *sequenced, sample.clone());
    }
    let [_, robot] = timeline.summaries();
    assert_eq!((robot.samples, robot.unusable), (4, 1));
    // Nor when one was whose arrival lies before that of the last.
    let (sample, sequenced) = Heard::of(&plain(), b"1,2,3,4,5\n").samples.remove(0);
    timeline.push_sample(DeviceKind::Robot, 1_000_000, 0, sequenced, sample);
    assert_eq!(timeline.summaries().map(|track| (track.samples, track.unusable, track.clock_steps))[1], (4, 2, 0));
}
