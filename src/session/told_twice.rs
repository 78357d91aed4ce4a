//! How far telemetry and beads are apart is found by several checks, each with a sentence of its own; who shows an exposure tells it once.

use super::crosscheck::TELEMETRY_AND_BEADS;

/// How the sentences of [`super::tie`] begin.
const OF_THE_TIE: [&str; 2] = ["its beads put the specimen ", "the specimen was tied to the room anew"];

/// Whether a sentence about an exposure tells how far telemetry and its beads are apart.
pub(super) fn is_of_telemetry(words: &str) -> bool {
    [TELEMETRY_AND_BEADS].iter().chain(&OF_THE_TIE).any(|begin| words.starts_with(begin))
}

#[cfg(test)]
mod tests {
    use glam::DVec3;

    use super::super::crosscheck::Finding;
    use super::super::tie::SpecimenTie;
    use super::*;
    use crate::geometry::Rigid;

    /// The same 27.7 mm were told five times.
    #[test]
    fn sentences_of_the_tie_and_of_the_checks_are_known() {
        let at = |mm: f64| Rigid::translation(DVec3::X * mm);
        let mut declared = SpecimenTie::new(Some(at(0.0)), DVec3::ZERO);
        let mut learnt = SpecimenTie::new(None, DVec3::ZERO);
        let mut said = vec![declared.observe(1, "a", at(30.0), false, false).words];
        said.extend([0.0, 0.0, 30.0, 30.0].iter().zip(1..).map(|(mm, number)| {
            let content = format!("{number}");
            learnt.observe(number, &content, at(*mm), false, false).words
        }));
        let said: Vec<String> = said.into_iter().flatten().collect();
        assert!(said.len() >= 3 && said.iter().all(|words| is_of_telemetry(words)), "{said:#?}");
        assert!(is_of_telemetry(
            &Finding::warn(TELEMETRY_AND_BEADS, "telemetry puts the specimen elsewhere", "check").to_string()
        ));
        assert!(is_of_telemetry("telemetry and beads are 27.7 mm and 0.5 degrees apart"));
        assert!(!is_of_telemetry("the images are 0.30 nepers apart"), "the control");
    }
}
