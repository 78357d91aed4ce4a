//! Sets of disjoint intervals along a ray.

/// Sorted, disjoint, closed intervals of depth in mm.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Intervals {
    spans: Vec<(f64, f64)>,
}

impl Intervals {
    /// Forgets everything, keeps the memory.
    pub fn clear(&mut self) {
        self.spans.clear();
    }

    /// Whether nothing is covered.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.spans.is_empty()
    }

    /// The intervals, in order.
    #[must_use]
    pub fn spans(&self) -> &[(f64, f64)] {
        &self.spans
    }

    /// Adds [`from`, `to`], merging what it touches; empty and NaN intervals add nothing.
    pub fn insert(&mut self, from: f64, to: f64) {
        if !(to > from) {
            return;
        }
        let first = self.spans.partition_point(|span| span.1 < from);
        let last = first + self.spans[first..].partition_point(|span| span.0 <= to);
        if first == last {
            self.spans.insert(first, (from, to));
        } else {
            let merged = (from.min(self.spans[first].0), to.max(self.spans[last - 1].1));
            self.spans[first] = merged;
            self.spans.drain(first + 1..last);
        }
    }

    /// Calls `visit` for each part of [`from`, `to`] that is not covered, in order.
    pub fn for_each_gap(&self, from: f64, to: f64, mut visit: impl FnMut(f64, f64)) {
        let mut start = from;
        for &(a, b) in &self.spans[self.spans.partition_point(|span| span.1 <= from)..] {
            if !(a < to) {
                break;
            }
            if a > start {
                visit(start, a);
            }
            start = start.max(b);
        }
        if to > start {
            visit(start, to);
        }
    }

    /// Length of the part of [`from`, `to`] that is not covered.
    #[must_use]
    pub fn uncovered(&self, from: f64, to: f64) -> f64 {
        let mut length = 0.0;
        self.for_each_gap(from, to, |a, b| length += b - a);
        length
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn intervals_merge_where_they_touch_and_gaps_are_what_is_left() {
        let mut set = Intervals::default();
        for (a, b) in [(5.0, 6.0), (1.0, 2.0), (8.0, 9.0), (2.0, 3.0), (f64::NAN, 4.0), (7.0, 7.0)] {
            set.insert(a, b);
        }
        assert_eq!(set.spans(), [(1.0, 3.0), (5.0, 6.0), (8.0, 9.0)]);
        assert_eq!(set.uncovered(0.0, 10.0), 6.0);
        assert_eq!(set.uncovered(1.5, 2.5), 0.0);
        assert_eq!(set.uncovered(2.5, 5.5), 2.0);
        set.insert(0.0, 20.0);
        assert_eq!(set.spans(), [(0.0, 20.0)]);
    }

    #[test]
    fn against_a_bitmap() {
        let mut stream = crate::random::Stream::new(3, 0, 0, crate::random::Purpose::Evaluation);
        let mut cases = 0;
        for _ in 0..200 {
            let (mut set, mut bits) = (Intervals::default(), [false; 40]);
            for _ in 0..8 {
                let (a, b) = ((stream.next_u32() % 40) as usize, (stream.next_u32() % 40) as usize);
                set.insert(a as f64, b as f64);
                (a..b.max(a)).for_each(|i| bits[i] = true);
            }
            assert_eq!(set.uncovered(0.0, 40.0), bits.iter().filter(|bit| !**bit).count() as f64);
            assert!(set.spans().windows(2).all(|pair| pair[0].1 < pair[1].0));
            cases += 1;
        }
        assert_eq!(cases, 200);
    }
}
