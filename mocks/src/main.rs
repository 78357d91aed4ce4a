//! The `mock-lab` program.

use std::path::PathBuf;
use std::process::ExitCode;

use clap::Parser;
use serde_json::json;

use mock_lab::dicom::{FrameTags, encode};
use mock_lab::kinematics::camera_from_lps;
use mock_lab::kit::{arm, frame_name, true_world_from_lps, write};
use mock_lab::lab::Lab;
use mock_lab::phantom::Phantom;
use mock_lab::play::{Performance, play, say};
use mock_lab::pty::Line;
use mock_lab::radiograph::{Physics, Shot, take};
use mock_lab::{MockError, lab};

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
    /// Seconds between `ready` and the first packet.
    #[arg(long, default_value_t = 1.0)]
    start_delay_s: f64,
    /// Exposures, at most all of the script's.
    #[arg(long, default_value_t = usize::MAX, hide_default_value = true)]
    exposures: usize,
    /// Play without faults.
    #[arg(long)]
    no_faults: bool,
    /// No exposure counter on the wire and in the frames.
    #[arg(long)]
    no_counter: bool,
    /// No C-arm line.
    #[arg(long)]
    no_carm: bool,
    /// No robot line.
    #[arg(long)]
    no_robot: bool,
    /// Only write the kit and the frames; no ports, no real time.
    #[arg(long)]
    kit_only: bool,
}

fn main() -> ExitCode {
    match run(&Args::parse()) {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            eprintln!("mock-lab: {error}");
            ExitCode::FAILURE
        }
    }
}

fn run(args: &Args) -> Result<(), MockError> {
    if !(args.duration_s >= 5.0 && args.duration_s <= 86_400.0) {
        let detail = format!("{} s, expected 5 to 86400", args.duration_s);
        return Err(MockError::Data { what: "--duration-s".to_owned(), detail });
    }
    let lab = Lab::embedded()?;
    let phantom = Phantom::embedded()?;
    write(&args.out, &lab, &phantom, !args.no_carm, !args.no_robot)?;
    let frames = take_frames(args, &lab, &phantom)?;
    let session = args.out.join("session.json");
    if args.kit_only {
        for (path, bytes) in &frames {
            mock_lab::dicom::deliver(path, bytes)?;
        }
        say(&json!({"event": "finished", "session": session, "frames": frames.len()}));
        return Ok(());
    }
    let open = |wanted: bool, name: &str| wanted.then(|| Line::open(&args.out.join(name))).transpose();
    let carm = open(!args.no_carm, "ttyCARM")?;
    let robot = open(!args.no_robot, "ttyROBOT")?;
    say(&json!({
        "event": "ready", "session": session, "carm_port": carm.as_ref().map(Line::path),
        "robot_port": robot.as_ref().map(Line::path), "exposures": frames.len()
    }));
    let performance = Performance {
        duration_s: args.duration_s,
        start_delay_s: args.start_delay_s,
        faults: !args.no_faults,
        counter: !args.no_counter,
        exposures: frames.len(),
        seed: args.seed,
    };
    play(&lab, &performance, carm, robot, &frames)
}

/// Draws every frame of the session beforehand.
fn take_frames(args: &Args, lab: &Lab, phantom: &Phantom) -> Result<Vec<(PathBuf, Vec<u8>)>, MockError> {
    let arm = arm(lab)?;
    let physics = Physics::embedded()?;
    let world_from_lps = true_world_from_lps(lab);
    let mut frames = Vec::new();
    for (index, exposure) in lab.exposures.iter().take(args.exposures).enumerate() {
        let exposure: &lab::Exposure = exposure;
        let shot = Shot {
            size_px: arm.size_px,
            geometry: arm.geometry,
            source_to_detector_mm: arm.source_to_detector_mm,
            pitch_mm: arm.pitch_mm,
            camera_from_lps: camera_from_lps(&arm.geometry, &exposure.joints(), &world_from_lps),
            field_mm: exposure.field_mm,
            photons_per_pixel: lab.photons_per_pixel,
            readout_sigma: lab.readout_sigma,
            noise: true,
            seed: args.seed.wrapping_add(index as u64 * 7919),
        };
        let mut bodies = phantom.tissue();
        bodies.extend(phantom.metal(&exposure.control_deg));
        let image = take(&shot, &bodies, &physics);
        let values: Vec<u16> = image.iter().map(|v| (v * lab.air_value).round().clamp(0.0, 65_535.0) as u16).collect();
        let tags = FrameTags {
            size_px: arm.size_px,
            pitch_mm: arm.pitch_mm,
            source_to_detector_mm: arm.source_to_detector_mm,
            tube_kvp: lab.tube_kvp,
            exposure_counter: (!args.no_counter).then_some(index as u32 + 1),
            instance: index as u32 + 1,
        };
        frames.push((args.out.join("frames").join(frame_name(index)), encode(&tags, &values)?));
        eprint!("\rdrawing frame {} of {}", index + 1, lab.exposures.len().min(args.exposures));
    }
    eprintln!();
    Ok(frames)
}
