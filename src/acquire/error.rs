//! Why a frame could not be read.

use std::path::PathBuf;

/// Why a frame could not be read: which file, where in it, what to do.
#[derive(Debug, thiserror::Error)]
pub enum AcquireError {
    /// The operating system refused.
    #[error("{path}: {source}", path = path.display())]
    Io {
        /// The file or folder.
        path: PathBuf,
        /// What the system said.
        source: std::io::Error,
    },
    /// Neither DICOM nor PNG nor TIFF.
    #[error("{path}: found {found}, expected a DICOM (with preamble), PNG or TIFF file", path = path.display())]
    NotAnImage {
        /// The file.
        path: PathBuf,
        /// What it looks like.
        found: String,
    },
    /// The DICOM data set ends early or does not parse.
    #[error("{path}: DICOM data set is damaged or cut short ({detail}); copy the file again from the console", path = path.display())]
    Dicom {
        /// The file.
        path: PathBuf,
        /// What the parser said.
        detail: String,
    },
    /// An attribute that every image needs is missing or not usable.
    #[error("{path}: DICOM attribute {tag} is {found}, expected {expected}", path = path.display())]
    Attribute {
        /// The file.
        path: PathBuf,
        /// Name and number.
        tag: &'static str,
        /// What is there.
        found: String,
        /// What was expected.
        expected: &'static str,
    },
    /// Pixels are compressed in a way that is not supported.
    #[error(
        "{path}: pixels are compressed with transfer syntax {name} ({uid}), which is not supported; export uncompressed (Explicit VR \
         Little Endian)",
        path = path.display()
    )]
    TransferSyntax {
        /// The file.
        path: PathBuf,
        /// Its identifier.
        uid: String,
        /// Its name in the standard.
        name: String,
    },
    /// Fewer or more pixel bytes than the header promises.
    #[error("{path}: pixel data holds {found} bytes, expected {expected}; the file is cut short or its header is wrong", path = path.display())]
    PixelBytes {
        /// The file.
        path: PathBuf,
        /// From rows, columns, bits and frames.
        expected: u64,
        /// In the file.
        found: u64,
    },
    /// The image has no pixels.
    #[error("{path}: image of {width}x{height} pixels is empty", path = path.display())]
    Empty {
        /// The file.
        path: PathBuf,
        /// Columns.
        width: usize,
        /// Rows.
        height: usize,
    },
    /// More pixels than a radiograph has.
    #[error("{path}: image of {width}x{height} pixels is larger than the limit of {limit} pixels; its header is probably damaged", path = path.display())]
    TooLarge {
        /// The file.
        path: PathBuf,
        /// Columns.
        width: u64,
        /// Rows.
        height: u64,
        /// The limit.
        limit: u64,
    },
    /// NaN or infinite pixels.
    #[error("{path}: {count} pixels are NaN or infinite, the first at column {column}, row {row}; mask or repair them before import", path = path.display())]
    NotFinite {
        /// The file.
        path: PathBuf,
        /// How many.
        count: usize,
        /// The first one's column.
        column: usize,
        /// The first one's row.
        row: usize,
    },
    /// A colour image.
    #[error("{path}: pixels are in colour ({found}), expected one grey sample per pixel; export the radiograph without colour", path = path.display())]
    Colour {
        /// The file.
        path: PathBuf,
        /// The colour type.
        found: String,
    },
    /// A sample type that is not read.
    #[error("{path}: samples are {found}, expected 8- or 16-bit integers or 32-bit floats", path = path.display())]
    Samples {
        /// The file.
        path: PathBuf,
        /// The sample type.
        found: String,
    },
    /// A damaged PNG or TIFF.
    #[error("{path}: {kind} is damaged or cut short ({detail}); copy the file again", path = path.display())]
    Raster {
        /// The file.
        path: PathBuf,
        /// `PNG` or `TIFF`.
        kind: &'static str,
        /// What the decoder said.
        detail: String,
    },
    /// Several images where one was expected.
    #[error("{path}: holds {found} images, expected one; export single frames, or drop the file into a session's frame folder", path = path.display())]
    SeveralImages {
        /// The file.
        path: PathBuf,
        /// How many.
        found: usize,
    },
}

impl AcquireError {
    /// Whether the file could be one that is still being written: what it lacks may yet arrive.
    #[must_use]
    pub fn may_be_unfinished(&self) -> bool {
        match self {
            Self::Dicom { .. } | Self::PixelBytes { .. } | Self::Raster { .. } | Self::Attribute { .. } => true,
            Self::NotAnImage { found, .. } => found.starts_with("an empty") || found.starts_with("a file with"),
            _ => false,
        }
    }
}
