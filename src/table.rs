//! Tables of commas, a line at a time: their readers name the line in which something is wrong.

/// Written before the text by spreadsheets; it marks UTF-8 and is no part of the first cell.
const BYTE_ORDER_MARK: char = '\u{feff}';

/// Cells of one line without the blanks around them; a quoted cell may hold commas and doubled quotes.
#[must_use]
pub fn cells_of(line: &str) -> csv::StringRecord {
    let mut one_line = csv::ReaderBuilder::new();
    one_line.has_headers(false).flexible(true).trim(csv::Trim::All).terminator(csv::Terminator::Any(b'\n'));
    // A line of text always falls into cells.
    one_line.from_reader(line.as_bytes()).into_records().next().and_then(Result::ok).unwrap_or_default()
}

/// The text without the mark that spreadsheets write before it.
#[must_use]
pub fn unmarked(text: &str) -> &str {
    text.trim_start_matches(BYTE_ORDER_MARK)
}
