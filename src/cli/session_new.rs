//! `sidecarm session new`: a session file from a few answers.

use std::io::{BufRead, Write};
use std::path::{Path, PathBuf};

use serde::de::DeserializeOwned;

use super::check::{self, CheckArgs};
use super::devices::list_ports;
pub use super::session_ask::SessionNewError;
use super::session_ask::{Asker, Question};
use crate::acquire::Domain;
use crate::beads::parse_markups;
use crate::foreign::read_small;
use crate::geometry::{CarmCalibration, ConsoleGeometry, RobotModel};
use crate::image::write_atomically;
use crate::json::parse_json;
use crate::reporter::Reporter;
use crate::scene::built_in;
use crate::scene::file::SceneFile;
use crate::session::file::{CarmLine, FrameSource, RobotLine, SessionFile};
use crate::session::servers::{DicomServer, IgtlServer};
use crate::telemetry::PortAddress;

/// What stands for a thing that the lab does not have.
const NONE: &str = "none";
/// Bits per second, where nobody says otherwise.
const BAUD: u32 = 921_600;

/// What sends telemetry.
struct Device {
    name: &'static str,
    /// What says its port, and its calibration, without being asked.
    options: [&'static str; 2],
    /// The calibration that comes with the program, and what it is called beside a session.
    nominal: (&'static str, &'static str),
    /// What is wrong with a calibration of its own.
    looked: fn(&Path) -> Result<(), String>,
}

const CARM: Device = Device {
    name: "C-arm",
    options: ["--carm", "--carm-calibration"],
    nominal: ("calibration/carm/nominal-mobile.json", "carm-nominal.json"),
    looked: |path| read::<CarmCalibration>(path).map(drop),
};
const ROBOT: Device = Device {
    name: "robot",
    options: ["--robot", "--robot-model"],
    nominal: ("calibration/robot/cdm.json", "robot-nominal.json"),
    looked: |path| read::<RobotModel>(path)?.check().map_err(|error| error.to_string()),
};

/// Sessions.
#[derive(Clone, Debug, clap::Args)]
#[command(after_help = "Example:
  sidecarm session new session.json")]
pub struct SessionArgs {
    #[command(subcommand)]
    of: SessionOf,
}

#[derive(Clone, Debug, clap::Subcommand)]
enum SessionOf {
    New(NewArgs),
}

/// Write a session file: what no option says is asked, every answer is looked at, and `check` has the last word.
#[derive(Clone, Debug, clap::Args)]
#[command(after_help = "Examples:
  sidecarm session new session.json
  sidecarm session new session.json --carm /dev/ttyUSB0 --robot none --frames /mnt/console/export --scene scene.json --beads beads.mrk.json

`none` is an answer where the lab has no such thing. Exit code: that of `sidecarm check`.")]
pub struct NewArgs {
    /// The session file; none may be there yet
    session: PathBuf,
    /// Port of the C-arm's telemetry (serial, udp://ADDRESS:PORT or file:PATH), or none
    #[arg(long, value_name = "PORT")]
    carm: Option<String>,
    /// Its bits per second
    #[arg(long, value_name = "BAUD", default_value_t = BAUD)]
    carm_baud: u32,
    /// Its calibration, or nominal: the one that comes with the program is written beside the session
    #[arg(long, value_name = "FILE")]
    carm_calibration: Option<String>,
    /// How its lines are read, where it does not speak Sidecarm's packets
    #[arg(long, value_name = "FILE")]
    carm_adapter: Option<PathBuf>,
    /// Port of the robot's telemetry (as --carm), or none
    #[arg(long, value_name = "PORT")]
    robot: Option<String>,
    /// Its bits per second
    #[arg(long, value_name = "BAUD", default_value_t = BAUD)]
    robot_baud: u32,
    /// Its model, or nominal
    #[arg(long, value_name = "FILE")]
    robot_model: Option<String>,
    /// How its lines are read, where it does not speak Sidecarm's packets
    #[arg(long, value_name = "FILE")]
    robot_adapter: Option<PathBuf>,
    /// Folder in which frames appear
    #[arg(long, value_name = "DIR")]
    frames: Option<String>,
    /// The scene: CT, tools, beam and detector, without a view
    #[arg(long, value_name = "SCENE.json")]
    scene: Option<String>,
    /// Beads of the specimen (3D Slicer markups or .fcsv), or none
    #[arg(long, value_name = "FILE")]
    beads: Option<String>,
    /// What the frames' values mean: linear, log, display, or file for what each file says of itself
    #[arg(long, value_name = "DOMAIN")]
    domain: Option<String>,
    /// TCP port on which frames may be sent to this machine over DICOM, or none
    #[arg(long, value_name = "PORT")]
    dicom: Option<String>,
    /// TCP port on which 3D Slicer and others may listen over OpenIGTLink, or none
    #[arg(long, value_name = "PORT")]
    igtl: Option<String>,
    /// What the console does to the panel's picture: degrees clockwise, a file with the keys of "console", or none
    #[arg(long, value_name = "DEG|FILE")]
    console: Option<String>,
    /// Folder of the results [default: out, beside the session]
    #[arg(long, value_name = "DIR")]
    out: Option<PathBuf>,
    /// Do not check what was written
    #[arg(long)]
    no_check: bool,
}

/// Writes a session file and checks it; the exit code of the check.
///
/// # Errors
/// When a session of that name is there, an option will not do, a question is not answered, or the file cannot be written.
pub fn run(args: &SessionArgs, reporter: &Reporter) -> Result<u8, SessionNewError> {
    let SessionOf::New(args) = &args.of;
    if args.session.exists() {
        return Err(SessionNewError::Exists { path: args.session.clone() });
    }
    let ports = list_ports().iter().map(|port| port.by_id.first().unwrap_or(&port.path).display().to_string()).collect();
    let mut asker = Asker { answers: std::io::stdin().lock(), screen: std::io::stderr() };
    let (session, files) = answered(args, ports, &mut asker)?;
    for (path, text) in &files {
        write_atomically(path, |file| file.write_all(text.as_bytes()))?;
    }
    write_atomically(&args.session, |file| Ok(serde_json::to_writer_pretty(file, &session)?))?;
    println!("{}", args.session.display());
    if args.no_check {
        return Ok(0);
    }
    let check = CheckArgs { session: args.session.clone(), out: args.out.clone(), limit: check::LIMIT_S, json: false };
    Ok(check::run(&check, reporter))
}

/// The session, and files that belong beside it.
type Answered = (SessionFile, Vec<(PathBuf, &'static str)>);

fn answered<R: BufRead, W: Write>(
    args: &NewArgs,
    ports: Vec<String>,
    asker: &mut Asker<R, W>,
) -> Result<Answered, SessionNewError> {
    let folder = args.session.parent().filter(|folder| !folder.as_os_str().is_empty()).unwrap_or(Path::new("."));
    let folder = std::path::absolute(folder).unwrap_or_else(|_| folder.to_owned());
    let named = |path: &Path| {
        let whole = std::path::absolute(path).unwrap_or_else(|_| path.to_owned());
        // A session that is moved with its files still finds them.
        whole.strip_prefix(&folder).map(Path::to_owned).unwrap_or(whole)
    };
    let carm = line(asker, &CARM, [&args.carm, &args.carm_calibration], ports.first().cloned(), &named)?;
    // A port that the C-arm does not have is the robot's, whatever was offered before.
    let taken = carm.as_ref().map(|(port, _)| place_of(port));
    let free = ports.into_iter().find(|port| taken != Some(place_of(Path::new(port))));
    let robot = line(asker, &ROBOT, [&args.robot, &args.robot_model], free, &named)?;
    let nominal = [(&carm, &CARM), (&robot, &ROBOT)].into_iter().filter_map(|(line, device)| {
        let (_, file) = line.as_ref()?;
        let (built, beside) = device.nominal;
        (*file == Path::new(beside)).then(|| (folder.join(beside), built_in(built).unwrap_or_default()))
    });
    let files = nominal.filter(|(path, _)| !path.exists()).collect();
    let frames = Question {
        option: "--frames",
        given: &args.frames,
        words: "Folder in which frames appear",
        default: None,
        may_be_silent: false,
    };
    let frames = asker.ask(&frames, &|answer| {
        let path = Path::new(answer);
        if path.is_dir() { Ok(named(path)) } else { Err(format!("'{answer}' is no folder; mount it, or make it")) }
    })?;
    let scene = Question {
        option: "--scene",
        given: &args.scene,
        words: "Scene (CT, tools, beam, detector)",
        default: None,
        may_be_silent: false,
    };
    let scene = asker.ask(&scene, &|answer| read::<SceneFile>(Path::new(answer)).map(|_| named(Path::new(answer))))?;
    let words = format!("Beads of the specimen (markups), or {NONE}");
    let beads = Question { option: "--beads", given: &args.beads, words: &words, default: None, may_be_silent: false };
    let beads = asker.ask(&beads, &|answer| {
        if answer == NONE {
            return Ok(None);
        }
        let path = Path::new(answer);
        let content = read_small(path).map_err(|error| format!("{answer}: {error}"))?;
        parse_markups(path, &content).map_err(|error| error.to_string())?;
        Ok(Some(named(path)))
    })?;
    let further = Further::ask(args, asker)?;
    let session = SessionFile {
        carm: carm.map(|(port, calibration)| CarmLine {
            port,
            baud: args.carm_baud,
            calibration,
            adapter: args.carm_adapter.as_deref().map(named),
            fuse: false,
        }),
        robot: robot.map(|(port, model)| RobotLine {
            port,
            baud: args.robot_baud,
            model,
            adapter: args.robot_adapter.as_deref().map(named),
        }),
        frames: FrameSource { folder: frames, sub_folders: false, domain: None, dicom: further.dicom, video: None },
        scene,
        beads,
        world_from_lps: None,
        world_from_tracker: None,
        out: Some(args.out.as_deref().map_or_else(|| PathBuf::from("out"), named)),
        domain: further.domain,
        tone: None,
        air_level: None,
        bead_radius_mm: None,
        landmarks: None,
        console: further.console,
        detector: None,
        intensifier: None,
        tags: None,
        igtl: further.igtl,
    };
    Ok((session, files))
}

/// What few labs need to say; no answer is an answer.
struct Further {
    domain: Option<Domain>,
    dicom: Option<DicomServer>,
    igtl: Option<IgtlServer>,
    console: Option<ConsoleGeometry>,
}

impl Further {
    fn ask<R: BufRead, W: Write>(args: &NewArgs, asker: &mut Asker<R, W>) -> Result<Self, SessionNewError> {
        let question =
            |option, given, words, default| Question { option, given, words, default: Some(default), may_be_silent: true };
        let words = "Values of the frames: linear, log or display, or file: what each says of itself";
        let domain = asker.ask(&question("--domain", &args.domain, words, "file"), &|answer| match answer {
            "file" => Ok(None),
            word => word.parse().map(Some),
        })?;
        let port = |answer: &str| match answer {
            NONE => Ok(None),
            number => number.parse().map(Some).map_err(|_| format!("'{number}' is no TCP port, 1 to 65535")),
        };
        let words = "TCP port on which frames may be sent here over DICOM (11112), or none";
        let dicom: Option<u16> = asker.ask(&question("--dicom", &args.dicom, words, NONE), &port)?;
        let words = "TCP port for 3D Slicer over OpenIGTLink (18944), or none";
        let igtl: Option<u16> = asker.ask(&question("--igtl", &args.igtl, words, NONE), &port)?;
        let words = "The console turns the picture: degrees clockwise, a file with the keys of \"console\", or none";
        let console = asker.ask(&question("--console", &args.console, words, NONE), &|answer| {
            let geometry = match (answer, answer.parse::<f64>()) {
                (NONE, _) => return Ok(None),
                (_, Ok(rotation_deg)) => ConsoleGeometry { rotation_deg, ..ConsoleGeometry::default() },
                (path, Err(_)) => read(Path::new(path))?,
            };
            geometry.check().map(|()| Some(geometry)).map_err(|error| error.to_string())
        })?;
        Ok(Self { domain, dicom: dicom.map(DicomServer::on_port), igtl: igtl.map(IgtlServer::on_port), console })
    }
}

/// Where a port really is: an adapter has several names.
fn place_of(port: &Path) -> PathBuf {
    std::fs::canonicalize(port).unwrap_or_else(|_| port.to_owned())
}

/// Port and calibration of a device, if the lab has it.
fn line<R: BufRead, W: Write>(
    asker: &mut Asker<R, W>,
    device: &Device,
    [port, file]: [&Option<String>; 2],
    seen: Option<String>,
    named: &dyn Fn(&Path) -> PathBuf,
) -> Result<Option<(PathBuf, PathBuf)>, SessionNewError> {
    let words = format!("Port of the {} (a serial port, udp://…, file:…), or {NONE}", device.name);
    let default = Some(seen.as_deref().unwrap_or(NONE));
    let port = Question { option: device.options[0], given: port, words: &words, default, may_be_silent: false };
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
    let words = format!("Calibration of the {}, or nominal", device.name);
    let file = Question { option: device.options[1], given: file, words: &words, default: Some("nominal"), may_be_silent: false };
    let file = asker.ask(&file, &|answer| match answer {
        "nominal" => Ok(PathBuf::from(device.nominal.1)),
        path => (device.looked)(Path::new(path)).map(|()| named(Path::new(path))),
    })?;
    Ok(Some((port, file)))
}

/// One of our JSON files, or what is wrong with it.
fn read<T: DeserializeOwned>(path: &Path) -> Result<T, String> {
    let bytes = read_small(path).map_err(|error| format!("{}: {error}", path.display()))?;
    parse_json(&bytes).map_err(|fault| format!("{}: {fault}", path.display()))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn args(session: &Path) -> NewArgs {
        NewArgs {
            session: session.to_owned(),
            carm: None,
            carm_baud: BAUD,
            carm_calibration: None,
            carm_adapter: None,
            robot: None,
            robot_baud: 115_200,
            robot_model: None,
            robot_adapter: None,
            frames: None,
            scene: None,
            beads: None,
            domain: None,
            dicom: None,
            igtl: None,
            console: None,
            out: None,
            no_check: true,
        }
    }

    #[test]
    fn an_answer_that_will_not_do_is_asked_again_and_an_option_is_not_asked() {
        let folder = tempfile::tempdir().expect("a folder");
        let at = |name: &str| folder.path().join(name).display().to_string();
        std::fs::create_dir(at("frames")).expect("a folder");
        std::fs::write(at("scene.json"), r#"{"objects": [], "beam": {"mono_kev": 60}}"#).expect("written");
        std::fs::write(at("wrong.json"), r#"{"objects": [], "beam": {"mono_keV": 60}}"#).expect("written");
        // The port that is there, no calibration of that name, the nominal one; no robot; a folder that is none; a scene with a wrong key; no beads.
        let mut lines = vec!["", "nowhere.json", "nominal", NONE, "nothing"];
        let (frames, wrong, scene) = (at("frames"), at("wrong.json"), at("scene.json"));
        lines.extend([frames.as_str(), wrong.as_str(), scene.as_str(), NONE]);
        // Log values; no DICOM; OpenIGTLink, after a port that is none; a console that turns.
        lines.extend(["log", "", "many", "18944", "90"]);
        let answers = lines.join("\n") + "\n";
        let mut asker = Asker { answers: answers.as_bytes(), screen: Vec::new() };
        let session = folder.path().join("session.json");
        let (found, files) = answered(&args(&session), vec!["/dev/ttyUSB7".to_owned()], &mut asker).expect("answered");
        let screen = String::from_utf8(asker.screen).expect("text");
        for words in ["[/dev/ttyUSB7]", "nowhere.json", "'nothing' is no folder", "mono_keV", "'many' is no TCP port"] {
            assert!(screen.contains(words), "{words}: {screen}");
        }
        assert_eq!(screen.matches("Port of the ").count(), 2);
        let carm = found.carm.expect("a C-arm");
        assert_eq!(
            (carm.port.as_path(), carm.calibration.as_path(), carm.baud),
            (Path::new("/dev/ttyUSB7"), Path::new(CARM.nominal.1), BAUD)
        );
        assert!(found.robot.is_none() && found.beads.is_none());
        assert_eq!((found.frames.folder.as_path(), found.scene.as_path()), (Path::new("frames"), Path::new("scene.json")));
        assert_eq!((found.domain, found.frames.dicom, found.igtl), (Some(Domain::Log), None, Some(IgtlServer::on_port(18_944))));
        assert_eq!(found.console.map(|console| console.rotation_deg), Some(90.0));
        let [(path, text)] = &files[..] else { panic!("{files:?}") };
        assert!(*path == folder.path().join(CARM.nominal.1) && parse_json::<CarmCalibration>(text.as_bytes()).is_ok());

        let mut given = args(&session);
        (given.carm, given.robot, given.frames) = (Some(NONE.to_owned()), Some("/dev/ttyACM0".to_owned()), Some(at("frames")));
        (given.robot_model, given.scene, given.beads) =
            (Some("nominal".to_owned()), Some(at("scene.json")), Some(NONE.to_owned()));
        let mut silent = Asker { answers: &b""[..], screen: Vec::new() };
        let (found, files) = answered(&given, Vec::new(), &mut silent).expect("nothing that needs an answer");
        let asked = String::from_utf8(std::mem::take(&mut silent.screen)).expect("text");
        assert!(!asked.contains("Port of the ") && !asked.contains("Scene") && asked.contains("OpenIGTLink"), "{asked}");
        assert_eq!((found.domain, found.frames.dicom, found.igtl, found.console), (None, None, None, None));
        assert!(found.carm.is_none() && found.robot.is_some_and(|robot| robot.baud == 115_200));
        assert!(parse_json::<RobotModel>(files[0].1.as_bytes()).is_ok());
        given.frames = Some(at("nothing"));
        let refused = answered(&given, Vec::new(), &mut silent).expect_err("no folder").to_string();
        assert!(refused.starts_with("--frames ") && refused.contains("is no folder"), "{refused}");
        given.frames = None;
        let refused = answered(&given, Vec::new(), &mut silent).expect_err("nobody answers").to_string();
        assert!(refused.contains("give --frames"), "{refused}");
    }

    /// With one adapter plugged in and no C-arm, the robot's default was `none`: the C-arm's question had used the port up.
    #[test]
    fn a_port_that_the_c_arm_does_not_have_is_offered_for_the_robot() {
        let folder = tempfile::tempdir().expect("a folder");
        let mut given = args(&folder.path().join("session.json"));
        let scene = folder.path().join("scene.json");
        std::fs::write(&scene, r#"{"objects": [], "beam": {"mono_kev": 60}}"#).expect("written");
        let folder_name = folder.path().display().to_string();
        (given.frames, given.scene, given.beads) = (Some(folder_name), Some(scene.display().to_string()), Some(NONE.to_owned()));
        (given.carm_calibration, given.robot_model) = (Some("nominal".to_owned()), Some("nominal".to_owned()));
        let robot_port = |answers: &str, ports: &[&str]| {
            let mut asker = Asker { answers: answers.as_bytes(), screen: Vec::new() };
            let ports = ports.iter().map(|port| (*port).to_owned()).collect();
            let (found, _) = answered(&given, ports, &mut asker).expect("answered");
            found.robot.map(|robot| robot.port.display().to_string())
        };
        assert_eq!(robot_port("none\n\n", &["/dev/ttyUSB7"]).as_deref(), Some("/dev/ttyUSB7"));
        assert_eq!(robot_port("\n\n", &["/dev/ttyUSB7"]), None, "the C-arm has the only one");
        assert_eq!(robot_port("\n\n", &["/dev/ttyUSB7", "/dev/ttyUSB8"]).as_deref(), Some("/dev/ttyUSB8"));
        assert_eq!(robot_port("/dev/ttyUSB8\n\n", &["/dev/ttyUSB7", "/dev/ttyUSB8"]).as_deref(), Some("/dev/ttyUSB7"));
    }
}
