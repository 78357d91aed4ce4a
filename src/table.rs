//! Tables of commas, a line at a time: their readers name the line in which something is wrong.

/// Written before the text by spreadsheets; it marks UTF-8 and is no part of the first cell.
const BYTE_ORDER_MARK: char = '\u{feff}';

/// Cells of one line without the blanks around them; a quoted cell may hold commas and doubled quotes.
#[must_use]
pub fn cells_of(line: &str) -> csv::StringRecord {
    let mut one_line = csv::ReaderBuilder::new();
    one_line.has_headers(false).flexible(true).trim(csv::Trim::All).terminator(csv::Terminator::Any(b'\n'));
    let line = without_blanks_before_quotes(line);
    // A line of text always falls into cells.
    one_line.from_reader(line.as_bytes()).into_records().next().and_then(Result::ok).unwrap_or_default()
}

/// The same line; only quotes at the very beginning of a cell are quotes to the library.
fn without_blanks_before_quotes(line: &str) -> String {
    let (mut out, mut quoted, mut rest) = (String::with_capacity(line.len()), false, line);
    let mut begins = true;
    while let Some(next) = rest.chars().next() {
        let trimmed = rest.trim_start();
        if begins && trimmed.starts_with('"') {
            rest = trimmed;
        }
        let next = rest.chars().next().unwrap_or(next);
        quoted ^= next == '"';
        begins = next == ',' && !quoted;
        out.push(next);
        rest = &rest[next.len_utf8()..];
    }
    out
}

/// The text without the mark that spreadsheets write before it.
#[must_use]
pub fn unmarked(text: &str) -> &str {
    text.trim_start_matches(BYTE_ORDER_MARK)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn cells_are_split_as_they_are_meant() {
        for (line, cells) in [
            ("a, b ,c", &["a", "b", "c"][..]),
            ("1, \"femur, \"\"left\"\"\" , 2", &["1", "femur, \"left\"", "2"]),
            ("\"a, \"\" b\",\t\"c\"", &["a, \" b", "c"]),
            ("5 \"x\",y", &["5 \"x\"", "y"]),
            ("\"one\"", &["one"]),
            (",,", &["", "", ""]),
        ] {
            assert_eq!(cells_of(line).iter().collect::<Vec<_>>(), cells, "{line}");
        }
    }
}
