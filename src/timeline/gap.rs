//! An arm that moves while nothing is heard of it: between the samples on either side it may have been anywhere on the way, and joints that
//! are interpolated there are a guess.

use super::Timeline;
use super::evidence::{Binding, BindingFlag, GAP_LIMIT_US, MOVED_LIMITS, is_angle};
use crate::geometry::CarmJoints;
use crate::units::wrap_rad;

/// So many of the limits from which motion matters are five degrees, or 12.5 mm: the standard deviation with which an expected pose is held,
/// where nothing says how good it is.
const AS_A_PRIOR: f64 = 25.0;

/// The time without telemetry around a moment, and the joints on either side of it.
#[derive(Clone, Copy, Debug)]
pub struct Gap {
    gap_us: i64,
    sides: [CarmJoints; 2],
}

impl Gap {
    /// Around `host_us`; `None` where telemetry was not heard on both sides.
    #[must_use]
    pub fn around(timeline: &Timeline, host_us: i64) -> Option<Self> {
        let bracket = timeline.carm().bracket(host_us)?;
        let sides = [bracket.left.value.joints, bracket.right?.value.joints];
        Some(Self { gap_us: bracket.answer(()).gap_us, sides })
    }

    /// The joint that moved most, beside how far it may, where telemetry was silent for long enough.
    fn moved(&self) -> Option<BindingFlag> {
        let [before, after] = self.sides.map(|joints| joints.to_array());
        let apart = |i: usize| {
            let apart = after[i] - before[i];
            if is_angle(i) { wrap_rad(apart).to_degrees().abs() } else { apart.abs() }
        };
        // A joint without an encoder is NaN here; that it moved is not known.
        let most = (0..MOVED_LIMITS.len()).filter(|i| apart(*i) > MOVED_LIMITS[*i].1);
        let most = most.max_by(|a, b| (apart(*a) / MOVED_LIMITS[*a].1).total_cmp(&(apart(*b) / MOVED_LIMITS[*b].1)))?;
        let (joint, limit) = MOVED_LIMITS[most];
        let moved = BindingFlag::MovedInGap { joint, moved: apart(most), limit, gap_us: self.gap_us };
        (self.gap_us > GAP_LIMIT_US).then_some(moved)
    }
}

impl Binding {
    /// The same with word of an arm that moved in `gap`, in which the frame was taken.
    #[must_use]
    pub fn across(mut self, gap: Option<Gap>) -> Self {
        self.flags.extend(gap.and_then(|gap| gap.moved()));
        self
    }

    /// Whether the arm moved while nothing was heard of it: its joints say nothing of where the specimen lies.
    #[must_use]
    pub fn is_guessed(&self) -> bool {
        self.flags.iter().any(|flag| matches!(flag, BindingFlag::MovedInGap { .. }))
    }

    /// Whether it moved farther than an expected pose may be off: there is none by its joints.
    #[must_use]
    pub fn is_no_prior(&self) -> bool {
        let is_far = |flag: &BindingFlag| match flag {
            BindingFlag::MovedInGap { moved, limit, .. } => !(*moved <= AS_A_PRIOR * limit),
            _ => false,
        };
        self.flags.iter().any(is_far)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Joints of a gap of the C-arm's telemetry were used as if they had been measured: they tied the specimen to the room, and a pose was held
    /// against them.
    #[test]
    fn an_arm_that_moves_in_a_gap_is_said_and_one_that_moves_far_is_no_prior() {
        let at = |orbital_deg: f64, lift_mm: f64| {
            let orbital_rad = orbital_deg.to_radians();
            CarmJoints { orbital_rad, lift_mm, ..CarmJoints::ZERO }
        };
        let across = |gap_us: i64, after: CarmJoints| {
            let sides = [at(179.0, 0.0), after];
            Binding::default().across(Some(Gap { gap_us, sides }))
        };
        let plain = across(400_000, at(179.1, 0.4));
        assert!(plain.flags.is_empty() && !plain.is_guessed() && !plain.is_no_prior(), "it stood still: {plain:?}");
        let short = across(100_000, at(-171.0, 0.0));
        assert!(short.flags.is_empty(), "between two samples in a row: {short:?}");
        assert_eq!(Binding::default().across(None).flags, []);
        // Two degrees, the short way round.
        let near = across(400_000, at(-179.0, 0.3));
        assert!(near.is_guessed() && !near.is_no_prior(), "{near:?}");
        let words = near.flags[0].to_string();
        assert!(words.starts_with("orbital moved by 2.00 while nothing was heard of the C-arm for 0.400 s"), "{words}");
        let far = across(400_000, at(-174.0, 0.0));
        assert!(far.is_guessed() && far.is_no_prior(), "{far:?}");
        let lifted = across(400_000, at(179.0, 20.0));
        assert!(lifted.is_no_prior() && lifted.flags[0].to_string().starts_with("lift moved by 20.00"), "{lifted:?}");
    }
}
