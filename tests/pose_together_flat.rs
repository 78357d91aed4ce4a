//! How loosely flat beads hold views that are solved together: as their errors show, and not as each view alone had it.

use glam::{DVec2, DVec3};
use sidecarm::beads::BeadLayout;
use sidecarm::geometry::Intrinsics;
use sidecarm::pose::{Pose, SeveralViews, Together, register_together};

use crate::pose_intrinsics::beads;
use crate::pose_synthetic as synthetic;
use crate::pose_together::Lab;

const DRAWS: u64 = 120;
/// What a view says of itself alone.
const ALONE: &str =
    "the beads hold the pose loosely: off their plane it is uncertain by 33.3 px (1 σ); bring more beads into view";
const ALONE_NOTE: &str = "the beads are nearly flat: off their plane the pose is uncertain by 1.7 px";

/// Eight beads within a millimetre of a plane, each known to half a millimetre.
fn plate() -> BeadLayout {
    let mut layout = synthetic::layout(8, 0.75, 7);
    for bead in &mut layout.beads {
        bead.lps_mm.z *= 0.01;
        bead.sigma_mm = Some(0.5);
    }
    layout
}

/// All views together, each having said of itself alone what [`ALONE`] and [`ALONE_NOTE`] say.
fn together(lab: &mut Lab, k: &Intrinsics) -> Together {
    let mut views = lab.all(k);
    for view in &mut views {
        view.pose.cautions.push(ALONE.to_owned());
        view.pose.notes.push(ALONE_NOTE.to_owned());
    }
    let together =
        register_together(&SeveralViews { layout: &lab.layout, intrinsics_prior: None, landmarks: &[], views: &views });
    assert!(together.is_accepted(), "{:?}", together.reason);
    together
}

/// σ off the plane as the pose says it, px.
fn said_px(pose: &Pose) -> Vec<f64> {
    let words = pose.cautions.iter().chain(&pose.notes).filter(|words| words.contains("off their plane"));
    let number = |words: &String| words.split("uncertain by ").nth(1)?.split(' ').next()?.parse::<f64>().ok();
    words.map(|words| number(words).unwrap_or_else(|| panic!("no number: {words}"))).collect()
}

/// A view alone knows its tilt against a plate several times worse than all views together: its own number stood for theirs.
#[test]
fn what_is_said_off_the_plane_of_flat_beads_is_what_their_errors_show() {
    let (drawn, layout) = (Lab::new(3, plate(), 0).views, plate());
    let k = drawn[0].intrinsics;
    let centroid = layout.centroid_lps_mm();
    let radius_mm = layout.beads.iter().map(|bead| bead.lps_mm.distance(centroid)).fold(0.0, f64::max);
    let feet = layout.beads.iter().map(|bead| bead.lps_mm).chain([centroid]);
    let above: Vec<DVec3> = feet.flat_map(|foot| [1.0, -1.0].map(|side| foot + DVec3::Z * (side * radius_mm))).collect();
    // Squares that are said, and of errors at each place: uu, uv, vv.
    let mut said = [0.0; 3];
    let mut errors = vec![[[0.0; 3]; 3]; above.len()];
    for seed in 0..DRAWS {
        let mut lab = Lab::new(3, plate(), seed);
        lab.views.clone_from(&drawn);
        for (view, pose) in together(&mut lab, &k).views.iter().enumerate() {
            let [sigma_px] = said_px(pose)[..] else { panic!("seed {seed}: {:?} {:?}", pose.cautions, pose.notes) };
            said[view] += sigma_px.powi(2) / DRAWS as f64;
            let (found, truth) = (pose.projection.expect("accepted"), drawn[view].projection());
            for (place, errors) in above.iter().zip(&mut errors) {
                let DVec2 { x, y } = found.project(*place).0 - truth.project(*place).0;
                let squares = [x * x, x * y, y * y].map(|square| square / DRAWS as f64);
                errors[view].iter_mut().zip(squares).for_each(|(sum, square)| *sum += square);
            }
        }
    }
    for (view, said) in said.into_iter().enumerate() {
        let largest = |[uu, uv, vv]: [f64; 3]| 0.5 * (uu + vv) + (0.5 * (uu - vv)).hypot(uv);
        let shown = errors.iter().map(|errors| largest(errors[view])).fold(0.0, f64::max);
        let ratio = (said / shown).sqrt();
        println!("view {view}: {:.2} px are said, {:.2} px shown", said.sqrt(), shown.sqrt());
        // σ of 120 draws is known to 6.5 %, and the worst of its places is picked.
        assert!((0.75..1.3).contains(&ratio), "view {view}: {:.2} px are said, {:.2} px shown", said.sqrt(), shown.sqrt());
    }
}

#[test]
fn beads_that_are_not_flat_together_take_back_what_a_view_said_alone() {
    let mut lab = Lab::new(3, beads(8, 3), 3);
    let k = lab.views[0].intrinsics;
    let together = together(&mut lab, &k);
    let all: Vec<f64> = together.views.iter().flat_map(said_px).collect();
    assert!(all.is_empty() && together.views.len() == 3, "{all:?}");
}

/// A view alone cannot tell a bead that is elsewhere from a poor fit, all views together can: its own remark stood beside residuals that they
/// explain.
#[test]
fn residuals_are_called_large_where_those_of_all_views_are() {
    const ALONE: &str = "residuals are 9.9 times what was expected; all uncertainties are scaled up by that";
    // Beads of known places: what is left is of the shadows.
    let mut layout = beads(8, 3);
    layout.beads.iter_mut().for_each(|bead| bead.sigma_mm = Some(0.001));
    let mut lab = Lab::new(3, layout, 3);
    let k = lab.views[0].intrinsics;
    let mut said = |stated_px: f64| -> Vec<Vec<String>> {
        let mut views = lab.all(&k);
        for view in &mut views {
            view.pose.notes.extend([ALONE.to_owned(), "another note".to_owned()]);
            view.pose.beads.iter_mut().for_each(|bead| bead.sigma_px = Some(stated_px));
        }
        let together =
            register_together(&SeveralViews { layout: &lab.layout, intrinsics_prior: None, landmarks: &[], views: &views });
        assert!(together.is_accepted() && together.views.len() == 3, "{stated_px}: {:?}", together.reason);
        together.views.into_iter().map(|pose| pose.notes).collect()
    };
    // Shadows have 0.05 px of noise.
    for notes in said(0.05) {
        assert!(notes.iter().all(|words| !words.contains("times what was expected")), "{notes:?}");
        assert!(notes.contains(&"another note".to_owned()), "{notes:?}");
    }
    for notes in said(0.027) {
        let of_residuals: Vec<&String> = notes.iter().filter(|words| words.contains("times what was expected")).collect();
        assert!(of_residuals.len() == 1 && of_residuals[0] != ALONE, "the control: {notes:?}");
    }
}
