//! What the DRRs of a session lack of what a frame shows, by the plans that were executed.

use std::collections::BTreeMap;

use crate::render::plan::Choice;

/// What shapes a frame, as plans call it; whatever else a plan leaves out is no part of a picture.
const OF_A_FRAME: [&str; 8] = [
    "scatter",
    "quantum noise",
    "bow-tie",
    "heel effect",
    "blur of the focal spot",
    "scintillator",
    "blur of the scintillator",
    "antiscatter grid",
];
/// No plan knows of these.
const NEVER: &str = "lag of the detector, the operating table, and whatever else is not in the scene";
/// As a plan says that nobody asked for an ingredient.
const NOT_GIVEN: &str = "not given";

/// What each frame's plan left out; a frame that is rendered again replaces its earlier plan.
#[derive(Debug, Default)]
pub(super) struct LeftOut {
    frames: BTreeMap<u32, Vec<Choice>>,
}

impl LeftOut {
    /// Notes the plan of a DRR; one that cannot be read says nothing.
    pub(super) fn take(&mut self, number: u32, plan: &serde_json::Value) {
        let Ok(choices) = serde_json::from_value::<Vec<Choice>>(plan["choices"].clone()) else { return };
        let left_out = choices.into_iter().filter(|choice| !choice.modelled && OF_A_FRAME.contains(&choice.what.as_str()));
        self.frames.insert(number, left_out.collect());
    }

    /// One sentence for each reason.
    pub(super) fn sentences(&self) -> Vec<String> {
        if self.frames.is_empty() {
            return vec!["no DRR was rendered".to_owned()];
        }
        let mut frames_of: BTreeMap<(usize, &str), usize> = BTreeMap::new();
        for choice in self.frames.values().flatten() {
            if let Some(place) = OF_A_FRAME.iter().position(|what| *what == choice.what) {
                *frames_of.entry((place, choice.why.as_str())).or_default() += 1;
            }
        }
        let all = self.frames.len();
        let (not_given, others): (Vec<_>, Vec<_>) =
            frames_of.into_iter().partition(|((_, why), count)| *why == NOT_GIVEN && *count == all);
        let mut sentences: Vec<String> = others
            .into_iter()
            .map(|((place, why), count)| {
                let some = if count == all { String::new() } else { format!(" ({count} of {all} frames)") };
                format!("{}: {why}{some}", OF_A_FRAME[place])
            })
            .collect();
        if !not_given.is_empty() {
            let names: Vec<&str> = not_given.iter().map(|((place, _), _)| OF_A_FRAME[*place]).collect();
            sentences.push(format!("not given in the scene: {}", names.join(", ")));
        }
        sentences.push(NEVER.to_owned());
        sentences
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn plan(choices: &[(&str, bool, &str)]) -> serde_json::Value {
        let choice =
            |(what, modelled, why): &(&str, bool, &str)| serde_json::json!({"what": what, "modelled": modelled, "why": why});
        serde_json::json!({"choices": choices.iter().map(choice).collect::<Vec<_>>()})
    }

    /// The report said "detector blur, focal spot, anode heel" of scenes that had all three.
    #[test]
    fn only_what_the_plans_left_out_is_said() {
        let mut left_out = LeftOut::default();
        assert_eq!(left_out.sentences(), ["no DRR was rendered"]);
        let whole = [("heel effect", true, "by energy"), ("blur of the focal spot", true, "FWHM"), ("bow-tie", false, NOT_GIVEN)];
        left_out.take(1, &plan(&whole));
        assert_eq!(left_out.sentences(), ["not given in the scene: bow-tie", NEVER]);
        left_out.take(2, &plan(&[("scatter", false, "no network"), ("bow-tie", false, NOT_GIVEN), ("GPU", false, "small")]));
        assert_eq!(
            left_out.sentences(),
            ["scatter: no network (1 of 2 frames)", "not given in the scene: bow-tie", NEVER],
            "the GPU is no part of a picture"
        );
        left_out.take(2, &plan(&whole));
        assert_eq!(left_out.sentences().len(), 2, "a frame that is rendered again has its last plan");
    }
}
