//! Questions to a person, and why there is no session file.

use std::io::{BufRead, Write};
use std::path::{Path, PathBuf};

use serde::de::DeserializeOwned;

use crate::foreign::read_small;
use crate::image::ImageFileError;
use crate::json::parse_json;

/// What stands for a thing that the lab does not have.
pub(super) const NONE: &str = "none";

/// Why there is no session file.
#[derive(Debug, thiserror::Error)]
pub enum SessionNewError {
    /// Nothing is overwritten.
    #[error("{}: is there already; name another session file, or edit it and run `sidecarm check`", path.display())]
    Exists {
        /// It.
        path: PathBuf,
    },
    /// An option that will not do.
    #[error("{option} {given}: {reason}")]
    Option {
        /// Which.
        option: &'static str,
        /// Its value.
        given: String,
        /// Why.
        reason: String,
    },
    /// Nobody answers.
    #[error("no answer to \"{question}\": give {option}")]
    Unanswered {
        /// What was asked.
        question: String,
        /// What says it without being asked.
        option: &'static str,
    },
    /// Writing.
    #[error(transparent)]
    File(#[from] ImageFileError),
    /// The terminal.
    #[error("the answers cannot be read ({0})")]
    Input(#[from] std::io::Error),
}

/// One thing to find out.
pub(super) struct Question<'a> {
    /// What says it without being asked.
    pub option: &'static str,
    /// Its value.
    pub given: &'a Option<String>,
    /// What is asked.
    pub words: &'a str,
    /// What an empty answer means.
    pub default: Option<&'a str>,
    /// Whether no answer at all means it as well.
    pub may_be_silent: bool,
}

/// Asks in the order of the answers that it gets.
pub(super) struct Asker<R, W> {
    /// Lines of a person.
    pub answers: R,
    /// Where questions stand.
    pub screen: W,
}

impl<R: BufRead, W: Write> Asker<R, W> {
    /// The first answer that `looked` takes; an option is the only answer.
    pub(super) fn ask<T>(
        &mut self,
        question: &Question<'_>,
        looked: &dyn Fn(&str) -> Result<T, String>,
    ) -> Result<T, SessionNewError> {
        let Question { option, given, words, default, may_be_silent } = *question;
        if let Some(given) = given {
            return looked(given).map_err(|reason| SessionNewError::Option { option, given: given.clone(), reason });
        }
        let shown = default.map_or_else(String::new, |default| format!(" [{default}]"));
        loop {
            write!(self.screen, "{words}{shown}: ")?;
            self.screen.flush()?;
            let mut line = String::new();
            if self.answers.read_line(&mut line)? == 0 && !may_be_silent {
                return Err(SessionNewError::Unanswered { question: words.to_owned(), option });
            }
            let answer = match (line.trim(), default) {
                ("", Some(default)) => default,
                (answer, _) => answer,
            };
            match looked(answer) {
                Ok(found) => return Ok(found),
                Err(reason) => writeln!(self.screen, "  {reason}")?,
            }
        }
    }
}

/// One of our JSON files, or what is wrong with it.
pub(super) fn read<T: DeserializeOwned>(path: &Path) -> Result<T, String> {
    let bytes = read_small(path).map_err(|error| format!("{}: {error}", path.display()))?;
    parse_json(&bytes).map_err(|fault| format!("{}: {fault}", path.display()))
}
