//! `sidecarm session new`: a session file from a few answers.

use std::io::{BufRead, Write};
use std::path::{Path, PathBuf};

use super::check::{self, CheckArgs};
use super::devices::list_ports;
pub use super::session_ask::SessionNewError;
use super::session_ask::{Asker, NONE, Question, read};
use super::session_device::{CARM, Line, ROBOT, line, place_of};
use super::session_further::{Further, FurtherArgs};
use crate::beads::parse_markups;
use crate::foreign::read_small;
use crate::image::write_atomically;
use crate::reporter::Reporter;
use crate::scene::built_in;
use crate::scene::file::SceneFile;
use crate::session::file::{CarmLine, FrameSource, RobotLine, SessionFile};

/// Bits per second, where nobody says otherwise.
const BAUD: u32 = 921_600;

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
  sidecarm session new session.json --json --carm none --robot none --frames frames --scene scene.json --beads none < /dev/null

`none` is an answer where the lab has no such thing, and no answer takes what stands in brackets. Exit code: that of `sidecarm check`.")]
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
    /// How its lines are read, or packets where it speaks Sidecarm's
    #[arg(long, value_name = "FILE")]
    carm_adapter: Option<String>,
    /// Port of the robot's telemetry (as --carm), or none
    #[arg(long, value_name = "PORT")]
    robot: Option<String>,
    /// Its bits per second
    #[arg(long, value_name = "BAUD", default_value_t = BAUD)]
    robot_baud: u32,
    /// Its model, or nominal
    #[arg(long, value_name = "FILE")]
    robot_model: Option<String>,
    /// How its lines are read, or packets
    #[arg(long, value_name = "FILE")]
    robot_adapter: Option<String>,
    /// Folder in which frames appear
    #[arg(long, value_name = "DIR")]
    frames: Option<String>,
    /// The scene: CT, tools, beam and detector, without a view
    #[arg(long, value_name = "SCENE.json")]
    scene: Option<String>,
    /// Beads of the specimen (3D Slicer markups or .fcsv), or none
    #[arg(long, value_name = "FILE")]
    beads: Option<String>,
    #[command(flatten)]
    further: FurtherArgs,
    /// Folder of the results [default: out, beside the session]
    #[arg(long, value_name = "DIR")]
    out: Option<PathBuf>,
    /// Do not check what was written
    #[arg(long)]
    no_check: bool,
    /// Print JSON: what `check --json` finds, or without a check the file's name and content
    #[arg(long)]
    json: bool,
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
    match (args.json, args.no_check) {
        (false, _) => println!("{}", args.session.display()),
        (true, true) => println!("{}", serde_json::json!({ "file": args.session, "session": session })),
        (true, false) => {}
    }
    if args.no_check {
        return Ok(0);
    }
    let check = CheckArgs { session: args.session.clone(), out: args.out.clone(), limit: check::LIMIT_S, json: args.json };
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
    let given = [&args.carm, &args.carm_calibration, &args.carm_adapter];
    let carm = line(asker, &CARM, given, ports.first().cloned(), &named)?;
    // A port that the C-arm does not have is the robot's, whatever was offered before.
    let taken = carm.as_ref().map(|line| place_of(&line.port));
    let free = ports.into_iter().find(|port| taken != Some(place_of(Path::new(port))));
    let robot = line(asker, &ROBOT, [&args.robot, &args.robot_model, &args.robot_adapter], free, &named)?;
    let nominal = [(&carm, &CARM), (&robot, &ROBOT)].into_iter().filter_map(|(line, device)| {
        let (built, beside) = device.nominal;
        let is_nominal = line.as_ref()?.calibration == Path::new(beside);
        is_nominal.then(|| (folder.join(beside), built_in(built).unwrap_or_default()))
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
    let further = Further::ask(&args.further, carm.is_some(), asker, &named)?;
    let session = SessionFile {
        carm: carm.map(|Line { port, calibration, adapter }| CarmLine {
            port,
            baud: args.carm_baud,
            calibration,
            adapter,
            fuse: false,
        }),
        robot: robot.map(|Line { port, calibration, adapter }| RobotLine {
            port,
            baud: args.robot_baud,
            model: calibration,
            adapter,
        }),
        frames: FrameSource {
            folder: frames,
            sub_folders: further.sub_folders,
            domain: None,
            dicom: further.dicom,
            video: further.video,
        },
        scene,
        beads,
        world_from_lps: further.world_from_lps,
        world_from_tracker: None,
        out: Some(args.out.as_deref().map_or_else(|| PathBuf::from("out"), named)),
        domain: further.domain,
        tone: None,
        air_level: None,
        bead_radius_mm: None,
        landmarks: further.landmarks,
        console: further.console,
        detector: further.detector,
        intensifier: further.intensifier,
        intrinsics: further.intrinsics,
        tags: None,
        igtl: further.igtl,
    };
    Ok((session, files))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::acquire::Domain;
    use crate::cli::session_device::PACKETS;
    use crate::geometry::{CarmCalibration, RobotModel};
    use crate::json::parse_json;
    use crate::session::servers::IgtlServer;

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
            further: FurtherArgs::default(),
            out: None,
            no_check: true,
            json: false,
        }
    }

    #[test]
    fn an_answer_that_will_not_do_is_asked_again_and_an_option_is_not_asked() {
        let folder = tempfile::tempdir().expect("a folder");
        let at = |name: &str| folder.path().join(name).display().to_string();
        std::fs::create_dir(at("frames")).expect("a folder");
        std::fs::write(at("scene.json"), r#"{"objects": [], "beam": {"mono_kev": 60}}"#).expect("written");
        std::fs::write(at("wrong.json"), r#"{"objects": [], "beam": {"mono_keV": 60}}"#).expect("written");
        // The port that is there, no calibration of that name, the nominal one, the robot's lines, then packets; no robot; a folder that is none; a
        // scene with a wrong key; no beads.
        let robot_lines = format!("{}/calibration/telemetry/generic-robot-csv.json", env!("CARGO_MANIFEST_DIR"));
        let mut lines = vec!["", "nowhere.json", "nominal", robot_lines.as_str(), PACKETS, NONE, "nothing"];
        let (frames, wrong, scene) = (at("frames"), at("wrong.json"), at("scene.json"));
        lines.extend([frames.as_str(), wrong.as_str(), scene.as_str(), NONE]);
        // Log values; no DICOM; OpenIGTLink, after a port that is none; a console that turns.
        lines.extend(["log", "", "many", "18944", "90"]);
        let answers = lines.join("\n") + "\n";
        let mut asker = Asker { answers: answers.as_bytes(), screen: Vec::new() };
        let session = folder.path().join("session.json");
        let (found, files) = answered(&args(&session), vec!["/dev/ttyUSB7".to_owned()], &mut asker).expect("answered");
        let screen = String::from_utf8(asker.screen).expect("text");
        for words in [
            "[/dev/ttyUSB7]",
            "nowhere.json",
            "lines of a robot, not of a C-arm",
            "'nothing' is no folder",
            "mono_keV",
            "'many' is no TCP port",
        ] {
            assert!(screen.contains(words), "{words}: {screen}");
        }
        assert_eq!(screen.matches("Port of the ").count(), 2);
        assert!(!screen.contains("K of the frames"), "the arm's calibration has it: {screen}");
        let carm = found.carm.expect("a C-arm");
        assert_eq!(
            (carm.port.as_path(), carm.calibration.as_path(), carm.baud),
            (Path::new("/dev/ttyUSB7"), Path::new(CARM.nominal.1), BAUD)
        );
        assert!(found.robot.is_none() && found.beads.is_none() && carm.adapter.is_none());
        assert_eq!((found.frames.folder.as_path(), found.scene.as_path()), (Path::new("frames"), Path::new("scene.json")));
        assert_eq!((found.domain, found.frames.dicom, found.igtl), (Some(Domain::Log), None, Some(IgtlServer::on_port(18_944))));
        assert_eq!(found.console.map(|console| console.rotation_deg), Some(90.0));
        let [(path, text)] = &files[..] else { panic!("{files:?}") };
        assert!(*path == folder.path().join(CARM.nominal.1) && parse_json::<CarmCalibration>(text.as_bytes()).is_ok());

        let mut given = args(&session);
        (given.carm, given.robot, given.frames) = (Some(NONE.to_owned()), Some("/dev/ttyACM0".to_owned()), Some(at("frames")));
        (given.robot_model, given.scene, given.beads) =
            (Some("nominal".to_owned()), Some(at("scene.json")), Some(NONE.to_owned()));
        given.robot_adapter = Some(robot_lines);
        std::fs::write(at("k.json"), r#"{"intrinsics": [[2600, 0, 309.5], [0, 2600, 239.5], [0, 0, 1]]}"#).expect("written");
        let mut silent = Asker { answers: &b""[..], screen: Vec::new() };
        let (found, files) = answered(&given, Vec::new(), &mut silent).expect("nothing that needs an answer");
        let asked = String::from_utf8(std::mem::take(&mut silent.screen)).expect("text");
        assert!(!asked.contains("Port of the ") && !asked.contains("Scene") && asked.contains("OpenIGTLink"), "{asked}");
        assert_eq!((found.domain, found.frames.dicom, found.igtl, found.console), (None, None, None, None));
        let robot = found.robot.expect("a robot");
        assert!(found.carm.is_none() && robot.baud == 115_200);
        assert!(robot.adapter.is_some_and(|file| file.ends_with("calibration/telemetry/generic-robot-csv.json")));
        assert!(parse_json::<RobotModel>(files[0].1.as_bytes()).is_ok());
        assert!(asked.contains("K of the frames") && found.intrinsics.is_none(), "no arm tells K: {asked}");
        given.further.intrinsics = Some(at("k.json"));
        let (found, _) = answered(&given, Vec::new(), &mut silent).expect("nothing that needs an answer");
        assert_eq!(found.intrinsics.as_deref(), Some(Path::new("k.json")));
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
        (given.carm_adapter, given.robot_adapter) = (Some(PACKETS.to_owned()), Some(PACKETS.to_owned()));
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
