//! How long a pair takes in a session: the sum of its stages from the frame that is read, its null, and the whole time from the frame that lies
//! in its folder to the files that are written, with all waiting, reading and queueing.
#![cfg(unix)]

use std::collections::BTreeMap;
use std::path::Path;
use std::time::UNIX_EPOCH;

use serde_json::Value;

use crate::lab_truth::{counter_of, file_of};
use crate::live_lab::{HANG_S, Lab, Live};
use crate::register_times::built;

/// Milliseconds that the median pair of the live size may take, one of 1536², and the null of either, on a machine that does nothing else.
const PAIR_MS: f64 = 400.0;
const LARGE_PAIR_MS: f64 = 1500.0;
const NULL_MS: f64 = 300.0;
/// What the whole may take besides: the folder is looked at, a file must lie still, it is read, threads wait for each other, files are written.
/// With the stages it is a second at the live size.
const OTHER_MS: f64 = 600.0;
/// The first pair of a session may take so much longer: it comes to a renderer that was warmed up.
const FIRST_TIMES: f64 = 2.5;

/// Smallest, median and largest; `None` of nothing.
fn spread(mut values: Vec<f64>) -> Option<[f64; 3]> {
    values.sort_by(f64::total_cmp);
    Some([*values.first()?, values[values.len() / 2], *values.last()?])
}

/// Milliseconds of the first pair, of the median one, of the median null where there is one, and of the median whole.
struct Found {
    title: &'static str,
    first_ms: f64,
    pair_ms: f64,
    null_ms: Option<f64>,
    whole_ms: f64,
}

/// When a file was written, ms since 1970.
fn written_ms(path: &Path) -> f64 {
    let modified =
        std::fs::metadata(path).and_then(|file| file.modified()).unwrap_or_else(|error| panic!("{}: {error}", path.display()));
    modified.duration_since(UNIX_EPOCH).expect("after 1970").as_secs_f64() * 1e3
}

/// Of each pair, from its frame's file to that of its DRR, with which it can be seen, and to its strip, which waits for the null.
fn wholes_ms(lab: &Lab, live: &Live, pairs: &[&Value]) -> Vec<[f64; 2]> {
    let whole = |pair: &&Value| {
        let text = |key: &str| pair[key].as_str().unwrap_or_else(|| panic!("no {key}: {pair:#}"));
        let delivered_ms = written_ms(&file_of(lab, counter_of(text("frame"))));
        ["drr", "strip"].map(|key| written_ms(&live.out.join(text(key))) - delivered_ms)
    };
    pairs.iter().map(whole).collect()
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
    let accepted: Vec<&Value> =
        pairs["pairs"].as_array().into_iter().flatten().filter(|pair| pair["status"] == "accepted").collect();
    let rows: Vec<_> = accepted.iter().map(|pair| &timings[&pair["number"].as_u64().expect("a number")]).collect();
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
    let wholes_ms = wholes_ms(&lab, &live, &accepted);
    println!("  from the file of the frame to that of the DRR, and to the strip with its null: first {:.0?}", wholes_ms[0]);
    let [to_drr_ms, to_strip_ms] = [0, 1].map(|end| spread(wholes_ms.iter().map(|whole| whole[end]).collect()).expect("rows"));
    println!("  to the DRR {to_drr_ms:.0?}\n  to the strip {to_strip_ms:.0?}");
    let beside_ms = rows.iter().zip(&wholes_ms).map(|(stages, [to_drr_ms, _])| to_drr_ms - whole(stages)).collect();
    println!("  of it no stage (waiting, reading, queues, writing) {:.0?}", spread(beside_ms).expect("rows"));
    let null_ms = stage_ms("null").map(|spread| spread[1]);
    Some(Found { title, first_ms, pair_ms: pair_ms[1], null_ms, whole_ms: to_drr_ms[1] })
}

#[test]
#[ignore = "minutes long: scripts/evaluate pairs runs it"]
fn pairs_and_their_nulls() {
    println!("{}", built());
    // Every figure is printed before any is judged.
    let found = [(None, PAIR_MS), (Some("1536"), LARGE_PAIR_MS)].map(|(panel_px, most_ms)| (times_of(panel_px), most_ms));
    let mut slow = Vec::new();
    for (times, most_ms) in found {
        let Some(Found { title, first_ms, pair_ms, null_ms, whole_ms }) = times else { return };
        let first_most_ms = FIRST_TIMES * most_ms;
        println!("{title}: first pair {first_ms:.0} ms, {first_most_ms:.0} allowed");
        if !(first_ms <= first_most_ms) {
            slow.push(format!("{title}: {first_ms:.0} ms for the first pair, {first_most_ms:.0} allowed"));
        }
        if !(pair_ms <= most_ms) {
            slow.push(format!("{title}: {pair_ms:.0} ms a pair, {most_ms:.0} allowed"));
        }
        let whole_most_ms = most_ms + OTHER_MS;
        println!("{title}: {whole_ms:.0} ms from a frame's file to its DRR's, {whole_most_ms:.0} allowed");
        if !(whole_ms <= whole_most_ms) {
            slow.push(format!("{title}: {whole_ms:.0} ms from a frame's file to its DRR's, {whole_most_ms:.0} allowed"));
        }
        if !null_ms.is_some_and(|ms| ms <= NULL_MS) {
            slow.push(format!("{title}: {null_ms:.0?} ms a null, {NULL_MS:.0} allowed"));
        }
    }
    assert!(slow.is_empty(), "{slow:#?}");
}
