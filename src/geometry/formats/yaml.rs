//! The part of YAML that `cv::FileStorage` writes: keys with plain values and `!!opencv-matrix` at the first level.

use super::FormatError;
use super::numbers::{number, numbers};

/// What stands at a key.
#[derive(Clone, Debug, PartialEq)]
pub(super) enum Node {
    /// A plain value.
    Scalar(String),
    /// Rows of a dense matrix of one channel.
    Matrix(Vec<Vec<f64>>),
    /// Something deeper; not looked into.
    Other,
}

fn wrong(line: usize, detail: &str) -> FormatError {
    FormatError::Syntax { expected: "OpenCV's YAML", detail: format!("line {}: {detail}", line + 1) }
}

/// A line without its comment; `#` opens one at the start or after a blank.
fn without_comment(line: &str) -> &str {
    let at = line.char_indices().find(|&(at, c)| c == '#' && (at == 0 || line[..at].ends_with([' ', '\t']))).map(|(at, _)| at);
    line[..at.unwrap_or(line.len())].trim_end()
}

/// Keys and values in the order of the file.
pub(super) fn parse(text: &str) -> Result<Vec<(String, Node)>, FormatError> {
    let lines: Vec<&str> = text.lines().map(without_comment).collect();
    let mut found: Vec<(String, Node)> = Vec::new();
    let mut at = 0;
    while let Some(line) = lines.get(at) {
        let start = at;
        at += 1;
        if line.is_empty() || line.starts_with('%') || *line == "---" || *line == "..." {
            continue;
        }
        if line.starts_with([' ', '\t']) {
            return Err(wrong(start, "an indented line belongs to no key"));
        }
        let (key, value) = line.split_once(':').ok_or_else(|| wrong(start, "expected `key: value`"))?;
        let (key, value) = (key.trim().trim_matches('"').to_owned(), value.trim());
        if found.iter().any(|(known, _)| *known == key) {
            return Err(FormatError::TwiceKey { key });
        }
        // All that is indented, and lists in the block style, belong to the key above.
        let below = lines[at..]
            .iter()
            .take_while(|line| line.is_empty() || line.starts_with([' ', '\t', '-']) && **line != "---")
            .count();
        let block = &lines[at..at + below];
        at += below;
        let node = if value.starts_with("!!opencv-matrix") {
            Node::Matrix(dense(block, &key, start)?)
        } else if value.is_empty() || block.iter().any(|line| !line.is_empty()) || value.starts_with(['[', '{', '!']) {
            Node::Other
        } else {
            Node::Scalar(value.trim_matches('"').to_owned())
        };
        found.push((key, node));
    }
    Ok(found)
}

/// Rows of a matrix given by `rows`, `cols`, `dt` and `data`.
fn dense(block: &[&str], key: &str, start: usize) -> Result<Vec<Vec<f64>>, FormatError> {
    let joined = block.iter().map(|line| line.trim()).collect::<Vec<_>>().join(" ");
    let (head, data) = joined.split_once("data:").ok_or_else(|| wrong(start, "a matrix without data"))?;
    let data = data
        .trim()
        .strip_prefix('[')
        .and_then(|rest| rest.strip_suffix(']'))
        .ok_or_else(|| wrong(start, "data in no brackets"))?;
    let words: Vec<&str> = head.split_whitespace().collect();
    let field = |name: &str| words.iter().position(|word| *word == name).and_then(|at| words.get(at + 1)).copied();
    let count = |name: &str| -> Result<usize, FormatError> {
        let word = field(name).ok_or_else(|| wrong(start, &format!("a matrix without {name}")))?;
        word.parse().map_err(|_| FormatError::NotNumber { what: format!("{key}: {name}"), found: word.to_owned() })
    };
    let (rows, columns) = (count("rows:")?, count("cols:")?);
    let kind = field("dt:").ok_or_else(|| wrong(start, "a matrix without dt"))?.trim_matches('"');
    if !matches!(kind, "d" | "f" | "i" | "s" | "u" | "w" | "c") {
        return Err(FormatError::Unsupported {
            key: format!("{key}: dt"),
            found: kind.to_owned(),
            expected: "one channel of numbers",
        });
    }
    // FileStorage writes NaN and infinity as .Nan and .Inf.
    if data.to_ascii_lowercase().contains(".nan") || data.to_ascii_lowercase().contains(".inf") {
        return Err(FormatError::NotFinite { what: key.to_owned() });
    }
    let values = numbers(data, key)?;
    if rows.checked_mul(columns) != Some(values.len()) || values.is_empty() {
        let found = format!("{rows}x{columns} with {} numbers", values.len());
        return Err(FormatError::Shape { what: key.to_owned(), found, expected: "rows times columns numbers" });
    }
    Ok(values.chunks(columns).map(<[f64]>::to_vec).collect())
}

/// A plain number.
pub(super) fn scalar(node: &Node, key: &str) -> Result<f64, FormatError> {
    match node {
        Node::Scalar(word) if word.eq_ignore_ascii_case(".nan") => Err(FormatError::NotFinite { what: key.to_owned() }),
        Node::Scalar(word) => number(word, key),
        _ => Err(FormatError::Shape { what: key.to_owned(), found: "no plain value".to_owned(), expected: "a number" }),
    }
}

/// A matrix.
pub(super) fn rows<'a>(node: &'a Node, key: &str) -> Result<&'a [Vec<f64>], FormatError> {
    match node {
        Node::Matrix(rows) => Ok(rows),
        _ => Err(FormatError::Shape { what: key.to_owned(), found: "no matrix".to_owned(), expected: "an !!opencv-matrix" }),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_matrix_over_several_lines_is_read_whole() {
        let text = "%YAML:1.0\n---\n# note\nn: 3\nm: !!opencv-matrix\n   rows: 2\n   cols: 2\n   dt: d\n   data: [ 1., 2.,\n       3e-1, 4 ]\nlast: \"x y\"\n";
        let found = parse(text).expect("OpenCV's YAML");
        assert_eq!(found[0], ("n".to_owned(), Node::Scalar("3".to_owned())));
        assert_eq!(found[1], ("m".to_owned(), Node::Matrix(vec![vec![1.0, 2.0], vec![0.3, 4.0]])));
        assert_eq!(found[2].1, Node::Scalar("x y".to_owned()));
    }

    #[test]
    fn wrong_counts_nan_and_repeated_keys_are_refused() {
        let matrix = |data: &str| format!("m: !!opencv-matrix\n   rows: 1\n   cols: 2\n   dt: d\n   data: [ {data} ]\n");
        assert!(parse(&matrix("1., 2.")).is_ok());
        assert!(matches!(parse(&matrix("1., 2., 3.")), Err(FormatError::Shape { .. })));
        assert!(matches!(parse(&matrix("1., .Nan")), Err(FormatError::NotFinite { .. })));
        assert!(matches!(parse(&matrix("1., x")), Err(FormatError::NotNumber { .. })));
        assert!(matches!(parse("a: 1\na: 2\n"), Err(FormatError::TwiceKey { .. })));
        assert!(matches!(parse("   a: 1\n"), Err(FormatError::Syntax { .. })));
    }
}
