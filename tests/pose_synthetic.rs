//! Radiographs of beads in closed form, for the tests of detection and pose: sphere chords along exact rays, three energies, blur,
//! Poisson noise, and in front of it things a pelvis shows: broad lobes, bones with rims, wires, a screw, a collimator.

use glam::{DVec2, DVec3};
use sidecarm::beads::{Bead, BeadLayout};
use sidecarm::geometry::{Intrinsics, Projection, Rigid, View};
use sidecarm::image::Image;
use sidecarm::random::{Purpose, Stream};

/// What is drawn.
#[derive(Clone, Debug)]
pub struct Radiograph {
    pub view: View,
    pub beads: Vec<(DVec3, f64)>,
    /// Detected photons a pixel with nothing in the beam; 0: no noise.
    pub photons: f64,
    pub blur_px: f64,
    pub anatomy: bool,
    pub metal: bool,
    pub collimated: bool,
    pub seed: u64,
}

/// Weight, attenuation of steel and of tissue-like paths (relative) of three energies.
const ENERGIES: [(f64, f64, f64); 3] = [(0.3, 0.55, 1.3), (0.4, 0.28, 1.0), (0.3, 0.16, 0.85)];

pub fn view(width: u32, height: u32, seed: u64) -> View {
    let mut random = Stream::new(seed, 0, 0, Purpose::Evaluation);
    let fx = 1020.0 / (300.0 / f64::from(width.max(height)));
    let mut normal = |s: f64| random.normal() * s;
    let turn = Rigid::exp(DVec3::new(normal(0.6), normal(0.6), normal(0.8)), DVec3::ZERO);
    let shift = Rigid::translation(DVec3::new(normal(6.0), normal(6.0), 680.0 + normal(30.0)));
    let intrinsics = Intrinsics {
        fx,
        fy: fx,
        skew: 0.0,
        cx: 0.5 * (f64::from(width) - 1.0) + normal(4.0),
        cy: 0.5 * (f64::from(height) - 1.0) + normal(4.0),
    };
    View { size_px: [width, height], intrinsics, camera_from_lps: shift * turn }
}

/// `count` beads in 120 × 120 × 100 mm about the origin, no two closer than 15 mm.
pub fn layout(count: usize, radius_mm: f64, seed: u64) -> BeadLayout {
    let mut random = Stream::new(seed, 1, 0, Purpose::Evaluation);
    let mut places: Vec<DVec3> = Vec::new();
    while places.len() < count {
        let mut side = |mm: f64| (random.uniform() - 0.5) * mm;
        let place = DVec3::new(side(120.0), side(120.0), side(100.0));
        if places.iter().all(|other| other.distance(place) > 15.0) {
            places.push(place);
        }
    }
    layout_of(&places, radius_mm)
}

pub fn layout_of(places: &[DVec3], radius_mm: f64) -> BeadLayout {
    let bead = |(n, lps_mm): (usize, &DVec3)| Bead { radius_mm: Some(radius_mm), ..Bead::new(format!("b{n}"), *lps_mm) };
    BeadLayout { beads: places.iter().enumerate().map(bead).collect(), source: "synthetic".to_owned(), ..BeadLayout::none() }
}

pub fn radiograph(view: View, layout: &BeadLayout, photons: f64, seed: u64) -> Radiograph {
    let beads = layout.beads.iter().map(|bead| (bead.lps_mm, bead.radius_mm.unwrap_or(0.75))).collect();
    Radiograph { view, beads, photons, blur_px: 0.6, anatomy: true, metal: true, collimated: false, seed }
}

impl Radiograph {
    /// Centres of the beads' projections.
    pub fn centres(&self) -> Vec<DVec2> {
        let projection: Projection = self.view.projection();
        self.beads.iter().map(|(p, _)| projection.project(*p).0).collect()
    }

    /// Transmission times photons (or times 1 without noise).
    pub fn draw(&self) -> Image<f32> {
        let [w, h] = self.view.size_px.map(|n| n as usize);
        let steel = self.steel_mm(w, h);
        let tissue = self.tissue(w, h);
        let mut clean = Image::filled(w, h, 0.0f32);
        for (n, out) in clean.pixels.iter_mut().enumerate() {
            let sum: f64 = ENERGIES
                .iter()
                .map(|(share, s, t)| share * (-s * f64::from(steel.pixels[n]) - t * f64::from(tissue.pixels[n])).exp())
                .sum();
            *out = sum as f32;
        }
        let blurred = blur(&clean, self.blur_px);
        if self.photons <= 0.0 {
            return blurred;
        }
        let mut noisy = blurred;
        for (n, out) in noisy.pixels.iter_mut().enumerate() {
            let mut random = Stream::new(self.seed, 7, n as u32, Purpose::Evaluation);
            *out = poisson(f64::from(*out) * self.photons, &mut random) as f32;
        }
        noisy
    }

    fn steel_mm(&self, w: usize, h: usize) -> Image<f32> {
        let mut image = Image::filled(w, h, 0.0f32);
        let source = self.view.source_in_lps();
        for ((centre, radius), at) in self.beads.iter().zip(self.centres()) {
            let depth = self.view.camera_from_lps.transform_point(*centre).z;
            if !(depth > 0.0) {
                continue;
            }
            let reach = (self.view.intrinsics.fx * radius / depth * 1.2 + 2.0).ceil();
            let (c0, c1) = ((at.x - reach).max(0.0) as usize, (at.x + reach).clamp(0.0, w as f64) as usize);
            let (r0, r1) = ((at.y - reach).max(0.0) as usize, (at.y + reach).clamp(0.0, h as f64) as usize);
            for row in r0..r1 {
                for column in c0..c1 {
                    const SUB: usize = 4;
                    let mut sum = 0.0;
                    for k in 0..SUB * SUB {
                        let offset = |i: usize| (i as f64 + 0.5) / SUB as f64 - 0.5;
                        let pixel = DVec2::new(column as f64 + offset(k % SUB), row as f64 + offset(k / SUB));
                        let ray = self.view.ray_in_lps(pixel).normalize();
                        let to = *centre - source;
                        let miss2 = to.length_squared() - to.dot(ray).powi(2);
                        sum += 2.0 * (radius * radius - miss2).max(0.0).sqrt();
                    }
                    image.pixels[row * w + column] += (sum / (SUB * SUB) as f64) as f32;
                }
            }
        }
        if self.metal {
            let scale = w as f64 / 620.0;
            // Two wires, a screw with a round head, a robot-like thick bar with a round end.
            let bars = [
                (0.1, 0.2, 0.7, 0.9, 2.2, 0.8),
                (0.9, 0.05, 0.55, 0.5, 1.5, 0.8),
                (0.12, 0.82, 0.3, 0.75, 6.0, 3.5),
                (0.97, 0.7, 0.7, 0.62, 14.0, 5.0),
            ];
            for (u0, v0, u1, v1, half, thick) in bars {
                let (a, b) = (DVec2::new(u0 * w as f64, v0 * h as f64), DVec2::new(u1 * w as f64, v1 * h as f64));
                for row in 0..h {
                    for column in 0..w {
                        let p = DVec2::new(column as f64, row as f64);
                        let t = ((p - a).dot(b - a) / (b - a).length_squared()).clamp(0.0, 1.0);
                        let d = (p - a - (b - a) * t).length() / (half * scale);
                        if d < 1.0 {
                            image.pixels[row * w + column] += (thick * (1.0 - d * d).sqrt()) as f32;
                        }
                    }
                }
            }
        }
        image
    }

    fn tissue(&self, w: usize, h: usize) -> Image<f32> {
        let mut image = Image::filled(w, h, 0.0f32);
        let mut random = Stream::new(self.seed, 3, 0, Purpose::Evaluation);
        let mut shapes = Vec::new();
        if self.anatomy {
            for n in 0..14 {
                let size = if n < 4 { 0.5 } else { 0.05 + 0.15 * random.uniform() };
                let amount = if n < 4 { 0.5 } else { 0.15 + 0.5 * random.uniform() };
                let inner = if n % 3 == 0 { 0.85 } else { 0.0 };
                shapes.push((
                    random.uniform(),
                    random.uniform(),
                    size,
                    0.5 + random.uniform(),
                    random.uniform() * 3.0,
                    amount,
                    inner,
                ));
            }
            // Gas bubbles: round, negative, of bead size and larger.
            for _ in 0..3 {
                shapes.push((
                    random.uniform(),
                    random.uniform(),
                    0.012 + 0.03 * random.uniform(),
                    1.2,
                    random.uniform(),
                    -0.12,
                    0.0,
                ));
            }
        }
        for row in 0..h {
            for column in 0..w {
                let mut sum = 0.3;
                for (u, v, size, aspect, angle, amount, inner) in &shapes {
                    let (x, y) =
                        ((column as f64 / w as f64 - u) / size, (row as f64 - v * h as f64) / w as f64 / (size * aspect));
                    let (sin, cos) = f64::sin_cos(*angle);
                    let d2 = (x * cos - y * sin).powi(2) + (x * sin + y * cos).powi(2);
                    let chord = |r: f64| if r > 0.0 { (r * r - d2).max(0.0).sqrt() } else { 0.0 };
                    sum += amount * (chord(1.0) - 0.6 * chord(*inner));
                }
                let outside = self.collimated
                    && !((0.08..0.9).contains(&(column as f64 / w as f64)) && (0.1..0.93).contains(&(row as f64 / h as f64)));
                image.pixels[row * w + column] = (sum.max(0.0) + if outside { 4.5 } else { 0.0 }) as f32;
            }
        }
        image
    }
}

/// Poisson: Knuth below 30, else the rounded normal approximation.
pub fn poisson(mean: f64, random: &mut Stream) -> f64 {
    if mean > 30.0 {
        return (mean + mean.sqrt() * random.normal()).round().max(0.0);
    }
    let limit = (-mean).exp();
    let (mut product, mut count) = (random.uniform(), 0.0);
    while product > limit {
        product *= random.uniform();
        count += 1.0;
    }
    count
}

fn blur(image: &Image<f32>, sigma: f64) -> Image<f32> {
    let kernel: Vec<f32> = (-3i32..=3).map(|n| (-0.5 * (f64::from(n) / sigma).powi(2)).exp() as f32).collect();
    let total: f32 = kernel.iter().sum();
    let (w, h) = (image.width as i64, image.height as i64);
    let pass = |from: &Image<f32>, dx: i64, dy: i64| {
        let mut out = from.clone();
        for row in 0..h {
            for column in 0..w {
                let sum: f32 = (0..7i64)
                    .map(|n| {
                        let (c, r) = ((column + (n - 3) * dx).clamp(0, w - 1), (row + (n - 3) * dy).clamp(0, h - 1));
                        kernel[n as usize] * from.pixels[(r * w + c) as usize]
                    })
                    .sum();
                out.pixels[(row * w + column) as usize] = sum / total;
            }
        }
        out
    };
    pass(&pass(image, 1, 0), 0, 1)
}

/// An 8-bit picture as a console shows it: windowed logarithm, metal dark or bright, clipped at both ends.
pub fn display(transmission: &Image<f32>, photons: f64, metal_bright: bool) -> Image<f32> {
    let scale = if photons > 0.0 { photons as f32 } else { 1.0 };
    let mut logs: Vec<f32> = transmission
        .pixels
        .iter()
        .map(|v| -(v.max(0.5 * scale.recip().min(1.0) * scale.min(1.0)) / scale).max(1e-4).ln())
        .collect();
    let mut sorted = logs.clone();
    sorted.sort_by(f32::total_cmp);
    let (low, high) = (sorted[sorted.len() / 100], sorted[sorted.len() - 1 - sorted.len() / 200]);
    for value in &mut logs {
        let t = ((*value - low) / (high - low)).clamp(0.0, 1.0);
        *value = (255.0 * if metal_bright { t } else { 1.0 - t }).round();
    }
    Image { width: transmission.width, height: transmission.height, pixels: logs }
}
