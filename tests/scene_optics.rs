//! Beam shape and panel in scene files: what they become, and what is said of mistakes.

use std::path::Path;

use glam::{DVec2, DVec3};
use serde_json::{Value, json};
use sidecarm::reporter::Reporter;
use sidecarm::scene::optics::{Axis, Field, Heel, Towards};
use sidecarm::scene::{self, Scene};

fn load(value: &Value) -> Result<Scene, String> {
    scene::load_text(&value.to_string(), Path::new("SCENE.json"), true, &Reporter::silent()).map_err(|error| error.to_string())
}

fn example() -> Value {
    json!({
        "objects": [{"sphere": {"centre_lps_mm": [1, 2, 3], "radius_mm": 5, "material": "water"}}],
        "view": {"size_px": [620, 480], "intrinsics": [[5257, 0, 309.5], [0, 5257, 239.5], [0, 0, 1]],
            "camera_from_lps": [[1, 0, 0, 0], [0, 0, -1, 0], [0, 1, 0, 600], [0, 0, 0, 1]]},
        "beam": {"tube_kvp": 110, "anode_angle_deg": 10, "filtration_mm": {"aluminium": 4.3}, "photons_per_pixel": 5e5,
            "heel": {"anode_towards": "-column"},
            "bowtie": {"material": "aluminium", "axis": "row", "thickness_mm": [[-8, 12.0], [0, 1.5], [8, 12.0]]},
            "field": {"rectangle": {"size_mm": [200, 150], "centre_mm": [5, 0], "rotation_deg": 10}},
            "focal_spot_mm": 0.6},
        "detector": {"response": "energy", "pitch_mm": 0.194, "blur_fwhm_mm": 0.34, "bits": 16, "saturation": 1.2,
            "scintillator": {"material": "csi", "thickness_mm": 0.6}, "grid": {"primary_transmission": 0.7}}
    })
}

#[test]
fn beam_shape_and_panel_load() {
    let scene = load(&example()).expect("good");
    let (shape, panel) = (&scene.beam.shape, &scene.detector.panel);
    assert_eq!(shape.heel, Some(Heel { tube_kvp: 110.0, anode_angle_deg: 10.0, anode_towards: Towards::MinusColumn }));
    let bowtie = shape.bowtie.as_ref().expect("there");
    assert_eq!((bowtie.axis, bowtie.density_g_per_cm3), (Axis::Row, 2.699));
    // 4 degrees up in the fan's plane: halfway between 1.5 and 12 mm.
    let ray = DVec3::new(0.0, 4f64.to_radians().tan(), 1.0);
    assert!((bowtie.area_density(ray) - 0.2699 * 6.75).abs() < 1e-12);
    assert!((bowtie.area_density(ray + DVec3::X) / (0.2699 * 6.75) - 1.0) > 0.3, "longer out of the plane");
    let expected = Field::Rectangle { size_mm: DVec2::new(200.0, 150.0), centre_mm: DVec2::new(5.0, 0.0), rotation_deg: 10.0 };
    assert_eq!(shape.field.as_ref(), Some(&expected));
    assert_eq!(shape.focal_spot_mm, [0.6, 0.6]);
    assert_eq!((panel.bits, panel.saturation, panel.blur_fwhm_mm), (Some(16), Some(1.2), 0.34));
    assert_eq!(panel.scintillator.as_ref().expect("there").density_g_per_cm3, 4.51);
    assert_eq!(panel.grid.expect("there").primary_transmission, 0.7);
    let mut other = example();
    other["beam"]["field"] = json!({"polygon": {"corners_mm": [[0, 0], [10, 0], [0, 10]]}});
    other["beam"]["focal_spot_mm"] = json!([0.6, 1.0]);
    let other = load(&other).expect("good");
    assert_eq!(other.beam.shape.focal_spot_mm, [0.6, 1.0]);
    let triangle = other.beam.shape.field.expect("there");
    assert!(triangle.contains(DVec2::new(2.0, 2.0)) && !triangle.contains(DVec2::new(6.0, 6.0)));
}

#[test]
fn mistakes_in_beam_and_panel_name_key_and_place() {
    type Change = fn(&mut Value);
    let cases: [(&str, Change, &[&str]); 34] = [
        ("unknown in bowtie", |s| s["beam"]["bowtie"]["thick"] = json!(1), &["beam.bowtie", "thick"]),
        ("bowtie axis", |s| s["beam"]["bowtie"]["axis"] = json!("x"), &["beam.bowtie.axis", "column"]),
        ("bowtie material", |s| s["beam"]["bowtie"]["material"] = json!("aluminum1"), &["beam.bowtie.material"]),
        ("bowtie empty", |s| s["beam"]["bowtie"]["thickness_mm"] = json!([]), &["beam.bowtie.thickness_mm", "at least 1"]),
        ("bowtie negative", |s| s["beam"]["bowtie"]["thickness_mm"][1][1] = json!(-2), &["beam.bowtie.thickness_mm", "-2"]),
        ("bowtie order", |s| s["beam"]["bowtie"]["thickness_mm"][1][0] = json!(-9), &["beam.bowtie.thickness_mm", "-9"]),
        ("bowtie angle", |s| s["beam"]["bowtie"]["thickness_mm"][2][0] = json!(90), &["beam.bowtie.thickness_mm", "90"]),
        ("bowtie density", |s| s["beam"]["bowtie"]["density_g_per_cm3"] = json!(0), &["beam.bowtie.density_g_per_cm3", "0"]),
        ("bowtie formula", |s| s["beam"]["bowtie"]["material"] = json!("Ti90Al6V4"), &["beam.bowtie.material", "density"]),
        ("heel side", |s| s["beam"]["heel"]["anode_towards"] = json!("left"), &["beam.heel", "+column"]),
        ("heel key", |s| s["beam"]["heel"]["angle"] = json!(3), &["beam.heel", "angle"]),
        (
            "heel without tube",
            |s| {
                let beam = s["beam"].as_object_mut().expect("an object");
                beam.remove("tube_kvp");
                beam.remove("anode_angle_deg");
                beam.insert("mono_kev".to_owned(), json!(60));
            },
            &["beam.heel", "tube_kvp"],
        ),
        ("anode angle", |s| s["beam"]["anode_angle_deg"] = json!(2), &["anode angle 2"]),
        ("tube 0", |s| s["beam"]["tube_kvp"] = json!(0), &["beam.tube_kvp", "0 kV"]),
        ("tube 500", |s| s["beam"]["tube_kvp"] = json!(500), &["beam.tube_kvp", "500 kV"]),
        ("filter", |s| s["beam"]["filtration_mm"]["aluminium"] = json!(-0.1), &["beam.filtration_mm.aluminium", "-0.1"]),
        ("field shape", |s| s["beam"]["field"] = json!({"oval": {}}), &["beam.field", "oval"]),
        ("field two", |s| s["beam"]["field"]["circle"] = json!({"diameter_mm": 3}), &["beam.field"]),
        ("field key", |s| s["beam"]["field"]["rectangle"]["size"] = json!(3), &["beam.field.rectangle", "size"]),
        ("field size", |s| s["beam"]["field"]["rectangle"]["size_mm"] = json!([0, 3]), &["beam.field.rectangle.size_mm", "0"]),
        (
            "field corners",
            |s| s["beam"]["field"] = json!({"polygon": {"corners_mm": [[0, 0], [1, 1]]}}),
            &["beam.field.polygon.corners_mm", "at least 3"],
        ),
        ("iris", |s| s["beam"]["field"] = json!({"circle": {"diameter_mm": -1}}), &["beam.field.circle.diameter_mm", "-1"]),
        ("spot", |s| s["beam"]["focal_spot_mm"] = json!(-0.6), &["beam.focal_spot_mm", "-0.6"]),
        ("spot text", |s| s["beam"]["focal_spot_mm"] = json!("NaN"), &["beam.focal_spot_mm", "width in mm"]),
        ("layer", |s| s["detector"]["scintillator"]["thickness_mm"] = json!(-1), &["detector.scintillator.thickness_mm", "-1"]),
        ("layer key", |s| s["detector"]["scintillator"]["mm"] = json!(1), &["detector.scintillator", "mm"]),
        ("blur", |s| s["detector"]["blur_fwhm_mm"] = json!(-0.3), &["detector.blur_fwhm_mm", "-0.3"]),
        ("no saturation", |s| s["detector"]["saturation"] = json!(0), &["detector.saturation", "0"]),
        ("no bits", |s| s["detector"]["bits"] = json!(0), &["detector.bits", "1 to 24"]),
        ("many bits", |s| s["detector"]["bits"] = json!(40), &["detector.bits", "40"]),
        ("half bits", |s| s["detector"]["bits"] = json!(8.5), &["detector.bits", "8.5"]),
        ("grid", |s| s["detector"]["grid"]["primary_transmission"] = json!(1.1), &["detector.grid.primary_transmission", "1.1"]),
        ("grid key", |s| s["detector"]["grid"]["ratio"] = json!(10), &["detector.grid", "ratio"]),
        ("gain", |s| s["detector"]["gain"] = json!(0), &["detector.gain", "0"]),
    ];
    assert!(load(&example()).is_ok(), "unchanged it loads");
    for (what, change, words) in cases {
        let mut scene = example();
        change(&mut scene);
        let error = load(&scene).expect_err(what);
        let good = error.starts_with("SCENE.json") && !error.contains('\n') && words.iter().all(|word| error.contains(word));
        assert!(good, "{what}: {error}");
    }
}

#[test]
fn energies_off_the_tables_are_refused() {
    let folder = tempfile::tempdir().expect("temporary folder");
    let mut cases = 0;
    for (csv, words) in [("30,1\n200,1\n", ["row 3", "200 keV"]), ("0.5,1\n1.5,1\n", ["row 2", "0.5 keV"])] {
        std::fs::write(folder.path().join("s.csv"), format!("energy_kev,fluence\n{csv}")).expect("written");
        let mut scene = example();
        scene["beam"] = json!({"spectrum_csv": "s.csv"});
        let path = folder.path().join("scene.json");
        let error = scene::load_text(&scene.to_string(), &path, true, &Reporter::silent()).expect_err(csv).to_string();
        assert!(error.contains("beam.spectrum_csv") && words.iter().all(|word| error.contains(word)), "{error}");
        cases += 1;
    }
    let mut scene = example();
    scene["beam"] = json!({"mono_kev": 500});
    assert!(load(&scene).expect_err("off the table").contains("beam.mono_kev"));
    assert_eq!(cases, 2);
}
