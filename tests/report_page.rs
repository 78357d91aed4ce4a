//! The report's page in a narrow window: wide tables scroll in boxes of their own, pictures and plots take the width there is.

use std::collections::BTreeMap;

use sidecarm::image::Image;
use sidecarm::report::{BeadRow, Gap, LinkReport, Pair, PoseSource, Provenance, SessionReport, Track, png_bytes, report_page};

/// A table, a plot and a picture of each kind that the page has.
fn page() -> String {
    let bead = BeadRow { name: "B1".into(), found_px: None, residual_px: None, used: false, reason: None, check: false };
    let pair = |number: i64, path: &str| Pair {
        time_us: Some(1_000_000 * number),
        pose_source: PoseSource::Telemetry,
        rms_px: Some(0.2),
        beads: vec![bead.clone()],
        strip: Some(path.to_owned()),
        ..Pair::unmatched("a_frame_with_a_long_name_as_consoles_give_them", "too few beads")
    };
    let link = LinkReport {
        device: "carm".into(),
        first_us: Some(0),
        last_us: Some(9_000_000),
        counters: vec![("frames".into(), 100), ("corrupt".into(), 1)],
        gaps: vec![Gap { start_us: 1_000_000, end_us: 2_000_000, reason: "unplugged".into() }],
    };
    let track = Track {
        title: "C-arm angles".into(),
        unit: "deg".into(),
        series: vec![("orbital".into(), vec![(0, 1.0), (9_000_000, 2.0)])],
    };
    let strip = png_bytes(&Image::filled(1932, 507, [40; 3]));
    report_page(&SessionReport {
        title: "Session".into(),
        started_us: Some(0),
        ended_us: Some(10_000_000),
        pairs: vec![pair(1, "strips/001.png"), pair(2, "strips/002.png")],
        links: vec![link],
        tracks: vec![track],
        provenance: Provenance { inputs: vec![("ct.nii.gz".into(), "0f".repeat(32))], ..Provenance::default() },
        pictures: ["strips/001.png", "strips/002.png"].map(|path| (path.to_owned(), strip.clone())).into(),
        ..SessionReport::default()
    })
}

/// How many tables there are, and how many of them have no box that scrolls.
fn tables(page: &str) -> [usize; 2] {
    let is_boxed = |at: usize| {
        let before = page[..at].trim_end();
        let after = page[at..].split_once("</table>").map_or("", |(_, after)| after.trim_start());
        let has_box = ["scroll", "fold", "over"].iter().any(|class| before.ends_with(&format!("<div class=\"{class}\">")));
        has_box && after.starts_with("</div>")
    };
    let places: Vec<usize> = page.match_indices("<table").map(|(at, _)| at).collect();
    [places.len(), places.iter().filter(|at| !is_boxed(**at)).count()]
}

fn style(page: &str) -> &str {
    page.split_once("<style>").and_then(|(_, rest)| rest.split_once("</style>")).map_or("", |(style, _)| style)
}

/// Whether the style sheet says `declaration` of `selector`, whatever the width of the window.
fn says(style: &str, selector: &str, declaration: &str) -> bool {
    let rules = style.split('}').filter_map(|rule| rule.split_once('{'));
    let of_it = rules.filter(|(selectors, _)| selectors.split(',').any(|one| one.trim() == selector));
    of_it.flat_map(|(_, body)| body.split(';')).any(|one| one.trim() == declaration)
}

/// The rules of the first block for windows of at most so many px.
fn narrow<'a>(style: &'a str, px: &str) -> &'a str {
    let block = style.split_once(&format!("@media(max-width:{px}px){{\n"));
    block.and_then(|(_, rest)| rest.split_once("\n}")).map_or("", |(rules, _)| rules)
}

#[test]
fn every_table_of_the_page_scrolls_in_a_box_of_its_own() {
    let page = page();
    // Exposures, links, provenance; of each exposure the scores and the beads.
    assert_eq!(tables(&page), [7, 0]);
    let style = style(&page);
    for class in [".scroll", ".fold", ".over"] {
        assert!(says(style, class, "overflow-x:auto"), "{class}");
    }
    // A box in a grid is no wider than its column.
    assert!(says(style, ".two>*", "min-width:0"));
    // Control: without their boxes, or closed before the table ends, they do not.
    let bare = page.replace("<div class=\"over\">", "<div>");
    assert_eq!(tables(&bare), [7, 5]);
    assert!(!says(&style.replace("overflow-x:auto", ""), ".over", "overflow-x:auto"));
}

#[test]
fn pictures_and_plots_take_the_width_that_there_is() {
    let page = page();
    let style = style(&page);
    // Pictures are backgrounds of boxes as wide as what they stand in, and as high as the picture's shape asks.
    assert!(!page.contains("<img"), "a picture of its own needs a rule that lets it shrink");
    let tags = |what: &str| -> Vec<String> {
        let opened = page.match_indices(what).map(|(at, _)| {
            let from = page[..=at].rfind('<').unwrap_or(0);
            page[from..].split('>').next().unwrap_or_default().to_owned()
        });
        opened.collect()
    };
    for (class, count) in [("class=\"strip p", 2), ("class=\"shot p", 2)] {
        let found = tags(class);
        assert_eq!(found.len(), count, "{class}");
        for tag in found {
            assert!(tag.contains("aspect-ratio:") && !tag.contains("width:"), "{tag}");
        }
    }
    for selector in [".strip", ".tile .shot"] {
        assert!(says(style, selector, "display:block"), "{selector}");
    }
    assert!(says(style, ".strip", "background-size:100% 100%"));
    let plots = tags("<svg");
    assert!(plots.len() >= 3 && plots.iter().all(|tag| tag.contains("viewBox=")), "{plots:?}");
    assert!(says(style, "svg", "width:100%") && says(style, "svg", "height:auto"));
    // Nothing is wider than a window of 1000 px but what may be narrower.
    let mut widths = BTreeMap::new();
    for (at, _) in style.match_indices("width:") {
        let name = style[..at].rsplit(['{', ';', '(']).next().unwrap_or_default();
        let digits: String = style[at + 6..].chars().take_while(char::is_ascii_digit).collect();
        if let (true, Ok(px)) = (style[at + 6 + digits.len()..].starts_with("px"), digits.parse::<u32>()) {
            widths.insert(format!("{name}width:{px}px"), (name != "max-", px));
        }
    }
    assert!(widths.len() >= 3, "{widths:?}");
    assert!(widths.values().all(|(is_fixed, px)| !is_fixed || *px < 600), "{widths:?}");
}

/// Reasons hold paths and names of files, which have no spaces to break at.
#[test]
fn long_words_are_broken() {
    let page = page();
    for selector in ["p", "summary", ".plain li", "td.name"] {
        assert!(says(style(&page), selector, "overflow-wrap:anywhere"), "{selector}");
    }
}

/// At 1000 px the table of exposures hid its columns of masks and times at its right end.
#[test]
fn in_a_narrow_window_the_many_columns_fold_and_each_cell_names_its_own() {
    let page = page();
    let table = page.split("<h2>Exposures</h2>").nth(1).and_then(|rest| rest.split("</table>").next()).expect("the table");
    let text = |html: &str| html.replace("<br>", " ");
    let headings: Vec<String> =
        table.split("<th").skip(2).filter_map(|th| Some(text(th.split_once('>')?.1.split("</th>").next()?))).collect();
    assert!(headings.len() >= 13, "{headings:?}");
    let rows: Vec<Vec<&str>> = table
        .split("<tr>")
        .skip(2)
        .map(|row| row.split(" data-of=\"").skip(1).filter_map(|cell| cell.split('"').next()).collect())
        .collect();
    assert_eq!(rows.len(), 2, "two exposures");
    for (row, cells) in rows.iter().zip(table.split("<tr>").skip(2)) {
        assert_eq!(row, &headings, "cells name their columns");
        assert_eq!(cells.matches("<td").count(), headings.len(), "no cell is without a name");
    }
    // As wide as a window of 1000 px is, and wider ones in which the columns would not fit.
    let rules = narrow(style(&page), "1180");
    for (selector, declaration) in [
        (".fold thead", "display:none"),
        (".fold tr", "display:grid"),
        (".fold tr", "grid-template-columns:repeat(auto-fill,minmax(108px,1fr))"),
        (".fold td", "white-space:normal"),
        (".fold td", "min-width:0"),
        (".fold td", "overflow-wrap:anywhere"),
        (".fold td::before", "content:attr(data-of)"),
    ] {
        assert!(says(rules, selector, declaration), "{selector}: {declaration}");
    }
    assert!(!says(rules, ".fold tr", "display:table-row") && narrow(style(&page), "640").is_empty(), "control");
}
