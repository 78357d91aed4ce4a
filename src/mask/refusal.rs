//! Why a candidate is no edge of the field.

/// Why a candidate is no edge of the field, with what was found.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) enum Refusal {
    NotSeen,
    NoStep,
    Wide { width_px: f64 },
    Slope { outside: f64, inside: f64 },
    Mismatch { share: f64, length_px: f64 },
    Bent { share: f64, widening_px: f64 },
    BrightBeside { share: f64 },
    BrightBeyond { share: f64 },
    Structured { spread: f64 },
    DarkerInside { share: f64 },
    NotDark { ratio: f64, noise_ratio: f64 },
}
