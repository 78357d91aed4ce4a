//! One synthetic exposure through the whole path, before the session, by the session's own parts:
//!
//! ```text
//! joints, angles ── packets ───────────────────────────┐
//! scene ─ render ─ console ─ file in a watched folder ─┴─ engine: telemetry, import, masks, beads, P ─ workshop: DRR, scores, strip
//! ```
//! All files lie in a temporary folder of their own and are removed. Ports and threads that only record are not rehearsed.

mod console;
mod lines;
mod played;
mod stand;
mod verdict;

use std::path::Path;
use std::sync::Arc;

use glam::DVec3;

use super::crosscheck::{Finding, bead_spheres, pose_difference, scene_kvp};
use super::file::Setup;
use super::input::Input;
use super::newest_files::{Found, newest_files};
use super::remedy::of_refusal;
use crate::acquire::Frame;
use crate::beads::BeadLayout;
use crate::geometry::CarmJoints;
use crate::image::{Image, write_atomically};
use crate::render::{Options, Quantity, Renderer};
use crate::reporter::Reporter;
use crate::scene::Scene;
use crate::scene::model::Noise;
use crate::telemetry::DeviceKind;
use crate::time::{Stopwatch, host_now_us};
use console::stored_file;
use lines::{COUNTER, Told, sends_packets};
use played::{Played, play};
use stand::Stand;
use verdict::{Rehearsed, failed, verdict};

/// Radius of beads that name none.
const BEAD_RADIUS_MM: f64 = 0.75;
/// What a session says of a frame because of how it is imported or drawn, whatever is in the picture.
const TELLING: [&str; 7] =
    ["detector calibration", "frame size", "console geometry", "distortion", "carm", "scatter", "robot bend"];
const BY_SCENE: &str = "correct the scene or the calibration; `sidecarm render --explain` says more";
const FAULT: &str = "report this with the session's files";

/// Rehearses an exposure; its files go to a temporary folder in `within`.
#[must_use]
pub fn rehearse(setup: &Setup, scene: &Scene, layout: &BeadLayout, renderer: Renderer, within: &Path) -> Finding {
    let temporary = match tempfile::tempdir_in(within) {
        Ok(temporary) => temporary,
        Err(error) => return failed(format!("no temporary folder: {error}"), "see to the temporary folder (TMPDIR)"),
    };
    let found = exposed(setup, scene, layout, renderer, temporary.path());
    let left = temporary.path().display().to_string();
    match temporary.close() {
        Ok(()) => found.unwrap_or_else(|refused| refused),
        Err(error) => failed(format!("its files are left in {left}: {error}"), "remove that folder"),
    }
}

fn exposed(
    setup: &Setup,
    scene: &Scene,
    layout: &BeadLayout,
    mut renderer: Renderer,
    temporary: &Path,
) -> Result<Finding, Finding> {
    let frames = temporary.join("frames");
    std::fs::create_dir(&frames).map_err(|error| failed(format!("{}: {error}", frames.display()), FAULT))?;
    let mut own = setup.with_frames_in(&frames);
    own.session.frames.sub_folders = false;
    // No tags are drawn, and no tracker sees the robot.
    (own.tags, own.session.tags, own.session.world_from_tracker) = (None, None, None);
    let mut untold = Vec::new();
    if own.robot.is_some() && !sends_packets(&own, DeviceKind::Robot) {
        (own.robot, own.session.robot) = (None, None);
        untold.push("the robot's lines of text");
    }
    let tells_joints = own.carm.is_some() && sends_packets(&own, DeviceKind::Carm);
    if own.carm.is_some() && !tells_joints {
        untold.push("the arm's lines of text");
    }
    let layout = BeadLayout { refused: None, ..layout.clone() };

    let (mut exposed, places) = with_beads(scene, &layout)?;
    let declares_console = own.session.console.is_some();
    let stand = Stand::of(&mut own, &places, scene).map_err(|detail| failed(detail, BY_SCENE))?;
    if declares_console && own.session.console.is_none() {
        untold.push("the console");
    }
    exposed.view = Some(stand.view);
    exposed.model.noise = Noise::True;
    exposed.detector.panel.intensifier.clone_from(&stand.intensifier);
    let watch = Stopwatch::start();
    let picture = rendered(&exposed, &mut renderer).map_err(|detail| failed(detail, BY_SCENE))?;
    let first_render_ms = watch.ms();

    let kvp = scene_kvp(scene);
    let watch = Stopwatch::start();
    let frame = stored_and_read(&own, &stand, &picture, kvp, &frames)?;
    let read_ms = watch.ms();
    let reporter = Reporter::silent();
    let told = Told {
        joints: stand.joints.unwrap_or(CarmJoints::ZERO),
        kvp,
        control_angles_deg: scene.robot.as_ref().map_or([0.0; 5], |robot| robot.control_angles_deg),
        begun_us: host_now_us(),
    };
    let declared = own.session.world_from_lps.is_some();
    let attempt = |with_prior: bool| {
        let mut own = own.clone();
        own.session.world_from_lps = stand.world_from_lps.filter(|_| with_prior);
        let mut inputs = told.inputs(&own);
        let at = inputs.partition_point(|input| matches!(input, Input::Bytes { host_us, .. } if *host_us <= told.frame_us()));
        inputs.insert(at, Input::Frame { frame: Arc::clone(&frame), host_us: told.frame_us() });
        (play(own.clone(), &layout, inputs, told.ended_us(), &reporter), own)
    };
    let (mut played, mut played_by) = attempt(declared && tells_joints);
    let mut needs_prior = false;
    if !declared && tells_joints && !is_accepted(&played) {
        let (with_prior, own) = attempt(true);
        // A refusal is told as the session would have it.
        if is_accepted(&with_prior) {
            (played, played_by, needs_prior) = (with_prior, own, true);
        }
    }
    if let Some(fault) = played.faults.first() {
        return Err(failed(format!("its own packets were not understood: {fault}"), FAULT));
    }
    let posed = played.posed.take().ok_or_else(|| failed("its frame was never handed on to be posed", FAULT))?;
    if tells_joints && posed.binding.exposure.is_none() {
        let evidence = posed.binding.evidence.join("; ");
        return Err(failed(format!("its frame was tied to no exposure of what the arm told: {evidence}"), FAULT));
    }
    let Some(view) = posed.view.filter(|_| posed.pose.is_accepted()) else {
        let reason = posed.pose.reason.as_deref().unwrap_or("no reason given");
        let remedy = posed.pose.refusal.as_ref().map_or("expose again", of_refusal);
        let remedy =
            format!("check the beads against the scene, photons_per_pixel, and the calibration's pitch and distances; {remedy}");
        return Err(failed(format!("the scene's beads gave no pose: {reason}"), &remedy));
    };
    let off = pose_difference(&view.camera_from_lps, &stand.view.camera_from_lps, layout.centroid_lps_mm());
    let out = temporary.join("session");
    let drawn = played.draw(posed, (&played_by, &layout), scene, renderer, &out, &reporter);
    let drawn = drawn.map_err(|error| failed(format!("no strip: {error}"), "see to the temporary folder (TMPDIR)"))?;
    let told = reporter.warnings().into_iter().filter(|(kind, _)| TELLING.contains(&kind.as_str()));
    let told = told.map(|(kind, counted)| (kind, counted.latest)).collect();
    let stages = ["register", "render", "compare", "strip"];
    let stages = stages.map(|stage| format!("{stage} {:.0} ms", drawn.pair.stages_ms.get(stage).unwrap_or(0.0)));
    let left_out = if untold.is_empty() { String::new() } else { format!("; without {}", untold.join(", ")) };
    let times = format!("first render {first_render_ms:.0} ms, read {read_ms:.0} ms, {}{left_out}", stages.join(", "));
    Ok(verdict(&Rehearsed { drawn, off, needs_prior, told, times }))
}

fn is_accepted(played: &Played) -> bool {
    played.posed.as_ref().is_some_and(|posed| posed.pose.is_accepted())
}

/// The scene with beads to be seen, and where they are: its own spheres, else those of the layout.
fn with_beads(scene: &Scene, layout: &BeadLayout) -> Result<(Scene, Vec<DVec3>), Finding> {
    let spheres = bead_spheres(scene);
    if spheres.len() >= 4 {
        return Ok((scene.clone(), spheres));
    }
    let radius_mm = |index: usize| layout.radius_mm(index, None).unwrap_or(BEAD_RADIUS_MM);
    let balls: Vec<(DVec3, f64)> = layout.beads.iter().enumerate().map(|(index, bead)| (bead.lps_mm, radius_mm(index))).collect();
    let mut exposed = scene.clone();
    exposed.add_beads(&balls, "steel_316l").map_err(|error| failed(error.to_string(), BY_SCENE))?;
    Ok((exposed, balls.into_iter().map(|(place, _)| place).collect()))
}

fn rendered(exposed: &Scene, renderer: &mut Renderer) -> Result<Image<f32>, String> {
    let options = Options { quantity: Quantity::Intensity, ..Options::default() };
    let rendered = renderer.render(exposed, &options).map_err(|error| error.to_string())?;
    rendered.pages.into_iter().next().ok_or_else(|| "nothing was rendered".to_owned())
}

/// The picture as the console exports it and the session reads it.
fn stored_and_read(
    setup: &Setup,
    stand: &Stand,
    picture: &Image<f32>,
    kvp: Option<f64>,
    frames: &Path,
) -> Result<Arc<Frame>, Finding> {
    let bytes = stored_file(setup, stand, picture, kvp, COUNTER).map_err(|detail| failed(detail, FAULT))?;
    write_atomically(&frames.join("frame-001.dcm"), |file| file.write_all(&bytes))
        .map_err(|error| failed(error.to_string(), "see to the temporary folder (TMPDIR): is its disk full?"))?;
    let found = newest_files(setup, &Reporter::silent()).map_err(|error| failed(error.to_string(), FAULT))?;
    match found.into_iter().next() {
        Some(Found::Frame(frame)) => Ok(Arc::new(Frame { number: 1, ..*frame })),
        Some(Found::Unreadable(words)) => Err(failed(format!("its frame cannot be read back: {words}"), FAULT)),
        None => Err(failed("its frame was not found in the folder it was exported to", FAULT)),
    }
}
