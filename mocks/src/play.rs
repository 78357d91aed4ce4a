//! Plays the scripted session in real time: packets with noise, drift and faults, exposures, files.

use std::path::{Path, PathBuf};
use std::time::{Duration, Instant, SystemTime, UNIX_EPOCH};

use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use serde_json::json;

use crate::MockError;
use crate::delivery::{Delivery, Way};
use crate::dialect::Dialect;
use crate::dicom::Drawn;
use crate::fault::{Channel, FaultKind};
use crate::lab::{Device, Fault};
use crate::oddity::Oddity;
use crate::pty::Line;
use crate::script::{Script, carm_metadata, robot_metadata};
use crate::wire::{Stamp, encode_carm, encode_metadata, encode_robot};

/// What is played besides the script.
#[derive(Clone, Debug)]
pub struct Performance {
    /// Waits at most this long until somebody reads the lines.
    pub await_reader_s: f64,
    /// Waits for a reader of every line, not only of one.
    pub await_all: bool,
    /// Wait before the first packet, once the lines are read.
    pub start_delay_s: f64,
    /// How long the devices go on telling where they are when the script is over.
    pub idle_s: f64,
    /// How long the lines stay open after the last packet.
    pub linger_s: f64,
    /// Packets per second, relative to 100 Hz and 30 Hz.
    pub rate: f64,
    /// The same when the script is over.
    pub idle_rate: f64,
    /// Faults, in any order.
    pub faults: Vec<Fault>,
    /// How long an unplugged line stays away; by itself no longer than the next exposure allows.
    pub unplugged_s: Option<f64>,
    /// Share of the time in which a device holds its packets back, at random, about a tenth of a second each time.
    pub stalled: f64,
    /// Share of the packets that never leave the device, at random.
    pub missing: f64,
    /// Lines that carry random bytes instead of packets.
    pub garbage: Vec<Device>,
    /// Devices that print lines instead of sending packets.
    pub dialects: Vec<(Device, Dialect)>,
    /// How frames reach the receiver.
    pub way: Way,
    /// What the devices say oddly.
    pub oddities: Vec<Oddity>,
    /// Where every packet that leaves a device is noted: host time in µs, device, sequence, bytes.
    pub sent: Option<PathBuf>,
    /// Seed of encoders and faults.
    pub seed: u64,
}

/// What [`FaultKind::Jump`] adds to a device's clock.
const JUMP_US: u64 = 5_000_000;
/// What [`FaultKind::Ahead`] adds to it and [`FaultKind::Back`] takes away.
const HOUR_US: u64 = 3_600_000_000;

/// What a device's clock gains in an hour of [`FaultKind::Away`], at 200 ppm.
const GAINED_US: u64 = 720_000;

/// How long a device holds its packets back at a time: at least and at most.
const STALL_S: [f64; 2] = [0.07, 0.15];

/// Prints one event as a line of JSON.
pub fn say(event: &serde_json::Value) {
    use std::io::Write;
    let mut out = std::io::stdout().lock();
    // Whoever started the mock may have gone; that is no reason to stop playing.
    let _ = writeln!(out, "{event}").and_then(|()| out.flush());
}

/// Plays `script` on the lines; `frames` are those of the exposures, in order. Every event goes to `tell`.
///
/// # Errors
/// When a line or a file cannot be written.
pub fn play(
    script: &Script,
    performance: &Performance,
    lines: Vec<(Device, Line)>,
    frames: &[Drawn],
    tell: &mut dyn FnMut(serde_json::Value),
) -> Result<(), MockError> {
    let mut notes = performance.sent.as_deref().map(Notes::create).transpose()?;
    let mut senders: Vec<Sender> =
        lines.into_iter().map(|(device, line)| Sender::new(device, line, script, performance)).collect();
    for sender in &mut senders {
        sender.channel.line.write(&[sender.channel.delimiter]);
    }
    let mut delivery = Delivery::new(script, frames, &performance.way)?;
    let awaiting = Instant::now();
    await_reader(&senders, performance.await_reader_s, performance.await_all)?;
    while !delivery.is_awaited() && awaiting.elapsed().as_secs_f64() < performance.await_reader_s {
        std::thread::sleep(Duration::from_millis(10));
    }
    std::thread::sleep(Duration::from_secs_f64(performance.start_delay_s));
    delivery.start(now_us());
    let mut faults = performance.faults.clone();
    let mut announced = 0;
    let end_s = script.end_s() + performance.idle_s;
    let start = Instant::now();
    loop {
        let elapsed_s = start.elapsed().as_secs_f64();
        // However late this thread is woken, everything until the end is sent.
        let now_s = elapsed_s.min(end_s);
        for fault in faults.extract_if(.., |fault| fault.at * script.duration_s <= now_s) {
            if let Some(sender) = senders.iter_mut().find(|sender| sender.device == fault.device) {
                match fault.kind {
                    FaultKind::Freeze => sender.frozen_s = Some(now_s),
                    FaultKind::Stuck => sender.stuck_s = Some(now_s),
                    FaultKind::Stale => sender.stale_s = Some(now_s),
                    FaultKind::Restart => (sender.began_s, sender.epoch_us, sender.sequence) = (now_s, 0, 0),
                    FaultKind::Jump => sender.epoch_us += JUMP_US,
                    FaultKind::Ahead => sender.epoch_us += HOUR_US,
                    FaultKind::Back => sender.epoch_us = sender.epoch_us.saturating_sub(HOUR_US),
                    FaultKind::Millis => sender.run_clock_at(now_s, 1e-3),
                    FaultKind::Other => sender.is_other = true,
                    FaultKind::Away => {
                        sender.pass_an_hour();
                        sender.channel.inject(FaultKind::Away);
                    }
                    kind => sender.channel.inject(kind),
                }
                tell(json!({"event": "fault", "device": fault.device, "kind": fault.kind, "at_s": now_s}));
            }
        }
        // Nothing is held back for ever.
        let last = elapsed_s >= end_s;
        for sender in &mut senders {
            if last || !sender.is_stalled(now_s) {
                sender.advance(script, now_s, &mut notes, tell)?;
            }
        }
        if announced < script.count() && now_s >= script.start_s(announced) {
            announced += 1;
            tell(json!({"event": "exposure", "counter": announced, "at_s": now_s}));
        }
        delivery.advance(now_s, tell)?;
        if last {
            break;
        }
        std::thread::sleep(Duration::from_millis(1));
    }
    let delivered = delivery.finish(tell);
    let sent: serde_json::Map<_, _> = senders
        .iter()
        .map(|s| {
            let counts = json!({"packets": s.sequence, "missing": s.missed, "overrun_bytes": s.channel.line.overrun_bytes});
            (s.device.name().to_owned(), counts)
        })
        .collect();
    tell(json!({"event": "finished", "frames": delivered, "sent": sent}));
    // The end of the script must not look like pulled plugs.
    std::thread::sleep(Duration::from_secs_f64(performance.linger_s));
    Ok(())
}

/// Returns once one of the lines is read, or `all` of them, so that the session starts with its listener, however long that takes to start.
fn await_reader(senders: &[Sender], limit_s: f64, all: bool) -> Result<(), MockError> {
    let start = Instant::now();
    while !senders.is_empty() && start.elapsed().as_secs_f64() < limit_s {
        let mut read = 0;
        for sender in senders {
            read += usize::from(sender.channel.line.is_read()?);
        }
        if read == senders.len() || read > 0 && !all {
            return Ok(());
        }
        std::thread::sleep(Duration::from_millis(10));
    }
    Ok(())
}

fn now_us() -> i64 {
    SystemTime::now().duration_since(UNIX_EPOCH).map_or(0, |since| since.as_micros() as i64)
}

/// A device: its clock, its packets, its line.
struct Sender {
    device: Device,
    channel: Channel,
    random: ChaCha8Rng,
    sequence: u32,
    ppm: f64,
    epoch_us: u64,
    period_s: f64,
    /// Time between packets when the script is over, until it is.
    idle_period_s: Option<f64>,
    /// When the packet was due from which `packets` is counted.
    from_s: f64,
    packets: u64,
    seconds: u64,
    missing: f64,
    /// Decides which packets are missing; apart from `random`, so that what is sent does not depend on it.
    missing_random: ChaCha8Rng,
    missed: u64,
    stalled: f64,
    /// When the next stall begins and ends; apart from `random` as well.
    stall_s: [f64; 2],
    stall_random: ChaCha8Rng,
    garbage: bool,
    /// How it prints lines, where it does not send packets.
    dialect: Option<Dialect>,
    oddities: Vec<Oddity>,
    /// When the clock stopped.
    frozen_s: Option<f64>,
    /// Of which moment all that it measures is said to be.
    stuck_s: Option<f64>,
    /// Of which moment it is.
    stale_s: Option<f64>,
    /// When it was switched on.
    began_s: f64,
    /// Seconds that its clock advances in one, but for `ppm`.
    clock_rate: f64,
    /// It is another one than in the beginning.
    is_other: bool,
}

/// The list of what was sent.
struct Notes(std::fs::File, PathBuf);

impl Notes {
    fn create(path: &Path) -> Result<Self, MockError> {
        Ok(Self(std::fs::File::create(path).map_err(MockError::io(path.display()))?, path.to_owned()))
    }

    fn note(&mut self, device: Device, sequence: u32, bytes: usize) -> Result<(), MockError> {
        use std::io::Write;
        let line = format!("{},{},{sequence},{bytes}\n", now_us(), device.name());
        self.0.write_all(line.as_bytes()).map_err(MockError::io(self.1.display()))
    }
}

impl Sender {
    fn new(device: Device, line: Line, script: &Script, performance: &Performance) -> Self {
        let mut channel = Channel::new(line);
        // In a short session the plug must be back before the next exposure.
        channel.unplugged_s = performance.unplugged_s.unwrap_or((0.05 * script.duration_s).min(1.0));
        let clock = &script.lab.clock;
        let (ppm, epoch_us, nominal_s, stream) = match device {
            Device::Carm => (clock.carm_ppm, clock.carm_epoch_us, 1.0 / 30.0, 1),
            Device::Robot => (clock.robot_ppm, clock.robot_epoch_us, 0.01, 2),
        };
        // A stream per device: what one sends does not depend on how the two take turns.
        let mut random = ChaCha8Rng::seed_from_u64(performance.seed);
        random.set_stream(stream);
        let period_s = nominal_s / performance.rate;
        let idle_period_s = Some(nominal_s / performance.idle_rate);
        let mut missing_random = random.clone();
        missing_random.set_stream(stream + 2);
        let mut stall_random = random.clone();
        stall_random.set_stream(stream + 4);
        let garbage = performance.garbage.contains(&device);
        let dialect = performance.dialects.iter().find(|(printing, _)| *printing == device).map(|(_, dialect)| *dialect);
        channel.delimiter = if dialect.is_some() { b'\n' } else { 0 };
        let missing = performance.missing;
        Self {
            device,
            channel,
            random,
            sequence: 0,
            ppm,
            epoch_us,
            period_s,
            idle_period_s,
            from_s: 0.0,
            packets: 0,
            seconds: 0,
            missing,
            missing_random,
            missed: 0,
            stalled: performance.stalled,
            stall_s: [0.0; 2],
            stall_random,
            garbage,
            dialect,
            oddities: performance.oddities.clone(),
            frozen_s: None,
            stuck_s: None,
            stale_s: None,
            began_s: 0.0,
            clock_rate: 1.0,
            is_other: false,
        }
    }

    /// Whether the device holds back what it has measured; it sends all of it at once when it goes on.
    fn is_stalled(&mut self, now_s: f64) -> bool {
        if self.stalled <= 0.0 {
            return false;
        }
        let [shortest_s, longest_s] = STALL_S;
        if now_s >= self.stall_s[1] {
            // Between stalls as much time, on average, as gives the share that is asked for.
            let free_s = 0.5 * (shortest_s + longest_s) * (1.0 - self.stalled) / self.stalled;
            let begin_s = now_s + 2.0 * free_s * self.stall_random.random::<f64>();
            self.stall_s = [begin_s, begin_s + self.stall_random.random_range(shortest_s..longest_s)];
        }
        now_s >= self.stall_s[0]
    }

    /// What the clock shows.
    fn device_us(&self, at_s: f64) -> u64 {
        let clock_s = self.frozen_s.map_or(at_s, |frozen_s| at_s.min(frozen_s));
        // What is sent late is of before the start.
        let clock_s = (clock_s - self.began_s).max(0.0);
        self.epoch_us + (clock_s * 1e6 * self.clock_rate * (1.0 + self.ppm * 1e-6)) as u64
    }

    /// What the device did in an hour in which nobody heard it.
    fn pass_an_hour(&mut self) {
        self.epoch_us += HOUR_US + GAINED_US;
        self.sequence = self.sequence.wrapping_add((1e-6 * HOUR_US as f64 / self.period_s).round() as u32);
    }

    /// From `now_s` on the clock advances by `rate` seconds in one.
    fn run_clock_at(&mut self, now_s: f64, rate: f64) {
        self.epoch_us = self.device_us(now_s);
        (self.began_s, self.clock_rate) = (now_s, rate);
    }

    fn stamp(&mut self, at_s: f64) -> Stamp {
        let stamp = Stamp { sequence: self.sequence, device_us: self.device_us(at_s) };
        self.sequence = self.sequence.wrapping_add(1);
        stamp
    }

    /// Sends everything that is due until `now_s`.
    fn advance(
        &mut self,
        script: &Script,
        now_s: f64,
        notes: &mut Option<Notes>,
        tell: &mut dyn FnMut(serde_json::Value),
    ) -> Result<(), MockError> {
        if self.channel.tick(now_s)? {
            tell(json!({"event": "plugged", "device": self.device, "at_s": now_s}));
        }
        loop {
            let at_s = self.from_s + self.packets as f64 * self.period_s;
            if at_s > now_s {
                return Ok(());
            }
            if at_s > script.end_s()
                && let Some(period_s) = self.idle_period_s.take()
            {
                (self.from_s, self.packets, self.period_s) = (at_s, 0, period_s);
            }
            self.packets += 1;
            if at_s >= self.seconds as f64 {
                self.seconds += 1;
                // No line says who prints it.
                if self.dialect.is_none() {
                    let mut metadata = if self.device == Device::Carm { carm_metadata() } else { robot_metadata() };
                    if self.is_other {
                        metadata.texts[0].push_str("-OTHER");
                    }
                    let stamp = self.stamp(at_s);
                    self.send(stamp, encode_metadata(stamp, &metadata), at_s, notes)?;
                }
            }
            let stamp = self.stamp(self.stuck_s.map_or(at_s, |stuck_s| at_s.min(stuck_s)));
            let measured_s = self.stale_s.map_or(at_s, |stale_s| at_s.min(stale_s));
            let packet = match self.device {
                Device::Carm => {
                    let mut message = script.carm(measured_s, &mut self.random);
                    self.oddities.iter().for_each(|oddity| oddity.befall_carm(&mut message));
                    self.dialect.map_or_else(|| encode_carm(stamp, &message), |dialect| dialect.carm(stamp, &message))
                }
                Device::Robot => {
                    let mut message = script.robot(measured_s, &mut self.random);
                    let share = at_s / script.duration_s;
                    self.oddities.iter().for_each(|oddity| oddity.befall_robot(at_s, share, &mut message));
                    self.dialect.map_or_else(|| encode_robot(stamp, &message), |dialect| dialect.robot(stamp, &message))
                }
            };
            self.send(stamp, packet, at_s, notes)?;
        }
    }

    fn send(&mut self, stamp: Stamp, mut packet: Vec<u8>, at_s: f64, notes: &mut Option<Notes>) -> Result<(), MockError> {
        if self.missing > 0.0 && self.missing_random.random::<f64>() < self.missing {
            self.missed += 1;
            return Ok(());
        }
        if self.garbage {
            self.missing_random.fill(packet.as_mut_slice());
        }
        let overrun_bytes = self.channel.line.overrun_bytes;
        self.channel.send(&packet, at_s, &mut self.random)?;
        // Noted once the line has it: what is in the list was sent, and what nobody read in time is not in it.
        if self.channel.line.overrun_bytes > overrun_bytes {
            return Ok(());
        }
        notes.as_mut().map_or(Ok(()), |notes| notes.note(self.device, stamp.sequence, packet.len()))
    }
}
