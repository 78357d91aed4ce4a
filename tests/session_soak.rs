//! Ten hours in minutes: telemetry and exposures come faster than in a lab, and memory is sampled all the while, then that of a replay.
//!
//! `scripts/evaluate soak [HOURS] [SPEED]`: packets at SPEED times their rate, thirty frames for every hour. What is bounded by time of
//! day (retention in seconds) is not sped up, what is bounded by numbers of packets, exposures and frames is; so is how long free memory is kept.
#![cfg(target_os = "linux")]

use std::path::Path;
use std::process::{Command, ExitStatus, Stdio};
use std::time::Duration;

use sidecarm::time::{Stopwatch, host_now_us};

use crate::live_lab::{HANG_S, Lab, Live, Signal, eventually, keeper};

/// Memory of a process in MiB: `VmRSS` is what is resident, `VmHWM` the most that ever was.
fn memory_mib(pid: u32, key: &str) -> Option<f64> {
    let status = std::fs::read_to_string(format!("/proc/{pid}/status")).ok()?;
    let line = status.lines().find_map(|line| line.strip_prefix(key)?.strip_prefix(':'))?;
    line.split_whitespace().next()?.parse::<f64>().ok().map(|kib| kib / 1024.0)
}

/// The processes that a process has started: for a session the one that writes its log, and those that read foreign files.
fn started_by(parent: u32) -> Vec<u32> {
    let found = std::fs::read_dir("/proc").into_iter().flatten().flatten().filter_map(|entry| {
        let pid = entry.file_name().to_str()?.parse().ok()?;
        let stat = std::fs::read_to_string(entry.path().join("stat")).ok()?;
        // Behind the name in parentheses: state, then the parent.
        let of: u32 = stat.rsplit_once(") ")?.1.split(' ').nth(1)?.parse().ok()?;
        (of == parent).then_some(pid)
    });
    found.collect()
}

/// Resident memory of a session in MiB, with that of the processes that it has started. Pages that they share count for each: what is said
/// is never too little.
fn resident_mib(pid: u32) -> Option<f64> {
    let own = memory_mib(pid, "VmRSS")?;
    // One that has just ended has none.
    Some(own + started_by(pid).into_iter().filter_map(|child| memory_mib(child, "VmRSS")).sum::<f64>())
}

/// Replays a log; how that ended, unless it hangs, and the most memory that it took, in MiB.
fn replayed(log: &Path, out: &Path, limit_s: f64) -> (Option<ExitStatus>, f64) {
    let mut command = Command::new(env!("CARGO_BIN_EXE_sidecarm"));
    command.arg("replay").arg(log).arg("--out").arg(out).stdout(Stdio::null()).stderr(Stdio::null());
    let mut replay = command.spawn().expect("the program starts");
    let mut peak_mib = 0.0f64;
    let ended = eventually(limit_s, || {
        // The system keeps the highest: a peak between two looks is not missed.
        peak_mib = peak_mib.max(memory_mib(replay.id(), "VmHWM").unwrap_or(0.0));
        replay.try_wait().expect("a child can be asked")
    });
    if ended.is_none() {
        let _ = replay.kill();
    }
    replay.wait().expect("it has ended");
    (ended, peak_mib)
}

/// What a replay may take beyond its session, MiB. It reads the log message by message, so that nothing in it grows with the log; but it goes
/// as fast as it can, where a session waits for exposures: six frames wait for their DRR and six pairs to be written, all the time, each of
/// the frame, its DRR, that of the log and the strip, 9 MB apiece at the size of a panel. A replay that holds the log of hours has gigabytes.
const REPLAY_MORE_MIB: f64 = 512.0;

/// Seconds, MiB of memory, bytes of log.
type Sample = (f64, f64, u64);

/// MiB of a picture of the live size.
const PICTURE_MIB: f64 = mib_of(620.0 * 480.0);
/// What memory may grow by with each frame, of a picture. Rows of the report, places of beads and samples of telemetry are kept to the end; a
/// picture that is held for every frame, or for every tenth, is none of them.
const GROWTH: f64 = 0.1;
/// The most that a session may take, MiB: the program, the specimen and what is kept of telemetry; and how many pictures besides.
const MOST_MIB: f64 = 2048.0;
const MOST_PICTURES: f64 = 64.0;
/// What a session lets the allocator keep free memory, ms (`src/cli/live.rs`). A run at many times the rate must be as short of it as the hours
/// that it stands for: memory that nobody gives back tells nothing of what is held.
const KEPT_MS: f64 = 600_000.0;

const fn mib_of(pixels: f64) -> f64 {
    pixels * size_of::<f32>() as f64 / (1 << 20) as f64
}

/// MiB per second of the line through the second half of a curve, by least squares.
fn slope_mib_per_s(curve: &[Sample]) -> f64 {
    let half = &curve[curve.len() / 2..];
    let mean = |of: fn(&Sample) -> f64| half.iter().map(of).sum::<f64>() / half.len() as f64;
    let (mean_s, mean_mib) = (mean(|sample| sample.0), mean(|sample| sample.1));
    let together: f64 = half.iter().map(|(s, mib, _)| (s - mean_s) * (mib - mean_mib)).sum();
    together / half.iter().map(|(s, ..)| (s - mean_s).powi(2)).sum::<f64>()
}

/// Whether memory grows by more with each frame than it may.
fn still_grows(mib_per_frame: f64, picture_mib: f64) -> bool {
    !(mib_per_frame <= GROWTH * picture_mib)
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
    let kept_ms = format!("{:.0}", KEPT_MS / speed);
    let out = lab.kit.with_file_name("session");
    let live = Live::launch_told(&lab.kit.join("session.json"), &out, ("MIMALLOC_PURGE_DELAY", &kept_ms));
    let mut live = live.recording();
    let watch = Stopwatch::start();
    let writes_log = keeper(&live.log).expect("the log has its keeper").as_raw_nonzero().get();
    assert!(started_by(live.program.id()).iter().any(|pid| i64::from(*pid) == i64::from(writes_log)), "the keeper is counted");
    let mut curve: Vec<Sample> = Vec::new();
    let mut peak_mib = 0.0f64;
    while watch.ms() < (seconds - 3.0).max(5.0) * 1e3 {
        let log_bytes = std::fs::metadata(&live.log).map_or(0, |found| found.len());
        let mib = resident_mib(live.program.id()).unwrap_or_else(|| panic!("the session ended: {}", live.stderr()));
        curve.push((watch.ms() * 1e-3, mib, log_bytes));
        peak_mib = peak_mib.max(mib).max(memory_mib(live.program.id(), "VmHWM").unwrap_or(0.0));
        std::thread::sleep(Duration::from_millis(500));
    }
    let signal_us = host_now_us();
    live.program.signal(Signal::INT);
    // Large frames wait for their DRRs: each takes seconds, and telemetry no longer comes.
    let finishing_s = 300.0 + 8.0 * 8.0 * rounds as f64;
    let status = live.program.end(finishing_s).unwrap_or_else(|| panic!("hangs: {}", live.stderr()));
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
    let edge_px = panel.as_ref().map(|edge| edge.parse::<f64>().expect("pixels"));
    let picture_mib = edge_px.map_or(PICTURE_MIB, |edge_px| mib_of(edge_px * edge_px));
    let frames_per_s = 8.0 * rounds as f64 / seconds;
    let (mib_per_frame, most_mib) = (slope_mib_per_s(&curve) / frames_per_s, MOST_MIB + MOST_PICTURES * picture_mib);
    println!(
        "second half: {mib_per_frame:+.4} MiB a frame ({:.4} allowed, a picture has {picture_mib:.2}); at most {peak_mib:.0} MiB ({most_mib:.0} \
         allowed); free memory is kept for {kept_ms} ms",
        GROWTH * picture_mib
    );
    assert!(!still_grows(mib_per_frame, picture_mib), "memory grows by {mib_per_frame:.4} MiB with each frame");
    assert!(peak_mib <= most_mib, "{peak_mib:.0} MiB, {most_mib:.0} allowed");
    // A pseudo-terminal holds twelve thousand bytes: nothing at the rate of a lab, ten milliseconds at a hundred times that.
    assert!(missing.lost as f64 <= 2e-3 * missing.sent as f64, "{missing:?}");
    assert_eq!(status.code(), Some(if missing.lost == 0 { 0 } else { 3 }), "what is lost is said: {}", live.stdout());

    let (ended, replay_mib) = replayed(&live.log, &lab.kit.with_file_name("again"), seconds + finishing_s);
    println!("memory at most: {peak_mib:.0} MiB of the session, {replay_mib:.0} MiB of the replay of its log ({ended:?})");
    assert!(ended.is_some_and(|status| matches!(status.code(), Some(0 | 3))), "the replay: {ended:?}");
    assert!(replay_mib > 1.0 && peak_mib > 1.0, "both were looked at");
    assert!(replay_mib <= peak_mib + REPLAY_MORE_MIB, "a replay takes {replay_mib:.0} MiB, its session took {peak_mib:.0} MiB");
}

/// The control: a leak is seen, a plateau is none, however memory comes and goes. Between quarters of a curve, nearly two pictures a frame are not
/// told from none where a session takes a gigabyte.
#[test]
fn a_leak_is_seen() {
    // Six minutes with a frame every 1.2 s; memory fills up in the first of them.
    let frames_per_s = 1.0 / 1.2;
    let curve = |mib_per_frame: f64| -> Vec<Sample> {
        let filled = |s: f64| 1200.0 * (1.0 - (-s / 20.0).exp());
        let swings = |n: i32| 15.0 * f64::from(n % 11 - 5);
        (0..720)
            .map(|n| (n, 0.5 * f64::from(n)))
            .map(|(n, s)| (s, filled(s) + swings(n) + mib_per_frame * frames_per_s * s, 0))
            .collect()
    };
    let grows = |mib_per_frame: f64| still_grows(slope_mib_per_s(&curve(mib_per_frame)) / frames_per_s, PICTURE_MIB);
    for leak_mib in [1.9, PICTURE_MIB, 0.25 * PICTURE_MIB] {
        assert!(grows(leak_mib), "{leak_mib} MiB a frame");
    }
    assert!(!grows(0.0) && !grows(0.02), "a plateau, and rows of a report");
    let found = slope_mib_per_s(&curve(0.3)) / frames_per_s;
    assert!((found - 0.3).abs() < 0.05, "{found} MiB a frame");
    assert!(still_grows(slope_mib_per_s(&[(0.0, f64::NAN, 0); 8]), PICTURE_MIB), "NaN is no proof");
    assert!((PICTURE_MIB - 1.135).abs() < 1e-3, "620 x 480 of f32");
}

/// The control: what a process that was started takes is counted with the one that started it.
#[test]
fn memory_of_what_a_process_has_started_is_counted() {
    let mut command = Command::new("sh");
    let mut shell = command.args(["-c", "cat; true"]).stdin(Stdio::piped()).stdout(Stdio::null()).spawn().expect("a shell");
    let started = eventually(HANG_S, || started_by(shell.id()).into_iter().find_map(|child| memory_mib(child, "VmRSS")));
    let (own, both) = (memory_mib(shell.id(), "VmRSS"), resident_mib(shell.id()));
    // Its input ends, and so does what it has started.
    shell.wait().expect("it has ended");
    assert!(started.is_some_and(|mib| mib > 0.0), "{started:?}");
    assert!(own.is_some() && both > own, "{own:?} of it, {both:?} of both");
    assert!(memory_mib(std::process::id(), "VmHWM").is_some_and(|mib| mib > 1.0), "the highest is known");
}
