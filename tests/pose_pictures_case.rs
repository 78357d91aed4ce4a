//! Pictures of beads with what labs get wrong about them, drawn by seed and registered as `register` and `live` do it.

use std::f64::consts::{PI, TAU};

use glam::{DQuat, DVec2, DVec3};
use sidecarm::beads::{Bead, BeadLayout, Landmark};
use sidecarm::geometry::{Intrinsics, Projection, Rigid, View};
use sidecarm::pose::{Pose, Prior, Registration, register};
use sidecarm::random::{Purpose, Stream};

use crate::pose_mistakes::{
    Draw, K, RADIUS_TELLS, SMALL_RADIUS_PX2, WRONG_PX, about_beads, doubled, scattered, stated_k, turned,
};
use crate::pose_pictures_draw::{Ball, Console, Looks, Sight, take};
use crate::pose_synthetic as synthetic;

/// What a stated prior states.
const STATED: (f64, f64) = (1.0, 3.0);
/// Landmarks within the beads' box, and how far beside a thin one there are others.
const WITHIN: usize = 9;
const BESIDE_MM: f64 = 15.0;
/// Beside the box a landmark may be off by so much of what the pose states of it.
const STATED_SIGMAS: f64 = 6.0;

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Layout {
    Scattered,
    Flat,
    NearlyFlat,
    NearLine,
    HalfTurn,
    MirrorImage,
    ShiftedCopy,
    Grid,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Mistake {
    None,
    OtherLayout,
    LayoutScaled,
    FrameMirrored,
    FrameQuarterTurned,
    FrameHalfTurned,
    FocalLength,
    PrincipalPoint,
    /// All beads a second time, elsewhere.
    Copy,
    /// All beads a second time, 10 to 40 px away.
    Ghost,
}

/// Where the pose is expected.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Expected {
    Nowhere,
    Right,
    RightStated,
    /// 10° and 30 mm away.
    Off,
    /// By a quarter or half a turn in the picture; about the axis of a layout that half a turn puts onto itself.
    Turned,
    OtherSpecimen,
}

/// What a picture is made of.
#[derive(Clone, Copy, Debug)]
pub struct Recipe {
    pub seed: u64,
    pub layout: Layout,
    pub mistake: Mistake,
    pub expected: Expected,
    pub k: K,
    /// Of the layout.
    pub beads: usize,
    /// Of them that have not come off; a copy and a ghost have all.
    pub left: usize,
    /// As many spheres that are no beads, of about their size.
    pub has_false: bool,
    pub looks: Looks,
}

impl Recipe {
    /// A good picture of twelve beads, no mistake, and a prior near the pose.
    pub fn plain(seed: u64) -> Self {
        let (layout, mistake, expected, k) = (Layout::Scattered, Mistake::None, Expected::Right, K::Known);
        Self { seed, layout, mistake, expected, k, beads: 12, left: 12, has_false: false, looks: Looks::PLAIN }
    }

    /// The recipe of `seed`.
    pub fn drawn(seed: u64) -> Self {
        use self::{Expected as E, Layout as L, Mistake as M};
        let mut draw = Draw(Stream::new(seed, 98, 0, Purpose::Evaluation));
        let (some, other) =
            ([L::Scattered, L::Flat, L::NearlyFlat, L::NearLine], [L::HalfTurn, L::MirrorImage, L::ShiftedCopy, L::Grid]);
        let layout = match draw.one_of(&[0, 1, 2]) {
            0 => L::Scattered,
            1 => draw.one_of(&some),
            _ => draw.one_of(&other),
        };
        let mistaken = [
            M::OtherLayout,
            M::LayoutScaled,
            M::FrameMirrored,
            M::FrameQuarterTurned,
            M::FrameHalfTurned,
            M::FocalLength,
            M::PrincipalPoint,
            M::Copy,
            M::Ghost,
        ];
        let mistake = if draw.chance(0.35) { M::None } else { draw.one_of(&mistaken) };
        let expected = draw.one_of(&[E::Nowhere, E::Right, E::RightStated, E::Off, E::Turned, E::OtherSpecimen]);
        let k = draw.one_of(&[K::Known, K::Known, K::Known, K::Known, K::Known, K::Known, K::Stated, K::Free]);
        let beads = draw.between(5.0, 15.0) as usize;
        let left = match mistake {
            M::Copy | M::Ghost => draw.between(4.0, 10.0),
            _ => beads as f64 * draw.one_of(&[1.0, 1.0, 0.85, 0.6]),
        };
        let (left, has_false) = ((left as usize).min(beads), draw.chance(0.4));
        Self { seed, layout, mistake, expected, k, beads, left, has_false, looks: Looks::drawn(&mut draw) }
    }
}

/// A picture, and what came of it.
pub struct Case {
    pub recipe: Recipe,
    /// Beads of the specimen in the open field, and those of them that any method should find.
    pub visible: usize,
    pub clear: usize,
    pub pose: Pose,
    /// P of the picture as it was stored.
    pub truth: Projection,
    pub landmarks: Vec<Landmark>,
    /// Of the landmark that is farthest off; 0 where the pose is refused.
    pub worst_px: f64,
    /// Nothing that is given, and nothing that a lab has besides, tells the mistake.
    pub nothing_tells: bool,
    pub ms: f64,
}

impl Case {
    /// What a lab may ask for: no mistake, a layout like no other, K, a prior that is not far off, and six beads that can be seen.
    pub fn is_clear(&self) -> bool {
        let Recipe { layout, mistake, expected, k, .. } = self.recipe;
        let usable = matches!(expected, Expected::Right | Expected::RightStated | Expected::Off);
        mistake == Mistake::None && layout == Layout::Scattered && k == K::Known && usable && self.clear >= 6
    }

    /// Whether the pose puts a landmark elsewhere.
    pub fn is_wrong(&self) -> bool {
        !(self.worst_px <= WRONG_PX)
    }
}

fn places(layout: Layout, count: usize, draw: &mut Draw) -> Vec<DVec3> {
    let half = DVec3::new(draw.between(30.0, 60.0), draw.between(30.0, 60.0), draw.between(20.0, 50.0));
    match layout {
        Layout::Scattered => scattered(count, half, draw),
        Layout::Flat => scattered(count, DVec3::new(half.x, half.y, 1e-6), draw),
        Layout::NearlyFlat => {
            let thick_mm = draw.between(2.0, 10.0);
            scattered(count, DVec3::new(half.x, half.y, thick_mm), draw)
        }
        Layout::NearLine => {
            let thin_mm = draw.between(2.0, 7.0);
            scattered(count, DVec3::new(70.0, thin_mm, thin_mm), draw)
        }
        Layout::HalfTurn => doubled(count, half, &|p| DVec3::new(-p.x, -p.y, p.z), draw),
        Layout::MirrorImage => doubled(count, half, &|p| DVec3::new(-p.x, p.y, p.z), draw),
        Layout::ShiftedCopy => {
            let shift = DVec3::new(draw.between(15.0, 40.0), draw.between(-20.0, 20.0), draw.between(-10.0, 10.0));
            doubled(count, half, &|p| p + shift, draw)
        }
        Layout::Grid => {
            let step_mm = draw.between(15.0, 30.0);
            let cell = |n: usize| DVec3::new((n % 3) as f64 - 1.0, (n / 3 % 3) as f64 - 1.0, (n / 9) as f64 - 0.5) * step_mm;
            (0..18).map(cell).filter(|_| draw.chance(count as f64 / 18.0)).collect()
        }
    }
}

fn prior(recipe: &Recipe, view: &View, draw: &mut Draw) -> Option<Prior> {
    let off = |draw: &mut Draw, deg: f64, mm: f64| {
        let turn_rad = draw.normal3(deg.to_radians());
        turned(view, DQuat::from_scaled_axis(turn_rad), draw.normal3(mm))
    };
    let (camera_from_lps, is_stated) = match recipe.expected {
        Expected::Nowhere => return None,
        Expected::Right => (off(draw, 2.0, 5.0), false),
        Expected::RightStated => (off(draw, STATED.0, STATED.1), true),
        Expected::Off => {
            let turn = DQuat::from_axis_angle(draw.normal3(1.0).normalize(), 10f64.to_radians());
            (turned(view, turn, draw.normal3(1.0).normalize() * 30.0), false)
        }
        Expected::Turned if recipe.layout == Layout::HalfTurn => {
            (view.camera_from_lps * Rigid::rotation(DQuat::from_rotation_z(PI)), false)
        }
        Expected::Turned => {
            let turn = DQuat::from_rotation_z(draw.one_of(&[0.5, 1.0, 1.5]) * PI);
            (turned(view, turn, DVec3::ZERO), false)
        }
        Expected::OtherSpecimen => {
            let is_stated = draw.chance(0.3);
            (off(draw, 60.0, 60.0), is_stated)
        }
    };
    let covariance = is_stated.then(|| about_beads(&camera_from_lps, STATED.0, STATED.1));
    Some(Prior { camera_from_lps, covariance })
}

/// Corners and middle of the beads' box, then the corners of one that is nowhere thin.
fn landmarks(layout: &BeadLayout) -> Vec<Landmark> {
    let places = || layout.beads.iter().map(|bead| bead.lps_mm);
    let (low, high) = (places().fold(DVec3::INFINITY, DVec3::min), places().fold(DVec3::NEG_INFINITY, DVec3::max));
    let (middle, half) = (0.5 * (low + high), 0.5 * (high - low));
    let corner = |n: usize, half: DVec3| {
        middle + half * DVec3::new((n % 2) as f64 - 0.5, (n / 2 % 2) as f64 - 0.5, (n / 4) as f64 - 0.5) * 2.0
    };
    let within = (0..8).map(|n| corner(n, half)).chain([layout.centroid_lps_mm()]);
    let beside = (0..8).map(|n| corner(n, half.max(DVec3::splat(BESIDE_MM))));
    within.chain(beside).enumerate().map(|(n, lps_mm)| Landmark { name: format!("landmark {n}"), lps_mm }).collect()
}

/// How far a pose puts the landmark that is farthest off. Beside the beads' box, where their own noise grows, only what is beyond the pose's own
/// stated deviations counts: another reading, and no noise.
pub fn worst_px(pose: &Pose, truth: &Projection, landmarks: &[Landmark]) -> f64 {
    let found = pose.projection.expect("accepted poses have a projection");
    let off = |(n, landmark): (usize, &Landmark)| {
        let (at, depth_mm) = found.project(landmark.lps_mm);
        let off_px = at.distance(truth.project(landmark.lps_mm).0);
        if !(depth_mm > 0.0 && off_px.is_finite()) {
            return f64::INFINITY;
        }
        let stated_px = pose.landmarks.get(n).and_then(|stated| stated.sigma_px).map_or(0.0, |[u, v]| u.hypot(v));
        if n >= WITHIN && off_px <= STATED_SIGMAS * stated_px { 0.0 } else { off_px }
    };
    landmarks.iter().enumerate().map(off).fold(0.0, f64::max)
}

/// Draws the picture, finds its masks and beads, registers it.
pub fn case(recipe: Recipe) -> Case {
    let Recipe { seed, mistake, expected, .. } = recipe;
    let mut draw = Draw(Stream::new(seed, 99, 0, Purpose::Evaluation));
    // A picture turned by a quarter still is of the panel's size.
    let size: [usize; 2] = if mistake == Mistake::FrameQuarterTurned { [512, 512] } else { [620, 480] };
    let view = synthetic::view(size[0] as u32, size[1] as u32, seed);
    let radius_mm = draw.one_of(&[0.75, 1.0, 1.5]);
    let specimen = synthetic::layout_of(&places(recipe.layout, recipe.beads, &mut draw), radius_mm);
    let noise_mm = draw.between(0.02, 0.1);
    let set = |camera_from_lps: &Rigid, draw: &mut Draw| -> Vec<Ball> {
        let ball = |bead: &Bead| {
            let lps_mm = bead.lps_mm + draw.normal3(noise_mm);
            Ball { centre_mm: camera_from_lps.transform_point(lps_mm), radius_mm }
        };
        specimen.beads.iter().map(ball).collect()
    };
    let mut own = set(&view.camera_from_lps, &mut draw);
    while own.len() > recipe.left {
        let lost = draw.between(0.0, own.len() as f64) as usize;
        own.remove(lost.min(own.len() - 1));
    }
    let mut balls = own.clone();
    let depth_mm = view.camera_from_lps.transform_point(DVec3::ZERO).z;
    if mistake == Mistake::Copy {
        let turn = DQuat::from_axis_angle(draw.normal3(1.0).normalize(), draw.between(0.2, 3.0));
        let elsewhere = turned(&view, turn, draw.normal3(20.0) * DVec3::new(1.0, 1.0, 0.3));
        balls.extend(set(&elsewhere, &mut draw));
    }
    if mistake == Mistake::Ghost {
        let away_px = DVec2::from_angle(draw.between(0.0, TAU)) * draw.between(10.0, 40.0);
        let beside = turned(&view, DQuat::IDENTITY, (away_px * depth_mm / view.intrinsics.fx).extend(0.0));
        balls.extend(set(&beside, &mut draw));
    }
    if recipe.has_false {
        for bead in &own {
            let at = DVec2::new(draw.between(0.0, size[0] as f64), draw.between(0.0, size[1] as f64));
            let centre_mm = view.intrinsics.unproject(at) * bead.centre_mm.z * draw.between(0.85, 1.15);
            balls.push(Ball { centre_mm, radius_mm: radius_mm * draw.between(0.8, 1.25) });
        }
    }
    let taken = take(&recipe.looks, &view.intrinsics, size, &balls, seed);
    let seen = &taken.sight[..own.len()];
    let clear = seen.iter().filter(|sight| **sight == Sight::Clear).count();
    let visible = seen.iter().filter(|sight| **sight != Sight::Hidden).count();
    let console = match mistake {
        Mistake::FrameMirrored => Console::Mirrored,
        Mistake::FrameQuarterTurned => Console::QuarterTurn,
        Mistake::FrameHalfTurned => Console::HalfTurn,
        _ => Console::AsTaken,
    };
    let (frame, truth) = (taken.frame(console), console.projection(&view.projection(), size));

    let (mut layout, mut k, mut scale) = (specimen.clone(), view.intrinsics, 1.0f64);
    match mistake {
        Mistake::OtherLayout => {
            // Two grids share most of their cells.
            let kind = if recipe.layout == Layout::Grid { Layout::Scattered } else { recipe.layout };
            layout = synthetic::layout_of(&places(kind, recipe.beads, &mut draw), radius_mm);
        }
        Mistake::LayoutScaled => {
            scale = 1.0 + draw.sign() * draw.between(0.05, 0.2);
            layout.beads.iter_mut().for_each(|bead| bead.lps_mm *= scale);
        }
        Mistake::FocalLength => {
            let factor = 1.0 + draw.sign() * draw.between(0.05, 0.25);
            k = Intrinsics { fx: factor * k.fx, fy: factor * k.fy, ..k };
        }
        Mistake::PrincipalPoint => {
            let away_px = DVec2::from_angle(draw.between(0.0, TAU)) * draw.between(50.0, 200.0);
            k = Intrinsics { cx: k.cx + away_px.x, cy: k.cy + away_px.y, ..k };
        }
        _ => {}
    }
    let prior = prior(&recipe, &view, &mut draw);
    let pitch_mm = 1020.0 / view.intrinsics.fx;
    let intrinsics_prior = (recipe.k == K::Stated).then(|| stated_k(&k, pitch_mm, &mut draw));
    let landmarks = landmarks(&specimen);
    let request = Registration {
        intrinsics: (recipe.k != K::Free).then_some(intrinsics_prior.map_or(k, |prior| prior.mean)),
        intrinsics_prior,
        pitch_mm: Some(pitch_mm),
        prior: prior.as_ref(),
        landmarks: &landmarks,
        ..Registration::new(frame.size_px.map(|n| n as u32), &layout)
    };
    let watch = sidecarm::time::Stopwatch::start();
    let pose = register(&request, &frame);
    let ms = watch.ms();
    let worst_px = if pose.is_accepted() { worst_px(&pose, &truth, &landmarks) } else { 0.0 };

    let fewest = if recipe.k == K::Free { 6 } else { 4 };
    let near = matches!(expected, Expected::Right | Expected::RightStated);
    // A prior with covariance is never left unheeded here, and what it contradicts counts.
    let unheld = prior.as_ref().is_none_or(|prior| prior.covariance.is_none());
    let smallest_px = own.iter().map(|ball| view.intrinsics.fx * ball.radius_mm / ball.centre_mm.z).fold(f64::INFINITY, f64::min);
    let nothing_tells = match mistake {
        // The same picture from nearer or farther: the size of the shadows tells of a scale only what is beyond the radii's own error.
        Mistake::LayoutScaled => unheld && (scale - 1.0).abs() <= RADIUS_TELLS + SMALL_RADIUS_PX2 * (scale / smallest_px).powi(2),
        // Depth makes up for the one, a shift across for the other. Where K is solved, nothing is wrong.
        Mistake::FocalLength | Mistake::PrincipalPoint => unheld && recipe.k != K::Free,
        // The frame shows too few of the specimen for any reading of them, and all of another. A prior near the pose is far from a copy, and not
        // from a ghost.
        Mistake::Copy => unheld && clear < fewest && !near,
        Mistake::Ghost => clear < fewest,
        _ => false,
    };
    Case { recipe, visible, clear, pose, truth, landmarks, worst_px, nothing_tells, ms }
}
