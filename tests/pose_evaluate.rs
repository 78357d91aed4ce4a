//! Is a wrong pose ever accepted? Shadows of layouts of every kind, with what labs get wrong, drawn by seed: `scripts/evaluate pose`.

use std::collections::BTreeMap;

use glam::{DQuat, DVec2, DVec3};
use rayon::prelude::*;
use sidecarm::beads::{BeadLayout, Detection};
use sidecarm::geometry::{Intrinsics, Rigid, View};
use sidecarm::pose::{IntrinsicsPrior, Pose, Prior, Refusal, Registration, register_shadows};
use sidecarm::random::{Purpose, Stream};

use crate::pose_registration::{clutter, landmark_error_px, shadows, worst_landmark_px};
use crate::pose_synthetic as synthetic;

/// Landmarks off by more are a wrong pose.
pub const WRONG_PX: f64 = 2.0;
/// How well K is stated where it is solved with priors.
const DISTANCE_SIGMA_MM: f64 = 3.0;
const CENTRE_SIGMA_PX: f64 = 5.0;
/// Radii tell a scale that is off by more than a tenth and the few per cent that blur takes from them; those of small shadows one that is off
/// by so many px² over their square more.
const RADIUS_TELLS: f64 = 0.13;
const SMALL_RADIUS_PX2: f64 = 0.3;

pub struct Draw(pub Stream);

impl Draw {
    pub fn between(&mut self, low: f64, high: f64) -> f64 {
        low + (high - low) * self.0.uniform()
    }

    pub fn chance(&mut self, share: f64) -> bool {
        self.0.uniform() < share
    }

    pub fn one_of<T: Copy>(&mut self, list: &[T]) -> T {
        list[(self.0.uniform() * list.len() as f64) as usize % list.len()]
    }

    pub fn sign(&mut self) -> f64 {
        if self.chance(0.5) { 1.0 } else { -1.0 }
    }

    pub fn normal3(&mut self, sigma: f64) -> DVec3 {
        DVec3::new(self.0.normal(), self.0.normal(), self.0.normal()) * sigma
    }
}

#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
enum Beads {
    Scattered,
    HalfTurn,
    MirrorImage,
    Grid,
    ShiftedCopy,
    NearlyFlat,
    Flat,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
enum Mistake {
    None,
    OtherLayout,
    LayoutScaled,
    LayoutMirrored,
    LayoutAxes,
    BeadDisplaced,
    NamesSwapped,
    FrameMirrored,
    FocalLength,
    PrincipalPoint,
    SecondSpecimen,
    Ghost,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
enum Expected {
    Nowhere,
    Near,
    NearWithCovariance,
    Turned,
    Elsewhere,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
enum K {
    Known,
    /// Solved with priors.
    Stated,
    Free,
}

struct Case {
    beads: Beads,
    mistake: Mistake,
    expected: Expected,
    k: K,
    visible: usize,
    pose: Pose,
    /// Mean over places near the middle.
    error_px: f64,
    /// Of the landmarks that is farthest off.
    worst_px: f64,
    /// From here on an error is no noise.
    wrong_px: f64,
    /// The fixed cases are not held to the mistake.
    untold: bool,
    /// Nothing that is given, and nothing that a lab has besides, tells the mistake.
    nothing_tells: bool,
    ms: f64,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Verdict {
    Right,
    Refused,
    GreenWrong,
    AmberWrong,
    NothingTells,
}

impl Case {
    /// Strips and pairs show a pose with a caution in the colour of one without; a doubt has another.
    fn verdict(&self) -> Verdict {
        if !self.pose.is_accepted() {
            Verdict::Refused
        } else if self.worst_px <= WRONG_PX {
            Verdict::Right
        } else if self.pose.doubt.is_some() {
            Verdict::AmberWrong
        } else if self.nothing_tells {
            Verdict::NothingTells
        } else {
            Verdict::GreenWrong
        }
    }

    /// What a lab may ask for: no mistake, six beads that are not flat, K, and a prior near the pose.
    fn is_clear(&self) -> bool {
        let solid = matches!(self.beads, Beads::Scattered) && self.visible >= 6 && self.k == K::Known;
        let near = matches!(self.expected, Expected::Near | Expected::NearWithCovariance);
        self.mistake == Mistake::None && solid && near
    }

    /// Of the fixed cases: by the mean error, beyond noise.
    fn is_off(&self) -> bool {
        self.pose.is_accepted() && !(self.error_px <= self.wrong_px) && !self.untold
    }
}

fn places(kind: Beads, count: usize, draw: &mut Draw) -> Vec<DVec3> {
    let half = DVec3::new(draw.between(30.0, 90.0), draw.between(30.0, 90.0), draw.between(20.0, 70.0));
    let scattered = |count: usize, half: DVec3, draw: &mut Draw| {
        let mut places: Vec<DVec3> = Vec::new();
        for _ in 0..10_000 {
            let place = half * DVec3::new(draw.between(-1.0, 1.0), draw.between(-1.0, 1.0), draw.between(-1.0, 1.0));
            if places.len() < count && places.iter().all(|other| other.distance(place) > 8.0) {
                places.push(place);
            }
        }
        places
    };
    let doubled = |image: &dyn Fn(DVec3) -> DVec3, draw: &mut Draw| {
        let some = scattered(count.div_ceil(2), half, draw);
        some.iter().flat_map(|p| [*p, image(*p)]).collect::<Vec<_>>()
    };
    match kind {
        Beads::Scattered => scattered(count, half, draw),
        Beads::HalfTurn => doubled(&|p| DVec3::new(-p.x, -p.y, p.z), draw),
        Beads::MirrorImage => doubled(&|p| DVec3::new(-p.x, p.y, p.z), draw),
        Beads::ShiftedCopy => {
            let shift = DVec3::new(draw.between(15.0, 40.0), draw.between(-20.0, 20.0), draw.between(-10.0, 10.0));
            doubled(&|p| p + shift, draw)
        }
        Beads::Grid => {
            let step = draw.between(15.0, 30.0);
            let cell = |n: usize| DVec3::new((n % 3) as f64 - 1.0, (n / 3 % 3) as f64 - 1.0, (n / 9) as f64 - 0.5) * step;
            (0..18).map(cell).filter(|_| draw.chance(count as f64 / 18.0)).collect()
        }
        Beads::NearlyFlat => scattered(count, DVec3::new(half.x, half.y, draw.between(2.0, 12.0)), draw),
        Beads::Flat => scattered(count, DVec3::new(half.x, half.y, 1e-6), draw),
    }
}

pub fn turned(view: &View, turn: DQuat, shift_mm: DVec3) -> Rigid {
    let centre = view.camera_from_lps.transform_point(DVec3::ZERO);
    Rigid::translation(centre + shift_mm) * Rigid::rotation(turn) * Rigid::translation(-centre) * view.camera_from_lps
}

/// K as a lab states it, off by what it states.
fn stated_k(k: &Intrinsics, pitch_mm: f64, draw: &mut Draw) -> IntrinsicsPrior {
    let fx = k.fx + DISTANCE_SIGMA_MM / pitch_mm * draw.0.normal();
    let mut about = |centre_px: f64| centre_px + CENTRE_SIGMA_PX * draw.0.normal();
    let mean = Intrinsics { fx, fy: fx, cx: about(k.cx), cy: about(k.cy), ..*k };
    IntrinsicsPrior::from_distance(mean, (fx * pitch_mm, DISTANCE_SIGMA_MM), (pitch_mm, 0.0), CENTRE_SIGMA_PX)
}

/// One of the fixed cases: K is known or free.
fn case(seed: u64) -> Option<Case> {
    drawn(seed, false)
}

/// `with_stated_k`: a third of those whose K is known have it stated with its deviations instead, and are else the same.
fn drawn(seed: u64, with_stated_k: bool) -> Option<Case> {
    let mut draw = Draw(Stream::new(seed, 90, 0, Purpose::Evaluation));
    let side = draw.one_of(&[512, 768, 1024, 1536]);
    let view = synthetic::view(side, side, seed);
    let beads = draw.one_of(&[
        Beads::Scattered,
        Beads::Scattered,
        Beads::HalfTurn,
        Beads::MirrorImage,
        Beads::Grid,
        Beads::ShiftedCopy,
        Beads::NearlyFlat,
        Beads::Flat,
    ]);
    let count = 5 + (draw.0.uniform() * 10.0) as usize;
    let truth = synthetic::layout_of(&places(beads, count, &mut draw), 0.75);
    let mistake = draw.one_of(&[
        Mistake::None,
        Mistake::None,
        Mistake::None,
        Mistake::OtherLayout,
        Mistake::LayoutScaled,
        Mistake::LayoutMirrored,
        Mistake::LayoutAxes,
        Mistake::BeadDisplaced,
        Mistake::NamesSwapped,
        Mistake::FrameMirrored,
        Mistake::FocalLength,
        Mistake::PrincipalPoint,
        Mistake::SecondSpecimen,
        Mistake::Ghost,
    ]);
    let (noise_px, noise_mm) = (draw.between(0.02, 0.2), draw.between(0.02, 0.15));
    let mut found = shadows(&view, &truth, noise_px, noise_mm, seed);
    let seen = draw.one_of(&[1.0, 1.0, 0.85, 0.6]);
    found.retain(|_| draw.chance(seen));
    let visible = found.len();
    let mut copies = 0;
    let radius_px = found.first()?.radius_px;
    let smallest_px = found.iter().map(|shadow| shadow.radius_px).fold(f64::INFINITY, f64::min);
    let false_ones = draw.one_of(&[0, 0, 3, 8, visible]);
    let quality = draw.one_of(&[0.3, 0.8]);
    found.extend(clutter(&view, false_ones, radius_px, seed).into_iter().map(|shadow| Detection { quality, ..shadow }));
    let mut layout = truth.clone();
    let mut k = view.intrinsics;
    let mut scale = 1.0f64;
    let each = |layout: &mut BeadLayout, image: &dyn Fn(DVec3) -> DVec3| {
        layout.beads.iter_mut().for_each(|bead| bead.lps_mm = image(bead.lps_mm));
    };
    match mistake {
        Mistake::None => {}
        Mistake::OtherLayout => layout = synthetic::layout_of(&places(beads, count, &mut draw), 0.75),
        Mistake::LayoutScaled => {
            scale = 1.0 + draw.sign() * draw.between(0.02, 0.2);
            each(&mut layout, &|p| p * scale);
        }
        Mistake::LayoutMirrored => each(&mut layout, &|p| p * DVec3::new(-1.0, 1.0, 1.0)),
        Mistake::LayoutAxes => each(&mut layout, &|p| p * DVec3::new(-1.0, -1.0, 1.0)),
        Mistake::BeadDisplaced => {
            let n = (draw.0.uniform() * layout.beads.len() as f64) as usize;
            layout.beads[n].lps_mm += draw.normal3(1.0).normalize() * draw.between(2.0, 15.0);
        }
        Mistake::NamesSwapped => layout.beads.rotate_left(1),
        Mistake::FrameMirrored => {
            let last = f64::from(side) - 1.0;
            found.iter_mut().for_each(|shadow| shadow.image_px = DVec2::new(last - shadow.image_px.x, shadow.image_px.y));
        }
        Mistake::FocalLength => {
            let factor = 1.0 + draw.sign() * draw.between(0.03, 0.25);
            k = Intrinsics { fx: factor * k.fx, fy: factor * k.fy, ..k };
        }
        Mistake::PrincipalPoint => k = Intrinsics { cx: k.cx + draw.sign() * draw.between(20.0, 200.0), ..k },
        Mistake::SecondSpecimen | Mistake::Ghost => {
            let (angle, shift) = if mistake == Mistake::Ghost { (0.0, 3.0) } else { (draw.between(0.2, 3.0), 30.0) };
            let turn = DQuat::from_axis_angle(draw.normal3(1.0).normalize(), angle);
            let other = View { camera_from_lps: turned(&view, turn, draw.normal3(shift) * DVec3::new(1.0, 1.0, 0.3)), ..view };
            let second = shadows(&other, &truth, noise_px, noise_mm, seed + 1);
            copies = second.len();
            found.extend(second);
            // The others may be seen better.
            if draw.chance(0.5) {
                found.reverse();
            }
        }
    }
    let expected =
        draw.one_of(&[Expected::Nowhere, Expected::Near, Expected::NearWithCovariance, Expected::Turned, Expected::Elsewhere]);
    let off = |draw: &mut Draw, deg: f64, mm: f64| {
        let turn = draw.normal3(deg.to_radians());
        turned(&view, DQuat::from_scaled_axis(turn), draw.normal3(mm))
    };
    let prior = match expected {
        Expected::Nowhere => None,
        Expected::Near => Some((off(&mut draw, 5.0, 15.0), false)),
        Expected::NearWithCovariance => Some((off(&mut draw, 1.0, 3.0), true)),
        Expected::Turned => {
            let turn = DQuat::from_rotation_z(draw.one_of(&[0.5, 1.0, 1.5]) * std::f64::consts::PI);
            Some((turned(&view, turn, DVec3::ZERO), false))
        }
        Expected::Elsewhere => Some((off(&mut draw, 60.0, 60.0), draw.chance(0.3))),
    };
    let prior = prior.map(|(camera_from_lps, stated)| Prior {
        camera_from_lps,
        covariance: stated.then(|| about_beads(&camera_from_lps, 1.0, 3.0)),
    });
    let free = draw.chance(0.25);
    let mut of_k = Draw(Stream::new(seed, 93, 0, Purpose::Evaluation));
    let mode = if free {
        K::Free
    } else if with_stated_k && of_k.chance(1.0 / 3.0) {
        K::Stated
    } else {
        K::Known
    };
    let pitch_mm = 1020.0 / view.intrinsics.fx;
    let intrinsics_prior = (mode == K::Stated).then(|| stated_k(&k, pitch_mm, &mut of_k));
    let request = Registration {
        intrinsics: (mode != K::Free).then_some(intrinsics_prior.map_or(k, |prior| prior.mean)),
        intrinsics_prior,
        pitch_mm: Some(pitch_mm),
        prior: prior.as_ref(),
        ..Registration::new(view.size_px, &layout)
    };
    let watch = sidecarm::time::Stopwatch::start();
    let pose = register_shadows(&request, &found);
    let ms = watch.ms();
    let (error_px, worst_px) =
        if pose.is_accepted() { (landmark_error_px(&pose, &view), worst_landmark_px(&pose, &view, &truth)) } else { (0.0, 0.0) };
    let near = matches!(expected, Expected::Near | Expected::NearWithCovariance);
    let used = pose.beads.iter().filter(|bead| bead.used).count();
    let untold = match mistake {
        // The same picture at another depth, from a camera half a turn away, of a layout that is its own mirror image.
        Mistake::LayoutScaled | Mistake::FocalLength | Mistake::PrincipalPoint => expected != Expected::NearWithCovariance,
        Mistake::LayoutAxes => !near,
        Mistake::FrameMirrored | Mistake::LayoutMirrored => beads == Beads::MirrorImage && !near,
        // The better seen of two is the specimen. That beads are missing only a picture tells.
        Mistake::SecondSpecimen | Mistake::Ghost => copies > visible || 10 * used < 7 * visible,
        _ => false,
    };
    let fewest = if free { 6 } else { 4 };
    // One frame alone: no earlier pose, no innovation, and no header whose SID and pitch K could be held against. What else could tell:
    // a prior with covariance is never left unheeded here, and what it contradicts counts; the shadows' radii as each case says.
    let unheld = prior.as_ref().is_none_or(|prior| prior.covariance.is_none());
    let nothing_tells = unheld
        && match mistake {
            // The same picture from nearer or farther, K and tags being right. Beads of known size are then too large or too small, which tells
            // of a scale only what is beyond the radii's own error.
            Mistake::LayoutScaled => (scale - 1.0).abs() <= RADIUS_TELLS + SMALL_RADIUS_PX2 * (scale / smallest_px).powi(2),
            // The depth changes as f does, and with it no radius; a principal point is made up for by a shift across. SID and pitch are what K
            // says, stated or known. Where K is solved, neither is given and nothing is wrong.
            Mistake::FocalLength | Mistake::PrincipalPoint => mode != K::Free,
            // A rigid turn of the layout: the same shadows of the same radii under the same K, from a camera half a turn away. A prior near the
            // pose tells it, if one is there.
            Mistake::LayoutAxes => !near,
            // The frame shows too few of the specimen for any reading of them, and of the other all that a pose needs: that one is read, with
            // its own right radii and K. A prior near the pose is far from a second specimen, and not from a ghost.
            Mistake::SecondSpecimen => visible < fewest && !near,
            Mistake::Ghost => visible < fewest,
            // A layout that is its own mirror image, or resembles itself, shows that it does, and of two specimens that can both be read the
            // frame shows both: what cannot be told is then to be said.
            _ => false,
        };
    let depth_mm = view.camera_from_lps.transform_point(DVec3::ZERO).z;
    let wrong_px = WRONG_PX.max(6.0 * noise_px.hypot(noise_mm * view.intrinsics.fx / depth_mm));
    Some(Case { beads, mistake, expected, k: mode, visible, pose, error_px, worst_px, wrong_px, untold, nothing_tells, ms })
}

/// Covariance of ξ about the source that is σ of `deg` and `mm` about the beads' middle.
pub fn about_beads(camera_from_lps: &Rigid, deg: f64, mm: f64) -> [[f64; 6]; 6] {
    let c = camera_from_lps.transform_point(DVec3::ZERO);
    let mut local = nalgebra::Matrix6::<f64>::zeros();
    (0..3).for_each(|n| (local[(n, n)], local[(n + 3, n + 3)]) = (deg.to_radians().powi(2), mm * mm));
    let mut shift = nalgebra::Matrix6::<f64>::identity();
    shift.fixed_view_mut::<3, 3>(3, 0).copy_from(&nalgebra::Matrix3::new(0.0, -c.z, c.y, c.z, 0.0, -c.x, -c.y, c.x, 0.0));
    let covariance = shift * local * shift.transpose();
    std::array::from_fn(|i| std::array::from_fn(|j| covariance[(i, j)]))
}

/// What came of some cases; they add up.
#[derive(Clone, Copy, Debug, Default)]
struct Counts {
    cases: usize,
    right: usize,
    refused: usize,
    green_wrong: usize,
    /// Of the green and wrong: with a caution, and off by no more than six times the noise.
    cautioned: usize,
    within_noise: usize,
    amber_wrong: usize,
    nothing_tells: usize,
}

impl Counts {
    fn add(&mut self, case: &Case) {
        self.cases += 1;
        match case.verdict() {
            Verdict::Right => self.right += 1,
            Verdict::Refused => self.refused += 1,
            Verdict::AmberWrong => self.amber_wrong += 1,
            Verdict::NothingTells => self.nothing_tells += 1,
            Verdict::GreenWrong => {
                self.green_wrong += 1;
                self.cautioned += usize::from(!case.pose.cautions.is_empty());
                self.within_noise += usize::from(case.worst_px <= case.wrong_px);
            }
        }
    }
}

/// `count` cases from `first`; gives all their counts, and of those that a lab may ask for the right ones and all.
fn evaluate(first: u64, count: u64) -> (Counts, usize, usize) {
    let cases: Vec<(u64, Case)> =
        (first..first + count).into_par_iter().filter_map(|seed| Some((seed, drawn(seed, true)?))).collect();
    let mut table: BTreeMap<String, Counts> = BTreeMap::new();
    let mut refusals: BTreeMap<String, usize> = BTreeMap::new();
    let mut all = Counts::default();
    let (mut right, mut clear) = (0, 0);
    for (seed, case) in &cases {
        let Case { beads, mistake, expected, k, visible, pose, worst_px, wrong_px, .. } = case;
        all.add(case);
        let classes = [format!("{mistake:?}"), format!("K {k:?}"), format!("beads {beads:?}"), format!("prior {expected:?}")];
        classes.into_iter().for_each(|class| table.entry(class).or_default().add(case));
        let verdict = case.verdict();
        if matches!(verdict, Verdict::GreenWrong | Verdict::AmberWrong) {
            println!(
                "seed {seed}: {verdict:?}, landmarks up to {worst_px:.1} px off (six sigma of noise, or 2 px: {wrong_px:.1}): {beads:?}, {mistake:?}, \
                 prior {expected:?}, K {k:?}, {visible} of {} visible, {} used, rms {:.3} px, {:?}",
                pose.beads.len(),
                pose.beads.iter().filter(|bead| bead.used).count(),
                pose.rms_px.unwrap_or(f64::NAN),
                pose.cautions
            );
        }
        if case.is_clear() {
            clear += 1;
            right += usize::from(pose.is_accepted() && worst_px <= wrong_px);
            if !pose.is_accepted() {
                *refusals.entry(pose.refusal.as_ref().map(Refusal::code).unwrap_or_default()).or_default() += 1;
            }
        }
    }
    for k in [K::Known, K::Stated, K::Free] {
        let mut ms: Vec<(f64, u64)> = cases.iter().filter(|(_, case)| case.k == k).map(|(seed, case)| (case.ms, *seed)).collect();
        ms.sort_by(|a, b| a.0.total_cmp(&b.0));
        let Some((worst, slowest)) = ms.last() else { continue };
        let [median, most] = [ms[ms.len() / 2].0, ms[ms.len() * 99 / 100].0];
        println!("K {k:?}: median {median:.1} ms, 99 % {most:.0} ms, worst {worst:.0} ms (seed {slowest})");
    }
    println!(
        "wrong: off by over 2 px     cases  right  refused  green wrong: all  with a caution  within 6 sigma  amber wrong  nothing tells"
    );
    for (class, counts) in &table {
        let Counts { cases, right, refused, green_wrong, cautioned, within_noise, amber_wrong, nothing_tells } = counts;
        println!(
            "{class:26} {cases:6} {right:6} {refused:8} {green_wrong:17} {cautioned:15} {within_noise:15} {amber_wrong:12} {nothing_tells:14}"
        );
    }
    println!("seeds {first} to {}; no mistake, K and a good prior, but refused: {refusals:?}", first + count - 1);
    let Counts { cases, right: all_right, refused, green_wrong, cautioned, within_noise, amber_wrong, nothing_tells } = all;
    println!(
        "SUM cases {cases} green_wrong {green_wrong} amber_wrong {amber_wrong} refused {refused} right {all_right} nothing_tells {nothing_tells} \
         green_wrong_cautioned {cautioned} green_wrong_within_6_sigma {within_noise} clear {clear} clear_right {right}"
    );
    (all, right, clear)
}

#[test]
fn no_drawn_mistake_gives_a_wrong_pose() {
    let cases: Vec<Case> = (400..460u64).into_par_iter().filter_map(case).collect();
    assert_eq!(cases.iter().filter(|case| case.is_off() && case.pose.cautions.is_empty()).count(), 0);
    let clear: Vec<&Case> = cases.iter().filter(|case| case.is_clear()).collect();
    let right = clear.iter().filter(|case| case.pose.is_accepted() && !case.is_off()).count();
    assert!(!clear.is_empty() && right + 1 >= clear.len(), "{right} of {}", clear.len());
}

/// A layout that half a turn puts onto itself, under a prior that is turned so: the wrong pose fits, and nothing but the prior speaks for it.
#[test]
fn that_only_a_prior_tells_a_layout_from_itself_is_said() {
    let case = case(7_000_713).expect("drawn");
    assert!(case.pose.is_accepted() && case.error_px > 100.0, "{} px off, {:?}", case.error_px, case.pose.reason);
    assert!(case.pose.cautions.iter().any(|caution| caution.contains("rests on the prior alone")), "{:?}", case.pose.cautions);
}

/// A bead that has moved hides that the others' layout is put onto itself by half a turn, with a turned prior and without one; a second specimen
/// stands behind more false shadows than were looked through; a mirrored grid near its prior.
#[test]
fn a_bead_that_moved_and_a_second_specimen_do_not_hide_what_else_fits() {
    for seed in [10_001_565, 10_003_185, 10_003_931, 10_002_511] {
        let case = case(seed).expect("drawn");
        let is_right = case.pose.is_accepted() && case.error_px <= case.wrong_px;
        assert!(!case.pose.is_accepted() || is_right || !case.pose.cautions.is_empty(), "seed {seed}: {} px off", case.error_px);
    }
}

/// Five or six beads, flat or close together: they fit, the pose is right as far as they go, and landmarks are pixels off.
#[test]
fn a_pose_that_few_beads_hold_loosely_says_so() {
    for seed in [10_002_355, 11_000_396, 11_000_532] {
        let case = case(seed).expect("drawn");
        assert!(
            case.pose.is_accepted() && case.error_px > case.wrong_px,
            "seed {seed}: {} px off, {:?}",
            case.error_px,
            case.pose.reason
        );
        assert!(case.pose.cautions.iter().any(|caution| caution.contains("loosely")), "seed {seed}: {:?}", case.pose.cautions);
    }
    // Others are not called so.
    let firm = (400..460).filter_map(case).filter(|case| case.pose.is_accepted());
    let (loose, all) = firm.fold((0, 0), |(loose, all), case| {
        (loose + usize::from(case.pose.cautions.iter().any(|caution| caution.contains("loosely"))), all + 1)
    });
    assert!(all > 10 && 3 * loose < all, "{loose} of {all}");
}

/// Mirrored frames of flat layouts whose mirror image is where the prior says, plates with a negated axis, grids and layouts with a half turn
/// under a prior that is turned, a mirrored grid: a wrong reading fitted, and the right one was not looked for.
#[test]
fn the_reading_that_a_prior_or_a_mirror_hides_is_found() {
    for seed in [500_040, 500_065, 500_144, 500_162, 500_292, 530_065, 530_169, 530_359, 530_914] {
        let case = case(seed).expect("drawn");
        let is_right = case.pose.is_accepted() && case.error_px <= case.wrong_px;
        assert!(!case.pose.is_accepted() || is_right, "seed {seed}: {} px off, {:?}", case.error_px, case.pose.cautions);
    }
}

#[test]
#[ignore = "minutes to hours long: scripts/evaluate pose runs it"]
fn many_registrations() {
    let number = |name: &str, default: u64| std::env::var(name).ok().and_then(|text| text.parse().ok()).unwrap_or(default);
    let (all, right, clear) = evaluate(number("SIDECARM_FIRST_SEED", 0), number("SIDECARM_POSES", 50_000));
    assert!(all.cases > 0 && all.green_wrong == 0, "{} of {} wrong, and nothing doubts them", all.green_wrong, all.cases);
    // A part of a run has few of them.
    assert!(clear - right <= (clear / 1000).max(1), "{right} of {clear}");
}
