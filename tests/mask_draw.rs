//! Drawn radiographs whose open field is known: every kind of shutter over pelvis-like backgrounds, in every domain that frames come in.
//! Shares nothing with the detector but the image type and the random streams.

use glam::DVec2;
use rayon::prelude::*;
use sidecarm::image::Image;
use sidecarm::mask::{FieldShape, HalfPlane};
use sidecarm::random::{Purpose, Stream};

use crate::beads_drawn::{Sphere, shade, steel_passes};
use crate::mask_blades::{Blades, seen_blades};
use crate::mask_matter::draw_anatomy;

/// A frame and what is true about it.
pub struct Drawn {
    pub pixels: Image<f32>,
    pub larger_is_more_attenuation: bool,
    pub shape: &'static str,
    pub domain: &'static str,
    /// Signed distance in pixels to where the blades let half of the beam pass, positive in the open field; absent without blades.
    pub depth_px: Option<Image<f32>>,
    /// From fully shut to fully open.
    pub penumbra_px: f64,
    /// Along half of the edge or more, inside and outside cannot be told apart on 8 × 8 pixels.
    pub faint: bool,
    /// The straight blades: what telemetry would tell.
    pub told: FieldShape,
    /// Which parts and numbers were drawn, for people.
    pub note: String,
    /// Beads in the beam, where they were asked for.
    pub beads: Vec<DrawnBead>,
}

/// A steel sphere in the beam, and how well its shadow stands out.
#[derive(Clone, Copy, Debug)]
pub struct DrawnBead {
    pub sphere: Sphere,
    /// Expected quanta a pixel where it stands, without it.
    pub quanta: f64,
    /// Quanta that it takes at its middle over their deviation there, times √(pixels of its shadow).
    pub snr: f64,
    /// What it changes at its middle, in steps between neighbouring values, where those are coarse.
    pub steps: f64,
    /// Nepers between the thickest and the thinnest that lies in front of it, within two radii.
    pub relief: f64,
    /// From the shadow's rim to the nearest of: half of the beam, the frame's border, writing.
    pub free_px: f64,
}

/// Uniform numbers of one seed.
pub struct Draw(Stream);

impl Draw {
    pub fn between(&mut self, low: f64, high: f64) -> f64 {
        low + (high - low) * self.0.uniform()
    }

    pub fn log(&mut self, low: f64, high: f64) -> f64 {
        self.between(low.ln(), high.ln()).exp()
    }

    pub fn chance(&mut self, share: f64) -> bool {
        self.0.uniform() < share
    }

    pub fn count(&mut self, least: usize, most: usize) -> usize {
        least + (self.0.next_u32() as usize) % (most - least + 1)
    }

    pub fn pick<T: Copy>(&mut self, from: &[T]) -> T {
        from[(self.0.next_u32() as usize) % from.len()]
    }

    /// A point of the frame, or up to `beyond` of its size outside it.
    pub fn place(&mut self, size: DVec2, beyond: f64) -> DVec2 {
        DVec2::new(self.between(-beyond, 1.0 + beyond), self.between(-beyond, 1.0 + beyond)) * size
    }

    pub fn direction(&mut self) -> DVec2 {
        DVec2::from_angle(self.between(0.0, std::f64::consts::TAU))
    }
}

/// A Poisson number of this mean.
fn poisson(mean: f64, stream: &mut Stream) -> f64 {
    if mean > 30.0 {
        return (mean + mean.sqrt() * stream.normal()).round().max(0.0);
    }
    let (mut share, mut term, mut count) = (stream.uniform(), (-mean).exp(), 0.0);
    while share > term && count < 200.0 {
        share -= term;
        count += 1.0;
        term *= mean / count;
    }
    count
}

/// How quanta become pixel values.
enum Domain {
    Linear { gain: f64, pedestal: f64 },
    Words { gain: f64, pedestal: f64 },
    Nepers,
    Clamped { floor: f64 },
    Display { white: f64, exponent: f64, inverted: bool },
}

impl Domain {
    /// `quanta` may be negative: readout noise; `air` is the open beam's number.
    fn value(&self, quanta: f64, air: f64) -> f32 {
        match *self {
            Self::Linear { gain, pedestal } => (gain * quanta + pedestal) as f32,
            Self::Words { gain, pedestal } => (gain * quanta + pedestal).round().clamp(0.0, 65535.0) as f32,
            Self::Nepers => -((quanta / air).ln() as f32),
            Self::Clamped { floor } => -((quanta.max(floor) / air).ln() as f32),
            Self::Display { white, exponent, inverted } => {
                let shade = 255.0 * (quanta / (air * white)).clamp(0.0, 1.0).powf(exponent);
                (if inverted { 255.0 - shade } else { shade }).round() as f32
            }
        }
    }

    /// Values closer than this cannot be told apart.
    fn step(&self) -> f32 {
        match self {
            Self::Words { .. } | Self::Display { .. } => 3.0,
            _ => 0.0,
        }
    }
}

/// Letters of 5 × 7 dots, some with a plate behind them, near the border.
///
/// Gives the first and the last of its pixels.
fn burn_text(draw: &mut Draw, pixels: &mut Image<f32>, ink: f32) -> [DVec2; 2] {
    let dot = draw.count(1, 1 + pixels.width.min(pixels.height) / 300);
    let letters = draw.count(1, 12);
    let (width, height) = (6 * dot * letters, 7 * dot);
    let (free_x, free_y) = (pixels.width.saturating_sub(width + 8), pixels.height.saturating_sub(height + 8));
    let left = 4 + draw.pick(&[0, free_x, free_x / 2]);
    let top = 4 + draw.pick(&[0, free_y, free_y / 8]);
    for letter in 0..letters {
        for bit in 0..35 {
            if !draw.chance(0.5) {
                continue;
            }
            for v in 0..dot {
                for u in 0..dot {
                    let (column, row) = (left + (letter * 6 + bit % 5) * dot + u, top + bit / 5 * dot + v);
                    if column < pixels.width && row < pixels.height {
                        *pixels.at_mut(column, row) = ink;
                    }
                }
            }
        }
    }
    [DVec2::new(left as f64, top as f64), DVec2::new((left + width) as f64, (top + height) as f64)]
}

fn smooth(share: f64) -> f64 {
    let share = share.clamp(0.0, 1.0);
    share * share * (3.0 - 2.0 * share)
}

fn draw_size(draw: &mut Draw) -> (usize, usize) {
    let width = draw.log(200.0, 1536.0) as usize;
    let height = if draw.chance(0.5) { width } else { (width as f64 * draw.between(0.65, 1.5)).clamp(200.0, 1536.0) as usize };
    (width, height)
}

/// Columns and rows of `draw_frame`'s frame.
pub fn frame_size(seed: u64, collimated: bool) -> (usize, usize) {
    draw_size(&mut Draw(Stream::new(seed, u32::from(collimated), 0, Purpose::Evaluation)))
}

/// The frame of `seed`, with or without blades.
pub fn draw_frame(seed: u64, collimated: bool) -> Drawn {
    draw(seed, collimated, false)
}

/// The same with six to fourteen beads, and nothing else that is round and of metal.
pub fn draw_beaded_frame(seed: u64, collimated: bool) -> Drawn {
    draw(seed, collimated, true)
}

/// Spheres that lie beside each other, of one size or nearly so.
fn draw_spheres(seed: u64, size: DVec2) -> Vec<Sphere> {
    let mut draw = Draw(Stream::new(seed, 4, 0, Purpose::Evaluation));
    let (count, radius) = (draw.count(6, 14), draw.log(2.5, 9.0));
    let mut spheres: Vec<Sphere> = Vec::new();
    for _ in 0..400 {
        let (place, radius_px) = (draw.place(size, 0.0), radius * draw.between(0.93, 1.07));
        let apart = |other: &Sphere| DVec2::new(other.u_px, other.v_px).distance(place) > 6.0 * radius;
        if spheres.len() < count && spheres.iter().all(apart) {
            spheres.push(Sphere { u_px: place.x, v_px: place.y, radius_px });
        }
    }
    spheres
}

fn draw(seed: u64, collimated: bool, beaded: bool) -> Drawn {
    let mut draw = Draw(Stream::new(seed, u32::from(collimated), 0, Purpose::Evaluation));
    let (width, height) = draw_size(&mut draw);
    let size = DVec2::new(width as f64 - 1.0, height as f64 - 1.0);
    let (shape, blades) = if collimated { seen_blades(&mut draw, size) } else { ("open", Blades::none()) };
    let penumbra_px = if draw.chance(0.2) { 0.0 } else { draw.between(0.5, 20.0) * (width.min(height) as f64 / 600.0).min(1.0) };
    let mut anatomy = draw_anatomy(&mut draw, size);
    let spheres = if beaded { draw_spheres(seed, size) } else { Vec::new() };
    anatomy.retain(|part| !beaded || !part.is_round_metal());
    let shade = beaded.then(|| shade(width, height, &spheres, 0.5 + 0.5 * (seed % 7) as f64 / 6.0));
    let air = draw.log(5.0, 1e5);
    let readout = draw.log(0.3, 10.0).min(0.5 + 0.1 * air);
    let leak = draw.between(0.0, 0.003);
    let scatter = draw.between(0.0, 0.08);
    let (glare, glare_px) = (draw.between(0.0, 0.02), draw.log(3.0, 80.0));
    let (domain_name, domain) = draw_domain(&mut draw, air);
    let anatomy_mean = {
        let places: Vec<f64> = (0..200)
            .map(|_| draw.place(size, 0.0))
            .map(|x| (-anatomy.iter().map(|part| part.nepers(x)).sum::<f64>()).exp())
            .collect();
        places.iter().sum::<f64>() / 200.0
    };
    let behind = |x: DVec2, shade: f64| {
        let depth = blades.depth_px(x);
        let open = if penumbra_px > 0.0 {
            smooth(depth / penumbra_px + 0.5)
        } else if depth >= 0.0 {
            1.0
        } else {
            0.0
        };
        let passed = (-anatomy.iter().map(|part| part.nepers(x)).sum::<f64>()).exp();
        let tail = if depth < 0.0 { glare * (depth / glare_px).exp() } else { glare };
        air * (passed * shade * (open + leak * (1.0 - open)) + anatomy_mean * (scatter * open + tail))
    };
    let expected = |x: DVec2| behind(x, 1.0);
    let mut pixels = Image::filled(width, height, 0.0_f32);
    let mut depth_px = Image::filled(width, height, f32::INFINITY);
    let faulty = if draw.chance(0.2) { 1e-4 } else { 0.0 };
    pixels.pixels.par_chunks_mut(width).zip(depth_px.pixels.par_chunks_mut(width)).enumerate().for_each(
        |(row, (values, depths))| {
            for column in 0..width {
                let x = DVec2::new(column as f64, row as f64);
                let mut stream =
                    Stream::new(seed, 2 + u32::from(collimated), (row * width + column) as u32, Purpose::QuantumNoise);
                let shade = shade.as_ref().map_or(1.0, |shade| shade.pixels[row * width + column]);
                let quanta = poisson(behind(x, shade), &mut stream) + readout * stream.normal();
                values[column] = domain.value(quanta, air);
                if faulty > 0.0 && stream.uniform() < faulty && matches!(domain, Domain::Linear { .. } | Domain::Nepers) {
                    values[column] = f32::NAN;
                }
                depths[column] = blades.depth_px(x) as f32;
            }
        },
    );
    let paint = paint(&mut draw, &domain, collimated);
    if let Some(paint) = paint {
        for (value, depth) in pixels.pixels.iter_mut().zip(&depth_px.pixels) {
            if f64::from(*depth) < -penumbra_px / 2.0 {
                *value = paint;
            }
        }
    }
    let mut written = Vec::new();
    if draw.chance(0.35) {
        let finite = pixels.pixels.iter().copied().filter(|value| value.is_finite());
        let (least, most) =
            finite.fold((f32::INFINITY, f32::NEG_INFINITY), |(least, most), value| (least.min(value), most.max(value)));
        for _ in 0..draw.count(1, 3) {
            let ink = draw.pick(&[least, most, most]);
            written.push(burn_text(&mut draw, &mut pixels, ink));
        }
    }
    let seen = |sphere: &Sphere| {
        let at = DVec2::new(sphere.u_px, sphere.v_px);
        let (quanta, shaded) = (expected(at), behind(at, steel_passes(1.5)));
        let deviation = (shaded + readout * readout).sqrt();
        let value = |quanta: f64| f64::from(domain.value(quanta, air));
        let (change, step) = ((value(quanta) - value(shaded)).abs(), f64::from(domain.step()) / 3.0);
        let around = (0..32).map(|n| at + DVec2::from_angle(0.4 * f64::from(n)) * sphere.radius_px * f64::from(n) / 16.0);
        let nepers: Vec<f64> = around.map(|x| anatomy.iter().map(|part| part.nepers(x)).sum()).collect();
        let relief =
            nepers.iter().copied().fold(f64::NEG_INFINITY, f64::max) - nepers.iter().copied().fold(f64::INFINITY, f64::min);
        let border = at.min(size - at).min_element();
        let writing = written.iter().map(|[first, last]| (*first - at).max(at - *last).max(DVec2::ZERO).length());
        let nearest = writing.fold(border.min(blades.depth_px(at) - 0.5 * penumbra_px), f64::min);
        DrawnBead {
            sphere: *sphere,
            quanta,
            snr: (quanta - shaded) / deviation * (std::f64::consts::PI * sphere.radius_px.powi(2)).sqrt(),
            steps: if step > 0.0 { change / step } else { f64::INFINITY },
            relief,
            free_px: nearest - sphere.radius_px,
        }
    };
    let beads = spheres.iter().map(seen).collect();
    let faint = collimated
        && is_faint(&blades, size, penumbra_px, expected, |quanta| domain.value(quanta, air), readout, paint, domain.step());
    let note = format!(
        "{width}x{height} {shape} {domain_name} penumbra {penumbra_px:.1} air {air:.0} readout {readout:.1} leak {leak:.4} scatter {scatter:.3} glare {glare:.3}/{glare_px:.0} mean {anatomy_mean:.3} paint {paint:?}"
    );
    Drawn {
        told: FieldShape {
            half_planes: blades.planes.iter().map(|&(normal, limit_px)| HalfPlane { normal, limit_px }).collect(),
            ..FieldShape::default()
        },
        pixels,
        larger_is_more_attenuation: matches!(
            domain,
            Domain::Nepers | Domain::Clamped { .. } | Domain::Display { inverted: true, .. }
        ),
        shape,
        domain: domain_name,
        depth_px: collimated.then_some(depth_px),
        penumbra_px,
        faint,
        note,
        beads,
    }
}

fn draw_domain(draw: &mut Draw, air: f64) -> (&'static str, Domain) {
    match draw.count(0, 5) {
        0 | 1 => {
            let gain = draw.pick(&[1.0, 1.0 / air, 0.1]);
            let pedestal = gain * air * draw.pick(&[0.0, 0.0, 0.02, 0.3]);
            ("linear", Domain::Linear { gain, pedestal })
        }
        2 => {
            let gain = draw.log(800.0, 60000.0) / air;
            let pedestal = draw.pick(&[0.0, 0.0, 100.0, 4000.0]);
            ("u16 cut at 0", Domain::Words { gain, pedestal })
        }
        3 => ("log", Domain::Nepers),
        4 => ("log clamped", Domain::Clamped { floor: draw.pick(&[0.5, 1.0, 1e-4 * air]) }),
        _ => {
            let (white, exponent) = (draw.between(0.3, 1.2), draw.between(0.3, 1.0));
            ("display", Domain::Display { white, exponent, inverted: draw.chance(0.5) })
        }
    }
}

/// What the console writes over the shut area, if it does.
fn paint(draw: &mut Draw, domain: &Domain, collimated: bool) -> Option<f32> {
    let painted = collimated
        && match domain {
            Domain::Display { .. } => draw.chance(0.75),
            Domain::Linear { .. } => draw.chance(0.1),
            _ => false,
        };
    let shade = match domain {
        Domain::Display { .. } => draw.pick(&[0.0, 0.0, 255.0, 128.0, 60.0]),
        _ => draw.pick(&[0.0, f32::NAN]),
    };
    painted.then_some(shade)
}

#[expect(clippy::too_many_arguments, reason = "the whole chain of one drawing")]
fn is_faint(
    blades: &Blades,
    size: DVec2,
    penumbra_px: f64,
    expected: impl Fn(DVec2) -> f64,
    value: impl Fn(f64) -> f32,
    readout: f64,
    paint: Option<f32>,
    step: f32,
) -> bool {
    let (mut seen, mut told) = (0usize, 0usize);
    let gap = penumbra_px / 2.0 + 4.0;
    for row in (0..size.y as usize).step_by(3) {
        for column in (0..size.x as usize).step_by(3) {
            let x = DVec2::new(column as f64, row as f64);
            let depth = blades.depth_px(x);
            if !(depth.abs() < 3.0) {
                continue;
            }
            // Towards the open field.
            let slope = DVec2::new(
                blades.depth_px(x + DVec2::X) - blades.depth_px(x - DVec2::X),
                blades.depth_px(x + DVec2::Y) - blades.depth_px(x - DVec2::Y),
            )
            .normalize_or_zero();
            let (inside, outside) = (expected(x + slope * gap), expected(x - slope * gap));
            let contrast = 8.0 * (inside - outside) / (inside + readout * readout + 1.0).sqrt();
            let shown = (value(inside) - paint.unwrap_or(value(outside))).abs();
            let told_here =
                if paint.is_some() { !(shown < step) } else { contrast > 8.0 && inside > 2.0 * outside && shown > step };
            seen += 1;
            told += usize::from(told_here);
        }
    }
    told * 2 < seen
}
