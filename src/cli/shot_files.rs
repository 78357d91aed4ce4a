//! What the calibrations from shots share: how shots are named, tables of them, reports.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use crate::foreign::read_small;
use crate::json::parse_json;
use crate::pose::{PoseFileError, Prior};
use crate::reporter::Reporter;
use crate::table::{cells_of, unmarked};

/// A session's log, by its ending.
pub(super) fn is_log(path: &Path) -> bool {
    has_ending(path, "mcap")
}

/// JSON, by its ending.
pub(super) fn is_json(path: &Path) -> bool {
    has_ending(path, "json")
}

fn has_ending(path: &Path, ending: &str) -> bool {
    path.extension().is_some_and(|extension| extension.eq_ignore_ascii_case(ending))
}

/// The file's name without its ending.
pub(super) fn shot_name(path: &Path) -> String {
    path.file_stem().unwrap_or_default().to_string_lossy().into_owned()
}

/// A typed number that makes no sense.
#[derive(Debug, thiserror::Error)]
#[error("{option} is {found}, expected above 0 and at most {most}")]
pub struct OutOfRange {
    /// As typed.
    option: &'static str,
    found: f64,
    /// Largest that makes sense.
    most: f64,
}

/// Whether each option's number is above 0 and at most what stands behind it.
pub(super) fn check_range<const N: usize>(options: [(&'static str, f64, f64); N]) -> Result<(), OutOfRange> {
    // NaN is out of every range.
    let wrong = options.into_iter().find(|(_, found, most)| !(*found > 0.0 && found <= most));
    wrong.map_or(Ok(()), |(option, found, most)| Err(OutOfRange { option, found, most }))
}

/// What a JSON file holds, or what is wrong with it and where.
pub(super) fn read_json<T: serde::de::DeserializeOwned>(path: &Path) -> Result<T, String> {
    let bytes = read_small(path).map_err(|error| error.to_string())?;
    parse_json(&bytes).map_err(|fault| fault.to_string())
}

/// As it is written and printed.
pub(super) fn pretty<T: serde::Serialize>(value: &T) -> String {
    format!("{}\n", serde_json::to_string_pretty(value).unwrap_or_default())
}

/// Of each pose file the prior, and why the pose that it is read from is in doubt, where it is.
pub(super) fn read_priors(paths: &[PathBuf]) -> Result<(Vec<Prior>, Vec<Option<String>>), PoseFileError> {
    Ok(paths.iter().map(|path| Prior::read_with_doubt(path)).collect::<Result<Vec<_>, _>>()?.into_iter().unzip())
}

/// Warns of `shots` whose priors are in doubt; the words are for what is written of the shots.
pub(super) fn doubted(shots: &[PathBuf], doubts: &[Option<String>], reporter: &Reporter) -> Vec<String> {
    let words = |(path, doubt): (&PathBuf, &Option<String>)| {
        let doubt = doubt.as_ref()?;
        Some(format!("{}: the pose that its prior is read from is in doubt: {doubt}", shot_name(path)))
    };
    let found: Vec<String> = shots.iter().zip(doubts).filter_map(words).collect();
    found.iter().for_each(|words| reporter.warn("prior in doubt", words));
    found
}

/// A finite number, or what stands in its place.
pub(super) fn number(key: &str, cell: &str) -> Result<f64, String> {
    let value = cell.parse::<f64>().ok().filter(|value| value.is_finite());
    value.ok_or_else(|| format!("{key} is '{cell}', expected a number"))
}

/// A table of commas: a header that `check` takes, then a line a shot, its name first; `row` reads header and cells.
///
/// # Errors
/// What is wrong, with its line.
pub(super) fn csv_table<Row>(
    text: &str,
    check: impl Fn(&[&str]) -> Result<(), String>,
    row: impl Fn(&[&str], &[&str]) -> Result<Row, String>,
) -> Result<BTreeMap<String, Row>, String> {
    let mut lines = (1..).zip(unmarked(text).lines()).filter(|(_, line)| !line.trim().is_empty());
    let header = lines.next().map(|(_, line)| cells_of(line)).unwrap_or_default();
    let header: Vec<&str> = header.iter().collect();
    check(&header).map_err(|wrong| format!("line 1: the columns are {}, expected {wrong}", header.join(",")))?;
    let mut rows = BTreeMap::new();
    for (line_number, line) in lines {
        let wrong = |detail: String| format!("line {line_number}: {detail}");
        let cells = cells_of(line);
        let cells: Vec<&str> = cells.iter().collect();
        if cells.len() != header.len() {
            return Err(wrong(format!("{} cells, the header has {}", cells.len(), header.len())));
        }
        if rows.insert(cells[0].to_owned(), row(&header, &cells).map_err(wrong)?).is_some() {
            return Err(wrong(format!("'{}' stands in the table twice", cells[0])));
        }
    }
    Ok(rows)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn read(text: &str) -> Result<BTreeMap<String, f64>, String> {
        let check = |header: &[&str]| if header == ["frame", "lift_mm"] { Ok(()) } else { Err("frame,lift_mm".to_owned()) };
        csv_table(text, check, |header, cells| number(header[1], cells[1]))
    }

    /// A spreadsheet's mark stood in the first column's name, and a shot whose name has a comma had a cell too many.
    #[test]
    fn a_table_is_read_as_spreadsheets_write_it() {
        let text = "\u{feff}frame,\"lift_mm\"\r\n\r\n\"a, first\", 1.5\r\nb,\"2\"\r\n  \r\n";
        assert_eq!(read(text), Ok(BTreeMap::from([("a, first".to_owned(), 1.5), ("b".to_owned(), 2.0)])));
    }

    #[test]
    fn what_is_wrong_is_said_with_its_line() {
        for (text, words) in [
            ("frame,height\n", "line 1: the columns are frame,height"),
            ("frame,lift_mm\n\na\n", "line 3: 1 cells, the header has 2"),
            ("frame,lift_mm\na,1\na,2\n", "line 3: 'a' stands in the table twice"),
            ("frame,lift_mm\na,1\n\"b,2\"\n", "line 3: 1 cells"),
        ] {
            let said = read(text).expect_err(words);
            assert!(said.contains(words), "{said}");
        }
    }
}
