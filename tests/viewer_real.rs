//! A real window, on a screen of its own: it opens, shows something, is quiet, and goes when it is told to.
#![cfg(all(feature = "viewer", target_os = "linux"))]

use std::collections::BTreeSet;
use std::io::Read;
use std::ops::Range;
use std::os::unix::fs::FileExt;
use std::path::Path;
use std::process::{Child, Command, Stdio};
use std::time::Duration;

use serde_json::Value;
use sidecarm::image::Image;

use crate::live_lab::{HANG_S, Lab, Live, Running, Signal, deliver, eventually, quiet_lab};
use crate::log_lab::recorded;

/// A screen without a monitor.
pub struct Screen {
    server: Child,
    /// As programs are told it, `:7`.
    pub display: String,
    /// Holds what the screen shows, as XWD.
    folder: tempfile::TempDir,
}

impl Screen {
    /// `None` (said) where there is no Xvfb.
    pub fn open() -> Option<Self> {
        let folder = tempfile::tempdir().expect("temporary folder");
        let mut command = Command::new("Xvfb");
        // The server chooses a free number and says it; what it shows lies in a file.
        command.args(["-displayfd", "1", "-screen", "0", "1400x900x24", "-nolisten", "tcp", "-fbdir"]).arg(folder.path());
        let server = command.stdin(Stdio::null()).stdout(Stdio::piped()).stderr(Stdio::null()).spawn();
        let Ok(mut server) = server else {
            println!("skipped: no Xvfb on this machine; scripts/install --tests installs it");
            return None;
        };
        let mut told = server.stdout.take().expect("piped");
        let mut number = Vec::new();
        let mut byte = [0];
        while told.read(&mut byte).is_ok_and(|read| read == 1) && byte[0] != b'\n' {
            number.push(byte[0]);
        }
        let number = String::from_utf8(number).expect("a number");
        assert!(!number.is_empty(), "Xvfb says its display");
        Some(Self { server, display: format!(":{number}"), folder })
    }

    /// What a measurement needs.
    pub fn required() -> Self {
        Self::open().expect("Xvfb; scripts/install --tests installs it")
    }

    /// Where the pixels begin in the screen's file, its columns and rows, and bytes a row.
    fn layout(head: &[u8]) -> [usize; 4] {
        let word = |at: usize| u32::from_be_bytes(head[4 * at..][..4].try_into().expect("four bytes")) as usize;
        // XWD: size of the header, then (from the 4th word) depth, columns, rows; bytes a row; colours of 12 bytes behind the header.
        [word(0) + 12 * word(19), word(4), word(5), word(12)]
    }

    /// The bytes of a part of the screen, read quickly.
    pub fn part(&self, columns: Range<usize>, rows: Range<usize>) -> Vec<u8> {
        let file = std::fs::File::open(self.folder.path().join("Xvfb_screen0")).expect("the screen's file");
        let mut head = [0; 80];
        file.read_exact_at(&mut head, 0).expect("a header");
        let [from, _, _, row_bytes] = Self::layout(&head);
        let mut bytes = vec![0; 4 * columns.len() * rows.len()];
        for (row, part) in rows.zip(bytes.chunks_exact_mut(4 * columns.len())) {
            file.read_exact_at(part, (from + row * row_bytes + 4 * columns.start) as u64).expect("within the screen");
        }
        bytes
    }

    /// What is on the screen.
    pub fn picture(&self) -> Image<[u8; 3]> {
        let bytes = std::fs::read(self.folder.path().join("Xvfb_screen0")).expect("the screen's file");
        let [from, columns, rows, row_bytes] = Self::layout(&bytes);
        let pixels = (0..rows).flat_map(|row| bytes[from + row * row_bytes..][..4 * columns].chunks_exact(4));
        // Blue comes first.
        let pixels = pixels.map(|pixel| [pixel[2], pixel[1], pixel[0]]).collect();
        Image::from_pixels(columns, rows, pixels).expect("as large as its header says")
    }

    /// Different colours on the screen, and the share of pixels that are not black.
    fn look(&self) -> (usize, f64) {
        let picture = self.picture();
        let lit = picture.pixels.iter().filter(|pixel| pixel.iter().any(|channel| *channel > 4)).count();
        let seen: BTreeSet<_> = picture.pixels.iter().collect();
        (seen.len(), lit as f64 / picture.pixels.len() as f64)
    }

    /// Different grays on the screen. The window's own colours are no grays.
    fn grays(&self) -> usize {
        let picture = self.picture();
        let grays = picture.pixels.iter().filter(|[red, green, blue]| red == green && green == blue);
        grays.collect::<BTreeSet<_>>().len()
    }
}

/// Replays `log` in a window on `screen`.
pub fn window_of_replay(log: &Path, args: &[&str], screen: &Screen) -> Running {
    let mut command = Command::new(env!("CARGO_BIN_EXE_sidecarm"));
    command.arg("replay").arg(log).arg("--window").args(args).env("DISPLAY", &screen.display);
    command.env_remove("WAYLAND_DISPLAY").env_remove("WAYLAND_SOCKET");
    Running(command.stdin(Stdio::null()).stdout(Stdio::null()).stderr(Stdio::null()).spawn().expect("the program starts"))
}

impl Drop for Screen {
    fn drop(&mut self) {
        let _ = self.server.kill();
        let _ = self.server.wait();
    }
}

/// Grays on a screen that shows a radiograph.
const RADIOGRAPH: usize = 100;

/// `sidecarm live` in a window shows the exposure, and goes with SIGTERM: log and report complete, exit code 0.
#[test]
fn a_live_window_shows_the_exposure_and_goes_when_it_is_told_to() {
    let Some(screen) = Screen::open() else { return };
    let Some((lab, frame, folder)) = quiet_lab("120") else { return };
    let mut live = Live::windowed(&lab.kit.join("session.json"), &folder.path().join("session"), &screen.display);
    let opened = eventually(HANG_S, || (screen.look().1 > 0.5).then_some(()));
    assert!(opened.is_some(), "no window: {}", live.stderr());
    let (before, _) = screen.look();
    let grays = screen.grays();
    assert!(grays < RADIOGRAPH, "{grays} grays in a window without a radiograph");
    deliver(&[frame], &lab);
    // A radiograph has more grays than a window without one.
    let shown = eventually(HANG_S, || Some(screen.look().0).filter(|colours| *colours > before + 100));
    assert!(shown.is_some(), "no picture: {:?} after {before}: {}", screen.look(), live.stderr());
    live.program.signal(Signal::TERM);
    let status = live.program.end(HANG_S).unwrap_or_else(|| panic!("still there: {}", live.stderr()));
    assert!(live.lacks_exposures_alone(status.code()), "{} {}", live.stderr(), live.stdout());
    assert!(live.report().contains("</html>") && live.pairs() == 1, "{}", live.stderr());
}

/// `sidecarm replay --window` shows the exposures of its log, and goes on to show them when all are replayed.
#[test]
fn a_window_of_a_replay_shows_exposures_and_stays() {
    let Some(screen) = Screen::open() else { return };
    let Some(session) = recorded() else { return };
    let folder = tempfile::tempdir().expect("temporary folder");
    let out = folder.path().join("replayed");
    let [out, kit] = [&out, &session.kit].map(|path| path.to_str().expect("paths of tests are UTF-8"));
    let mut window = window_of_replay(&session.logs[1], &["--data", kit, "--out", out], &screen);
    let report = Path::new(out).join("report.html");
    let is_whole = || std::fs::read_to_string(&report).is_ok_and(|page| page.contains("</html>"));
    assert!(eventually(HANG_S, || is_whole().then_some(())).is_some(), "no report: {:?}", window.0.try_wait());
    let shown = eventually(HANG_S, || (screen.grays() > RADIOGRAPH).then_some(()));
    assert!(shown.is_some(), "no picture: {} grays, {:?}", screen.grays(), window.0.try_wait());
    assert_eq!(window.0.try_wait().expect("a child can be asked"), None, "the window is still there");
}

/// A session that could not start left an empty window, and its reason unsaid until that was closed.
#[test]
fn a_session_that_cannot_start_leaves_no_window() {
    let Some(screen) = Screen::open() else { return };
    let Some(lab) = Lab::start(&["--kit-only"]) else { return };
    let out = lab.kit.join("taken");
    std::fs::create_dir_all(&out).expect("a folder");
    std::fs::write(out.join("session.mcap"), "a log").expect("written");
    let mut live = Live::launch_windowed(&lab.kit.join("session.json"), &out, &screen.display);
    let status = live.program.end(HANG_S).unwrap_or_else(|| panic!("the window is still there: {}", live.stderr()));
    assert_eq!(status.code(), Some(1), "{}", live.stderr());
    assert!(live.stderr().contains("there is a session in this folder already"), "{}", live.stderr());
}

/// Waits for the session's newest pair to be so, and to have its null where it has a DRR.
pub fn newest(live: &Live, is_so: impl Fn(&Value) -> bool) -> Value {
    let found = eventually(HANG_S, || {
        let bytes = std::fs::read(live.out.join("pairs.json")).unwrap_or_default();
        let value: Value = serde_json::from_slice(&bytes).unwrap_or_default();
        let pair = value["pairs"].as_array()?.last()?.clone();
        let is_complete = pair["drr"].is_null() || pair["null"].as_object().is_some_and(|null| !null.is_empty());
        (is_complete && is_so(&pair)).then_some(pair)
    });
    found.unwrap_or_else(|| panic!("no such pair: {}", live.stderr()))
}

/// Time that a process has used, in seconds.
pub fn used_s(id: u32) -> f64 {
    let stat = std::fs::read_to_string(Path::new("/proc").join(id.to_string()).join("stat")).unwrap_or_default();
    let after = stat.rsplit_once(')').map_or("", |(_, after)| after);
    let ticks = |field: usize| after.split_whitespace().nth(field).and_then(|word| word.parse::<f64>().ok()).unwrap_or(0.0);
    (ticks(11) + ticks(12)) / 100.0
}

/// Share of a core that a session in a window may take while nothing happens, on a machine that does nothing else.
const MOST_IDLE: f64 = 0.05;

/// How much of a core the window of a live session takes while nothing happens, beside the same session without one.
#[test]
#[ignore = "a minute, on a machine that does nothing else: scripts/evaluate window runs it"]
fn what_an_idle_window_costs() {
    let screen = Screen::required();
    let Some((lab, frame, folder)) = quiet_lab("300") else { return };
    let mut shares = Vec::new();
    for windowed in [false, true] {
        let out = folder.path().join(format!("session-{windowed}"));
        let session = lab.kit.join("session.json");
        let live = if windowed { Live::windowed(&session, &out, &screen.display) } else { Live::start(&session, &out, &[]) };
        let copy = folder.path().join(format!("{windowed}.dcm"));
        std::fs::copy(&frame, &copy).expect("copied");
        deliver(&[copy], &lab);
        let done = eventually(HANG_S, || (live.pairs() == 1).then_some(()));
        assert!(done.is_some(), "{}", live.stderr());
        std::thread::sleep(Duration::from_secs(20));
        let (id, before_s) = (live.program.id(), used_s(live.program.id()));
        std::thread::sleep(Duration::from_secs(20));
        shares.push((used_s(id) - before_s) / 20.0);
    }
    println!("idle: {:.1} % of a core without a window, {:.1} % with one", 100.0 * shares[0], 100.0 * shares[1]);
    assert!(shares[1] <= MOST_IDLE, "{:.1} % of a core, {:.0} % allowed", 100.0 * shares[1], 100.0 * MOST_IDLE);
}
