//! A short session in real time, heard on both ports.

use mock_lab::delivery::Way;
use mock_lab::dialect::Dialect;
use mock_lab::fault::FaultKind;
use mock_lab::lab::{Device, Fault, Lab};
use mock_lab::play::{Performance, play};
use mock_lab::pty::Line;
use mock_lab::script::Script;

use crate::folder;
use crate::receiver::{Heard, hear, open, read_available};

/// Plays two seconds; what each port heard, and the events.
fn play_two_seconds(name: &str, faults: Vec<Fault>) -> (Heard, Heard, Vec<serde_json::Value>) {
    play_two_seconds_with(name, |performance| performance.faults = faults)
}

fn play_two_seconds_with(name: &str, change: impl FnOnce(&mut Performance)) -> (Heard, Heard, Vec<serde_json::Value>) {
    let folder = folder(name);
    let mut performance = Performance {
        await_reader_s: 0.0,
        await_all: false,
        start_delay_s: 0.0,
        idle_s: 0.0,
        linger_s: 0.0,
        rate: 1.0,
        idle_rate: 1.0,
        faults: Vec::new(),
        seed: 1,
        unplugged_s: None,
        stalled: 0.0,
        missing: 0.0,
        garbage: Vec::new(),
        dialects: Vec::new(),
        way: Way::Folder,
        oddities: Vec::new(),
        sent: None,
    };
    change(&mut performance);
    let lab = Lab::embedded().expect("embedded");
    let lines: Vec<(Device, Line)> = [Device::Carm, Device::Robot]
        .map(|device| (device, Line::open(&folder.join(device.name())).expect("pty")))
        .into_iter()
        .collect();
    let mut ports = [open(lines[0].1.path()), open(lines[1].1.path())];
    let player = std::thread::spawn(move || {
        let script = Script { lab: &lab, duration_s: 2.0, exposures: 1, counter: true };
        let mut events = Vec::new();
        play(&script, &performance, lines, &[], &mut |event| events.push(event)).expect("plays");
        events
    });
    let mut bytes = [Vec::new(), Vec::new()];
    while !player.is_finished() {
        for (port, bytes) in ports.iter_mut().zip(&mut bytes) {
            bytes.extend(read_available(port));
        }
        std::thread::sleep(std::time::Duration::from_millis(2));
    }
    for (port, bytes) in ports.iter_mut().zip(&mut bytes) {
        bytes.extend(read_available(port));
    }
    let events = player.join().expect("player");
    std::fs::remove_dir_all(folder).expect("removed");
    (hear(&bytes[0]), hear(&bytes[1]), events)
}

#[test]
fn a_session_sends_at_its_rates_and_shows_its_exposure() {
    let (carm, robot, events) = play_two_seconds("session", Vec::new());
    let count = |heard: &Heard, message: u8| heard.packets.iter().filter(|packet| packet.0 == message).count();
    assert_eq!((carm.corrupt, carm.lost, robot.corrupt, robot.lost), (0, 0, 0, 0));
    assert!((58..=61).contains(&count(&carm, 2)) && (2..=3).contains(&count(&carm, 3)), "{} C-arm packets", count(&carm, 2));
    assert!((198..=201).contains(&count(&robot, 1)) && count(&robot, 2) == 0, "{} robot packets", count(&robot, 1));
    let lit = carm.packets.iter().filter(|packet| packet.0 == 2 && packet.1 & 1 == 1);
    let counters: Vec<u8> = lit.map(|packet| packet.4[92]).collect();
    assert!((8..=10).contains(&counters.len()) && counters.iter().all(|counter| *counter == 1), "{counters:?}");
    // The robot's clock runs 60 ppm fast from an epoch of its own.
    let times: Vec<u64> = robot.packets.iter().filter(|packet| packet.0 == 1).map(|packet| packet.3).collect();
    assert_eq!(times[0], 9_876_543_210);
    assert_eq!(times[150] - times[0], 1_500_090);
    assert_eq!(events.last().expect("events")["event"], "finished");
}

#[test]
fn a_session_has_the_faults_that_were_asked_for() {
    let fault = |device, at, kind| Fault { device, at, kind };
    let faults = vec![
        fault(Device::Robot, 0.5, FaultKind::Flip),
        fault(Device::Robot, 0.6, FaultKind::Duplicate),
        fault(Device::Carm, 0.7, FaultKind::Drop),
    ];
    let (carm, robot, events) = play_two_seconds("faults", faults);
    assert_eq!((carm.corrupt, carm.lost, carm.duplicate), (0, 1, 0));
    assert_eq!((robot.corrupt, robot.lost, robot.duplicate), (1, 1, 1));
    assert_eq!(events.iter().filter(|event| event["event"] == "fault").count(), 3);
}

#[test]
fn half_of_the_packets_are_missing_and_the_list_of_those_sent_says_so() {
    let list = std::env::temp_dir().join(format!("mock-lab-{}-sent.csv", std::process::id()));
    let (carm, robot, events) = play_two_seconds_with("missing", |performance| {
        performance.missing = 0.5;
        // What a line holds when it is closed is gone.
        performance.linger_s = 0.3;
        performance.sent = Some(list.clone());
    });
    let sent = std::fs::read_to_string(&list).expect("the list");
    std::fs::remove_file(&list).expect("removed");
    let listed = |device: &str| sent.lines().filter(|line| line.split(',').nth(1) == Some(device)).count();
    assert_eq!((listed("carm"), listed("robot")), (carm.packets.len(), robot.packets.len()));
    assert!((70..=130).contains(&robot.packets.len()), "{} of about 202", robot.packets.len());
    let finished = events.last().expect("events");
    let (all, missing) = (&finished["sent"]["robot"]["packets"], &finished["sent"]["robot"]["missing"]);
    assert_eq!(all.as_u64(), missing.as_u64().map(|missing| missing + robot.packets.len() as u64), "{finished}");
}

#[test]
fn garbage_holds_no_packet() {
    let (carm, robot, _) = play_two_seconds_with("garbage", |performance| performance.garbage = vec![Device::Robot]);
    assert!(robot.packets.is_empty() && robot.corrupt > 0, "{} packets of garbage", robot.packets.len());
    assert!(carm.packets.len() > 50, "the other line is sound");
}

/// The bytes that a robot which prints lines sends in two seconds, and those of the arm beside it, which sends packets.
#[test]
fn a_device_that_prints_lines_prints_one_for_each_sample_and_the_other_sends_packets() {
    let list = std::env::temp_dir().join(format!("mock-lab-{}-lines.csv", std::process::id()));
    let (carm, robot, _) = play_two_seconds_with("lines", |performance| {
        performance.dialects = vec![(Device::Robot, Dialect::Csv)];
        performance.linger_s = 0.3;
        performance.sent = Some(list.clone());
    });
    let sent = std::fs::read_to_string(&list).expect("the list");
    std::fs::remove_file(&list).expect("removed");
    let numbers: Vec<u32> = sent
        .lines()
        .map(|line| line.split(',').collect::<Vec<_>>())
        .filter(|fields| fields[1] == "robot")
        .map(|fields| fields[2].parse().expect("a number"))
        .collect();
    assert!((198..=201).contains(&numbers.len()) && numbers.iter().zip(0..).all(|(found, due)| *found == due), "{numbers:?}");
    // No zero ends anything on that line: all of it is one piece that is no packet.
    assert!(robot.packets.is_empty() && robot.corrupt == 1, "{} packets, {} corrupt", robot.packets.len(), robot.corrupt);
    assert!(carm.packets.len() > 50 && carm.corrupt == 0, "the arm sends packets");
}

#[test]
fn exposures_repeated_come_round_after_round() {
    let once = Lab::embedded().expect("embedded");
    let thrice = once.clone().repeated(3);
    assert_eq!(thrice.exposures.len(), 3 * once.exposures.len());
    assert!(thrice.exposures.windows(2).all(|pair| pair[0].at < pair[1].at));
    assert_eq!(thrice.exposures[once.exposures.len()].orbital_deg, once.exposures[0].orbital_deg);
}
