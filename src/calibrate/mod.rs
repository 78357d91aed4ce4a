//! Calibrations measured from frames and logs; each becomes a file of `calibration/` with its unit in every key and its origin.

mod logged_poses;

pub mod beads;
pub mod carm;
pub mod detector;
pub mod layout;
pub mod intensifier;
pub mod robot;
pub mod phantom;
