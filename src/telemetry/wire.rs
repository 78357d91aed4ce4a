//! The wire of `mocks/PROTOCOL.md`, version 1: from one stuffed frame to a [`Sample`].

use crc::{CRC_32_ISCSI, Crc};
use glam::{DQuat, DVec3};
use serde::Serialize;

use super::device::DeviceKind;
use super::sample::{CarmSample, Limit, Metadata, RobotSample, Sample, Tendon};
use crate::geometry::{CarmJoints, Rigid};

/// Protocol version that is read.
pub const VERSION: u8 = 1;
/// CRC-32C of the schema text; seeds every checksum, so that other firmware fails it.
pub const SCHEMA_HASH: u32 = 0x9A57_EB41;
/// Longest stuffed frame without its delimiter.
pub const MAX_ENCODED_BYTES: usize = 512;

pub(super) const HEADER_BYTES: usize = 16;
pub(super) const CRC_BYTES: usize = 4;
pub(super) const ROBOT: u8 = 1;
pub(super) const CARM: u8 = 2;
pub(super) const METADATA: u8 = 3;
pub(super) const NO_COUNTER: u32 = u32::MAX;
const CRC32C: Crc<u32> = Crc::<u32>::new(&CRC_32_ISCSI);
/// A tracked rotation may be off unit length by this much, as f64 on the wire never is.
const QUATERNION_LIMIT: f64 = 1e-3;

/// Why a frame is no sample.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, thiserror::Error)]
#[serde(rename_all = "snake_case", tag = "kind")]
pub enum FrameFault {
    /// The checksum disagrees.
    #[error("frame is corrupt: checksum {found_crc:#010x}, expected {expected_crc:#010x}")]
    Corrupt {
        /// Computed from the bytes.
        expected_crc: u32,
        /// At the end of the frame.
        found_crc: u32,
    },
    /// The byte stuffing is broken, or the frame is too short for a header.
    #[error("frame is corrupt: byte stuffing broken or cut ({bytes} bytes)")]
    Stuffing {
        /// Stuffed bytes.
        bytes: usize,
    },
    /// Intact, but by another schema: other firmware.
    #[error("frame follows schema {found:#010x}, this program reads {expected:#010x}")]
    SchemaMismatch {
        /// Ours.
        expected: u32,
        /// The device's.
        found: u32,
    },
    /// Intact, but of another protocol version.
    #[error("frame has protocol version {found}, this program reads {expected}")]
    VersionMismatch {
        /// Ours.
        expected: u8,
        /// The device's.
        found: u8,
    },
    /// Intact, but with a message id that is not known.
    #[error("message {id} is not known")]
    UnknownMessage {
        /// Message id.
        id: u8,
    },
    /// Intact, but its content is impossible.
    #[error("message {id} is malformed: {reason}")]
    Malformed {
        /// Message id.
        id: u8,
        /// What is impossible.
        reason: String,
    },
}

/// A frame that is no sample. Where it came intact, its number and device time count all the same.
#[derive(Debug)]
pub(super) struct Unread {
    pub fault: FrameFault,
    pub stamp: Option<Stamp>,
}

impl From<FrameFault> for Unread {
    fn from(fault: FrameFault) -> Self {
        Self { fault, stamp: None }
    }
}

/// Unstuffs (in place), checks and reads one frame without its delimiter. `foreign` is another schema that this device has announced.
pub(super) fn read_frame(stuffed: &mut [u8], foreign: Option<u32>) -> Result<Sample, Unread> {
    let bytes = stuffed.len();
    let length = cobs::decode_in_place(stuffed).map_err(|_| FrameFault::Stuffing { bytes })?;
    let packet = &stuffed[..length];
    if length < HEADER_BYTES + CRC_BYTES {
        return Err(FrameFault::Stuffing { bytes }.into());
    }
    let (body, crc) = packet.split_at(length - CRC_BYTES);
    let found_crc = u32::from_le_bytes([crc[0], crc[1], crc[2], crc[3]]);
    let expected_crc = seeded_crc(SCHEMA_HASH, body);
    if found_crc != expected_crc {
        let stated = foreign.or_else(|| stated_schema(body)).filter(|schema| seeded_crc(*schema, body) == found_crc);
        return Err(match stated {
            Some(found) => FrameFault::SchemaMismatch { expected: SCHEMA_HASH, found },
            None => FrameFault::Corrupt { expected_crc, found_crc },
        }
        .into());
    }
    read_packet(body)
}

/// CRC-32C over the schema hash and then `body`.
pub(super) fn seeded_crc(schema: u32, body: &[u8]) -> u32 {
    let mut digest = CRC32C.digest();
    digest.update(&schema.to_le_bytes());
    digest.update(body);
    digest.finalize()
}

/// The schema that a metadata message says it follows.
fn stated_schema(body: &[u8]) -> Option<u32> {
    let at = HEADER_BYTES + 4;
    let bytes = body.get(at..at + 4).filter(|_| body[1] == METADATA)?;
    Some(u32::from_le_bytes([bytes[0], bytes[1], bytes[2], bytes[3]]))
}

/// Whether a message is one that only the other device sends.
pub(super) fn is_of_another(id: u8, device: DeviceKind) -> bool {
    match id {
        ROBOT => device != DeviceKind::Robot,
        CARM => device != DeviceKind::Carm,
        _ => false,
    }
}

fn read_packet(body: &[u8]) -> Result<Sample, Unread> {
    let (version, id) = (body[0], body[1]);
    if version != VERSION {
        return Err(FrameFault::VersionMismatch { expected: VERSION, found: version }.into());
    }
    let mut header = Fields { id, rest: &body[2..HEADER_BYTES] };
    let flags = header.u16()?;
    let stamp = Stamp { sequence: header.u32()?, device_us: header.u64()? };
    read_payload(id, flags, stamp, &body[HEADER_BYTES..]).map_err(|fault| Unread { fault, stamp: Some(stamp) })
}

fn read_payload(id: u8, flags: u16, stamp: Stamp, payload: &[u8]) -> Result<Sample, FrameFault> {
    let mut fields = Fields { id, rest: payload };
    let sample = match id {
        ROBOT => Sample::Robot(fields.robot(flags, stamp)?),
        CARM => Sample::Carm(fields.carm(flags, stamp)?),
        METADATA => Sample::Metadata(fields.metadata(stamp)?),
        _ => return Err(FrameFault::UnknownMessage { id }),
    };
    match fields.rest.len() {
        0 => Ok(sample),
        extra => Err(fields.malformed(format!("{extra} bytes too many"))),
    }
}

/// Number and device time of a packet.
#[derive(Clone, Copy, Debug)]
pub(super) struct Stamp {
    pub sequence: u32,
    pub device_us: u64,
}

/// Takes fields off the front of a payload.
struct Fields<'a> {
    id: u8,
    rest: &'a [u8],
}

impl Fields<'_> {
    fn malformed(&self, reason: impl Into<String>) -> FrameFault {
        FrameFault::Malformed { id: self.id, reason: reason.into() }
    }

    fn take<const N: usize>(&mut self) -> Result<[u8; N], FrameFault> {
        let Some((field, rest)) = self.rest.split_first_chunk::<N>() else {
            return Err(self.malformed(format!("a field of {N} bytes is cut to {}", self.rest.len())));
        };
        self.rest = rest;
        Ok(*field)
    }

    fn u8(&mut self) -> Result<u8, FrameFault> {
        Ok(self.take::<1>()?[0])
    }

    fn u16(&mut self) -> Result<u16, FrameFault> {
        self.take().map(u16::from_le_bytes)
    }

    fn u32(&mut self) -> Result<u32, FrameFault> {
        self.take().map(u32::from_le_bytes)
    }

    fn u64(&mut self) -> Result<u64, FrameFault> {
        self.take().map(u64::from_le_bytes)
    }

    /// Whatever is not finite was not measured.
    fn f32(&mut self) -> Result<f64, FrameFault> {
        self.take().map(|bytes| measured(f64::from(f32::from_le_bytes(bytes))))
    }

    /// Whatever is not finite was not measured.
    fn f64(&mut self) -> Result<f64, FrameFault> {
        self.take().map(|bytes| measured(f64::from_le_bytes(bytes)))
    }

    fn radians(&mut self) -> Result<f64, FrameFault> {
        Ok(self.f64()?.to_radians())
    }

    fn f32s<const N: usize>(&mut self) -> Result<[f64; N], FrameFault> {
        let mut values = [f64::NAN; N];
        for value in &mut values {
            *value = self.f32()?;
        }
        Ok(values)
    }

    fn string(&mut self) -> Result<String, FrameFault> {
        let length = usize::from(self.u8()?);
        let Some((text, rest)) = self.rest.split_at_checked(length) else {
            return Err(self.malformed(format!("a string of {length} bytes is cut to {}", self.rest.len())));
        };
        let text = std::str::from_utf8(text).map_err(|_| self.malformed("a string is not UTF-8"))?;
        self.rest = rest;
        // What a device says ends up in terminals and reports.
        Ok(text.chars().filter(|c| !c.is_control()).collect())
    }

    fn tendon(&mut self) -> Result<Tendon, FrameFault> {
        let [position_mm, velocity_mm_per_s, tension_n, current_a] = self.f32s()?;
        Ok(Tendon { position_mm, velocity_mm_per_s, tension_n, current_a })
    }

    fn robot(&mut self, flags: u16, stamp: Stamp) -> Result<RobotSample, FrameFault> {
        let commanded_deg = self.f32s()?;
        let sensed_deg = Some(self.f32s()?).filter(|_| flags & 1 != 0);
        let tendons = [self.tendon()?, self.tendon()?];
        let translation_mm = DVec3::new(self.f64()?, self.f64()?, self.f64()?);
        let rotation = DQuat::from_xyzw(self.f64()?, self.f64()?, self.f64()?, self.f64()?);
        let tracker_from_base = if flags & 2 != 0 {
            let off = (rotation.length() - 1.0).abs();
            if !(off <= QUATERNION_LIMIT && translation_mm.is_finite()) {
                return Err(self.malformed("the base is flagged as tracked, but its pose is no rigid motion"));
            }
            Some(Rigid { rotation: rotation.normalize(), translation_mm })
        } else {
            None
        };
        Ok(RobotSample {
            device_us: stamp.device_us,
            sequence: stamp.sequence,
            commanded_deg,
            sensed_deg,
            tendons,
            tracker_from_base,
            drill_rpm: self.f32()?,
            status: self.u32()?,
        })
    }

    fn carm(&mut self, flags: u16, stamp: Stamp) -> Result<CarmSample, FrameFault> {
        let joints = CarmJoints {
            lift_mm: self.f64()?,
            wig_wag_rad: self.radians()?,
            longitudinal_mm: self.f64()?,
            angulation_rad: self.radians()?,
            orbital_rad: self.radians()?,
            detector_rotation_rad: self.radians()?,
            source_to_detector_mm: self.f64()?,
        };
        Ok(CarmSample {
            device_us: stamp.device_us,
            sequence: stamp.sequence,
            joints,
            tube_kvp: self.f32()?,
            tube_ma: self.f32()?,
            pulse_width_ms: self.f32()?,
            filter_mm_al: self.f32()?,
            filter_mm_cu: self.f32()?,
            field_mm: self.f32s()?,
            xray_on: flags & 1 != 0,
            exposure_counter: Some(self.u32()?).filter(|counter| *counter != NO_COUNTER),
            status: self.u32()?,
        })
    }

    fn metadata(&mut self, stamp: Stamp) -> Result<Metadata, FrameFault> {
        let device = match self.u8()? {
            ROBOT => DeviceKind::Robot,
            CARM => DeviceKind::Carm,
            kind => return Err(self.malformed(format!("device kind {kind} is not known"))),
        };
        let limit_count = self.u8()?;
        let _reserved = self.u16()?;
        let schema = self.u32()?;
        let (serial_number, firmware) = (self.string()?, self.string()?);
        let (calibration_id, units) = (self.string()?, self.string()?);
        let mut limits = Vec::with_capacity(usize::from(limit_count));
        for _ in 0..limit_count {
            limits.push(Limit { min: self.f32()?, max: self.f32()? });
        }
        let Stamp { sequence, device_us } = stamp;
        Ok(Metadata { device_us, sequence, device, schema, serial_number, firmware, calibration_id, units, limits })
    }
}

/// NaN for everything that is not finite.
fn measured(value: f64) -> f64 {
    if value.is_finite() { value } else { f64::NAN }
}
