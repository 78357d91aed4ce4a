//! A declaration without the words of whoever wrote it: a log that is given away reads its lines as before.

use std::collections::BTreeMap;
use std::convert::Infallible;
use std::ops::Range;

use regex_syntax::ast::parse::Parser;
use regex_syntax::ast::{self, Ast, GroupKind};
use serde_json::Value;

use super::adapter::LineAdapter;
use super::blank::IGNORED_LINES;
use super::declaration::{Declaration, Format};

/// Names that the declaration gives, and what stands for each.
type Renamed = BTreeMap<String, String>;

impl LineAdapter {
    /// The same lines, as [`super::LineBlanker`] leaves them, said by nobody: without what was to be ignored, with numbers for the names of groups
    /// and of columns. What stands in the lines themselves stays: a pattern's own text, columns that a header names, keys of JSON, words of a flag
    /// and how comments begin.
    ///
    /// `None` where the words could not be taken out: it is not to be given away then.
    #[must_use]
    pub fn nameless(&self, origin: &str) -> Option<Self> {
        let mut declaration = Declaration { origin: origin.to_owned(), ..self.declaration().clone() };
        if !declaration.ignore.is_empty() {
            declaration.ignore = vec![IGNORED_LINES.to_owned()];
        }
        Self::try_from(numbered(&declaration)?).ok()
    }
}

/// With numbered groups or columns; `None` where a pattern is none.
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

/// A pattern with numbered groups, and what they were called; `None` where it is none.
fn number_groups(pattern: &str) -> Option<(String, Renamed)> {
    let mut groups = ast::visit(&Parser::new().parse(pattern).ok()?, Groups::default()).ok()?;
    groups.sort_unstable_by_key(|(place, _)| place.start);
    let (mut numbered, mut renamed, mut from) = (String::new(), Renamed::new(), 0);
    for (place, name) in groups {
        let number = format!("value_{}", renamed.len() + 1);
        numbered.push_str(pattern.get(from..place.start)?);
        numbered.push_str(&number);
        from = place.end;
        renamed.insert(name, number);
    }
    numbered.push_str(pattern.get(from..)?);
    Some((numbered, renamed))
}

/// Names of groups, and where they stand in the pattern.
#[derive(Default)]
struct Groups(Vec<(Range<usize>, String)>);

impl ast::Visitor for Groups {
    type Output = Vec<(Range<usize>, String)>;
    type Err = Infallible;

    fn finish(self) -> Result<Self::Output, Infallible> {
        Ok(self.0)
    }

    fn visit_pre(&mut self, node: &Ast) -> Result<(), Infallible> {
        if let Ast::Group(group) = node
            && let GroupKind::CaptureName { name, .. } = &group.kind
        {
            self.0.push((name.span.start.offset..name.span.end.offset, name.name.clone()));
        }
        Ok(())
    }
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
        // With blanks and comments in it, where brackets are none.
        let (numbered, _) = number_groups("(?x) (?<Quax>\\d+) # a [ bracket\n (?<welk>.)").unwrap_or_default();
        assert_eq!(numbered, "(?x) (?<value_1>\\d+) # a [ bracket\n (?<value_2>.)");
        assert!(number_groups("(?<t>").is_none(), "no pattern");
    }
}
