//! Scene files: what they become, and what is said of mistakes.

use std::path::Path;

use glam::DVec3;
use serde_json::{Value, json};
use sidecarm::geometry::Rigid;
use sidecarm::reporter::Reporter;
use sidecarm::scene::model::{Matter, Noise, Response, ScatterModel, Shape};
use sidecarm::scene::{self, Scene};

use super::scene_support::NiftiFile;

fn load(value: &Value) -> Result<Scene, String> {
    load_with(value, true, &Reporter::silent())
}

fn load_with(value: &Value, need_view: bool, reporter: &Reporter) -> Result<Scene, String> {
    scene::load_text(&value.to_string(), Path::new("SCENE.json"), need_view, reporter).map_err(|error| {
        let error = error.to_string();
        assert!(!error.contains('\n'), "{error}");
        error
    })
}

fn unit() -> Value {
    json!([[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]])
}

/// The example of the format, without its files.
fn example() -> Value {
    json!({
        "objects": [
            {"sphere": {"centre_lps_mm": [1, 2, 3], "radius_mm": 0.75, "material": "Steel_316L"}},
            {"ellipsoid": {"centre_lps_mm": [0, 0, 0], "semi_axes_mm": [30, 20, 10],
                "rotation_lps_from_local": [[1, 0, 0], [0, 1, 0], [0, 0, 1]], "material": "water"}},
            {"box": {"centre_lps_mm": [0, 0, 0], "size_mm": [400, 400, 200], "material": "water", "density_g_per_cm3": 0.9}},
            {"cylinder": {"from_lps_mm": [0, 0, 0], "to_lps_mm": [50, 0, 0], "radius_mm": 1.5, "inner_radius_mm": 0.5,
                "material": "Ti90Al6V4", "density_g_per_cm3": 4.4, "body": "left femur"}},
            {"robot": {"model": "calibration/robot/cdm.json", "lps_from_base": unit(), "control_angles_deg": [1.0, 2.0, 0.5, -1.0, 0.0]}}
        ],
        "view": {"size_px": [620, 480], "intrinsics": [[5257, 0, 309.5], [0, 5257, 239.5], [0, 0, 1]],
            "camera_from_lps": [[1, 0, 0, 0], [0, 0, -1, 0], [0, 1, 0, 600], [0, 0, 0, 1]]},
        "beam": {"tube_kvp": 120, "anode_angle_deg": 12, "filtration_mm": {"aluminium": 4.3}, "photons_per_pixel": 5e5},
        "detector": {"response": "energy", "pitch_mm": 0.194},
        "model": {"formation": "deepdrr", "scatter": "off", "noise": false, "seed": 1}
    })
}

#[test]
fn the_example_loads() {
    let scene = load(&example()).expect("good");
    let names: Vec<&str> = scene.materials.iter().map(|material| material.name.as_str()).collect();
    assert_eq!(names, ["steel_316l", "water", "Ti90Al6V4", "nitinol"], "in order of first appearance");
    let counts: Vec<usize> =
        scene.objects.iter().map(|object| if let Matter::Solids(solids) = &object.matter { solids.len() } else { 0 }).collect();
    assert_eq!(counts, [1, 1, 1, 1, 57]);
    assert_eq!((scene.objects[3].name.as_str(), scene.objects[3].body.as_str()), ("objects[3].cylinder", "left femur"));
    assert_eq!(scene.objects[0].body, "specimen");
    let Matter::Solids(cylinder) = &scene.objects[3].matter else { panic!("solids") };
    let end = cylinder[0].lps_from_local.transform_point(DVec3::new(0.0, 0.0, 50.0));
    assert!(end.distance(DVec3::new(50.0, 0.0, 0.0)) < 1e-9 && cylinder[0].density_g_per_cm3 == 4.4);
    assert!((scene.beam.spectrum.mean_kev() - 57.5).abs() < 0.6 && scene.beam.photons_per_pixel == 5e5);
    assert!(scene.detector.response == Response::Energy && scene.model.noise == Noise::Off);
    assert_eq!(scene.view.expect("has one").size_px, [620, 480]);
    assert_eq!(scene.inputs.len(), 2, "the scene and the robot's model: {:?}", scene.inputs);
}

/// A picture of exchanged sides was rendered without a word.
#[test]
fn a_size_that_is_written_rows_first_is_doubted() {
    let warned = |size_px: [u32; 2]| {
        let (mut value, reporter) = (example(), Reporter::silent());
        value["view"]["size_px"] = json!(size_px);
        load_with(&value, true, &reporter).expect("good");
        reporter.warnings().get("size_px").map(|warning| warning.latest.clone())
    };
    assert!(warned([480, 620]).is_some_and(|words| words.ends_with("size_px is [columns, rows]: swapped?")));
    // As it is, and a part of a picture whose middle is elsewhere either way.
    assert_eq!((warned([620, 480]), warned([620, 300])), (None, None));
}

#[test]
fn robots_bend_move_and_clamp() {
    let reporter = Reporter::silent();
    let scene = load_with(&example(), true, &reporter).expect("good");
    assert!(reporter.warnings().is_empty());
    let Matter::Solids(solids) = &scene.objects[4].matter else { panic!("solids") };
    assert!(matches!(solids[0].shape, Shape::Cylinder { radius_mm: 3.0, inner_radius_mm: 2.0, .. }));
    assert!(matches!(solids[28].shape, Shape::Cylinder { radius_mm: 1.0, inner_radius_mm: 0.0, .. }));
    assert!(matches!(solids[56].shape, Shape::Cylinder { length_mm: 4.0, radius_mm: 2.5, .. }));
    let moved = scene.with_robot([0.0; 5], Some(Rigid::translation(DVec3::new(0.0, 5.0, 0.0)))).expect("finite");
    let Matter::Solids(straight) = &moved.objects[4].matter else { panic!("solids") };
    let tip = straight[56].lps_from_local.transform_point(DVec3::new(0.0, 0.0, 4.0));
    assert!(tip.distance(DVec3::new(0.0, 5.0, 39.0)) < 1e-9, "{tip}");
    assert!(scene.with_robot([f64::NAN; 5], None).is_err());
    assert_eq!(moved.without_robot().objects.len(), 4);
    let mut bent = example();
    bent["objects"][4]["robot"]["control_angles_deg"] = json!([20, 20, 20, 20, 20]);
    let limited = load_with(&bent, true, &reporter).expect("good");
    assert!(reporter.warnings().contains_key("robot bend") && limited.robot.expect("there").clamped == 27);
}

#[test]
fn beads_come_last() {
    let mut scene = load(&example()).expect("good");
    scene.add_beads(&[(DVec3::ZERO, 0.75), (DVec3::X, 1.0)], "steel_316l").expect("good");
    assert!(matches!(&scene.objects[5].matter, Matter::Solids(solids) if solids.len() == 2 && solids[1].material == 0));
    assert!(scene.add_beads(&[(DVec3::ZERO, f64::NAN)], "steel_316l").is_err());
    let (low, high) = scene.bounds_lps_mm().expect("not empty");
    assert!(low.x <= -200.0 && high.z >= 100.0);
}

#[test]
fn a_projection_and_joints_give_the_same_kind_of_view() {
    let first = load(&example()).expect("good").view.expect("has one");
    let mut by_projection = example();
    let scaled: Vec<Vec<f64>> = first.projection().0.iter().map(|row| row.iter().map(|x| x * -3.5).collect()).collect();
    by_projection["view"] = json!({"size_px": [620, 480], "projection": scaled});
    let second = load(&by_projection).expect("good").view.expect("has one");
    assert!((second.intrinsics.fx - 5257.0).abs() < 1e-6);
    assert!(second.camera_from_lps.translation_mm.distance(first.camera_from_lps.translation_mm) < 1e-6);

    let mut by_joints = example();
    by_joints["view"] = by_carm(json!({}));
    by_joints["detector"] = json!({});
    let scene = load(&by_joints).expect("good");
    let view = scene.view.expect("has one");
    assert_eq!((view.size_px, scene.detector.pitch_mm), ([620, 480], 0.388));
    assert!((view.intrinsics.source_to_detector_mm(0.388) - 1020.0).abs() < 1e-9);
    // Orbital 90° swings the source, below the isocentre at zero, to −x: Ry(90°) takes −z to −x.
    assert!(view.source_in_lps().distance(DVec3::new(800.0 - 631.8, 0.0, 1000.0)) < 1e-6, "{}", view.source_in_lps());
    by_joints["detector"] = json!({"pitch_mm": 0.2});
    assert!(load(&by_joints).expect_err("two pitches").contains("0.388"));
}

/// A view by joints, orbital at 90 degrees, with `changes`.
fn by_carm(changes: Value) -> Value {
    let mut carm = json!({
        "lift_mm": 0, "wig_wag_deg": 0, "longitudinal_mm": 0, "angulation_deg": 0, "orbital_deg": 90, "detector_rotation_deg": 0,
        "source_to_detector_mm": 1020
    });
    for (key, value) in changes.as_object().expect("joints") {
        carm[key] = value.clone();
    }
    json!({"carm": carm, "calibration": "calibration/carm/live-620x480.json", "world_from_lps": unit()})
}

/// A joint that was left out stood at zero, the distance at the calibration's, and a thousand degrees went round: the picture of a view
/// that nobody asked for.
#[test]
fn a_view_needs_every_joint_and_one_that_a_carm_has() {
    let with = |view: Value| {
        let mut scene = example();
        scene["view"] = view;
        scene["detector"] = json!({});
        load(&scene).map(|scene| scene.view.expect("has one"))
    };
    let keys = ["lift_mm", "wig_wag_deg", "longitudinal_mm", "angulation_deg", "orbital_deg", "detector_rotation_deg"];
    let mut refused = 0;
    for key in keys.into_iter().chain(["source_to_detector_mm"]) {
        let mut left_out = by_carm(json!({}));
        left_out["carm"].as_object_mut().expect("joints").remove(key);
        let absurd = if key.ends_with("_deg") { 1000.0 } else { 1e6 };
        for view in [left_out, by_carm(json!({key: null})), by_carm(json!({key: absurd})), by_carm(json!({key: -absurd}))] {
            let error = with(view).expect_err(key);
            assert!(error.contains(&format!("view.carm.{key} is ")) && error.contains("all seven joints"), "{error}");
            refused += 1;
        }
    }
    assert_eq!(refused, 28);
    for distance_mm in [-1020.0, 0.0, 1.02, 102.0] {
        let error = with(by_carm(json!({"source_to_detector_mm": distance_mm}))).expect_err("no C-arm");
        assert!(error.contains("expected 200 to 5000 mm"), "{error}");
    }
    for turn in [-360.0, 180.0, 360.0] {
        with(by_carm(json!({"orbital_deg": turn}))).expect("a turn");
    }
    assert_eq!(with(by_carm(json!({"lift_mm": 300, "source_to_detector_mm": 900}))).expect("good").intrinsics.fx, 900.0 / 0.388);
}

#[test]
fn mistakes_name_file_and_place() {
    type Change = fn(&mut Value);
    let cases: [(&str, Change, &[&str]); 34] = [
        ("unknown key", |s| s["objects"][0]["sphere"]["radius"] = json!(1), &["objects[0].sphere", "radius"]),
        ("unknown kind", |s| s["objects"][0] = json!({"ball": {}}), &["objects[0]", "ball"]),
        ("no kind", |s| s["objects"][0] = json!({}), &["objects[0]", "one of ct, mesh"]),
        (
            "two kinds",
            |s| s["objects"][0] = json!({"sphere": s["objects"][0]["sphere"].clone(), "mesh": {}}),
            &["objects[0]", "one of ct, mesh"],
        ),
        ("a name", |s| s["objects"][0] = json!("ct"), &["objects[0]", "one of ct, mesh"]),
        ("unknown top", |s| s["vew"] = json!(1), &["vew"]),
        (
            "unknown material",
            |s| s["objects"][0]["sphere"]["material"] = json!("steal_316l"),
            &["objects[0].sphere.material", "steel_316l"],
        ),
        ("no density", |s| s["objects"][3]["cylinder"]["density_g_per_cm3"] = Value::Null, &["objects[3]", "density"]),
        (
            "negative density",
            |s| s["objects"][2]["box"]["density_g_per_cm3"] = json!(-1),
            &["objects[2].box.density_g_per_cm3", "-1"],
        ),
        ("radius", |s| s["objects"][0]["sphere"]["radius_mm"] = json!(0), &["objects[0].sphere.radius_mm"]),
        ("lumen", |s| s["objects"][3]["cylinder"]["inner_radius_mm"] = json!(2), &["inner_radius_mm"]),
        ("no length", |s| s["objects"][3]["cylinder"]["to_lps_mm"] = json!([0, 0, 0]), &["objects[3].cylinder"]),
        ("overflow", |s| s["objects"][0]["sphere"]["centre_lps_mm"] = json!([1e300, 0, 0]), &["centre_lps_mm"]),
        (
            "not rigid",
            |s| s["objects"][4]["robot"]["lps_from_base"][0][0] = json!(2),
            &["objects[4].robot.lps_from_base", "rigid"],
        ),
        ("mirrored", |s| s["view"]["camera_from_lps"][0][0] = json!(-1), &["view.camera_from_lps", "mirrors"]),
        (
            "not a rotation",
            |s| s["objects"][1]["ellipsoid"]["rotation_lps_from_local"][0][0] = json!(3),
            &["rotation_lps_from_local"],
        ),
        ("missing model", |s| s["objects"][4]["robot"]["model"] = json!("none.json"), &["objects[4].robot.model", "none.json"]),
        (
            "missing volume",
            |s| s["objects"][0] = json!({"ct": {"path": "no.nii", "materials": "threshold"}}),
            &["objects[0].ct.path", "no.nii"],
        ),
        (
            "materials",
            |s| s["objects"][0] = json!({"ct": {"path": "no.nii", "materials": "guess"}}),
            &["objects[0].ct.materials", "guess"],
        ),
        ("focal", |s| s["view"]["intrinsics"][0][0] = json!(0), &["view.intrinsics", "focal"]),
        ("no size", |s| s["view"]["size_px"] = json!([0, 480]), &["view.size_px"]),
        ("two cameras", |s| s["view"]["projection"] = json!([[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0]]), &["view", "projection"]),
        ("distance", |s| s["detector"]["pitch_mm"] = json!(0.000194 / 5257.0), &["source-to-detector"]),
        ("no pitch", |s| s["detector"] = json!({}), &["pitch_mm"]),
        ("kvp", |s| s["beam"]["tube_kvp"] = json!(500), &["beam.tube_kvp", "500"]),
        ("no kvp", |s| s["beam"]["tube_kvp"] = json!(0), &["beam.tube_kvp"]),
        ("filter", |s| s["beam"]["filtration_mm"]["aluminium"] = json!(-1), &["beam.filtration_mm.aluminium", "-1"]),
        ("two beams", |s| s["beam"]["mono_kev"] = json!(60), &["beam", "exactly one"]),
        ("photons", |s| s["beam"]["photons_per_pixel"] = json!(0), &["beam.photons_per_pixel"]),
        ("crosstalk", |s| s["detector"]["crosstalk"] = json!([[0.5, 0.5]]), &["detector.crosstalk"]),
        (
            "negative",
            |s| s["detector"]["crosstalk"] = json!([[0.0, -0.1, 0.0], [-0.1, 1.4, -0.1], [0.0, -0.1, 0.0]]),
            &["detector.crosstalk", "-0.1", "0 or more"],
        ),
        ("sum", |s| s["detector"]["crosstalk"] = json!([[0.5]]), &["crosstalk", "0.5"]),
        ("noise", |s| s["model"]["noise"] = json!("loud"), &["model.noise", "loud"]),
        ("correlation", |s| s["detector"]["readout_noise"] = json!({"sigma": 0.1, "row_correlation": 1}), &["row_correlation"]),
    ];
    assert!(load(&example()).is_ok(), "unchanged it loads");
    for (what, change, words) in cases {
        let mut scene = example();
        change(&mut scene);
        let error = load(&scene).expect_err(what);
        assert!(error.starts_with("SCENE.json") && words.iter().all(|word| error.contains(word)), "{what}: {error}");
    }
}

#[test]
fn a_scene_says_where_its_scatter_comes_from() {
    let mut scene = example();
    for (word, model) in
        [("off", ScatterModel::Off), ("network", ScatterModel::Network), ("monte_carlo", ScatterModel::MonteCarlo)]
    {
        scene["model"]["scatter"] = json!(word);
        assert_eq!(load(&scene).expect("good").model.scatter, model);
    }
    scene["model"]["scatter"] = json!("measured");
    assert!(load(&scene).expect_err("no such model").contains("model.scatter"));
}

#[test]
fn session_scenes_need_no_view() {
    let mut scene = example();
    scene.as_object_mut().expect("an object").remove("view");
    assert!(load(&scene).expect_err("none").contains("view"));
    let loaded = load_with(&scene, false, &Reporter::silent()).expect("good");
    assert!(loaded.view.is_none());
    let malformed = scene::load_text("{\"objects\": [", Path::new("SCENE.json"), true, &Reporter::silent());
    assert!(malformed.expect_err("cut").to_string().contains("line 1"));
}

fn write_stl(path: &Path, triangles: &[[[f32; 3]; 3]], ascii: bool) {
    let mut bytes = Vec::new();
    if ascii {
        let mut text = String::from("solid box\n");
        for triangle in triangles {
            text += "facet normal 0 0 0\nouter loop\n";
            triangle.iter().for_each(|[x, y, z]| text += &format!("vertex {x} {y} {z}\n"));
            text += "endloop\nendfacet\n";
        }
        bytes.extend_from_slice((text + "endsolid box\n").as_bytes());
    } else {
        bytes.extend_from_slice(&[0; 80]);
        bytes.extend_from_slice(&(triangles.len() as u32).to_le_bytes());
        for triangle in triangles {
            bytes.extend_from_slice(&[0; 12]);
            triangle.iter().flatten().for_each(|x| bytes.extend_from_slice(&x.to_le_bytes()));
            bytes.extend_from_slice(&[0; 2]);
        }
    }
    std::fs::write(path, bytes).expect("temporary folder");
}

#[test]
fn meshes_are_closed_turned_outward_or_refused() {
    let folder = tempfile::tempdir().expect("temporary folder");
    let corner = |bits: u32| [0, 1, 2].map(|axis| if bits >> axis & 1 == 1 { 2.0f32 } else { -2.0 });
    let quads = [[0, 2, 3, 1], [4, 5, 7, 6], [0, 1, 5, 4], [2, 6, 7, 3], [0, 4, 6, 2], [1, 3, 7, 5]];
    let good: Vec<[[f32; 3]; 3]> =
        quads.iter().flat_map(|[a, b, c, d]| [[a, b, c], [a, c, d]].map(|t| t.map(|v| corner(*v)))).collect();
    let path = folder.path().join("box.stl");
    let scene_path = folder.path().join("scene.json");
    let mut scene = example();
    scene["objects"] = json!([{"mesh": {"path": "box.stl", "material": "titanium",
        "lps_from_mesh": [[1, 0, 0, 10], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]}}]);
    let load = |triangles: &[[[f32; 3]; 3]], ascii: bool| {
        write_stl(&path, triangles, ascii);
        let reporter = Reporter::silent();
        let loaded = scene::load_text(&scene.to_string(), &scene_path, true, &reporter);
        loaded.map(|scene| (scene, reporter.warnings().len())).map_err(|error| error.to_string())
    };
    let volume_mm3 = |scene: &Scene| -> f64 {
        let Matter::Mesh(mesh) = &scene.objects[0].matter else { panic!("a mesh") };
        let middle = DVec3::new(10.0, 0.0, 0.0);
        assert_eq!(mesh.vertices_lps_mm.len(), 8, "welded");
        mesh.triangles
            .iter()
            .map(|t| t.map(|v| mesh.vertices_lps_mm[v as usize] - middle))
            .map(|[a, b, c]| a.dot(b.cross(c)) / 6.0)
            .sum()
    };
    for ascii in [false, true] {
        let (scene, warnings) = load(&good, ascii).expect("good");
        assert!((volume_mm3(&scene) - 64.0).abs() < 1e-9 && warnings == 0);
    }
    let mut one_inverted = good.clone();
    one_inverted[3].swap(0, 1);
    let (scene, warnings) = load(&one_inverted, false).expect("repaired");
    assert!((volume_mm3(&scene) - 64.0).abs() < 1e-9 && warnings == 1);
    let inside_out: Vec<_> = good.iter().map(|[a, b, c]| [*a, *c, *b]).collect();
    let (scene, warnings) = load(&inside_out, false).expect("turned");
    assert!((volume_mm3(&scene) - 64.0).abs() < 1e-9 && warnings == 1);
    let error = load(&good[1..], false).expect_err("a hole");
    assert!(error.contains("holes") && error.contains("box.stl") && error.contains("3 open edges"), "{error}");
    std::fs::write(&path, b"solid nothing").expect("temporary folder");
    assert!(scene::load_text(&scene_text(), &scene_path, true, &Reporter::silent()).is_err());
}

/// What 3D Slicer writes into the header of a binary STL was not looked at: a mesh lay on the other side of the patient.
#[test]
fn a_mesh_whose_header_says_ras_is_placed_in_lps() {
    let folder = tempfile::tempdir().expect("temporary folder");
    let low = [30.0f32, -20.0, 100.0];
    let corner = |bits: u32| [0, 1, 2].map(|axis| low[axis] + (bits >> axis & 1) as f32);
    let quads = [[0, 2, 3, 1], [4, 5, 7, 6], [0, 1, 5, 4], [2, 6, 7, 3], [0, 4, 6, 2], [1, 3, 7, 5]];
    let faces: Vec<[[f32; 3]; 3]> =
        quads.iter().flat_map(|[a, b, c, d]| [[a, b, c], [a, c, d]].map(|t| t.map(|v| corner(*v)))).collect();
    let path = folder.path().join("box.stl");
    let scene_path = folder.path().join("scene.json");
    let load = |header: &[u8], lps_from_mesh: Option<Value>| {
        write_stl(&path, &faces, false);
        let mut bytes = std::fs::read(&path).expect("readable");
        bytes[..header.len()].copy_from_slice(header);
        std::fs::write(&path, bytes).expect("written");
        let mut scene = example();
        scene["objects"] = json!([{"mesh": {"path": "box.stl", "material": "titanium"}}]);
        if let Some(pose) = lps_from_mesh {
            scene["objects"][0]["mesh"]["lps_from_mesh"] = pose;
        }
        let reporter = Reporter::silent();
        let scene = scene::load_text(&scene.to_string(), &scene_path, true, &reporter).expect("a box");
        let Matter::Mesh(mesh) = &scene.objects[0].matter else { panic!("a mesh") };
        let low = mesh.vertices_lps_mm.iter().fold(DVec3::splat(f64::INFINITY), |low, v| low.min(*v));
        (low, reporter.warnings().len())
    };
    assert_eq!(load(b"", None), (DVec3::new(30.0, -20.0, 100.0), 0));
    assert_eq!(load(b"3D Slicer output. SPACE=LPS", None), (DVec3::new(30.0, -20.0, 100.0), 0));
    assert_eq!(load(b"3D Slicer output. SPACE=RAS", None), (DVec3::new(-31.0, 19.0, 100.0), 1));
    let said = json!([[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]);
    assert_eq!(load(b"3D Slicer output. SPACE=RAS", Some(said)), (DVec3::new(30.0, -20.0, 100.0), 0), "the scene's word counts");
}

#[test]
fn a_ct_that_is_listed_after_a_tool_erases_it_and_that_is_said() {
    let folder = tempfile::tempdir().expect("temporary folder");
    NiftiFile::int16([2, 2, 2], &[40; 8]).write(&folder.path().join("ct.nii"));
    let (ct, robot) = (json!({"ct": {"path": "ct.nii", "materials": "threshold"}}), example()["objects"][4].clone());
    let (ball, water) = (example()["objects"][0].clone(), example()["objects"][1].clone());
    let words = |objects: Value| {
        let mut scene = example();
        scene["objects"] = objects;
        let reporter = Reporter::silent();
        scene::load_text(&scene.to_string(), &folder.path().join("scene.json"), true, &reporter).expect("good");
        reporter.warnings().get("order of objects").map(|counted| counted.latest.clone())
    };
    for (objects, tool) in [(json!([water, robot, ct]), "objects[1].robot"), (json!([ball, robot, ct]), "objects[0].sphere")] {
        let said = words(objects).expect("said");
        assert!(said.contains(&format!("objects[2].ct comes after {tool}")), "{said}");
    }
    assert_eq!(words(json!([ct, robot, ball])), None);
    assert_eq!(words(json!([water, ct])), None, "what is no metal is no tool");
}

fn scene_text() -> String {
    let mut scene = example();
    scene["objects"] = json!([{"mesh": {"path": "box.stl", "material": "titanium"}}]);
    scene.to_string()
}
