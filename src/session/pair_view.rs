//! One exposure as the window shows it: what is known of it, its marks and its pictures.

use std::sync::Arc;

use super::pair_marks::PairMarks;
use super::pair_pictures::PairPictures;
use crate::pose::Pose;
use crate::report::Pair;

/// One frame with its matched DRR, as the window shows it.
#[derive(Clone, Debug)]
pub struct PairView {
    /// The row of the report: status and reason, scores, null, masks.
    pub pair: Arc<Pair>,
    /// What registration said.
    pub pose: Arc<Pose>,
    /// When it was exposed, host time.
    pub time_us: i64,
    /// How often the frame was posed before.
    pub development: u32,
    /// The frame that was this picture before its file was written on or anew: what was said of it is taken back.
    pub replaces: Option<u32>,
    /// Nothing more comes: the null is made, or there is none.
    pub complete: bool,
    /// Millimetres at the depth of interest per pixel of the frame.
    pub mm_per_px: Option<f64>,
    /// What a person can do about a pose that is refused or doubted.
    pub remedy: Option<String>,
    /// What is drawn over the pictures.
    pub marks: Arc<PairMarks>,
    /// The pictures.
    pub pictures: Arc<PairPictures>,
    /// From the exposure until it could be shown; `None` in a replay.
    pub latency_ms: Option<f64>,
}

impl PairView {
    /// The frame's number of arrival.
    #[must_use]
    pub fn number(&self) -> u32 {
        self.pair.number
    }
}
