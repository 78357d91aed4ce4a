//! NIfTI volumes and what becomes of their voxels.

use std::path::{Path, PathBuf};

use glam::DVec3;
use sidecarm::reporter::Reporter;
use sidecarm::scene::model::{Matter, Volume};
use sidecarm::scene::{self, PlacedBy, Scene, read_volume};

use super::scene_support::NiftiFile;

fn folder() -> tempfile::TempDir {
    tempfile::tempdir().expect("temporary folder")
}

fn read(file: &NiftiFile) -> Result<scene::VolumeFile, String> {
    let folder = folder();
    let path = folder.path().join("volume.nii");
    file.write(&path);
    read_volume(&path, &Reporter::silent()).map_err(|error| error.to_string())
}

fn close(a: DVec3, b: [f64; 3]) -> bool {
    a.distance(DVec3::from_array(b)) < 1e-4
}

#[test]
fn ras_becomes_lps_and_i_runs_fastest() {
    let mut file = NiftiFile::int16([3, 2, 2], &(0..12).collect::<Vec<i16>>());
    file.sform = Some([[2.0, 0.0, 0.0, 10.0], [0.0, 3.0, 0.0, 20.0], [0.0, 0.0, 4.0, 30.0]]);
    let volume = read(&file).expect("good");
    assert_eq!(volume.size, [3, 2, 2]);
    assert_eq!(volume.values[1 + 3 * (1 + 2)], 10.0, "voxel (1, 1, 1)");
    assert!(close(volume.lps_from_voxel.transform_point3(DVec3::ZERO), [-10.0, -20.0, 30.0]));
    assert!(close(volume.lps_from_voxel.transform_point3(DVec3::new(1.0, 1.0, 1.0)), [-12.0, -23.0, 34.0]));
}

#[test]
fn left_handed_oblique_and_quaternion_affines_are_right() {
    // Radiological storage: i runs to the patient's right in LAS data, so the affine is left-handed.
    let mut las = NiftiFile::int16([2, 2, 2], &[0; 8]);
    las.sform = Some([[-2.0, 0.0, 0.0, 5.0], [0.0, 2.0, 0.0, 0.0], [0.0, 0.0, 2.0, 0.0]]);
    let volume = read(&las).expect("good");
    assert!(volume.lps_from_voxel.matrix3.determinant() < 0.0);
    assert!(close(volume.lps_from_voxel.transform_point3(DVec3::X), [-3.0, 0.0, 0.0]));

    // A quarter turn about z (quaternion (cos 45°, 0, 0, sin 45°)) with qfac −1: x → y, y → −x, z mirrored.
    let mut turned = NiftiFile::int16([2, 2, 2], &[0; 8]);
    turned.sform = None;
    turned.pixdim = [-1.0, 1.0, 2.0, 3.0, 1.0, 1.0, 1.0, 1.0];
    turned.qform = Some([0.0, 0.0, 0.5f32.sqrt(), 7.0, 8.0, 9.0]);
    let volume = read(&turned).expect("good");
    assert_eq!(volume.placed_by, PlacedBy::Qform);
    assert!(close(volume.lps_from_voxel.transform_point3(DVec3::ZERO), [-7.0, -8.0, 9.0]));
    assert!(close(volume.lps_from_voxel.transform_vector3(DVec3::X), [0.0, -1.0, 0.0]));
    assert!(close(volume.lps_from_voxel.transform_vector3(DVec3::Y), [2.0, 0.0, 0.0]));
    assert!(close(volume.lps_from_voxel.transform_vector3(DVec3::Z), [0.0, 0.0, -3.0]));

    // Both: the sform counts. Neither: spacing alone, with a warning.
    turned.sform = las.sform;
    assert_eq!(read(&turned).expect("good").placed_by, PlacedBy::Sform);
    // An empty sform places nothing.
    turned.sform = Some([[0.0; 4]; 3]);
    assert_eq!(read(&turned).expect("good").placed_by, PlacedBy::Qform);
    (turned.sform, turned.qform) = (None, None);
    let folder = folder();
    let path = folder.path().join("volume.nii");
    turned.write(&path);
    let reporter = Reporter::silent();
    assert_eq!(read_volume(&path, &reporter).expect("good").spacing_mm, [1.0, 2.0, 3.0]);
    assert!(reporter.warnings().contains_key("no orientation"));
}

#[test]
fn units_scaling_types_and_byte_orders() {
    let mut metres = NiftiFile::int16([2, 1, 1], &[3, -4]);
    metres.sform = Some([[0.002, 0.0, 0.0, 0.0], [0.0, 0.001, 0.0, 0.0], [0.0, 0.0, 0.001, 0.0]]);
    metres.units = 1;
    metres.slope_intercept = [2.0, -1000.0];
    let volume = read(&metres).expect("good");
    assert!((volume.spacing_mm[0] - 2.0).abs() < 1e-6);
    assert_eq!(volume.values, [-994.0, -1008.0]);
    metres.slope_intercept = [0.0, 7.0];
    assert_eq!(read(&metres).expect("good").values, [3.0, -4.0], "slope 0 means unscaled");

    let cases: [(i16, Vec<u8>); 10] = [
        (2, vec![200, 5]),
        (256, vec![200, 5]),
        (4, [-500i16, 5].iter().flat_map(|x| x.to_be_bytes()).collect()),
        (512, [65000u16, 5].iter().flat_map(|x| x.to_be_bytes()).collect()),
        (8, [-70000i32, 5].iter().flat_map(|x| x.to_be_bytes()).collect()),
        (768, [70000u32, 5].iter().flat_map(|x| x.to_be_bytes()).collect()),
        (1024, [-70000i64, 5].iter().flat_map(|x| x.to_be_bytes()).collect()),
        (1280, [70000u64, 5].iter().flat_map(|x| x.to_be_bytes()).collect()),
        (16, [0.5f32, 5.0].iter().flat_map(|x| x.to_be_bytes()).collect()),
        (64, [-0.25f64, 5.0].iter().flat_map(|x| x.to_be_bytes()).collect()),
    ];
    let expected = [200.0, -56.0, -500.0, 65000.0, -70000.0, 70000.0, -70000.0, 70000.0, 0.5, -0.25];
    for ((datatype, voxels), first) in cases.into_iter().zip(expected) {
        let mut file = NiftiFile::int16([2, 1, 1], &[]);
        (file.datatype, file.voxels, file.big_endian) = (datatype, voxels, true);
        assert_eq!(read(&file).expect("good").values, [first, 5.0], "type {datatype}");
    }
}

#[test]
fn damaged_and_unsuitable_files_are_one_sentence() {
    let good = NiftiFile::int16([4, 4, 4], &[0; 64]);
    let folder = folder();
    let fails = |name: &str, bytes: &[u8]| {
        let path = folder.path().join(name);
        std::fs::write(&path, bytes).expect("temporary folder");
        let error = read_volume(&path, &Reporter::silent()).expect_err(name).to_string();
        assert!(error.contains(name) && !error.contains('\n'), "{error}");
        error
    };
    let bytes = good.bytes();
    let mut cuts = 0;
    for cut in [0, 10, 347, 352, bytes.len() - 1] {
        fails("cut.nii", &bytes[..cut]);
        cuts += 1;
    }
    assert_eq!(cuts, 5);
    assert!(fails("cut.nii", &bytes[..400]).contains("cut short"));
    let zipped_path = folder.path().join("good.nii.gz");
    good.write(&zipped_path);
    let zipped = std::fs::read(&zipped_path).expect("just written");
    assert!(read_volume(&zipped_path, &Reporter::silent()).is_ok());
    fails("cut.nii.gz", &zipped[..zipped.len() - 9]);
    let mut flipped = zipped.clone();
    let last = flipped.len() - 6;
    flipped[last] ^= 1;
    assert!(fails("flipped.nii.gz", &flipped).contains("damaged"), "gzip's checksum is looked at");

    let mut four = good.clone();
    four.dim = [4, 4, 4, 2, 2, 1, 1, 1];
    assert!(fails("four.nii", &four.bytes()).contains("4-dimensional"));
    four.dim = [4, 4, 4, 4, 1, 1, 1, 1];
    let path = folder.path().join("trailing.nii");
    four.write(&path);
    assert!(read_volume(&path, &Reporter::silent()).is_ok(), "a trailing axis of 1");
    let mut huge = good.clone();
    huge.dim = [3, 32767, 32767, 32767, 1, 1, 1, 1];
    assert!(fails("huge.nii", &huge.bytes()).contains("cut short"));
    // Zipped, only the memory says that it cannot be: with both numbers, before anything is read.
    let zipped_path = folder.path().join("huge.nii.gz");
    huge.write(&zipped_path);
    let error = read_volume(&zipped_path, &Reporter::silent()).expect_err("more than any memory").to_string();
    assert!(error.contains("32767 x 32767 x 32767 voxels need 2293") && error.contains("GiB are free"), "{error}");
    huge.dim[1] = -4;
    assert!(fails("negative.nii", &huge.bytes()).contains("-4"));
    let mut complex = good.clone();
    complex.datatype = 32;
    assert!(fails("complex.nii", &complex.bytes()).contains("Complex64"));
    let mut flat = good.clone();
    flat.sform = Some([[1.0, 0.0, 0.0, 0.0], [1.0, 0.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0]]);
    assert!(fails("flat.nii", &flat.bytes()).contains("singular"));
    let mut nan = NiftiFile::int16([2, 1, 1], &[]);
    (nan.datatype, nan.voxels) = (16, [f32::NAN, 0.0].iter().flat_map(|x| x.to_le_bytes()).collect());
    assert!(fails("nan.nii", &nan.bytes()).contains("1 of 2 voxels"));
    let mut pair = good.bytes();
    pair[345] = b'i';
    assert!(fails("pair.nii", &pair).contains(".hdr/.img"));
    assert!(
        read_volume(Path::new("not/there.nii"), &Reporter::silent()).expect_err("missing").to_string().contains("not/there.nii")
    );
}

fn ct_scene(folder: &Path, objects: &str) -> Result<Scene, String> {
    let path = folder.join("scene.json");
    let text = format!(r#"{{"objects": [{objects}], "beam": {{"mono_kev": 60}}, "detector": {{"pitch_mm": 0.2}}}}"#);
    std::fs::write(&path, text).expect("temporary folder");
    scene::load(&path, false, &Reporter::silent()).map_err(|error| error.to_string())
}

fn only_volume(scene: &Scene) -> &Volume {
    let Matter::Volume(volume) = &scene.objects[0].matter else { panic!("a volume") };
    volume
}

#[test]
fn thresholds_densities_and_padding() {
    let folder = folder();
    let hu = [-2048, -1000, -701, -700, 0, 250, 251, 1700];
    NiftiFile::int16([8, 1, 1], &hu).write(&folder.path().join("ct.nii.gz"));
    let scene = ct_scene(folder.path(), r#"{"ct": {"path": "ct.nii.gz", "materials": "threshold"}}"#).expect("good");
    let names: Vec<&str> = scene.materials.iter().map(|material| material.name.as_str()).collect();
    assert_eq!(names, ["soft_tissue", "bone_cortical"]);
    let volume = only_volume(&scene);
    assert_eq!(volume.class, [0, 0, 0, 1, 1, 1, 2, 2]);
    assert_eq!(volume.unknown, [true, false, false, false, false, false, false, false]);
    assert!(volume.truncated_at_faces);
    assert_eq!(volume.density_g_per_cm3[..3], [0.0; 3]);
    assert!((volume.density_g_per_cm3[4] - 1.0).abs() < 1e-6 && (volume.density_g_per_cm3[7] - 1.92).abs() < 1e-6);
    assert_eq!(scene.inputs.len(), 2);
    assert!(scene.inputs.iter().all(|input| input.sha256.len() == 64));

    let kept =
        ct_scene(folder.path(), r#"{"ct": {"path": "ct.nii.gz", "materials": "threshold", "air": "keep"}}"#).expect("good");
    let volume = only_volume(&kept);
    assert_eq!(volume.class, [1, 1, 1, 2, 2, 2, 3, 3]);
    assert!((volume.density_g_per_cm3[0] - 0.0012).abs() < 1e-6 && kept.is_air(volume.class_materials[0]));
}

#[test]
fn classes_without_voxels_leave_no_material() {
    let folder = folder();
    NiftiFile::int16([2, 1, 1], &[0, -1000]).write(&folder.path().join("ct.nii"));
    let scene = ct_scene(folder.path(), r#"{"ct": {"path": "ct.nii", "materials": "threshold"}}"#).expect("good");
    assert_eq!(scene.materials.len(), 1);
    assert_eq!(only_volume(&scene).class, [1, 0]);
}

#[test]
fn labels_pick_the_composition_and_nominal_the_density() {
    let folder = folder();
    NiftiFile::int16([6, 1, 1], &[0, 0, -980, -850, 3000, 0]).write(&folder.path().join("ct.nii"));
    NiftiFile::int16([6, 1, 1], &[0, 7, 0, 8, 9, 10]).write(&folder.path().join("labels.nii"));
    let labels = r#"{"ct": {"path": "ct.nii", "materials": {"labels": "labels.nii", "default": "soft_tissue",
        "map": {"7": "Bone_Cortical", "8": "lung", "9": {"material": "titanium", "density": "nominal"}, "10": "air"}}}}"#;
    let scene = ct_scene(folder.path(), labels).expect("good");
    let volume = only_volume(&scene);
    let name = |voxel: usize| {
        let class = usize::from(volume.class[voxel]);
        if class == 0 { "nothing" } else { scene.materials[volume.class_materials[class - 1]].name.as_str() }
    };
    assert_eq!([0, 1, 2, 3, 4, 5].map(name), ["soft_tissue", "bone_cortical", "nothing", "lung", "titanium", "nothing"]);
    assert!((volume.density_g_per_cm3[1] - 1.0).abs() < 1e-6, "a label does not change the density");
    assert!((volume.density_g_per_cm3[4] - 4.54).abs() < 1e-6, "nominal does");

    // The same labels, their first axis backwards along the CT's second and their second along its first.
    let mut turned = NiftiFile::int16([1, 6, 1], &[10, 9, 8, 0, 7, 0]);
    turned.sform = Some([[0.0, -1.0, 0.0, 5.0], [-1.0, 0.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0]]);
    turned.write(&folder.path().join("turned.nii"));
    let again = ct_scene(folder.path(), &labels.replace("labels.nii", "turned.nii")).expect("good");
    assert_eq!(only_volume(&again).class, volume.class);

    for (map, warnings) in [(labels.to_owned(), 0), (labels.replace(r#""10": "air""#, r#""77": "air""#), 1)] {
        ct_scene(folder.path(), &map).expect("good");
        let reporter = Reporter::silent();
        scene::load(&folder.path().join("scene.json"), false, &reporter).expect("good");
        let found = reporter.warnings();
        assert_eq!(found.len(), warnings, "{found:?}");
        assert!(warnings == 0 || format!("{found:?}").contains("no voxel has the labels 77"), "{found:?}");
    }

    NiftiFile::int16([5, 1, 1], &[0; 5]).write(&folder.path().join("labels.nii"));
    assert!(ct_scene(folder.path(), labels).expect_err("size").contains("not on the grid"));
    let mut moved = NiftiFile::int16([6, 1, 1], &[0; 6]);
    moved.sform = Some([[1.0, 0.0, 0.0, 0.5], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0]]);
    moved.write(&folder.path().join("labels.nii"));
    assert!(ct_scene(folder.path(), labels).expect_err("place").contains("0.500 mm apart"));
}

#[test]
fn voxelised_tools_are_fractions_in_their_own_frame() {
    let folder = folder();
    let mut file = NiftiFile::int16([2, 1, 1], &[]);
    (file.datatype, file.voxels) = (16, [0.5f32, 0.0].iter().flat_map(|x| x.to_le_bytes()).collect());
    file.write(&folder.path().join("tool.nii"));
    let tool = r#"{"voxels": {"path": "tool.nii", "material": "nitinol",
        "lps_from_voxels_frame": [[1,0,0,5],[0,0,-1,0],[0,1,0,0],[0,0,0,1]]}}"#;
    let scene = ct_scene(folder.path(), tool).expect("good");
    let volume = only_volume(&scene);
    assert!((volume.density_g_per_cm3[0] - 3.225).abs() < 1e-6 && volume.class == [1, 0] && !volume.truncated_at_faces);
    assert!(close(volume.lps_from_voxel.transform_vector3(DVec3::Z), [0.0, -1.0, 0.0]));
    assert!(close(volume.lps_from_voxel.transform_point3(DVec3::ZERO), [5.0, 0.0, 0.0]));
    file.voxels = [1.5f32, 0.0].iter().flat_map(|x| x.to_le_bytes()).collect();
    file.write(&folder.path().join("tool.nii"));
    assert!(ct_scene(folder.path(), tool).expect_err("fraction").contains("outside 0 to 1"));
}

/// A NIfTI-2 file was called damaged, and nobody was told what to do.
#[test]
fn nifti_2_is_told_from_damage() {
    let folder = folder();
    let path = folder.path().join("x.nii");
    let complaint = |size: [u8; 4], length: usize| {
        let mut bytes = vec![0u8; length];
        bytes[..4].copy_from_slice(&size);
        bytes[4..8].copy_from_slice(b"n+2\0");
        std::fs::write(&path, bytes).expect("writes");
        read_volume(&path, &Reporter::silent()).expect_err("no volume").to_string()
    };
    for size in [540i32.to_le_bytes(), 540i32.to_be_bytes()] {
        assert!(complaint(size, 600).contains("this is NIfTI-2; convert it to NIfTI-1"), "{}", complaint(size, 600));
    }
    for (size, length) in [(541i32.to_le_bytes(), 600), (540i32.to_le_bytes(), 300)] {
        assert!(complaint(size, length).contains("no NIfTI-1 header"), "control: {}", complaint(size, length));
    }
}

/// Real CTs, where they are at hand.
#[test]
fn real_cts_load_with_their_labels() {
    let data: PathBuf = Path::new(env!("CARGO_MANIFEST_DIR")).join("../shared/data");
    let cases = [
        ("ct-pelvis", [122, 101, 112], [3.0, 3.0, 3.0], 1.0, "77"),
        ("ct-chest", [512, 512, 133], [0.703, 0.703, 2.5], -1.0, "92"),
    ];
    for (name, size, spacing, handedness, label) in cases {
        let folder = data.join(name);
        if !folder.join("ct.nii.gz").is_file() {
            println!("skipped: {} is not there", folder.display());
            continue;
        }
        let file = read_volume(&folder.join("ct.nii.gz"), &Reporter::silent()).expect("good");
        assert_eq!(file.size, size, "{name}");
        assert!(file.spacing_mm.iter().zip(spacing).all(|(a, b)| (a - b).abs() < 0.01), "{name}: {:?}", file.spacing_mm);
        let m = file.lps_from_voxel.matrix3;
        assert!(m.determinant() * handedness > 0.0, "{name}: RAS is right-handed in LPS too, LAS is not");
        assert!(m.x_axis.x * handedness < 0.0 && m.y_axis.y < 0.0 && m.z_axis.z > 0.0, "{name}: {m}");
        let objects = format!(
            r#"{{"ct": {{"path": "{0}/ct.nii.gz", "materials": {{"labels": "{0}/labels.nii.gz", "default": "soft_tissue", "map": {{"{label}": "bone_cortical"}}}}}}}}"#,
            folder.display()
        );
        let temporary = tempfile::tempdir().expect("temporary folder");
        let scene = ct_scene(temporary.path(), &objects).expect("same grid");
        assert_eq!(scene.materials.len(), 2, "{name}");
    }
}
