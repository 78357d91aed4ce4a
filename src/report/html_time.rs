//! What the page shows over time: residuals, scores, times per stage, links, joints.

use maud::{Markup, html};

use super::html_parts::{number, table};
use super::pair::Pair;
use super::plots::{self, Dot};
use super::session::{Gap, LinkReport, SessionReport};

pub(super) fn over_time(report: &SessionReport) -> Markup {
    let end_us = report.ended_us.or_else(|| report.pairs.iter().filter_map(|pair| pair.time_us).max()).unwrap_or(0);
    let span_s = [0.0, report.seconds(end_us).max(1.0)];
    html! {
        h2 { "Over time" }
        div class="plots" {
            (of_scores(report, span_s))
            (of_stages(report))
            @if !report.links.is_empty() {
                (figure("Links", "green: samples arrive; red: down", &html! { (of_links(report, span_s)) (link_table(report)) }))
            }
            (of_tracks(report, span_s))
        }
    }
}

fn figure(title: &str, note: &str, inside: &Markup) -> Markup {
    html! { figure { figcaption { (title) " " span { (note) } } (inside) } }
}

fn of_scores(report: &SessionReport, span_s: [f64; 2]) -> Markup {
    let dot = |pair: &Pair, value: Option<f64>, against: Option<f64>| -> Option<Dot> {
        Some(Dot {
            time_s: report.seconds(pair.time_us?),
            value: value?,
            class: pair.standing().class(),
            against,
            label: format!("{}: {}", pair.frame, number(value, 3)),
        })
    };
    let rms: Vec<Dot> = report.pairs.iter().filter_map(|pair| dot(pair, pair.rms_px, None)).collect();
    // Both ends of a stem are computed at null size; the score of the full image would not compare.
    let zncc = |pair: &Pair| pair.null.get("zncc").map_or((pair.scores.zncc, None), |null| (null.at_pose, null.best_shifted));
    let scores: Vec<Dot> = report.pairs.iter().filter_map(|pair| dot(pair, zncc(pair).0, zncc(pair).1)).collect();
    html! {
        @if let Some(svg) = plots::dots("bead residual over time", &rms, span_s, true) {
            (figure("Bead residual", "rms, px", &svg))
        }
        @if let Some(svg) = plots::dots("ZNCC and its null over time", &scores, span_s, false) {
            (figure("ZNCC", "at the stated pose; hollow: best wrong pose", &svg))
        }
    }
}

fn of_stages(report: &SessionReport) -> Markup {
    let mut names: Vec<String> = Vec::new();
    for (name, _) in report.pairs.iter().flat_map(|pair| pair.stages_ms.iter()) {
        if !names.iter().any(|known| known == name) {
            names.push(name.to_owned());
        }
    }
    let values = |pair: &Pair| names.iter().map(|name| pair.stages_ms.get(name).unwrap_or(0.0)).collect();
    let bars: Vec<(String, Vec<f64>)> = (1..).zip(&report.pairs).map(|(at, pair)| (at.to_string(), values(pair))).collect();
    html! {
        @if let Some(drawn) = plots::stacks("milliseconds per stage", &names, &bars) {
            (figure("Time per stage", "ms per exposure", &drawn))
        }
    }
}

fn of_links(report: &SessionReport, span_s: [f64; 2]) -> Markup {
    let band = |link: &LinkReport| {
        let at = |us: Option<i64>, otherwise: f64| us.map_or(otherwise, |us| report.seconds(us));
        let gap = |gap: &Gap| ([report.seconds(gap.start_us), report.seconds(gap.end_us)], gap.reason.clone());
        let there_s = [at(link.first_us, 0.0), at(link.last_us, 0.0)];
        plots::Band { name: link.device.clone(), there_s, gaps: link.gaps.iter().map(gap).collect() }
    };
    let bands: Vec<plots::Band> = report.links.iter().map(band).collect();
    plots::links("links over time", &bands, span_s)
}

fn of_tracks(report: &SessionReport, span_s: [f64; 2]) -> Markup {
    let exposures: Vec<f64> = report.pairs.iter().filter_map(|pair| Some(report.seconds(pair.time_us?))).collect();
    let in_seconds = |points: &[(i64, f64)]| points.iter().map(|(us, value)| (report.seconds(*us), *value)).collect();
    html! {
        @for track in &report.tracks {
            @let series: Vec<(String, Vec<(f64, f64)>)> =
                track.series.iter().map(|(name, points)| (name.clone(), in_seconds(points))).collect();
            @if let Some(drawn) = plots::lines(&track.title, &series, span_s, &exposures) {
                (figure(&track.title, &format!("{}; dotted: exposures", track.unit), &drawn))
            }
        }
    }
}

fn link_table(report: &SessionReport) -> Markup {
    let names: Vec<&str> =
        report.links.first().map(|link| link.counters.iter().map(|(name, _)| &**name).collect()).unwrap_or_default();
    let headings: Vec<&str> = ["<link"].into_iter().chain(names.iter().copied()).chain(["gaps"]).collect();
    let rows = html! {
        @for link in &report.links {
            tr {
                td class="l" { (link.device) }
                @for name in &names {
                    td {
                        @match link.counters.iter().find(|(known, _)| known == name) {
                            Some((_, count)) => (count),
                            None => "–",
                        }
                    }
                }
                td { (link.gaps.len()) }
            }
        }
    };
    table("over", &headings, &rows)
}
