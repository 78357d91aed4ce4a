//! A camera as formats exchange it, and what is known of one besides the text.

use super::error::FormatError;
use super::format::Format;
use crate::geometry::{Intrinsics, Projection, Rigid};

/// A camera as formats exchange it.
#[derive(Clone, Debug, PartialEq)]
pub struct ExchangedCamera {
    /// Pose of the specimen in the camera.
    pub camera_from_lps: Rigid,
    /// K, where the format has it.
    pub intrinsics: Option<Intrinsics>,
    /// Columns and rows, where the format has them.
    pub size_px: Option<[u32; 2]>,
    /// Distance of neighbouring columns and of neighbouring rows on the detector, where the format has it.
    pub pitch_mm: Option<[f64; 2]>,
    /// What a reader of the camera should know, one sentence each.
    pub notes: Vec<String>,
}

impl ExchangedCamera {
    /// A camera of which only the pose is known.
    #[must_use]
    pub fn placed(camera_from_lps: Rigid) -> Self {
        Self { camera_from_lps, intrinsics: None, size_px: None, pitch_mm: None, notes: Vec::new() }
    }

    /// P, where K is known.
    #[must_use]
    pub fn projection(&self) -> Option<Projection> {
        Some(Projection::compose(&self.intrinsics?, &self.camera_from_lps))
    }

    pub(super) fn intrinsics_for(&self, format: Format) -> Result<Intrinsics, FormatError> {
        self.intrinsics.ok_or(FormatError::Needs { format, what: "K", remedy: "--intrinsics K.json" })
    }

    pub(super) fn size_for(&self, format: Format) -> Result<[u32; 2], FormatError> {
        self.size_px.ok_or(FormatError::Needs {
            format,
            what: "the image size",
            remedy: "--intrinsics K.json with size_px, or --size COLUMNS,ROWS",
        })
    }

    pub(super) fn pitch_for(&self, format: Format) -> Result<[f64; 2], FormatError> {
        self.pitch_mm.ok_or(FormatError::Needs {
            format,
            what: "the pixel pitch in mm",
            remedy: "--intrinsics K.json with pitch_mm, or --pitch MM",
        })
    }
}

/// What is known besides the text.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Known {
    /// K, for formats without it.
    pub intrinsics: Option<Intrinsics>,
    /// Columns and rows.
    pub size_px: Option<[u32; 2]>,
    /// Distance of neighbouring columns and rows.
    pub pitch_mm: Option<[f64; 2]>,
}
