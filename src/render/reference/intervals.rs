//! Sets of disjoint closed intervals of depth along a ray.

/// Sorted, disjoint intervals; touching ones may stay apart, empty ones are left out.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Intervals(Vec<[f64; 2]>);

impl Intervals {
    /// One interval, or none unless `from < to` (NaN gives none).
    #[must_use]
    pub fn between(from: f64, to: f64) -> Self {
        Self(if from < to { vec![[from, to]] } else { Vec::new() })
    }

    /// Of intervals in any order, overlapping as they like.
    #[must_use]
    pub fn of(mut intervals: Vec<[f64; 2]>) -> Self {
        intervals.retain(|[from, to]| from < to);
        intervals.sort_by(|a, b| a[0].total_cmp(&b[0]));
        let mut merged: Vec<[f64; 2]> = Vec::with_capacity(intervals.len());
        for [from, to] in intervals {
            match merged.last_mut() {
                Some(last) if from <= last[1] => last[1] = last[1].max(to),
                _ => merged.push([from, to]),
            }
        }
        Self(merged)
    }

    /// The intervals, ascending.
    pub fn iter(&self) -> impl Iterator<Item = [f64; 2]> {
        self.0.iter().copied()
    }

    /// Whether there are none.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.0.is_empty()
    }

    /// Sum of the lengths.
    #[must_use]
    pub fn length(&self) -> f64 {
        self.0.iter().map(|[from, to]| to - from).sum()
    }

    /// What lies in either.
    #[must_use]
    pub fn union(&self, other: &Self) -> Self {
        Self::of(self.0.iter().chain(&other.0).copied().collect())
    }

    /// What lies in both.
    #[must_use]
    pub fn intersection(&self, other: &Self) -> Self {
        let (mut a, mut b) = (0, 0);
        let mut both = Vec::new();
        while a < self.0.len() && b < other.0.len() {
            let (x, y) = (self.0[a], other.0[b]);
            let (from, to) = (x[0].max(y[0]), x[1].min(y[1]));
            if from < to {
                both.push([from, to]);
            }
            if x[1] < y[1] { a += 1 } else { b += 1 }
        }
        Self(both)
    }

    /// What lies in `self` and not in `other`.
    #[must_use]
    pub fn without(&self, other: &Self) -> Self {
        let mut left = Vec::new();
        let mut first = 0;
        for [from, to] in self.iter() {
            let mut start = from;
            while first < other.0.len() && other.0[first][1] <= from {
                first += 1;
            }
            for [hole_from, hole_to] in other.0[first..].iter().copied().take_while(|[hole_from, _]| *hole_from < to) {
                if hole_from > start {
                    left.push([start, hole_from]);
                }
                start = start.max(hole_to);
            }
            if start < to {
                left.push([start, to]);
            }
        }
        Self(left)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn set(intervals: &[[f64; 2]]) -> Intervals {
        Intervals::of(intervals.to_vec())
    }

    #[test]
    fn sets_obey_their_algebra_on_a_grid() {
        let mut cases = 0;
        // Every pair of subsets of six unit cells, against bits.
        for a in 0u32..64 {
            for b in 0u32..64 {
                let of_bits = |bits: u32| {
                    set(&(0..6).filter(|i| bits >> i & 1 == 1).map(|i| [f64::from(i), f64::from(i + 1)]).collect::<Vec<_>>())
                };
                let (x, y) = (of_bits(a), of_bits(b));
                let measure = |bits: u32| f64::from(bits.count_ones());
                assert_eq!(x.union(&y).length(), measure(a | b));
                assert_eq!(x.intersection(&y).length(), measure(a & b), "{x:?} {y:?}");
                assert_eq!(x.without(&y).length(), measure(a & !b), "{x:?} {y:?}");
                cases += 1;
            }
        }
        assert_eq!(cases, 4096);
    }

    #[test]
    fn nan_and_empty_intervals_vanish() {
        assert!(Intervals::between(f64::NAN, 1.0).is_empty() && Intervals::between(1.0, 1.0).is_empty());
        assert!(set(&[[2.0, 1.0], [f64::NAN, 3.0]]).is_empty());
    }
}
