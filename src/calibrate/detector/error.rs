//! Why a panel is not calibrated.

/// Why a panel is not calibrated.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum DetectorError {
    /// No air frame.
    #[error("there is no air frame; take at least two per exposure level with nothing in the beam")]
    NoAir,
    /// Frames of different sizes.
    #[error("{label} is {found:?} px, {first} {expected:?}; calibrate one mode of the panel at a time")]
    Size {
        /// The frame.
        label: String,
        /// Columns and rows.
        found: [usize; 2],
        /// The first frame.
        first: String,
        /// Columns and rows.
        expected: [usize; 2],
    },
    /// A frame with pixels that hold no number.
    #[error("{label}: {count} pixels are NaN or infinite; a calibration needs every pixel, export the frame unmasked")]
    NotFinite {
        /// The frame.
        label: String,
        /// How many.
        count: usize,
    },
    /// A dark frame with signal in it.
    #[error("{label} reads {found:.1} where the other dark frames read {expected:.1}: was X-ray on? leave it out")]
    DarkDiffers {
        /// The frame.
        label: String,
        /// Its median.
        found: f64,
        /// Median of the medians.
        expected: f64,
    },
    /// No darks and no way to do without.
    #[error("the offset is not known: there is no dark frame, and {detail}; take dark frames (--dark)")]
    NoOffset {
        /// Why the exposures do not give it.
        detail: String,
    },
    /// Some frames state a quantity and others do not.
    #[error(
        "{label} does not state its {what}, others do; state it for all (--kvp, --mas, --added-filter) or leave the frame out"
    )]
    NotStated {
        /// The frame.
        label: String,
        /// Which quantity.
        what: &'static str,
    },
    /// A total that cannot be one.
    #[error(
        "--filter names {material}, all of it that is in the beam, and the air frames have {filters}: leave {material} out of --filter, what \
         frames state comes on top"
    )]
    Filtration {
        /// The material.
        material: &'static str,
        /// Of all beams, in words.
        filters: String,
    },
    /// The signal is not proportional to the exposure.
    #[error(
        "at {beam}, the signal per mAs scatters by {scatter:.0} % between frames ({most} and {least}): different tube voltages, filters or \
         distances in one set? calibrate them apart"
    )]
    NotProportional {
        /// Tube voltage and filter, in words.
        beam: String,
        /// Largest over smallest, less 1, percent.
        scatter: f64,
        /// The frame with the most signal per mAs.
        most: String,
        /// With the least.
        least: String,
    },
    /// Nothing but saturated frames.
    #[error("every air frame at {beam} is saturated ({share:.1} % of the pixels at the end of the scale); lower the exposure")]
    Saturated {
        /// Tube voltage and filter, in words.
        beam: String,
        /// Least share, percent.
        share: f64,
    },
    /// Too many frames disagree with each other.
    #[error("{found} of {of} air frames at {beam} differ from the others ({first}); take them again with nothing in the beam")]
    TooManyOutliers {
        /// How many.
        found: usize,
        /// Of how many.
        of: usize,
        /// Tube voltage and filter, in words.
        beam: String,
        /// What is wrong with the first.
        first: String,
    },
    /// A thing in the beam of all frames.
    #[error(
        "something stands in the beam of every air frame at {beam}, near column {column}, row {row} (signal {change:+.0} %, {pixels} \
         pixels); remove it and take them again"
    )]
    Object {
        /// Tube voltage and filter, in words.
        beam: String,
        /// Where.
        column: usize,
        /// Where.
        row: usize,
        /// Against the smooth surface, percent.
        change: f64,
        /// Connected pixels.
        pixels: usize,
    },
    /// Not two frames of one exposure.
    #[error("no exposure level at {beam} has two usable frames: the gain comes from pairs; take at least two per level")]
    NoPairs {
        /// Tube voltage and filter, in words.
        beam: String,
    },
    /// Variance does not rise with the mean.
    #[error(
        "at {beam}, the variance does not rise with the mean (slope {slope:.3e}): are these stored values linear and not smoothed?"
    )]
    NoTransfer {
        /// Tube voltage and filter, in words.
        beam: String,
        /// Found.
        slope: f64,
    },
    /// Noise that pixels have in common and that is not of shared quanta.
    #[error(
        "at {beam}, pixels {columns} columns and {rows} rows apart have noise in common (correlation {correlation:.2}) that is not of light \
         that spreads: whole lines vary as one, or the frames were smoothed or enlarged, and the gain is not known; take frames as the \
         panel reads them, or have its line noise corrected"
    )]
    CommonNoise {
        /// Tube voltage and filter, in words.
        beam: String,
        /// From one to the other.
        columns: usize,
        /// From one to the other.
        rows: usize,
        /// Over the variance that rises with the signal.
        correlation: f64,
    },
    /// The edge frame shows no usable edge.
    #[error("{label}: {detail}")]
    Edge {
        /// The frame.
        label: String,
        /// Why.
        detail: String,
    },
}
