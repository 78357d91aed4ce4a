//! `sidecarm log csv`.

use std::path::PathBuf;

use super::outcome::say;
use crate::reporter::Reporter;
use crate::session::logbook::{LogbookError, write_tables};

/// Put a log into tables: exposures, C-arm, robot, poses, beads and scores.
#[derive(Clone, Debug, clap::Args)]
#[command(after_help = "Example:\n  sidecarm log csv run-1/session.mcap --out tables\n\n\
    DIR gets exposures.csv (one row an exposure, with the frames bound to it), carm.csv and robot.csv (one row a packet, decoded anew), \
    poses.csv (one row a frame: P and camera_from_lps row by row, K, the C-arm's joints), beads.csv (one row a bead of each frame) and \
    scores.csv (one row a frame). Headers carry units; host times are microseconds since 1970 \
    (UTC), `arrival_us` that of the bytes, `host_us` that of the measurement by the device's clock. A null margin is the score at the pose \
    minus the best at any wrong one, signed so that positive is good. What was not measured is empty. Files are not written over.")]
pub struct CsvArgs {
    /// The log.
    pub log: PathBuf,
    /// Folder for the tables.
    #[arg(long, value_name = "DIR")]
    pub out: PathBuf,
    /// Print JSON.
    #[arg(long)]
    pub json: bool,
}

/// Writes the tables and says how long they are.
///
/// # Errors
/// When the log cannot be read or a table cannot be written.
pub fn run(args: &CsvArgs, reporter: &Reporter) -> Result<u8, LogbookError> {
    let report = write_tables(&args.log, &args.out, reporter)?;
    if args.json {
        let tables: Vec<_> = report.rows.iter().map(|(path, rows)| serde_json::json!({"path": path, "rows": rows})).collect();
        println!("{:#}", serde_json::json!({"tables": tables, "losses": report.losses}));
    } else {
        report.rows.iter().for_each(|(path, rows)| println!("{}: {rows} rows", path.display()));
    }
    Ok(say(&report.losses, reporter))
}
