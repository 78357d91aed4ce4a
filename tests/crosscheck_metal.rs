//! Beads against metal that the CT itself shows, where the scene draws none: through `check` and through `live`.
#![cfg(unix)]

use std::io::{Read, Write};
use std::path::Path;

use serde_json::{Value, json as value};

use crate::crosscheck_image::{json, kit};
use crate::crosscheck_live::live;
use crate::crosscheck_session::{check, check_unrehearsed, copy, edit, move_beads};
use crate::session_demo::mock_is_built;

const CHECK: &str = "beads and CT metal";

type Place = [f64; 3];

/// Where the kit's beads are, lps mm.
fn beads(lab: &Path) -> Vec<Place> {
    let points = json(&lab.join("beads.mrk.json"))["markups"][0]["controlPoints"].clone();
    let points = points.as_array().expect("points");
    points.iter().map(|point| serde_json::from_value(point["position"].clone()).expect("three numbers")).collect()
}

/// The scene without its bead spheres: nothing but the CT tells where metal is.
fn without_spheres(lab: &Path) {
    edit(lab, "scene.json", |scene| {
        let objects = scene["objects"].as_array_mut().expect("a list");
        objects.retain(|object| object["sphere"].is_null());
        assert!(!objects.is_empty());
    });
}

/// Writes metal into the CT, as a scanner shows beads that were there when it scanned: the eight voxels around each place.
fn scan_with_metal(lab: &Path, places: &[Place]) {
    const METAL_HU: i16 = 3071;
    let (path, mut bytes) = (lab.join("ct.nii.gz"), Vec::new());
    let file = std::fs::File::open(&path).expect("the CT");
    flate2::read::GzDecoder::new(file).read_to_end(&mut bytes).expect("unpacks");
    let number = |at: usize| f64::from(f32::from_le_bytes(bytes[at..at + 4].try_into().expect("four")));
    let short = |at: usize| usize::from(u16::from_le_bytes(bytes[at..at + 2].try_into().expect("two")));
    let size = [42, 44, 46].map(short);
    // Rows of the sform, which is diagonal and in RAS: scale on the diagonal, offset at the end.
    let axis = |n: usize| (number(280 + 16 * n + 4 * n), number(280 + 16 * n + 12));
    let first = number(108) as usize;
    let mut voxels = Vec::new();
    for [x, y, z] in places {
        let at: Vec<f64> = [-x, -y, *z].into_iter().enumerate().map(|(n, mm)| (mm - axis(n).1) / axis(n).0).collect();
        for corner in 0..8usize {
            let index = |n: usize| at[n].floor() as usize + (corner >> n & 1);
            assert!((0..3).all(|n| index(n) < size[n]), "the bead lies in the CT: {at:?}");
            voxels.push(first + 2 * (index(0) + size[0] * (index(1) + size[1] * index(2))));
        }
    }
    for at in voxels {
        bytes[at..at + 2].copy_from_slice(&METAL_HU.to_le_bytes());
    }
    let mut packed = flate2::write::GzEncoder::new(std::fs::File::create(&path).expect("writable"), flate2::Compression::fast());
    packed.write_all(&bytes).and_then(|()| packed.finish().map(drop)).expect("written");
}

fn say_ras(lab: &Path) {
    edit(lab, "beads.mrk.json", |beads| beads["markups"][0]["coordinateSystem"] = value!("RAS"));
}

fn mirror(lab: &Path) {
    move_beads(lab, |[x, y, z]| [-x, y, z]);
}

/// Still in the specimen, and at none of its metal: other distances from each other.
fn of_another_specimen(lab: &Path) {
    move_beads(lab, |[x, y, z]| [0.55 * y + 3.0, 0.7 * z - 4.0, 0.45 * x + 0.2 * z]);
}

type Fault = (&'static str, fn(&Path), &'static str, &'static [&'static str]);

/// Faults of a layout: how, the level of the check, words that it uses.
const FAULTS: [Fault; 4] = [
    (
        "ras",
        say_ras,
        "fail",
        &["RAS and LPS were swapped", "says RAS but its numbers are LPS: set its coordinateSystem to \"LPS\""],
    ),
    ("mirrored", mirror, "fail", &["mirrored (x negated)", "export the beads again from the CT that the scene names"]),
    (
        "shifted",
        |lab| move_beads(lab, |[x, y, z]| [x + 9.0, y, z - 7.0]),
        "fail",
        &["shifted by (9.0, 0.0, -7.0) mm", "export the beads again"],
    ),
    ("another", of_another_specimen, "warn", &["none of 9 beads lies at one", "CT and beads are of the same specimen"]),
];

#[test]
fn a_layout_that_is_not_the_metal_of_the_ct_is_named_with_its_remedy_and_the_right_one_is_silent() {
    if !mock_is_built() {
        return;
    }
    let folder = tempfile::tempdir().expect("temporary folder");
    let lab = kit(folder.path(), &["--exposures", "1"]);
    edit(&lab, "session.json", |session| session["robot"] = Value::Null);
    without_spheres(&lab);
    // The control: a CT without metal cannot tell, so what is said below is said by the metal.
    let bare = copy(&lab, "bare");
    mirror(&bare);
    let row = |rows: &[(String, String, String)]| rows.iter().find(|row| row.0 == CHECK).expect("checked").clone();
    let (_, level, words) = row(&check_unrehearsed(&bare).0);
    assert!(level == "pass" && words.contains("nothing can be said"), "{words}");

    scan_with_metal(&lab, &beads(&lab));
    let (good, _) = check(&copy(&lab, "good"));
    let (_, level, words) = row(&good);
    assert!(level == "pass" && words.contains("9 of 9 beads lie at bright spots of the CT (9 found)"), "{words}");
    let doubtful =
        |row: &&(String, String, String)| row.1 != "pass" && row.0 != "robot" && row.0 != "C-arm port" && row.0 != "disk space";
    assert_eq!(good.iter().filter(doubtful).collect::<Vec<_>>(), Vec::<&(String, String, String)>::new());
    let mut cases = 0;
    for (name, spoil, expected, says) in FAULTS {
        let spoiled = copy(&lab, name);
        spoil(&spoiled);
        let (_, level, words) = row(&check_unrehearsed(&spoiled).0);
        assert_eq!(level, expected, "{name}: {words}");
        assert!(says.iter().all(|word| words.contains(word)) && !words.ends_with("→ "), "{name}: {says:?} are not in: {words}");
        cases += 1;
    }
    assert_eq!(cases, 4);
}

/// A layout: how it is spoiled, the check that finds it, and what is said of it.
type Case = (&'static str, fn(&Path), &'static str, &'static [&'static str]);

/// Without spheres in the scene nothing held the beads against anything: a mirrored layout gave mirrored poses in green.
#[test]
fn a_live_session_refuses_beads_that_are_not_the_metal_of_the_ct() {
    if !mock_is_built() {
        return;
    }
    let cases: [Case; 4] = [
        ("right", |_| (), CHECK, &[]),
        ("mirrored", mirror, CHECK, &["mirrored (x negated)", "export the beads again from the CT that the scene names"]),
        (
            "metres",
            |lab| move_beads(lab, |place| place.map(|mm| 1e-3 * mm)),
            "bead units",
            &["they look like metres taken for millimetres", "export the beads in millimetres"],
        ),
        (
            "outside",
            // Also in distances, or the CT's metal would tell by how much they were shifted.
            |lab| {
                of_another_specimen(lab);
                move_beads(lab, |[x, y, z]| [x + 400.0, y, z]);
            },
            "beads in specimen",
            &["9 of 9 beads are more than 8 mm from any matter", "check that CT and beads are of the same specimen"],
        ),
    ];
    let run = |(name, spoil, check, says): &Case| {
        let folder = tempfile::tempdir().expect("temporary folder");
        let (pairs, report, words) = live(folder.path(), &["--no-robot"], |lab| {
            without_spheres(lab);
            scan_with_metal(lab, &beads(lab));
            spoil(lab);
        });
        let told = format!("check: {check}");
        if says.is_empty() {
            let good = pairs.iter().filter(|pair| pair["pose_source"] == "beads").count();
            assert!(good >= 2 && !words.contains("0 accepted") && !words.contains(&told), "{name}: {words}");
            assert!(!report.contains("bright spots"), "{name}");
            return;
        }
        for pair in &pairs {
            let reason = pair["reason"].as_str().unwrap_or_default();
            let status = pair["status"].as_str().expect("a word");
            assert!(["refused", "no_pose"].contains(&status) && pair["pose_source"] != "beads", "{name}: {pair:#}");
            assert!(says.iter().all(|word| reason.contains(word)), "{name}: {says:?} are not in: {reason}");
        }
        assert!(words.contains(&told) && words.contains("0 accepted") && words.contains("exit status: 3"), "{name}: {words}");
        assert!(!words.contains("tied to the room") && report.contains(says[0]), "{name}: {words}");
    };
    let run = &run;
    cases.chunks(2).for_each(|cases| {
        std::thread::scope(|scope| {
            let runs: Vec<_> = cases.iter().map(|case| scope.spawn(move || run(case))).collect();
            runs.into_iter().for_each(|run| run.join().expect("as expected"));
        });
    });
}
