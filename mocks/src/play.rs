//! Plays the scripted session in real time: packets with noise, drift and faults, exposures, frames.

use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use rand::{Rng, RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use rand_distr::{Distribution, Normal};
use serde_json::json;

use crate::MockError;
use crate::lab::{FaultKind, Lab};
use crate::pty::Line;
use crate::wire::{CarmMessage, MetadataMessage, NO_COUNTER, RobotMessage, Stamp, encode_carm, encode_metadata, encode_robot};

/// What is played.
#[derive(Clone, Debug)]
pub struct Performance {
    /// Length.
    pub duration_s: f64,
    /// Wait before the first packet, so that a reader can open the ports.
    pub start_delay_s: f64,
    /// Play the lab's faults.
    pub faults: bool,
    /// Store the exposure counter.
    pub counter: bool,
    /// Exposures played, at most all of the lab's.
    pub exposures: usize,
    /// Seed of encoders and faults.
    pub seed: u64,
}

/// A device's packets on their way to its line.
struct Sender {
    name: &'static str,
    line: Line,
    sequence: u32,
    ppm: f64,
    epoch_us: u64,
    period_s: f64,
    next_s: f64,
    next_metadata_s: f64,
    pending: Option<FaultKind>,
    held: Vec<u8>,
    held_until_s: f64,
    plug_at_s: Option<f64>,
}

impl Sender {
    fn stamp(&mut self, at_s: f64) -> Stamp {
        let device_us = self.epoch_us + (at_s * 1e6 * (1.0 + self.ppm * 1e-6)) as u64;
        let stamp = Stamp { sequence: self.sequence, device_us };
        self.sequence = self.sequence.wrapping_add(1);
        stamp
    }

    /// Sends `packet`, after the fault that is due, if one is.
    fn send(&mut self, mut packet: Vec<u8>, at_s: f64, random: &mut impl Rng) {
        match self.pending.take() {
            None if self.held.is_empty() => self.line.write(&packet),
            None => {
                // A reordered packet waits for one other; delayed ones wait until their time.
                if at_s >= self.held_until_s {
                    self.line.write(&packet);
                    let held = std::mem::take(&mut self.held);
                    self.line.write(&held);
                } else {
                    self.held.extend(packet);
                }
            }
            Some(FaultKind::Drop) => {}
            Some(FaultKind::Flip) => {
                let at = random.random_range(1..packet.len() - 1);
                // Never into a delimiter, which would be a tear.
                let flipped = packet[at] ^ 0x10;
                packet[at] = if flipped == 0 { packet[at] ^ 0x20 } else { flipped };
                self.line.write(&packet);
            }
            Some(FaultKind::Tear) => self.line.write(&packet[..packet.len() / 2]),
            Some(FaultKind::Duplicate) => {
                self.line.write(&packet);
                self.line.write(&packet);
            }
            Some(FaultKind::Reorder) => {
                self.held = packet;
                self.held_until_s = at_s;
            }
            Some(FaultKind::Delay) => {
                self.held = packet;
                self.held_until_s = at_s + 0.08;
            }
            Some(FaultKind::Unplug) => {
                self.line.unplug();
                self.plug_at_s = Some(at_s + 1.0);
            }
        }
    }
}

/// Prints one event as a line of JSON.
pub fn say(event: &serde_json::Value) {
    use std::io::Write;
    let mut out = std::io::stdout().lock();
    // Whoever started the mock may have gone; that is no reason to stop playing.
    let _ = writeln!(out, "{event}").and_then(|()| out.flush());
}

/// Plays the session on `carm` and `robot`; `frames` are the files of the exposures, in order.
///
/// # Errors
/// When a line or a file cannot be written.
pub fn play(
    lab: &Lab,
    performance: &Performance,
    carm: Option<Line>,
    robot: Option<Line>,
    frames: &[(PathBuf, Vec<u8>)],
) -> Result<(), MockError> {
    let mut random = ChaCha8Rng::seed_from_u64(performance.seed);
    let sender = |name, line, ppm, epoch_us, period_s| Sender {
        name,
        line,
        sequence: 0,
        ppm,
        epoch_us,
        period_s,
        next_s: 0.0,
        next_metadata_s: 0.0,
        pending: None,
        held: Vec::new(),
        held_until_s: 0.0,
        plug_at_s: None,
    };
    let mut senders: Vec<Sender> = Vec::new();
    senders.extend(carm.map(|line| sender("carm", line, lab.clock.carm_ppm, lab.clock.carm_epoch_us, 1.0 / 30.0)));
    senders.extend(robot.map(|line| sender("robot", line, lab.clock.robot_ppm, lab.clock.robot_epoch_us, 0.01)));
    for sender in &mut senders {
        sender.line.write(&[0]);
    }
    std::thread::sleep(Duration::from_secs_f64(performance.start_delay_s));
    let script = Script { lab, performance };
    let mut faults: Vec<_> = lab.faults.iter().filter(|_| performance.faults).collect();
    let mut delivered = 0;
    let mut half: Option<(PathBuf, Vec<u8>, f64)> = None;
    let mut announced = 0;
    let start = Instant::now();
    let last_frame_s = script.last_frame_s();
    loop {
        let now_s = start.elapsed().as_secs_f64();
        if now_s > performance.duration_s.max(last_frame_s + 0.5) {
            break;
        }
        faults.retain(|fault| {
            let due = fault.at * performance.duration_s <= now_s;
            if due && let Some(sender) = senders.iter_mut().find(|sender| sender.name == fault.device) {
                sender.pending = Some(fault.kind);
                say(&json!({"event": "fault", "device": fault.device, "kind": fault.kind, "at_s": now_s}));
            }
            !due
        });
        for sender in &mut senders {
            advance(sender, &script, now_s, &mut random)?;
        }
        if announced < script.count() && now_s >= script.start_s(announced) {
            announced += 1;
            say(&json!({"event": "exposure", "counter": announced, "at_s": now_s}));
        }
        if let Some((path, bytes, at_s)) = half.take_if(|(_, _, at_s)| now_s >= *at_s) {
            append(&path, &bytes, at_s)?;
        }
        if let Some((path, bytes)) = frames.get(delivered).filter(|_| now_s >= script.frame_s(delivered)) {
            if delivered == 1 {
                // One file arrives in two halves, as over a slow share.
                let cut = bytes.len() / 2;
                std::fs::write(path, &bytes[..cut]).map_err(MockError::io(path.display()))?;
                half = Some((path.clone(), bytes[cut..].to_vec(), now_s + 0.4));
            } else {
                crate::dicom::deliver(path, bytes)?;
            }
            delivered += 1;
            say(&json!({"event": "frame", "file": path, "at_s": now_s}));
        }
        std::thread::sleep(Duration::from_millis(1));
    }
    let sent: serde_json::Map<_, _> = senders
        .iter()
        .map(|s| (s.name.to_owned(), json!({"packets": s.sequence, "overrun_bytes": s.line.overrun_bytes})))
        .collect();
    say(&json!({"event": "finished", "frames": delivered, "sent": sent}));
    // The lines stay open for a moment, so that the end of the script does not look like pulled plugs.
    std::thread::sleep(Duration::from_secs(3));
    Ok(())
}

fn append(path: &Path, bytes: &[u8], _at_s: f64) -> Result<(), MockError> {
    use std::io::Write;
    let mut file = std::fs::OpenOptions::new().append(true).open(path).map_err(MockError::io(path.display()))?;
    file.write_all(bytes).map_err(MockError::io(path.display()))
}

fn advance(sender: &mut Sender, script: &Script, now_s: f64, random: &mut ChaCha8Rng) -> Result<(), MockError> {
    if sender.plug_at_s.is_some_and(|at_s| now_s >= at_s) {
        sender.plug_at_s = None;
        sender.line.plug()?;
        sender.line.write(&[0]);
        say(&json!({"event": "plugged", "device": sender.name, "at_s": now_s}));
    }
    while sender.next_s <= now_s {
        let at_s = sender.next_s;
        sender.next_s += sender.period_s;
        if at_s >= sender.next_metadata_s {
            sender.next_metadata_s += 1.0;
            let stamp = sender.stamp(at_s);
            let packet = encode_metadata(stamp, &metadata(sender.name));
            sender.line.write(&packet);
        }
        let stamp = sender.stamp(at_s);
        let packet = match sender.name {
            "carm" => encode_carm(stamp, &script.carm(at_s, random)),
            _ => encode_robot(stamp, &script.robot(at_s, random)),
        };
        sender.send(packet, at_s, random);
    }
    Ok(())
}

fn metadata(name: &str) -> MetadataMessage {
    let texts = |serial: &str, calibration: &str, units: &str| [serial, "mock 1.0", calibration, units].map(str::to_owned);
    match name {
        "carm" => MetadataMessage {
            kind: 2,
            texts: texts("MOCK-CARM-1", "carm.json", "mm,deg,kV,mA,ms"),
            limits: vec![
                [0.0, 400.0],
                [-10.0, 10.0],
                [0.0, 200.0],
                [-190.0, 190.0],
                [-90.0, 90.0],
                [-180.0, 180.0],
                [900.0, 1200.0],
            ],
        },
        _ => MetadataMessage {
            kind: 1,
            texts: texts("MOCK-SNAKE-1", "robot.json", "deg,mm,mm/s,N,A,rpm"),
            limits: vec![[-7.9, 7.9]; 5],
        },
    }
}

/// Where everything is at a time.
struct Script<'a> {
    lab: &'a Lab,
    performance: &'a Performance,
}

impl Script<'_> {
    fn count(&self) -> usize {
        self.performance.exposures.min(self.lab.exposures.len())
    }

    fn start_s(&self, index: usize) -> f64 {
        self.lab.exposures[index].at * self.performance.duration_s
    }

    fn frame_s(&self, index: usize) -> f64 {
        self.start_s(index) + self.lab.exposure_s + self.lab.frame_delay_s
    }

    fn last_frame_s(&self) -> f64 {
        self.count().checked_sub(1).map_or(0.0, |last| self.frame_s(last))
    }

    /// Values of two exposures blended: still during an exposure (and 0.2 s before), smooth in between.
    fn blend<const N: usize>(&self, at_s: f64, value: impl Fn(&crate::lab::Exposure) -> [f64; N]) -> [f64; N] {
        let still = 0.2;
        let exposures = &self.lab.exposures[..self.count()];
        let Some(after) = exposures.iter().position(|e| e.at * self.performance.duration_s + self.lab.exposure_s > at_s) else {
            return exposures.last().map_or([0.0; N], value);
        };
        let target = value(&exposures[after]);
        let Some(before) = after.checked_sub(1) else { return target };
        let from_s = self.start_s(before) + self.lab.exposure_s;
        let to_s = self.start_s(after) - still;
        let t = ((at_s - from_s) / (to_s - from_s)).clamp(0.0, 1.0);
        let smooth = t * t * (3.0 - 2.0 * t);
        let start = value(&exposures[before]);
        std::array::from_fn(|i| start[i] + (target[i] - start[i]) * smooth)
    }

    fn exposure_at(&self, at_s: f64) -> Option<usize> {
        (0..self.count()).find(|index| (self.start_s(*index)..self.start_s(*index) + self.lab.exposure_s).contains(&at_s))
    }

    fn noise(&self, sigma: f64, random: &mut impl Rng) -> f64 {
        Normal::new(0.0, sigma).map_or(0.0, |normal| normal.sample(random))
    }

    fn carm(&self, at_s: f64, random: &mut impl Rng) -> CarmMessage {
        let [lift, wig_wag, longitudinal, angulation, orbital, rotation] = self.blend(at_s, |exposure| exposure.joints());
        let EncoderSigma { deg, mm } = EncoderSigma { deg: self.lab.encoder_noise.deg, mm: self.lab.encoder_noise.mm };
        let joints = [
            lift + self.noise(mm, random),
            wig_wag + self.noise(deg, random),
            longitudinal + self.noise(mm, random),
            angulation + self.noise(deg, random),
            orbital + self.noise(deg, random),
            rotation,
            self.lab.carm["source_to_detector_mm"].as_f64().unwrap_or(f64::NAN),
        ];
        let exposed = self.exposure_at(at_s);
        let seen = (0..self.count()).filter(|index| self.start_s(*index) <= at_s).count();
        let open = [-120.28, -93.12, 120.28, 93.12];
        let field = exposed.and_then(|index| self.lab.exposures[index].field_mm).unwrap_or(open);
        CarmMessage {
            joints,
            tube_kvp: self.lab.tube_kvp,
            tube_ma: self.lab.tube_ma,
            pulse_width_ms: self.lab.pulse_width_ms,
            filter_mm: [self.lab.aluminium_mm as f32, 0.0],
            field_mm: field.map(|side| side as f32),
            xray_on: exposed.is_some(),
            exposure_counter: if self.performance.counter { seen as u32 } else { NO_COUNTER },
            status: 0,
        }
    }

    fn robot(&self, at_s: f64, random: &mut impl Rng) -> RobotMessage {
        let control = self.blend(at_s, |exposure| exposure.control_deg);
        let bend = control.iter().sum::<f64>();
        let pull = |sign: f64| [(sign * bend * 0.2) as f32, 0.0, (10.0 + sign * bend) as f32, 0.4];
        RobotMessage {
            commanded_deg: control.map(|angle| angle as f32),
            sensed_deg: Some(control.map(|angle| (angle + self.noise(0.02, random)) as f32)),
            tendons: [pull(1.0), pull(-1.0)],
            tracker_from_base: None,
            drill_rpm: 0.0,
            status: 0,
        }
    }
}

struct EncoderSigma {
    deg: f64,
    mm: f64,
}
