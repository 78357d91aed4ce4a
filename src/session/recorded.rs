//! What a log says came out of its session, by the numbers of its frames.

use std::collections::BTreeMap;
use std::path::Path;

use super::SessionError;
use super::against_log::PairDigest;
use super::as_recorded::AsRecorded;
use super::edit::EDIT_TOPIC;
use super::file::Setup;
use super::log::{DRR_HASH_TOPIC, ORDER_TOPIC, SCATTER_NETWORK, SETUP_TOPIC};
use crate::image::{Image, sha256_bytes};
use crate::record::{LogEntry, LogReader, Provenance, Tolerance, topic};
use crate::render::Plan;

/// Number of a frame, and how often it was posed before.
pub(super) type Development = (u32, u32);

/// See the module. Poses, plans and hashes are small; images stay in the log.
#[derive(Default)]
pub(super) struct Recorded {
    pub(super) setup: Option<Setup>,
    /// SHA-256 of the weights of the network that was asked for scatter.
    pub(super) network_sha256: Option<String>,
    pub(super) started_us: i64,
    /// Messages in the log.
    pub(super) messages: u64,
    pub(super) poses: BTreeMap<Development, Vec<u8>>,
    pub(super) plans: BTreeMap<Development, Plan>,
    /// Of the last DRR of each frame.
    pub(super) hashes: BTreeMap<u32, String>,
    /// The last word of the log on each pair.
    pub(super) scores: BTreeMap<u32, PairDigest>,
    /// The log says in which order frames were registered.
    pub(super) has_order: bool,
    /// How often that order names each frame.
    orders: BTreeMap<u32, usize>,
    /// Beads were edited.
    pub(super) has_edits: bool,
    pub(super) losses: Vec<String>,
    /// Frames by their label, for logs that know no numbers.
    labels: Vec<String>,
}

#[derive(serde::Deserialize)]
struct OfFrame {
    number: Option<u32>,
    /// Of logs without numbers: counts from 0.
    index: Option<u32>,
    frame: Option<String>,
    #[serde(default)]
    development: u32,
}

#[derive(serde::Deserialize)]
struct PlanRecord {
    plan: Plan,
}

#[derive(serde::Deserialize)]
struct HashRecord {
    sha256: String,
}

#[derive(serde::Deserialize)]
struct Label {
    name: String,
}

impl Recorded {
    /// Reads through `log` once.
    ///
    /// # Errors
    /// When the file cannot be read or is no log. What is damaged in it is in [`Recorded::losses`].
    pub(super) fn read(log: &Path) -> Result<Self, SessionError> {
        let mut found = Self::default();
        let mut tolerance = Tolerance::default();
        let mut reader = LogReader::open(log)?;
        let mut drr: Option<String> = None;
        let mut order = AsRecorded::default();
        for entry in reader.by_ref() {
            order.see(&entry);
            if found.messages == 0 {
                found.started_us = entry.host_us;
            }
            found.messages += 1;
            match &*entry.topic {
                topic::PROVENANCE if found.network_sha256.is_none() => {
                    let provenance: Option<Provenance> = tolerance.take(entry.json());
                    let sha256 = provenance.and_then(|found| found.details[SCATTER_NETWORK].as_str().map(str::to_owned));
                    found.network_sha256 = sha256;
                }
                SETUP_TOPIC if found.setup.is_none() => found.setup = tolerance.take(entry.json()),
                topic::FRAME_TAGS => {
                    let label: Option<Label> = tolerance.take(entry.json());
                    found.labels.push(label.map(|label| label.name).unwrap_or_default());
                }
                topic::POSE => {
                    let development = found.of(&entry, &mut tolerance, |found, number| found.poses.contains_key(&(number, 0)));
                    if let Some(development) = development {
                        found.poses.insert(development, entry.data);
                    }
                }
                topic::PLAN => {
                    let plan: Option<PlanRecord> = tolerance.take(entry.json());
                    let development = found.of(&entry, &mut tolerance, |found, number| found.plans.contains_key(&(number, 0)));
                    if let (Some(development), Some(record)) = (development, plan) {
                        found.plans.insert(development, record.plan);
                    }
                }
                topic::DRR => drr = tolerance.take(entry.image()).flatten().map(|image| sha256_of(&image)),
                topic::SCORES => {
                    let pair: Option<serde_json::Value> = tolerance.take(entry.json());
                    let number = pair.as_ref().and_then(|pair| pair.get("number")).and_then(serde_json::Value::as_u64);
                    if let (Some(number), Some(pair)) = (number.and_then(|number| u32::try_from(number).ok()), pair) {
                        found.scores.insert(number, PairDigest::of(&pair));
                    }
                }
                DRR_HASH_TOPIC => {
                    let hash: Option<HashRecord> = tolerance.take(entry.json());
                    let of = found.of(&entry, &mut tolerance, |found, number| found.hashes.contains_key(&number));
                    if let (Some((number, _)), Some(HashRecord { sha256 })) = (of, hash) {
                        match drr.take() {
                            Some(of_pixels) if of_pixels != sha256 => found
                                .losses
                                .push(format!("the DRR of frame {number} in the log is not the one that its own hash names")),
                            Some(_) => {}
                            None => {
                                found.losses.push(format!("the DRR of frame {number} is gone from the log; its hash is there"))
                            }
                        }
                        found.hashes.insert(number, sha256);
                    }
                }
                ORDER_TOPIC => {
                    found.has_order = true;
                    let of: Option<OfFrame> = tolerance.take(entry.json());
                    if let Some(number) = of.and_then(|of| of.number) {
                        *found.orders.entry(number).or_default() += 1;
                    }
                }
                EDIT_TOPIC => found.has_edits = true,
                _ => {}
            }
        }
        let damage = reader.losses().iter().map(ToString::to_string);
        found.losses.splice(0..0, damage);
        found.losses.extend(tolerance.losses());
        found.losses.extend(order.words().map(str::to_owned));
        Ok(found)
    }

    /// How often the session registered a frame: again, where its exposure became clear only later. Logs without an order say it with poses.
    pub(super) fn times_registered(&self, number: u32) -> usize {
        match self.has_order {
            true => self.orders.get(&number).copied().unwrap_or(0),
            false => self.poses.keys().filter(|(of, _)| *of == number).count(),
        }
    }

    /// Whether the session drew no DRR of this development, because the frame's next edit came first.
    pub(super) fn is_passed_over(&self, (number, development): Development) -> bool {
        let is_later = |(of, later): &Development| *of == number && *later > development;
        let is_drawn = |(of, _): &Development| *of == number;
        self.has_edits
            && !self.plans.contains_key(&(number, development))
            && self.poses.keys().any(is_later)
            && self.plans.keys().any(is_drawn)
    }

    /// Of which frame a message speaks; `is_known` says whether that frame has such a message already.
    fn of(&self, entry: &LogEntry, tolerance: &mut Tolerance, is_known: impl Fn(&Self, u32) -> bool) -> Option<Development> {
        let of: OfFrame = tolerance.take(entry.json())?;
        let number = of.number.or_else(|| of.index.map(|index| index.saturating_add(1))).or_else(|| {
            // A log without numbers: of several frames with this label, the first that has none yet.
            let label = of.frame?;
            let numbered = (1u32..).zip(&self.labels);
            numbered.filter(|(_, known)| **known == label).map(|(number, _)| number).find(|number| !is_known(self, *number))
        })?;
        Some((number, of.development))
    }
}

/// Of an image's pixels, little-endian f32, row by row.
pub(super) fn sha256_of(image: &Image<f32>) -> String {
    let bytes: Vec<u8> = image.pixels.iter().flat_map(|value| value.to_le_bytes()).collect();
    sha256_bytes(&bytes)
}

/// The DRRs of `wanted` in `log`, one after the other; of a frame that was posed again, the last one comes last.
pub(super) fn drrs_of(
    log: &Path,
    wanted: &dyn Fn(u32) -> bool,
    take: &mut dyn FnMut(u32, Image<f32>),
) -> Result<(), SessionError> {
    let mut labels = Recorded::default();
    let mut tolerance = Tolerance::default();
    let mut drr = None;
    for entry in LogReader::open(log)? {
        match &*entry.topic {
            topic::FRAME_TAGS => {
                let label: Option<Label> = tolerance.take(entry.json());
                labels.labels.push(label.map(|label| label.name).unwrap_or_default());
            }
            topic::DRR => drr = Some(entry),
            DRR_HASH_TOPIC => {
                let Some(drr) = drr.take() else { continue };
                let of = labels.of(&entry, &mut tolerance, |found, number| found.hashes.contains_key(&number));
                let Some((number, _)) = of else { continue };
                labels.hashes.insert(number, String::new());
                if wanted(number)
                    && let Some(Some(image)) = tolerance.take(drr.image())
                {
                    take(number, image);
                }
            }
            _ => {}
        }
    }
    Ok(())
}
