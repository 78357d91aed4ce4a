//! Radiographs of steel spheres whose expected values are known: chords by supersampling, integrated over pixels, blurred, with
//! counted quanta; and the least variance that any unbiased estimate of a centre can have in them.
//!
//! Shares nothing with `beads::profile`.

use nalgebra::{DMatrix, DVector};
use sidecarm::image::Image;
use sidecarm::random::{Purpose, Stream};

/// Samples a pixel, along each axis.
const FINE: usize = 4;
/// Radius of a 1.5 mm sphere, magnification 1.6, on 0.194 mm pixels.
pub const RADIUS_PX: f64 = 0.75 * 1.6 / 0.194;
/// Distance between beads.
pub const CELL_PX: usize = 60;

/// A sphere's shadow: centre, radius.
#[derive(Clone, Copy, Debug)]
pub struct Sphere {
    pub u_px: f64,
    pub v_px: f64,
    pub radius_px: f64,
}

/// What lies in front of the beads besides a plane.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Clutter {
    None,
    /// Lobes of soft tissue of about 70 px.
    Tissue,
    /// A bone's rim through each row of beads.
    Bone,
    /// A Kirschner wire through each row.
    Wire,
    /// A threaded screw beside each row.
    Screw,
}

/// A straight thing across the frame.
#[derive(Clone, Copy, Debug)]
pub struct Line {
    /// v = offset + slope · u.
    offset: f64,
    slope: f64,
    height: f64,
}

/// A frame to be drawn.
#[derive(Clone, Debug)]
pub struct Drawn {
    pub columns: usize,
    pub rows: usize,
    pub quanta: f64,
    pub blur_px: f64,
    pub beads: Vec<Sphere>,
    pub clutter: Clutter,
    /// Share and attenuation (in 1/mm) of steel for each energy of the beam.
    pub steel: Vec<(f64, f64)>,
    /// Nepers per pixel along either axis.
    pub tilt: (f64, f64),
    /// Phases of the lobes of tissue.
    pub lobes: [f64; 4],
    /// A bone, wire or screw for each row of beads.
    pub lines: Vec<Line>,
}

impl Drawn {
    pub fn new(across: usize, down: usize, quanta: f64, clutter: Clutter, seed: u64) -> Self {
        let mut random = Stream::new(seed, 40, 0, Purpose::Evaluation);
        let mut within = |low: f64, high: f64| low + (high - low) * random.uniform();
        let mut beads = Vec::new();
        let mut lines = Vec::new();
        for row in 0..down {
            let middle = |n: usize| (n as f64 + 0.5) * CELL_PX as f64;
            for column in 0..across {
                let (u_px, v_px) = (middle(column) + within(-2.0, 2.0), middle(row) + within(-2.0, 2.0));
                beads.push(Sphere { u_px, v_px, radius_px: RADIUS_PX });
            }
            let slope = within(-0.12, 0.12);
            let away = match clutter {
                Clutter::Screw => within(22.0, 27.0) * within(-1.0, 1.0).signum(),
                _ => within(-18.0, 18.0),
            };
            let slope = if clutter == Clutter::Screw { 0.1 * slope } else { slope };
            let offset = middle(row) + away - slope * 0.5 * (across * CELL_PX) as f64;
            lines.push(Line { offset, slope, height: within(0.15, 0.5) });
        }
        let tilt = (within(-2e-3, 2e-3), within(-2e-3, 2e-3));
        let lobes = std::array::from_fn(|_| within(0.0, std::f64::consts::TAU));
        // Three energies of a filtered beam: hardening makes the shadow a little flatter than one energy would.
        let steel = BEAM.to_vec();
        Self { columns: across * CELL_PX, rows: down * CELL_PX, quanta, blur_px: 0.8, beads, clutter, steel, tilt, lobes, lines }
    }

    /// Tissue and bone in nepers, and steel besides beads in millimetres.
    fn clutter_at(&self, u: f64, v: f64) -> (f64, f64) {
        let mut nepers = self.tilt.0 * (u - 0.5 * self.columns as f64) + self.tilt.1 * (v - 0.5 * self.rows as f64);
        let mut steel_mm = 0.0;
        match self.clutter {
            Clutter::None => {}
            Clutter::Tissue => {
                let [a, b, c, d] = self.lobes;
                nepers += 0.35 * ((u / 11.0 + a).sin() * (v / 13.0 + b).cos())
                    + 0.2 * ((u + 0.6 * v) / 9.0 + c).sin()
                    + 0.1 * ((u - v) / 15.0 + d).cos();
            }
            Clutter::Bone => {
                for (n, line) in self.lines.iter().enumerate() {
                    // A tube's wall: steep outside, falling slowly inwards.
                    let inside = (v - line.offset - line.slope * u - 2.0 * (u / 23.0 + n as f64).sin()) / 3.0;
                    if inside > 0.0 && inside < 12.0 {
                        nepers += line.height * inside.sqrt() * (-inside / 3.0).exp();
                    }
                }
            }
            Clutter::Wire => {
                let radius = 0.5 * 1.5 / 0.194;
                for line in &self.lines {
                    let off = (v - line.offset - line.slope * u) / (1.0 + line.slope * line.slope).sqrt() / radius;
                    steel_mm += if off.abs() < 1.0 { 1.0 * (1.0 - off * off).sqrt() } else { 0.0 };
                }
            }
            Clutter::Screw => {
                for line in &self.lines {
                    let thread = 1.0 + 0.18 * (u * 0.9 + if v > line.offset + line.slope * u { 1.6 } else { 0.0 }).sin();
                    let off = (v - line.offset - line.slope * u) / (9.0 * thread);
                    steel_mm += if off.abs() < 1.0 { 1.8 * (1.0 - off * off).sqrt() } else { 0.0 };
                }
            }
        }
        (nepers, steel_mm)
    }

    /// Expected quanta of each pixel.
    pub fn expected(&self) -> Image<f64> {
        let (w, h) = (self.columns * FINE, self.rows * FINE);
        let mut fine = vec![0.0f64; w * h];
        let mut beads_mm = vec![0.0f64; w * h];
        let place = |n: usize| (n as f64 + 0.5) / FINE as f64 - 0.5;
        for bead in &self.beads {
            let span = |centre: f64, end: usize| {
                let at = |x: f64| ((x + 0.5) * FINE as f64).clamp(0.0, end as f64) as usize;
                at(centre - bead.radius_px - 0.5)..at(centre + bead.radius_px + 1.5)
            };
            let mm = 1.5 * bead.radius_px / RADIUS_PX;
            for row in span(bead.v_px, h) {
                for column in span(bead.u_px, w) {
                    let off2 = ((place(column) - bead.u_px).powi(2) + (place(row) - bead.v_px).powi(2)) / bead.radius_px.powi(2);
                    beads_mm[row * w + column] += mm * (1.0 - off2).max(0.0).sqrt();
                }
            }
        }
        for row in 0..h {
            for column in 0..w {
                let (nepers, steel_mm) = self.clutter_at(place(column), place(row));
                let mm = steel_mm + beads_mm[row * w + column];
                let through: f64 =
                    if mm > 0.0 { self.steel.iter().map(|(share, mu)| share * (-mu * mm).exp()).sum() } else { 1.0 };
                fine[row * w + column] = (-nepers).exp() * through;
            }
        }
        let blurred = gaussian(&fine, w, h, self.blur_px * FINE as f64);
        let mut out = Image::filled(self.columns, self.rows, 0.0f64);
        for row in 0..h {
            for column in 0..w {
                out.pixels[row / FINE * self.columns + column / FINE] += blurred[row * w + column];
            }
        }
        let scale = self.quanta / (FINE * FINE) as f64;
        out.pixels.iter_mut().for_each(|value| *value *= scale);
        out
    }
}

/// Three energies of a filtered beam: share, and attenuation of steel in 1/mm.
const BEAM: [(f64, f64); 3] = [(0.3, 1.5), (0.4, 0.8), (0.3, 0.45)];

/// What steel lets pass.
pub fn steel_passes(mm: f64) -> f64 {
    BEAM.iter().map(|(share, mu)| share * (-mu * mm).exp()).sum()
}

/// What 1.5 mm spheres let pass at each pixel, blurred by a Gaussian.
pub fn shade(width: usize, height: usize, spheres: &[Sphere], blur_px: f64) -> Image<f64> {
    let mut all = Image::filled(width, height, 1.0);
    for sphere in spheres {
        let reach = (sphere.radius_px + 5.0).ceil();
        let first = |at: f64| (at - reach).floor().max(0.0);
        let (left, top) = (first(sphere.u_px), first(sphere.v_px));
        let span = |at: f64, first: f64, end: usize| (((at + reach).ceil() + 1.0).min(end as f64) - first).max(0.0) as usize;
        let (w, h) = (span(sphere.u_px, left, width), span(sphere.v_px, top, height));
        let mut fine = vec![0.0; w * FINE * h * FINE];
        for (n, value) in fine.iter_mut().enumerate() {
            let place = |n: usize| (n as f64 + 0.5) / FINE as f64 - 0.5;
            let (u, v) = (left + place(n % (w * FINE)), top + place(n / (w * FINE)));
            let off2 = ((u - sphere.u_px).powi(2) + (v - sphere.v_px).powi(2)) / sphere.radius_px.powi(2);
            *value = steel_passes(1.5 * (1.0 - off2).max(0.0).sqrt());
        }
        let blurred = gaussian(&fine, w * FINE, h * FINE, blur_px * FINE as f64);
        for row in 0..h {
            for column in 0..w {
                let fine = |n: usize| blurred[(row * FINE + n / FINE) * w * FINE + column * FINE + n % FINE];
                let mean = (0..FINE * FINE).map(fine).sum::<f64>() / (FINE * FINE) as f64;
                all.pixels[(top as usize + row) * width + left as usize + column] *= mean;
            }
        }
    }
    all
}

/// Gaussian blur, the border repeated.
pub fn gaussian(values: &[f64], w: usize, h: usize, sigma: f64) -> Vec<f64> {
    let reach = (4.0 * sigma).ceil() as usize;
    let mut kernel: Vec<f64> = (0..=2 * reach).map(|n| (-0.5 * ((n as f64 - reach as f64) / sigma).powi(2)).exp()).collect();
    let sum: f64 = kernel.iter().sum();
    kernel.iter_mut().for_each(|weight| *weight /= sum);
    let mut across = vec![0.0; w * h];
    let mut padded = vec![0.0; w + 2 * reach];
    for row in 0..h {
        let line = &values[row * w..(row + 1) * w];
        for (n, value) in padded.iter_mut().enumerate() {
            *value = line[n.saturating_sub(reach).min(w - 1)];
        }
        for (column, out) in across[row * w..(row + 1) * w].iter_mut().enumerate() {
            *out = kernel.iter().zip(&padded[column..]).map(|(weight, value)| weight * value).sum();
        }
    }
    let mut down = vec![0.0; w * h];
    for row in 0..h {
        let out = &mut down[row * w..(row + 1) * w];
        for (n, weight) in kernel.iter().enumerate() {
            let from = (row + n).saturating_sub(reach).min(h - 1);
            for (value, source) in out.iter_mut().zip(&across[from * w..(from + 1) * w]) {
                *value += weight * source;
            }
        }
    }
    down
}

/// Counts around `expected`.
pub fn counted(expected: &Image<f64>, seed: u64) -> Image<f32> {
    let mut out = Image::filled(expected.width, expected.height, 0.0f32);
    for (n, (value, mean)) in out.pixels.iter_mut().zip(&expected.pixels).enumerate() {
        let mut random = Stream::new(seed, 41, n as u32, Purpose::Evaluation);
        *value = poisson(*mean, &mut random) as f32;
    }
    out
}

fn poisson(mean: f64, random: &mut Stream) -> f64 {
    if mean > 60.0 {
        // Second term of Cornish and Fisher: the skew of counts.
        let z = random.normal();
        return (mean + mean.sqrt() * z + (z * z - 1.0) / 6.0).round().max(0.0);
    }
    let limit = (-mean).exp();
    let (mut product, mut count) = (random.uniform(), 0.0);
    while product > limit {
        product *= random.uniform();
        count += 1.0;
    }
    count
}

/// Least standard deviation of (u, v) that an unbiased estimate can have (Cramér and Rao) from counts around one bead on a plane, when
/// radius, blur, attenuation and the plane are unknown too.
pub fn bound_px(quanta: f64, blur_px: f64, steel_per_mm: f64, side: usize) -> [f64; 2] {
    // u, v, radius, blur, attenuation; then level and two slopes in nepers.
    let middle = 0.5 * (side as f64 - 1.0);
    let truth = [middle + 0.13, middle - 0.21, RADIUS_PX, blur_px, steel_per_mm, 0.0, 0.0, 0.0];
    let draw = |p: &[f64; 8]| {
        let drawn = Drawn {
            columns: side,
            rows: side,
            quanta,
            blur_px: p[3],
            beads: vec![Sphere { u_px: p[0], v_px: p[1], radius_px: p[2] }],
            clutter: Clutter::None,
            // The thickness follows the drawn radius; here attenuation alone is free.
            steel: vec![(1.0, p[4] * RADIUS_PX / p[2])],
            tilt: (p[6], p[7]),
            lobes: [0.0; 4],
            lines: Vec::new(),
        };
        let level = (-p[5]).exp();
        drawn.expected().pixels.iter().map(|value| value * level).collect::<Vec<f64>>()
    };
    let mean = draw(&truth);
    let steps = [0.1, 0.1, 0.1, 0.05, 0.02, 0.01, 1e-4, 1e-4];
    let slopes: Vec<Vec<f64>> = (0..8)
        .map(|n| {
            let moved = |by: f64| {
                let mut p = truth;
                p[n] += by;
                draw(&p)
            };
            let (up, down) = (moved(steps[n]), moved(-steps[n]));
            up.iter().zip(&down).map(|(a, b)| (a - b) / (2.0 * steps[n])).collect()
        })
        .collect();
    let information =
        DMatrix::from_fn(8, 8, |i, j| slopes[i].iter().zip(&slopes[j]).zip(&mean).map(|((a, b), m)| a * b / m).sum::<f64>());
    let Some(factor) = information.cholesky() else { return [f64::NAN; 2] };
    [0, 1].map(|n| {
        let mut unit = DVector::zeros(8);
        unit[n] = 1.0;
        factor.solve(&unit)[n].sqrt()
    })
}
