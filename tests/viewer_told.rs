//! What the window tells of an exposure that is not the newest, of a session that has ended, and of one thing that is known from several sides.
#![cfg(feature = "viewer")]

use std::sync::Arc;

use sidecarm::geometry::CarmJoints;
use sidecarm::report::{Innovation, PairStatus};
use sidecarm::session::RobotState;
use sidecarm::session::board::{AtExposure, BoardState, Link, PairView, PictureMemory};
use sidecarm::telemetry::DeviceKind;

use crate::viewer_boards::{accepted, board, line};
use crate::viewer_window::{said, texts, window};

/// That telemetry and beads were 27.7 mm apart was told five times.
#[test]
fn how_far_telemetry_and_beads_are_apart_is_told_once() {
    let doubted = |status: PairStatus, reason: &str| {
        let mut view = accepted(3);
        let pair = Arc::make_mut(&mut view.pair);
        (pair.status, pair.reason) = (status, Some(reason.to_owned()));
        pair.innovation = Some(Innovation { shift_mm: [27.7, 0.0, 0.0], turn_deg: 0.5, sigmas: None });
        pair.flags = [
            "its beads put the specimen 27.7 mm and 0.5 degrees from where the session's world_from_lps and telemetry do: check it",
            "telemetry and beads are 27.7 mm and 0.5 degrees apart",
            "telemetry and beads: telemetry puts the specimen 27.7 mm across from where the beads are; check world_from_lps",
            "writing in the picture",
        ]
        .map(str::to_owned)
        .to_vec();
        texts(board(vec![view]))
    };
    let apart = "telemetry and beads are 27.7 mm and 0.5 degrees apart";
    let seen = doubted(PairStatus::AcceptedTelemetryDisagrees, apart);
    assert_eq!((seen.matches("27.7 mm").count(), seen.contains("writing in the picture")), (1, true), "{seen}");
    // Where something else is the reason, one caution tells it, and the row of telemetry.
    let seen = doubted(PairStatus::AcceptedInDoubt, "another reading fits as well");
    assert_eq!(seen.matches("27.7 mm").count(), 2, "{seen}");
}

#[test]
fn one_is_no_plural() {
    let seen = texts(board(vec![accepted(1)]));
    assert!(seen.contains("1 frame, 1 shown") && !seen.contains("1 frames"), "{seen}");
    assert!(texts(board(vec![accepted(1), accepted(2)])).contains("2 frames, 2 shown"));
}

/// A replay that had ended showed its lines as live for ever: its clock stands still.
#[test]
fn lines_of_a_session_that_has_ended_have_ended() {
    let ended = |replayed: bool| texts(BoardState { replayed, finished: true, ..board(vec![accepted(1)]) });
    for replayed in [true, false] {
        let seen = ended(replayed);
        assert!(seen.contains("C-arm ended") && !seen.contains("C-arm live") && !seen.contains("50 Hz"), "{seen}");
    }
    assert!(texts(BoardState { replayed: true, ..board(vec![accepted(1)]) }).contains("C-arm live"), "the control: it goes on");
}

/// Scrubbing showed the newest joints beside an exposure of which they were not.
#[test]
fn an_earlier_exposure_is_shown_with_what_the_devices_said_at_it() {
    let told = || {
        let mut view = accepted(1);
        let joints = CarmJoints { orbital_rad: 0.1, lift_mm: -0.04, ..CarmJoints::ZERO };
        let robot = RobotState {
            control_angles_deg: [1.5, 0.0, 0.0, 0.0, -2.5],
            lps_from_base: None,
            source: "commanded".to_owned(),
            gap_us: 0,
            cautions: Vec::new(),
        };
        view.devices = Arc::new(AtExposure { joints: Some(joints), beam: None, robot: Some(robot) });
        view
    };
    let robot_line = || Link { device: DeviceKind::Robot, latest: None, ..line(20_000) };
    let with = |pairs: Vec<PairView>, finished: bool, selected: Option<u32>| {
        let links = vec![line(20_000), robot_line()];
        let (mut harness, state) = window(BoardState { links, finished, ..board(pairs) });
        state.borrow_mut().selected = selected;
        harness.run_steps(3);
        said(&harness)
    };
    let now = with(vec![told(), accepted(2)], false, None);
    assert!(now.contains("28.6°") && !now.contains("at the exposure of frame"), "{now}");
    for seen in [with(vec![told(), accepted(2)], false, Some(1)), with(vec![told()], true, None)] {
        for words in ["at the exposure of frame 1", "5.7°", "0.0 mm", "1.5°", "−2.5°", "angles commanded"] {
            assert!(seen.contains(words), "{words}: {seen}");
        }
        assert!(!seen.contains("28.6°") && !seen.contains("−0.0 mm") && !seen.contains("−0.0°"), "{seen}");
    }
    let untold = with(vec![accepted(1), accepted(2)], false, Some(1));
    assert!(untold.contains("at the exposure of frame 1: no telemetry") && !untold.contains("28.6°"), "{untold}");
}

/// A picture of 155 pixels across was shown as if it were the frame.
#[test]
fn a_small_picture_says_that_it_is_one_and_where_the_whole_one_is() {
    let with = |away: bool, selected: u32| {
        let mut state = BoardState { picture_memory: PictureMemory(0), ..board(Vec::new()) };
        let left = [1, 2].map(|number| state.show(accepted(number)).len());
        assert_eq!(left, [0, 1], "the newest one stays");
        if away {
            state.away.insert(1);
        }
        let (mut harness, state) = window(state);
        state.borrow_mut().selected = Some(selected);
        harness.run_steps(3);
        said(&harness)
    };
    let (loading, lost, whole) = (with(true, 1), with(false, 1), with(true, 2));
    assert!(loading.contains("acquired: small picture: loading") && !loading.contains("the log has it"), "{loading}");
    assert!(lost.contains("matched DRR: small picture: the log has it") && !lost.contains("loading"), "{lost}");
    assert!(!whole.contains("small picture"), "{whole}");
}
