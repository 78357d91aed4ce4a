//! What a replay makes again besides poses and images, against what the log says of it: the samples that its bytes decode to, and the
//! scores of each pair.

use std::collections::HashMap;
use std::hash::{DefaultHasher, Hash, Hasher};

use serde_json::Value;

use crate::record::{LogEntry, topic};
use crate::report::Pair;
use crate::telemetry::{DeviceKind, Sample};

/// Where a session says of which device a sample is.
pub(super) fn topic_of(device: DeviceKind, sample: &Sample) -> &'static str {
    match (device, sample) {
        (_, Sample::Metadata(_)) => METADATA_TOPIC,
        (DeviceKind::Carm, _) => topic::CARM_JOINTS,
        (DeviceKind::Robot, _) => topic::ROBOT_JOINTS,
    }
}

/// What devices say of themselves.
const METADATA_TOPIC: &str = "/devices/metadata";

/// Samples of the log against those that its bytes decode to, whatever stands between them. What agrees is forgotten at once, so memory does
/// not grow with the log.
#[derive(Debug, Default)]
pub(super) struct Samples {
    /// Of each sample by its hash: how often it was decoded, less how often the log says it.
    balance: HashMap<u64, i64>,
    /// The log holds samples at all.
    recorded: bool,
}

impl Samples {
    /// A sample was decoded from the bytes in the log.
    pub(super) fn decoded(&mut self, device: DeviceKind, host_us: i64, sample: &Sample) {
        self.weigh(topic_of(device, sample), host_us, &serde_json::to_vec(sample).unwrap_or_default(), 1);
    }

    /// The log says something; whether it is a sample.
    pub(super) fn says(&mut self, entry: &LogEntry) -> bool {
        let is_sample = matches!(&*entry.topic, topic::CARM_JOINTS | topic::ROBOT_JOINTS | METADATA_TOPIC);
        if is_sample {
            self.recorded = true;
            self.weigh(&entry.topic, entry.host_us, &entry.data, -1);
        }
        is_sample
    }

    fn weigh(&mut self, topic: &str, host_us: i64, data: &[u8], by: i64) {
        let mut hasher = DefaultHasher::new();
        (topic, host_us, data).hash(&mut hasher);
        let key = hasher.finish();
        let balance = self.balance.entry(key).or_insert(0);
        *balance += by;
        if *balance == 0 {
            self.balance.remove(&key);
        }
    }

    /// Samples in the log that its bytes do not give, and those that its bytes give and it does not say. A session that was cut short had
    /// decoded more than it had written.
    pub(super) fn different(&self, is_whole: bool) -> u64 {
        let said_only = self.balance.values().filter(|balance| **balance < 0).map(|balance| balance.unsigned_abs()).sum::<u64>();
        let given_only = self.balance.values().filter(|balance| **balance > 0).map(|balance| balance.unsigned_abs()).sum::<u64>();
        if is_whole && self.recorded { said_only.max(given_only) } else { said_only }
    }
}

/// What follows from pose, DRR and frame alone.
const FROM_IMAGES: [&str; 9] =
    ["scores", "scores_without_tone", "scores_tool", "masks", "tone", "air", "disagreements", "rms_px", "rms_mm"];
/// What follows from these and all other poses, unless the null was left out.
const WITH_NULL: [&str; 7] = ["null", "status", "binding", "pose_source", "time_us", "innovation", "tip"];

/// Whether the log's word on a pair is that of the replay, whose DRR and pose are the same. `once`: its frame was posed once in both.
pub(super) fn same_scores(then: &Value, now: &Pair, once: bool) -> bool {
    // Through text, so that both were rounded alike.
    let Ok(now) = serde_json::to_vec(now).and_then(|text| serde_json::from_slice::<Value>(&text)) else { return false };
    let same = |key: &&str| then.get(*key) == now.get(*key);
    let has_null = |pair: &Value| pair.get("null").and_then(Value::as_object).is_some_and(|null| !null.is_empty());
    let comparable = once && has_null(then) && has_null(&now) && then.get("null_plan") == now.get("null_plan");
    FROM_IMAGES.iter().all(same) && (!comparable || WITH_NULL.iter().all(same))
}
