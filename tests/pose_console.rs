//! One exposure, stored by a console in many ways: turned, mirrored, cropped, enlarged. The panel's pose is the same.

use glam::{DQuat, DVec2, DVec3};
use serde_json::{Value, json};
use sidecarm::acquire::{Domain, Frame};
use sidecarm::beads::BeadLayout;
use sidecarm::geometry::{ConsoleGeometry, Flip, Intrinsics, Rigid, View};
use sidecarm::image::{Image, write_tiff_f32};
use sidecarm::mask;
use sidecarm::pose::{Looked, Panel, Pose, Prior, Refusal, Registration, look, register, register_looked, solve_console};

use crate::pose_synthetic as synthetic;

const FLIPS: [Flip; 3] = [Flip::None, Flip::Horizontal, Flip::Vertical];

/// What a console shows of a panel of `view`: cropped, enlarged, turned clockwise about the middle by less than a quarter. Written from
/// what a person sees, not from the program's matrices.
struct Shown {
    crop_px: [u32; 4],
    zoom: f64,
    turned_deg: f64,
}

impl Shown {
    fn view(&self, panel: &View) -> View {
        let [left, top, columns, rows] = self.crop_px.map(f64::from);
        let (sin, cos) = self.turned_deg.to_radians().sin_cos();
        let size = DVec2::new((columns * self.zoom).round(), (rows * self.zoom).round());
        let enlarged = (DVec2::new(panel.intrinsics.cx, panel.intrinsics.cy) + 0.5 - DVec2::new(left, top)) * self.zoom;
        let off = enlarged - 0.5 * size;
        // Rows count downwards: clockwise takes +x to +y.
        let turned = DVec2::new(off.x * cos - off.y * sin, off.x * sin + off.y * cos) + 0.5 * size - 0.5;
        let f = panel.intrinsics.fx * self.zoom;
        View {
            size_px: [size.x as u32, size.y as u32],
            intrinsics: Intrinsics { fx: f, fy: f, skew: 0.0, cx: turned.x, cy: turned.y },
            camera_from_lps: Rigid::rotation(DQuat::from_rotation_z(self.turned_deg.to_radians())) * panel.camera_from_lps,
        }
    }
}

/// The picture after `quarters` clockwise and a flip, pixel by pixel.
pub fn stored(picture: &Image<f32>, quarters: u32, flip: Flip) -> Image<f32> {
    let mut image = picture.clone();
    for _ in 0..quarters {
        let (w, h) = (image.height, image.width);
        let pixels = (0..w * h).map(|at| *image.at(at / w, image.height - 1 - at % w)).collect();
        image = Image { width: w, height: h, pixels };
    }
    match flip {
        Flip::None => {}
        Flip::Horizontal => image.pixels.chunks_exact_mut(image.width).for_each(<[f32]>::reverse),
        Flip::Vertical => image.pixels = image.pixels.chunks_exact(image.width).rev().flatten().copied().collect(),
    }
    image
}

fn frame(image: Image<f32>) -> Frame {
    Frame::from_pixels("drawn", image, Domain::Linear).expect("a frame")
}

/// A pose against the truth.
pub struct Off {
    pub angle_deg: f64,
    /// At the beads, parallel to the panel.
    pub across_mm: f64,
    /// At the beads, away from the source.
    pub along_mm: f64,
}

pub fn off(found: &Rigid, truth: &Rigid) -> Off {
    let at = |camera: &Rigid| camera.transform_point(DVec3::ZERO);
    let shift_mm = at(found) - at(truth);
    Off { angle_deg: found.angle_to_rad(truth).to_degrees(), across_mm: shift_mm.truncate().length(), along_mm: shift_mm.z }
}

/// How far off in depth the beads may be: three of the pose's own standard deviations. Depth comes from the magnification alone, so what is
/// off across by e is off in depth by e times the distance over the beads' reach across, more than ten times as much; the code claims no more
/// than its covariance.
pub fn depth_allowed_mm(pose: &Pose) -> f64 {
    let rows = pose.covariance_at_centroid.expect("accepted");
    3.0 * rows[5][5].sqrt()
}

/// Depth against that limit, and ten millimetres, which are beyond it; gives the depth, mm.
fn assert_depth(pose: &Pose, found: &Rigid, truth: &Rigid, what: &str) -> f64 {
    let (along_mm, allowed_mm) = (off(found, truth).along_mm, depth_allowed_mm(pose));
    println!("{what}: {along_mm:+.3} mm off in depth, {allowed_mm:.3} mm allowed");
    assert!(along_mm.abs() <= allowed_mm, "{what}: {along_mm} mm off in depth, {allowed_mm} mm allowed");
    let farther = off(&(Rigid::translation(DVec3::Z * 10.0) * *truth), truth).along_mm;
    assert!(!(farther <= allowed_mm), "the control: {farther} mm, {allowed_mm} mm allowed");
    along_mm
}

fn panel() -> (View, BeadLayout) {
    (synthetic::view(768, 640, 5), synthetic::layout(12, 0.75, 5))
}

fn registration<'a>(view: &View, layout: &'a BeadLayout) -> Registration<'a> {
    Registration { pitch_mm: Some(1020.0 / view.intrinsics.fx), ..Registration::new(view.size_px, layout) }
}

/// Shows beads alone: over what else looks like one a search that finds no pose takes its time.
fn beads_alone(seen: View, layout: &BeadLayout) -> Image<f32> {
    synthetic::Radiograph { anatomy: false, metal: false, ..synthetic::radiograph(seen, layout, 20_000.0, 5) }.draw()
}

#[test]
fn the_panels_pose_is_the_same_however_the_console_stored_the_picture() {
    let (view, layout) = panel();
    let shown = Shown { crop_px: [60, 40, 600, 520], zoom: 1.4, turned_deg: 13.0 };
    let seen = shown.view(&view);
    let picture = synthetic::radiograph(seen, &layout, 20_000.0, 5).draw();
    let (mut cases, mut depths_mm) = (0, Vec::new());
    let mut firsts: [Option<(Frame, Looked)>; 2] = [None, None];
    for quarters in 0..4 {
        for flip in FLIPS {
            let console = ConsoleGeometry {
                rotation_deg: 13.0 + 90.0 * f64::from(quarters),
                flip,
                crop_px: Some(shown.crop_px),
                zoom: shown.zoom,
                ..ConsoleGeometry::default()
            };
            let image = stored(&picture, quarters, flip);
            let stored_px = [image.width as u32, image.height as u32];
            let matrix = ConsoleGeometry::of_matrix(&console.detector_from_image(stored_px));
            for (console, first) in [console, matrix].into_iter().zip(&mut firsts) {
                console.check().expect("a console");
                let window = console.window_on(view.size_px, stored_px).expect("fits");
                let (intrinsics, turn_rad) = window.intrinsics(&view.intrinsics);
                let frame = frame(image.clone()).oriented(&console, Some(view.size_px));
                let prior = Prior { camera_from_lps: view.camera_from_lps, covariance: None }.turned(turn_rad);
                let request = Registration {
                    size_px: frame.size_px.map(|n| n as u32),
                    intrinsics: Some(intrinsics),
                    prior: Some(&prior),
                    pitch_mm: Some(1020.0 / intrinsics.fx),
                    ..Registration::new(seen.size_px, &layout)
                };
                // On the panel it is one picture: beads are looked for once, and once where a matrix says nothing of the crop.
                let looked = || look(&request, &frame, &mask::of_frame(&frame));
                let (same, looked) = &*first.get_or_insert_with(|| (frame.clone(), looked()));
                assert!(frame.pixels == same.pixels, "{quarters} {flip:?}: another picture");
                let pose = register_looked(&request, &frame, looked);
                assert!(pose.is_accepted(), "{quarters} {flip:?}: {:?}", pose.reason);
                assert_eq!(pose.mirrored, flip != Flip::None);
                let detector = pose.detector.clone().expect("the console is known");
                let camera = detector.camera_from_lps.expect("accepted");
                let Off { angle_deg, across_mm, .. } = off(&camera, &view.camera_from_lps);
                assert!(angle_deg <= 0.02 && across_mm <= 0.1, "{quarters} {flip:?}: {angle_deg}°, {across_mm} mm");
                depths_mm.push(assert_depth(&pose, &camera, &view.camera_from_lps, &format!("{quarters} {flip:?}")));
                let k = detector.intrinsics.expect("K");
                assert!((k.fx - view.intrinsics.fx).abs() < 1e-6 && (k.cx - view.intrinsics.cx).abs() < 1e-6, "{k:?}");
                let (there, _) = detector.projection.expect("accepted").project(layout.beads[0].lps_mm);
                assert!(there.distance(view.projection().project(layout.beads[0].lps_mm).0) < 0.2);
                cases += 1;
            }
        }
    }
    assert_eq!(cases, 24);
    // What the one picture's noise does to the depth it does to all of them: in the same panel's pose they do not differ.
    let ends = depths_mm.iter().fold((f64::INFINITY, f64::NEG_INFINITY), |(low, high), mm| (mm.min(low), mm.max(high)));
    assert!(ends.1 - ends.0 <= 0.1, "depths differ by {} mm: {depths_mm:?}", ends.1 - ends.0);
}

#[test]
fn undone_the_wrong_way_there_is_no_pose() {
    let (view, layout) = panel();
    let picture = synthetic::radiograph(view, &layout, 20_000.0, 5).draw();
    let prior = Prior { camera_from_lps: view.camera_from_lps, covariance: None };
    let request = Registration { intrinsics: Some(view.intrinsics), prior: Some(&prior), ..registration(&view, &layout) };
    let undone = |flip| {
        let console = ConsoleGeometry { flip, ..ConsoleGeometry::default() };
        register(&request, &frame(stored(&picture, 0, Flip::Horizontal)).oriented(&console, None))
    };
    let (right, wrong) = (undone(Flip::Horizontal), undone(Flip::None));
    assert!(right.is_accepted() && right.mirrored, "{:?}", right.reason);
    assert!(!wrong.is_accepted() && !wrong.mirrored, "a mirrored picture is none of the specimen");
}

#[test]
fn what_the_console_did_is_found_under_the_prior() {
    let (view, layout) = panel();
    let prior_off = Rigid::exp(DVec3::new(0.03, -0.04, 0.02), DVec3::new(4.0, -3.0, 8.0));
    let prior = Prior { camera_from_lps: prior_off * view.camera_from_lps, covariance: None };
    let panel = Panel { intrinsics: view.intrinsics, size_px: view.size_px, prior };
    let picture = beads_alone(view, &layout);
    // A turn the wrong way shows in 1 and 3, what is turned before it is flipped in 3.
    for (quarters, flip) in [(1, Flip::None), (2, Flip::None), (3, Flip::Horizontal)] {
        let frame = frame(stored(&picture, quarters, flip));
        let found = solve_console(&registration(&view, &layout), &frame, &panel).expect("one way");
        let expected = ConsoleGeometry { rotation_deg: 90.0 * f64::from(quarters), flip, ..ConsoleGeometry::default() };
        assert_eq!((&found.console, found.with_intrinsics), (&expected, false), "{}", found.words);
    }
    // Neither: the beads of another specimen.
    let other = synthetic::layout(12, 0.75, 99);
    let refused = solve_console(&registration(&view, &other), &frame(picture), &panel).expect_err("no way");
    assert!(matches!(refused, Refusal::NoOrientation { .. }), "{refused}");
}

#[test]
fn a_layout_that_is_its_own_mirror_image_leaves_the_console_open() {
    let view = synthetic::view(768, 640, 5);
    let half = synthetic::layout(6, 0.75, 8).beads;
    // Beads and their mirror images about x = 0 fit the picture both ways.
    let places: Vec<DVec3> = half
        .iter()
        .flat_map(|bead| [bead.lps_mm + DVec3::X * 3.0, (bead.lps_mm + DVec3::X * 3.0) * DVec3::new(-1.0, 1.0, 1.0)])
        .collect();
    let layout = synthetic::layout_of(&places, 0.75);
    let picture = synthetic::radiograph(view, &layout, 20_000.0, 5).draw();
    let prior = Prior { camera_from_lps: view.camera_from_lps, covariance: None };
    let panel = Panel { intrinsics: view.intrinsics, size_px: view.size_px, prior };
    let refused = solve_console(&registration(&view, &layout), &frame(picture), &panel).expect_err("either way");
    assert!(matches!(refused, Refusal::EitherOrientation { .. }), "{refused}");
}

#[test]
fn cropping_and_enlargement_are_solved_with_k() {
    let (view, layout) = panel();
    let shown = Shown { crop_px: [60, 40, 600, 520], zoom: 1.4, turned_deg: 20.0 };
    let seen = shown.view(&view);
    let image = stored(&beads_alone(seen, &layout), 1, Flip::Horizontal);
    let truth = ConsoleGeometry {
        rotation_deg: 110.0,
        flip: Flip::Horizontal,
        crop_px: Some(shown.crop_px),
        zoom: shown.zoom,
        ..ConsoleGeometry::default()
    }
    .detector_from_image([image.width as u32, image.height as u32]);
    let prior = Prior { camera_from_lps: view.camera_from_lps, covariance: None };
    let panel = Panel { intrinsics: view.intrinsics, size_px: view.size_px, prior };
    let found = solve_console(&registration(&view, &layout), &frame(image), &panel).expect("one way");
    assert!(found.with_intrinsics && found.console.is_mirrored(), "{}", found.words);
    let rows = found.console.detector_from_image.expect("a matrix");
    let linear = [[truth.matrix2.x_axis.x, truth.matrix2.y_axis.x], [truth.matrix2.x_axis.y, truth.matrix2.y_axis.y]];
    for (row, expected) in rows.iter().zip(linear) {
        assert!((row[0] - expected[0]).abs() < 0.02 && (row[1] - expected[1]).abs() < 0.02, "{rows:?} {truth}");
    }
}

#[test]
fn the_command_undoes_what_the_console_did_and_compare_follows() {
    let (view, layout) = panel();
    let folder = tempfile::tempdir().expect("a folder");
    let at = |name: &str| folder.path().join(name);
    let shown = Shown { crop_px: [60, 40, 600, 520], zoom: 1.0, turned_deg: 13.0 };
    // With anatomy, for `compare`.
    let picture = synthetic::Radiograph { metal: false, ..synthetic::radiograph(shown.view(&view), &layout, 20_000.0, 5) }.draw();
    write_tiff_f32(&at("stored.tif"), &[stored(&picture, 1, Flip::Horizontal)]).expect("written");
    let line_integral = picture.map(|counts| -(counts.max(1.0) / 20_000.0).ln());
    write_tiff_f32(&at("drr.tif"), &[line_integral]).expect("written");
    let points: Vec<Value> = layout
        .beads
        .iter()
        .map(|bead| json!({"label": bead.name, "position": bead.lps_mm.to_array(), "description": "radius_mm=0.75"}))
        .collect();
    let markups =
        json!({"markups": [{"type": "Fiducial", "coordinateSystem": "LPS", "coordinateUnits": "mm", "controlPoints": points}]});
    let rows = |camera: &Rigid| {
        let m = glam::DMat3::from_quat(camera.rotation).transpose();
        let t = camera.translation_mm;
        json!([
            [m.x_axis.x, m.x_axis.y, m.x_axis.z, t.x],
            [m.y_axis.x, m.y_axis.y, m.y_axis.z, t.y],
            [m.z_axis.x, m.z_axis.y, m.z_axis.z, t.z],
            [0, 0, 0, 1]
        ])
    };
    let k = view.intrinsics;
    let files = [
        ("beads.mrk.json", markups),
        ("K.json", json!({"intrinsics": k.to_rows(), "size_px": view.size_px, "pitch_mm": 1020.0 / k.fx})),
        ("prior.json", json!({"camera_from_lps": rows(&view.camera_from_lps)})),
        ("console.json", json!({"rotation_deg": 103.0, "flip": "horizontal", "crop_px": shown.crop_px})),
    ];
    for (name, value) in &files {
        std::fs::write(at(name), value.to_string()).expect("written");
    }
    let run = |words: &[&str]| {
        std::process::Command::new(env!("CARGO_BIN_EXE_sidecarm")).args(words).current_dir(folder.path()).output().expect("runs")
    };
    let register = [
        "register",
        "stored.tif",
        "--beads",
        "beads.mrk.json",
        "--intrinsics",
        "K.json",
        "--prior",
        "prior.json",
        "--domain",
        "linear",
    ];
    let posed = run(&[&register[..], &["--console", "console.json", "--out", "POSE.json", "--overlay", "seen.png"]].concat());
    assert_eq!(
        posed.status.code(),
        Some(0),
        "{}{}",
        String::from_utf8_lossy(&posed.stdout),
        String::from_utf8_lossy(&posed.stderr)
    );
    let pose = Pose::read(&at("POSE.json")).expect("a pose");
    // A file that states its camera twice, 15 mm apart.
    let mut twice: serde_json::Value = serde_json::from_slice(&std::fs::read(at("POSE.json")).expect("written")).expect("JSON");
    let moved = twice["camera_from_lps"][0][3].as_f64().expect("mm") + 15.0;
    twice["camera_from_lps"][0][3] = moved.into();
    std::fs::write(at("TWICE.json"), twice.to_string()).expect("written");
    let error = Pose::read(&at("TWICE.json")).expect_err("which of the two?").to_string();
    assert!(error.contains("projection is not K [I|0] camera_from_lps"), "{error}");
    let camera = pose.detector.as_ref().and_then(|detector| detector.camera_from_lps).expect("a pose of the panel");
    let Off { angle_deg, across_mm, .. } = off(&camera, &view.camera_from_lps);
    assert!(pose.mirrored && angle_deg <= 0.02 && across_mm <= 0.1, "{angle_deg}°, {across_mm} mm");
    assert_depth(&pose, &camera, &view.camera_from_lps, "the command's");
    // The acquired frame is turned as the pose says: the very same picture has nothing left to differ.
    let compared = run(&[
        "compare",
        "stored.tif",
        "drr.tif",
        "--pose",
        "POSE.json",
        "--quantity",
        "line_integral",
        "--air",
        "20000",
        "--offset",
        "none",
        "--domain",
        "linear",
        "--json",
        "--out",
        "compared",
    ]);
    assert_eq!(compared.status.code(), Some(0), "{}", String::from_utf8_lossy(&compared.stderr));
    let answer: Value = serde_json::from_slice(&compared.stdout).expect("JSON");
    assert!(answer["comparison"]["scores"]["zncc"].as_f64().expect("a score") > 0.999, "{answer}");
    // Without a word the frame's size contradicts K; with a wrong one it is said what would fit.
    let silent = run(&[&register[..], &["--out", "P2.json"]].concat());
    assert_eq!(silent.status.code(), Some(1));
    std::fs::write(at("console.json"), json!({"rotation_deg": 13.0}).to_string()).expect("written");
    let wrong = run(&[&register[..], &["--console", "console.json", "--out", "P3.json"]].concat());
    assert_eq!(wrong.status.code(), Some(1));
    assert!(String::from_utf8_lossy(&wrong.stderr).contains("declare"), "{wrong:?}");
    let solved = run(&[&register[..], &["--console", "solve", "--out", "P4.json"]].concat());
    assert_eq!(
        solved.status.code(),
        Some(0),
        "{}{}",
        String::from_utf8_lossy(&solved.stdout),
        String::from_utf8_lossy(&solved.stderr)
    );
    let solved = Pose::read(&at("P4.json")).expect("a pose");
    assert!(solved.mirrored && solved.notes.iter().any(|note| note.contains("mirrored")), "{:?}", solved.notes);
}
