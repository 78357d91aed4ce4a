//! Declarations of lines: what they may say, what they keep in a log and take out of one that is given away, and the documentation's examples.

use serde_json::{Value, json};
use sidecarm::telemetry::LineAdapter;
use sidecarm::telemetry::lines::{Declaration, LineBlanker};

use crate::telemetry_lines::{Heard, adapter, clocked, plain, shipped};

#[test]
fn a_declaration_that_cannot_hold_names_the_key() {
    type Change = fn(&mut Value);
    let cases: [(Change, &str, &str); 20] = [
        (
            |d| d["robot"]["sensed_angles"][2]["unit"] = json!("mm"),
            "robot.sensed_angles[2].unit",
            "no unit of an angle, expected one of deg",
        ),
        (
            |d| _ = d["robot"]["sensed_angles"][0].as_object_mut().map(|o| o.remove("unit")),
            "sensed_angles[0].unit",
            "no unit is stated",
        ),
        (|d| d["robot"]["sensed_angles"][0]["from"] = json!("z"), "robot.sensed_angles[0].from", "\"z\" is none of the columns"),
        (|d| d["robot"]["sensed_angles"][0]["sign"] = json!(2), "sensed_angles[0].sign", "expected 1 or -1"),
        (|d| d["robot"]["sensed_angles"][0]["scale"] = json!(0), "sensed_angles[0].scale", "positive"),
        (|d| d["robot"]["sensed_angles"][0]["min"] = json!(5), "x", "x"),
        (|d| d["robot"]["sensed_angles"][0]["max"] = json!(-5), "x", "x"),
        (|d| d["device_time"]["unit"] = json!("m"), "device_time.unit", "no unit of a time"),
        (|d| d["device_time"]["wraps_at"] = json!(10), "device_time.wraps_at", "a second or more"),
        (|d| d["sequence"]["wraps_at"] = json!(1), "sequence.wraps_at", "expected 16"),
        (|d| d["host_time_sigma_ms"] = json!(5), "host_time_sigma_ms", "leave one of the two out"),
        (|d| d["origin"] = json!(" "), "origin", "is empty"),
        (|d| d["format"]["csv"]["separator"] = json!("::"), "format.csv.separator", "one character"),
        (|d| d["format"]["csv"]["decimal"] = json!(","), "format.csv.decimal", "separator as well"),
        (|d| d["format"]["csv"]["header"] = json!(true), "format.csv.columns", "leave one of the two out"),
        (|d| d["format"]["csv"]["columns"].as_array_mut().expect("a list").push(json!("a")), "format.csv.columns", "named twice"),
        (|d| d["format"] = json!({"regex": {"pattern": "(?<t>\\d+"}}), "format.regex.pattern", "no regular expression"),
        (|d| d["format"] = json!({"regex": {"pattern": "(?<t>\\d+)"}}), "sequence.from", "none of the named groups t"),
        (|d| d["ignore"] = json!(["ok", "*"]), "ignore[1]", "no regular expression"),
        (|d| d["robot"] = json!({"drill_speed": {"from": "a", "unit": "rpm"}}), "robot", "says no angles"),
    ];
    let mut refused = 0;
    for (change, place, words) in cases {
        let mut declaration = clocked();
        change(&mut declaration);
        if place == "x" {
            // A bound alone is none of these faults.
            assert!(LineAdapter::try_from(typed(&declaration)).is_ok());
            continue;
        }
        let error = LineAdapter::try_from(typed(&declaration)).expect_err(place);
        assert!(error.place.contains(place) && error.detail.contains(words), "{place}: {error}");
        refused += 1;
    }
    assert_eq!(refused, 18);
    // Both bounds, the wrong way round.
    let mut declaration = clocked();
    declaration["robot"]["sensed_angles"][1]["min"] = json!(5);
    declaration["robot"]["sensed_angles"][1]["max"] = json!(-5);
    assert!(LineAdapter::try_from(typed(&declaration)).is_err_and(|error| error.place == "robot.sensed_angles[1].min"));
    // Keys that are not known, and four angles.
    for (key, value) in [("colour", json!("red")), ("robot", json!({"sensed_angles": [1, 2, 3, 4]}))] {
        let mut declaration = clocked();
        declaration[key] = value;
        assert!(serde_json::from_value::<Declaration>(declaration).is_err(), "{key}");
    }
}

fn typed(declaration: &Value) -> Declaration {
    serde_json::from_value(declaration.clone()).expect("the keys are known")
}

#[test]
fn what_is_beyond_its_bounds_or_no_rotation_is_refused() {
    let mut declaration = plain();
    declaration["robot"]["sensed_angles"][0] =
        json!({"from": "a", "unit": "deg", "scale": 0.5, "offset": -1, "min": -2, "max": 2});
    let heard = Heard::of(&declaration, b"6,2,3,4,5\n7,2,3,4,5\n-2,2,3,4,5\n-3,2,3,4,5\n");
    assert_eq!(heard.robots().iter().map(|robot| robot.sensed_deg.expect("declared")[0]).collect::<Vec<_>>(), [2.0, -2.0]);
    assert!(heard.faults.len() == 2 && heard.faults[0].contains("expected -2 to 2 deg"), "{:?}", heard.faults);
    let base = shipped("generic-robot-json.json");
    let object = |qw: f64| {
        json!({"joints": [0, 0, 0, 0, 0], "stopped": false,
        "base": {"x": 0, "y": 0, "z": 0, "qx": 0, "qy": 0, "qz": 0.6, "qw": qw}})
    };
    let heard = Heard::of(&base, format!("{}\n{}\n", object(0.8), object(0.5)).as_bytes());
    assert_eq!((heard.health().frames, heard.health().corrupt), (1, 1));
    assert!(heard.faults[0].contains("no rotation") && heard.faults[0].contains("0.781"), "{:?}", heard.faults);
    let unknown = format!("{}\n", object(0.8)).replace("false", "\"perhaps\"");
    let heard = Heard::of(&base, unknown.as_bytes());
    assert!(heard.faults[0].contains("'perhaps', expected true or false"), "{:?}", heard.faults);
    for text in ["[1,2]", "{\"joints\": [0,0,0,0,0]", "{\"joints\": [0,0,0,0], \"stopped\": false}", "{} {}", "null"] {
        assert_eq!(Heard::of(&base, format!("{text}\n").as_bytes()).health().corrupt, 1, "{text}");
    }
}

/// A log keeps the declaration: what comes back from it reads the same.
#[test]
fn a_declaration_comes_back_from_a_log_as_it_was() {
    for name in ["generic-robot-csv.json", "generic-robot-json.json", "generic-carm-regex.json"] {
        let declared = adapter(&shipped(name));
        let text = serde_json::to_string(&declared).expect("serialises");
        let back: LineAdapter = serde_json::from_str(&text).expect("is one");
        assert_eq!(back, declared, "{name}");
        assert_eq!(serde_json::to_string(&back).expect("serialises"), text);
        assert_eq!(declared.nameless("removed").expect("a pattern").declaration().origin, "removed");
    }
}

/// What a log that is given away may hold of lines: all that a sample rests on, and nothing else.
#[test]
fn words_that_no_sample_rests_on_are_taken_out_and_the_sample_is_the_same() {
    let mut declaration = plain();
    declaration["format"]["csv"]["columns"] = json!(["a", "who", "b", "c", "d", "e", "id"]);
    declaration["format"]["csv"]["comment"] = json!("#");
    let mut blanker = LineBlanker::new(&adapter(&declaration));
    let mut blanked = |line: &str| String::from_utf8(blanker.blanked(line.as_bytes())).expect("text");
    assert_eq!(blanked("11.5,Quaxwelk_7,2,33,4,5,4711"), "11.5,aaaaaaaaa1,2,33,4,5,1111");
    assert_eq!(blanked("# Dr. Müller, 1961"), "# aa. aaaaaaa, 1111");
    assert_eq!(blanked("no sample of Quaxwelk"), "aa aaaaaa aa aaaaaaaa");
    let json = adapter(&shipped("generic-robot-json.json"));
    let object = r#"{"joints":[0.1,-0.2,0.05,12,0],"stopped":false,"operator":"Quaxwelk","base":null}"#;
    let kept = String::from_utf8(LineBlanker::new(&json).blanked(object.as_bytes())).expect("text");
    assert!(kept.len() == object.len() && !kept.contains("Quax") && !kept.contains("operator"), "{kept}");
    // Numbers that must not begin with 0, and escapes, as programs write what is no ASCII.
    let escaped = r#"{"joints":[0.1,-0.2,0.05,12,0],"stopped":false,"id":4711,"by":"J\u00fcrgen","note":"x\nMeier"}"#;
    let hidden = String::from_utf8(LineBlanker::new(&json).blanked(escaped.as_bytes())).expect("text");
    assert!(!["4711", "rgen", "eier"].iter().any(|name| hidden.contains(name)) && hidden.len() == escaped.len(), "{hidden}");
    let of = |text: &str| Heard::of(&shipped("generic-robot-json.json"), format!("{text}\n").as_bytes()).robot().sensed_deg;
    assert_eq!(of(&kept), of(object));
    assert_eq!(of(&hidden), of(escaped));
    // A header keeps the names that are read, and goes on to name them.
    declaration["format"]["csv"] = json!({"header": true});
    let mut blanker = LineBlanker::new(&adapter(&declaration));
    let mut blanked = |line: &str| String::from_utf8(blanker.blanked(line.as_bytes())).expect("text");
    assert_eq!([blanked("a,surgeon,b,c,d,e"), blanked("11,Quaxwelk,2,3,4,5")], ["a,aaaaaaa,b,c,d,e", "11,aaaaaaaa,2,3,4,5"]);
}

/// A log that was given away kept the words of lines to be ignored, in the declaration and in the lines, and what its groups and columns were called.
#[test]
fn a_nameless_declaration_reads_blanked_lines_as_before() {
    let mut pattern = shipped("generic-carm-regex.json");
    let named = pattern["format"]["regex"]["pattern"].as_str().expect("text").replace("<orb>", "<Quaxwelk52x>");
    pattern["format"]["regex"]["pattern"] = json!(named);
    pattern["carm"]["orbital"]["from"] = json!("Quaxwelk52x");
    pattern["ignore"] = json!(["Quaxwelk51 .*", "-+"]);
    let mut columns = clocked();
    columns["format"]["csv"]["columns"] = json!(["t", "n", "Quaxwelk", "who", "who", "b", "c", "d", "e"]);
    columns["robot"]["sensed_angles"][0]["from"] = json!("Quaxwelk");
    columns["ignore"] = json!(["Quaxwelk51 .*"]);
    let of_pattern = "Quaxwelk51 is up\nt=1000 orb=120.25 ang=1 lift=12cm sid=40in kV=74 x=ON exp=1\n---\nno sample of Quaxwelk\n\
                      t=2000 orb=121 ang=2 lift=12cm sid=40in kV=74 x=OFF exp=-\n";
    let of_columns = "1500,42,1,Quaxwelk,x,2,3,4,5\nQuaxwelk51 ü\n1600,43,2,x,Quaxwelk,2,3,4,5\nno sample of Quaxwelk\n";
    for (declaration, text) in [(pattern, of_pattern), (columns, of_columns)] {
        let declared = adapter(&declaration);
        let mut blanker = LineBlanker::new(&declared);
        let blanked: Vec<String> =
            text.lines().map(|line| String::from_utf8(blanker.blanked(line.as_bytes())).expect("text") + "\n").collect();
        let (given, blanked) =
            (serde_json::to_value(declared.nameless("removed").expect("a pattern")).expect("serialises"), blanked.concat());
        assert!(blanked.len() == text.len() && !format!("{given}{blanked}").contains("Quaxwelk"), "{given} {blanked}");
        let heard = |declaration: &Value, text: &str| {
            let heard = Heard::of(declaration, text.as_bytes());
            assert_eq!((heard.health().frames, heard.health().corrupt), (2, 1), "{:?}", heard.faults);
            format!("{:?} {:?} {:?}", heard.carms(), heard.robots(), heard.health())
        };
        assert_eq!(heard(&declaration, text), heard(&given, &blanked));
        // Once more there is nothing to take out.
        assert_eq!(adapter(&given).nameless("removed"), Some(adapter(&given)));
    }
}

/// What `docs/robot-lines.md` says of its examples.
#[test]
fn the_examples_of_the_documentation_are_as_it_says() {
    let text = include_str!("../docs/robot-lines.md");
    let blocks: Vec<Value> = text
        .split("```json\n")
        .skip(1)
        .filter_map(|rest| serde_json::from_str(rest.split("```").next()?).ok())
        .filter(|block: &Value| block["origin"].is_string())
        .collect();
    let [columns, pattern, objects] = &blocks[..] else { panic!("{} examples", blocks.len()) };
    for line in ["1500,42,112,225,50,-125,6", "t=123456 orb=120.25 lift=12.05cm sid=40in kV=74 x=ON"] {
        assert!(text.contains(&format!("`{line}`")), "{line}");
    }
    let robot = Heard::of(columns, b"1500,42,112,225,50,-125,6\n").robot();
    assert_eq!((robot.device_us, robot.sequence, robot.sensed_deg), (1_500_000, 42, Some([1.12, 2.25, 0.5, -1.25, 0.06])));
    let carm = Heard::of(pattern, b"t=123456 orb=120.25 lift=12.05cm sid=40in kV=74 x=ON\n").carms().remove(0);
    assert!((carm.joints.orbital_rad.to_degrees() + 30.25).abs() < 1e-12 && (carm.joints.lift_mm - 120.5).abs() < 1e-9);
    assert_eq!((carm.joints.source_to_detector_mm, carm.tube_kvp, carm.xray_on), (1016.0, 74.0, true));
    let object = "{\"joints\": [0.02, 0.04, 0.009, -0.022, 0.001], \"stopped\": false}";
    assert!(text.contains(object));
    let robot = Heard::of(objects, format!("{object}\n").as_bytes()).robot();
    assert!((robot.sensed_deg.expect("declared")[1] - 0.04f64.to_degrees()).abs() < 1e-12 && robot.device_us == 995_000);
}
