//! Opening what a person, or another file, names: only regular files, and never waiting. A pipe may give nothing for ever, a device more than
//! there is memory. Nothing else in this program opens a file to read it (`tests/architecture.rs`).

use std::fs::{File, Metadata};
use std::io::{self, Read};
use std::path::Path;

/// Many times what any small file takes: JSON, a table, markups.
const SMALL_BYTES: u64 = 64 << 20;

/// What tells one version of a file from another: size, time of change, and the file itself where the system numbers files.
#[derive(Clone, Copy, Debug)]
pub struct FileStamp {
    /// Size.
    pub bytes: u64,
    /// Time of change, nanoseconds since the Unix epoch.
    pub modified_ns: i128,
    /// Device and inode; zeros where there are none.
    pub inode: (u64, u64),
    /// When content, owner, mode or name changed last, nanoseconds since the Unix epoch; 0 where the system does not say. Not compared: a
    /// rename changes it and makes no new version. No program can set it, so it tells of content whose time was set back.
    pub touched_ns: i128,
}

impl PartialEq for FileStamp {
    fn eq(&self, other: &Self) -> bool {
        (self.bytes, self.modified_ns, self.inode) == (other.bytes, other.modified_ns, other.inode)
    }
}

impl Eq for FileStamp {}

impl FileStamp {
    /// The stamp in `metadata`.
    #[must_use]
    pub fn of(metadata: &Metadata) -> Self {
        let since_epoch = |time: std::time::SystemTime| match time.duration_since(std::time::UNIX_EPOCH) {
            Ok(since) => since.as_nanos() as i128,
            Err(before) => -(before.duration().as_nanos() as i128),
        };
        Self {
            bytes: metadata.len(),
            modified_ns: metadata.modified().map_or(0, since_epoch),
            inode: inode(metadata),
            touched_ns: touched_ns(metadata),
        }
    }
}

#[cfg(unix)]
fn touched_ns(metadata: &Metadata) -> i128 {
    use std::os::unix::fs::MetadataExt;
    i128::from(metadata.ctime()) * 1_000_000_000 + i128::from(metadata.ctime_nsec())
}

#[cfg(not(unix))]
fn touched_ns(_metadata: &Metadata) -> i128 {
    0
}

#[cfg(unix)]
fn inode(metadata: &Metadata) -> (u64, u64) {
    use std::os::unix::fs::MetadataExt;
    (metadata.dev(), metadata.ino())
}

#[cfg(not(unix))]
fn inode(_metadata: &Metadata) -> (u64, u64) {
    (0, 0)
}

/// Something in a folder that is no file with content.
#[derive(Clone, Copy, Debug, PartialEq, Eq, serde::Serialize, serde::Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum NotRegular {
    /// A folder.
    Folder,
    /// A named pipe, which would be waited for without end.
    Fifo,
    /// A socket.
    Socket,
    /// A device, such as one without end.
    Device,
    /// A link that leads nowhere, and whatever else there is.
    Other,
}

impl NotRegular {
    /// What `metadata` is, if no regular file.
    #[must_use]
    pub fn of(metadata: &Metadata) -> Option<Self> {
        let kind = metadata.file_type();
        if kind.is_file() {
            return None;
        }
        if kind.is_dir() {
            return Some(Self::Folder);
        }
        #[cfg(unix)]
        {
            use std::os::unix::fs::FileTypeExt;
            if kind.is_fifo() {
                return Some(Self::Fifo);
            }
            if kind.is_socket() {
                return Some(Self::Socket);
            }
            if kind.is_block_device() || kind.is_char_device() {
                return Some(Self::Device);
            }
        }
        Some(Self::Other)
    }

    /// In words.
    #[must_use]
    pub fn words(self) -> &'static str {
        match self {
            Self::Folder => "a folder",
            Self::Fifo => "a named pipe",
            Self::Socket => "a socket",
            Self::Device => "a device",
            Self::Other => "no file with content",
        }
    }
}

/// Why a file was not opened.
#[derive(Debug, thiserror::Error)]
pub enum OpenFault {
    /// The system refused.
    #[error("{0}")]
    Io(#[from] io::Error),
    /// Not a regular file.
    #[error("it is {}, expected a file; it was not opened", .0.words())]
    NotRegular(NotRegular),
    /// Larger than any file of its kind.
    #[error("the file has {bytes} bytes, at most {limit} are read; it is probably no such file")]
    TooLarge {
        /// Its size.
        bytes: u64,
        /// The limit.
        limit: u64,
    },
}

impl From<OpenFault> for io::Error {
    fn from(fault: OpenFault) -> Self {
        match fault {
            OpenFault::Io(source) => source,
            other => Self::new(io::ErrorKind::InvalidInput, other),
        }
    }
}

/// A regular file, open for reading, with its stamp.
#[derive(Debug)]
pub struct OpenFile {
    /// The file, at its start.
    pub file: File,
    /// What it was when it was opened.
    pub stamp: FileStamp,
}

/// Opens `path` if it is (or links to) a regular file of at most `limit` bytes. Never waits: a pipe that replaces the file between looking
/// and opening is opened without blocking and then refused.
///
/// # Errors
/// When the system refuses, or the file is none.
pub fn open_regular(path: &Path, limit: u64) -> Result<OpenFile, OpenFault> {
    if let Some(other) = NotRegular::of(&std::fs::metadata(path)?) {
        return Err(OpenFault::NotRegular(other));
    }
    let mut options = File::options();
    options.read(true);
    #[cfg(unix)]
    {
        use std::os::unix::fs::OpenOptionsExt;
        options.custom_flags((rustix::fs::OFlags::NONBLOCK | rustix::fs::OFlags::NOCTTY).bits() as i32);
    }
    let file = options.open(path)?;
    let metadata = file.metadata()?;
    if let Some(other) = NotRegular::of(&metadata) {
        return Err(OpenFault::NotRegular(other));
    }
    if metadata.len() > limit {
        return Err(OpenFault::TooLarge { bytes: metadata.len(), limit });
    }
    Ok(OpenFile { file, stamp: FileStamp::of(&metadata) })
}

/// [`open_regular`] for a file of any size.
///
/// # Errors
/// When the system refuses, or it is no regular file; the words say what it is and what was expected.
pub fn open(path: &Path) -> io::Result<File> {
    Ok(open_regular(path, u64::MAX)?.file)
}

/// The content of a file of any size.
///
/// # Errors
/// As [`open`].
pub fn read(path: &Path) -> io::Result<Vec<u8>> {
    read_within(path, u64::MAX)
}

/// [`read`] for a text.
///
/// # Errors
/// As [`open`], and when it is not UTF-8.
pub fn read_text(path: &Path) -> io::Result<String> {
    text(read(path)?)
}

/// The content of a small file that a person or another file names: JSON, a table, markups. What parses them takes any content, so they are
/// read in this process; only what cannot be such a file is kept out.
///
/// # Errors
/// As [`open`], and when it is larger than 64 MiB.
pub fn read_small(path: &Path) -> io::Result<Vec<u8>> {
    read_within(path, SMALL_BYTES)
}

/// [`read_small`] for a text.
///
/// # Errors
/// As [`read_small`], and when it is not UTF-8.
pub fn read_small_text(path: &Path) -> io::Result<String> {
    text(read_small(path)?)
}

fn read_within(path: &Path, limit: u64) -> io::Result<Vec<u8>> {
    let mut bytes = Vec::new();
    // It may grow meanwhile.
    open_regular(path, limit)?.file.take(limit.saturating_add(1)).read_to_end(&mut bytes)?;
    let count = bytes.len() as u64;
    if count > limit {
        return Err(OpenFault::TooLarge { bytes: count, limit }.into());
    }
    Ok(bytes)
}

fn text(bytes: Vec<u8>) -> io::Result<String> {
    let not_text = |_| io::Error::new(io::ErrorKind::InvalidData, "stream did not contain valid UTF-8");
    String::from_utf8(bytes).map_err(not_text)
}
