//! Points in time of a log, as people name them.

use crate::time::us_from_rfc3339;

/// When, as it is typed.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Moment {
    /// Seconds from the start of the log.
    SinceStart {
        /// So many.
        s: f64,
    },
    /// Host time.
    At {
        /// Microseconds since the Unix epoch.
        host_us: i64,
    },
}

impl std::str::FromStr for Moment {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let seconds = text.parse::<f64>().ok().filter(|s| s.is_finite() && *s >= 0.0).map(|s| Self::SinceStart { s });
        seconds.or_else(|| us_from_rfc3339(text).map(|host_us| Self::At { host_us })).ok_or_else(|| {
            "expected seconds from the start of the log (12.5), or a time as 2026-11-21T10:00:00Z (RFC 3339, with its zone)"
                .to_owned()
        })
    }
}

impl Moment {
    /// Of a log that begins at `start_us`.
    pub(super) fn host_us(self, start_us: i64) -> i64 {
        match self {
            // Saturates far outside any log.
            Self::SinceStart { s } => start_us.saturating_add((s * 1e6).round() as i64),
            Self::At { host_us } => host_us,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_moment_is_seconds_or_a_time_with_its_zone() {
        assert_eq!("12.5".parse(), Ok(Moment::SinceStart { s: 12.5 }));
        assert_eq!("2024-02-29T12:00:00Z".parse(), Ok(Moment::At { host_us: 1_709_208_000_000_000 }));
        for text in ["-1", "NaN", "inf", "noon", "2024-02-29T12:00:00", ""] {
            assert!(text.parse::<Moment>().is_err(), "{text}");
        }
    }
}
