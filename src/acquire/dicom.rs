//! DICOM files: stored values, rescaling and direction.

use dicom_core::Tag;
use dicom_dictionary_std::tags;
use dicom_encoding::TransferSyntaxIndex;
use dicom_object::DefaultDicomObject;
use dicom_pixeldata::PixelDecoder;

use super::domain::{Traces, judge};
use super::padding::Padding;
use super::tag_reader::TagReader;
use super::terms::is_term;
use super::{Domain, Fault, LOSSY_PIXELS, Raw, extent, whole};
use crate::foreign::Limits;
use crate::image::Image;

/// Lossy transfer syntaxes that can be decoded: JPEG baseline and extended.
const LOSSY: [&str; 2] = ["1.2.840.10008.1.2.4.50", "1.2.840.10008.1.2.4.51"];

/// A parsed file whose pixels are decoded: images are made of them one at a time.
pub(super) struct DicomImages {
    object: DefaultDicomObject,
    layout: Layout,
    stored: Vec<u8>,
    declared: Option<Domain>,
}

impl DicomImages {
    /// Parses and decodes.
    pub(super) fn open(bytes: &[u8], declared: Option<Domain>, limits: &Limits) -> Result<Self, Fault> {
        let object = parse(bytes, None)?;
        let layout = Layout::of(&object, limits)?;
        let stored = stored_bytes(&object, &layout)?;
        Ok(Self { object, layout, stored, declared })
    }

    /// How many images there are.
    pub(super) fn count(&self) -> usize {
        self.layout.frames
    }

    /// The header's words that identify someone.
    pub(super) fn identity(&self) -> Vec<String> {
        super::identity::words(&self.object)
    }

    /// Gives the images to `take`, in order.
    pub(super) fn each(&self, take: &mut dyn FnMut(Raw) -> Result<(), Fault>) -> Result<(), Fault> {
        each(&self.object, &self.layout, &self.stored, self.declared, take)
    }
}

fn each(
    object: &DefaultDicomObject,
    layout: &Layout,
    stored: &[u8],
    declared: Option<Domain>,
    take: &mut dyn FnMut(Raw) -> Result<(), Fault>,
) -> Result<(), Fault> {
    let mut notes = Vec::new();
    let frame_tags = TagReader::new(object, &mut notes).read();
    let mut altered = Vec::new();
    let mapping = Mapping::of(object, layout, frame_tags.intensity_relationship.as_deref(), &mut notes, &mut altered);
    let traces = Traces {
        voi_lut: object.get(tags::VOILUT_SEQUENCE).is_some(),
        processing: has_text(object, tags::PROCESSING_FUNCTION)
            || has_text(object, tags::ACQUISITION_DEVICE_PROCESSING_DESCRIPTION)
            || has_text(object, tags::ACQUISITION_DEVICE_PROCESSING_CODE),
        lossy: LOSSY.contains(&transfer_syntax(object))
            || has_text(object, tags::LOSSY_IMAGE_COMPRESSION_RATIO)
            || was_lossy(object),
    };
    let verdict = judge(&frame_tags, traces, mapping.decreasing(), declared);
    notes.extend(verdict.notes);
    if traces.lossy {
        altered.push(LOSSY_PIXELS.to_owned());
    }
    if frame_tags.pitch_mm.is_none() && frame_tags.pixel_spacing_mm.is_some() {
        notes.push(
            "only pixel spacing (0028,0030) is given, which may be calibrated at the object: the detector's pitch stays open"
                .into(),
        );
    }
    if let Some(turned) = frame_tags.field_of_view_rotation_deg.filter(|&turned| turned != 0.0) {
        notes.push(format!("the console turned the image by {turned} degrees; this is not undone"));
    }
    let padding = Padding::of(object, layout.signed, &mut notes);
    notes.extend(padding.map(|padding| padding.words()));

    let ends = mapping.ends(layout);
    // Linear and display frames promise "larger is more signal", log frames "larger is more attenuation".
    let inverted = match verdict.domain {
        Domain::Log => verdict.larger_is_more_signal,
        Domain::Linear | Domain::Display | Domain::Unknown => !verdict.larger_is_more_signal,
    };
    if inverted && verdict.domain == Domain::Linear {
        notes.push(format!(
            "turned round about the ends of {} bits stored, {} and {}: no attribute says at which value there is no signal",
            layout.bits_stored, ends[0], ends[1]
        ));
    }
    let unmirrored = frame_tags.field_of_view_flipped == Some(true);
    for values in stored.chunks_exact(layout.frame_bytes()).take(layout.frames) {
        let (mut padded, mut beyond) = (0, 0u64);
        let mut pixels: Vec<f32> = values
            .chunks_exact(layout.sample_bytes())
            .map(|sample| {
                let word = layout.word(sample);
                // Padding may lie beyond the stored bits, where no measured value can be.
                if padding.is_some_and(|padding| padding.holds(layout.value(word)) || padding.holds(layout.whole(word))) {
                    padded += 1;
                    return f32::NAN;
                }
                beyond += u64::from(layout.holds_more(word));
                let value = mapping.apply(layout.value(word));
                (if inverted { ends[0] + ends[1] - value } else { value }) as f32
            })
            .collect();
        let mut altered = altered.clone();
        if beyond > 0 {
            altered.push(format!(
                "{beyond} pixels hold more than the {} bits that are stored (0028,0101): the rest was cut off, as overlays are; if they are bright, their values have wrapped round",
                layout.bits_stored
            ));
        }
        if unmirrored {
            pixels.chunks_exact_mut(layout.columns).for_each(<[f32]>::reverse);
        }
        take(Raw {
            pixels: Image { width: layout.columns, height: layout.rows, pixels },
            domain: verdict.domain,
            evidence: verdict.evidence.clone(),
            unit: None,
            turned_about: inverted.then_some(ends[0] + ends[1]),
            unmirrored,
            tags: frame_tags.clone(),
            scale_ends: Some([ends[0] as f32, ends[1] as f32]),
            padded,
            altered,
            notes: notes.clone(),
        })?;
    }
    Ok(())
}

/// The data set in the bytes of a file, the elements from `until` on left out.
pub(super) fn parse(bytes: &[u8], until: Option<Tag>) -> Result<DefaultDicomObject, Fault> {
    if extent::claims_too_much(bytes, until) {
        return Err(Fault::Dicom { detail: "it ends early".to_owned() });
    }
    let options = dicom_object::OpenFileOptions::new().read_preamble(dicom_object::file::ReadPreamble::Always);
    let options = if let Some(tag) = until { options.read_until(tag) } else { options };
    options.from_reader(bytes).map_err(|error| where_parsing_stopped(&error))
}

/// Where the parser stopped. Its own words are not passed on, because they may repeat what the file says.
fn where_parsing_stopped(error: &dicom_object::ReadError) -> Fault {
    use dicom_object::ReadError;
    let damaged = |detail: &str| Fault::Dicom { detail: detail.to_owned() };
    match error {
        ReadError::ParseMetaDataSet { .. } => damaged("in its file meta information"),
        ReadError::ReadUnrecognizedTransferSyntax { .. }
        | ReadError::ReadUnsupportedTransferSyntax { .. }
        | ReadError::ReadUnsupportedTransferSyntaxWithSuggestion { .. } => {
            Fault::TransferSyntax { name: "that is not read here, perhaps deflated".to_owned() }
        }
        ReadError::PrematureEnd { .. } => damaged("it ends early"),
        _ => damaged("in its data set"),
    }
}

fn has_text(object: &DefaultDicomObject, tag: Tag) -> bool {
    object.get(tag).and_then(|element| element.to_str().ok()).is_some_and(|text| !text.trim().is_empty())
}

/// Whether the pixels passed through lossy compression at any time (PS3.3 C.7.6.1.1.5), whatever they are kept in now.
fn was_lossy(object: &DefaultDicomObject) -> bool {
    let said = object.get(tags::LOSSY_IMAGE_COMPRESSION).and_then(|element| element.to_str().ok());
    said.is_some_and(|said| said.trim_matches(['\0', ' ']) == "01")
}

fn transfer_syntax(object: &DefaultDicomObject) -> &str {
    object.meta().transfer_syntax.trim_end_matches(['\0', ' '])
}

/// How samples lie in the pixel data.
pub(super) struct Layout {
    pub(super) columns: usize,
    pub(super) rows: usize,
    pub(super) frames: usize,
    bits_allocated: usize,
    bits_stored: u32,
    high_bit: u32,
    pub(super) signed: bool,
}

impl Layout {
    pub(super) fn of(object: &DefaultDicomObject, limits: &Limits) -> Result<Self, Fault> {
        let attribute = |tag: &str, found: String, expected: &str| Fault::Attribute {
            tag: tag.to_owned(),
            found,
            expected: expected.to_owned(),
        };
        let integer = |tag: Tag, name: &'static str| {
            let element = object.get(tag).ok_or_else(|| attribute(name, "missing".into(), "a number"))?;
            element.to_int::<u32>().map_err(|_| attribute(name, "not a number".into(), "a number"))
        };
        let optional =
            |tag: Tag, default: u32| object.get(tag).and_then(|element| element.to_int::<u32>().ok()).unwrap_or(default);
        let (rows, columns) = (integer(tags::ROWS, "rows (0028,0010)")?, integer(tags::COLUMNS, "columns (0028,0011)")?);
        if rows == 0 || columns == 0 {
            return Err(Fault::Empty { width: u64::from(columns), height: u64::from(rows) });
        }
        let samples = optional(tags::SAMPLES_PER_PIXEL, 1);
        let photometric = object.get(tags::PHOTOMETRIC_INTERPRETATION).and_then(|element| element.to_str().ok());
        let photometric = photometric.as_deref().map_or("MONOCHROME2", |text| text.trim_matches([' ', '\0']));
        if samples != 1 || !photometric.starts_with("MONOCHROME") {
            let shown = if is_term("photometric", photometric) { photometric } else { "none of the standard" };
            let found = format!("{samples} samples per pixel, photometric interpretation {shown}");
            return Err(Fault::Colour { found });
        }
        let bits_allocated = integer(tags::BITS_ALLOCATED, "bits allocated (0028,0100)")?;
        if !matches!(bits_allocated, 8 | 16 | 32) {
            return Err(attribute("bits allocated (0028,0100)", bits_allocated.to_string(), "8, 16 or 32"));
        }
        let bits_stored = optional(tags::BITS_STORED, bits_allocated);
        if !(1..=bits_allocated).contains(&bits_stored) {
            return Err(attribute("bits stored (0028,0101)", bits_stored.to_string(), "between 1 and the bits allocated"));
        }
        let high_bit = optional(tags::HIGH_BIT, bits_stored - 1);
        if !(bits_stored - 1..bits_allocated).contains(&high_bit) {
            return Err(attribute("high bit (0028,0102)", high_bit.to_string(), "within the allocated bits"));
        }
        let frames = optional(tags::NUMBER_OF_FRAMES, 1).max(1);
        let image = u64::from(rows) * u64::from(columns);
        if image > limits.image_pixels {
            return Err(Fault::TooLarge { width: u64::from(columns), height: u64::from(rows), limit: limits.image_pixels });
        }
        super::check_total(u64::from(frames), image.saturating_mul(u64::from(frames)), limits)?;
        Ok(Self {
            columns: columns as usize,
            rows: rows as usize,
            frames: frames as usize,
            bits_allocated: bits_allocated as usize,
            bits_stored,
            high_bit,
            signed: optional(tags::PIXEL_REPRESENTATION, 0) == 1,
        })
    }

    pub(super) fn sample_bytes(&self) -> usize {
        self.bits_allocated / 8
    }

    pub(super) fn frame_bytes(&self) -> usize {
        self.rows * self.columns * self.sample_bytes()
    }

    /// All bits of `sample` (little-endian).
    pub(super) fn word(&self, sample: &[u8]) -> u64 {
        sample.iter().rev().fold(0, |word, &byte| word << 8 | u64::from(byte))
    }

    /// The stored value in `word`: overlay bits are masked off, the sign is extended.
    pub(super) fn value(&self, word: u64) -> i64 {
        self.number(word >> (self.high_bit + 1 - self.bits_stored) & ((1u64 << self.bits_stored) - 1), self.bits_stored)
    }

    /// The value of the whole `word`, overlay bits and all.
    pub(super) fn whole(&self, word: u64) -> i64 {
        self.number(word, self.bits_allocated as u32)
    }

    /// Whether there is anything but a sign above the stored bits of `word`.
    pub(super) fn holds_more(&self, word: u64) -> bool {
        let above = self.high_bit + 1;
        let (rest, all) = (word >> above, (1u64 << (self.bits_allocated as u32 - above)) - 1);
        rest != 0 && !(self.signed && rest == all && self.value(word) < 0)
    }

    fn number(&self, bits: u64, count: u32) -> i64 {
        if self.signed && bits >> (count - 1) == 1 { bits as i64 - (1i64 << count) } else { bits as i64 }
    }

    /// Smallest and largest value that can be stored.
    fn stored_ends(&self) -> [i64; 2] {
        if self.signed {
            [-(1i64 << (self.bits_stored - 1)), (1i64 << (self.bits_stored - 1)) - 1]
        } else {
            [0, (1i64 << self.bits_stored) - 1]
        }
    }
}

/// All frames' samples, little-endian.
pub(super) fn stored_bytes(object: &DefaultDicomObject, layout: &Layout) -> Result<Vec<u8>, Fault> {
    let Some(element) = object.get(tags::PIXEL_DATA) else {
        return Err(Fault::Attribute {
            tag: "pixel data (7FE0,0010)".into(),
            found: "missing".into(),
            expected: "integer pixels; the file is cut short or holds no image".into(),
        });
    };
    let uid = transfer_syntax(object);
    match dicom_transfer_syntax(uid) {
        Some((_, true)) => {}
        // An identifier of the standard may be shown; any other might be somebody's own text.
        Some((name, false)) => return Err(Fault::TransferSyntax { name: format!("{name} ({uid})") }),
        None => return Err(Fault::TransferSyntax { name: "that is not in the standard".into() }),
    }
    let expected = layout.frame_bytes() * layout.frames;
    if let Some(fragments) = element.value().fragments() {
        let size = [layout.columns as u64, layout.rows as u64];
        whole::check_fragments(fragments, uid, size, layout.sample_bytes())?;
    }
    let decoded = object.decode_pixel_data().map_err(|_| Fault::Dicom { detail: "in its pixel data".into() })?;
    let bytes = decoded.into_data();
    // An odd number of bytes is padded to even.
    if bytes.len() < expected || bytes.len() > expected + 1 {
        return Err(Fault::PixelBytes { expected: expected as u64, found: bytes.len() as u64 });
    }
    Ok(bytes)
}

/// Whether pixels of this transfer syntax are read.
pub(super) fn is_readable(transfer_syntax: &str) -> bool {
    dicom_transfer_syntax(transfer_syntax).is_some_and(|(_, is_decoded)| is_decoded)
}

/// Name of a transfer syntax, and whether its pixels can be decoded.
fn dicom_transfer_syntax(uid: &str) -> Option<(&'static str, bool)> {
    let syntax = dicom_transfer_syntax_registry::TransferSyntaxRegistry.get(uid)?;
    Some((syntax.name(), syntax.can_decode_all()))
}

/// From stored values to the file's output values: rescale slope and intercept, or a look-up table.
enum Mapping {
    Linear { slope: f64, intercept: f64 },
    Table { first: i64, values: Vec<u16>, bits: u32 },
}

impl Mapping {
    fn of(
        object: &DefaultDicomObject,
        layout: &Layout,
        relation: Option<&str>,
        notes: &mut Vec<String>,
        altered: &mut Vec<String>,
    ) -> Self {
        if object.get(tags::MODALITY_LUT_SEQUENCE).is_some() {
            // XA files with a LOG relationship bring a table that linearises them; the stored logarithm is what is wanted here.
            if relation == Some("LOG") {
                notes.push(
                    "the modality look-up table was not applied: the stored values are logarithmic, as the header says".into(),
                );
                return Self::identity();
            }
            if let Some(table) = Self::table(object, layout) {
                notes.push("a modality look-up table was applied".into());
                return table;
            }
            altered.push("the modality look-up table (0028,3000) is not usable and was ignored".to_owned());
            return Self::identity();
        }
        let mut reader = TagReader::new(object, notes);
        let (slope, intercept) = (reader.number(tags::RESCALE_SLOPE), reader.number(tags::RESCALE_INTERCEPT));
        let (slope, intercept) = (slope.unwrap_or(1.0), intercept.unwrap_or(0.0));
        if slope == 0.0 {
            altered.push("rescale slope (0028,1053) is 0 and was ignored".to_owned());
            return Self::identity();
        }
        if (slope, intercept) != (1.0, 0.0) {
            notes.push(format!("rescaled: {slope} × stored value + {intercept}"));
        }
        Self::Linear { slope, intercept }
    }

    fn identity() -> Self {
        Self::Linear { slope: 1.0, intercept: 0.0 }
    }

    fn table(object: &DefaultDicomObject, layout: &Layout) -> Option<Self> {
        let item = object.get(tags::MODALITY_LUT_SEQUENCE)?.value().items()?.first()?;
        let descriptor = item.get(tags::LUT_DESCRIPTOR)?.to_multi_int::<i32>().ok()?;
        let [count, first, bits] = descriptor[..] else { return None };
        let count = if count == 0 { 65536 } else { usize::from(count as u16) };
        // The descriptor is written unsigned even where the first value is a signed one.
        let first = if layout.signed { i64::from(first as u16 as i16) } else { i64::from(first as u16) };
        let values = item.get(tags::LUT_DATA)?.to_multi_int::<u16>().ok()?;
        (values.len() >= count && (8..=16).contains(&bits)).then(|| Self::Table {
            first,
            values: values[..count].to_vec(),
            bits: bits as u32,
        })
    }

    fn apply(&self, stored: i64) -> f64 {
        match self {
            Self::Linear { slope, intercept } => slope * stored as f64 + intercept,
            Self::Table { first, values, .. } => {
                let index = (stored - first).clamp(0, values.len() as i64 - 1) as usize;
                f64::from(values[index])
            }
        }
    }

    /// Whether larger stored values come out smaller.
    fn decreasing(&self) -> bool {
        match self {
            Self::Linear { slope, .. } => *slope < 0.0,
            Self::Table { values, .. } => values.last() < values.first(),
        }
    }

    /// Smallest and largest value that can come out.
    fn ends(&self, layout: &Layout) -> [f64; 2] {
        match self {
            Self::Linear { .. } => {
                let [a, b] = layout.stored_ends().map(|end| self.apply(end));
                [a.min(b), a.max(b)]
            }
            Self::Table { bits, .. } => [0.0, f64::from((1u32 << bits) - 1)],
        }
    }
}
