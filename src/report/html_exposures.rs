//! Each exposure of the page: strip, scores against their null, circumstances.

use maud::{Markup, html};

use super::html_parts::{Shown, margin_words, number, table};
use super::pair::{Pair, Standing};
use super::session::SessionReport;
use crate::compare::NULL_SCORES;

pub(super) fn each_exposure(report: &SessionReport, strips: &[Option<Shown>]) -> Markup {
    html! {
        h2 { "Each exposure" }
        @for (index, (pair, strip)) in report.pairs.iter().zip(strips).enumerate() {
            @let standing = pair.standing();
            details id={ "e" (index) } open[index == 0] {
                summary {
                    b { (pair.frame) }
                    span class={ "badge " (standing.class()) } { (standing.word().to_lowercase()) }
                    span class="dim" { (pair.status_line()) }
                }
                div class="inside" {
                    (pictures(index, pair, strip.as_ref()))
                    div class="two wide" {
                        (score_table(pair))
                        ul class="plain" { @for line in circumstances(pair, standing) { li { (line) } } }
                    }
                    @if !pair.beads.is_empty() { (bead_table(pair)) }
                }
            }
        }
    }
}

/// What a strip shows of a pair that was compared.
const COMPARED: &str = "acquired, matched DRR, difference, edges with beads and residuals";
/// And of a frame without a DRR.
const ALONE: &str = "acquired, with the shadows seen";

/// The strip, and where it and the DRR lie.
fn pictures(index: usize, pair: &Pair, strip: Option<&Shown>) -> Markup {
    html! {
        @match (strip, &pair.strip) {
            (Some(strip), path) => {
                @let path = path.as_deref().unwrap_or_default();
                @let shows = if pair.masks.is_some() { COMPARED } else { ALONE };
                a class={ "strip p" (index) } role="img" href=(path) style={ "aspect-ratio:" (strip.width) "/" (strip.height) }
                    aria-label={ (pair.frame) ": " (shows) } {}
                p class="dim" {
                    "In full, beside this page: " a href=(path) { (path) }
                    @if let Some(drr) = &pair.drr { ", DRR " a href=(drr) { (drr) } }
                }
            }
            (None, Some(path)) => p class="caution" { "The strip " (path) " is missing or no PNG." },
            (None, None) => p class="dim" { "No strip was made." },
        }
    }
}

fn score_table(pair: &Pair) -> Markup {
    let headings =
        ["<score", "in full", "without tone", "at null size", "best wrong pose,\nat null size", "<here, against that", "rank"];
    table("over", &headings, &html! { @for (name, _) in NULL_SCORES { (score_row(pair, name)) } })
}

fn score_row(pair: &Pair, name: &str) -> Markup {
    let here = pair.scores.get(name);
    let plain = pair.scores_without_tone.as_ref().and_then(|scores| scores.get(name));
    let null = pair.null.get(name);
    let reason = pair.scores.reasons.get(name).filter(|_| here.is_none());
    html! {
        tr {
            td class="l" title=[reason] { (name.replace('_', " ")) }
            td { (number(here, 4)) }
            td { (number(plain, 4)) }
            td { (number(null.and_then(|null| null.at_pose), 4)) }
            @match null {
                Some(null) => {
                    td { (number(null.best_shifted, 4)) " " small { (null.best_shift.as_deref().unwrap_or("")) } }
                    td class="l words" { (margin_words(null)) }
                    td { span class=(if null.discriminating { "good" } else { "caution" }) { (null.rank) " of " (null.of) } }
                }
                None => {
                    td { "–" }
                    td class="l words" { "no null" }
                    td { "–" }
                }
            }
        }
    }
}

/// Each bead of the layout: where its shadow was found, by how much P misses it, and whether P rests on it.
fn bead_table(pair: &Pair) -> Markup {
    let both = |place: Option<[f64; 2]>, decimals| {
        place.map_or_else(|| "–".to_owned(), |place| place.map(|px| number(Some(px), decimals)).join(", "))
    };
    let headings = ["<bead", "found\ncolumn, row px", "found minus P\ncolumn, row px", "distance\npx", "<part in P"];
    let rows = html! {
        @for bead in &pair.beads {
            tr {
                td class="l" { (bead.name) }
                td { (both(bead.found_px, 2)) }
                td { (both(bead.residual_px, 3)) }
                td { (number(bead.residual_px.map(|[u, v]| u.hypot(v)), 3)) }
                td class=(if bead.used { "l words" } else { "l words caution" }) { (bead.part()) }
            }
        }
    };
    table("over", &headings, &rows)
}

/// What is to be known of an exposure besides its scores, a line each.
fn circumstances(pair: &Pair, standing: Standing) -> Vec<String> {
    let mut lines = Vec::new();
    let mut item = |text: String| lines.push(text);
    if let (Some(reason), true) = (&pair.reason, standing != Standing::Accepted) {
        item(format!("reason: {reason}"));
    }
    if let Some(note) = &pair.note {
        item(format!("note: {note}"));
    }
    item(format!(
        "bound by {}",
        if pair.binding_evidence.is_empty() {
            pair.binding.clone()
        } else {
            format!("{}: {}", pair.binding, pair.binding_evidence.join("; "))
        }
    ));
    pair.k_source.iter().for_each(|source| item(source.to_string()));
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
    lines
}
