//! What is asked of an open file, and of standard input as one.

use std::fs::File;
use std::io;

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
