//! Air, lung and gas in a CT (DESIGN §5), and labels by their names.

use std::path::Path;
use std::process::{Command, Output};

use serde_json::{Value, json};
use sidecarm::gpu::DeviceChoice;
use sidecarm::image::read_tiff_f32;
use sidecarm::render::achieved::Achieved;
use sidecarm::render::plan::Sampling;
use sidecarm::render::{Goal, Options, Quantity, Renderer, reference};
use sidecarm::reporter::Reporter;
use sidecarm::scene::model::{Matter, Volume};
use sidecarm::scene::physics::Material;
use sidecarm::scene::{self, Scene};

use super::render_scenes::{render_on, worst};
use super::scene_support::NiftiFile;

/// Voxels along x, y, z, 4 mm each: 52 along x, of which 200 mm are lung.
const SIZE: [usize; 3] = [56, 20, 20];
const SPACING_MM: f32 = 4.0;
const LUNG_HU: i16 = -850;

/// A trunk of tissue around one lung, room air about it, and a slit of air in the skin that is open to the room.
pub fn chest() -> NiftiFile {
    let hu = |index: usize| {
        let [x, y, _] = [index % SIZE[0], index / SIZE[0] % SIZE[1], index / (SIZE[0] * SIZE[1])];
        match (x, y) {
            (0, _) | (55, _) | (_, 0 | 19) => -1000,
            (30, 1) => -800,
            (1 | 2 | 53 | 54, _) | (_, 1 | 2 | 17 | 18) => 40,
            _ => LUNG_HU,
        }
    };
    let voxels: Vec<i16> = (0..SIZE.iter().product()).map(hu).collect();
    let mut file = NiftiFile::int16(SIZE.map(|n| n as i16), &voxels);
    file.sform = Some([[SPACING_MM, 0.0, 0.0, 0.0], [0.0, SPACING_MM, 0.0, 0.0], [0.0, 0.0, SPACING_MM, 0.0]]);
    file
}

fn load(folder: &Path, ct: &Value) -> (Result<Scene, String>, Vec<String>) {
    let text = json!({"objects": [{"ct": ct}], "beam": {"mono_kev": 60}, "detector": {"pitch_mm": 0.2}}).to_string();
    let reporter = Reporter::silent();
    let loaded = scene::load_text(&text, &folder.join("scene.json"), false, &reporter).map_err(|error| error.to_string());
    (loaded, reporter.warnings().iter().map(|warning| format!("{warning:?}")).collect())
}

fn volume(scene: &Scene) -> &Volume {
    let Matter::Volume(volume) = &scene.objects[0].matter else { panic!("a volume") };
    volume
}

/// Material and density at a voxel of the middle slice.
fn matter_at(scene: &Scene, x: usize, y: usize) -> (&str, f32) {
    let volume = volume(scene);
    let index = volume.index(x, y, 10);
    let class = usize::from(volume.class[index]);
    let name = if class == 0 { "nothing" } else { scene.materials[volume.class_materials[class - 1]].name.as_str() };
    (name, volume.density_g_per_cm3[index])
}

/// A voxel of 1e30 HU has a density that no number of the image could hold.
#[test]
fn numbers_beyond_any_metal_are_no_ct() {
    let folder = tempfile::tempdir().expect("folder");
    let mut file = NiftiFile::int16([2, 2, 2], &[40; 8]);
    for (highest, is_ct) in [(60_000f32, true), (1e30, false)] {
        (file.datatype, file.voxels) = (16, [40.0, highest, 40.0, 40.0, 40.0, 40.0, 40.0, 40.0].map(f32::to_le_bytes).concat());
        file.write(&folder.path().join("ct.nii"));
        let (scene, _) = load(folder.path(), &json!({"path": "ct.nii"}));
        match scene {
            Ok(_) => assert!(is_ct, "{highest} HU are taken"),
            Err(words) => assert!(!is_ct && words.contains("1.000e30 HU"), "{words}"),
        }
    }
}

#[test]
fn room_air_is_nothing_and_lung_keeps_its_density() {
    let folder = tempfile::tempdir().expect("folder");
    chest().write(&folder.path().join("ct.nii"));
    // The curve between (-1000, 0.0012) and (-82, 0.95).
    let thin = |hu: f32| 0.0012 + (hu + 1000.0) / 918.0 * (0.95 - 0.0012);
    let lung = ("soft_tissue", thin(-850.0));
    let cases = [
        (json!({"path": "ct.nii"}), [("nothing", 0.0), lung, ("nothing", 0.0)]),
        (json!({"path": "ct.nii", "air": "keep"}), [("air", 0.0012), lung, ("air", thin(-800.0))]),
        (json!({"path": "ct.nii", "air": "drop"}), [("nothing", 0.0), ("nothing", 0.0), ("nothing", 0.0)]),
    ];
    for (ct, expected) in cases {
        let (scene, warnings) = load(folder.path(), &ct);
        let scene = scene.expect("good");
        for ((x, y), (name, density)) in [(0, 0), (28, 10), (30, 1)].into_iter().zip(expected) {
            let found = matter_at(&scene, x, y);
            assert!(found.0 == name && (found.1 - density).abs() < 1e-5, "{ct} at {x}, {y}: {found:?}, not {name} of {density}");
        }
        assert_eq!(warnings, Vec::<String>::new(), "{ct}");
    }
}

/// A lung that the scan cuts open at its side is taken for room air by the rule; that is said.
#[test]
fn a_lung_that_reaches_the_border_is_said() {
    let folder = tempfile::tempdir().expect("folder");
    let mut open = chest();
    // A duct through skin and chest wall in every slice.
    let tunnel = LUNG_HU.to_le_bytes();
    for z in 0..SIZE[2] {
        for y in 1..=2 {
            let at = 2 * (28 + SIZE[0] * (y + SIZE[1] * z));
            open.voxels[at..at + 2].copy_from_slice(&tunnel);
        }
    }
    open.write(&folder.path().join("ct.nii"));
    let (scene, warnings) = load(folder.path(), &json!({"path": "ct.nii"}));
    assert_eq!(matter_at(&scene.expect("good"), 28, 10).0, "nothing");
    assert!(warnings.len() == 1 && warnings[0].contains("in 20 axial slices"), "{warnings:?}");
}

fn sidecarm(folder: &Path, args: &[&str]) -> Output {
    Command::new(env!("CARGO_BIN_EXE_sidecarm")).args(args).current_dir(folder).output().expect("runs")
}

/// 20 cm of lung at 60 keV, by the program, fast and by the reference, against the sum over the voxels that the ray crosses.
#[test]
fn lung_attenuates_as_its_voxels_say() {
    let folder = tempfile::tempdir().expect("folder");
    chest().write(&folder.path().join("ct.nii"));
    // Along the patient's -x through the middle of the trunk; lps is -RAS in x and y.
    let scene = |air: &str| {
        json!({
            "objects": [{"ct": {"path": "ct.nii", "air": air}}],
            "view": {"size_px": [3, 3], "intrinsics": [[5000, 0, 1], [0, 5000, 1], [0, 0, 1]],
                     "camera_from_lps": [[0, 1, 0, 38], [0, 0, -1, 38], [-1, 0, 0, 400], [0, 0, 0, 1]]},
            "beam": {"mono_kev": 60}, "detector": {"pitch_mm": 0.2}
        })
    };
    let tissue = Material::parse("soft_tissue").expect("known").attenuation(60.0).expect("in range").total_cm2_per_g;
    let lung_g_per_cm3 = 0.0012 + 150.0 / 918.0 * (0.95 - 0.0012);
    let wall_g_per_cm3 = 1.0 + 40.0 / 55.0 * 0.06;
    let lung = tissue * lung_g_per_cm3 * 20.0;
    let wall = tissue * wall_g_per_cm3 * 4.0 * 0.4;
    assert!(lung > 0.6, "{lung}");
    for (air, expected) in [("ambient", wall + lung), ("drop", wall)] {
        std::fs::write(folder.path().join("scene.json"), scene(air).to_string()).expect("writes");
        for (more, limit) in [(&[][..], 1e-4), (&["--reference"][..], 1e-6)] {
            let mut args = vec!["render", "scene.json", "--quantity", "line_integral", "--device", "cpu", "--out", "drr.tif"];
            args.extend(more);
            let output = sidecarm(folder.path(), &args);
            assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
            let found = f64::from(read_tiff_f32(&folder.path().join("drr.tif")).expect("a TIFF")[0].pixels[4]);
            assert!((found - expected).abs() < limit, "{air} {more:?}: {found}, the voxels say {expected}");
        }
    }
}

/// Padding borders on room air here, not on tissue: nothing is cut off, whether the air is kept or not.
#[test]
fn kept_air_that_meets_padding_cuts_nothing_off() {
    let folder = tempfile::tempdir().expect("folder");
    let trunk = |padded_to: usize| {
        let mut file = chest();
        for (index, raw) in file.voxels.chunks_exact_mut(2).enumerate() {
            let [x, y, _] = [index % SIZE[0], index / SIZE[0] % SIZE[1], index / (SIZE[0] * SIZE[1])];
            let inward = x.min(55 - x).min(y).min(19 - y);
            let hu: i16 = if inward <= padded_to {
                -2048
            } else if inward <= 2 {
                -1000
            } else {
                40
            };
            raw.copy_from_slice(&hu.to_le_bytes());
        }
        file.write(&folder.path().join("ct.nii"));
    };
    let invalid = |air: &str| {
        let scene = json!({
            "objects": [{"ct": {"path": "ct.nii", "air": air}}],
            "view": {"size_px": [3, 3], "intrinsics": [[5000, 0, 1], [0, 5000, 1], [0, 0, 1]],
                     "camera_from_lps": [[0, 1, 0, 38], [0, 0, -1, 38], [-1, 0, 0, 400], [0, 0, 0, 1]]},
            "beam": {"mono_kev": 60}, "detector": {"pitch_mm": 0.2}
        });
        let path = folder.path().join("scene.json");
        let scene = scene::load_text(&scene.to_string(), &path, true, &Reporter::silent()).expect("good");
        let view = scene.view.expect("a view");
        let fast = render_on(DeviceChoice::Cpu, &scene, Quantity::LineIntegral).valid.pixels;
        assert_eq!(fast, reference::valid(&scene, &view).expect("good").pixels, "{air}: the reference");
        fast.iter().filter(|valid| **valid == 0).count()
    };
    trunk(1);
    assert_eq!(["ambient", "keep", "drop"].map(invalid), [0, 0, 0]);
    trunk(2);
    assert_eq!(["ambient", "keep", "drop"].map(invalid), [9, 9, 9], "control: tissue that meets padding");
}

/// Rays through air that is kept are not crossed in slabs: a plan of such a scene uses them, or says that it does not, and its image is off by
/// no more than it states, whether a shape stands before the CT, which displaces it, or after it.
#[test]
fn a_plan_for_kept_air_says_how_it_is_cast_and_its_image_is_as_exact_as_stated() {
    let folder = tempfile::tempdir().expect("folder");
    chest().write(&folder.path().join("ct.nii"));
    // Partly in lung and skin, partly in the room's air, partly outside the scan.
    let ball = json!({"sphere": {"centre_lps_mm": [-110, -10, 38], "radius_mm": 30, "material": "water"}});
    let scene = |air: &str, ball_first: bool| {
        let ct = json!({"ct": {"path": "ct.nii", "air": air}});
        let objects = if ball_first { [&ball, &ct] } else { [&ct, &ball] };
        let text = json!({
            "objects": objects,
            "view": {"size_px": [64, 64], "intrinsics": [[333, 0, 31.5], [0, 333, 31.5], [0, 0, 1]],
                     "camera_from_lps": [[0, 1, 0, 38], [0, 0, -1, 38], [-1, 0, 0, 400], [0, 0, 0, 1]]},
            "beam": {"tube_kvp": 80, "filtration_mm": {"aluminium": 3}, "photons_per_pixel": 1e5},
            "detector": {"response": "energy", "pitch_mm": 3.0}
        });
        scene::load_text(&text.to_string(), &folder.path().join("scene.json"), true, &Reporter::silent()).expect("good")
    };
    let quantity = Quantity::LineIntegral;
    let mut renderer = Renderer::new(DeviceChoice::Cpu, &Reporter::silent()).expect("cpu");
    let mut page = |scene: &Scene, options: &Options| {
        let plan = renderer.plan(scene, options).expect("a plan");
        let rendered = renderer.render(scene, &Options { plan: Some(plan.clone()), ..options.clone() }).expect("renders");
        (rendered.pages[0].pixels.clone(), plan)
    };
    let yardstick = Options { quantity, reference: true, ..Options::default() };
    let in_slabs = |sampling: Sampling| matches!(sampling, Sampling::ExactSlabs | Sampling::FixedSlabs);
    let said = "not in slabs, because rays meet another volume or kept air";
    let slabs = Goal::Explicit { sampling: Sampling::ExactSlabs, energies: None, step_px: 1 };
    let (mut cases, mut truths) = (0, Vec::new());
    for ball_first in [true, false] {
        let (kept, ambient) = (scene("keep", ball_first), scene("ambient", ball_first));
        let (truth, _) = page(&kept, &yardstick);
        assert!(worst(&page(&ambient, &yardstick).0, &truth) > 1e-4, "control: the room's air is in the picture");
        for goal in [slabs, Goal::MaxError(1e-5), Goal::MaxError(1e-2)] {
            let (found, plan) = page(&kept, &Options { quantity, goal: Some(goal), ..Options::default() });
            let text = plan.explain();
            let achieved = Achieved::of(&found, &truth, 0.0);
            assert!(in_slabs(plan.sampling) != text.contains(said), "ball first {ball_first}, {goal:?}: {text}");
            assert!(achieved.error <= plan.stated_error, "ball first {ball_first}, {goal:?}: {achieved:?}, {text}");
            cases += 1;
        }
        let (_, plan) = page(&ambient, &Options { quantity, goal: Some(slabs), ..Options::default() });
        assert!(in_slabs(plan.sampling) && !plan.explain().contains(said), "control, without air: {}", plan.explain());
        truths.push(truth);
    }
    assert_eq!(cases, 6);
    assert!(worst(&truths[0], &truths[1]) > 1e-2, "control: which is first makes another picture");
}

/// A label volume of the chest: lung 1, tissue 2, with a table of names in its header.
pub fn labels(names: &[(u32, &str)]) -> Vec<u8> {
    let ct = chest();
    let value = |raw: &[u8]| match i16::from_le_bytes([raw[0], raw[1]]) {
        LUNG_HU => 1i16,
        40 => 2,
        _ => 0,
    };
    let voxels: Vec<i16> = ct.voxels.chunks_exact(2).map(value).collect();
    let mut file = NiftiFile::int16(SIZE.map(|n| n as i16), &voxels);
    file.sform = ct.sform;
    let mut bytes = file.bytes();
    if !names.is_empty() {
        let rows: String = names.iter().map(|(key, name)| format!("<Label Key=\"{key}\"><![CDATA[{name}]]></Label>")).collect();
        let mut xml = format!(
            "<?xml version=\"1.0\"?><CaretExtension><VolumeInformation><LabelTable>{rows}</LabelTable></VolumeInformation></CaretExtension>"
        );
        while (xml.len() + 8) % 16 != 0 {
            xml.push(' ');
        }
        let mut extension = (xml.len() as i32 + 8).to_le_bytes().to_vec();
        extension.extend([0; 4]);
        extension.extend(xml.bytes());
        bytes[348] = 1;
        bytes[108..112].copy_from_slice(&(352.0 + extension.len() as f32).to_le_bytes());
        bytes.splice(352..352, extension);
    }
    bytes
}

/// It was told to give a key that is not known there.
#[test]
fn a_label_s_material_without_a_density_is_told_what_can_be_said_there() {
    let folder = tempfile::tempdir().expect("folder");
    chest().write(&folder.path().join("ct.nii"));
    std::fs::write(folder.path().join("own.nii"), labels(&[])).expect("writes");
    let of = |density: &str| {
        let map = json!({"1": "lung", "2": {"material": "CaCO3", "density": density}});
        load(folder.path(), &json!({"path": "ct.nii", "materials": {"labels": "own.nii", "map": map}})).0
    };
    let error = of("nominal").expect_err("no density");
    assert!(error.contains("'CaCO3' has no nominal density") && error.contains("\"density\": \"hu\""), "{error}");
    assert!(!error.contains("density_g_per_cm3"), "{error}");
    assert_eq!(matter_at(&of("hu").expect("what was said"), 28, 2).0, "CaCO3");
    // Where there is such a key it is named.
    let text = json!({
        "objects": [{"sphere": {"centre_lps_mm": [0, 0, 0], "radius_mm": 20, "material": "CaCO3"}}],
        "beam": {"mono_kev": 60},
        "detector": {"pitch_mm": 1.0}
    });
    let error = scene::load_text(&text.to_string(), &folder.path().join("scene.json"), false, &Reporter::silent());
    assert!(error.is_err_and(|error| error.to_string().contains("give density_g_per_cm3")), "the control");
}

#[test]
fn labels_go_by_name_and_the_nearest_is_offered() {
    let folder = tempfile::tempdir().expect("folder");
    chest().write(&folder.path().join("ct.nii"));
    std::fs::write(folder.path().join("own.nii"), labels(&[(1, "lung_left"), (2, "rib_left_1")])).expect("writes");
    std::fs::write(folder.path().join("bare.nii"), labels(&[])).expect("writes");
    let ct = |labels: Value| json!({"path": "ct.nii", "materials": labels});
    let named = [
        json!({"labels": "own.nii", "map": {"rib_left_1": "bone_cortical", "1": "lung"}}),
        json!({"labels": "own.nii", "map": "totalsegmentator"}),
        json!({"labels": "own.nii", "preset": "totalsegmentator", "map": {"lung_left": "lung"}}),
        // As a log has it that was given away.
        json!({"labels": "own.nii", "map": {(scene::hidden_label(0, "rib_left_1")): "bone_cortical", "1": "lung"}}),
    ];
    for materials in &named {
        let scene = load(folder.path(), &ct(materials.clone())).0.expect("good");
        assert_eq!([(28, 10), (28, 2), (0, 0)].map(|(x, y)| matter_at(&scene, x, y).0), ["lung", "bone_cortical", "nothing"]);
        let mut dropped = ct(materials.clone());
        dropped["air"] = "drop".into();
        let scene = load(folder.path(), &dropped).0.expect("good");
        assert_eq!(
            [(28, 10), (28, 2)].map(|(x, y)| matter_at(&scene, x, y).0),
            ["nothing", "bone_cortical"],
            "dropped, named or not"
        );
    }
    let wrong = load(folder.path(), &ct(json!({"labels": "own.nii", "map": {"rib_left_2": "bone_cortical"}}))).0;
    assert!(wrong.expect_err("no such name").contains("did you mean rib_left_1?"));
    // A volume without names has those of the file beside it, or of one that is named.
    let by_name = json!({"labels": "bare.nii", "map": {"lung_left": "lung"}});
    assert!(load(folder.path(), &ct(by_name.clone())).0.expect_err("no names").contains("label-names.csv"));
    let preset = load(folder.path(), &ct(json!({"labels": "bare.nii", "map": "totalsegmentator"}))).0;
    assert!(preset.expect_err("no names").contains("no label of bare.nii"));
    std::fs::write(folder.path().join("label-names.csv"), "id,structure\n1,lung_left\n2,rib_left_1\n").expect("writes");
    let scene = load(folder.path(), &ct(by_name)).0.expect("good");
    assert_eq!(matter_at(&scene, 28, 10).0, "lung");
    assert!(scene.inputs.iter().any(|input| input.path == "label-names.csv"), "what names labels is an input");
    std::fs::rename(folder.path().join("label-names.csv"), folder.path().join("names.csv")).expect("moves");
    let told =
        json!({"labels": "bare.nii", "names": "names.csv", "map": {"lung_left": "lung"}, "bodies": {"wall": ["rib_left_1"]}});
    assert_eq!(load(folder.path(), &ct(told)).0.expect("good").bodies.labelled[0].voxels.len(), {
        let ct = chest();
        ct.voxels.chunks_exact(2).filter(|raw| **raw == 40i16.to_le_bytes()).count()
    });
}

#[test]
fn what_no_label_names_is_said_or_goes_by_threshold() {
    let folder = tempfile::tempdir().expect("folder");
    let mut bony = chest();
    let at = 2 * (28 + SIZE[0] * (1 + SIZE[1] * 10));
    bony.voxels[at..at + 2].copy_from_slice(&1200i16.to_le_bytes());
    bony.write(&folder.path().join("ct.nii"));
    std::fs::write(folder.path().join("labels.nii"), labels(&[])).expect("writes");
    let of = |materials: Value| load(folder.path(), &json!({"path": "ct.nii", "materials": materials}));
    let (scene, warnings) = of(json!({"labels": "labels.nii"}));
    assert_eq!(matter_at(&scene.expect("good"), 28, 1).0, "soft_tissue");
    assert!(warnings.len() == 1 && warnings[0].contains("no label is given a material"), "{warnings:?}");
    let (scene, warnings) = of(json!({"labels": "labels.nii", "else": "threshold"}));
    let scene = scene.expect("good");
    assert_eq!(
        [(28, 1), (28, 2), (28, 10)].map(|(x, y)| matter_at(&scene, x, y).0),
        ["bone_cortical", "soft_tissue", "soft_tissue"]
    );
    assert_eq!(warnings, Vec::<String>::new());
    let (both, _) = of(json!({"labels": "labels.nii", "else": "threshold", "default": "water"}));
    assert!(both.expect_err("both").contains("leave one out"));
    // What is named by nothing else, and called air, is nothing.
    let (scene, _) = of(json!({"labels": "labels.nii", "default": "air", "map": {"1": "lung"}}));
    let scene = scene.expect("good");
    assert_eq!([(28, 2), (28, 10)].map(|(x, y)| matter_at(&scene, x, y).0), ["nothing", "lung"]);
}

#[test]
fn materials_are_listed_and_the_nearest_is_offered() {
    let folder = tempfile::tempdir().expect("folder");
    let all = sidecarm(folder.path(), &["materials", "--json"]);
    let all: Value = serde_json::from_slice(&all.stdout).expect("JSON");
    let rows = all["materials"].as_array().expect("rows");
    let titanium = rows.iter().find(|row| row["name"] == "titanium").expect("titanium");
    assert_eq!((titanium["density_g_per_cm3"].as_f64(), &titanium["mass_fractions"]["Ti"]), (Some(4.54), &json!(1.0)));
    let classes: Vec<&str> =
        all["threshold_classes"].as_array().expect("rows").iter().filter_map(|row| row["class"].as_str()).collect();
    assert_eq!(classes, ["air", "lung", "soft_tissue", "bone_cortical"]);
    let some = sidecarm(folder.path(), &["materials", "steel"]);
    let some = String::from_utf8_lossy(&some.stdout).into_owned();
    assert!(some.contains("steel_316l") && !some.contains("titanium"), "{some}");
    let none = sidecarm(folder.path(), &["materials", "titanum"]);
    assert_eq!(none.status.code(), Some(1));
    assert!(String::from_utf8_lossy(&none.stderr).contains("titanium"));
}
