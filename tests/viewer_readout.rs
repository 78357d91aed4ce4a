//! What the window tells of the pixel under the cursor.
#![cfg(feature = "viewer")]

use std::cell::RefCell;
use std::rc::Rc;
use std::sync::Arc;

use eframe::egui::{Pos2, Rect, Vec2};
use egui_kittest::Harness;
use egui_kittest::kittest::NodeT;
use sidecarm::image::Image;
use sidecarm::mask::{Cause, Masks};
use sidecarm::report::short;
use sidecarm::session::board::{BoardState, PairPictures, PairView, PictureMemory};
use sidecarm::viewer::{ViewState, draw};

use crate::compare_synthetic::{acquired, line_integral, view};
use crate::viewer_boards::{accepted, board, refused};

/// A window that shows one exposure of 310 × 240 px.
struct Window {
    harness: Harness<'static>,
}

impl Window {
    fn open(pair: PairView) -> Self {
        Self::of(board(vec![pair]), None)
    }

    fn of(board: BoardState, selected: Option<u32>) -> Self {
        let state = Rc::new(RefCell::new(ViewState::default()));
        state.borrow_mut().selected = selected;
        let show = move |ui: &mut eframe::egui::Ui| draw(ui, &board, &mut state.borrow_mut());
        let mut harness = Harness::builder().with_size(Vec2::new(1400.0, 900.0)).build_ui(show);
        harness.run_steps(3);
        Self { harness }
    }

    fn said(&self) -> String {
        let words = |node: egui_kittest::Node| {
            let node = node.accesskit_node();
            node.label().or_else(|| node.value())
        };
        self.harness.root().children_recursive().filter_map(words).collect::<Vec<_>>().join("\n")
    }

    /// What is said with the cursor over the middle of a pixel, in the pane of this name.
    fn over(&mut self, pane: &str, column: u16, row: u16) -> String {
        let is_it = |node: &egui_kittest::Node| node.accesskit_node().label().as_deref() == Some(pane);
        let pane: Rect = self.harness.root().children_recursive().find(is_it).expect("the pane").rect();
        let scale = (pane.width() / 310.0).min(pane.height() / 240.0);
        let off = Vec2::new(f32::from(column) + 0.5 - 155.0, f32::from(row) + 0.5 - 120.0);
        self.at(pane.center() + scale * off)
    }

    fn at(&mut self, at: Pos2) -> String {
        self.harness.hover_at(at);
        self.harness.run_steps(3);
        self.said()
    }
}

#[test]
fn the_pixel_under_the_cursor_is_told_in_places_millimetres_and_values() {
    let pair = accepted(1);
    let pictures = Arc::clone(&pair.pictures);
    let mut window = Window::open(pair);
    assert!(!window.said().contains("column ") && window.said().contains("gray from"), "no cursor, no pixel");
    let value = |image: &Image<f32>, column: u16, row: u16| f64::from(*image.at(column.into(), row.into()));
    let mut told = Vec::new();
    // 0.2 mm a pixel, the middle of the frame at (154.5, 119.5); the same in whichever pane the cursor is.
    for (pane, column, row, mm) in [
        ("acquired", 100, 180, "−10.9, 12.1 mm from the middle"),
        ("matched DRR", 100, 180, "−10.9, 12.1 mm from the middle"),
        ("acquired", 200, 60, "9.1, −11.9 mm from the middle"),
    ] {
        let seen = window.over(pane, column, row);
        let frame = value(pictures.acquired(), column, row);
        let drr = value(pictures.simulated().expect("a DRR"), column, row);
        let [frame, drr, difference] = [frame, drr, frame - drr].map(|value| short(value, 1.0));
        let line = [
            format!("column {column}, row {row}"),
            mm.to_owned(),
            format!("acquired {frame}"),
            format!("DRR {drr}"),
            format!("difference {difference}"),
            "nepers".to_owned(),
        ];
        assert!(seen.contains(&line.join("  ·  ")), "{line:?}: {seen}");
        told.push(frame);
    }
    assert!(told[0] != told[2] && told[0] != "0", "control: the two places differ: {told:?}");
    // Outside the pictures nothing lies under it.
    assert!(!window.at(Pos2::new(20.0, 600.0)).contains("column "));
}

#[test]
fn a_masked_pixel_says_so_and_a_frame_alone_has_no_drr() {
    let frame = acquired(&line_integral(&view()), 0.02);
    let mut masks = Masks::default();
    masks.add(Cause::Extra, Image { width: 310, height: 240, pixels: (0..310 * 240).map(|at| at % 310 >= 155).collect() });
    let mut pair = refused(1);
    pair.pictures = Arc::new(PairPictures::alone(&frame, &masks));
    let mut window = Window::open(pair);
    let (left, right) = (window.over("acquired", 60, 200), window.over("acquired", 250, 200));
    let masked = "nepers  ·  masked";
    assert!(left.contains("column 60, row 200") && left.contains("  ·  nepers") && !left.contains(masked), "{left}");
    assert!(right.contains("column 250, row 200") && right.contains(masked), "{right}");
    assert!(!right.contains("  ·  DRR ") && !right.contains("  ·  difference "), "{right}");
}

/// The values of a small picture, each of which stands for a block of pixels, were told as those of the pixel under the cursor.
#[test]
fn a_small_picture_tells_no_values() {
    let mut state = BoardState { picture_memory: PictureMemory(0), ..board(Vec::new()) };
    [1, 2].into_iter().for_each(|number| drop(state.show(accepted(number))));
    assert_eq!([0, 1].map(|n: usize| state.pairs[n].pictures.is_small()), [true, false]);
    let small = Window::of(state.clone(), Some(1)).over("acquired: small picture: the log has it", 100, 180);
    assert!(small.contains("column 100, row 180") && small.contains("−10.9, 12.1 mm from the middle"), "{small}");
    assert!(small.contains("small picture, no values"), "{small}");
    for words in ["acquired 0", "acquired 1", "acquired 2", "  ·  DRR ", "  ·  difference ", "  ·  nepers"] {
        assert!(!small.contains(words), "{words}: {small}");
    }
    let whole = Window::of(state, Some(2)).over("acquired", 100, 180);
    assert!(whole.contains("  ·  DRR ") && !whole.contains("small picture"), "the control: {whole}");
}
