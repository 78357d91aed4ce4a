//! A pair on its way from a posed frame to the report.

use std::sync::Arc;

use super::board::PairView;
use super::posing::Posed;
use crate::compare::Compared;
use crate::image::Image;
use crate::render::{Rendered, Scatter};
use crate::report::{self, Pair, StripInput};
use crate::scene::Scene;

/// Stands in a pair until its null is made.
pub(super) const UNCHECKED: &str = "the image has not been put against other poses yet";

/// A pair as far as it has come; it is delivered once when it can be shown and once more with its null.
#[derive(Clone, Debug)]
pub struct Developed {
    /// The posed frame.
    pub posed: Arc<Posed>,
    /// The row of the report.
    pub pair: Pair,
    /// The matched DRR as line integral, and the scene it shows.
    pub drr: Option<(Arc<Rendered>, Arc<Scene>)>,
    /// The scatter in it.
    pub(super) scatter: Option<Arc<Scatter>>,
    /// The compared images.
    pub compared: Option<Arc<Compared>>,
    /// The strip.
    pub strip: Arc<Image<[u8; 3]>>,
    /// SHA-256 of the DRR's pixels, little-endian f32, row by row.
    pub drr_sha256: Option<String>,
    /// Whether this is the final state, null included.
    pub complete: bool,
}

/// The strip of a pair as it stands; in place of a DRR the words why there is none.
pub(super) fn draw(posed: &Posed, pair: &Pair, compared: Option<&Compared>, without: Option<&str>) -> Image<[u8; 3]> {
    report::strip(&StripInput {
        acquired: &posed.frame,
        pictures: compared.map(|compared| &compared.pictures),
        without,
        standing: pair.standing(),
        status: &pair.status_line(),
        scores: &pair.score_words(),
        mm_per_px: compared.and_then(|compared| compared.comparison.mm_per_px),
    })
}

impl Developed {
    /// Complete as it is, and why there is no null.
    pub(super) fn without_null(mut self, because: &str) -> Self {
        self.pair.flags.retain(|flag| flag != UNCHECKED);
        let words = format!("no null, so the image has not been put against other poses: {because}");
        // An image that nobody has looked at may prefer another pose.
        self.pair.doubt(&words);
        self.pair.flags.push(words);
        self.strip = Arc::new(draw(&self.posed, &self.pair, self.compared.as_deref(), None));
        self.complete = true;
        self
    }

    /// Side of a pixel at the detector, if it is known.
    pub(super) fn pitch_mm(&self) -> Option<f64> {
        let of_scene = || self.drr.as_ref().map(|(_, scene)| scene.detector.pitch_mm);
        self.posed.pose.pitch_mm.or_else(of_scene)
    }

    /// What the window shows.
    #[must_use]
    pub fn picture(&self) -> PairView {
        let frame = &self.posed.frame;
        let shown = self.compared.as_ref().map(|compared| &compared.pictures);
        let gray = |image: &Image<f32>, window: [f64; 2]| image.map(|value| report::gray(*value, window)[0]);
        let (acquired, drr, difference) = match shown {
            Some(pictures) => {
                let window = report::window(&[&pictures.acquired, &pictures.simulated], Some(&pictures.usable));
                let half = 0.5 * (window[1] - window[0]).max(1e-9);
                let signed = |(a, b): (&f32, &f32)| report::diverging(((a - b) as f64 / half) as f32);
                let pixels = pictures.acquired.pixels.iter().zip(&pictures.simulated.pixels).map(signed).collect();
                let difference = Image::from_pixels(pictures.acquired.width, pictures.acquired.height, pixels);
                (gray(&pictures.acquired, window), Some(gray(&pictures.simulated, window)), difference)
            }
            None => (gray(&frame.pixels, report::window(&[&frame.pixels], None)), None, None),
        };
        let scores = ["zncc", "gradient_ncc", "ssim", "local_ncc", "edge_distance_mm", "rmse_nepers"];
        PairView {
            number: self.posed.number,
            name: frame.name.clone(),
            time_us: self.posed.time_us,
            status: self.pair.status_line(),
            standing: self.pair.standing(),
            acquired,
            drr,
            difference,
            scores: scores.iter().map(|name| ((*name).to_owned(), self.pair.scores.get(name))).collect(),
        }
    }
}
