//! The strip, the HTML report and `pairs.json`, made from closed-form images.

use std::path::Path;

use glam::DVec3;
use sidecarm::compare::{CompareInput, Tone, compare};
use sidecarm::geometry::{Rigid, View};
use sidecarm::image::Image;
use sidecarm::pose::{Pose, Refusal};
use sidecarm::report::{
    BeadRow, Gap, LinkReport, Pair, PairStatus, PairsFile, PoseSource, Provenance, SessionReport, Standing, StripInput, Track,
    TruthError, counted, counted_of, png_bytes, report_page, restated, strip, write_session,
};
use sidecarm::timeline::NO_EXPOSURE;

use crate::compare_synthetic::{acquired, line_integral, pose, view};

const START_US: i64 = 1_795_000_000_000_000;

/// With telemetry, frames of a session that names no beads counted as refused.
#[test]
fn a_frame_without_beads_to_look_for_was_not_tried_whatever_telemetry_tells() {
    let layout = || Refusal::Layout { detail: "the session names no beads".to_owned() };
    for source in [PoseSource::Telemetry, PoseSource::None] {
        assert_eq!(PairStatus::of(&Pose::default().refused_for(layout()), source), PairStatus::NoPose);
        assert_eq!(PairStatus::of(&Pose::default().refused_for(Refusal::Unsolved), source), PairStatus::Refused);
    }
    let pair = |status| Pair { status, pose_source: PoseSource::Telemetry, ..Pair::unmatched("a", "no beads") };
    let pairs = [pair(PairStatus::NoPose), pair(PairStatus::NoPose), pair(PairStatus::Refused)];
    assert_eq!(counted(&pairs), "3 frames, 0 accepted, 1 refused, 2 not registered");
    assert_eq!(pairs[0].standing(), Standing::Telemetry, "its pose is telemetry's");
}

/// Three exposures of which two were exported again were five exposures, five of them accepted; of a session that was left at once, what the
/// log held was not counted.
#[test]
fn copies_and_what_is_not_finished_are_counted_apart() {
    let pair = |copy_of| Pair { status: PairStatus::Accepted, copy_of, ..Pair::unmatched("a", "") };
    let pairs = vec![pair(None), pair(None), pair(None), pair(Some(2)), pair(Some(3))];
    assert_eq!(counted(&pairs), "5 frames, 3 accepted, 2 copies");
    assert_eq!(counted(&pairs[..4]), "4 frames, 3 accepted, 1 copy");
    let counts = SessionReport { pairs: pairs.clone(), ..SessionReport::default() }.counts();
    assert_eq!([counts.exposures, counts.accepted, counts.copies], [3, 3, 2]);
    assert_eq!(counted_of(&[], 3, 3), "3 frames, 0 accepted, 3 not finished");
    assert_eq!(counted_of(&pairs[..3], 3, 2), "3 frames, 3 accepted, 2 not finished");
    assert_eq!(counted_of(&pairs, 6, 1), "6 frames, 3 accepted, 1 not finished, 2 copies");
}

/// A pair with its strip; `turn_deg` off the truth when refused.
fn exposure(index: usize) -> (Pair, Image<[u8; 3]>) {
    let truth = View { camera_from_lps: pose(DVec3::new(0.2, 0.3 - 0.15 * index as f64, 0.1)), ..view() };
    let mut frame = acquired(&line_integral(&truth), 0.02);
    frame.name = format!("frame_{:03}", index + 1);
    let mut pair = Pair::unmatched(&frame.name, "the frame could not be bound to an exposure: two intervals fit");
    pair.time_us = Some(START_US + 2_600_000 * (index as i64 + 1));
    pair.stages_ms.add("detect", 12.0 + index as f64);
    pair.stages_ms.add("register", 4.0);
    if index == 4 {
        let picture = strip(&StripInput {
            acquired: &frame,
            pictures: None,
            masks: None,
            without: pair.reason.as_deref(),
            marks: None,
            standing: pair.standing(),
            status: &pair.status_line(),
            scores: &pair.score_words(),
            mm_per_px: None,
        });
        return (pair, picture);
    }
    let error = if index == 2 { 0.012 } else { 0.0 };
    let stated =
        View { camera_from_lps: Rigid::exp(DVec3::new(0.0, 0.4 * error, error), DVec3::ZERO) * truth.camera_from_lps, ..truth };
    let simulated = line_integral(&stated);
    let input = CompareInput {
        view: Some(&stated),
        centre_lps_mm: Some(DVec3::ZERO),
        tone: if index == 3 { Tone::Gain } else { Tone::None },
        ..CompareInput::new(&frame, &simulated)
    };
    let mut compared = compare(&input).expect("comparable");
    compared.add_null(&mut |small| Ok(line_integral(small)), &|| false).expect("null");
    (pair.binding, pair.reason) = ("counter".into(), None);
    pair.binding_evidence = vec![format!("exposure counter {}", 17 + index)];
    if index == 2 {
        (pair.status, pair.pose_source) = (PairStatus::Refused, PoseSource::Telemetry);
        pair.reason = Some("3 beads found, 4 are needed: two lie outside the field, three behind the robot".into());
    } else {
        (pair.status, pair.pose_source) = (PairStatus::Accepted, PoseSource::Beads);
        (pair.rms_px, pair.rms_mm) = (Some(0.041 + 0.011 * index as f64), Some(0.0094 + 0.0025 * index as f64));
        pair.truth = Some(TruthError { mean_px: 0.05, mean_mm: Some(0.012) });
    }
    pair.robot_source = Some("sensed".into());
    pair.stages_ms.add("render", 180.0 + 9.0 * index as f64);
    pair.stages_ms.add("compare", 41.0);
    pair.set_comparison(&compared.comparison);
    let picture = strip(&StripInput {
        acquired: &frame,
        pictures: Some(&*compared.pictures),
        masks: None,
        without: None,
        marks: None,
        standing: pair.standing(),
        status: &pair.status_line(),
        scores: &pair.score_words(),
        mm_per_px: compared.comparison.mm_per_px,
    });
    (pair, picture)
}

fn session(folder: &Path) -> SessionReport {
    std::fs::create_dir_all(folder.join("strips")).expect("folder");
    let mut pairs = Vec::new();
    for index in 0..6 {
        let (mut pair, picture) = exposure(index);
        let path = format!("strips/{:03}.png", index + 1);
        std::fs::write(folder.join(&path), png_bytes(&picture)).expect("writes");
        pair.strip = Some(path);
        if index == 0 {
            let row = |name: &str, used, reason: Option<&str>, check| BeadRow {
                name: name.into(),
                found_px: Some([100.25, 90.5]).filter(|_| used),
                residual_px: Some([0.03, -0.04]).filter(|_| used),
                used,
                reason: reason.map(str::to_owned),
                check,
            };
            pair.beads = vec![
                row("B1", true, None, false),
                row("B2", false, Some("behind the robot"), false),
                row("B3", false, None, true),
            ];
        }
        pairs.push(pair);
    }
    let angle =
        |phase: f64| (0..400).map(|i| (START_US + 50_000 * i, 20.0 * (0.01 * i as f64 + phase).sin())).collect::<Vec<_>>();
    SessionReport {
        title: "Demo <session> & friends".into(),
        started_us: Some(START_US),
        ended_us: Some(START_US + 20_000_000),
        pairs,
        links: ["carm", "robot"]
            .map(|device| LinkReport {
                device: device.into(),
                first_us: Some(START_US + 40_000),
                last_us: Some(START_US + 19_900_000),
                counters: [("frames", 598), ("corrupt", 2), ("lost", 3), ("duplicate", 1), ("reordered", 0), ("stale", 0)]
                    .map(|(name, count)| (name.to_owned(), count))
                    .to_vec(),
                gaps: vec![Gap { start_us: START_US + 8_000_000, end_us: START_US + 9_300_000, reason: "unplugged".into() }],
            })
            .to_vec(),
        tracks: vec![Track {
            title: "C-arm angles".into(),
            unit: "deg".into(),
            series: vec![("orbital".into(), angle(0.0)), ("angulation".into(), angle(1.0)), ("wig-wag".into(), angle(2.4))],
        }],
        losses: vec!["carm: 3 samples lost on the wire".into()],
        not_modelled: vec!["scatter is not modelled: behind 20 cm of tissue it can exceed the primary signal".into()],
        provenance: Provenance {
            version: "0.1.0".into(),
            adapter: Some("CPU executor, 2 cores".into()),
            command: Some("demo".into()),
            inputs: vec![("phantom.nii.gz".into(), "0f".repeat(32))],
            details: Vec::new(),
        },
        ..SessionReport::default()
    }
}

#[test]
fn a_session_becomes_one_page_without_outside_resources() {
    let scratch = tempfile::tempdir().expect("scratch");
    let kept = std::env::var_os("SIDECARM_LOOK").map(std::path::PathBuf::from);
    let folder = kept.as_deref().unwrap_or(scratch.path());
    let report = session(folder);
    assert!(write_session(folder, &report).is_empty());
    let page = std::fs::read_to_string(folder.join("report.html")).expect("page");
    for outside in ["http://", "https://", "<script", "src=\"", "@import", "<session>"] {
        assert!(!page.contains(outside), "{outside}");
    }
    assert_eq!(page.matches("data:image/jpeg;base64,").count(), 6, "every picture once");
    // Strips of ten frames made a page of ten megabytes.
    assert!(page.len() < 6 * 100_000, "{} bytes for 6 frames", page.len());
    assert_eq!(page.matches("href=\"strips/").count(), 12, "each strip is linked, as picture and by name");
    for wanted in [
        "prefers-color-scheme",
        "pose from telemetry",
        "no pose",
        "3 beads found",
        "unplugged",
        "Demo &lt;session&gt; &amp; friends",
    ] {
        assert!(page.contains(wanted), "{wanted}");
    }
    // Which wrong pose is the best one stands beside its score.
    let mut named = 0;
    for null in report.pairs.iter().flat_map(|pair| pair.null.values()) {
        let (Some(score), Some(shift)) = (null.best_shifted, null.best_shift.as_deref()) else { continue };
        let cell = format!("<td>{score:.4} <small>{shift}</small></td>").replace(">-", ">−");
        assert!(page.contains(&cell), "{cell}");
        named += 1;
    }
    assert!(named > 5, "{named} scores have a best wrong pose");
    assert_eq!(page.matches("class=\"tile ").count(), 6);
    let counts = report.counts();
    assert_eq!((counts.exposures, counts.accepted, counts.refused, counts.no_pose, counts.from_telemetry), (6, 4, 1, 1, 1));

    // The score beside its null is of the same size; that of the full picture stood there before.
    let null = &report.pairs[0].null["zncc"];
    let (here, wrong) = (null.at_pose.expect("scored"), null.best_shifted.expect("scored"));
    let table = page.split("<h2>Exposures</h2>").nth(1).and_then(|rest| rest.split("</table>").next()).expect("the table");
    let by = here - wrong;
    let by = if by >= 1e-3 { format!("{by:.4}") } else { format!("{by:.0e}") };
    // Without the headings that a narrow window shows beside the cells.
    let headings = regex::Regex::new(" data-of=\"[^\"]*\"").expect("a pattern");
    let table = headings.replace_all(table, "");
    let cells = format!("<td>{here:.4}</td><td>{wrong:.4}</td><td class=\"l words\">better by {by}</td>");
    assert!(table.contains(&cells), "{cells}");
    let full = report.pairs[0].scores.zncc.expect("scored");
    assert!((full - here).abs() > 1e-4 && !table.contains(&format!("<td>{full:.4}</td><td>{wrong:.4}</td>")), "{full} {here}");
    // Each bead: used, or why not.
    assert_eq!(page.matches("part in P").count(), 1, "one frame has beads");
    for cell in [
        "<td>100.25, 90.50</td><td>0.030, −0.040</td><td>0.050</td><td class=\"l words\">used</td>",
        "behind the robot",
        "kept to check P",
    ] {
        assert!(page.contains(cell), "{cell}");
    }

    let text = std::fs::read_to_string(folder.join("pairs.json")).expect("pairs");
    let value: serde_json::Value = serde_json::from_str(&text).expect("json");
    let first = &value["pairs"][0];
    for key in ["frame", "time_us", "binding", "pose_source", "status", "rms_px", "rms_mm", "scores", "null", "stages_ms"] {
        assert!(!first[key].is_null(), "{key}");
    }
    assert_eq!((first["pose_source"].as_str(), first["status"].as_str()), (Some("beads"), Some("accepted")));
    assert!(first["scores"]["zncc"].as_f64().expect("number") > 0.98 && first["null"]["zncc"]["discriminating"].is_boolean());
    for pair in value["pairs"].as_array().expect("pairs").iter().filter(|pair| pair["status"] == "accepted") {
        let px = pair["scores"]["edge_distance_px"].as_f64().expect("edges");
        assert!(px < 0.5, "{}: at the true pose edges lie {px} px apart", pair["frame"]);
    }
    let back: PairsFile = serde_json::from_str(&text).expect("reads back");
    assert_eq!(back.pairs.len(), 6);
}

#[test]
fn an_empty_session_and_a_missing_strip_still_make_a_page() {
    let page = report_page(&SessionReport::default());
    assert!(page.contains("nothing was lost"));
    // Losses are read first.
    let places = ["Losses", "Warnings", "Contact sheet", "Exposures", "Not modelled", "Provenance"]
        .map(|name| page.find(&format!("<h2>{name}</h2>")));
    assert!(places.iter().all(Option::is_some) && places.is_sorted(), "{places:?}");
    let mut pair = Pair::unmatched("frame_001", "no telemetry");
    pair.strip = Some("strips/001.png".into());
    let page = report_page(&SessionReport { pairs: vec![pair], ..SessionReport::default() });
    assert!(page.contains("strips/001.png is missing"));
}

/// A robot that is drawn as in the scene file is not to be taken for one that telemetry tells of.
#[test]
fn a_robot_that_no_telemetry_tells_of_is_said_on_strip_and_page() {
    let of = |source: &str, binding: &str, evidence: &str| Pair {
        robot_source: Some(source.to_owned()),
        binding: binding.to_owned(),
        binding_evidence: vec![evidence.to_owned()],
        ..Pair::unmatched("frame_001", "too few beads")
    };
    let (uncovered, unbound) = ("no telemetry covers the exposure", "the frame is bound to no exposure");
    // The line above the pictures of a strip.
    let drawn = |pair: &Pair| {
        let blank = Image::filled(1900, 80, [0; 3]);
        restated(blank, &pair.frame, pair.standing(), &pair.status_line())
    };
    let told = of("sensed", "counter", "exposure 3");
    assert_eq!((told.robot_words(), told.status_line().as_str()), (None, "too few beads"), "control");
    assert!(!counted(std::slice::from_ref(&told)).contains("robot"));
    let mut cases = 0;
    for (binding, evidence, why) in
        [("counter", "exposure 3", uncovered), ("none", NO_EXPOSURE, uncovered), ("none", "two exposures fit", unbound)]
    {
        let pair = of("scene", binding, evidence);
        let words = format!("robot drawn as in the scene file: {why}");
        let line = format!("{words} · too few beads");
        assert_eq!(pair.status_line(), line, "{binding}, {evidence}");
        assert!(drawn(&pair).pixels != drawn(&told).pixels, "the strip shows it: {words}");
        assert!(counted(std::slice::from_ref(&pair)).contains("1 with the robot drawn as in the scene file"));
        let page = report_page(&SessionReport { pairs: vec![told.clone(), pair], ..SessionReport::default() });
        // At its head, on the contact sheet, and with the exposure.
        let places =
            [format!("1 of 2: {words}."), format!("title=\"{line}\""), format!(">{line}</span>"), format!("<li>{words}</li>")];
        for place in places {
            assert!(page.contains(&place), "{place}");
        }
        cases += 1;
    }
    assert_eq!(cases, 3);
}

#[test]
fn a_strip_shows_four_panels_and_a_frame_without_a_drr_stands_there_large() {
    let frame = acquired(&line_integral(&view()), 0.01);
    let alone = strip(&StripInput {
        acquired: &frame,
        pictures: None,
        masks: None,
        without: Some("no pose"),
        marks: None,
        standing: Standing::NoPose,
        status: "no telemetry",
        scores: &[],
        mm_per_px: None,
    });
    let simulated = line_integral(&view());
    let compared = compare(&CompareInput::new(&frame, &simulated)).expect("comparable");
    let full = strip(&StripInput {
        pictures: Some(&*compared.pictures),
        masks: None,
        without: None,
        marks: None,
        standing: Standing::Accepted,
        ..StripInput {
            acquired: &frame,
            pictures: None,
            masks: None,
            without: None,
            marks: None,
            standing: Standing::Accepted,
            status: "",
            scores: &[],
            mm_per_px: Some(0.228),
        }
    });
    assert!(full.width > 4 * 310 && full.height > 240);
    // As wide; a frame of 310 × 240 px stands in twice its size beside the words, below the header and above the scale.
    assert_eq!((alone.width, alone.height), (full.width, full.height + 2 * 240 - 356));
    let teal = full.pixels.iter().filter(|p| p[1] > 190 && p[0] < 110).count();
    let none = alone.pixels.iter().filter(|p| p[1] > 190 && p[0] < 110).count();
    assert!(teal > 500 && none == 0, "edges are drawn: {teal}, without a DRR: {none}");
}
