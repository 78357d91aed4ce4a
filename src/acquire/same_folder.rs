//! Whether the watched folder is still the one that it was: whoever has the one before open writes on into it, wherever it lies now.

use std::path::Path;

use super::source::Sighting;
use crate::foreign::FileStamp;

/// What there is to say of another folder in its place.
const ANOTHER: &str = "the frame folder is another one than before (it was moved away, made anew or mounted again): what is still written \
                       into the one before is not seen; check that the console writes into this one, and tie what lies in the other to \
                       its exposures with `sidecarm attach`";

/// Device and inode of the watched folder, where it is there.
#[derive(Debug)]
pub(super) struct SameFolder(Option<(u64, u64)>);

impl SameFolder {
    /// The one that is there now.
    pub(super) fn of(folder: &Path) -> Self {
        Self(inode_of(folder))
    }

    /// Said once for each folder that takes the place of another.
    pub(super) fn look(&mut self, folder: &Path) -> Option<Sighting> {
        let now = inode_of(folder)?;
        let is_another = self.0.replace(now).is_some_and(|before| before != now);
        is_another.then(|| Sighting::Said { kind: "frame folder replaced", words: ANOTHER.to_owned() })
    }
}

fn inode_of(folder: &Path) -> Option<(u64, u64)> {
    std::fs::metadata(folder).ok().map(|metadata| FileStamp::of(&metadata).inode)
}
