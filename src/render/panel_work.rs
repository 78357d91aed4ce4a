//! What a scene asks of the stages between attenuation and the page, for what they cost.

use super::Quantity;
use super::blur::{focal_blur, gaussian_kernel};
use super::detector::scintillator_sigma_px;
use super::flood::is_plain;
use super::panel_costs::PanelWork;
use super::plan::{Executor, noise_applies};
use super::veil::block_pairs;
use crate::geometry::View;
use crate::scene::model::{Formation, ScatterModel, Scene};
use crate::scene::optics::Field;

/// Of an image of `scene` from `view` that `executor` casts. Scatter counts where the scene asks for it: that somebody has found out about it.
pub(super) fn panel_work(scene: &Scene, view: &View, quantity: Quantity, executor: Executor) -> PanelWork {
    if quantity == Quantity::AreaDensity {
        return PanelWork::default();
    }
    let (shape, panel) = (&scene.beam.shape, &scene.detector.panel);
    let noise = noise_applies(scene, quantity);
    let scatter = scatters(scene);
    let (mut blurred, mut weights) = (0.0, [0.0; 2]);
    let mut blur = |sigma_px: [f64; 2], fields: f64| {
        blurred += 1.0;
        for (weights, sigma_px) in weights.iter_mut().zip(sigma_px).filter(|(_, sigma_px)| *sigma_px > 0.0) {
            *weights += fields * gaussian_kernel(sigma_px * sigma_px).len() as f64;
        }
    };
    if let Some(focal) = focal_blur(scene, view) {
        // With noise the photons, their response and its square as well.
        blur(focal.sigma_px, if noise { 4.0 } else { 1.0 });
    }
    if panel.blur_fwhm_mm > 0.0 {
        // With noise the quanta as well.
        blur(scintillator_sigma_px(scene, view), if noise { 2.0 } else { 1.0 });
    }
    let side = scene.detector.crosstalk.len();
    PanelWork {
        pixels: f64::from(view.size_px[0]) * f64::from(view.size_px[1]),
        flood: wants_photons(scene, quantity) && !shape.varies() && shape.field.is_none(),
        field: match &shape.field {
            None => [0.0; 3],
            Some(Field::Circle { .. }) => [1.0, 0.0, 0.0],
            Some(Field::Rectangle { .. }) => [0.0, 1.0, 0.0],
            Some(Field::Polygon { corners_mm }) => [0.0, 0.0, corners_mm.len() as f64],
        },
        blurred,
        weights,
        scatter,
        distorted: panel.intensifier.is_some(),
        noise,
        // Shaders draw it where the beam is as they know it.
        drawn: noise && !(executor == Executor::Wgsl && is_plain(scene) && !scatter),
        crosstalk: if noise && side > 1 { (side * side) as f64 } else { 0.0 },
        readout: noise && scene.detector.readout_noise.is_some(),
        block_pairs: if glares(scene) { block_pairs(view.size_px.map(|n| n as usize)) } else { 0.0 },
        plain_page: quantity == Quantity::LineIntegral && !noise,
    }
}

/// How many times heel or bow-tie are evaluated at every energy: without an object, and with it.
pub(super) fn shaped(scene: &Scene, quantity: Quantity) -> [f64; 2] {
    let shape = &scene.beam.shape;
    if quantity == Quantity::AreaDensity || !shape.varies() {
        return [0.0; 2];
    }
    let alone = wants_photons(scene, quantity) || shape.heel.is_some() || shape.field.is_some();
    [alone, scene.model.formation == Formation::Deepdrr].map(|is_so| f64::from(u8::from(is_so)))
}

/// Whether N₀(u) is wanted.
fn wants_photons(scene: &Scene, quantity: Quantity) -> bool {
    noise_applies(scene, quantity) || quantity == Quantity::Counts || glares(scene) || scatters(scene)
}

fn glares(scene: &Scene) -> bool {
    scene.detector.panel.intensifier.as_ref().is_some_and(|intensifier| intensifier.glare.is_some())
}

fn scatters(scene: &Scene) -> bool {
    scene.model.possible_scatter() != ScatterModel::Off
}

#[cfg(test)]
mod tests {
    use glam::{DQuat, DVec2, DVec3};

    use super::*;
    use crate::geometry::{Distortion, Glare, Intensifier, Intrinsics, Rigid, term_count};
    use crate::scene::model::{Matter, Noise, Object, ReadoutNoise, Shape, Solid};
    use crate::scene::optics::{Axis, BowTie};
    use crate::scene::physics::{Material, Spectrum};

    /// A ball half-way to a panel of 192×96 px of 1 mm.
    fn scene() -> Scene {
        let mut scene = Scene::plain(Spectrum::mono(60.0).expect("inside"));
        let water = scene.material_index(Material::parse("water").expect("known"));
        let ball = Solid {
            shape: Shape::Ellipsoid { semi_axes_mm: DVec3::splat(20.0) },
            lps_from_local: Rigid::translation(DVec3::Z * 500.0),
            material: water,
            density_g_per_cm3: 1.0,
        };
        scene.objects.push(Object { name: "ball".to_owned(), body: String::new(), matter: Matter::Solids(vec![ball]) });
        scene.detector.pitch_mm = 1.0;
        scene.detector.crosstalk = Vec::new();
        scene
    }

    fn view() -> View {
        View {
            size_px: [192, 96],
            intrinsics: Intrinsics { fx: 1000.0, fy: 1000.0, skew: 0.0, cx: 95.5, cy: 47.5 },
            camera_from_lps: Rigid { rotation: DQuat::IDENTITY, translation_mm: DVec3::ZERO },
        }
    }

    fn intensifier(glare: Option<Glare>) -> Intensifier {
        let shift_px = vec![DVec2::ZERO; term_count(1)];
        let distortion = Distortion::new(DVec2::new(95.5, 47.5), 90.0, 1, shift_px).expect("the identity");
        Intensifier { size_px: [192, 96], distortion, glare, note: None }
    }

    /// Each option asks for its own stages, and the options together for all.
    #[test]
    fn each_option_of_beam_and_panel_asks_for_its_stages() {
        let of = |change: &dyn Fn(&mut Scene)| {
            let mut scene = scene();
            change(&mut scene);
            panel_work(&scene, &view(), Quantity::LineIntegral, Executor::Cpu)
        };
        let bare = of(&|_| ());
        assert_eq!(bare, PanelWork { pixels: 192.0 * 96.0, plain_page: true, ..PanelWork::default() });
        let noisy = PanelWork { flood: true, noise: true, drawn: true, plain_page: false, ..bare };
        assert_eq!(of(&|scene| scene.model.noise = Noise::True), noisy);
        // One pixel of deviation, to 8.5 of them and two more; each weight but the first serves both sides.
        let blur = |scene: &mut Scene| scene.detector.panel.blur_fwhm_mm = 2.0 * (2.0 * 2f64.ln()).sqrt();
        let kernel = gaussian_kernel(1.0).len() as f64;
        assert!((10.0..16.0).contains(&kernel), "{kernel}");
        assert_eq!(of(&blur), PanelWork { blurred: 1.0, weights: [kernel; 2], ..bare });
        let both = |scene: &mut Scene| {
            blur(scene);
            scene.model.noise = Noise::Paper;
        };
        assert_eq!(of(&both), PanelWork { blurred: 1.0, weights: [2.0 * kernel; 2], ..noisy });
        // At half the distance a spot is drawn as wide as it is.
        let spot = |scene: &mut Scene| scene.beam.shape.focal_spot_mm = [2.0 * (2.0 * 2f64.ln()).sqrt(), 0.0];
        assert_eq!(of(&spot), PanelWork { blurred: 1.0, weights: [kernel, 0.0], ..bare });
        let both = |scene: &mut Scene| {
            spot(scene);
            scene.model.noise = Noise::True;
        };
        assert_eq!(of(&both), PanelWork { blurred: 1.0, weights: [4.0 * kernel, 0.0], ..noisy });
        let circle = |scene: &mut Scene| {
            scene.beam.shape.field = Some(Field::Circle { diameter_mm: 50.0, centre_mm: DVec2::ZERO });
        };
        assert_eq!(of(&circle), PanelWork { field: [1.0, 0.0, 0.0], ..bare });
        let polygon = |scene: &mut Scene| {
            let corners_mm = vec![DVec2::ZERO, DVec2::X, DVec2::Y];
            scene.beam.shape.field = Some(Field::Polygon { corners_mm });
        };
        assert_eq!(of(&polygon), PanelWork { field: [0.0, 0.0, 3.0], ..bare });
        let scatter = of(&|scene| scene.model.scatter = ScatterModel::Network);
        assert_eq!(scatter, PanelWork { scatter: true, flood: true, ..bare });
        let electronics = |scene: &mut Scene| {
            scene.detector.crosstalk = vec![vec![1.0 / 9.0; 3]; 3];
            scene.detector.readout_noise = Some(ReadoutNoise { sigma: 1e-3, row_correlation: 0.0 });
        };
        assert_eq!(of(&electronics), bare, "there is no noise that they could be part of");
        let both = |scene: &mut Scene| {
            electronics(scene);
            scene.model.noise = Noise::True;
        };
        assert_eq!(of(&both), PanelWork { crosstalk: 9.0, readout: true, ..noisy });
        let dull = of(&|scene| scene.detector.panel.intensifier = Some(intensifier(None)));
        assert_eq!(dull, PanelWork { distorted: true, ..bare });
        let glare = Some(Glare { fraction: 0.1, scale_px: 40.0 });
        let glaring = of(&|scene| scene.detector.panel.intensifier = Some(intensifier(glare)));
        let block_pairs = (96.0f64 * 48.0).powi(2);
        assert_eq!(glaring, PanelWork { distorted: true, flood: true, block_pairs, ..bare });
        let naive = of(&|scene| {
            (scene.model.formation, scene.model.noise) = (Formation::Naive, Noise::True);
            scene.model.scatter = ScatterModel::MonteCarlo;
        });
        assert_eq!(naive, bare, "it has neither noise nor scatter");
    }

    #[test]
    fn what_is_asked_hangs_on_the_page_and_on_who_casts() {
        let mut noisy = scene();
        noisy.model.noise = Noise::True;
        let drawn = |scene: &Scene, executor| panel_work(scene, &view(), Quantity::Intensity, executor).drawn;
        assert!(drawn(&noisy, Executor::Cpu) && !drawn(&noisy, Executor::Wgsl));
        noisy.beam.shape.focal_spot_mm = [0.5; 2];
        assert!(drawn(&noisy, Executor::Wgsl), "the shaders' photons are those before the blur");
        assert_eq!(panel_work(&noisy, &view(), Quantity::AreaDensity, Executor::Cpu), PanelWork::default());
        let counts = panel_work(&scene(), &view(), Quantity::Counts, Executor::Cpu);
        assert!(counts.flood && !counts.plain_page);
    }

    #[test]
    fn a_bow_tie_alone_is_evaluated_without_an_object_only_where_somebody_asks() {
        let mut scene = scene();
        assert_eq!(shaped(&scene, Quantity::Counts), [0.0; 2]);
        let material = Material::parse("Al").expect("known");
        let bowtie = BowTie { material, density_g_per_cm3: 2.7, axis: Axis::Column, thickness_mm: vec![[0.0, 1.0]] };
        scene.beam.shape.bowtie = Some(bowtie);
        assert_eq!(shaped(&scene, Quantity::LineIntegral), [0.0, 1.0]);
        assert_eq!(shaped(&scene, Quantity::Counts), [1.0, 1.0]);
        assert!(!panel_work(&scene, &view(), Quantity::Counts, Executor::Cpu).flood, "it is the bow-tie's already");
        scene.model.formation = Formation::Naive;
        assert_eq!(shaped(&scene, Quantity::LineIntegral), [0.0; 2]);
        assert_eq!(shaped(&scene, Quantity::AreaDensity), [0.0; 2]);
    }
}
