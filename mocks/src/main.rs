//! The `mock-lab` program.

mod args;

use std::path::{Path, PathBuf};
use std::process::ExitCode;

use clap::Parser as _;
use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;
use serde_json::json;

use mock_lab::MockError;
use mock_lab::delivery::Way;
use mock_lab::dicom::{BeamTags, Drawn, FrameTags, deliver, encode};
use mock_lab::drawn;
use mock_lab::kinematics::camera_from_lps;
use mock_lab::kit::{Wires, arm, frame_name, true_world_from_lps, write};
use mock_lab::lab::{Device, Lab};
use mock_lab::monitor::{make_pipe, record};
use mock_lab::phantom::Phantom;
use mock_lab::play::{Performance, play, say};
use mock_lab::pty::Line;
use mock_lab::radiograph::{Physics, Shot, take};
use mock_lab::script::Script;
use mock_lab::wire::CarmMessage;

use args::{Args, choose};

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
    let port = |wanted: bool, number: usize, device: Device, terminal: &str| {
        let other = if args.tail.contains(&device) { format!("file:{}.log", device.name()) } else { terminal.to_owned() };
        wanted.then(|| args.udp.get(number).map_or(other, |port| format!("udp://127.0.0.1:{port}")))
    };
    let carm = port(!args.no_carm, 0, Device::Carm, "ttyCARM");
    let robot = port(!args.no_robot, 1, Device::Robot, "ttyROBOT");
    let way = args.way();
    let wires = Wires { ports: [carm.as_deref(), robot.as_deref()], dialects: &args.lines, way: way.clone() };
    write(&args.out, &script, &phantom, &wires, args.drawn.as_deref())?;
    let frames = draw_frames(args, &script, &phantom)?;
    match &way {
        Way::Folder | Way::Dicom(_) => {}
        Way::Monitor(pipe) => make_pipe(pipe)?,
        Way::Recording(file) => record(file, &script, &frames)?,
    }
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
        let line = match (args.udp.get(number), name.strip_prefix("file:")) {
            (Some(port), _) => Line::to_port(*port)?,
            (None, Some(file)) => Line::to_file(&args.out.join(file))?,
            (None, None) => Line::open(&args.out.join(&name))?,
        };
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
        dialects: args.lines.clone(),
        way,
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
            let detail = format!("holds {count} files of an earlier session; choose another --out, or remove this folder");
            Err(MockError::Data { what: folder.display().to_string(), detail })
        }
    }
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
        let path = args.out.join(args.way().folder()).join(frame_name(index));
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
