//! Pictures through an image intensifier against formulas by hand: where shadows fall, what is dark, how noise goes, what glares.

use glam::{DVec2, DVec3};
use sidecarm::acquire::{Domain, Frame};
use sidecarm::beads::{Bead, BeadLayout};
use sidecarm::calibrate::intensifier::measure_glare;
use sidecarm::compare::{bead_marks, posed_scene};
use sidecarm::geometry::{ConsoleGeometry, Distortion, Glare, Intensifier, View, homogeneous_rows, term_count};
use sidecarm::gpu::DeviceChoice;
use sidecarm::image::Image;
use sidecarm::mask::Disc;
use sidecarm::pose::{DetectorPose, Pose, Refusal, Registration};
use sidecarm::render::{Options, Quantity, Rendered, Renderer};
use sidecarm::reporter::Reporter;
use sidecarm::scene::Scene;
use sidecarm::scene::model::Noise;

use crate::render_scenes::{With, empty, render_on, solids, sphere};

const CENTRE: DVec2 = DVec2::new(101.0, 97.0);
const RADIUS_PX: f64 = 92.0;
/// Pincushion and S at the rim.
const RIM_PX: (f64, f64) = (9.0, 4.0);

/// r² (pincushion · x + S · x turned): terms 6 to 9 of the third order are x³, x²y, xy², y³.
fn intensifier(glare: Option<Glare>) -> Intensifier {
    let mut shift = vec![DVec2::ZERO; term_count(3)];
    let (p, s) = (-RIM_PX.0, RIM_PX.1);
    for (n, value) in [(6, DVec2::new(p, s)), (7, DVec2::new(-s, p)), (8, DVec2::new(p, s)), (9, DVec2::new(-s, p))] {
        shift[n] = value;
    }
    let distortion = Distortion::new(CENTRE, RADIUS_PX, 3, shift).expect("invertible");
    Intensifier { size_px: [200, 200], distortion, glare, note: None }
}

/// The same law, written out.
fn undistorted(p: DVec2) -> DVec2 {
    let x = (p - CENTRE) / RADIUS_PX;
    p + x.length_squared() * (-RIM_PX.0 * x + RIM_PX.1 * x.perp())
}

fn scene(objects: &[(DVec3, f64)], intensifier: Option<Intensifier>) -> Scene {
    let balls: Vec<_> = objects.iter().map(|(centre, radius_mm)| sphere(*centre, *radius_mm, 0, 11.35)).collect();
    let mut scene = empty(&["lead"]).with(solids(&balls));
    let view = scene.view.as_mut().expect("has one");
    view.size_px = [200, 200];
    (view.intrinsics.cx, view.intrinsics.cy) = (99.5, 99.5);
    (view.intrinsics.fx, view.intrinsics.fy) = (2000.0, 2000.0);
    scene.detector.panel.intensifier = intensifier;
    scene
}

/// Centre of the darkness within `reach_px`.
fn dark_centre(page: &Image<f32>, near: DVec2, reach_px: f64) -> DVec2 {
    let (mut sum, mut weight) = (DVec2::ZERO, 0.0);
    for (index, value) in page.pixels.iter().enumerate() {
        let p = DVec2::new((index % page.width) as f64, (index / page.width) as f64);
        if p.distance(near) < reach_px {
            sum += p * f64::from(1.0 - value);
            weight += f64::from(1.0 - value);
        }
    }
    sum / weight
}

/// Where a pose that lists the balls as beads has their marks in the scene's view; a ball is 0.9 mm in radius.
fn marks_of(balls: &[(DVec3, f64)], scene: &Scene) -> Vec<(DVec2, f64)> {
    let bead = |(n, (at, _)): (usize, &(DVec3, f64))| Bead::new(n.to_string(), *at);
    let layout = BeadLayout { beads: balls.iter().enumerate().map(bead).collect(), ..BeadLayout::none() };
    let view = scene.view.expect("has one");
    let listed = Registration::new(view.size_px, &layout).refuse(&Refusal::Fault { detail: "not looked for".to_owned() });
    bead_marks(&listed, &view, Some(scene), |_| Some(0.9))
}

#[test]
fn shadows_fall_where_the_distortion_puts_them() {
    let places = [
        DVec2::new(60.0, 70.0),
        DVec2::new(140.0, 60.0),
        DVec2::new(101.0, 97.0),
        DVec2::new(70.0, 150.0),
        DVec2::new(165.0, 120.0),
    ];
    let ball = |px: &DVec2| (DVec3::new((px.x - 99.5) * 0.3, (px.y - 99.5) * 0.3, 600.0), 0.9);
    let balls: Vec<(DVec3, f64)> = places.iter().map(ball).collect();
    let scene = scene(&balls, Some(intensifier(None)));
    let reference = || {
        let mut renderer = Renderer::new(DeviceChoice::Cpu, &Reporter::silent()).expect("device");
        let options = Options { quantity: Quantity::Intensity, reference: true, ..Options::default() };
        renderer.render(&scene, &options).expect("renders")
    };
    let marks = marks_of(&balls, &scene);
    let (mut moved, mut checked) = (0.0f64, 0);
    for rendered in [render_on(DeviceChoice::Cpu, &scene, Quantity::Intensity), reference()] {
        let page = &rendered.pages[0];
        for (px, mark) in places.iter().zip(&marks) {
            // p with undistorted(p) = px, by fixed point.
            let there = (0..200).fold(*px, |p, _| p + (*px - undistorted(p)));
            let found = dark_centre(page, there, 8.0);
            let expected = shadow_centre(*px, there, 3.0);
            assert!(found.distance(expected) < 0.06, "{px} is at {found}, expected {expected}");
            assert!(mark.0.distance(there) < 1e-6, "the mark of {px}");
            moved = moved.max(px.distance(there));
            checked += 1;
        }
        for (index, (value, valid)) in page.pixels.iter().zip(&rendered.valid.pixels).enumerate() {
            let r = DVec2::new((index % 200) as f64, (index / 200) as f64).distance(CENTRE);
            assert_eq!(*valid == 0, r > RADIUS_PX, "{index}");
            assert!(r <= RADIUS_PX || *value == 0.0, "{index}: {value} outside the disc");
        }
        assert!((page.at(101, 30) - 1.0).abs() < 1e-6, "air is 1");
    }
    assert!(checked == 10 && moved > 3.0, "{checked} {moved}");
}

/// Middle of the opaque disc of `radius_px` about `straight` as the law shows it about `there`: no disc, and fuller on the outer side.
fn shadow_centre(straight: DVec2, there: DVec2, radius_px: f64) -> DVec2 {
    let steps = || (-60..=60).map(|n| f64::from(n) * 0.1);
    let places = steps().flat_map(|u| steps().map(move |v| there + DVec2::new(u, v)));
    let (mut sum, mut count) = (DVec2::ZERO, 0.0);
    for p in places.filter(|p| undistorted(*p).distance(straight) < radius_px) {
        sum += p;
        count += 1.0;
    }
    sum / count
}

/// Variance of `page` where `here` says.
fn variance(page: &Image<f32>, here: impl Fn(f64) -> bool) -> f64 {
    let at = |index: usize| DVec2::new((index % 200) as f64, (index / 200) as f64).distance(CENTRE) / RADIUS_PX;
    let values: Vec<f64> = (0..page.pixels.len()).filter(|index| here(at(*index))).map(|n| f64::from(page.pixels[n])).collect();
    let mean = values.iter().sum::<f64>() / values.len() as f64;
    values.iter().map(|value| (value - mean).powi(2)).sum::<f64>() / values.len() as f64
}

/// Noise belongs to the frame's own pixels: neighbours are independent, and a pixel at the rim, which shows less area, has fewer quanta.
#[test]
fn noise_is_drawn_in_the_frame_s_pixels_by_the_area_that_each_shows() {
    let mut scene = scene(&[(DVec3::new(0.0, 0.0, 600.0), 1e-3)], Some(intensifier(None)));
    scene.model.noise = Noise::True;
    scene.beam.photons_per_pixel = 1e3;
    let Rendered { pages, .. } = render_on(DeviceChoice::Cpu, &scene, Quantity::Intensity);
    let page = &pages[0];
    let (inner, rim) = (variance(page, |r| r < 0.3), variance(page, |r| r > 0.85 && r <= 1.0));
    assert!((inner * 1e3 - 1.0).abs() < 0.12, "{inner}");
    // det J = (1 − p r²)(1 − 3 p r²) + 3 (s r²)², p and s over the radius; about r = 0.93 on average.
    let (p, s, square) = (RIM_PX.0 / RADIUS_PX, RIM_PX.1 / RADIUS_PX, 0.5 * (1.0 + 0.85f64.powi(2)));
    let area = (1.0 - p * square) * (1.0 - 3.0 * p * square) + 3.0 * (s * square).powi(2);
    assert!(area < 0.75 && (rim / inner * area - 1.0).abs() < 0.12, "{} {area}", rim / inner);
    let (mut both, mut count) = (0.0, 0);
    for row in 40..150 {
        for column in 40..150 {
            both += f64::from(page.at(column, row) - 1.0) * f64::from(page.at(column + 1, row) - 1.0);
            count += 1;
        }
    }
    let correlation = both / f64::from(count) / inner;
    assert!(correlation.abs() < 0.05, "{correlation}");
}

/// Light that glare has spread brings no noise of its own, and makes the frame brighter: the noise of air over the air frame is that of
/// what arrives directly.
#[test]
fn glare_dilutes_the_noise_of_what_arrives_directly() {
    let glare = Glare { fraction: 0.12, scale_px: 45.0 };
    let mut scene = scene(&[(DVec3::new(0.0, 0.0, 600.0), 1e-3)], Some(intensifier(Some(glare))));
    scene.model.noise = Noise::True;
    scene.beam.photons_per_pixel = 1e3;
    let Rendered { pages, .. } = render_on(DeviceChoice::Cpu, &scene, Quantity::Intensity);
    let direct = 1.0 - glare.fraction;
    let share = direct / (direct + glare.fraction * (1.0 - (-RADIUS_PX / glare.scale_px).exp()));
    let found = 1e3 * variance(&pages[0], |r| r < 0.4);
    assert!(share < 0.92 && (found / share.powi(2) - 1.0).abs() < 0.1, "{found} {}", share.powi(2));
}

/// Behind lead of radius a in the middle of a disc of radius R glare alone arrives: ρ (e^(−a/k) − e^(−R/k)) of the light, over an air
/// frame that glares as well.
#[test]
fn glare_shines_behind_lead_and_is_measured_there() {
    let glare = Glare { fraction: 0.12, scale_px: 45.0 };
    let straight = Distortion::new(CENTRE, RADIUS_PX, 1, vec![DVec2::ZERO; 3]).expect("none");
    let veiled = Intensifier { size_px: [200, 200], distortion: straight, glare: Some(glare), note: None };
    let lead_px = 24.0;
    let lead = [(DVec3::new((CENTRE.x - 99.5) * 0.3, (CENTRE.y - 99.5) * 0.3, 600.0), lead_px * 0.3)];
    let scene = scene(&lead, Some(veiled));
    let page = render_on(DeviceChoice::Cpu, &scene, Quantity::Intensity).pages.remove(0);
    let spread = |r: f64| 1.0 - (-r / glare.scale_px).exp();
    let behind =
        glare.fraction * (spread(RADIUS_PX) - spread(lead_px)) / (1.0 - glare.fraction + glare.fraction * spread(RADIUS_PX));
    let found = f64::from(*page.at(CENTRE.x as usize, CENTRE.y as usize));
    assert!((found / behind - 1.0).abs() < 0.03, "{found} {behind}");
    let clear = f64::from(*page.at(CENTRE.x as usize, 20));
    assert!(clear < 1.0 && clear > 0.95, "air beside the lead loses what the lead keeps back: {clear}");

    let counts = render_on(DeviceChoice::Cpu, &scene, Quantity::Counts).pages.remove(0);
    let disc = Disc { centre: CENTRE, radius_px: RADIUS_PX };
    let frame = |pixels: Image<f32>| Frame::from_pixels("lead", pixels, Domain::Linear).expect("a frame");
    let measured = measure_glare(&frame(counts.clone()), &disc).expect("measured");
    println!("glare {glare:?}, measured {measured:?}");
    assert!(
        (measured.fraction / glare.fraction - 1.0).abs() < 0.03 && (measured.scale_px / glare.scale_px - 1.0).abs() < 0.06,
        "{measured:?}"
    );
    let refused = |frame: &Frame, word: &str| {
        let said = measure_glare(frame, &disc).expect_err(word).to_string();
        assert!(said.contains(word), "{word}: {said}");
    };
    refused(&frame(counts.map(|value| if *value > 0.0 { 1e5 } else { 0.0 })), "no opaque disc");
    let behind_lead = |n: usize| DVec2::new((n % 200) as f64, (n / 200) as f64).distance(CENTRE) < lead_px + 1.5;
    let behind = |value: &dyn Fn(usize, f32) -> f32| {
        let seen = |(n, own): (usize, &f32)| if behind_lead(n) { value(n, *own) } else { *own };
        frame(Image { pixels: counts.pixels.iter().enumerate().map(seen).collect(), ..counts.clone() })
    };
    refused(&behind(&|n, own| if n % 200 < 101 { 5.0 * own } else { own }), "is no glare");
    let beside = *counts.at(CENTRE.x as usize, 20);
    refused(&behind(&|_, _| 0.7 * beside), "is no glare");
    let shown = Frame::from_pixels("lead", counts.clone(), Domain::Display).expect("a frame");
    refused(&shown, "linear values only");
}

/// A console's part of the picture is drawn, and its beads are marked, as in the whole.
#[test]
fn a_part_of_the_picture_is_distorted_as_it_is_in_the_whole() {
    let balls = [DVec2::new(70.0, 60.0), DVec2::new(140.0, 90.0), DVec2::new(100.0, 130.0)]
        .map(|px| (DVec3::new((px.x - 99.5) * 0.3, (px.y - 99.5) * 0.3, 600.0), 0.9));
    let whole = scene(&balls, Some(intensifier(None)));
    let console = ConsoleGeometry { crop_px: Some([40, 30, 130, 120]), ..ConsoleGeometry::default() };
    let of_panel = whole.view.expect("has one");
    let (intrinsics, _) = console.window([130, 120]).intrinsics(&of_panel.intrinsics);
    let view = View { size_px: [130, 120], intrinsics, ..of_panel };
    let detector = DetectorPose {
        detector_from_image: homogeneous_rows(&console.detector_from_image([130, 120])),
        size_px: Some([200, 200]),
        projection: None,
        intrinsics: None,
        camera_from_lps: None,
        covariance: None,
    };
    let pose = Pose { size_px: Some([130, 120]), console: Some(console), detector: Some(detector), ..Pose::default() };
    let part = posed_scene(&whole, &pose, view).expect("of this panel");
    let [all, cut] = [&whole, &part].map(|scene| render_on(DeviceChoice::Cpu, scene, Quantity::Intensity));
    let mut compared = 0;
    for row in 0..120 {
        for column in 0..130 {
            // What lies outside the part without distortion was not cast.
            if *cut.valid.at(column, row) != 0 {
                let (here, there) = (cut.pages[0].at(column, row), all.pages[0].at(column + 40, row + 30));
                // Rays that graze lead are of single precision; a pixel farther is air or lead.
                assert!((here - there).abs() < 0.05, "{column}, {row}: {here}, in the whole {there}");
                compared += 1;
            }
        }
    }
    assert!(compared > 13_000, "{compared} of 15600 pixels");
    let marks = |scene: &Scene| marks_of(&balls, scene);
    let (in_part, in_whole) = (marks(&part), marks(&whole));
    assert_eq!((in_part.len(), in_whole.len()), (3, 3));
    for (part, whole) in in_part.iter().zip(&in_whole) {
        assert!((part.0 + DVec2::new(40.0, 30.0)).distance(whole.0) < 1e-6, "{} {}", part.0, whole.0);
    }
    // The control: the panel's own file, of a picture of another shape.
    assert!(marks(&whole.with_view(view))[0].0.distance(in_part[0].0) > 1.0);
}

#[test]
fn an_intensifier_of_another_picture_is_refused_and_a_binned_one_is_not() {
    let ours = intensifier(None);
    assert!(ours.for_size([100, 100]).is_ok() && ours.for_size([66, 66]).is_ok());
    assert!(ours.for_size([200, 150]).expect_err("another picture").to_string().contains("[200, 150]"));
}
