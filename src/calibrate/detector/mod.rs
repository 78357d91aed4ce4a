//! The panel, from frames without a specimen: offset, gain by photon transfer, the air signal by tube voltage, bad pixels, noise power,
//! and the presampled MTF where an edge was imaged.
//!
//! ```text
//! darks ── offset ─┐
//! airs  ── groups ─┴─ consistent ── air maps ── bad pixels ── photon transfer ── noise power ── DetectorCalibration
//! edge  ─────────────────────────────────────────────────── MTF ─────────────────────────────┘
//! ```
//! Photon transfer: a panel that stores `offset + gain · quanta` has a variance of `gain · (mean − offset)` plus its electronics'. The
//! fixed pattern would add to the variance, so it is taken from differences of two frames of the same exposure. An energy-integrating
//! panel sums photons of different energies; one quantum of its noise is ⟨E²⟩/⟨E⟩, and photons outnumber quanta by ⟨E²⟩/⟨E⟩².

mod air;
mod bad_pixels;
mod edge;
mod fourier;
mod groups;
mod noise_power;
mod offset;
mod surface;
mod transfer;

use crate::acquire::{
    AirBeam, DetectorCalibration, DetectorRecord, EdgeMtf, ExposureLevel, PanelResponse, panel_maps::PanelMaps,
};
use crate::image::Image;

/// A frame without a specimen.
#[derive(Clone, Debug)]
pub struct PanelFrame {
    /// For messages.
    pub label: String,
    /// Stored values.
    pub pixels: Image<f32>,
    /// Tube voltage, if known.
    pub tube_kvp: Option<f64>,
    /// Tube current times time, if known.
    pub exposure_mas: Option<f64>,
    /// Focal spot to panel, if known.
    pub source_to_detector_mm: Option<f64>,
}

/// What a panel is calibrated from.
#[derive(Clone, Debug)]
pub struct Measurement {
    /// Nothing in the beam; two or more per exposure level, several levels.
    pub air: Vec<PanelFrame>,
    /// No X-rays.
    pub dark: Vec<PanelFrame>,
    /// A straight edge of metal on the panel, turned by 2 to 10 degrees against its grid.
    pub edge: Option<PanelFrame>,
    /// Added filtration of all air frames: `aluminium=4.3`; it also gives the spectrum.
    pub filter: Option<String>,
    /// ⟨E⟩ and ⟨E²⟩ (keV, keV²) of the beam at a tube voltage, where the spectrum is known.
    pub spectrum_moments_kev: fn(f64, &str) -> Option<[f64; 2]>,
    /// Bits per stored value, if known.
    pub bits: Option<u32>,
    /// Pixel pitch, if known.
    pub pitch_mm: Option<f64>,
    /// What the panel adds up.
    pub response: PanelResponse,
    /// Who, when, with what.
    pub origin: String,
}

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
    #[error("{label} does not state its {what}, others do; state it for all (--kvp, --mas) or leave the frame out")]
    NotStated {
        /// The frame.
        label: String,
        /// Which quantity.
        what: &'static str,
    },
    /// The signal is not proportional to the exposure.
    #[error(
        "at {kvp}, the signal per mAs scatters by {scatter:.0} % between frames ({most} and {least}): different tube voltages, filters or \
         distances in one set? calibrate them apart"
    )]
    NotProportional {
        /// Tube voltage, in words.
        kvp: String,
        /// Largest over smallest, less 1, percent.
        scatter: f64,
        /// The frame with the most signal per mAs.
        most: String,
        /// With the least.
        least: String,
    },
    /// Nothing but saturated frames.
    #[error("every air frame at {kvp} is saturated ({share:.1} % of the pixels at the end of the scale); lower the exposure")]
    Saturated {
        /// Tube voltage, in words.
        kvp: String,
        /// Least share, percent.
        share: f64,
    },
    /// Too many frames disagree with each other.
    #[error("{found} of {of} air frames at {kvp} differ from the others ({first}); take them again with nothing in the beam")]
    TooManyOutliers {
        /// How many.
        found: usize,
        /// Of how many.
        of: usize,
        /// Tube voltage, in words.
        kvp: String,
        /// What is wrong with the first.
        first: String,
    },
    /// A thing in the beam of all frames.
    #[error(
        "something stands in the beam of every air frame at {kvp}, near column {column}, row {row} (signal {change:+.0} %, {pixels} \
         pixels); remove it and take them again"
    )]
    Object {
        /// Tube voltage, in words.
        kvp: String,
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
    #[error("no exposure level at {kvp} has two usable frames: the gain comes from pairs; take at least two per level")]
    NoPairs {
        /// Tube voltage, in words.
        kvp: String,
    },
    /// Variance does not rise with the mean.
    #[error(
        "at {kvp}, the variance does not rise with the mean (slope {slope:.3e}): are these stored values linear and not smoothed?"
    )]
    NoTransfer {
        /// Tube voltage, in words.
        kvp: String,
        /// Found.
        slope: f64,
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

/// `90 kVp`, or that it is not stated.
fn kvp_words(kvp: Option<f64>) -> String {
    kvp.map_or_else(|| "a tube voltage that is not stated".to_owned(), |kvp| format!("{kvp:.0} kVp"))
}

/// Calibrates.
///
/// # Errors
/// When the frames do not determine offset, air signal or gain, or contradict each other; the message says which frame and what to do.
pub fn calibrate(measurement: &Measurement) -> Result<DetectorCalibration, DetectorError> {
    let size_px = check_frames(measurement)?;
    let mut notes = Vec::new();
    let saturation = saturation_value(measurement, &mut notes);
    let groups = groups::group(&measurement.air, saturation)?;
    let offset = offset::find(&measurement.dark, &groups, saturation, &mut notes)?;
    let mut beams = Vec::new();
    let mut maps = PanelMaps { offset_value: offset.map.clone(), ..PanelMaps::default() };
    let mut bad = bad_pixels::hot(&offset, size_px);
    let (mut nps, mut fitted_readout_sigma) = (None, None);
    for group in &groups {
        let consistent = air::consistent(group, &offset)?;
        let air = air::map(&consistent, &offset, &bad)?;
        bad_pixels::add_dead(&mut bad, &air);
        let transferred = transfer::find(&consistent, &offset, &bad, saturation)?;
        bad_pixels::add_unstable(&mut bad, &consistent, &air, &offset, &transferred);
        // Once more without the pixels that turned out to be unstable.
        let transferred = transfer::find(&consistent, &offset, &bad, saturation)?;
        if nps.is_none() {
            nps = noise_power::find(&consistent, &offset, &air, &bad, measurement.pitch_mm);
        }
        fitted_readout_sigma = fitted_readout_sigma.or(transferred.readout_sigma);
        notes.extend(transferred.notes.iter().cloned());
        beams.push(beam(measurement, &consistent, &air, &transferred));
        maps.air_share.push(air.share);
    }
    let mtf = match &measurement.edge {
        Some(edge) => Some(edge_mtf(edge, &offset, &maps, measurement.pitch_mm)?),
        None => {
            notes.push("no MTF: no edge frame was given (--edge)".into());
            None
        }
    };
    if measurement.pitch_mm.is_none() {
        notes.push("the pixel pitch is not known: frequencies are per pixel".into());
    }
    let record = DetectorRecord {
        origin: measurement.origin.clone(),
        columns_px: size_px[0] as u32,
        rows_px: size_px[1] as u32,
        pitch_mm: measurement.pitch_mm,
        response: measurement.response,
        bits: measurement.bits,
        saturation_value: saturation,
        offset_value: Some(offset.median),
        offset_sigma_value: Some(offset.sigma),
        offset_from: Some(offset.from.to_owned()),
        readout_sigma_value: offset.readout_sigma.or(fitted_readout_sigma),
        air_value: None,
        photons_per_pixel: None,
        noise_correlation_first_neighbour: None,
        noise_correlation_second_neighbour: None,
        beams,
        bad_pixels: bad_pixels::count(&bad),
        mtf,
        nps,
        notes,
        maps: None,
    };
    maps.bad = Some(bad);
    Ok(DetectorCalibration { record, maps })
}

fn check_frames(measurement: &Measurement) -> Result<[usize; 2], DetectorError> {
    let first = measurement.air.first().ok_or(DetectorError::NoAir)?;
    let expected = [first.pixels.width, first.pixels.height];
    let all = measurement.air.iter().chain(&measurement.dark).chain(&measurement.edge);
    for frame in all.clone() {
        let count = frame.pixels.pixels.iter().filter(|value| !value.is_finite()).count();
        if count > 0 {
            return Err(DetectorError::NotFinite { label: frame.label.clone(), count });
        }
    }
    match all.map(|frame| (frame, [frame.pixels.width, frame.pixels.height])).find(|(_, size)| *size != expected) {
        None => Ok(expected),
        Some((frame, found)) => {
            Err(DetectorError::Size { label: frame.label.clone(), found, first: first.label.clone(), expected })
        }
    }
}

/// Equal values at the very top of a frame are a plateau when there are this many …
const PLATEAU_PIXELS: usize = 20;
/// … and this many times as many as at the value below.
const PLATEAU_RATIO: usize = 5;

/// The stored value at which the panel saturates: the end of its bits, or a plateau that the frames show.
fn saturation_value(measurement: &Measurement, notes: &mut Vec<String>) -> Option<f64> {
    let values = || measurement.air.iter().flat_map(|frame| frame.pixels.pixels.iter().copied());
    let top = values().fold(f32::MIN, f32::max);
    let at = |value: f32| values().filter(|v| *v == value).count();
    let plateau = at(top);
    let shown = plateau >= PLATEAU_PIXELS && plateau >= PLATEAU_RATIO * at(top - 1.0).max(1);
    let by_bits = measurement.bits.map(|bits| f64::from(2u32.saturating_pow(bits.min(31))) - 1.0);
    if shown && by_bits.is_none_or(|end| f64::from(top) < end) {
        notes.push(format!("the panel saturates at {top}: {plateau} pixels stand there"));
        return Some(f64::from(top));
    }
    by_bits
}

fn beam(measurement: &Measurement, group: &air::Consistent, air: &air::AirMap, transferred: &transfer::Transfer) -> AirBeam {
    let moments =
        group.kvp.zip(measurement.filter.as_deref()).and_then(|(kvp, filter)| (measurement.spectrum_moments_kev)(kvp, filter));
    let moments = moments.filter(|_| measurement.response == PanelResponse::Energy);
    let gain = transferred.gain;
    let photons_per_quantum = match measurement.response {
        PanelResponse::Counting => Some(1.0),
        PanelResponse::Energy => moments.map(|[mean, square]| square / (mean * mean)),
    };
    let quanta_per_mas = air.per_mas.map(|value| value / gain);
    let levels = group.levels.iter().map(|level| ExposureLevel {
        exposure_mas: level.mas,
        frames: level.frames.len(),
        air_value: level.median,
        quanta_per_pixel: Some(level.median / gain),
        saturated_share: 0.0,
    });
    let mut levels: Vec<ExposureLevel> = levels.chain(group.saturated.iter().cloned()).collect();
    levels.sort_by(|a, b| a.air_value.total_cmp(&b.air_value));
    AirBeam {
        tube_kvp: group.kvp,
        filter: measurement.filter.clone(),
        source_to_detector_mm: group.source_to_detector_mm,
        air_value_per_mas: air.per_mas,
        air_value: air.per_mas.is_none().then_some(air.median),
        air_relative_sigma: air.relative_sigma,
        gain_value_per_quantum: Some(gain),
        gain_relative_sigma: Some(transferred.relative_sigma),
        quanta_per_pixel_per_mas: quanta_per_mas,
        photons_per_quantum,
        photons_per_pixel_per_mas: quanta_per_mas.zip(photons_per_quantum).map(|(quanta, photons)| quanta * photons),
        gain_value_per_kev: moments.map(|[mean, square]| gain * mean / square),
        heel_share: Some(air.heel_share),
        levels,
        frames_left_out: group.left_out.clone(),
    }
}

fn edge_mtf(
    edge: &PanelFrame,
    offset: &offset::Offset,
    maps: &PanelMaps,
    pitch_mm: Option<f64>,
) -> Result<EdgeMtf, DetectorError> {
    let mut flat = edge.pixels.clone();
    for (at, value) in flat.pixels.iter_mut().enumerate() {
        let share = maps.air_share.first().map_or(1.0, |map| map.pixels[at]);
        *value = (f64::from(*value) - offset.at(at)) as f32 / if share > 0.0 { share } else { 1.0 };
    }
    edge::mtf(&flat, pitch_mm.unwrap_or(1.0)).map_err(|detail| DetectorError::Edge { label: edge.label.clone(), detail })
}
