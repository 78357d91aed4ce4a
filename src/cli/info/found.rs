//! What is found in a file of any kind, or why nothing can be said about it.

use std::path::PathBuf;

use serde_json::{Map, Value};

use crate::acquire::AcquireError;
use crate::record::RecordError;

/// Kind, facts and losses.
pub(super) type Found = (&'static str, Map<String, Value>, Vec<String>);

/// The fields of an object.
pub(super) fn object(value: Value) -> Map<String, Value> {
    match value {
        Value::Object(map) => map,
        other => Map::from_iter([("value".to_owned(), other)]),
    }
}

/// Why nothing can be said about a file.
#[derive(Debug, thiserror::Error)]
pub enum InfoError {
    /// The operating system refused.
    #[error("{path}: {source}", path = path.display())]
    Io {
        /// The file.
        path: PathBuf,
        /// What the system said.
        source: std::io::Error,
    },
    /// A frame that cannot be read.
    #[error(transparent)]
    Frame(#[from] AcquireError),
    /// A log that cannot be read.
    #[error(transparent)]
    Log(#[from] RecordError),
    /// A file of a known kind that is damaged.
    #[error("{path}: {kind} is damaged: {detail}", path = path.display())]
    Damaged {
        /// The file.
        path: PathBuf,
        /// What it should be.
        kind: &'static str,
        /// Where and what.
        detail: String,
    },
    /// DICOM slices that make no volume.
    #[error("{path}: no volume: {detail}", path = path.display())]
    NoVolume {
        /// The folder, or one of the slices.
        path: PathBuf,
        /// Why not, and what to do.
        detail: String,
    },
    /// A file of no kind that is known here.
    #[error(
        "{path}: not a kind of file that is known here ({found}); expected DICOM, PNG, TIFF, MCAP, NIfTI, NRRD, MetaImage, .mrk.json, \
         .fcsv, STL, CSV, safetensors, a report (HTML), SVG, AVI, a camera as `sidecarm pose convert` writes it, a JSON file of this \
         program or the folder of a DICOM series",
        path = path.display()
    )]
    Unknown {
        /// The file.
        path: PathBuf,
        /// What was found.
        found: String,
    },
}
