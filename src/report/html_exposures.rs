//! Each exposure of the page: strip, scores against their null, circumstances.

use std::fmt::Write as _;

use super::html_parts::{Shown, margin_words, number};
use super::pair::{Pair, Standing};
use super::plots::escape;
use super::session::SessionReport;
use crate::compare::NULL_SCORES;

pub(super) fn each_exposure(page: &mut String, report: &SessionReport, strips: &[Option<Shown>]) {
    page.push_str("<h2>Each exposure</h2>");
    for (index, (pair, strip)) in report.pairs.iter().zip(strips).enumerate() {
        let standing = pair.standing();
        let open = if index == 0 { " open" } else { "" };
        let _ = write!(
            page,
            "<details id=\"e{index}\"{open}><summary><b>{}</b><span class=\"badge {}\">{}</span><span class=\"dim\">{}</span></summary><div class=\"inside\">",
            escape(&pair.frame),
            standing.class(),
            standing.word().to_lowercase(),
            escape(&pair.status_line())
        );
        match (strip, &pair.strip) {
            (Some(strip), _) => {
                let words = format!("{}: acquired, matched DRR, difference, edges", pair.frame);
                let path = pair.strip.as_deref().map(escape).unwrap_or_default();
                let _ = write!(
                    page,
                    "<a class=\"strip p{index}\" role=\"img\" aria-label=\"{}\" href=\"{path}\" style=\"aspect-ratio:{}/{}\"></a>",
                    escape(&words),
                    strip.width,
                    strip.height
                );
                let drr = pair.drr.as_deref().map(escape).map(|drr| format!(", DRR <a href=\"{drr}\">{drr}</a>"));
                let _ = write!(
                    page,
                    "<p class=\"dim\">In full, beside this page: <a href=\"{path}\">{path}</a>{}</p>",
                    drr.unwrap_or_default()
                );
            }
            (None, Some(path)) => {
                let _ = write!(page, "<p class=\"caution\">The strip {} is missing or no PNG.</p>", escape(path));
            }
            (None, None) => page.push_str("<p class=\"dim\">No strip was made.</p>"),
        }
        page.push_str("<div class=\"two wide\">");
        score_table(page, pair);
        circumstances(page, pair, standing);
        page.push_str("</div>");
        bead_table(page, pair);
        page.push_str("</div></details>");
    }
}

fn score_table(page: &mut String, pair: &Pair) {
    page.push_str("<div class=\"over\"><table><thead><tr><th class=\"l\">score</th><th>in full</th><th>without tone</th><th>at null size</th><th>best wrong pose,<br>at null size</th><th class=\"l\">here, against that</th><th>rank</th></tr></thead><tbody>");
    for (name, _) in NULL_SCORES {
        let plain = pair.scores_without_tone.as_ref().and_then(|scores| scores.get(name));
        let null = pair.null.get(name);
        let best = null.map_or_else(
            || "–".into(),
            |null| {
                format!("{} <small>{}</small>", number(null.best_shifted, 4), escape(null.best_shift.as_deref().unwrap_or("")))
            },
        );
        let rank = null.map_or_else(
            || "–".into(),
            |null| {
                format!(
                    "<span class=\"{}\">{} of {}</span>",
                    if null.discriminating { "good" } else { "caution" },
                    null.rank,
                    null.of
                )
            },
        );
        let margin = null.map_or_else(|| "no null".to_owned(), margin_words);
        let here = pair.scores.get(name);
        let reason = pair.scores.reasons.get(name).filter(|_| here.is_none());
        let title = reason.map(|reason| format!(" title=\"{}\"", escape(reason))).unwrap_or_default();
        let _ = write!(
            page,
            "<tr><td class=\"l\"{title}>{}</td><td>{}</td><td>{}</td><td>{}</td><td>{best}</td><td class=\"l words\">{margin}</td><td>{rank}</td></tr>",
            name.replace('_', " "),
            number(here, 4),
            number(plain, 4),
            number(null.and_then(|null| null.at_pose), 4)
        );
    }
    page.push_str("</tbody></table></div>");
}

/// Each bead of the layout: where its shadow was found, by how much P misses it, and whether P rests on it.
fn bead_table(page: &mut String, pair: &Pair) {
    if pair.beads.is_empty() {
        return;
    }
    page.push_str("<div class=\"over\"><table><thead><tr><th class=\"l\">bead</th><th>found<br>column, row px</th><th>found minus P<br>column, row px</th><th>distance<br>px</th><th class=\"l\">part in P</th></tr></thead><tbody>");
    let both = |place: Option<[f64; 2]>, decimals| {
        place.map_or_else(|| "–".to_owned(), |place| place.map(|px| number(Some(px), decimals)).join(", "))
    };
    for bead in &pair.beads {
        let class = if bead.used { "l words" } else { "l words caution" };
        let _ = write!(
            page,
            "<tr><td class=\"l\">{}</td><td>{}</td><td>{}</td><td>{}</td><td class=\"{class}\">{}</td></tr>",
            escape(&bead.name),
            both(bead.found_px, 2),
            both(bead.residual_px, 3),
            number(bead.residual_px.map(|[u, v]| u.hypot(v)), 3),
            escape(bead.part())
        );
    }
    page.push_str("</tbody></table></div>");
}

fn circumstances(page: &mut String, pair: &Pair, standing: Standing) {
    page.push_str("<ul class=\"plain\">");
    let mut item = |text: String| {
        let _ = write!(page, "<li>{}</li>", escape(&text));
    };
    if let (Some(reason), true) = (&pair.reason, standing != Standing::Accepted) {
        item(format!("reason: {reason}"));
    }
    item(format!(
        "bound by {}",
        if pair.binding_evidence.is_empty() {
            pair.binding.clone()
        } else {
            format!("{}: {}", pair.binding, pair.binding_evidence.join("; "))
        }
    ));
    if let Some(innovation) = &pair.innovation {
        let [u, v, depth] = innovation.shift_mm;
        let sigmas = innovation.sigmas.map(|sigmas| format!(", {sigmas:.1} standard deviations of the arm")).unwrap_or_default();
        item(format!(
            "telemetry minus beads: {u:+.1}, {v:+.1} mm across, {depth:+.1} mm in depth, {:.2} degrees{sigmas}",
            innovation.turn_deg
        ));
    }
    if let Some(tip) = &pair.tip {
        let ([u, v], [sigma_u, sigma_v]) = (tip.off_mm, tip.sigma_mm);
        item(format!(
            "drill's tip, seen minus drawn: {u:+.2} ± {sigma_u:.2}, {v:+.2} ± {sigma_v:.2} mm across, {:.2} mm in all ({} profiles)",
            tip.length_mm, tip.profiles
        ));
    }
    if let Some(gap_us) = pair.gap_us {
        item(format!("telemetry answers span a gap of {:.1} ms", gap_us as f64 * 1e-3));
    }
    if let Some(robot) = &pair.robot_source {
        item(pair.robot_words().map_or_else(|| format!("robot shape: {robot}"), str::to_owned));
    }
    pair.robot_cautions.iter().for_each(|words| item(words.clone()));
    if let Some(tone) = &pair.tone {
        item(format!(
            "tone {}: {} fitted numbers, {} px fitted, {} px scored",
            tone.tone.as_str(),
            tone.degrees_of_freedom,
            tone.fitted_pixels,
            tone.scored_pixels
        ));
    }
    if let Some(air) = &pair.air {
        let level = air.level.map_or_else(|| "unknown".into(), |level| format!("{level:.4}"));
        item(format!(
            "air level {level} by rule {}{}",
            air.rule,
            air.reason.as_ref().map(|r| format!(": {r}")).unwrap_or_default()
        ));
    }
    if let Some(masks) = &pair.masks {
        let causes: Vec<String> =
            masks.causes.iter().map(|(cause, share)| format!("{} {:.1} %", cause.words(), 100.0 * share)).collect();
        let field = masks.field.as_ref().map(|field| format!(" ({field})")).unwrap_or_default();
        item(format!(
            "masked {:.1} %: {}{field}",
            100.0 * masks.masked,
            if causes.is_empty() { "nothing".into() } else { causes.join(", ") }
        ));
    }
    if let Some(error) = pair.render_error {
        item(format!("stated error of the render: {error:.1e} of max(1, line integral)"));
    }
    for flag in &pair.flags {
        item(flag.clone());
    }
    page.push_str("</ul>");
}
