//! The devices of a session file that is being made: port, calibration, and how their lines are read.

use std::io::{BufRead, Write};
use std::path::{Path, PathBuf};

use super::session_ask::{Asker, NONE, Question, SessionNewError, read};
use crate::geometry::{CarmCalibration, RobotModel};
use crate::telemetry::lines::Declaration;
use crate::telemetry::{DeviceKind, LineAdapter, PortAddress};

/// What stands for a device that speaks Sidecarm's packets.
pub(super) const PACKETS: &str = "packets";

/// What sends telemetry.
pub(super) struct Device {
    pub kind: DeviceKind,
    /// What says its port, its calibration, and how its lines are read, without being asked.
    pub options: [&'static str; 3],
    /// The calibration that comes with the program, and what it is called beside a session.
    pub nominal: (&'static str, &'static str),
    /// What is wrong with a calibration of its own.
    pub looked: fn(&Path) -> Result<(), String>,
}

pub(super) const CARM: Device = Device {
    kind: DeviceKind::Carm,
    options: ["--carm", "--carm-calibration", "--carm-adapter"],
    nominal: ("calibration/carm/nominal-mobile.json", "carm-nominal.json"),
    looked: |path| read::<CarmCalibration>(path).map(drop),
};
pub(super) const ROBOT: Device = Device {
    kind: DeviceKind::Robot,
    options: ["--robot", "--robot-model", "--robot-adapter"],
    nominal: ("calibration/robot/cdm.json", "robot-nominal.json"),
    looked: |path| read::<RobotModel>(path)?.check().map_err(|error| error.to_string()),
};

/// A device that the lab has, as the session names it.
pub(super) struct Line {
    pub port: PathBuf,
    pub calibration: PathBuf,
    pub adapter: Option<PathBuf>,
}

/// Where a port really is: an adapter has several names.
pub(super) fn place_of(port: &Path) -> PathBuf {
    std::fs::canonicalize(port).unwrap_or_else(|_| port.to_owned())
}

/// A device, if the lab has it.
pub(super) fn line<R: BufRead, W: Write>(
    asker: &mut Asker<R, W>,
    device: &Device,
    [port, calibration, adapter]: [&Option<String>; 3],
    seen: Option<String>,
    named: &dyn Fn(&Path) -> PathBuf,
) -> Result<Option<Line>, SessionNewError> {
    let words = format!("Port of the {} (a serial port, udp://…, file:…), or {NONE}", device.kind);
    let default = Some(seen.as_deref().unwrap_or(NONE));
    let [of_port, of_calibration, of_adapter] = device.options;
    let port = Question { option: of_port, given: port, words: &words, default, may_be_silent: false };
    let port = asker.ask(&port, &|answer| {
        let path = Path::new(answer);
        if path.is_file() || path.is_dir() {
            return Err(format!("'{answer}' is no serial port; a file that a device writes is named file:{answer}"));
        }
        // A port beside the session, as mocks have it, and a file that a device writes are found from wherever the session is started.
        Ok((answer != NONE).then(|| match PortAddress::of(path) {
            Ok(PortAddress::File(file)) => PathBuf::from(format!("file:{}", named(&file).display())),
            _ if path.exists() => named(path),
            _ => path.to_owned(),
        }))
    })?;
    let Some(port) = port else {
        return Ok(None);
    };
    let words = format!("Model of the {} (its calibration), or nominal", device.kind);
    let default = Some("nominal");
    let file = Question { option: of_calibration, given: calibration, words: &words, default, may_be_silent: false };
    let calibration = asker.ask(&file, &|answer| match answer {
        "nominal" => Ok(PathBuf::from(device.nominal.1)),
        path => (device.looked)(Path::new(path)).map(|()| named(Path::new(path))),
    })?;
    let words = format!("Lines of the {}: a file that says how they are read, or {PACKETS}", device.kind);
    let file = Question { option: of_adapter, given: adapter, words: &words, default: Some(PACKETS), may_be_silent: true };
    let adapter = asker.ask(&file, &|answer| match answer {
        PACKETS => Ok(None),
        path => reads_lines_of(device.kind, Path::new(path)).map(|()| Some(named(Path::new(path)))),
    })?;
    Ok(Some(Line { port, calibration, adapter }))
}

/// What is wrong with a declaration of a device's lines.
fn reads_lines_of(device: DeviceKind, path: &Path) -> Result<(), String> {
    let adapter = LineAdapter::try_from(read::<Declaration>(path)?).map_err(|error| format!("{}: {error}", path.display()))?;
    let found = adapter.device();
    if found == device { Ok(()) } else { Err(format!("{}: these are the lines of a {found}, not of a {device}", path.display())) }
}
