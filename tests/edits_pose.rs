//! Poses of frames whose beads a person has edited: what a hand may change, and what it may not.

use glam::{DVec2, DVec3};
use sidecarm::acquire::{Domain, Frame};
use sidecarm::beads::{BeadLayout, Detection};
use sidecarm::geometry::View;
use sidecarm::mask;
use sidecarm::pose::{HandMark, HandSays, Pose, Registration, look, register_edited, register_looked, register_shadows};
use sidecarm::time::Stopwatch;

use crate::pose_registration::{landmark_error_px, matching, reason, shadows};
use crate::pose_synthetic as synthetic;

fn put(bead: &str, image_px: DVec2) -> HandMark {
    HandMark { image_px, says: HandSays::Put(bead.to_owned()) }
}

fn named(bead: &str, image_px: DVec2) -> HandMark {
    HandMark { image_px, says: HandSays::Named(bead.to_owned()) }
}

/// Where P of `view` puts a bead.
fn place(view: &View, layout: &BeadLayout, bead: usize) -> DVec2 {
    view.projection().project(layout.beads[bead].lps_mm).0
}

fn edited(view: &View, layout: &BeadLayout, found: &[Detection], marks: &[HandMark]) -> Pose {
    let request = matching(view, layout);
    let automatic = register_shadows(&request, found);
    register_edited(&request, marks, &automatic, &|request: &Registration| register_shadows(request, found))
}

fn lab(seed: u64) -> (View, BeadLayout, Vec<Detection>) {
    let (view, layout) = (synthetic::view(1024, 1024, seed), synthetic::layout(8, 0.75, seed));
    let found = shadows(&view, &layout, 0.05, 0.02, seed);
    (view, layout, found)
}

/// Beads whose shadows are found, by their number.
fn seen(pose: &Pose) -> Vec<usize> {
    (0..pose.beads.len()).filter(|n| pose.beads[*n].used).collect()
}

#[test]
fn a_bead_that_a_hand_moves_a_little_changes_the_pose_and_is_said() {
    let mut cases = 0;
    for seed in 0..4 {
        let (view, layout, found) = lab(seed);
        let automatic = register_shadows(&matching(&view, &layout), &found);
        assert!(automatic.is_accepted() && automatic.edited.is_none(), "control: {:?}", automatic.reason);
        let bead = seen(&automatic)[0];
        let name = layout.beads[bead].name.clone();
        let pose = edited(&view, &layout, &found, &[put(&name, place(&view, &layout, bead) + DVec2::new(0.4, 0.2))]);
        assert!(pose.is_accepted() && pose.doubt.is_none(), "seed {seed}: {:?} {:?}", pose.reason, pose.cautions);
        assert_ne!(pose.projection, automatic.projection, "seed {seed}");
        let said = pose.edited.as_ref().expect("said");
        assert_eq!((said.placed.as_slice(), said.named.len(), &said.refused_before), ([name].as_slice(), 0, &None));
        assert!(landmark_error_px(&pose, &view) < 1.0);
        assert_eq!(pose.beads[bead].sigma_px, Some(1.0), "a hand is good to a pixel");
        cases += 1;
    }
    assert_eq!(cases, 4);
}

/// Whatever else fits: beads at wrong names or places give no pose; now and then so few beads are left that another reason comes first.
#[test]
fn names_and_places_that_the_other_beads_contradict_refuse_the_pose() {
    let (mut cases, mut by_hand) = (0, 0);
    for seed in 0..4 {
        let (view, layout, found) = lab(seed);
        let automatic = register_shadows(&matching(&view, &layout), &found);
        let [a, b, c, ..] = seen(&automatic)[..] else { panic!("seed {seed}: {:?}", automatic.reason) };
        let (at, name) = (|n| place(&view, &layout, n), |n: usize| layout.beads[n].name.as_str());
        let wrong = [
            vec![named(name(a), at(b)), named(name(b), at(a))],
            vec![named(name(a), at(b)), named(name(b), at(c)), named(name(c), at(a))],
            vec![put(name(a), at(a) + DVec2::new(40.0, -25.0))],
            vec![named(name(a), at(b))],
        ];
        for marks in wrong {
            let pose = edited(&view, &layout, &found, &marks);
            assert!(!pose.is_accepted(), "seed {seed}: {:?}", pose.cautions);
            by_hand += usize::from(reason(&pose).starts_with("by_hand: "));
            assert!(pose.edited.is_some(), "a refused pose says so as well");
            cases += 1;
        }
        let right = edited(&view, &layout, &found, &[named(name(a), at(a)), named(name(b), at(b))]);
        assert!(right.is_accepted() && right.doubt.is_none(), "control: {:?} {:?}", right.reason, right.cautions);
    }
    assert!(cases == 16 && by_hand >= 12, "{by_hand} of {cases}");
}

/// A hand adds what the frame does not show well enough: the pose is right, and never plainly accepted.
#[test]
fn a_frame_that_gave_no_pose_by_itself_gives_one_in_doubt_at_most() {
    let mut cases = 0;
    for seed in 0..6 {
        let (view, layout, mut found) = lab(seed);
        found.truncate(3);
        let automatic = register_shadows(&matching(&view, &layout), &found);
        assert!(!automatic.is_accepted(), "three shadows are too few");
        let shown = |n: &usize| {
            let at = place(&view, &layout, *n);
            at.min_element() > 10.0 && at.max_element() < 1013.0 && found.iter().all(|d| d.image_px.distance(at) > 20.0)
        };
        let free: Vec<usize> = (0..8).filter(shown).collect();
        let marks: Vec<HandMark> = free.iter().map(|n| put(&layout.beads[*n].name, place(&view, &layout, *n))).collect();
        if marks.len() < 4 {
            continue;
        }
        let pose = edited(&view, &layout, &found, &marks);
        assert!(pose.is_accepted(), "seed {seed}: {:?}", pose.reason);
        assert!(pose.doubt.is_some() && landmark_error_px(&pose, &view) < 2.0, "seed {seed}: {:?}", pose.cautions);
        assert!(pose.edited.is_some_and(|edited| edited.refused_before.is_some()), "why it gave none is kept");
        // Beads that are scattered at will are no evidence.
        let scattered: Vec<HandMark> = free
            .iter()
            .map(|n| put(&layout.beads[*n].name, DVec2::new(100.0 + 211.0 * (*n % 4) as f64, 130.0 + 340.0 * (*n / 4) as f64)))
            .collect();
        let wrong = edited(&view, &layout, &found, &scattered);
        assert!(!wrong.is_accepted(), "seed {seed}: accepted");
        cases += 1;
    }
    assert!(cases >= 3, "{cases}");
}

/// A cube looks the same from several sides: whoever names its corners says which one it is, and nothing confirms it.
#[test]
fn names_that_the_geometry_does_not_tell_leave_the_pose_in_doubt() {
    let side = |bit: usize, n: usize| if n >> bit & 1 == 1 { 40.0 } else { -40.0 };
    let places: Vec<DVec3> = (0..8).map(|n| DVec3::new(side(0, n), side(1, n), side(2, n))).collect();
    let (view, layout) = (synthetic::view(1024, 1024, 2), synthetic::layout_of(&places, 0.75));
    let found = shadows(&view, &layout, 0.02, 0.0, 2);
    let automatic = register_shadows(&matching(&view, &layout), &found);
    assert!(reason(&automatic).starts_with("ambiguous"), "{:?}", automatic.reason);
    let marks: Vec<HandMark> = (0..8).map(|n| named(&layout.beads[n].name, place(&view, &layout, n))).collect();
    let pose = edited(&view, &layout, &found, &marks);
    assert!(pose.is_accepted() && landmark_error_px(&pose, &view) < 1.0, "{:?}", pose.reason);
    let doubt = pose.doubt.as_deref().unwrap_or_default();
    assert!(pose.cautions.iter().any(|words| words.contains("rests on a hand")), "{doubt}: {:?}", pose.cautions);
}

/// What a hand drops is no bead's; the shadow stays among those that speak of accidents.
#[test]
fn a_shadow_that_is_dropped_carries_no_bead() {
    let (view, layout, found) = lab(1);
    let automatic = register_shadows(&matching(&view, &layout), &found);
    let bead = seen(&automatic)[2];
    let mark = HandMark { image_px: place(&view, &layout, bead), says: HandSays::NoBead };
    let pose = edited(&view, &layout, &found, &[mark]);
    assert!(pose.is_accepted(), "{:?}", pose.reason);
    assert!(!pose.beads[bead].used && seen(&pose).len() + 1 == seen(&automatic).len());
    assert_eq!(pose.detections, automatic.detections, "it still counts");
    assert_eq!(pose.edited.expect("said").dropped_px.len(), 1);
}

/// A hand that puts a bead where the picture shows none is told so, and solving again is quick: the frame is not looked at again.
#[test]
fn a_bead_put_where_nothing_is_seen_is_doubted_and_edits_are_quick() {
    let (view, layout) = (synthetic::view(620, 480, 3), synthetic::layout(8, 1.5, 3));
    let pixels = synthetic::radiograph(view, &layout, 20000.0, 3).draw();
    let frame = Frame::from_pixels("drawn", pixels, Domain::Linear).expect("finite");
    // The eighth bead is in the layout, and the picture shows it nowhere.
    let all = synthetic::layout(8, 1.5, 3);
    let request = matching(&view, &all);
    let watch = Stopwatch::start();
    let looked = look(&request, &frame, &mask::of_frame(&frame));
    let automatic = register_looked(&request, &frame, &looked);
    let whole_ms = watch.ms();
    assert!(automatic.is_accepted(), "control: {:?}", automatic.reason);
    let bead = seen(&automatic)[1];
    let watch = Stopwatch::start();
    let again = |request: &Registration| register_looked(request, &frame, &looked);
    let moved = register_edited(&request, &[put(&all.beads[bead].name, place(&view, &all, bead))], &automatic, &again);
    let edit_ms = watch.ms();
    println!("looked at and registered in {whole_ms:.0} ms, edited in {edit_ms:.0} ms");
    assert!(moved.is_accepted() && moved.doubt.is_none(), "{:?} {:?}", moved.reason, moved.cautions);
    assert!(edit_ms < whole_ms, "{edit_ms:.0} ms against {whole_ms:.0} ms");

    // The same frame, and a layout with one bead more that lies where the picture shows none.
    let mut more = all.clone();
    let empty = view.camera_from_lps.inverse().transform_point(view.intrinsics.unproject(DVec2::new(310.0, 470.0)) * 680.0);
    more.beads.push(sidecarm::beads::Bead { name: "ghost".to_owned(), lps_mm: empty, ..more.beads[0].clone() });
    let request = matching(&view, &more);
    let automatic = register_looked(&request, &frame, &looked);
    assert!(automatic.is_accepted(), "control: {:?}", automatic.reason);
    let pose = register_edited(&request, &[put("ghost", DVec2::new(310.0, 470.0))], &automatic, &again);
    let doubted = pose.cautions.iter().any(|words| words.contains("nothing like a bead is seen where a hand put ghost"));
    assert!(!pose.is_accepted() || doubted && pose.doubt.is_some(), "{:?} {:?}", pose.reason, pose.cautions);
}
