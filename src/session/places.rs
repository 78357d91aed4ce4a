//! Where on this machine the files lie that sessions read, by their hash. Kept in the user's cache folder and nowhere else, so that a replay
//! finds its CT although the log does not say where it was.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use serde::{Deserialize, Serialize};

use super::SessionError;
use super::file::Setup;
use super::inputs::{InputNames, LoggedInput};
use crate::image::{cache_file, sha256_file, write_atomically};
use crate::regular;
use crate::scene::VolumeSource;

/// Files remembered: the latest.
const MOST: usize = 500;
/// Folders below one that was named are searched as well, so deep.
const DEPTH: usize = 4;
/// A folder with more entries than this is not searched to its end.
const MOST_ENTRIES: usize = 20_000;

#[derive(Clone, Debug, Default, Serialize, Deserialize)]
struct Known {
    /// The latest first.
    files: Vec<KnownFile>,
}

#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
struct KnownFile {
    sha256: String,
    path: PathBuf,
}

fn known() -> Known {
    let text = cache_file("places.json").and_then(|path| regular::read(&path).ok());
    text.and_then(|text| serde_json::from_slice(&text).ok()).unwrap_or_default()
}

/// Remembers where the files of a session lie. A cache that cannot be written is no error: a replay then asks for `--data`.
pub(super) fn remember(names: &InputNames) {
    let mut files: Vec<KnownFile> = names
        .places()
        .filter_map(|(sha256, place)| Some(KnownFile { sha256: sha256.to_owned(), path: std::fs::canonicalize(place).ok()? }))
        .collect();
    for file in known().files {
        if files.len() < MOST && !files.contains(&file) {
            files.push(file);
        }
    }
    if let Some(path) = cache_file("places.json")
        && path.parent().is_some_and(|folder| std::fs::create_dir_all(folder).is_ok())
        && let Ok(text) = serde_json::to_vec(&Known { files })
    {
        let _ = write_atomically(&path, |file| file.write_all(&text));
    }
}

/// Finds the files of a logged session: in `data`, near the log, where this machine last had them, and in the current folder. A file is
/// found by its content, whatever it is called by now. What lies near the log comes before a file of the same content elsewhere, which
/// belongs to another session and goes when that does.
///
/// # Errors
/// When one is nowhere; the sentence names it.
pub(super) fn find(setup: &mut Setup, log: &Path, data: Option<&Path>) -> Result<(), SessionError> {
    let known = known();
    let beside = log.parent().filter(|folder| !folder.as_os_str().is_empty()).unwrap_or(Path::new("."));
    let mut near: Vec<(PathBuf, usize)> = data.map(|data| (data.to_owned(), DEPTH)).into_iter().collect();
    near.extend([(beside.to_owned(), 1), (beside.join(".."), 2)]);
    let mut places = BTreeMap::new();
    // The scene itself is in the log, and so are files without a size: those that come with the program.
    for input in setup.inputs.iter().skip(1).filter(|input| input.bytes > 0) {
        let place = place_of(input, &near, &known);
        let missing = || SessionError::InputMissing {
            label: input.label.clone(),
            sha256: input.sha256.clone(),
            there: instead(input, &known),
        };
        places.insert(input.label.clone(), place.ok_or_else(missing)?);
    }
    setup.places = places;
    Ok(())
}

fn place_of(input: &LoggedInput, near: &[(PathBuf, usize)], known: &Known) -> Option<PathBuf> {
    // Of what has several files, one that is found leads to the others: a header, or any slice of a series.
    let bytes = input.part.as_ref().map_or(input.bytes, |part| part.bytes);
    let has_part = |path: &Path| input.part.as_ref().is_none_or(|part| has(path, part.bytes, &part.sha256));
    let below =
        |folder: &Path, depth: usize| same_size(folder, depth, bytes).into_iter().find(|path| has_part(path) && is(path, input));
    let remembered = || {
        let same = known.files.iter().filter(|file| file.sha256 == input.sha256);
        same.map(|file| file.path.clone()).find(|path| is(path, input))
    };
    near.iter().find_map(|(folder, depth)| below(folder, *depth)).or_else(remembered).or_else(|| below(Path::new("."), 1))
}

/// What is where this machine had a file that is found no more.
fn instead(input: &LoggedInput, known: &Known) -> &'static str {
    let had = known.files.iter().filter(|file| file.sha256 == input.sha256);
    match had.map(|file| &file.path).any(|path| path.exists()) {
        true => " (what is there has other content: it was changed, or replaced, since the session read it)",
        false => "",
    }
}

fn is(path: &Path, input: &LoggedInput) -> bool {
    if input.part.is_none() {
        return has(path, input.bytes, &input.sha256);
    }
    let content = VolumeSource::open(path).and_then(|source| source.content());
    content.is_ok_and(|content| content.sha256 == input.sha256)
}

fn has(path: &Path, bytes: u64, sha256: &str) -> bool {
    path.metadata().is_ok_and(|metadata| metadata.is_file() && metadata.len() == bytes)
        && sha256_file(path).is_ok_and(|found| found == sha256)
}

/// Files of `bytes` bytes in `folder` and those below it.
fn same_size(folder: &Path, depth: usize, bytes: u64) -> Vec<PathBuf> {
    let (mut found, mut open, mut seen) = (Vec::new(), vec![(folder.to_owned(), depth)], 0);
    while let Some((folder, depth)) = open.pop() {
        let Ok(entries) = std::fs::read_dir(&folder) else { continue };
        for entry in entries.flatten() {
            seen += 1;
            if seen > MOST_ENTRIES {
                return found;
            }
            let Ok(metadata) = entry.metadata() else { continue };
            if metadata.is_dir() && depth > 1 {
                open.push((entry.path(), depth - 1));
            } else if metadata.is_file() && metadata.len() == bytes {
                found.push(entry.path());
            }
        }
    }
    found.sort();
    found
}

#[cfg(test)]
mod tests {
    use super::super::file::LoggedPart;
    use super::*;
    use crate::image::sha256_bytes;

    /// A file of the same content in another session's folder may be gone a moment later.
    #[test]
    fn what_lies_near_the_log_comes_before_what_is_remembered() {
        let (near, other) = (tempfile::tempdir().expect("a folder"), tempfile::tempdir().expect("a folder"));
        let content = b"the same robot";
        let sha256 = sha256_bytes(content);
        let paths = [near.path().join("robot.json"), other.path().join("robot.json")];
        paths.iter().for_each(|path| std::fs::write(path, content).expect("written"));
        let input = LoggedInput { label: "robot".to_owned(), sha256: sha256.clone(), bytes: content.len() as u64, part: None };
        let known = Known { files: vec![KnownFile { sha256, path: paths[1].clone() }] };
        let folders = [(near.path().to_owned(), 1)];
        assert_eq!(place_of(&input, &folders, &known).as_ref(), Some(&paths[0]));
        std::fs::remove_file(&paths[0]).expect("removed");
        assert_eq!(place_of(&input, &folders, &known).as_ref(), Some(&paths[1]));
        std::fs::remove_file(&paths[1]).expect("removed");
        assert_eq!(place_of(&input, &folders, &known), None);
    }

    /// A CT that was replaced while the session ran was said not to be there.
    #[test]
    fn a_file_with_other_content_is_said_to_be_there() {
        let folder = tempfile::tempdir().expect("a folder");
        let path = folder.path().join("ct.nrrd");
        std::fs::write(&path, b"another scan").expect("written");
        let sha256 = sha256_bytes(b"the scan");
        let input = LoggedInput { label: "ct.nrrd".to_owned(), sha256: sha256.clone(), bytes: 8, part: None };
        let known = Known { files: vec![KnownFile { sha256: sha256.clone(), path: path.clone() }] };
        assert_eq!(place_of(&input, &[], &known), None);
        let there = instead(&input, &known);
        let words = SessionError::InputMissing { label: "ct.nrrd".to_owned(), sha256, there }.to_string();
        assert!(words.contains("last had it (what is there has other content") && words.contains("nor near the log"), "{words}");
        std::fs::remove_file(&path).expect("removed");
        assert_eq!(instead(&input, &known), "", "gone");
        assert_eq!(instead(&input, &Known::default()), "", "never had");
    }

    /// A header leads to its voxels, whatever the two are called by now and whichever of them has the smaller hash.
    #[test]
    fn a_volume_of_several_files_is_found_by_one_of_them_and_checked_whole() {
        let (before, now) = (tempfile::tempdir().expect("a folder"), tempfile::tempdir().expect("a folder"));
        let header = "NRRD0004\ntype: uchar\ndimension: 3\nspace: LPS\nsizes: 2 2 2\nspace directions: (1,0,0) (0,1,0) (0,0,1)\n\
                      encoding: raw\nspace origin: (0,0,0)\ndata file: ct.raw\n";
        std::fs::write(before.path().join("ct.nhdr"), header).expect("written");
        std::fs::write(before.path().join("ct.raw"), [7; 8]).expect("written");
        let place = before.path().join("ct.nhdr");
        let content = VolumeSource::open(&place).and_then(|source| source.content()).expect("a volume");
        let part = content.parts.iter().find(|part| part.path == place).expect("the header is a part");
        let part = Some(LoggedPart { sha256: part.sha256.clone(), bytes: part.bytes });
        let input = LoggedInput { label: "ct.nhdr".to_owned(), sha256: content.sha256, bytes: 0, part };
        let (known, folders) = (Known::default(), [(now.path().to_owned(), 1)]);
        assert_eq!(place_of(&input, &folders, &known), None, "not there yet");
        std::fs::write(now.path().join("moved.nhdr"), header).expect("written");
        std::fs::write(now.path().join("ct.raw"), [8; 8]).expect("written");
        assert_eq!(place_of(&input, &folders, &known), None, "other voxels");
        std::fs::write(now.path().join("ct.raw"), [7; 8]).expect("written");
        assert_eq!(place_of(&input, &folders, &known), Some(now.path().join("moved.nhdr")));
        let known = Known { files: vec![KnownFile { sha256: input.sha256.clone(), path: place.clone() }] };
        assert_eq!(place_of(&input, &[], &known), Some(place), "where it was");
    }
}
