//! One exposure as the window shows it: what is known of it, its marks and its pictures.

use std::sync::Arc;

use super::at_exposure::AtExposure;
use super::pair_marks::PairMarks;
use super::pair_pictures::PairPictures;
use super::told_twice::is_of_telemetry;
use crate::calibrate::robot::SeenRobot;
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
    /// The robot as the frame shows it; absent where it was not looked for, or not seen.
    pub seen_robot: Option<Arc<SeenRobot>>,
    /// What the devices said at the exposure.
    pub devices: Arc<AtExposure>,
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

    /// Whether its reason tells how far telemetry and beads are apart.
    #[must_use]
    pub fn is_reason_telemetry(&self) -> bool {
        self.pair.reason.as_deref().is_some_and(is_of_telemetry)
    }

    /// What to beware of besides the reason. Sentences that tell the same in other words stand together, the first of them for all: that
    /// telemetry and beads are apart is found by several checks.
    #[must_use]
    pub fn cautions(&self) -> Vec<Vec<&str>> {
        let (of_telemetry, others): (Vec<&str>, Vec<&str>) = self.all_cautions().partition(|words| is_of_telemetry(words));
        let together = Some(of_telemetry).filter(|words| !words.is_empty() && !self.is_reason_telemetry());
        together.into_iter().chain(others.into_iter().map(|words| vec![words])).collect()
    }

    /// What tells in other words what its reason tells.
    #[must_use]
    pub fn said_otherwise(&self) -> Vec<&str> {
        self.all_cautions().filter(|words| self.is_reason_telemetry() && is_of_telemetry(words)).collect()
    }

    fn all_cautions(&self) -> impl Iterator<Item = &str> {
        let pair = &self.pair;
        let others = pair.robot_cautions.iter().chain(&pair.flags).map(String::as_str);
        pair.robot_words().into_iter().chain(others).filter(move |words| pair.reason.as_deref() != Some(*words))
    }
}
