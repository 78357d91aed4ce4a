//! Logs: topics, duration, provenance, losses.

use std::collections::BTreeMap;
use std::path::Path;

use serde_json::{Value, json};

use super::found::{Found, InfoError, object};
use crate::record::{LogReader, topic};

#[derive(Default)]
struct Topic {
    messages: u64,
    bytes: u64,
    schema: String,
}

pub(super) fn examine(path: &Path) -> Result<Found, InfoError> {
    let mut reader = LogReader::open(path)?;
    let mut topics: BTreeMap<String, Topic> = BTreeMap::new();
    let mut provenance = Value::Null;
    let mut span: Option<(i64, i64)> = None;
    for entry in reader.by_ref() {
        let topic = topics.entry(entry.topic.to_string()).or_default();
        topic.messages += 1;
        topic.bytes += entry.data.len() as u64;
        topic.schema = entry.schema.to_string();
        let (first, last) = span.unwrap_or((entry.host_us, entry.host_us));
        span = Some((first.min(entry.host_us), last.max(entry.host_us)));
        if &*entry.topic == topic::PROVENANCE && provenance.is_null() {
            provenance = entry.json()?;
        }
    }
    let losses: Vec<String> = reader.losses().iter().map(ToString::to_string).collect();
    let attachments: Vec<Value> = reader
        .attachments()
        .iter()
        .map(|file| json!({"name": file.name, "media_type": file.media_type, "bytes": file.data.len()}))
        .collect();
    let listed: serde_json::Map<String, Value> = topics
        .iter()
        .map(|(name, topic)| (name.clone(), json!({"messages": topic.messages, "bytes": topic.bytes, "schema": topic.schema})))
        .collect();
    let facts = json!({
        "messages": topics.values().map(|topic| topic.messages).sum::<u64>(),
        "start_us": span.map(|(first, _)| first),
        "duration_s": span.map(|(first, last)| (last - first) as f64 / 1e6),
        "topics": listed,
        "attachments": attachments,
        "provenance": provenance,
    });
    Ok(("log", object(facts), losses))
}
