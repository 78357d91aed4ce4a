//! Views of a round field that are solved together: what may have bent their pictures counts at places beyond the beads, as in each alone.

use glam::{DMat2, DVec2, DVec3};
use sidecarm::beads::{BeadLayout, Landmark};
use sidecarm::geometry::View;
use sidecarm::mask::Disc;
use sidecarm::pose::{Pose, SeveralViews, Together, ViewAlone, register_together};

use crate::pose_synthetic as synthetic;
use crate::pose_together::Lab;

const RADIUS_PX: f64 = 480.0;
/// What a view has said of itself alone.
const ALONE: &str =
    "the frame's field is round, as that of an image intensifier, and no distortion is stated: tip may be off by 99.0 px";

/// Ten beads in the middle half of the field.
fn layout(seed: u64) -> BeadLayout {
    let mut layout = synthetic::layout(10, 1.0, seed);
    for bead in &mut layout.beads {
        bead.lps_mm *= 0.58;
        bead.sigma_mm = Some(0.06);
    }
    layout
}

fn field(view: &View) -> Disc {
    let k = view.intrinsics;
    Disc { centre: DVec2::new(k.cx + 5.0, k.cy - 6.0), radius_px: RADIUS_PX }
}

/// Where a place of the straight picture is seen through a lens that shifts the field's edge by a share of its radius.
fn bent(at: DVec2, field: &Disc, share: f64) -> DVec2 {
    let off = at - field.centre;
    at + off * (share * off.length_squared() / field.radius_px.powi(2))
}

/// Three views through one such lens, each as it was alone.
fn alone(lab: &mut Lab, share: f64, is_round: bool) -> Vec<ViewAlone> {
    let k = lab.views[0].intrinsics;
    let mut views = lab.all(&k);
    for (alone, view) in views.iter_mut().zip(&lab.views) {
        let field = field(view);
        for at in alone.pose.beads.iter_mut().filter_map(|bead| bead.image_px.as_mut()) {
            *at = bent(DVec2::from_array(*at), &field, share).to_array();
        }
        alone.round_field = is_round.then_some(field);
    }
    views
}

fn together(lab: &Lab, views: &[ViewAlone], lps_mm: DVec3) -> Together {
    let landmarks = [Landmark { name: "tip".to_owned(), lps_mm }];
    register_together(&SeveralViews { layout: &lab.layout, intrinsics_prior: None, landmarks: &landmarks, views })
}

const AMONG: DVec3 = DVec3::new(4.0, -6.0, 5.0);
const BEYOND: DVec3 = DVec3::new(78.0, 20.0, -12.0);

/// Whether the 95 % region of a pose's landmark holds the place where it is seen.
fn is_held(pose: &Pose, view: &View, share: f64) -> bool {
    let own = &pose.landmarks[0];
    let off =
        bent(view.projection().project(own.lps_mm).0, &field(view), share) - DVec2::from_array(own.image_px.expect("in front"));
    let covariance = DMat2::from_cols_array_2d(&own.covariance_px2.expect("in front"));
    off.dot(covariance.inverse() * off) <= 5.99
}

/// A pincushion of two per cent put places beyond the beads 5 to 10 px from where the views together had them to half a pixel.
#[test]
fn regions_beyond_the_beads_hold_places_that_a_lens_has_shifted_in_all_views() {
    let (mut solved, mut with, mut without) = (0, 0, 0);
    for (seed, share) in [-0.02, -0.01, 0.01, 0.02, -0.02, -0.01, 0.01, 0.02].into_iter().enumerate() {
        let held = |is_round: bool| {
            let mut lab = Lab::new(3, layout(seed as u64), seed as u64);
            let views = alone(&mut lab, share, is_round);
            let found = together(&lab, &views, BEYOND);
            let held = found.views.iter().zip(&lab.views).filter(|(pose, view)| is_held(pose, view, share));
            found.is_accepted().then(|| held.count())
        };
        if let (Some(round), Some(any)) = (held(true), held(false)) {
            solved += 3;
            with += round;
            without += any;
        }
    }
    println!("{with} of {solved} in their regions, {without} without the lens");
    assert!(solved >= 15 && 10 * with >= 9 * solved, "{with} of {solved}");
    assert!(2 * without < solved, "the control: {without} of {solved}");
}

/// Of a round field a view's own words stood, of a region that nobody stated.
#[test]
fn what_a_lens_may_do_is_told_of_the_common_solution() {
    let mut cases = 0;
    for (lps_mm, is_round, is_doubted) in [(AMONG, true, false), (BEYOND, true, true), (BEYOND, false, false)] {
        let mut lab = Lab::new(3, layout(4), 4);
        let mut views = alone(&mut lab, 0.0, is_round);
        if is_round {
            views.iter_mut().for_each(|view| view.pose.doubt(ALONE.to_owned()));
        }
        let found = together(&lab, &views, lps_mm);
        assert!(found.is_accepted(), "{:?}", found.reason);
        for pose in &found.views {
            let words: Vec<&String> = pose.cautions.iter().filter(|words| words.contains("field is round")).collect();
            assert_eq!(words.len(), usize::from(is_doubted), "{words:?}");
            assert!(words.iter().all(|words| words.contains("tip may be off by") && !words.contains("99.0")), "{words:?}");
            assert_eq!(pose.doubt.is_some(), is_doubted, "{:?}", pose.doubt);
            let [u, v] = pose.landmarks[0].sigma_px.expect("in front");
            assert_eq!(u.hypot(v) > 1.0, is_doubted, "{u} {v} px");
        }
        assert_eq!(found.doubt.is_some(), is_doubted, "{:?}", found.doubt);
        cases += 1;
    }
    assert_eq!(cases, 3);
}
