//! Drawing an index by weights with one random number (Walker's alias method, Vose's construction).

use super::stream::Stream;

/// Weights, ready to draw by.
#[derive(Clone, Debug)]
pub struct Alias {
    /// By slot: up to where the slot itself is drawn, and what is drawn beyond.
    pub(super) slots: Vec<(f64, u32)>,
}

impl Alias {
    /// Of weights ≥ 0 of which one is positive.
    #[must_use]
    pub fn new(weights: &[f64]) -> Self {
        let count = weights.len();
        let mean = weights.iter().sum::<f64>() / count as f64;
        let mut scaled: Vec<f64> = weights.iter().map(|weight| weight / mean).collect();
        let mut slots: Vec<(f64, u32)> = (0..count as u32).map(|n| (1.0, n)).collect();
        let (mut small, mut large): (Vec<usize>, Vec<usize>) = (0..count).partition(|n| scaled[*n] < 1.0);
        while let (Some(low), Some(high)) = (small.pop(), large.pop()) {
            slots[low] = (scaled[low], high as u32);
            scaled[high] -= 1.0 - scaled[low];
            if scaled[high] < 1.0 { small.push(high) } else { large.push(high) }
        }
        Self { slots }
    }

    /// An index.
    #[inline]
    pub fn draw(&self, stream: &mut Stream) -> usize {
        let position = stream.uniform() * self.slots.len() as f64;
        let slot = (position as usize).min(self.slots.len() - 1);
        let (own, other) = self.slots[slot];
        if position - slot as f64 <= own { slot } else { other as usize }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn indices_come_as_often_as_they_weigh() {
        let weights = [0.0, 3.0, 1.0, 0.5, 0.0, 7.5];
        let (alias, mut stream, draws) = (Alias::new(&weights), Stream::new(3, 0), 200_000);
        let mut counts = [0.0; 6];
        (0..draws).for_each(|_| counts[alias.draw(&mut stream)] += 1.0);
        let chi_squared = |weights: &[f64]| {
            let expected = weights.iter().map(|weight| weight / weights.iter().sum::<f64>() * f64::from(draws));
            counts.iter().zip(expected).filter(|(_, e)| *e > 0.0).map(|(n, e): (&f64, f64)| (n - e).powi(2) / e).sum::<f64>()
        };
        assert!(counts[0] == 0.0 && counts[4] == 0.0);
        // Three degrees of freedom: 21 has a probability of 1e-4.
        assert!(chi_squared(&weights) < 21.0 && chi_squared(&[0.0, 3.1, 1.0, 0.5, 0.0, 7.5]) > 21.0);
    }
}
