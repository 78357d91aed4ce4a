//! What a frame says about when it was taken, and what was concluded from it.

use serde::{Deserialize, Serialize};

use super::exposure::ExposureInterval;
use super::stated_length::{Length, length_of, stated_us};
use crate::acquire::FrameTags;
use crate::geometry::CarmJoints;

/// What one image says about when it was taken; made once, when its file has arrived.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct FrameEvidence {
    /// Number of arrival; the key.
    pub frame: u32,
    /// SHA-256 of the file: the same content again is no new frame, images of one content are one run.
    pub content: String,
    /// Index and count of the image within its file.
    pub image_of_file: [u32; 2],
    /// The exposure counter as the console wrote it, whatever it counts.
    pub counter: Option<u32>,
    /// Date and time by the console's clock, as if its zone were UTC: the estimated offset absorbs zone and error alike.
    pub console_us: Option<i64>,
    /// Last digit of that stamp.
    pub console_resolution_us: i64,
    /// Host time at which the file was complete; `None` if it was exported afterwards, so that its arrival says nothing.
    pub arrival_us: Option<i64>,
    /// Time from image to image of a run, where the file says it.
    pub frame_time_us: Option<i64>,
    /// How long after the first each image of the file was taken, where it says so of each.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub image_times_us: Vec<i64>,
    /// How long its header states that the exposure took, of a file with one image, which no fluoroscopy gave.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub stated_length_us: Option<i64>,
    /// By its tags it is the last image held of a beam: taken when that ended.
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    pub last_image: bool,
    /// The frame that was this image before its file was written on or anew.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub completes: Option<u32>,
}

impl FrameEvidence {
    /// From the kept tags of a frame.
    #[must_use]
    pub fn of(frame: u32, tags: &FrameTags, sha256: &str, image_of_file: [u32; 2], arrival_us: Option<i64>) -> Self {
        let last_image = image_of_file[1] <= 1 && shows_last_image(tags);
        Self {
            frame,
            content: sha256.to_owned(),
            image_of_file,
            counter: tags.exposure_counter,
            console_us: tags.acquired_local_us(),
            console_resolution_us: resolution_us(tags.acquired_time.as_deref().unwrap_or_default()),
            arrival_us,
            frame_time_us: tags.frame_time_ms.map(|ms| (ms * 1e3).round() as i64),
            image_times_us: tags.image_times_us(),
            // Of a run, and of fluoroscopy, it may be the time of the pulses.
            stated_length_us: stated_us(tags.exposure_ms).filter(|_| image_of_file[1] <= 1 && !last_image),
            last_image,
            completes: None,
        }
    }
}

/// Whether a single picture with these tags is the last image held of fluoroscopy: by its type, or by the dose.
fn shows_last_image(tags: &FrameTags) -> bool {
    // Sums and differences are made of many images, and a radiograph of its whole beam.
    const OF_ALL: [&str; 10] =
        ["ADDITION", "AVERAGE", "MEAN", "MAXIMUM", "MINIMUM", "SUBTRACTION", "SUBTRACTED", "DSA", "SPOT", "RADIOGRAPHY"];
    const HELD: [&str; 4] = ["LAST IMAGE HOLD", "LIH", "FLUOROSCOPY", "FLUORO"];
    let is_one_of = |terms: &[&str]| tags.image_type.iter().any(|term| terms.contains(&term.as_str()));
    !is_one_of(&OF_ALL) && (is_one_of(&HELD) || tags.radiation_setting.as_deref() == Some("SC"))
}

/// Weight of the last digit of `HHMMSS.FFFFFF`, of which any tail may be missing.
fn resolution_us(time: &str) -> i64 {
    match time.len() {
        0..4 => 3_600_000_000,
        4..6 => 60_000_000,
        6..8 => 1_000_000,
        length => 10i64.pow(6 - (length - 7).min(6) as u32),
    }
}

/// What tied a frame to its exposure.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum BindingHow {
    /// The exposure counter.
    Counter,
    /// Time: the console's stamp or the arrival.
    Time,
    /// Nothing: no pose from telemetry.
    #[default]
    None,
}

/// What a person should know of a binding before relying on its joints.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
#[serde(rename_all = "snake_case", tag = "flag")]
pub enum BindingFlag {
    /// A joint moved while the beam was on; mm or degrees.
    Moved {
        /// Which.
        joint: &'static str,
        /// By how much.
        moved: f64,
        /// From where on it matters.
        limit: f64,
    },
    /// The joints are interpolated over a gap of telemetry.
    TelemetryGap {
        /// Its length.
        gap_us: i64,
    },
    /// A joint moved while telemetry was silent around the frame's time; mm or degrees.
    MovedInGap {
        /// Which moved most.
        joint: &'static str,
        /// By how much.
        moved: f64,
        /// From where on it matters.
        limit: f64,
        /// For how long nothing was heard.
        gap_us: i64,
    },
    /// Beam on or beam off fell into a gap: the interval is as long as it can be.
    OpenEnds,
    /// Only the C-arm's counter tells of the exposure.
    Unseen {
        /// How long the time is in which it was, by telemetry, arrival and stamp.
        within_us: i64,
    },
    /// The frame came long after its exposure.
    Late {
        /// How long.
        by_us: i64,
    },
    /// One image of a run: its time lies within the exposure.
    Run {
        /// Which, from 0.
        image: u32,
        /// Of how many.
        count: u32,
    },
    /// The last image held of a long beam: its time is the beam's end, or when it came.
    LastImage {
        /// How long the beam was on.
        beam_us: i64,
    },
    /// The frame's header states another length of the exposure.
    OtherLength {
        /// By the header.
        stated_us: i64,
        /// How long the beam was on.
        beam_us: i64,
    },
    /// The same picture as an earlier frame, which has the exposure.
    Duplicate {
        /// That frame.
        of: u32,
    },
    /// Bound to no exposure because the one that all names has another frame: a console may store a processed picture beside the raw one.
    SecondPicture {
        /// That frame.
        of: u32,
    },
    /// The file was written on, or anew, after it was read; the whole picture, which has the exposure, came later.
    Unfinished {
        /// As that frame.
        replaced_by: u32,
    },
}

impl std::fmt::Display for BindingFlag {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self {
            Self::Moved { joint, moved, limit } => write!(f, "{joint} moved by {moved:.2} during the exposure (limit {limit})"),
            Self::TelemetryGap { gap_us } => write!(f, "joints are interpolated over {} without telemetry", seconds(*gap_us)),
            Self::MovedInGap { joint, moved, limit, gap_us } => write!(
                f,
                "{joint} moved by {moved:.2} while nothing was heard of the C-arm for {}: where it was is not known (limit {limit})",
                seconds(*gap_us)
            ),
            Self::OpenEnds => f.write_str("beam on or off fell into a gap of telemetry"),
            Self::Unseen { within_us } => {
                write!(f, "telemetry missed the exposure; only its counter tells of it, within {}", seconds(*within_us))
            }
            Self::Late { by_us } => write!(f, "came {} after its exposure", seconds(*by_us)),
            Self::Run { image, count } => write!(f, "image {} of {count} of one run", image + 1),
            Self::LastImage { beam_us } => {
                write!(
                    f,
                    "the last image held of a beam of {}: it is taken to be of the last pulses before it came",
                    seconds(*beam_us)
                )
            }
            Self::OtherLength { stated_us, beam_us } => write!(
                f,
                "its header states an exposure of {}, the beam was on for {}: unless it was pulsed, the picture may be of another exposure",
                seconds(*stated_us),
                seconds(*beam_us)
            ),
            Self::Duplicate { of } => write!(f, "the same picture as frame {of}, exported again"),
            Self::SecondPicture { of } => write!(f, "a second picture of the exposure that frame {of} has"),
            Self::Unfinished { replaced_by } => {
                write!(f, "the file was written on, or anew: frame {replaced_by} is the whole picture")
            }
        }
    }
}

/// A frame's exposure, or why there is none.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct Binding {
    /// The exposure; `None` unless exactly one qualifies.
    pub exposure: Option<ExposureInterval>,
    /// What tied them.
    pub how: BindingHow,
    /// What was found, in sentences, the decisive one last.
    pub evidence: Vec<String>,
    /// False while telemetry has not yet reached the frame's arrival: asking again soon may give another answer.
    pub settled: bool,
    /// Host time of this image: the middle of the exposure, the end of a long one for the last image held, its own place in it for one of a run.
    pub time_us: Option<i64>,
    /// What to know before relying on it.
    pub flags: Vec<BindingFlag>,
}

/// Joints that moved farther than this during an exposure are flagged: mm and degrees.
pub(super) const MOVED_LIMITS: [(&str, f64); 7] = [
    ("lift", 0.5),
    ("wig-wag", 0.2),
    ("longitudinal", 0.5),
    ("angulation", 0.2),
    ("orbital", 0.2),
    ("detector rotation", 0.2),
    ("source to detector", 0.5),
];
/// Joints from samples farther apart than this are flagged.
pub(super) const GAP_LIMIT_US: i64 = 200_000;
/// No radiograph takes so long: what is exposed for longer is fluoroscopy, and a picture of it may be of any moment.
pub const LONG_BEAM_US: i64 = 1_000_000;
/// The last image held is of pulses up to twice as long before the beam's end: consoles average a few.
const LAST_PULSES_US: i64 = 100_000;
/// A frame later than this is flagged.
const LATE_LIMIT_US: i64 = 10_000_000;

/// Host times between which `frame` was taken: those of its exposure. Where only a counter tells of that, it was before the frame arrived, and when
/// the console's `stamp` says, if that is known in host time.
pub(super) fn span_of(frame: &FrameEvidence, exposure: &ExposureInterval, stamp: Option<[i64; 2]>) -> [i64; 2] {
    let whole = [exposure.start_us, exposure.end_us];
    if exposure.samples > 0 {
        // What came while the beam was on shows nothing of what came after it.
        let over_us = exposure.end_us.saturating_sub(exposure.end_uncertainty_us as i64);
        let early_us = frame.arrival_us.filter(|arrival_us| (exposure.start_us..over_us).contains(arrival_us));
        return [whole[0], early_us.unwrap_or(whole[1])];
    }
    let narrowed = |[from_us, to_us]: [i64; 2], [low_us, high_us]: [i64; 2]| {
        let both = [from_us.max(low_us), to_us.min(high_us)];
        if both[0] <= both[1] { both } else { [from_us, to_us] }
    };
    let arrived = frame.arrival_us.map(|arrival_us| [i64::MIN, arrival_us]);
    arrived.into_iter().chain(stamp).fold(whole, narrowed)
}

/// What to know of `frame` bound to `exposure`, taken within `span_us`.
pub(super) fn flags_of(frame: &FrameEvidence, exposure: &ExposureInterval, span_us: [i64; 2]) -> Vec<BindingFlag> {
    let mut flags = Vec::new();
    for (i, (joint, limit)) in MOVED_LIMITS.into_iter().enumerate() {
        let range = exposure.joint_range[i];
        let moved = if is_angle(i) { range.to_degrees() } else { range };
        // A joint without an encoder is NaN here; that it moved is not known.
        if moved > limit {
            flags.push(BindingFlag::Moved { joint, moved, limit });
        }
    }
    if exposure.samples == 0 {
        flags.push(BindingFlag::Unseen { within_us: span_us[1].saturating_sub(span_us[0]) });
    } else if !(exposure.start_seen && exposure.end_seen) {
        flags.push(BindingFlag::OpenEnds);
    }
    if let Some(joints) = exposure.joints.as_ref().filter(|joints| joints.gap_us > GAP_LIMIT_US) {
        flags.push(BindingFlag::TelemetryGap { gap_us: joints.gap_us });
    }
    let late_us = frame.arrival_us.map(|arrival_us| arrival_us.saturating_sub(exposure.end_us));
    if let Some(by_us) = late_us.filter(|by_us| *by_us > LATE_LIMIT_US) {
        flags.push(BindingFlag::Late { by_us });
    }
    let [image, count] = frame.image_of_file;
    if count > 1 {
        flags.push(BindingFlag::Run { image, count });
    }
    flags.extend(long_beam_us(frame, exposure).map(|beam_us| BindingFlag::LastImage { beam_us }));
    let unlike_us = frame.stated_length_us.filter(|us| length_of(Some(*us), exposure) == Length::Unlike);
    let beam_us = exposure.end_us.saturating_sub(exposure.start_us);
    flags.extend(unlike_us.map(|stated_us| BindingFlag::OtherLength { stated_us, beam_us }));
    flags
}

/// How long the beam was on of which `frame` is the last image held; `None` where it is none, or where that makes no difference.
fn long_beam_us(frame: &FrameEvidence, exposure: &ExposureInterval) -> Option<i64> {
    let beam_us = exposure.end_us.saturating_sub(exposure.start_us);
    (frame.last_image && exposure.samples > 0 && beam_us >= LONG_BEAM_US).then_some(beam_us)
}

impl Binding {
    /// Whether it is of the last image held of a long beam.
    #[must_use]
    pub fn is_of_last_image(&self) -> bool {
        self.flags.iter().any(|flag| matches!(flag, BindingFlag::LastImage { .. }))
    }

    /// Until when telemetry must have come for what is asked of it: the middle of the exposure, or the last image held.
    #[must_use]
    pub fn asks_until_us(&self) -> Option<i64> {
        let exposure = self.exposure.as_ref()?;
        // From the count on, a beam may have been on for long.
        let mid_us = if exposure.samples == 0 { exposure.mid_us().saturating_add(LONG_BEAM_US / 2) } else { exposure.mid_us() };
        Some(self.time_us.filter(|_| self.is_of_last_image()).unwrap_or(mid_us))
    }

    /// The half length of the time that one image of a run, or the last image held, took, where it is that.
    #[must_use]
    pub fn half_image_us(&self) -> Option<i64> {
        if self.is_of_last_image() {
            return Some(LAST_PULSES_US);
        }
        let count =
            self.flags.iter().find_map(|flag| if let BindingFlag::Run { count, .. } = flag { Some(*count) } else { None })?;
        let exposure = self.exposure.as_ref()?;
        Some(exposure.end_us.saturating_sub(exposure.start_us).max(0) / (2 * i64::from(count.max(1))))
    }

    /// The same without word of motion that was in other images of the run, or before the last one held: `joints` are those while this one
    /// was taken.
    #[must_use]
    pub fn moved_within(mut self, joints: &[CarmJoints]) -> Self {
        self.flags.retain_mut(|flag| {
            let BindingFlag::Moved { joint, moved, limit } = flag else { return true };
            let own = MOVED_LIMITS.iter().position(|(name, _)| name == joint).map(|i| {
                let values = joints.iter().map(|joints| joints.to_array()[i]);
                let (low, high) = values.fold((f64::MAX, f64::MIN), |(low, high), value| (low.min(value), high.max(value)));
                if is_angle(i) { (high - low).to_degrees() } else { high - low }
            });
            // A joint that is not known may have moved as far as in all of the run.
            *moved = own.filter(|own| own.is_finite() && *own >= 0.0).unwrap_or(*moved);
            *moved > *limit
        });
        self
    }
}

/// Whether the joint in this place of [`MOVED_LIMITS`] turns.
pub(super) fn is_angle(i: usize) -> bool {
    matches!(i, 1 | 3 | 4 | 5)
}

/// Host time of `frame` within `span_us` of its exposure: the middle, the end for the last image held, or the image's share of the run.
pub(super) fn time_within(frame: &FrameEvidence, exposure: &ExposureInterval, [start_us, end_us]: [i64; 2]) -> i64 {
    if long_beam_us(frame, exposure).is_some() {
        // Stored while the beam was on, it shows nothing of what came after it.
        let end_us = frame.arrival_us.map_or(end_us, |arrival_us| end_us.min(arrival_us));
        return end_us.saturating_sub(LAST_PULSES_US).max(start_us);
    }
    let [image, count] = frame.image_of_file;
    let length_us = end_us.saturating_sub(start_us).max(0);
    if count <= 1 {
        return start_us.saturating_add(length_us / 2);
    }
    let even_us = length_us / i64::from(count);
    // The file's own pace, unless the run would not fit into the exposure with it.
    let step_us =
        frame.frame_time_us.filter(|step_us| *step_us > 0 && *step_us <= even_us.saturating_mul(5) / 4 + 1).unwrap_or(even_us);
    let at_us = step_us.saturating_mul(i64::from(image)).saturating_add(step_us / 2);
    start_us.saturating_add(at_us.clamp(0, length_us))
}

pub(super) fn seconds(us: i64) -> String {
    format!("{:.3} s", us as f64 * 1e-6)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// An arm that turns by ten degrees in the middle of a run of ten images.
    #[test]
    fn an_image_of_a_run_has_moved_only_where_it_did() {
        let moved = BindingFlag::Moved { joint: "orbital", moved: 10.0, limit: 0.2 };
        let binding = Binding { flags: vec![moved, BindingFlag::Run { image: 4, count: 10 }], ..Binding::default() };
        let at = |deg: f64| CarmJoints { orbital_rad: deg.to_radians(), ..CarmJoints::ZERO };
        let of = |degs: [f64; 3]| {
            let flags = binding.clone().moved_within(&degs.map(at)).flags;
            flags.iter().find_map(|flag| if let BindingFlag::Moved { moved, .. } = flag { Some(*moved) } else { None })
        };
        assert_eq!(of([3.0, 3.1, 3.05]), None);
        assert!(of([3.0, 5.0, 3.0]).is_some_and(|deg| (deg - 2.0).abs() < 1e-9), "there and back");
        assert_eq!(of([f64::NAN; 3]), Some(10.0), "an encoder that says nothing");
        assert_eq!(binding.half_image_us(), None, "of no exposure");
    }

    /// A last image held after four seconds of fluoroscopy was drawn with the robot of two seconds before.
    #[test]
    fn the_last_image_held_of_a_long_beam_is_of_its_end_and_a_radiograph_of_its_middle() {
        let time = |tags: &FrameTags, images: u32, beam_us: i64| {
            let (said, exposure) = (FrameEvidence::of(1, tags, "a", [0, images], None), ExposureInterval::seen_for(beam_us));
            let span_us = [exposure.start_us, exposure.end_us];
            let flags = flags_of(&said, &exposure, span_us);
            let is_held = flags.contains(&BindingFlag::LastImage { beam_us });
            (time_within(&said, &exposure, span_us) - exposure.start_us, is_held)
        };
        let tags = |image_type: &[&str], setting: Option<&str>| FrameTags {
            image_type: image_type.iter().map(|term| (*term).to_owned()).collect(),
            radiation_setting: setting.map(str::to_owned),
            ..FrameTags::default()
        };
        let mut held = 0;
        for of_beam in [
            tags(&["ORIGINAL", "PRIMARY"], Some("SC")),
            tags(&["DERIVED", "SECONDARY", "LAST IMAGE HOLD"], None),
            tags(&["FLUORO"], None),
        ] {
            assert_eq!(time(&of_beam, 1, 4_000_000), (3_900_000, true), "{of_beam:?}");
            assert_eq!(time(&of_beam, 1, 600_000), (300_000, false), "as short as a radiograph: {of_beam:?}");
            held += 1;
        }
        assert_eq!(held, 3);
        let mut others = 0;
        for of_beam in [
            tags(&["ORIGINAL", "PRIMARY"], None),
            tags(&["ORIGINAL", "PRIMARY"], Some("GR")),
            tags(&["DERIVED", "PRIMARY", "AVERAGE"], Some("SC")),
        ] {
            assert_eq!(time(&of_beam, 1, 4_000_000), (2_000_000, false), "{of_beam:?}");
            others += 1;
        }
        assert_eq!(others, 3);
        assert_eq!(time(&tags(&[], Some("SC")), 4, 4_000_000), (500_000, false), "the first of a run has its own place");
    }

    /// An arm that stands still while the last pulses are taken has not moved in the picture, whatever it did before.
    #[test]
    fn the_last_image_has_moved_only_where_it_was_taken() {
        let moved = BindingFlag::Moved { joint: "orbital", moved: 10.0, limit: 0.2 };
        let held = Binding { flags: vec![moved, BindingFlag::LastImage { beam_us: 4_000_000 }], ..Binding::default() };
        let plain = Binding { flags: vec![moved], ..Binding::default() };
        assert_eq!((held.half_image_us(), plain.half_image_us()), (Some(LAST_PULSES_US), None));
        let still = [CarmJoints::ZERO; 3];
        assert_eq!(held.moved_within(&still).flags, [BindingFlag::LastImage { beam_us: 4_000_000 }]);
    }

    #[test]
    fn a_stamp_is_as_fine_as_its_last_digit() {
        let cases =
            [("12", 3_600_000_000), ("1234", 60_000_000), ("123456", 1_000_000), ("123456.5", 100_000), ("123456.123456", 1)];
        for (time, expected) in cases {
            assert_eq!(resolution_us(time), expected, "{time}");
        }
    }
}
