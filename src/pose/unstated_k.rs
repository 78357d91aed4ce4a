//! K that nobody has measured: the header's distance over its pitch, and the middle of the picture. A panel's principal point is some pixels off its
//! middle, and a C-arm's distance is not to the millimetre what its header says.

use super::cautions::HEADER_K;
use super::flat::along_worst_px;
use super::nuisance::{MOST_PX, Nuisance, Unmeasured, Word};
use super::request::Registration;
use super::settle::Settled;
use super::solve::{Free, IntrinsicsPrior, Solution};
use crate::geometry::Intrinsics;

/// Standard deviation of the principal point from the picture's middle along each axis, in shares of its longer side: calibrated C-arms have 5 to
/// 20 px of 1024.
const CENTRE: f64 = 0.01;
/// Of the focal length, in shares of it: a distance of 1 m to 5 mm.
const FOCAL: f64 = 0.005;

/// What is taken of a focal length of which nothing is known, …
const WIDE: f64 = 0.5;
/// … and what beads must leave open of it before it is said.
const OPEN: f64 = 0.03;

/// What to do about it; how it is given, `register` and a session say of every K of a header.
pub const MEASURE_K: &str = "calibrate K, and give it (intrinsics)";

/// What K may be instead, and what is said of it, also that it cannot be told; nothing where somebody states K, or the beads solve it.
pub(super) fn heard_of_k(request: &Registration, settled: &Settled) -> (Option<Nuisance>, Option<Word>) {
    if !request.is_k_of_header || settled.options.free != Free::Pose {
        return (None, None);
    }
    // It counts at landmarks alone.
    if request.landmarks.is_empty() {
        return (None, Some(Word::Note(format!("{HEADER_K}; {MEASURE_K}"))));
    }
    let taken = taken_for(request.size_px, settled.solution.intrinsics);
    let k = Nuisance::of(settled, &Unmeasured::K(taken));
    let word = match &k {
        Some(k) => moves(k, request, &settled.solution, &taken, &told_of_focal(request, settled)),
        None => {
            Word::Doubt(format!("{HEADER_K}, and how far another would move places beside the beads cannot be told: {MEASURE_K}"))
        }
    };
    (k, Some(word))
}

/// K of a header, and how well it is known.
fn taken_for(size_px: [u32; 2], mean: Intrinsics) -> IntrinsicsPrior {
    let [columns, rows] = size_px.map(f64::from);
    IntrinsicsPrior { mean, focal_sigma_px: FOCAL * mean.fx, centre_sigma_px: [CENTRE * columns.max(rows); 2] }
}

/// How far the header's focal length may be off before the beads show it, where that is more than anybody would take it to be.
fn told_of_focal(request: &Registration, settled: &Settled) -> String {
    let mean = settled.solution.intrinsics;
    let anything = IntrinsicsPrior { focal_sigma_px: WIDE * mean.fx, ..taken_for(request.size_px, mean) };
    let off = Nuisance::of(settled, &Unmeasured::K(anything)).map_or(WIDE, |k| k.moment_of_first().sqrt() / mean.fx);
    if off < OPEN {
        return String::new();
    }
    let (beads, percent) = (settled.matches.len(), 100.0 * off.min(WIDE));
    format!(
        "these {beads} beads tell the focal length to {percent:.0} % only, so that a header that is wrong by as much shows nowhere; "
    )
}

/// How far it may move the landmarks in the picture.
fn moves(k: &Nuisance, request: &Registration, solution: &Solution, taken: &IntrinsicsPrior, told: &str) -> Word {
    let assumed = format!(
        "a principal point {:.0} px off the middle along each axis and a focal length {:.1} % off (1 σ)",
        taken.centre_sigma_px[0],
        100.0 * FOCAL
    );
    let is_seen = |lps_mm| solution.place(lps_mm).1.is_some_and(|at| !request.is_outside(at));
    let seen = request.landmarks.iter().filter(|landmark| is_seen(landmark.lps_mm));
    let off_px = seen.filter_map(|landmark| Some((along_worst_px(&k.image_px2(solution, landmark.lps_mm)?), &landmark.name)));
    match off_px.max_by(|a, b| a.0.total_cmp(&b.0)) {
        Some((worst_px, name)) if !(worst_px <= MOST_PX) => Word::Doubt(format!(
            "{HEADER_K}: with {assumed} {name} may be off by {worst_px:.1} px, which beads elsewhere do not show; {MEASURE_K}"
        )),
        Some((worst_px, name)) => Word::Note(format!(
            "{HEADER_K}: the stated sigma of landmarks count {assumed}, which move {name} by {worst_px:.1} px against the beads; {told}{MEASURE_K}"
        )),
        None => Word::Note(format!("{HEADER_K}: the stated sigma of landmarks count {assumed}; {told}{MEASURE_K}")),
    }
}

#[cfg(test)]
mod tests {
    use glam::{DMat3, DVec2, DVec3};

    use super::super::solve::{Match, Options, Sharpness, solve};
    use super::*;
    use crate::beads::{BeadLayout, Landmark};
    use crate::geometry::Rigid;
    use crate::random::{Purpose, Stream};

    const SIZE_PX: [u32; 2] = [1024; 2];
    const HEADER: Intrinsics = Intrinsics { fx: 3480.0, fy: 3480.0, skew: 0.0, cx: 511.5, cy: 511.5 };
    const AMONG: DVec3 = DVec3::new(4.0, -6.0, 5.0);
    /// 80 mm and more from every bead, at the picture's edge.
    const BEYOND: DVec3 = DVec3::new(-85.0, 80.0, 120.0);

    /// Ten beads seen by `k` and solved with the header's.
    fn settled(seed: u64, k: &Intrinsics) -> (Settled, Rigid) {
        let mut random = Stream::new(seed, 0, 0, Purpose::Evaluation);
        let pose = Rigid::translation(DVec3::new(24.0, -16.0, 680.0)) * Rigid::exp(DVec3::new(0.1, -0.2, 0.3), DVec3::ZERO);
        let sigma_px = 0.05;
        let matches: Vec<Match> = (0..10)
            .map(|bead| {
                let mut side = |mm: f64| (random.uniform() - 0.5) * mm;
                let lps_mm = DVec3::new(side(70.0), side(70.0), side(50.0));
                let noise = DVec2::new(random.normal(), random.normal()) * sigma_px;
                Match {
                    bead,
                    detection: bead,
                    lps_mm,
                    image_px: k.project(pose.transform_point(lps_mm)) + noise,
                    sigma_px,
                    noise_px2: [sigma_px * sigma_px, 0.0, sigma_px * sigma_px],
                    place_mm2: DMat3::from_diagonal(DVec3::splat(1e-4)),
                }
            })
            .collect();
        let options = Options::least_squares(Free::Pose);
        let solution = solve(&matches, &pose, &HEADER, &options).expect("regular");
        let chi2_per_dof = solution.chi2.iter().sum::<f64>() / 14.0;
        (Settled { solution, matches, left_out: Vec::new(), merged: Vec::new(), chi2_per_dof, options }, pose)
    }

    fn request<'a>(layout: &'a BeadLayout, landmarks: &'a [Landmark]) -> Registration<'a> {
        Registration { is_k_of_header: true, landmarks, ..Registration::new(SIZE_PX, layout) }
    }

    /// Squared standard deviations of a place's error in the picture, and of its place in `camera`: with K taken as known, and with it open.
    fn squares(seed: u64, k: &Intrinsics, lps_mm: DVec3) -> [[f64; 2]; 2] {
        let (settled, pose) = settled(seed, k);
        let layout = BeadLayout::none();
        let landmarks = [Landmark { name: "tip".to_owned(), lps_mm }];
        let open = heard_of_k(&request(&layout, &landmarks), &settled).0.expect("regular");
        let solution = &settled.solution;
        let known = solution.sharpness(lps_mm, &(&solution.covariance * settled.chi2_per_dof.max(1.0)));
        let off = k.project(pose.transform_point(lps_mm)) - solution.place(lps_mm).0;
        let off = nalgebra::Vector2::new(off.x, off.y);
        let off_mm = pose.transform_point(lps_mm) - solution.camera_from_lps.transform_point(lps_mm);
        let off_mm = nalgebra::Vector3::new(off_mm.x, off_mm.y, off_mm.z);
        let squares = |sharpness: Sharpness| {
            let image = sharpness.image_px2.expect("in front");
            let (image, camera) = (image.try_inverse().expect("regular"), sharpness.camera_mm2.try_inverse().expect("regular"));
            [off.dot(&(image * off)), off_mm.dot(&(camera * off_mm))]
        };
        [known, open.with(&known, solution, lps_mm)].map(squares)
    }

    /// A landmark beside the beads was 1.3 px off at 4.4 standard deviations, because a panel's principal point is not in its middle.
    #[test]
    fn regions_hold_places_whatever_k_is_beside_the_header_s() {
        let mut draw = Stream::new(7, 0, 0, Purpose::Evaluation);
        let count = 120;
        let (mut known, mut open, mut in_camera, mut among) = (0, 0, 0, 0);
        for seed in 0..count {
            let taken = taken_for(SIZE_PX, HEADER);
            let focal = HEADER.fx + taken.focal_sigma_px * draw.normal();
            let centre_px = taken.centre_sigma_px.map(|sigma| sigma * draw.normal());
            let k = Intrinsics { fx: focal, fy: focal, cx: HEADER.cx + centre_px[0], cy: HEADER.cy + centre_px[1], ..HEADER };
            let [taken, left_open] = squares(seed, &k, BEYOND);
            known += usize::from(taken[0] <= 5.99);
            open += usize::from(left_open[0] <= 5.99);
            in_camera += usize::from(left_open[1] <= 7.81);
            among += usize::from(squares(seed, &k, AMONG)[1][0] <= 5.99);
        }
        println!(
            "{open} of {count} in their regions, {in_camera} in the camera, {among} among the beads; {known} with K as known"
        );
        let most = 0.9 * count as f64;
        assert!(open as f64 >= most && in_camera as f64 >= most && among as f64 >= most, "{open} {in_camera} {among} of {count}");
        assert!((known as f64) < 0.75 * count as f64, "the control: {known} of {count}");
    }

    #[test]
    fn k_of_a_header_is_a_note_and_a_doubt_only_where_it_moves_a_landmark_by_too_much() {
        let (settled, _) = settled(3, &HEADER);
        let layout = BeadLayout::none();
        let said = |lps_mm: DVec3, is_k_of_header: bool| {
            let landmarks = [Landmark { name: "tip".to_owned(), lps_mm }];
            heard_of_k(&Registration { is_k_of_header, ..request(&layout, &landmarks) }, &settled).1
        };
        let Some(Word::Note(words)) = said(AMONG, true) else { panic!("no note among the beads") };
        for part in [HEADER_K, "10 px off the middle", "0.5 % off", "move tip by", "calibrate K, and give it (intrinsics)"] {
            assert!(words.contains(part), "{part} in {words}");
        }
        // Ten sharp beads that stand deep tell it well enough, four blurred ones do not: a header 55 % off was "0.0 px".
        assert!(!words.contains("tell the focal length"), "{words}");
        let few = self::settled(3, &HEADER).0;
        let rough = |m: &Match| Match { noise_px2: [1.0, 0.0, 1.0], ..*m };
        let few = Settled { matches: few.matches.iter().take(4).map(rough).collect(), ..few };
        let told = told_of_focal(&request(&layout, &[]), &few);
        assert!(told.starts_with("these 4 beads tell the focal length to "), "{told}");
        // Far from the beads, and in the picture still.
        let Some(Word::Doubt(words)) = said(DVec3::new(-40.0, 30.0, -320.0), true) else { panic!("no doubt beyond them") };
        assert!(words.contains("tip may be off by") && words.contains("calibrate K"), "{words}");
        assert_eq!(said(BEYOND, false), None, "somebody states K");
        assert!(matches!(said(DVec3::new(400.0, 0.0, 0.0), true), Some(Word::Note(_))), "not in the picture");
        let solved = Settled { options: Options::least_squares(Free::Square), ..settled };
        let landmarks = [Landmark { name: "tip".to_owned(), lps_mm: AMONG }];
        assert!(heard_of_k(&request(&layout, &landmarks), &solved).0.is_none(), "solved from the beads");
    }
}
