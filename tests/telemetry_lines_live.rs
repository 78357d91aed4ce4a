//! A robot that prints lines, through `live`, its log, a replay of it, and what is done with the log: the mocked robot's packets are read
//! and printed on as lines.
#![cfg(unix)]

use std::io::{Read, Write};
use std::net::{Ipv4Addr, UdpSocket};
use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

use serde_json::{Value, json};
use sidecarm::record::{LogEntry, read_log, topic};
use sidecarm::telemetry::{Decoder, DeviceKind, Event, RobotSample, Sample};

use crate::live_lab::{HANG_S, Lab, Live, eventually};
use crate::log_lab::{count, replay, sidecarm, text};
use crate::telemetry_line_ports::free_udp_port;
use crate::telemetry_lines::{adapter as adapter_of, shipped};

/// Who stands in a column that nobody reads.
const CANARY: &str = "Quaxwelk";

/// Prints what the mocked robot says until it is dropped.
struct Printer {
    over: Arc<AtomicBool>,
    thread: Option<std::thread::JoinHandle<usize>>,
}

impl Printer {
    /// `print` is given each sample of the robot behind `port` and how many came before it.
    fn start(port: &Path, mut print: impl FnMut(usize, &RobotSample) + Send + 'static) -> Self {
        let over = Arc::new(AtomicBool::new(false));
        let (told, port) = (Arc::clone(&over), port.to_owned());
        let thread = std::thread::spawn(move || {
            let path = std::fs::canonicalize(port).expect("the mock's port");
            let opened = serialport::new(path.to_string_lossy(), 921_600).timeout(Duration::from_millis(50)).open_native();
            let mut line = opened.expect("the mock's port opens");
            let (mut decoder, mut buffer, mut printed) = (Decoder::new(DeviceKind::Robot), [0; 4096], 0);
            while !told.load(Ordering::Relaxed) {
                let read = match line.read(&mut buffer) {
                    Ok(0) => break,
                    Ok(read) => read,
                    Err(error) if error.kind() == std::io::ErrorKind::TimedOut => continue,
                    Err(_) => break,
                };
                decoder.push(&buffer[..read], &mut |event| {
                    if let Event::Sample(Sample::Robot(robot), _) = event {
                        print(printed, &robot);
                        printed += 1;
                    }
                });
            }
            printed
        });
        Self { over, thread: Some(thread) }
    }

    /// How many samples were printed.
    fn end(mut self) -> usize {
        self.over.store(true, Ordering::Relaxed);
        self.thread.take().expect("it runs").join().expect("it does not panic")
    }
}

impl Drop for Printer {
    fn drop(&mut self) {
        self.over.store(true, Ordering::Relaxed);
    }
}

/// In hundredths of a degree, with a number of 16 bits and a clock of 32 bits in ms that began at `begin_us` of the mock's, five seconds before
/// its end.
fn columns(robot: &RobotSample, begin_us: u64) -> String {
    let (sensed, cents) = (robot.sensed_deg.expect("the mock senses"), |deg: f64| format!("{:.0}", deg * 100.0));
    let angles: Vec<String> = robot.commanded_deg.iter().chain(&sensed).map(|deg| cents(*deg)).collect();
    let t_ms = (4_294_962_296 + robot.device_us.saturating_sub(begin_us) / 1000) % 4_294_967_296;
    let (number, micrometres) = (robot.sequence % 65_536, |tendon: usize| robot.tendons[tendon].position_mm * 1e3);
    let (first, second, drill_hz) = (micrometres(0), micrometres(1), robot.drill_rpm / 60.0);
    format!("{t_ms},{number},{},{first:.0},{second:.0},{drill_hz:.3},run,{CANARY}\n", angles.join(","))
}

fn robots(entries: &[LogEntry]) -> Vec<Value> {
    let is_robot = |entry: &&LogEntry| &*entry.topic == topic::ROBOT_JOINTS;
    entries.iter().filter(is_robot).map(|entry| entry.json().expect("JSON")).collect()
}

fn raw_bytes(entries: &[LogEntry]) -> Vec<u8> {
    let raw = |entry: &LogEntry| entry.raw_bytes().expect("sound").expect("bytes").bytes.to_vec();
    entries.iter().filter(|entry| &*entry.topic == topic::ROBOT_RAW).flat_map(raw).collect()
}

fn holds(bytes: &[u8], word: &str) -> bool {
    bytes.windows(word.len()).any(|window| window == word.as_bytes())
}

/// The topics whose messages hold a word.
fn naming<'a>(entries: &'a [LogEntry], word: &str) -> Vec<&'a str> {
    entries.iter().filter(|entry| holds(&entry.data, word)).map(|entry| &*entry.topic).collect()
}

/// A lab whose devices send datagrams can be rehearsed without them.
#[test]
fn the_mocked_devices_send_datagrams_as_well_and_are_heard() {
    let ports = [free_udp_port(), free_udp_port()];
    assert_ne!(ports[0], ports[1]);
    let told = ports.map(|port| port.to_string()).join(",");
    let args = ["--udp", &told, "--duration-s", "20", "--exposures", "1", "--faults", "none", "--await-all", "--idle-s", "300"];
    let Some(lab) = Lab::start_without_ct(&args) else { return };
    let session = lab.session("datagrams.json", |session| {
        for (device, port) in ["carm", "robot"].into_iter().zip(ports) {
            assert_eq!(session[device]["port"], format!("udp://127.0.0.1:{port}"), "as the kit has it");
        }
    });
    let mut live = Live::start(&session, &lab.kit.with_file_name("session"), &[]);
    let both = eventually(HANG_S, || {
        let heard = live.heard();
        let of = |device| heard.packets.keys().filter(|(known, _)| *known == device).count();
        (of(DeviceKind::Carm) > 20 && of(DeviceKind::Robot) > 20).then_some(())
    });
    assert!(both.is_some(), "{}", live.stderr());
    assert!(!lab.kit.join("ttyCARM").exists() && !lab.kit.join("ttyROBOT").exists(), "no terminals beside them");
    live.signalled(crate::live_lab::Signal::INT);
    assert!(live.program.end(HANG_S).is_some_and(|status| matches!(status.code(), Some(0 | 3))), "{}", live.stderr());
}

#[test]
fn a_robot_that_prints_lines_rides_along_and_its_log_replays_the_same() {
    let Some(lab) = Lab::start_without_ct(&["--duration-s", "25", "--faults", "none"]) else { return };
    let mut declaration = shipped("generic-robot-csv.json");
    declaration["format"]["csv"]["columns"].as_array_mut().expect("a list").push(json!("surgeon"));
    let adapter = lab.kit.join("Annegrund.json");
    std::fs::write(&adapter, declaration.to_string()).expect("written");
    let port = free_udp_port();
    let session = lab.session("lines.json", |session| {
        session["robot"]["port"] = json!(format!("udp://127.0.0.1:{port}"));
        session["robot"]["adapter"] = json!("Annegrund.json");
    });
    let out = lab.kit.with_file_name("session");
    let mut live = Live::launch(&session, &out, &["--seconds", "14"]);
    let sender = UdpSocket::bind((Ipv4Addr::LOCALHOST, 0)).expect("a socket");
    let mut begin_us = None;
    let printer = Printer::start(&lab.kit.join("ttyROBOT"), move |_, robot| {
        let line = columns(robot, *begin_us.get_or_insert(robot.device_us));
        // Nobody listens yet, or any more.
        let _ = sender.send_to(line.as_bytes(), (Ipv4Addr::LOCALHOST, port));
    });
    let ended = eventually(HANG_S, || live.program.end(0.1));
    let said = live.stdout() + &live.stderr();
    assert!(ended.is_some_and(|status| matches!(status.code(), Some(0 | 3))), "{said}");
    assert!(printer.end() > 500 && !said.contains("corrupt"), "{said}");
    assert!(
        !said.contains("no device time") && !said.contains("clock jumped"),
        "a clock that begins anew is none that jumps: {said}"
    );
    assert!(live.pairs() >= 3, "{said}");

    let log = read_log(&live.log).expect("a log");
    let robots = robots(&log.entries);
    assert!(robots.len() > 500, "{}", robots.len());
    assert!(robots.windows(2).all(|pair| pair[0]["device_us"].as_u64() < pair[1]["device_us"].as_u64()), "counted on");
    assert!(robots.last().expect("some")["device_us"].as_u64() > Some(4_294_967_296_000), "the clock began anew");
    let poses: Vec<Value> =
        log.entries.iter().filter(|entry| &*entry.topic == topic::POSE).map(|entry| entry.json().expect("JSON")).collect();
    assert!(poses.len() >= 3 && poses.iter().all(|pose| pose["control_angles_deg"].is_array()), "{poses:#?}");

    // The log knows the lines by what they are, and where they came from by what kind of port it was.
    let setup: Value = log.entries.iter().find(|entry| &*entry.topic == "/session/setup").expect("a setup").json().expect("JSON");
    assert_eq!(
        (&setup["session"]["robot"]["port"], &setup["session"]["robot"]["adapter"]),
        (&json!("udp:"), &json!("robot-lines.json"))
    );
    assert_eq!(adapter_of(&setup["adapters"]["robot"]), adapter_of(&declaration));
    assert_eq!(naming(&log.entries, "Annegrund"), [""; 0], "the name of a file");
    assert!(!naming(&log.entries, "lps").is_empty(), "the control");

    // A replay reads them as the log says, without the file.
    std::fs::remove_file(&adapter).expect("removed");
    let folder = tempfile::tempdir().expect("a folder");
    let (code, found) = replay(&live.log, &lab.kit, &folder.path().join("again"));
    assert!(matches!(code, Some(0 | 3)), "{found:#}");
    assert_eq!(count(&found, "poses_identical"), poses.len() as u64, "{found:#}");
    for key in ["poses_different", "poses_missing", "images_different", "scores_different", "samples_different", "not_in_log"] {
        assert_eq!(count(&found, key), 0, "{key}: {found:#}");
    }
    assert!(count(&found, "images_identical") >= 3, "{found:#}");
    let verified = sidecarm(&["log", "verify", text(&live.log), "--json"]);
    assert_eq!((verified.code, count(&verified.json(), "faults")), (Some(0), 0), "{}", verified.stdout);
    let tables = sidecarm(&["log", "csv", text(&live.log), "--out", text(&folder.path().join("tables"))]);
    assert_eq!(tables.code, Some(0), "{}", tables.stderr);
    let table = std::fs::read_to_string(folder.path().join("tables/robot.csv")).expect("a table");
    assert_eq!(table.lines().count(), robots.len() + 1);

    // What no sample rests on is not given away, and the rest replays.
    assert!(holds(&raw_bytes(&log.entries), CANARY), "the session keeps what came");
    let given = folder.path().join("given.mcap");
    let redacted = sidecarm(&["log", "redact", text(&live.log), "--out", text(&given)]);
    assert_eq!(redacted.code, Some(0), "{}", redacted.stderr);
    let entries = read_log(&given).expect("a log").entries;
    assert!(!holds(&raw_bytes(&entries), CANARY) && self::robots(&entries) == robots);
    assert!(!naming(&log.entries, "surgeon").is_empty(), "the control: a column is called so");
    assert_eq!(naming(&entries, "surgeon"), [""; 0]);
    let (_, found) = replay(&given, &lab.kit, &folder.path().join("given"));
    assert_eq!(count(&found, "poses_identical"), poses.len() as u64, "{found:#}");
    assert_eq!(count(&found, "samples_different"), 0, "{found:#}");
}

/// One object a line in a file, without clock and number, one line in twenty of them none.
#[test]
fn bad_lines_are_counted_shown_and_kept_and_what_cannot_be_known_is_said() {
    let Some(lab) = Lab::start_without_ct(&["--duration-s", "14", "--faults", "none", "--exposures", "0"]) else { return };
    std::fs::write(lab.kit.join("robot-lines.json"), shipped("generic-robot-json.json").to_string()).expect("written");
    let file = lab.kit.join("Zettelhuber.jsonl");
    std::fs::write(&file, "{\"yesterday\": true}\n").expect("written");
    let session = lab.session("lines.json", |session| {
        session["robot"]["port"] = json!("file:Zettelhuber.jsonl");
        session["robot"]["adapter"] = json!("robot-lines.json");
    });
    let out = lab.kit.with_file_name("session");
    let mut live = Live::launch(&session, &out, &["--seconds", "8"]);
    let mut lines = std::fs::OpenOptions::new().append(true).open(&file).expect("opens");
    let printer = Printer::start(&lab.kit.join("ttyROBOT"), move |nth, robot| {
        let joints = robot.sensed_deg.expect("the mock senses").map(f64::to_radians);
        let line = match nth % 20 {
            7 => format!("{{\"joints\": [{}, NaN, 0, 0, 0], \"stopped\": false}}\n", joints[0]),
            _ => json!({"joints": joints, "stopped": false}).to_string() + "\n",
        };
        lines.write_all(line.as_bytes()).expect("written");
    });
    let ended = eventually(HANG_S, || live.program.end(0.1));
    let said = live.stdout() + &live.stderr();
    assert_eq!(ended.and_then(|status| status.code()), Some(3), "{said}");
    assert!(printer.end() > 300);
    for words in ["corrupt lines", "no JSON object", "±15 ms", "cannot be known"] {
        assert!(said.contains(words), "{words}: {said}");
        assert!(live.report().contains(words), "{words} is not in the report");
    }
    let log = read_log(&live.log).expect("a log");
    let (robots, raw) = (robots(&log.entries), String::from_utf8(raw_bytes(&log.entries)).expect("text"));
    let (good, bad) =
        (raw.lines().filter(|line| !line.contains("NaN")).count(), raw.lines().filter(|line| line.contains("NaN")).count());
    assert!(robots.len() > 200 && bad > 10 && !raw.contains("yesterday"), "{} {bad}", robots.len());
    // The last line may lack its end.
    assert!(robots.len() == good || robots.len() + 1 == good, "{} of {good}", robots.len());
    assert_eq!(naming(&log.entries, "Zettelhuber"), [""; 0], "the name of a file");
    assert!(!live.report().contains("Zettelhuber"), "the name of a file");
    let (_, found) = replay(&live.log, &lab.kit, &out.with_file_name("again"));
    assert_eq!(count(&found, "samples_different"), 0, "{found:#}");
    assert!(found["session_losses"].to_string().contains("no JSON object"), "{found:#}");
}

#[test]
fn a_check_listens_to_lines_and_says_what_is_wrong_with_an_adapter() {
    let Some(lab) = Lab::start_without_ct(&["--kit-only", "--exposures", "0"]) else { return };
    let adapter = lab.kit.join("robot-lines.json");
    let port = free_udp_port();
    let session = lab.session("lines.json", |session| {
        session["carm"] = Value::Null;
        session["robot"]["port"] = json!(format!("udp://:{port}"));
        session["robot"]["adapter"] = json!("robot-lines.json");
    });
    let over = Arc::new(AtomicBool::new(false));
    let told = Arc::clone(&over);
    let sending = std::thread::spawn(move || {
        let sender = UdpSocket::bind((Ipv4Addr::LOCALHOST, 0)).expect("a socket");
        while !told.load(Ordering::Relaxed) {
            let line = json!({"joints": [0.01, 0.02, 0, 0, 0], "stopped": false, "commanded": ["x"]}).to_string();
            let _ = sender.send_to(line.as_bytes(), (Ipv4Addr::LOCALHOST, port));
            std::thread::sleep(Duration::from_millis(20));
        }
    });
    let checked = |declaration: &Value| {
        std::fs::write(&adapter, declaration.to_string()).expect("written");
        let ran = sidecarm(&["check", text(&session), "--json", "--limit", "300"]);
        let found = ran.json()["checks"].as_array().expect("a list").clone();
        move |check: &str| -> Vec<String> {
            found.iter().filter(|finding| finding["check"] == check).map(ToString::to_string).collect()
        }
    };
    let declaration = shipped("generic-robot-json.json");
    let found = checked(&declaration);
    assert!(found("robot port").len() == 1 && found("robot port")[0].contains("lines as declared"), "{:?}", found("robot port"));
    assert!(found("robot port")[0].contains("\"pass\"") && found("line adapter").len() == 2, "{:?}", found("line adapter"));
    let mut other = declaration.clone();
    other["robot"]["sensed_angles"][4]["from"] = json!("joints.5");
    let found = checked(&other)("robot port");
    assert!(found[0].contains("\"fail\"") && found[0].contains("robot.sensed_angles[4] is missing ('joints.5')"), "{found:?}");
    other["robot"]["sensed_angles"][4]["unit"] = json!("mm");
    let found = checked(&other)("session file");
    let words =
        "robot-lines.json: at robot.sensed_angles[4].unit: \\\"mm\\\" is no unit of an angle, expected one of deg, rad, mrad";
    assert!(found[0].contains("\"fail\"") && found[0].contains(words), "{found:?}");
    let found = checked(&shipped("generic-carm-regex.json"))("session file");
    assert!(found[0].contains("these are the lines of a C-arm"), "{found:?}");
    over.store(true, Ordering::Relaxed);
    sending.join().expect("it does not panic");
}
