//! Small files that a person or another file names: JSON, tables, markups. What parses them takes any content, so they are read in this
//! process; only what cannot be such a file is kept out.

use std::io::{Error, ErrorKind, Read, Result};
use std::path::Path;

use super::open::{OpenFault, open_regular};

/// Many times what any of them takes.
const MOST_BYTES: u64 = 64 << 20;

/// The content of a small file. Never waits: what is no regular file is not opened ([`open_regular`]).
///
/// # Errors
/// When the system refuses, or it is no regular file or larger than 64 MiB; the words say what it is and what was expected.
pub fn read_small(path: &Path) -> Result<Vec<u8>> {
    let refused = |fault: OpenFault| match fault {
        OpenFault::Io(source) => source,
        other => Error::new(ErrorKind::InvalidInput, other),
    };
    let open = open_regular(path, MOST_BYTES).map_err(refused)?;
    let mut bytes = Vec::new();
    // It may grow meanwhile.
    open.file.take(MOST_BYTES + 1).read_to_end(&mut bytes)?;
    let count = bytes.len() as u64;
    if count > MOST_BYTES {
        return Err(refused(OpenFault::TooLarge { bytes: count, limit: MOST_BYTES }));
    }
    Ok(bytes)
}

/// [`read_small`] for a text.
///
/// # Errors
/// As [`read_small`], and when it is not UTF-8.
pub fn read_small_text(path: &Path) -> Result<String> {
    let not_text = |_| Error::new(ErrorKind::InvalidData, "stream did not contain valid UTF-8");
    String::from_utf8(read_small(path)?).map_err(not_text)
}
