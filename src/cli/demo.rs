//! `sidecarm demo`: mocked C-arm, robot and detector on pseudo-terminals, the whole live pipeline, and its error against truth.

use std::io::{BufRead, BufReader};
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::time::Duration;

use glam::DVec3;
use serde::Deserialize;

use super::live::{stop_on_signals, watch};
use crate::geometry::Projection;
use crate::regular;
use crate::report::{Pair, TruthError};
use crate::reporter::Reporter;
use crate::session::file::{SessionFileError, Setup};
use crate::session::folder::Folder;
use crate::session::live::LiveOptions;
use crate::session::{SessionError, Stop};

/// A 20 s session on mocked devices, with faults: log, strips, report, and the error against truth.
#[derive(Clone, Debug, clap::Args)]
#[command(after_help = "Example:\n  sidecarm demo --headless --out demo-1")]
pub struct DemoArgs {
    /// Folder for the mocked laboratory and the session.
    #[arg(long, default_value = "sidecarm-demo")]
    pub out: PathBuf,
    /// No window.
    #[arg(long)]
    pub headless: bool,
    /// Length of the session.
    #[arg(long, default_value_t = 20.0, value_name = "S")]
    pub seconds: f64,
    /// Seed of noise and encoders.
    #[arg(long, default_value_t = 1)]
    pub seed: u64,
}

/// Why there is no demo.
#[derive(Debug, thiserror::Error)]
pub enum DemoError {
    /// The mocks are a program of their own.
    #[error("{path}: mock-lab is not beside this program; build it with `cargo build --workspace`")]
    NoMock {
        /// Where it should be.
        path: String,
    },
    /// The mocks ended or spoke nonsense.
    #[error("mock-lab: {detail}")]
    Mock {
        /// What happened.
        detail: String,
    },
    /// The folder holds an earlier demo.
    #[error("{path}: holds an earlier demo; choose another --out, or remove it")]
    Occupied {
        /// The folder.
        path: String,
    },
    /// The session.
    #[error(transparent)]
    Session(#[from] SessionError),
    /// The session file.
    #[error(transparent)]
    File(#[from] SessionFileError),
}

/// `truth.json`: read only after the session.
#[derive(Deserialize)]
struct Truth {
    frames: Vec<TrueFrame>,
    landmarks: Vec<TrueLandmark>,
}

#[derive(Deserialize)]
struct TrueFrame {
    frame: String,
    projection: [[f64; 4]; 3],
}

#[derive(Deserialize)]
struct TrueLandmark {
    lps_mm: DVec3,
}

/// Runs the demo; exit code 0 also when packets were lost, which the mocks see to.
///
/// # Errors
/// When the mocks cannot be started or the session fails.
pub fn run(args: &DemoArgs, reporter: &Reporter) -> Result<u8, DemoError> {
    let out = &args.out;
    let session_folder = out.join("session");
    if session_folder.join("session.mcap").exists() {
        return Err(DemoError::Occupied { path: out.display().to_string() });
    }
    reporter.note(format!("demo: starting the mocked laboratory in {}", out.display()));
    let mut lab = MockLab::start(out, args)?;
    let session = lab.ready()?;
    let setup = Setup::load(&session)?;
    let stop = Stop::default();
    stop_on_signals(&stop, reporter);
    let follower = lab.follow(stop.clone(), reporter.clone());
    let options = LiveOptions { out: session_folder, stop, seconds: None, include_existing: true, sound: false };
    let folder = watch(setup, options, args.headless, reporter);
    drop(lab);
    let _ = follower.join();
    let mut folder = folder?;
    judge(&mut folder, &out.join("truth.json"))?;
    print_table(&folder);
    println!();
    println!("report  {}", folder.path.join("report.html").display());
    println!("strips  {}", folder.path.join("strips").display());
    println!("log     {}", folder.path.join("session.mcap").display());
    println!("replay  sidecarm replay {}", folder.path.join("session.mcap").display());
    // The mocks lose packets on purpose: here a loss is part of the play.
    for loss in &folder.losses {
        println!("lost    {loss} (faults that the demo injects)");
    }
    Ok(0)
}

/// The running mocks; stopped when dropped.
struct MockLab {
    child: Child,
    lines: Option<std::io::Lines<BufReader<std::process::ChildStdout>>>,
}

impl MockLab {
    fn start(out: &Path, args: &DemoArgs) -> Result<Self, DemoError> {
        let beside = std::env::current_exe().ok().and_then(|path| path.parent().map(Path::to_owned)).unwrap_or_default();
        let program = beside.join(format!("mock-lab{}", std::env::consts::EXE_SUFFIX));
        if !program.exists() {
            return Err(DemoError::NoMock { path: program.display().to_string() });
        }
        let failed = |error: std::io::Error| DemoError::Mock { detail: format!("cannot be started: {error}") };
        let mut child = Command::new(program)
            .arg("--out")
            .arg(out)
            .args(["--seed", &args.seed.to_string(), "--duration-s", &args.seconds.to_string()])
            .stdin(Stdio::null())
            .stdout(Stdio::piped())
            .spawn()
            .map_err(failed)?;
        let lines = child.stdout.take().map(|stdout| BufReader::new(stdout).lines());
        Ok(Self { child, lines })
    }

    /// Waits for the ports; gives the session file.
    fn ready(&mut self) -> Result<PathBuf, DemoError> {
        let line = self.lines.as_mut().and_then(Iterator::next).and_then(Result::ok);
        let event: serde_json::Value = line.and_then(|line| serde_json::from_str(&line).ok()).unwrap_or_default();
        match event["session"].as_str() {
            Some(path) => Ok(PathBuf::from(path)),
            None => Err(DemoError::Mock { detail: "ended before its ports were open".to_owned() }),
        }
    }

    /// Reads events until the mocks have finished, then, a moment later, ends the session.
    fn follow(&mut self, stop: Stop, reporter: Reporter) -> std::thread::JoinHandle<()> {
        let lines = self.lines.take();
        std::thread::spawn(move || {
            for line in lines.into_iter().flatten().map_while(Result::ok) {
                let event: serde_json::Value = serde_json::from_str(&line).unwrap_or_default();
                match event["event"].as_str() {
                    Some("exposure") => reporter.note(format!("demo: exposure {}", event["counter"])),
                    Some("fault") => {
                        let said = |key: &str| event[key].as_str().unwrap_or("?").to_owned();
                        reporter.note(format!("demo: injected fault '{}' on {}", said("kind"), said("device")));
                    }
                    Some("finished") => break,
                    _ => {}
                }
            }
            // The last frame may still be settling in its folder.
            std::thread::sleep(Duration::from_millis(1500));
            stop.finish();
        })
    }
}

impl Drop for MockLab {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

/// Adds to each pair how far the pose used puts the landmarks from where they are, in `pairs.json` and the report.
fn judge(folder: &mut Folder, truth: &Path) -> Result<(), DemoError> {
    let wrong = |detail: String| DemoError::Mock { detail: format!("{}: {detail}", truth.display()) };
    let text = regular::read_text(truth).map_err(|error| wrong(error.to_string()))?;
    let truth: Truth = serde_json::from_str(&text).map_err(|error| wrong(error.to_string()))?;
    for pair in &mut folder.pairs {
        let known = truth.frames.iter().find(|frame| same_file(&frame.frame, &pair.frame));
        let (Some(known), Some(view)) = (known, folder.views.get(&pair.number)) else { continue };
        let (found, true_projection) = (view.projection(), Projection(known.projection));
        let mut shifts_px = Vec::new();
        let mut shifts_mm = Vec::new();
        for landmark in &truth.landmarks {
            let ((at, depth_mm), (should, _)) = (found.project(landmark.lps_mm), true_projection.project(landmark.lps_mm));
            let inside = should.x >= 0.0
                && should.y >= 0.0
                && should.x < f64::from(view.size_px[0])
                && should.y < f64::from(view.size_px[1]);
            if inside {
                shifts_px.push(at.distance(should));
                shifts_mm.push(at.distance(should) * depth_mm / view.intrinsics.fx);
            }
        }
        if !shifts_px.is_empty() {
            let mean = |values: &[f64]| values.iter().sum::<f64>() / values.len() as f64;
            pair.truth = Some(TruthError { mean_px: mean(&shifts_px), mean_mm: Some(mean(&shifts_mm)) });
        }
    }
    Ok(folder.write_again()?)
}

fn same_file(a: &str, b: &str) -> bool {
    Path::new(a).file_stem() == Path::new(b).file_stem()
}

fn print_table(folder: &Folder) {
    println!("{}", crate::report::counted(&folder.pairs));
    println!(
        "{:<12}{:>20}{:>11}{:>9}{:>11}{:>11}{:>9}{:>13}{:>12}{:>10}{:>9}{:>9}",
        "frame",
        "status",
        "pose",
        "rms px",
        "truth px",
        "truth mm",
        "ZNCC",
        "small: pose",
        "best wrong",
        "register",
        "render",
        "compare"
    );
    let number = |value: Option<f64>, digits: usize| value.map_or_else(|| "-".to_owned(), |value| format!("{value:.digits$}"));
    for pair in &folder.pairs {
        let Pair { frame, pose_source, rms_px, truth, scores, null, stages_ms, .. } = pair;
        let stage = |name: &str| stages_ms.get(name).map_or_else(|| "-".to_owned(), |ms| format!("{ms:.0} ms"));
        let small = null.get("zncc");
        println!(
            "{frame:<12}{:>20}{:>11}{:>9}{:>11}{:>11}{:>9}{:>13}{:>12}{:>10}{:>9}{:>9}",
            pair.standing().short(),
            word(pose_source),
            number(*rms_px, 3),
            number(truth.map(|truth| truth.mean_px), 3),
            number(truth.and_then(|truth| truth.mean_mm), 3),
            number(scores.zncc, 4),
            number(small.and_then(|score| score.at_pose), 5),
            number(small.and_then(|score| score.best_shifted), 5),
            stage("register"),
            stage("render"),
            stage("compare"),
        );
    }
    println!("truth: mean distance of the landmarks in the frame from where they really are");
    println!("small, best wrong: ZNCC of small pictures, at the pose and at the best wrong one");
}

/// The word that files use for a value.
fn word(value: &impl serde::Serialize) -> String {
    serde_json::to_value(value).ok().and_then(|value| value.as_str().map(str::to_owned)).unwrap_or_default()
}
