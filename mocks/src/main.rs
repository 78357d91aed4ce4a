//! The `mock-lab` program.

use std::path::{Path, PathBuf};
use std::process::ExitCode;

use clap::Parser;
use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;
use serde_json::json;

use mock_lab::MockError;
use mock_lab::dicom::{BeamTags, FrameTags, deliver, encode};
use mock_lab::drawn;
use mock_lab::fault::FaultKind;
use mock_lab::kinematics::camera_from_lps;
use mock_lab::kit::{arm, frame_name, true_world_from_lps, write};
use mock_lab::lab::{Device, Fault, Lab};
use mock_lab::oddity::Oddity;
use mock_lab::phantom::Phantom;
use mock_lab::play::{Drawn, Performance, play, say};
use mock_lab::pty::Line;
use mock_lab::radiograph::{Physics, Shot, take};
use mock_lab::script::Script;
use mock_lab::tag_lie::TagLie;
use mock_lab::wire::CarmMessage;

/// A C-arm, a snake robot and a detector at the wire: pseudo-terminals with real-time telemetry and faults, DICOM frames in a folder.
///
/// Prints one JSON line per event; the first, `ready`, names the session file and the ports.
#[derive(Debug, Parser)]
#[command(
    name = "mock-lab",
    version,
    after_help = "Example:\n  mock-lab --out /tmp/lab --duration-s 20 &\n  sidecarm live /tmp/lab/session.json --headless"
)]
struct Args {
    /// Folder for the lab kit (CT, beads, scene, session), the ports and the frames.
    #[arg(long)]
    out: PathBuf,
    /// Seed of noise and encoders.
    #[arg(long, default_value_t = 1)]
    seed: u64,
    /// Length of the session in seconds.
    #[arg(long, default_value_t = 20.0)]
    duration_s: f64,
    /// Waits at most so many seconds until somebody reads one of the ports.
    #[arg(long, default_value_t = 60.0)]
    await_reader_s: f64,
    /// Waits until all ports are read.
    #[arg(long)]
    await_all: bool,
    /// Seconds between that and the first packet.
    #[arg(long, default_value_t = 1.0)]
    start_delay_s: f64,
    /// Seconds in which the devices go on telling where they are when the session is over.
    #[arg(long, default_value_t = 0.0)]
    idle_s: f64,
    /// Seconds between the last packet and the lines' end.
    #[arg(long, default_value_t = 3.0)]
    linger_s: f64,
    /// Length of an exposure in seconds, other than the script's.
    #[arg(long, value_name = "SECONDS")]
    exposure_s: Option<f64>,
    /// Exposures, at most all of the script's.
    #[arg(long, default_value_t = usize::MAX, hide_default_value = true)]
    exposures: usize,
    /// `default`, `none`, or a list of KIND (those of the script), DEVICE:KIND or DEVICE:KIND@SHARE of the session.
    ///
    /// Kinds: drop, flip, tear, duplicate, reorder, delay, unplug, away (unplugged, and by the device for an hour), mute (silent for good), gone (unplugged for good), freeze (its clock), restart (its clock and its numbers begin anew), jump (its clock, by 5 s), ahead and back (its clock, by an hour), millis (its clock counts milliseconds); devices: carm, robot.
    #[arg(long, default_value = "default", value_name = "LIST")]
    faults: String,
    /// Packets per second, relative to 100 Hz (robot) and 30 Hz (C-arm).
    #[arg(long, default_value_t = 1.0)]
    rate: f64,
    /// The same when the session is over, for --idle-s; as --rate when absent.
    #[arg(long)]
    idle_rate: Option<f64>,
    /// How often the scripted exposures are played within the session.
    #[arg(long, default_value_t = 1)]
    repeat: usize,
    /// Seconds for which an unplugged line stays away.
    #[arg(long, value_name = "SECONDS")]
    unplugged_s: Option<f64>,
    /// Share of the time in which a device holds its packets back, at random, and then sends them at once.
    #[arg(long, default_value_t = 0.0, value_name = "SHARE")]
    stalled: f64,
    /// Share of the packets that never leave the device, at random.
    #[arg(long, default_value_t = 0.0, value_name = "SHARE")]
    missing: f64,
    /// Lines that carry random bytes instead of packets: carm, robot or both.
    #[arg(long, value_delimiter = ',', value_parser = device)]
    garbage: Vec<Device>,
    /// What the devices say oddly in packets that are well formed: carm-stopped, copper, robot-homing, tracked, tracked-at-first,
    /// sensed-at-first, apart, swaying.
    #[arg(long, value_delimiter = ',', value_parser = oddity)]
    odd: Vec<Oddity>,
    /// Writes for every packet that leaves a device: host time in µs, device, sequence, bytes.
    #[arg(long, value_name = "FILE.csv")]
    sent: Option<PathBuf>,
    /// Takes the exposures at these stands of the script, counted from 1: in 1,2,2 the arm stays where it is for the third.
    #[arg(long, value_delimiter = ',', value_name = "LIST")]
    stands: Vec<usize>,
    /// From this exposure on, counted from 1, the specimen lies 15 mm and 4 degrees from where it lay: somebody moved it, and no device tells.
    #[arg(long, value_name = "EXPOSURE")]
    specimen_moves: Option<usize>,
    /// In these exposures, counted from 1, the arm's orbital angle goes on by 2 degrees while the beam is on; the picture is that of the middle.
    #[arg(long, value_delimiter = ',', value_name = "LIST")]
    arm_moves: Vec<usize>,
    /// What the tags of frames say otherwise than the arm's line: a list of KIND@EXPOSURE, counted from 1; kinds: kvp (20 kV more), filter
    /// (0.3 mm more of copper), collimator (the left shutter 60 mm further in).
    #[arg(long, value_delimiter = ',', value_parser = tag_lie, value_name = "LIST")]
    tags_lie: Vec<(TagLie, usize)>,
    /// Another panel: square, as high as the lab's own, of so many pixels a side.
    #[arg(long, value_name = "PIXELS")]
    panel_px: Option<u32>,
    /// No exposure counter on the wire and in the frames.
    #[arg(long)]
    no_counter: bool,
    /// Datagrams to these two ports of this machine, instead of pseudo-terminals: as a robot and an arm on a network send them.
    #[arg(long, value_delimiter = ',', value_name = "CARM,ROBOT", value_parser = clap::value_parser!(u16).range(1..))]
    udp: Vec<u16>,
    /// No C-arm line.
    #[arg(long)]
    no_carm: bool,
    /// No robot line.
    #[arg(long)]
    no_robot: bool,
    /// Only write the kit and the frames; no ports, no real time.
    #[arg(long)]
    kit_only: bool,
    /// A CT and pictures that lie in this folder are not drawn again, and those that are drawn are kept there, for other runs of this very
    /// program. Without it, the folder that the environment names as MOCK_LAB_DRAWN.
    #[arg(long, value_name = "FOLDER")]
    drawn: Option<PathBuf>,
}

fn device(name: &str) -> Result<Device, String> {
    [Device::Carm, Device::Robot]
        .into_iter()
        .find(|known| known.name() == name)
        .ok_or_else(|| "expected carm or robot".to_owned())
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

fn main() -> ExitCode {
    let mut args = Args::parse();
    args.drawn = args.drawn.take().or_else(|| std::env::var_os("MOCK_LAB_DRAWN").map(PathBuf::from));
    match run(&args) {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            eprintln!("mock-lab: {error}");
            ExitCode::FAILURE
        }
    }
}

fn run(args: &Args) -> Result<(), MockError> {
    let within = |what: &str, value: f64, low: f64, high: f64| match value >= low && value <= high {
        true => Ok(()),
        false => Err(MockError::Data { what: what.to_owned(), detail: format!("{value}, expected {low} to {high}") }),
    };
    within("--duration-s", args.duration_s, 5.0, 86_400.0)?;
    within("--await-reader-s", args.await_reader_s, 0.0, 3600.0)?;
    within("--start-delay-s", args.start_delay_s, 0.0, 3600.0)?;
    within("--linger-s", args.linger_s, 0.0, 3600.0)?;
    within("--idle-s", args.idle_s, 0.0, 86_400.0)?;
    within("--unplugged-s", args.unplugged_s.unwrap_or(1.0), 0.01, 86_400.0)?;
    within("--stalled", args.stalled, 0.0, 0.9)?;
    within("--rate", args.rate, 0.01, 100.0)?;
    let idle_rate = args.idle_rate.unwrap_or(args.rate);
    within("--idle-rate", idle_rate, 0.01, 1000.0)?;
    within("--repeat", args.repeat as f64, 1.0, 1000.0)?;
    within("--missing", args.missing, 0.0, 1.0)?;
    if !matches!(args.udp[..], [] | [_, _]) {
        let detail = "expected two ports, the C-arm's and the robot's, as in --udp 5005,5006".to_owned();
        return Err(MockError::Data { what: "--udp".to_owned(), detail });
    }
    let mut lab = Lab::embedded()?.at_stands(&args.stands)?.repeated(args.repeat);
    if let Some(exposure) = args.specimen_moves {
        within("--specimen-moves", exposure as f64, 1.0, lab.exposures.len() as f64)?;
        lab.moved_from = exposure.checked_sub(1);
    }
    let exposures = lab.exposures.len() as f64;
    for exposure in &args.arm_moves {
        within("--arm-moves", *exposure as f64, 1.0, exposures)?;
        lab.arm_moves.push(exposure - 1);
    }
    for (_, exposure) in &args.tags_lie {
        within("--tags-lie", *exposure as f64, 1.0, exposures)?;
    }
    if let Some(side_px) = args.panel_px {
        within("--panel-px", f64::from(side_px), 64.0, 4096.0)?;
        lab = lab.with_square_panel(side_px);
    }
    if let Some(exposure_s) = args.exposure_s {
        let apart = lab.exposures.windows(2).map(|pair| (pair[1].at - pair[0].at) * args.duration_s);
        within("--exposure-s", exposure_s, 0.05, apart.fold(3600.0, f64::min) - 0.3)?;
        lab.exposure_s = exposure_s;
    }
    let faults = choose(&args.faults, &lab.faults)?;
    let phantom = Phantom::embedded()?;
    refuse_old_frames(&args.out)?;
    let script = Script { lab: &lab, duration_s: args.duration_s, exposures: args.exposures, counter: !args.no_counter };
    let port = |wanted: bool, number: usize, name: &str| {
        wanted.then(|| args.udp.get(number).map_or_else(|| name.to_owned(), |port| format!("udp://127.0.0.1:{port}")))
    };
    let (carm, robot) = (port(!args.no_carm, 0, "ttyCARM"), port(!args.no_robot, 1, "ttyROBOT"));
    write(&args.out, &script, &phantom, [carm.as_deref(), robot.as_deref()], args.drawn.as_deref())?;
    let frames = draw_frames(args, &script, &phantom)?;
    let session = args.out.join("session.json");
    if args.kit_only {
        for frame in &frames {
            deliver(&frame.path, &encode(&frame.tags, &frame.values)?)?;
        }
        say(&json!({"event": "finished", "session": session, "frames": frames.len()}));
        return Ok(());
    }
    let mut lines = Vec::new();
    let mut open = |name: Option<String>, device: Device, number: usize| -> Result<Option<PathBuf>, MockError> {
        let Some(name) = name else { return Ok(None) };
        let line = args.udp.get(number).map_or_else(|| Line::open(&args.out.join(name)), |port| Line::to_port(*port))?;
        let path = line.path().to_owned();
        lines.push((device, line));
        Ok(Some(path))
    };
    let (carm, robot) = (open(carm, Device::Carm, 0)?, open(robot, Device::Robot, 1)?);
    say(&json!({"event": "ready", "session": session, "carm_port": carm, "robot_port": robot, "exposures": frames.len()}));
    let performance = Performance {
        await_reader_s: args.await_reader_s,
        await_all: args.await_all,
        start_delay_s: args.start_delay_s,
        idle_s: args.idle_s,
        linger_s: args.linger_s,
        rate: args.rate,
        idle_rate,
        faults,
        unplugged_s: args.unplugged_s,
        stalled: args.stalled,
        missing: args.missing,
        garbage: args.garbage.clone(),
        oddities: args.odd.clone(),
        sent: args.sent.clone(),
        seed: args.seed,
    };
    play(&script, &performance, lines, &frames, &mut |event| say(&event))
}

/// Frames of an earlier session would be taken for this one's.
fn refuse_old_frames(out: &Path) -> Result<(), MockError> {
    let folder = out.join("frames");
    let count = std::fs::read_dir(&folder).map_or(0, Iterator::count);
    match count {
        0 => Ok(()),
        _ => {
            let detail = format!("holds {count} files of an earlier session; choose another --out, or remove it");
            Err(MockError::Data { what: folder.display().to_string(), detail })
        }
    }
}

/// What `--faults` asks for, of the `scripted` ones or new ones.
fn choose(list: &str, scripted: &[Fault]) -> Result<Vec<Fault>, MockError> {
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
            Some((device, kind)) => {
                let known = [Device::Carm, Device::Robot].into_iter().find(|known| known.name() == device);
                (Some(known.ok_or_else(|| wrong("the device is not carm or robot"))?), kind)
            }
            None => (None, item_without_share),
        };
        let known = FaultKind::ALL.into_iter().find(|known| known.name() == kind);
        let kind = known.ok_or_else(|| {
            wrong(
                "not one of drop, flip, tear, duplicate, reorder, delay, unplug, away, mute, gone, freeze, restart, jump, ahead, back, millis",
            )
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

/// What the arm tells in the middle of the `index`-th exposure, from 0: its console knows the same.
fn told(args: &Args, script: &Script, index: usize) -> CarmMessage {
    let at_s = script.start_s(index) + 0.5 * script.lab.exposure_s;
    let mut message = script.carm(at_s, &mut ChaCha8Rng::seed_from_u64(args.seed));
    args.odd.iter().for_each(|oddity| oddity.befall_carm(&mut message));
    message
}

/// Draws every frame of the session beforehand.
fn draw_frames(args: &Args, script: &Script, phantom: &Phantom) -> Result<Vec<Drawn>, MockError> {
    let lab = script.lab;
    let arm = arm(lab)?;
    let physics = Physics::embedded()?;
    // What is moved has another picture in the next round.
    let rounds = if lab.moved_from.is_some() { 1 } else { args.repeat };
    let distinct = script.count().min(lab.exposures.len() / rounds);
    eprintln!("mock-lab: drawing {distinct} frames");
    let mut frames: Vec<Drawn> = Vec::new();
    for (index, exposure) in lab.exposures.iter().take(script.count()).enumerate() {
        let path = args.out.join("frames").join(frame_name(index));
        // A repeated exposure has the same picture; time, counter and instance are its own.
        if let Some(first) = index.checked_sub(distinct) {
            let Drawn { tags, values, .. } = frames[first].clone();
            let exposure_counter = script.counter.then_some(index as u32 + 1);
            frames.push(Drawn { path, tags: FrameTags { exposure_counter, instance: index as u32 + 1, ..tags }, values });
            continue;
        }
        let shot = Shot {
            size_px: arm.size_px,
            geometry: arm.geometry,
            source_to_detector_mm: arm.source_to_detector_mm,
            pitch_mm: arm.pitch_mm,
            camera_from_lps: camera_from_lps(&arm.geometry, &exposure.joints(), &true_world_from_lps(lab, index)),
            field_mm: exposure.field_mm,
            photons_per_pixel: lab.photons_per_pixel,
            readout_sigma: lab.readout_sigma,
            noise: true,
            seed: args.seed.wrapping_add(index as u64 * 7919),
        };
        let mut bodies = phantom.tissue();
        bodies.extend(phantom.metal(&exposure.control_deg));
        let key = format!("{shot:?} {bodies:?} {}", lab.air_value);
        let bytes = drawn::once(args.drawn.as_deref(), &key, || {
            let value = |v: &f64| (v * lab.air_value).round().clamp(0.0, 65_535.0) as u16;
            Ok(take(&shot, &bodies, &physics).iter().flat_map(|v| value(v).to_le_bytes()).collect())
        })?;
        let values: Vec<u16> = bytes.chunks_exact(2).map(|pair| u16::from_le_bytes([pair[0], pair[1]])).collect();
        let told = told(args, script, index);
        let mut tags = FrameTags {
            size_px: arm.size_px,
            pitch_mm: arm.pitch_mm,
            source_to_detector_mm: arm.source_to_detector_mm,
            tube_kvp: told.tube_kvp,
            tube_ma: told.tube_ma,
            exposure_ms: 1e3 * lab.exposure_s,
            acquired_us: None,
            exposure_counter: script.counter.then_some(index as u32 + 1),
            instance: index as u32 + 1,
            beam: Some(BeamTags { filter_mm: told.filter_mm.map(f64::from), field_mm: told.field_mm.map(f64::from) }),
        };
        let lies = args.tags_lie.iter().filter(|(_, exposure)| *exposure == index + 1);
        lies.for_each(|(lie, _)| lie.befall(&mut tags));
        frames.push(Drawn { path, tags, values: values.into() });
    }
    Ok(frames)
}

#[cfg(test)]
mod tests {
    use super::*;

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
    fn lies_of_tags_are_of_an_exposure() {
        assert_eq!(tag_lie("filter@3"), Ok((TagLie::Filter, 3)));
        for wrong in ["", "filter", "@3", "dose@3", "filter@x", "filter@-1"] {
            assert!(tag_lie(wrong).is_err(), "{wrong}");
        }
    }
}
