//! What is typed, and what it means.

use std::path::PathBuf;

use clap::Parser;

use mock_lab::MockError;
use mock_lab::delivery::Way;
use mock_lab::dialect::Dialect;
use mock_lab::fault::FaultKind;
use mock_lab::lab::{Device, Fault};
use mock_lab::monitor::file_in;
use mock_lab::oddity::Oddity;
use mock_lab::tag_lie::TagLie;

/// A C-arm, a snake robot and a detector at the wire: pseudo-terminals with real-time telemetry and faults, DICOM frames in a folder.
///
/// Devices may print lines instead of sending packets, over datagrams or into files as well; frames may come over DICOM or off a monitor.
///
/// Prints one JSON line per event; the first, `ready`, names the session file and the ports.
#[derive(Debug, Parser)]
#[command(
    name = "mock-lab",
    version,
    after_help = "Example:
  mock-lab --out /tmp/lab --duration-s 20 &
  sidecarm live /tmp/lab/session.json --headless
The same with other wires, each in a folder of its own:
  mock-lab --out a --lines carm:words,robot:csv      lines, declared in a/carm-lines.json and a/robot-lines.json
  mock-lab --out b --lines robot:json --tail robot   a robot whose program writes objects into b/robot.log
  mock-lab --out c --dicom 11112                     frames by C-STORE
  mock-lab --out d --video monitor                   frames off a monitor
  mock-lab --out e --video recording --kit-only      frames off a recording of it, without devices"
)]
pub struct Args {
    /// Folder for the lab kit (CT, beads, scene, session), the ports and the frames.
    #[arg(long)]
    pub out: PathBuf,
    /// Seed of noise and encoders.
    #[arg(long, default_value_t = 1)]
    pub seed: u64,
    /// Length of the session in seconds.
    #[arg(long, default_value_t = 20.0)]
    pub duration_s: f64,
    /// Waits at most so many seconds until somebody reads one of the ports.
    #[arg(long, default_value_t = 60.0)]
    pub await_reader_s: f64,
    /// Waits until all ports are read.
    #[arg(long)]
    pub await_all: bool,
    /// Seconds between that and the first packet.
    #[arg(long, default_value_t = 1.0)]
    pub start_delay_s: f64,
    /// Seconds in which the devices go on telling where they are when the session is over.
    #[arg(long, default_value_t = 0.0)]
    pub idle_s: f64,
    /// Seconds between the last packet and the lines' end.
    #[arg(long, default_value_t = 3.0)]
    pub linger_s: f64,
    /// Length of an exposure in seconds, other than the script's.
    #[arg(long, value_name = "SECONDS")]
    pub exposure_s: Option<f64>,
    /// Exposures, at most all of the script's.
    #[arg(long, default_value_t = usize::MAX, hide_default_value = true)]
    pub exposures: usize,
    /// `default`, `none`, or a list of KIND (those of the script), DEVICE:KIND or DEVICE:KIND@SHARE of the session.
    ///
    /// Kinds: drop, flip, tear, duplicate, reorder, delay, unplug, away (unplugged, and by the device for an hour), mute (silent for good), gone (unplugged for good), freeze (its clock), stuck (its clock, but for what it says of itself), stale (all that it measures), restart (its clock and its numbers begin anew), jump (its clock, by 5 s), ahead and back (its clock, by an hour), millis (its clock counts milliseconds), other (another device goes on in its place); devices: carm, robot.
    #[arg(long, default_value = "default", value_name = "LIST")]
    pub faults: String,
    /// Packets per second, relative to 100 Hz (robot) and 30 Hz (C-arm).
    #[arg(long, default_value_t = 1.0)]
    pub rate: f64,
    /// The same when the session is over, for --idle-s; as --rate when absent.
    #[arg(long)]
    pub idle_rate: Option<f64>,
    /// How often the scripted exposures are played within the session.
    #[arg(long, default_value_t = 1)]
    pub repeat: usize,
    /// Seconds for which an unplugged line stays away.
    #[arg(long, value_name = "SECONDS")]
    pub unplugged_s: Option<f64>,
    /// Share of the time in which a device holds its packets back, at random, and then sends them at once.
    #[arg(long, default_value_t = 0.0, value_name = "SHARE")]
    pub stalled: f64,
    /// Share of the packets that never leave the device, at random.
    #[arg(long, default_value_t = 0.0, value_name = "SHARE")]
    pub missing: f64,
    /// Lines that carry random bytes instead of packets: carm, robot or both.
    #[arg(long, value_delimiter = ',', value_parser = device)]
    pub garbage: Vec<Device>,
    /// What the devices say oddly in packets that are well formed: carm-stopped, copper, sid-in-metres, robot-homing, tracked, tracked-at-first,
    /// sensed-at-first, apart, swaying.
    #[arg(long, value_delimiter = ',', value_parser = oddity)]
    pub odd: Vec<Oddity>,
    /// Writes for every packet that leaves a device: host time in µs, device, sequence, bytes.
    #[arg(long, value_name = "FILE.csv")]
    pub sent: Option<PathBuf>,
    /// Takes the exposures at these stands of the script, counted from 1: in 1,2,2 the arm stays where it is for the third.
    #[arg(long, value_delimiter = ',', value_name = "LIST")]
    pub stands: Vec<usize>,
    /// From this exposure on, counted from 1, the specimen lies 15 mm and 4 degrees from where it lay: somebody moved it, and no device tells.
    #[arg(long, value_name = "EXPOSURE")]
    pub specimen_moves: Option<usize>,
    /// In these exposures, counted from 1, the arm's orbital angle goes on by 2 degrees while the beam is on; the picture is that of the middle.
    #[arg(long, value_delimiter = ',', value_name = "LIST")]
    pub arm_moves: Vec<usize>,
    /// What the tags of frames say otherwise than the arm's line: a list of KIND@EXPOSURE, counted from 1; kinds: kvp (20 kV more), filter
    /// (0.3 mm more of copper), collimator (the left shutter 60 mm further in).
    #[arg(long, value_delimiter = ',', value_parser = tag_lie, value_name = "LIST")]
    pub tags_lie: Vec<(TagLie, usize)>,
    /// Another panel: square, as high as the lab's own, of so many pixels a side.
    #[arg(long, value_name = "PIXELS")]
    pub panel_px: Option<u32>,
    /// No exposure counter on the wire and in the frames.
    #[arg(long)]
    pub no_counter: bool,
    /// Datagrams to these two ports of this machine, instead of pseudo-terminals: as a robot and an arm on a network send them.
    #[arg(long, value_delimiter = ',', value_name = "CARM,ROBOT", value_parser = clap::value_parser!(u16).range(1..))]
    pub udp: Vec<u16>,
    /// Devices that print lines instead of sending packets, each as DEVICE:FORMAT; formats: csv, json, words.
    #[arg(long, value_delimiter = ',', value_parser = lines, value_name = "LIST")]
    pub lines: Vec<(Device, Dialect)>,
    /// Devices whose bytes are written to the end of a file, carm.log or robot.log, instead of pseudo-terminals.
    #[arg(long, value_delimiter = ',', value_parser = device, value_name = "LIST", conflicts_with = "udp")]
    pub tail: Vec<Device>,
    /// Frames are sent to this port of this machine by C-STORE; their files lie in exported/, where no session looks.
    #[arg(long, value_name = "PORT", value_parser = clap::value_parser!(u16).range(1..), conflicts_with = "video")]
    pub dicom: Option<u16>,
    /// Frames are shown on a monitor: `monitor` gives what a capture device sees of it, through a pipe, `recording` makes a file of it
    /// beforehand; the files of frames lie in exported/.
    #[arg(long, value_name = "KIND")]
    pub video: Option<Video>,
    /// No C-arm line.
    #[arg(long)]
    pub no_carm: bool,
    /// No robot line.
    #[arg(long)]
    pub no_robot: bool,
    /// Only write the kit and the frames; no ports, no real time.
    #[arg(long)]
    pub kit_only: bool,
    /// A CT and pictures that lie in this folder are not drawn again, and those that are drawn are kept there, for other runs of this very
    /// program. Without it, the folder that the environment names as MOCK_LAB_DRAWN.
    #[arg(long, value_name = "FOLDER")]
    pub drawn: Option<PathBuf>,
}

/// How a monitor is seen.
#[derive(Clone, Copy, Debug, PartialEq, Eq, clap::ValueEnum)]
pub enum Video {
    Monitor,
    Recording,
}

fn device(name: &str) -> Result<Device, String> {
    [Device::Carm, Device::Robot]
        .into_iter()
        .find(|known| known.name() == name)
        .ok_or_else(|| "expected carm or robot".to_owned())
}

fn lines(text: &str) -> Result<(Device, Dialect), String> {
    let (name, format) = text.split_once(':').ok_or("expected DEVICE:FORMAT, as in robot:csv")?;
    let known = Dialect::ALL.into_iter().find(|known| known.name() == format);
    let known = known.ok_or_else(|| format!("expected one of {}", Dialect::ALL.map(Dialect::name).join(", ")))?;
    Ok((device(name)?, known))
}

fn oddity(name: &str) -> Result<Oddity, String> {
    let known = Oddity::ALL.into_iter().find(|known| known.name() == name);
    known.ok_or_else(|| format!("expected one of {}", Oddity::ALL.map(Oddity::name).join(", ")))
}

fn tag_lie(text: &str) -> Result<(TagLie, usize), String> {
    let (name, exposure) = text.split_once('@').ok_or("expected KIND@EXPOSURE")?;
    let known = TagLie::ALL.into_iter().find(|known| known.name() == name);
    let known = known.ok_or_else(|| format!("expected one of {}", TagLie::ALL.map(TagLie::name).join(", ")))?;
    Ok((known, exposure.parse().map_err(|_| "the exposure is not a number")?))
}

impl Args {
    /// How frames reach the receiver.
    pub fn way(&self) -> Way {
        match (self.dicom, self.video) {
            (Some(port), _) => Way::Dicom(port),
            (None, Some(Video::Monitor)) => Way::Monitor(file_in(&self.out, false)),
            (None, Some(Video::Recording)) => Way::Recording(file_in(&self.out, true)),
            (None, None) => Way::Folder,
        }
    }
}

/// What `--faults` asks for, of the `scripted` ones or new ones.
pub fn choose(list: &str, scripted: &[Fault]) -> Result<Vec<Fault>, MockError> {
    if let "default" | "none" = list {
        return Ok(if list == "none" { Vec::new() } else { scripted.to_vec() });
    }
    let mut out = Vec::new();
    for item in list.split(',').map(str::trim) {
        let wrong = |detail: &str| MockError::Data { what: format!("--faults '{item}'"), detail: detail.to_owned() };
        let (item_without_share, share) = match item.split_once('@') {
            Some((rest, share)) => (rest, Some(share.parse::<f64>().map_err(|_| wrong("the share is not a number"))?)),
            None => (item, None),
        };
        if share.is_some_and(|share| !(0.0..=1.0).contains(&share)) {
            return Err(wrong("the share is not within 0 to 1"));
        }
        let (device, kind) = match item_without_share.split_once(':') {
            Some((name, kind)) => (Some(device(name).map_err(|expected| wrong(&expected))?), kind),
            None => (None, item_without_share),
        };
        let known = FaultKind::ALL.into_iter().find(|known| known.name() == kind);
        let kind = known.ok_or_else(|| {
            let all: Vec<&str> = FaultKind::ALL.iter().map(|kind| kind.name()).collect();
            wrong(&format!("not one of {}", all.join(", ")))
        })?;
        match (device, share) {
            (Some(device), Some(at)) => out.push(Fault { device, at, kind }),
            (None, Some(_)) => return Err(wrong("a share needs a device, as in robot:unplug@0.5")),
            (device, None) => {
                let asked = |fault: &&Fault| fault.kind == kind && device.is_none_or(|device| device == fault.device);
                let found: Vec<Fault> = scripted.iter().filter(asked).cloned().collect();
                if found.is_empty() {
                    return Err(wrong("the script has none; say when, as in robot:unplug@0.5"));
                }
                out.extend(found);
            }
        }
    }
    Ok(out)
}

#[cfg(test)]
mod tests {
    use super::*;
    use mock_lab::lab::Lab;

    #[test]
    fn faults_are_chosen_by_kind_device_and_time() {
        let scripted = Lab::embedded().expect("embedded").faults;
        assert_eq!(choose("default", &scripted).expect("all"), scripted);
        assert_eq!(choose("none", &scripted).expect("none"), []);
        let unplugs = choose("robot:unplug", &scripted).expect("scripted");
        assert!(unplugs.len() == 1 && unplugs[0].device == Device::Robot && unplugs[0].kind == FaultKind::Unplug);
        let asked = choose("carm:tear@0.25, flip", &scripted).expect("asked");
        assert_eq!(asked[0], Fault { device: Device::Carm, at: 0.25, kind: FaultKind::Tear });
        assert!(asked.len() > 1 && asked[1..].iter().all(|fault| fault.kind == FaultKind::Flip));
        for wrong in ["", "melt", "arm:flip", "flip@0.5", "robot:flip@1.5", "robot:flip@NaN", "carm:tear"] {
            assert!(choose(wrong, &scripted).is_err(), "{wrong}");
        }
    }

    #[test]
    fn lines_are_of_a_device_and_in_a_format() {
        assert_eq!(lines("robot:json"), Ok((Device::Robot, Dialect::Json)));
        for wrong in ["", "robot", "robot:", "drill:csv", "carm:xml"] {
            assert!(lines(wrong).is_err(), "{wrong}");
        }
        let refused = |args: &[&str]| Args::try_parse_from([&["mock-lab", "--out", "x"][..], args].concat()).is_err();
        assert!(!refused(&["--dicom", "11112", "--lines", "carm:words,robot:csv", "--tail", "carm"]), "control");
        for wrong in [&["--dicom", "11112", "--video", "monitor"][..], &["--udp", "1,2", "--tail", "carm"], &["--video", "film"]]
        {
            assert!(refused(wrong), "{wrong:?}");
        }
    }

    #[test]
    fn lies_of_tags_are_of_an_exposure() {
        assert_eq!(tag_lie("filter@3"), Ok((TagLie::Filter, 3)));
        for wrong in ["", "filter", "@3", "dose@3", "filter@x", "filter@-1"] {
            assert!(tag_lie(wrong).is_err(), "{wrong}");
        }
    }
}
