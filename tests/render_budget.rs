//! A time that is predicted, and a budget, hold everything from the rays to the page: beam shape, noise and panel as well.

use std::sync::Arc;

use glam::{DVec2, DVec3};
use sidecarm::geometry::{Distortion, Glare, Intensifier, term_count};
use sidecarm::gpu::DeviceChoice;
use sidecarm::image::Image;
use sidecarm::render::plan::Plan;
use sidecarm::render::{Goal, Options, Origin, Quantity, Renderer, Scatter};
use sidecarm::reporter::Reporter;
use sidecarm::scene::Scene;
use sidecarm::scene::model::{Noise, ReadoutNoise, ScatterModel};
use sidecarm::scene::optics::Field;

use crate::render_scenes::{With, empty, solids, sphere};

/// A ball on 96×96 pixels.
fn bare() -> Scene {
    empty(&["water"]).with(solids(&[sphere(DVec3::new(0.0, 0.0, 600.0), 20.0, 0, 1.0)]))
}

fn cpu() -> Renderer {
    Renderer::new(DeviceChoice::Cpu, &Reporter::silent()).expect("cpu")
}

fn intensifier(glare: Option<Glare>) -> Intensifier {
    let distortion = Distortion::new(DVec2::splat(47.5), 46.0, 1, vec![DVec2::ZERO; term_count(1)]).expect("the identity");
    Intensifier { size_px: [96; 2], distortion, glare, note: None }
}

const GLARE: Glare = Glare { fraction: 0.1, scale_px: 20.0 };

type Change = fn(&mut Scene);

/// What beam and panel may do, each added to a scene.
fn options() -> [(&'static str, Change); 9] {
    [
        ("field", |scene| scene.beam.shape.field = Some(Field::Circle { diameter_mm: 60.0, centre_mm: DVec2::ZERO })),
        ("focal spot", |scene| scene.beam.shape.focal_spot_mm = [2.0; 2]),
        ("blur", |scene| scene.detector.panel.blur_fwhm_mm = 3.0),
        ("scatter", |scene| scene.model.scatter = ScatterModel::MonteCarlo),
        ("noise", |scene| scene.model.noise = Noise::True),
        ("crosstalk", |scene| scene.detector.crosstalk = vec![vec![1.0 / 9.0; 3]; 3]),
        ("readout", |scene| scene.detector.readout_noise = Some(ReadoutNoise { sigma: 1e-3, row_correlation: 0.2 })),
        // Last: beside what glare takes, a measured cost of noise is within the measurement's own scatter.
        ("intensifier", |scene| scene.detector.panel.intensifier = Some(intensifier(None))),
        ("glare", |scene| scene.detector.panel.intensifier = Some(intensifier(Some(GLARE)))),
    ]
}

/// Neither a prediction nor a budget knew of any of these, and the image took their time all the same.
#[test]
fn every_option_of_beam_and_panel_is_in_the_predicted_time() {
    let mut renderer = cpu();
    let mut predicted = |scene: &Scene, quantity| {
        let plan = renderer.plan(scene, &Options { quantity, ..Options::default() }).expect("a plan");
        plan.predicted_ms.expect("a model")
    };
    let mut scene = bare();
    let bare_ms = predicted(&scene, Quantity::LineIntegral);
    assert!(predicted(&scene, Quantity::Counts) > bare_ms);
    let (mut before_ms, mut cases) = (bare_ms, 0);
    for (name, add) in options() {
        add(&mut scene);
        let with_ms = predicted(&scene, Quantity::LineIntegral);
        assert!(with_ms > before_ms, "{name}: {with_ms} ms, {before_ms} ms without");
        (before_ms, cases) = (with_ms, cases + 1);
    }
    assert_eq!(cases, 9);
    // The control: of paths alone there is neither a beam nor a panel.
    let paths_ms = predicted(&scene, Quantity::AreaDensity);
    assert_eq!(predicted(&bare(), Quantity::AreaDensity), paths_ms);
}

#[test]
fn a_budget_is_not_promised_to_an_image_whose_panel_takes_longer() {
    let mut renderer = cpu();
    let mut plan = |scene: &Scene, goal: Goal| -> Plan {
        renderer.plan(scene, &Options { goal: Some(goal), ..Options::default() }).expect("a plan")
    };
    let ms_of = |plan: &Plan| plan.predicted_ms.expect("a model");
    let (plain, mut glaring) = (bare(), bare());
    glaring.detector.panel.intensifier = Some(intensifier(Some(GLARE)));
    let error = Goal::MaxError(1e-3);
    let (plain_ms, glaring_ms) = (ms_of(&plan(&plain, error)), ms_of(&plan(&glaring, error)));
    let between = Goal::BudgetMs(0.5 * (plain_ms + glaring_ms));
    let refused = plan(&glaring, between);
    assert!(
        refused.explain().contains("cannot be met") && refused.explain().contains("noise and panel"),
        "{}",
        refused.explain()
    );
    // The control: without its panel the image can be made, and with twice the time with it.
    assert!(!plan(&plain, between).explain().contains("cannot be met"));
    assert!(!plan(&glaring, Goal::BudgetMs(2.0 * glaring_ms)).explain().contains("cannot be met"));
}

/// A stage that is added to the image needs a cost.
#[test]
fn an_image_has_no_stage_that_nobody_predicts() {
    let mut scene = bare();
    options().into_iter().for_each(|(_, add)| add(&mut scene));
    let cells = |value: f64| Image { width: 4, height: 4, pixels: vec![value; 16] };
    let scatter = Scatter {
        signal: cells(0.1),
        error: cells(1e-3),
        unattenuated: cells(1.0),
        from: Origin::Photons { histories: 1, seed: 1, device: "cpu".to_owned() },
        relative_error: 0.01,
    };
    let options = Options { quantity: Quantity::Counts, scatter: Some(Arc::new(scatter)), ..Options::default() };
    let rendered = cpu().render(&scene, &options).expect("renders");
    let ahead = ["prepare", "calibrate", "plan"];
    let mut stages: Vec<&str> = rendered.stages.iter().map(|(stage, _)| stage).filter(|stage| !ahead.contains(stage)).collect();
    stages.sort_unstable();
    let costed =
        ["add_noise", "add_scatter", "attenuate_spectrum", "cut_faces", "detect", "distort", "integrate_density", "shape_beam"];
    assert_eq!(stages, costed);
}
