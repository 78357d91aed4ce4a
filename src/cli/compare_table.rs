//! A comparison as the terminal shows it.

use crate::compare::{Comparison, NULL_SCORES, Scores, Tone, elsewhere, with_deviation};

/// The scores that there are.
fn in_a_line(scores: &Scores) -> String {
    let shown = |(name, _): &(&str, bool)| scores.get(name).map(|value| format!("{name} {value:.4}"));
    let shown: Vec<String> = NULL_SCORES.iter().filter_map(shown).collect();
    if shown.is_empty() { "no score".to_owned() } else { shown.join(", ") }
}

/// Scores, each with its null; then masks, tone, air level and flags.
pub(super) fn table(found: &Comparison) -> String {
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
            None => ("-".into(), "-".into(), found.scores.reasons.get(name).cloned().unwrap_or_default()),
        };
        text += format!("{name:<18}{:>10}  {small:>10}  {best:>10}  {rank}", number(found.scores.get(name))).trim_end();
        text.push('\n');
    }
    for name in ["edge_distance_mm", "bias_nepers", "noise_nepers"] {
        let reason = found.scores.reasons.get(name).map(String::as_str).unwrap_or_default();
        text += format!("{name:<18}{:>10}  {reason}", number(found.scores.get(name))).trim_end();
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
    if let Some(prefers) = elsewhere(&found.null) {
        text += &format!("{prefers}\n");
    }
    found.flags.iter().for_each(|flag| text += &format!("note: {flag}\n"));
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
            table(&compare(&input).expect("comparable").comparison)
        };
        let fitted = shown(Tone::LogAffine);
        // The curve counts from the frame's open air, which reads −0.175.
        for words in ["without tone: zncc 1.0000", "curve 0.000 to 0.425, 1.000 to 1.325", "robot alone: zncc 1.0000"] {
            assert!(fitted.contains(words), "{words} is not in\n{fitted}");
        }
        assert!(!shown(Tone::None).contains("without tone"), "control");
    }
}
