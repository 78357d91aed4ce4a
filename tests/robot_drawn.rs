//! Radiographs of a snake robot, drawn by code that shares nothing with the program: its own chain, its own chords, one energy.

use rand_free::Noise;

/// Columns of a rotation, and an origin: maps points of a frame to the one around it.
#[derive(Clone, Copy, Debug)]
pub struct Place {
    pub axes: [[f64; 3]; 3],
    pub origin: [f64; 3],
}

pub type V = [f64; 3];

pub fn dot(a: V, b: V) -> f64 {
    a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
}

fn plus(a: V, b: V, times: f64) -> V {
    std::array::from_fn(|n| a[n] + times * b[n])
}

impl Place {
    /// The frame turned by `deg` about its own axis `axis`.
    pub fn turned(self, axis: usize, deg: f64) -> Self {
        let (sin, cos) = deg.to_radians().sin_cos();
        let (b, c) = ((axis + 1) % 3, (axis + 2) % 3);
        let mut axes = self.axes;
        axes[b] = std::array::from_fn(|n| cos * self.axes[b][n] + sin * self.axes[c][n]);
        axes[c] = std::array::from_fn(|n| cos * self.axes[c][n] - sin * self.axes[b][n]);
        Self { axes, ..self }
    }

    /// The frame moved along its own third axis.
    pub fn along(self, mm: f64) -> Self {
        Self { origin: plus(self.origin, self.axes[2], mm), ..self }
    }

    pub fn point(&self, p: V) -> V {
        (0..3).fold(self.origin, |sum, n| plus(sum, self.axes[n], p[n]))
    }

    fn local(&self, p: V) -> V {
        let from = plus(p, self.origin, -1.0);
        self.axes.map(|axis| dot(axis, from))
    }

    fn local_way(&self, way: V) -> V {
        self.axes.map(|axis| dot(axis, way))
    }
}

/// A robot: where its base is, its five angles as they are, and what a load adds at every notch, in the plane and across it.
#[derive(Clone, Copy, Debug)]
pub struct Snake {
    pub base: Place,
    pub angles_deg: [f64; 5],
    pub load_deg: [f64; 2],
}

const NOTCHES: usize = 27;
const BODY_MM: f64 = 35.0;

impl Snake {
    /// Angle of a notch: the natural cubic through five knots, by its inner second derivatives from a 3×3 inverse written out.
    fn notch_deg(&self, notch: usize) -> f64 {
        let y = self.angles_deg;
        let bow = |k: usize| 6.0 * (y[k - 1] - 2.0 * y[k] + y[k + 1]);
        let (a, b, c) = (bow(1), bow(2), bow(3));
        let m =
            [0.0, (15.0 * a - 4.0 * b + c) / 56.0, (16.0 * b - 4.0 * a - 4.0 * c) / 56.0, (a - 4.0 * b + 15.0 * c) / 56.0, 0.0];
        let t = (notch as f64 * 6.0 / 26.0 - 1.0).clamp(0.0, 4.0);
        let k = (t as usize).min(3);
        let (u, d) = (t - k as f64, 1.0 - (t - k as f64));
        y[k] * d + y[k + 1] * u - (m[k] * (d - d * d * d) + m[k + 1] * (u - u * u * u)) / 6.0
    }

    /// Frame and length of each piece, and the frame at the body's end.
    fn pieces(&self) -> (Vec<(Place, f64)>, Place) {
        let step = BODY_MM / NOTCHES as f64;
        let mut at = self.base;
        let mut pieces = Vec::new();
        for notch in 0..NOTCHES {
            let length = if notch == 0 { 0.5 * step } else { step };
            pieces.push((at, length));
            at = at.along(length).turned(1, self.notch_deg(notch) + self.load_deg[0]).turned(0, self.load_deg[1]);
        }
        pieces.push((at, 0.5 * step));
        (pieces, at.along(0.5 * step))
    }

    /// The drill's tip.
    pub fn tip(&self) -> V {
        self.pieces().1.along(4.0).origin
    }
}

/// A rod that attenuates, hollow or not.
struct Rod {
    place: Place,
    length: f64,
    radii: [f64; 2],
    per_mm: f64,
    group: usize,
}

/// Where a line is inside a cylinder of a rod.
fn chord(rod: &Rod, radius: f64, from: V, way: V) -> Option<[f64; 2]> {
    let (p, w) = (rod.place.local(from), rod.place.local_way(way));
    let flat = w[0] * w[0] + w[1] * w[1];
    // The line's nearest approach to the axis, then half the chord there.
    let nearest = -(p[0] * w[0] + p[1] * w[1]) / flat;
    let miss2 = (p[0] + nearest * w[0]).powi(2) + (p[1] + nearest * w[1]).powi(2);
    let half = ((radius * radius - miss2) / flat).sqrt();
    let ends = [-p[2] / w[2], (rod.length - p[2]) / w[2]];
    let (low, high) = (ends[0].min(ends[1]).max(nearest - half), ends[0].max(ends[1]).min(nearest + half));
    (half.is_finite() && low < high).then_some([low, high])
}

/// Total length of stretches, counted once where they overlap.
fn covered(stretches: &mut [[f64; 2]]) -> f64 {
    stretches.sort_by(|a, b| a[0].total_cmp(&b[0]));
    let (mut sum, mut end) = (0.0, f64::NEG_INFINITY);
    for [low, high] in stretches.iter() {
        if *high > end {
            sum += high - low.max(end);
            end = *high;
        }
    }
    sum
}

/// Balls of tissue, bone and steel: centre, radius, attenuation per mm beyond what surrounds it.
pub type Ball = (V, f64, f64);

/// A camera: its frame in the specimen (third axis to the detector), focal length and principal point in px.
#[derive(Clone, Copy, Debug)]
pub struct Eye {
    pub place: Place,
    pub focal_px: f64,
    pub principal_px: [f64; 2],
    pub size_px: [usize; 2],
}

/// Metal per mm: nitinol, steel.
const PER_MM: [f64; 2] = [0.55, 0.75];

/// The frame: counts with noise for `photons` per pixel in air, or without any for 0.
pub fn draw(eye: &Eye, snake: Option<&Snake>, balls: &[Ball], photons: f64, seed: u64) -> Vec<f32> {
    let mut rods = Vec::new();
    if let Some(snake) = snake {
        let (pieces, end) = snake.pieces();
        for (place, length) in &pieces {
            rods.push(Rod { place: *place, length: *length, radii: [3.0, 2.0], per_mm: PER_MM[0], group: 0 });
            rods.push(Rod { place: *place, length: *length, radii: [1.0, 0.0], per_mm: PER_MM[1], group: 1 });
        }
        rods.push(Rod { place: end, length: 4.0, radii: [2.5, 0.0], per_mm: PER_MM[1], group: 1 });
    }
    // No point of a robot of 39 mm lies farther from the middle of its straight shape than 30 mm, unless it is bent back on itself.
    let middle = snake.map(|snake| snake.base.along(15.0).origin);
    let source = eye.place.origin;
    let mut noise = Noise::new(seed);
    let mut pixels = Vec::with_capacity(eye.size_px[0] * eye.size_px[1]);
    let mut stretches: [Vec<[f64; 2]>; 2] = [Vec::new(), Vec::new()];
    for row in 0..eye.size_px[1] {
        for column in 0..eye.size_px[0] {
            let mut passed = 0.0;
            for (du, dv) in [(-0.25, -0.25), (0.25, -0.25), (-0.25, 0.25), (0.25, 0.25)] {
                let ray = [
                    (column as f64 + du - eye.principal_px[0]) / eye.focal_px,
                    (row as f64 + dv - eye.principal_px[1]) / eye.focal_px,
                    1.0,
                ];
                let length = dot(ray, ray).sqrt();
                let way = plus(eye.place.point(ray), source, -1.0).map(|x| x / length);
                let mut depth = 0.0;
                let near = middle.is_some_and(|middle| {
                    let to = plus(middle, source, -1.0);
                    dot(to, to) - dot(to, way).powi(2) < 30.0 * 30.0
                });
                for (centre, radius, per_mm) in balls {
                    let to = plus(*centre, source, -1.0);
                    let miss2 = dot(to, to) - dot(to, way).powi(2);
                    depth += per_mm * 2.0 * (radius * radius - miss2).max(0.0).sqrt();
                }
                stretches.iter_mut().for_each(Vec::clear);
                for rod in rods.iter().filter(|_| near) {
                    let to = plus(rod.place.origin, source, -1.0);
                    if dot(to, to) - dot(to, way).powi(2) > 36.0 {
                        continue;
                    }
                    let Some([low, high]) = chord(rod, rod.radii[0], source, way) else { continue };
                    match chord(rod, rod.radii[1], source, way).filter(|_| rod.radii[1] > 0.0) {
                        Some([a, b]) => stretches[rod.group].extend([[low, a], [b, high]]),
                        None => stretches[rod.group].push([low, high]),
                    }
                }
                depth += stretches.iter_mut().zip(PER_MM).map(|(some, per_mm)| per_mm * covered(some)).sum::<f64>();
                passed += 0.25 * (-depth).exp();
            }
            let mean = 65_535.0 * passed;
            let spread = if photons > 0.0 { mean * (1.0 / (photons * passed)).sqrt() } else { 0.0 };
            pixels.push((mean + spread * noise.normal()).max(0.0) as f32);
        }
    }
    debug_assert!(rods.iter().all(|rod| rod.per_mm > 0.0));
    pixels
}

/// Random numbers that nobody else uses.
pub mod rand_free {
    /// A 64-bit mixing generator.
    #[derive(Clone, Debug)]
    pub struct Noise(u64);

    impl Noise {
        pub fn new(seed: u64) -> Self {
            Self(seed.wrapping_mul(0x9E37_79B9_7F4A_7C15).wrapping_add(0x1234_5678_9ABC_DEF1))
        }

        /// Between 0 and 1.
        pub fn uniform(&mut self) -> f64 {
            self.0 = self.0.wrapping_add(0x9E37_79B9_7F4A_7C15);
            let mut z = self.0;
            z = (z ^ (z >> 30)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
            z = (z ^ (z >> 27)).wrapping_mul(0x94D0_49BB_1331_11EB);
            ((z ^ (z >> 31)) >> 11) as f64 * (0.5f64).powi(53)
        }

        /// Between −half and half.
        pub fn within(&mut self, half: f64) -> f64 {
            half * (2.0 * self.uniform() - 1.0)
        }

        /// Of mean 0 and standard deviation 1: twelve uniform numbers, enough for noise of pixels.
        pub fn normal(&mut self) -> f64 {
            (0..12).map(|_| self.uniform()).sum::<f64>() - 6.0
        }

        /// A direction.
        pub fn way(&mut self) -> [f64; 3] {
            loop {
                let v = [self.within(1.0), self.within(1.0), self.within(1.0)];
                let length = super::dot(v, v).sqrt();
                if length > 0.1 && length < 1.0 {
                    return v.map(|x| x / length);
                }
            }
        }
    }
}

/// The worked example of the wire's protocol, and a load that moves the tip as a lever does.
#[test]
fn the_drawn_robot_is_the_protocol_s() {
    let base = Place { axes: [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]], origin: [0.0; 3] };
    let snake = Snake { base, angles_deg: [1.0, 2.0, 0.5, -1.0, 0.0], load_deg: [0.0; 2] };
    let printed = include_str!("../mocks/PROTOCOL.md").split("tip at (").nth(1).and_then(|s| s.split(')').next()).expect("tip");
    for (a, b) in snake.tip().iter().zip(printed.split(", ")) {
        assert!((a - b.parse::<f64>().expect("a number")).abs() < 1e-6, "{a} {b}");
    }
    let straight = Snake { angles_deg: [0.0; 5], ..snake };
    let bent = Snake { load_deg: [0.2, 0.0], ..straight }.tip();
    // 0.2 degrees at each pivot, whose levers to the tip sum to 27 · (39 − 17.5) mm.
    assert!((bent[0] - 0.2f64.to_radians() * 27.0 * 21.5).abs() < 0.01, "{bent:?}");
}
