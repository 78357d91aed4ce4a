//! Commands: what was typed and what it means. Results go to standard output, everything else to standard error.

use std::process::ExitCode;

use clap::{Parser, Subcommand};

use crate::reporter::{Reporter, to_stderr};

pub mod attach;
pub mod attenuation;
pub mod calibrate;
pub mod calibrate_beads;
pub mod calibrate_carm;
pub mod calibrate_layout;
pub mod calibrate_robot;
pub mod calibrate_robot_error;
mod calibrate_robot_shots;
pub mod calibrate_layout_error;
pub mod calibrate_layout_shots;
pub mod calibrate_intensifier;
mod calibrate_intensifier_args;
mod calibrate_intensifier_beads;
mod calibrate_intensifier_error;
pub mod check;
pub mod compare;
mod compare_error;
mod compare_origin;
mod compare_pictures;
mod compare_table;
#[cfg(feature = "learn")]
pub mod dataset;
#[cfg(feature = "learn")]
mod dataset_error;
#[cfg(feature = "learn")]
mod dataset_materials;
pub mod demo;
pub mod devices;
mod exit;
pub mod following;
pub mod grab;
pub mod hints;
pub mod info;
#[cfg(target_os = "linux")]
pub mod keep_log;
pub mod line_checks;
pub mod live;
pub mod log;
pub mod materials;
mod named;
mod network_targets;
pub mod pose;
mod pose_losses;
mod posed;
mod quiet;
mod read_aloud;
pub mod read_foreign;
pub mod register;
mod register_args;
pub mod register_error;
mod register_explain;
mod register_seen;
pub mod register_together;
pub mod render;
pub mod replay;
pub mod scatter;
mod scattered;
mod session_ask;
mod session_device;
mod session_further;
pub mod session_new;
mod shot_files;
mod signals;
pub mod spectrum;
pub mod tags;
pub mod time;
pub mod time_changes;
pub mod trade;
#[cfg(feature = "learn")]
pub mod train;
#[cfg(feature = "viewer")]
mod windowed;

/// Rides beside a mobile C-arm and a snake robot: finds beads in each radiograph, recovers its pose, renders the matched DeepDRR,
/// compares, records and replays. For research; not a medical device.
#[derive(Debug, Parser)]
#[command(name = "sidecarm", version, after_help = EXAMPLES)]
struct Cli {
    #[command(subcommand)]
    command: Command,
}

const EXAMPLES: &str = "Examples:
  sidecarm demo --headless
  sidecarm register frame.dcm --beads beads.mrk.json --intrinsics k.json --out pose.json
  sidecarm render scene.json --pose pose.json --out drr.tif --explain

Exit codes: 0 good, 1 failed or refused, 2 usage, 3 finished with loss (said which), 128 + N ended by
signal N (nothing half-written is left).";

#[derive(Debug, Subcommand)]
enum Command {
    Demo(demo::DemoArgs),
    Live(live::LiveArgs),
    Session(session_new::SessionArgs),
    Check(check::CheckArgs),
    Replay(replay::ReplayArgs),
    Render(render::RenderArgs),
    Trade(trade::TradeArgs),
    Scatter(scatter::ScatterArgs),
    #[cfg(feature = "learn")]
    Dataset(dataset::DatasetArgs),
    #[cfg(feature = "learn")]
    Train(train::TrainArgs),
    Time(time::TimeArgs),
    Register(register::RegisterArgs),
    Pose(pose::PoseArgs),
    Tags(tags::TagsArgs),
    Compare(compare::CompareArgs),
    Calibrate(calibrate::CalibrateArgs),
    Attach(attach::AttachArgs),
    Grab(grab::GrabArgs),
    Log(log::LogArgs),
    Attenuation(attenuation::AttenuationArgs),
    Spectrum(spectrum::SpectrumArgs),
    Materials(materials::MaterialsArgs),
    Devices(devices::DevicesArgs),
    Info(info::InfoArgs),
    ReadForeign(read_foreign::ReadForeignArgs),
    #[cfg(target_os = "linux")]
    KeepLog(keep_log::KeepLogArgs),
}

/// Runs the program.
#[must_use]
pub fn main() -> ExitCode {
    // A fault of this program is one sentence for whoever uses it; where it happened is for whoever mends it.
    std::panic::set_hook(Box::new(|panic| {
        if let Some(why) = unprintable(panic.payload()) {
            // Whoever reads only the first lines closes the pipe: that is no fault.
            if !why.contains("Broken pipe") {
                to_stderr(&format!("sidecarm: standard output cannot be written{why}"));
            }
            std::process::exit(1);
        }
        let place = panic.location().map(|place| format!(" ({}:{})", place.file(), place.line())).unwrap_or_default();
        to_stderr(&format!("sidecarm: a fault of this program{place}; please report it with what you did"));
    }));
    let cli = Cli::parse();
    if lists_devices(&cli.command) {
        quiet::begin_without_device_layer();
    }
    crate::foreign::install(crate::foreign::ForeignReader::this_program());
    let reporter = Reporter::stderr();
    if !hears_signals(&cli.command) {
        signals::end_on_signals(&reporter);
    }
    ExitCode::from(dispatch(&cli.command, &reporter))
}

/// Whether a command opens a GPU.
fn lists_devices(command: &Command) -> bool {
    match command {
        Command::Demo(_)
        | Command::Live(_)
        | Command::Replay(_)
        | Command::Render(_)
        | Command::Time(_)
        | Command::Trade(_)
        | Command::Scatter(_)
        | Command::Compare(_)
        | Command::Check(_)
        | Command::Devices(_) => true,
        #[cfg(feature = "learn")]
        Command::Train(_) | Command::Dataset(_) => true,
        _ => false,
    }
}

/// Whether a command ends in its own way at a signal, or with the process that started it.
fn hears_signals(command: &Command) -> bool {
    match command {
        Command::Demo(_) | Command::Live(_) | Command::Check(_) | Command::ReadForeign(_) => true,
        Command::Devices(args) => args.check.is_some(),
        #[cfg(target_os = "linux")]
        Command::KeepLog(_) => true,
        _ => false,
    }
}

/// Why standard output could not be written, where a panic is of that.
fn unprintable(payload: &dyn std::any::Any) -> Option<&str> {
    payload.downcast_ref::<String>()?.strip_prefix("failed printing to stdout")
}

fn dispatch(command: &Command, reporter: &Reporter) -> u8 {
    match command {
        Command::Demo(args) => end(demo::run(args, reporter), reporter),
        Command::Live(args) => end(live::run(args, reporter), reporter),
        Command::Replay(args) => end(replay::run(args, reporter), reporter),
        Command::Render(args) => end(render::run(args, reporter), reporter),
        Command::Time(args) => end(time::run(args, reporter), reporter),
        Command::Trade(args) => end(trade::run(args, reporter), reporter),
        Command::Scatter(args) => end(scatter::run(args, reporter), reporter),
        #[cfg(feature = "learn")]
        Command::Train(args) => end(train::run(args, reporter), reporter),
        #[cfg(feature = "learn")]
        Command::Dataset(args) => end(dataset::run(args, reporter), reporter),
        Command::Compare(args) => end(compare::run(args, reporter), reporter),
        Command::Calibrate(args) => end(calibrate::run(args, reporter), reporter),
        Command::Register(args) => end(register::run(args, reporter), reporter),
        Command::Pose(args) => end(pose::run(args, reporter), reporter),
        Command::Tags(args) => end(tags::run(args, reporter), reporter),
        Command::Attach(args) => end(attach::run(args, reporter), reporter),
        Command::Grab(args) => end(grab::run(args, reporter), reporter),
        Command::Log(args) => end(log::run(args, reporter), reporter),
        Command::Attenuation(args) => end(attenuation::run(args, &mut std::io::stdout().lock()).map(|()| 0), reporter),
        Command::Spectrum(args) => end(spectrum::run(args, &mut std::io::stdout().lock()).map(|()| 0), reporter),
        Command::Materials(args) => end(materials::run(args, &mut std::io::stdout().lock()).map(|()| 0), reporter),
        Command::Session(args) => end(session_new::run(args, reporter), reporter),
        Command::Check(args) => check::run(args, reporter),
        Command::Devices(args) => match &args.check {
            Some(session) => {
                let args = check::CheckArgs { session: session.clone(), out: None, limit: check::LIMIT_S, json: args.json };
                check::run(&args, reporter)
            }
            None => devices::list(args.json, reporter),
        },
        Command::Info(args) => end(info::run(args, reporter), reporter),
        Command::ReadForeign(args) => end(read_foreign::run(args), reporter),
        #[cfg(target_os = "linux")]
        Command::KeepLog(args) => keep_log::run(args),
    }
}

/// One sentence and, where there is one, a hint; the exit code.
fn end<E: std::error::Error + 'static>(outcome: Result<u8, E>, reporter: &Reporter) -> u8 {
    match outcome {
        Ok(code) => code,
        Err(error) => {
            reporter.note(format!("sidecarm: {error}"));
            if let Some(hint) = hints::hint(&error) {
                reporter.note(format!("hint: {hint}"));
            }
            1
        }
    }
}
