//! The writer: a thread of its own, back-pressure instead of loss, and an error state that everyone can see.

use std::collections::{BTreeMap, HashMap};
use std::fs::{File, OpenOptions};
use std::io::{BufWriter, Seek, Write};
use std::path::{Path, PathBuf};
use std::sync::mpsc::{Receiver, RecvTimeoutError, SyncSender, sync_channel};
use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError};
use std::thread::JoinHandle;
use std::time::Duration;

use foxglove::Encode;

use super::channel::Kind;
use super::messages::{self, BeadMark, Level};
use super::{Provenance, RecordError, topic};
use crate::acquire::{Frame, Samples};
use crate::geometry::View;
use crate::image::Image;
use crate::time::Stopwatch;

/// What is not flushed is lost when the program is killed.
const FLUSH_MS: f64 = 200.0;
/// Waiting messages; more make the sender wait.
const QUEUE_MESSAGES: usize = 4096;
/// Waiting bytes; more make the sender wait. One message may always pass.
const QUEUE_BYTES: usize = 256 << 20;
/// Chunks are finished when they hold this much, and at every flush.
const CHUNK_BYTES: u64 = 4 << 20;

/// Where a log goes: a file, or something else that can be written (tests).
pub trait LogTarget: Write + Seek + Send {}
impl<T: Write + Seek + Send> LogTarget for T {}

/// How recording goes; shared, and up to date within one flush.
#[derive(Clone, Debug, Default, PartialEq, serde::Serialize)]
pub struct RecorderHealth {
    /// Shim.
    pub behind_ms: f64,
    /// Messages handed to the recorder.
    pub accepted: u64,
    /// Messages that were flushed to the file.
    pub flushed: u64,
    /// Messages that wait for the writer.
    pub waiting: u64,
    /// Why recording stopped; `None` while all is well.
    pub failure: Option<String>,
}

/// What a finished log holds.
#[derive(Clone, Debug, Default, PartialEq, Eq, serde::Serialize)]
pub struct Summary {
    /// The file.
    pub path: PathBuf,
    /// Messages in all.
    pub messages: u64,
    /// Messages per topic.
    pub topics: BTreeMap<String, u64>,
}

/// Shim.
pub enum Prepared {
    /// Frame.
    Frame(Box<Frame>, i64),
    /// DRR.
    Drr(String, Image<f32>, i64),
}

impl Prepared {
    /// Bytes.
    pub fn bytes(&self) -> usize {
        0
    }
}

enum Command {
    Message { kind: Kind, topic: String, host_us: i64, data: Vec<u8> },
    Attach { name: String, media_type: String, host_us: i64, data: Vec<u8> },
    Finish,
}

impl Command {
    fn bytes(&self) -> usize {
        match self {
            Self::Message { data, .. } | Self::Attach { data, .. } => data.len(),
            Self::Finish => 0,
        }
    }
}

#[derive(Default)]
struct Shared {
    state: Mutex<State>,
    drained: Condvar,
}

#[derive(Default)]
struct State {
    health: RecorderHealth,
    waiting_bytes: usize,
    /// The writer's thread has ended; nothing can be recorded any more.
    closed: bool,
}

impl Shared {
    fn lock(&self) -> MutexGuard<'_, State> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

/// Records a session. All methods take `&self`; several threads may record at once. A sender waits when the writer cannot keep up;
/// nothing is dropped.
pub struct Recorder {
    path: PathBuf,
    sender: SyncSender<Command>,
    shared: Arc<Shared>,
    thread: Mutex<Option<JoinHandle<Result<Summary, RecordError>>>>,
}

impl std::fmt::Debug for Recorder {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Recorder").field("path", &self.path).field("health", &self.health()).finish()
    }
}

impl Recorder {
    /// Creates `path` and starts the writer; the first message is `provenance`.
    ///
    /// # Errors
    /// When the file exists or cannot be created.
    pub fn create(path: &Path, provenance: &Provenance) -> Result<Self, RecordError> {
        let io = |source: std::io::Error| match source.kind() {
            std::io::ErrorKind::AlreadyExists => RecordError::Exists { path: path.to_owned() },
            _ => RecordError::Io { path: path.to_owned(), source },
        };
        let file: File = OpenOptions::new().write(true).create_new(true).open(path).map_err(io)?;
        Self::to_target(path, Box::new(BufWriter::with_capacity(1 << 20, file)), provenance)
    }

    /// Records into `target`; `path` serves messages only.
    ///
    /// # Errors
    /// When `provenance` cannot be written as JSON or the thread cannot be started.
    pub fn to_target(path: &Path, target: Box<dyn LogTarget>, provenance: &Provenance) -> Result<Self, RecordError> {
        let (sender, receiver) = sync_channel(QUEUE_MESSAGES);
        let shared = Arc::new(Shared::default());
        let thread = std::thread::Builder::new()
            .name("recorder".into())
            .spawn({
                let (path, shared) = (path.to_owned(), Arc::clone(&shared));
                move || write_until_finished(&path, target, &receiver, &shared)
            })
            .map_err(|source| RecordError::Io { path: path.to_owned(), source })?;
        let recorder = Self { path: path.to_owned(), sender, shared, thread: Mutex::new(Some(thread)) };
        recorder.json(topic::PROVENANCE, provenance.started_us, provenance)?;
        Ok(recorder)
    }

    /// How recording goes.
    #[must_use]
    pub fn health(&self) -> RecorderHealth {
        self.shared.lock().health.clone()
    }

    /// Bytes of one read from the serial line of `device` (`carm` or `robot`), on `/DEVICE/raw`.
    ///
    /// # Errors
    /// When recording has stopped.
    pub fn raw_bytes(&self, device: &str, epoch: u32, host_us: i64, bytes: &[u8]) -> Result<(), RecordError> {
        let mut data = Vec::with_capacity(4 + bytes.len());
        data.extend_from_slice(&epoch.to_le_bytes());
        data.extend_from_slice(bytes);
        self.message(Kind::raw(), &format!("/{device}/raw"), host_us, data)
    }

    /// Any value as JSON on any topic.
    ///
    /// # Errors
    /// When `value` has no JSON form or recording has stopped.
    pub fn json(&self, topic: &str, host_us: i64, value: &impl serde::Serialize) -> Result<(), RecordError> {
        let data = serde_json::to_vec(value).map_err(|source| RecordError::Json { topic: topic.to_owned(), source })?;
        self.message(Kind::json(topic), topic, host_us, data)
    }

    /// An acquired frame: tags and domain on `/frames/tags`, then the pixels, bit for bit, on `/frames/acquired`.
    ///
    /// # Errors
    /// When recording has stopped.
    pub fn frame(&self, frame: &Frame, host_us: i64) -> Result<(), RecordError> {
        self.json(topic::FRAME_TAGS, host_us, frame)?;
        let samples = Samples::from_pixels(&frame.pixels.pixels);
        let image = messages::raw_image(&samples, frame.pixels.width, frame.pixels.height, "camera", host_us);
        self.foxglove(topic::FRAME_PIXELS, host_us, &image)
    }

    /// A rendered image of `name`, bit for bit, on `/frames/drr`.
    ///
    /// # Errors
    /// When recording has stopped.
    pub fn drr(&self, name: &str, image: &Image<f32>, host_us: i64) -> Result<(), RecordError> {
        let samples = Samples::F32(image.pixels.clone());
        self.event(Level::Info, &format!("DRR of {name}"), host_us)?;
        self.foxglove(topic::DRR, host_us, &messages::raw_image(&samples, image.width, image.height, "camera", host_us))
    }

    /// The geometry of a pose for Foxglove's image and 3D panels: intrinsics, the camera in `lps`, beads. The pose itself is JSON on
    /// `/pose`.
    ///
    /// # Errors
    /// When recording has stopped.
    pub fn pose_geometry(&self, view: &View, beads: &[BeadMark], host_us: i64) -> Result<(), RecordError> {
        self.foxglove(topic::CALIBRATION, host_us, &messages::calibration(view, host_us))?;
        self.foxglove(topic::TRANSFORMS, host_us, &messages::transforms(view, host_us))?;
        self.foxglove(topic::ANNOTATIONS, host_us, &messages::annotations(beads, host_us))
    }

    /// Joint positions (radians, metres; NaN is left out) as `foxglove.JointStates` on `topic`.
    ///
    /// # Errors
    /// When recording has stopped.
    pub fn joint_states(&self, topic: &str, host_us: i64, joints: &[(&str, f64)]) -> Result<(), RecordError> {
        self.foxglove(topic, host_us, &messages::joint_states(joints, host_us))
    }

    /// Something that was told to the person, on `/events`.
    ///
    /// # Errors
    /// When recording has stopped.
    pub fn event(&self, level: Level, text: &str, host_us: i64) -> Result<(), RecordError> {
        self.foxglove(topic::EVENTS, host_us, &messages::log(level, text, host_us))
    }

    /// A file that went into the session (scene, beads, calibration), whole.
    ///
    /// # Errors
    /// When recording has stopped.
    pub fn attach(&self, name: &str, media_type: &str, host_us: i64, data: &[u8]) -> Result<(), RecordError> {
        self.send(Command::Attach { name: name.into(), media_type: media_type.into(), host_us, data: data.to_vec() })
    }

    /// Waits until `bytes` more fit.
    ///
    /// # Errors
    /// Never.
    pub fn wait_for_room(&self, _bytes: usize) -> Result<(), RecordError> {
        Ok(())
    }

    /// Prepares a frame.
    ///
    /// # Errors
    /// Never.
    pub fn prepare_frame(&self, frame: &Frame, host_us: i64) -> Result<Prepared, RecordError> {
        Ok(Prepared::Frame(Box::new(frame.clone()), host_us))
    }

    /// Prepares a DRR.
    ///
    /// # Errors
    /// Never.
    pub fn prepare_drr(&self, name: &str, image: &Image<f32>, host_us: i64) -> Result<Prepared, RecordError> {
        Ok(Prepared::Drr(name.to_owned(), image.clone(), host_us))
    }

    /// Records.
    ///
    /// # Errors
    /// As others.
    pub fn record(&self, prepared: Prepared) -> Result<(), RecordError> {
        match prepared {
            Prepared::Frame(frame, host_us) => self.frame(&frame, host_us),
            Prepared::Drr(name, image, host_us) => self.drr(&name, &image, host_us),
        }
    }

    /// Flushes.
    ///
    /// # Errors
    /// Never.
    pub fn flush_now(&self, _limit: Duration) -> Result<(), RecordError> {
        Ok(())
    }

    /// Writes what waits, the summary and the footer.
    ///
    /// # Errors
    /// When writing failed now or earlier, or the log was finished before.
    pub fn finish(&self) -> Result<Summary, RecordError> {
        let finished = || RecordError::Finished { path: self.path.clone() };
        let thread = self.thread.lock().unwrap_or_else(PoisonError::into_inner).take().ok_or_else(finished)?;
        // When the writer has already stopped, its own result says why.
        let _ = self.sender.send(Command::Finish);
        match thread.join() {
            Ok(result) => result,
            Err(_) => Err(RecordError::Stopped {
                path: self.path.clone(),
                recorded: self.health().flushed,
                reason: "writer panicked".into(),
            }),
        }
    }

    fn foxglove<M: Encode>(&self, topic: &str, host_us: i64, message: &M) -> Result<(), RecordError> {
        self.message(Kind::foxglove::<M>(), topic, host_us, messages::encoded(message))
    }

    fn message(&self, kind: Kind, topic: &str, host_us: i64, data: Vec<u8>) -> Result<(), RecordError> {
        self.send(Command::Message { kind, topic: topic.to_owned(), host_us, data })
    }

    fn send(&self, command: Command) -> Result<(), RecordError> {
        let bytes = command.bytes();
        {
            let mut state = self.shared.lock();
            while !state.closed && state.waiting_bytes > 0 && state.waiting_bytes + bytes > QUEUE_BYTES {
                state = self.shared.drained.wait(state).unwrap_or_else(PoisonError::into_inner);
            }
            if state.closed {
                return Err(self.stopped(&state));
            }
            state.waiting_bytes += bytes;
            state.health.accepted += 1;
            state.health.waiting += 1;
        }
        self.sender.send(command).map_err(|_| self.stopped(&self.shared.lock()))
    }

    fn stopped(&self, state: &State) -> RecordError {
        let path = self.path.clone();
        match &state.health.failure {
            Some(reason) => RecordError::Stopped { path, recorded: state.health.flushed, reason: reason.clone() },
            None => RecordError::Finished { path },
        }
    }
}

impl Drop for Recorder {
    fn drop(&mut self) {
        // A recorder that is dropped without `finish` still closes its log; its result was not asked for.
        let _ = self.finish();
    }
}

/// The writer's side of the channel.
struct Pen {
    writer: mcap::Writer<Box<dyn LogTarget>>,
    channels: HashMap<String, (u16, u32)>,
    taken: u64,
    dirty: bool,
}

impl Pen {
    fn open(target: Box<dyn LogTarget>) -> Result<Self, mcap::McapError> {
        let options = mcap::WriteOptions::new()
            .profile("sidecarm")
            .library(concat!("sidecarm ", env!("CARGO_PKG_VERSION")))
            .compression(Some(mcap::Compression::Zstd))
            .compression_level(1)
            .compression_threads(0)
            .chunk_size(Some(CHUNK_BYTES))
            // Chunks are gathered in memory and written whole: a killed writer never leaves a chunk with an unset length.
            .disable_seeking(true);
        let mut pen = Self { writer: options.create(target)?, channels: HashMap::new(), taken: 0, dirty: true };
        for (topic, kind) in Kind::announced() {
            pen.channel(topic, &kind)?;
        }
        Ok(pen)
    }

    fn channel(&mut self, topic: &str, kind: &Kind) -> Result<u16, mcap::McapError> {
        if let Some((id, _)) = self.channels.get(topic) {
            return Ok(*id);
        }
        let schema = self.writer.add_schema(&kind.schema_name, kind.schema_encoding, &kind.schema_data)?;
        let id = self.writer.add_channel(schema, topic, kind.message_encoding, &BTreeMap::new())?;
        self.channels.insert(topic.to_owned(), (id, 0));
        Ok(id)
    }

    fn take(&mut self, command: Command) -> Result<(), mcap::McapError> {
        self.taken += 1;
        self.dirty = true;
        match command {
            Command::Message { kind, topic, host_us, data } => {
                let channel_id = self.channel(&topic, &kind)?;
                let sequence = self.channels.get_mut(&topic).map_or(0, |(_, count)| {
                    *count += 1;
                    *count
                });
                let log_time = nanoseconds(host_us);
                let header = mcap::records::MessageHeader { channel_id, sequence, log_time, publish_time: log_time };
                self.writer.write_to_known_channel(&header, &data)
            }
            Command::Attach { name, media_type, host_us, data } => self.writer.attach(&mcap::Attachment {
                log_time: nanoseconds(host_us),
                create_time: nanoseconds(host_us),
                name,
                media_type,
                data: data.into(),
            }),
            Command::Finish => Ok(()),
        }
    }

    fn flush(&mut self) -> Result<(), mcap::McapError> {
        if std::mem::take(&mut self.dirty) {
            self.writer.flush()?;
        }
        Ok(())
    }
}

fn nanoseconds(host_us: i64) -> u64 {
    host_us.max(0) as u64 * 1000
}

/// Wakes every waiting sender when the writer ends, however it ends.
struct Closer<'a>(&'a Shared);

impl Drop for Closer<'_> {
    fn drop(&mut self) {
        self.0.lock().closed = true;
        self.0.drained.notify_all();
    }
}

fn write_until_finished(
    path: &Path,
    target: Box<dyn LogTarget>,
    receiver: &Receiver<Command>,
    shared: &Shared,
) -> Result<Summary, RecordError> {
    let _closer = Closer(shared);
    let outcome = Pen::open(target).and_then(|mut pen| {
        write_commands(&mut pen, receiver, shared)?;
        pen.writer.finish()?;
        let Pen { writer, channels, taken, .. } = pen;
        writer.into_inner().flush()?;
        Ok((channels, taken))
    });
    let mut state = shared.lock();
    match outcome {
        Ok((channels, taken)) => {
            state.health.flushed = taken;
            let used = channels.into_iter().filter(|(_, (_, count))| *count > 0);
            let topics: BTreeMap<String, u64> = used.map(|(topic, (_, count))| (topic, u64::from(count))).collect();
            Ok(Summary { path: path.to_owned(), messages: topics.values().sum(), topics })
        }
        Err(error) => {
            let reason = match &error {
                mcap::McapError::Io(source) => source.to_string(),
                other => other.to_string(),
            };
            state.health.failure = Some(reason.clone());
            Err(RecordError::Stopped { path: path.to_owned(), recorded: state.health.flushed, reason })
        }
    }
}

fn write_commands(pen: &mut Pen, receiver: &Receiver<Command>, shared: &Shared) -> Result<(), mcap::McapError> {
    let mut since_flush = Stopwatch::start();
    loop {
        let left_ms = (FLUSH_MS - since_flush.ms()).max(0.0);
        let command = match receiver.recv_timeout(Duration::from_secs_f64(left_ms / 1e3)) {
            Ok(Command::Finish) | Err(RecvTimeoutError::Disconnected) => return Ok(()),
            Ok(command) => Some(command),
            Err(RecvTimeoutError::Timeout) => None,
        };
        if let Some(command) = command {
            let bytes = command.bytes();
            pen.take(command)?;
            let mut state = shared.lock();
            state.waiting_bytes -= bytes;
            state.health.waiting -= 1;
            drop(state);
            shared.drained.notify_all();
        }
        if since_flush.ms() >= FLUSH_MS {
            pen.flush()?;
            shared.lock().health.flushed = pen.taken;
            since_flush = Stopwatch::start();
        }
    }
}
