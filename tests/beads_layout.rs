//! Slicer's point lists, right and wrong.

use std::path::{Path, PathBuf};

use glam::DVec3;
use sidecarm::beads::{BeadsError, read_landmarks, read_markups, says_ras};

fn file(name: &str, text: &str) -> (tempfile::TempDir, PathBuf) {
    let folder = tempfile::tempdir().expect("a temporary folder");
    let path = folder.path().join(name);
    std::fs::write(&path, text).expect("written");
    (folder, path)
}

fn json(system: &str, units: &str, points: &str) -> String {
    format!(
        r#"{{"@schema":"x","markups":[{{"type":"Fiducial","coordinateSystem":{system},"coordinateUnits":{units},"controlPoints":[{points}]}}]}}"#
    )
}

#[test]
fn every_coordinate_system_and_unit_lands_in_lps_millimetres() {
    let mut cases = 0;
    for (system, units, position, expected) in [
        ("\"LPS\"", "\"mm\"", "[1,2,3]", DVec3::new(1.0, 2.0, 3.0)),
        ("\"RAS\"", "\"mm\"", "[1,2,3]", DVec3::new(-1.0, -2.0, 3.0)),
        ("\"0\"", "\"mm\"", "[1,2,3]", DVec3::new(-1.0, -2.0, 3.0)),
        ("1", "\"mm\"", "[1,2,3]", DVec3::new(1.0, 2.0, 3.0)),
        ("\"LPS\"", "\"m\"", "[0.001,0.002,0.003]", DVec3::new(1.0, 2.0, 3.0)),
    ] {
        let point = format!(
            r#"{{"id":"1","label":"F-1","description":"steel radius_mm=0.75; sigma_mm=0.05 body=pelvis","position":{position},"positionStatus":"defined"}},
               {{"id":"2","label":"F-2","position":null,"positionStatus":"undefined"}}"#
        );
        let (_folder, path) = file("b.mrk.json", &json(system, units, &point));
        let layout = read_markups(&path).expect("readable");
        assert_eq!(layout.beads.len(), 1);
        let bead = &layout.beads[0];
        assert!(bead.lps_mm.distance(expected) < 1e-12, "{system} {units}: {}", bead.lps_mm);
        assert_eq!((bead.radius_mm, bead.sigma_mm, bead.body.as_str()), (Some(0.75), Some(0.05), "pelvis"));
        cases += 1;
    }
    assert_eq!(cases, 5);
}

#[test]
fn fcsv_is_read_with_its_columns_and_status() {
    let text = "# Markups fiducial file version = 4.11\n# CoordinateSystem = LPS\n# columns = id,x,y,z,ow,ox,oy,oz,vis,sel,lock,label,desc,associatedNodeID\n\
        n0,10,20,30,0,0,0,1,1,1,0,\"a, first\",radius_mm=1.0,,2,0\nn1,1,2,3,0,0,0,1,1,1,0,b,,,0,0\n";
    let (_folder, path) = file("b.fcsv", text);
    let layout = read_markups(&path).expect("readable");
    assert_eq!(layout.beads.len(), 1);
    assert_eq!((layout.beads[0].name.as_str(), layout.beads[0].lps_mm), ("a, first", DVec3::new(10.0, 20.0, 30.0)));
    assert_eq!(read_landmarks(&path).expect("readable").len(), 1);
    let (_folder, path) = file("b.fcsv", &text.replace("= LPS", "= 0"));
    assert_eq!(read_markups(&path).expect("readable").beads[0].lps_mm, DVec3::new(-10.0, -20.0, 30.0));
    let (_folder, path) = file("b.fcsv", "n0,10,20,30,0,0,0,1,1,1,0,a,,\n");
    assert!(matches!(read_markups(&path), Err(BeadsError::Form { .. })));
}

/// As spreadsheets and Windows write it: a byte order mark, CRLF, labels in quotes with commas and quotes of their own, blank lines.
#[test]
fn an_fcsv_keeps_labels_in_quotes_whatever_wrote_it() {
    let text = "\u{feff}# Markups fiducial file version = 4.11\r\n# CoordinateSystem = LPS\r\n# columns = id,x,y,z,label,desc,associatedNodeID\r\n\
        n0,10,20,30,\"hip, left, \"\"upper\"\"\",\"radius_mm=1.0, body=pelvis\",\r\n\r\n# of the second day\r\nn1, 1 ,2,3, b ,,\r\n \r\n\r\n";
    let (_folder, path) = file("b.fcsv", text);
    let beads = read_markups(&path).expect("readable").beads;
    let found: Vec<(&str, DVec3)> = beads.iter().map(|bead| (bead.name.as_str(), bead.lps_mm)).collect();
    assert_eq!(found, [("hip, left, \"upper\"", DVec3::new(10.0, 20.0, 30.0)), ("b", DVec3::new(1.0, 2.0, 3.0))]);
    assert_eq!((beads[0].radius_mm, beads[0].body.as_str()), (Some(1.0), "pelvis"));
    // Blank lines and comments count, and a comma within quotes parts nothing.
    for (last, words) in [("n1,1,y,3,b,,", "line 7: 1,y,3"), ("\"n1,1,2,3,b\"", "line 7 is 1 cells")] {
        let (_folder, path) = file("b.fcsv", &text.replace("n1, 1 ,2,3, b ,,", last));
        let message = read_markups(&path).expect_err(words).to_string();
        assert!(message.contains(words), "{message}");
    }
}

#[test]
fn damage_is_named() {
    let good = r#"{"label":"F-1","position":[1,2,3]}"#;
    let expect = |name: &str, text: &str, word: &str| {
        let (_folder, path) = file(name, text);
        let message = read_markups(&path).expect_err(word).to_string();
        assert!(message.contains(word) && message.contains(name), "{message}");
    };
    expect("b.mrk.json", "{\"markups\": [", "not readable as JSON");
    expect("b.mrk.json", "{}", "markups");
    expect("b.mrk.json", &json("\"XYZ\"", "\"mm\"", good), "LPS or RAS");
    expect("b.mrk.json", &json("\"LPS\"", "\"inch\"", good), "coordinateUnits");
    expect("b.mrk.json", &json("\"LPS\"", "\"mm\"", ""), "no defined point");
    expect("b.mrk.json", &json("\"LPS\"", "\"mm\"", &format!("{good},{good}")), "occurs twice");
    expect("b.mrk.json", &json("\"LPS\"", "\"mm\"", r#"{"label":"F-1","position":[1,null,3]}"#), "F-1");
    expect(
        "b.mrk.json",
        &json("\"LPS\"", "\"mm\"", r#"{"label":"F-1","position":[1,2,3],"description":"radius_mm=-1"}"#),
        "radius_mm=-1",
    );
    expect("b.fcsv", "# CoordinateSystem = LPS\nn0,nan,2,3,0,0,0,1,1,1,0,a,,\n", "position");
    expect("b.txt", "", "expected a Slicer markups file");
}

/// Whoever puts right what a file says of its axes must know what it says, in either format and in Slicer's old numbers.
#[test]
fn what_a_file_says_of_its_axes_is_known_in_every_form() {
    let json = |stated: &str| format!("{{\"markups\": [{{\"coordinateSystem\": {stated}}}]}}");
    let fcsv =
        |stated: &str| format!("# Markups fiducial file version = 4.11\n# CoordinateSystem = {stated}\n# columns = id,x,y,z\n");
    for (stated, ras) in [("RAS", Some(true)), ("0", Some(true)), ("LPS", Some(false)), ("1", Some(false)), ("IJK", None)] {
        for text in [json(&format!("\"{stated}\"")), fcsv(stated)] {
            assert_eq!(says_ras(Path::new("b"), text.as_bytes()), ras, "{text}");
        }
    }
    assert_eq!(says_ras(Path::new("b"), json("0").as_bytes()), Some(true));
    assert_eq!(says_ras(Path::new("b"), json("null").as_bytes()), None);
    assert_eq!(says_ras(Path::new("b"), b"id,x,y,z\n"), None);
}

/// `radius=0.75` was passed over in silence: the size of the beads, and with it a bound on their depth, was not known.
#[test]
fn words_that_are_not_read_are_named_and_sentences_are_not() {
    let read = |descriptions: [&str; 3]| {
        let point = |(n, words): (usize, &str)| format!(r#"{{"label":"F-{n}","position":[{n},2,3],"description":"{words}"}}"#);
        let points: Vec<String> = descriptions.into_iter().enumerate().map(point).collect();
        let (_folder, path) = file("b.mrk.json", &json("\"LPS\"", "\"mm\"", &points.join(",")));
        read_markups(&path).expect("readable")
    };
    let layout = read(["radius=0.75 body=pelvis", "radius=0.75", "Role: check, sat well"]);
    assert_eq!((layout.doubts.len(), layout.checks.len()), (2, 0), "{:?}", layout.doubts);
    let [radius, role] = &layout.doubts[..] else { panic!("{:?}", layout.doubts) };
    assert!(radius.contains("radius= in the description of F-0 and of 1 more") && radius.contains("radius_mm=0.75"), "{radius}");
    assert!(role.contains("Role: in the description of F-2 is not read") && role.contains("role=check"), "{role}");
    assert!(layout.doubts.iter().all(|words| layout.notes.contains(words)), "every pose says them: {:?}", layout.notes);
    let slip = read(["radius_mm=0.075", "radius_mm=0.075", "radius_mm=0.075"]).doubts.concat();
    assert!(slip.contains("radius_mm=0.075") && slip.contains("F-0 and of 2 more") && slip.contains("centimetres"), "{slip}");
    let sound = read(["radius_mm=0.75 role=check", "steel, at the rim: see photo 3", "the body of this one is worn"]);
    assert!(sound.doubts.is_empty() && sound.notes.is_empty(), "the control: {:?}", sound.notes);
}
