//! A C-arm for tests, written without the program's chain: focal spot and panel are points and vectors in the room, a shadow is where a
//! line meets the panel's plane. It bends by a law of its own, smooth and of third order in the angles.

use sidecarm::random::{Purpose, Stream};

pub type V = [f64; 3];

pub fn add(a: V, b: V) -> V {
    [a[0] + b[0], a[1] + b[1], a[2] + b[2]]
}

pub fn sub(a: V, b: V) -> V {
    [a[0] - b[0], a[1] - b[1], a[2] - b[2]]
}

pub fn dot(a: V, b: V) -> f64 {
    a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
}

pub fn scaled(a: V, by: f64) -> V {
    a.map(|x| x * by)
}

/// Turns `p` about coordinate axis `axis` through `deg`, right-handed.
pub fn turned(p: V, axis: usize, deg: f64) -> V {
    let (s, c) = deg.to_radians().sin_cos();
    let (i, j) = ((axis + 1) % 3, (axis + 2) % 3);
    let mut q = p;
    q[i] = c * p[i] - s * p[j];
    q[j] = s * p[i] + c * p[j];
    q
}

pub fn angle_deg(a: V, b: V) -> f64 {
    let cross = [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
    dot(cross, cross).sqrt().atan2(dot(a, b)).to_degrees()
}

/// Joints in mm and degrees, in the order of the wire.
pub type Joints = [f64; 7];

/// Focal spot, middle of the panel, and the panel's axes along columns and rows, in the room.
#[derive(Clone, Copy, Debug)]
pub struct Posture {
    pub source: V,
    pub panel: V,
    pub columns: V,
    pub rows: V,
    /// Where the axes meet, or nearly so.
    pub isocentre: V,
}

impl Posture {
    /// Shadow of a point, px; the first pixel's centre is (0, 0).
    pub fn shadow(&self, p: V, arm: &Arm) -> [f64; 2] {
        let [u, v] = self.shadow_mm(p);
        [u / arm.pitch_mm + 0.5 * (arm.size_px[0] - 1.0), v / arm.pitch_mm + 0.5 * (arm.size_px[1] - 1.0)]
    }

    pub fn shadow_mm(&self, p: V) -> [f64; 2] {
        let normal = self.normal();
        let ray = sub(p, self.source);
        let t = dot(sub(self.panel, self.source), normal) / dot(ray, normal);
        let hit = sub(add(self.source, scaled(ray, t)), self.panel);
        [dot(hit, self.columns), dot(hit, self.rows)]
    }

    pub fn normal(&self) -> V {
        let (a, b) = (self.columns, self.rows);
        [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]
    }
}

/// A sum of three harmonics of the orbital angle, coupled to the angulation.
#[derive(Clone, Copy, Debug)]
struct Bend {
    size: f64,
    phase: [f64; 5],
}

impl Bend {
    fn drawn(random: &mut Stream) -> Self {
        Self { size: random.normal(), phase: std::array::from_fn(|_| std::f64::consts::TAU * random.uniform()) }
    }

    fn at(&self, angulation_deg: f64, orbital_deg: f64) -> f64 {
        let (a, o) = (angulation_deg.to_radians(), orbital_deg.to_radians());
        let [p, q, r, s, t] = self.phase;
        let first = (o + p).sin() * a.cos() + q.sin() * a.sin();
        let second = (2.0 * o + r).sin() + (o + s).sin() * a.sin();
        let third = (3.0 * o + t).sin() + (2.0 * a + q).sin();
        self.size * (first + 0.12 * second + 0.02 * third)
    }
}

#[derive(Clone, Debug)]
pub struct Arm {
    pub size_px: [f64; 2],
    pub pitch_mm: f64,
    source_to_isocentre_mm: f64,
    distance_offset_mm: f64,
    column_to_isocentre_mm: V,
    /// Added to the true readings of angulation, orbital angle, detector rotation.
    offsets_deg: V,
    skew_deg: f64,
    axis_offset_mm: f64,
    source_offset_mm: V,
    panel_offset_mm: V,
    panel_tilt_deg: V,
    source_bend_mm: [Bend; 3],
    panel_bend_mm: [Bend; 3],
    tilt_bend_deg: [Bend; 3],
}

/// Of the published arm: how far the piercing point wanders on the panel, and how far the panel turns, over the range of angles.
pub const WANDERS_MM: f64 = 15.8;
pub const TURNS_DEG: f64 = 2.9;

impl Arm {
    /// The nominal one of `calibration/carm/nominal-mobile.json`, with the errors of a real one.
    pub fn drawn(seed: u64) -> Self {
        let mut random = Stream::new(seed, 0, 0, Purpose::Evaluation);
        let mut about = |nominal: f64, sigma: f64| nominal + sigma * random.normal();
        let mut arm = Self {
            size_px: [1536.0, 1536.0],
            pitch_mm: 0.194,
            source_to_isocentre_mm: about(631.8, 5.0),
            distance_offset_mm: about(0.0, 3.0),
            column_to_isocentre_mm: [about(800.0, 5.0), about(0.0, 5.0), about(1000.0, 5.0)],
            offsets_deg: [about(0.0, 0.7), about(0.0, 0.7), about(0.0, 0.7)],
            skew_deg: about(0.0, 0.3),
            axis_offset_mm: about(0.0, 8.0),
            source_offset_mm: [about(0.0, 3.0), about(0.0, 3.0), 0.0],
            panel_offset_mm: [about(0.0, 2.0), about(0.0, 2.0), 0.0],
            panel_tilt_deg: [about(0.0, 0.5), about(0.0, 0.5), 0.0],
            source_bend_mm: [Bend { size: 0.0, phase: [0.0; 5] }; 3],
            panel_bend_mm: [Bend { size: 0.0, phase: [0.0; 5] }; 3],
            tilt_bend_deg: [Bend { size: 0.0, phase: [0.0; 5] }; 3],
        };
        for n in 0..3 {
            arm.source_bend_mm[n] = Bend::drawn(&mut random);
            arm.panel_bend_mm[n] = Bend::drawn(&mut random);
            arm.tilt_bend_deg[n] = Bend::drawn(&mut random);
        }
        // The distance between focal spot and panel hardly changes: the C is stiff against pulling.
        arm.panel_bend_mm[2].size *= 0.1;
        for _ in 0..3 {
            let (mm, deg) = arm.wanders();
            arm.source_bend_mm.iter_mut().chain(&mut arm.panel_bend_mm).for_each(|bend| bend.size *= WANDERS_MM / mm);
            arm.tilt_bend_deg.iter_mut().for_each(|bend| bend.size *= TURNS_DEG / deg);
        }
        arm
    }

    /// The nominal one as drawn, but for the distances from the focal spot to the isocentre and to the panel, and the panel's middle.
    pub fn straight(source_mm: f64, distance_mm: f64, panel_mm: [f64; 2]) -> Self {
        let straight = [Bend { size: 0.0, phase: [0.0; 5] }; 3];
        Self {
            size_px: [1536.0, 1536.0],
            pitch_mm: 0.194,
            source_to_isocentre_mm: 631.8 + source_mm,
            distance_offset_mm: distance_mm,
            column_to_isocentre_mm: [800.0, 0.0, 1000.0],
            offsets_deg: [0.0; 3],
            skew_deg: 0.0,
            axis_offset_mm: 0.0,
            source_offset_mm: [0.0; 3],
            panel_offset_mm: [panel_mm[0], panel_mm[1], 0.0],
            panel_tilt_deg: [0.0; 3],
            source_bend_mm: straight,
            panel_bend_mm: straight,
            tilt_bend_deg: straight,
        }
    }

    /// Largest distance between piercing points on the panel, mm, and largest turn of the panel within the C, degrees, over the range.
    pub fn wanders(&self) -> (f64, f64) {
        let grid = (-6..=6).flat_map(|o| (-2..=2).map(move |a| (15.0 * f64::from(o), 15.0 * f64::from(a))));
        let (mut points, mut turns) = (Vec::new(), Vec::new());
        for (o, a) in grid {
            let posture = self.posture([0.0, 0.0, 0.0, a, o, 0.0, 1020.0]);
            points.push(posture.shadow_mm(posture.isocentre));
            turns.push(self.tilt_bend_deg.map(|bend| bend.at(a, o)));
        }
        let pairs = |n: usize| (0..n).flat_map(move |i| (0..i).map(move |j| (i, j)));
        let apart = |(i, j): (usize, usize)| (points[i][0] - points[j][0]).hypot(points[i][1] - points[j][1]);
        let turn = |(i, j): (usize, usize)| dot(sub(turns[i], turns[j]), sub(turns[i], turns[j])).sqrt();
        (pairs(points.len()).map(apart).fold(0.0, f64::max), pairs(turns.len()).map(turn).fold(0.0, f64::max))
    }

    /// Where everything is at true joints.
    pub fn posture(&self, joints: Joints) -> Posture {
        let [lift, wig_wag, longitudinal, angulation, orbital, detector_rotation, distance] = joints;
        let (a, o) = (angulation + self.offsets_deg[0], orbital + self.offsets_deg[1]);
        let bend = |bends: &[Bend; 3]| bends.map(|bend| bend.at(a, o));
        // From the C's axes, origin where its own axis passes, to the room.
        let direction_to_room = |p: V| {
            let in_carriage = turned(turned(p, 1, o), 2, self.skew_deg);
            turned(turned(in_carriage, 0, a), 2, wig_wag)
        };
        let to_room = |p: V| {
            let in_carriage = add(turned(turned(p, 1, o), 2, self.skew_deg), [0.0, 0.0, self.axis_offset_mm]);
            let at_column = add(turned(in_carriage, 0, a), self.column_to_isocentre_mm);
            add(turned(at_column, 2, wig_wag), [longitudinal, 0.0, lift])
        };
        let source = add(add([0.0, 0.0, -self.source_to_isocentre_mm], self.source_offset_mm), bend(&self.source_bend_mm));
        let reach = distance + self.distance_offset_mm - self.source_to_isocentre_mm;
        let panel = add(add([0.0, 0.0, reach], self.panel_offset_mm), bend(&self.panel_bend_mm));
        let tilt = add(self.panel_tilt_deg, bend(&self.tilt_bend_deg));
        let in_c = |axis: V| {
            let rolled = turned(axis, 2, detector_rotation + self.offsets_deg[2]);
            turned(turned(turned(rolled, 2, tilt[2]), 1, tilt[1]), 0, tilt[0])
        };
        Posture {
            source: to_room(source),
            panel: to_room(panel),
            columns: direction_to_room(in_c([1.0, 0.0, 0.0])),
            rows: direction_to_room(in_c([0.0, 1.0, 0.0])),
            isocentre: to_room([0.0; 3]),
        }
    }
}

/// Where the specimen lies: supine at the isocentre of the arm at rest, a little askew.
#[derive(Clone, Copy, Debug)]
pub struct Bed {
    pub at: V,
    pub askew_deg: V,
}

impl Bed {
    pub fn drawn(seed: u64) -> Self {
        let mut random = Stream::new(seed, 1, 0, Purpose::Evaluation);
        let mut about = |nominal: f64, sigma: f64| nominal + sigma * random.normal();
        Self {
            at: [about(815.0, 10.0), about(0.0, 10.0), about(1025.0, 10.0)],
            askew_deg: std::array::from_fn(|_| about(0.0, 4.0)),
        }
    }

    /// x → x, y → −z, z → y.
    pub fn room_from_lps(&self, p: V) -> V {
        let askew = (0..3).fold(p, |p, axis| turned(p, axis, self.askew_deg[axis]));
        add([askew[0], askew[2], -askew[1]], self.at)
    }

    pub fn lps_from_room(&self, p: V) -> V {
        let q = sub(p, self.at);
        (0..3).rev().fold([q[0], -q[2], q[1]], |p, axis| turned(p, axis, -self.askew_deg[axis]))
    }
}
