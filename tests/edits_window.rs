//! Beads edited in the window: what a click and a key ask of the session.
#![cfg(feature = "viewer")]

use std::cell::RefCell;
use std::rc::Rc;
use std::sync::Arc;

use eframe::egui::{Key, Modifiers, Pos2, Rect, Vec2};
use egui_kittest::Harness;
use egui_kittest::kittest::NodeT;
use glam::DVec2;
use sidecarm::pose::Edited;
use sidecarm::session::board::BoardState;
use sidecarm::session::edit::{BeadEdit, EditRequest};
use sidecarm::viewer::{Arrangement, ViewState, draw};

use crate::viewer_boards::{FOUND_PX, accepted, board};

struct Window {
    harness: Harness<'static>,
    state: Rc<RefCell<ViewState>>,
    size_px: [usize; 2],
}

impl Window {
    fn open(board: BoardState) -> Self {
        let size_px = board.pairs[0].pictures.size_px;
        let mut state = ViewState::default();
        state.arrangement = Arrangement::Two;
        let state = Rc::new(RefCell::new(state));
        let shared = Rc::clone(&state);
        let show = move |ui: &mut eframe::egui::Ui| draw(ui, &board, &mut shared.borrow_mut());
        let mut harness = Harness::builder().with_size(Vec2::new(1400.0, 900.0)).build_ui(show);
        harness.run_steps(3);
        Self { harness, state, size_px }
    }

    fn press(&mut self, with: Modifiers, key: Key) -> &mut Self {
        self.harness.key_press_modifiers(with, key);
        self.harness.run_steps(4);
        self
    }

    fn said(&self) -> String {
        let words = |node: egui_kittest::Node| {
            let node = node.accesskit_node();
            node.label().or_else(|| node.value())
        };
        self.harness.root().children_recursive().filter_map(words).collect::<Vec<_>>().join("\n")
    }

    /// Where the acquired picture shows a pixel of the frame.
    fn at(&self, [u, v]: [f64; 2]) -> Pos2 {
        let is_it = |node: &egui_kittest::Node| node.accesskit_node().label().as_deref() == Some("acquired");
        let pane: Rect = self.harness.root().children_recursive().find(is_it).expect("the acquired picture").rect();
        let [width, height] = self.size_px.map(|side| side as f32);
        let scale = (pane.width() / width).min(pane.height() / height);
        pane.center() + scale * Vec2::new(u as f32 + 0.5 - 0.5 * width, v as f32 + 0.5 - 0.5 * height)
    }

    fn hover(&mut self, px: [f64; 2]) {
        self.harness.hover_at(self.at(px));
        self.harness.run_steps(3);
    }

    fn click(&mut self, px: [f64; 2]) {
        self.hover(px);
        let at = self.at(px);
        self.harness.drag_at(at);
        self.harness.drop_at(at);
        self.harness.run_steps(4);
    }

    fn asked(&self) -> Vec<EditRequest> {
        self.state.borrow_mut().editing.take_asked()
    }

    fn one_asked(&self) -> EditRequest {
        let asked = self.asked();
        assert_eq!(asked.len(), 1, "{asked:?}");
        asked[0].clone()
    }
}

fn window() -> Window {
    Window::open(BoardState { editable: true, ..board(vec![accepted(1), accepted(7)]) })
}

fn near(edit: &EditRequest, px: [f64; 2], within_px: f64) -> bool {
    edit.edit.image_px().is_some_and(|at| at.distance(DVec2::from_array(px)) < within_px)
}

#[test]
fn a_click_and_a_key_ask_for_the_edit_that_they_mean() {
    let mut window = window();
    // Nothing is edited before it is said.
    window.click(FOUND_PX);
    assert!(window.press(Modifiers::NONE, Key::Delete).asked().is_empty());

    window.press(Modifiers::COMMAND, Key::E);
    assert!(window.state.borrow().editing.is_on() && window.said().contains("EDITING BEADS"), "{}", window.said());
    assert_eq!(window.state.borrow().selected, Some(7), "no newer exposure comes under the hand");
    window.click(FOUND_PX);
    assert!(window.said().contains("EDITING bead B1"), "{}", window.said());
    window.press(Modifiers::NONE, Key::Delete);
    let dropped = window.one_asked();
    assert!(
        dropped.number == 7 && matches!(dropped.edit, BeadEdit::Drop { .. }) && near(&dropped, FOUND_PX, 1e-6),
        "{dropped:?}"
    );

    // The shadow without a name gets the first that is free: P does not rest on B2.
    window.click([30.0, 30.0]);
    window.press(Modifiers::NONE, Key::Num1);
    let name = window.one_asked();
    assert_eq!(name.edit, BeadEdit::Name { bead: "B2".to_owned(), image_px: DVec2::new(30.0, 30.0) });

    window.press(Modifiers::COMMAND, Key::Z);
    assert_eq!(window.asked(), [EditRequest { number: 7, edit: BeadEdit::Undo }]);
    let zoom = window.state.borrow().sight.zoom;
    assert_eq!(zoom, 1.0, "Ctrl Z is not Z");

    window.hover([200.0, 40.0]);
    window.press(Modifiers::NONE, Key::A);
    let added = window.one_asked();
    assert!(added.edit.bead() == Some("B2") && near(&added, [200.0, 40.0], 1.0), "{added:?}");
    assert!(matches!(added.edit, BeadEdit::Put { .. }));

    window.press(Modifiers::NONE, Key::Escape);
    assert!(!window.state.borrow().editing.is_on() && window.state.borrow().selected.is_none(), "the newest is followed again");
    assert!(window.press(Modifiers::NONE, Key::A).asked().is_empty());
}

#[test]
fn a_bead_is_moved_by_dragging_and_by_arrows() {
    let mut window = window();
    window.press(Modifiers::COMMAND, Key::E);
    window.hover(FOUND_PX);
    let (from, to) = (window.at(FOUND_PX), [FOUND_PX[0] + 30.0, FOUND_PX[1] - 12.0]);
    window.harness.drag_at(from);
    window.harness.run_steps(2);
    for share in [0.3, 0.7, 1.0] {
        let at = [0, 1].map(|n| FOUND_PX[n] + share * (to[n] - FOUND_PX[n]));
        window.hover(at);
    }
    assert!(window.asked().is_empty(), "it is asked when it is let go");
    window.harness.drop_at(window.at(to));
    window.harness.run_steps(4);
    let moved = window.one_asked();
    assert!(moved.edit.bead() == Some("B1") && near(&moved, to, 1.0), "{moved:?}");
    let sight = window.state.borrow().sight;
    assert_eq!(sight, Default::default(), "the picture stays");

    // Keys alone: N chooses, arrows move, Enter puts.
    let mut window = self::window();
    window.press(Modifiers::COMMAND, Key::E).press(Modifiers::NONE, Key::N);
    window.press(Modifiers::NONE, Key::ArrowRight).press(Modifiers::NONE, Key::ArrowRight);
    window.press(Modifiers::SHIFT, Key::ArrowUp);
    assert!(window.asked().is_empty());
    window.press(Modifiers::NONE, Key::Enter);
    let moved = window.one_asked();
    assert!(moved.edit.bead() == Some("B1") && near(&moved, [FOUND_PX[0] + 2.0, FOUND_PX[1] - 0.1], 1e-6), "{moved:?}");
    assert!(window.press(Modifiers::NONE, Key::Enter).asked().is_empty(), "what was not moved is not put");
}

#[test]
fn nothing_is_edited_in_a_replay_and_its_keys_are_listed_in_a_session_alone() {
    let mut replay = Window::open(BoardState { replayed: true, ..board(vec![accepted(1)]) });
    replay.press(Modifiers::COMMAND, Key::E);
    assert!(!replay.state.borrow().editing.is_on() && !replay.said().contains("EDITING"));
    let of_replay = replay.press(Modifiers::NONE, Key::F1).said();
    let mut session = Window::open(BoardState { editable: true, ..board(vec![accepted(1)]) });
    let of_session = session.press(Modifiers::NONE, Key::F1).said();
    for words in ["Ctrl E", "edit the beads of this exposure", "Ctrl Z", "what is chosen is no bead"] {
        assert!(of_session.contains(words) && !of_replay.contains(words), "{words}: {of_session} {of_replay}");
    }
}

#[test]
fn an_edited_pair_says_so() {
    let mut edited = accepted(7);
    let marked = Edited { placed: vec!["B1".to_owned()], ..Edited::default() };
    Arc::make_mut(&mut edited.pair).edited = Some(marked);
    edited.development = 1;
    let seen = Window::open(board(vec![edited])).said();
    assert!(seen.contains("frame-007, edited by hand") && seen.contains("edited by hand: B1 placed"), "{seen}");
    assert!(!Window::open(board(vec![accepted(7)])).said().contains("by hand"), "control");
}
