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

/// The lines are read by a thread each: at the end of a log their samples may be out of order by as much.
const TAIL_US: i64 = 200_000;
/// What devices say of themselves.
pub(super) const METADATA_TOPIC: &str = "/devices/metadata";

/// Samples of the log against those that its bytes decode to, whatever stands between them. What agrees is forgotten at once, so memory does
/// not grow with the log.
#[derive(Debug, Default)]
pub(super) struct Samples {
    /// Of each sample by its hash: how often it was decoded, less how often the log says it; and its time.
    balance: HashMap<u64, (i64, i64)>,
    /// Time of the latest sample that the log says.
    last_said_us: Option<i64>,
    /// Of a log that was cut: bytes of other times are there, the samples that they gave are not.
    within_us: Option<[i64; 2]>,
    /// Of the logs that were joined before this one.
    different_before: u64,
}

impl Samples {
    /// The log was cut to this.
    pub(super) fn cut(&mut self, from_us: i64, to_us: i64) {
        self.within_us = Some([from_us, to_us]);
    }

    /// Another log begins, joined on to this one.
    pub(super) fn begin_anew(&mut self) {
        *self = Self { different_before: self.different(), ..Self::default() };
    }

    /// A sample was decoded from the bytes in the log.
    pub(super) fn decoded(&mut self, device: DeviceKind, host_us: i64, sample: &Sample) {
        if self.within_us.is_some_and(|[from_us, to_us]| host_us < from_us || host_us > to_us) {
            return;
        }
        self.weigh(topic_of(device, sample), host_us, &serde_json::to_vec(sample).unwrap_or_default(), 1);
    }

    /// The log says something; whether it is a sample.
    pub(super) fn says(&mut self, entry: &LogEntry) -> bool {
        let is_sample = matches!(&*entry.topic, topic::CARM_JOINTS | topic::ROBOT_JOINTS | METADATA_TOPIC);
        if is_sample {
            self.last_said_us = self.last_said_us.max(Some(entry.host_us));
            self.weigh(&entry.topic, entry.host_us, &entry.data, -1);
        }
        is_sample
    }

    fn weigh(&mut self, topic: &str, host_us: i64, data: &[u8], by: i64) {
        let mut hasher = DefaultHasher::new();
        (topic, host_us, data).hash(&mut hasher);
        let key = hasher.finish();
        let (balance, _) = self.balance.entry(key).or_insert((0, host_us));
        *balance += by;
        if *balance == 0 {
            self.balance.remove(&key);
        }
    }

    /// Samples in the log that its bytes do not give, or those that its bytes give and it does not say, whichever are more. A session that
    /// was cut short, or left at once, had more bytes than it had come to decode: its last samples do not count.
    pub(super) fn different(&self) -> u64 {
        let until_us = self.last_said_us.map_or(i64::MIN, |last_us| last_us.saturating_sub(TAIL_US));
        let (mut said_only, mut given_only) = (0, 0);
        for (balance, host_us) in self.balance.values() {
            match *balance {
                said if said < 0 => said_only += said.unsigned_abs(),
                given if *host_us < until_us => given_only += given.unsigned_abs(),
                _ => {}
            }
        }
        self.different_before + said_only.max(given_only)
    }
}

/// What follows from pose, DRR and frame alone.
const FROM_IMAGES: [&str; 10] =
    ["edited", "scores", "scores_without_tone", "scores_tool", "masks", "tone", "air", "disagreements", "rms_px", "rms_mm"];
/// What follows from these and all other poses, unless the null was left out.
const WITH_NULL: [&str; 7] = ["null", "status", "binding", "pose_source", "time_us", "innovation", "tip"];

/// What a pair says, in little: a log may hold thousands.
#[derive(Clone, Copy, Debug)]
pub(super) struct PairDigest {
    from_images: u64,
    with_null: u64,
    /// Of how the null was made; `None` where there is no null.
    null_plan: Option<u64>,
}

impl PairDigest {
    /// Of a pair as the log has it.
    pub(super) fn of(pair: &Value) -> Self {
        let digest = |keys: &[&str]| {
            let mut hasher = DefaultHasher::new();
            keys.iter().for_each(|key| pair.get(*key).map(Value::to_string).hash(&mut hasher));
            hasher.finish()
        };
        let has_null = pair.get("null").and_then(Value::as_object).is_some_and(|null| !null.is_empty());
        let null_plan = has_null.then(|| digest(&["null_plan"]));
        Self { from_images: digest(&FROM_IMAGES), with_null: digest(&WITH_NULL), null_plan }
    }

    /// Whether the replay, whose DRR and pose are the same, says the same. `once`: the frame was posed once in both.
    pub(super) fn agrees(&self, now: &Pair, once: bool) -> bool {
        // Through text, so that both were rounded alike.
        let now = serde_json::to_vec(now).and_then(|text| serde_json::from_slice::<Value>(&text));
        now.is_ok_and(|now| {
            let now = Self::of(&now);
            let comparable = once && self.null_plan.is_some() && self.null_plan == now.null_plan;
            self.from_images == now.from_images && (!comparable || self.with_null == now.with_null)
        })
    }
}
