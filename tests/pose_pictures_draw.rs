//! Radiographs of steel spheres as rooms and consoles make them: over a pelvis, bone edges, wires, screws and rods, behind shutters, with text,
//! at 6 to 20 000 quanta, in every kind of values. Chords along exact rays and closed forms: no code of the renderer.

use std::f64::consts::PI;

use glam::{DVec2, DVec3};
use sidecarm::acquire::{Clipping, Domain, Frame};
use sidecarm::geometry::{Intrinsics, Projection};
use sidecarm::image::Image;
use sidecarm::random::{Purpose, Stream};

use crate::beads_drawn::{gaussian, steel_passes};
use crate::beads_varied::{CLEAR_SNR, CLEAR_STEPS, FREE_PX, PLAIN_NEPERS};
use crate::mask_matter::Matter;
use crate::pose_mistakes::Draw;
use crate::pose_pictures_scenery::{Opening, Shutters, edges, metal, pelvis, write};
use crate::pose_synthetic::poisson;

/// Samples a pixel within a sphere's shadow, along each axis.
const FINE: usize = 4;
/// Blur of the noise that a console leaves.
const SMOOTHED_PX: f64 = 0.8;
/// Share of equal pixels from which on the picture's own extreme is an end of its scale.
const PLATEAU_SHARE: f64 = 1e-3;

/// A steel sphere in the beam.
#[derive(Clone, Copy, Debug)]
pub struct Ball {
    /// In the camera.
    pub centre_mm: DVec3,
    pub radius_mm: f64,
}

/// How quanta become values.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Values {
    /// Floats, offset corrected: noise about zero where nothing arrives.
    Linear,
    /// 16 bits without a sign.
    Words,
    Nepers,
    /// Eight bits for eyes, metal dark.
    Display,
    /// The same, metal bright.
    Inverted,
}

/// How a picture looks besides its spheres.
#[derive(Clone, Copy, Debug)]
pub struct Looks {
    /// Detected a pixel beside a usual bead.
    pub quanta: f64,
    pub blur_px: f64,
    pub is_smoothed: bool,
    pub values: Values,
    pub shutters: Shutters,
    /// Behind the shutters there is NaN, or black, instead of what is measured there.
    pub is_blank_behind: bool,
    pub has_pelvis: bool,
    /// Rims of bones.
    pub has_edges: bool,
    /// Wires, a screw, a rod.
    pub has_metal: bool,
    pub has_text: bool,
}

impl Looks {
    /// A well exposed picture of a pelvis and nothing else.
    pub const PLAIN: Self = Self {
        quanta: 2000.0,
        blur_px: 1.0,
        is_smoothed: false,
        values: Values::Linear,
        shutters: Shutters::Open,
        is_blank_behind: false,
        has_pelvis: true,
        has_edges: false,
        has_metal: false,
        has_text: false,
    };

    pub fn drawn(draw: &mut Draw) -> Self {
        Self {
            quanta: draw.between(6f64.ln(), 20_000f64.ln()).exp(),
            blur_px: draw.between(0.8, 1.6),
            is_smoothed: draw.chance(0.4),
            values: draw.one_of(&[
                Values::Linear,
                Values::Linear,
                Values::Words,
                Values::Nepers,
                Values::Display,
                Values::Inverted,
            ]),
            shutters: draw.one_of(&[Shutters::Open, Shutters::Round, Shutters::Rectangle, Shutters::Rotated]),
            is_blank_behind: draw.chance(0.35),
            has_pelvis: draw.chance(0.7),
            has_edges: draw.chance(0.4),
            has_metal: draw.chance(0.4),
            has_text: draw.chance(0.3),
        }
    }
}

/// What can be seen of a sphere.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Sight {
    /// Outside the frame or behind a shutter.
    Hidden,
    Poor,
    Clear,
}

/// What a console did to the picture before it was stored.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Console {
    AsTaken,
    Mirrored,
    QuarterTurn,
    HalfTurn,
}

impl Console {
    /// Where the pixels of a picture of `taken_px` columns and rows are stored, homogeneous rows.
    fn stored_from_taken(self, taken_px: [usize; 2]) -> [[f64; 3]; 2] {
        let [right, bottom] = taken_px.map(|n| n as f64 - 1.0);
        match self {
            Self::AsTaken => [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0]],
            Self::Mirrored => [[-1.0, 0.0, right], [0.0, 1.0, 0.0]],
            Self::QuarterTurn => [[0.0, -1.0, bottom], [1.0, 0.0, 0.0]],
            Self::HalfTurn => [[-1.0, 0.0, right], [0.0, -1.0, bottom]],
        }
    }

    /// P of the stored picture; of a mirrored one it is no camera's.
    pub fn projection(self, taken: &Projection, taken_px: [usize; 2]) -> Projection {
        let Projection(rows) = taken;
        let row = |of: [f64; 3]| -> [f64; 4] { std::array::from_fn(|column| (0..3).map(|n| of[n] * rows[n][column]).sum()) };
        let [first, second] = self.stored_from_taken(taken_px);
        Projection([row(first), row(second), rows[2]])
    }

    fn store(self, taken: &Image<f32>) -> Image<f32> {
        let (w, h) = (taken.width, taken.height);
        let (width, height) = if self == Self::QuarterTurn { (h, w) } else { (w, h) };
        let from = |(column, row): (usize, usize)| match self {
            Self::AsTaken => (column, row),
            Self::Mirrored => (w - 1 - column, row),
            Self::QuarterTurn => (row, h - 1 - column),
            Self::HalfTurn => (w - 1 - column, h - 1 - row),
        };
        let pixel = |n: usize| {
            let (column, row) = from((n % width, n / width));
            *taken.at(column, row)
        };
        Image { width, height, pixels: (0..width * height).map(pixel).collect() }
    }
}

/// What one sphere lets pass, integrated over pixels and blurred.
fn cast(all: &mut Image<f64>, k: &Intrinsics, ball: &Ball, blur_px: f64) {
    let at = k.project(ball.centre_mm);
    let reach_px = (1.2 * k.fx * ball.radius_mm / ball.centre_mm.z + 4.0 * blur_px + 2.0).ceil();
    let range = |at: f64, end: usize| {
        let [first, last] = [at - reach_px, at + reach_px + 1.0].map(|x| x.clamp(0.0, end as f64) as usize);
        (first, last - first)
    };
    let ((left, w), (top, h)) = (range(at.x, all.width), range(at.y, all.height));
    if w == 0 || h == 0 {
        return;
    }
    let place = |first: usize, n: usize| first as f64 + (n as f64 + 0.5) / FINE as f64 - 0.5;
    let passes = |n: usize| {
        let ray = k.unproject(DVec2::new(place(left, n % (w * FINE)), place(top, n / (w * FINE)))).normalize();
        let miss2_mm2 = ball.centre_mm.length_squared() - ball.centre_mm.dot(ray).powi(2);
        steel_passes(2.0 * (ball.radius_mm.powi(2) - miss2_mm2).max(0.0).sqrt())
    };
    let sharp: Vec<f64> = (0..w * FINE * h * FINE).map(passes).collect();
    let blurred = gaussian(&sharp, w * FINE, h * FINE, blur_px * FINE as f64);
    for row in 0..h {
        for column in 0..w {
            let fine = |n: usize| blurred[(row * FINE + n / FINE) * w * FINE + column * FINE + n % FINE];
            *all.at_mut(left + column, top + row) *= (0..FINE * FINE).map(fine).sum::<f64>() / (FINE * FINE) as f64;
        }
    }
}

/// From quanta to values.
struct Tone {
    values: Values,
    air: f64,
    gain: f64,
    pedestal: f64,
    /// Share of the air's quanta that is shown white, and how the rest is shown.
    white: f64,
    exponent: f64,
}

impl Tone {
    fn drawn(values: Values, air: f64, usual: f64, draw: &mut Draw) -> Self {
        let gain = if values == Values::Words { draw.between(20_000.0, 60_000.0) / air } else { draw.one_of(&[1.0, 1.0 / air]) };
        let (pedestal, exponent) = (draw.one_of(&[0.0, 0.0, 100.0, 4000.0]), draw.between(0.4, 1.0));
        Self { values, air, gain, pedestal, white: (usual * draw.between(1.5, 5.0)).min(1.2), exponent }
    }

    fn value(&self, quanta: f64) -> f32 {
        match self.values {
            Values::Linear => (self.gain * quanta) as f32,
            Values::Words => (self.gain * quanta + self.pedestal).round().clamp(0.0, 65_535.0) as f32,
            Values::Nepers => -((quanta / self.air).ln() as f32),
            Values::Display | Values::Inverted => {
                let shade = 255.0 * (quanta / (self.air * self.white)).clamp(0.0, 1.0).powf(self.exponent);
                (if self.values == Values::Inverted { 255.0 - shade } else { shade }).round() as f32
            }
        }
    }

    /// Largest and smallest value that can be stored, where there is one.
    fn ends(&self) -> Option<[f32; 2]> {
        match self.values {
            Values::Linear | Values::Nepers => None,
            Values::Words => Some([0.0, 65_535.0]),
            Values::Display | Values::Inverted => Some([0.0, 255.0]),
        }
    }

    /// Values that can be told apart between the two.
    fn steps(&self, some: f64, other: f64) -> f64 {
        if self.ends().is_some() { f64::from((self.value(some) - self.value(other)).abs()) } else { f64::INFINITY }
    }
}

/// A picture, and what can be seen of each sphere.
pub struct Taken {
    pixels: Image<f32>,
    values: Values,
    ends: Option<[f32; 2]>,
    pub sight: Vec<Sight>,
}

impl Taken {
    /// As a reader gives what the console stored.
    pub fn frame(&self, console: Console) -> Frame {
        let domain = match self.values {
            Values::Linear | Values::Words => Domain::Linear,
            Values::Nepers => Domain::Log,
            Values::Display | Values::Inverted => Domain::Display,
        };
        let mut frame = Frame::from_pixels("drawn", console.store(&self.pixels), domain).expect("a frame");
        if domain == Domain::Log {
            frame.unit = Some("neper".to_owned());
        }
        if let Some(ends) = self.ends {
            frame.clipping = clipping(&self.pixels, ends);
        }
        frame
    }
}

/// What the readers of integers say of the ends of the scale.
fn clipping(pixels: &Image<f32>, [least, most]: [f32; 2]) -> Clipping {
    let (low, high) = pixels.pixels.iter().fold((f32::MAX, f32::MIN), |(low, high), &value| (low.min(value), high.max(value)));
    if !(low < high) {
        return Clipping::default();
    }
    let at = |end: f32, of_scale: f32| {
        let share = pixels.pixels.iter().filter(|value| **value == end).count() as f64 / pixels.pixels.len() as f64;
        if end == of_scale || share >= PLATEAU_SHARE { (share, Some(end)) } else { (0.0, None) }
    };
    let ((black_share, black_at), (saturated_share, saturated_at)) = (at(low, least), at(high, most));
    Clipping { saturated_share, saturated_at, black_share, black_at }
}

/// Takes the picture of `balls` with a camera of `k`.
pub fn take(looks: &Looks, k: &Intrinsics, [width, height]: [usize; 2], balls: &[Ball], seed: u64) -> Taken {
    let mut draw = Draw(Stream::new(seed, 96, 0, Purpose::Evaluation));
    let size = DVec2::new(width as f64 - 1.0, height as f64 - 1.0);
    let opening = Opening::drawn(looks.shutters, size, &mut draw);
    let mut matter: Vec<Matter> = Vec::new();
    if looks.has_pelvis {
        matter.extend(pelvis(size, &mut draw));
    }
    if looks.has_edges {
        matter.extend(edges(size, &mut draw));
    }
    if looks.has_metal {
        matter.extend(metal(size, &mut draw));
    }
    let nepers = |x: DVec2| matter.iter().map(|part| part.nepers(x)).sum::<f64>().max(0.0);
    let pixel = |n: usize| DVec2::new((n % width) as f64, (n / width) as f64);
    let sharp: Vec<f64> = (0..width * height).map(|n| (-nepers(pixel(n))).exp()).collect();
    let passed = gaussian(&sharp, width, height, looks.blur_px);
    let mut shade = Image::filled(width, height, 1.0);
    balls.iter().for_each(|ball| cast(&mut shade, k, ball, looks.blur_px));

    let centres: Vec<DVec2> = balls.iter().map(|ball| k.project(ball.centre_mm)).collect();
    let border_px = |x: DVec2| x.min(size - x).min_element();
    let mut beside: Vec<f64> = centres.iter().filter(|x| border_px(**x) >= 0.0).map(|x| (-nepers(*x)).exp()).collect();
    beside.sort_by(f64::total_cmp);
    let usual = beside.get(beside.len() / 2).copied().unwrap_or(1.0).max(0.02);
    let (air, mean) = (looks.quanta / usual, passed.iter().sum::<f64>() / passed.len() as f64);
    let (leak, scatter) = (draw.between(0.0, 0.003), draw.between(0.0, 0.08));
    let readout = draw.between(0.3f64.ln(), 5f64.ln()).exp().min(0.5 + 0.1 * looks.quanta);
    let expected = |x: DVec2, passed: f64| {
        let open = opening.share(x);
        air * (passed * (open + leak * (1.0 - open)) + mean * scatter * open)
    };
    let mut quanta: Vec<f64> = (0..width * height).map(|n| expected(pixel(n), passed[n] * shade.pixels[n])).collect();
    let mut noise = vec![0.0f64; width * height];
    for (row, (noise, quanta)) in noise.chunks_mut(width).zip(quanta.chunks(width)).enumerate() {
        let mut random = Stream::new(seed, 97, row as u32, Purpose::QuantumNoise);
        for (noise, mean) in noise.iter_mut().zip(quanta) {
            *noise = poisson(*mean, &mut random) - mean + readout * random.normal();
        }
    }
    if looks.is_smoothed {
        noise = gaussian(&noise, width, height, SMOOTHED_PX);
    }
    quanta.iter_mut().zip(&noise).for_each(|(quanta, noise)| *quanta += noise);

    let tone = Tone::drawn(looks.values, air, usual, &mut draw);
    let mut pixels = Image { width, height, pixels: quanta.iter().map(|quanta| tone.value(*quanta)).collect() };
    if looks.is_blank_behind {
        let blank = if tone.ends().is_some() { 0.0 } else { f32::NAN };
        let is_shut = |n: usize| opening.depth_px(pixel(n)) < -0.5 * opening.penumbra_px;
        pixels.pixels.iter_mut().enumerate().filter(|(n, _)| is_shut(*n)).for_each(|(_, value)| *value = blank);
    }
    let mut written = Vec::new();
    if looks.has_text {
        let finite = pixels.pixels.iter().copied().filter(|value| value.is_finite());
        let (least, most) =
            finite.fold((f32::INFINITY, f32::NEG_INFINITY), |(low, high), value| (low.min(value), high.max(value)));
        for ink in [most, least] {
            written.push(write(&mut pixels, ink, &mut draw));
        }
    }

    let radius_px = |ball: &Ball| k.fx * ball.radius_mm / ball.centre_mm.z;
    let sight = |(own, ball): (usize, &Ball)| {
        let (at, radius) = (centres[own], radius_px(ball));
        if !(border_px(at) >= 0.0 && opening.depth_px(at) > 0.0) {
            return Sight::Hidden;
        }
        let beam = (-nepers(at)).exp();
        let (beside, shaded) = (expected(at, beam), expected(at, beam * steel_passes(2.0 * ball.radius_mm)));
        let snr = (beside - shaded) / (shaded + readout * readout).sqrt() * (PI * radius * radius).sqrt();
        let around = (0..32).map(|n| nepers(at + DVec2::from_angle(0.4 * f64::from(n)) * radius * f64::from(n) / 16.0));
        let (thin, thick) = around.fold((f64::INFINITY, f64::NEG_INFINITY), |(low, high), x| (low.min(x), high.max(x)));
        let writing = written.iter().map(|[first, last]| (*first - at).max(at - *last).max(DVec2::ZERO).length());
        let others = (0..balls.len()).filter(|n| *n != own).map(|n| centres[n].distance(at) - radius_px(&balls[n]));
        let shutter_px = opening.depth_px(at) - 0.5 * opening.penumbra_px;
        let nearest_px = writing.chain(others).fold(border_px(at).min(shutter_px), f64::min);
        let stands_out = snr >= CLEAR_SNR && thick - thin < PLAIN_NEPERS && tone.steps(beside, shaded) >= CLEAR_STEPS;
        if stands_out && nearest_px - radius >= FREE_PX { Sight::Clear } else { Sight::Poor }
    };
    let sight = balls.iter().enumerate().map(sight).collect();
    Taken { pixels, values: looks.values, ends: tone.ends(), sight }
}
