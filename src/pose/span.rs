//! How far apart the two farthest of many points are.

use glam::DVec3;

/// So few points are compared one by one.
const FEW: usize = 16;

/// Points of one box, halved until few are left.
struct Clump<'a> {
    low: DVec3,
    high: DVec3,
    within: Within<'a>,
}

enum Within<'a> {
    Few(&'a [DVec3]),
    Halves(Box<[Clump<'a>; 2]>),
}

impl<'a> Clump<'a> {
    /// Reorders `points`, of which none is NaN.
    fn of(points: &'a mut [DVec3]) -> Self {
        let low = points.iter().copied().fold(DVec3::INFINITY, DVec3::min);
        let high = points.iter().copied().fold(DVec3::NEG_INFINITY, DVec3::max);
        if points.len() <= FEW {
            return Self { low, high, within: Within::Few(points) };
        }
        let (longest, middle) = ((high - low).max_position(), points.len() / 2);
        points.select_nth_unstable_by(middle, |a, b| a[longest].total_cmp(&b[longest]));
        let (first, second) = points.split_at_mut(middle);
        Self { low, high, within: Within::Halves(Box::new([Self::of(first), Self::of(second)])) }
    }

    fn size_mm(&self) -> f64 {
        (self.high - self.low).max_element()
    }

    /// No point of one is farther from one of the other, to the last bit.
    fn most_mm(&self, other: &Self) -> f64 {
        // Along each axis no two are farther apart than two faces; a difference, a square, a sum and a root of what is no smaller are no
        // smaller when rounded either, and `distance` takes the same ones in the same order.
        (self.high - other.low).max(other.high - self.low).length()
    }
}

#[derive(Default)]
struct Farthest {
    mm: f64,
    /// Pairs of points.
    compared: usize,
}

impl Farthest {
    fn search(&mut self, a: &Clump<'_>, b: &Clump<'_>) {
        if a.most_mm(b) <= self.mm {
            return;
        }
        if let (true, Within::Halves(halves)) = (std::ptr::eq(a, b), &a.within) {
            let [first, second] = &**halves;
            self.search(first, second);
            self.search(first, first);
            self.search(second, second);
            return;
        }
        let (halves, other) = match (&a.within, &b.within) {
            (Within::Few(of_a), Within::Few(of_b)) => {
                let pairs = of_a.iter().flat_map(|one| of_b.iter().map(move |other| one.distance(*other)));
                self.mm = pairs.fold(self.mm, f64::max);
                self.compared += of_a.len() * of_b.len();
                return;
            }
            (Within::Halves(halves), Within::Few(_)) => (halves, b),
            (Within::Halves(halves), Within::Halves(_)) if a.size_mm() >= b.size_mm() => (halves, b),
            (_, Within::Halves(halves)) => (halves, a),
        };
        // The far half first: what it finds often says that the near one need not be searched.
        let [first, second] = &**halves;
        let (far, near) = if first.most_mm(other) >= second.most_mm(other) { (first, second) } else { (second, first) };
        self.search(far, other);
        self.search(near, other);
    }

    fn of(points: &[DVec3]) -> Self {
        let mut known: Vec<DVec3> = points.iter().copied().filter(|point| !point.is_nan()).collect();
        let mut found = Self::default();
        if !known.is_empty() {
            let all = Clump::of(&mut known);
            found.search(&all, &all);
        }
        found
    }
}

/// Between the two points that are farthest apart; 0 of fewer. Those without a place are passed over.
#[must_use]
pub fn span_mm(points: &[DVec3]) -> f64 {
    Farthest::of(points).mm
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::random::{Purpose, Stream};

    /// Every point with every other.
    fn one_by_one(points: &[DVec3]) -> f64 {
        let pairs = points.iter().enumerate().flat_map(|(n, one)| points[n + 1..].iter().map(move |other| one.distance(*other)));
        pairs.fold(0.0, f64::max)
    }

    fn cloud(seed: u64, count: usize) -> Vec<DVec3> {
        let mut stream = Stream::new(seed, 0, 0, Purpose::Evaluation);
        let mut number = || 2.0 * stream.uniform() - 1.0;
        (0..count).map(|_| DVec3::new(number(), number(), number())).collect()
    }

    /// What becomes of a point of the cloud.
    type Moved = fn(&DVec3) -> DVec3;

    #[test]
    fn the_span_is_that_of_all_pairs_to_the_last_bit() {
        for (seed, count) in [0, 1, 2, 3, 16, 17, 40, 200, 700, 701, 702].into_iter().enumerate() {
            let scattered = cloud(seed as u64, count);
            let kinds: [(&str, Moved); 5] = [
                ("a cube", |p| *p),
                ("a sphere", |p| 83.0 * p.normalize() + DVec3::new(4e3, -7.0, 0.1)),
                ("a line", |p| DVec3::new(p.x, 2.0 * p.x, 0.0)),
                ("whole numbers", |p| (*p * 3.0).round()),
                ("one point", |_| DVec3::new(0.1, 0.2, 0.3)),
            ];
            for (kind, of) in kinds {
                let mut points: Vec<DVec3> = scattered.iter().map(of).collect();
                assert_eq!(span_mm(&points).to_bits(), one_by_one(&points).to_bits(), "{count} points of {kind}");
                points.push(DVec3::new(f64::NAN, 1e9, 0.0));
                assert_eq!(
                    span_mm(&points).to_bits(),
                    one_by_one(&points).to_bits(),
                    "{count} points of {kind}, one without a place"
                );
            }
        }
        let endless = [DVec3::ZERO, DVec3::new(f64::INFINITY, 0.0, 0.0), DVec3::new(f64::INFINITY, 1.0, 0.0)];
        assert_eq!(span_mm(&endless), f64::INFINITY);
    }

    #[test]
    fn tens_of_thousands_of_points_take_few_comparisons() {
        let cube = cloud(1, 30_000);
        let sphere: Vec<DVec3> = cube.iter().map(|p| p.normalize()).collect();
        let same = vec![DVec3::ONE; 30_000];
        for (points, least_mm) in [(cube, 3.2), (sphere, 1.999), (same, 0.0)] {
            let Farthest { mm, compared } = Farthest::of(&points);
            assert!(mm >= least_mm, "{mm}");
            // Of a sphere's points every one is nearly as far from some other.
            assert!(compared < points.len() * points.len() / 8, "{compared}");
        }
    }
}
