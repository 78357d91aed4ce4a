//! What the page shows over time: residuals, scores, times per stage, links, joints.

use maud::{Markup, PreEscaped, html};

use super::html_parts::{number, table};
use super::pair::{Pair, Standing};
use super::session::{Gap, LinkReport, SessionReport, Track};
use crate::image::plot::{Axis, BAD, CAUTION, GOOD, Mark, Place, Plot, Scale, Series, Stroke, Tick};

/// Height of the axes, user units of the drawing.
const HEIGHT: f64 = 160.0;
/// Height of a link's band.
const BAND: f64 = 34.0;
/// More points of a line than the drawing has columns only make the page large.
const MOST_POINTS: usize = 900;
/// So many exposures have room for their numbers beside each other.
const MOST_NUMBERS: usize = 30;

pub(super) fn over_time(report: &SessionReport) -> Markup {
    let end_us = report.ended_us.or_else(|| report.pairs.iter().filter_map(|pair| pair.time_us).max()).unwrap_or(0);
    let span_s = [0.0, report.seconds(end_us).max(1.0)];
    html! {
        h2 { "Over time" }
        div class="plots" {
            (figure("Bead residual", "rms", &of_residuals(report, span_s), &html! {}))
            (figure("ZNCC", "at the stated pose, and at the best wrong one", &of_scores(report, span_s), &html! {}))
            (figure("Time per stage", "of each exposure", &of_stages(report), &html! {}))
            @if !report.links.is_empty() {
                (figure("Links", "when samples arrived", &of_links(report, span_s), &link_table(report)))
            }
            @for track in &report.tracks {
                (figure(&track.title, "dotted: exposures", &of_track(report, track, span_s), &html! {}))
            }
        }
    }
}

/// A plot under a heading, and what belongs below it; that alone where the plot has nothing to show.
fn figure(heading: &str, note: &str, plot: &Plot, below: &Markup) -> Markup {
    html! {
        @if let Ok(svg) = plot.svg() {
            figure { figcaption { (heading) " " span { (note) } } (PreEscaped(svg)) (below) }
        } @else {
            (below)
        }
    }
}

/// Over the session's time.
fn timed(title: &str, unit: &str, span_s: [f64; 2], series: Vec<Series>) -> Plot {
    Plot {
        title: title.to_owned(),
        place: Place::InPage { height: HEIGHT },
        x: Axis { range: Some(span_s), ..Axis::new("s since start", Scale::Linear) },
        y: Axis::new(unit, Scale::Linear),
        series,
        ..Plot::default()
    }
}

/// A dot for each exposure that has a value, a series for each way in which exposures came out.
fn dots(report: &SessionReport, value: impl Fn(&Pair) -> Option<f64>) -> Vec<Series> {
    let mut found: Vec<(Standing, Series)> = Vec::new();
    for pair in &report.pairs {
        let (Some(time_us), Some(value), standing) = (pair.time_us, value(pair), pair.standing()) else { continue };
        let at = found.iter().position(|(known, _)| *known == standing).unwrap_or_else(|| {
            let colour = match standing {
                Standing::Accepted => GOOD,
                Standing::Refused => BAD,
                _ => CAUTION,
            };
            let (label, colour) = (standing.short().to_owned(), Some(colour));
            found.push((standing, Series { label, stroke: Stroke::Points, colour, ..Series::default() }));
            found.len() - 1
        });
        let series = &mut found[at].1;
        series.points.push([report.seconds(time_us), value]);
        series.words.push(format!("{}: {}", pair.frame, number(Some(value), 3)));
    }
    found.into_iter().map(|(_, series)| series).collect()
}

fn of_residuals(report: &SessionReport, span_s: [f64; 2]) -> Plot {
    let mut plot = timed("bead residual over time", "px", span_s, dots(report, |pair| pair.rms_px));
    plot.y.holds = Some(0.0);
    plot
}

fn of_scores(report: &SessionReport, span_s: [f64; 2]) -> Plot {
    // Both ends of a stem are computed at null size; the score of the full image would not compare.
    let zncc = |pair: &Pair| pair.null.get("zncc").map_or((pair.scores.zncc, None), |null| (null.at_pose, null.best_shifted));
    let ends = |pair: &Pair| {
        let (time_s, (here, wrong)) = (report.seconds(pair.time_us?), zncc(pair));
        Some([[time_s, here?], [time_s, wrong?]])
    };
    let stems: Vec<[[f64; 2]; 2]> = report.pairs.iter().filter_map(ends).collect();
    let wrong = Series {
        label: "best wrong pose".to_owned(),
        points: stems.iter().map(|[_, wrong]| *wrong).collect(),
        stroke: Stroke::Rings,
        colour: Some(0),
        ..Series::default()
    };
    // What is no number lifts the pen.
    let points = stems.into_iter().flat_map(|[here, wrong]| [here, wrong, [f64::NAN; 2]]).collect();
    let stems = Series { points, stroke: Stroke::Dashed, colour: Some(0), ..Series::default() };
    let mut series = vec![stems, wrong];
    series.extend(dots(report, |pair| zncc(pair).0));
    timed("ZNCC and its null over time", "ZNCC", span_s, series)
}

/// Bars that begin at zero: of each stage with all before it, the highest behind.
fn of_stages(report: &SessionReport) -> Plot {
    let mut names: Vec<&str> = Vec::new();
    for (name, _) in report.pairs.iter().flat_map(|pair| pair.stages_ms.iter()) {
        if !names.contains(&name) {
            names.push(name);
        }
    }
    let ms = |pair: &Pair, name: &str| pair.stages_ms.get(name).filter(|ms| ms.is_finite()).unwrap_or(0.0);
    let series = (0..names.len()).rev().map(|stage| {
        let up_to = |pair: &Pair| names[..=stage].iter().map(|name| ms(pair, name)).sum::<f64>();
        Series {
            label: names[stage].to_owned(),
            points: (1u32..).zip(&report.pairs).map(|(at, pair)| [f64::from(at), up_to(pair)]).collect(),
            words: report.pairs.iter().map(|pair| format!("{}: {:.1} ms", names[stage], ms(pair, names[stage]))).collect(),
            stroke: Stroke::Bars,
            colour: Some(stage + 1),
        }
    });
    let count = report.pairs.len();
    let step = count.div_ceil(MOST_NUMBERS).max(1);
    let named = (1..=count).step_by(step).map(|at| Tick { value: at as f64, label: at.to_string() });
    Plot {
        title: "milliseconds per stage".to_owned(),
        place: Place::InPage { height: HEIGHT },
        x: Axis { range: Some([0.5, count as f64 + 0.5]), named: named.collect(), ..Axis::new("exposure", Scale::Linear) },
        y: Axis { holds: Some(0.0), ..Axis::new("ms", Scale::Linear) },
        series: series.collect(),
        ..Plot::default()
    }
}

/// A band for each link: there, and gone.
fn of_links(report: &SessionReport, span_s: [f64; 2]) -> Plot {
    let bands = |label: &str, colour: usize| Series {
        label: label.to_owned(),
        stroke: Stroke::Bands,
        colour: Some(colour),
        ..Series::default()
    };
    let (mut there, mut gone) = (bands("there", GOOD), bands("gone", BAD));
    let count = report.links.len() as f64;
    let middle = |index: usize| count - 0.5 - index as f64;
    for (index, LinkReport { first_us, last_us, gaps, .. }) in report.links.iter().enumerate() {
        let at = |us: i64| [report.seconds(us).clamp(span_s[0], span_s[1]), middle(index)];
        let ends = [first_us, last_us].map(|us| us.map_or([0.0, middle(index)], at));
        there.points.extend(ends);
        for Gap { start_us, end_us, reason } in gaps {
            gone.points.extend([*start_us, *end_us].map(at));
            let told = format!("{reason} ({:.2} s)", (end_us - start_us) as f64 * 1e-6);
            gone.words.extend([told, String::new()]);
        }
    }
    let name = |(index, link): (usize, &LinkReport)| Tick { value: middle(index), label: link.device.clone() };
    let named = report.links.iter().enumerate().map(name).collect();
    Plot {
        place: Place::InPage { height: BAND * count },
        y: Axis { range: Some([0.0, count]), named, ..Axis::default() },
        ..timed("links over time", "", span_s, vec![there, gone])
    }
}

fn of_track(report: &SessionReport, track: &Track, span_s: [f64; 2]) -> Plot {
    let line = |(name, points): &(String, Vec<(i64, f64)>)| {
        let step = points.len().div_ceil(MOST_POINTS).max(1);
        let points = points.iter().step_by(step).map(|(us, value)| [report.seconds(*us), *value]);
        Series { label: name.clone(), points: points.collect(), ..Series::default() }
    };
    let exposures = report.pairs.iter().filter_map(|pair| pair.time_us);
    let mark = |us: i64| Mark { x: report.seconds(us), label: String::new() };
    Plot {
        marks: exposures.map(mark).collect(),
        ..timed(&track.title, &track.unit, span_s, track.series.iter().map(line).collect())
    }
}

fn link_table(report: &SessionReport) -> Markup {
    let names: Vec<&str> =
        report.links.first().map(|link| link.counters.iter().map(|(name, _)| &**name).collect()).unwrap_or_default();
    // On a page of pictures `frames` would be those.
    let words = names.iter().map(|name| if *name == "frames" { "packets" } else { *name });
    let headings: Vec<&str> = ["<link"].into_iter().chain(words).chain(["gaps"]).collect();
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

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn packets_are_not_called_frames() {
        let link = LinkReport {
            device: "carm".to_owned(),
            first_us: None,
            last_us: None,
            counters: vec![("frames".to_owned(), 7)],
            gaps: Vec::new(),
        };
        let page = link_table(&SessionReport { links: vec![link], ..SessionReport::default() }).into_string();
        assert!(page.contains("packets") && !page.contains("frames") && page.contains("<td>7</td>"), "{page}");
    }

    /// The counters of the links were on no page whose plot could not be drawn.
    #[test]
    fn what_belongs_below_a_plot_is_shown_without_it() {
        let below = html! { p { "counters" } };
        let plot = |points: Vec<[f64; 2]>| timed("links", "", [0.0, 1.0], vec![Series { points, ..Series::default() }]);
        assert_eq!(figure("Links", "", &plot(Vec::new()), &below).into_string(), "<p>counters</p>");
        let drawn = figure("Links", "", &plot(vec![[0.0, 1.0], [1.0, 2.0]]), &below).into_string();
        assert!(drawn.contains("<svg") && drawn.contains("<p>counters</p>"), "{drawn}");
    }
}
