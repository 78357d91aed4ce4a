//! Why a log could not be written or read.

use std::path::PathBuf;

/// Why a log could not be written or read. Losses inside a readable log are no errors, see [`super::LogLoss`].
#[derive(Debug, thiserror::Error)]
pub enum RecordError {
    /// The operating system refused to open or create the file.
    #[error("{path}: {source}", path = path.display())]
    Io {
        /// The log.
        path: PathBuf,
        /// What the system said.
        source: std::io::Error,
    },
    /// The file exists; logs are never overwritten.
    #[error("{path}: exists already, and logs are not overwritten; choose another --out", path = path.display())]
    Exists {
        /// The log.
        path: PathBuf,
    },
    /// Writing failed (disk full, folder gone). What was recorded before stays readable.
    #[error("{path}: recording stopped after {recorded} messages: {reason}; start a new session, on a full disk after making room", path = path.display())]
    Stopped {
        /// The log.
        path: PathBuf,
        /// Messages that reached the file.
        recorded: u64,
        /// What the writer said.
        reason: String,
    },
    /// The disk does not follow.
    #[error("{path}: recording is {behind_ms} ms behind with {waiting_bytes} bytes in memory; the disk is too slow or stands still", path = path.display())]
    Behind {
        /// The log.
        path: PathBuf,
        /// Bytes that wait.
        waiting_bytes: usize,
        /// Age of the oldest of them.
        behind_ms: u64,
    },
    /// Recording was asked for after the end.
    #[error("{path}: recording has already been finished", path = path.display())]
    Finished {
        /// The log.
        path: PathBuf,
    },
    /// A value has no JSON form.
    #[error("topic {topic}: value cannot be written as JSON: {source}")]
    Json {
        /// The topic.
        topic: String,
        /// What the serializer said.
        source: serde_json::Error,
    },
    /// Not a file.
    #[error("{path}: is a folder; name the log in it, which a session calls session.mcap", path = path.display())]
    Folder {
        /// The folder.
        path: PathBuf,
    },
    /// The file does not start as MCAP files do.
    #[error("{path}: not an MCAP log (found {found}); it starts with other bytes", path = path.display())]
    NotALog {
        /// The file.
        path: PathBuf,
        /// Its first bytes, in hexadecimal.
        found: String,
    },
    /// The log is compressed in a way that is not read here.
    #[error(
        "{path}: is compressed with lz4, which is not read here; write it anew with zstd or uncompressed, for instance \
         `mcap compress --compression zstd {path} -o zstd.mcap`",
        path = path.display()
    )]
    Compression {
        /// The log.
        path: PathBuf,
    },
    /// A message in a log does not hold what its topic promises.
    #[error("{topic}, message {sequence}: {detail}")]
    Message {
        /// The topic.
        topic: String,
        /// Sequence number in the log.
        sequence: u32,
        /// What is wrong.
        detail: String,
    },
}
