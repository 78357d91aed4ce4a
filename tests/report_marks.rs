//! What is marked in a frame, and where strips and overlays draw it.

use std::path::Path;

use glam::{DVec2, DVec3};
use sidecarm::acquire::{Domain, Frame};
use sidecarm::beads::{Detection, Landmark};
use sidecarm::compare::Pictures;
use sidecarm::geometry::{Distortion, Rigid, View};
use sidecarm::image::Image;
use sidecarm::mask::Masks;
use sidecarm::pose::{LandmarkUncertainty, Pose, Registration, Shadow, Status, register_shadows};
use sidecarm::report::figures::ring_reach;
use sidecarm::report::{PairMarks, Standing, StripInput, overlay, strip};
use sidecarm::reporter::Reporter;
use sidecarm::scene::{Scene, load_text};

use crate::pose_registration::{clutter, matching, shadows};
use crate::pose_synthetic as synthetic;

const USED: [u8; 3] = [40, 230, 80];
const PREDICTED: [u8; 3] = [250, 220, 30];
const RESIDUAL: [u8; 3] = [255, 110, 230];
const SHADOW: [u8; 3] = [235, 235, 245];
const ROBOT: [u8; 3] = [90, 190, 255];
const LANDMARK: [u8; 3] = [255, 170, 90];

/// Exact shadows of nine beads but for a tenth of a pixel, and one that is nobody's; the pose that they give, and its landmarks.
fn posed() -> (View, Vec<Detection>, Pose) {
    let (view, layout) = (synthetic::view(1024, 1024, 3), synthetic::layout(9, 0.75, 3));
    let mut found = shadows(&view, &layout, 0.1, 0.0, 3);
    let radius_px = found[0].radius_px;
    found.extend(clutter(&view, 1, radius_px, 3));
    let side = |n: usize, axis: usize| if (n >> axis).is_multiple_of(2) { -35.0 } else { 35.0 };
    let place = |n: usize| Landmark { name: format!("l{n}"), lps_mm: DVec3::new(side(n, 0), side(n, 1), side(n, 2)) };
    let landmarks: Vec<Landmark> = (0..8).map(place).collect();
    let pose = register_shadows(&Registration { landmarks: &landmarks, ..matching(&view, &layout) }, &found);
    assert!(pose.is_accepted() && pose.landmarks.len() == 8, "{:?}", pose.reason);
    (view, found, pose)
}

/// A straight robot whose base is turned by nothing.
fn robot(base_mm: [f64; 3]) -> Scene {
    let [x, y, z] = base_mm;
    let text = serde_json::json!({
        "objects": [
            {"box": {"centre_lps_mm": [0, 0, 0], "size_mm": [100, 80, 60], "material": "water"}},
            {"robot": {"model": concat!(env!("CARGO_MANIFEST_DIR"), "/calibration/robot/cdm.json"),
                       "lps_from_base": [[1, 0, 0, x], [0, 1, 0, y], [0, 0, 1, z], [0, 0, 0, 1]]}}
        ],
        "beam": {"tube_kvp": 90, "filtration_mm": {"aluminium": 4.3}}, "detector": {"pitch_mm": 0.388}
    });
    load_text(&text.to_string(), Path::new("scene.json"), false, &Reporter::silent()).expect("loads")
}

fn point(at: Option<[f64; 2]>) -> DVec2 {
    DVec2::from_array(at.expect("in the frame"))
}

#[test]
fn marks_lie_where_the_pose_puts_them() {
    let (_, found, pose) = posed();
    let projection = pose.projection.expect("accepted");
    let marks = PairMarks::of(&pose, None, None, None);
    assert_eq!((marks.beads.len(), marks.robot.is_none()), (9, true));
    let mut used = 0;
    for (mark, bead) in marks.beads.iter().zip(&pose.beads) {
        assert_eq!((&mark.name, mark.used), (&bead.name, bead.used));
        let place = projection.project(bead.lps_mm).0;
        assert!(point(mark.predicted_px).distance(place) < 1e-6, "{}: {:?}, P has it at {place}", mark.name, mark.predicted_px);
        let Some(seen) = mark.found_px.map(DVec2::from_array) else { continue };
        let own = found.iter().find(|shadow| shadow.image_px.distance(seen) < 0.2).expect("a shadow lies there");
        assert_eq!(mark.radius_px, Some(own.radius_px), "{}", mark.name);
        assert!((point(mark.residual_px) - (seen - place)).length() < 1e-6, "{}: found minus predicted", mark.name);
        used += usize::from(mark.used);
    }
    assert!(used >= 7, "{used} of nine");
    // All shadows have their rank, and one is nobody's.
    assert!(marks.shadows.iter().map(|shadow| shadow.rank).eq(1..=found.len()));
    let strays: Vec<_> = marks.strays().collect();
    assert_eq!(strays.len(), found.len() - used);
    let clutter_px = found.last().expect("shadows").image_px.to_array();
    assert!(strays.iter().any(|shadow| shadow.image_px == clutter_px));
}

/// The window drew uncertainties along columns and rows, whichever way they were longest.
#[test]
fn a_landmark_has_the_covariance_of_its_projection() {
    let (_, _, pose) = posed();
    let ((k, camera_from_lps), sigma) = (pose.camera().expect("accepted"), pose.covariance.expect("accepted"));
    let project = |[a, b, c, d, e, f]: [f64; 6], place: DVec3| {
        let moved = Rigid::exp(DVec3::new(a, b, c), DVec3::new(d, e, f)) * camera_from_lps;
        k.project(moved.transform_point(place))
    };
    let marks = PairMarks::of(&pose, None, None, None);
    let (mut cases, mut most) = (0, 0.0f64);
    for (mark, landmark) in marks.landmarks.iter().zip(&pose.landmarks) {
        let place = project([0.0; 6], landmark.lps_mm);
        assert!(point(mark.image_px).distance(place) < 1e-6, "{}", mark.name);
        // By differences: J Σ Jᵀ.
        let slopes: [DVec2; 6] = std::array::from_fn(|n| {
            let step = if n < 3 { 1e-6 } else { 1e-3 };
            let at = |sign: f64| project(std::array::from_fn(|m| if m == n { sign * step } else { 0.0 }), landmark.lps_mm);
            (at(1.0) - at(-1.0)) / (2.0 * step)
        });
        let entry = |i: usize, j: usize| {
            let terms = (0..36).map(|at| (at / 6, at % 6)).map(|(a, b)| slopes[a][i] * sigma[a][b] * slopes[b][j]);
            terms.sum::<f64>()
        };
        let covariance = mark.covariance_px2.expect("in front of the source");
        let size = entry(0, 0) + entry(1, 1);
        for (i, j) in [(0, 0), (0, 1), (1, 0), (1, 1)] {
            let off = covariance[i][j] - entry(i, j);
            assert!(off.abs() < 0.01 * size, "{} [{i}][{j}]: {} for {}", mark.name, covariance[i][j], entry(i, j));
        }
        let [u, v] = landmark.sigma_px.expect("in front of the source");
        assert!((covariance[0][0].sqrt() - u).abs() < 1e-12 && (covariance[1][1].sqrt() - v).abs() < 1e-12);
        most = most.max((covariance[0][1] / (u * v)).abs());
        cases += 1;
    }
    assert_eq!(cases, 8);
    assert!(most > 0.05, "none is correlated: the test says nothing ({most})");
    // A pose of before has no covariance: its standard deviations are drawn.
    let mut before = pose.clone();
    before.landmarks[0].covariance_px2 = None;
    let [u, v] = before.landmarks[0].sigma_px.expect("in front of the source");
    assert_eq!(PairMarks::of(&before, None, None, None).landmarks[0].covariance_px2, Some([[u * u, 0.0], [0.0, v * v]]));
}

#[test]
fn the_robot_is_marked_where_p_puts_its_base_its_end_and_its_tip() {
    let (view, base) = (synthetic::view(620, 480, 0), DVec3::new(5.0, -4.0, -10.0));
    let scene = robot(base.to_array());
    let of = |view: Option<&View>| PairMarks::of(&Pose::default(), None, view, Some(&scene)).robot;
    let mark = of(Some(&view)).expect("a robot");
    let place = |along_mm: f64| view.projection().project(base + along_mm * DVec3::Z).0;
    let ends = [point(mark.centreline_px.first().copied()), point(mark.centreline_px.last().copied())];
    assert_eq!(mark.centreline_px.len(), 29, "28 pieces and the end of the body");
    // 35 mm of body, 4 mm of drill.
    for (found, along_mm) in [(ends[0], 0.0), (ends[1], 35.0), (DVec2::from_array(mark.tip_px), 39.0)] {
        assert!(found.distance(place(along_mm)) < 1e-6, "{along_mm} mm along it: {found} for {}", place(along_mm));
    }
    assert!(of(None).is_none(), "nothing says where the frame was taken from");
}

#[test]
fn marks_lie_where_a_distorted_frame_shows_them() {
    let (_, _, pose) = posed();
    let centre = DVec2::splat(511.5);
    let shifts = vec![DVec2::ZERO, DVec2::new(20.0, 0.0), DVec2::new(0.0, 40.0)];
    let distortion = Distortion::new(centre, 800.0, 1, shifts).expect("it does not fold");
    let stretch = DVec2::ONE + DVec2::new(20.0, 40.0) / 800.0;
    let shown = |straight: DVec2| centre + (straight - centre) / stretch;
    let (straight, marks) = (PairMarks::of(&pose, None, None, None), PairMarks::of(&pose, Some(&distortion), None, None));
    let mut farthest = 0.0f64;
    for (mark, straight) in marks.beads.iter().zip(&straight.beads) {
        let (at, there) = (point(mark.predicted_px), point(straight.predicted_px));
        assert!(at.distance(shown(there)) < 1e-6, "{}: {at} for {}", mark.name, shown(there));
        farthest = farthest.max(at.distance(there));
    }
    assert!(farthest > 3.0, "control: it is hardly distorted ({farthest} px)");
    assert!(marks.shadows.iter().zip(&straight.shadows).all(|(mark, straight)| {
        DVec2::from_array(mark.image_px).distance(shown(DVec2::from_array(straight.image_px))) < 1e-6
    }));
    for (mark, straight) in marks.landmarks.iter().zip(&straight.landmarks) {
        assert!(point(mark.image_px).distance(shown(point(straight.image_px))) < 1e-6, "{}", mark.name);
        let (covariance, straight) = (mark.covariance_px2.expect("known"), straight.covariance_px2.expect("known"));
        for (i, j) in [(0, 0), (0, 1), (1, 0), (1, 1)] {
            let expected = straight[i][j] / (stretch[i] * stretch[j]);
            assert!((covariance[i][j] - expected).abs() < 1e-9 * (straight[0][0] + straight[1][1]), "{} [{i}][{j}]", mark.name);
        }
    }
}

/// Pixels between two corners that are as `wanted` says.
fn count(picture: &Image<[u8; 3]>, from: DVec2, to: DVec2, wanted: impl Fn(&[u8; 3]) -> bool) -> usize {
    let span = |from: f64, to: f64, end: usize| (from.max(0.0) as usize)..(to.max(0.0) as usize + 1).min(end);
    let rows = span(from.y, to.y, picture.height);
    let columns = span(from.x, to.x, picture.width);
    rows.flat_map(|row| columns.clone().map(move |column| (column, row))).filter(|(u, v)| wanted(picture.at(*u, *v))).count()
}

/// Pixels of about this colour near a place.
fn near(picture: &Image<[u8; 3]>, at: DVec2, reach: f64, colour: [u8; 3]) -> usize {
    let like = |pixel: &[u8; 3]| pixel.iter().zip(colour).all(|(a, b)| a.abs_diff(b) < 60);
    count(picture, at - reach, at + reach, like)
}

/// Pixels that are lighter than gray of this level.
fn lighter(picture: &Image<[u8; 3]>, from: DVec2, to: DVec2, level: u8) -> usize {
    count(picture, from, to, |pixel| pixel.iter().all(|channel| *channel > level))
}

/// Flat pictures of a frame, one pixel for `block` × `block` of its own: every colour in them is a mark.
fn flat(frame: &Frame, block: usize) -> Pictures {
    let [width, height] = frame.size_px.map(|side| side / block);
    Pictures {
        acquired: Image::filled(width, height, 0.7),
        simulated: Image::filled(width, height, 0.7),
        usable: Image::filled(width, height, true),
        shut_off: Image::filled(width, height, false),
        edges: Image::filled(width, height, false),
        unit: "nepers",
    }
}

/// The report had no beads, no residuals and no robot in any picture.
#[test]
fn the_strip_of_a_posed_frame_marks_what_its_pose_says() {
    let (view, _, mut pose) = posed();
    // One bead is seen 1.5 px from its place.
    let off = DVec2::new(1.2, 0.9);
    let own = pose.beads.iter().position(|bead| bead.used).expect("P rests on beads");
    let from = point(pose.beads[own].predicted_px);
    pose.beads[own].image_px = Some((from + off).to_array());
    let scene = robot([0.0, 0.0, -20.0]);
    let marks = PairMarks::of(&pose, None, Some(&view), Some(&scene));
    let frame = Frame::from_pixels("flat", Image::filled(1024, 1024, 0.5f32), Domain::Linear).expect("finite");
    let drawn = |pictures: &Pictures, marks: Option<&PairMarks>| {
        strip(&StripInput {
            acquired: &frame,
            pictures: Some(pictures),
            masks: None,
            without: None,
            marks,
            standing: Standing::Accepted,
            status: "rms 0.1 px",
            scores: &[],
            mm_per_px: None,
        })
    };
    let mut cases = 0;
    for block in [1, 2] {
        let pictures = flat(&frame, block);
        let (seen, bare) = (drawn(&pictures, Some(&marks)), drawn(&pictures, None));
        assert_eq!([seen.width, seen.height], [bare.width, bare.height]);
        assert!(seen.pixels == drawn(&pictures, Some(&marks)).pixels, "the same each time");
        // Four panels of 460 px, gaps of 16 px, margins of 22 px; header and title take 88 rows.
        let scale = 460.0 / 1024.0;
        let place = |panel: f64, at: DVec2| DVec2::new(22.0 + 476.0 * panel, 88.0) + (at + 0.5) * scale - 0.5;
        for bead in marks.beads.iter().filter(|bead| bead.used) {
            let (found, predicted) = (point(bead.found_px), point(bead.predicted_px));
            let reach = ring_reach(bead.radius_px.expect("a shadow"), scale);
            let ring = |picture: &Image<[u8; 3]>, panel: f64| near(picture, place(panel, found), reach + 2.0, USED);
            assert!(ring(&seen, 3.0) > 8, "the ring of {} in blocks of {block}: {}", bead.name, ring(&seen, 3.0));
            assert_eq!((ring(&bare, 3.0), ring(&seen, 0.0)), (0, 0), "control: nothing without marks, nor over the bare frame");
            let cross = near(&seen, place(3.0, predicted), 3.0, PREDICTED);
            assert!(cross > 3 && near(&bare, place(3.0, predicted), 3.0, PREDICTED) == 0, "the cross of {}: {cross}", bead.name);
            // Names stand above, at the right where there is room.
            if found.x < 850.0 && found.y > 60.0 {
                let corner = place(3.0, found) + DVec2::new(reach + 2.0, -reach - 2.0);
                let is_green = |[red, green, blue]: &[u8; 3]| *green > red.saturating_add(40) && *green > blue.saturating_add(40);
                let letters = count(&seen, corner - DVec2::new(0.0, 10.0), corner + DVec2::new(14.0, 0.0), is_green);
                assert!(letters > 5, "the name of {}: {letters} pixels", bead.name);
            }
            cases += 1;
        }
        // Its residual, twenty times as long as it is.
        assert!((point(marks.beads[own].residual_px) - off).length() < 1e-9);
        let [end, other] = [20.0, -20.0].map(|times| near(&seen, place(3.0, from + times * off), 2.0, RESIDUAL));
        assert!(end > 2 && other == 0, "the end of the arrow: {end}, on the other side: {other}");
        let stray = marks.strays().next().expect("one is nobody's");
        let ring = near(&seen, place(3.0, DVec2::from_array(stray.image_px)), ring_reach(stray.radius_px, scale) + 2.0, SHADOW);
        assert!(ring > 8, "the ring of a shadow that is nobody's: {ring}");
        let robot = marks.robot.as_ref().expect("a robot");
        for (what, at, most) in [("tip", robot.tip_px, 10), ("middle", robot.centreline_px[14], 3)] {
            let found = near(&seen, place(3.0, DVec2::from_array(at)), 7.0, ROBOT);
            assert!(found > most, "the robot's {what}: {found} pixels");
        }
    }
    assert!(cases >= 14, "{cases}");
}

/// Three of four panels said that there was no DRR, and the frame was as small as beside one.
#[test]
fn the_strip_of_a_refused_frame_shows_every_shadow_large_with_its_rank_and_why() {
    let shadow =
        |image_px: [f64; 2], radius_px: f64, snr: f64| Shadow { image_px, sigma_px: 0.1, radius_px, snr, ..Shadow::default() };
    let reason = "too_few_shadows: 3 bead-like shadows in the frame, 4 are needed; bring more beads into the open field";
    let pose = Pose {
        status: Status::Refused,
        reason: Some(reason.to_owned()),
        shadows: vec![shadow([100.0, 80.0], 6.0, 20.0), shadow([400.0, 300.0], 5.0, 9.0), shadow([320.0, 120.0], 4.0, 5.0)],
        detections: 3,
        ..Pose::default()
    };
    let marks = PairMarks::of(&pose, None, None, None);
    let frame = Frame::from_pixels("flat", Image::filled(620, 480, 0.5f32), Domain::Linear).expect("finite");
    let drawn = |marks: Option<&PairMarks>, status: &str| {
        strip(&StripInput {
            acquired: &frame,
            pictures: None,
            masks: None,
            without: Some("no pose: nothing to render"),
            marks,
            standing: Standing::Refused,
            status,
            scores: &[],
            mm_per_px: None,
        })
    };
    let (seen, bare) = (drawn(Some(&marks), reason), drawn(None, reason));
    // The frame fills 700 rows in the middle of the first two panels.
    let scale = 700.0 / 480.0;
    let place = |at: DVec2| DVec2::new(22.0 + 16.0, 88.0) + (at + 0.5) * scale - 0.5;
    assert_eq!([seen.width, seen.height], [1932, 58 + 30 + 700 + 52 + 11]);
    for shadow in &marks.shadows {
        let (at, reach) = (place(DVec2::from_array(shadow.image_px)), ring_reach(shadow.radius_px, scale));
        assert!((reach - (shadow.radius_px + 4.0) * scale).abs() < 1e-9, "its size is to be seen");
        for side in [DVec2::X, DVec2::Y, -DVec2::X, -DVec2::Y] {
            let rim = |picture| lighter(picture, at + reach * side - 1.0, at + reach * side + 1.0, 165);
            assert!(rim(&seen) > 1 && rim(&bare) == 0, "shadow {}: {}", shadow.rank, rim(&seen));
        }
        assert_eq!(near(&seen, at, 0.5 * reach, SHADOW), 0, "its middle is not covered");
        let corner = at + reach + 2.0;
        let number = |picture| lighter(picture, corner, corner + DVec2::new(12.0, 11.0), 160);
        assert!(number(&seen) > 3 && number(&bare) == 0, "the rank of shadow {}: {} pixels", shadow.rank, number(&seen));
    }
    // Beside it: the reason, and a row for each shadow.
    let ink = |picture: &Image<[u8; 3]>| lighter(picture, DVec2::new(974.0, 88.0), DVec2::new(1910.0, 790.0), 90);
    let (rows, words, short) = (ink(&seen), ink(&bare), ink(&drawn(None, "unsolved")));
    assert!(rows > words + 100 && words > short + 200, "{rows} with shadows, {words} with the reason alone, {short} with a word");
    let two = PairMarks { shadows: marks.shadows[..2].to_vec(), ..marks.clone() };
    assert!(ink(&drawn(Some(&two), reason)) < rows, "a row less");
    // What is said later of a frame stands in its header alone.
    let later = sidecarm::report::restated(seen.clone(), "flat", Standing::Refused, "frame 2 is the whole picture");
    let header = 58 * seen.width;
    assert!(later.pixels[header..] == seen.pixels[header..] && later.pixels[..header] != seen.pixels[..header]);
}

/// A hundred shadows have no room in the table: it says how many are left out, and nothing is drawn outside.
#[test]
fn many_shadows_leave_the_strip_as_large_as_it_is() {
    let at = |n: usize| [4.0 + 6.0 * (n % 100) as f64, 5.0 + 30.0 * (n / 100) as f64];
    let shadow = |n: usize| Shadow { image_px: at(n), sigma_px: 0.1, radius_px: 1.5, snr: 4.0, ..Shadow::default() };
    let drawn = |count: usize| {
        let pose = Pose { status: Status::Refused, shadows: (0..count).map(shadow).collect(), ..Pose::default() };
        let frame = Frame::from_pixels("flat", Image::filled(620, 480, 0.5f32), Domain::Linear).expect("finite");
        strip(&StripInput {
            acquired: &frame,
            pictures: None,
            masks: None,
            without: None,
            marks: Some(&PairMarks::of(&pose, None, None, None)),
            standing: Standing::Refused,
            status: "",
            scores: &[],
            mm_per_px: Some(0.2),
        })
    };
    let (one, many) = (drawn(1), drawn(1000));
    assert_eq!([one.width, one.height], [many.width, many.height]);
    let rest = |picture| lighter(picture, DVec2::new(964.0, 88.0 + 700.0 + 8.0), DVec2::new(1931.0, 850.0), 90);
    assert_eq!((rest(&one), rest(&many)), (0, 0), "below the table nothing stands");
}

#[test]
fn the_overlay_draws_a_landmark_s_uncertainty_the_way_it_lies() {
    let of = |across: f64| Pose {
        landmarks: vec![LandmarkUncertainty {
            name: "tip".to_owned(),
            lps_mm: DVec3::ZERO,
            image_px: Some([300.0, 200.0]),
            sigma_mm: [0.1, 0.1, 1.0],
            sigma_px: Some([0.6, 0.6]),
            covariance_px2: Some([[0.36, across], [across, 0.36]]),
        }],
        ..Pose::default()
    };
    let frame = Frame::from_pixels("flat", Image::filled(620, 480, 0.5f32), Domain::Linear).expect("finite");
    // The long axis is √0.66 px, enlarged twenty times, along a diagonal.
    let end = 20.0 * 0.66f64.sqrt() / std::f64::consts::SQRT_2;
    let corners = [DVec2::new(-end, -end), DVec2::new(end, -end)];
    let ends = |across: f64| {
        let seen = overlay(&frame, &of(across), &Masks::default());
        corners.map(|off| near(&seen, DVec2::new(300.0, 200.0) + off, 2.0, LANDMARK))
    };
    let (falling, rising) = (ends(0.30), ends(-0.30));
    assert!(falling[0] > 2 && falling[1] == 0, "{falling:?}");
    assert!(rising[0] == 0 && rising[1] > 2, "{rising:?}");
}
