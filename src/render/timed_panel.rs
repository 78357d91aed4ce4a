//! What the stages between attenuation and the page cost on this machine.

use glam::DVec2;

use super::blur::{blur, blur_line_integral, gaussian_kernel};
use super::cpu::add_noise::add_noise;
use super::cpu::attenuate_spectrum::{Arriving, Signal};
use super::flood::Weights;
use super::panel_costs::PanelCosts;
use super::plan_parts::Node;
use super::scattered::{Origin, Scatter};
use super::spectrum::Bins;
use super::veil::block_pairs;
use super::{Quantity, RenderError, detector, flood, intensifier};
use crate::geometry::{DEFAULT_ORDER, Distortion, Glare, Intensifier, Intrinsics, View, term_count};
use crate::image::Image;
use crate::scene::model::{Noise, ReadoutNoise, Scene};
use crate::scene::optics::Field;

/// Pixels along the edge of the image that is timed.
const SIDE: usize = 256;
/// Deviation of the blur that is timed, px.
const SIGMA_PX: f64 = 3.0;
/// Corners of the field that is timed as a polygon.
const CORNERS: usize = 6;
/// Weights along the edge of the crosstalk that is timed.
const CROSSTALK: usize = 3;
/// Cells along the edge of the scatter that is timed.
const CELLS: usize = 32;
/// A picture whose glare is nearly all spread between blocks, and one with many pixels for few pairs of blocks.
const BY_PAIR: [usize; 2] = [48, 48];
const BY_PIXEL: [usize; 2] = [960, 96];

/// The costs of this machine, where `threads` cores work at once; `time` says how many milliseconds something takes. `scene` has a view and
/// `nodes` for energies, `bins` are its.
///
/// # Errors
/// When the scene cannot be rendered.
pub(super) fn measure(
    (scene, nodes, bins): (&Scene, &[Node], &Bins),
    threads: usize,
    time: impl Fn(&dyn Fn()) -> f64,
) -> Result<PanelCosts, RenderError> {
    let seen = scene.view.ok_or(RenderError::NoView)?;
    let ns = |work: &dyn Fn()| time(work) * 1e6 * threads as f64;
    let pixels = SIDE * SIDE;
    let per = |work: &dyn Fn()| (ns(work) / pixels as f64).max(1e-3);
    let view = of_size(&seen, [SIDE; 2]);
    let size = [SIDE; 2];
    let weights = Weights::new(scene, nodes, bins)?;
    let open = flood::flood(scene, &view, &weights, true)?;
    let (signal, dull) = signals(pixels, scene.beam.photons_per_pixel);
    let line = &dull.line_integral;
    let mut costs = PanelCosts { flood_ns: per(&|| drop(flood::flood(scene, &view, &weights, true))), ..PanelCosts::default() };
    for (ns, (field, count)) in costs.field_ns.iter_mut().zip(fields(SIDE as f64 * scene.detector.pitch_mm)) {
        let mut collimated = scene.clone();
        collimated.beam.shape.field = Some(field);
        *ns = per(&|| {
            if let Ok(flood) = flood::flood(&collimated, &view, &weights, true) {
                drop(detector::seen_line_integral(&collimated, &view, line, &flood));
            }
        }) / count;
    }
    costs.blurred_ns = per(&|| blur_line_integral(&mut line.clone(), size, [0.0; 2]));
    let count = gaussian_kernel(SIGMA_PX * SIGMA_PX).len() as f64;
    let field: Vec<f64> = (0..pixels).map(|pixel| (pixel % 97) as f64).collect();
    costs.weight_ns =
        [[SIGMA_PX, 0.0], [0.0, SIGMA_PX]].map(|sigma_px| per(&|| blur(&mut field.clone(), size, sigma_px)) / count);
    let (scatter, valid) = (scatter(), vec![1u8; pixels]);
    costs.scatter_ns = per(&|| drop(scatter.add_to(&mut signal.clone(), &mut open.clone(), bins, size, &valid)));
    let bent = bent(size, None)?;
    // Without noise nobody asks for N₀(u), unless the intensifier glares.
    let mut unasked = open.clone();
    unasked.photons = Vec::new();
    costs.distorted_ns = [(&dull, &unasked), (&signal, &open)].map(|(signal, flood)| {
        per(&|| {
            let (mut signal, mut flood, mut valid) = (signal.clone(), flood.clone(), valid.clone());
            intensifier::distort(&bent, &mut signal, &mut flood, &mut valid);
            drop(detector::seen_line_integral(scene, &view, &signal.line_integral, &flood));
        })
    });
    costs.drawn_ns = per(&|| drop(add_noise(&detector::expected_photons(&signal, &open), 1, 0)));
    let mut noisy = scene.clone();
    noisy.model.noise = Noise::True;
    noisy.detector.crosstalk = Vec::new();
    noisy.detector.readout_noise = None;
    let deviates = vec![1.5f32; pixels];
    costs.quanta_ns = per(&|| drop(detector::intensity_noise(&noisy, &view, &open, &signal, &deviates, 0)));
    let kernel = vec![vec![1.0 / (CROSSTALK * CROSSTALK) as f64; CROSSTALK]; CROSSTALK];
    let crosstalk_ns = per(&|| drop(detector::correlated(&deviates, SIDE, SIDE, &kernel)));
    costs.crosstalk_ns = crosstalk_ns / (CROSSTALK * CROSSTALK) as f64;
    let readout = ReadoutNoise { sigma: 1e-3, row_correlation: 0.3 };
    costs.readout_ns = per(&|| detector::read_out(readout, (1, 0), &open, SIDE, &mut deviates.clone()));
    costs.page_ns = [Quantity::LineIntegral, Quantity::Counts].map(|quantity| {
        per(&|| {
            let seen = detector::seen_line_integral(scene, &view, line, &open);
            drop(detector::page(scene, quantity, &seen, &[], &open));
        })
    });
    let veiled_ns = |size: [usize; 2]| {
        let glaring = bent_with_glare(size)?;
        let view = of_size(&seen, size);
        let flood = flood::flood(scene, &view, &weights, true)?;
        let (Signal { line_integral, .. }, _) = signals(size[0] * size[1], scene.beam.photons_per_pixel);
        Ok::<f64, RenderError>(ns(&|| intensifier::veil(&glaring, &mut line_integral.clone(), &mut [], &mut flood.clone())))
    };
    costs.block_pair_ns = (veiled_ns(BY_PAIR)? / block_pairs(BY_PAIR)).max(1e-3);
    let rest_ns = veiled_ns(BY_PIXEL)? - costs.block_pair_ns * block_pairs(BY_PIXEL);
    costs.veiled_ns = (rest_ns / (BY_PIXEL[0] * BY_PIXEL[1]) as f64).max(1e-3);
    Ok(costs)
}

/// The view in an image of `size` about the same principal ray.
fn of_size(view: &View, size: [usize; 2]) -> View {
    let [cx, cy] = size.map(|n| 0.5 * (n as f64 - 1.0));
    View { size_px: size.map(|n| n as u32), intrinsics: Intrinsics { cx, cy, ..view.intrinsics }, ..*view }
}

/// What arrives: from half a neper to five, with moments and without; its photons are as few and as many as those that noise is drawn from.
fn signals(pixels: usize, photons_per_pixel: f64) -> (Signal, Signal) {
    let line_integral: Vec<f32> = (0..pixels).map(|pixel| 0.5 + (pixel % 97) as f32 * 0.05).collect();
    let arriving = |pixel: usize| Arriving {
        photon_fraction: ((10 + pixel % 4096) as f64 / photons_per_pixel) as f32,
        mean_response: 60.0,
        mean_square_response: 3700.0,
    };
    let dull = Signal { line_integral: line_integral.clone(), arriving: Vec::new() };
    (Signal { line_integral, arriving: (0..pixels).map(arriving).collect() }, dull)
}

/// Half of a panel so wide open, as each kind of field, and what its cost is counted by.
fn fields(across_mm: f64) -> [(Field, f64); 3] {
    let (half_mm, centre_mm) = (0.5 * across_mm, DVec2::ZERO);
    let corner = |n: usize| half_mm * DVec2::from_angle(std::f64::consts::TAU * n as f64 / CORNERS as f64);
    [
        (Field::Circle { diameter_mm: 1.2 * half_mm, centre_mm }, 1.0),
        (Field::Rectangle { size_mm: DVec2::new(half_mm, 1.4 * half_mm), centre_mm, rotation_deg: 10.0 }, 1.0),
        (Field::Polygon { corners_mm: (0..CORNERS).map(corner).collect() }, CORNERS as f64),
    ]
}

/// Some scatter, known well enough.
fn scatter() -> Scatter {
    let cells = |value: fn(usize) -> f64| Image { width: CELLS, height: CELLS, pixels: (0..CELLS * CELLS).map(value).collect() };
    Scatter {
        signal: cells(|cell| 0.1 + 1e-3 * (cell % CELLS) as f64),
        error: cells(|_| 1e-3),
        unattenuated: cells(|_| 1.0),
        from: Origin::Photons { histories: 1, seed: 1, device: String::new() },
        relative_error: 0.01,
    }
}

/// An intensifier that moves every place by parts of a pixel, so that each looks at four.
fn bent(size: [usize; 2], glare: Option<Glare>) -> Result<Intensifier, RenderError> {
    let mut shift_px = vec![DVec2::ZERO; term_count(DEFAULT_ORDER)];
    shift_px[0] = DVec2::new(0.3, 0.2);
    let [width, height] = size.map(|n| n as f64);
    let centre_px = 0.5 * DVec2::new(width - 1.0, height - 1.0);
    let distortion = Distortion::new(centre_px, width.max(height), DEFAULT_ORDER, shift_px)
        .map_err(|error| RenderError::Intensifier { detail: error.to_string() })?;
    Ok(Intensifier { size_px: size.map(|n| n as u32), distortion, glare, note: None })
}

fn bent_with_glare(size: [usize; 2]) -> Result<Intensifier, RenderError> {
    bent(size, Some(Glare { fraction: 0.1, scale_px: 30.0 }))
}
