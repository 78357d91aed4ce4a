//! How long a pair takes in a session, from the frame that is read to the strip that is written, and its null.
#![cfg(unix)]

use std::collections::BTreeMap;

use serde_json::Value;

use crate::live_lab::{HANG_S, Lab, Live};

/// Milliseconds that the median pair of the live size may take, one of 1536², and the null of either, on a machine that does nothing else.
const PAIR_MS: f64 = 400.0;
const LARGE_PAIR_MS: f64 = 1500.0;
const NULL_MS: f64 = 300.0;
/// The first pair of a session may take so much longer: it comes to a renderer that was warmed up.
const FIRST_TIMES: f64 = 2.5;

/// Smallest, median and largest; `None` of nothing.
fn spread(mut values: Vec<f64>) -> Option<[f64; 3]> {
    values.sort_by(f64::total_cmp);
    Some([*values.first()?, values[values.len() / 2], *values.last()?])
}

/// Milliseconds of the first pair, of the median one, and of the median null where there is one.
struct Found {
    title: &'static str,
    first_ms: f64,
    pair_ms: f64,
    null_ms: Option<f64>,
}

fn times_of(panel_px: Option<&'static str>) -> Option<Found> {
    let mut args = vec!["--duration-s", "80", "--exposures", "12", "--faults", "none", "--linger-s", "10"];
    args.extend(panel_px.iter().flat_map(|panel| ["--panel-px", panel]));
    let lab = Lab::start(&args)?;
    let folder = tempfile::tempdir().expect("temporary folder");
    let mut live = Live::launch(&lab.kit.join("session.json"), &folder.path().join("session"), &["--seconds", "84"]);
    let code = live.program.end(HANG_S).expect("it ends").code();
    let text = std::fs::read(live.out.join("timings.json")).expect("timings");
    let timings: Value = serde_json::from_slice(&text).expect("JSON");
    let frames = timings["frames"].as_array().expect("a list");
    let stages = |row: &Value| serde_json::from_value(row["stages_ms"].clone()).expect("milliseconds by stage");
    let timings: BTreeMap<u64, BTreeMap<String, f64>> =
        frames.iter().map(|row| (row["number"].as_u64().expect("a number"), stages(row))).collect();
    let text = std::fs::read(live.out.join("pairs.json")).expect("pairs");
    let pairs: Value = serde_json::from_slice(&text).expect("JSON");
    let accepted = |number: &u64| {
        pairs["pairs"].as_array().into_iter().flatten().any(|pair| pair["number"] == *number && pair["status"] == "accepted")
    };
    let rows: Vec<_> = timings.iter().filter(|(number, _)| accepted(number)).map(|(_, stages)| stages).collect();
    assert!(rows.len() >= 4, "{} of {} frames: {code:?} {}", rows.len(), timings.len(), live.stderr());
    // The pair stands before its null is made and the drill's tip is looked for.
    let is_later = |name: &str| ["null", "tip"].contains(&name);
    let whole = |stages: &BTreeMap<String, f64>| stages.iter().filter(|(name, _)| !is_later(name)).map(|(_, ms)| ms).sum::<f64>();
    let pair_ms = spread(rows.iter().map(|stages| whole(stages)).collect()).expect("rows");
    let stage_ms = |name: &str| spread(rows.iter().filter_map(|stages| stages.get(name)).copied().collect());
    let title = panel_px.unwrap_or("620x480 (the live size)");
    println!("{title}: {} accepted pairs, milliseconds least, median, most", rows.len());
    let first_ms = whole(rows[0]);
    println!("  first pair {first_ms:.0}");
    println!("  pair       {pair_ms:.0?}");
    let mut names: Vec<&String> = rows.iter().flat_map(|stages| stages.keys()).collect();
    names.sort();
    names.dedup();
    for name in names {
        println!("  {name:10} {:.0?}", stage_ms(name).expect("rows"));
    }
    Some(Found { title, first_ms, pair_ms: pair_ms[1], null_ms: stage_ms("null").map(|spread| spread[1]) })
}

#[test]
#[ignore = "minutes long: scripts/evaluate pairs runs it"]
fn pairs_and_their_nulls() {
    // Every figure is printed before any is judged.
    let found = [(None, PAIR_MS), (Some("1536"), LARGE_PAIR_MS)].map(|(panel_px, most_ms)| (times_of(panel_px), most_ms));
    let mut slow = Vec::new();
    for (times, most_ms) in found {
        let Some(Found { title, first_ms, pair_ms, null_ms }) = times else { return };
        let first_most_ms = FIRST_TIMES * most_ms;
        println!("{title}: first pair {first_ms:.0} ms, {first_most_ms:.0} allowed");
        if !(first_ms <= first_most_ms) {
            slow.push(format!("{title}: {first_ms:.0} ms for the first pair, {first_most_ms:.0} allowed"));
        }
        if !(pair_ms <= most_ms) {
            slow.push(format!("{title}: {pair_ms:.0} ms a pair, {most_ms:.0} allowed"));
        }
        if !null_ms.is_some_and(|ms| ms <= NULL_MS) {
            slow.push(format!("{title}: {null_ms:.0?} ms a null, {NULL_MS:.0} allowed"));
        }
    }
    assert!(slow.is_empty(), "{slow:#?}");
}
