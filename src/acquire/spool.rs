//! An object that arrives or is made, as a file of the watched folder: Part 10 (PS3.10 §7.1) around the very bytes that came. Nothing of it is parsed
//! here, and nothing of it is to be seen before it is whole.

use std::collections::HashMap;
use std::io::{BufWriter, Write};
use std::path::{Path, PathBuf};
use std::sync::{Mutex, PoisonError};

use dicom_object::FileMetaTableBuilder;
use sha2::{Digest, Sha256};
use tempfile::NamedTempFile;

use crate::image::{Temporary, sync_folder, temporary_file};

/// The largest object that is taken.
pub(super) const MOST_OBJECT_BYTES: u64 = 256 << 20;
/// What an object on its way is called before its random part.
pub(super) const INCOMING: &str = ".incoming-";
/// Files in one folder whose names are tried.
const MOST_FILES: u32 = 1_000_000;

/// Why an object is not taken.
#[derive(Debug, thiserror::Error)]
pub(super) enum SpoolError {
    /// The folder cannot be written.
    #[error("it cannot be written into the frames' folder ({0})")]
    Write(std::io::ErrorKind),
    /// More bytes than any frame has.
    #[error("it is longer than {limit} bytes")]
    TooLarge {
        /// The most.
        limit: u64,
    },
    /// Its identifiers do not make a head.
    #[error("its identifiers are none")]
    Head,
}

impl From<std::io::Error> for SpoolError {
    fn from(error: std::io::Error) -> Self {
        Self::Write(error.kind())
    }
}

/// How an object was taken.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Taken {
    /// As a file of its own.
    New,
    /// It was there already: its sender did not hear that.
    Again,
}

/// The folder that objects are written into, by any number of associations.
pub(super) struct Spool {
    folder: PathBuf,
    /// What its files are called before their number.
    prefix: &'static str,
    /// An object is taken when it is on the disk, and not before.
    lasting: bool,
    named: Mutex<Named>,
}

#[derive(Default)]
struct Named {
    /// Files so far, or those of earlier sessions in the same folder.
    number: u32,
    /// Of each instance, the hash of what was taken last.
    hashes: HashMap<String, [u8; 32]>,
}

impl Spool {
    /// Its files are `PREFIX-0001.dcm` and so on.
    pub(super) fn named(folder: &Path, prefix: &'static str) -> Self {
        Self { folder: folder.to_owned(), prefix, lasting: false, named: Mutex::default() }
    }

    /// The same for senders, which may throw away what was taken.
    pub(super) fn lasting(folder: &Path, prefix: &'static str) -> Self {
        Self { lasting: true, ..Self::named(folder, prefix) }
    }

    /// Begins an object.
    pub(super) fn begin(&self, class: &str, instance: &str, transfer_syntax: &str) -> Result<Incoming, SpoolError> {
        let head = FileMetaTableBuilder::new()
            .media_storage_sop_class_uid(class)
            .media_storage_sop_instance_uid(instance)
            .transfer_syntax(transfer_syntax)
            .build()
            .map_err(|_| SpoolError::Head)?;
        // Passed over by the watch for its first letter and for its ending; gone when it is dropped.
        let file = temporary_file(&self.folder, INCOMING, ".part")?;
        let mut file = BufWriter::with_capacity(1 << 16, file);
        file.write_all(&[0; 128])?;
        file.write_all(b"DICM")?;
        head.write(&mut file).map_err(|_| SpoolError::Head)?;
        Ok(Incoming { file, instance: instance.to_owned(), bytes: 0, hash: Sha256::new() })
    }

    /// Gives a whole object the next name, unless it was taken before.
    fn take(&self, mut file: NamedTempFile, instance: String, hash: [u8; 32]) -> Result<Taken, SpoolError> {
        if self.lasting {
            file.as_file().sync_all()?;
        }
        let mut named = self.named.lock().unwrap_or_else(PoisonError::into_inner);
        if named.hashes.get(&instance) == Some(&hash) {
            return Ok(Taken::Again);
        }
        while named.number < MOST_FILES {
            named.number += 1;
            let path = self.folder.join(format!("{}-{:04}.dcm", self.prefix, named.number));
            match file.persist_noclobber(&path) {
                Ok(_) => {
                    named.hashes.insert(instance, hash);
                    drop(named);
                    if self.lasting {
                        sync_folder(&path);
                    }
                    return Ok(Taken::New);
                }
                Err(taken) if taken.error.kind() == std::io::ErrorKind::AlreadyExists => file = taken.file,
                Err(refused) => return Err(SpoolError::Write(refused.error.kind())),
            }
        }
        Err(SpoolError::Write(std::io::ErrorKind::AlreadyExists))
    }
}

/// An object on its way.
pub(super) struct Incoming {
    file: BufWriter<Temporary<NamedTempFile>>,
    instance: String,
    bytes: u64,
    hash: Sha256,
}

impl Incoming {
    /// Bytes of its data set so far.
    pub(super) fn bytes(&self) -> u64 {
        self.bytes
    }

    /// Adds what came.
    pub(super) fn write(&mut self, bytes: &[u8]) -> Result<(), SpoolError> {
        self.bytes += bytes.len() as u64;
        if self.bytes > MOST_OBJECT_BYTES {
            return Err(SpoolError::TooLarge { limit: MOST_OBJECT_BYTES });
        }
        self.hash.update(bytes);
        Ok(self.file.write_all(bytes)?)
    }

    /// It is whole: gives it a name, in the order in which objects become whole.
    pub(super) fn finish(self, spool: &Spool) -> Result<Taken, SpoolError> {
        let Self { file, instance, hash, .. } = self;
        let file = file.into_inner().map_err(|error| SpoolError::Write(error.error().kind()))?;
        file.end_with(|file| spool.take(file, instance, hash.finalize().into()))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn whole_objects_get_names_of_their_own_and_half_ones_leave_nothing() {
        let folder = tempfile::tempdir().expect("a folder");
        std::fs::write(folder.path().join("dicom-0001.dcm"), b"of an earlier session").expect("written");
        let spool = Spool::named(folder.path(), "dicom");
        let incoming = |instance: &str, bytes: &[u8]| {
            let mut incoming = spool.begin("1.2.840.10008.5.1.4.1.1.12.1", instance, "1.2.840.10008.1.2.1").expect("a file");
            incoming.write(bytes).expect("written");
            incoming
        };
        drop(incoming("1.2.3.1", b"half"));
        assert_eq!(incoming("1.2.3.2", b"whole").finish(&spool).expect("written"), Taken::New);
        assert_eq!(incoming("1.2.3.2", b"whole").finish(&spool).expect("written"), Taken::Again);
        assert_eq!(incoming("1.2.3.2", b"other").finish(&spool).expect("written"), Taken::New);
        let mut names: Vec<_> =
            std::fs::read_dir(folder.path()).expect("listed").flatten().map(|entry| entry.file_name()).collect();
        names.sort();
        assert_eq!(names, ["dicom-0001.dcm", "dicom-0002.dcm", "dicom-0003.dcm"]);
        let bytes = std::fs::read(folder.path().join("dicom-0002.dcm")).expect("there");
        assert!(bytes.ends_with(b"whole") && &bytes[128..132] == b"DICM");
        assert_eq!(std::fs::read(folder.path().join("dicom-0001.dcm")).expect("there"), b"of an earlier session");
    }

    #[test]
    fn an_object_without_end_is_not_taken() {
        let folder = tempfile::tempdir().expect("a folder");
        let spool = Spool::named(folder.path(), "dicom");
        let mut incoming = spool.begin("1.2", "1.2.3", "1.2.840.10008.1.2").expect("a file");
        incoming.bytes = MOST_OBJECT_BYTES;
        assert!(matches!(incoming.write(b"!"), Err(SpoolError::TooLarge { .. })));
    }
}
