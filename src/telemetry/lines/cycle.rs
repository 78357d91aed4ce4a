//! Numbers that begin anew at some value, counted on.

/// Follows a number that wraps.
#[derive(Clone, Debug)]
pub(super) struct Cycle {
    period: Option<i64>,
    last: Option<i64>,
}

impl Cycle {
    pub(super) fn new(period: Option<i64>) -> Self {
        Self { period, last: None }
    }

    /// `found` counted on: of all that it may stand for the one nearest to `expected`. A device that starts over before half a
    /// turn stays below: it is nearer to what it was than to another turn.
    pub(super) fn take(&mut self, found: i64, since_last: i64) -> i64 {
        let counted = match (self.period, self.last) {
            (Some(period), Some(last)) => {
                let expected = last.saturating_add(since_last);
                let turns = (expected.saturating_sub(found) as f64 / period as f64).round().max(0.0);
                found.saturating_add((turns as i64).saturating_mul(period))
            }
            _ => found,
        };
        self.last = Some(counted);
        counted
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_clock_of_sixteen_bits_goes_on_over_its_end_and_over_a_pause_longer_than_itself() {
        let mut clock = Cycle::new(Some(65_536));
        assert_eq!(clock.take(65_000, 0), 65_000);
        assert_eq!(clock.take(64, 600), 65_600);
        // 200 s later by the host: three turns and some.
        assert_eq!(clock.take((65_600 + 200_000) % 65_536, 199_985), 265_600);
        // A line that came late.
        assert_eq!(clock.take((265_600 - 20) % 65_536, 5), 265_580);
        let mut without = Cycle::new(None);
        assert_eq!([without.take(9, 0), without.take(3, 7)], [9, 3]);
    }

    #[test]
    fn a_device_that_starts_over_is_behind_and_not_a_turn_ahead() {
        let mut clock = Cycle::new(Some(1 << 32));
        assert_eq!(clock.take(5_000_000, 0), 5_000_000);
        assert_eq!(clock.take(20, 3_000_000), 20);
    }
}
