//! The window's panes, driven without a display.
#![cfg(feature = "viewer")]

use std::sync::Arc;

use egui_kittest::Harness;
use egui_kittest::kittest::NodeT;
use sidecarm::image::Image;
use sidecarm::report::Standing;
use sidecarm::session::board::{BoardState, Link, PairView};
use sidecarm::telemetry::{DeviceKind, Health};
use sidecarm::viewer::{ViewState, draw};

fn board(last_byte_us: Option<i64>, open: bool) -> BoardState {
    let link = Link { device: DeviceKind::Carm, open, epoch: 1, health: Health::default(), last_byte_us, trouble: None };
    BoardState { links: vec![link], now_us: 10_000_000, ..BoardState::default() }
}

fn texts(board: &BoardState) -> String {
    let mut state = ViewState::default();
    let board = board.clone();
    let mut harness = Harness::new_ui(move |ui| draw(ui, &board, &mut state));
    harness.run_steps(3);
    let words = |node: egui_kittest::Node| {
        let node = node.accesskit_node();
        node.label().or_else(|| node.value())
    };
    let found: Vec<String> = harness.root().children_recursive().filter_map(words).collect();
    found.join("\n")
}

#[test]
fn a_silent_line_looks_stale_and_a_live_one_does_not() {
    assert!(texts(&board(Some(9_900_000), true)).contains("live"));
    let stale = texts(&board(Some(8_000_000), true));
    assert!(stale.contains("STALE 2.0 s") && !stale.contains("live"), "{stale}");
    assert!(texts(&board(Some(9_900_000), false)).contains("unplugged"));
    assert!(texts(&board(None, true)).contains("silent"));
}

#[test]
fn a_refused_pair_shows_its_reason_and_no_drr() {
    let pair = PairView {
        number: 7,
        name: "frame-007".to_owned(),
        time_us: 1,
        status: "refused: two beads found, four needed".to_owned(),
        standing: Standing::ImageDisagrees,
        acquired: Image::filled(8, 6, 100),
        drr: None,
        difference: None,
        scores: vec![("zncc".to_owned(), None)],
    };
    let seen = texts(&BoardState { pairs: vec![Arc::new(pair)], ..board(None, true) });
    assert!(seen.contains("refused: two beads found, four needed") && seen.contains("frame-007"), "{seen}");
    assert!(seen.contains("no pose: nothing to render") && seen.contains("not known"), "{seen}");
}
