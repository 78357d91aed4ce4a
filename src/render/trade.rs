//! The trade between accuracy and time, measured: every combination of sampling, energies and cast pixels, against the yardstick.

use std::fmt::Write as _;

use serde::Serialize;

use super::achieved::Achieved;
use super::before_panel::{before_panel, is_before_panel};
use super::cpu::attenuate_spectrum::attenuate_spectrum;
use super::cpu::fixed_lanes::is_fast;
use super::cpu::resample_overlap::overlap_by_resampling;
use super::plan::{Plan, Sampling};
use super::planner::Goal;
use super::spectrum::{Bins, whole_spectrum};
use super::{Options, Quantity, RenderError, Renderer, survey};
use crate::image::plot::{Axis, Plot, PlotError, Scale, Series, Stroke};
use crate::reporter::Reporter;
use crate::scene::model::Scene;
use crate::time::Stopwatch;

/// One way to make the image, and what came of it.
#[derive(Clone, Debug, Serialize)]
pub struct Row {
    /// How volumes were sampled.
    pub sampling: Sampling,
    /// Energies that every pixel was evaluated at.
    pub energies: usize,
    /// Every which pixel was cast.
    pub step_px: u32,
    /// `exact`, or the grid of a resampled overlap (Eq. 5).
    pub displacement: String,
    /// Bound that the plan states; `None` where a way states none.
    pub stated_error: Option<f64>,
    /// Measured against the yardstick.
    pub achieved: Achieved,
    /// By the cost model.
    pub predicted_ms: Option<f64>,
    /// Whether nothing else is both faster and closer.
    pub on_front: bool,
}

/// All rows, by time.
#[derive(Clone, Debug, Serialize)]
pub struct Trade {
    /// Columns, rows.
    pub size_px: [u32; 2],
    /// Device, driver, version.
    pub adapter: String,
    /// Rays that the yardstick cast to measure errors.
    pub judged_rays: usize,
    /// What errors are errors of.
    pub judged: String,
    /// What was measured.
    pub rows: Vec<Row>,
}

/// Grid spacings of resampled overlaps that are measured, mm.
const GRIDS_MM: [f64; 2] = [1.0, 0.5];

/// Measures every combination, on line integrals before the panel: noise, collimation and blur, which the thin yardstick could not share, are
/// left out. The yardstick casts every n-th pixel of images over 128 pixels wide.
///
/// # Errors
/// As [`Renderer::render`].
pub fn sweep(scene: &Scene, renderer: &mut Renderer, reporter: &Reporter) -> Result<Trade, RenderError> {
    let without_panel = !is_before_panel(scene);
    let scene = before_panel(scene);
    let view = scene.view.ok_or(RenderError::NoView)?;
    let [width, height] = view.size_px;
    // Odd, so that pixels between cast ones are judged too.
    let stride = (width.max(height) / 96).max(1) | 1;
    let mut thin = scene.clone();
    if stride > 1 {
        // fx · pitch stays: the detector does not move.
        thin.view = Some(survey::every(&view, stride));
        thin.detector.pitch_mm *= f64::from(stride);
    }
    let quantity = Quantity::LineIntegral;
    reporter.note(format_args!("yardstick: every {stride} px"));
    let yardstick = renderer.render(&thin, &Options { quantity, reference: true, ..Options::default() })?;
    let judged = Judged::new(&yardstick.pages[0].pixels, yardstick.pages[0].width, [width, height], stride);
    let mut rows = Vec::new();
    for goal in goals() {
        let options = Options { quantity, goal: Some(goal), ..Options::default() };
        let plan = renderer.plan(&scene, &options)?;
        if rows.iter().any(|row: &Row| row.same_as(&plan)) {
            continue;
        }
        let options = Options { plan: Some(plan.clone()), ..options };
        let mut ms = f64::INFINITY;
        let mut pixels = Vec::new();
        // Once to warm up, then the fastest.
        for round in 0..4 {
            let mut rendered = renderer.render(&scene, &options)?;
            ms = if round == 0 { ms } else { ms.min(rendered.image_ms()) };
            pixels = rendered.pages.remove(0).pixels;
        }
        let achieved = judged.judge(&pixels, ms);
        reporter.note(format_args!(
            "{}, {} energies, step {}: {:.1} ms, error {:.1e}",
            sampling_name(plan.sampling),
            plan.energy_nodes.len(),
            plan.step_px,
            ms,
            achieved.error
        ));
        rows.push(Row {
            sampling: plan.sampling,
            energies: plan.energy_nodes.len(),
            step_px: plan.step_px,
            displacement: if plan.displacement { "exact" } else { "none" }.to_owned(),
            stated_error: Some(plan.stated_error),
            achieved,
            predicted_ms: plan.predicted_ms,
            on_front: false,
        });
    }
    rows.extend(resampled_overlaps(&scene, &judged)?);
    mark_front(&mut rows);
    rows.sort_by(|a, b| a.achieved.ms.total_cmp(&b.achieved.ms));
    let left_out = if without_panel { "; the scene's noise, collimation and blur are left out" } else { "" };
    let words = format!("line integrals before the panel{left_out}");
    Ok(Trade {
        size_px: view.size_px,
        adapter: renderer.adapter_with_threads(),
        judged_rays: judged.expected.len(),
        judged: words,
        rows,
    })
}

fn goals() -> Vec<Goal> {
    let mut goals = Vec::new();
    let mut add = |sampling, energies, step_px| goals.push(Goal::Explicit { sampling, energies, step_px });
    for energies in [Some(3e-2), Some(1e-2), Some(1e-3), Some(1e-4), Some(1e-5), Some(3e-6), None] {
        add(Sampling::ExactSlabs, energies, 1);
    }
    for step_px in [2, 4] {
        for energies in [Some(1e-2), Some(1e-3)] {
            add(Sampling::ExactSlabs, energies, step_px);
        }
    }
    // Where it is not fast, no plan takes it.
    if is_fast() {
        for energies in [Some(1e-2), Some(1e-3), Some(1e-4), None] {
            add(Sampling::FixedSlabs, energies, 1);
        }
        for step_px in [2, 4] {
            for energies in [Some(1e-2), Some(1e-3)] {
                add(Sampling::FixedSlabs, energies, step_px);
            }
        }
    }
    add(Sampling::ExactCells, Some(1e-5), 1);
    add(Sampling::ExactCells, None, 1);
    goals
}

/// Eq. 5 with a resampled third volume, where the scene is one CT and then shapes: what exact masking is better than.
fn resampled_overlaps(scene: &Scene, judged: &Judged) -> Result<Vec<Row>, RenderError> {
    let (Some(view), Ok(bins)) = (scene.view, Bins::new(scene, &whole_spectrum(scene))) else { return Ok(Vec::new()) };
    let mut rows = Vec::new();
    for grid_mm in GRIDS_MM {
        let watch = Stopwatch::start();
        // Other scenes have no such volume: nothing to measure.
        let Ok(density) = overlap_by_resampling(scene, &view, grid_mm) else { return Ok(Vec::new()) };
        let line = attenuate_spectrum(&density, &bins, false).line_integral;
        rows.push(Row {
            sampling: Sampling::ExactCells,
            energies: whole_spectrum(scene).len(),
            step_px: 1,
            displacement: format!("overlap resampled at {grid_mm} mm"),
            stated_error: None,
            achieved: judged.judge(&line, watch.ms()),
            predicted_ms: None,
            on_front: false,
        });
    }
    Ok(rows)
}

impl Row {
    fn same_as(&self, plan: &Plan) -> bool {
        self.sampling == plan.sampling && self.energies == plan.energy_nodes.len() && self.step_px == plan.step_px
    }
}

/// The yardstick's pixels and where they lie in the image.
struct Judged {
    expected: Vec<f32>,
    at: Vec<usize>,
}

impl Judged {
    fn new(pixels: &[f32], columns: usize, [width, height]: [u32; 2], stride: u32) -> Self {
        let (mut expected, mut at) = (Vec::new(), Vec::new());
        for (index, value) in pixels.iter().enumerate() {
            let (u, v) = (index % columns * stride as usize, index / columns * stride as usize);
            if u < width as usize && v < height as usize {
                expected.push(*value);
                at.push(v * width as usize + u);
            }
        }
        Self { expected, at }
    }

    fn judge(&self, pixels: &[f32], ms: f64) -> Achieved {
        let found: Vec<f32> = self.at.iter().map(|pixel| pixels[*pixel]).collect();
        Achieved::of(&found, &self.expected, ms)
    }
}

fn mark_front(rows: &mut [Row]) {
    let points: Vec<(f64, f64)> = rows.iter().map(|row| (row.achieved.ms, row.achieved.error)).collect();
    for (index, row) in rows.iter_mut().enumerate() {
        let (ms, error) = points[index];
        row.on_front =
            !points.iter().enumerate().any(|(other, (m, e))| *m <= ms && *e <= error && (*m < ms || *e < error || other < index));
    }
}

impl Trade {
    /// Rows as text, the front marked with `*`.
    #[must_use]
    pub fn table(&self) -> String {
        let mut text = format!(
            "{} x {} px on {}; error against the yardstick on {} rays, of {}\n  {:>9} {:>9} {:>9} {:>9} {:>9}  way\n",
            self.size_px[0],
            self.size_px[1],
            self.adapter,
            self.judged_rays,
            self.judged,
            "ms",
            "predicted",
            "error",
            "stated",
            "worst"
        );
        for row in &self.rows {
            let ms = |ms: Option<f64>| ms.map_or("-".to_owned(), |ms| format!("{ms:.1}"));
            let error = |error: Option<f64>| error.map_or("-".to_owned(), |error| format!("{error:.1e}"));
            let _ = writeln!(
                text,
                "{} {:>9.1} {:>9} {:>9.1e} {:>9} {:>9.1e}  {}, {} energies, every {} px, displacement {}",
                if row.on_front { '*' } else { ' ' },
                row.achieved.ms,
                ms(row.predicted_ms),
                row.achieved.error,
                error(row.stated_error),
                row.achieved.worst,
                row.name(),
                row.energies,
                row.step_px,
                row.displacement
            );
        }
        text
    }

    /// Error against time, the front as a line.
    ///
    /// # Errors
    /// When nothing can be drawn.
    pub fn plot(&self) -> Result<String, PlotError> {
        let point = |row: &Row| [row.achieved.ms, row.achieved.error.max(1e-8)];
        let mut series = Vec::new();
        let front: Vec<[f64; 2]> = self.rows.iter().filter(|row| row.on_front).map(point).collect();
        series.push(Series { label: "Pareto front".to_owned(), points: front, colour: Some(0), ..Series::default() });
        let ways = [
            ("fixed point", Sampling::FixedSlabs),
            ("exact in slabs", Sampling::ExactSlabs),
            ("exact, cell by cell", Sampling::ExactCells),
        ];
        for (label, sampling) in ways {
            let points: Vec<[f64; 2]> = self.rows.iter().filter(|row| row.sampling == sampling).map(point).collect();
            if !points.is_empty() {
                series.push(Series { label: label.to_owned(), points, stroke: Stroke::Points, ..Series::default() });
            }
        }
        let plot = Plot {
            title: format!("Error against time, {} x {} px", self.size_px[0], self.size_px[1]),
            x: Axis::new("time / ms", Scale::Log),
            y: Axis::new("error, 99.9th percentile", Scale::Log),
            series,
            ..Plot::default()
        };
        plot.svg()
    }
}

impl Row {
    fn name(&self) -> &'static str {
        sampling_name(self.sampling)
    }
}

/// As tables have it.
fn sampling_name(sampling: Sampling) -> &'static str {
    match sampling {
        Sampling::ExactSlabs => "exact in slabs",
        Sampling::FixedSlabs => "in slabs, fixed point",
        Sampling::ExactCells => "exact, cell by cell",
        Sampling::PiecewiseConstant => "piecewise constant",
        Sampling::None => "no volume",
    }
}
