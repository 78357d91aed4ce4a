//! Cross-checks that cost nothing: everything that is known twice is compared, before the session and at each exposure.
//!
//! A session whose files contradict each other still records; what would give a wrong pose in green is refused with the reason and the
//! remedy, what is merely doubtful is a counted warning.

mod alignment;
mod beads;
mod disk;
mod drift;
mod exposure;
mod field;
mod filter;
mod finding;
mod first_view;
mod line;
mod listened;
mod metal;
mod ports;
mod robot;
mod robot_watch;
mod stated_k;
mod units;
mod video;

use glam::DVec3;

pub use alignment::{Alignment, Mistake, Strictness, align, mistakes};
pub(super) use disk::free_bytes;
pub use disk::{check_disk, refuse_among_frames};
pub use drift::DriftWatch;
pub(super) use exposure::TELEMETRY_AND_BEADS;
pub use exposure::{ExposureFacts, PoseDifference, check_exposure, innovation, pose_difference, turned_picture_deg};
pub use finding::{Finding, Level, refusal, tell};
pub use first_view::{choose_view, first_joints};
pub use line::{LineWatch, check_line};
pub use listened::{Listened, check_listened};
pub(super) use metal::bead_spheres;
pub use ports::check_ports;
pub use robot::APART_DEG;
pub(super) use units::scene_kvp;
pub use video::check_video;

use super::file::Setup;
use crate::beads::BeadLayout;
use crate::scene::Scene;

/// What the session's files say of each other. One that fails must keep beads from being registered ([`refusal`]).
#[must_use]
pub fn check_session(setup: &Setup, scene: &Scene, layout: Option<&BeadLayout>) -> Vec<Finding> {
    let mut found = Vec::new();
    found.extend(layout.into_iter().flat_map(|layout| beads::check_beads(setup, scene, layout)));
    found.extend(units::check_cts(scene));
    found.extend(setup.carm.iter().flat_map(units::check_calibration));
    found.extend(check_fuse(setup));
    found.extend(units::check_scene_detector(setup, scene));
    found.extend(stated_k::check_stated_k(setup, scene));
    let centre = layout.map(BeadLayout::centroid_lps_mm).or_else(|| scene.bounds().map(|(centre, _): (DVec3, f64)| centre));
    found.extend(units::check_room(setup, centre));
    found.extend(robot::check_robot(setup, scene));
    found
}

/// What is fused must say how good it is.
fn check_fuse(setup: &Setup) -> Option<Finding> {
    let carm = setup.carm.as_ref().filter(|_| setup.session.carm.as_ref().is_some_and(|line| line.fuse))?;
    carm.camera_sigma_mm.zip(carm.camera_sigma_deg).is_none().then(|| {
        let detail =
            "the session fuses telemetry, and the C-arm's calibration does not say how good it is: poses are the beads' alone";
        let remedy =
            "`sidecarm calibrate carm` states camera_sigma_mm and camera_sigma_deg; or leave \"fuse\" out of the session";
        Finding::warn("fuse", detail, remedy)
    })
}
