//! Ten hours in minutes: telemetry and exposures come faster than in a lab, and memory is sampled all the while.
//!
//! `scripts/evaluate soak [HOURS] [SPEED]`: packets at SPEED times their rate, thirty frames for every hour. What is bounded by time of
//! day (retention in seconds) is not sped up, what is bounded by numbers of packets, exposures and frames is.
#![cfg(target_os = "linux")]

use std::time::Duration;

use sidecarm::time::{Stopwatch, host_now_us};

use crate::live_lab::{Lab, Live, Signal};

/// Resident memory of a process in MiB.
fn resident_mib(pid: u32) -> Option<f64> {
    let status = std::fs::read_to_string(format!("/proc/{pid}/status")).ok()?;
    let line = status.lines().find_map(|line| line.strip_prefix("VmRSS:"))?;
    line.split_whitespace().next()?.parse::<f64>().ok().map(|kib| kib / 1024.0)
}

/// Seconds, MiB of memory, bytes of log.
type Sample = (f64, f64, u64);

fn mean_mib(curve: &[Sample], from: f64, to: f64) -> f64 {
    let part: Vec<f64> =
        curve[(curve.len() as f64 * from) as usize..(curve.len() as f64 * to) as usize].iter().map(|s| s.1).collect();
    part.iter().sum::<f64>() / part.len() as f64
}

/// Whether memory still grows in the second half: the last quarter against the second.
fn still_grows(curve: &[Sample]) -> bool {
    let (second, last) = (mean_mib(curve, 0.25, 0.5), mean_mib(curve, 0.75, 1.0));
    !(last <= 1.2 * second + 32.0)
}

#[test]
#[ignore = "minutes to hours long: scripts/evaluate soak runs it"]
fn memory_stays_bounded_over_hours() {
    let number = |name: &str, default: f64| std::env::var(name).ok().and_then(|text| text.parse().ok()).unwrap_or(default);
    let (hours, speed) = (number("SIDECARM_SOAK_HOURS", 10.0), number("SIDECARM_SOAK_SPEED", 100.0));
    let seconds = (hours * 3600.0 / speed).max(10.0);
    // Eight exposures a round, thirty an hour; a round takes at least six seconds, so that exposures do not overlap.
    let rounds = (hours * 30.0 / 8.0).min(seconds / 6.0).max(1.0) as usize;
    let (duration, repeat, rate) = (seconds.to_string(), rounds.to_string(), speed.to_string());
    let panel = std::env::var("SIDECARM_SOAK_PANEL").ok();
    let mut args = vec!["--duration-s", &duration, "--repeat", &repeat, "--rate", &rate, "--faults", "none", "--linger-s", "5"];
    if let Some(panel) = &panel {
        args.extend(["--panel-px", panel]);
    }
    let Some(lab) = Lab::start(&args) else { return };
    let mut live = Live::start(&lab.kit.join("session.json"), &lab.kit.with_file_name("session"), &[]);
    let watch = Stopwatch::start();
    let mut curve: Vec<Sample> = Vec::new();
    while watch.ms() < (seconds - 3.0).max(5.0) * 1e3 {
        let log_bytes = std::fs::metadata(&live.log).map_or(0, |found| found.len());
        let mib = resident_mib(live.program.id()).unwrap_or_else(|| panic!("the session ended: {}", live.stderr()));
        curve.push((watch.ms() * 1e-3, mib, log_bytes));
        std::thread::sleep(Duration::from_millis(500));
    }
    let signal_us = host_now_us();
    live.program.signal(Signal::INT);
    // Large frames wait for their DRRs: each takes seconds, and telemetry no longer comes.
    let status = live.program.end(300.0 + 8.0 * 8.0 * rounds as f64).unwrap_or_else(|| panic!("hangs: {}", live.stderr()));
    let rows: String = curve.iter().map(|(s, mib, bytes)| format!("{s:.1},{mib:.1},{bytes}\n")).collect();
    let csv = format!("seconds,resident_mib,log_bytes\n{rows}");
    let path = std::env::var("SIDECARM_SOAK_CSV").unwrap_or_else(|_| "target/soak.csv".to_owned());
    std::fs::write(&path, csv).expect("written");
    println!("{hours} h at {speed}x: {seconds:.0} s, {} exposures; memory over time ({path}):", rounds * 8);
    curve.iter().step_by((curve.len() / 16).max(1)).for_each(|(s, mib, bytes)| {
        println!("  {s:7.1} s {mib:8.1} MiB, log {:8.1} MB", *bytes as f64 * 1e-6);
    });
    let heard = live.heard();
    let missing = heard.missing(&lab.sent(), live.recording_us, signal_us);
    println!("{} of {} packets lost, {} frames in the log, exit {:?}", missing.lost, missing.sent, heard.images, status.code());
    assert!(curve.len() > 8 && missing.sent > 1000, "{missing:?}");
    assert!(!still_grows(&curve), "memory grows: {:.0} then {:.0} MiB", mean_mib(&curve, 0.25, 0.5), mean_mib(&curve, 0.75, 1.0));
    // A pseudo-terminal holds twelve thousand bytes: nothing at the rate of a lab, ten milliseconds at a hundred times that.
    assert!(missing.lost as f64 <= 2e-3 * missing.sent as f64, "{missing:?}");
    assert_eq!(status.code(), Some(if missing.lost == 0 { 0 } else { 3 }), "what is lost is said: {}", live.stdout());
}

/// The control: a leak is seen, a plateau is none.
#[test]
fn a_leak_is_seen() {
    let curve = |growth: f64| -> Vec<Sample> { (0..100).map(|i| (f64::from(i), 300.0 + growth * f64::from(i), 0)).collect() };
    assert!(still_grows(&curve(4.0)));
    assert!(!still_grows(&curve(0.1)));
    assert!(still_grows(&[(0.0, f64::NAN, 0); 8]), "NaN is no proof");
}
