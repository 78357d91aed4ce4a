//! The workshop: a thread that turns posed frames into pairs: scene, DRR, comparison, strip, and later the null.

use std::collections::VecDeque;
use std::sync::Arc;
use std::sync::mpsc::{Receiver, Sender, TryRecvError, channel};

use glam::{DVec2, DVec3};

use super::SessionError;
use super::board::PairView;
use super::crosscheck::{self, ExposureFacts, check_exposure, check_session};
use super::engine::{PoseSource, Posed};
use super::file::Setup;
use crate::beads::{BeadLayout, parse_markups};
use crate::compare::{Cause, CompareInput, Compared, MaskShares, Tone, compare};
use crate::geometry::View;
use crate::gpu::DeviceChoice;
use crate::image::{Image, sha256_bytes};
use crate::render::{Options, Plan, Quantity, Rendered, Renderer};
use crate::report::{self, Pair, PairStatus, StripInput};
use crate::reporter::Reporter;
use crate::scene::{self, Scene};
use crate::time::Stopwatch;
use crate::timeline::{Binding, BindingHow};

/// A pair as far as it has come; it is delivered once when it can be shown and once more with its null.
#[derive(Clone, Debug)]
pub struct Developed {
    /// The posed frame.
    pub posed: Arc<Posed>,
    /// The row of the report.
    pub pair: Pair,
    /// The matched DRR as line integral, and the scene it shows.
    pub drr: Option<(Arc<Rendered>, Arc<Scene>)>,
    /// The compared images.
    pub compared: Option<Arc<Compared>>,
    /// The strip.
    pub strip: Arc<Image<[u8; 3]>>,
    /// SHA-256 of the DRR's pixels, little-endian f32, row by row.
    pub drr_sha256: Option<String>,
    /// Whether this is the final state, null included.
    pub complete: bool,
}

impl Developed {
    /// What the window shows.
    #[must_use]
    pub fn picture(&self) -> PairView {
        let frame = &self.posed.frame;
        let shown = self.compared.as_ref().map(|compared| &compared.pictures);
        let gray = |image: &Image<f32>, window: [f64; 2]| image.map(|value| report::gray(*value, window)[0]);
        let (acquired, drr, difference) = match shown {
            Some(pictures) => {
                let window = report::window(&[&pictures.acquired, &pictures.simulated], Some(&pictures.usable));
                let half = 0.5 * (window[1] - window[0]).max(1e-9);
                let signed = |(a, b): (&f32, &f32)| report::diverging(((a - b) as f64 / half) as f32);
                let pixels = pictures.acquired.pixels.iter().zip(&pictures.simulated.pixels).map(signed).collect();
                let difference = Image::from_pixels(pictures.acquired.width, pictures.acquired.height, pixels);
                (gray(&pictures.acquired, window), Some(gray(&pictures.simulated, window)), difference)
            }
            None => (gray(&frame.pixels, report::window(&[&frame.pixels], None)), None, None),
        };
        let scores = ["zncc", "gradient_ncc", "ssim", "local_ncc", "edge_distance_mm", "rmse_nepers"];
        PairView {
            name: frame.name.clone(),
            time_us: self.posed.time_us,
            status: self.pair.status_line(),
            standing: self.pair.standing(),
            acquired,
            drr,
            difference,
            scores: scores.iter().map(|name| ((*name).to_owned(), self.pair.scores.get(name))).collect(),
        }
    }
}

/// A frame, and the plan to execute where a log has one.
type Job = (Posed, Option<Plan>);

/// The null needs about twenty small renders: it waits until no frame waits.
struct NullJob {
    developed: Developed,
    scene: Arc<Scene>,
}

/// Renders and compares on a thread of its own.
pub struct Workshop {
    jobs: Option<Sender<Job>>,
    done: Receiver<Developed>,
    thread: Option<std::thread::JoinHandle<()>>,
    layout: Option<BeadLayout>,
    adapter: String,
    inputs: Vec<scene::InputFile>,
    open: usize,
}

impl Workshop {
    /// Loads the scene and the beads, chooses a renderer, starts the thread.
    ///
    /// # Errors
    /// When scene or beads are wrong, or the renderer is not available.
    pub fn open(setup: &Setup, device: DeviceChoice, reporter: &Reporter) -> Result<Self, SessionError> {
        let scene = scene::load_text(&setup.scene_json, &setup.scene_path, false, reporter)?;
        let mut layout = match &setup.beads {
            Some((path, text)) => Some(
                parse_markups(path, text.as_bytes())
                    .map_err(|error| SessionError::Beads { path: path.display().to_string(), detail: error.to_string() })?,
            ),
            None => None,
        };
        let findings = check_session(setup, &scene, layout.as_ref());
        crosscheck::tell(&findings, reporter);
        if let Some(layout) = &mut layout {
            layout.refused = crosscheck::refusal(&findings);
        }
        let renderer = Renderer::new(device, reporter)?;
        let adapter = renderer.adapter();
        let inputs = scene.inputs.clone();
        let (jobs, inbox) = channel();
        let (outbox, done) = channel();
        let bench = Bench {
            scene,
            setup: setup.clone(),
            layout: layout.clone(),
            renderer,
            reporter: reporter.clone(),
            nulls: VecDeque::new(),
        };
        let thread = std::thread::spawn(move || bench.work(&inbox, &outbox));
        Ok(Self { jobs: Some(jobs), done, thread: Some(thread), layout, adapter, inputs, open: 0 })
    }

    /// The specimen's beads.
    #[must_use]
    pub fn layout(&self) -> Option<&BeadLayout> {
        self.layout.as_ref()
    }

    /// What renders.
    #[must_use]
    pub fn adapter(&self) -> &str {
        &self.adapter
    }

    /// Files that went into the scene.
    #[must_use]
    pub fn inputs(&self) -> &[scene::InputFile] {
        &self.inputs
    }

    /// Hands in a frame; `plan` is executed as it is where there is one, else the renderer plans.
    pub fn submit(&mut self, posed: Posed, plan: Option<Plan>) {
        if let Some(jobs) = &self.jobs
            && jobs.send((posed, plan)).is_ok()
        {
            self.open += 1;
        }
    }

    /// A pair, if one is ready.
    pub fn try_take(&mut self) -> Option<Developed> {
        let developed = self.done.try_recv().ok()?;
        self.open -= usize::from(developed.complete);
        Some(developed)
    }

    /// No more frames: waits for every pair and its null.
    ///
    /// # Errors
    /// When the thread died.
    pub fn finish(&mut self) -> Result<Vec<Developed>, SessionError> {
        self.jobs = None;
        let rest: Vec<Developed> = self.done.iter().collect();
        self.open -= rest.iter().filter(|developed| developed.complete).count().min(self.open);
        let ended = self.thread.take().is_none_or(|thread| thread.join().is_ok());
        if ended && self.open == 0 { Ok(rest) } else { Err(SessionError::WorkshopDied) }
    }
}

/// What the thread works with.
struct Bench {
    scene: Scene,
    setup: Setup,
    layout: Option<BeadLayout>,
    renderer: Renderer,
    reporter: Reporter,
    nulls: VecDeque<NullJob>,
}

impl Bench {
    fn work(mut self, inbox: &Receiver<Job>, outbox: &Sender<Developed>) {
        loop {
            let job = if self.nulls.is_empty() { inbox.recv().map_err(|_| TryRecvError::Disconnected) } else { inbox.try_recv() };
            let developed = match job {
                Ok((posed, plan)) => self.develop(posed, plan),
                Err(_) => match self.nulls.pop_front() {
                    Some(job) => self.add_null(job),
                    None => return,
                },
            };
            if outbox.send(developed).is_err() {
                return;
            }
        }
    }

    fn develop(&mut self, posed: Posed, plan: Option<Plan>) -> Developed {
        let posed = Arc::new(posed);
        let mut pair = row(&posed);
        if self.scene.robot.is_none() {
            pair.robot_source = Some("none".to_owned());
        }
        let Some(view) = posed.view else {
            return self.without(posed, pair, "no pose: nothing to render");
        };
        let scene = match self.scene_at(&posed, view) {
            Ok(scene) => Arc::new(scene),
            Err(reason) => return self.without(posed, pair, &reason),
        };
        let watch = Stopwatch::start();
        let options = Options { quantity: Quantity::LineIntegral, frame_index: posed.index, plan, ..Options::default() };
        let rendered = match self.renderer.render(&scene, &options) {
            Ok(rendered) => Arc::new(rendered),
            Err(error) => return self.without(posed, pair, &format!("not rendered: {error}")),
        };
        pair.stages_ms.add("render", watch.ms());
        pair.render_error = Some(rendered.stated_error);
        pair.flags.extend(rendered.notes.iter().cloned());
        let bytes: Vec<u8> = rendered.pages[0].pixels.iter().flat_map(|value| value.to_le_bytes()).collect();
        let drr_sha256 = Some(sha256_bytes(&bytes));

        let watch = Stopwatch::start();
        let beads = self.bead_marks(&view);
        let tool = self.tool_mask(&scene, &view);
        let mut input = CompareInput::new(&posed.frame, &rendered.pages[0]);
        input.valid = Some(&rendered.valid);
        input.beads = &beads;
        input.tool = tool.as_ref();
        input.tone = Tone::None;
        input.view = Some(&view);
        input.centre_lps_mm = self.centre();
        let compared = match compare(&input) {
            Ok(compared) => {
                pair.set_comparison(&compared.comparison);
                Some(Arc::new(compared))
            }
            Err(error) => {
                pair.flags.push(error.to_string());
                None
            }
        };
        pair.stages_ms.add("compare", watch.ms());
        self.cross_check(&posed, &mut pair);
        let watch = Stopwatch::start();
        let without = compared.is_none().then(|| pair.flags.last().cloned().unwrap_or_default());
        let strip = Arc::new(draw(&posed, &pair, compared.as_deref(), without.as_deref()));
        pair.stages_ms.add("strip", watch.ms());
        let complete = compared.is_none();
        let developed = Developed { posed, pair, drr: Some((rendered, scene.clone())), compared, strip, drr_sha256, complete };
        if !complete {
            self.nulls.push_back(NullJob { developed: developed.clone(), scene });
        }
        developed
    }

    /// What is known of the exposure from several sides, compared: disagreements are flags of the pair and counted warnings.
    fn cross_check(&self, posed: &Posed, pair: &mut Pair) {
        let shuttered = |masks: &MaskShares| masks.causes.get(&Cause::Collimation).copied().unwrap_or(0.0);
        let findings = check_exposure(&ExposureFacts {
            frame: &posed.frame,
            carm: self.setup.carm.as_ref(),
            scene: &self.scene,
            scene_json: &self.setup.scene_json,
            beam: posed.beam.as_deref(),
            from_beads: posed.view.as_ref().filter(|_| posed.pose_source == PoseSource::Beads).map(|view| &view.camera_from_lps),
            nominal: posed.nominal.as_ref(),
            centre_lps_mm: self.centre(),
            shuttered_share: pair.masks.as_ref().map(shuttered),
        });
        if let (Some(words), Some(_)) = (pair.robot_words(), &self.setup.robot) {
            self.reporter.warn("robot not told", format!("{}: {words} covers the exposure", posed.frame.name));
        }
        for finding in findings {
            self.reporter.warn(&format!("check: {}", finding.check), format!("{}: {finding}", posed.frame.name));
            pair.flags.push(finding.to_string());
        }
    }

    /// The scene at the exposure: view, robot shape.
    fn scene_at(&self, posed: &Posed, view: View) -> Result<Scene, String> {
        let scene = self.scene.with_view(view);
        match posed.robot.as_ref().filter(|_| scene.robot.is_some()) {
            Some(robot) => scene.with_robot(robot.control_angles_deg, robot.lps_from_base).map_err(|error| error.to_string()),
            None => Ok(scene),
        }
    }

    fn centre(&self) -> Option<DVec3> {
        let beads = self.layout.as_ref().filter(|layout| layout.refused.is_none()).map(BeadLayout::centroid_lps_mm);
        beads.or_else(|| self.scene.bounds().map(|(centre, _)| centre))
    }

    /// Centre and radius of each bead's shadow.
    fn bead_marks(&self, view: &View) -> Vec<(DVec2, f64)> {
        let projection = view.projection();
        let Some(layout) = &self.layout else { return Vec::new() };
        let mark = |(index, bead): (usize, &crate::beads::Bead)| {
            let (pixel, depth_mm) = projection.project(bead.lps_mm);
            let radius_px = layout.radius_mm(index, None).unwrap_or(1.0) * view.intrinsics.fx / depth_mm;
            (depth_mm > 0.0).then_some((pixel, radius_px + 1.5))
        };
        layout.beads.iter().enumerate().filter_map(mark).collect()
    }

    /// Pixels within the projected discs around the robot's parts.
    fn tool_mask(&self, scene: &Scene, view: &View) -> Option<Image<bool>> {
        let robot = scene.robot.as_ref()?;
        let crate::scene::model::Matter::Solids(solids) = &scene.objects[robot.object].matter else { return None };
        let [width, height] = view.size_px.map(|n| n as usize);
        let mut mask = Image::filled(width, height, false);
        let projection = view.projection();
        for solid in solids {
            let (centre, radius_mm) = solid.shape.bounding_sphere();
            let (pixel, depth_mm) = projection.project(solid.lps_from_local.transform_point(centre));
            if !(depth_mm > radius_mm) {
                continue;
            }
            let radius = radius_mm * view.intrinsics.fx / depth_mm;
            let rows = (pixel.y - radius).max(0.0) as usize..((pixel.y + radius).max(-1.0) + 1.0).min(height as f64) as usize;
            for row in rows {
                let half = (radius * radius - (row as f64 - pixel.y).powi(2)).max(0.0).sqrt();
                let columns = (pixel.x - half).max(0.0) as usize..((pixel.x + half).max(-1.0) + 1.0).min(width as f64) as usize;
                for column in columns {
                    *mask.at_mut(column, row) = true;
                }
            }
        }
        Some(mask)
    }

    fn add_null(&mut self, job: NullJob) -> Developed {
        let NullJob { mut developed, scene } = job;
        developed.complete = true;
        let Some(compared) = developed.compared.as_deref() else { return developed };
        let mut compared = compared.clone();
        let watch = Stopwatch::start();
        let renderer = &mut self.renderer;
        let options = Options { quantity: Quantity::LineIntegral, ..Options::default() };
        let mut rerender = |view: &View| {
            let coarse = scene.with_binned_view(*view);
            let rendered = renderer.render(&coarse, &options).map_err(|error| error.to_string())?;
            let mut page = rendered.pages.into_iter().next().ok_or_else(|| "no page".to_owned())?;
            let invalid = rendered.valid.pixels.iter().map(|valid| *valid == 0);
            page.pixels.iter_mut().zip(invalid).filter(|(_, invalid)| *invalid).for_each(|(pixel, _)| *pixel = f32::NAN);
            Ok(page)
        };
        match compared.add_null(&mut rerender, &|| false) {
            Ok(()) => {
                developed.pair.set_comparison(&compared.comparison);
                developed.pair.judge_image();
                if let Some(found) = &developed.pair.image_prefers {
                    self.reporter.warn("image disagrees", format!("{}: {found}", developed.pair.frame));
                }
            }
            Err(error) => developed.pair.flags.push(error.to_string()),
        }
        developed.pair.stages_ms.add("null", watch.ms());
        developed.strip = Arc::new(draw(&developed.posed, &developed.pair, Some(&compared), None));
        developed.compared = Some(Arc::new(compared));
        developed
    }

    fn without(&self, posed: Arc<Posed>, mut pair: Pair, reason: &str) -> Developed {
        if pair.reason.is_none() {
            pair.reason = Some(reason.to_owned());
        }
        if pair.pose_source != report::PoseSource::None {
            self.reporter.warn("no DRR", format!("{}: {reason}", posed.frame.name));
        }
        let strip = Arc::new(draw(&posed, &pair, None, Some(reason)));
        Developed { posed, pair, drr: None, compared: None, strip, drr_sha256: None, complete: true }
    }
}

fn draw(posed: &Posed, pair: &Pair, compared: Option<&Compared>, without: Option<&str>) -> Image<[u8; 3]> {
    report::strip(&StripInput {
        acquired: &posed.frame,
        pictures: compared.map(|compared| &compared.pictures),
        without,
        standing: pair.standing(),
        status: &pair.status_line(),
        scores: &pair.score_words(),
        mm_per_px: compared.and_then(|compared| compared.comparison.mm_per_px),
    })
}

/// The report's row of a posed frame, before anything is rendered.
fn row(posed: &Posed) -> Pair {
    let mut pair = Pair::unmatched(&posed.frame.name, "");
    pair.reason = posed.pose.reason.clone();
    pair.time_us = Some(posed.time_us);
    pair.binding = how(&posed.binding).to_owned();
    pair.binding_evidence = posed.binding.evidence.clone();
    pair.pose_source = match posed.pose_source {
        PoseSource::Beads => report::PoseSource::Beads,
        PoseSource::Telemetry => report::PoseSource::Telemetry,
        PoseSource::None => report::PoseSource::None,
    };
    pair.status = match (posed.pose.is_accepted(), posed.pose_source) {
        (true, _) => PairStatus::Accepted,
        (false, PoseSource::None) => PairStatus::NoPose,
        (false, _) => PairStatus::Refused,
    };
    pair.rms_px = posed.pose.rms_px.filter(|_| posed.pose.is_accepted());
    pair.rms_mm = posed.pose.rms_mm.filter(|_| posed.pose.is_accepted());
    pair.robot_source = Some(match &posed.robot {
        Some(robot) => robot.source.clone(),
        None => "scene".to_owned(),
    });
    if posed.robot.as_ref().is_some_and(|robot| robot.stale) {
        pair.flags.push("robot: telemetry is stale at the exposure".to_owned());
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
