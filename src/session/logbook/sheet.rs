//! A table's file and its cells: what was not measured is empty.

use std::fs::File;
use std::io::BufWriter;
use std::path::{Path, PathBuf};

use super::LogbookError;
use crate::image::NewFile;

/// A file that appears under its name when it is whole.
pub(super) struct Table {
    new: NewFile,
    writer: csv::Writer<BufWriter<File>>,
    rows: u64,
}

impl Table {
    pub(super) fn create(path: &Path) -> Result<Self, LogbookError> {
        let (new, file) = NewFile::create(path).map_err(|source| failed(path, source))?;
        Ok(Self { new, writer: csv::Writer::from_writer(BufWriter::new(file)), rows: 0 })
    }

    pub(super) fn head(&mut self, columns: impl IntoIterator<Item = String>) -> Result<(), LogbookError> {
        let outcome = self.writer.write_record(columns.into_iter().collect::<Vec<_>>());
        outcome.map_err(|error| self.failed(error.into()))
    }

    pub(super) fn row(&mut self, cells: Vec<String>) -> Result<(), LogbookError> {
        self.rows += 1;
        self.writer.write_record(cells).map_err(|error| self.failed(error.into()))
    }

    fn failed(&self, source: std::io::Error) -> LogbookError {
        failed(self.new.path(), source)
    }

    pub(super) fn finish(mut self) -> Result<(PathBuf, u64), LogbookError> {
        self.writer.flush().map_err(|source| self.failed(source))?;
        let Self { new, writer, rows } = self;
        drop(writer);
        let path = new.path().to_owned();
        new.appear().map_err(|source| failed(&path, source))?;
        Ok((path, rows))
    }
}

fn failed(path: &Path, source: std::io::Error) -> LogbookError {
    let path = path.to_owned();
    match source.kind() {
        std::io::ErrorKind::AlreadyExists => LogbookError::TableExists { path },
        _ => LogbookError::Out { path, source },
    }
}

pub(super) fn number(value: f64) -> String {
    if value.is_finite() { value.to_string() } else { String::new() }
}

pub(super) fn or_empty<T: ToString>(value: Option<T>) -> String {
    value.map(|value| value.to_string()).unwrap_or_default()
}

/// A variant's name in files.
pub(super) fn word(value: &impl serde::Serialize) -> String {
    serde_json::to_value(value).ok().and_then(|value| value.as_str().map(str::to_owned)).unwrap_or_default()
}
