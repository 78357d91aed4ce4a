//! Words of a header that identify a person, a place or a study: for comparison with the file's name, and for nothing else.

use dicom_core::Tag;
use dicom_dictionary_std::tags;
use dicom_object::InMemDicomObject;

/// Attributes whose words and numbers must not be in a label.
const IDENTIFYING: [Tag; 27] = [
    tags::PATIENT_NAME,
    tags::PATIENT_ID,
    tags::OTHER_PATIENT_NAMES,
    // Other patient IDs: retired, still written.
    Tag(0x0010, 0x1000),
    tags::PATIENT_BIRTH_DATE,
    tags::PATIENT_BIRTH_NAME,
    tags::PATIENT_MOTHER_BIRTH_NAME,
    tags::PATIENT_ADDRESS,
    tags::ACCESSION_NUMBER,
    tags::STUDY_ID,
    tags::INSTITUTION_NAME,
    tags::INSTITUTION_ADDRESS,
    tags::INSTITUTIONAL_DEPARTMENT_NAME,
    tags::STATION_NAME,
    tags::REFERRING_PHYSICIAN_NAME,
    tags::PERFORMING_PHYSICIAN_NAME,
    tags::PHYSICIANS_OF_RECORD,
    tags::NAME_OF_PHYSICIANS_READING_STUDY,
    tags::OPERATORS_NAME,
    tags::STUDY_DESCRIPTION,
    tags::SERIES_DESCRIPTION,
    tags::PATIENT_COMMENTS,
    tags::IMAGE_COMMENTS,
    tags::SOP_INSTANCE_UID,
    tags::STUDY_INSTANCE_UID,
    tags::SERIES_INSTANCE_UID,
    tags::FRAME_OF_REFERENCE_UID,
];

/// Free texts: a word that any file may be named with says nothing there.
const FREE_TEXTS: [Tag; 4] = [tags::STUDY_DESCRIPTION, tags::SERIES_DESCRIPTION, tags::PATIENT_COMMENTS, tags::IMAGE_COMMENTS];

/// Components of an UID that are shorter than this are counters and versions, as in any file name.
const UID_DIGITS: usize = 4;

/// The words, in lower case: each as written, with its umlauts and accents replaced in both usual ways, and dates in the usual orders.
pub(super) fn words(object: &InMemDicomObject) -> Vec<String> {
    let mut words = Vec::new();
    for tag in IDENTIFYING {
        let Some(Ok(text)) = object.get(tag).map(|element| element.to_str()) else { continue };
        let is_uid = text.starts_with(|c: char| c.is_ascii_digit()) && text.contains('.');
        for word in text.to_lowercase().split(|c: char| !c.is_alphanumeric()) {
            if word.chars().count() < if is_uid { UID_DIGITS } else { 2 } {
                continue;
            }
            if FREE_TEXTS.contains(&tag) && super::label::is_listed(word) {
                continue;
            }
            words.push(word.to_owned());
            words.extend(transliterated(word));
            words.extend(dates(word));
            // `AB1234` is as telling as `1234`.
            words.extend(word.split(|c: char| !c.is_ascii_digit()).filter(|digits| digits.len() >= 3).map(str::to_owned));
        }
        let digits: String = text.chars().filter(char::is_ascii_digit).collect();
        words.push(digits);
    }
    words.retain(|word| word.len() > 1);
    words
}

/// `ä` as `ae` and as `a`, `ß` as `ss`, other accents dropped.
fn transliterated(word: &str) -> Vec<String> {
    if word.is_ascii() {
        return Vec::new();
    }
    let replace = |long: bool| {
        let mut out = String::new();
        for c in word.chars() {
            let base = match c {
                'ä' => "a",
                'ö' | 'ø' => "o",
                'ü' => "u",
                'ß' => "ss",
                'á' | 'à' | 'â' | 'ã' | 'å' => "a",
                'é' | 'è' | 'ê' | 'ë' => "e",
                'í' | 'ì' | 'î' | 'ï' => "i",
                'ó' | 'ò' | 'ô' | 'õ' => "o",
                'ú' | 'ù' | 'û' => "u",
                'ç' | 'č' | 'ć' => "c",
                'ñ' | 'ń' => "n",
                'š' | 'ś' => "s",
                'ž' | 'ź' | 'ż' => "z",
                'ł' => "l",
                _ => "",
            };
            match (base, long && matches!(c, 'ä' | 'ö' | 'ü' | 'ø')) {
                ("", _) => out.push(c),
                (base, true) => {
                    out.push_str(base);
                    out.push('e');
                }
                (base, false) => out.push_str(base),
            }
        }
        out
    };
    vec![replace(true), replace(false)]
}

/// Eight digits `YYYYMMDD` in the other orders in which a day is written, with and without century, and their pairs.
fn dates(word: &str) -> Vec<String> {
    if word.len() != 8 || !word.bytes().all(|b| b.is_ascii_digit()) {
        return Vec::new();
    }
    let (year, month, day) = (&word[..4], &word[4..6], &word[6..]);
    let short = &year[2..];
    vec![
        format!("{day}{month}{year}"),
        format!("{month}{day}{year}"),
        format!("{day}{month}{short}"),
        format!("{month}{day}{short}"),
        format!("{short}{month}{day}"),
        format!("{year}{month}"),
        format!("{day}{month}"),
        format!("{month}{day}"),
        year.to_owned(),
    ]
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn umlauts_and_dates_are_known_in_every_spelling() {
        assert_eq!(transliterated("müller"), ["mueller", "muller"]);
        assert!(transliterated("li").is_empty());
        let dates = dates("19521204");
        for written in ["04121952", "12041952", "041252", "521204", "1952", "0412"] {
            assert!(dates.iter().any(|date| date == written), "{written}");
        }
    }
}
