//! `sidecarm time` and `sidecarm trade` through the program itself.

use std::path::Path;
use std::process::{Command, Output};

use serde_json::{Value, json};

use crate::scene_support::NiftiFile;

/// A block of bone in tissue, a steel ball beside it.
fn folder() -> tempfile::TempDir {
    let folder = tempfile::tempdir().expect("folder");
    let hounsfield = |index: usize| {
        let from_centre = [index % 16, index / 16 % 16, index / 256].map(|at| (at as i32 - 7).abs());
        match from_centre.into_iter().max() {
            Some(0..3) => 1200,
            Some(3..6) => 40,
            _ => -1000,
        }
    };
    let voxels: Vec<i16> = (0..4096).map(hounsfield).collect();
    NiftiFile::int16([16; 3], &voxels).write(&folder.path().join("ct.nii"));
    let scene = json!({
        "objects": [{"ct": {"path": "ct.nii"}},
                    {"sphere": {"centre_lps_mm": [-4, -8, 8], "radius_mm": 2, "material": "steel_316l"}}],
        "view": {"size_px": [200, 150], "intrinsics": [[5000, 0, 99.5], [0, 5000, 74.5], [0, 0, 1]],
                 "camera_from_lps": [[1, 0, 0, 7], [0, 0, -1, 8], [0, 1, 0, 600], [0, 0, 0, 1]]},
        "beam": {"tube_kvp": 80, "filtration_mm": {"aluminium": 3}, "photons_per_pixel": 1e5},
        "detector": {"response": "energy", "pitch_mm": 0.2}
    });
    std::fs::write(folder.path().join("scene.json"), scene.to_string()).expect("writes");
    folder
}

fn sidecarm(folder: &Path, args: &[&str]) -> Output {
    Command::new(env!("CARGO_BIN_EXE_sidecarm")).args(args).current_dir(folder).output().expect("runs")
}

fn printed(output: &Output) -> Value {
    assert_eq!(output.status.code(), Some(0), "{}", String::from_utf8_lossy(&output.stderr));
    serde_json::from_slice(&output.stdout).expect("JSON")
}

#[test]
fn every_view_and_every_change_is_timed() {
    let folder = folder();
    let view = |x: f64| json!([[1, 0, 0, x], [0, 0, -1, 8], [0, 1, 0, 600], [0, 0, 0, 1]]);
    std::fs::write(folder.path().join("views.json"), json!([view(7.0), view(9.0)]).to_string()).expect("writes");
    let report =
        printed(&sidecarm(folder.path(), &["time", "scene.json", "--views", "views.json", "--repeat", "2", "--changes"]));
    let views = report["views"].as_array().expect("views");
    assert_eq!(views.len(), 2);
    for view in views {
        let ms = |name: &str| view[name].as_f64().expect("a time");
        assert!(ms("fastest_ms") > 0.0 && ms("fastest_ms") <= ms("median_ms") && ms("median_ms") <= ms("wall_ms"), "{view}");
        assert!(ms("stated_error") <= 1e-3, "{view}");
    }
    assert!(report["images_per_second"].as_f64().expect("a rate") > 0.0);
    let changes = report["changes"].as_array().expect("changes");
    let named: Vec<&str> = changes.iter().filter_map(|change| change["what"].as_str()).collect();
    assert_eq!(named, ["nothing", "robot", "c_arm", "spectrum", "ct"]);
    assert!(changes.iter().all(|change| change["wall_ms"].as_f64().is_some_and(|ms| ms > 0.0)), "{changes:?}");
}

#[test]
fn what_cannot_be_timed_is_refused() {
    let folder = folder();
    let none = sidecarm(folder.path(), &["time", "scene.json", "--repeat", "0"]);
    assert_eq!(none.status.code(), Some(2), "{}", String::from_utf8_lossy(&none.stderr));
    let less = sidecarm(folder.path(), &["time", "scene.json", "--repeat", "-1"]);
    assert!(less.status.code() == Some(2) && String::from_utf8_lossy(&less.stderr).contains("whole number from 1"), "{less:?}");
    for error in ["nan", "0", "-1", "inf"] {
        let ran = sidecarm(folder.path(), &["time", "scene.json", "--repeat", "1", "--max-error", error]);
        let stderr = String::from_utf8_lossy(&ran.stderr);
        assert!(ran.status.code() == Some(1) && stderr.contains("expected a positive number"), "{error}: {stderr}");
        assert!(ran.stdout.is_empty(), "{error}");
    }
    // As `render` refuses it; it was timed at the bound that there is.
    let ran = sidecarm(folder.path(), &["time", "scene.json", "--repeat", "1", "--max-error", "1e-9"]);
    let stderr = String::from_utf8_lossy(&ran.stderr);
    assert!(ran.status.code() == Some(1) && stderr.contains("--max-error 1e-9: the plan's bound is"), "{stderr}");
    assert!(stderr.contains("render --reference") && ran.stdout.is_empty(), "{stderr}");
    std::fs::write(folder.path().join("views.json"), "[]").expect("writes");
    let empty = sidecarm(folder.path(), &["time", "scene.json", "--views", "views.json"]);
    let stderr = String::from_utf8_lossy(&empty.stderr);
    assert!(empty.status.code() == Some(1) && stderr.contains("views.json: it holds no matrix"), "{stderr}");
    std::fs::write(folder.path().join("views.json"), "[[[2,0,0,0],[0,2,0,0],[0,0,2,0],[0,0,0,1]]]").expect("writes");
    let scaled = sidecarm(folder.path(), &["time", "scene.json", "--views", "views.json"]);
    let stderr = String::from_utf8_lossy(&scaled.stderr);
    assert_eq!(scaled.status.code(), Some(1), "{stderr}");
    assert!(stderr.contains("views.json") && stderr.contains("not rigid"), "{stderr}");
}

#[test]
fn a_trade_judges_pixels_between_those_that_were_cast() {
    let folder = folder();
    let ran = sidecarm(folder.path(), &["trade", "scene.json", "--out", "trade", "--json"]);
    let trade = printed(&ran);
    // Progress names the sampling as the table does, not as the program calls it.
    let stderr = String::from_utf8_lossy(&ran.stderr);
    assert!(stderr.contains(" energies, step 1: ") && !stderr.contains("Exact") && !stderr.contains("None"), "{stderr}");
    let rows = trade["rows"].as_array().expect("rows");
    let error = |row: &Value| row["achieved"]["error"].as_f64().expect("an error");
    let best = |step: u64| {
        let of_step = rows.iter().filter(|row| row["step_px"] == step && row["displacement"] == "exact");
        of_step.map(error).min_by(f64::total_cmp).expect("a row")
    };
    let (whole, second, fourth) = (best(1), best(2), best(4));
    assert!(whole < 3e-6, "{whole:e}");
    // Edges of bone and steel are interpolated across.
    assert!(second > 1e-3 && fourth > second, "{second:e} {fourth:e}");
    for row in rows.iter().filter(|row| !row["stated_error"].is_null()) {
        assert!(error(row) <= row["stated_error"].as_f64().expect("a bound"), "{row}");
    }
    let ms = |row: &Value| row["achieved"]["ms"].as_f64().expect("a time");
    for row in rows {
        let no_worse = |other: &&Value| ms(other) <= ms(row) && error(other) <= error(row);
        let beaten = rows.iter().filter(no_worse).any(|other| ms(other) < ms(row) || error(other) < error(row));
        assert_eq!(row["on_front"] == true, !beaten, "{row}");
    }
    for (file, says) in [("trade.json", "judged_rays"), ("trade.txt", "cell by cell"), ("trade.svg", "Pareto front")] {
        let text = std::fs::read_to_string(folder.path().join("trade").join(file)).expect("written");
        assert!(text.contains(says), "{file}");
    }
}
