//! Words in a line that no sample rests on: a log that is given away does without them.

use super::adapter::{LineAdapter, Read};
use super::split::{Columns, text_of_line};

/// Shorter words name nobody.
const LEAST_WORD_BYTES: usize = 2;

/// What a line is made of that was to be ignored, …
const IGNORED: u8 = b'~';
/// … and how a declaration says that such lines are: no device prints them.
pub(super) const IGNORED_LINES: &str = "~+";

/// Takes words out of lines, in the order in which they came.
#[derive(Clone, Debug)]
pub struct LineBlanker {
    adapter: LineAdapter,
    header: Option<Columns>,
}

/// What a line says, as text.
#[derive(PartialEq)]
enum Said {
    Values(String),
    Header(Columns),
    Nothing,
    NoSample,
}

impl LineBlanker {
    /// For lines as declared.
    #[must_use]
    pub fn new(adapter: &LineAdapter) -> Self {
        Self { adapter: adapter.clone(), header: None }
    }

    /// A line without its end, as long as it was and saying the same, with other letters and digits for all that its sample does not rest on:
    /// columns that nobody reads, comments, lines that are none. Of a line that the declaration ignores nothing is left: by which words it does so
    /// is taken out of the declaration as well ([`LineAdapter::nameless`]).
    #[must_use]
    pub fn blanked(&mut self, line: &[u8]) -> Vec<u8> {
        if text_of_line(line).is_some_and(|text| self.adapter.is_ignored(text)) {
            return vec![IGNORED; line.len()];
        }
        let said = self.said(line);
        let mut kept = line.to_vec();
        let mut at = 0;
        while at < line.len() {
            let end = at + line[at..].iter().take_while(|byte| is_word(**byte)).count();
            if end - at >= LEAST_WORD_BYTES {
                let before = kept[at..end].to_vec();
                // The letter of an escape in a JSON string (`\n`, `\u00fc`) stays, where nothing is one without it.
                for from in [at, at + 1] {
                    kept[from..end].iter_mut().for_each(|byte| *byte = filler(*byte));
                    if self.said(&kept) == said {
                        break;
                    }
                    kept[at..end].copy_from_slice(&before);
                }
            }
            at = end.max(at + 1);
        }
        if let Said::Header(columns) = said {
            self.header = Some(columns);
        }
        kept
    }

    fn said(&self, line: &[u8]) -> Said {
        let Some(text) = text_of_line(line) else { return Said::NoSample };
        match self.adapter.read(text, self.header.as_ref()) {
            Ok(Read::Values(values)) => values.told().map_or(Said::NoSample, Said::Values),
            Ok(Read::Header(columns)) => Said::Header(columns),
            Ok(Read::Nothing) => Said::Nothing,
            Err(_) => Said::NoSample,
        }
    }
}

/// A hexadecimal digit, and none that a number must not begin with: what is JSON stays JSON.
fn filler(byte: u8) -> u8 {
    if byte.is_ascii_digit() { b'1' } else { b'a' }
}

fn is_word(byte: u8) -> bool {
    byte.is_ascii_alphanumeric() || byte >= 0x80 || byte == b'_'
}
