//! Recording: messages go into a queue, a thread of its own writes them, and everyone can see how it goes.

use std::collections::HashMap;
use std::fs::{File, OpenOptions};
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex, PoisonError};
use std::thread::JoinHandle;
use std::time::Duration;

use foxglove::Encode;

use super::channel::Kind;
use super::chunk::{ClosedChunk, OpenChunk};
use super::messages::{self, BeadMark, Level, Placed};
use super::queue::{Queue, RecorderHealth};
use super::sink::{LogTarget, OwnFile, Sink};
use super::writer::{Summary, write_until_finished};
use super::{Provenance, RecordError, topic};
use crate::acquire::{Frame, Samples};
use crate::geometry::View;
use crate::image::{Image, sha256_bytes, sync_folder};
use crate::time::Stopwatch;

/// How often whoever leaves looks whether the writer has ended.
const LOOK: Duration = Duration::from_millis(5);

/// Records a session. All methods take `&self`; several threads may record at once, and the log keeps the order of their calls.
///
/// Nothing waits for the disk but [`Recorder::frame`], [`Recorder::drr`], [`Recorder::wait_for_room`], [`Recorder::flush_now`] and
/// [`Recorder::finish`]. Large messages are compressed by whoever records them, so that they do not delay telemetry.
pub struct Recorder {
    path: PathBuf,
    /// The file, whoever writes it; none in tests that record into something else.
    log: Option<File>,
    queue: Arc<Queue>,
    /// Channels of large messages, and how many of each were prepared.
    prepared: Mutex<HashMap<&'static str, (u16, u32)>>,
    thread: Mutex<Option<JoinHandle<Result<Summary, RecordError>>>>,
}

/// A large message that is ready to be recorded: compressed, but not yet part of the log.
#[derive(Debug)]
pub struct Prepared {
    /// Goes directly before the chunk: topic, time, content.
    before: (&'static str, u64, Vec<u8>),
    before_kind: Kind,
    chunk: ClosedChunk,
}

impl Prepared {
    /// What it will take in the queue, for [`Recorder::wait_for_room`].
    #[must_use]
    pub fn bytes(&self) -> usize {
        self.chunk.bytes.len() + self.before.2.len()
    }
}

impl std::fmt::Debug for Recorder {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Recorder").field("path", &self.path).field("health", &self.health()).finish()
    }
}

impl Recorder {
    /// Creates `path` and starts the writer; the first message is `provenance`. This process writes the file itself: a kill −9 while the
    /// disk stands still loses what came meanwhile.
    ///
    /// # Errors
    /// When the file exists or cannot be created.
    pub fn create(path: &Path, provenance: &Provenance) -> Result<Self, RecordError> {
        let (queue, file) = (Arc::new(Queue::new(path)), new_file(path)?);
        let log = Some(another(path, &file)?);
        Self::start((path, log), &queue, Box::new(OwnFile::of(path, file, &queue)?), provenance)
    }

    /// As [`Recorder::create`], but the file is written by a process of its own, which a kill −9 of this one leaves alone: `program`,
    /// which must know `keep-log`. Where that cannot be started, this process writes the file, and the error says why. Linux only;
    /// elsewhere this is [`Recorder::create`].
    ///
    /// # Errors
    /// When the file exists or cannot be created.
    pub fn create_kept(
        path: &Path,
        program: &Path,
        provenance: &Provenance,
    ) -> Result<(Self, Option<std::io::Error>), RecordError> {
        let (queue, file) = (Arc::new(Queue::new(path)), new_file(path)?);
        let log = Some(another(path, &file)?);
        let (sink, unkept): (Box<dyn Sink>, _) = match keeper(program, path, &file, &queue) {
            Ok(Some(kept)) => (kept, None),
            Ok(None) => (Box::new(OwnFile::of(path, file, &queue)?), None),
            Err(error) => (Box::new(OwnFile::of(path, file, &queue)?), Some(error)),
        };
        Ok((Self::start((path, log), &queue, sink, provenance)?, unkept))
    }

    /// Records into `target`; `path` serves messages only.
    ///
    /// # Errors
    /// When `provenance` cannot be written as JSON or the thread cannot be started.
    pub fn to_target(path: &Path, target: Box<dyn LogTarget>, provenance: &Provenance) -> Result<Self, RecordError> {
        let queue = Arc::new(Queue::new(path));
        let sink =
            OwnFile { target, watched: None, path: path.to_owned(), queue: Arc::clone(&queue), delivered: 0, at_rest: false };
        Self::start((path, None), &queue, Box::new(sink), provenance)
    }

    fn start(
        (path, log): (&Path, Option<File>),
        queue: &Arc<Queue>,
        sink: Box<dyn Sink>,
        provenance: &Provenance,
    ) -> Result<Self, RecordError> {
        let mut prepared = HashMap::new();
        for (topic, kind) in Kind::announced() {
            let id = queue.announce(topic, kind);
            prepared.insert(topic, (id, 0));
        }
        let queue = Arc::clone(queue);
        let thread = std::thread::Builder::new()
            .name("recorder".into())
            .spawn({
                let (path, queue) = (path.to_owned(), Arc::clone(&queue));
                move || write_until_finished(&path, sink, &queue)
            })
            .map_err(|source| RecordError::Io { path: path.to_owned(), source })?;
        let (prepared, thread) = (Mutex::new(prepared), Mutex::new(Some(thread)));
        let recorder = Self { path: path.to_owned(), log, queue, prepared, thread };
        recorder.json(topic::PROVENANCE, provenance.started_us, provenance)?;
        Ok(recorder)
    }

    /// How recording goes.
    #[must_use]
    pub fn health(&self) -> RecorderHealth {
        self.queue.health()
    }

    /// Bytes of one read from the serial line of `device` (`carm` or `robot`), on `/DEVICE/raw`. Never waits.
    ///
    /// # Errors
    /// When recording has stopped.
    pub fn raw_bytes(&self, device: &str, epoch: u32, host_us: i64, bytes: &[u8]) -> Result<(), RecordError> {
        let mut data = Vec::with_capacity(4 + bytes.len());
        data.extend_from_slice(&epoch.to_le_bytes());
        data.extend_from_slice(bytes);
        self.message(Kind::raw, &format!("/{device}/raw"), host_us, data)
    }

    /// Any value as JSON on any topic. Never waits.
    ///
    /// # Errors
    /// When `value` has no JSON form or recording has stopped.
    pub fn json(&self, topic: &str, host_us: i64, value: &impl serde::Serialize) -> Result<(), RecordError> {
        self.message(|| Kind::json(topic), topic, host_us, as_json(topic, value)?)
    }

    /// An acquired frame: tags and domain on `/frames/tags`, then the pixels, bit for bit, on `/frames/acquired`. Waits until there is
    /// room.
    ///
    /// # Errors
    /// When recording has stopped.
    pub fn frame(&self, frame: &Frame, host_us: i64) -> Result<(), RecordError> {
        self.record_when_there_is_room(self.prepare_frame(frame, host_us)?)
    }

    /// The slow part of [`Recorder::frame`], without recording anything yet.
    ///
    /// # Errors
    /// When the tags have no JSON form.
    pub fn prepare_frame(&self, frame: &Frame, host_us: i64) -> Result<Prepared, RecordError> {
        let samples = Samples::from_pixels(&frame.pixels.pixels);
        let image = messages::raw_image(&samples, frame.pixels.width, frame.pixels.height, "camera", host_us);
        let image = messages::encoded(&image);
        let tags = as_json(topic::FRAME_TAGS, &messages::TagsOf { frame, message_sha256: sha256_bytes(&image) })?;
        let chunk = self.chunk_of(topic::FRAME_PIXELS, host_us, &image);
        let before = (topic::FRAME_TAGS, nanoseconds(host_us), tags);
        Ok(Prepared { before, before_kind: Kind::json(topic::FRAME_TAGS), chunk })
    }

    /// A rendered image of `name`, bit for bit, on `/frames/drr`. Waits until there is room.
    ///
    /// # Errors
    /// When recording has stopped.
    pub fn drr(&self, name: &str, image: &Image<f32>, host_us: i64) -> Result<(), RecordError> {
        self.record_when_there_is_room(self.prepare_drr(name, image, host_us))
    }

    /// The slow part of [`Recorder::drr`], without recording anything yet.
    #[must_use]
    pub fn prepare_drr(&self, name: &str, image: &Image<f32>, host_us: i64) -> Prepared {
        let samples = Samples::F32(image.pixels.clone());
        let message = messages::raw_image(&samples, image.width, image.height, "camera", host_us);
        let chunk = self.chunk_of(topic::DRR, host_us, &messages::encoded(&message));
        let event = messages::encoded(&messages::log(Level::Info, &format!("DRR of {name}"), host_us));
        let before = (topic::EVENTS, nanoseconds(host_us), event);
        Prepared { before, before_kind: Kind::foxglove::<foxglove::messages::Log>(), chunk }
    }

    fn chunk_of(&self, topic: &'static str, host_us: i64, data: &[u8]) -> ClosedChunk {
        let (channel, sequence) = {
            let mut prepared = self.prepared.lock().unwrap_or_else(PoisonError::into_inner);
            prepared.get_mut(topic).map_or((0, 0), |(channel, count)| {
                *count += 1;
                (*channel, *count)
            })
        };
        let mut chunk = OpenChunk::default();
        chunk.message(channel, sequence, nanoseconds(host_us), data);
        chunk.close()
    }

    fn record_when_there_is_room(&self, prepared: Prepared) -> Result<(), RecordError> {
        self.wait_for_room(prepared.bytes())?;
        self.record(prepared)
    }

    /// Records what was prepared; its place in the log is that of this call. Never waits.
    ///
    /// # Errors
    /// When recording has stopped.
    pub fn record(&self, prepared: Prepared) -> Result<(), RecordError> {
        let Prepared { before: (topic, log_time_ns, data), before_kind, chunk } = prepared;
        self.queue.put([(topic, || before_kind, log_time_ns, data)], Some(chunk))
    }

    /// Waits until `bytes` more may be recorded without piling up in memory: producers of large messages call it before they take a lock
    /// that others need.
    ///
    /// # Errors
    /// When recording has stopped.
    pub fn wait_for_room(&self, bytes: usize) -> Result<(), RecordError> {
        self.queue.wait_for_room(bytes)
    }

    /// Waits until everything recorded before is in the file, at most `limit`.
    ///
    /// # Errors
    /// When the disk does not follow in time, or recording has stopped.
    pub fn flush_now(&self, limit: Duration) -> Result<(), RecordError> {
        self.queue.flush(limit)
    }

    /// The geometry of a pose for Foxglove's image and 3D panels: intrinsics, `placed` as where the frame stands in the tree, beads. The pose itself is JSON on `/pose`.
    ///
    /// # Errors
    /// When recording has stopped.
    pub fn pose_geometry(&self, view: &View, placed: &[Placed], beads: &[BeadMark], host_us: i64) -> Result<(), RecordError> {
        self.foxglove(topic::CALIBRATION, host_us, &messages::calibration(view, host_us))?;
        if !placed.is_empty() {
            self.transforms(topic::TRANSFORMS, placed, host_us)?;
        }
        self.foxglove(topic::ANNOTATIONS, host_us, &messages::annotations(beads, host_us))
    }

    /// Frames in their parents, on `topic`.
    ///
    /// # Errors
    /// When recording has stopped.
    pub fn transforms(&self, topic: &str, placed: &[Placed], host_us: i64) -> Result<(), RecordError> {
        self.foxglove(topic, host_us, &messages::transforms(placed, host_us))
    }

    /// A picture for the eye, on `/camera/image`. Waits until there is room.
    ///
    /// # Errors
    /// When recording has stopped.
    pub fn shown(&self, image: &Image<u8>, host_us: i64) -> Result<(), RecordError> {
        let message = messages::encoded(&messages::gray_image(image, "camera", host_us));
        // In a chunk of its own: the writer has no pixels to compress.
        let chunk = self.chunk_of(topic::SHOWN, host_us, &message);
        self.wait_for_room(chunk.bytes.len())?;
        self.queue.put(std::iter::empty::<(&str, fn() -> Kind, u64, Vec<u8>)>(), Some(chunk))
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
        self.queue.attach(name, media_type, nanoseconds(host_us), data)
    }

    /// Writes what waits, the summary and the footer, and waits until all of it is on the disk.
    ///
    /// # Errors
    /// When writing failed now or earlier, or the log was finished before.
    pub fn finish(&self) -> Result<Summary, RecordError> {
        let thread = self.last_taken()?;
        let summary = self.ended(thread)?;
        if let Some(log) = &self.log {
            log.sync_all().map_err(|source| RecordError::Io { path: self.path.clone(), source })?;
            sync_folder(&self.path);
        }
        Ok(summary)
    }

    /// As [`Self::finish`], of a disk that may stand still: waits for so long, and not for what the system has still to put on the disk. `None`
    /// when the file is not written to its end by then, and a process of its own writes what is left of it: all is handed over, and this process
    /// may end.
    ///
    /// # Errors
    /// As [`Self::finish`]; when the disk does not follow in time, and nobody else has what is left.
    pub fn finish_within(&self, limit: Duration) -> Result<Option<Summary>, RecordError> {
        let thread = self.last_taken()?;
        let watch = Stopwatch::start();
        while !thread.is_finished() && watch.ms() < limit.as_secs_f64() * 1e3 {
            std::thread::sleep(LOOK);
        }
        if thread.is_finished() {
            return self.ended(thread).map(Some);
        }
        let health = self.health();
        match health.kill_loses_ms > 0.0 {
            false => Ok(None),
            true => Err(RecordError::Behind {
                path: self.path.clone(),
                waiting_bytes: health.waiting_bytes,
                behind_ms: health.behind_ms as u64,
            }),
        }
    }

    /// Takes no more; the thread that writes what there is.
    fn last_taken(&self) -> Result<JoinHandle<Result<Summary, RecordError>>, RecordError> {
        let finished = || RecordError::Finished { path: self.path.clone() };
        let thread = self.thread.lock().unwrap_or_else(PoisonError::into_inner).take().ok_or_else(finished)?;
        // When the writer has already stopped, its own result says why.
        self.queue.finish();
        Ok(thread)
    }

    /// How the writer's thread ended.
    fn ended(&self, thread: JoinHandle<Result<Summary, RecordError>>) -> Result<Summary, RecordError> {
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
        self.message(Kind::foxglove::<M>, topic, host_us, messages::encoded(message))
    }

    fn message(&self, kind: impl FnOnce() -> Kind, topic: &str, host_us: i64, data: Vec<u8>) -> Result<(), RecordError> {
        self.queue.put([(topic, kind, nanoseconds(host_us), data)], None)
    }
}

fn new_file(path: &Path) -> Result<File, RecordError> {
    OpenOptions::new().write(true).create_new(true).open(path).map_err(|source| match source.kind() {
        std::io::ErrorKind::AlreadyExists => RecordError::Exists { path: path.to_owned() },
        _ => RecordError::Io { path: path.to_owned(), source },
    })
}

/// Another handle of the same file.
fn another(path: &Path, file: &File) -> Result<File, RecordError> {
    file.try_clone().map_err(|source| RecordError::Io { path: path.to_owned(), source })
}

#[cfg(target_os = "linux")]
fn keeper(program: &Path, path: &Path, file: &File, queue: &Arc<Queue>) -> std::io::Result<Option<Box<dyn Sink>>> {
    Ok(Some(Box::new(super::handover::Handover::start(program, path, file, queue)?)))
}

/// Elsewhere there is no memory that two processes share by a plain file handle.
#[cfg(not(target_os = "linux"))]
fn keeper(_: &Path, _: &Path, _: &File, _: &Arc<Queue>) -> std::io::Result<Option<Box<dyn Sink>>> {
    Ok(None)
}

fn as_json(topic: &str, value: &impl serde::Serialize) -> Result<Vec<u8>, RecordError> {
    serde_json::to_vec(value).map_err(|source| RecordError::Json { topic: topic.to_owned(), source })
}

fn nanoseconds(host_us: i64) -> u64 {
    (host_us.max(0) as u64).saturating_mul(1000)
}

impl Drop for Recorder {
    fn drop(&mut self) {
        // A recorder that is dropped without `finish` still closes its log; its result was not asked for.
        let _ = self.finish();
    }
}
