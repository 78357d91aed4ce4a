//! Whether the ports and files that a session names are in place, each looked at on its own.

use std::path::PathBuf;
use std::time::Duration;

use serde::Serialize;
use tokio::sync::mpsc;

use crate::foreign::read_small_text;
use crate::geometry::{CarmCalibration, RobotModel};
use crate::json::parse_json;
use crate::regular;
use crate::session::crosscheck::Listened;
use crate::telemetry::{DeviceKind, Event, Health, Link, Metadata, PortAddress, PortConfig, PortEvent, Sample, hint, spawn_port};
use crate::time::host_now_us;

/// How long each port is listened to.
const LISTEN: Duration = Duration::from_millis(1500);

/// How a session's file is looked at.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum FileCheck {
    /// Can be read and is not empty.
    Readable,
    /// Is JSON.
    Json,
    /// Is a C-arm calibration.
    CarmCalibration,
    /// Is a robot model.
    RobotModel,
    /// Is a folder.
    Folder,
}

/// A file that a session needs.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct CheckFile {
    /// Its role, as shown: `scene`, `beads` …
    pub role: String,
    /// Where.
    pub path: PathBuf,
    /// How it is looked at.
    pub check: FileCheck,
}

impl From<PathBuf> for CheckFile {
    /// JSON by its extension, else merely readable.
    fn from(path: PathBuf) -> Self {
        let is_json = path.extension().is_some_and(|extension| extension.eq_ignore_ascii_case("json"));
        let check = if is_json { FileCheck::Json } else { FileCheck::Readable };
        Self { role: "file".to_owned(), path, check }
    }
}

/// What a session needs.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct CheckList {
    /// The C-arm's port.
    pub carm: Option<PortConfig>,
    /// The robot's port.
    pub robot: Option<PortConfig>,
    /// Files and folders.
    pub files: Vec<CheckFile>,
}

/// The verdict on one thing.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct CheckLine {
    /// `C-arm`, `robot` or the role of a file.
    pub what: String,
    /// Port or file.
    pub path: PathBuf,
    /// Good enough to start.
    pub ok: bool,
    /// What was found, or what is wrong and what to do.
    pub detail: String,
    /// Decoded samples per second; ports only.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub rate_hz: Option<f64>,
    /// Counters; ports only.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub health: Option<Health>,
    /// What the device said; ports only.
    #[serde(skip)]
    pub listened: Box<Listened>,
}

/// The verdicts, ports first. Ports are listened to for 1.5 s, together.
#[must_use]
pub fn check_lines(list: &CheckList) -> Vec<CheckLine> {
    let ports: Vec<&PortConfig> = [&list.carm, &list.robot].into_iter().flatten().collect();
    let mut lines = match listen(&ports) {
        Ok(heard) => ports.iter().zip(heard).map(|(config, heard)| heard.verdict(config)).collect(),
        Err(error) => ports.iter().map(|config| bad_port(config, format!("cannot listen: {error}"))).collect::<Vec<_>>(),
    };
    lines.extend(list.files.iter().map(check_file));
    lines
}

/// What came from one port.
struct Heard {
    link: Link,
    /// The same bytes as the other device would mean them: swapped ports show here.
    as_other: Link,
    listened: Listened,
    samples: u64,
    first_last_us: Option<(i64, i64)>,
    /// Why the port is not open now.
    closed: Option<String>,
    /// The device went away while it was listened to.
    lost: Option<String>,
    /// What the port had to say.
    said: Option<String>,
}

impl Heard {
    fn take(&mut self, event: &PortEvent) {
        match event {
            PortEvent::Retry { error, .. } => self.closed = Some(format!("{error}; {}", hint(error))),
            PortEvent::Lost { reason, .. } => self.lost = Some(format!("the device went away: {reason}; check the cable")),
            // An earlier attempt may have failed because another program was just letting go.
            PortEvent::Opened { .. } => self.closed = None,
            PortEvent::Said { words, .. } => self.said = Some(words.clone()),
            PortEvent::Bytes { .. } => {}
        }
        let Self { link, as_other, listened, samples, first_last_us, .. } = self;
        as_other.handle(event, &mut |_| {});
        link.handle(event, &mut |received| {
            let Event::Sample(sample, _) = received.event else { return };
            listened.take(&sample);
            if matches!(sample, Sample::Metadata(_)) {
                return;
            }
            *samples += 1;
            *first_last_us = Some((first_last_us.map_or(received.host_us, |(first, _)| first), received.host_us));
        });
    }

    fn verdict(self, config: &PortConfig) -> CheckLine {
        let health = *self.link.health();
        let of_lines = config.adapter.is_some();
        let address = PortAddress::of(&config.path);
        let rate_hz = match self.first_last_us {
            Some((first, last)) if last > first => (self.samples.saturating_sub(1)) as f64 * 1e6 / (last - first) as f64,
            _ => 0.0,
        };
        let device = config.device;
        let (ok, detail) = if let Some(trouble) = self.lost.or(self.closed).or(self.said) {
            (false, trouble)
        } else if health.bytes == 0 {
            let silent = match address {
                Ok(PortAddress::Udp(_)) => "listened to, but no datagram came; start the sender, and check where it sends to",
                Ok(PortAddress::File(_)) => "read, but nothing was written to it; start the program that writes it",
                Ok(PortAddress::Serial(_)) | Err(_) => {
                    "open, but silent; switch the device on, and check that its baud rate is the session's"
                }
            };
            (false, silent.to_owned())
        } else if self.samples == 0 && health.schema_mismatch + health.version_mismatch > 0 {
            (false, format!("speaks another protocol version ({health}); update the device's firmware or sidecarm"))
        } else if self.samples == 0 && !of_lines && self.as_other.health().frames > 0 {
            let other = self.as_other.device();
            (
                false,
                format!(
                    "the {other} speaks here, not the {device}: the two ports are swapped; exchange carm.port and robot.port"
                ),
            )
        } else if self.samples == 0 && of_lines {
            let latest = self.link.latest_fault().unwrap_or("not one whole line");
            (false, format!("{} bytes, but no line is as its adapter declares it ({latest}); correct the adapter", health.bytes))
        } else if self.samples == 0 {
            let detail = format!(
                "{} bytes, but no {device} sample ({health}); check that its baud rate is the session's ({}), then the cable",
                health.bytes, config.baud
            );
            (false, detail)
        } else {
            let none = if of_lines { "lines as declared" } else { "no metadata yet" };
            let about = self.listened.metadata.as_ref().map_or(none.to_owned(), Metadata::summary);
            let latest = self.link.latest_fault().map(|fault| format!(", of the latest: {fault}")).unwrap_or_default();
            (true, format!("{rate_hz:.1} Hz, {health}{latest}; {about}"))
        };
        CheckLine {
            what: device.to_string(),
            path: config.path.clone(),
            ok,
            detail,
            rate_hz: Some(rate_hz),
            health: Some(health),
            listened: Box::new(self.listened),
        }
    }
}

fn listen(ports: &[&PortConfig]) -> std::io::Result<Vec<Heard>> {
    let mut heard: Vec<Heard> = ports
        .iter()
        .map(|config| Heard {
            link: Link::of_port(config),
            as_other: Link::new(match config.device {
                DeviceKind::Carm => DeviceKind::Robot,
                DeviceKind::Robot => DeviceKind::Carm,
            }),
            listened: Listened::default(),
            samples: 0,
            first_last_us: None,
            closed: None,
            lost: None,
            said: None,
        })
        .collect();
    if ports.is_empty() {
        return Ok(heard);
    }
    let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build()?;
    runtime.block_on(async {
        let (sink, mut events) = mpsc::channel::<(DeviceKind, PortEvent)>(256);
        let tasks: Vec<_> = ports.iter().map(|config| spawn_port(runtime.handle(), (*config).clone(), sink.clone())).collect();
        let until_us = host_now_us() + LISTEN.as_micros() as i64;
        loop {
            let left_us = until_us - host_now_us();
            if left_us <= 0 {
                break;
            }
            let Ok(Some((device, event))) = tokio::time::timeout(Duration::from_micros(left_us as u64), events.recv()).await
            else {
                break;
            };
            for (config, heard) in ports.iter().zip(&mut heard) {
                if config.device == device {
                    heard.take(&event);
                }
            }
        }
        for task in tasks {
            task.closed().await;
        }
    });
    Ok(heard)
}

fn bad_port(config: &PortConfig, detail: String) -> CheckLine {
    CheckLine {
        what: config.device.to_string(),
        path: config.path.clone(),
        ok: false,
        detail,
        rate_hz: None,
        health: None,
        listened: Box::default(),
    }
}

fn check_file(file: &CheckFile) -> CheckLine {
    let (ok, detail) = match look_at(file) {
        Ok(detail) => (true, detail),
        Err(detail) => (false, detail),
    };
    CheckLine {
        what: file.role.clone(),
        path: file.path.clone(),
        ok,
        detail,
        rate_hz: None,
        health: None,
        listened: Box::default(),
    }
}

fn look_at(file: &CheckFile) -> Result<String, String> {
    let metadata = std::fs::metadata(&file.path).map_err(|error| match error.kind() {
        std::io::ErrorKind::NotFound => "does not exist".to_owned(),
        _ => error.to_string(),
    })?;
    if file.check == FileCheck::Folder {
        return if metadata.is_dir() { Ok("a folder".to_owned()) } else { Err("is not a folder".to_owned()) };
    }
    if metadata.is_dir() {
        return if file.check == FileCheck::Readable { Ok("a folder".to_owned()) } else { Err("is a folder".to_owned()) };
    }
    regular::open(&file.path).map_err(|error| error.to_string())?;
    if metadata.len() == 0 {
        return Err("is empty".to_owned());
    }
    let text = || read_small_text(&file.path).map_err(|error| error.to_string());
    match file.check {
        FileCheck::Readable => Ok(format!("{} bytes", metadata.len())),
        FileCheck::Json => parse::<serde_json::Value>(&text()?).map(|_| "JSON".to_owned()),
        FileCheck::CarmCalibration => parse::<CarmCalibration>(&text()?).map(|calibration| calibration.origin),
        FileCheck::RobotModel => {
            let model = parse::<RobotModel>(&text()?)?;
            model.check().map_err(|error| error.to_string())?;
            Ok(model.origin)
        }
        FileCheck::Folder => Err("is not a folder".to_owned()),
    }
}

/// Parses JSON; an error names the key and the place.
fn parse<T: serde::de::DeserializeOwned>(text: &str) -> Result<T, String> {
    parse_json(text.as_bytes()).map_err(|fault| fault.to_string())
}
