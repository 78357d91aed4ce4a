//! The window's panes, driven without a display: what can be read in them.
#![cfg(feature = "viewer")]

use std::cell::RefCell;
use std::collections::BTreeMap;
use std::rc::Rc;
use std::sync::Arc;

use eframe::egui::{Event, Key, Role, Vec2};
use egui_kittest::Harness;
use egui_kittest::kittest::NodeT;
use sidecarm::session::board::{BoardState, Link, Phase};
use sidecarm::session::edit::{BeadEdit, EditRequest};
use sidecarm::telemetry::{DeviceKind, Health, RobotSample, Sample, Tendon};
use sidecarm::timeline::{ClockEstimate, NO_EXPOSURE};
use sidecarm::viewer::{Arrangement, Mark, Overlay, ViewState, draw};

use crate::viewer_boards::{NOW_US, accepted, amber, board, line, refused};

/// A window of the size that it opens with, and what it remembers.
pub fn window(board: BoardState) -> (Harness<'static>, Rc<RefCell<ViewState>>) {
    let state = Rc::new(RefCell::new(ViewState::default()));
    let shared = Rc::clone(&state);
    let show = move |ui: &mut eframe::egui::Ui| draw(ui, &board, &mut shared.borrow_mut());
    let mut harness = Harness::builder().with_size(Vec2::new(1400.0, 900.0)).build_ui(show);
    harness.run_steps(3);
    (harness, state)
}

/// What each part of the window says, once: lines into which a text is broken repeat it.
pub fn said(harness: &Harness) -> String {
    let is_line = |node: &egui_kittest::Node| node.accesskit_node().role() == Role::TextRun;
    let words = |node: egui_kittest::Node| {
        let node = node.accesskit_node();
        node.label().or_else(|| node.value())
    };
    let found: Vec<String> = harness.root().children_recursive().filter(|node| !is_line(node)).filter_map(words).collect();
    found.join("\n")
}

/// All that a window with this board says.
pub fn texts(board: BoardState) -> String {
    said(&window(board).0)
}

#[test]
fn a_silent_line_looks_stale_and_a_live_one_does_not() {
    let with = |link: Link| texts(BoardState { links: vec![link], now_us: NOW_US, ..BoardState::default() });
    let live = with(line(100_000));
    assert!(
        live.contains("C-arm live") && live.contains("50 Hz") && live.contains("orbital") && live.contains("28.6°"),
        "{live}"
    );
    let stale = with(line(2_000_000));
    assert!(stale.contains("STALE 2 s") && !stale.contains("live") && !stale.contains("50 Hz"), "{stale}");
    assert!(with(Link { open: false, ..line(100_000) }).contains("unplugged"));
    assert!(with(Link { last_sample_us: None, ..line(0) }).contains("silent"));
}

/// Two ports that were swapped had "none lost": of the counters four were told.
#[test]
fn a_line_tells_what_went_wrong_how_its_clock_runs_and_its_joints_with_units() {
    let with = |link: Link| texts(BoardState { links: vec![link], now_us: NOW_US, ..BoardState::default() });
    let health = Health { frames: 900, lost: 3, wrong_device: 2, ..Health::default() };
    let clock = ClockEstimate { offset_us: 0.0, drift_ppm: -34.5, drift_sigma_ppm: 4.75, uncertainty_us: 1_010.0, points: 900 };
    let carm = with(Link { health, clock: Some(clock), clock_steps: 2, ..line(20_000) });
    let quiet = with(line(20_000));
    for words in ["900 samples, 3 lost, 2 of the other device", "clock −34.5 ± 4.8 ppm, ± 1.01 ms, 2 steps"] {
        assert!(carm.contains(words) && !quiet.contains(words), "{words}: {carm}");
    }
    assert!(quiet.contains("0 samples, none lost"), "{quiet}");
    for words in ["1020.0 mm", "90.0 kV", "28.6°", "beam off, exposure 3"] {
        assert!(carm.contains(words), "{words}: {carm}");
    }
    let slack = || Tendon { position_mm: 0.0, velocity_mm_per_s: 0.0, tension_n: 2.0, current_a: 0.1 };
    let robot = RobotSample {
        device_us: 1,
        sequence: 1,
        commanded_deg: [1.0, 2.0, 3.0, 4.0, -5.5],
        sensed_deg: None,
        tendons: [slack(), slack()],
        tracker_from_base: None,
        drill_rpm: 120.0,
        status: 0,
    };
    let robot = with(Link { device: DeviceKind::Robot, latest: Some(Sample::Robot(robot)), ..line(20_000) });
    for words in ["robot live", "bend 5", "−5.5°", "120 rpm", "angles commanded, not sensed"] {
        assert!(robot.contains(words), "{words}: {robot}");
    }
}

/// What must be read across the room is written large, a long word no smaller than a short one.
#[test]
fn the_state_is_written_large() {
    for (pair, words, lines) in [(accepted(1), "ACCEPTED", 1.0), (refused(1), "REFUSED", 1.0), (amber(1), "IMAGE DISAGREES", 2.0)]
    {
        let (harness, _) = window(board(vec![pair]));
        let is_it = |node: &egui_kittest::Node| {
            let node = node.accesskit_node();
            node.label().or_else(|| node.value()).as_deref() == Some(words)
        };
        let height = harness.root().children_recursive().find(is_it).expect("the state").rect().height();
        assert!(height >= 50.0 * lines, "{words}: {height} points high");
    }
}

#[test]
fn an_accepted_pair_says_so_with_its_residuals_its_scores_and_its_latency() {
    let seen = texts(board(vec![accepted(1), accepted(7)]));
    for words in [
        "ACCEPTED",
        "frame 7",
        "0.21 px = 0.050 mm",
        "acetabulum",
        "0.05 mm",
        "1.2 mm",
        "better than all wrong poses",
        "latency 0.8 s",
        "backlog 0",
        "matched DRR",
        "exposure 2 of 2",
        "Live",
    ] {
        assert!(seen.contains(words), "{words}: {seen}");
    }
    assert!(!seen.contains("REFUSED") && !seen.contains("DISAGREES"), "{seen}");
}

#[test]
fn a_refused_pair_shows_its_reason_and_what_to_do_and_no_drr() {
    let seen = texts(board(vec![accepted(1), refused(7)]));
    for words in
        ["REFUSED", "2 bead-like shadows in the frame", "bring more beads", "matched DRR: no matched DRR", "nothing was compared"]
    {
        assert!(seen.contains(words), "{words}: {seen}");
    }
    assert!(!seen.contains("ACCEPTED") && seen.contains("not known"), "{seen}");
    // What scripts go by, and what is for a command line, is not for a window; what to do is said once.
    for words in ["too_few_shadows", "--bead-radius", "open the collimator"] {
        assert!(!seen.contains(words), "{words}: {seen}");
    }
    let mut untold = refused(7);
    untold.remedy = None;
    assert!(texts(board(vec![untold])).contains("open the collimator"), "the control: nobody else says what to do");
}

#[test]
fn a_doubted_pair_is_amber_and_says_what_doubts_it() {
    let seen = texts(board(vec![amber(3)]));
    for words in ["IMAGE DISAGREES", "accepted but", "3 of 4 scores prefer", "expose once more"] {
        assert!(seen.contains(words), "{words}: {seen}");
    }
}

/// Backlog, log and failure were published and never drawn.
#[test]
fn a_backlog_a_slow_log_and_a_failed_one_are_said() {
    let quiet = texts(board(vec![accepted(1)]));
    assert!(!quiet.contains("NOT RECORDING") && quiet.contains("log 0 ms behind"), "{quiet}");
    let failure = Some("session.mcap: no space left on device".to_owned());
    let seen = texts(BoardState {
        frames_waiting: 5,
        recorder_behind_ms: 2_400.0,
        recorder_failure: failure,
        ..board(vec![accepted(1)])
    });
    for words in
        ["NOT RECORDING", "no space left on device", "backlog 5", "log 2400 ms behind", "5 newer frames are being developed"]
    {
        assert!(seen.contains(words), "{words}: {seen}");
    }
}

/// What hangs is published in sentences, one for each part that does.
#[test]
fn parts_that_take_long_are_said_each_in_a_sentence() {
    let slow = [
        "the frame folder does not answer (4 s so far): is its server or disk there? telemetry is recorded all the same",
        "frame 7: making its DRR takes long (13 s so far); recording and registration go on",
    ];
    let quiet = texts(board(vec![accepted(1)]));
    let seen = texts(BoardState { slow: slow.map(str::to_owned).to_vec(), ..board(vec![accepted(1)]) });
    for words in slow {
        assert!(seen.contains(words) && !quiet.contains(words), "{words}: {seen}");
    }
}

/// A robot that is drawn as in the scene file is not to be taken for one that telemetry tells of.
#[test]
fn a_robot_that_no_telemetry_tells_of_is_said_beside_the_pose() {
    let with = |source: &str, binding: &str, evidence: &str| {
        let mut view = accepted(3);
        let pair = Arc::make_mut(&mut view.pair);
        (pair.robot_source, pair.binding) = (Some(source.to_owned()), binding.to_owned());
        pair.binding_evidence = vec![evidence.to_owned()];
        texts(board(vec![view]))
    };
    let (uncovered, unbound) = (": no telemetry covers the exposure", ": the frame is bound to no exposure");
    let mut cases = 0;
    for (binding, evidence, words) in
        [("counter", "exposure 3", uncovered), ("none", NO_EXPOSURE, uncovered), ("none", "two exposures fit", unbound)]
    {
        let seen = with("scene", binding, evidence);
        assert!(seen.contains(&format!("robot drawn as in the scene file{words}")), "{binding}, {evidence}: {seen}");
        cases += 1;
    }
    assert_eq!(cases, 3);
    let told = with("sensed", "counter", "exposure 3");
    assert!(!told.contains("robot drawn"), "control: {told}");
}

#[test]
fn a_replay_says_that_it_is_one_and_no_latency() {
    let mut pair = accepted(2);
    pair.latency_ms = None;
    let seen = texts(BoardState { replayed: true, ..board(vec![pair.clone()]) });
    assert!(seen.contains("Replay") && seen.contains("developed in 0.4 s") && !seen.contains("log 0 ms behind"), "{seen}");
    let ended = texts(BoardState { replayed: true, finished: true, ..board(vec![pair]) });
    assert!(ended.contains("Replay ended"), "{ended}");
}

/// Everything has a key: exposures are stepped through by their frames' numbers, and the newest one is followed again.
#[test]
fn keys_step_through_exposures_and_choose_what_is_shown() {
    let (mut harness, state) = window(board(vec![accepted(1), refused(4), accepted(9)]));
    let mut press = |key: Key| {
        harness.key_press(key);
        harness.run_steps(2);
        said(&harness)
    };
    assert!(press(Key::ArrowLeft).contains("frame 4, 2 of 3"));
    assert_eq!(state.borrow().selected, Some(4));
    assert!(press(Key::Home).contains("frame 1, 1 of 3"));
    assert!(press(Key::End).contains("frame 9, 3 of 3"));
    assert_eq!(state.borrow().selected, None, "the newest one is followed");
    assert!(press(Key::C).contains("acquired and DRR in squares"));
    assert!(press(Key::Plus).contains("2×"));
    assert!(press(Key::Num2).contains("matched DRR"));
    assert_eq!((state.borrow().arrangement, state.borrow().overlay), (Arrangement::Two, Overlay::Checkerboard));
    press(Key::M);
    press(Key::Z);
    assert!(state.borrow().draws(Mark::Masks) && state.borrow().sight.zoom > 1.2);
    let keys = press(Key::F1);
    assert!(keys.contains("the exposure before") && keys.contains("more contrast"), "{keys}");
    assert!(!press(Key::Escape).contains("the exposure before"));
}

/// A replay listed the keys of edits and notes, which did nothing there.
#[test]
fn only_keys_that_do_something_are_listed() {
    for editable in [true, false] {
        let (mut harness, _) = window(BoardState { editable, ..board(vec![accepted(1)]) });
        harness.key_press(Key::F1);
        harness.run_steps(2);
        let seen = said(&harness);
        assert!(seen.contains("the exposure before"), "{seen}");
        for words in ["write a note about this exposure", "edit the beads of this exposure, or stop", "stop editing"] {
            assert_eq!(seen.contains(words), editable, "{words}: {seen}");
        }
    }
}

/// A replay at the pace of its session stood at "No frame yet" for minutes, and nobody saw that it went on.
#[test]
fn a_replay_without_a_frame_yet_shows_how_far_it_is() {
    for replayed in [true, false] {
        let seen = texts(BoardState { replayed, ..board(Vec::new()) });
        assert_eq!(seen.contains("replayed up to "), replayed, "{seen}");
        assert_eq!(seen.contains("No frame yet"), !replayed, "{seen}");
    }
}

/// Space plays from the first exposure at the pace at which they came, and stops at the last.
#[test]
fn play_steps_at_the_recorded_pace() {
    let (mut harness, state) = window(board(vec![accepted(1), accepted(2), accepted(3)]));
    harness.key_press(Key::Space);
    harness.run_steps(1);
    assert!(state.borrow().player.is_playing());
    assert_eq!(state.borrow().selected, Some(1));
    // A step of the harness is a quarter of a second, exposures are one second apart.
    harness.run_steps(5);
    assert_eq!(state.borrow().selected, Some(2));
    harness.run_steps(5);
    assert_eq!((state.borrow().selected, state.borrow().player.is_playing()), (None, false));
}

/// Each frame in work says what it waits for; the beam is told on only while the line lives.
#[test]
fn how_far_frames_have_come_and_that_the_beam_is_on_is_told() {
    let phases = BTreeMap::from([(2, Phase::Null), (3, Phase::Registering), (4, Phase::Binding)]);
    let words =
        ["frame 4 waits for the telemetry of its exposure", "frame 3 is being registered", "frame 2 is put against other poses"];
    let idle = texts(board(vec![accepted(1), accepted(2)]));
    let seen = texts(BoardState { phases, frames_waiting: 2, ..board(vec![accepted(1), accepted(2)]) });
    for words in words {
        assert!(seen.contains(words) && !idle.contains(words), "{words}: {seen}");
    }
    let with = |xray_on: bool, age_us: i64| {
        let mut link = line(age_us);
        let Some(Sample::Carm(carm)) = &mut link.latest else { panic!("a sample of the C-arm") };
        carm.xray_on = xray_on;
        texts(BoardState { links: vec![link], ..board(vec![accepted(1)]) }).contains("X-RAY ON")
    };
    assert!(with(true, 20_000));
    assert!(!with(false, 20_000) && !with(true, 2_000_000), "the beam is off, or nobody knows");
}

/// While a note is written, keys are its letters; Enter asks the session to keep it, Escape does not.
#[test]
fn a_note_is_written_in_a_line_of_the_window() {
    let written = |editable: bool, last: Key| {
        let (mut harness, state) = window(BoardState { editable, ..board(vec![accepted(1), accepted(7)]) });
        harness.key_press(Key::T);
        harness.run_steps(4);
        let opened = said(&harness).contains("note on frame 7");
        harness.event(Event::Text("table high".to_owned()));
        if opened {
            // A letter; it chooses no overlay.
            harness.key_press(Key::B);
        }
        harness.run_steps(2);
        harness.key_press(last);
        harness.run_steps(4);
        assert_eq!(state.borrow().overlay, Overlay::Edges);
        assert!(!said(&harness).contains("note on frame 7"), "it is closed");
        harness.key_press(Key::B);
        harness.run_steps(2);
        assert_eq!(state.borrow().overlay, Overlay::Blink, "the control");
        let asked = state.borrow_mut().editing.take_asked();
        (opened, asked)
    };
    let note = EditRequest { number: 7, edit: BeadEdit::Note { words: "table high".to_owned() } };
    assert_eq!(written(true, Key::Enter), (true, vec![note]));
    assert_eq!(written(true, Key::Escape), (true, Vec::new()));
    assert_eq!(written(false, Key::Enter), (false, Vec::new()), "a replay takes none");
}

#[test]
fn a_note_is_shown_with_its_exposure_alone() {
    let with = |number: u32| {
        let notes = BTreeMap::from([(number, "table high".to_owned())]);
        texts(BoardState { notes, replayed: true, ..board(vec![accepted(1), accepted(7)]) })
    };
    assert!(with(7).contains("note: table high"), "{}", with(7));
    assert!(!with(1).contains("table high"), "the newest exposure is shown");
}

/// A pair that was posed again stands in the place of the one before: its own words, and its own pictures (see `viewer_drawn`).
#[test]
fn a_pair_posed_again_says_so() {
    let mut again = accepted(7);
    again.development = 1;
    let mut state = board(vec![refused(7)]);
    state.show(again);
    assert_eq!(state.pairs.len(), 1);
    let seen = texts(state);
    assert!(seen.contains("posed again") && seen.contains("ACCEPTED"), "{seen}");
}
