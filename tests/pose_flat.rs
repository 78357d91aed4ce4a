//! Beads nearly in a plane, drawn by seed: is every pose that they hold loosely off it flagged? Against the closed form of
//! [`crate::pose_limits`]: `scripts/evaluate flat`.

use glam::DVec3;
use nalgebra::Matrix3;
use rayon::prelude::*;
use sidecarm::beads::BeadLayout;
use sidecarm::geometry::{Rigid, View};
use sidecarm::pose::{Pose, Prior, Refusal, Registration, register_shadows};
use sidecarm::random::{Purpose, Stream};

use crate::pose_limits::{NOISE_PX, known_to, tilted_view, worst_px};
use crate::pose_mistakes::{Draw, about_beads};
use crate::pose_registration::{matching, shadows};
use crate::pose_synthetic as synthetic;

/// Standard deviation off the plane above which no pose may go without a flag, and below which hardly one may have it.
const LOOSE_PX: f64 = 2.0;
const FIRM_PX: f64 = 1.0;
/// Share of firm poses that may be flagged.
const MOST_FALSE: f64 = 0.05;

struct Run {
    seed: u64,
    pose: Pose,
    /// By the closed form, of the beads on which the pose rests; 0 where it is refused.
    sigma_px: f64,
    thickness_mm: f64,
}

/// The places one layout radius off the plane of the beads, above each and above their middle, on both sides.
fn off_plane(layout: &BeadLayout) -> Vec<DVec3> {
    let middle = layout.centroid_lps_mm();
    let arms: Vec<DVec3> = layout.beads.iter().map(|bead| bead.lps_mm - middle).collect();
    let scatter = arms.iter().fold(Matrix3::<f64>::zeros(), |sum, arm| {
        let arm = nalgebra::Vector3::new(arm.x, arm.y, arm.z);
        sum + arm * arm.transpose()
    });
    let eigen = scatter.symmetric_eigen();
    let normal = eigen.eigenvectors.column(eigen.eigenvalues.imin());
    let normal = DVec3::new(normal[0], normal[1], normal[2]);
    let radius_mm = arms.iter().map(|arm| arm.length()).fold(0.0, f64::max);
    let feet = layout.beads.iter().map(|bead| bead.lps_mm).chain([middle]);
    feet.flat_map(|foot| [1.0, -1.0].map(|side| foot + normal * (side * radius_mm))).collect()
}

/// Four to ten beads in a slab, whose places are off by what is stated of them.
fn cloud(draw: &mut Draw) -> (BeadLayout, f64) {
    let half = DVec3::new(draw.between(20.0, 60.0), draw.between(20.0, 60.0), 0.5 * draw.between(0.0, 16.0));
    let count = draw.between(4.0, 11.0) as usize;
    let mut places: Vec<DVec3> = Vec::new();
    for _ in 0..10_000 {
        let place = half * DVec3::new(draw.between(-1.0, 1.0), draw.between(-1.0, 1.0), draw.between(-1.0, 1.0));
        if places.len() < count && places.iter().all(|other| other.distance(place) > 8.0) {
            places.push(place);
        }
    }
    (synthetic::layout_of(&places, 0.75), 2.0 * half.z)
}

fn run(seed: u64) -> Run {
    let mut draw = Draw(Stream::new(seed, 96, 0, Purpose::Evaluation));
    let (plain, thickness_mm) = cloud(&mut draw);
    let view = tilted_view(draw.between(-55.0, 55.0));
    let roll = Rigid::exp(DVec3::Z * draw.between(-3.0, 3.0), DVec3::ZERO);
    let view = View { camera_from_lps: view.camera_from_lps * roll, ..view };
    let sigma_mm = draw.between(0.02f64.ln(), 0.6f64.ln()).exp();
    let layout = known_to(plain, sigma_mm);
    let found = shadows(&view, &layout, NOISE_PX, sigma_mm, seed);
    // From the beads alone nobody can tell a plate from its mirror image.
    let prior = Prior { camera_from_lps: view.camera_from_lps, covariance: Some(about_beads(&view.camera_from_lps, 3.0, 10.0)) };
    let pose = register_shadows(&Registration { prior: Some(&prior), ..matching(&view, &layout) }, &found);
    let is_used = |name: &str| pose.beads.iter().any(|bead| bead.used && bead.name == name);
    let beads = layout.beads.iter().filter(|bead| is_used(&bead.name)).cloned().collect();
    let used = BeadLayout { beads, ..layout.clone() };
    let sigma_px = if pose.is_accepted() { worst_px(&view, &used, sigma_mm, &off_plane(&used)) } else { 0.0 };
    Run { seed, pose, sigma_px, thickness_mm }
}

impl Run {
    /// By a note, a caution or a doubt that names it.
    fn is_flagged(&self) -> bool {
        self.pose.notes.iter().chain(&self.pose.cautions).any(|words| words.contains("off their plane"))
    }
}

/// Poses that are loose, those of them without a flag, those that are firm, those of them with one.
fn evaluate(first: u64, count: u64) -> [usize; 4] {
    let runs: Vec<Run> = (first..first + count).into_par_iter().map(run).collect();
    let accepted = || runs.iter().filter(|run| run.pose.is_accepted());
    let loose: Vec<&Run> = accepted().filter(|run| run.sigma_px > LOOSE_PX).collect();
    let firm: Vec<&Run> = accepted().filter(|run| run.sigma_px < FIRM_PX).collect();
    let missed: Vec<&&Run> = loose.iter().filter(|run| !run.is_flagged()).collect();
    for Run { seed, pose, sigma_px, thickness_mm } in &missed {
        println!(
            "seed {seed}: no flag, {sigma_px:.2} px off the plane, {} beads, {thickness_mm:.1} mm thick: {:?} {:?}",
            pose.beads.iter().filter(|bead| bead.used).count(),
            pose.notes,
            pose.cautions
        );
    }
    let falsely = firm.iter().filter(|run| run.is_flagged()).count();
    let between = accepted().count() - loose.len() - firm.len();
    let mut refusals = std::collections::BTreeMap::<String, usize>::new();
    for run in runs.iter().filter(|run| !run.pose.is_accepted()) {
        *refusals.entry(run.pose.refusal.as_ref().map(Refusal::code).unwrap_or_default()).or_default() += 1;
    }
    println!("refused: {refusals:?}");
    println!(
        "SUM clouds {} loose {} loose_without_flag {} between {between} firm {} firm_with_flag {falsely} refused {}",
        runs.len(),
        loose.len(),
        missed.len(),
        firm.len(),
        refusals.values().sum::<usize>()
    );
    [loose.len(), missed.len(), firm.len(), falsely]
}

#[test]
fn no_nearly_flat_cloud_is_loose_without_a_flag() {
    let [loose, missed, firm, falsely] = evaluate(0, 60);
    assert!(loose >= 3 && missed == 0, "{missed} of {loose} loose ones without a flag");
    assert!(firm >= 3 && 4 * falsely <= firm, "the control: {falsely} of {firm} firm ones with one");
}

#[test]
#[ignore = "minutes long: scripts/evaluate flat runs it"]
fn many_flat_clouds() {
    let number = |name: &str, default: u64| std::env::var(name).ok().and_then(|text| text.parse().ok()).unwrap_or(default);
    let [loose, missed, firm, falsely] = evaluate(number("SIDECARM_FIRST_SEED", 0), number("SIDECARM_CLOUDS", 5000));
    assert!(loose > 0 && missed == 0, "{missed} of {loose} loose ones without a flag");
    assert!(firm > 0 && falsely as f64 <= MOST_FALSE * firm as f64, "{falsely} of {firm} firm ones with one");
}
