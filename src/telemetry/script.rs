//! A byte source from memory: what a log holds of a line, or what a test makes up.

use std::collections::VecDeque;
use std::path::PathBuf;

use super::byte_source::{ByteSource, Closing, Heard};
use super::port_error::PortError;

/// Attempts to open, in their order, each with what is heard of it at once. One that does not end in [`Heard::Lost`] stays open, silent,
/// until it is closed; after the last attempt nothing is there.
#[derive(Clone, Debug)]
pub struct Script {
    attempts: VecDeque<Result<Vec<Heard>, PortError>>,
    heard: VecDeque<Heard>,
}

impl Script {
    /// See the type.
    #[must_use]
    pub fn new(attempts: impl IntoIterator<Item = Result<Vec<Heard>, PortError>>) -> Self {
        Self { attempts: attempts.into_iter().collect(), heard: VecDeque::new() }
    }
}

impl ByteSource for Script {
    const KEEPS_BYTES: bool = false;

    async fn open(&mut self) -> Result<PathBuf, PortError> {
        let path = PathBuf::from("script");
        let attempt = self.attempts.pop_front().unwrap_or_else(|| Err(PortError::NotFound { path: path.clone() }));
        self.heard = attempt?.into();
        Ok(path)
    }

    async fn next(&mut self, closing: &mut Closing) -> Heard {
        if let Some(heard) = self.heard.pop_front() {
            return heard;
        }
        closing.asked().await;
        Heard::Closed
    }
}
