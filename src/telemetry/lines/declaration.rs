//! What a file of `telemetry/` says of a device's lines, as typed. Every key, with its unit: `docs/robot-lines.md`.

use serde::{Deserialize, Serialize};

/// Lines of a device that does not speak the packets of `mocks/PROTOCOL.md`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Declaration {
    /// Who says that the lines are so: a manual, a maker, whoever measured it, and when.
    pub origin: String,
    /// How a line falls into named values.
    pub format: Format,
    /// Regular expressions of whole lines that mean nothing: banners, comments, debugging.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub ignore: Vec<String>,
    /// The device's clock; without it the host's time of arrival stands for it.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub device_time: Option<TimeSource>,
    /// Standard deviation of a line's arrival as the time of its measurement, where there is no device clock.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub host_time_sigma_ms: Option<f64>,
    /// How long after its measurement a line arrives on the average, where there is no device clock.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub host_time_delay_ms: Option<f64>,
    /// A number that counts the lines; without it what is lost on the way cannot be known.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub sequence: Option<SequenceSource>,
    /// What a robot's line says.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub robot: Option<Box<RobotFields>>,
    /// What a C-arm's line says.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub carm: Option<Box<CarmFields>>,
}

/// How a line falls into named values.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Format {
    /// Columns.
    Csv(CsvFormat),
    /// The named groups of a pattern that the whole line must match.
    Regex(RegexFormat),
    /// One object a line; `from` is a path, its keys and indices separated by dots.
    Json(JsonFormat),
}

/// Columns.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct CsvFormat {
    /// One ASCII character, or `whitespace`: blanks and tabs, as many as there are.
    #[serde(default = "comma")]
    pub separator: String,
    /// Their names, in order; all of them.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub columns: Option<Vec<String>>,
    /// A line before the first one names them.
    #[serde(default, skip_serializing_if = "is_false")]
    pub header: bool,
    /// Lines that begin so mean nothing.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub comment: Option<String>,
    /// What stands before the decimals: `.` or `,`.
    #[serde(default = "point", skip_serializing_if = "is_point")]
    pub decimal: String,
}

/// A pattern.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct RegexFormat {
    /// With named groups, `(?<name>…)`; the whole line must match it.
    pub pattern: String,
}

/// One object a line.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct JsonFormat {}

/// A measured number: `sign · scale · read + offset`, in its unit; or one that stands still and that no line says.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Source {
    /// Column, group or path.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub from: Option<String>,
    /// In its place: the value itself, in `unit`.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub constant: Option<f64>,
    /// Unit of the result; none for what has none.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub unit: Option<String>,
    /// Units per count of what is read; positive.
    #[serde(skip_serializing_if = "is_one")]
    pub scale: f64,
    /// 1 or −1.
    #[serde(skip_serializing_if = "is_one")]
    pub sign: f64,
    /// Added at the end, in `unit`.
    #[serde(skip_serializing_if = "is_zero")]
    pub offset: f64,
    /// Smallest result that is believed, in `unit`.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub min: Option<f64>,
    /// Largest result that is believed, in `unit`.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub max: Option<f64>,
    /// An empty, absent or null value is one that was not measured; else the line is no sample.
    #[serde(skip_serializing_if = "is_false")]
    pub optional: bool,
}

impl Default for Source {
    fn default() -> Self {
        Self { from: None, constant: None, unit: None, scale: 1.0, sign: 1.0, offset: 0.0, min: None, max: None, optional: false }
    }
}

/// The device's clock.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct TimeSource {
    /// Column, group or path.
    pub from: String,
    /// `ns`, `us`, `ms` or `s`.
    pub unit: String,
    /// Where it begins anew at 0, in `unit`: 4294967296 for microseconds in 32 bits.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub wraps_at: Option<f64>,
}

/// A number that counts the lines, one up each.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct SequenceSource {
    /// Column, group or path.
    pub from: String,
    /// Where it begins anew at 0; 2³² when absent.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub wraps_at: Option<u64>,
}

/// Something that is or is not. A word of neither list makes the line no sample.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct FlagSource {
    /// Column, group or path.
    pub from: String,
    /// Words that say that it is.
    pub on: Vec<String>,
    /// Words that say that it is not.
    pub off: Vec<String>,
}

/// A whole number.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct CounterSource {
    /// Column, group or path.
    pub from: String,
    /// Words that say that there is none.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub none: Vec<String>,
}

/// What a robot's line says; at least one kind of angles.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct RobotFields {
    /// Five control angles asked for.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub commanded_angles: Option<[Source; 5]>,
    /// Five control angles measured.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub sensed_angles: Option<[Source; 5]>,
    /// Both tendons.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub tendons: Option<[TendonFields; 2]>,
    /// The tracked base.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub base: Option<BaseFields>,
    /// Speed of the drill.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub drill_speed: Option<Source>,
    /// A fault of the device.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub fault: Option<FlagSource>,
    /// Its emergency stop.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub emergency_stop: Option<FlagSource>,
    /// It is homing.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub homing: Option<FlagSource>,
}

/// A tendon.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct TendonFields {
    /// Pulled length.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub position: Option<Source>,
    /// Its rate.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub velocity: Option<Source>,
    /// Pull.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub tension: Option<Source>,
    /// Motor current.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub current: Option<Source>,
}

/// Where the base is; its rotation as a quaternion or as a rotation vector.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct BaseFields {
    /// Which of the two the line holds.
    pub holds: Direction,
    /// x, y, z.
    pub translation: [Source; 3],
    /// x, y, z, w; without unit.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub quaternion_xyzw: Option<[Source; 4]>,
    /// Axis times angle.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub rotation_vector: Option<[Source; 3]>,
    /// Whether the tracker sees it; always when absent.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub tracked: Option<FlagSource>,
}

/// Between base and tracker.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Direction {
    /// Points of the base to points of the tracker: the base's pose as the tracker has it.
    TrackerFromBase,
    /// The other way.
    BaseFromTracker,
}

/// What a C-arm's line says; at least one joint, or whether X-ray is on.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct CarmFields {
    /// Joint.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub lift: Option<Source>,
    /// Joint.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub wig_wag: Option<Source>,
    /// Joint.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub longitudinal: Option<Source>,
    /// Joint.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub angulation: Option<Source>,
    /// Joint.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub orbital: Option<Source>,
    /// Joint.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub detector_rotation: Option<Source>,
    /// Distance.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub source_to_detector: Option<Source>,
    /// kVp.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub tube_voltage: Option<Source>,
    /// Tube current.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub tube_current: Option<Source>,
    /// X-ray pulse.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub pulse_width: Option<Source>,
    /// Added filter.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub filter_aluminium: Option<Source>,
    /// Added filter.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub filter_copper: Option<Source>,
    /// Left, top, right, bottom of the field at the detector, from the panel's middle.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub field: Option<[Source; 4]>,
    /// Beam on; without it no exposure is known.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub xray_on: Option<FlagSource>,
    /// Counts exposures.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub exposure_counter: Option<CounterSource>,
    /// A fault of the device.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub fault: Option<FlagSource>,
    /// Its emergency stop.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub emergency_stop: Option<FlagSource>,
}

fn comma() -> String {
    ",".to_owned()
}

fn point() -> String {
    ".".to_owned()
}

fn is_point(text: &str) -> bool {
    text == "."
}

fn is_one(value: &f64) -> bool {
    *value == 1.0
}

fn is_zero(value: &f64) -> bool {
    *value == 0.0
}

fn is_false(value: &bool) -> bool {
    !value
}
