//! Files of numbers: tables as CSV, and tensors (safetensors: the length of a header, 8 bytes little-endian, the header as JSON, values).

use std::io::Read;
use std::path::Path;

use serde_json::{Value, json};

use super::found::{Found, InfoError, object};
use crate::regular;

/// A header that is longer is none.
const LONGEST_HEADER: u64 = 100 << 20;
/// A text of a file's own that is longer is not shown.
const LONGEST_TEXT: usize = 200;

/// A table with a line of column names; where the last name ends in three dots, rows go on with more of that column.
pub(super) fn csv(path: &Path) -> Result<Found, InfoError> {
    let damaged = |detail: String| InfoError::Damaged { path: path.to_owned(), kind: "table", detail };
    let file = regular::open(path).map_err(|error| damaged(error.to_string()))?;
    let mut reader = csv::ReaderBuilder::new().comment(Some(b'#')).flexible(true).from_reader(file);
    let columns: Vec<String> = reader.headers().map_err(|error| damaged(error.to_string()))?.iter().map(str::to_owned).collect();
    if columns.iter().all(|column| column.trim().is_empty()) {
        return Err(damaged("no column has a name".to_owned()));
    }
    let goes_on = columns.last().is_some_and(|last| last.ends_with("..."));
    let mut rows = 0u64;
    for record in reader.records() {
        let record = record.map_err(|error| damaged(error.to_string()))?;
        let (found, expected) = (record.len(), columns.len());
        if found < expected || found > expected && !goes_on {
            let line = record.position().map_or(0, csv::Position::line);
            return Err(damaged(format!("line {line} has {found} cells, the line of names {expected}")));
        }
        rows += 1;
    }
    Ok(("table", object(json!({"format": "CSV", "rows": rows, "columns": columns})), Vec::new()))
}

/// The table of `sidecarm trade`, by its first line; `None` where it is none.
pub(super) fn trade(text: &str) -> Option<Found> {
    let (first, rows) = text.split_once('\n')?;
    let (seen, judged) = first.split_once("; error against the yardstick on ")?;
    let (size, adapter) = seen.split_once(" px on ")?;
    // Below the first line stand the names of the columns.
    let rows = rows.lines().skip(1).count();
    let facts = json!({"format": "text", "size": size, "adapter": adapter, "judged": judged, "rows": rows});
    Some(("trade", object(facts), Vec::new()))
}

/// Weights of a network, or what a training or a data set keeps.
pub(super) fn tensors(path: &Path) -> Result<Found, InfoError> {
    let io = |source| InfoError::Io { path: path.to_owned(), source };
    let damaged = |detail: &str| InfoError::Damaged { path: path.to_owned(), kind: "file of tensors", detail: detail.to_owned() };
    let mut file = regular::open(path).map_err(io)?;
    let bytes = file.metadata().map_err(io)?.len();
    let mut length = [0u8; 8];
    file.read_exact(&mut length).map_err(|_| damaged("it is shorter than the length of its header"))?;
    let length = u64::from_le_bytes(length);
    if length > LONGEST_HEADER.min(bytes.saturating_sub(8)) {
        return Err(damaged("its header is longer than the file"));
    }
    let mut header = Vec::new();
    file.take(length).read_to_end(&mut header).map_err(io)?;
    let Ok(Value::Object(mut header)) = serde_json::from_slice(&header) else {
        return Err(damaged("its header is no JSON object"));
    };
    let texts = header.remove("__metadata__").and_then(|texts| texts.as_object().cloned()).unwrap_or_default();
    let short = texts.into_iter().filter(|(_, text)| text.as_str().is_some_and(|text| text.len() <= LONGEST_TEXT));
    let end = |tensor: &Value| tensor["data_offsets"][1].as_u64().unwrap_or(u64::MAX);
    let needed = header.values().map(end).max().unwrap_or(0).saturating_add(8 + length);
    let losses = if needed > bytes { vec![format!("{bytes} bytes, the header tells of {needed}")] } else { Vec::new() };
    let values: u64 = header
        .values()
        .filter_map(|tensor| tensor["shape"].as_array())
        .map(|shape| shape.iter().filter_map(Value::as_u64).fold(1, u64::saturating_mul))
        .fold(0, u64::saturating_add);
    let listed: Vec<String> =
        header.iter().map(|(name, tensor)| format!("{name} {} {}", tensor["dtype"], tensor["shape"])).collect();
    let facts = json!({
        "format": "safetensors",
        "tensors": listed.len(),
        "values": values,
        "metadata": short.collect::<serde_json::Map<String, Value>>(),
        "list": listed.into_iter().map(|line| line.replace('"', "")).collect::<Vec<_>>(),
    });
    Ok(("tensors", object(facts), losses))
}
