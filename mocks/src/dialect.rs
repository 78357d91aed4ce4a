//! Devices that print lines in place of packets, and the declarations by which a receiver reads them: "Lines in place of packets" of
//! `PROTOCOL.md`.

use serde_json::{Value, json};

use crate::lab::Device;
use crate::wire::{CarmMessage, NO_COUNTER, RobotMessage, Stamp};

/// How a device prints its lines.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Dialect {
    /// Values in columns, commas between them.
    Csv,
    /// An object a line.
    Json,
    /// `name=value`, blanks between them.
    Words,
}

/// Where the clocks of 32 bits begin anew.
const CLOCK_TURN: u64 = 1 << 32;
/// Where the robot's number of 16 bits does.
const NUMBER_TURN: u64 = 1 << 16;

const COMMANDED: [&str; 5] = ["c1", "c2", "c3", "c4", "c5"];
const SENSED: [&str; 5] = ["s1", "s2", "s3", "s4", "s5"];
const PULLED: [&str; 2] = ["pull1_um", "pull2_um"];
const FIELD: [&str; 4] = ["left_cm", "top_cm", "right_cm", "bottom_cm"];

/// A value of a line; no text where it is not measured.
struct Entry {
    name: &'static str,
    text: Option<String>,
    is_word: bool,
}

fn number(name: &'static str, value: f64, decimals: usize) -> Entry {
    Entry { name, text: value.is_finite().then(|| format!("{value:.decimals$}")), is_word: false }
}

fn count(name: &'static str, value: u64) -> Entry {
    Entry { name, text: Some(value.to_string()), is_word: false }
}

fn word(name: &'static str, text: &str) -> Entry {
    Entry { name, text: Some(text.to_owned()), is_word: true }
}

/// Angles commanded in hundredths of a degree and sensed in milliradians, tendons in micrometres, the drill in turns a second.
fn of_robot(stamp: Stamp, message: &RobotMessage) -> Vec<Entry> {
    let mut entries =
        vec![count("t_ms", stamp.device_us / 1000 % CLOCK_TURN), count("n", u64::from(stamp.sequence) % NUMBER_TURN)];
    let commanded = COMMANDED.into_iter().zip(message.commanded_deg);
    entries.extend(commanded.map(|(name, deg)| number(name, 100.0 * f64::from(deg), 1)));
    let sensed = SENSED.into_iter().zip(message.sensed_deg.unwrap_or([f32::NAN; 5]));
    entries.extend(sensed.map(|(name, deg)| number(name, 1e3 * f64::from(deg).to_radians(), 3)));
    let pulled = PULLED.into_iter().zip(message.tendons);
    entries.extend(pulled.map(|(name, tendon)| number(name, 1e3 * f64::from(tendon[0]), 0)));
    entries.push(number("drill_hz", f64::from(message.drill_rpm) / 60.0, 3));
    let state = match message.status {
        0 => "run",
        status if status & 2 != 0 => "stop",
        status if status & 4 != 0 => "home",
        _ => "fault",
    };
    entries.push(word("state", state));
    entries
}

/// The orbital angle the other way round and from 90 degrees, angulation in milliradians, lengths in what comes to hand.
fn of_carm(stamp: Stamp, message: &CarmMessage) -> Vec<Entry> {
    let [lift, wig_wag, longitudinal, angulation, orbital, rotation, source_to_detector] = message.joints;
    let [aluminium, copper] = message.filter_mm.map(f64::from);
    let mut entries = vec![
        count("t_us", stamp.device_us % CLOCK_TURN),
        count("n", u64::from(stamp.sequence)),
        number("orb", 90.0 - orbital, 4),
        number("ang_mrad", 1e3 * angulation.to_radians(), 3),
        number("wig", wig_wag, 4),
        number("rot", rotation, 4),
        number("lift_cm", lift / 10.0, 5),
        number("along", longitudinal, 4),
        number("sid_in", source_to_detector / 25.4, 6),
        number("kv", f64::from(message.tube_kvp), 2),
        number("ma", f64::from(message.tube_ma), 3),
        number("pulse_us", 1e3 * f64::from(message.pulse_width_ms), 1),
        number("al", aluminium, 3),
        number("cu_um", 1e3 * copper, 1),
    ];
    entries.extend(FIELD.into_iter().zip(message.field_mm).map(|(name, mm)| number(name, f64::from(mm) / 10.0, 4)));
    entries.push(word("x", if message.xray_on { "ON" } else { "OFF" }));
    let counter = if message.exposure_counter == NO_COUNTER { "-".to_owned() } else { message.exposure_counter.to_string() };
    entries.push(word("exp", &counter));
    let state = match message.status {
        0 => "ok",
        status if status & 2 != 0 => "stop",
        _ => "fault",
    };
    entries.push(word("state", state));
    entries
}

impl Dialect {
    /// All of them.
    pub const ALL: [Self; 3] = [Self::Csv, Self::Json, Self::Words];

    /// Its name on the command line.
    #[must_use]
    pub fn name(self) -> &'static str {
        match self {
            Self::Csv => "csv",
            Self::Json => "json",
            Self::Words => "words",
        }
    }

    /// A line of the robot, its end included.
    #[must_use]
    pub fn robot(self, stamp: Stamp, message: &RobotMessage) -> Vec<u8> {
        self.line(&of_robot(stamp, message))
    }

    /// A line of the C-arm, its end included.
    #[must_use]
    pub fn carm(self, stamp: Stamp, message: &CarmMessage) -> Vec<u8> {
        self.line(&of_carm(stamp, message))
    }

    fn line(self, entries: &[Entry]) -> Vec<u8> {
        let plain = |entry: &Entry| entry.text.clone().unwrap_or_default();
        let joined = |between: &str, part: &dyn Fn(&Entry) -> String| entries.iter().map(part).collect::<Vec<_>>().join(between);
        let line = match self {
            Self::Csv => joined(",", &plain),
            Self::Words => joined(" ", &|entry: &Entry| format!("{}={}", entry.name, plain(entry))),
            Self::Json => {
                let value = |entry: &Entry| match &entry.text {
                    None => "null".to_owned(),
                    Some(text) if entry.is_word => format!("\"{text}\""),
                    Some(text) => text.clone(),
                };
                format!("{{{}}}", joined(",", &|entry: &Entry| format!("\"{}\":{}", entry.name, value(entry))))
            }
        };
        (line + "\n").into_bytes()
    }

    /// What a receiver needs to read the lines of a device.
    #[must_use]
    pub fn declaration(self, device: Device) -> Value {
        let entries = match device {
            Device::Carm => of_carm(Stamp { sequence: 0, device_us: 0 }, &CarmMessage::UNMEASURED),
            Device::Robot => of_robot(Stamp { sequence: 0, device_us: 0 }, &RobotMessage::UNMEASURED),
        };
        let names: Vec<&str> = entries.iter().map(|entry| entry.name).collect();
        let format = match self {
            Self::Csv => json!({"csv": {"columns": names}}),
            Self::Json => json!({"json": {}}),
            Self::Words => {
                let groups: Vec<String> = names.iter().map(|name| format!("{name}=(?<{name}>\\S*)")).collect();
                json!({"regex": {"pattern": groups.join(" ")}})
            }
        };
        let (clock, unit, number) = match device {
            Device::Carm => ("t_us", "us", json!({"from": "n"})),
            Device::Robot => ("t_ms", "ms", json!({"from": "n", "wraps_at": NUMBER_TURN})),
        };
        let said = match device {
            Device::Carm => said_by_carm(),
            Device::Robot => said_by_robot(),
        };
        json!({
            "origin": "mock-lab: mocks/PROTOCOL.md, Lines in place of packets",
            "format": format,
            "device_time": {"from": clock, "unit": unit, "wraps_at": CLOCK_TURN},
            "sequence": number,
            device.name(): said
        })
    }
}

fn told(name: &str, unit: &str) -> Value {
    json!({"from": name, "unit": unit, "optional": true})
}

fn flag(name: &str, on: &str, off: &[&str]) -> Value {
    json!({"from": name, "on": [on], "off": off})
}

fn said_by_robot() -> Value {
    let commanded = COMMANDED.map(|name| json!({"from": name, "unit": "deg", "scale": 0.01, "optional": true}));
    json!({
        "commanded_angles": commanded,
        "sensed_angles": SENSED.map(|name| told(name, "mrad")),
        "tendons": PULLED.map(|name| json!({"position": told(name, "um")})),
        "drill_speed": told("drill_hz", "Hz"),
        "fault": flag("state", "fault", &["run", "stop", "home"]),
        "emergency_stop": flag("state", "stop", &["run", "fault", "home"]),
        "homing": flag("state", "home", &["run", "fault", "stop"])
    })
}

fn said_by_carm() -> Value {
    json!({
        "orbital": {"from": "orb", "unit": "deg", "sign": -1, "offset": 90, "optional": true},
        "angulation": told("ang_mrad", "mrad"),
        "wig_wag": told("wig", "deg"),
        "detector_rotation": told("rot", "deg"),
        "lift": told("lift_cm", "cm"),
        "longitudinal": told("along", "mm"),
        "source_to_detector": told("sid_in", "in"),
        "tube_voltage": told("kv", "kV"),
        "tube_current": told("ma", "mA"),
        "pulse_width": told("pulse_us", "us"),
        "filter_aluminium": told("al", "mm"),
        "filter_copper": told("cu_um", "um"),
        "field": FIELD.map(|name| told(name, "cm")),
        "xray_on": flag("x", "ON", &["OFF"]),
        "exposure_counter": {"from": "exp", "none": ["-"]},
        "fault": flag("state", "fault", &["ok", "stop"]),
        "emergency_stop": flag("state", "stop", &["ok", "fault"])
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::wire::tests::{CARM, ROBOT};

    /// The lines that the protocol prints of a device, in the order of [`Dialect::ALL`].
    fn printed(device: &str) -> Vec<String> {
        let text = include_str!("../PROTOCOL.md");
        let section = text.split("## Lines in place of packets").nth(1).expect("section");
        let block = section.split(device).nth(1).and_then(|rest| rest.split("```").nth(1)).expect("block");
        block.trim().lines().map(|line| format!("{line}\n")).collect()
    }

    #[test]
    fn lines_are_what_the_protocol_prints() {
        let (robot_stamp, robot) = ROBOT;
        let (carm_stamp, carm) = CARM;
        let text = |bytes: Vec<u8>| String::from_utf8(bytes).expect("text");
        assert_eq!(Dialect::ALL.map(|dialect| text(dialect.robot(robot_stamp, &robot))).to_vec(), printed("Robot:"));
        assert_eq!(Dialect::ALL.map(|dialect| text(dialect.carm(carm_stamp, &carm))).to_vec(), printed("C-arm:"));
        let other = RobotMessage { drill_rpm: 60.0, ..robot };
        assert_ne!(text(Dialect::Csv.robot(robot_stamp, &other)), printed("Robot:")[0], "control");
    }

    #[test]
    fn what_is_not_measured_has_no_text_and_a_state_is_a_word() {
        let robot = RobotMessage { status: 6, ..RobotMessage::UNMEASURED };
        let stamp = Stamp { sequence: u32::MAX, device_us: u64::MAX };
        let line = |dialect: Dialect| String::from_utf8(dialect.robot(stamp, &robot)).expect("text");
        assert!(line(Dialect::Csv).contains(",65535,,,,,,,,,,,,,,stop\n"), "{}", line(Dialect::Csv));
        assert!(line(Dialect::Words).contains(" s5= "), "{}", line(Dialect::Words));
        let object: Value = serde_json::from_str(&line(Dialect::Json)).expect("JSON");
        assert!(object["s1"].is_null() && object["state"] == "stop" && object["n"] == 65_535, "{object}");
        let dark = String::from_utf8(Dialect::Words.carm(stamp, &CarmMessage::UNMEASURED)).expect("text");
        assert!(dark.ends_with("x=OFF exp=- state=ok\n"), "{dark}");
    }
}
