//! One malformed message is one loss, and the rest of the log is read.

use std::collections::BTreeMap;

use super::RecordError;

/// Counts what could not be understood in a log.
#[derive(Clone, Debug, Default)]
pub struct Tolerance {
    /// Per topic: how many, and the first one's error.
    malformed: BTreeMap<String, (u64, String)>,
}

impl Tolerance {
    /// The value, or one loss more.
    pub fn take<T>(&mut self, outcome: Result<T, RecordError>) -> Option<T> {
        match outcome {
            Ok(value) => Some(value),
            Err(error) => {
                let topic = match &error {
                    RecordError::Message { topic, .. } | RecordError::Json { topic, .. } => topic.clone(),
                    _ => String::new(),
                };
                self.malformed.entry(topic).or_insert_with(|| (0, error.to_string())).0 += 1;
                None
            }
        }
    }

    /// Messages that could not be understood.
    #[must_use]
    pub fn count(&self) -> u64 {
        self.malformed.values().map(|(count, _)| count).sum()
    }

    /// A sentence for each topic that has malformed messages.
    #[must_use]
    pub fn losses(&self) -> Vec<String> {
        let sentence = |(count, first): &(u64, String)| match count {
            1 => format!("1 message is malformed and was skipped: {first}"),
            _ => format!("{count} messages are malformed and were skipped; the first: {first}"),
        };
        self.malformed.values().map(sentence).collect()
    }
}
