//! `calibrate intensifier --beads`: distortion from drawn frames of one bead phantom, against the law that drew them.

use std::path::Path;
use std::process::{Command, Output};

use glam::{DVec2, DVec3};
use serde_json::json;
use sidecarm::acquire::{Domain, Frame};
use sidecarm::beads::BeadLayout;
use sidecarm::calibrate::intensifier::{GridFrame, IntensifierFault, PhantomRequest, calibrate_phantom};
use sidecarm::geometry::{AnglesDeg, AnglesFrom, Distortion, IntensifierCalibration, View};
use sidecarm::image::{Image, write_tiff_f32};
use sidecarm::pose::Pose;
use sidecarm::random::{Purpose, Stream};

use crate::intensifier_draw::{Drawn, Law, rms_apart};
use crate::pose_synthetic as synthetic;

pub const SIZE: u32 = 512;
/// What global polynomials of the fifth order leave in published measurements.
pub const LIMIT_PX: f64 = 0.2;
/// Standard deviation per axis with which the phantom's maker knows its beads.
const PLACED_MM: f64 = 0.03;

/// A phantom of beads in depth, an intensifier, and frames of it.
#[derive(Clone)]
pub struct Lab {
    seed: u64,
    pub law: Law,
    /// As it is stated.
    pub layout: BeadLayout,
    /// As it is.
    built: BeadLayout,
}

impl Lab {
    /// `count` beads in a slab of 165 mm across and 90 mm deep, no two closer than 16 mm.
    pub fn new(seed: u64, count: usize) -> Self {
        let mut random = Stream::new(seed, 60, 0, Purpose::Evaluation);
        let mut places: Vec<DVec3> = Vec::new();
        while places.len() < count {
            let mut side = |mm: f64| (random.uniform() - 0.5) * mm;
            let place = DVec3::new(side(165.0), side(165.0), side(90.0));
            if place.truncate().length() < 82.5 && places.iter().all(|other| other.distance(place) > 16.0) {
                places.push(place);
            }
        }
        let mut normal = |mm: f64| DVec3::new(random.normal(), random.normal(), random.normal()) * mm;
        let built: Vec<DVec3> = places.iter().map(|place| *place + normal(PLACED_MM)).collect();
        let stated = |places: &[DVec3]| {
            let mut layout = synthetic::layout_of(places, 1.5);
            layout.beads.iter_mut().for_each(|bead| bead.sigma_mm = Some(PLACED_MM));
            layout
        };
        Self { seed, law: Drawn::random(seed, SIZE as usize).law, layout: stated(&places), built: stated(&built) }
    }

    /// How the phantom lies in frame `n`; K is the same in all.
    pub fn view(&self, n: u64) -> View {
        let mut random = Stream::new(self.seed, 61, n as u32, Purpose::Evaluation);
        let mut normal = |s: f64| random.normal() * s;
        let turn = sidecarm::geometry::Rigid::exp(DVec3::new(normal(0.35), normal(0.35), normal(1.2)), DVec3::ZERO);
        let shift = DVec3::new(normal(12.0), normal(12.0), 690.0 + normal(25.0));
        View { camera_from_lps: sidecarm::geometry::Rigid::translation(shift) * turn, ..synthetic::view(SIZE, SIZE, self.seed) }
    }

    pub fn pitch_mm(&self) -> f64 {
        1020.0 / self.view(0).intrinsics.fx
    }

    /// Frame `n` as the intensifier shows it, with its noise.
    pub fn pixels(&self, n: u64, law: &Law) -> Image<f32> {
        let mut radiograph = synthetic::radiograph(self.view(n), &self.built, 0.0, self.seed);
        (radiograph.anatomy, radiograph.metal) = (false, false);
        let straight = radiograph.draw();
        let through = |index: usize| {
            let p = DVec2::new((index % SIZE as usize) as f64, (index / SIZE as usize) as f64);
            let there = law.undistorted(p);
            let seen = (p.distance(law.centre) <= law.radius_px).then(|| straight.bilinear(there.x, there.y)).flatten();
            let mut random = Stream::new(self.seed, 62 + n as u32, index as u32, Purpose::Evaluation);
            synthetic::poisson(3000.0 * seen.unwrap_or(0.0), &mut random) as f32
        };
        let (width, height) = (SIZE as usize, SIZE as usize);
        Image { width, height, pixels: (0..width * height).map(through).collect() }
    }

    fn frame(&self, n: u64, angles_deg: Option<AnglesDeg>, law: &Law) -> GridFrame {
        let frame = Frame::from_pixels(&format!("shot-{n}"), self.pixels(n, law), Domain::Linear).expect("a frame");
        GridFrame { frame, angles_deg }
    }

    fn frames(&self, count: u64) -> Vec<GridFrame> {
        (0..count).map(|n| self.frame(n, None, &self.law)).collect()
    }

    fn request<'a>(&self, layout: &'a BeadLayout) -> PhantomRequest<'a> {
        PhantomRequest {
            layout,
            intrinsics: self.view(0).intrinsics,
            pitch_mm: self.pitch_mm(),
            priors: &[],
            bead_radius_mm: None,
            order: None,
            disc: None,
            angles_from: AnglesFrom::Given,
            glare: None,
            origin: "drawn".to_owned(),
        }
    }

    fn calibrated(&self, frames: &[GridFrame]) -> Result<IntensifierCalibration, IntensifierFault> {
        calibrate_phantom(frames, &self.request(&self.layout), &|| {})
    }
}

/// Distance of what was measured from the law where beads were seen, up to `reach` of the disc's radius.
fn off_px(found: &Distortion, law: &Law, reach: f64) -> f64 {
    let pairs: Vec<(DVec2, DVec2)> = law.places(reach).map(|p| (found.undistorted(p), law.undistorted(p))).collect();
    rms_apart(&pairs)
}

/// Rms of held-out beads, rms against the law within 0.9 of the beads' reach, that reach, shadows.
pub fn judged(calibration: &IntensifierCalibration, law: &Law, view: usize) -> (f64, f64, f64, usize) {
    let row = &calibration.views[view];
    let angles = row.orbital_deg.zip(row.angulation_deg).map(|(orbital, angulation)| [orbital, angulation]);
    let distortion = calibration.at(angles).expect("measured").distortion;
    let reach = row.reach.expect("measured");
    (row.held_out_rms_px.expect("measured"), off_px(&distortion, law, 0.9 * reach), reach, row.spots)
}

#[test]
fn several_frames_of_one_phantom_straighten_the_picture() {
    let lab = Lab::new(1, 28);
    assert!((lab.law.mean_px() - 11.0).abs() < 0.01);
    let calibration = lab.calibrated(&lab.frames(4)).unwrap_or_else(|error| panic!("{error}"));
    let (held_out_px, law_px, reach, spots) = judged(&calibration, &lab.law, 0);
    println!("held out {held_out_px:.3} px, law {law_px:.3} px up to {reach:.2} R, {spots} shadows");
    assert!(law_px <= LIMIT_PX && held_out_px <= 2.0 * LIMIT_PX, "{law_px} {held_out_px}");
    assert!(reach > 0.8 && spots > 70 && calibration.order == 5, "{reach} {spots}");
    assert!(calibration.notes[0].starts_with("measured from 4 of 4 frames of a phantom of 28"), "{calibration:?}");
    // The frames' own gauge, without the similarity: the centre stays, and so do area and direction there.
    let distortion = calibration.at(None).expect("one view").distortion;
    let (centre, jacobian) = (distortion.centre_px(), distortion.jacobian(distortion.centre_px()));
    assert!(distortion.undistorted(centre).distance(centre) < 1e-9);
    assert!((jacobian.determinant() - 1.0).abs() < 1e-3 && (jacobian.x_axis.y - jacobian.y_axis.x).abs() < 1e-12);
    let straight = Distortion::new(lab.law.centre, lab.law.radius_px, 1, vec![DVec2::ZERO; 3]).expect("none");
    assert!(off_px(&straight, &lab.law, 0.9 * reach) > 10.0 * LIMIT_PX, "control");
}

#[test]
fn frames_at_two_angles_give_two_distortions_and_a_frame_without_the_phantom_is_left_out() {
    let lab = Lab::new(3, 28);
    let turned = Law { s_rad: lab.law.s_rad + 0.03, ..lab.law };
    // Angles within a tenth of a degree are one.
    let at = |n: u64| [if n < 4 { 0.02 * n as f64 } else { 30.0 }, 0.0];
    let mut frames: Vec<GridFrame> = (0..8).map(|n| lab.frame(n, Some(at(n)), if n < 4 { &lab.law } else { &turned })).collect();
    let mut blank = frames[0].clone();
    blank
        .frame
        .pixels
        .pixels
        .iter_mut()
        .enumerate()
        .for_each(|(n, value)| *value = if *value > 0.0 { 900.0 + (n % 7) as f32 } else { 0.0 });
    blank.frame.name = "blank".to_owned();
    frames.push(blank);
    let calibration = lab.calibrated(&frames).expect("two views");
    assert_eq!(calibration.views.iter().map(|view| view.orbital_deg).collect::<Vec<_>>(), [Some(0.0), Some(30.0)]);
    assert_eq!(calibration.views[1].frame, "shot-4 and 3 more");
    for (view, (own, other)) in [(&lab.law, &turned), (&turned, &lab.law)].into_iter().enumerate() {
        let (held_out_px, law_px, reach, spots) = judged(&calibration, own, view);
        let other_px = judged(&calibration, other, view).1;
        println!(
            "view {view}: held out {held_out_px:.3}, law {law_px:.3} px, other's law {other_px:.3} px, {reach:.2} R, {spots}"
        );
        assert!(law_px <= LIMIT_PX && other_px > 2.0 * LIMIT_PX, "view {view}: {law_px} {other_px}");
    }
    let left_out = calibration.notes.iter().filter(|note| note.contains("is left out")).collect::<Vec<_>>();
    assert!(left_out.len() == 1 && left_out[0].starts_with("blank is left out"), "{left_out:?}");
    frames[1].angles_deg = None;
    assert!(matches!(lab.calibrated(&frames), Err(IntensifierFault::NoAngle { .. })));
}

#[test]
fn what_the_beads_do_not_bear_is_refused() {
    let lab = Lab::new(4, 34);
    let frames = lab.frames(1);
    let with = |layout: &BeadLayout, order: Option<usize>| {
        let request = PhantomRequest { order, ..lab.request(layout) };
        calibrate_phantom(&frames, &request, &|| {})
    };
    let good = with(&lab.layout, None).expect("the third order");
    assert!(good.order == 3 && good.views[0].spots >= 23, "{good:?}");
    match with(&lab.layout, Some(5)).expect_err("too few") {
        IntensifierFault::TooFewBeads { order: 5, required: 45, found, frames: 1, .. } => assert!(found < 45, "{found}"),
        other => panic!("{other}"),
    }
    // Sixteen beads of its middle are enough to recognise it; those of its mirror image, another phantom, are not recognised.
    let mut part = lab.layout.clone();
    part.beads.sort_by(|a, b| a.lps_mm.truncate().length().total_cmp(&b.lps_mm.truncate().length()));
    part.beads.truncate(16);
    assert!(matches!(with(&part, None), Err(IntensifierFault::TooFewBeads { order: 3, required: 23, .. })));
    part.beads.iter_mut().for_each(|bead| bead.lps_mm.x = -bead.lps_mm.x);
    let fault = with(&part, None).expect_err("not this phantom");
    assert!(matches!(fault, IntensifierFault::NotRecognised { frames: 1, beads: 16, .. }), "{fault}");
    let mut flat = lab.layout.clone();
    flat.beads.iter_mut().for_each(|bead| bead.lps_mm.z *= 0.1);
    assert!(matches!(with(&flat, None), Err(IntensifierFault::FlatLayout { .. })));
    let few = BeadLayout { beads: lab.layout.beads[..8].to_vec(), ..lab.layout.clone() };
    assert!(matches!(with(&few, None), Err(IntensifierFault::SmallLayout { found: 8, .. })));
    assert!(matches!(calibrate_phantom(&[], &lab.request(&lab.layout), &|| {}), Err(IntensifierFault::NoFrames)));
}

pub fn markups(folder: &Path, name: &str, layout: &BeadLayout) {
    let point = |bead: &sidecarm::beads::Bead| {
        let (radius_mm, sigma_mm) = (bead.radius_mm.unwrap_or(1.0), bead.sigma_or_default_mm());
        json!({"label": bead.name, "description": format!("radius_mm={radius_mm} sigma_mm={sigma_mm}"), "position": bead.lps_mm.to_array()})
    };
    let points: Vec<_> = layout.beads.iter().map(point).collect();
    let list = json!({"markups": [{"type": "Fiducial", "coordinateSystem": "LPS", "controlPoints": points}]});
    std::fs::write(folder.join(name), list.to_string()).expect("written");
}

/// The command measures the distortion with one phantom, and a radiograph of another specimen is registered with its file.
#[test]
fn a_specimen_is_registered_with_the_distortion_that_a_phantom_gave() {
    let folder = tempfile::tempdir().expect("folder");
    let sidecarm = |words: &[&str]| -> Output {
        Command::new(env!("CARGO_BIN_EXE_sidecarm")).args(words).current_dir(folder.path()).output().expect("runs")
    };
    let lab = Lab::new(6, 28);
    let names: Vec<String> = (0..4).map(|n| format!("shot-{n}.tif")).collect();
    for (n, name) in names.iter().enumerate() {
        write_tiff_f32(&folder.path().join(name), &[lab.pixels(n as u64, &lab.law)]).expect("written");
    }
    markups(folder.path(), "phantom.mrk.json", &lab.layout);
    let view = lab.view(0);
    let k = json!({"intrinsics": view.intrinsics, "size_px": [SIZE, SIZE], "pitch_mm": lab.pitch_mm()});
    std::fs::write(folder.path().join("K.json"), k.to_string()).expect("written");
    let frames: Vec<&str> = names.iter().map(String::as_str).collect();
    let calibrate =
        |more: &[&str]| sidecarm(&[&["calibrate", "intensifier"], frames.as_slice(), &["--domain", "linear"], more].concat());
    let phantom = ["--beads", "phantom.mrk.json", "--intrinsics", "K.json", "--out", "ii.json"];
    let made = calibrate(&[phantom.as_slice(), &["--json"]].concat());
    assert!(made.status.success(), "{}", String::from_utf8_lossy(&made.stderr));
    let printed: IntensifierCalibration = serde_json::from_slice(&made.stdout).expect("JSON");
    assert_eq!(printed, IntensifierCalibration::read(&folder.path().join("ii.json")).expect("written"));
    assert!(printed.notes[0].contains("4 of 4 frames") && printed.notes[0].contains("phantom.mrk.json"), "{:?}", printed.notes);

    let said = |output: &Output| String::from_utf8_lossy(&output.stderr).into_owned();
    let no_k = calibrate(&["--beads", "phantom.mrk.json", "--out", "ii2.json"]);
    assert!(!no_k.status.success() && said(&no_k).contains("--intrinsics"), "{}", said(&no_k));
    let one_prior = calibrate(&[phantom.as_slice(), &["--prior", "K.json"]].concat());
    assert!(!one_prior.status.success() && said(&one_prior).contains("1 priors are given for 4 frames"), "{}", said(&one_prior));

    let specimen = synthetic::layout(14, 1.0, 6);
    let of_specimen = Lab { built: specimen.clone(), ..lab.clone() };
    write_tiff_f32(&folder.path().join("frame.tif"), &[of_specimen.pixels(9, &lab.law)]).expect("written");
    markups(folder.path(), "beads.mrk.json", &specimen);
    let truth = lab.view(9).projection();
    let register = |more: &[&str]| {
        let words = ["register", "frame.tif", "--beads", "beads.mrk.json", "--intrinsics", "K.json", "--domain", "linear"];
        let output = sidecarm(&[&words, more, &["--out", "pose.json"]].concat());
        let pose = Pose::read(&folder.path().join("pose.json")).unwrap_or_else(|error| panic!("{error}: {}", said(&output)));
        let projection = pose.projection?;
        let squares =
            specimen.beads.iter().map(|bead| projection.project(bead.lps_mm).0.distance_squared(truth.project(bead.lps_mm).0));
        Some((squares.sum::<f64>() / specimen.beads.len() as f64).sqrt())
    };
    let straightened = register(&["--distortion", "ii.json"]).expect("registered");
    let plain = register(&[]);
    println!("P off by {straightened:.3} px, without --distortion {plain:?}");
    assert!(straightened < 0.4, "{straightened}");
    assert!(plain.is_none_or(|px| px > 5.0 * straightened), "control");
}

#[test]
#[ignore = "minutes long: scripts/evaluate intensifier-beads runs it"]
fn many_phantoms_straighten_the_picture() {
    let number = |name: &str, otherwise: u64| std::env::var(name).ok().and_then(|text| text.parse().ok()).unwrap_or(otherwise);
    let (count, first) = (number("SIDECARM_PHANTOMS", 20), number("SIDECARM_FIRST_SEED", 100));
    let (mut over, mut worst, mut squares) = (Vec::new(), [0.0f64; 2], [0.0f64; 2]);
    for seed in first..first + count {
        let lab = Lab::new(seed, 24 + (seed % 7) as usize);
        let found =
            lab.calibrated(&lab.frames(4)).map(|calibration| (judged(&calibration, &lab.law, 0), calibration.notes[0].clone()));
        match found {
            Ok(((held_out_px, law_px, reach, spots), note)) => {
                println!(
                    "seed {seed}: held out {held_out_px:.3} px, law {law_px:.3} px up to {reach:.2} R, {spots} shadows; {note}"
                );
                for (n, px) in [held_out_px, law_px].into_iter().enumerate() {
                    worst[n] = worst[n].max(px);
                    squares[n] += px * px;
                }
                if !(law_px <= 1.5 * LIMIT_PX) {
                    over.push(seed);
                }
            }
            Err(error) => {
                println!("seed {seed}: {error}");
                over.push(seed);
            }
        }
    }
    let rms = squares.map(|sum| (sum / count as f64).sqrt());
    println!("{count} phantoms, seeds from {first}: held out, law: rms {rms:.3?} px, worst {worst:.3?} px, over: {over:?}");
    assert!(count > 0 && over.is_empty(), "{over:?}");
}
