//! How warnings, notes and progress reach the person: on standard error, counted, never lost.

use std::collections::BTreeMap;
use std::io::IsTerminal;
use std::sync::{Arc, Mutex, PoisonError};

use crate::time::Stopwatch;

/// Counts warnings by kind and prints them; cheap to clone, every clone shares the counts.
#[derive(Clone, Debug)]
pub struct Reporter {
    state: Arc<Mutex<State>>,
    loud: bool,
    shows_progress: bool,
}

#[derive(Debug, Default)]
struct State {
    warnings: BTreeMap<String, Counted>,
    /// When a kind was printed last.
    printed: BTreeMap<String, Stopwatch>,
    bars: Option<indicatif::MultiProgress>,
}

/// How often a kind of warning occurred, and its latest words.
#[derive(Clone, Debug, PartialEq, Eq, serde::Serialize)]
pub struct Counted {
    /// Occurrences.
    pub count: u64,
    /// The latest message.
    pub latest: String,
}

/// After this many of one kind, further messages are counted, and no more than one in so long is printed.
const PRINTED_PER_KIND: u64 = 3;
const REMINDED_MS: f64 = 60e3;

impl Reporter {
    /// Prints to standard error.
    #[must_use]
    pub fn stderr() -> Self {
        Self { state: Arc::default(), loud: true, shows_progress: true }
    }

    /// Only counts: for tests and libraries.
    #[must_use]
    pub fn silent() -> Self {
        Self { state: Arc::default(), loud: false, shows_progress: false }
    }

    /// Only counts, and shows progress: for those who say in their own words what was counted.
    #[must_use]
    pub fn counting() -> Self {
        Self { state: Arc::default(), loud: false, shows_progress: true }
    }

    /// Something went less well than it should: counted under `kind`, the first few of a kind are printed.
    pub fn warn(&self, kind: &str, message: impl std::fmt::Display) {
        let message = message.to_string();
        let (count, reminds) = {
            let mut state = self.lock();
            let reminds = state.printed.get(kind).is_none_or(|printed| printed.ms() >= REMINDED_MS);
            let counted = state.warnings.entry(kind.to_owned()).or_insert(Counted { count: 0, latest: String::new() });
            counted.count += 1;
            counted.latest = printable(&message).into_owned();
            let count = counted.count;
            if count <= PRINTED_PER_KIND || reminds {
                state.printed.insert(kind.to_owned(), Stopwatch::start());
            }
            (count, reminds)
        };
        match count {
            ..=PRINTED_PER_KIND => self.print(&format!("warning: {message}")),
            _ if reminds => self.print(&format!("warning: {message} ({count} of '{kind}' so far)")),
            _ => {}
        }
        if count == PRINTED_PER_KIND {
            self.print(&format!("warning: further '{kind}' warnings are counted, and one a minute is printed"));
        }
    }

    /// Something worth knowing.
    pub fn note(&self, message: impl std::fmt::Display) {
        self.print(&message.to_string());
    }

    /// All warnings so far, by kind.
    #[must_use]
    pub fn warnings(&self) -> BTreeMap<String, Counted> {
        self.lock().warnings.clone()
    }

    /// A progress bar over `length` steps; invisible unless standard error is a terminal and the reporter shows any.
    #[must_use]
    pub fn progress(&self, label: &str, length: u64) -> Progress {
        if !(self.shows_progress && std::io::stderr().is_terminal()) {
            return Progress(indicatif::ProgressBar::hidden());
        }
        let bar = indicatif::ProgressBar::new(length);
        if let Ok(style) = indicatif::ProgressStyle::with_template("{msg} {wide_bar} {pos}/{len} {eta}") {
            bar.set_style(style);
        }
        bar.set_message(label.to_owned());
        let mut state = self.lock();
        Progress(state.bars.get_or_insert_default().add(bar))
    }

    fn print(&self, line: &str) {
        if !self.loud {
            return;
        }
        let line = &*printable(line);
        match &self.lock().bars {
            Some(bars) => {
                if bars.println(line).is_err() {
                    to_stderr(line);
                }
            }
            None => to_stderr(line),
        }
    }

    fn lock(&self) -> std::sync::MutexGuard<'_, State> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

/// Nobody may be there to read it, and a session does not end with its listener.
pub(crate) fn to_stderr(line: &str) {
    use std::io::Write;
    let _ = writeln!(std::io::stderr(), "{line}");
}

/// What a session came to, on standard output: where that is closed, the exit code says it all the same.
pub(crate) fn to_stdout(line: &str) {
    use std::io::Write;
    let _ = writeln!(std::io::stdout(), "{line}");
}

/// `text` with everything escaped that a terminal would obey instead of showing: control characters other than newline and tab, and marks
/// that reverse the direction of writing.
#[must_use]
pub fn printable(text: &str) -> std::borrow::Cow<'_, str> {
    let obeyed =
        |c: char| c.is_control() && c != '\n' && c != '\t' || matches!(c, '\u{202a}'..='\u{202e}' | '\u{2066}'..='\u{2069}');
    if !text.contains(obeyed) {
        return text.into();
    }
    let mut shown = String::with_capacity(text.len() + 8);
    for c in text.chars() {
        if obeyed(c) { shown.extend(c.escape_unicode()) } else { shown.push(c) }
    }
    shown.into()
}

/// A running progress bar; it disappears when dropped.
#[derive(Debug)]
pub struct Progress(indicatif::ProgressBar);

impl Progress {
    /// There are `steps` in all.
    pub fn lengthen(&self, steps: u64) {
        self.0.set_length(steps);
    }

    /// `steps` more are done.
    pub fn advance(&self, steps: u64) {
        self.0.inc(steps);
    }
}

impl Drop for Progress {
    fn drop(&mut self) {
        self.0.finish_and_clear();
    }
}

#[cfg(test)]
mod tests {
    use super::printable;

    #[test]
    fn nothing_that_a_terminal_obeys_is_printed() {
        assert_eq!(printable("a\u{1b}[31mb\u{7}\u{9b}c\u{202e}d\r"), "a\\u{1b}[31mb\\u{7}\\u{9b}c\\u{202e}d\\u{d}");
        assert_eq!(printable("two\nlines\tü"), "two\nlines\tü");
    }
}
