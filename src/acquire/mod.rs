//! Acquired radiographs: DICOM, PNG and TIFF files become [`Frame`]s with a declared [`Domain`]; identity stays outside.
//!
//! Pixels are oriented by X-ray meaning, not by how a console shows them: in `linear` and `display` frames a larger value means more
//! X-rays at the detector, in `log` frames a larger value means more attenuation (like a line integral). What had to be turned round
//! for that is in [`Frame::inverted`], and why is in [`Frame::domain_evidence`].

mod added_filter;
mod beam_tags;
mod beside;
mod corrected;
mod correction;
mod departed;
mod detector_record;
mod dicom;
mod dimse;
mod domain;
mod entry;
mod error;
mod extent;
mod flood;
mod identity;
mod label;
mod listing;
mod log_form;
mod notices;
mod offer;
mod padding;
pub mod panel_maps;
mod passed_over;
mod photo;
mod raster;
mod read;
mod received;
mod receiver;
mod same_folder;
mod services;
mod source;
mod spool;
mod stored_values;
mod tag_reader;
mod tags;
mod terms;
mod tree;
pub mod video;
mod watch;
mod whole;

use crate::foreign::Limits;
use crate::image::{Image, sha256_bytes};

pub use added_filter::{AddedFilter, AddedFilterError, FilterSource, Likeness};
pub use beam_tags::{
    ALUMINIUM_APART_MM, COPPER_APART_MM, CollimatorShape, CollimatorTags, FilterForm, FilterLayer, FilterMaterial, FilterTags,
    OWN_ALUMINIUM_MM, thickness_words,
};
pub use corrected::{Correction, Stored};
pub use detector_record::{
    AirBeam, BadPixels, DetectorCalibration, DetectorCalibrationError, DetectorRecord, EdgeMtf, ExposureLevel, MapsFile,
    NoisePower, PanelResponse,
};
pub use domain::Domain;
pub use error::{AcquireError, Fault};
pub use flood::exposure_mas;
pub use label::{hashed_input_label, input_label};
pub use listing::files_below;
pub use log_form::Samples;
pub use read::{read_frame, read_frames, read_open, read_photo, serve};
pub use received::ReceivedSource;
pub use receiver::{MOST_ASSOCIATIONS, ReceiverError, ReceiverOptions};
pub use source::{Arrival, Earlier, FrameSource, Reading, Sighting, Trouble};
pub use stored_values::{StoredValue, StoredValues, is_dicom, parse_dicom};
pub use tags::{FrameTags, KEPT_TAGS, KeptTag};
pub use tree::FolderTree;
pub use watch::FolderSource;

use beside::Beside;

/// An acquired radiograph. Serialized (and printed with `{:?}`) without its pixels.
#[derive(Clone, PartialEq, serde::Serialize, serde::Deserialize)]
pub struct Frame {
    /// Counts the frames of a session from 1, in order of arrival; 0 outside one. With the hash it identifies the frame, the name does not.
    #[serde(default)]
    pub number: u32,
    /// What people call the frame: the file's name without folders and ending where that is harmless (with `#0002` for the images of a file
    /// with several), else `frame-HASH`. A label, not an identity: two frames may share it.
    pub name: String,
    /// Pixels; NaN where nothing was measured (not finite in the file, or padding), every other one is finite.
    #[serde(skip, default = "no_pixels")]
    pub pixels: Image<f32>,
    /// Columns and rows.
    pub size_px: [usize; 2],
    /// What the values mean.
    pub domain: Domain,
    /// Why `domain` and the direction of the values are believed, one reason an entry.
    pub domain_evidence: Vec<String>,
    /// Unit of the values where it is known: `neper`, `keV`, `photons`, or `1` (1 is the unattenuated signal).
    pub unit: Option<String>,
    /// The stored values were turned round (`low + high − value`) to give them the direction that `domain` promises.
    pub inverted: bool,
    /// `low + high` of that: the ends of what can be stored, because no attribute says at which value there is no signal.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub turned_about: Option<f64>,
    /// The columns were reversed because the file says that the console had mirrored them.
    pub unmirrored: bool,
    /// What was kept of the file's header.
    pub tags: FrameTags,
    /// SHA-256 of the file's bytes, lower-case hexadecimal.
    pub sha256: String,
    /// Index of this image in its file, and how many images that has. With `sha256` it identifies the content.
    #[serde(default = "only_image")]
    pub image_of_file: [usize; 2],
    /// Number of the frame that was this image before its file was written on or anew.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub completes: Option<u32>,
    /// Pixels clipped at either end of the scale.
    pub clipping: Clipping,
    /// Pixels that were masked, put elsewhere, or are not what the panel measured, at import, a sentence each: whoever uses the frame says them
    /// aloud.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub altered: Vec<String>,
    /// What else a person should know: assumptions, ignored values, conversions.
    pub notes: Vec<String>,
    /// What was done to the pixels after they were read; `None` as long as they are the file's own.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub correction: Option<Correction>,
}

/// What is said of pixels that lossy compression has changed.
pub(crate) const LOSSY_PIXELS: &str = "the pixels passed through lossy compression";

impl Frame {
    /// Whether lossy compression has changed the pixels: the noise of one then tells of the next.
    #[must_use]
    pub fn is_lossy(&self) -> bool {
        self.altered.iter().any(|words| words == LOSSY_PIXELS)
    }
}

/// Pixels that lie at an end of the scale, where detail is lost.
#[derive(Clone, Copy, Debug, Default, PartialEq, serde::Serialize, serde::Deserialize)]
pub struct Clipping {
    /// Share of pixels at the end with the most signal, 0 to 1.
    pub saturated_share: f64,
    /// Their value; `None` when no pixel is clipped there.
    pub saturated_at: Option<f32>,
    /// Share of pixels at the end with the least signal (also collimated and masked areas), 0 to 1.
    pub black_share: f64,
    /// Their value; `None` when no pixel is clipped there.
    pub black_at: Option<f32>,
}

fn only_image() -> [usize; 2] {
    [0, 1]
}

fn no_pixels() -> Image<f32> {
    Image { width: 0, height: 0, pixels: Vec::new() }
}

impl std::fmt::Debug for Frame {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match serde_json::to_string(self) {
            Ok(json) => write!(f, "Frame {json}"),
            Err(_) => write!(f, "Frame {}", self.name),
        }
    }
}

impl Frame {
    /// A frame made in memory, from a simulation or a test; `domain` is taken at its word.
    ///
    /// # Errors
    /// When there is no pixel, or none is finite.
    pub fn from_pixels(name: &str, pixels: Image<f32>, domain: Domain) -> Result<Self, AcquireError> {
        let mut bytes = Vec::with_capacity(pixels.pixels.len() * 4);
        pixels.pixels.iter().for_each(|value| bytes.extend_from_slice(&value.to_le_bytes()));
        let raw = Raw {
            pixels,
            domain,
            evidence: vec![format!("declared: {domain}")],
            unit: None,
            turned_about: None,
            unmirrored: false,
            tags: FrameTags::default(),
            scale_ends: None,
            padded: 0,
            altered: Vec::new(),
            notes: Vec::new(),
        };
        raw.into_frame(name.to_owned(), sha256_bytes(&bytes), only_image())
            .map_err(|fault| AcquireError::Refused { file: name.to_owned(), fault })
    }

    /// Whether a larger value means more attenuation (beads are bright) rather than more signal (beads are dark).
    #[must_use]
    pub fn larger_is_more_attenuation(&self) -> bool {
        self.domain == Domain::Log
    }
}

/// What a file reader hands over before the checks that all kinds of file share.
struct Raw {
    pixels: Image<f32>,
    domain: Domain,
    evidence: Vec<String>,
    unit: Option<String>,
    turned_about: Option<f64>,
    unmirrored: bool,
    tags: FrameTags,
    /// The smallest and largest value that could have been stored, after conversion; `None` for floats, unless they end in a
    /// spike at the highest value of digits.
    scale_ends: Option<[f32; 2]>,
    /// Pixels that are NaN because the file calls them padding.
    padded: usize,
    /// See [`Frame::altered`]; masked pixels are added to it.
    altered: Vec<String>,
    notes: Vec<String>,
}

impl Raw {
    fn into_frame(mut self, name: String, sha256: String, image_of_file: [usize; 2]) -> Result<Frame, Fault> {
        let Image { width, height, .. } = self.pixels;
        if self.pixels.pixels.is_empty() {
            return Err(Fault::Empty { width: width as u64, height: height as u64 });
        }
        // A frame that marks what lies behind the shutters with NaN, or takes the logarithm of nothing there, is ordinary.
        let blank = self.pixels.pixels.iter().filter(|value| !value.is_finite()).count();
        if blank == self.pixels.pixels.len() {
            return Err(Fault::NotFinite { count: blank as u64 });
        }
        let percent = |count: usize| 100.0 * count as f64 / self.pixels.pixels.len() as f64;
        if self.padded > 0 {
            let share = percent(self.padded);
            self.altered
                .push(format!("{} pixels ({share:.2} %) are padding by the file's own word: they are masked", self.padded));
        }
        if blank > self.padded {
            let lost = blank - self.padded;
            self.altered.push(format!("{lost} pixels ({:.2} %) are NaN or infinite: they are masked", percent(lost)));
            self.pixels.pixels.iter_mut().filter(|value| !value.is_finite()).for_each(|value| *value = f32::NAN);
        }
        // Integers cannot lie that far out.
        if self.scale_ends.is_none() {
            let far = mask_far_values(&mut self.pixels.pixels);
            if far > 0 {
                let all = self.pixels.pixels.len();
                self.altered
                    .push(format!("{far} of {all} pixels masked: over {FAR:.0e} times the range of all others away from them"));
            }
        }
        if is_uniform(&self.pixels.pixels) {
            self.altered.push("every pixel has the same value: there is no picture in this frame".to_owned());
        }
        let clipping = clipping(&self.pixels, self.scale_ends, self.domain == Domain::Log);
        Ok(Frame {
            number: 0,
            name,
            size_px: [width, height],
            pixels: self.pixels,
            domain: self.domain,
            domain_evidence: self.evidence,
            unit: self.unit,
            inverted: self.turned_about.is_some(),
            turned_about: self.turned_about,
            unmirrored: self.unmirrored,
            tags: self.tags,
            sha256,
            image_of_file,
            completes: None,
            clipping,
            altered: self.altered,
            notes: self.notes,
            correction: None,
        })
    }
}

/// A few pixels that lie so many ranges of the others away from them are marks or faults: sums over pixels would consist of them.
const FAR: f32 = 1e4;
/// Values that tell the range of all others, and their share that is left out at either end of it.
const RANGE_SAMPLES: usize = 65_536;
const STRANGE_SHARE: usize = 1000;

/// Makes pixels NaN that cannot be of the picture; how many. Wherever most pixels are equal none is.
fn mask_far_values(pixels: &mut [f32]) -> usize {
    let step = (pixels.len() / RANGE_SAMPLES).max(1);
    let mut some: Vec<f32> = pixels.iter().copied().filter(|value| value.is_finite()).step_by(step).collect();
    if some.is_empty() {
        return 0;
    }
    let strange = some.len() / STRANGE_SHARE;
    let last = some.len() - 1;
    let low = *some.select_nth_unstable_by(strange, f32::total_cmp).1;
    let high = *some.select_nth_unstable_by(last - strange, f32::total_cmp).1;
    let reach = FAR * (high - low);
    // A range of 0, or beyond what a float holds.
    if !(reach > 0.0 && reach.is_finite()) {
        return 0;
    }
    let far: Vec<&mut f32> = pixels.iter_mut().filter(|value| **value > high + reach || **value < low - reach).collect();
    let count = far.len();
    far.into_iter().for_each(|value| *value = f32::NAN);
    count
}

fn is_uniform(pixels: &[f32]) -> bool {
    let mut values = pixels.iter().copied().filter(|value| value.is_finite());
    values.next().is_some_and(|first| values.all(|value| value == first))
}

/// Below this share, pixels at the image's own extreme are its brightest pixels, not a clipped plateau.
const PLATEAU_SHARE: f64 = 1e-3;

fn clipping(pixels: &Image<f32>, scale_ends: Option<[f32; 2]>, signal_is_low: bool) -> Clipping {
    // The smaller of a number and NaN is the number.
    let (low, high) = pixels.pixels.iter().fold((f32::MAX, f32::MIN), |(low, high), &v| (low.min(v), high.max(v)));
    if !(low < high) {
        return Clipping::default();
    }
    let at = |end: f32, scale_end: Option<f32>| {
        let share = pixels.pixels.iter().filter(|&&v| v == end).count() as f64 / pixels.pixels.len() as f64;
        let clipped = scale_end == Some(end) || share >= PLATEAU_SHARE && scale_end.is_some();
        if clipped { (share, Some(end)) } else { (0.0, None) }
    };
    let at_low = at(low, scale_ends.map(|ends| ends[0]));
    let at_high = at(high, scale_ends.map(|ends| ends[1]));
    let ((saturated_share, saturated_at), (black_share, black_at)) =
        if signal_is_low { (at_low, at_high) } else { (at_high, at_low) };
    Clipping { saturated_share, saturated_at, black_share, black_at }
}

/// What a reader is told besides the bytes.
#[derive(Clone, Debug, Default, serde::Serialize, serde::Deserialize)]
struct Settings {
    /// The person's word on what the values mean; beats all evidence.
    domain: Option<Domain>,
    /// The file's name, if it is harmless by itself.
    label: Option<String>,
    /// What the description beside a PNG or TIFF says.
    beside: Beside,
    /// Any picture will do: a JPEG or a colour PNG is taken for its brightness.
    #[serde(default)]
    photo: bool,
}

fn check_image(width: u64, height: u64, limits: &Limits) -> Result<(), Fault> {
    if width == 0 || height == 0 {
        return Err(Fault::Empty { width, height });
    }
    if width.saturating_mul(height) > limits.image_pixels {
        return Err(Fault::TooLarge { width, height, limit: limits.image_pixels });
    }
    Ok(())
}

fn check_total(images: u64, pixels: u64, limits: &Limits) -> Result<(), Fault> {
    let over = |what: &str, found: u64, limit: u64| (found > limit).then(|| Fault::TooMany { what: what.into(), found, limit });
    over("images", images, limits.images).or_else(|| over("pixels", pixels, limits.file_pixels)).map_or(Ok(()), Err)
}

/// What the first bytes of a file say.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) enum FileKind {
    /// A DICOM file with its 128-byte preamble.
    Dicom,
    /// PNG.
    Png,
    /// Classic or big TIFF.
    Tiff,
    /// Something else, in words.
    Other(String),
}

impl FileKind {
    /// The kind of the file that starts with `bytes`.
    pub(crate) fn of(bytes: &[u8]) -> Self {
        let starts = |magic: &[u8]| bytes.starts_with(magic);
        if bytes.get(128..132) == Some(b"DICM".as_slice()) {
            Self::Dicom
        } else if starts(b"\x89PNG\r\n\x1a\n") {
            Self::Png
        } else if starts(b"II*\0") || starts(b"MM\0*") || starts(b"II+\0") || starts(b"MM\0+") {
            Self::Tiff
        } else if bytes.is_empty() {
            Self::Other("an empty file".into())
        } else if starts(b"\xff\xd8\xff") {
            Self::Other("a JPEG file (lossy)".into())
        } else if bytes.len() >= 132 && bytes[..128].iter().all(|&byte| byte == 0) {
            Self::Other("a file with a DICOM preamble but without 'DICM' at byte 128".into())
        } else {
            Self::Other("something else".into())
        }
    }
}
