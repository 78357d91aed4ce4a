//! Scatter that a network says instead of photons.

use super::error::TransportError;
use super::simulation::{Histories, Simulation};
use crate::geometry::View;
use crate::image::Image;
use crate::infer::{CELL_COLUMNS, CELL_ROWS, COLUMNS, InferError, Input, ROWS, ScatterNetwork};
use crate::render::{Origin, Scatter};
use crate::scene::model::Scene;

/// Keys of a card's figures: Σ(Ŝ−S)²/ΣS² of what was not trained on, without and with the noise of S.
const ERROR: &str = "nmse";
const RAW_ERROR: &str = "nmse_raw";
/// Of the second, what the first is taken to be at least: noise that is taken off may by chance be more than there is.
const LEAST: f64 = 0.1;

/// Why a network says nothing about a scene.
#[derive(Debug, thiserror::Error)]
pub enum PredictError {
    /// The scene.
    #[error(transparent)]
    Scene(#[from] TransportError),
    /// The network.
    #[error(transparent)]
    Network(#[from] InferError),
}

/// Scatter of `scene` seen in `view` as `network` has it, with the error of its card; with one as large as the scatter where the scene is
/// unlike what it was trained on, or nobody knows its error.
///
/// # Errors
/// As [`Simulation::new`]; when the network takes other inputs.
pub fn predicted(network: &dyn ScatterNetwork, scene: &Scene, view: &View) -> Result<Scatter, PredictError> {
    let raster = Histories { count: 1, seed: scene.model.seed, grid_px: [CELL_COLUMNS, CELL_ROWS], ..Histories::default() };
    let simulation = Simulation::new(scene, view, raster)?;
    let columns = simulation.columns([COLUMNS, ROWS]);
    let input = Input { inputs: columns.channels.concat(), scalars: columns.scalars.to_vec(), scale: columns.scale };
    let found = network.predict(&input)?;
    let shares: Vec<f64> = found.single.iter().zip(&found.multiple).map(|(once, more)| once + more).collect();
    let rms = (shares.iter().map(|share| share * share).sum::<f64>() / shares.len() as f64).sqrt();
    let figure = |key: &str| network.card().held_out.get(key).copied();
    let known = figure(ERROR).zip(figure(RAW_ERROR)).map(|(nmse, raw)| nmse.max(LEAST * raw).sqrt());
    let relative_error = if found.outside.is_empty() { known.unwrap_or(1.0) } else { 1.0 };
    let unit = simulation.unshaped();
    let image = |pixels: Vec<f64>| Image { width: CELL_COLUMNS, height: CELL_ROWS, pixels };
    Ok(Scatter {
        signal: image(shares.iter().zip(&unit).map(|(share, unit)| share * unit).collect()),
        error: image(unit.iter().map(|unit| relative_error * rms * unit).collect()),
        unattenuated: image(simulation.unattenuated().to_vec()),
        from: Origin::Network { sha256: network.card().weights_sha256.clone(), outside: found.outside },
        relative_error,
    })
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeMap;

    use glam::DVec3;

    use super::*;
    use crate::geometry::{Intrinsics, Rigid};
    use crate::infer::{Architecture, CELLS, Card, JudgedBy, Prediction};
    use crate::scene::model::{Matter, Shape};
    use crate::scene::optics::{Heel, Towards};
    use crate::transport::columns::{CHANNELS, SCALARS};
    use crate::transport::fixture::{scene, solid};

    /// Says the same wherever it is asked.
    struct Known {
        card: Card,
        outside: Vec<String>,
    }

    impl ScatterNetwork for Known {
        fn card(&self) -> &Card {
            &self.card
        }

        fn predict(&self, sample: &Input) -> Result<Prediction, InferError> {
            assert_eq!((sample.inputs.len(), sample.scalars.len()), (CHANNELS.len() * ROWS * COLUMNS, SCALARS.len()));
            let single = (0..CELLS).map(|cell| 0.01 * cell as f64).collect();
            Ok(Prediction { single, multiple: vec![0.02; CELLS], outside: self.outside.clone() })
        }
    }

    fn known(figures: &[(&str, f64)], outside: &[&str]) -> Known {
        let held_out: BTreeMap<String, f64> = figures.iter().map(|(name, value)| ((*name).to_owned(), *value)).collect();
        let card = Card {
            architecture: Architecture::Default,
            channels: Vec::new(),
            scalars: Vec::new(),
            scale_bounds: [0.0, 1.0],
            weights_sha256: "of the weights".to_owned(),
            training_seed: 1,
            training_epochs: 1,
            kept_epoch: None,
            training_devices: Vec::new(),
            sample_count: 1,
            set_aside: 0,
            histories_per_sample: None,
            sample_seeds: Vec::new(),
            specimens: Vec::new(),
            samples_sha256: String::new(),
            judged_by: JudgedBy::Seeds,
            held_out,
        };
        Known { card, outside: outside.iter().map(|text| (*text).to_owned()).collect() }
    }

    /// Once and more often add up, in units of the flood without the heel, be it dark there; the error is the card's, or all of it.
    #[test]
    fn what_a_network_says_is_added_up_with_the_error_of_its_card() {
        let ball = Shape::Ellipsoid { semi_axes_mm: DVec3::splat(50.0) };
        let matter = Matter::Solids(vec![solid(ball, DVec3::new(0.0, 0.0, 600.0), DVec3::ZERO, 0, 1.0)]);
        let mut scene = scene(&["water"], vec![matter]);
        scene.beam.shape.heel = Some(Heel { tube_kvp: 60.0, anode_angle_deg: 8.0, anode_towards: Towards::PlusColumn });
        let intrinsics = Intrinsics { fx: 1000.0, fy: 1000.0, skew: 0.0, cx: 199.5, cy: 149.5 };
        let view = View { size_px: [400, 300], intrinsics, camera_from_lps: Rigid::IDENTITY };
        let asked = |network: &Known| predicted(network, &scene, &view).expect("says something");
        let found = asked(&known(&[("nmse", 0.04), ("nmse_raw", 0.05)], &[]));
        assert!(found.unattenuated.pixels.contains(&0.0), "the heel leaves a cell dark");
        let shares: Vec<f64> = (0..CELLS).map(|cell| 0.01 * cell as f64 + 0.02).collect();
        let rms = (shares.iter().map(|share| share * share).sum::<f64>() / CELLS as f64).sqrt();
        for (cell, share) in shares.iter().enumerate() {
            let (signal, error) = (found.signal.pixels[cell], found.error.pixels[cell]);
            assert!(signal > 0.0 && (error / signal / (0.2 * rms / share) - 1.0).abs() < 1e-9, "cell {cell}");
        }
        // The flood without heel is the distance's: at the centre 1/192 of the image's signal and a little more.
        let (middle, mean) = (found.signal.pixels[CELL_COLUMNS * 6 + 8] / shares[CELL_COLUMNS * 6 + 8], 60.0 / CELLS as f64);
        assert!((middle / mean - 1.0).abs() < 0.05, "{middle}, {mean}");
        assert!((found.relative_error - 0.2).abs() < 1e-12);
        assert!(
            (asked(&known(&[("nmse", -0.01), ("nmse_raw", 0.1)], &[])).relative_error - 0.1).abs() < 1e-12,
            "by chance below 0"
        );
        for network in [known(&[("nmse", 0.04), ("nmse_raw", 0.05)], &["too soft"]), known(&[], &[])] {
            assert_eq!(asked(&network).relative_error, 1.0);
        }
    }
}
