//! Files of the session's folder that could not be written.

use std::collections::BTreeMap;
use std::fmt::Display;

/// By file, why the latest attempt failed; a file that is written after all is forgotten.
#[derive(Debug, Default)]
pub(super) struct Unwritten(BTreeMap<String, String>);

impl Unwritten {
    /// Takes how writing `file` went; a sentence when it failed.
    pub(super) fn note<E: Display>(&mut self, file: &str, written: Result<(), E>) -> Option<String> {
        match written {
            Ok(()) => {
                self.forget(file);
                None
            }
            Err(error) => {
                let sentence = format!("{file} is not written: {error}");
                self.0.insert(file.to_owned(), error.to_string());
                Some(sentence)
            }
        }
    }

    /// `file` is about to be written once more, by somebody who says so if it fails.
    pub(super) fn forget(&mut self, file: &str) {
        self.0.remove(file);
    }

    /// Whether the latest attempt at `file` failed.
    pub(super) fn holds(&self, file: &str) -> bool {
        self.0.contains_key(file)
    }

    /// All of them in a sentence; `None` where there are none. `again`: how they are had all the same.
    pub(super) fn sentence(&self, again: &str) -> Option<String> {
        let (file, reason) = self.0.iter().next_back()?;
        let others = match self.0.len() {
            1 => String::new(),
            count => format!(" and {} other files", count - 1),
        };
        Some(format!("{file}{others} could not be written ({reason}); {again}"))
    }
}
