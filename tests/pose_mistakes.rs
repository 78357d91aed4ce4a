//! Registrations as labs get them wrong, drawn by seed: layouts of every kind, mistakes, priors, K.

use glam::{DQuat, DVec2, DVec3};
use sidecarm::beads::{BeadLayout, Detection};
use sidecarm::geometry::{Intrinsics, Rigid, View};
use sidecarm::pose::{IntrinsicsPrior, Pose, Prior, Registration, register_shadows};
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
pub const RADIUS_TELLS: f64 = 0.13;
pub const SMALL_RADIUS_PX2: f64 = 0.3;

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
pub enum Beads {
    Scattered,
    HalfTurn,
    MirrorImage,
    Grid,
    ShiftedCopy,
    NearlyFlat,
    Flat,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum Mistake {
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
pub enum Expected {
    Nowhere,
    Near,
    NearWithCovariance,
    Turned,
    Elsewhere,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum K {
    Known,
    /// Solved with priors.
    Stated,
    Free,
}

pub struct Case {
    pub beads: Beads,
    pub mistake: Mistake,
    pub expected: Expected,
    pub k: K,
    pub visible: usize,
    pub pose: Pose,
    /// Mean over places near the middle.
    pub error_px: f64,
    /// Of the landmarks that is farthest off.
    pub worst_px: f64,
    /// From here on an error is no noise.
    pub wrong_px: f64,
    /// The fixed cases are not held to the mistake.
    pub untold: bool,
    /// Nothing that is given, and nothing that a lab has besides, tells the mistake.
    pub nothing_tells: bool,
    pub ms: f64,
}

/// Up to `count` places within a box of so half sides, no two nearer than 8 mm.
pub fn scattered(count: usize, half: DVec3, draw: &mut Draw) -> Vec<DVec3> {
    let mut places: Vec<DVec3> = Vec::new();
    for _ in 0..10_000 {
        let place = half * DVec3::new(draw.between(-1.0, 1.0), draw.between(-1.0, 1.0), draw.between(-1.0, 1.0));
        if places.len() < count && places.iter().all(|other| other.distance(place) > 8.0) {
            places.push(place);
        }
    }
    places
}

/// Half as many scattered places, each with its image.
pub fn doubled(count: usize, half: DVec3, image: &dyn Fn(DVec3) -> DVec3, draw: &mut Draw) -> Vec<DVec3> {
    let some = scattered(count.div_ceil(2), half, draw);
    some.iter().flat_map(|place| [*place, image(*place)]).collect()
}

fn places(kind: Beads, count: usize, draw: &mut Draw) -> Vec<DVec3> {
    let half = DVec3::new(draw.between(30.0, 90.0), draw.between(30.0, 90.0), draw.between(20.0, 70.0));
    match kind {
        Beads::Scattered => scattered(count, half, draw),
        Beads::HalfTurn => doubled(count, half, &|p| DVec3::new(-p.x, -p.y, p.z), draw),
        Beads::MirrorImage => doubled(count, half, &|p| DVec3::new(-p.x, p.y, p.z), draw),
        Beads::ShiftedCopy => {
            let shift = DVec3::new(draw.between(15.0, 40.0), draw.between(-20.0, 20.0), draw.between(-10.0, 10.0));
            doubled(count, half, &|p| p + shift, draw)
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
pub fn stated_k(k: &Intrinsics, pitch_mm: f64, draw: &mut Draw) -> IntrinsicsPrior {
    let fx = k.fx + DISTANCE_SIGMA_MM / pitch_mm * draw.0.normal();
    let mut about = |centre_px: f64| centre_px + CENTRE_SIGMA_PX * draw.0.normal();
    let mean = Intrinsics { fx, fy: fx, cx: about(k.cx), cy: about(k.cy), ..*k };
    IntrinsicsPrior::from_distance(mean, (fx * pitch_mm, DISTANCE_SIGMA_MM), (pitch_mm, 0.0), CENTRE_SIGMA_PX)
}

/// One of the fixed cases: K is known or free.
pub fn case(seed: u64) -> Option<Case> {
    drawn(seed, false)
}

/// `with_stated_k`: a third of those whose K is known have it stated with its deviations instead, and are else the same.
pub fn drawn(seed: u64, with_stated_k: bool) -> Option<Case> {
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
