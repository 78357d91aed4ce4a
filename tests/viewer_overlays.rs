//! What the window lays over pictures, and where: the DRR in squares and through the frame, names, the robot as it is seen, the cursor; and
//! where a score stands among those of wrong poses.
#![cfg(feature = "viewer")]

use std::sync::Arc;

use eframe::egui::{Pos2, Rect, pos2, vec2};
use egui_kittest::kittest::NodeT;
use sidecarm::calibrate::robot::{SeenRobot, SeenTip};
use sidecarm::compare::{NullScore, ShiftedScore};
use sidecarm::image::Image;
use sidecarm::report::PoseSource;
use sidecarm::session::board::PairView;
use sidecarm::viewer::{Arrangement, Mark, Overlay};

use crate::viewer_boards::{FOUND_PX, RESIDUAL_PX, accepted, board, refused};
use crate::viewer_drawn::{AMBER, Drawn, GREEN, IN_ACQUIRED, mean, near, on_screen, picture_at};
use crate::viewer_window::window;

/// In the middle of the upper right picture, where no mark is.
const IN_DRR: [usize; 2] = [1100, 330];
/// The colour of names of beads on which a pose rests.
const NAME: [u8; 3] = [40, 230, 80];
const SEEN_ROBOT: [u8; 3] = [165, 95, 255];
const MARKS: [Mark; 5] = [Mark::Beads, Mark::Names, Mark::Residuals, Mark::Robot, Mark::Landmarks];

/// A pair whose frame is white and whose DRR is black, in a window that shows the overlay alone and no marks.
fn black_on_white(drawn: &mut Drawn, overlay: Overlay) -> PairView {
    (drawn.state.arrangement, drawn.state.overlay) = (Arrangement::Overlay, overlay);
    MARKS.into_iter().for_each(|mark| drawn.state.toggle(mark));
    let mut pair = accepted(1);
    let mut pictures = (*pair.pictures).clone();
    (pictures.window, pictures.window_of_drr) = ([-9.0, -8.0], [90.0, 91.0]);
    (pair.pictures, pair.mm_per_px) = (Arc::new(pictures), None);
    pair
}

#[test]
fn the_checkerboard_has_the_drr_in_every_other_square() {
    let Some(mut drawn) = Drawn::open() else { return };
    let pair = black_on_white(&mut drawn, Overlay::Checkerboard);
    let seen = drawn.picture(&board(vec![pair]));
    let picture = picture_at(&seen, [850, 420]);
    assert!(picture.width() > 700.0, "{picture:?}");
    let mut squares = [0, 0];
    for square in 0..64u8 {
        let (row, column) = (square / 8, square % 8);
        let side = 0.125 * picture.size();
        // The middle quarter of it.
        let from = picture.min + side * vec2(f32::from(column) + 0.375, f32::from(row) + 0.375);
        let level = mean(&seen, Rect::from_min_size(from, 0.25 * side));
        let is_drr = (row + column) % 2 == 1;
        assert!(if is_drr { level < 30.0 } else { level > 230.0 }, "row {row}, column {column}: {level}");
        squares[usize::from(is_drr)] += 1;
    }
    assert_eq!(squares, [32, 32]);
}

#[test]
fn the_drr_covers_the_frame_as_far_as_it_is_opaque() {
    let Some(mut drawn) = Drawn::open() else { return };
    let one = board(vec![black_on_white(&mut drawn, Overlay::Opacity)]);
    let middle = Rect::from_min_max(pos2(700.0, 300.0), pos2(1000.0, 500.0));
    // White is 250 and black 10.
    let mut cases = 0;
    for (opacity, expected) in [(0.0, 250.0), (0.25, 190.0), (0.5, 130.0), (0.75, 70.0), (1.0, 10.0)] {
        drawn.state.opacity = opacity;
        let level = mean(&drawn.picture(&one), middle);
        assert!((level - expected).abs() < 5.0, "{opacity}: {level}, expected {expected}");
        cases += 1;
    }
    assert_eq!(cases, 5);
}

/// Where the name of a bead begins beside its ring, and half the height of its letters.
fn name_beside(picture: Rect, at_px: [f64; 2]) -> (Pos2, f32) {
    // The shadow's radius is 5 px and the gap to its ring 4.
    let aside = 9.0 * picture.width() / 310.0 + 2.0;
    (on_screen(picture, at_px) + vec2(aside + 8.0, -aside - 7.0), 7.0)
}

#[test]
fn beads_are_named_beside_their_rings_and_where_p_has_them_in_the_drr() {
    let Some(mut drawn) = Drawn::open() else { return };
    // Neither rings nor arrows.
    [Mark::Beads, Mark::Residuals].into_iter().for_each(|mark| drawn.state.toggle(mark));
    let one = board(vec![accepted(1)]);
    let seen = drawn.picture(&one);
    let acquired = picture_at(&seen, IN_ACQUIRED);
    let drr = picture_at(&seen, IN_DRR);
    let predicted = [FOUND_PX[0] - RESIDUAL_PX[0], FOUND_PX[1] - RESIDUAL_PX[1]];
    let places = [name_beside(acquired, FOUND_PX), name_beside(drr, predicted)];
    let letters = |seen: &Image<[u8; 3]>| places.map(|(at, reach)| near(seen, at, reach, NAME));
    assert!(letters(&seen).iter().all(|pixels| *pixels > 8), "{:?}", letters(&seen));
    // The ground of the letters is dark, so that they can be read on any picture.
    let (at, reach) = places[0];
    let around = Rect::from_center_size(at, vec2(2.0 * reach, 2.0 * reach));
    let mut bare = board(vec![accepted(1)]);
    drawn.state.toggle(Mark::Names);
    let without = drawn.picture(&bare);
    assert_eq!(letters(&without), [0, 0], "names are not wanted");
    let darkest = |seen: &Image<[u8; 3]>| {
        let within = |row: usize, column: usize| around.contains(pos2(column as f32, row as f32));
        let all = (0..seen.pixels.len()).filter(|at| within(at / seen.width, at % seen.width));
        all.map(|at| seen.pixels[at][0]).min().expect("pixels")
    };
    assert!(f32::from(darkest(&seen)) < 0.5 * f32::from(darkest(&without)).max(4.0), "{} {}", darkest(&seen), darkest(&without));
    // Another name is another picture.
    drawn.state.toggle(Mark::Names);
    let pair = Arc::make_mut(&mut bare.pairs[0]);
    Arc::make_mut(&mut pair.marks).beads[0].name = "X7".to_owned();
    let renamed = drawn.picture(&bare);
    let part = |seen: &Image<[u8; 3]>| {
        let row = |row: usize| (at.x as usize - 8..at.x as usize + 8).map(move |column| (column, row));
        let places = (at.y as usize - 7..at.y as usize + 7).flat_map(row);
        places.map(|(column, row)| *seen.at(column, row)).collect::<Vec<_>>()
    };
    assert_ne!(part(&seen), part(&renamed));
}

/// A frame whose pose is telemetry's has no bead by registration, and had none over its DRR.
#[test]
fn beads_of_a_pose_from_telemetry_are_marked_where_it_has_them() {
    let Some(mut drawn) = Drawn::open() else { return };
    let mut view = accepted(1);
    Arc::make_mut(&mut view.pair).pose_source = PoseSource::Telemetry;
    let marks = Arc::make_mut(&mut view.marks);
    for bead in &mut marks.beads {
        (bead.found_px, bead.radius_px, bead.residual_px, bead.used) = (None, None, None, false);
    }
    let predicted = marks.beads[0].predicted_px.expect("by telemetry");
    let one = board(vec![view]);
    let seen = drawn.picture(&one);
    for pane in [IN_ACQUIRED, IN_DRR] {
        let at = on_screen(picture_at(&seen, pane), predicted);
        assert!(yellow(&seen, at) >= 6, "{pane:?}: {}", yellow(&seen, at));
        assert_eq!(near(&seen, at, 24.0, NAME), 0, "no pose rests on it");
    }
    // The control: registration has put it nowhere.
    let bare = drawn.picture(&board(vec![refused(1)]));
    let at = on_screen(picture_at(&bare, IN_ACQUIRED), predicted);
    assert_eq!(yellow(&bare, at), 0);
}

/// Pixels of a cross on a gray picture.
fn yellow(seen: &Image<[u8; 3]>, at: Pos2) -> usize {
    let is_yellow = |[red, green, blue]: [u8; 3]| red > blue.saturating_add(50) && green > blue.saturating_add(30);
    let span = |middle: f32| (middle - 4.0) as usize..=(middle + 4.0) as usize;
    span(at.y).flat_map(|row| span(at.x).map(move |column| (column, row))).filter(|(u, v)| is_yellow(*seen.at(*u, *v))).count()
}

/// Where the frame shows the tip was told in millimetres, and nowhere in the picture.
#[test]
fn the_robot_as_it_is_seen_lies_beside_that_of_telemetry_dashed_and_in_its_own_colour() {
    let Some(mut drawn) = Drawn::open() else { return };
    let (from, tip) = ([150.0, 215.0], [240.0, 140.0]);
    let with = |is_seen: bool| {
        let mut view = accepted(1);
        let seen = SeenTip { image_px: tip, off_mm: [4.0, -6.0], sigma_mm: [0.2; 2], length_mm: 7.2, profiles: 40 };
        if is_seen {
            Arc::make_mut(&mut view.pair).tip = Some(seen);
            view.seen_robot = Some(Arc::new(SeenRobot { tip: seen, centreline_px: vec![from, tip] }));
        }
        board(vec![view])
    };
    let seen = drawn.picture(&with(true));
    let picture = picture_at(&seen, IN_ACQUIRED);
    let violet = |seen: &Image<[u8; 3]>, at: [f64; 2], reach: f32| near(seen, on_screen(picture, at), reach, SEEN_ROBOT);
    // The corners of the diamond about the tip.
    assert!(violet(&seen, tip, 8.0) > 15, "{}", violet(&seen, tip, 8.0));
    let along = |seen: &Image<[u8; 3]>| {
        let place = |n: u32| {
            let share = 0.1 + 0.8 * f64::from(n) / 99.0;
            [from[0] + share * (tip[0] - from[0]), from[1] + share * (tip[1] - from[1])]
        };
        (0..100).filter(|n| violet(seen, place(*n), 1.0) > 0).count()
    };
    // Dashes of six points with gaps of four, about which a look of three points sees some more.
    assert!((55..98).contains(&along(&seen)), "{}", along(&seen));
    let legend = Rect::from_min_max(pos2(picture.right() - 235.0, picture.top()), pos2(picture.right(), picture.top() + 62.0));
    let in_legend = |seen: &Image<[u8; 3]>, colour: [u8; 3]| near(seen, legend.center(), 0.5 * legend.height(), colour);
    assert!(in_legend(&seen, SEEN_ROBOT) > 15, "{}", in_legend(&seen, SEEN_ROBOT));
    assert!(in_legend(&seen, [90, 190, 255]) > 15, "telemetry's is named too: {}", in_legend(&seen, [90, 190, 255]));
    // The controls: one that is not seen, and one that nobody wants to see.
    let unseen = drawn.picture(&with(false));
    assert_eq!(violet(&unseen, tip, 8.0) + along(&unseen) + in_legend(&unseen, SEEN_ROBOT), 0);
    drawn.state.toggle(Mark::Robot);
    let hidden = drawn.picture(&with(true));
    assert_eq!(violet(&hidden, tip, 8.0) + along(&hidden) + in_legend(&hidden, SEEN_ROBOT), 0);
}

/// The cross that marks the cursor's place in other panes stood in their colour scales and numbers, and then was missing where words might
/// have been and were not.
#[test]
fn the_cursor_s_cross_is_in_the_other_pictures_and_never_in_a_legend() {
    let Some(mut drawn) = Drawn::open() else { return };
    let one = board(vec![accepted(1)]);
    let plain = drawn.picture(&one);
    let (acquired, drr) = (picture_at(&plain, IN_ACQUIRED), picture_at(&plain, IN_DRR));
    let mut changed = |from_corner: [f32; 2]| {
        drawn.pointer = Some(acquired.right_bottom() - vec2(from_corner[0], from_corner[1]));
        let seen = drawn.picture(&one);
        let at = drr.right_bottom() - vec2(from_corner[0], from_corner[1]);
        let around = Rect::from_center_size(at, vec2(40.0, 40.0)).intersect(drr.shrink(1.0));
        let within = |index: &usize| around.contains(pos2((index % seen.width) as f32, (index / seen.width) as f32));
        (0..seen.pixels.len()).filter(within).filter(|index| seen.pixels[*index] != plain.pixels[*index]).count()
    };
    let (on_picture, on_scale, on_words) = (changed([200.0, 150.0]), changed([70.0, 13.0]), changed([100.0, 28.0]));
    assert!(on_picture > 20, "the control: {on_picture}");
    let on_bare_corner = changed([100.0, acquired.height() - 30.0]);
    assert!(on_bare_corner > 20, "the DRR has no words in its upper right corner: {on_bare_corner}");
    assert_eq!((on_scale, on_words), (0, 0));
}

fn null(at_pose: f64, best: f64, wrong: &[f64], discriminating: bool) -> NullScore {
    let shift = |value: &f64| ShiftedScore { shift: "u +1 mm".to_owned(), value: Some(*value), same_picture: false };
    let shifts: Vec<ShiftedScore> = wrong.iter().map(shift).collect();
    let (rank, of) = (if discriminating { 1 } else { 2 }, wrong.len() + 1);
    NullScore { at_pose: Some(at_pose), best_shifted: Some(best), best_shift: None, rank, of, discriminating, shifts }
}

#[test]
fn a_score_stands_where_it_is_among_those_of_wrong_poses() {
    let Some(mut drawn) = Drawn::open() else { return };
    let mut view = accepted(1);
    let pair = Arc::make_mut(&mut view.pair);
    pair.null.clear();
    pair.null.insert("zncc".to_owned(), null(0.9, 0.6, &[0.1, 0.3, 0.6], true));
    // Of distances the smaller is the better.
    pair.null.insert("edge_distance_px".to_owned(), null(4.0, 2.0, &[2.0, 6.0, 10.0], false));
    let one = board(vec![view]);
    let (harness, _) = window(one.clone());
    // What is driven without a display has a margin of eight points about it.
    let bar = |name: &str| {
        let is_bar = |label: &str| label.contains("better than all wrong poses") || label.contains("not discriminating");
        let is_it = |node: &egui_kittest::Node| {
            node.accesskit_node().label().is_some_and(|label| label.starts_with(name) && is_bar(&label))
        };
        let bar = harness.root().children_recursive().find(is_it).unwrap_or_else(|| panic!("no {name}")).rect();
        bar.translate(vec2(-8.0, -8.0))
    };
    let seen = drawn.picture(&one);
    let like = |pixel: &[u8; 3], colour: [u8; 3], by: u8| pixel.iter().zip(colour).all(|(a, b)| a.abs_diff(b) <= by);
    // Mark's place, the band's ends, places within the band and beyond it: shares of the bar from worse to better.
    let cases = [("ZNCC ", GREEN, 1.0, [0.0, 0.625], [0.45, 0.8]), ("edges ", AMBER, 0.75, [0.0, 1.0], [0.25, f32::NAN])];
    for (name, colour, mark, band, [within, beyond]) in cases {
        let bar = bar(name);
        let (from, to, row) = (bar.left() + 5.0, bar.right() - 5.0, bar.center().y as usize);
        let x = |share: f32| from + share * (to - from);
        let columns = bar.left() as usize..bar.right() as usize + 1;
        let of_mark: Vec<f32> =
            columns.filter(|column| like(seen.at(*column, row), colour, 40)).map(|column| column as f32 + 0.5).collect();
        assert!(!of_mark.is_empty(), "{name}: no mark of its colour in {bar:?}");
        let middle = of_mark.iter().sum::<f32>() / of_mark.len() as f32;
        assert!((middle - x(mark)).abs() < 1.5 && of_mark.len() <= 5, "{name}: mark at {middle}, expected at {}", x(mark));
        let (line, well) = ([0x2b, 0x32, 0x3b], [0x17, 0x1b, 0x21]);
        let pixel = |share: f32| *seen.at(x(share) as usize, row);
        assert!(like(&pixel(within), line, 8), "{name}: {:?} within the band", pixel(within));
        if beyond.is_finite() {
            assert!(like(&pixel(beyond), well, 8), "{name}: {:?} beyond the band {band:?}", pixel(beyond));
        }
    }
}
