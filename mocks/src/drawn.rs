//! What takes seconds to draw, kept in a folder for other runs of this very program.

use std::hash::{DefaultHasher, Hash, Hasher};
use std::path::Path;

use crate::MockError;

/// What `draw` gives, or gave when it was kept in `folder`: `key` is all on which it depends but this program.
///
/// # Errors
/// Those of `draw`.
pub fn once(folder: Option<&Path>, key: &str, draw: impl FnOnce() -> Result<Vec<u8>, MockError>) -> Result<Vec<u8>, MockError> {
    let Some(folder) = folder else { return draw() };
    let mut hasher = DefaultHasher::new();
    key.hash(&mut hasher);
    let path = folder.join(format!("{:016x}", hasher.finish()));
    if let Ok(bytes) = std::fs::read(&path) {
        return Ok(bytes);
    }
    let bytes = draw()?;
    // Whoever looks for it meanwhile finds all of it or nothing. Where it cannot be kept it is drawn again.
    let part = path.with_extension(std::process::id().to_string());
    let _ = std::fs::write(&part, &bytes).and_then(|()| std::fs::rename(&part, &path));
    Ok(bytes)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_is_drawn_is_drawn_once_for_all_that_share_a_folder() {
        let folder = std::env::temp_dir().join(format!("mock-lab-drawn-{}", std::process::id()));
        std::fs::create_dir_all(&folder).expect("a folder");
        let drawn = |folder: Option<&Path>, key: &str, value: u8| once(folder, key, || Ok(vec![value, 7])).expect("drawn");
        assert_eq!(drawn(Some(&folder), "a", 1), [1, 7]);
        assert_eq!(drawn(Some(&folder), "a", 2), [1, 7], "kept");
        assert_eq!(drawn(Some(&folder), "b", 3), [3, 7], "another picture");
        assert_eq!(drawn(None, "a", 4), [4, 7]);
        std::fs::remove_dir_all(&folder).expect("removed");
        assert_eq!(drawn(Some(&folder), "a", 5), [5, 7], "a folder that is not there costs nothing but time");
    }
}
