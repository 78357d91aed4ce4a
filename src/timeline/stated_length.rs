//! How long a picture's header says it was exposed, against how long the beam was on.

use super::exposure::ExposureInterval;

/// What a header states beyond these is no time of an exposure, ms.
const STATED_MS: std::ops::RangeInclusive<f64> = 1.0..=60_000.0;
/// Lengths that differ by this factor, and by so much, are unlike.
const FAR_FACTOR: i64 = 2;
const FAR_US: i64 = 150_000;
/// Lengths alike differ by less than a quarter and this.
const ALIKE_US: i64 = 60_000;

/// What a stated length says of an exposure.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Length {
    /// The beam was on for about so long.
    Alike,
    /// The beam was on for much longer, or for much less: of another exposure, or the sum of the pulses within it.
    Unlike,
    /// Nothing is stated, telemetry did not see both ends, or the two are neither.
    Untold,
}

/// Exposure Time of a header in µs, where it may be one.
pub(super) fn stated_us(exposure_ms: Option<f64>) -> Option<i64> {
    exposure_ms.filter(|ms| STATED_MS.contains(ms)).map(|ms| (ms * 1e3).round() as i64)
}

/// Whether one of two lengths, µs, is a multiple of the other.
pub(super) fn are_unlike(one_us: i64, other_us: i64) -> bool {
    let (less_us, more_us) = (one_us.min(other_us).max(0), one_us.max(other_us));
    more_us > less_us.saturating_mul(FAR_FACTOR) && more_us.saturating_sub(less_us) > FAR_US
}

/// What the length `stated_us` says of `exposure`, whose ends are known as well as telemetry is dense.
pub(super) fn length_of(stated_us: Option<i64>, exposure: &ExposureInterval) -> Length {
    let is_seen = exposure.samples > 0 && exposure.start_seen && exposure.end_seen && !exposure.open;
    let Some(stated_us) = stated_us.filter(|_| is_seen) else { return Length::Untold };
    let beam_us = exposure.end_us.saturating_sub(exposure.start_us);
    let doubt_us = (exposure.start_uncertainty_us + exposure.end_uncertainty_us) as i64;
    let (least_us, most_us) = (beam_us.saturating_sub(doubt_us), beam_us.saturating_add(doubt_us));
    let nearest_us = if least_us <= most_us { stated_us.clamp(least_us, most_us) } else { beam_us };
    let apart_us = stated_us.saturating_sub(nearest_us).saturating_abs();
    if are_unlike(stated_us, nearest_us) {
        Length::Unlike
    } else if apart_us <= (nearest_us / 4).saturating_add(ALIKE_US) {
        Length::Alike
    } else {
        Length::Untold
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_stated_length_is_unlike_only_where_it_is_far_off_in_time_and_in_ratio() {
        let exposure = |beam_us: i64, end_seen: bool| ExposureInterval { end_seen, ..ExposureInterval::seen_for(beam_us) };
        let mut asked = 0;
        for (stated_ms, beam_us, expected) in [
            (1007.0, 1_000_000, Length::Alike),
            (300.0, 1_000_000, Length::Unlike),
            (1000.0, 300_000, Length::Unlike),
            // Twice as long, and yet within what telemetry may have missed.
            (40.0, 100_000, Length::Alike),
            (600.0, 1_000_000, Length::Untold),
            (f64::NAN, 1_000_000, Length::Untold),
            (0.0, 1_000_000, Length::Untold),
        ] {
            let stated_us = stated_us(Some(stated_ms));
            assert_eq!(length_of(stated_us, &exposure(beam_us, true)), expected, "{stated_ms} ms of {beam_us} µs");
            assert_eq!(length_of(stated_us, &exposure(beam_us, false)), Length::Untold, "an end that was not seen");
            asked += 1;
        }
        assert_eq!(asked, 7);
        assert_eq!(length_of(None, &exposure(1_000_000, true)), Length::Untold);
        let extreme =
            ExposureInterval { start_us: i64::MIN, end_us: i64::MAX, start_uncertainty_us: f64::NAN, ..exposure(1, true) };
        assert_eq!(length_of(Some(1_000_000), &extreme), Length::Unlike);
    }
}
