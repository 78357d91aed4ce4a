//! Opening a file that may be anything: only regular ones, never waiting.

use std::fs::{File, Metadata};
use std::io;
use std::path::Path;

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

/// Whether part of `file` was never written: the mark of a copy that reserved the whole size first. Leaves the file at its start.
#[must_use]
pub fn has_hole(file: &File, bytes: u64) -> bool {
    #[cfg(target_os = "linux")]
    {
        use rustix::fs::{SeekFrom, seek};
        let hole = seek(file, SeekFrom::Hole(0));
        let _ = seek(file, SeekFrom::Start(0));
        hole.is_ok_and(|at| at < bytes)
    }
    #[cfg(not(target_os = "linux"))]
    {
        let _ = (file, bytes);
        false
    }
}

/// Standard input as a file: what a helper was given to read.
///
/// # Errors
/// When the system refuses to hand it over.
pub fn standard_input() -> io::Result<File> {
    #[cfg(unix)]
    {
        use std::os::fd::AsFd;
        Ok(File::from(io::stdin().as_fd().try_clone_to_owned()?))
    }
    #[cfg(windows)]
    {
        use std::os::windows::io::AsHandle;
        Ok(File::from(io::stdin().as_handle().try_clone_to_owned()?))
    }
}
