//! Why a frame could not be read.

use crate::foreign::{ForeignFault, NotRegular, OpenFault};

/// Why a frame could not be read: which file, where in it, what to do. `file` is what was typed on a command line, or the label of a file that
/// arrived by itself; the rest holds nothing of the file's texts.
#[derive(Debug, thiserror::Error)]
pub enum AcquireError {
    /// The operating system refused.
    #[error("{file}: {source}")]
    Io {
        /// The file or folder, as it may be shown.
        file: String,
        /// What the system said.
        source: std::io::Error,
    },
    /// The file is no frame that can be used.
    #[error("{file}: {fault}")]
    Refused {
        /// The file, as it may be shown.
        file: String,
        /// What is wrong with it.
        fault: Fault,
    },
}

impl AcquireError {
    /// What is wrong with the file; `None` where the system refused.
    #[must_use]
    pub fn fault(&self) -> Option<&Fault> {
        match self {
            Self::Io { .. } => None,
            Self::Refused { fault, .. } => Some(fault),
        }
    }

    pub(super) fn from_open(file: String, fault: OpenFault) -> Self {
        match fault {
            OpenFault::Io(source) => Self::Io { file, source },
            OpenFault::NotRegular(kind) => Self::Refused { file, fault: Fault::NotRegular(kind) },
            OpenFault::TooLarge { bytes, limit } => Self::Refused { file, fault: Fault::FileSize { bytes, limit } },
        }
    }
}

/// What is wrong with a file. Holds numbers and words of this program only, because it goes into logs and reports.
#[derive(Clone, Debug, PartialEq, thiserror::Error, serde::Serialize, serde::Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Fault {
    /// Neither DICOM nor PNG nor TIFF.
    #[error("found {found}, expected a DICOM (with preamble), PNG or TIFF file")]
    NotAnImage {
        /// What it looks like.
        found: String,
    },
    /// The DICOM data set ends early or does not parse.
    #[error("DICOM data set is damaged or cut short ({detail}); copy the file again from the console")]
    Dicom {
        /// Where.
        detail: String,
    },
    /// An attribute that every image needs is missing or not usable.
    #[error("DICOM attribute {tag} is {found}, expected {expected}")]
    Attribute {
        /// Name and number.
        tag: String,
        /// What is there.
        found: String,
        /// What was expected.
        expected: String,
    },
    /// Pixels are compressed in a way that is not supported.
    #[error(
        "pixels are compressed with transfer syntax {name}, which is not supported; export uncompressed (Explicit VR Little Endian)"
    )]
    TransferSyntax {
        /// Its name and identifier in the standard, or that it is none.
        name: String,
    },
    /// Fewer or more pixel bytes than the header promises.
    #[error("pixel data holds {found} bytes, expected {expected}; the file is cut short or its header is wrong")]
    PixelBytes {
        /// From rows, columns, bits and frames.
        expected: u64,
        /// In the file.
        found: u64,
    },
    /// Header and compressed stream disagree.
    #[error("the header says {header}, the compressed pixels say {stream}; the file is damaged")]
    Disagreement {
        /// Size or components by the header.
        header: String,
        /// The same by the compressed stream.
        stream: String,
    },
    /// The image has no pixels.
    #[error("image of {width}x{height} pixels is empty")]
    Empty {
        /// Columns.
        width: u64,
        /// Rows.
        height: u64,
    },
    /// More pixels than a radiograph has.
    #[error("image of {width}x{height} pixels is larger than the limit of {limit} pixels; its header is probably damaged")]
    TooLarge {
        /// Columns.
        width: u64,
        /// Rows.
        height: u64,
        /// The limit.
        limit: u64,
    },
    /// More images, or more pixels together, than a run has.
    #[error("holds {found} {what}, at most {limit} are read; export the run in parts")]
    TooMany {
        /// `images` or `pixels`.
        what: String,
        /// How many.
        found: u64,
        /// The limit.
        limit: u64,
    },
    /// Nothing but NaN, infinite and padding pixels.
    #[error("all {count} pixels are NaN, infinite or padding; export the radiograph again")]
    NotFinite {
        /// How many.
        count: u64,
    },
    /// A colour image.
    #[error("pixels are in colour ({found}), expected one grey sample per pixel; export the radiograph without colour")]
    Colour {
        /// The colour type.
        found: String,
    },
    /// A sample type that is not read.
    #[error("samples are {found}, expected 8- or 16-bit integers or 32-bit floats")]
    Samples {
        /// The sample type.
        found: String,
    },
    /// A damaged PNG or TIFF.
    #[error("{kind} is damaged or cut short ({detail}); copy the file again")]
    Raster {
        /// `PNG` or `TIFF`.
        kind: String,
        /// Where and what.
        detail: String,
    },
    /// Several images where one was expected.
    #[error("holds {found} images, expected one; export single frames, or drop the file into a session's frame folder")]
    SeveralImages {
        /// How many.
        found: u64,
    },
    /// A pipe, a socket, a device or a folder.
    #[error("it is {}, expected a file; it was not opened", .0.words())]
    NotRegular(NotRegular),
    /// Larger than any radiograph.
    #[error("the file has {bytes} bytes, at most {limit} are read; it is probably no radiograph")]
    FileSize {
        /// Its size.
        bytes: u64,
        /// The limit.
        limit: u64,
    },
    /// The size was reserved, the content is not all there.
    #[error("parts of the file were never written; the copy is not finished")]
    Unwritten,
    /// It changed while it was read.
    #[error("the file changed while it was read; try again when it lies still")]
    Changed,
    /// The helper process that reads foreign files did not get through.
    #[error("{0}")]
    Helper(ForeignFault),
    /// The helper could not read what was opened for it.
    #[error("its content cannot be read ({detail})")]
    Content {
        /// What the system said.
        detail: String,
    },
}

impl Fault {
    /// Whether the file could be one that is still being written: what it lacks may yet arrive.
    #[must_use]
    pub fn may_be_unfinished(&self) -> bool {
        match self {
            Self::Dicom { .. } | Self::PixelBytes { .. } | Self::Raster { .. } | Self::Attribute { .. } | Self::Unwritten => true,
            Self::NotAnImage { found } => found.starts_with("an empty") || found.starts_with("a file with"),
            _ => false,
        }
    }
}
