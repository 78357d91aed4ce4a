//! The session's report as one HTML file: no script, no network, a small picture of every strip, and links to the files beside it.

use std::fmt::Write as _;

use rayon::prelude::*;

use super::html_exposures::each_exposure;
use super::html_parts::{Shown, margin_words, number, shown};
use super::pair::{Pair, PairStatus};
use super::plots::{self, Dot, escape};
use super::session::SessionReport;
use super::strip::panel_rectangle;
use crate::time::utc;

/// Width of a tile of the contact sheet in CSS pixels.
const TILE_PX: f64 = 220.0;

/// The whole page, with the strips that the report holds.
#[must_use]
pub fn html(report: &SessionReport) -> String {
    page(report, &|path| report.pictures.get(path).cloned())
}

/// The whole page; `strip` gives the bytes of the PNG that a pair names.
pub(super) fn page(report: &SessionReport, strip: &(dyn Fn(&str) -> Option<Vec<u8>> + Sync)) -> String {
    let mut page = String::with_capacity(64 * 1024);
    let title = if report.title.is_empty() { "Session" } else { &report.title };
    let _ = write!(
        page,
        "<!doctype html>\n<html lang=\"en\"><head><meta charset=\"utf-8\"><meta name=\"viewport\" content=\"width=device-width\">\
         <meta name=\"generator\" content=\"sidecarm {}\"><title>{} · Sidecarm</title>\n<style>\n{}",
        escape(&report.provenance.version),
        escape(title),
        include_str!("style.css")
    );
    let small = |pair: &Pair| shown(&strip(pair.strip.as_deref()?)?);
    let strips: Vec<Option<Shown>> = report.pairs.par_iter().map(small).collect();
    for (index, strip) in strips.iter().enumerate() {
        if let Some(strip) = strip {
            // As a background the picture is in the file once, for the tile and for the strip.
            let _ = writeln!(page, ".p{index}{{background-image:url(data:image/jpeg;base64,{})}}", strip.base64);
        }
    }
    page.push_str("</style></head><body><main>\n");
    summary(&mut page, report, title);
    contact_sheet(&mut page, report, &strips);
    table(&mut page, report);
    over_time(&mut page, report);
    each_exposure(&mut page, report, &strips);
    honest_notes(&mut page, report);
    provenance(&mut page, report);
    page.push_str("</main></body></html>\n");
    page
}

fn median(mut values: Vec<f64>) -> Option<f64> {
    values.sort_unstable_by(f64::total_cmp);
    values.get(values.len() / 2).copied()
}

fn start_us(report: &SessionReport) -> i64 {
    report.started_us.or_else(|| report.pairs.iter().filter_map(|pair| pair.time_us).min()).unwrap_or(0)
}

fn seconds(report: &SessionReport, us: i64) -> f64 {
    (us - start_us(report)) as f64 * 1e-6
}

fn summary(page: &mut String, report: &SessionReport, title: &str) {
    let counts = report.counts();
    let when = report.started_us.map(utc).unwrap_or_default();
    let lasted =
        report.started_us.zip(report.ended_us).map(|(a, b)| format!(" · {:.0} s", (b - a) as f64 * 1e-6)).unwrap_or_default();
    let what = report.provenance.command.as_deref().unwrap_or("");
    let _ = write!(page, "<h1>{}</h1><p class=\"dim\">{when}{lasted} {}</p>", escape(title), escape(what));
    let rms = median(report.pairs.iter().filter_map(|pair| pair.rms_px).collect());
    let zncc = median(report.pairs.iter().filter_map(|pair| pair.scores.zncc).collect());
    let warned: u64 = report.warnings.values().map(|counted| counted.count).sum();
    page.push_str("<div class=\"cards\">");
    let mut card = |class: &str, value: String, words: &str| {
        let _ = write!(page, "<div class=\"card\"><b class=\"{class}\">{value}</b><span>{words}</span></div>");
    };
    let lit = |class: &'static str, count: usize| if count > 0 { class } else { "" };
    card("", counts.exposures.to_string(), "exposures");
    card(lit("good", counts.accepted), counts.accepted.to_string(), "accepted");
    for (count, what) in [(counts.image_disagrees, "image"), (counts.telemetry_disagrees, "telemetry")] {
        if count > 0 {
            card("caution", count.to_string(), &format!("accepted, {what} disagrees"));
        }
    }
    if counts.in_doubt > 0 {
        card("caution", counts.in_doubt.to_string(), "accepted, in doubt");
    }
    card(lit("bad", counts.refused), counts.refused.to_string(), "refused");
    card(lit("caution", counts.no_pose), counts.no_pose.to_string(), "not registered");
    card("", number(rms, 3), "median rms, px");
    card("", number(zncc, 3), "median ZNCC");
    card(lit("caution", warned as usize), warned.to_string(), "warnings");
    card(lit("bad", report.losses.len()), report.losses.len().to_string(), "losses");
    page.push_str("</div>");
    if counts.from_telemetry > 0 {
        let _ = write!(
            page,
            "<p class=\"dim\" style=\"margin-top:12px\">{} shown with the pose from telemetry.</p>",
            counts.from_telemetry
        );
    }
    let words = report.pairs.iter().filter_map(Pair::robot_words).collect::<Vec<_>>();
    if let Some(first) = words.first() {
        let _ =
            write!(page, "<p class=\"caution\" style=\"margin-top:12px\">{} of {}: {first}.</p>", words.len(), counts.exposures);
    }
}

fn contact_sheet(page: &mut String, report: &SessionReport, strips: &[Option<Shown>]) {
    page.push_str("<h2>Contact sheet</h2><div class=\"sheet\">");
    for (index, (pair, strip)) in report.pairs.iter().zip(strips).enumerate() {
        let standing = pair.standing();
        let picture = strip.as_ref().map_or_else(
            || format!("<span class=\"shot\" style=\"height:{:.0}px\"></span>", 0.75 * TILE_PX),
            |strip| {
                // The last panel (edges over acquired) tells most; without a DRR the first is the only picture.
                let rendered = pair.masks.is_some();
                let [left, top, width, height] = panel_rectangle(if rendered { 3 } else { 0 }, strip.width, strip.height);
                let across = 100.0 * left / (strip.width as f64 - width);
                let down = 100.0 * top / (strip.height as f64 - height);
                format!(
                    "<span class=\"shot p{index}\" style=\"aspect-ratio:{width:.1}/{height:.1};background-size:{:.2}% {:.2}%;background-position:{across:.3}% {down:.3}%\"></span>",
                    100.0 * strip.width as f64 / width,
                    100.0 * strip.height as f64 / height
                )
            },
        );
        let right = pair
            .rms_px
            .filter(|_| pair.status == PairStatus::Accepted)
            .map_or_else(|| standing.short().to_owned(), |px| format!("{px:.3} px"));
        let _ = write!(
            page,
            "<a class=\"tile {}\" href=\"#e{index}\" title=\"{}\">{picture}<span class=\"words\"><i>{}</i><span>{right}</span></span></a>",
            standing.class(),
            escape(&pair.status_line()),
            escape(&pair.frame)
        );
    }
    page.push_str("</div>");
}

fn table(page: &mut String, report: &SessionReport) {
    page.push_str("<h2>Exposures</h2><div class=\"scroll\"><table><thead><tr><th class=\"l\">frame</th><th>time<br>s</th><th class=\"l\">bound by</th><th class=\"l\">status</th>\
        <th>rms<br>px</th><th>rms<br>mm</th>");
    let truth = report.pairs.iter().any(|pair| pair.truth.is_some());
    if truth {
        page.push_str("<th>truth error<br>px</th>");
    }
    page.push_str("<th>ZNCC</th><th>best wrong<br>pose</th><th class=\"l\">here, against that</th><th>RMSE<br>nepers</th><th>edges<br>mm</th><th>masked<br>%</th><th>total<br>ms</th></tr></thead><tbody>");
    for (index, pair) in report.pairs.iter().enumerate() {
        let standing = pair.standing();
        let total: f64 = pair.stages_ms.iter().map(|(_, ms)| ms).sum();
        let _ = write!(
            page,
            "<tr><td class=\"l name\"><a href=\"#e{index}\">{}</a></td><td>{}</td><td class=\"l\">{}</td><td class=\"l words\"><span class=\"badge {}\">{}</span></td><td>{}</td><td>{}</td>",
            escape(&pair.frame),
            number(pair.time_us.map(|us| seconds(report, us)), 2),
            escape(&pair.binding),
            standing.class(),
            standing.word().to_lowercase(),
            number(pair.rms_px, 3),
            number(pair.rms_mm, 3),
        );
        if truth {
            let _ = write!(page, "<td>{}</td>", number(pair.truth.map(|truth| truth.mean_px), 3));
        }
        let scores = &pair.scores;
        // Scores of pictures of two sizes do not compare: beside its null stands the score at null size.
        let _ = match pair.null.get("zncc") {
            Some(null) => write!(
                page,
                "<td>{}</td><td>{}</td><td class=\"l words{}\">{}</td>",
                number(null.at_pose, 4),
                number(null.best_shifted, 4),
                if null.discriminating { "" } else { " caution" },
                margin_words(null)
            ),
            None => write!(page, "<td>{}</td><td>–</td><td class=\"l words dim\">no null</td>", number(scores.zncc, 4)),
        };
        let _ = write!(
            page,
            "<td>{}</td><td>{}</td><td>{}</td><td>{}</td></tr>",
            number(scores.rmse_nepers, 3),
            number(scores.edge_distance_mm, 2),
            number(pair.masks.as_ref().map(|masks| 100.0 * masks.masked), 1),
            number((total > 0.0).then_some(total), 0)
        );
    }
    page.push_str(
        "</tbody></table></div><p class=\"dim\" style=\"margin-top:8px\">ZNCC and best wrong pose are both of pictures at reduced size, at most 256 px wide: \
        the score at the stated pose, and the highest at other poses (±1, 3, 10 mm; ±1, 3°; turned round, negated, mirrored) and in mirrored pictures. Where a wrong \
        pose is better, the score does not tell the stated pose from it. Scores of the full picture stand with each exposure.</p>",
    );
}

fn over_time(page: &mut String, report: &SessionReport) {
    let end_us = report.ended_us.or_else(|| report.pairs.iter().filter_map(|pair| pair.time_us).max()).unwrap_or(0);
    let span = [0.0, seconds(report, end_us).max(1.0)];
    page.push_str("<h2>Over time</h2><div class=\"plots\">");
    let mut figure = |title: &str, note: &str, inside: String| {
        let _ = write!(page, "<figure><figcaption>{} <span>{}</span></figcaption>{inside}</figure>", escape(title), escape(note));
    };
    let dot = |pair: &Pair, value: Option<f64>, against: Option<f64>| -> Option<Dot> {
        Some(Dot {
            time_s: seconds(report, pair.time_us?),
            value: value?,
            class: pair.standing().class(),
            against,
            label: format!("{}: {}", pair.frame, number(value, 3)),
        })
    };
    let rms: Vec<Dot> = report.pairs.iter().filter_map(|pair| dot(pair, pair.rms_px, None)).collect();
    if let Some(svg) = plots::dots("bead residual over time", &rms, span, true) {
        figure("Bead residual", "rms, px", svg);
    }
    // Both ends of a stem are computed at null size; the score of the full image would not compare.
    let zncc = |pair: &Pair| pair.null.get("zncc").map_or((pair.scores.zncc, None), |null| (null.at_pose, null.best_shifted));
    let scores: Vec<Dot> = report.pairs.iter().filter_map(|pair| dot(pair, zncc(pair).0, zncc(pair).1)).collect();
    if let Some(svg) = plots::dots("ZNCC and its null over time", &scores, span, false) {
        figure("ZNCC", "at the stated pose; hollow: best wrong pose", svg);
    }
    let mut names: Vec<String> = Vec::new();
    for (name, _) in report.pairs.iter().flat_map(|pair| pair.stages_ms.iter()) {
        if !names.iter().any(|known| known == name) {
            names.push(name.to_owned());
        }
    }
    let bars: Vec<(String, Vec<f64>)> = report
        .pairs
        .iter()
        .enumerate()
        .map(|(index, pair)| {
            ((index + 1).to_string(), names.iter().map(|name| pair.stages_ms.get(name).unwrap_or(0.0)).collect())
        })
        .collect();
    if let Some((svg, legend)) = plots::stacks("milliseconds per stage", &names, &bars) {
        figure("Time per stage", "ms per exposure", svg + &legend);
    }
    if !report.links.is_empty() {
        let bands: Vec<plots::Band> = report
            .links
            .iter()
            .map(|link| {
                let at = |us: Option<i64>, otherwise: f64| us.map_or(otherwise, |us| seconds(report, us));
                let gaps = link
                    .gaps
                    .iter()
                    .map(|gap| ([seconds(report, gap.start_us), seconds(report, gap.end_us)], gap.reason.clone()))
                    .collect();
                let there_s = [at(link.first_us, 0.0), at(link.last_us, 0.0)];
                plots::Band { name: link.device.clone(), there_s, gaps }
            })
            .collect();
        figure("Links", "green: samples arrive; red: down", plots::links("links over time", &bands, span) + &link_table(report));
    }
    let exposures: Vec<f64> = report.pairs.iter().filter_map(|pair| Some(seconds(report, pair.time_us?))).collect();
    for track in &report.tracks {
        let series: Vec<(String, Vec<(f64, f64)>)> = track
            .series
            .iter()
            .map(|(name, points)| (name.clone(), points.iter().map(|(us, value)| (seconds(report, *us), *value)).collect()))
            .collect();
        if let Some((svg, legend)) = plots::lines(&track.title, &series, span, &exposures) {
            figure(&track.title, &format!("{}; dotted: exposures", track.unit), svg + &legend);
        }
    }
    page.push_str("</div>");
}

fn link_table(report: &SessionReport) -> String {
    let Some(first) = report.links.first() else {
        return String::new();
    };
    let mut text = String::from("<div style=\"overflow-x:auto\"><table><thead><tr><th class=\"l\">link</th>");
    for (name, _) in &first.counters {
        let _ = write!(text, "<th>{}</th>", escape(name));
    }
    text.push_str("<th>gaps</th></tr></thead><tbody>");
    for link in &report.links {
        let _ = write!(text, "<tr><td class=\"l\">{}</td>", escape(&link.device));
        for (name, _) in &first.counters {
            let count = link.counters.iter().find(|(known, _)| known == name).map(|(_, count)| *count);
            let _ = write!(text, "<td>{}</td>", count.map_or_else(|| "–".into(), |count| count.to_string()));
        }
        let _ = write!(text, "<td>{}</td></tr>", link.gaps.len());
    }
    text.push_str("</tbody></table></div>");
    text
}

fn list(page: &mut String, heading: &str, lines: impl Iterator<Item = String>, none: &str) {
    let _ = write!(page, "<div><h2>{heading}</h2><ul class=\"plain\">");
    let mut count = 0;
    for line in lines {
        let _ = write!(page, "<li>{}</li>", escape(&line));
        count += 1;
    }
    if count == 0 {
        let _ = write!(page, "<li class=\"dim\">{none}</li>");
    }
    page.push_str("</ul></div>");
}

fn honest_notes(page: &mut String, report: &SessionReport) {
    page.push_str("<div class=\"two\">");
    let times = |count: u64| if count == 1 { "once".to_owned() } else { format!("{count} times") };
    list(page, "Warnings", report.warnings.iter().map(|(kind, w)| format!("{kind}, {}: {}", times(w.count), w.latest)), "none");
    list(page, "Losses", report.losses.iter().cloned(), "nothing was lost");
    list(page, "Not modelled", report.not_modelled.iter().cloned(), "nothing stated");
    page.push_str("</div>");
}

fn provenance(page: &mut String, report: &SessionReport) {
    let from = &report.provenance;
    page.push_str("<h2>Provenance</h2><div class=\"scroll\"><table><tbody>");
    let mut row = |name: &str, value: &str| {
        let _ = write!(
            page,
            "<tr><td class=\"l dim\">{}</td><td class=\"l wrap\"><code>{}</code></td></tr>",
            escape(name),
            escape(value)
        );
    };
    row("sidecarm", &from.version);
    row("adapter", from.adapter.as_deref().unwrap_or("nothing was rendered"));
    from.details.iter().for_each(|(name, value)| row(name, value));
    from.inputs.iter().for_each(|(path, sha256)| row(path, sha256));
    page.push_str(
        "</tbody></table></div><p class=\"dim\" style=\"margin-top:14px\">For research use only; not a medical device.</p>",
    );
}
