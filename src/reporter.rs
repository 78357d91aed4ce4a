//! How warnings, notes and progress reach the person: on standard error, counted, never lost.

use std::collections::BTreeMap;
use std::io::IsTerminal;
use std::path::Path;
use std::sync::{Arc, Mutex, PoisonError};

use crate::time::Stopwatch;

/// Counts warnings by kind and prints them; cheap to clone, every clone shares the counts.
#[derive(Clone, Debug)]
pub struct Reporter {
    state: Arc<Mutex<State>>,
    loud: bool,
    shows_progress: bool,
    /// What is kept until [`Reporter::release`]; `None` inside where that has been.
    held: Option<Arc<Mutex<Option<Vec<Held>>>>>,
}

/// What is said later.
#[derive(Debug)]
enum Held {
    Warning { kind: String, message: String },
    Note(String),
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
        Self { state: Arc::default(), loud: true, shows_progress: true, held: None }
    }

    /// Only counts: for tests and libraries.
    #[must_use]
    pub fn silent() -> Self {
        Self { state: Arc::default(), loud: false, shows_progress: false, held: None }
    }

    /// Only counts, and shows progress: for those who say in their own words what was counted.
    #[must_use]
    pub fn counting() -> Self {
        Self { state: Arc::default(), loud: false, shows_progress: true, held: None }
    }

    /// The same, but warnings and notes are kept until [`Reporter::release`]: for what is said of files before it is known what they may be called.
    #[must_use]
    pub fn holding(&self) -> Self {
        Self { held: Some(Arc::new(Mutex::new(Some(Vec::new())))), ..self.clone() }
    }

    /// Says what was kept, in other words; nothing is kept from then on.
    pub fn release(&self, reword: impl Fn(&str) -> String) {
        let Some(held) = &self.held else { return };
        let said = held.lock().unwrap_or_else(PoisonError::into_inner).take();
        for said in said.into_iter().flatten() {
            match said {
                Held::Warning { kind, message } => self.warn(&kind, reword(&message)),
                Held::Note(message) => self.note(reword(&message)),
            }
        }
    }

    /// Whether it is kept for later.
    fn keeps(&self, said: impl FnOnce() -> Held) -> bool {
        let Some(held) = &self.held else { return false };
        let mut held = held.lock().unwrap_or_else(PoisonError::into_inner);
        match held.as_mut() {
            Some(held) => {
                held.push(said());
                true
            }
            None => false,
        }
    }

    /// Something went less well than it should: counted under `kind`, the first few of a kind are printed.
    pub fn warn(&self, kind: &str, message: impl std::fmt::Display) {
        let message = message.to_string();
        if self.keeps(|| Held::Warning { kind: kind.to_owned(), message: message.clone() }) {
            return;
        }
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

    /// What was warned of under `kind` has turned out well: printed, and from now on the latest message of its kind; it stays counted.
    pub fn mend(&self, kind: &str, message: impl std::fmt::Display) {
        let message = message.to_string();
        if let Some(counted) = self.lock().warnings.get_mut(kind) {
            counted.latest = printable(&message).into_owned();
        }
        self.print(&message);
    }

    /// Something worth knowing.
    pub fn note(&self, message: impl std::fmt::Display) {
        let message = message.to_string();
        if !self.keeps(|| Held::Note(message.clone())) {
            self.print(&message);
        }
    }

    /// Names the files that a command has made.
    pub fn wrote<P: AsRef<Path>>(&self, files: impl IntoIterator<Item = P>) {
        let files: Vec<String> = files.into_iter().map(|file| file.as_ref().display().to_string()).collect();
        if !files.is_empty() {
            self.note(format!("wrote {}", files.join(", ")));
        }
    }

    /// How far something long is, which names no file: said at once, whatever is held.
    pub fn announce(&self, message: impl std::fmt::Display) {
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
    // In one write: where both outputs are one file, a line of the other may come between two.
    let _ = std::io::stderr().write_all(format!("{line}\n").as_bytes());
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

    /// Whether a person sees it: then nobody needs to be told in lines how far it has come.
    #[must_use]
    pub fn is_shown(&self) -> bool {
        !self.0.is_hidden()
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
    use super::{Counted, Reporter, printable};

    #[test]
    fn what_is_held_is_said_in_other_words_once_it_is_released() {
        let reporter = Reporter::silent();
        let held = reporter.holding();
        held.warn("not HU", "/home/somebody/ct.nii.gz: 8 bits?");
        held.warn("not HU", "/home/somebody/ct.nii.gz: densities?");
        assert!(reporter.warnings().is_empty());
        held.release(|words| words.replace("/home/somebody/", ""));
        let said = Counted { count: 2, latest: "ct.nii.gz: densities?".to_owned() };
        assert_eq!(reporter.warnings().remove("not HU"), Some(said));
        held.warn("not HU", "at once");
        held.release(str::to_owned);
        assert_eq!(reporter.warnings()["not HU"].count, 3, "nothing is said twice, and nothing is held any more");
    }

    #[test]
    fn what_turned_out_well_is_the_latest_word_and_stays_counted() {
        let reporter = Reporter::silent();
        reporter.warn("unfinished frame", "f4: cut");
        reporter.mend("unfinished frame", "f4: completed");
        reporter.mend("of no such kind", "good news");
        let told = Counted { count: 1, latest: "f4: completed".to_owned() };
        assert_eq!(reporter.warnings().into_iter().collect::<Vec<_>>(), [("unfinished frame".to_owned(), told)]);
    }

    #[test]
    fn nothing_that_a_terminal_obeys_is_printed() {
        assert_eq!(printable("a\u{1b}[31mb\u{7}\u{9b}c\u{202e}d\r"), "a\\u{1b}[31mb\\u{7}\\u{9b}c\\u{202e}d\\u{d}");
        assert_eq!(printable("two\nlines\tü"), "two\nlines\tü");
    }
}
