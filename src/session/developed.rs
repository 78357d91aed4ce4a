//! A pair on its way from a posed frame to the report.

use std::sync::Arc;

use super::at_exposure::AtExposure;
use super::pair_marks::marks_of;
use super::pair_pictures::PairPictures;
use super::pair_view::PairView;
use super::posed::Posed;
use super::remedy::remedy;
use crate::calibrate::robot::SeenRobot;
use crate::compare::Compared;
use crate::image::Image;
use crate::render::{Rendered, Scatter};
use crate::report::{self, Heading, Pair, StripInput};
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
    /// The robot as the frame shows it; it is looked for with the null.
    pub seen_robot: Option<Arc<SeenRobot>>,
    /// The strip.
    pub strip: Arc<Image<[u8; 3]>>,
    /// SHA-256 of the DRR's pixels, little-endian f32, row by row.
    pub drr_sha256: Option<String>,
    /// Whether this is the final state, null included.
    pub complete: bool,
}

/// The strip of a pair as it stands, and of the scene that its DRR shows; in place of a DRR the words why there is none.
pub(super) fn draw(
    posed: &Posed,
    pair: &Pair,
    scene: Option<&Scene>,
    compared: Option<&Compared>,
    without: Option<&str>,
) -> Image<[u8; 3]> {
    let Heading { standing, status, scores } = pair.heading();
    report::strip(&StripInput {
        acquired: &posed.frame,
        pictures: compared.map(|compared| &*compared.pictures),
        masks: Some(&posed.masks),
        without,
        marks: Some(&marks_of(posed, scene)),
        standing,
        status: &status,
        scores: &scores,
        mm_per_px: compared.and_then(|compared| compared.comparison.mm_per_px),
    })
}

impl Developed {
    /// Complete as it is, and why there is no null.
    pub(super) fn without_null(mut self, because: &str) -> Self {
        let before = self.pair.heading();
        self.pair.flags.retain(|flag| flag != UNCHECKED);
        let words = format!("no null, so the image has not been put against other poses: {because}");
        // An image that nobody has looked at may prefer another pose.
        self.pair.doubt(&words);
        self.pair.flags.push(words);
        if self.pair.heading() != before {
            self.strip = Arc::new(draw(&self.posed, &self.pair, self.scene(), self.compared.as_deref(), None));
        }
        self.complete = true;
        self
    }

    /// What its DRR shows.
    fn scene(&self) -> Option<&Scene> {
        self.drr.as_ref().map(|(_, scene)| &**scene)
    }

    /// Side of a pixel at the detector, if it is known.
    pub(super) fn pitch_mm(&self) -> Option<f64> {
        let of_scene = || self.drr.as_ref().map(|(_, scene)| scene.detector.pitch_mm);
        self.posed.pose.pitch_mm.or_else(of_scene)
    }

    /// What the window shows.
    #[must_use]
    pub fn picture(&self) -> PairView {
        let Self { posed, pair, .. } = self;
        let comparison = self.compared.as_ref().map(|compared| &compared.comparison);
        let of_comparison = comparison.and_then(|found| Some(found.mm_per_px? / found.binning.max(1) as f64));
        let of_pose = || {
            let (view, centre) = posed.view.zip(posed.pose.centroid_lps_mm)?;
            Some(view.camera_from_lps.transform_point(centre).z / view.intrinsics.fx)
        };
        let pictures = match &self.compared {
            Some(compared) => PairPictures::compared(posed.frame.size_px, &compared.pictures),
            None => PairPictures::alone(&posed.frame, &posed.masks),
        };
        PairView {
            pair: Arc::new(pair.clone()),
            pose: Arc::new(posed.pose.clone()),
            time_us: posed.time_us,
            development: posed.development,
            replaces: posed.frame.completes,
            complete: self.complete,
            mm_per_px: of_comparison.or_else(of_pose),
            remedy: remedy(posed, pair),
            marks: Arc::new(marks_of(posed, self.scene())),
            seen_robot: self.seen_robot.clone(),
            devices: Arc::new(AtExposure { joints: posed.joints, beam: posed.beam.clone(), robot: posed.robot.clone() }),
            pictures: Arc::new(pictures),
            latency_ms: None,
        }
    }
}
