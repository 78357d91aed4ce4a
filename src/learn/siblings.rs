//! How good a network is that was trained on everything: as its siblings are on what they never saw.

use std::collections::BTreeMap;
use std::path::PathBuf;

use super::LearnError;
use super::figures::{EDGE_BIAS, EDGE_CELLS, MEAN_RMS, SAMPLES};
use crate::infer::{Card, JudgedBy, NetworkFiles};

/// Writes into `card` the figures of `siblings`: of each by the specimen it was not trained on, and their mean by samples. Without siblings
/// nothing changes.
///
/// # Errors
/// When a sibling is of other samples or layers, does not hold out one specimen of its own, or `card` is of a network that holds out.
pub(super) fn judge(card: &mut Card, siblings: &[PathBuf]) -> Result<(), LearnError> {
    if siblings.is_empty() {
        return Ok(());
    }
    let (mut weights_sha256, mut sums) = (BTreeMap::new(), BTreeMap::<String, f64>::new());
    for path in siblings {
        let files = NetworkFiles::of(path);
        let (sibling, _) = files.read()?;
        let no = |because: &'static str| Err(LearnError::NoSibling { path: files.card.clone(), because });
        if card.judged_by != JudgedBy::Nothing {
            return no("this training holds out samples of its own");
        }
        if sibling.samples_sha256 != card.samples_sha256 {
            return no("it was trained on other samples");
        }
        let made = |card: &Card| (card.architecture, card.training_seed, card.training_epochs);
        if made(&sibling) != made(card) {
            return no("its layers, its seed or its epochs are others");
        }
        let JudgedBy::Specimens { names } = &sibling.judged_by else { return no("it holds out no specimen") };
        let [name] = names.as_slice() else { return no("it holds out more than one specimen") };
        if weights_sha256.insert(name.clone(), sibling.weights_sha256.clone()).is_some() {
            return no("another one holds out the same specimen");
        }
        let count = |figure: &str| sibling.held_out.get(figure).copied().unwrap_or(f64::NAN);
        let (samples, cells) = (count(SAMPLES), count(EDGE_CELLS));
        for (figure, value) in &sibling.held_out {
            card.held_out.insert(format!("{figure} of {name}"), *value);
            *sums.entry(figure.clone()).or_default() += match figure.as_str() {
                SAMPLES | EDGE_CELLS => *value,
                MEAN_RMS => samples * value * value,
                EDGE_BIAS => cells * value,
                _ => samples * value,
            };
        }
    }
    let all = sums.get(SAMPLES).copied().unwrap_or(f64::NAN);
    let cells = sums.get(EDGE_CELLS).copied().unwrap_or(f64::NAN);
    for (figure, sum) in sums {
        let of_all = match figure.as_str() {
            SAMPLES | EDGE_CELLS => sum,
            MEAN_RMS => (sum / all).sqrt(),
            // Nothing ends anywhere where there are none.
            EDGE_BIAS if cells == 0.0 => 0.0,
            EDGE_BIAS => sum / cells,
            _ => sum / all,
        };
        card.held_out.insert(figure, of_all);
    }
    card.judged_by = JudgedBy::Siblings { weights_sha256 };
    Ok(())
}
