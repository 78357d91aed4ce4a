//! Quantiles of values in any order.

/// Of so many values those that may be the one are told by their first bits before they are put in order.
const MANY: usize = 1 << 17;
/// So many first bits: sign, exponent, and a hundredth of the value.
const FIRST_BITS: u32 = 16;

/// The value below which `share` of `values` lie; `None` when there are none. May reorder `values`; NaN sorts last.
pub fn quantile(values: &mut [f32], share: f64) -> Option<f64> {
    if values.is_empty() {
        return None;
    }
    let rank = ((values.len() - 1) as f64 * share.clamp(0.0, 1.0)).round() as usize;
    let value = if values.len() < MANY { at_rank(values, rank) } else { at_rank_of_many(values, rank) };
    Some(f64::from(value))
}

fn at_rank(values: &mut [f32], rank: usize) -> f32 {
    *values.select_nth_unstable_by(rank, f32::total_cmp).1
}

/// The same without putting all of them in order.
fn at_rank_of_many(values: &[f32], rank: usize) -> f32 {
    let first_bits = |value: f32| (in_order(value) >> (32 - FIRST_BITS)) as usize;
    let mut counts = vec![0usize; 1 << FIRST_BITS];
    values.iter().for_each(|value| counts[first_bits(*value)] += 1);
    let (mut of_rank, mut before) = (0, 0);
    for (bits, count) in counts.iter().enumerate() {
        of_rank = bits;
        if rank < before + count {
            break;
        }
        before += count;
    }
    let mut alike: Vec<f32> = values.iter().copied().filter(|value| first_bits(*value) == of_rank).collect();
    at_rank(&mut alike, rank - before)
}

/// Words in the order of [`f32::total_cmp`].
#[must_use]
pub fn in_order(value: f32) -> u32 {
    let bits = value.to_bits();
    if bits >> 31 == 0 { bits | 1 << 31 } else { !bits }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::random::{Purpose, Stream};

    /// Against all values in order; bit for bit, so that zeros keep their sign.
    #[test]
    fn of_many_values_the_same_one_is_found_as_in_their_order() {
        let mut random = Stream::new(17, 0, 0, Purpose::Evaluation);
        let mut any = move || f32::from_bits(random.next_u32());
        let special = [0.0, -0.0, f32::NAN, -f32::NAN, f32::INFINITY, f32::NEG_INFINITY, 1e-40, -1e-40];
        let kinds: [Vec<f32>; 4] = [
            (0..MANY + 3).map(|_| any()).collect(),
            (0..MANY).map(|at| (at * 7919 % 1009) as f32 * 1e-3 - 0.3).collect(),
            (0..MANY).map(|at| special[at * 31 % special.len()]).collect(),
            vec![2.5; MANY],
        ];
        for values in kinds {
            let mut sorted = values.clone();
            sorted.sort_by(f32::total_cmp);
            for share in [0.0, 0.005, 0.1, 0.5, 0.77, 0.995, 1.0] {
                let rank = ((values.len() - 1) as f64 * share).round() as usize;
                let expected = sorted[rank];
                assert_eq!(at_rank_of_many(&values, rank).to_bits(), expected.to_bits(), "{share} of {}", values.len());
                let found = quantile(&mut values.clone(), share).expect("values");
                assert!(found.to_bits() == f64::from(expected).to_bits(), "{found}, expected {expected}");
            }
        }
        assert_eq!(quantile(&mut [], 0.5), None);
    }
}
