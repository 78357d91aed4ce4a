//! From a posed frame to a pair: scene, DRR, comparison, strip, and later the null.

use std::sync::Arc;

use glam::DVec3;

use super::bound::copy_of;
use super::crosscheck::{ExposureFacts, check_exposure, innovation, turned_picture_deg};
use super::declared::Declared;
use super::developed::{Developed, UNCHECKED, draw};
use super::file::Setup;
use super::pair_view::PairView;
use super::posed::Posed;
use crate::beads::BeadLayout;
use crate::calibrate::robot::{RobotFitError, SeenRobot, SeenTip, tip_in_frame};
use crate::compare::{CompareInput, Compared, NullError, NullRenders, NullScatter, bead_marks, compare, posed_scene, tool_mask};
use crate::geometry::View;
use crate::image::{Image, sha256_bytes};
use crate::mask::{Cause, MaskShares};
use crate::render::{Options, Plan, Quantity, Rendered, Renderer, Scatter};
use crate::report::{BeadRow, KSource, Pair, PairStatus, PoseSource};
use crate::reporter::Reporter;
use crate::scene::Scene;
use crate::scene::model::ScatterModel;
use crate::time::Stopwatch;
use crate::timeline::{Binding, BindingFlag, BindingHow};
use crate::transport::NetworkScatter;

/// Share of a picture from which on writing is said to be in it: a mark of a few pixels names nobody.
const WRITING_SHARE: f64 = 1e-3;

/// What frames are developed with.
pub(super) struct Bench {
    pub(super) scene: Scene,
    pub(super) setup: Setup,
    pub(super) declared: Declared,
    pub(super) layout: Option<BeadLayout>,
    pub(super) network: Option<NetworkScatter>,
    pub(super) renderer: Renderer,
    pub(super) reporter: Reporter,
    /// What was compared last without its pair being finished, and the same with its null, which took so many ms: it was put off while the
    /// drill's tip was looked for.
    pub(super) with_null: Option<(Arc<Compared>, Arc<Compared>, f64)>,
}

impl Bench {
    /// Renders and compares; `plan` is executed as it is where there is one, else the renderer plans. The null comes later.
    pub(super) fn develop(&mut self, posed: Posed, plan: Option<Plan>) -> Developed {
        let posed = Arc::new(posed);
        let mut pair = row(&posed);
        if self.scene.robot.is_none() {
            pair.robot_source = Some("none".to_owned());
            pair.robot_cautions.clear();
        }
        let Some(view) = posed.view else {
            return self.without(posed, pair, "no pose: nothing to render");
        };
        let scene = match self.scene_at(&posed, view, &mut pair.flags) {
            Ok(scene) => Arc::new(scene),
            Err(reason) => return self.without(posed, pair, &reason),
        };
        let scatter = self.scatter_of(&scene, &view, &mut pair);
        let scene = if self.network.is_some() && scatter.is_none() { Arc::new(without_scatter(&scene)) } else { scene };
        let watch = Stopwatch::start();
        let (quantity, frame_index) = (Quantity::LineIntegral, posed.number);
        let options = Options { quantity, frame_index, plan, guessed: true, scatter: scatter.clone(), ..Options::default() };
        let rendered = match self.renderer.render(&scene, &options) {
            Ok(rendered) => Arc::new(rendered),
            Err(error) => return self.without(posed, pair, &format!("not rendered: {error}")),
        };
        pair.stages_ms.add("render", watch.ms());
        pair.render_error = Some(rendered.stated_error);
        pair.flags.extend(rendered.notes.iter().cloned());
        let drr_sha256 = Some(sha256_of(&rendered.pages[0]));

        let watch = Stopwatch::start();
        let beads = bead_marks(&posed.pose, &view, Some(&scene), |name| {
            let listed = self.layout.iter().flat_map(|layout| layout.beads.iter().chain(&layout.checks));
            let radius_mm = listed.filter(|bead| bead.name == name).find_map(|bead| bead.radius_mm);
            radius_mm.or(self.setup.session.bead_radius_mm)
        });
        let tool = tool_mask(&scene);
        let mut input = CompareInput::new(&posed.frame, &rendered.pages[0]);
        input.valid = Some(&rendered.valid);
        input.guessed = rendered.guessed.as_ref();
        input.masks = Some(&posed.masks);
        input.beads = &beads;
        input.tool = tool.as_ref();
        input.tone = self.declared.tone_of(&posed.frame, &mut pair.flags);
        input.air = self.declared.air_level();
        input.view = Some(&view);
        input.centre_lps_mm = self.centre();
        let compared = match compare(&input) {
            Ok(compared) => {
                pair.set_comparison(&compared.comparison);
                pair.judge_image();
                for disagreement in &pair.disagreements {
                    self.reporter.warn("images disagree", format!("{}: {disagreement}", posed.label()));
                }
                Some(Arc::new(compared))
            }
            Err(error) => {
                pair.doubt(&error.to_string());
                pair.flags.push(error.to_string());
                None
            }
        };
        pair.stages_ms.add("compare", watch.ms());
        self.cross_check(&posed, &mut pair);
        self.look_for_writing(&posed, &mut pair);
        let watch = Stopwatch::start();
        let without = compared.is_none().then(|| pair.flags.last().cloned().unwrap_or_default());
        let strip = Arc::new(draw(&posed, &pair, Some(&scene), compared.as_deref(), without.as_deref()));
        pair.stages_ms.add("strip", watch.ms());
        let complete = compared.is_none();
        if !complete {
            pair.flags.push(UNCHECKED.to_owned());
        }
        let (drr, seen_robot) = (Some((rendered, scene)), None);
        Developed { posed, pair, drr, scatter, compared, seen_robot, strip, drr_sha256, complete }
    }

    /// What is known of the exposure from several sides, compared: disagreements are flags of the pair and counted warnings.
    fn cross_check(&self, posed: &Posed, pair: &mut Pair) {
        let shuttered = |masks: &MaskShares| masks.causes.get(&Cause::Collimation).copied().unwrap_or(0.0);
        let carm = self.setup.carm_of_frame(&posed.frame);
        let facts = ExposureFacts {
            frame: &posed.frame,
            carm: carm.as_ref(),
            scene: &self.scene,
            scene_json: &self.setup.scene_json,
            beam: posed.beam.as_deref(),
            // Of a pose that telemetry is fused into, what the beads alone say.
            from_beads: posed
                .view
                .as_ref()
                .filter(|_| posed.pose_source == PoseSource::Beads)
                .map(|view| posed.pose.innovation.as_ref().map_or(&view.camera_from_lps, |off| &off.camera_from_lps)),
            nominal: posed.nominal.as_ref(),
            centre_lps_mm: self.centre(),
            shuttered_share: pair.masks.as_ref().map(shuttered),
        };
        pair.innovation = innovation(&facts);
        let findings = check_exposure(&facts);
        if let (Some(words), Some(_), Some(_)) = (pair.robot_words(), &self.setup.robot, &posed.view) {
            self.reporter.warn("robot not told", format!("{}: {words}", posed.label()));
        }
        let drawn = posed.robot.as_ref().filter(|_| self.scene.robot.is_some());
        for caution in drawn.iter().flat_map(|robot| &robot.cautions) {
            self.reporter.warn(caution.kind(), format!("{}: {caution}; {}", posed.label(), caution.remedy()));
        }
        for flag in &posed.binding.flags {
            match flag {
                BindingFlag::Moved { .. } => {
                    self.reporter.warn("moved during the exposure", format!("{}: {flag}", posed.label()));
                }
                BindingFlag::TelemetryGap { .. } | BindingFlag::MovedInGap { .. } | BindingFlag::OpenEnds => {
                    self.reporter.warn("gap at the exposure", format!("{}: {flag}", posed.label()));
                }
                BindingFlag::Duplicate { .. } => self.reporter.warn("same picture", format!("{}: {flag}", posed.label())),
                _ => {}
            }
        }
        for finding in findings {
            self.reporter.warn(&format!("check: {}", finding.check), format!("{}: {finding}", posed.label()));
            // What P rests on besides the beads.
            if ["SID", "pitch"].contains(&finding.check.as_str()) {
                pair.doubt_by_telemetry(&finding.to_string());
            }
            pair.flags.push(finding.to_string());
        }
    }

    /// Writing in a picture may be a name, and it goes wherever the picture goes.
    fn look_for_writing(&self, posed: &Posed, pair: &mut Pair) {
        let share_of = |cause| pair.masks.as_ref().and_then(|masks| masks.causes.get(&cause)).copied().unwrap_or(0.0);
        let share = share_of(Cause::BurnedIn);
        // Single quanta behind shutters look like dots of writing: what is masked there is not told apart.
        if !(share >= WRITING_SHARE && share_of(Cause::Collimation) < WRITING_SHARE) {
            return;
        }
        let words = format!(
            "{:.1} % of the picture is masked as writing that is burned in; log, strips and report show it as it is: export without overlays \
             if it names anyone",
            100.0 * share
        );
        self.reporter.warn("burned-in writing", format!("{}: {words}", posed.label()));
        pair.flags.push(words);
    }

    /// The robot where the frame shows it; a DRR that draws the drill's tip elsewhere says so. Pictures of an intensifier are not measured: profiles
    /// across the robot are those of the picture as it is acquired.
    ///
    /// # Errors
    /// When `cancelled`, which is asked now and then, says so.
    fn look_for_robot(
        &self,
        posed: &Posed,
        scene: &Scene,
        pair: &mut Pair,
        cancelled: &dyn Fn() -> bool,
    ) -> Result<Option<SeenRobot>, RobotFitError> {
        // A robot that is drawn as in the scene file for want of its angles is nowhere in particular.
        let placeholder = posed.robot.is_none() && self.setup.robot.is_some();
        if scene.robot.is_none() || posed.intensifier.is_some() || placeholder {
            return Ok(None);
        }
        let watch = Stopwatch::start();
        let seen = match tip_in_frame(&posed.frame, &posed.masks, &posed.pose, scene, cancelled) {
            Err(error) if !matches!(error, RobotFitError::Cancelled) => {
                pair.flags.push(format!("the drill's tip was not looked for: {error}"));
                None
            }
            found => found?,
        };
        pair.tip = seen.as_ref().map(|seen| seen.tip);
        pair.stages_ms.add("tip", watch.ms());
        if let Some(tip) = pair.tip.filter(SeenTip::is_elsewhere) {
            let words = format!("the drill's tip is seen {:.1} mm from where the DRR draws it", tip.length_mm);
            self.reporter.warn("drill's tip", format!("{}: {words}", posed.label()));
            pair.flags.push(words);
        } else if pair.tip.is_none()
            && let Some((kind, words)) = pair.robot_unseen()
        {
            self.reporter.warn(kind, format!("{}: {words}", posed.label()));
            pair.flags.push(words);
        }
        Ok(seen)
    }

    /// The scene at the exposure: as the pose shows it, the robot bent as telemetry says. A body that the scene does not know stays as it was
    /// scanned, and `flags` say so.
    fn scene_at(&self, posed: &Posed, view: View, flags: &mut Vec<String>) -> Result<Scene, String> {
        let scene = posed_scene(&self.scene, &posed.pose, view).or_else(|unknown| {
            flags.push(format!("{unknown}; the DRR shows it as scanned"));
            self.reporter.warn("unknown body", format!("{}: {unknown}", posed.label()));
            let mut pose = posed.pose.clone();
            pose.bodies.retain(|body| self.scene.body_names().contains(&body.name.as_str()));
            posed_scene(&self.scene, &pose, view)
        });
        let mut scene = scene.map_err(|error| error.to_string())?;
        scene.detector.panel.intensifier = posed.intensifier.as_deref().cloned();
        if let Some(robot) = posed.robot.as_ref().filter(|_| scene.robot.is_some()) {
            scene = scene.with_robot(robot.control_angles_deg, robot.lps_from_base).map_err(|error| error.to_string())?;
            if let Some(bent) = scene.robot.as_ref().filter(|robot| robot.clamped > 0) {
                let words = format!(
                    "{} notches of the robot were clamped to {} deg: its reported angles {:.1?} are beyond what it can bend",
                    bent.clamped, bent.model.max_bend_deg, robot.control_angles_deg
                );
                self.reporter.warn("robot bend", format!("{}: {words}", posed.label()));
                flags.push(words);
            }
        }
        Ok(scene)
    }

    /// What the network says of the scatter, where the scene asks it; without a word from it there is none in the DRR, and `pair` says so.
    fn scatter_of(&self, scene: &Scene, view: &View, pair: &mut Pair) -> Option<Arc<Scatter>> {
        let network = self.network.as_ref()?;
        let watch = Stopwatch::start();
        let found = network.say(scene, view, &self.reporter);
        pair.stages_ms.add("scatter", watch.ms());
        match found {
            Ok(scatter) => Some(Arc::new(scatter)),
            Err(error) => {
                let words = format!("no scatter in the DRR: {error}");
                self.reporter.warn("scatter", &words);
                pair.flags.push(words);
                None
            }
        }
    }

    pub(super) fn centre(&self) -> Option<DVec3> {
        let beads = self.layout.as_ref().filter(|layout| layout.refused.is_none()).map(BeadLayout::centroid_lps_mm);
        beads.or_else(|| self.scene.bounds().map(|(centre, _)| centre))
    }

    /// Puts each score against its null, and looks for the drill's tip; `None` when `cancelled`, which is asked all the while, says so.
    pub(super) fn add_null(&mut self, mut developed: Developed, cancelled: &dyn Fn() -> bool) -> Option<Developed> {
        developed.complete = true;
        let (Some(before), Some((drr, scene))) = (developed.compared.clone(), developed.drr.clone()) else {
            return Some(developed);
        };
        let (compared, ms) = match self.with_null.take_if(|(of, ..)| Arc::ptr_eq(of, &before)) {
            Some((_, compared, ms)) => (compared, ms),
            None => match self.null_of(&before, (&drr, &scene), developed.scatter.clone(), cancelled) {
                Ok(made) => made,
                Err(None) => return None,
                Err(Some(because)) => return Some(developed.without_null(&because)),
            },
        };
        developed.pair.flags.retain(|flag| flag != UNCHECKED);
        developed.pair.set_comparison(&compared.comparison);
        developed.pair.judge_image();
        developed.pair.stages_ms.add("null", ms);
        // Nothing is said of a pair that is taken up once more.
        let Ok(seen_robot) = self.look_for_robot(&developed.posed, &scene, &mut developed.pair, cancelled) else {
            self.with_null = Some((before, compared, ms));
            return None;
        };
        developed.seen_robot = seen_robot.map(Arc::new);
        if let Some(found) = &developed.pair.image_prefers {
            self.reporter.warn("image disagrees", format!("{}: {found}", developed.posed.label()));
        }
        developed.strip = Arc::new(draw(&developed.posed, &developed.pair, Some(&scene), Some(&compared), None));
        developed.compared = Some(compared);
        Some(developed)
    }

    /// What was compared with its null, and how many ms that took; why there is none, where it was not `cancelled`.
    fn null_of(
        &mut self,
        before: &Compared,
        (drr, scene): (&Rendered, &Scene),
        near: Option<Arc<Scatter>>,
        cancelled: &dyn Fn() -> bool,
    ) -> Result<(Arc<Compared>, f64), Option<String>> {
        let watch = Stopwatch::start();
        let plan = serde_json::from_value::<Plan>(drr.plan.clone()).map_err(|error| Some(error.to_string()))?;
        let network = self.network.as_ref();
        // Poses that nobody has are unlike what it knows: that is not worth a word.
        let far = |scene: &Scene, view: &View| network?.say(scene, view, &Reporter::silent()).ok();
        let scatter = NullScatter { near, far: Some(&far) };
        let mut renders = NullRenders::new(&mut self.renderer, scene, Some(plan), scatter);
        let mut compared = before.clone();
        compared.add_null(&mut |view| renders.render(view), cancelled).map_err(|error| match error {
            NullError::Cancelled { .. } => None,
            error => Some(error.to_string()),
        })?;
        Ok((Arc::new(compared), watch.ms()))
    }

    /// A pair for a frame whose development failed.
    pub(super) fn failed(&self, posed: Posed, reason: &str) -> Developed {
        let pair = row(&posed);
        self.without(Arc::new(posed), pair, reason)
    }

    fn without(&self, posed: Arc<Posed>, mut pair: Pair, reason: &str) -> Developed {
        if pair.reason.is_none() {
            pair.reason = Some(reason.to_owned());
        }
        if pair.pose_source != PoseSource::None {
            self.reporter.warn("no DRR", format!("{}: {reason}", posed.label()));
        }
        // What header and telemetry contradict each other in may well be why there is no pose.
        self.cross_check(&posed, &mut pair);
        let strip = Arc::new(draw(&posed, &pair, None, None, Some(reason)));
        let (drr, scatter, compared, seen_robot, drr_sha256) = (None, None, None, None, None);
        Developed { posed, pair, drr, scatter, compared, seen_robot, strip, drr_sha256, complete: true }
    }
}

/// SHA-256 of the pixels, little-endian f32, row by row.
fn sha256_of(page: &Image<f32>) -> String {
    if cfg!(target_endian = "little") {
        // They lie in memory as they are hashed.
        return sha256_bytes(bytemuck::cast_slice(&page.pixels));
    }
    sha256_bytes(&page.pixels.iter().flat_map(|value| value.to_le_bytes()).collect::<Vec<u8>>())
}

/// The same scene, whose DRR nobody expects to have scatter.
fn without_scatter(scene: &Scene) -> Scene {
    let mut scene = scene.clone();
    scene.model.scatter = ScatterModel::Off;
    scene
}

/// What the window shows of a frame that was solved again, until its DRR is there.
pub(super) fn solved(posed: Posed) -> PairView {
    let mut pair = row(&posed);
    if posed.view.is_some() {
        pair.flags.push("the DRR of this pose is being made".to_owned());
    }
    let strip = Arc::new(Image { width: 0, height: 0, pixels: Vec::new() });
    let (drr, compared, seen_robot, scatter, drr_sha256) = (None, None, None, None, None);
    Developed { posed: Arc::new(posed), pair, drr, scatter, compared, seen_robot, strip, drr_sha256, complete: false }.picture()
}

/// The report's row of a posed frame, before anything is rendered.
fn row(posed: &Posed) -> Pair {
    let mut pair = Pair::unmatched(&posed.frame.name, "");
    pair.number = posed.number;
    pair.sha256 = posed.frame.sha256.clone();
    pair.reason = posed.pose.reason.clone();
    pair.time_us = Some(posed.time_us);
    pair.binding = how(&posed.binding).to_owned();
    pair.binding_evidence = posed.binding.evidence.clone();
    pair.copy_of = copy_of(&posed.binding);
    pair.pose_source = posed.pose_source;
    pair.status = PairStatus::of(&posed.pose, posed.pose_source);
    if let Some(doubt) = &posed.pose.doubt {
        pair.doubt(doubt);
    }
    pair.flags.extend(posed.frame.altered.iter().chain(&posed.warnings).chain(&posed.pose.cautions).cloned());
    if posed.pose.is_accepted() && !posed.pose.beads.iter().any(|bead| bead.used) {
        pair.flags.push("the pose is that of tags alone".to_owned());
    }
    pair.flags.extend(posed.binding.flags.iter().map(ToString::to_string));
    pair.edited = posed.pose.edited.clone();
    pair.rms_px = posed.pose.rms_px.filter(|_| posed.pose.is_accepted());
    pair.beads = posed.pose.beads.iter().map(BeadRow::of).collect();
    pair.rms_mm = posed.pose.rms_mm.filter(|_| posed.pose.is_accepted());
    let known = posed.k_source.filter(|_| posed.view.is_some());
    pair.k_source = posed.pose.solved_k().map(|_| KSource::Beads).or(known);
    pair.robot_source = Some(match &posed.robot {
        Some(robot) => robot.source.clone(),
        None => "scene".to_owned(),
    });
    pair.robot_cautions = posed.robot.iter().flat_map(|robot| &robot.cautions).map(ToString::to_string).collect();
    if let Some(apart) = posed.telemetry_disagreement {
        let turned_deg =
            posed.view.zip(posed.nominal).and_then(|(view, nominal)| turned_picture_deg(&view.camera_from_lps, &nominal));
        let turned =
            turned_deg.map(|deg| format!(": was the picture turned by {deg} degrees at the console?")).unwrap_or_default();
        let words = format!("telemetry and beads are {:.1} mm and {:.1} degrees apart{turned}", apart.mm, apart.deg);
        pair.doubt_by_telemetry(&words);
        pair.flags.push(words);
    }
    if let Some(words) = &posed.other_depth {
        pair.doubt_by_telemetry(words);
    }
    pair.gap_us = posed.robot.as_ref().map(|robot| robot.gap_us).max(posed.carm_gap_us);
    pair.stages_ms = posed.stages.clone();
    pair
}

/// The word of `pairs.json`.
fn how(binding: &Binding) -> &'static str {
    match binding.how {
        BindingHow::Counter => "counter",
        BindingHow::Time => "time",
        BindingHow::None => "none",
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::geometry::{Intrinsics, Projection, Rigid};
    use crate::pose::Pose;
    use crate::session::tie::Disagreement;

    fn accepted() -> Posed {
        let intrinsics = Intrinsics { fx: 1700.0, fy: 1700.0, skew: 0.0, cx: 199.5, cy: 159.5 };
        let view = View { size_px: [400, 320], intrinsics, camera_from_lps: Rigid::translation(DVec3::Z * 600.0) };
        let projection: Option<Projection> = Some(view.projection());
        Posed { pose: Pose { projection, ..Pose::default() }, view: Some(view), ..Posed::bare(1) }
    }

    #[test]
    fn a_depth_that_is_another_is_amber_with_its_words() {
        assert_eq!(row(&accepted()).status, PairStatus::Accepted);
        let pair = row(&Posed { other_depth: Some("6 mm nearer".to_owned()), ..accepted() });
        assert_eq!((pair.status, pair.reason.as_deref()), (PairStatus::AcceptedTelemetryDisagrees, Some("6 mm nearer")));
    }

    #[test]
    fn a_picture_that_lies_the_other_way_round_asks_for_the_console() {
        let apart = Some(Disagreement { mm: 7.0, deg: 180.0 });
        let turned = Rigid::exp(DVec3::Z * std::f64::consts::PI, DVec3::ZERO) * Rigid::translation(DVec3::Z * 600.0);
        let of = |nominal| {
            row(&Posed { telemetry_disagreement: apart, nominal: Some(nominal), ..accepted() }).reason.unwrap_or_default()
        };
        let words = of(turned);
        assert!(
            words.starts_with("telemetry and beads are 7.0 mm and 180.0 degrees apart: was the picture turned by 180"),
            "{words}"
        );
        assert!(!of(Rigid::translation(DVec3::Z * 600.0)).contains("console"));
    }
}
