//! A watched folder into which pictures of a video come, grabbed by a process of its own.

use std::io::{BufRead, BufReader};
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::sync::mpsc::{Receiver, Sender, channel};

use super::super::source::{FrameSource, Sighting, Trouble};
use super::grabber::{GrabError, Grabbed};
use super::settings::VideoSettings;
use crate::foreign;

/// A process that died is started again after so long, and after twice as long each time that it dies of the same, up to the second.
const AGAIN_US: (i64, i64) = (1_000_000, 60_000_000);

/// See the module.
pub struct GrabbedSource {
    folder: Box<dyn FrameSource>,
    wanted: Wanted,
    process: Option<Process>,
    said: (Sender<Said>, Receiver<Said>),
    /// When it is started again, and how long that was waited for.
    again_us: Option<i64>,
    wait_us: i64,
    /// Why it ended last: what does not change, as a wrong crop, is a loss once.
    ended_for: Option<String>,
    is_closed: bool,
}

/// What is grabbed, and into which folder.
struct Wanted {
    settings: VideoSettings,
    path: PathBuf,
    include_first: bool,
}

/// What the process says.
enum Said {
    Event(Grabbed),
    /// Its output has ended; why, in words of the program's own, if it said any.
    End(Option<String>),
}

/// The process; it ends when its standard input does.
struct Process(Child);

impl Process {
    fn start(wanted: &Wanted, more: &[&str], said: Sender<Said>) -> Result<Self, GrabError> {
        let start = |detail: String| GrabError::Start { detail };
        let program = foreign::installed().program().map(Path::to_owned);
        let program = program.map_or_else(std::env::current_exe, Ok).map_err(|error| start(error.to_string()))?;
        let settings = serde_json::to_string(&wanted.settings).map_err(|error| start(error.to_string()))?;
        let mut command = Command::new(program);
        command.args(["grab", &wanted.settings.from, "--settings", &settings, "--json", "--attended", "--into"]);
        command.arg(&wanted.path).args(more).args(wanted.include_first.then_some("--include-first"));
        command.env("RUST_BACKTRACE", "0").env("OPENCV_FFMPEG_LOGLEVEL", "-8");
        command.stdin(Stdio::piped()).stdout(Stdio::piped()).stderr(Stdio::piped());
        // Ctrl-C in the terminal is meant for the session.
        #[cfg(unix)]
        std::os::unix::process::CommandExt::process_group(&mut command, 0);
        let mut child = command.spawn().map_err(|error| start(error.kind().to_string()))?;
        let (Some(out), Some(err)) = (child.stdout.take(), child.stderr.take()) else { return Err(start("no pipe".to_owned())) };
        // Drivers and decoders speak there as well, some without end: read on, or they wait for us.
        let words = std::thread::spawn(move || {
            let lines = BufReader::new(err).split(b'\n').map_while(Result::ok);
            lines.filter_map(|line| String::from_utf8_lossy(&line).strip_prefix("sidecarm: ").map(str::to_owned)).last()
        });
        std::thread::spawn(move || {
            let lines = BufReader::new(out).lines().map_while(Result::ok);
            for event in lines.filter_map(|line| serde_json::from_str(&line).ok()) {
                let _ = said.send(Said::Event(event));
            }
            let _ = said.send(Said::End(words.join().ok().flatten()));
        });
        Ok(Self(child))
    }

    /// Lets it end: at its next picture.
    fn release(&mut self) {
        drop(self.0.stdin.take());
    }
}

impl Drop for Process {
    fn drop(&mut self) {
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

impl GrabbedSource {
    /// Starts to grab; `path` is the folder that `folder` watches. `include_first`: what stands on the screen is taken as well.
    ///
    /// # Errors
    /// When the process cannot be started.
    pub fn open(
        folder: Box<dyn FrameSource>,
        path: &Path,
        settings: &VideoSettings,
        include_first: bool,
    ) -> Result<Self, GrabError> {
        let wanted = Wanted { settings: settings.clone(), path: path.to_owned(), include_first };
        let said = channel();
        let process = Some(Process::start(&wanted, &[], said.0.clone())?);
        Ok(Self { folder, wanted, process, said, again_us: None, wait_us: AGAIN_US.0, ended_for: None, is_closed: false })
    }

    fn hear(&mut self, now_us: i64, found: &mut Vec<Sighting>) {
        let said: Vec<Said> = self.said.1.try_iter().collect();
        for said in said {
            match said {
                Said::Event(Grabbed::Picture { .. }) => self.ended_for = None,
                Said::Event(event) => found.extend(sighting(&event)),
                Said::End(words) => self.ended(words, now_us, found),
            }
        }
        if self.again_us.take_if(|again_us| now_us >= *again_us).is_some() && !self.is_closed {
            // What stands there now may have come while nobody looked.
            self.wanted.include_first = true;
            match Process::start(&self.wanted, &[], self.said.0.clone()) {
                Ok(process) => self.process = Some(process),
                Err(error) => self.ended(Some(error.to_string()), now_us, found),
            }
        }
    }

    /// The process has ended, for what it said last, if it said anything.
    fn ended(&mut self, words: Option<String>, now_us: i64, found: &mut Vec<Sighting>) {
        let is_good = self.process.take().is_some_and(|mut process| process.0.wait().is_ok_and(|status| status.success()));
        if is_good || self.is_closed {
            return;
        }
        let words = words.unwrap_or_else(|| "the process that grabs it died".to_owned());
        if self.ended_for.as_ref() == Some(&words) {
            self.wait_us = (2 * self.wait_us).min(AGAIN_US.1);
        } else {
            self.wait_us = AGAIN_US.0;
            found.push(trouble(format!("{words}; it is tried again")));
            self.ended_for = Some(words);
        }
        self.again_us = Some(now_us.saturating_add(self.wait_us));
    }
}

fn trouble(detail: String) -> Sighting {
    Sighting::Trouble(Trouble::NoVideo { detail })
}

/// What a person is told of an event.
fn sighting(event: &Grabbed) -> Option<Sighting> {
    match event {
        Grabbed::Picture { .. } => None,
        Grabbed::Lost { detail } => Some(trouble(format!("{detail}; it is tried again"))),
        Grabbed::Unwritten { .. } => Some(trouble(event.to_string())),
        Grabbed::Restless { .. } | Grabbed::Ticking { .. } => {
            Some(Sighting::Said { kind: "video never still", words: event.to_string() })
        }
        Grabbed::Opened { .. } | Grabbed::First { .. } | Grabbed::Back | Grabbed::Ended { .. } => {
            Some(Sighting::Said { kind: "video", words: event.to_string() })
        }
    }
}

impl FrameSource for GrabbedSource {
    fn look(&mut self, now_us: i64) -> Vec<Sighting> {
        let mut found = Vec::new();
        self.hear(now_us, &mut found);
        found.extend(self.folder.look(now_us));
        found
    }

    fn close(&mut self) {
        self.is_closed = true;
        self.process.iter_mut().for_each(Process::release);
        self.folder.close();
    }

    fn is_expecting(&self) -> bool {
        self.folder.is_expecting()
    }

    fn give_up(&mut self) -> Vec<Sighting> {
        self.folder.give_up()
    }
}

/// Grabs `seconds` of a video for a trial and returns what happened. Pictures go to a temporary folder in `within`.
///
/// # Errors
/// When there is no video, or the process that looks ends otherwise than it should.
pub fn probe(settings: &VideoSettings, seconds: f64, within: &Path) -> Result<Vec<Grabbed>, GrabError> {
    let folder = tempfile::tempdir_in(within).map_err(|error| GrabError::Start { detail: error.to_string() })?;
    let wanted = Wanted { settings: settings.clone(), path: folder.path().to_owned(), include_first: true };
    let (sender, said) = channel();
    let seconds = seconds.to_string();
    let _process = Process::start(&wanted, &["--seconds", &seconds, "--at-once"], sender)?;
    let mut events = Vec::new();
    for said in said {
        match said {
            Said::Event(event) => events.push(event),
            Said::End(Some(detail)) => return Err(GrabError::Video { from: settings.from.clone(), detail }),
            Said::End(None) => break,
        }
    }
    Ok(events)
}
