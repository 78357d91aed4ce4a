//! Stored values of a DICOM file, for those who make something else than frames of it.

use dicom_core::Tag;
use dicom_object::DefaultDicomObject;

use super::dicom::{Layout, parse, stored_bytes};
use super::padding::Padding;
use super::{Fault, FileKind};
use crate::foreign::Limits;

/// Whether a file that begins with these bytes is a DICOM file (with preamble).
#[must_use]
pub fn is_dicom(head: &[u8]) -> bool {
    FileKind::of(head) == FileKind::Dicom
}

/// The data set in the bytes of a file, the elements from `until` on left out.
///
/// # Errors
/// When it is damaged or cut short before that.
pub fn parse_dicom(bytes: &[u8], until: Option<Tag>) -> Result<DefaultDicomObject, Fault> {
    parse(bytes, until)
}

/// One pixel.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct StoredValue {
    /// What is stored.
    pub value: i64,
    /// It is padding by the file's own word.
    pub is_padding: bool,
    /// There is more above the stored bits than a sign: overlays, or a value that has wrapped round.
    pub holds_more: bool,
}

/// Pixels of a file as they are stored: decompressed, overlays cut off, signs extended, not rescaled.
pub struct StoredValues {
    layout: Layout,
    bytes: Vec<u8>,
    padding: Option<Padding>,
}

impl StoredValues {
    /// Of a whole data set.
    ///
    /// # Errors
    /// When attributes or pixels are missing, damaged, in colour, compressed in a way that is not supported, or too many.
    pub fn of(object: &DefaultDicomObject, limits: &Limits, notes: &mut Vec<String>) -> Result<Self, Fault> {
        let layout = Layout::of(object, limits)?;
        let padding = Padding::of(object, layout.signed, notes);
        Ok(Self { bytes: stored_bytes(object, &layout)?, layout, padding })
    }

    /// Columns and rows.
    #[must_use]
    pub fn size_px(&self) -> [usize; 2] {
        [self.layout.columns, self.layout.rows]
    }

    /// How many images there are.
    #[must_use]
    pub fn images(&self) -> usize {
        self.layout.frames
    }

    /// The pixels of one image row by row.
    pub fn image(&self, number: usize) -> impl Iterator<Item = StoredValue> + '_ {
        let image_bytes = self.layout.frame_bytes();
        let bytes = self.bytes.get(number * image_bytes..(number + 1) * image_bytes).unwrap_or_default();
        bytes.chunks_exact(self.layout.sample_bytes()).map(|sample| {
            let word = self.layout.word(sample);
            let value = self.layout.value(word);
            // Padding may lie beyond the stored bits, where no measured value can be.
            let is_padding = self.padding.is_some_and(|padding| padding.holds(value) || padding.holds(self.layout.whole(word)));
            StoredValue { value, is_padding, holds_more: !is_padding && self.layout.holds_more(word) }
        })
    }
}
