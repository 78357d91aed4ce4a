//! A comparison as the terminal shows it.

use crate::compare::{Comparison, NULL_SCORES, Scores, Tone, elsewhere, with_deviation};

/// Scores beside those of [`NULL_SCORES`] that have a row.
const OTHERS: [&str; 3] = ["edge_distance_mm", "bias_nepers", "noise_nepers"];

/// The scores that there are.
fn in_a_line(scores: &Scores) -> String {
    let shown = |(name, _): &(&str, bool)| scores.get(name).map(|value| format!("{name} {value:.4}"));
    let shown: Vec<String> = NULL_SCORES.iter().filter_map(shown).collect();
    if shown.is_empty() { "no score".to_owned() } else { shown.join(", ") }
}

/// Scores, each with its null; then masks, tone, air level and flags. Of these nothing is said twice, nor what was `warned` of.
pub(super) fn table(found: &Comparison, warned: &[String]) -> String {
    let reasons = &found.scores.reasons;
    // Several scores may lack one thing: the first says it.
    let rows = || NULL_SCORES.iter().map(|(name, _)| *name).chain(OTHERS);
    let first = |name: &str| rows().find(|other| reasons.get(*other) == reasons.get(name));
    let reason = |name: &str| match (reasons.get(name), first(name)) {
        (Some(_), Some(other)) if other != name => format!("as {other}"),
        (reason, _) => reason.cloned().unwrap_or_default(),
    };
    let number = |value: Option<f64>| value.map_or_else(|| "-".to_owned(), |value| format!("{value:.4}"));
    let mut text = format!("{:<18}{:>10}  {:>10}  {:>10}  {}\n", "score", "here", "null size", "best null", "rank");
    for (name, _) in NULL_SCORES {
        let (small, best, rank) = match found.null.get(name) {
            Some(null) => {
                let doubt = if null.discriminating { "" } else { ", not discriminating" };
                let at = null.best_shift.as_deref().unwrap_or("nowhere");
                (
                    number(null.at_pose),
                    number(null.best_shifted),
                    format!("{} of {} (best wrong: {at}{doubt})", null.rank, null.of),
                )
            }
            None => ("-".into(), "-".into(), reason(name)),
        };
        text += format!("{name:<18}{:>10}  {small:>10}  {best:>10}  {rank}", number(found.scores.get(name))).trim_end();
        text.push('\n');
    }
    for name in OTHERS {
        text += format!("{name:<18}{:>10}  {}", number(found.scores.get(name)), reason(name)).trim_end();
        text.push('\n');
    }
    if found.tone.tone != Tone::None {
        text += &format!("without tone: {}\n", in_a_line(&found.scores_without_tone));
    }
    if let Some(tool) = &found.scores_tool {
        text += &format!("robot alone: {}\n", in_a_line(tool));
    }
    let causes: Vec<String> =
        found.masks.causes.iter().map(|(cause, share)| format!("{} {:.1} %", cause.words(), 100.0 * share)).collect();
    text += &format!(
        "masked {:.1} % ({})\n",
        100.0 * found.masks.masked,
        if causes.is_empty() { "nothing".into() } else { causes.join(", ") }
    );
    text += &format!(
        "domain {}, tone {} with {} fitted numbers, ",
        found.domain,
        found.tone.tone.as_str(),
        found.tone.degrees_of_freedom
    );
    if found.tone.tone != Tone::None {
        let knots: Vec<String> = found.tone.curve.iter().map(|[x, y]| format!("{x:.3} to {y:.3}")).collect();
        text += &format!("curve {}, ", knots.join(", "));
    }
    text += &match found.air.level {
        Some(level) => format!("air level {level:.6} ({})", found.air.rule),
        None => "air level unknown".to_owned(),
    };
    if let Some(offset) = &found.air.offset {
        text += &match offset.sigma {
            Some(sigma) => format!(", offset {} ({})", with_deviation(offset.value, sigma), offset.rule),
            None => format!(", offset {} ({})", offset.value, offset.rule),
        };
        text += &offset.reason.as_ref().map(|reason| format!(": {reason}")).unwrap_or_default();
    }
    text.push('\n');
    if let (Some(seen), Some(expected)) = (found.scores.noise_nepers, found.noise_expected_nepers) {
        text += &format!("noise {seen:.4} nepers, the detector calibration expects {expected:.4}\n");
    }
    if let Some(prefers) = elsewhere(&found.null).filter(|prefers| !warned.contains(&prefers.to_string())) {
        text += &format!("{prefers}\n");
    }
    let is_reason =
        |flag: &str| rows().filter_map(|name| reasons.get(name)).any(|reason| !reason.is_empty() && flag.ends_with(reason));
    found
        .flags
        .iter()
        .filter(|flag| !warned.contains(flag) && !is_reason(flag))
        .for_each(|flag| text += &format!("note: {flag}\n"));
    text
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::acquire::{Domain, Frame};
    use crate::compare::{CompareInput, compare};
    use crate::image::Image;
    use crate::mask::Masks;

    /// What a tone absorbs and what the robot alone scores stood in the file only.
    #[test]
    fn a_fitted_tone_shows_its_curve_and_the_scores_without_it() {
        let line = |at: usize| ((at % 160) as f32 * 0.07).sin() + (at / 160) as f32 * 0.01;
        let simulated = Image { width: 160, height: 120, pixels: (0..160 * 120).map(line).collect() };
        let frame = Frame::from_pixels("log", simulated.map(|l| 0.25 + 0.9 * l), Domain::Log).expect("finite");
        let tool = Image { width: 160, height: 120, pixels: (0..160 * 120).map(|at| at % 160 < 30).collect() };
        let unmasked = Masks::default();
        let shown = |tone: Tone| {
            let masks = Some(&unmasked);
            let input = CompareInput { tone, masks, tool: Some(&tool), ..CompareInput::new(&frame, &simulated) };
            table(&compare(&input).expect("comparable").comparison, &[])
        };
        let fitted = shown(Tone::LogAffine);
        // The curve counts from the frame's open air, which reads −0.175.
        for words in ["without tone: zncc 1.0000", "curve 0.000 to 0.425, 1.000 to 1.325", "robot alone: zncc 1.0000"] {
            assert!(fitted.contains(words), "{words} is not in\n{fitted}");
        }
        assert!(!shown(Tone::None).contains("without tone"), "control");
    }

    /// One sentence stood behind three scores and once more as a note, and a warning was a note as well.
    #[test]
    fn nothing_is_said_twice() {
        let line = |at: usize| ((at % 160) as f32 * 0.07).sin() + (at / 160) as f32 * 0.01;
        let simulated = Image { width: 160, height: 120, pixels: (0..160 * 120).map(line).collect() };
        let frame = Frame::from_pixels("log", simulated.map(|l| 0.25 + 0.9 * l), Domain::Log).expect("finite");
        let mut found = compare(&CompareInput::new(&frame, &simulated)).expect("comparable").comparison;
        let why = "nobody measured open air";
        for name in ["rmse_nepers", "bias_nepers", "noise_nepers"] {
            found.scores.reasons.insert(name.to_owned(), why.to_owned());
        }
        found.flags = vec![format!("air level unknown: {why}"), "other images".to_owned(), "a flag".to_owned()];
        let shown = table(&found, &["other images".to_owned()]);
        assert_eq!((shown.matches(why).count(), shown.matches("as rmse_nepers").count()), (1, 2), "{shown}");
        assert!(shown.contains("note: a flag") && !shown.contains("other images"), "{shown}");
        assert!(table(&found, &[]).contains("note: other images"), "the control");
    }
}
