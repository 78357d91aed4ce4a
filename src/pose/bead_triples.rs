//! Triples of beads that may be those of three shadows, by the distances between them.

use super::tables::{Depths, Tables};
use super::triangle::{Images, MOST_OFF};

/// The two of each of a triple's sides.
const SIDES: [(usize, usize); 3] = [(0, 1), (0, 2), (1, 2)];
/// More than all rounding, as a factor.
const ROUNDING: f64 = 1.001;

/// See the module.
pub(super) struct BeadTriples<'t> {
    tables: &'t Tables,
    count: usize,
    /// Words of a row of bits.
    words: usize,
    /// Which beads are far enough apart to be the two of a side, as rows of bits.
    fitting: [Vec<u64>; 3],
    /// Those of them that may be at depths that count.
    possible: [Vec<u64>; 3],
}

/// At which depths each bead may be where each shadow of a triple is.
pub(super) struct Windows {
    own: [Vec<Depths>; 3],
    /// All that any bead has.
    pub widest: [Depths; 3],
    /// Each bead has all of them.
    pub are_alike: bool,
}

impl Windows {
    /// Of `window`, for the beads that are `open` to each shadow.
    pub fn new(open: &[Vec<bool>; 3], window: impl Fn(usize, usize) -> Depths) -> Self {
        let own: [Vec<Depths>; 3] = std::array::from_fn(|n| {
            let of = |(bead, is_open): (usize, &bool)| if *is_open { window(bead, n) } else { Depths::NONE };
            open[n].iter().enumerate().map(of).collect()
        });
        let widest = own.each_ref().map(|own| own.iter().copied().fold(Depths::NONE, Depths::hull));
        let is_widest = |n: usize| (0..own[n].len()).all(|bead| !open[n][bead] || own[n][bead] == widest[n]);
        let are_alike = (0..3).all(is_widest);
        Self { own, widest, are_alike }
    }

    /// Whether depths that may be off by a factor are among those of the beads.
    #[inline]
    pub fn may_contain(&self, beads: [u32; 3], depths_mm: [f64; 3], factor: f64) -> bool {
        (0..3).all(|n| self.own[n][beads[n] as usize].may_contain(depths_mm[n], factor))
    }
}

impl<'t> BeadTriples<'t> {
    /// Of beads that are `open` to each of three shadows, whose distances have at least these squares. What `windows` leaves no exact depths is
    /// counted, and not given.
    // A bead that is n or more away on the ray of one shadow is at least n times as far from the ray of another as the place at a depth of 1 mm
    // on the first; and the exact depths (`triangle::agree`) put two beads as far apart as they are, but for a share of their triangle.
    pub fn new(tables: &'t Tables, images: &Images, open: &[Vec<bool>; 3], least_mm2: [f64; 3], windows: &Windows) -> Self {
        let count = open[0].len();
        let words = count.div_ceil(64);
        let [mut fitting, mut possible] = [(); 2].map(|()| [(); 3].map(|()| vec![0u64; count * words]));
        let off_mm = ROUNDING * MOST_OFF * tables.longest_mm;
        for (side, (p, q)) in SIDES.into_iter().enumerate() {
            let nearest = |one: usize, other: usize| -> Vec<f64> {
                let sine = images.off_ray(one, other);
                let square = |window: &Depths| (window.near * sine - off_mm).max(0.0).powi(2);
                windows.own[one].iter().map(square).collect()
            };
            let (of_first, of_second) = (nearest(p, q), nearest(q, p));
            for first in (0..count).filter(|first| open[p][*first]) {
                let squares_mm2 = &tables.squares_mm2[first * count..][..count];
                for (second, square_mm2) in squares_mm2.iter().enumerate() {
                    let fits = open[q][second] & (*square_mm2 >= least_mm2[side]) & (*square_mm2 > 0.0);
                    let is_possible = fits & (*square_mm2 >= of_first[first]) & (*square_mm2 >= of_second[second]);
                    let word = first * words + second / 64;
                    fitting[side][word] |= u64::from(fits) << (second % 64);
                    possible[side][word] |= u64::from(is_possible) << (second % 64);
                }
            }
        }
        Self { tables, count, words, fitting, possible }
    }

    /// Gives those that are possible, in order, with the squares of their sides; and says how many fit.
    pub fn each(&self, mut take: impl FnMut([usize; 3], [f64; 3])) -> u64 {
        let Self { count, words, .. } = *self;
        let mut fitting = 0;
        for i in 0..count {
            let [seconds, thirds] = [0, 1].map(|side| &self.fitting[side][i * words..][..words]);
            let [possible_seconds, possible_thirds] = [0, 1].map(|side| &self.possible[side][i * words..][..words]);
            let from_i = &self.tables.squares_mm2[i * count..][..count];
            each_bit(seconds.iter().copied(), |j| {
                let both = thirds.iter().zip(&self.fitting[2][j * words..][..words]);
                fitting += both.map(|(a, b)| u64::from((a & b).count_ones())).sum::<u64>();
                if (possible_seconds[j / 64] >> (j % 64)) & 1 == 1 {
                    let from_j = &self.tables.squares_mm2[j * count..][..count];
                    let both = possible_thirds.iter().zip(&self.possible[2][j * words..][..words]);
                    each_bit(both.map(|(a, b)| a & b), |k| take([i, j, k], [from_i[j], from_i[k], from_j[k]]));
                }
            });
        }
        fitting
    }
}

/// Takes the places of the bits that are set, in order.
fn each_bit(words: impl Iterator<Item = u64>, mut take: impl FnMut(usize)) {
    for (n, mut word) in words.enumerate() {
        while word != 0 {
            take(64 * n + word.trailing_zeros() as usize);
            word &= word - 1;
        }
    }
}

#[cfg(test)]
mod tests {
    use glam::{DMat3, DVec2, DVec3};

    use super::super::tables::Target;
    use super::super::triangle;
    use super::*;
    use crate::beads::Detection;
    use crate::geometry::Intrinsics;
    use crate::random::{Purpose, Stream};

    /// Triples of three of many beads' own images, and of three others; with 70 beads, rows of two words.
    #[test]
    fn all_that_fit_are_counted_and_none_that_has_exact_depths_is_left_out() {
        let mut random = Stream::new(12, 0, 0, Purpose::Evaluation);
        let intrinsics = Intrinsics { fx: 3500.0, fy: 3500.0, skew: 0.0, cx: 511.5, cy: 511.5 };
        let (mut given, mut left_out, mut exact) = (0, 0, 0);
        for count in [6, 12, 12, 12, 70] {
            let mut side = |mm: f64| mm * (random.uniform() - 0.5);
            let places: Vec<DVec3> = (0..count).map(|_| DVec3::new(side(120.0), side(120.0), side(120.0))).collect();
            let target = |lps_mm: &DVec3| Target { lps_mm: *lps_mm, sigma_mm: 0.1, place_mm2: DMat3::IDENTITY, radius_mm: None };
            let targets: Vec<Target> = places.iter().map(target).collect();
            let at: Vec<DVec3> = places.iter().map(|place| *place + DVec3::Z * 700.0).collect();
            let detections: Vec<Detection> =
                at.iter().map(|p| Detection { image_px: intrinsics.project(*p), ..Detection::default() }).collect();
            let in_gate: Vec<Depths> = (0..count).map(|n| Depths { near: 500.0 + 15.0 * (n % 6) as f64, far: 900.0 }).collect();
            let tables = Tables::new(&targets, &detections, &intrinsics, 8.0, &in_gate, |_, _| true);
            for triple in [[0, 1, 2], [1, 3, 5], [5, 4, 2], [2, 3, 4]] {
                let images = Images::new(triple.map(|n: usize| DVec2::new(at[n].x / at[n].z, at[n].y / at[n].z)));
                let least_mm2 = images.squares_apart().map(|square| square * 400.0f64.powi(2));
                let open = [0, 1, 2].map(|n| (0..count).map(|bead| (bead + n) % 5 != 3).collect::<Vec<bool>>());
                let windows = Windows::new(&open, |bead, n| tables.in_gate(bead, triple[n]));
                let mut taken = Vec::new();
                let fitting = BeadTriples::new(&tables, &images, &open, least_mm2, &windows).each(|beads, squares| {
                    taken.push((beads, squares));
                });
                assert!(taken.is_sorted_by(|a, b| a.0 < b.0));
                let mut next = taken.iter().peekable();
                let mut expected = 0;
                for (i, j, k) in (0..count * count * count).map(|n| (n / count / count, n / count % count, n % count)) {
                    let squares_mm2 = SIDES.map(|(a, b)| places[[i, j, k][a]].distance_squared(places[[i, j, k][b]]));
                    let is_one = i != j && i != k && j != k && open[0][i] && open[1][j] && open[2][k];
                    if !is_one || (0..3).any(|side| squares_mm2[side] < least_mm2[side]) {
                        continue;
                    }
                    expected += 1;
                    if next.next_if(|(beads, _)| *beads == [i, j, k]).is_some_and(|(_, squares)| *squares == squares_mm2) {
                        given += 1;
                        continue;
                    }
                    left_out += 1;
                    let has_exact = |start: [f64; 3]| {
                        let found = triangle::depths(squares_mm2, &images, start, |_| true);
                        found.is_some_and(|depths| windows.may_contain([i, j, k].map(|n| n as u32), depths, 1.0))
                    };
                    exact += triangle::rough_depths(squares_mm2, &images)
                        .map_or(0, |rough| rough.depths_mm.into_iter().filter(|start| has_exact(*start)).count());
                }
                assert_eq!((fitting, next.next()), (expected, None), "{count} beads, {triple:?}");
            }
        }
        assert!(exact == 0 && given > 1000 && left_out > 1000, "{exact} of {left_out} have depths, {given} are given");
    }
}
