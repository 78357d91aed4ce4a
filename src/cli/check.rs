//! `sidecarm check`: everything that a session needs, before the session.

use std::path::{Path, PathBuf};
use std::sync::mpsc::{RecvTimeoutError, Sender, channel};
use std::time::Duration;

use super::line_checks::{CheckFile, CheckLine, CheckList, FileCheck, check_lines};
use super::signals::on_signals;
use crate::beads::{BeadLayout, parse_markups};
use crate::gpu::DeviceChoice;
use crate::render::Renderer;
use crate::reporter::Reporter;
use crate::scene::{self, Scene};
use crate::session::Stop;
use crate::session::crosscheck::{Finding, Level, check_disk, check_listened, check_ports, check_session, check_video, refusal};
use crate::session::file::{SessionFileError, Setup};
use crate::session::inputs::InputNames;
use crate::session::newest::check_newest;
use crate::session::rehearsal::rehearse;
use crate::time::Stopwatch;

/// Check a session before it starts: ports, files, beads, units, disk, the newest frame that is there, and one synthetic exposure through the
/// whole path.
///
/// A line per check: pass, warn or fail, with what to do. Exit code 0 when nothing failed, else 1. Ports are only listened to, and nothing is
/// written but what is removed again.
#[derive(Clone, Debug, clap::Args)]
#[command(after_help = "Example:\n  sidecarm check session.json && sidecarm live session.json --out run-1")]
pub struct CheckArgs {
    /// The session file.
    pub session: PathBuf,
    /// Folder of the session to come; the session file's `out` when absent.
    #[arg(long)]
    pub out: Option<PathBuf>,
    /// Give up after this many seconds, and say what was found until then; a large CT takes longer.
    #[arg(long, value_name = "S", default_value_t = LIMIT_S)]
    pub limit: f64,
    /// Print JSON.
    #[arg(long)]
    pub json: bool,
}

/// Default of `--limit`.
pub const LIMIT_S: f64 = 20.0;

/// How often whoever waits for a finding looks whether it is all over.
const LOOK: Duration = Duration::from_millis(50);
/// A check that nobody waits for any more may still write into the folder that is removed: it is tried so often, [`LOOK`] apart.
const TRIES: u32 = 20;

/// How the checks ended.
enum End {
    Done,
    Late,
    Interrupted,
}

/// Runs all checks; the exit code. Temporary files lie in one folder, which is removed however the checks end: a thread that is still at work then
/// removes nothing.
pub fn run(args: &CheckArgs, reporter: &Reporter) -> u8 {
    let stop = Stop::default();
    let asked = stop.clone();
    on_signals(move |_| _ = asked.ask());
    let mut findings = Vec::new();
    let scratch = tempfile::Builder::new().prefix("sidecarm-check-").tempdir();
    // Where there is none, each check that wants one says so.
    let within = scratch.as_ref().map_or_else(|_| std::env::temp_dir(), |scratch| scratch.path().to_owned());
    let (sender, inbox) = channel();
    let (for_thread, args_of_thread) = (reporter.clone(), args.clone());
    let worker = std::thread::spawn(move || work(&args_of_thread, &within, &for_thread, &sender));
    let watch = Stopwatch::start();
    let end = loop {
        // NaN is no time at all.
        let left_s = (args.limit - watch.ms() * 1e-3).max(0.0);
        let left = Duration::try_from_secs_f64(left_s).unwrap_or(Duration::MAX);
        match inbox.recv_timeout(left.min(LOOK)) {
            Ok(finding) => take(finding, args.json, &mut findings),
            Err(RecvTimeoutError::Timeout) if stop.is_asked() => break End::Interrupted,
            Err(RecvTimeoutError::Timeout) if left <= LOOK => break End::Late,
            Err(RecvTimeoutError::Timeout) => {}
            Err(RecvTimeoutError::Disconnected) => break End::Done,
        }
    };
    let left = match end {
        End::Done => {
            let fault = || Finding::fail("check", "a check ended unexpectedly", "report this with the session's files");
            worker.join().err().map(|_| fault())
        }
        End::Late => {
            let detail = format!("not all checks were done within {} s", args.limit);
            Some(Finding::warn("time", detail, "give it longer with --limit; a session starts as late"))
        }
        End::Interrupted => Some(Finding::fail("check", "it was ended before all checks were done", "run it again")),
    };
    left.into_iter().chain(scratch.ok().and_then(removed)).for_each(|finding| take(finding, args.json, &mut findings));
    let count = |level: Level| findings.iter().filter(|finding| finding.level == level).count();
    let (passed, warned, failed) = (count(Level::Pass), count(Level::Warn), count(Level::Fail));
    if args.json {
        println!("{}", serde_json::json!({ "checks": findings, "ok": failed == 0 }));
    } else {
        println!("{passed} passed, {warned} warned, {failed} failed");
    }
    u8::from(failed > 0)
}

/// Removes the temporary folder; a finding where that does not do.
fn removed(scratch: tempfile::TempDir) -> Option<Finding> {
    let folder = scratch.keep();
    let mut error = std::fs::remove_dir_all(&folder).err()?;
    for _ in 1..TRIES {
        if error.kind() == std::io::ErrorKind::NotFound {
            return None;
        }
        std::thread::sleep(LOOK);
        error = std::fs::remove_dir_all(&folder).err()?;
    }
    let detail = format!("temporary files are left in {}: {error}", folder.display());
    Some(Finding::warn("temporary folder", detail, "remove that folder"))
}

fn take(finding: Finding, json: bool, findings: &mut Vec<Finding>) {
    if !json {
        let verdict = match finding.level {
            Level::Pass => "pass",
            Level::Warn => "warn",
            Level::Fail => "FAIL",
        };
        println!("{verdict}  {:<20} {}", finding.check, finding.detail);
        if let Some(remedy) = &finding.remedy {
            println!("      {:<20} → {remedy}", "");
        }
    }
    findings.push(finding);
}

/// What has been loaded so far.
struct Loaded {
    setup: Setup,
    scene: Option<Scene>,
    layout: Option<BeadLayout>,
}

/// Tells what was found, under the names that may be shown: folders and files are called after persons more often than not. What the session
/// file itself is wrong in is said as it was typed.
struct Teller<'a> {
    found: &'a Sender<Finding>,
    names: InputNames,
}

impl Teller<'_> {
    fn tell(&self, finding: Finding) {
        let remedy = finding.remedy.as_deref().map(|remedy| self.names.hide(remedy));
        let detail = self.names.hide(&finding.detail);
        // Whoever asked may have given up waiting; what is found then is nobody's.
        drop(self.found.send(Finding { detail, remedy, ..finding }));
    }

    fn tell_all(&self, findings: impl IntoIterator<Item = Finding>) {
        findings.into_iter().for_each(|finding| self.tell(finding));
    }
}

/// All checks, one after the other; temporary folders are made in `within`.
fn work(args: &CheckArgs, within: &Path, reporter: &Reporter, found: &Sender<Finding>) {
    let mut teller = Teller { found, names: InputNames::default() };
    let setup = match Setup::load(&args.session) {
        Ok(setup) => setup,
        Err(error) => {
            let remedy = match error {
                SessionFileError::Io { .. } => "name a session file; `sidecarm session new` makes one",
                _ => "correct the key that is named",
            };
            return teller.tell(Finding::fail("session file", error.to_string(), remedy));
        }
    };
    teller.names = InputNames::of(&setup, &[]);
    teller.tell(Finding::pass("session file", "every key is understood"));
    teller.tell_all(check_disk(&out_folder(args, &setup), &setup.session.frames.folder));
    teller.tell_all(check_ports(&setup));
    teller.tell_all(check_video(&setup, within));
    reporter.note("check: listening to the ports, reading files");
    for (_, words) in setup.adapters.unknowns() {
        let remedy = "declare device_time and sequence in the adapter where the device sends them; else this is how it is";
        teller.tell(Finding::warn("line adapter", words, remedy));
    }
    let lines = check_lines(&check_list(&setup));
    teller.tell_all(lines.iter().map(of_line));
    reporter.note("check: loading the scene");
    let mut loaded = Loaded { setup, scene: None, layout: None };
    load(&mut loaded, &mut teller);
    for line in lines.iter().filter(|line| line.ok && line.rate_hz.is_some()) {
        teller.tell_all(check_listened(&loaded.setup, loaded.scene.as_ref(), &line.listened));
    }
    let Some(scene) = &loaded.scene else { return };
    let findings = check_session(&loaded.setup, scene, loaded.layout.as_ref());
    if let Some(layout) = &mut loaded.layout {
        layout.refused = refusal(&findings);
    }
    teller.tell_all(findings);
    reporter.note("check: reading the newest frame");
    teller.tell_all(check_newest(&loaded.setup, scene, loaded.layout.as_ref()));
    let Some(layout) = &loaded.layout else { return };
    reporter.note("check: one synthetic exposure through the whole path");
    match Renderer::new(DeviceChoice::Auto, &Reporter::silent()) {
        Ok(renderer) => teller.tell(rehearse(&loaded.setup, scene, layout, renderer, within)),
        Err(error) => {
            let remedy = "check the graphics driver, or run without a GPU";
            teller.tell(Finding::fail("synthetic exposure", error.to_string(), remedy));
        }
    }
}

fn out_folder(args: &CheckArgs, setup: &Setup) -> PathBuf {
    let beside = args.session.parent().unwrap_or(Path::new("."));
    let named = setup.session.out.as_ref().map(|out| beside.join(out));
    args.out.clone().or(named).unwrap_or_else(|| beside.join("session"))
}

fn check_list(setup: &Setup) -> CheckList {
    let session = &setup.session;
    let [carm, robot] = setup.ports();
    let file = |role: &str, path: &PathBuf, check| CheckFile { role: role.to_owned(), path: path.clone(), check };
    let mut files = vec![file("frames", &session.frames.folder, FileCheck::Folder)];
    files.extend(session.carm.as_ref().map(|line| file("calibration file", &line.calibration, FileCheck::CarmCalibration)));
    files.extend(session.robot.as_ref().map(|line| file("robot model", &line.model, FileCheck::RobotModel)));
    CheckList { carm, robot, files }
}

/// The verdict on a port or a file.
fn of_line(line: &CheckLine) -> Finding {
    let check = if line.rate_hz.is_some() { format!("{} port", line.what) } else { line.what.clone() };
    let detail = format!("{}: {}", line.path.display(), line.detail);
    if line.ok {
        return Finding::pass(&check, detail);
    }
    // The words of a port's trouble hold the remedy after the semicolon.
    match line.detail.split_once("; ") {
        Some((what, remedy)) => Finding::fail(&check, format!("{}: {what}", line.path.display()), remedy),
        None => Finding::fail(&check, detail, "correct the path in the session file, or the file"),
    }
}

fn load(loaded: &mut Loaded, teller: &mut Teller) {
    let setup = &loaded.setup;
    let quiet = Reporter::counting();
    match scene::load_text(&setup.scene_json, &setup.scene_path, false, &quiet) {
        Ok(scene) => {
            teller.names = InputNames::of(setup, &scene.inputs);
            let detail = format!("{} objects, {} materials", scene.objects.len(), scene.materials.len());
            teller.tell(Finding::pass("scene", detail));
            loaded.scene = Some(scene);
        }
        Err(error) => {
            let remedy = "correct the scene; `sidecarm info` shows what a file holds";
            teller.tell(Finding::fail("scene", error.to_string(), remedy));
        }
    }
    for (kind, counted) in quiet.warnings() {
        teller.tell(Finding::warn("scene", format!("{kind}: {}", counted.latest), "see to the file that is named"));
    }
    match &setup.beads {
        None => teller.tell(Finding::warn(
            "beads",
            "the session names no beads: every pose will be telemetry's",
            "name a markups file under \"beads\"",
        )),
        Some((path, text)) => match parse_markups(path, text.as_bytes()) {
            Ok(layout) => {
                teller.tell(Finding::pass("beads", format!("{} beads in {}", layout.beads.len(), path.display())));
                loaded.layout = Some(layout);
            }
            Err(error) => {
                let remedy = "export the points from Slicer again (.mrk.json or .fcsv)";
                teller.tell(Finding::fail("beads", error.to_string(), remedy));
            }
        },
    }
}
