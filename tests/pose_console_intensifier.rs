//! One exposure through an image intensifier, stored whole, cropped, and turned: the panel's pose is the same.

use glam::DVec2;
use serde_json::json;
use sidecarm::acquire::{Domain, Frame};
use sidecarm::beads::BeadLayout;
use sidecarm::geometry::{ConsoleGeometry, Distortion, Flip, Intensifier, IntensifierCalibration, Rigid, View};
use sidecarm::image::{Image, write_tiff_f32};
use sidecarm::pose::{Pose, Prior, Registration, register};

use crate::calibrate_intensifier_beads::markups;
use crate::pose_console::{Off, depth_allowed_mm, off, stored};
use crate::pose_synthetic as synthetic;
use crate::session_optics::Bent;

const SIZE: [u32; 2] = [768, 640];
/// The rim is beyond the corners.
const BENT: Bent = Bent { centre: DVec2::new(380.0, 325.0), radius_px: 510.0, rim_px: (-34.0, 10.0) };
/// All beads are in it, and its middle is not the disc's.
const CROP_PX: [u32; 4] = [200, 70, 520, 470];

/// A picture whose pixels lie in `picture` where `place` says; black beside it.
fn resampled(picture: &Image<f32>, size: [u32; 2], place: impl Fn(DVec2) -> DVec2) -> Image<f32> {
    let [width, height] = size.map(|side| side as usize);
    let at = |index: usize| {
        let from = place(DVec2::new((index % width) as f64, (index / width) as f64));
        picture.bilinear(from.x, from.y).map_or(0.0, |value| value as f32)
    };
    Image { width, height, pixels: (0..width * height).map(at).collect() }
}

struct Lab {
    view: View,
    layout: BeadLayout,
    whole: Intensifier,
}

impl Lab {
    /// The pose by a picture that the console stored so; `distortion` makes of the panel's distortion that of the picture.
    fn registered(&self, image: Image<f32>, console: &ConsoleGeometry, distortion: impl Fn(&Frame) -> Distortion) -> Pose {
        console.check().expect("a console");
        let stored_px = [image.width as u32, image.height as u32];
        let window = console.window_on(SIZE, stored_px).expect("fits");
        let (intrinsics, turn_rad) = window.intrinsics(&self.view.intrinsics);
        let frame = Frame::from_pixels("drawn", image, Domain::Linear).expect("a frame").oriented(console, Some(SIZE));
        let prior = Prior { camera_from_lps: self.view.camera_from_lps, covariance: None }.turned(turn_rad);
        let distortion = distortion(&frame);
        let request = Registration {
            intrinsics: Some(intrinsics),
            prior: Some(&prior),
            pitch_mm: Some(1020.0 / intrinsics.fx),
            distortion: Some(&distortion),
            ..Registration::new(frame.size_px.map(|side| side as u32), &self.layout)
        };
        register(&request, &frame)
    }

    /// What the intensifier did to the frame.
    fn seen(&self, frame: &Frame) -> Distortion {
        frame.seen_through(&self.whole).expect("of this panel").distortion
    }
}

fn of_panel(pose: &Pose) -> Rigid {
    assert!(pose.is_accepted(), "{:?}", pose.reason);
    pose.detector.as_ref().and_then(|detector| detector.camera_from_lps).expect("a pose of the panel")
}

/// A calibration knows the distortion of the whole picture; what the console stores may be a part of it, turned and mirrored.
#[test]
fn a_console_s_part_of_a_distorted_picture_gives_the_pose_of_the_whole() {
    let read: IntensifierCalibration = serde_json::from_value(BENT.calibration(SIZE, "unknown")).expect("a calibration");
    let (view, layout) = (synthetic::view(SIZE[0], SIZE[1], 5), synthetic::layout(12, 0.75, 5));
    let lab = Lab { view, layout, whole: read.at(None).expect("one view") };
    let straight = synthetic::radiograph(view, &lab.layout, 20_000.0, 5).draw();
    let panel = resampled(&straight, SIZE, |p| BENT.undistorted(p));
    let whole = lab.registered(panel.clone(), &ConsoleGeometry::default(), |frame| lab.seen(frame));
    let truth = of_panel(&whole);
    let Off { angle_deg, across_mm, .. } = off(&truth, &view.camera_from_lps);
    assert!(angle_deg <= 0.05 && across_mm <= 0.1, "the whole picture: {angle_deg}°, {across_mm} mm");

    let corner = DVec2::new(f64::from(CROP_PX[0]), f64::from(CROP_PX[1]));
    let cropped = resampled(&panel, [CROP_PX[2], CROP_PX[3]], |p| p + corner);
    let console = ConsoleGeometry { crop_px: Some(CROP_PX), ..ConsoleGeometry::default() };
    let part = lab.registered(cropped.clone(), &console, |frame| lab.seen(frame));
    let Off { angle_deg, across_mm, along_mm } = off(&of_panel(&part), &truth);
    println!("cropped: {angle_deg:.4}°, {across_mm:.4} mm across, {along_mm:+.3} mm in depth");
    assert!(angle_deg <= 0.02 && across_mm.hypot(along_mm) <= 0.1, "{angle_deg}°, {across_mm} mm, {along_mm} mm");
    // The control: the disc of the whole picture laid on the part.
    let wrong = lab.registered(cropped.clone(), &console, |_| lab.whole.distortion.clone());
    let camera = wrong.detector.as_ref().and_then(|detector| detector.camera_from_lps).filter(|_| wrong.is_accepted());
    let is_right = |camera: Rigid| off(&camera, &truth).angle_deg <= 0.02 && off(&camera, &truth).across_mm <= 0.1;
    assert!(!camera.is_some_and(is_right), "the control");

    // Enlarged, turned clockwise by 13 degrees and a quarter, mirrored: as a person sees it, not by the program's matrices.
    let (zoom, (sin, cos)) = (1.2, 13f64.to_radians().sin_cos());
    let size = DVec2::new(f64::from(CROP_PX[2]) * zoom, f64::from(CROP_PX[3]) * zoom);
    let back = |p: DVec2| {
        let off = p + 0.5 - 0.5 * size;
        (DVec2::new(off.x * cos + off.y * sin, off.y * cos - off.x * sin) + 0.5 * size) / zoom + corner - 0.5
    };
    let turned = resampled(&panel, [size.x as u32, size.y as u32], back);
    let console = ConsoleGeometry { rotation_deg: 103.0, flip: Flip::Horizontal, zoom, ..console };
    let turned = lab.registered(stored(&turned, 1, Flip::Horizontal), &console, |frame| lab.seen(frame));
    let Off { angle_deg, across_mm, along_mm } = off(&of_panel(&turned), &truth);
    println!("turned: {angle_deg:.4}°, {across_mm:.4} mm across, {along_mm:+.3} mm in depth");
    assert!(turned.mirrored && angle_deg <= 0.02 && across_mm <= 0.1, "{angle_deg}°, {across_mm} mm");
    assert!(along_mm.abs() <= depth_allowed_mm(&turned), "{along_mm} mm in depth");

    // The cropped one as it is typed.
    let folder = tempfile::tempdir().expect("a folder");
    let at = |name: &str| folder.path().join(name);
    write_tiff_f32(&at("part.tif"), &[cropped]).expect("written");
    markups(folder.path(), "beads.mrk.json", &lab.layout);
    let prior = Pose { camera_from_lps: Some(view.camera_from_lps), ..Pose::default() };
    let k = json!({"intrinsics": view.intrinsics, "size_px": SIZE, "pitch_mm": 1020.0 / view.intrinsics.fx});
    for (name, value) in [
        ("ii.json", BENT.calibration(SIZE, "unknown")),
        ("K.json", k),
        ("console.json", json!({"crop_px": CROP_PX})),
        ("prior.json", serde_json::to_value(prior).expect("JSON")),
    ] {
        std::fs::write(at(name), value.to_string()).expect("written");
    }
    let words = "register part.tif --beads beads.mrk.json --intrinsics K.json --prior prior.json --console console.json --distortion \
                 ii.json --domain linear --bead-radius 0.75 --overlay seen.png --out POSE.json";
    let mut command = std::process::Command::new(env!("CARGO_BIN_EXE_sidecarm"));
    let typed = command.args(words.split_whitespace()).current_dir(folder.path()).output().expect("runs");
    assert_eq!(typed.status.code(), Some(0), "{typed:?}");
    let typed = of_panel(&Pose::read(&at("POSE.json")).expect("a pose"));
    let Off { angle_deg, across_mm, along_mm } = off(&typed, &truth);
    assert!(angle_deg <= 0.02 && across_mm.hypot(along_mm) <= 0.1, "typed: {angle_deg}°, {across_mm} mm, {along_mm} mm");
}
