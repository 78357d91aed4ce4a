//! What waits for the writer: whoever records leaves it here and goes on.

use std::collections::{HashMap, VecDeque};
use std::path::{Path, PathBuf};
use std::sync::{Condvar, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use super::RecordError;
use super::channel::Kind;
use super::chunk::ClosedChunk;
use crate::time::Stopwatch;

/// Waiting bytes beyond which producers of large messages wait.
const ROOM_BYTES: usize = 24 << 20;
/// Waiting bytes beyond which messages are refused: the disk has stood still for minutes.
const MOST_BYTES: usize = 512 << 20;
/// Beyond this a chunk is written before its time.
const EAGER_BYTES: usize = 4 << 20;
/// What waits in a queue besides its bytes, roughly.
const COMMAND_BYTES: usize = 64;

/// How recording goes; shared, and up to date within one write.
#[derive(Clone, Debug, Default, PartialEq, serde::Serialize)]
pub struct RecorderHealth {
    /// Messages handed to the recorder.
    pub accepted: u64,
    /// Messages that are in the file.
    pub flushed: u64,
    /// Messages that wait for the writer.
    pub waiting: u64,
    /// Bytes that wait for the writer.
    pub waiting_bytes: usize,
    /// Age of the oldest message that is not in the file yet. Large when the disk stands still.
    pub behind_ms: f64,
    /// Age of the oldest message that a kill of this program would lose now: one that is neither in the file nor with a keeper.
    pub kill_loses_ms: f64,
    /// How often the process that writes the file died and another took its place; nothing is lost by it.
    pub keepers_lost: u32,
    /// Messages that were refused because recording had stopped or was too far behind: lost.
    pub refused: u64,
    /// Why recording stopped; `None` while all is well.
    pub failure: Option<String>,
    /// The log has been moved or renamed; it is still written, but no longer at its path.
    pub moved: bool,
}

/// Something to be written, in order.
pub(super) enum Command {
    /// A channel is used for the first time; ids count from 1.
    Channel {
        id: u16,
        topic: String,
        kind: Kind,
    },
    Message {
        channel: u16,
        log_time_ns: u64,
        data: Vec<u8>,
    },
    /// A chunk that was compressed by whoever recorded it.
    Chunk(ClosedChunk),
    Attach {
        name: String,
        media_type: String,
        time_ns: u64,
        data: Vec<u8>,
    },
}

impl Command {
    fn bytes(&self) -> usize {
        COMMAND_BYTES
            + match self {
                Self::Channel { .. } => 0,
                Self::Message { data, .. } | Self::Attach { data, .. } => data.len(),
                Self::Chunk(chunk) => chunk.bytes.len(),
            }
    }
}

#[derive(Default)]
struct State {
    health: RecorderHealth,
    channels: HashMap<String, u16>,
    commands: VecDeque<Command>,
    /// When the oldest waiting command came.
    waiting_since: Option<Stopwatch>,
    /// Batches that the writer took and that are not in the file, the oldest first.
    taken: VecDeque<Taken>,
    taken_bytes: usize,
    /// Bytes of the log that are in its file.
    in_file: u64,
    /// What was handed over is in this process only.
    unkept: bool,
    /// Commands that ever came, and those among them that are in the file.
    put: u64,
    written: u64,
    /// Someone waits in `flush_now`, or the end is near: write at once.
    hurry: bool,
    finish: bool,
    /// The writer has ended; nothing can be recorded any more.
    closed: bool,
}

/// A batch that the writer took and that is not in the file yet.
struct Taken {
    /// When its oldest command came.
    since: Stopwatch,
    messages: u64,
    bytes: usize,
    /// Commands put up to its end.
    put: u64,
    /// Bytes of the log up to its end, once it is safe from a kill of this process.
    end: Option<u64>,
}

impl State {
    fn in_memory_bytes(&self) -> usize {
        self.health.waiting_bytes + self.taken_bytes
    }

    fn behind_ms(&self) -> f64 {
        self.taken.front().map(|batch| batch.since).or(self.waiting_since).map_or(0.0, |since| since.ms())
    }

    fn kill_loses_ms(&self) -> f64 {
        let exposed = self.taken.iter().find(|batch| self.unkept || batch.end.is_none()).map(|batch| batch.since);
        exposed.or(self.waiting_since).map_or(0.0, |since| since.ms())
    }
}

/// The queue between everyone who records and the one who writes.
pub(super) struct Queue {
    path: PathBuf,
    state: Mutex<State>,
    arrived: Condvar,
    written: Condvar,
}

/// What the writer gets.
pub(super) struct Batch {
    pub(super) commands: VecDeque<Command>,
    /// No more will come.
    pub(super) last: bool,
}

impl Queue {
    pub(super) fn new(path: &Path) -> Self {
        Self { path: path.to_owned(), state: Mutex::default(), arrived: Condvar::new(), written: Condvar::new() }
    }

    fn lock(&self) -> MutexGuard<'_, State> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }

    pub(super) fn health(&self) -> RecorderHealth {
        let state = self.lock();
        RecorderHealth { behind_ms: state.behind_ms(), kill_loses_ms: state.kill_loses_ms(), ..state.health.clone() }
    }

    /// The channel of `topic`, announced when it is new.
    fn channel(state: &mut State, topic: &str, kind: impl FnOnce() -> Kind) -> u16 {
        if let Some(id) = state.channels.get(topic) {
            return *id;
        }
        let id = state.channels.len() as u16 + 1;
        state.channels.insert(topic.to_owned(), id);
        Self::push(state, Command::Channel { id, topic: topic.to_owned(), kind: kind() });
        id
    }

    fn push(state: &mut State, command: Command) {
        state.waiting_since.get_or_insert_with(Stopwatch::start);
        state.health.waiting_bytes += command.bytes();
        state.put += 1;
        state.commands.push_back(command);
    }

    /// Takes messages `(topic, kind, log_time_ns, data)` and, behind them, a chunk; never waits.
    pub(super) fn put<'a, K: FnOnce() -> Kind>(
        &self,
        messages: impl IntoIterator<Item = (&'a str, K, u64, Vec<u8>)>,
        chunk: Option<ClosedChunk>,
    ) -> Result<(), RecordError> {
        let mut state = self.lock();
        let state = &mut *state;
        self.admit(state)?;
        for (topic, kind, log_time_ns, data) in messages {
            let channel = Self::channel(state, topic, kind);
            Self::push(state, Command::Message { channel, log_time_ns, data });
            state.health.accepted += 1;
            state.health.waiting += 1;
        }
        if let Some(chunk) = chunk {
            let count = chunk.counts.iter().map(|(_, count)| count).sum::<u64>();
            state.health.accepted += count;
            state.health.waiting += count;
            Self::push(state, Command::Chunk(chunk));
        }
        self.arrived.notify_one();
        Ok(())
    }

    pub(super) fn announce(&self, topic: &str, kind: Kind) -> u16 {
        Self::channel(&mut self.lock(), topic, || kind)
    }

    pub(super) fn attach(&self, name: &str, media_type: &str, time_ns: u64, data: &[u8]) -> Result<(), RecordError> {
        let mut state = self.lock();
        self.admit(&mut state)?;
        let (name, media_type) = (name.to_owned(), media_type.to_owned());
        Self::push(&mut state, Command::Attach { name, media_type, time_ns, data: data.to_vec() });
        self.arrived.notify_one();
        Ok(())
    }

    fn admit(&self, state: &mut State) -> Result<(), RecordError> {
        if state.closed || state.finish {
            state.health.refused += u64::from(state.health.failure.is_some());
            return Err(self.stopped(state));
        }
        let waiting_bytes = state.in_memory_bytes();
        if waiting_bytes > MOST_BYTES {
            state.health.refused += 1;
            return Err(RecordError::Behind { path: self.path.clone(), waiting_bytes, behind_ms: state.behind_ms() as u64 });
        }
        Ok(())
    }

    fn stopped(&self, state: &State) -> RecordError {
        let path = self.path.clone();
        match &state.health.failure {
            Some(reason) => RecordError::Stopped { path, recorded: state.health.flushed, reason: reason.clone() },
            None => RecordError::Finished { path },
        }
    }

    /// Waits until `bytes` more may wait; what is larger than the room needs half of it.
    pub(super) fn wait_for_room(&self, bytes: usize) -> Result<(), RecordError> {
        let mut state = self.lock();
        while !state.closed && state.in_memory_bytes() + bytes.min(ROOM_BYTES / 2) > ROOM_BYTES {
            state.hurry = true;
            self.arrived.notify_one();
            state = self.written.wait(state).unwrap_or_else(PoisonError::into_inner);
        }
        if state.closed { Err(self.stopped(&state)) } else { Ok(()) }
    }

    /// Waits until all that was put before is written, at most `limit`.
    pub(super) fn flush(&self, limit: Duration) -> Result<(), RecordError> {
        let watch = Stopwatch::start();
        let mut state = self.lock();
        let wanted = state.put;
        loop {
            if state.written >= wanted {
                return Ok(());
            }
            if state.closed {
                return Err(self.stopped(&state));
            }
            state.hurry = true;
            self.arrived.notify_one();
            let Some(left) = limit.checked_sub(Duration::from_secs_f64(watch.ms() / 1e3)).filter(|left| !left.is_zero()) else {
                let (waiting_bytes, behind_ms) = (state.in_memory_bytes(), state.behind_ms() as u64);
                return Err(RecordError::Behind { path: self.path.clone(), waiting_bytes, behind_ms });
            };
            state = self.written.wait_timeout(state, left).unwrap_or_else(PoisonError::into_inner).0;
        }
    }

    /// No more will be put.
    pub(super) fn finish(&self) {
        self.lock().finish = true;
        self.arrived.notify_one();
    }

    /// For the writer: waits until something has waited for `gather`, or must be written now, or `idle` has passed.
    pub(super) fn take(&self, gather: Duration, idle: Duration) -> std::io::Result<Batch> {
        let slept = Stopwatch::start();
        let mut state = self.lock();
        loop {
            let due = match state.waiting_since {
                Some(since) => gather.saturating_sub(Duration::from_secs_f64(since.ms() / 1e3)),
                None => idle.saturating_sub(Duration::from_secs_f64(slept.ms() / 1e3)),
            };
            if state.closed
                || state.finish
                || (state.hurry && state.waiting_since.is_some())
                || due.is_zero()
                || state.health.waiting_bytes >= EAGER_BYTES
            {
                break;
            }
            state = self.arrived.wait_timeout(state, due).unwrap_or_else(PoisonError::into_inner).0;
        }
        failure(&state)?;
        state.hurry = false;
        if let Some(since) = state.waiting_since.take() {
            let messages = std::mem::take(&mut state.health.waiting);
            let bytes = std::mem::take(&mut state.health.waiting_bytes);
            let put = state.put;
            state.taken_bytes += bytes;
            state.taken.push_back(Taken { since, messages, bytes, put, end: None });
        }
        Ok(Batch { commands: std::mem::take(&mut state.commands), last: state.finish })
    }

    /// For the writer: what was taken ends at byte `end` of the log, and a kill of this process does not lose it any more.
    pub(super) fn handed_over(&self, end: u64) {
        if let Some(batch) = self.lock().taken.back_mut() {
            batch.end.get_or_insert(end);
        }
    }

    /// For the writer: waits until the log's first `end` bytes are in the file.
    pub(super) fn wait_until_in_file(&self, end: u64) -> std::io::Result<()> {
        let mut state = self.lock();
        while state.in_file < end {
            failure(&state)?;
            state = self.written.wait(state).unwrap_or_else(PoisonError::into_inner);
        }
        Ok(())
    }

    /// For whoever writes the file: its first `end` bytes are written.
    pub(super) fn in_file(&self, end: u64) {
        let mut state = self.lock();
        state.in_file = end;
        while let Some(batch) = state.taken.pop_front_if(|batch| batch.end.is_some_and(|its_end| its_end <= end)) {
            state.written = batch.put;
            state.health.flushed += batch.messages;
            state.taken_bytes -= batch.bytes;
        }
        self.written.notify_all();
    }

    /// For whoever writes the file: whether it is still at its path.
    pub(super) fn placed(&self, moved: bool) {
        self.lock().health.moved = moved;
    }

    /// The process that writes the file died: what it has not written is in this process only.
    pub(super) fn keeper_left(&self) {
        let mut state = self.lock();
        state.health.keepers_lost += 1;
        state.unkept = true;
    }

    /// Another process took its place.
    pub(super) fn keeper_came(&self) {
        self.lock().unkept = false;
    }

    /// Nothing can be written any more. What is not in the file is lost and counted.
    pub(super) fn close(&self, failure: Option<String>) {
        let mut state = self.lock();
        if let Some(reason) = failure {
            state.health.refused += state.taken.iter().map(|batch| batch.messages).sum::<u64>() + state.health.waiting;
            state.health.failure.get_or_insert(reason);
        }
        state.closed = true;
        state.commands.clear();
        state.taken.clear();
        state.health.waiting = 0;
        (state.taken_bytes, state.health.waiting_bytes) = (0, 0);
        state.waiting_since = None;
        self.arrived.notify_all();
        self.written.notify_all();
    }
}

/// Why nothing can be written any more, if that is so.
fn failure(state: &State) -> std::io::Result<()> {
    match &state.health.failure {
        Some(reason) if state.closed => Err(std::io::Error::other(reason.clone())),
        _ => Ok(()),
    }
}
