//! What few labs need to say when a session file is made: every question has an answer that stands for none.

use std::io::{BufRead, Write};
use std::path::{Path, PathBuf};

use super::session_ask::{Asker, NONE, Question, SessionNewError, read};
use crate::acquire::video::VideoSettings;
use crate::acquire::{DetectorCalibration, Domain};
use crate::beads::parse_landmarks;
use crate::foreign::read_small;
use crate::geometry::{ConsoleGeometry, IntensifierCalibration, Rigid};
use crate::pose::IntrinsicsFile;
use crate::session::servers::{DicomServer, IgtlServer};

/// Its options; what they do not say is asked.
#[derive(Clone, Debug, Default, clap::Args)]
pub(super) struct FurtherArgs {
    /// What the frames' values mean: linear, log, display, or file for what each file says of itself
    #[arg(long, value_name = "DOMAIN")]
    pub domain: Option<String>,
    /// TCP port on which frames may be sent to this machine over DICOM, or none
    #[arg(long, value_name = "PORT")]
    pub dicom: Option<String>,
    /// TCP port on which 3D Slicer and others may listen over OpenIGTLink, or none
    #[arg(long, value_name = "PORT")]
    pub igtl: Option<String>,
    /// What the console does to the panel's picture: degrees clockwise, a file with the keys of "console", or none
    #[arg(long, value_name = "DEG|FILE")]
    pub console: Option<String>,
    /// K of the frames (as `register --intrinsics`), or none: from their headers, else solved from the beads; asked without a C-arm
    #[arg(long, value_name = "K.json")]
    pub intrinsics: Option<String>,
    /// What is asked besides, of sub-folders, video, landmarks, detector, intensifier and room, or none
    #[arg(long, value_name = "NAMES")]
    pub more: Option<String>,
    /// Whether folders below that of the frames are watched as well: yes or no
    #[arg(long, value_name = "YES|NO")]
    pub sub_folders: Option<String>,
    /// Video output whose pictures become frames: a capture device or a video file, or none
    #[arg(long, value_name = "DEVICE|FILE")]
    pub video: Option<String>,
    /// Points of the specimen where uncertainty is wanted (3D Slicer markups or .fcsv), or none
    #[arg(long, value_name = "FILE")]
    pub landmarks: Option<String>,
    /// Calibration of the panel (`calibrate detector`), or none
    #[arg(long, value_name = "FILE")]
    pub detector: Option<String>,
    /// Calibration of the image intensifier (`calibrate intensifier`), or none
    #[arg(long, value_name = "FILE")]
    pub intensifier: Option<String>,
    /// Where the specimen lies in the room: a file with the 4 x 4 numbers of world_from_lps, or none: solved from the first frames
    #[arg(long, value_name = "FILE")]
    pub world_from_lps: Option<String>,
}

/// What came of them.
pub(super) struct Further {
    pub domain: Option<Domain>,
    pub dicom: Option<DicomServer>,
    pub igtl: Option<IgtlServer>,
    pub console: Option<ConsoleGeometry>,
    pub intrinsics: Option<PathBuf>,
    pub sub_folders: bool,
    pub video: Option<VideoSettings>,
    pub landmarks: Option<PathBuf>,
    pub detector: Option<PathBuf>,
    pub intensifier: Option<PathBuf>,
    pub world_from_lps: Option<[[f64; 4]; 4]>,
}

/// What is asked where a lab has it: the words of `--more`.
const TOPICS: [&str; 6] = ["sub-folders", "video", "landmarks", "detector", "intensifier", "room"];

/// Asked of whoever has no C-arm line, without being named.
const K: &str = "K";

impl Further {
    /// `has_carm`: a calibrated arm tells K. `named` is a file as the session names it.
    pub fn ask<R: BufRead, W: Write>(
        args: &FurtherArgs,
        has_carm: bool,
        asker: &mut Asker<R, W>,
        named: &dyn Fn(&Path) -> PathBuf,
    ) -> Result<Self, SessionNewError> {
        let words = "Values of the frames: linear, log, display, unknown, or file (what each says of itself)";
        let domain = asker.ask(&question("--domain", &args.domain, words, "file"), &|answer| match answer {
            "file" => Ok(None),
            word => word.parse().map(Some),
        })?;
        let port = |answer: &str| match answer {
            NONE => Ok(None),
            // 0 is whichever is free: nobody knows where to connect.
            number => match number.parse() {
                Ok(port @ 1..) => Ok(Some(port)),
                _ => Err(format!("'{number}' is no TCP port, 1 to 65535")),
            },
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

        let words = format!("What else there is, of {}, or {NONE}", TOPICS.join(", "));
        let topics = asker.ask(&question("--more", &args.more, &words, NONE), &topics)?;
        let mut about = About { asker, topics, named };
        if !has_carm {
            about.topics.push(K);
        }
        let words = "K of the frames (k.json; else that of their headers)";
        let intrinsics = about.file(K, "--intrinsics", &args.intrinsics, words, &|path| {
            IntrinsicsFile::read(path).map(drop).map_err(|error| error.to_string())
        })?;
        let words = "Watch the folders below that of the frames as well: yes or no";
        let sub_folders =
            about.ask("sub-folders", &question("--sub-folders", &args.sub_folders, words, "no"), &|answer| match answer {
                "yes" => Ok(Some(true)),
                "no" => Ok(None),
                other => Err(format!("'{other}' is neither yes nor no")),
            })?;
        let words = "Video output (/dev/video0) or video file whose pictures become frames, or none";
        let video = about.ask("video", &question("--video", &args.video, words, NONE), &video)?;
        let landmarks = about.file("landmarks", "--landmarks", &args.landmarks, "Landmarks (markups)", &|path| {
            let content = read_small(path).map_err(|error| format!("{}: {error}", path.display()))?;
            parse_landmarks(path, &content).map(drop).map_err(|error| error.to_string())
        })?;
        let detector = about.file("detector", "--detector", &args.detector, "Calibration of the panel", &|path| {
            DetectorCalibration::read(path).map(drop).map_err(|error| error.to_string())
        })?;
        let words = "Calibration of the image intensifier";
        let intensifier = about.file("intensifier", "--intensifier", &args.intensifier, words, &|path| {
            IntensifierCalibration::read(path).map(drop).map_err(|error| format!("{}: {error}", path.display()))
        })?;
        let words = "Where the specimen lies in the room: a file with world_from_lps, or none: from the first frames";
        let world_from_lps = about.ask("room", &question("--world-from-lps", &args.world_from_lps, words, NONE), &room)?;
        Ok(Self {
            domain,
            dicom: dicom.map(DicomServer::on_port),
            igtl: igtl.map(IgtlServer::on_port),
            console,
            intrinsics,
            sub_folders: sub_folders.is_some(),
            video,
            landmarks,
            detector,
            intensifier,
            world_from_lps,
        })
    }
}

/// Of these, no answer means `default`.
fn question<'a>(option: &'static str, given: &'a Option<String>, words: &'a str, default: &'a str) -> Question<'a> {
    Question { option, given, words, default: Some(default), may_be_silent: true }
}

/// Asks about what there is.
struct About<'a, R, W> {
    asker: &'a mut Asker<R, W>,
    topics: Vec<&'static str>,
    named: &'a dyn Fn(&Path) -> PathBuf,
}

impl<R: BufRead, W: Write> About<'_, R, W> {
    /// The answer of a person who has said that there is a `topic`, or of the option; else none.
    fn ask<T>(
        &mut self,
        topic: &str,
        question: &Question<'_>,
        looked: &dyn Fn(&str) -> Result<Option<T>, String>,
    ) -> Result<Option<T>, SessionNewError> {
        let is_wanted = question.given.is_some() || self.topics.contains(&topic);
        if is_wanted { self.asker.ask(question, looked) } else { Ok(None) }
    }

    /// A file that is as `looked` wants it.
    fn file(
        &mut self,
        topic: &str,
        option: &'static str,
        given: &Option<String>,
        what: &str,
        looked: &dyn Fn(&Path) -> Result<(), String>,
    ) -> Result<Option<PathBuf>, SessionNewError> {
        let (words, named) = (format!("{what}, or {NONE}"), self.named);
        self.ask(topic, &question(option, given, &words, NONE), &|answer| match answer {
            NONE => Ok(None),
            path => looked(Path::new(path)).map(|()| Some(named(Path::new(path)))),
        })
    }
}

/// Names of [`TOPICS`], with commas or spaces between them.
fn topics(answer: &str) -> Result<Vec<&'static str>, String> {
    let words = answer.split([',', ' ']).map(str::trim).filter(|word| !word.is_empty() && *word != NONE);
    let topic = |word: &str| {
        let known = TOPICS.into_iter().find(|topic| *topic == word);
        known.ok_or_else(|| format!("'{word}' is none of {}, {NONE}", TOPICS.join(", ")))
    };
    words.map(topic).collect()
}

fn video(answer: &str) -> Result<Option<VideoSettings>, String> {
    if answer == NONE {
        return Ok(None);
    }
    let is_number = answer.bytes().all(|byte| byte.is_ascii_digit());
    let path = Path::new(answer);
    if !is_number && !path.exists() {
        return Err(format!("'{answer}' is neither a capture device nor a video file; plug it in, or name its number"));
    }
    // A session that is moved still finds it.
    let from = if path.is_file() { std::path::absolute(path).unwrap_or_else(|_| path.to_owned()) } else { path.to_owned() };
    Ok(Some(VideoSettings::of(&from.to_string_lossy())))
}

/// The matrix of a file that holds its rows, alone or under its name.
fn room(answer: &str) -> Result<Option<[[f64; 4]; 4]>, String> {
    if answer == NONE {
        return Ok(None);
    }
    let file: serde_json::Value = read(Path::new(answer))?;
    let rows = file.get("world_from_lps").unwrap_or(&file).clone();
    let rows: [[f64; 4]; 4] = serde_json::from_value(rows)
        .map_err(|error| format!("{answer}: 4 rows of 4 numbers are expected, millimetres: {error}"))?;
    Rigid::from_rows(&rows).map(|_| Some(rows)).map_err(|error| format!("{answer}: {error}"))
}

#[cfg(test)]
mod tests {
    use super::*;

    const ROOM: &str = "[[1,0,0,0],[0,0,-1,0],[0,1,0,900],[0,0,0,1]]";

    /// What is asked of a person who answers with `lines`, and what comes of it.
    fn asked(args: &FurtherArgs, lines: &[&str]) -> (Result<Further, SessionNewError>, String) {
        let answers = lines.iter().map(|line| format!("{line}\n")).collect::<String>();
        let mut asker = Asker { answers: answers.as_bytes(), screen: Vec::new() };
        let found = Further::ask(args, true, &mut asker, &|path| PathBuf::from(path.file_name().unwrap_or_default()));
        (found, String::from_utf8(asker.screen).expect("text"))
    }

    #[test]
    fn only_what_a_lab_says_that_it_has_is_asked_and_each_answer_is_looked_at() {
        let folder = tempfile::tempdir().expect("a folder");
        let at = |name: &str| folder.path().join(name).display().to_string();
        std::fs::write(
            at("points.fcsv"),
            "# CoordinateSystem = LPS\n# columns = id,x,y,z,label,desc,associatedNodeID\n1,10,20,30,tip,,\n",
        )
        .expect("written");
        std::fs::write(at("room.json"), ROOM).expect("written");
        std::fs::write(at("mirrored.json"), ROOM.replace("-1", "1")).expect("written");
        std::fs::write(at("video.avi"), "RIFF").expect("written");
        let (points, room, mirrored, video) = (at("points.fcsv"), at("room.json"), at("mirrored.json"), at("video.avi"));
        // Domain, DICOM, OpenIGTLink and console as they are; a word that is no topic; four topics, in their own order.
        let lines = ["", "", "", "", "sofa", "room, landmarks video sub-folders", "perhaps", "yes", "/dev/nothing", &video];
        let rest = [room.as_str(), &points, &mirrored, &room];
        let (found, screen) = asked(&FurtherArgs::default(), &[&lines[..], &rest[..]].concat());
        let found = found.expect("answered");
        for words in ["'sofa' is none of sub-folders", "'perhaps' is neither yes nor no", "'/dev/nothing' is neither"] {
            assert!(screen.contains(words), "{words}: {screen}");
        }
        assert!(!screen.contains("Calibration of the"), "nobody has a detector or an intensifier: {screen}");
        assert!(screen.matches("Landmarks").count() == 2 && screen.matches("Where the specimen").count() == 2, "{screen}");
        assert!(found.sub_folders && found.landmarks.as_deref() == Some(Path::new("points.fcsv")));
        assert_eq!(found.video.map(|video| video.from), Some(at("video.avi")));
        assert_eq!(found.world_from_lps.map(|rows| rows[2]), Some([0.0, 1.0, 0.0, 900.0]));
        assert!(found.detector.is_none() && found.intensifier.is_none());
    }

    #[test]
    fn nobody_needs_to_answer_and_options_are_not_asked() {
        let (found, screen) = asked(&FurtherArgs::default(), &[]);
        let found = found.expect("no answer is an answer");
        assert!(!found.sub_folders && found.video.is_none() && found.landmarks.is_none() && found.world_from_lps.is_none());
        assert!(screen.contains("What else there is") && !screen.contains("Landmarks (markups)"), "{screen}");

        let folder = tempfile::tempdir().expect("a folder");
        let place = folder.path().join("session.json");
        std::fs::write(&place, format!("{{\"world_from_lps\": {ROOM}}}")).expect("written");
        let given = |words: &str| Some(words.to_owned());
        let args = FurtherArgs {
            more: given("none"),
            sub_folders: given("yes"),
            video: given("0"),
            world_from_lps: given(&place.display().to_string()),
            ..FurtherArgs::default()
        };
        let (found, screen) = asked(&args, &[]);
        let found = found.expect("given");
        assert!(!screen.contains("What else") && !screen.contains("Watch"), "{screen}");
        assert!(found.sub_folders && found.world_from_lps.is_some());
        assert_eq!(found.video.map(|video| video.from).as_deref(), Some("0"));

        let mut cases = 0;
        for (option, args) in [
            ("--more", FurtherArgs { more: given("detectors"), ..FurtherArgs::default() }),
            ("--dicom", FurtherArgs { dicom: given("0"), ..FurtherArgs::default() }),
            ("--igtl", FurtherArgs { igtl: given("0"), ..FurtherArgs::default() }),
            ("--sub-folders", FurtherArgs { sub_folders: given("1"), ..FurtherArgs::default() }),
            ("--video", FurtherArgs { video: given("/dev/nothing"), ..FurtherArgs::default() }),
            ("--landmarks", FurtherArgs { landmarks: given("nowhere.fcsv"), ..FurtherArgs::default() }),
            ("--intrinsics", FurtherArgs { intrinsics: given("nowhere.json"), ..FurtherArgs::default() }),
            ("--detector", FurtherArgs { detector: given("nowhere.json"), ..FurtherArgs::default() }),
            ("--intensifier", FurtherArgs { intensifier: given("nowhere.json"), ..FurtherArgs::default() }),
            ("--world-from-lps", FurtherArgs { world_from_lps: given("nowhere.json"), ..FurtherArgs::default() }),
        ] {
            let refused = asked(&args, &[]).0.err().map(|error| error.to_string()).unwrap_or_default();
            assert!(refused.starts_with(&format!("{option} ")), "{option}: {refused}");
            cases += 1;
        }
        assert_eq!(cases, 10);
    }
}
