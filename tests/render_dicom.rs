//! DRRs as DICOM: what others read of them is what was rendered.

use std::path::Path;
use std::process::Command;

use serde_json::{Value, json};
use sidecarm::acquire::{Domain, read_frame};
use sidecarm::image::read_tiff_f32;

fn scene(folder: &Path) -> std::path::PathBuf {
    let value = json!({
        "objects": [{"sphere": {"centre_lps_mm": [5.0, -3.0, 0.0], "radius_mm": 20.0, "material": "water"}}],
        // From the patient's left and somewhat from above: neither angle is 0.
        "view": {"size_px": [96, 64], "intrinsics": [[2000.0, 0.0, 40.0], [0.0, 2000.0, 30.0], [0.0, 0.0, 1.0]],
                 "camera_from_lps": [[1.0, 0.0, 0.0, 0.0], [0.0, 0.8, -0.6, 0.0], [0.0, 0.6, 0.8, 600.0], [0.0, 0.0, 0.0, 1.0]]},
        "beam": {"mono_kev": 60}, "detector": {"pitch_mm": 0.5}
    });
    let path = folder.join("scene.json");
    std::fs::write(&path, value.to_string()).expect("written");
    path
}

fn render(folder: &Path, quantity: &str) -> std::process::Output {
    let mut command = Command::new(env!("CARGO_BIN_EXE_sidecarm"));
    command.arg("render").arg(scene(folder)).arg("--out").arg(folder.join("drr.tif"));
    command
        .arg("--dicom")
        .arg(folder.join("drr.dcm"))
        .args(["--quantity", quantity, "--device", "cpu"])
        .output()
        .expect("it starts")
}

#[test]
fn a_drr_in_dicom_holds_its_values_and_its_geometry() {
    let folder = tempfile::tempdir().expect("a folder");
    let file = folder.path().join("drr.dcm");
    for (quantity, domain, per_unit) in [("intensity", Domain::Linear, 50_000.0), ("line_integral", Domain::Log, 4_000.0)] {
        let run = render(folder.path(), quantity);
        assert!(run.status.success(), "{}", String::from_utf8_lossy(&run.stderr));
        let (tif, frame) =
            (read_tiff_f32(&folder.path().join("drr.tif")).expect("a TIFF"), read_frame(&file, None).expect("a frame"));
        assert_eq!(
            (frame.domain, frame.tags.sid_mm, frame.tags.pitch_mm),
            (domain, Some(1000.0), Some([0.5, 0.5])),
            "{quantity}"
        );
        let apart = tif[0].pixels.iter().zip(&frame.pixels.pixels).map(|(a, b)| (f64::from(*a) * per_unit - f64::from(*b)).abs());
        // Where nothing is in the beam a line integral is 0, which no valid pixel has here.
        assert!(apart.fold(0.0, f64::max) <= if quantity == "intensity" { 0.51 } else { 1.0 }, "{quantity}");
        let bytes = std::fs::read(&file).expect("readable");
        assert!(render(folder.path(), quantity).status.success());
        assert_eq!(std::fs::read(&file).expect("readable"), bytes, "the same image is the same object");

        match Command::new("dciodvfy").arg(&file).output() {
            Ok(verdict) => {
                let words = String::from_utf8_lossy(&verdict.stderr).into_owned() + &String::from_utf8_lossy(&verdict.stdout);
                assert!(!words.contains("Error") && words.contains("DXImageForProcessing"), "{words}");
            }
            Err(_) => println!("skipped: dciodvfy of dicom3tools is not installed"),
        }
        let script = "import sys, json, pydicom; d = pydicom.dcmread(sys.argv[1]); c = json.loads(d.ImageComments); \
                      print(json.dumps([d.Rows, d.Columns, float(d.PositionerPrimaryAngle), float(d.PositionerSecondaryAngle), \
                      c['projection'], c['stored_per_unit'], max(d.PixelData[1::2])]))";
        let read = Command::new("/usr/bin/python3").args(["-c", script]).arg(&file).output();
        match read.ok().filter(|read| read.status.success()) {
            Some(read) => {
                let told: Value = serde_json::from_slice(&read.stdout).expect("JSON");
                assert_eq!((&told[0], &told[1], &told[5]), (&json!(64), &json!(96), &json!(per_unit)), "{told}");
                // The beam goes to the back of the patient and 53 degrees towards the head.
                let [primary, secondary] = [&told[2], &told[3]].map(|angle| angle.as_f64().expect("a number"));
                let beam = [0.0, 0.6, 0.8];
                let (p, s) = (primary.to_radians(), secondary.to_radians());
                // DICOM: the beam at (0, 0) goes from posterior to anterior (LPS −y); primary + turns it to the left, secondary + to the head.
                let said = [s.cos() * p.sin(), -s.cos() * p.cos(), s.sin()];
                assert!(said.iter().zip(beam).all(|(a, b)| (a - b).abs() < 1e-3), "{said:?} {told}");
                let depth: Vec<f64> = serde_json::from_value(told[4][2].clone()).expect("four numbers");
                assert!(depth.iter().zip([0.0, 0.6, 0.8, 600.0]).all(|(a, b)| (a - b).abs() < 1e-9), "{told}");
            }
            None => println!("skipped: pydicom is not installed"),
        }
    }
    let refused = render(folder.path(), "area_density");
    let words = String::from_utf8_lossy(&refused.stderr);
    assert!(!refused.status.success() && words.contains("area densities are no radiograph"), "{words}");
}
