//! One step of the training: the gradient clipped, then AdamW (Kingma & Ba 2015; Loshchilov & Hutter 2019).
//!
//! On the processor and in one loop: the state is three lists of numbers, kept and restored to the bit.

use super::StepRule;
use crate::infer::Layer;
use crate::random::{Purpose, Stream};

const MEAN_DECAY: f32 = 0.9;
const SQUARE_DECAY: f32 = 0.999;
const SMALL: f32 = 1e-8;
/// Last learning rate over the highest.
const LAST_RATE: f64 = 0.01;

/// Parameters and what the steps so far left behind, each in the order of the layers.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct Adam {
    pub parameters: Vec<f32>,
    pub means: Vec<f32>,
    pub squares: Vec<f32>,
    /// Steps done.
    pub steps: u64,
}

impl Adam {
    /// Drawn anew: weights normal (He et al. 2015), biases 0.
    pub(super) fn drawn(layers: &[Layer], seed: u64) -> Self {
        let mut parameters = Vec::new();
        for (place, layer) in layers.iter().enumerate() {
            let mut stream = Stream::new(seed, 0, place as u32, Purpose::FirstWeights);
            let deviation = f64::from(layer.gain) * (2.0 / layer.fan_in() as f64).sqrt();
            parameters.extend((0..layer.weight_count()).map(|_| (deviation * stream.normal()) as f32));
            parameters.extend(std::iter::repeat_n(0.0, layer.outputs));
        }
        let zeros = vec![0.0; parameters.len()];
        Self { parameters, means: zeros.clone(), squares: zeros, steps: 0 }
    }

    /// One step along `gradient`. The norm of the gradient as it came; the parameters are as before where that is not finite.
    pub(super) fn step(&mut self, gradient: &[f32], learning_rate: f64, rule: &StepRule) -> f64 {
        let norm = gradient.iter().map(|value| f64::from(*value).powi(2)).sum::<f64>().sqrt();
        if !norm.is_finite() {
            return norm;
        }
        let clip = (rule.largest_gradient / norm).min(1.0) as f32;
        self.steps += 1;
        let unbiased = |decay: f32| 1.0 - f64::from(decay).powf(self.steps as f64);
        let mean_scale = (1.0 / unbiased(MEAN_DECAY)) as f32;
        let square_scale = (1.0 / unbiased(SQUARE_DECAY)) as f32;
        let (rate, kept) = (learning_rate as f32, (1.0 - learning_rate * rule.weight_decay) as f32);
        let state = self.means.iter_mut().zip(&mut self.squares);
        for ((parameter, (mean, square)), slope) in self.parameters.iter_mut().zip(state).zip(gradient) {
            let slope = slope * clip;
            *mean = MEAN_DECAY * *mean + (1.0 - MEAN_DECAY) * slope;
            *square = SQUARE_DECAY * *square + (1.0 - SQUARE_DECAY) * slope * slope;
            *parameter = *parameter * kept - rate * (*mean * mean_scale) / ((*square * square_scale).sqrt() + SMALL);
        }
        norm
    }
}

/// The learning rate of step `step` (from 0) of `steps`: a linear rise, then half a cosine.
pub(super) fn learning_rate(rule: &StepRule, step: u64, steps: u64) -> f64 {
    let rise = (rule.warm_up * steps as f64).ceil();
    let step = step as f64;
    if step < rise {
        return rule.learning_rate * (step + 1.0) / rise;
    }
    let share = (step - rise) / (steps as f64 - rise - 1.0).max(1.0);
    let cosine = 0.5 * (1.0 + (std::f64::consts::PI * share.min(1.0)).cos());
    rule.learning_rate * (LAST_RATE + (1.0 - LAST_RATE) * cosine)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn at(parameters: Vec<f32>) -> Adam {
        let zeros = vec![0.0; parameters.len()];
        Adam { parameters, means: zeros.clone(), squares: zeros, steps: 0 }
    }

    #[test]
    fn the_first_step_is_the_learning_rate_against_the_slope_whatever_its_size() {
        let rule = StepRule { weight_decay: 0.0, ..StepRule::default() };
        let mut adam = at(vec![1.0, 1.0, 1.0]);
        let norm = adam.step(&[3.0, -4.0, 0.0], 0.1, &rule);
        assert_eq!(norm, 5.0);
        for (found, expected) in adam.parameters.iter().zip([0.9_f32, 1.1, 1.0]) {
            assert!((found - expected).abs() < 1e-5, "{found} {expected}");
        }
        // Clipped to norm 1: a fifth of the slope.
        assert!((adam.means[0] - 0.1 * 0.6).abs() < 1e-6);
    }

    #[test]
    fn a_gradient_that_is_no_number_moves_nothing() {
        let mut adam = at(vec![1.0, 2.0]);
        let before = adam.clone();
        assert!(adam.step(&[f32::NAN, 0.0], 0.1, &StepRule::default()).is_nan());
        assert_eq!(adam, before);
    }

    #[test]
    fn the_learning_rate_rises_and_falls_to_a_hundredth() {
        let rule = StepRule { learning_rate: 1.0, warm_up: 0.1, ..StepRule::default() };
        let rates: Vec<f64> = (0..100).map(|step| learning_rate(&rule, step, 100)).collect();
        assert!((rates[0] - 0.1).abs() < 1e-12 && rates[9] == 1.0 && (rates[99] - 0.01).abs() < 1e-12);
        assert!(rates[10..].windows(2).all(|pair| pair[1] < pair[0]));
    }
}
