//! Points against places where they should be: as they stand, or under one of the mistakes that people make with axes, signs and units.

use glam::DVec3;

/// A mistake: axes exchanged, signs turned, another unit, another origin. Applied as `shift + scale · signs · axes(p)`.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Mistake {
    /// Which coordinate of the point becomes x, y, z.
    axes: [usize; 3],
    /// Sign of each.
    signs: [f64; 3],
    /// 1000 where the file holds metres taken for millimetres: see `UNITS`.
    scale: f64,
    /// Added after all else, mm.
    shift_mm: DVec3,
}

const NONE: Mistake = Mistake { axes: [0, 1, 2], signs: [1.0; 3], scale: 1.0, shift_mm: DVec3::ZERO };
/// Units taken for millimetres: how many mm they are, their name, and what a markups file that is in them says.
const UNITS: [(f64, &str, Option<&str>); 4] =
    [(1000.0, "metres", Some("m")), (10.0, "centimetres", Some("cm")), (25.4, "inches", None), (0.001, "microns", Some("um"))];
/// RAS taken for LPS, or the reverse.
pub const SWAPPED: Mistake = Mistake { signs: [-1.0, -1.0, 1.0], ..NONE };

impl Mistake {
    /// Where a point belongs if this mistake was made.
    #[must_use]
    pub fn mend(&self, p: DVec3) -> DVec3 {
        let p = p.to_array();
        let turned: [f64; 3] = std::array::from_fn(|i| self.signs[i] * p[self.axes[i]]);
        self.scale * DVec3::from_array(turned) + self.shift_mm
    }

    /// What was done wrong, in words that stand after "as if".
    #[must_use]
    pub fn words(&self) -> String {
        let mut words = Vec::new();
        let straight = self.axes == NONE.axes;
        let negative: Vec<&str> = ["x", "y", "z"].into_iter().zip(self.signs).filter(|(_, s)| *s < 0.0).map(|(n, _)| n).collect();
        if !straight {
            words.push(format!("the axes were exchanged ({})", self.axes.map(|axis| ["x", "y", "z"][axis]).join(", ")));
        }
        match (negative.len(), straight) {
            (0, _) => {}
            (2, true) if self.signs == SWAPPED.signs => words.push("RAS and LPS were swapped (x and y negated)".to_owned()),
            (1 | 3, true) => words.push(format!("mirrored ({} negated)", negative.join(", "))),
            _ => words.push(format!("{} were negated", negative.join(", "))),
        }
        if let Some((unit, _)) = self.unit() {
            words.push(format!("they were in {unit}"));
        }
        if self.shift_mm != DVec3::ZERO {
            // Rounded first: −0.04 is no −0.0.
            let [x, y, z] = (-self.shift_mm).to_array().map(|mm| (mm * 10.0).round() / 10.0 + 0.0);
            words.push(format!("shifted by ({x:.1}, {y:.1}, {z:.1}) mm"));
        }
        words.join(" and ")
    }

    /// Whether it is the exchange of RAS and LPS and nothing else.
    #[must_use]
    pub fn is_swap(&self) -> bool {
        *self == SWAPPED
    }

    /// The unit that was taken for millimetres, and its name in a markups file, if it has one there.
    #[must_use]
    pub fn unit(&self) -> Option<(&'static str, Option<&'static str>)> {
        UNITS.iter().find(|(mm, ..)| *mm == self.scale).map(|(_, name, key)| (*name, *key))
    }

    /// Whether axes and signs are as they should be.
    #[must_use]
    pub fn keeps_axes(&self) -> bool {
        (self.axes, self.signs) == (NONE.axes, NONE.signs)
    }
}

/// Single mistakes, the likely ones first: units, RAS/LPS, mirrors, half-turns, exchanged axes.
#[must_use]
pub fn mistakes() -> Vec<Mistake> {
    let mut turned = Vec::with_capacity(47);
    for axes in [[0, 1, 2], [1, 0, 2], [0, 2, 1], [2, 1, 0], [1, 2, 0], [2, 0, 1]] {
        for bits in 0..8u8 {
            let signs = [1u8, 2, 4].map(|bit| if bits & bit != 0 { -1.0 } else { 1.0 });
            turned.push(Mistake { axes, signs, ..NONE });
        }
    }
    turned.retain(|mistake| *mistake != NONE);
    // The swap is by far the most frequent.
    turned.sort_by_key(|mistake| !mistake.is_swap());
    let scaled = UNITS.into_iter().flat_map(|(scale, ..)| [NONE, SWAPPED].map(|mistake| Mistake { scale, ..mistake }));
    let mut all: Vec<Mistake> = scaled.collect();
    all.extend(turned);
    all
}

/// How points lie against places.
#[derive(Clone, Debug, PartialEq)]
pub enum Alignment {
    /// Too few of either.
    Unknown,
    /// As they stand.
    Fits {
        /// Points at a place.
        matched: usize,
        /// Index of each point that is at none.
        off: Vec<usize>,
    },
    /// Under a mistake, and much better than as they stand.
    Mistaken {
        /// Which.
        mistake: Mistake,
        /// Points at a place when mended.
        matched: usize,
        /// Points at a place as they stand.
        as_stated: usize,
    },
    /// Neither.
    Apart {
        /// Points at a place as they stand.
        matched: usize,
    },
}

/// How well points must fit.
#[derive(Clone, Copy, Debug)]
pub struct Strictness {
    /// A point is at a place when it is this close.
    pub tolerance_mm: f64,
    /// Fewer matches than this mean nothing.
    pub fewest: usize,
    /// Share of the possible matches that a mistake must reach.
    pub mistaken_share: f64,
}

/// Share of the possible matches with which points fit as they stand.
const FITTING_SHARE: f64 = 0.6;
/// Most comparisons spent on the search for a shift.
const MOST_COMPARISONS: usize = 40_000_000;

/// Judges.
#[must_use]
pub fn align(points: &[DVec3], places: &[DVec3], strictness: &Strictness) -> Alignment {
    let possible = points.len().min(places.len());
    if possible < strictness.fewest {
        return Alignment::Unknown;
    }
    let at = |mistake: &Mistake| pairs(points, places, mistake, strictness.tolerance_mm);
    let stated = at(&NONE);
    let as_stated = stated.iter().flatten().count();
    if as_stated >= strictness.fewest && as_stated as f64 >= FITTING_SHARE * possible as f64 {
        let off = stated.iter().enumerate().filter(|(_, place)| place.is_none()).map(|(index, _)| index).collect();
        return Alignment::Fits { matched: as_stated, off };
    }
    let required = (strictness.mistaken_share * possible as f64).ceil() as usize;
    let required = required.max(strictness.fewest).max(as_stated + 2);
    let single = mistakes();
    let mut best: Option<(Mistake, usize)> = None;
    for mistake in &single {
        let count = at(mistake).iter().flatten().count();
        if count >= required && best.is_none_or(|(_, most)| count > most) {
            best = Some((*mistake, count));
        }
    }
    // A shift alone explains more than a shift of something turned round, and is tried first.
    let turned = std::iter::once(NONE).chain(single.iter().copied().filter(|mistake| mistake.unit().is_none()));
    let mut shifted =
        turned.filter_map(|mistake| best_shift(points, places, &mistake, strictness.tolerance_mm, single.len() + 1));
    let best = best.or_else(|| shifted.find(|(_, count)| *count >= required));
    match best {
        Some((mistake, matched)) => Alignment::Mistaken { mistake, matched, as_stated },
        None => Alignment::Apart { matched: as_stated },
    }
}

/// The place of each point under `mistake`; every place is given once, to the nearest point first.
fn pairs(points: &[DVec3], places: &[DVec3], mistake: &Mistake, tolerance_mm: f64) -> Vec<Option<usize>> {
    let mut close = Vec::new();
    for (p, point) in points.iter().enumerate() {
        let mended = mistake.mend(*point);
        for (q, place) in places.iter().enumerate() {
            let distance_mm = mended.distance(*place);
            if distance_mm <= tolerance_mm {
                close.push((distance_mm, p, q));
            }
        }
    }
    close.sort_by(|a, b| a.0.total_cmp(&b.0));
    let mut given = vec![None; points.len()];
    let mut taken = vec![false; places.len()];
    for (_, p, q) in close {
        if given[p].is_none() && !taken[q] {
            given[p] = Some(q);
            taken[q] = true;
        }
    }
    given
}

/// The shift, on top of `mistake`, that brings most points to places: one of those that bring some point exactly to some place.
fn best_shift(
    points: &[DVec3],
    places: &[DVec3],
    mistake: &Mistake,
    tolerance_mm: f64,
    of_mistakes: usize,
) -> Option<(Mistake, usize)> {
    let one = points.len() * places.len();
    let anchors = (MOST_COMPARISONS / of_mistakes / one.max(1) / places.len().max(1)).min(points.len());
    let mut best: Option<(Mistake, usize)> = None;
    for point in &points[..anchors] {
        for place in places {
            let shifted = Mistake { shift_mm: *place - mistake.mend(*point), ..*mistake };
            // The anchor itself has an error too: the others are given twice the room.
            let count = pairs(points, places, &shifted, 2.0 * tolerance_mm).iter().flatten().count();
            if best.is_none_or(|(_, most)| count > most) {
                best = Some((shifted, count));
            }
        }
    }
    best
}

#[cfg(test)]
mod tests {
    use super::*;

    const STRICT: Strictness = Strictness { tolerance_mm: 2.0, fewest: 3, mistaken_share: 0.75 };

    fn places() -> Vec<DVec3> {
        [
            [-46.0, -12.0, 18.0],
            [44.0, 24.0, 8.0],
            [10.0, -40.0, -22.0],
            [-20.0, 33.0, 30.0],
            [5.0, 12.0, -41.0],
            [31.0, -8.0, 37.0],
        ]
        .map(DVec3::from_array)
        .to_vec()
    }

    /// What a file holds when `mistake` was made: the inverse of mending.
    fn spoiled(mistake: &Mistake) -> Vec<DVec3> {
        let back = |place: DVec3| {
            let turned = ((place - mistake.shift_mm) / mistake.scale).to_array();
            let mut p = [0.0; 3];
            for axis in 0..3 {
                p[mistake.axes[axis]] = mistake.signs[axis] * turned[axis];
            }
            DVec3::from_array(p)
        };
        places().into_iter().map(back).collect()
    }

    #[test]
    fn every_single_mistake_is_recognised() {
        let all = mistakes();
        for mistake in &all {
            let found = align(&spoiled(mistake), &places(), &STRICT);
            assert_eq!(found, Alignment::Mistaken { mistake: *mistake, matched: 6, as_stated: 0 }, "{}", mistake.words());
        }
        assert_eq!(all.len(), 55);
        let units: Vec<_> = all.iter().filter_map(Mistake::unit).filter_map(|(_, key)| key).collect();
        assert_eq!(units, ["m", "m", "cm", "cm", "um", "um"], "each with and without the swap");
        assert!(SWAPPED.words().contains("RAS and LPS") && SWAPPED.is_swap());
    }

    #[test]
    fn a_shift_is_recognised_and_small_errors_are_none() {
        let shift = Mistake { shift_mm: DVec3::new(12.0, -3.0, 7.0), ..NONE };
        let Alignment::Mistaken { mistake, matched: 6, .. } = align(&spoiled(&shift), &places(), &STRICT) else {
            panic!("not found")
        };
        assert!(mistake.shift_mm.distance(shift.shift_mm) < 1e-9 && mistake.words().contains("shifted by (-12.0, 3.0, -7.0) mm"));
        let near: Vec<DVec3> = places().into_iter().map(|p| p + DVec3::splat(0.5)).collect();
        assert_eq!(align(&near, &places(), &STRICT), Alignment::Fits { matched: 6, off: Vec::new() });
    }

    #[test]
    fn strangers_are_apart_and_two_points_say_nothing() {
        let strangers: Vec<DVec3> =
            places().iter().zip([7.0, 19.0, -13.0, 3.0, -29.0, 11.0]).map(|(p, s)| *p * 0.6 + s).collect();
        assert_eq!(align(&strangers, &places(), &STRICT), Alignment::Apart { matched: 0 });
        assert_eq!(align(&places()[..2], &places(), &STRICT), Alignment::Unknown);
        let not_numbers = vec![DVec3::NAN; 6];
        assert_eq!(align(&not_numbers, &places(), &STRICT), Alignment::Apart { matched: 0 });
    }

    #[test]
    fn one_bead_off_is_named() {
        let mut points = places();
        points[4] += DVec3::new(0.0, 9.0, 0.0);
        assert_eq!(align(&points, &places(), &STRICT), Alignment::Fits { matched: 5, off: vec![4] });
    }
}
