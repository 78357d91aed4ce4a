//! What a replay found against its log.

pub use super::image_difference::ImageDifference;

/// What a replay found against the log. Frames are named by their number of arrival.
#[derive(Clone, Debug, Default, PartialEq, serde::Serialize)]
pub struct ReplayReport {
    /// Frames replayed.
    pub frames: usize,
    /// Poses that are the same, byte for byte.
    pub poses_identical: usize,
    /// Frames whose pose differs from the log.
    pub poses_different: Vec<u32>,
    /// Poses of the log that no frame of it gives now.
    pub poses_missing: Vec<u32>,
    /// DRRs with the same hash.
    pub images_identical: usize,
    /// Frames whose DRR differs.
    pub images_different: Vec<ImageDifference>,
    /// Pairs whose pose and DRR are the same, and whose scores are.
    pub scores_identical: usize,
    /// Frames whose pose and DRR are the same, and whose scores in the log are others.
    pub scores_different: Vec<u32>,
    /// Samples of a device that the log states and its bytes do not give, or the reverse.
    pub samples_different: u64,
    /// Frames with a DRR in the log that could not be rendered now.
    pub images_missing: Vec<u32>,
    /// Poses and DRRs that the log does not hold.
    pub not_in_log: Vec<String>,
    /// What the log has lost.
    pub losses: Vec<String>,
    /// What the session had lost on its lines; the log holds it as it was.
    pub session_losses: Vec<String>,
}

impl ReplayReport {
    /// Whether everything that the log holds came out the same (images within their plan's bound).
    #[must_use]
    pub fn is_faithful(&self) -> bool {
        self.poses_different.is_empty()
            && self.poses_missing.is_empty()
            && self.images_missing.is_empty()
            && self.scores_different.is_empty()
            && self.samples_different == 0
            && self.images_different.iter().all(|found| found.largest_nepers.is_some_and(|largest| largest <= found.bound))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_difference_that_is_not_finite_is_not_faithful() {
        let unknown = ImageDifference { number: 1, largest_nepers: None, bound: 1.0, detail: None };
        assert!(ReplayReport::default().is_faithful());
        let report = ReplayReport { images_different: vec![unknown], ..ReplayReport::default() };
        assert!(!report.is_faithful());
    }
}
