//! What a file is called where people and logs see it. A file's name may be a patient's, so it is kept only where it is made of harmless words
//! and short numbers, and where those do not stand in the file's own header.

use std::path::Path;
use std::sync::OnceLock;

/// Endings that say what kind of image a file is; whatever else follows a point belongs to the name (`XA.1.2.840.…` has no ending).
const IMAGE_ENDINGS: [&str; 6] = ["dcm", "dicom", "png", "tif", "tiff", "ima"];
/// More than any label made of harmless parts needs.
const MAX_CHARACTERS: usize = 40;
/// Digits in one number: six hold a birth date, so those are looked at more closely.
const MAX_DIGITS: usize = 6;

#[derive(serde::Deserialize)]
struct WordList {
    words: Vec<String>,
}

fn words() -> &'static [String] {
    static WORDS: OnceLock<Vec<String>> = OnceLock::new();
    WORDS.get_or_init(|| {
        let list: Result<WordList, _> = serde_json::from_str(include_str!("label_words.json"));
        list.map(|list| list.words).unwrap_or_default()
    })
}

/// Whether `word` is one of the harmless words.
pub(super) fn is_listed(word: &str) -> bool {
    words().iter().any(|known| known == word)
}

/// The name of `path` without folders and without the ending of an image.
fn stem(path: &Path) -> String {
    let name = path.file_name().map(|name| name.to_string_lossy().into_owned()).unwrap_or_default();
    match name.rsplit_once('.') {
        Some((stem, ending)) if IMAGE_ENDINGS.contains(&ending.to_ascii_lowercase().as_str()) => stem.to_owned(),
        _ => name,
    }
}

/// Endings of the other files that a session reads, the longer ones first.
const INPUT_ENDINGS: [&str; 12] =
    [".safetensors", ".nii.gz", ".mrk.json", ".nii", ".json", ".fcsv", ".csv", ".stl", ".nrrd", ".nhdr", ".mha", ".mhd"];

/// What a file that a session reads (CT, tool, calibration, beads) is called in what it writes: its own name without folders where that is
/// harmless, else the first digits of its hash; the ending stays, because it says how the file is read.
#[must_use]
pub fn input_label(path: &Path, sha256: &str) -> String {
    let name = path.file_name().map(|name| name.to_string_lossy().into_owned()).unwrap_or_default();
    let lower = name.to_ascii_lowercase();
    let ending = INPUT_ENDINGS.into_iter().find(|ending| lower.ends_with(ending)).unwrap_or_default();
    let stem = name.get(..name.len() - ending.len()).unwrap_or_default();
    match harmless(Path::new(stem)) {
        Some(stem) => format!("{stem}{ending}"),
        None => hashed_input_label(&lower, sha256),
    }
}

/// [`input_label`] of a name that says nothing: where two files of one session have the same harmless name.
#[must_use]
pub fn hashed_input_label(name: &str, sha256: &str) -> String {
    let ending = INPUT_ENDINGS.into_iter().find(|ending| name.ends_with(ending)).unwrap_or_default();
    format!("input-{}{ending}", sha256.get(..12).unwrap_or(sha256))
}

/// Whether the file's name ends as an image's does.
pub(super) fn looks_like_an_image(path: &Path) -> bool {
    path.extension().is_some_and(|ending| IMAGE_ENDINGS.contains(&ending.to_string_lossy().to_ascii_lowercase().as_str()))
}

/// The label of the file at `path`, if its name is harmless by itself: words of the list, at most one single letter, and at most two numbers
/// that are neither dates nor longer than six digits.
pub(super) fn harmless(path: &Path) -> Option<String> {
    let stem = stem(path);
    if stem.is_empty() || stem.len() > MAX_CHARACTERS || !stem.is_ascii() {
        return None;
    }
    let (mut letters, mut numbers, mut digits) = (0, 0, 0);
    for part in parts(&stem)? {
        if part.starts_with(|c: char| c.is_ascii_digit()) {
            numbers += 1;
            digits += part.len();
            if part.len() > MAX_DIGITS || part.len() == 6 && is_date(&part) {
                return None;
            }
        } else if part.len() == 1 {
            letters += 1;
        } else if !is_listed(&part) {
            return None;
        }
    }
    (letters <= 1 && numbers <= 2 && digits <= MAX_DIGITS).then_some(stem)
}

/// Words and numbers of a name, in lower case; `None` where something else than `-_ .()#` lies between them.
fn parts(stem: &str) -> Option<Vec<String>> {
    let mut parts: Vec<String> = Vec::new();
    let mut open = false;
    for c in stem.chars() {
        if !c.is_ascii_alphanumeric() {
            if !"-_ .()#".contains(c) {
                return None;
            }
            open = false;
            continue;
        }
        let c = c.to_ascii_lowercase();
        match parts.last_mut() {
            Some(part) if open && part.ends_with(|last: char| last.is_ascii_digit() == c.is_ascii_digit()) => part.push(c),
            _ => parts.push(c.to_string()),
        }
        open = true;
    }
    Some(parts)
}

/// Whether six digits can be read as a day in any order of day, month and year.
fn is_date(six: &str) -> bool {
    let pair = |at: usize| six.get(at..at + 2).and_then(|pair| pair.parse::<u32>().ok()).unwrap_or(0);
    let day = |n: u32| (1..=31).contains(&n);
    let month = |n: u32| (1..=12).contains(&n);
    let (a, b, c) = (pair(0), pair(2), pair(4));
    day(a) && month(b) || month(a) && day(b) || month(b) && day(c) || (1900..=2100).contains(&(a * 100 + b)) && month(c)
}

/// Whether a harmless label repeats one of `identity`: its words and numbers, and all its digits together.
pub(super) fn repeats(label: &str, identity: &[String]) -> bool {
    let Some(parts) = parts(label) else { return true };
    let digits: String = label.chars().filter(char::is_ascii_digit).collect();
    parts.iter().chain([&digits]).filter(|part| part.len() > 1).any(|part| {
        let bare = part.trim_start_matches('0');
        identity.iter().any(|known| {
            // Zeros in front do not matter, except in `0412`, which is half a date.
            known == part || !known.starts_with('0') && bare.len() >= 2 && known == bare
        })
    })
}

/// The label of a file whose content has this hash.
pub(super) fn of_hash(sha256: &str) -> String {
    format!("frame-{}", sha256.get(..12).unwrap_or(sha256))
}

/// The label of a file that has not been read, the `number`-th that was seen.
pub(super) fn of_unread(path: &Path, number: u64) -> String {
    harmless(path).unwrap_or_else(|| format!("file-{number}"))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_of_words_and_short_numbers_are_kept_and_nothing_else() {
        for (name, label) in [
            ("frame-001.dcm", "frame-001"),
            ("XA.dcm", "XA"),
            ("IM_0012", "IM_0012"),
            ("run 3.png", "run 3"),
            ("img000451.tif", "img000451"),
            ("a.dcm", "a"),
            ("latest.dcm", "latest"),
        ] {
            assert_eq!(harmless(Path::new("/folder").join(name).as_path()).as_deref(), Some(label), "{name}");
        }
        for name in [
            "XA.1.2.840.113619.2.55.3",
            "Li.dcm",
            "Mueller.dcm",
            "Müller.dcm",
            "frame_mueller_1.dcm",
            "img_19521204.png",
            "img_041252.png",
            "img_195212.png",
            "img-12-04-52.tif",
            "img_1234567.png",
            "a_b_c.dcm",
            "frame\u{1b}[31m.dcm",
            "frame\n1.dcm",
            "",
            "frame$1.dcm",
            "1952_12_04.dcm",
        ] {
            assert_eq!(harmless(Path::new(name)), None, "{name:?}");
        }
    }

    #[test]
    fn a_label_that_repeats_the_header_is_found() {
        let identity = ["4711".to_owned(), "run".to_owned(), "lovelace".to_owned()];
        for label in ["img_4711", "img_04711", "img_47_11", "RUN 3"] {
            assert!(repeats(label, &identity), "{label}");
        }
        for label in ["img_4712", "frame_3", "xa"] {
            assert!(!repeats(label, &identity), "{label}");
        }
    }

    #[test]
    fn only_endings_of_images_are_cut() {
        assert_eq!(stem(Path::new("x/XA.1.2.840")), "XA.1.2.840");
        assert_eq!(stem(Path::new("x/a.b.DCM")), "a.b");
        assert_eq!(of_unread(Path::new("Li.dcm"), 4), "file-4");
    }
}
