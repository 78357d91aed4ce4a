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

/// What to say where scatter is said by another network than then, or by one where there was none.
pub(super) fn another_network(then: Option<&str>, now: Option<&str>) -> Option<String> {
    let name = |sha256: Option<&str>| sha256.map_or_else(|| "no network".to_owned(), |sha256| format!("the network {sha256}"));
    let words = || format!("{} said the session's scatter, {} says it now: DRRs differ by that", name(then), name(now));
    (then != now).then(words)
}

/// What the plan of a DRR states, without what is uncertain about its scatter: by no more may it differ from itself.
pub(super) fn planned_error(plan: &serde_json::Value) -> f64 {
    plan["stated_error"].as_f64().unwrap_or(0.0)
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

    #[test]
    fn another_network_is_said_and_its_uncertainty_is_no_excuse() {
        assert_eq!((another_network(None, None), another_network(Some("a1"), Some("a1"))), (None, None));
        let said = another_network(Some("a1"), Some("b2")).expect("others");
        assert!(said.contains("network a1 said") && said.contains("network b2 says"), "{said}");
        assert!(another_network(None, Some("b2")).is_some_and(|said| said.starts_with("no network")));
        assert_eq!(planned_error(&serde_json::json!({"stated_error": 1e-5})), 1e-5);
        assert_eq!(planned_error(&serde_json::Value::Null), 0.0);
    }
}
