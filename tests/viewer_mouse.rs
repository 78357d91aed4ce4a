//! The window under a mouse: one zoom and one range of gray values for all pictures, and the exposures to scrub through.
#![cfg(feature = "viewer")]

use eframe::egui::{Event, Modifiers, MouseWheelSource, MouseWheelUnit, PointerButton, Pos2, Rect, TouchPhase, Vec2};
use egui_kittest::Harness;
use egui_kittest::kittest::NodeT;

use crate::viewer_boards::{accepted, board, refused};
use crate::viewer_window::{said, window};

/// Where a node of this label lies.
fn place(harness: &Harness, label: &str) -> Rect {
    let is_it = |node: &egui_kittest::Node| node.accesskit_node().label().as_deref() == Some(label);
    harness.root().children_recursive().find(is_it).unwrap_or_else(|| panic!("no {label}")).rect()
}

fn press(harness: &mut Harness, pos: Pos2, button: PointerButton, pressed: bool) {
    harness.event(Event::PointerButton { pos, button, pressed, modifiers: Modifiers::NONE });
    harness.run_steps(2);
}

fn move_to(harness: &mut Harness, at: Pos2) {
    harness.hover_at(at);
    harness.run_steps(2);
}

#[test]
fn the_mouse_zooms_moves_and_sets_gray_values() {
    let pair = accepted(1);
    let [low, high] = pair.pictures.window;
    let (mut harness, state) = window(board(vec![pair]));
    let middle = place(&harness, "matched DRR").center();
    move_to(&mut harness, middle);
    let wheel = Event::MouseWheel {
        unit: MouseWheelUnit::Point,
        delta: Vec2::new(0.0, 120.0),
        phase: TouchPhase::Move,
        source: MouseWheelSource::Wheel,
        modifiers: Modifiers::NONE,
    };
    harness.event(wheel);
    harness.run_steps(8);
    let sight = state.borrow().sight;
    assert!(sight.zoom > 1.3 && said(&harness).contains(&format!("zoom {:.1}×", sight.zoom)), "{sight:?}");
    // The right button: up is brighter values higher up, sideways is contrast.
    press(&mut harness, middle, PointerButton::Secondary, true);
    move_to(&mut harness, middle + Vec2::new(60.0, -90.0));
    press(&mut harness, middle + Vec2::new(60.0, -90.0), PointerButton::Secondary, false);
    let [from, to] = state.borrow().window.expect("chosen by hand");
    assert!(from + to > low + high && to - from > high - low, "{low} {high}: {from} {to}");
    assert_eq!(state.borrow().sight, sight, "the right button moves nothing");
    // The left one moves what is seen, in all pictures.
    move_to(&mut harness, middle);
    press(&mut harness, middle, PointerButton::Primary, true);
    move_to(&mut harness, middle + Vec2::new(40.0, 0.0));
    press(&mut harness, middle + Vec2::new(40.0, 0.0), PointerButton::Primary, false);
    assert!(state.borrow().sight.centre[0] < sight.centre[0] - 0.01, "{:?} after {sight:?}", state.borrow().sight);
    assert_eq!(state.borrow().window, Some([from, to]));
}

#[test]
fn the_exposures_are_scrubbed_through_by_dragging_along_them() {
    let (mut harness, state) = window(board(vec![accepted(1), refused(4), accepted(9)]));
    assert_eq!(state.borrow().selected, None, "the newest is followed");
    let strip = place(&harness, "exposure 3 of 3");
    // Of the half minute that the strip shows, three and eight seconds after the first; tiles are up to 46 points wide.
    let seconds = [0.0, 3.0, 8.0, 29.0];
    let tile = |n: usize| Pos2::new(strip.left() + seconds[n] / 30.0 * (strip.width() - 46.0) + 20.0, strip.top() + 10.0);
    move_to(&mut harness, tile(0));
    press(&mut harness, tile(0), PointerButton::Primary, true);
    // Less than some points is no drag yet.
    move_to(&mut harness, tile(0) + Vec2::new(12.0, 0.0));
    assert_eq!(state.borrow().selected, Some(1));
    move_to(&mut harness, tile(1));
    assert_eq!(state.borrow().selected, Some(4));
    assert!(said(&harness).contains("REFUSED"), "what is scrubbed to is shown");
    // Beyond the last it is the last, which is followed.
    move_to(&mut harness, tile(3));
    assert_eq!(state.borrow().selected, None);
    press(&mut harness, tile(3), PointerButton::Primary, false);
    move_to(&mut harness, tile(0));
    assert_eq!(state.borrow().selected, None, "control: nothing is chosen without a button");
}
