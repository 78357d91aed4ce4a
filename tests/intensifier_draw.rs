//! Frames of a grid as an image intensifier shows them, drawn from a law of its own: no polynomial, and no code of `calibrate`.

use glam::DVec2;
use sidecarm::acquire::{Domain, Frame};
use sidecarm::image::Image;
use sidecarm::random::{Purpose, Stream};

/// From the picture as it is to where it would be without distortion: pincushion of a round input (arc tangent), an S whose turn grows
/// with r³, and a bend to one side.
#[derive(Clone, Copy, Debug)]
pub struct Law {
    pub centre: DVec2,
    pub radius_px: f64,
    /// Overall strength, such that the mean over the disc is what is asked for.
    pub strength: f64,
    pub curvature: f64,
    /// Turn at the rim.
    pub s_rad: f64,
    /// Length of the bend, px, its direction and phase.
    pub bend: (f64, f64, f64),
}

impl Law {
    pub fn undistorted(&self, p: DVec2) -> DVec2 {
        let x = (p - self.centre) / self.radius_px;
        let r = x.length();
        let a = self.curvature * self.strength.max(0.0).sqrt();
        let shrink = if r > 1e-12 { (a * r).atan() / (a * r) } else { 1.0 };
        let turn = self.s_rad * self.strength * r.powi(3);
        let (length, direction, phase) = self.bend;
        let along = x.dot(DVec2::from_angle(direction + 1.0));
        let bend = self.strength * length * ((2.2 * along + phase).sin() - phase.sin() - 2.2 * along * phase.cos());
        self.centre + self.radius_px * DVec2::from_angle(turn).rotate(shrink * x) + bend * DVec2::from_angle(direction)
    }

    /// Places all over the disc, evenly.
    pub fn places(&self, reach: f64) -> impl Iterator<Item = DVec2> {
        let (centre, radius) = (self.centre, reach * self.radius_px);
        (0..2000).map(move |n| centre + radius * (f64::from(n) / 2000.0).sqrt() * DVec2::from_angle(2.399_963 * f64::from(n)))
    }

    pub fn mean_px(&self) -> f64 {
        self.places(1.0).map(|p| self.undistorted(p).distance(p)).sum::<f64>() / 2000.0
    }

    /// The law whose mean over the disc is `mean_px`.
    pub fn of_mean(self, mean_px: f64) -> Self {
        let (mut low, mut high) = (0.0, 30.0);
        for _ in 0..60 {
            let middle = 0.5 * (low + high);
            if (Self { strength: middle, ..self }).mean_px() < mean_px { low = middle } else { high = middle }
        }
        Self { strength: high, ..self }
    }
}

/// A plate, an intensifier and a noise.
#[derive(Clone, Debug)]
pub struct Drawn {
    pub size: usize,
    pub law: Law,
    pub holes: bool,
    pub pitch_px: f64,
    pub turn_rad: f64,
    pub origin: DVec2,
    pub spot_px: f64,
    pub missing: f64,
    /// Spots that are no node, in undistorted pixels.
    pub false_spots: Vec<DVec2>,
    pub quanta: f64,
    pub seed: u64,
}

impl Drawn {
    /// Everything at random: `size` columns and rows.
    pub fn random(seed: u64, size: usize) -> Self {
        let mut random = Stream::new(seed, 50, 0, Purpose::Evaluation);
        let mut within = |low: f64, high: f64| low + (high - low) * random.uniform();
        let side = size as f64;
        let centre = DVec2::splat(0.5 * side) + DVec2::new(within(-4.0, 4.0), within(-4.0, 4.0));
        let law = Law {
            centre,
            radius_px: within(0.465, 0.485) * side,
            strength: 1.0,
            curvature: within(0.4, 0.6),
            s_rad: within(-0.05, 0.05),
            bend: (within(0.5, 2.0), within(0.0, std::f64::consts::TAU), within(0.0, std::f64::consts::TAU)),
        }
        .of_mean(11.0);
        let pitch_px = if size <= 512 { within(20.0, 25.0) } else { within(32.0, 44.0) };
        let spots = (std::f64::consts::PI * (law.radius_px / pitch_px).powi(2)) as usize;
        let false_spots = (0..spots / 20).map(|_| centre + DVec2::new(within(-0.45, 0.45), within(-0.45, 0.45)) * side).collect();
        Self {
            size,
            law,
            holes: false,
            pitch_px,
            turn_rad: within(-std::f64::consts::PI, std::f64::consts::PI),
            origin: centre + DVec2::new(within(-20.0, 20.0), within(-20.0, 20.0)),
            spot_px: within(0.13, 0.18) * pitch_px,
            missing: 0.07,
            false_spots,
            quanta: within(800.0, 4000.0),
            seed,
        }
    }

    fn is_missing(&self, node: DVec2) -> bool {
        let key = (node.x as i32 as u32).wrapping_mul(7919).wrapping_add(node.y as i32 as u32);
        Stream::new(self.seed, 51, key, Purpose::Evaluation).uniform() < self.missing
    }

    /// Signal at a place without distortion, 1 for open air.
    fn plate(&self, q: DVec2) -> f64 {
        let cells = DVec2::from_angle(-self.turn_rad).rotate(q - self.origin) / self.pitch_px;
        let node = cells.round();
        let near = |off_px: f64| off_px < self.spot_px;
        let mut off_px = (cells - node).length() * self.pitch_px;
        if near(off_px) && self.is_missing(node) {
            off_px = f64::INFINITY;
        }
        for spot in &self.false_spots {
            off_px = off_px.min(spot.distance(q));
        }
        match (near(off_px), self.holes) {
            (true, false) => (-1.8 * (1.0 - (off_px / self.spot_px).powi(2)).sqrt()).exp(),
            (true, true) => 1.0,
            (false, false) => 1.0,
            (false, true) => 0.04,
        }
    }

    pub fn frame(&self) -> Frame {
        let size = self.size;
        let fine = 3;
        let value = |index: usize| {
            let (column, row) = ((index % size) as f64, (index / size) as f64);
            let mut sum = 0.0;
            for n in 0..fine * fine {
                let offset = |n: usize| (n as f64 + 0.5) / fine as f64 - 0.5;
                let p = DVec2::new(column + offset(n % fine), row + offset(n / fine));
                if p.distance(self.law.centre) <= self.law.radius_px {
                    let x = (p - self.law.centre) / self.law.radius_px;
                    let vignette = 1.0 - 0.25 * x.length_squared() + 0.06 * x.x;
                    sum += vignette * self.plate(self.law.undistorted(p));
                }
            }
            sum / (fine * fine) as f64
        };
        let sharp: Vec<f64> = (0..size * size).map(value).collect();
        let blurred = blurred(&blurred(&sharp, size, 1), size, size);
        let noisy = |(index, value): (usize, &f64)| {
            let mut random = Stream::new(self.seed, 52, index as u32, Purpose::Evaluation);
            ((value * self.quanta + (value * self.quanta).sqrt() * random.normal() + 3.0 * random.normal()).max(0.0)).round()
                as f32
        };
        let pixels = Image { width: size, height: size, pixels: blurred.iter().enumerate().map(noisy).collect() };
        Frame::from_pixels(&format!("grid-{}", self.seed), pixels, Domain::Linear).expect("a frame")
    }
}

/// A Gaussian of 0.8 px along one axis; `step` is 1 along rows, the width along columns.
fn blurred(values: &[f64], width: usize, step: usize) -> Vec<f64> {
    let kernel: Vec<f64> = (-4..=4).map(|n: i32| (-0.5 * (f64::from(n) / 0.8).powi(2)).exp()).collect();
    let total: f64 = kernel.iter().sum();
    let at = |index: usize| {
        let place = if step == 1 { index % width } else { index / width } as isize;
        let weigh = |(n, weight): (usize, &f64)| {
            let to = (place + n as isize - 4).clamp(0, width as isize - 1);
            weight * values[(index as isize + (to - place) * step as isize) as usize]
        };
        kernel.iter().enumerate().map(weigh).sum::<f64>() / total
    };
    (0..values.len()).map(at).collect()
}

/// Root mean square distance of `found` from `truth` after the similarity that brings them closest: turn, scale and place of a picture
/// without distortion are convention.
pub fn rms_apart(pairs: &[(DVec2, DVec2)]) -> f64 {
    let count = pairs.len() as f64;
    let mean = |of: fn(&(DVec2, DVec2)) -> DVec2| pairs.iter().map(of).sum::<DVec2>() / count;
    let (a, b) = (mean(|pair| pair.0), mean(|pair| pair.1));
    let (mut dot, mut cross, mut square) = (0.0, 0.0, 0.0);
    for (found, truth) in pairs {
        let (x, y) = (*found - a, *truth - b);
        dot += x.dot(y);
        cross += x.perp_dot(y);
        square += x.length_squared();
    }
    let turned = |x: DVec2| DVec2::new(dot * x.x - cross * x.y, cross * x.x + dot * x.y) / square;
    (pairs.iter().map(|(found, truth)| (turned(*found - a) + b - *truth).length_squared()).sum::<f64>() / count).sqrt()
}
