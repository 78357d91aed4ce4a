//! What the labels of a segmentation are called, and what the structures of a well-known one are made of.

use std::collections::BTreeMap;

use super::object_file::PresetFile;
use crate::image::sha256_bytes;
use crate::spelling::nearest;
use crate::table::{cells_of, unmarked};

/// How what stands for the name of a label begins.
const HIDDEN: &str = "label-";
/// How a number goes on.
const NUMBER: &str = "=";
/// Of the hash of a name.
const HASH_DIGITS: usize = 16;

/// What stands for a label, a name that is not to be told or a number beside such, the `rank`th of its scene in their order: whoever has the
/// label volume finds the label by it, and a map's materials keep their order.
#[must_use]
pub fn hidden_label(rank: usize, label: &str) -> String {
    match label.trim().parse::<u32>() {
        Ok(number) => format!("{HIDDEN}{rank:04}-{NUMBER}{number}"),
        Err(_) => format!("{HIDDEN}{rank:04}-{}", hash_of(label)),
    }
}

/// Whether `text` is what [`hidden_label`] makes of some label.
#[must_use]
pub fn is_hidden_label(text: &str) -> bool {
    hidden(text).is_some()
}

/// Which label is hidden by a text.
#[derive(Clone, Copy)]
enum Hidden<'t> {
    Number(u32),
    Hash(&'t str),
}

fn hidden(text: &str) -> Option<Hidden<'_>> {
    let (rank, label) = text.strip_prefix(HIDDEN)?.split_once('-')?;
    if !rank.bytes().all(|byte| byte.is_ascii_digit()) {
        return None;
    }
    if let Some(number) = label.strip_prefix(NUMBER) {
        return number.parse().ok().map(Hidden::Number);
    }
    let is_hash = label.len() == HASH_DIGITS && label.bytes().all(|byte| byte.is_ascii_hexdigit());
    is_hash.then_some(Hidden::Hash(label))
}

/// The same however it is written where labels are looked up.
fn hash_of(name: &str) -> String {
    let mut hash = sha256_bytes(name.trim().to_ascii_lowercase().as_bytes());
    hash.truncate(HASH_DIGITS);
    hash
}

/// Numbers and names of labels.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) struct LabelNames {
    /// The file that says them, as the scene names it.
    source: String,
    names: BTreeMap<u32, String>,
}

impl LabelNames {
    /// As `source` says them.
    pub fn new(source: &str, names: Vec<(u32, String)>) -> Self {
        Self { source: source.to_owned(), names: names.into_iter().collect() }
    }

    /// Of a CSV file with a header: the number in a column `id` (or `label`, `index`), the name in `structure` (or `name`).
    ///
    /// # Errors
    /// One sentence, when a column or a number is missing, or a number has two names.
    pub fn from_csv(source: &str, text: &str) -> Result<Self, String> {
        let mut lines = unmarked(text).lines().enumerate().filter(|(_, line)| !line.trim().is_empty());
        let header: Vec<String> =
            lines.next().map(|(_, line)| cells_of(line).iter().map(str::to_lowercase).collect()).unwrap_or_default();
        let column = |names: &[&str]| {
            let found = names.iter().find_map(|name| header.iter().position(|cell| cell == name));
            found.ok_or_else(|| format!("no column {} in its first line; expected for example id,structure", names.join(" or ")))
        };
        let (id, name) = (column(&["id", "label", "index"])?, column(&["structure", "name"])?);
        let mut names: BTreeMap<u32, String> = BTreeMap::new();
        for (at, line) in lines {
            let row = cells_of(line);
            let number = row.get(id).and_then(|cell| cell.parse().ok());
            let (Some(number), Some(name)) = (number, row.get(name)) else {
                return Err(format!("line {}: '{line}' is no number and name of a label", at + 1));
            };
            // The same line twice says nothing else.
            if let Some(other) = names.insert(number, name.to_owned()).filter(|other| other != name) {
                return Err(format!(
                    "line {}: label {number} is called '{name}', and '{other}' before; keep one of them",
                    at + 1
                ));
            }
        }
        Ok(Self { source: source.to_owned(), names })
    }

    /// All of them, ascending.
    pub fn iter(&self) -> impl Iterator<Item = (u32, &str)> {
        self.names.iter().map(|(number, name)| (*number, name.as_str()))
    }

    /// The number of the label that `text` names, or is, or stands for ([`hidden_label`]).
    ///
    /// # Errors
    /// What was expected instead, with the nearest name.
    pub fn number(&self, text: &str) -> Result<u32, String> {
        let text = text.trim();
        if let Ok(number) = text.parse() {
            return Ok(number);
        }
        let hash = match hidden(text) {
            Some(Hidden::Number(number)) => return Ok(number),
            Some(Hidden::Hash(hash)) => Some(hash),
            None => None,
        };
        let is_meant = |name: &str| name.eq_ignore_ascii_case(text) || hash.is_some_and(|hash| hash_of(name) == hash);
        let mut named = self.iter().filter(|&(_, name)| is_meant(name));
        match (named.next(), named.next()) {
            (Some((number, _)), None) => Ok(number),
            (Some((first, _)), Some((second, _))) => Err(format!("its number: both {first} and {second} are called so")),
            (None, _) if self.names.is_empty() => Err(format!(
                "a whole number from 0 up, or a name: but neither {} nor a label-names.csv beside it names labels",
                self.source
            )),
            (None, _) => {
                let near = nearest(&text.to_lowercase(), self.iter().map(|(_, name)| name));
                let near = near.map_or_else(String::new, |name| format!(" (did you mean {name}?)"));
                Err(format!("a name of {} or a whole number from 0 up{near}", self.source))
            }
        }
    }
}

/// What a structure is made of; `None` where the preset does not know it.
pub(super) fn preset_material(preset: PresetFile, structure: &str) -> Option<&'static str> {
    let PresetFile::TotalSegmentator = preset;
    let rows = include_str!("../../calibration/materials/totalsegmentator.csv").lines().skip_while(|line| line.starts_with('#'));
    let known = rows.skip(1).filter_map(|row| row.split_once(','));
    known.filter(|(start, _)| structure.starts_with(start)).max_by_key(|(start, _)| start.len()).map(|(_, material)| material)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::scene::physics::Material;

    fn names() -> LabelNames {
        let text =
            "\u{feff}group,original_idx,structure,id\norgans,1,spleen,1\nbones,75,femur_left,80\nbones,76,\"Hip_Left\",77\n";
        LabelNames::from_csv("label-names.csv", text).expect("good")
    }

    #[test]
    fn a_label_is_found_by_number_and_by_name_whatever_the_columns() {
        let found = names();
        for (text, number) in [("femur_left", 80), ("80", 80), (" hip_left ", 77), ("9", 9)] {
            assert_eq!(found.number(text), Ok(number), "{text}");
        }
        assert!(found.number("femur_lft").expect_err("misspelt").contains("did you mean femur_left?"));
        assert!(LabelNames::new("seg.nii.gz", Vec::new()).number("femur_left").expect_err("no names").contains("seg.nii.gz"));
        let twice = LabelNames::new("seg.nii.gz", vec![(1, "rib".into()), (2, "rib".into())]);
        assert!(twice.number("rib").expect_err("twice").contains("1 and 2"));
    }

    /// A log that was given away named the structures of its label map.
    #[test]
    fn a_label_is_found_by_what_stands_for_its_name_and_no_other_is() {
        let found = names();
        let hidden = hidden_label(3, " HIP_left ");
        assert!(
            hidden.starts_with("label-0003-") && !hidden.to_lowercase().contains("hip") && is_hidden_label(&hidden),
            "{hidden}"
        );
        assert_eq!((found.number(&hidden), found.number(&hidden_label(7, "hip_left"))), (Ok(77), Ok(77)));
        assert!(found.number(&hidden_label(3, "hip_right")).is_err());
        for name in ["label-3", "label-0003-hip_left", "label-0003-", "hip_left"] {
            assert!(!is_hidden_label(name), "{name}");
        }
        let twice = LabelNames::new("seg.nii.gz", vec![(1, "rib".into()), (2, "Rib".into())]);
        assert!(twice.number(&hidden_label(0, "rib")).expect_err("twice").contains("1 and 2"));
    }

    /// Quotes were cut off after the line had been split: a name with a comma was the part before it.
    #[test]
    fn a_quoted_name_may_hold_commas_and_quotes() {
        let text = "\u{feff}\"id\",\"structure\"\r\n80,\"femur, \"\"left\"\"\"\r\n\r\n77, hip \r\n  \r\n";
        let found = LabelNames::from_csv("a", text).expect("good");
        assert_eq!(found.iter().collect::<Vec<_>>(), [(77, "hip"), (80, "femur, \"left\"")]);
        let wrong = text.replace("77,", "hip,");
        assert!(LabelNames::from_csv("a", &wrong).expect_err("no number").contains("line 4"), "blank lines count");
    }

    #[test]
    fn a_csv_without_its_columns_is_refused_with_the_line() {
        assert!(LabelNames::from_csv("a", "number,structure\n1,spleen\n").expect_err("no id").contains("id or label"));
        assert!(LabelNames::from_csv("a", "id,structure\n1,spleen\nx,liver\n").expect_err("no number").contains("line 3"));
        let twice = LabelNames::from_csv("a", "id,structure\n1,spleen\n2,hip\n1,liver\n").expect_err("twice");
        assert!(twice.contains("line 4: label 1 is called 'liver', and 'spleen' before"), "{twice}");
        assert!(LabelNames::from_csv("a", "id,structure\n1,spleen\n1,spleen\n2,spleen\n").is_ok(), "the same again");
    }

    #[test]
    fn the_preset_knows_bones_lungs_and_organs() {
        let cases = [
            ("femur_left", Some("bone_cortical")),
            ("vertebrae_L5", Some("bone_cortical")),
            ("rib_left_7", Some("bone_cortical")),
            ("lung_upper_lobe_left", Some("lung")),
            ("aorta", Some("blood")),
            ("gluteus_maximus_left", Some("muscle")),
            ("liver", Some("soft_tissue")),
            ("trachea", Some("soft_tissue")),
            ("antler", None),
        ];
        for (structure, expected) in cases {
            assert_eq!(preset_material(PresetFile::TotalSegmentator, structure), expected, "{structure}");
            assert!(expected.is_none_or(|name| Material::parse(name).is_ok()), "{structure}");
        }
    }
}
