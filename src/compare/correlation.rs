//! Correlation of two images, by their values and by their ranks.

use crate::image::{Image, in_order};

/// At most so many pixels are ranked.
const MOST: usize = 20_000;

/// Both values at each scored pixel.
pub(super) fn for_each_scored(a: &Image<f32>, s: &Image<f32>, scored: &Image<bool>, mut f: impl FnMut(f64, f64)) {
    for ((a, s), _) in a.pixels.iter().zip(&s.pixels).zip(&scored.pixels).filter(|(_, scored)| **scored) {
        f(f64::from(*a), f64::from(*s));
    }
}

/// Correlation of values about their means; `None` where either is constant.
pub(super) fn zncc(a: &Image<f32>, b: &Image<f32>, scored: &Image<bool>) -> Option<f64> {
    let (mut n, mut mean_a, mut mean_b) = (0.0, 0.0, 0.0);
    for_each_scored(a, b, scored, |x, y| {
        n += 1.0;
        mean_a += x;
        mean_b += y;
    });
    (mean_a, mean_b) = (mean_a / n, mean_b / n);
    let (mut aa, mut bb, mut ab) = (0.0, 0.0, 0.0);
    for_each_scored(a, b, scored, |x, y| {
        aa += (x - mean_a) * (x - mean_a);
        bb += (y - mean_b) * (y - mean_b);
        ab += (x - mean_a) * (y - mean_b);
    });
    let product = (aa * bb).sqrt();
    // Beyond the rounding of f32 there must be something to correlate.
    let floor = 1e-12 * n * (1.0 + mean_a.abs()) * (1.0 + mean_b.abs());
    (product > floor).then(|| (ab / product).clamp(-1.0, 1.0))
}

/// Ranks from 0 to 1 of an even subsample of the scored pixels, as an image of one row; equal values share the mean of theirs.
pub(super) fn ranks(image: &Image<f32>, scored: &Image<bool>) -> Image<f32> {
    let count = scored.pixels.iter().filter(|scored| **scored).count();
    let step = count.div_ceil(MOST).max(1);
    let values = image.pixels.iter().zip(&scored.pixels).filter(|(_, scored)| **scored).map(|(value, _)| *value).step_by(step);
    // Value and index in one word, which sorts many times faster than indices that look their values up.
    let mut order: Vec<u64> = values.enumerate().map(|(index, value)| u64::from(sortable(value)) << 32 | index as u64).collect();
    sort_by_value(&mut order);
    let mut ranks = vec![0.0; order.len()];
    let mut start = 0;
    for equal in order.chunk_by(|a, b| a >> 32 == b >> 32) {
        let shared = 0.5 * (2 * start + equal.len() - 1) as f32 / order.len() as f32;
        equal.iter().for_each(|word| ranks[*word as u32 as usize] = shared);
        start += equal.len();
    }
    Image { width: ranks.len(), height: 1, pixels: ranks }
}

/// Bits of a value by which words are put in order at a time.
const DIGIT_BITS: u32 = 11;

/// Sorts words of a value and, below it, an index that rises: from the value's last digit to its first, each time keeping the order so far.
fn sort_by_value(words: &mut Vec<u64>) {
    let mut sorted = vec![0u64; words.len()];
    for shift in (32..u64::BITS).step_by(DIGIT_BITS as usize) {
        let digit = |word: u64| (word >> shift) as usize & ((1 << DIGIT_BITS) - 1);
        let mut places = [0usize; 1 << DIGIT_BITS];
        words.iter().for_each(|word| places[digit(*word)] += 1);
        let mut next = 0;
        places.iter_mut().for_each(|place| next += std::mem::replace(place, next));
        for word in words.iter() {
            let place = &mut places[digit(*word)];
            sorted[*place] = *word;
            *place += 1;
        }
        std::mem::swap(words, &mut sorted);
    }
}

/// Words in the order of values; both zeros are equal.
fn sortable(value: f32) -> u32 {
    in_order(value + 0.0)
}

/// Spearman's correlation of two images, given their [`ranks`] on the same pixels: blind to any monotone tone.
pub(super) fn rank_ncc(a: &Image<f32>, b: &Image<f32>) -> Option<f64> {
    zncc(a, b, &Image::filled(a.width, 1, true))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn row(values: &[f32]) -> Image<f32> {
        Image::from_pixels(values.len(), 1, values.to_vec()).expect("one row")
    }

    #[test]
    fn equal_values_share_their_rank_and_signs_do_not_matter() {
        let values = row(&[3.0, -1.0, 0.0, -0.0, 3.0, -f32::INFINITY, 7.5]);
        let ranked = ranks(&values, &Image::filled(7, 1, true));
        let expected = [4.5, 1.0, 2.5, 2.5, 4.5, 0.0, 6.0].map(|rank: f32| rank / 7.0);
        assert!(ranked.pixels.iter().zip(expected).all(|(found, expected)| (found - expected).abs() < 1e-6), "{ranked:?}");
    }

    #[test]
    fn words_are_sorted_by_their_values_and_then_by_their_indices() {
        use crate::random::{Purpose, Stream};
        let mut random = Stream::new(23, 0, 0, Purpose::Evaluation);
        // Any values, and few, of which many are equal.
        for kinds in [u32::MAX, 700, 1] {
            let mut words: Vec<u64> = (0..5000).map(|index| u64::from(random.next_u32() % kinds) << 32 | index).collect();
            let mut expected = words.clone();
            expected.sort_unstable();
            sort_by_value(&mut words);
            assert_eq!(words, expected, "{kinds} values");
        }
        sort_by_value(&mut Vec::new());
    }

    #[test]
    fn a_monotone_tone_changes_nothing_and_a_falling_one_turns_the_sign() {
        let values: Vec<f32> = (0..4000).map(|at| ((at * 7919) % 4001) as f32 * 1e-3).collect();
        let all = Image::filled(4000, 1, true);
        let plain = ranks(&row(&values), &all);
        let curved = ranks(&row(&values.iter().map(|v| v.exp()).collect::<Vec<_>>()), &all);
        let falling = ranks(&row(&values.iter().map(|v| -v).collect::<Vec<_>>()), &all);
        assert!((rank_ncc(&plain, &curved).expect("values differ") - 1.0).abs() < 1e-9);
        assert!((rank_ncc(&plain, &falling).expect("values differ") + 1.0).abs() < 1e-9);
    }
}
