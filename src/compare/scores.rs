//! How well two images agree: each score with its stated scale, or the reason why there is none.

use std::collections::BTreeMap;

use super::correlation::{for_each_scored, rank_ncc, ranks, zncc};
use super::domain::CommonDomain;
use super::edges::{EdgeMap, median_distance_px};
use super::filters::every;
use super::seen::{Ground, Seen, WINDOW_STRIDE_PX};
use super::tone::Tone;
use crate::image::{Image, quantile, zip};

/// K₁ and K₂ of SSIM; its range is the simulated image's from the 0.5th to the 99.5th percentile.
pub const SSIM_CONSTANTS: [f64; 2] = [0.01, 0.03];
/// Fewer scored pixels than this score nothing.
pub const FEWEST_PIXELS: usize = 200;
/// As many windows as stand on so many pixels.
const FEWEST_WINDOWS: f64 = (FEWEST_PIXELS / (WINDOW_STRIDE_PX * WINDOW_STRIDE_PX)) as f64;

/// The scores of one comparison; `None` where a score does not exist, with the reason in `reasons`.
#[derive(Clone, Debug, Default, PartialEq, serde::Serialize, serde::Deserialize)]
pub struct Scores {
    /// Zero-mean normalised cross-correlation, −1 to 1.
    pub zncc: Option<f64>,
    /// Spearman's rank correlation, −1 to 1: blind to any monotone tone.
    pub rank_ncc: Option<f64>,
    /// Mean correlation of the two components of the gradient after smoothing with σ = 1.5 px, −1 to 1.
    pub gradient_ncc: Option<f64>,
    /// Structural similarity, Gaussian windows σ = 1.5 px at every second pixel each way, K = 0.01 and 0.03, up to 1.
    pub ssim: Option<f64>,
    /// Mean NCC in Gaussian windows of σ = 8 px, at every second pixel each way, of the band between σ = 1.5 and 6 px, where the
    /// simulation has structure, −1 to 1.
    pub local_ncc: Option<f64>,
    /// Median symmetric distance of strong edges, px (12 at most).
    pub edge_distance_px: Option<f64>,
    /// The same at the depth of the beads (else of the stated centre), mm.
    pub edge_distance_mm: Option<f64>,
    /// Root mean square of acquired − simulated, nepers.
    pub rmse_nepers: Option<f64>,
    /// Mean of acquired − simulated, nepers.
    pub bias_nepers: Option<f64>,
    /// Noise of a pixel in the acquired frame, from second differences, nepers.
    pub noise_nepers: Option<f64>,
    /// Why a score is missing.
    #[serde(default, skip_serializing_if = "BTreeMap::is_empty")]
    pub reasons: BTreeMap<String, String>,
}

/// Scores that have a null distribution, and whether a larger value is better.
pub const NULL_SCORES: [(&str, bool); 7] = [
    ("zncc", true),
    ("rank_ncc", true),
    ("gradient_ncc", true),
    ("ssim", true),
    ("local_ncc", true),
    ("edge_distance_px", false),
    ("rmse_nepers", false),
];

impl Scores {
    /// A score by its name in files.
    #[must_use]
    pub fn get(&self, name: &str) -> Option<f64> {
        match name {
            "zncc" => self.zncc,
            "rank_ncc" => self.rank_ncc,
            "gradient_ncc" => self.gradient_ncc,
            "ssim" => self.ssim,
            "local_ncc" => self.local_ncc,
            "edge_distance_px" => self.edge_distance_px,
            "edge_distance_mm" => self.edge_distance_mm,
            "rmse_nepers" => self.rmse_nepers,
            "bias_nepers" => self.bias_nepers,
            "noise_nepers" => self.noise_nepers,
            _ => None,
        }
    }

    pub(super) fn absent(reason: &str) -> Self {
        let mut scores = Self::default();
        for name in ["zncc", "rank_ncc", "gradient_ncc", "ssim", "local_ncc", "edge_distance_px", "rmse_nepers", "bias_nepers"] {
            scores.reasons.insert(name.into(), reason.into());
        }
        scores
    }
}

/// What the scores are computed from.
pub(super) struct Scored<'a> {
    /// In the common domain.
    pub acquired: &'a Seen<'a>,
    /// [`ranks`] of the acquired image on `scored`.
    pub acquired_ranks: &'a Image<f32>,
    /// Noise of a pixel of the acquired image on `scored`, where somebody looked for it.
    pub acquired_noise: Option<f64>,
    /// In the common domain, tone applied.
    pub simulated: &'a Seen<'a>,
    /// What is not masked.
    pub ground: &'a Ground,
    /// Of the usable pixels those that were not used to fit the tone.
    pub scored: &'a Image<bool>,
    pub domain: CommonDomain,
    pub tone: Tone,
    /// Why there is no air level.
    pub air_reason: Option<&'a str>,
    /// Millimetres at the depth of interest per pixel.
    pub mm_per_px: Option<f64>,
}

/// All scores; the edges are handed in because the pictures need them as well.
pub(super) fn score(input: &Scored, edges: (&EdgeMap, &EdgeMap)) -> Scores {
    let count = input.scored.pixels.iter().filter(|s| **s).count();
    if count < FEWEST_PIXELS {
        return Scores::absent(&format!("{count} pixels are left to score, {FEWEST_PIXELS} are needed"));
    }
    let (acquired, simulated) = (input.acquired.image, input.simulated.image);
    let mut scores = Scores::default();
    let mut missing = |name: &str, reason: &str| {
        scores.reasons.insert(name.into(), reason.into());
    };
    let gray_reason = "gray values relate to nepers by an unknown curve; a monotone tone (--tone, a session's \"tone\") fits one";
    let toned_gray = input.domain == CommonDomain::GrayValues && input.tone != Tone::Monotone;
    let relative = input.domain == CommonDomain::RelativeLineIntegral;
    let ssim_reason = match input.domain {
        CommonDomain::GrayValues if toned_gray => Some(gray_reason),
        CommonDomain::RelativeLineIntegral if input.tone == Tone::None => {
            Some("the offset is unknown; a gain (--tone, a session's \"tone\") fits it")
        }
        _ => None,
    };
    let absolute_reason = match input.domain {
        CommonDomain::GrayValues => Some("gray values of an unknown curve are no line integrals"),
        CommonDomain::RelativeLineIntegral => Some(input.air_reason.unwrap_or("the air level is unknown")),
        CommonDomain::LineIntegral if input.tone == Tone::Monotone => Some("a monotone tone absorbs absolute errors"),
        CommonDomain::LineIntegral => None,
    };
    if toned_gray {
        missing("zncc", gray_reason);
    }
    if let Some(reason) = ssim_reason {
        missing("ssim", reason);
    }
    if let Some(reason) = absolute_reason {
        ["rmse_nepers", "bias_nepers", "noise_nepers"].iter().for_each(|name| missing(name, reason));
    }
    debug_assert!(!(relative && absolute_reason.is_none()));
    // What takes longest, the sort behind the ranks, beside what filters.
    let ((of_ranks, of_gradient, of_edges), (of_all, of_windows, of_bands)) = rayon::join(
        || {
            let of_ranks = rank_ncc(input.acquired_ranks, &ranks(simulated, input.scored));
            let (of_gradient, of_edges) =
                rayon::join(|| gradient_ncc(input), || median_distance_px(edges.0, edges.1, input.scored));
            (of_ranks, of_gradient, of_edges)
        },
        || {
            let of_all = || (!toned_gray).then(|| zncc(acquired, simulated, input.scored)).flatten();
            let of_windows = || ssim_reason.is_none().then(|| ssim(input)).flatten();
            let (of_all, (of_windows, of_bands)) = rayon::join(of_all, || rayon::join(of_windows, || local_ncc(input)));
            (of_all, of_windows, of_bands)
        },
    );
    (scores.zncc, scores.rank_ncc, scores.gradient_ncc) = (of_all, of_ranks, of_gradient);
    (scores.ssim, scores.local_ncc, scores.edge_distance_px) = (of_windows, of_bands, of_edges);
    scores.edge_distance_mm = scores.edge_distance_px.zip(input.mm_per_px).map(|(px, mm)| px * mm);
    if absolute_reason.is_none() {
        let (mut sum, mut squares) = (0.0, 0.0);
        for_each_scored(acquired, simulated, input.scored, |a, s| {
            sum += a - s;
            squares += (a - s) * (a - s);
        });
        scores.bias_nepers = Some(sum / count as f64);
        scores.rmse_nepers = Some((squares / count as f64).sqrt());
        scores.noise_nepers = input.acquired_noise;
    }
    for name in ["zncc", "rank_ncc", "gradient_ncc", "ssim", "local_ncc", "edge_distance_px", "edge_distance_mm", "noise_nepers"]
    {
        if scores.get(name).is_none() {
            let reason = match name {
                "edge_distance_px" => "fewer than 30 edge points in either image",
                "edge_distance_mm" => "no view, or no edges",
                _ => "an image has no structure where it is scored",
            };
            scores.reasons.entry(name.into()).or_insert_with(|| reason.into());
        }
    }
    scores
}

fn gradient_ncc(input: &Scored) -> Option<f64> {
    let (a, b) = (&input.acquired.gradient, &input.simulated.gradient);
    let known = zip(&a.known, input.scored, |k, s| *k && *s);
    let (du, dv) = rayon::join(|| zncc(&a.du, &b.du, &known), || zncc(&a.dv, &b.dv, &known));
    Some(0.5 * (du? + dv?))
}

/// Range of an image: between its 0.5th and 99.5th percentile.
fn range(image: &Image<f32>, scored: &Image<bool>) -> Option<f64> {
    let mut values: Vec<f32> = image.pixels.iter().zip(&scored.pixels).filter(|(_, s)| **s).map(|(v, _)| *v).collect();
    let low = quantile(&mut values, 0.005)?;
    let high = quantile(&mut values, 0.995)?;
    (high > low).then_some(high - low)
}

fn ssim(input: &Scored) -> Option<f64> {
    let (a, b) = (input.acquired.image, input.simulated.image);
    let (acquired, simulated) = (input.acquired, input.simulated);
    let in_windows = || {
        let cross = input.ground.in_fine_windows(&acquired.product(simulated));
        (cross, acquired.power(input.ground), simulated.power(input.ground))
    };
    let (range, (cross, power_a, power_b)) = rayon::join(|| range(b, input.scored), in_windows);
    let range = range?;
    let mut of_simulated = (0.0, 0.0);
    for_each_scored(a, b, input.scored, |_, s| of_simulated = (of_simulated.0 + s, of_simulated.1 + 1.0));
    let middle = of_simulated.0 / of_simulated.1;
    let scored = every(input.scored, WINDOW_STRIDE_PX);
    let [c1, c2] = SSIM_CONSTANTS.map(|k| (k * range).powi(2));
    let (mut sum, mut n) = (0.0, 0.0);
    for at in (0..scored.pixels.len()).filter(|&at| scored.pixels[at] && input.ground.known.pixels[at]) {
        let value = |image: &Image<f32>| f64::from(image.pixels[at]);
        let (fine_a, fine_b) = (value(&acquired.fine), value(&simulated.fine));
        let (ma, mb) = (fine_a - f64::from(acquired.mean), fine_b - f64::from(simulated.mean));
        let (va, vb, cov) = ((value(power_a) - ma * ma).max(0.0), (value(power_b) - mb * mb).max(0.0), value(&cross) - ma * mb);
        // The means are those of the images moved so that the simulated range starts at 0, as SSIM wants them positive.
        let (la, lb) = (fine_a - middle + 0.5 * range, fine_b - middle + 0.5 * range);
        sum += (2.0 * la * lb + c1) * (2.0 * cov + c2) / ((la * la + lb * lb + c1) * (va + vb + c2));
        n += 1.0;
    }
    (n >= FEWEST_WINDOWS).then(|| sum / n)
}

fn local_ncc(input: &Scored) -> Option<f64> {
    let known = &input.ground.known;
    let scored = every(input.scored, WINDOW_STRIDE_PX);
    let (maa, mbb) = (&input.acquired.band_power, &input.simulated.band_power);
    let mab = input.ground.in_windows(&zip(&input.acquired.band, &input.simulated.band, |a, b| a * b));
    let (mut total, mut n) = (0.0, 0.0);
    for at in (0..mbb.pixels.len()).filter(|&at| known.pixels[at]) {
        total += f64::from(mbb.pixels[at]);
        n += 1.0;
    }
    // Windows with less than a tenth of the mean power hold noise only, and would dilute the mean.
    let floor = 0.1 * total / f64::max(n, 1.0);
    let (mut sum, mut n) = (0.0, 0.0);
    for at in (0..mbb.pixels.len()).filter(|&at| known.pixels[at] && scored.pixels[at]) {
        let (aa, bb, ab) = (f64::from(maa.pixels[at]), f64::from(mbb.pixels[at]), f64::from(mab.pixels[at]));
        if bb > floor && aa > 0.0 {
            sum += ab / (aa * bb).sqrt();
            n += 1.0;
        }
    }
    (n >= FEWEST_WINDOWS).then(|| sum / n)
}
