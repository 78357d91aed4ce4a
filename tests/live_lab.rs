//! A mocked lab and a `sidecarm live` beside it, as processes: what the tests of sessions that go wrong are made of.
#![cfg(unix)]

use std::collections::{BTreeMap, BTreeSet};
use std::io::{BufRead, BufReader, Read};
use std::path::{Path, PathBuf};
use std::process::{Child, Command, ExitStatus, Stdio};
use std::sync::{Arc, Mutex, OnceLock};
use std::time::Duration;

use serde_json::Value;
use sidecarm::image::sha256_file;
use sidecarm::record::{LogLoss, read_log, topic};
use sidecarm::telemetry::{Decoder, DeviceKind, Event};
use sidecarm::time::{Stopwatch, host_now_us};

pub use rustix::process::Signal;

/// What does not happen within this hangs, however crowded the machine is.
pub const HANG_S: f64 = 400.0;

/// Checks every few milliseconds whether `fact` holds; `None` when it does not within `limit_s`. A check that takes long, as that of a whole
/// log, is made less often: it would take the processor from what it waits for.
pub fn eventually<T>(limit_s: f64, mut fact: impl FnMut() -> Option<T>) -> Option<T> {
    let watch = Stopwatch::start();
    loop {
        let asked_ms = watch.ms();
        if let Some(found) = fact() {
            return Some(found);
        }
        let now_ms = watch.ms();
        if now_ms > limit_s * 1e3 {
            return None;
        }
        std::thread::sleep(Duration::from_secs_f64(1e-3 * (3.0 * (now_ms - asked_ms)).max(5.0)));
    }
}

fn mock_program() -> Option<PathBuf> {
    let path = Path::new(env!("CARGO_BIN_EXE_sidecarm")).with_file_name(format!("mock-lab{}", std::env::consts::EXE_SUFFIX));
    if !path.exists() {
        println!("skipped: mock-lab is not beside sidecarm; cargo build --workspace makes it");
    }
    Some(path).filter(|path| path.exists())
}

/// Where mock-lab keeps the CT and the pictures that it has drawn: most labs have the same.
pub fn drawn() -> &'static Path {
    static DRAWN: OnceLock<PathBuf> = OnceLock::new();
    DRAWN.get_or_init(|| {
        let folder = Path::new(env!("CARGO_TARGET_TMPDIR")).join("drawn");
        // Those of another build may be others.
        let _ = std::fs::remove_dir_all(&folder);
        std::fs::create_dir_all(&folder).expect("a folder");
        folder
    })
}

/// Ends a process when the test ends, however it ends.
pub struct Running(pub Child);

impl Running {
    pub fn signal(&self, signal: Signal) {
        let pid = rustix::process::Pid::from_child(&self.0);
        rustix::process::kill_process(pid, signal).expect("the process is there");
    }

    /// How it ended, if it does within `limit_s`.
    pub fn end(&mut self, limit_s: f64) -> Option<ExitStatus> {
        eventually(limit_s, || self.0.try_wait().expect("a child can be asked"))
    }

    /// SIGKILL; gives the host time just before it.
    pub fn kill(&mut self) -> i64 {
        let before_us = host_now_us();
        self.0.kill().expect("the process is there");
        self.0.wait().expect("a killed process ends");
        before_us
    }

    pub fn id(&self) -> u32 {
        self.0.id()
    }
}

impl Drop for Running {
    fn drop(&mut self) {
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

/// The process that writes `log` for another one.
pub fn keeper(log: &Path) -> Option<rustix::process::Pid> {
    process_with(&[&b"keep-log"[..], log.as_os_str().as_encoded_bytes()])
}

/// A process of which these are the first arguments.
pub fn process_with(arguments: &[&[u8]]) -> Option<rustix::process::Pid> {
    std::fs::read_dir("/proc").into_iter().flatten().flatten().find_map(|entry| {
        let pid = entry.file_name().to_str()?.parse().ok()?;
        let words = std::fs::read(entry.path().join("cmdline")).ok()?;
        let words = words.split(|byte| *byte == 0).skip(1).take(arguments.len());
        words.eq(arguments.iter().copied()).then(|| rustix::process::Pid::from_raw(pid))?
    })
}

/// A packet that left a mocked device.
#[derive(Clone, Copy, Debug)]
pub struct Sent {
    pub host_us: i64,
    pub device: DeviceKind,
    pub sequence: u32,
}

/// A running mock-lab.
pub struct Lab {
    _folder: tempfile::TempDir,
    pub kit: PathBuf,
    pub mock: Running,
}

impl Lab {
    /// Starts mock-lab and waits until its ports are there; `None` (said) where it was not built.
    pub fn start(args: &[&str]) -> Option<Self> {
        let program = mock_program()?;
        let folder = tempfile::tempdir().expect("temporary folder");
        let kit = folder.path().join("lab");
        let mut command = Command::new(program);
        command.arg("--out").arg(&kit).arg("--sent").arg(folder.path().join("sent.csv")).arg("--drawn").arg(drawn()).args(args);
        let child = command.stdout(Stdio::piped()).stderr(Stdio::null()).spawn().expect("mock-lab starts");
        let mut mock = Running(child);
        let out = mock.0.stdout.take().expect("piped");
        let (told, ready) = std::sync::mpsc::channel();
        // Reads on to the end, so that the mock is never held up by a full pipe.
        std::thread::spawn(move || {
            for line in BufReader::new(out).lines().map_while(Result::ok) {
                let _ = told.send(line);
            }
        });
        let first = ready.recv_timeout(Duration::from_secs(120)).expect("mock-lab says that it is ready");
        assert!(first.contains("\"ready\"") || args.contains(&"--kit-only"), "{first}");
        Some(Self { _folder: folder, kit, mock })
    }

    /// As [`Lab::start`], with [`Lab::without_ct`].
    pub fn start_without_ct(args: &[&str]) -> Option<Self> {
        Self::start(args).map(Self::without_ct)
    }

    pub fn frames(&self) -> PathBuf {
        self.kit.join("frames")
    }

    /// What left the devices so far.
    pub fn sent(&self) -> Vec<Sent> {
        let text = std::fs::read_to_string(self.kit.with_file_name("sent.csv")).expect("the list is there");
        let whole = text.rsplit_once('\n').map_or("", |(whole, _)| whole);
        let packet = |line: &str| {
            let mut fields = line.split(',');
            let host_us = fields.next()?.parse().ok()?;
            let device = if fields.next()? == "carm" { DeviceKind::Carm } else { DeviceKind::Robot };
            Some(Sent { host_us, device, sequence: fields.next()?.parse().ok()? })
        };
        whole.lines().map(|line| packet(line).unwrap_or_else(|| panic!("{line}"))).collect()
    }

    /// Takes the CT out of the scene: what costs a pair most is drawing it, and poses, bindings and what is said of both do not hang on it.
    #[must_use]
    pub fn without_ct(self) -> Self {
        let path = self.kit.join("scene.json");
        let mut scene: Value = serde_json::from_slice(&std::fs::read(&path).expect("a scene")).expect("JSON");
        let objects = scene["objects"].as_array_mut().expect("a list");
        let count = objects.len();
        objects.retain(|object| object["ct"].is_null());
        assert_eq!(objects.len() + 1, count, "there was one");
        std::fs::write(&path, scene.to_string()).expect("written");
        self
    }

    /// The session file with changes.
    pub fn session(&self, name: &str, change: impl FnOnce(&mut Value)) -> PathBuf {
        let text = std::fs::read(self.kit.join("session.json")).expect("the session file");
        let mut value: Value = serde_json::from_slice(&text).expect("JSON");
        change(&mut value);
        let path = self.kit.join(name);
        std::fs::write(&path, value.to_string()).expect("written");
        path
    }

    /// Files complete in the frames' folder: content hash and host time of the last change.
    pub fn delivered(&self) -> Vec<(String, i64)> {
        let mut found = Vec::new();
        for entry in std::fs::read_dir(self.frames()).expect("the folder is there").flatten() {
            // A frame is written under another name and renamed: what was listed may be gone.
            let Ok(metadata) = entry.metadata() else { continue };
            let modified = metadata.modified().expect("a time");
            let since = modified.duration_since(std::time::UNIX_EPOCH).expect("after 1970");
            if entry.path().extension().is_some_and(|extension| extension == "dcm") {
                found.push((sha256_file(&entry.path()).expect("readable"), since.as_micros() as i64));
            }
        }
        found
    }
}

/// A running `sidecarm live --headless`.
pub struct Live {
    pub program: Running,
    pub out: PathBuf,
    pub log: PathBuf,
    /// When the log had been seen to grow: everything sent from then on must be in it.
    pub recording_us: i64,
    words: [Arc<Mutex<String>>; 2],
}

fn collect(mut stream: impl Read + Send + 'static) -> Arc<Mutex<String>> {
    let text = Arc::new(Mutex::new(String::new()));
    let shared = Arc::clone(&text);
    std::thread::spawn(move || {
        let mut buffer = [0u8; 4096];
        while let Ok(count @ 1..) = stream.read(&mut buffer) {
            shared.lock().expect("not poisoned").push_str(&String::from_utf8_lossy(&buffer[..count]));
        }
    });
    text
}

impl Live {
    /// Starts the program without waiting for anything.
    pub fn launch(session: &Path, out: &Path, args: &[&str]) -> Self {
        Self::spawn(Command::new(env!("CARGO_BIN_EXE_sidecarm")), session, out, args)
    }

    /// Starts the program with its window on the screen `display`, without waiting for anything.
    pub fn launch_windowed(session: &Path, out: &Path, display: &str) -> Self {
        let mut command = Command::new(env!("CARGO_BIN_EXE_sidecarm"));
        command.env("DISPLAY", display).env_remove("WAYLAND_DISPLAY").env_remove("WAYLAND_SOCKET");
        Self::spawned(command, session, out, &[])
    }

    /// The same, and waits until telemetry has reached the log.
    pub fn windowed(session: &Path, out: &Path, display: &str) -> Self {
        Self::launch_windowed(session, out, display).recording()
    }

    fn spawn(command: Command, session: &Path, out: &Path, args: &[&str]) -> Self {
        Self::spawned(command, session, out, &[&["--headless"], args].concat())
    }

    fn spawned(mut command: Command, session: &Path, out: &Path, args: &[&str]) -> Self {
        command.arg("live").arg(session).arg("--out").arg(out).args(args);
        let child = command.stdin(Stdio::null()).stdout(Stdio::piped()).stderr(Stdio::piped()).spawn();
        let mut program = Running(child.expect("the program starts"));
        let words = [collect(program.0.stdout.take().expect("piped")), collect(program.0.stderr.take().expect("piped"))];
        Self { program, out: out.to_owned(), log: out.join("session.mcap"), recording_us: 0, words }
    }

    /// Starts the program and waits until telemetry has reached the log.
    pub fn start(session: &Path, out: &Path, args: &[&str]) -> Self {
        Self::launch(session, out, args).recording()
    }

    /// As [`Live::start`], in a process group of its own, as a shell starts it.
    pub fn start_in_own_group(session: &Path, out: &Path) -> Self {
        let mut command = Command::new(env!("CARGO_BIN_EXE_sidecarm"));
        std::os::unix::process::CommandExt::process_group(&mut command, 0);
        Self::spawn(command, session, out, &[]).recording()
    }

    /// As [`Live::launch`], with parts that die, hang or are slow: `breaks` is a list of `PART:NUMBER` (`src/session/fault.rs`).
    pub fn breaking(session: &Path, out: &Path, breaks: &str) -> Self {
        Self::launch_told(session, out, ("SIDECARM_BREAKS", breaks))
    }

    /// As [`Live::launch`], with a word in the program's environment.
    pub fn launch_told(session: &Path, out: &Path, (name, value): (&str, &str)) -> Self {
        let mut command = Command::new(env!("CARGO_BIN_EXE_sidecarm"));
        command.env(name, value);
        Self::spawn(command, session, out, &[])
    }

    /// As [`Live::launch`], where no file of the program or of those that it starts may grow beyond so many blocks of the shell (512 or 1024 bytes).
    pub fn with_small_files(session: &Path, out: &Path, blocks: u32) -> Self {
        let mut command = Command::new("sh");
        // The system ends a program that writes more, unless that does not mind.
        let script = format!("trap '' XFSZ; ulimit -f {blocks} && exec \"$@\"");
        command.args(["-c", &script, "sh", env!("CARGO_BIN_EXE_sidecarm")]);
        Self::spawn(command, session, out, &[])
    }

    /// Waits until telemetry has reached the log.
    pub fn recording(self) -> Self {
        let mut live = self;
        let grown = eventually(HANG_S, || {
            let log = read_log(&live.log).ok()?;
            let raw = log.entries.iter().filter(|entry| [topic::CARM_RAW, topic::ROBOT_RAW].contains(&&*entry.topic)).count();
            (raw >= 4).then_some(())
        });
        assert!(grown.is_some(), "no telemetry ever came into the log: {}", live.stderr());
        live.recording_us = host_now_us();
        live
    }

    /// SIGKILL to the program, not to its keeper; waits until that has written what it holds. Gives the host time just before the kill.
    pub fn kill(&mut self) -> i64 {
        let before_us = self.program.kill();
        assert!(eventually(HANG_S, || keeper(&self.log).is_none().then_some(())).is_some(), "the keeper never leaves");
        before_us
    }

    /// Sends a signal and waits until the program has said that it heard it; gives the host time of the signal.
    pub fn signalled(&self, signal: Signal) -> i64 {
        let signal_us = host_now_us();
        self.program.signal(signal);
        let heard = eventually(HANG_S, || self.stderr().contains("ending the session").then_some(()));
        assert!(heard.is_some(), "{signal:?} is not heard: {}", self.stderr());
        signal_us
    }

    pub fn stdout(&self) -> String {
        self.words[0].lock().expect("not poisoned").clone()
    }

    pub fn stderr(&self) -> String {
        self.words[1].lock().expect("not poisoned").clone()
    }

    pub fn report(&self) -> String {
        std::fs::read_to_string(self.out.join("report.html")).unwrap_or_default()
    }

    /// Pairs in `pairs.json`.
    pub fn pairs(&self) -> usize {
        pairs_in(&self.out)
    }

    pub fn heard(&self) -> Heard {
        Heard::of(&self.log)
    }

    /// Whether a session in a lab that makes no exposure, which has ended with `code`, lost nothing but them.
    pub fn lacks_exposures_alone(&self, code: Option<i32>) -> bool {
        // Who reads what it prints lets go of it at its end.
        assert!(eventually(HANG_S, || (Arc::strong_count(&self.words[0]) == 1).then_some(())).is_some(), "it prints on");
        let (words, mut lost) = (self.stdout(), 0);
        let is_that = |line: &str| line.contains("told of no exposure");
        let alone = words.lines().filter(|line| line.contains("lost: ")).inspect(|_| lost += 1).all(is_that);
        code == Some(3) && alone && lost == 1
    }
}

/// Pairs in the `pairs.json` of a session's folder.
pub fn pairs_in(out: &Path) -> usize {
    let bytes = std::fs::read(out.join("pairs.json")).unwrap_or_default();
    let value: Value = serde_json::from_slice(&bytes).unwrap_or_default();
    value["pairs"].as_array().map_or(0, Vec::len)
}

/// What a log holds.
#[derive(Debug, Default)]
pub struct Heard {
    /// Sequence numbers of intact packets, and the host time of their last byte.
    pub packets: BTreeMap<(DeviceKind, u32), i64>,
    /// Content hashes of the frames whose pixels are there.
    pub frames: BTreeSet<String>,
    /// Images in all.
    pub images: usize,
    /// Host time of the session's end.
    pub end_us: Option<i64>,
    pub losses: Vec<LogLoss>,
}

impl Heard {
    pub fn of(log: &Path) -> Self {
        let contents = read_log(log).expect("the log opens");
        let mut heard = Self { losses: contents.losses, ..Self::default() };
        let mut decoders = DeviceKind::ALL.map(|device| (device, Decoder::new(device), None));
        let mut tags: Option<Value> = None;
        for entry in &contents.entries {
            match &*entry.topic {
                topic::FRAME_TAGS => tags = entry.json().ok(),
                topic::FRAME_PIXELS => {
                    let tags = tags.take().expect("tags come before pixels");
                    heard.frames.insert(tags["sha256"].as_str().expect("a hash").to_owned());
                    heard.images += 1;
                }
                "/session/end" => heard.end_us = Some(entry.host_us),
                _ => {}
            }
            for (device, decoder, epoch) in &mut decoders {
                if *entry.topic != format!("/{}/raw", device.key()) {
                    continue;
                }
                let raw = entry.raw_bytes().expect("sound").expect("raw bytes");
                if *epoch != Some(raw.epoch) {
                    decoder.begin_epoch();
                    *epoch = Some(raw.epoch);
                }
                decoder.push(raw.bytes, &mut |event| {
                    if let Event::Sample(sample, _) = event {
                        heard.packets.insert((*device, sample.sequence()), entry.host_us);
                    }
                });
            }
        }
        heard
    }

    /// Of what was sent between two host times, how much is not in the log.
    pub fn missing(&self, sent: &[Sent], from_us: i64, to_us: i64) -> Missing {
        let span: Vec<&Sent> = sent.iter().filter(|packet| (from_us..to_us).contains(&packet.host_us)).collect();
        let gone: Vec<&&Sent> =
            span.iter().filter(|packet| !self.packets.contains_key(&(packet.device, packet.sequence))).collect();
        let oldest_us = gone.iter().map(|packet| packet.host_us).min();
        let read_us = |packet: &&Sent| Some(self.packets.get(&(packet.device, packet.sequence))? - packet.host_us);
        Missing {
            sent: span.len(),
            lost: gone.len(),
            oldest_ms: oldest_us.map_or(0.0, |us| (to_us - us) as f64 * 1e-3),
            slowest_read_ms: span.iter().copied().filter_map(|packet| read_us(&packet)).max().unwrap_or(0) as f64 * 1e-3,
        }
    }
}

/// Packets that are not in a log.
#[derive(Clone, Copy, Debug, Default)]
pub struct Missing {
    pub sent: usize,
    pub lost: usize,
    /// From the oldest missing packet to the end of the span.
    pub oldest_ms: f64,
    /// The longest that a packet, once sent, took through the line and its driver to the program, of those in the log.
    pub slowest_read_ms: f64,
}

/// Frames of the mock, of other content each: `count` files in a folder of their own.
pub fn copies(frame: &Path, count: usize, folder: &Path) -> Vec<PathBuf> {
    let bytes = std::fs::read(frame).expect("a frame");
    std::fs::create_dir_all(folder).expect("a folder");
    let copy = |index: usize| {
        let mut bytes = bytes.clone();
        // The last pixels: another content, the same picture.
        let end = bytes.len();
        bytes[end - 4..].copy_from_slice(&(index as u32).to_le_bytes());
        let path = folder.join(format!("burst-{index:04}.dcm"));
        std::fs::write(&path, bytes).expect("written");
        path
    };
    (0..count).map(copy).collect()
}

/// One file of `count` images: the mock's frame again and again, each with other last pixels.
pub fn many_images(frame: &Path, count: usize, path: &Path) {
    use dicom_core::{DataElement, PrimitiveValue, VR};
    use dicom_dictionary_std::tags;
    let mut object = dicom_object::open_file(frame).expect("a DICOM file");
    let one = object.element(tags::PIXEL_DATA).expect("pixels").to_bytes().expect("bytes").into_owned();
    let mut all = Vec::with_capacity(one.len() * count);
    for index in 0..count {
        let at = all.len();
        all.extend_from_slice(&one);
        all[at..at + 4].copy_from_slice(&(index as u32).to_le_bytes());
    }
    object.put(DataElement::new(tags::NUMBER_OF_FRAMES, VR::IS, PrimitiveValue::from(count.to_string())));
    let words: Vec<u16> = all.chunks_exact(2).map(|pair| u16::from_le_bytes([pair[0], pair[1]])).collect();
    object.put(DataElement::new(tags::PIXEL_DATA, VR::OW, PrimitiveValue::U16(words.into())));
    object.write_to_file(path).expect("written");
}

/// The one frame of a lab, drawn once for all tests; `None` (said) where mock-lab was not built.
fn frame_of_a_lab() -> Option<&'static [u8]> {
    static FRAME: OnceLock<Option<Vec<u8>>> = OnceLock::new();
    let draw = || {
        let mut lab = Lab::start(&["--kit-only", "--exposures", "1"])?;
        lab.mock.end(HANG_S).expect("it ends when it has drawn");
        let made = std::fs::read_dir(lab.frames()).expect("the folder is there").flatten().next().expect("a frame");
        Some(std::fs::read(made.path()).expect("readable"))
    };
    FRAME.get_or_init(draw).as_deref()
}

/// A lab without exposures of its own, a frame of another lab to deliver, and an empty folder.
pub fn quiet_lab(seconds: &str) -> Option<(Lab, PathBuf, tempfile::TempDir)> {
    let folder = tempfile::tempdir().expect("temporary folder");
    let frame = folder.path().join("frame.dcm");
    std::fs::write(&frame, frame_of_a_lab()?).expect("written");
    let lab = Lab::start(&["--duration-s", seconds, "--faults", "none", "--exposures", "0", "--linger-s", "30"])?;
    Some((lab, frame, folder))
}

/// Files appear whole in the folder of frames, as a careful exporter makes them.
pub fn deliver(files: &[PathBuf], lab: &Lab) {
    for file in files {
        let name = file.file_name().expect("a name");
        let staged = lab.kit.join(name);
        std::fs::copy(file, &staged).expect("copied");
        std::fs::rename(staged, lab.frames().join(name)).expect("renamed");
    }
}
