//! A declaration without the words of whoever wrote it: a log that is given away reads its lines as before.

use std::collections::BTreeMap;

use regex::Regex;
use serde_json::Value;

use super::adapter::LineAdapter;
use super::blank::IGNORED_LINES;
use super::declaration::{Declaration, Format};

/// Names that the declaration gives, and what stands for each.
type Renamed = BTreeMap<String, String>;

/// How a named group begins.
const GROUPS: [&str; 2] = ["(?<", "(?P<"];

impl LineAdapter {
    /// The same lines, as [`super::LineBlanker`] leaves them, said by nobody: without what was to be ignored, with numbers for the names of groups
    /// and of columns. What stands in the lines themselves stays: a pattern's own text, columns that a header names, keys of JSON, words of a flag
    /// and how comments begin.
    #[must_use]
    pub fn nameless(&self, origin: &str) -> Self {
        let mut declaration = Declaration { origin: origin.to_owned(), ..self.declaration().clone() };
        if !declaration.ignore.is_empty() {
            declaration.ignore = vec![IGNORED_LINES.to_owned()];
        }
        let numbered = numbered(&declaration).and_then(|numbered| Self::try_from(numbered).ok());
        numbered.or_else(|| Self::try_from(declaration).ok()).unwrap_or_else(|| self.clone())
    }
}

/// With numbered groups or columns; `None` where a pattern is such that its groups are not found.
fn numbered(declaration: &Declaration) -> Option<Declaration> {
    let mut kept = declaration.clone();
    let renamed = match &mut kept.format {
        Format::Csv(csv) => csv.columns.as_deref_mut().map(number_columns).unwrap_or_default(),
        Format::Regex(regex) => {
            let (pattern, renamed) = number_groups(&regex.pattern)?;
            regex.pattern = pattern;
            renamed
        }
        // Its names are keys of the objects.
        Format::Json(_) => return Some(kept),
    };
    let mut value = serde_json::to_value(&kept).ok()?;
    rename_sources(&mut value, &renamed);
    serde_json::from_value(value).ok()
}

fn number_columns(columns: &mut [String]) -> Renamed {
    let mut renamed = Renamed::new();
    for (at, column) in columns.iter_mut().enumerate() {
        let name = format!("column_{}", at + 1);
        // Of columns that nobody reads several may be called the same.
        renamed.entry(std::mem::replace(column, name.clone())).or_insert(name);
    }
    renamed
}

/// A pattern with numbered groups, and what they were called.
fn number_groups(pattern: &str) -> Option<(String, Renamed)> {
    let (mut numbered, mut renamed, mut rest, mut brackets) = (String::new(), Renamed::new(), pattern, 0usize);
    while let Some(c) = rest.chars().next() {
        // Within brackets, and escaped, it is a character like any other.
        let group = GROUPS.into_iter().filter(|_| brackets == 0).find_map(|begin| Some((begin, rest.strip_prefix(begin)?)));
        if let Some((begin, (name, after))) = group.and_then(|(begin, after)| Some((begin, after.split_once('>')?))) {
            let number = format!("value_{}", renamed.len() + 1);
            numbered.push_str(begin);
            numbered.push_str(&number);
            numbered.push('>');
            renamed.insert(name.to_owned(), number);
            rest = after;
            continue;
        }
        let escaped = if c == '\\' { rest[1..].chars().next().map_or(0, char::len_utf8) } else { 0 };
        match c {
            '[' => brackets += 1,
            ']' => brackets = brackets.saturating_sub(1),
            _ => {}
        }
        let (taken, after) = rest.split_at(c.len_utf8() + escaped);
        numbered.push_str(taken);
        rest = after;
    }
    let names = |pattern: &str| Some(Regex::new(pattern).ok()?.capture_names().flatten().map(str::to_owned).collect::<Vec<_>>());
    let expected: Vec<String> = names(pattern)?.iter().filter_map(|name| renamed.get(name).cloned()).collect();
    (expected.len() == renamed.len() && names(&numbered)? == expected).then_some((numbered, renamed))
}

/// In each source of a declaration.
fn rename_sources(value: &mut Value, renamed: &Renamed) {
    match value {
        Value::Array(values) => values.iter_mut().for_each(|value| rename_sources(value, renamed)),
        Value::Object(fields) => {
            for (key, value) in fields {
                match value {
                    Value::String(from) if key == "from" => {
                        if let Some(name) = renamed.get(from.as_str()) {
                            from.clone_from(name);
                        }
                    }
                    other => rename_sources(other, renamed),
                }
            }
        }
        Value::Null | Value::Bool(_) | Value::Number(_) | Value::String(_) => {}
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn groups_are_numbered_wherever_they_stand_and_nothing_else_is() {
        let (numbered, renamed) = number_groups(r"\(?<Quax>\d+ [(?<x>]+ (?P<welk>ON|(?<off>-)) \\(?<end>.)").unwrap_or_default();
        assert_eq!(numbered, r"\(?<Quax>\d+ [(?<x>]+ (?P<value_1>ON|(?<value_2>-)) \\(?<value_3>.)");
        assert_eq!(renamed.keys().collect::<Vec<_>>(), ["end", "off", "welk"]);
        assert!(number_groups("(?<t>").is_none(), "no pattern");
    }
}
