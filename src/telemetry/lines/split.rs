//! A line into the texts that a declaration names.

use regex::Regex;
use serde_json::Value;

use super::super::line_fault::{LineFault, quoted};
use super::declaration::{CsvFormat, Format};
use super::error::AdapterError;

/// What a separator is called that is blanks and tabs.
const WHITESPACE: &str = "whitespace";

/// A line as text; a zero makes it none.
pub(super) fn text_of_line(line: &[u8]) -> Option<&str> {
    std::str::from_utf8(line).ok().filter(|text| !text.contains('\0'))
}

/// The names that are read of each line: the texts of a line are in their order.
#[derive(Clone, Debug, Default)]
pub(super) struct Names {
    /// Each with the key that names it.
    read: Vec<(String, String)>,
    /// What no line says, in words.
    pub(super) constants: Vec<String>,
}

impl Names {
    /// The place of `from` among the texts; `place` is the key that names it.
    pub(super) fn index(&mut self, from: &str, place: &str) -> usize {
        self.read.iter().position(|(known, _)| known == from).unwrap_or_else(|| {
            self.read.push((from.to_owned(), place.to_owned()));
            self.read.len() - 1
        })
    }

    fn texts(&self) -> impl ExactSizeIterator<Item = &str> {
        self.read.iter().map(|(from, _)| from.as_str())
    }

    /// The first one that is not among `known`.
    fn refuse_unknown(&self, known: &[&str], what: &str) -> Result<(), AdapterError> {
        match self.read.iter().find(|(from, _)| !known.contains(&from.as_str())) {
            Some((from, place)) => {
                let detail = format!("\"{from}\" is none of the {what} {}", known.join(", "));
                Err(AdapterError::new(format!("{place}.from"), detail))
            }
            None => Ok(()),
        }
    }
}

/// Where the named columns are.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) struct Columns {
    /// Of each name.
    places: Vec<usize>,
    /// In a line.
    count: usize,
}

/// What a line is.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) enum Split {
    /// The text of each name; none where it is absent.
    Texts(Vec<Option<String>>),
    /// It names the columns of those that follow.
    Header(Columns),
    /// It means nothing.
    Nothing,
}

#[derive(Clone, Debug)]
enum How {
    Csv {
        /// None: blanks and tabs.
        separator: Option<u8>,
        comment: Option<String>,
        /// As declared; else a header names them.
        columns: Option<Columns>,
    },
    Regex(Regex),
    /// Pointers, one a name.
    Json(Vec<String>),
}

/// Splits lines as declared.
#[derive(Clone, Debug)]
pub(super) struct Splitter {
    how: How,
    ignore: Vec<Regex>,
    names: Names,
    /// Decimals stand behind a comma.
    pub(super) decimal_comma: bool,
    /// A header names the columns.
    pub(super) has_header: bool,
}

impl Splitter {
    /// Of a format, for the names that are read.
    pub(super) fn new(format: &Format, ignore: &[String], names: Names) -> Result<Self, AdapterError> {
        let whole = |(at, pattern): (usize, &String)| whole_line(pattern, &format!("ignore[{at}]"));
        let ignore = ignore.iter().enumerate().map(whole).collect::<Result<_, _>>()?;
        let (mut decimal_comma, mut has_header) = (false, false);
        let how = match format {
            Format::Csv(csv) => {
                let separator = separator(csv)?;
                decimal_comma = decimal_comma_of(csv, separator)?;
                has_header = csv.header;
                let comment = csv.comment.clone();
                if comment.as_ref().is_some_and(String::is_empty) {
                    return Err(AdapterError::new("format.csv.comment", "is empty, expected how a line without meaning begins"));
                }
                How::Csv { separator, comment, columns: declared_columns(csv, &names)? }
            }
            Format::Regex(regex) => {
                let pattern = whole_line(&regex.pattern, "format.regex.pattern")?;
                let groups: Vec<&str> = pattern.capture_names().flatten().collect();
                names.refuse_unknown(&groups, "named groups")?;
                How::Regex(pattern)
            }
            Format::Json(_) => How::Json(names.texts().map(pointer).collect()),
        };
        Ok(Self { how, ignore, names, decimal_comma, has_header })
    }

    /// `header` are the columns that an earlier line has named.
    pub(super) fn split(&self, line: &str, header: Option<&Columns>) -> Result<Split, LineFault> {
        if self.is_ignored(line) {
            return Ok(Split::Nothing);
        }
        let line = self.trimmed(line);
        match &self.how {
            How::Csv { separator, comment, columns } => {
                if comment.as_ref().is_some_and(|comment| line.starts_with(comment)) {
                    return Ok(Split::Nothing);
                }
                self.columns(&fields(line, *separator)?, columns.as_ref().or(header))
            }
            How::Regex(pattern) => {
                let captures = pattern.captures(line).ok_or_else(|| LineFault::NoMatch { found: quoted(line) })?;
                let text = |name: &str| captures.name(name).map(|found| found.as_str().trim().to_owned());
                Ok(Split::Texts(self.names.texts().map(text).collect()))
            }
            How::Json(pointers) => {
                let object: Value =
                    serde_json::from_str(line).map_err(|error| LineFault::NotJson { reason: error.to_string() })?;
                if !object.is_object() {
                    return Err(LineFault::NotJson { reason: format!("found '{}'", quoted(line)) });
                }
                Ok(Split::Texts(pointers.iter().map(|pointer| object.pointer(pointer).and_then(text_of)).collect()))
            }
        }
    }

    /// Whether the declaration says that the line means nothing.
    pub(super) fn is_ignored(&self, line: &str) -> bool {
        let line = self.trimmed(line);
        self.ignore.iter().any(|pattern| pattern.is_match(line))
    }

    fn trimmed<'a>(&self, line: &'a str) -> &'a str {
        let separator = match &self.how {
            How::Csv { separator, .. } => separator.map(char::from),
            How::Regex(_) | How::Json(_) => None,
        };
        // A tab that separates stands for an empty column, at either end as well.
        line.trim_matches(|c: char| c.is_whitespace() && Some(c) != separator)
    }

    fn columns(&self, fields: &[String], columns: Option<&Columns>) -> Result<Split, LineFault> {
        if self.has_header {
            let places: Option<Vec<usize>> =
                self.names.texts().map(|name| fields.iter().position(|field| field == name)).collect();
            if let Some(places) = places {
                return Ok(Split::Header(Columns { places, count: fields.len() }));
            }
        }
        let Some(Columns { places, count }) = columns else {
            let expected = self.names.texts().collect::<Vec<_>>().join(", ");
            return Err(LineFault::NoHeader { expected: quoted(&expected) });
        };
        if fields.len() != *count {
            return Err(LineFault::Columns { expected: *count, found: fields.len() });
        }
        let text = |place: &usize| fields.get(*place).filter(|field| !field.is_empty()).cloned();
        Ok(Split::Texts(places.iter().map(text).collect()))
    }

    /// What a name is called in the line.
    pub(super) fn name(&self, index: usize) -> &str {
        self.names.read.get(index).map_or("", |(from, _)| from)
    }
}

/// The fields of a line, blanks around them taken off.
fn fields(line: &str, separator: Option<u8>) -> Result<Vec<String>, LineFault> {
    let Some(separator) = separator else {
        return Ok(line.split_whitespace().map(str::to_owned).collect());
    };
    if !line.contains('"') {
        return Ok(line.split(char::from(separator)).map(|field| field.trim().to_owned()).collect());
    }
    let mut reader = csv::ReaderBuilder::new()
        .has_headers(false)
        .flexible(true)
        .delimiter(separator)
        .trim(csv::Trim::All)
        .buffer_capacity(line.len().max(64))
        .from_reader(line.as_bytes());
    let mut record = csv::StringRecord::new();
    // The line is text already; a reader of bytes does not fail.
    reader.read_record(&mut record).map_err(|_| LineFault::NotText { bytes: line.len() })?;
    Ok(record.iter().map(str::to_owned).collect())
}

fn separator(csv: &CsvFormat) -> Result<Option<u8>, AdapterError> {
    match csv.separator.as_bytes() {
        _ if csv.separator == WHITESPACE => Ok(None),
        [byte]
            if byte.is_ascii() && !byte.is_ascii_alphanumeric() && !matches!(byte, b'"' | b'.' | b'-' | b'+' | b'\r' | b'\n') =>
        {
            Ok(Some(*byte))
        }
        _ => {
            let detail = format!(
                "is {:?}, expected one character that stands in no number (\",\", \";\", \"\\t\" …), or \"{WHITESPACE}\"",
                csv.separator
            );
            Err(AdapterError::new("format.csv.separator", detail))
        }
    }
}

fn decimal_comma_of(csv: &CsvFormat, separator: Option<u8>) -> Result<bool, AdapterError> {
    match (csv.decimal.as_str(), separator) {
        (".", _) => Ok(false),
        (",", Some(b',')) => Err(AdapterError::new("format.csv.decimal", "is the separator as well: one of the two is another")),
        (",", _) => Ok(true),
        (other, _) => Err(AdapterError::new("format.csv.decimal", format!("is {other:?}, expected \".\" or \",\""))),
    }
}

fn declared_columns(csv: &CsvFormat, names: &Names) -> Result<Option<Columns>, AdapterError> {
    let place = "format.csv.columns";
    match (&csv.columns, csv.header) {
        (None, true) => Ok(None),
        (None, false) => Err(AdapterError::new(place, "is missing: name all columns in order, or say \"header\": true")),
        (Some(_), true) => Err(AdapterError::new(place, "are named by the header as well: leave one of the two out")),
        (Some(columns), false) => {
            let known: Vec<&str> = columns.iter().map(String::as_str).collect();
            names.refuse_unknown(&known, "columns")?;
            if let Some(twice) = names.texts().find(|name| known.iter().filter(|known| known == &name).count() > 1) {
                return Err(AdapterError::new(place, format!("\"{twice}\" is named twice")));
            }
            let places = names.texts().filter_map(|name| known.iter().position(|known| *known == name)).collect();
            Ok(Some(Columns { places, count: columns.len() }))
        }
    }
}

/// A pattern of the whole line: half a match is how half a number is read.
fn whole_line(pattern: &str, place: &str) -> Result<Regex, AdapterError> {
    let wrong = |error: regex::Error| AdapterError::new(place, format!("is no regular expression: {}", sentence(&error)));
    // By itself first: a bracket too many must not close the group around it.
    Regex::new(pattern).map_err(wrong)?;
    Regex::new(&format!("^(?:{pattern})$")).map_err(wrong)
}

/// The last line says what is wrong; those before it draw the pattern.
fn sentence(error: &regex::Error) -> String {
    let text = error.to_string();
    text.lines().last().unwrap_or_default().trim_start_matches("error: ").to_owned()
}

/// A dotted path as JSON has it.
fn pointer(from: &str) -> String {
    if from.starts_with('/') { from.to_owned() } else { format!("/{}", from.replace('.', "/")) }
}

/// Of an object's value, where it has one.
fn text_of(value: &Value) -> Option<String> {
    match value {
        Value::Null | Value::Array(_) | Value::Object(_) => None,
        Value::String(text) => Some(text.trim().to_owned()).filter(|text| !text.is_empty()),
        Value::Bool(_) | Value::Number(_) => Some(value.to_string()),
    }
}
