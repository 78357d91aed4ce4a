//! The offset without darks, sharper than medians give it: the means of frames that agree, over the pixels that are good in all of them.
//!
//! A median is safe from what stands in the beam, but it is no mean. Where a distribution of density f over the panel gets noise of variance
//! σ²(y), as many pixels come to lie below y as belong there and ½ (σ² f)′ more; with σ² = gain · y and an even f the median falls by half
//! a quantum, and by a sixth of one where the panel sees one signal throughout and the noise is skewed. The fall is the same at every
//! exposure, so that it is the intercept's. Means over one set of pixels lie on `offset + k · mAs`, whatever the noise.
//!
//! A mean over n pixels has the variance (gain · signal + σ²) / n of photon transfer, and (τ · signal)² more where the tube's output scatters
//! by the share τ, one tube's in all its beams: as large as the frames' distances from their lines ask for.

use super::error::DetectorError;
use super::measured::MeasuredBeam;
use super::offset::{Offset, has_levels, of_exposures, student};
use crate::estimate::Line;
use crate::image::Image;

/// The weights follow the line.
const ROUNDS: usize = 4;
/// The output's scatter is found by halving; frames that scatter by more are left out before.
const MOST_SCATTER: f64 = 0.1;
const HALVINGS: usize = 40;

/// The frames of a beam.
struct Beam<N> {
    /// mAs and mean.
    points: Vec<[f64; 2]>,
    /// Variance of a mean by its signal.
    noise: N,
}

/// From the beam that gives it best; `first` is the offset with which the beams were judged. `None` where no beam tells more.
pub(super) fn refined(
    first: &Offset,
    measured: &[MeasuredBeam],
    bad: &Image<u8>,
    notes: &mut Vec<String>,
) -> Result<Option<Offset>, DetectorError> {
    let good: Vec<usize> = (0..bad.pixels.len()).filter(|&at| bad.pixels[at] == 0).collect();
    let count = good.len();
    let mean = |pixels: &[f32]| good.iter().map(|&at| f64::from(pixels[at])).sum::<f64>() / count as f64;
    let beams = measured.iter().map(|MeasuredBeam { group, transfer, .. }| {
        let frames = group.levels.iter().flat_map(|level| &level.frames);
        let points = frames.filter_map(|frame| Some([frame.exposure_mas?, mean(&frame.pixels.pixels)])).collect();
        Beam { points, noise: move |signal: f64| transfer.variance_of_mean(signal, count) }
    });
    let beams: Vec<_> = beams.filter(|beam| has_levels(&beam.points)).collect();
    let scatter = scatter(&beams, first.median);
    let freedom = beams.iter().map(|beam| beam.points.len() - 2).sum::<usize>();
    let of_line = |beam: &Beam<_>| {
        let line = beam.line(first.median, scatter)?;
        Some((
            line.intercept,
            student(freedom) * line.intercept_sigma(),
            beam.points.iter().map(|point| point[1]).fold(0.0, f64::max),
        ))
    };
    let Some(best) = beams.iter().filter_map(of_line).min_by(|a, b| a.1.total_cmp(&b.1)) else {
        notes.push(format!(
            "no dark frames: one offset of {:.2} ± {:.2} for all pixels, by the medians of the frames: without those that were left out no beam has \
             three different exposures (mAs), so it is less sure than that; take two dark frames",
            first.median, first.sigma
        ));
        return Ok(None);
    };
    let offset = of_exposures(Some(best))?;
    notes.push(format!(
        "no dark frames: one offset of {:.2} ± {:.2} for all pixels, from where the signal of the exposures vanishes if their mAs are true; \
         hot pixels are not found",
        offset.median, offset.sigma
    ));
    Ok(Some(offset))
}

/// The share by which the tube's output scatters: χ² of all beams is their degrees of freedom. A single beam of few frames would often have none by
/// chance, and be taken for the best.
fn scatter<N: Fn(f64) -> f64>(beams: &[Beam<N>], intercept: f64) -> f64 {
    let too_far = |scatter: f64| {
        let excess = |beam: &Beam<N>| Some(beam.line(intercept, scatter)?.chi2 - (beam.points.len() as f64 - 2.0));
        beams.iter().filter_map(excess).sum::<f64>() > 0.0
    };
    if !too_far(0.0) {
        return 0.0;
    }
    let (mut below, mut above) = (0.0, MOST_SCATTER);
    for _ in 0..HALVINGS {
        let middle = 0.5 * (below + above);
        *(if too_far(middle) { &mut below } else { &mut above }) = middle;
    }
    below
}

impl<N: Fn(f64) -> f64> Beam<N> {
    /// Through the points; the weights are of a line from `intercept` first.
    fn line(&self, intercept: f64, scatter: f64) -> Option<Line> {
        let slopes = self.points.iter().map(|[mas, value]| (value - intercept) / mas);
        let mut slope = slopes.sum::<f64>() / self.points.len() as f64;
        let mut found = None;
        for _ in 0..ROUNDS {
            let variance = |mas: f64| (self.noise)(slope * mas) + (scatter * slope * mas).powi(2);
            let line = Line::through(self.points.iter().map(|&[mas, value]| [mas, value, 1.0 / variance(mas)]))?;
            slope = line.slope;
            found = Some(line);
        }
        found
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Two frames of 1, 2, 4 and 8 mAs, 1000 per mAs, each off by its share of `output` and of the noise.
    fn frames(output: f64, noise: f64) -> Vec<[f64; 2]> {
        let sides = [1.0, -1.0, -1.0, 1.0, 1.0, -1.0, -1.0, 1.0];
        let point = |(nth, side): (usize, f64)| {
            let mas = [1.0, 2.0, 4.0, 8.0][nth / 2];
            [mas, 200.0 + 1000.0 * mas * (1.0 + output * side) + noise * mas.sqrt() * side]
        };
        sides.into_iter().enumerate().map(point).collect()
    }

    /// The line through such frames, and the scatter that they say.
    fn found(beams: &[(f64, f64)]) -> (Vec<Line>, f64) {
        let beam = |(output, noise): &(f64, f64)| Beam { points: frames(*output, *noise), noise: |signal: f64| signal * 1e-4 };
        let beams: Vec<_> = beams.iter().map(beam).collect();
        let scatter = scatter(&beams, 190.0);
        (beams.iter().map(|beam| beam.line(190.0, scatter).expect("a line")).collect(), scatter)
    }

    #[test]
    fn the_frames_say_how_much_the_output_scatters_and_noise_alone_says_none() {
        let (quiet, scatter) = found(&[(0.0, 0.1)]);
        let quiet = quiet[0];
        assert_eq!(scatter, 0.0);
        assert!((quiet.intercept - 200.0).abs() < 2.0 * quiet.intercept_sigma(), "{quiet:?}");
        // A variance of 0.1 x at x mAs: the inverse of the normal equations is 0.1 Σx / (Σ1/x Σx − (Σ1)²), of Σ1/x = 3.75, Σ1 = 8 and
        // Σx = 30.
        assert!((quiet.intercept_sigma() - (0.1f64 * 30.0 / 48.5).sqrt()).abs() < 1e-3, "{quiet:?}");
        let (scattering, _) = found(&[(0.01, 0.1)]);
        let scattering = scattering[0];
        assert!(scattering.intercept_sigma() > 10.0 * quiet.intercept_sigma(), "{scattering:?}");
        assert!((scattering.chi2 / 6.0 - 1.0).abs() < 1e-3, "{scattering:?}");
        assert!((scattering.intercept - 200.0).abs() < 2.0 * scattering.intercept_sigma(), "{scattering:?}");
    }

    /// A beam whose frames lie on their line by chance was as sure as its quanta allow, and was taken.
    #[test]
    fn the_tube_scatters_alike_in_all_its_beams() {
        let (lines, scatter) = found(&[(0.01, 0.1), (0.0, 0.1)]);
        assert!((0.003..0.02).contains(&scatter), "{scatter}");
        assert!(lines[1].intercept_sigma() > 0.9 * lines[0].intercept_sigma(), "{lines:?}");
    }
}
