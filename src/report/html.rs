//! The session's report as one HTML file: no script, no network, a small picture of every strip, and links to the files beside it.

use maud::{DOCTYPE, Markup, PreEscaped, html};
use rayon::prelude::*;

use super::html_exposures::each_exposure;
use super::html_parts::{Shown, folding_table, margin_words, number, shown};
use super::html_time::over_time;
use super::pair::{Pair, PairStatus};
use super::session::SessionReport;
use super::strip::telling_rectangle;
use crate::time::utc;

/// Width of a tile of the contact sheet in CSS pixels.
const TILE_PX: f64 = 220.0;

/// The whole page, with the strips that the report holds.
#[must_use]
pub fn report_page(report: &SessionReport) -> String {
    page(report, &|path| report.pictures.get(path).cloned())
}

/// The whole page; `strip` gives the bytes of the PNG that a pair names.
pub(super) fn page(report: &SessionReport, strip: &(dyn Fn(&str) -> Option<Vec<u8>> + Sync)) -> String {
    let title = if report.title.is_empty() { "Session" } else { &report.title };
    let small = |pair: &Pair| shown(&strip(pair.strip.as_deref()?)?);
    let strips: Vec<Option<Shown>> = report.pairs.par_iter().map(small).collect();
    let page = html! {
        (DOCTYPE)
        html lang="en" {
            head {
                meta charset="utf-8";
                meta name="viewport" content="width=device-width";
                meta name="generator" content={ "sidecarm " (report.provenance.version) };
                title { (title) " · Sidecarm" }
                style { (PreEscaped(include_str!("style.css"))) (backgrounds(&strips)) }
            }
            body {
                main {
                    (summary(report, title))
                    (losses_and_warnings(report))
                    (contact_sheet(report, &strips))
                    (exposures(report))
                    (over_time(report))
                    (each_exposure(report, &strips))
                    (list("Not modelled", &report.not_modelled, "nothing stated"))
                    (provenance(report))
                }
            }
        }
    };
    page.into_string() + "\n"
}

/// Small pictures as backgrounds: each is in the file once, for the tile and for the strip.
fn backgrounds(strips: &[Option<Shown>]) -> PreEscaped<String> {
    let rule = |(index, strip): (usize, &Option<Shown>)| {
        strip.as_ref().map(|strip| format!(".p{index}{{background-image:url(data:image/jpeg;base64,{})}}\n", strip.base64))
    };
    PreEscaped(strips.iter().enumerate().filter_map(rule).collect())
}

fn median(mut values: Vec<f64>) -> Option<f64> {
    values.sort_unstable_by(f64::total_cmp);
    let upper = *values.get(values.len() / 2)?;
    Some(if values.len().is_multiple_of(2) { f64::midpoint(values[values.len() / 2 - 1], upper) } else { upper })
}

fn summary(report: &SessionReport, title: &str) -> Markup {
    let counts = report.counts();
    let lasted = report
        .started_us
        .zip(report.ended_us)
        .filter(|(a, b)| b > a)
        .map(|(a, b)| format!(" · {:.0} s to the last packet", (b - a) as f64 * 1e-6));
    let rms = median(report.pairs.iter().filter_map(|pair| pair.rms_px).collect());
    let zncc = median(report.pairs.iter().filter_map(|pair| pair.scores.zncc).collect());
    let warned: u64 = report.warnings.values().map(|counted| counted.count).sum();
    let card = |class: &str, value: &str, words: &str| {
        html! { div class="card" { b class=(class) { (value) } span { (words) } } }
    };
    let count = |class: &str, count: usize, words: &str| card(if count > 0 { class } else { "" }, &count.to_string(), words);
    let doubts = [
        (counts.image_disagrees, "accepted, image disagrees"),
        (counts.telemetry_disagrees, "accepted, telemetry disagrees"),
        (counts.in_doubt, "accepted, in doubt"),
    ];
    let own = report.pairs.iter().filter(|pair| pair.copy_of.is_none());
    let robot_words: Vec<&str> = own.filter_map(Pair::robot_words).collect();
    html! {
        h1 { (title) }
        p class="dim" {
            (report.started_us.map(utc).unwrap_or_default()) (lasted.unwrap_or_default()) " "
            (report.provenance.command.as_deref().unwrap_or(""))
        }
        div class="cards" {
            (count("", counts.exposures, "exposures"))
            @if counts.copies > 0 {
                (count("", counts.copies, if counts.copies == 1 { "copy" } else { "copies" }))
            }
            (count("good", counts.accepted, "accepted"))
            @for (number, words) in doubts.into_iter().filter(|(number, _)| *number > 0) {
                (count("caution", number, words))
            }
            (count("bad", counts.refused, "refused"))
            (count("caution", counts.no_pose, "not registered"))
            (card("", &number(rms, 3), "median rms, px"))
            (card("", &number(zncc, 3), "median ZNCC"))
            (count("caution", warned as usize, "warnings"))
            (count("bad", report.losses.len(), "losses"))
        }
        @if counts.from_telemetry > 0 {
            p class="dim" style="margin-top:12px" { (counts.from_telemetry) " shown with the pose from telemetry." }
        }
        @if let Some(first) = robot_words.first() {
            p class="caution" style="margin-top:12px" { (robot_words.len()) " of " (counts.exposures) ": " (first) "." }
        }
    }
}

fn contact_sheet(report: &SessionReport, strips: &[Option<Shown>]) -> Markup {
    html! {
        h2 { "Contact sheet" }
        div class="sheet" {
            @for (index, (pair, strip)) in report.pairs.iter().zip(strips).enumerate() {
                a class={ "tile " (pair.standing().class()) } href={ "#e" (index) } title=(pair.status_line()) {
                    @match strip {
                        Some(strip) => span class={ "shot p" (index) } style=(tile_style(pair, strip)) {},
                        None => span class="shot" style={ "height:" (format!("{:.0}", 0.75 * TILE_PX)) "px" } {},
                    }
                    span class="words" {
                        i { (pair.frame) }
                        span {
                            @match pair.rms_px.filter(|_| pair.status == PairStatus::Accepted) {
                                Some(px) => (format!("{px:.3} px")),
                                None => (pair.standing().short()),
                            }
                        }
                    }
                }
            }
        }
    }
}

/// Which part of a strip its tile shows.
fn tile_style(pair: &Pair, strip: &Shown) -> String {
    let [left, top, width, height] = telling_rectangle(pair.masks.is_some(), strip.width, strip.height);
    let size = [strip.width as f64 / width, strip.height as f64 / height].map(|part| 100.0 * part);
    let at = [100.0 * left / (strip.width as f64 - width), 100.0 * top / (strip.height as f64 - height)];
    format!(
        "aspect-ratio:{width:.1}/{height:.1};background-size:{:.2}% {:.2}%;background-position:{:.3}% {:.3}%",
        size[0], size[1], at[0], at[1]
    )
}

fn exposures(report: &SessionReport) -> Markup {
    let truth = report.pairs.iter().any(|pair| pair.truth.is_some());
    let mut headings = vec!["<frame", "time\ns", "<bound by", "<status", "rms\npx", "rms\nmm"];
    headings.extend(truth.then_some("truth error\npx"));
    headings.extend(["ZNCC", "best wrong\npose", "<here, against that", "RMSE\nnepers", "edges\nmm", "masked\n%", "total\nms"]);
    let rows = report.pairs.iter().enumerate().map(|(index, pair)| row(report, index, pair, truth));
    html! {
        h2 { "Exposures" }
        (folding_table(&headings, rows))
        p class="dim" style="margin-top:8px" {
            "ZNCC and best wrong pose are both of pictures at reduced size, at most 256 px wide: the score at the stated pose, and the \
             highest at other poses (±1, 3, 10 mm; ±1, 3°; turned round, negated, mirrored) and in mirrored pictures. Where a wrong pose is \
             better, the score does not tell the stated pose from it. Scores of the full picture stand with each exposure."
        }
    }
}

/// The cells of a row: class and content.
fn row(report: &SessionReport, index: usize, pair: &Pair, truth: bool) -> Vec<(&'static str, Markup)> {
    let (standing, scores) = (pair.standing(), &pair.scores);
    let total: f64 = pair.stages_ms.iter().map(|(_, ms)| ms).sum();
    let of_number = |value: Option<f64>, decimals: usize| ("", html! { (number(value, decimals)) });
    let frame = html! { a href={ "#e" (index) } title=[pair.note.as_deref()] { (pair.frame) @if pair.note.is_some() { " *" } } };
    let badge = html! { span class={ "badge " (standing.class()) } { (standing.word().to_lowercase()) } };
    let mut cells = vec![
        ("l name", frame),
        of_number(pair.time_us.map(|us| report.seconds(us)), 2),
        ("l", html! { (pair.binding) }),
        ("l words", badge),
        of_number(pair.rms_px, 3),
        of_number(pair.rms_mm, 3),
    ];
    cells.extend(truth.then(|| of_number(pair.truth.map(|truth| truth.mean_px), 3)));
    // Scores of pictures of two sizes do not compare: beside its null stands the score at null size.
    cells.extend(match pair.null.get("zncc") {
        Some(null) => {
            let class = if null.discriminating { "l words" } else { "l words caution" };
            [of_number(null.at_pose, 4), of_number(null.best_shifted, 4), (class, html! { (margin_words(null)) })]
        }
        None => [of_number(scores.zncc, 4), of_number(None, 4), ("l words dim", html! { "no null" })],
    });
    cells.extend([
        of_number(scores.rmse_nepers, 3),
        of_number(scores.edge_distance_mm, 2),
        of_number(pair.masks.as_ref().map(|masks| 100.0 * masks.masked), 1),
        of_number((total > 0.0).then_some(total), 0),
    ]);
    cells
}

fn list(heading: &str, lines: &[String], none: &str) -> Markup {
    html! {
        div {
            h2 { (heading) }
            ul class="plain" {
                @for line in lines { li { (line) } }
                @if lines.is_empty() { li class="dim" { (none) } }
            }
        }
    }
}

/// What a reader must know before the exposures.
fn losses_and_warnings(report: &SessionReport) -> Markup {
    let times = |count: u64| if count == 1 { "once".to_owned() } else { format!("{count} times") };
    let warnings: Vec<String> =
        report.warnings.iter().map(|(kind, told)| format!("{kind}, {}: {}", times(told.count), told.latest)).collect();
    html! {
        div class="two" {
            (list("Losses", &report.losses, "nothing was lost"))
            (list("Warnings", &warnings, "none"))
        }
    }
}

fn provenance(report: &SessionReport) -> Markup {
    let from = &report.provenance;
    let adapter = from.adapter.as_deref().unwrap_or("nothing was rendered");
    let first = [("sidecarm", &*from.version), ("adapter", adapter)];
    let others = from.details.iter().chain(&from.inputs).map(|(name, value)| (&**name, &**value));
    html! {
        h2 { "Provenance" }
        div class="scroll" {
            table {
                tbody {
                    @for (name, value) in first.into_iter().chain(others) {
                        tr { td class="l dim" { (name) } td class="l wrap" { code { (value) } } }
                    }
                }
            }
        }
        p class="dim" style="margin-top:14px" { "For research use only; not a medical device." }
    }
}

#[cfg(test)]
mod tests {
    use super::median;

    #[test]
    fn the_median_of_two_lies_between_them() {
        assert_eq!(median(vec![0.2, 0.05]), Some(0.125));
        assert_eq!(median(vec![3.0, 1.0, 2.0]), Some(2.0));
        assert_eq!(median(Vec::new()), None);
    }
}
