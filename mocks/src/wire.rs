//! The encoder of `mocks/PROTOCOL.md`: messages to framed bytes.

/// Protocol version of every packet.
pub const VERSION: u8 = 1;
/// CRC-32C of the schema text of `PROTOCOL.md`; it seeds every packet's CRC.
pub const SCHEMA_HASH: u32 = 0x9A57_EB41;
/// Flag bits of the robot message.
pub const ROBOT_SENSED: u16 = 1;
/// See [`ROBOT_SENSED`].
pub const ROBOT_TRACKED: u16 = 2;
/// Flag bit of the C-arm message.
pub const XRAY_ON: u16 = 1;
/// Exposure counter of an arm that has none.
pub const NO_COUNTER: u32 = u32::MAX;

/// Header fields that the caller chooses.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Stamp {
    /// Counts every packet of the device.
    pub sequence: u32,
    /// Device clock.
    pub device_us: u64,
}

/// Position mm, velocity mm/s, tension N, current A.
pub type Tendon = [f32; 4];

/// Message 1.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct RobotMessage {
    /// Control-point angles asked for, degrees.
    pub commanded_deg: [f32; 5],
    /// Control-point angles measured, if they are.
    pub sensed_deg: Option<[f32; 5]>,
    /// The two tendons.
    pub tendons: [Tendon; 2],
    /// Translation (mm) and quaternion (x y z w) of the base in the tracker, if tracked.
    pub tracker_from_base: Option<([f64; 3], [f64; 4])>,
    /// Drill speed.
    pub drill_rpm: f32,
    /// Status bits.
    pub status: u32,
}

impl RobotMessage {
    /// Nothing is measured.
    pub const UNMEASURED: Self = Self {
        commanded_deg: [f32::NAN; 5],
        sensed_deg: None,
        tendons: [[f32::NAN; 4]; 2],
        tracker_from_base: None,
        drill_rpm: f32::NAN,
        status: 0,
    };
}

/// Message 2; NaN joints are not measured.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct CarmMessage {
    /// Lift, wig-wag, longitudinal, angulation, orbital, detector rotation, source to detector; mm and degrees.
    pub joints: [f64; 7],
    /// Tube voltage.
    pub tube_kvp: f32,
    /// Tube current.
    pub tube_ma: f32,
    /// Pulse width.
    pub pulse_width_ms: f32,
    /// Added aluminium and copper.
    pub filter_mm: [f32; 2],
    /// Left, top, right, bottom at the detector.
    pub field_mm: [f32; 4],
    /// X-ray on.
    pub xray_on: bool,
    /// Exposure counter, or [`NO_COUNTER`].
    pub exposure_counter: u32,
    /// Status bits.
    pub status: u32,
}

impl CarmMessage {
    /// Nothing is measured, and there is no counter.
    pub const UNMEASURED: Self = Self {
        joints: [f64::NAN; 7],
        tube_kvp: f32::NAN,
        tube_ma: f32::NAN,
        pulse_width_ms: f32::NAN,
        filter_mm: [f32::NAN; 2],
        field_mm: [f32::NAN; 4],
        xray_on: false,
        exposure_counter: NO_COUNTER,
        status: 0,
    };
}

/// Message 3.
#[derive(Clone, Debug, PartialEq)]
pub struct MetadataMessage {
    /// 1 robot, 2 C-arm.
    pub kind: u8,
    /// Serial number, firmware, calibration id, units; each at most 255 bytes.
    pub texts: [String; 4],
    /// Minimum and maximum of each joint.
    pub limits: Vec<[f32; 2]>,
}

/// A framed robot packet.
#[must_use]
pub fn encode_robot(stamp: Stamp, message: &RobotMessage) -> Vec<u8> {
    let mut payload = Vec::with_capacity(136);
    put_f32(&mut payload, &message.commanded_deg);
    put_f32(&mut payload, &message.sensed_deg.unwrap_or([f32::NAN; 5]));
    message.tendons.iter().for_each(|tendon| put_f32(&mut payload, tendon));
    let (translation, quaternion) = message.tracker_from_base.unwrap_or(([f64::NAN; 3], [f64::NAN; 4]));
    put_f64(&mut payload, &translation);
    put_f64(&mut payload, &quaternion);
    put_f32(&mut payload, &[message.drill_rpm]);
    payload.extend(message.status.to_le_bytes());
    let sensed = if message.sensed_deg.is_some() { ROBOT_SENSED } else { 0 };
    let tracked = if message.tracker_from_base.is_some() { ROBOT_TRACKED } else { 0 };
    frame(1, sensed | tracked, stamp, &payload)
}

/// A framed C-arm packet.
#[must_use]
pub fn encode_carm(stamp: Stamp, message: &CarmMessage) -> Vec<u8> {
    let mut payload = Vec::with_capacity(100);
    put_f64(&mut payload, &message.joints);
    put_f32(&mut payload, &[message.tube_kvp, message.tube_ma, message.pulse_width_ms]);
    put_f32(&mut payload, &message.filter_mm);
    put_f32(&mut payload, &message.field_mm);
    payload.extend(message.exposure_counter.to_le_bytes());
    payload.extend(message.status.to_le_bytes());
    frame(2, if message.xray_on { XRAY_ON } else { 0 }, stamp, &payload)
}

/// A framed metadata packet.
#[must_use]
pub fn encode_metadata(stamp: Stamp, message: &MetadataMessage) -> Vec<u8> {
    let mut payload = vec![message.kind, message.limits.len() as u8, 0, 0];
    payload.extend(SCHEMA_HASH.to_le_bytes());
    for text in &message.texts {
        let bytes = &text.as_bytes()[..text.len().min(255)];
        payload.push(bytes.len() as u8);
        payload.extend(bytes);
    }
    message.limits.iter().for_each(|limits| put_f32(&mut payload, limits));
    frame(3, 0, stamp, &payload)
}

fn put_f32(out: &mut Vec<u8>, values: &[f32]) {
    values.iter().for_each(|value| out.extend(value.to_le_bytes()));
}

fn put_f64(out: &mut Vec<u8>, values: &[f64]) {
    values.iter().for_each(|value| out.extend(value.to_le_bytes()));
}

fn frame(message: u8, flags: u16, stamp: Stamp, payload: &[u8]) -> Vec<u8> {
    let mut packet = vec![VERSION, message];
    packet.extend(flags.to_le_bytes());
    packet.extend(stamp.sequence.to_le_bytes());
    packet.extend(stamp.device_us.to_le_bytes());
    packet.extend(payload);
    let mut seeded = SCHEMA_HASH.to_le_bytes().to_vec();
    seeded.extend(&packet);
    packet.extend(crc32c(&seeded).to_le_bytes());
    let mut encoded = cobs(&packet);
    encoded.push(0);
    encoded
}

/// CRC-32C (Castagnoli).
#[must_use]
pub fn crc32c(bytes: &[u8]) -> u32 {
    let step = |crc: u32, byte: &u8| {
        (0..8).fold(crc ^ u32::from(*byte), |crc, _| if crc & 1 == 1 { (crc >> 1) ^ 0x82F6_3B78 } else { crc >> 1 })
    };
    !bytes.iter().fold(u32::MAX, step)
}

/// Consistent overhead byte stuffing, without the delimiter.
fn cobs(bytes: &[u8]) -> Vec<u8> {
    let mut out = vec![0];
    let (mut code_at, mut code) = (0, 1u8);
    let mut close = |out: &mut Vec<u8>, code: &mut u8| {
        out[code_at] = *code;
        code_at = out.len();
        out.push(0);
        *code = 1;
    };
    for byte in bytes {
        if *byte == 0 {
            close(&mut out, &mut code);
        } else {
            out.push(*byte);
            code += 1;
            if code == 255 {
                close(&mut out, &mut code);
            }
        }
    }
    out[code_at] = code;
    out
}

#[cfg(test)]
pub(crate) mod tests {
    use super::*;

    /// What the protocol's golden frames and lines say.
    pub(crate) const ROBOT: (Stamp, RobotMessage) = (
        Stamp { sequence: 1234, device_us: 987_654_321 },
        RobotMessage {
            commanded_deg: [1.0, 2.0, 0.5, -1.0, 0.0],
            sensed_deg: Some([1.125, 2.25, 0.5, -1.25, 0.0625]),
            tendons: [[3.5, -0.25, 12.5, 0.75], [-3.5, 0.25, 9.5, 0.5]],
            tracker_from_base: Some(([100.5, -20.25, 1500.0], [0.0, 0.0, 0.6, 0.8])),
            drill_rpm: 8000.0,
            status: 0,
        },
    );
    pub(crate) const CARM: (Stamp, CarmMessage) = (
        Stamp { sequence: 77, device_us: 123_456_789_012 },
        CarmMessage {
            joints: [120.5, -3.25, 40.0, 12.5, -30.25, f64::NAN, 1020.0],
            tube_kvp: 74.0,
            tube_ma: 3.5,
            pulse_width_ms: 8.0,
            filter_mm: [4.5, 0.25],
            field_mm: [-120.0, -93.0, 120.0, 93.0],
            xray_on: true,
            exposure_counter: 17,
            status: 0,
        },
    );

    /// The frames that the reference senders are held against, beyond those of the protocol.
    #[test]
    fn the_senders_golden_frames_are_those_of_this_encoder() {
        let text = include_str!("../../senders/golden.txt");
        let golden = |name: &str| {
            let line = text.lines().find_map(|line| line.strip_prefix(name)?.strip_prefix(' ')).expect(name);
            (0..line.len() / 2).map(|i| u8::from_str_radix(&line[2 * i..2 * i + 2], 16).expect("hex")).collect::<Vec<u8>>()
        };
        for (nth, name) in ["robot", "carm", "metadata"].into_iter().enumerate() {
            assert_eq!(golden(name), self::golden(nth), "{name}");
        }
        let unmeasured = RobotMessage {
            commanded_deg: [0.0; 5],
            sensed_deg: None,
            tendons: [[f32::NAN; 4]; 2],
            tracker_from_base: None,
            drill_rpm: f32::NAN,
            status: 5,
        };
        assert_eq!(golden("robot_unmeasured"), encode_robot(Stamp { sequence: 0, device_us: 0 }, &unmeasured));
        let dark = CarmMessage {
            joints: [0.0; 7],
            tube_kvp: 0.0,
            tube_ma: 0.0,
            pulse_width_ms: 0.0,
            filter_mm: [0.0; 2],
            field_mm: [f32::NAN; 4],
            xray_on: false,
            exposure_counter: NO_COUNTER,
            status: 3,
        };
        assert_eq!(golden("carm_dark"), encode_carm(Stamp { sequence: u32::MAX, device_us: u64::MAX }, &dark));
        let texts = ["S".repeat(100), "f".repeat(100), "c".repeat(60), "mm,deg".to_owned()];
        let long = MetadataMessage { kind: 1, texts, limits: Vec::new() };
        assert_eq!(golden("metadata_long"), encode_metadata(Stamp { sequence: 7, device_us: 1 }, &long));
    }

    fn golden(nth: usize) -> Vec<u8> {
        let text = include_str!("../PROTOCOL.md");
        let section = text.split("## Golden frames").nth(1).expect("section");
        let hex = section.split("```").nth(2 * nth + 1).expect("block").trim();
        (0..hex.len() / 2).map(|i| u8::from_str_radix(&hex[2 * i..2 * i + 2], 16).expect("hex")).collect()
    }

    #[test]
    fn the_schema_hash_is_that_of_the_printed_schema() {
        let text = include_str!("../PROTOCOL.md");
        let schema = text.split("**Schema hash**").nth(1).and_then(|rest| rest.split("```").nth(1)).expect("schema block");
        assert_eq!(crc32c(schema.trim_start_matches('\n').as_bytes()), SCHEMA_HASH);
        assert_eq!(crc32c(b"123456789"), 0xE306_9283);
    }

    #[test]
    fn golden_frames_are_what_the_protocol_prints() {
        assert_eq!(encode_robot(ROBOT.0, &ROBOT.1), golden(0));
        assert_eq!(encode_carm(CARM.0, &CARM.1), golden(1));
        let metadata = MetadataMessage {
            kind: 2,
            texts: ["CARM-0042", "1.4.2", "carm-nominal", "mm,deg,kV,mA,ms"].map(str::to_owned),
            limits: vec![
                [0.0, 400.0],
                [-10.0, 10.0],
                [0.0, 200.0],
                [-190.0, 190.0],
                [-90.0, 90.0],
                [-180.0, 180.0],
                [900.0, 1200.0],
            ],
        };
        assert_eq!(encode_metadata(Stamp { sequence: 78, device_us: 123_456_800_000 }, &metadata), golden(2));
        assert_ne!(encode_metadata(Stamp { sequence: 79, device_us: 123_456_800_000 }, &metadata), golden(2), "control");
    }
}
