//! Drawn phantoms and the shadows that a C-arm sees of them, by `carm_arm`, which shares no code with the program.

use glam::{DVec2, DVec3};
use nalgebra::{Matrix3, Vector3};
use sidecarm::calibrate::carm::Sensors;
use sidecarm::calibrate::phantom::{
    ArmSigma, Asked, CameraErrors, Cameras, Phantom, PhantomRefusal, PhantomShot, ShotShadow, measure,
};
use sidecarm::geometry::{CarmCalibration, CarmJoints};
use sidecarm::random::{Purpose, Stream};

use crate::calibrate_carm::nominal;
use crate::carm_arm::{Arm, Bed, Joints, V};

pub const RADIUS_MM: f64 = 1.5;

/// What is drawn, and what is stated of it.
#[derive(Clone, Debug)]
pub struct Lab {
    pub seed: u64,
    pub shots: usize,
    pub beads: Vec<V>,
    pub noise_px: f64,
    /// False shadows of each shot.
    pub false_shadows: usize,
    /// Share of shadows that are not there.
    pub missing: f64,
    /// Half the range of the orbit.
    pub orbit_deg: f64,
    /// The arm bends as the published one does.
    pub sags: bool,
    pub sigma: ArmSigma,
}

fn within(random: &mut Stream, half: f64) -> f64 {
    half * (2.0 * random.uniform() - 1.0)
}

/// Beads in a box of these sides, no two closer than 12 mm.
pub fn beads(count: usize, sides: V, seed: u64) -> Vec<V> {
    let mut random = Stream::new(seed, 50, 0, Purpose::Evaluation);
    let mut places: Vec<DVec3> = Vec::new();
    while places.len() < count {
        let place = DVec3::from_array(sides.map(|side| within(&mut random, 0.5 * side)));
        if places.iter().all(|other| other.distance(place) > 12.0) {
            places.push(place);
        }
    }
    places.iter().map(|place| place.to_array()).collect()
}

/// A well calibrated arm whose encoders are good to ±0.2° and ±1 mm.
pub const GOOD: ArmSigma = ArmSigma {
    encoders: Sensors { sigma_deg: 0.2, sigma_mm: 1.0 },
    each_deg: 0.0,
    each_mm: 0.0,
    source_to_isocentre_mm: 1.0,
    source_to_detector_mm: 1.0,
    principal_point_mm: 0.5,
    each_detector_mm: 0.0,
};

impl Lab {
    pub fn new(seed: u64) -> Self {
        Self {
            seed,
            shots: 6 + (seed % 3) as usize,
            beads: beads(10, [160.0, 160.0, 120.0], seed),
            noise_px: 0.05,
            false_shadows: 3,
            missing: 0.1,
            orbit_deg: 55.0,
            sags: false,
            sigma: GOOD,
        }
    }

    fn random(&self, what: u32) -> Stream {
        Stream::new(self.seed, 51, what, Purpose::Evaluation)
    }

    pub fn arm(&self) -> Arm {
        if self.sags {
            return Arm::drawn(self.seed);
        }
        let mut random = self.random(1);
        let ArmSigma { source_to_isocentre_mm, source_to_detector_mm, principal_point_mm, .. } = self.sigma;
        let mut about = |sigma: f64| sigma * random.normal();
        let panel = [about(principal_point_mm), about(principal_point_mm)];
        Arm::straight(about(source_to_isocentre_mm), about(source_to_detector_mm), panel)
    }

    /// The phantom lies at the isocentre, to some millimetres, and askew.
    pub fn bed(&self) -> Bed {
        let mut random = self.random(3);
        let at = [798.9, 41.9, 1020.0].map(|mm| mm + 3.0 * random.normal());
        Bed { at, ..Bed::drawn(self.seed) }
    }

    pub fn joints(&self) -> Vec<Joints> {
        let mut random = self.random(2);
        let joints = |n: usize| {
            let orbital = self.orbit_deg * (2.0 * (n as f64 + 0.5) / self.shots as f64 - 1.0) + within(&mut random, 3.0);
            let angulation = [-15.0, 15.0, 0.0][n % 3] * (self.orbit_deg / 55.0).min(1.0) + within(&mut random, 3.0);
            let mut mm = |half: f64| within(&mut random, half);
            [20.0 + mm(10.0), 3.0, mm(10.0), angulation, orbital, mm(5.0), 1020.0]
        };
        (0..self.shots).map(joints).collect()
    }

    /// As the encoders read the joints; every camera beside is off by its own error.
    pub fn read(&self, random: &mut Stream, joints: Joints) -> CarmJoints {
        let Sensors { sigma_deg, sigma_mm } = self.sigma.encoders;
        let sigmas = [sigma_mm, sigma_deg, sigma_mm, sigma_deg, sigma_deg, sigma_deg, 0.0];
        let mut read: [f64; 7] = std::array::from_fn(|n| joints[n] + sigmas[n] * random.normal());
        [1, 3, 4, 5].into_iter().for_each(|n| read[n] = read[n].to_radians());
        CarmJoints::from_array(read)
    }

    /// One shot of beads that are, at that moment, where `place` has them.
    pub fn shot(&self, n: usize, place: &dyn Fn(V) -> V) -> PhantomShot {
        let (arm, bed, carm) = (self.arm(), self.bed(), nominal());
        let mut random = self.random(10 + n as u32);
        let joints = self.joints()[n];
        let posture = arm.posture(joints);
        let inside = |at: &DVec2| at.cmpge(DVec2::splat(10.0)).all() && at.cmple(DVec2::splat(1525.0)).all();
        let mut shadows: Vec<ShotShadow> = Vec::new();
        let noise_px2 = [self.noise_px.powi(2), 0.0, self.noise_px.powi(2)];
        for bead in &self.beads {
            let [u, v] = posture.shadow(bed.room_from_lps(place(*bead)), &arm);
            let noise = DVec2::new(random.normal(), random.normal()) * self.noise_px;
            let at = DVec2::new(u, v) + noise;
            let missing = random.uniform() < self.missing;
            // Near enough for a radius.
            let radius_px = Some(RADIUS_MM * 1020.0 / 631.8 / 0.194);
            if inside(&at) && !missing {
                shadows.push(ShotShadow { image_px: at, noise_px2, radius_px });
            }
        }
        for _ in 0..self.false_shadows {
            let image_px = DVec2::new(767.5 + within(&mut random, 700.0), 767.5 + within(&mut random, 700.0));
            shadows.insert(0, ShotShadow { image_px, noise_px2, radius_px: None });
        }
        let read = self.read(&mut random, joints);
        let (camera_from_world, intrinsics, covariance) = Cameras::by_joints(&carm, &read, &self.sigma).expect("all joints");
        PhantomShot { name: format!("shot-{n:02}"), size_px: [1536, 1536], intrinsics, camera_from_world, covariance, shadows }
    }

    pub fn all(&self) -> Vec<PhantomShot> {
        (0..self.shots).map(|n| self.shot(n, &|bead| bead)).collect()
    }

    pub fn errors(&self) -> CameraErrors {
        let carm: CarmCalibration = nominal();
        let k = carm.intrinsics(&CarmJoints { source_to_detector_mm: 1020.0, ..CarmJoints::ZERO }).expect("measured");
        self.sigma.errors(&carm, &k)
    }

    pub fn measured(&self, shots: &[PhantomShot]) -> Result<Phantom, PhantomRefusal> {
        measure(&self.asked(shots))
    }

    pub fn asked<'a>(&self, shots: &'a [PhantomShot]) -> Asked<'a> {
        Asked {
            shots,
            errors: self.errors(),
            cameras_from: "joints of the C-arm",
            axes: "the room",
            bead_radius_mm: None,
            distances: &[],
        }
    }
}

/// A measured layout against the beads that were drawn.
#[derive(Clone, Debug)]
pub struct Compared {
    /// Which bead each is.
    pub of: Vec<usize>,
    /// √mean squared distance after the best rigid motion, and after the best scale too, mm.
    pub rigid_mm: f64,
    pub shape_mm: f64,
    /// Found over true size, less 1.
    pub larger_by: f64,
    /// √mean of squared distance over its stated variance, apart from the scale.
    pub shape_pull: f64,
}

impl Compared {
    /// Names are found by distances alone: each bead is the drawn one whose distances to all others fit best.
    pub fn new(phantom: &Phantom, drawn: &[V]) -> Self {
        let found: Vec<DVec3> = phantom.beads.iter().map(|bead| DVec3::from_array(bead.mm)).collect();
        let truth: Vec<DVec3> = drawn.iter().map(|bead| DVec3::from_array(*bead)).collect();
        let mut best: Option<(f64, Vec<usize>)> = None;
        // Three beads fix the motion; all others follow.
        for [i, j, k] in triples(truth.len()) {
            let sides = |p: &[DVec3], [a, b, c]: [usize; 3]| [p[a].distance(p[b]), p[a].distance(p[c]), p[b].distance(p[c])];
            let (own, theirs) = (sides(&found, [0, 1, 2]), sides(&truth, [i, j, k]));
            if own.iter().zip(theirs).any(|(a, b)| (a / b - 1.0).abs() > 0.05) {
                continue;
            }
            let (rotation, scale, shift) = similarity(&found[..3], &[truth[i], truth[j], truth[k]], true);
            let put = |p: &DVec3| scale * (rotation * Vector3::from(p.to_array())) + shift;
            let near = |p: &DVec3| {
                let at = DVec3::from_array(put(p).into());
                let own = (0..truth.len()).map(|n| (truth[n].distance(at), n));
                own.min_by(|a, b| a.0.total_cmp(&b.0)).expect("beads")
            };
            let pairs: Vec<(f64, usize)> = found.iter().map(near).collect();
            let off: f64 = pairs.iter().map(|(off, _)| off).sum();
            if best.as_ref().is_none_or(|best| off < best.0) {
                best = Some((off, pairs.into_iter().map(|(_, n)| n).collect()));
            }
        }
        let of = best.map(|best| best.1).unwrap_or_else(|| vec![0; found.len()]);
        let target: Vec<DVec3> = of.iter().map(|n| truth[*n]).collect();
        let off = |scaled: bool| -> (Vec<f64>, f64) {
            let (rotation, scale, shift) = similarity(&found, &target, scaled);
            let put = |p: &DVec3| scale * (rotation * Vector3::from(p.to_array())) + shift;
            (found.iter().zip(&target).map(|(p, q)| (put(p) - Vector3::from(q.to_array())).norm_squared()).collect(), scale)
        };
        let rms = |squares: &[f64]| (squares.iter().sum::<f64>() / squares.len() as f64).sqrt();
        let ((rigid, _), (shape, scale)) = (off(false), off(true));
        let stated: f64 = phantom.beads.iter().map(|bead| 3.0 * bead.shape_sigma_mm.powi(2)).sum();
        Self {
            of,
            rigid_mm: rms(&rigid),
            shape_mm: rms(&shape),
            larger_by: scale.recip() - 1.0,
            shape_pull: (shape.iter().sum::<f64>() / stated).sqrt(),
        }
    }
}

fn triples(n: usize) -> impl Iterator<Item = [usize; 3]> {
    let all = (0..n).flat_map(move |i| (0..n).flat_map(move |j| (0..n).map(move |k| [i, j, k])));
    all.filter(|[i, j, k]| i != j && j != k && i != k)
}

/// The best rotation, scale and shift of `from` onto `to` (Umeyama 1991); never mirrored.
fn similarity(from: &[DVec3], to: &[DVec3], scaled: bool) -> (Matrix3<f64>, f64, Vector3<f64>) {
    let v = |p: DVec3| Vector3::from(p.to_array());
    let mean = |points: &[DVec3]| v(points.iter().sum::<DVec3>() / points.len() as f64);
    let (a, b) = (mean(from), mean(to));
    let cross: Matrix3<f64> = from.iter().zip(to).map(|(p, q)| (v(*q) - b) * (v(*p) - a).transpose()).sum();
    let svd = cross.svd(true, true);
    let (u, vt) = (svd.u.expect("asked"), svd.v_t.expect("asked"));
    let least = svd.singular_values.imin();
    let mut signs = Vector3::repeat(1.0);
    signs[least] = (u * vt).determinant().signum();
    let rotation = u * Matrix3::from_diagonal(&signs) * vt;
    let size: f64 = from.iter().map(|p| (v(*p) - a).norm_squared()).sum();
    let scale = if scaled { svd.singular_values.dot(&signs) / size } else { 1.0 };
    (rotation, scale, b - scale * (rotation * a))
}
