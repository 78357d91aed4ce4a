//! The words of a bead's description: those that are read, and those that look as if they were meant to be.
//!
//! A description may be a sentence of whoever placed the point. Named is only what looks like a word with its value and is near one that is
//! read; where that one stands beside it nothing is lost, and nothing is said.

use std::ops::RangeInclusive;

use crate::spelling::edit_distance;

/// Words that are read, and how they are written.
const WORDS: [(&str, &str); 5] = [
    ("radius_mm", "radius_mm=0.75, in mm"),
    ("sigma_mm", "sigma_mm=0.05, in mm"),
    ("covariance_mm2", "covariance_mm2=xx:xy:xz:yy:yz:zz, in mm²"),
    ("body", "body=femur"),
    ("role", "role=check"),
];
/// Radii of what may be a bead; others are named. Detection is tuned for 0.75 mm.
const RADII_MM: RangeInclusive<f64> = 0.2..=7.0;
/// Radii of most beads: what a slip is told by.
const USUAL_RADII_MM: RangeInclusive<f64> = 0.2..=3.0;
/// Units that radii are stated in by mistake, and how many millimetres they have; tenths are a decimal point too far to the right.
const SLIPS: [(&str, f64); 4] = [("centimetres", 10.0), ("metres", 1e3), ("tenths of a millimetre", 0.1), ("micrometres", 1e-3)];

/// The words of a description.
fn words(description: &str) -> impl Iterator<Item = &str> {
    description.split(|c: char| c.is_whitespace() || c == ';' || c == ',').filter(|word| !word.is_empty())
}

/// What a description gives for `key`: the part after its `=`.
pub(super) fn value<'a>(description: &'a str, key: &str) -> Option<&'a str> {
    words(description).find_map(|word| word.split_once('=').filter(|(found, _)| *found == key).map(|(_, value)| value))
}

/// A word that is not read.
#[derive(Clone, Debug, PartialEq, Eq)]
struct Misspelt<'a> {
    /// As it is written, with its sign.
    found: &'a str,
    /// Of [`WORDS`].
    meant: usize,
}

/// Words that are not read and look like ones that are, one for each of these.
fn misspelt(description: &str) -> Vec<Misspelt<'_>> {
    let words: Vec<&str> = words(description).collect();
    let mut all: Vec<Misspelt> = Vec::new();
    for (n, &word) in words.iter().enumerate() {
        let next = words.get(n + 1).copied().unwrap_or_default();
        let (key, after) = match word.find(['=', ':']) {
            Some(at) => word.split_at(at),
            None if next.starts_with(['=', ':']) => (word, next),
            None => continue,
        };
        let (sign, value) = after.split_at(1);
        let is_apart = word.len() == key.len();
        // Blanks may stand behind the sign as well.
        let behind = if is_apart { words.get(n + 2).copied().unwrap_or_default() } else { next };
        let value = if value.is_empty() { behind } else { value };
        if sign == "=" && !is_apart && WORDS.iter().any(|(known, _)| *known == key) {
            continue;
        }
        // A colon stands behind any word of a sentence: a key is the first of its part, or stands behind another key's value.
        let is_first = || description.split([';', ',']).any(|part| part.trim_start().starts_with(word));
        if sign == ":" && !(n == 0 || words[n - 1].contains('=') || is_first()) {
            continue;
        }
        let Some(meant) = WORDS.iter().position(|(known, _)| is_meant(known, key, sign, value)) else { continue };
        let is_said = self::value(description, WORDS[meant].0).is_some() || all.iter().any(|other| other.meant == meant);
        if !is_said {
            all.push(Misspelt { found: if is_apart { key } else { &word[..key.len() + 1] }, meant });
        }
    }
    all
}

/// Whether whoever wrote `key`, a sign and `value` meant `known`.
fn is_meant(known: &str, key: &str, sign: &str, value: &str) -> bool {
    let letters = |text: &str| text.chars().filter(char::is_ascii_alphabetic).collect::<String>().to_ascii_lowercase();
    let (own, of_known) = (letters(key), letters(known));
    match known.split_once('_') {
        // The same name with another unit or none, or a slip of the pen. Words of a sentence have no number behind them.
        Some((stem, _)) => {
            value.starts_with(|c: char| c.is_ascii_digit() || matches!(c, '.' | '-' | '+'))
                && (own.contains(stem) || edit_distance(&own, stem) <= 1 || edit_distance(&own, &of_known) <= 2)
        }
        // So short that many words are near: with a colon they are those of a sentence.
        None => {
            let is_near = own == of_known || (sign == "=" && own.len() > 4 && edit_distance(&own, &of_known) <= 1);
            is_near && !value.is_empty() && (known != "role" || edit_distance(&letters(value), "check") <= 1)
        }
    }
}

/// What is in doubt of a layout's descriptions, each once however many beads have it.
#[derive(Debug, Default)]
pub(super) struct Doubts {
    /// What is written, what of it, the first bead, how many have it.
    all: Vec<(String, String, String, usize)>,
}

impl Doubts {
    /// Looks at the description of the bead `name`, and at the radius that was read from it.
    pub fn look(&mut self, name: &str, description: &str, radius_mm: Option<f64>) {
        for Misspelt { found, meant } in misspelt(description) {
            self.add(found.to_owned(), format!("is not read: write it as in {}, without blanks", WORDS[meant].1), name);
        }
        if let Some(mm) = radius_mm.filter(|mm| !RADII_MM.contains(mm)) {
            let what = match SLIPS.iter().find(|(_, mm_per_unit)| USUAL_RADII_MM.contains(&(mm * mm_per_unit))) {
                Some((unit, mm_per_unit)) => format!(
                    "looks like {unit}, or has its decimal point in the wrong place: write radius_mm={}, if that is meant",
                    rounded(mm * mm_per_unit)
                ),
                None => format!("is no bead's: radii are {} to {} mm; correct it", RADII_MM.start(), RADII_MM.end()),
            };
            self.add(format!("radius_mm={mm}"), what, name);
        }
    }

    fn add(&mut self, found: String, what: String, name: &str) {
        match self.all.iter_mut().find(|(other, ..)| *other == found) {
            Some((.., count)) => *count += 1,
            None => self.all.push((found, what, name.to_owned(), 1)),
        }
    }

    /// A sentence each.
    pub fn sentences(self) -> Vec<String> {
        let sentence = |(found, what, name, count): (String, String, String, usize)| {
            let more = if count > 1 { format!(" and of {} more", count - 1) } else { String::new() };
            format!("{found} in the description of {name}{more} {what}")
        };
        self.all.into_iter().map(sentence).collect()
    }
}

/// Without the digits that only a factor's rounding has.
fn rounded(mm: f64) -> f64 {
    (mm * 1e6).round() / 1e6
}

#[cfg(test)]
mod tests {
    use super::*;

    fn found(description: &str) -> Vec<(&str, &str)> {
        misspelt(description).into_iter().map(|one| (one.found, WORDS[one.meant].0)).collect()
    }

    #[test]
    fn a_word_that_was_meant_to_be_read_is_named_with_what_was_meant() {
        let cases = [
            ("radius=0.75", "radius=", "radius_mm"),
            ("radious_mm=0.75", "radious_mm=", "radius_mm"),
            ("steel; raduis_mm=0.75", "raduis_mm=", "radius_mm"),
            ("Radius_mm=0.75", "Radius_mm=", "radius_mm"),
            ("radius_cm=0.075", "radius_cm=", "radius_mm"),
            ("radius: 0.75", "radius:", "radius_mm"),
            ("radius_mm = 0.75", "radius_mm", "radius_mm"),
            ("radius_mm: 0.75 body=pelvis", "radius_mm:", "radius_mm"),
            ("sigma=0.1", "sigma=", "sigma_mm"),
            ("covariance_mm=1:0:0:1:0:1", "covariance_mm=", "covariance_mm2"),
            ("Role: check", "Role:", "role"),
            ("rolle=check", "rolle=", "role"),
            ("Body: pelvis", "Body:", "body"),
            ("boddy=pelvis", "boddy=", "body"),
        ];
        for (description, word, meant) in cases {
            assert_eq!(found(description), [(word, meant)], "{description}");
        }
        assert_eq!(found("radius=0.75 sigma: 0.1"), [("radius=", "radius_mm"), ("sigma:", "sigma_mm")]);
    }

    #[test]
    fn what_is_read_and_what_people_write_is_not_named() {
        let silent = [
            "",
            "radius_mm=0.75; sigma_mm=0.05 body=pelvis role=check",
            "covariance_mm2=1e-2:0:0:1e-2:0:1e-2",
            "steel bead, left of the femur, placed on Monday at 10:30 (see note: seated well)",
            "radius 0.75 or so, the role of this one is to check",
            "roll: 3, hole=2 mm, note=deep, side: left, radiology: none",
            "near the radius: distal end",
            "distal radius: 2 cm from the joint",
            "press-fit into the body: steel",
            "bony=yes",
            // What is meant is read beside it.
            "radius: 0.75, radius_mm=0.75",
            "https://example.org/body?role=check",
        ];
        for description in silent {
            assert!(found(description).is_empty(), "{description}: {:?}", found(description));
        }
    }

    #[test]
    fn a_radius_that_is_no_bead_s_is_named_with_its_unit() {
        let said = |radius_mm: f64| {
            let mut doubts = Doubts::default();
            for name in ["B1", "B2"] {
                doubts.look(name, "", Some(radius_mm));
            }
            doubts.sentences().concat()
        };
        for (radius_mm, unit, meant) in [
            (0.075, "centimetres", "=0.75,"),
            (7.5, "tenths", "=0.75,"),
            (750.0, "micrometres", "=0.75,"),
            (7.5e-4, "metres", "=0.75,"),
        ] {
            let words = said(radius_mm);
            assert!(words.contains(unit) && words.contains(meant) && words.contains("B1 and of 1 more"), "{words}");
        }
        assert!(said(80.0).contains("is no bead's"), "{}", said(80.0));
        for radius_mm in [0.25, 0.5, 0.75, 1.5, 3.0, 6.35] {
            assert_eq!(said(radius_mm), "", "{radius_mm}");
        }
    }
}
