//! How good a network is that was trained on everything: as its siblings are on what they never saw.

use std::collections::BTreeMap;
use std::path::PathBuf;

use super::LearnError;
use super::figures::{EDGE_BIAS, EDGE_CELLS, MEAN_RMS, SAMPLES};
use crate::infer::materials::MaterialsCard;
use crate::infer::{Card, JudgedBy, NetworkCard, NetworkFiles};

/// A card whose figures can be those of siblings.
pub(super) trait Judged: NetworkCard {
    /// What siblings have in common, besides their samples.
    fn made(&self) -> String;

    /// SHA-256 of all samples.
    fn samples_sha256(&self) -> &str;

    /// The figures, and what they were found on.
    fn judgement(&mut self) -> (&mut JudgedBy, &mut BTreeMap<String, f64>);

    /// What a figure is over all that the siblings were judged by.
    fn together(figure: &str, of: &[&BTreeMap<String, f64>]) -> f64;
}

fn value(figures: &BTreeMap<String, f64>, name: &str) -> f64 {
    figures.get(name).copied().unwrap_or(f64::NAN)
}

impl Judged for Card {
    fn made(&self) -> String {
        // One that stopped early at its best says nothing of one that went on to its end.
        let chose = self.set_aside > 0;
        format!("{:?} {} {} {chose}", self.architecture, self.training_seed, self.training_epochs)
    }

    fn samples_sha256(&self) -> &str {
        &self.samples_sha256
    }

    fn judgement(&mut self) -> (&mut JudgedBy, &mut BTreeMap<String, f64>) {
        (&mut self.judged_by, &mut self.held_out)
    }

    fn together(figure: &str, of: &[&BTreeMap<String, f64>]) -> f64 {
        let sum = |weight: &dyn Fn(&BTreeMap<String, f64>) -> f64| of.iter().map(|figures| weight(figures)).sum::<f64>();
        let mean = |count: &str, power: i32| {
            sum(&|figures| value(figures, count) * value(figures, figure).powi(power)) / sum(&|figures| value(figures, count))
        };
        match figure {
            SAMPLES | EDGE_CELLS => sum(&|figures| value(figures, figure)),
            MEAN_RMS => mean(SAMPLES, 2).sqrt(),
            // Nothing ends anywhere where there are none.
            EDGE_BIAS if sum(&|figures| value(figures, EDGE_CELLS)) == 0.0 => 0.0,
            EDGE_BIAS => mean(EDGE_CELLS, 1),
            _ => mean(SAMPLES, 1),
        }
    }
}

impl Judged for MaterialsCard {
    fn made(&self) -> String {
        let Self { materials, training_seed, training_epochs, training_steps, training_batch, .. } = self;
        let chose = self.set_aside > 0;
        format!("{materials:?} {training_seed} {training_epochs} {training_steps} {training_batch} {chose}")
    }

    fn samples_sha256(&self) -> &str {
        &self.samples_sha256
    }

    fn judgement(&mut self) -> (&mut JudgedBy, &mut BTreeMap<String, f64>) {
        (&mut self.judged_by, &mut self.held_out)
    }

    fn together(figure: &str, of: &[&BTreeMap<String, f64>]) -> f64 {
        of.iter().map(|figures| value(figures, figure)).sum::<f64>() / of.len() as f64
    }
}

/// Writes into `card` the figures of `siblings`, beside those that it has of its own: of each by the specimen it was not trained on, and over all of
/// them. Without siblings nothing changes, nor while one is still in training, unless this is what the training comes to.
///
/// # Errors
/// When a sibling is of other samples or layers, does not hold out one specimen of its own, is not at its end when this is, or `card` is of a network
/// that holds out.
pub(super) fn judge<C: Judged>(card: &mut C, siblings: &[PathBuf], is_last: bool) -> Result<(), LearnError> {
    if siblings.is_empty() {
        return Ok(());
    }
    let mut weights_sha256 = BTreeMap::new();
    let mut figures = card.judgement().1.clone();
    let own = figures.clone();
    let mut of_all: Vec<BTreeMap<String, f64>> = Vec::new();
    for path in siblings {
        let files = NetworkFiles::of(path);
        let (mut sibling, _) = files.read::<C>()?;
        let no = |because: &'static str| Err(LearnError::NoSibling { path: files.card.clone(), because });
        if *card.judgement().0 != JudgedBy::Nothing {
            return no("this training holds out samples of its own");
        }
        if sibling.samples_sha256() != card.samples_sha256() {
            return no("it was trained on other samples");
        }
        if sibling.made() != card.made() {
            return no("its layers, its seed or its epochs are others, or it chose one of them");
        }
        let sha256 = sibling.weights_sha256().to_owned();
        let (judged_by, found) = sibling.judgement();
        let JudgedBy::Specimens { names } = &*judged_by else { return no("it holds out no specimen") };
        let [name] = names.as_slice() else { return no("it holds out more than one specimen") };
        // Those of the first are as good as any: a training that is not at its end has none, or fewer.
        let of_first = of_all.first().unwrap_or(found);
        if !is_last && found.is_empty() {
            return Ok(());
        }
        if found.is_empty() || !found.keys().eq(of_first.keys()) || !found.values().all(|value| value.is_finite()) {
            return no("its card lacks figures: its training is not at its end");
        }
        if weights_sha256.insert(name.clone(), sha256).is_some() {
            return no("another one holds out the same specimen");
        }
        let of_sibling = found.iter().filter(|(figure, _)| !own.contains_key(*figure));
        figures.extend(of_sibling.map(|(figure, value)| (format!("{figure} of {name}"), *value)));
        of_all.push(found.clone());
    }
    let of_all: Vec<&BTreeMap<String, f64>> = of_all.iter().collect();
    for figure in of_all.iter().flat_map(|found| found.keys()).filter(|figure| !own.contains_key(*figure)) {
        figures.insert(figure.clone(), C::together(figure, &of_all));
    }
    let (by, own) = card.judgement();
    (*by, *own) = (JudgedBy::Siblings { weights_sha256 }, figures);
    Ok(())
}
