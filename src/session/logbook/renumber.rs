//! Frames of a log that is joined behind another one get numbers that no frame before has, in every message that names them.

use serde_json::Value;

use super::super::edit::{EDIT_TOPIC, NOTE_TOPIC};
use super::super::log::{DISAGREES_TOPIC, DRR_HASH_TOPIC, ORDER_TOPIC};
use super::super::records::{CUT_TOPIC, RESTART_TOPIC, SEEN_TOPIC};
use crate::record::{LogEntry, RecordError, topic};

/// `entry` with `by` added to the number of every frame that it names. A plan keeps the index under which it was executed: by it its noise
/// was drawn, and is drawn again.
///
/// # Errors
/// When the message is not what its topic promises.
pub(super) fn renumbered(entry: &LogEntry, by: u32) -> Result<LogEntry, RecordError> {
    let change: fn(&mut Value, u32) = match &*entry.topic {
        topic::FRAME_TAGS => frame,
        SEEN_TOPIC => |value, by| frame(&mut value["frame"], by),
        ORDER_TOPIC | EDIT_TOPIC | NOTE_TOPIC | DISAGREES_TOPIC | DRR_HASH_TOPIC | topic::PLAN => {
            |value, by| add(value.get_mut("number"), by)
        }
        topic::POSE => pose,
        topic::SCORES => pair,
        CUT_TOPIC => |value, by| {
            for list in ["frames", "frames_of_the_tie"] {
                value[list].as_array_mut().into_iter().flatten().for_each(|number| add(Some(number), by));
            }
        },
        // Of a log that was joined before: this shift comes on top.
        RESTART_TOPIC => |value, by| add(value.get_mut("numbers_from"), by),
        topic::EVENTS => return entry.reworded(&|text| shifted(text, by)),
        _ => return Ok(entry.clone()),
    };
    let mut value: Value = entry.json()?;
    change(&mut value, by);
    let data = serde_json::to_vec(&value).map_err(|source| RecordError::Json { topic: entry.topic.to_string(), source })?;
    Ok(LogEntry { data, ..entry.clone() })
}

fn add(number: Option<&mut Value>, by: u32) {
    if let Some(number) = number
        && let Some(before) = number.as_u64()
    {
        *number = (before + u64::from(by)).into();
    }
}

fn frame(value: &mut Value, by: u32) {
    add(value.get_mut("number"), by);
    add(value.get_mut("completes"), by);
}

/// Its binding may name other frames: copies, second pictures, and pictures that were not finished.
fn pose(value: &mut Value, by: u32) {
    add(value.get_mut("number"), by);
    let Some(binding) = value.get_mut("binding") else { return };
    shift_texts(binding.get_mut("evidence"), by);
    for flag in binding.get_mut("flags").and_then(Value::as_array_mut).into_iter().flatten() {
        add(flag.get_mut("of"), by);
        add(flag.get_mut("replaced_by"), by);
    }
}

fn pair(value: &mut Value, by: u32) {
    add(value.get_mut("number"), by);
    for texts in ["reason", "binding_evidence", "flags"] {
        shift_texts(value.get_mut(texts), by);
    }
}

fn shift_texts(value: Option<&mut Value>, by: u32) {
    match value {
        Some(Value::String(text)) => *text = shifted(text, by),
        Some(Value::Array(texts)) => texts.iter_mut().for_each(|text| shift_texts(Some(text), by)),
        _ => {}
    }
}

/// A sentence with `by` added to the numbers of frames in it. "The frame 70" is not one of them: there a frame says a voltage.
fn shifted(text: &str, by: u32) -> String {
    const WORD: &str = "frame ";
    let (mut out, mut rest) = (String::with_capacity(text.len() + 4), text);
    while let Some(at) = rest.find(WORD) {
        let (before, after) = rest.split_at(at + WORD.len());
        let digits = after.bytes().take_while(u8::is_ascii_digit).count();
        let stands_alone = !before[..at].ends_with("the ") && !before[..at].ends_with(|c: char| c.is_alphanumeric());
        out.push_str(before);
        match after[..digits].parse::<u32>() {
            Ok(number) if stands_alone => out.push_str(&number.saturating_add(by).to_string()),
            _ => out.push_str(&after[..digits]),
        }
        rest = &after[digits..];
    }
    out + rest
}

#[cfg(test)]
mod tests {
    use serde_json::json;

    use super::*;
    use crate::timeline::{Binding, BindingFlag};

    fn shifted_json(topic: &str, value: &Value) -> Value {
        let data = serde_json::to_vec(value).expect("JSON");
        let (schema, encoding) = ("any".into(), "json".into());
        let entry = LogEntry { topic: topic.into(), schema, encoding, host_us: 7, sequence: 1, data };
        renumbered(&entry, 5).expect("sound").json().expect("JSON")
    }

    #[test]
    fn numbers_of_frames_are_shifted_and_no_other_numbers() {
        let cases = [
            ("DRR of frame 7", "DRR of frame 12"),
            ("frame 1 (run 3): exposure 4 has frame 2 already", "frame 6 (run 3): exposure 4 has frame 7 already"),
            ("telemetry says 80 kVp, the frame 70", "telemetry says 80 kVp, the frame 70"),
            ("each frame counts; subframe 3", "each frame counts; subframe 3"),
            ("", ""),
        ];
        for (text, expected) in cases {
            assert_eq!(shifted(text, 5), expected);
        }
    }

    /// A copy and a picture whose file was written on or anew name the frame that has the exposure.
    #[test]
    fn the_frames_that_a_binding_names_are_shifted_with_the_frame() {
        let binding = |[of, by]: [u32; 2]| Binding {
            evidence: vec![format!("the picture is that of frame {of}: a copy, not another exposure")],
            flags: vec![
                BindingFlag::Duplicate { of },
                BindingFlag::Unfinished { replaced_by: by },
                BindingFlag::SecondPicture { of },
                BindingFlag::Run { image: 1, count: 3 },
                BindingFlag::Late { by_us: 2 },
            ],
            ..Binding::default()
        };
        let pose = |number: u32, named| json!({"number": number, "development": 1, "frame": "f", "binding": binding(named)});
        assert_eq!(shifted_json(topic::POSE, &pose(4, [2, 3])), pose(9, [7, 8]));
    }

    #[test]
    fn every_message_that_names_a_frame_is_shifted() {
        let tags =
            |number: u32, completes: Option<u32>| json!({"number": number, "completes": completes, "image_of_file": [0, 1]});
        let one = |number: u32| json!({"number": number, "sha256": "ab", "development": 0, "plan": {"frame": 3}});
        let pair = |number: u32, of: u32| {
            let words = format!("the same picture as frame {of}, exported again");
            json!({"number": number, "frame": "f", "reason": words, "binding_evidence": [words], "flags": [words, "5 of 7 beads"]})
        };
        let cut = |frames: [u32; 2]| json!({"from_us": 1, "to_us": 2, "frames": frames, "frames_of_the_tie": frames});
        let cases = [
            (topic::FRAME_TAGS, tags(3, Some(2)), tags(8, Some(7))),
            (topic::FRAME_TAGS, tags(3, None), tags(8, None)),
            (
                SEEN_TOPIC,
                json!({"frame": tags(3, Some(2)), "picture": null}),
                json!({"frame": tags(8, Some(7)), "picture": null}),
            ),
            (ORDER_TOPIC, one(3), one(8)),
            (EDIT_TOPIC, one(3), one(8)),
            (NOTE_TOPIC, one(3), one(8)),
            (DISAGREES_TOPIC, one(3), one(8)),
            (DRR_HASH_TOPIC, one(3), one(8)),
            (topic::PLAN, one(3), one(8)),
            (topic::SCORES, pair(4, 2), pair(9, 7)),
            (CUT_TOPIC, cut([1, 2]), cut([6, 7])),
            (RESTART_TOPIC, json!({"numbers_from": 4}), json!({"numbers_from": 9})),
            ("/session/clock", json!({"host_us": 3, "number": 3}), json!({"host_us": 3, "number": 3})),
        ];
        for (topic, before, after) in cases {
            assert_eq!(shifted_json(topic, &before), after, "{topic}");
        }
    }
}
