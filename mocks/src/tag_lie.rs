//! Consoles whose frames tell of another beam than the arm does on its line, each of the two well formed.

use crate::dicom::FrameTags;

/// What a frame's tags say otherwise.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum TagLie {
    /// The tube had 20 kV more.
    Kvp,
    /// There were 0.3 mm more of copper in the beam.
    Filter,
    /// The left shutter stood 60 mm further to the right, at the detector.
    Collimator,
}

/// Of [`TagLie::Kvp`].
const KV: f32 = 20.0;
/// Of [`TagLie::Filter`].
const COPPER_MM: f64 = 0.3;
/// Of [`TagLie::Collimator`].
const SHUTTER_MM: f64 = 60.0;

impl TagLie {
    /// All of them.
    pub const ALL: [Self; 3] = [Self::Kvp, Self::Filter, Self::Collimator];

    /// Its name on the command line.
    #[must_use]
    pub fn name(self) -> &'static str {
        match self {
            Self::Kvp => "kvp",
            Self::Filter => "filter",
            Self::Collimator => "collimator",
        }
    }

    /// Changes what the frame says, not its pixels.
    pub fn befall(self, tags: &mut FrameTags) {
        match (self, &mut tags.beam) {
            (Self::Kvp, _) => tags.tube_kvp += KV,
            (Self::Filter, Some(beam)) => beam.filter_mm[1] += COPPER_MM,
            (Self::Collimator, Some(beam)) => beam.field_mm[0] += SHUTTER_MM,
            (Self::Filter | Self::Collimator, None) => {}
        }
    }
}
