//! What a frame that lies in the folder already says of the session: imported, masked and registered as a live one, but for telemetry.

use std::sync::Arc;

use super::bound::Bound;
use super::crosscheck::{ExposureFacts, Finding, check_exposure};
use super::file::Setup;
use super::import::{Import, Imported};
use super::newest_files::{Found, newest_files};
use super::posed::Posed;
use super::posing::{Known, PoseJob};
use super::remedy::of_refused;
use crate::acquire::{Domain, Frame};
use crate::beads::BeadLayout;
use crate::pose::Refusal;
use crate::report::PoseSource;
use crate::reporter::Reporter;
use crate::scene::Scene;
use crate::timeline::Binding;

const POSE: &str = "newest frame's pose";

/// The newest frame against calibration, scene and beads; files from which no frame comes are named. Nothing is written.
#[must_use]
pub fn check_newest(setup: &Setup, scene: &Scene, layout: Option<&BeadLayout>) -> Vec<Finding> {
    let own = setup.with_frames_in(&setup.session.frames.folder);
    let found = match newest_files(&own, &Reporter::silent()) {
        Ok(found) => found,
        Err(error) => return vec![Finding::warn("newest frame", error.to_string(), "check the frames' folder")],
    };
    let mut findings = Vec::new();
    for found in found {
        match found {
            Found::Unreadable(words) => {
                findings.push(Finding::warn("unreadable frame", words, "export it again from the console, or move it away"));
            }
            Found::Frame(frame) => findings.extend(check_frame(&own, scene, layout, Arc::new(*frame))),
        }
    }
    findings
}

fn check_frame(setup: &Setup, scene: &Scene, layout: Option<&BeadLayout>, read: Arc<Frame>) -> Vec<Finding> {
    let imported = Import::of(setup).frame(&read, None);
    let remedy = "correct \"console\" or \"detector\" in the session, or the calibration that it names";
    let mut findings: Vec<Finding> =
        imported.warnings.iter().map(|(kind, words)| Finding::warn(kind, words.as_str(), remedy)).collect();
    let frame = Arc::clone(&imported.frame);
    if frame.domain == Domain::Unknown {
        let detail = format!(
            "{}: nothing says what its values mean: which of them are brighter is guessed, and no score in nepers is made",
            frame.name
        );
        findings.push(Finding::warn("frame values", detail, "name \"domain\" in the session: linear, log or display"));
    }
    let posed = (layout.is_some() || setup.tags.is_some()).then(|| pose(setup, layout, read, imported));
    let from_beads = posed.as_ref().filter(|posed| posed.pose_source == PoseSource::Beads).and_then(|posed| posed.view);
    let carm = setup.carm_of_frame(&frame);
    let against = check_exposure(&ExposureFacts {
        frame: &frame,
        carm: carm.as_ref(),
        scene,
        scene_json: &setup.scene_json,
        beam: None,
        from_beads: from_beads.as_ref().map(|view| &view.camera_from_lps),
        nominal: None,
        centre_lps_mm: None,
        shuttered_share: None,
    });
    if against.is_empty() {
        let [columns, rows] = frame.size_px;
        let fits = if carm.is_some() { ", as the calibration has it" } else { "" };
        let detail = format!("{}: {columns} x {rows} px, {} values{fits}", frame.name, frame.domain);
        findings.push(Finding::pass("newest frame", detail));
    }
    findings.extend(against);
    findings.extend(posed.iter().map(of_pose));
    findings
}

/// The pose as a session would find it of a frame of whose exposure nothing was told.
fn pose(setup: &Setup, layout: Option<&BeadLayout>, read: Arc<Frame>, imported: Imported) -> Posed {
    let bound = Bound::new(read, 0, Binding::default(), &setup.adapters.timeline());
    let known = Known {
        setup: Arc::new(setup.clone()),
        layout: layout.cloned().map(Arc::new),
        tags: setup.tag_layout().map(Arc::new),
        landmarks: setup.landmark_points().into(),
        world_from_lps: None,
        tie_disputed: false,
    };
    let (posed, _) = PoseJob::new(bound, imported, known, 0, &Reporter::silent()).run().into_posed(None);
    posed
}

fn of_pose(posed: &Posed) -> Finding {
    let (pose, name) = (&posed.pose, &posed.frame.name);
    let used = pose.beads.iter().filter(|bead| bead.used).count();
    let seen = format!("{name}: {used} of {} beads", pose.beads.len());
    if !pose.is_accepted() {
        let reason = pose.reason.as_deref().unwrap_or("no reason given");
        let remedy = match &pose.refusal {
            Some(Refusal::Layout { .. }) => "see the other checks of the beads: every frame is refused for this",
            _ => of_refused(pose).unwrap_or("expose again"),
        };
        return Finding::warn(POSE, format!("{name}: its beads give no pose without telemetry: {reason}"), remedy);
    }
    match &pose.doubt {
        None => {
            let rms = pose.rms_px.map(|px| format!(", rms {px:.3} px")).unwrap_or_default();
            Finding::pass(POSE, format!("{seen}{rms}, without telemetry"))
        }
        Some(doubt) => {
            let remedy = "check what the reason names; telemetry, another direction or more beads may tell two readings apart";
            Finding::warn(POSE, format!("{seen}, but the pose is in doubt: {doubt}"), remedy)
        }
    }
}
