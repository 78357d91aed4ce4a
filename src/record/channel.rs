//! Which schema and encoding a message has.

use std::borrow::Cow;

use foxglove::Encode;
use foxglove::messages as fg;

/// Schema and encoding of the messages of one topic.
#[derive(Clone, Debug, PartialEq, Eq, Hash)]
pub(super) struct Kind {
    pub schema_name: String,
    pub schema_encoding: Cow<'static, str>,
    pub schema_data: Cow<'static, [u8]>,
    pub message_encoding: Cow<'static, str>,
}

/// Schema name of raw serial bytes.
pub(super) const RAW_SCHEMA: &str = "sidecarm.RawBytes";

/// The layout of raw serial bytes, kept in the log for whoever reads it without this program.
const RAW_LAYOUT: &str = "u32 epoch, little-endian: counts the openings of the serial line, starting at 0\n\
    then, up to the end of the message: the bytes of one read, as they arrived\n\
    log time: host arrival time; wire format: COBS frames, see mocks/PROTOCOL.md of the program\n";

impl Kind {
    /// One of Foxglove's own messages.
    pub(super) fn foxglove<M: Encode>() -> Self {
        let (schema_name, schema_data) = M::get_schema().map(|schema| (schema.name, schema.data)).unwrap_or_default();
        Self { schema_name, schema_encoding: "protobuf".into(), schema_data, message_encoding: "protobuf".into() }
    }

    /// Any JSON object; the schema says no more than that.
    pub(super) fn json(topic: &str) -> Self {
        let name = topic.trim_matches('/').replace('/', "_");
        let schema = serde_json::json!({
            "$schema": "https://json-schema.org/draft/2020-12/schema",
            "title": name,
            "type": "object",
            "additionalProperties": true,
        });
        Self {
            schema_name: format!("sidecarm.{name}"),
            schema_encoding: "jsonschema".into(),
            schema_data: schema.to_string().into_bytes().into(),
            message_encoding: "json".into(),
        }
    }

    /// Raw serial bytes.
    pub(super) fn raw() -> Self {
        Self {
            schema_name: RAW_SCHEMA.into(),
            schema_encoding: "x-text".into(),
            schema_data: RAW_LAYOUT.as_bytes().into(),
            message_encoding: "x-sidecarm-raw".into(),
        }
    }

    /// The topics that every log announces in its first chunk, so that later chunks can be read without each other.
    pub(super) fn announced() -> Vec<(&'static str, Self)> {
        use super::topic as t;
        let mut kinds = vec![(t::CARM_RAW, Self::raw()), (t::ROBOT_RAW, Self::raw())];
        let json = [t::PROVENANCE, t::CARM_JOINTS, t::ROBOT_JOINTS, t::FRAME_TAGS, t::POSE, t::PLAN, t::SCORES];
        kinds.extend(json.map(|topic| (topic, Self::json(topic))));
        kinds.push((t::FRAME_PIXELS, Self::foxglove::<fg::RawImage>()));
        kinds.push((t::DRR, Self::foxglove::<fg::RawImage>()));
        kinds.push((t::SHOWN, Self::foxglove::<fg::RawImage>()));
        kinds.push((t::CALIBRATION, Self::foxglove::<fg::CameraCalibration>()));
        kinds.push((t::TRANSFORMS, Self::foxglove::<fg::FrameTransforms>()));
        for topic in [t::CARM_TRANSFORMS, t::ROBOT_TRANSFORMS] {
            kinds.push((topic, Self::foxglove::<fg::FrameTransforms>()));
        }
        for topic in [t::CARM_JOINT_STATES, t::ROBOT_JOINT_STATES] {
            kinds.push((topic, Self::foxglove::<fg::JointStates>()));
        }
        kinds.push((t::ANNOTATIONS, Self::foxglove::<fg::ImageAnnotations>()));
        kinds.push((t::EVENTS, Self::foxglove::<fg::Log>()));
        kinds
    }
}
