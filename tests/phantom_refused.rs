//! Shots that no layout is to be believed of, and what is left out of those that are.

use glam::{DVec2, DVec3};
use rayon::prelude::*;
use sidecarm::calibrate::phantom::{Asked, Distance, PhantomRefusal, PhantomShot, ShotShadow, measure};
use sidecarm::random::{Purpose, Stream};

use crate::carm_arm::{V, add, turned};
use crate::phantom_lab::{Compared, Lab, RADIUS_MM, beads};

/// The phantom turned by 4° and shifted by a centimetre.
fn bumped(bead: V) -> V {
    add(turned(bead, 1, 4.0), [6.0, -5.0, 7.0])
}

#[test]
fn a_shot_before_which_the_phantom_was_moved_is_left_out_by_name() {
    for seed in 30..34 {
        let lab = Lab { shots: 7, ..Lab::new(seed) };
        let mut shots = lab.all();
        shots[2] = lab.shot(2, &bumped);
        let phantom = lab.measured(&shots).unwrap_or_else(|refusal| panic!("{seed}: {refusal}"));
        let named: Vec<&str> = phantom.left_out_shots.iter().map(|left| left.shot.as_str()).collect();
        assert_eq!(named, ["shot-02"], "{seed}");
        let compared = Compared::new(&phantom, &lab.beads);
        assert!(compared.shape_mm < 0.1 && phantom.shots.len() == 6, "{seed}: {compared:?}");
    }
}

#[test]
fn a_phantom_moved_half_way_is_refused() {
    for seed in 40..44 {
        let lab = Lab { shots: 8, ..Lab::new(seed) };
        let shots: Vec<PhantomShot> =
            (0..8).map(|n| if n < 4 { lab.shot(n, &|bead| bead) } else { lab.shot(n, &bumped) }).collect();
        match lab.measured(&shots) {
            Err(PhantomRefusal::Contradictory { named, shots: 8 }) => assert!(named.len() >= 3, "{seed}: {named:?}"),
            Err(refusal @ PhantomRefusal::NoMatch { .. }) => assert!(refusal.to_string().contains("lying still")),
            other => panic!("{seed}: {:?}", other.map(|phantom| phantom.left_out_shots)),
        }
    }
}

#[test]
fn a_shot_of_another_phantom_is_left_out_by_name() {
    for seed in 50..54 {
        let lab = Lab { shots: 6, ..Lab::new(seed) };
        let other = Lab { beads: beads(10, [160.0, 160.0, 120.0], 1000 + seed), ..lab.clone() };
        let mut shots = lab.all();
        shots[4] = other.shot(4, &|bead| bead);
        let phantom = lab.measured(&shots).unwrap_or_else(|refusal| panic!("{seed}: {refusal}"));
        assert!(phantom.left_out_shots.len() == 1 && phantom.left_out_shots[0].shot == "shot-04", "{:?}", phantom.left_out_shots);
        assert!(phantom.left_out_shots[0].reason.contains("another phantom"));
        assert!(Compared::new(&phantom, &lab.beads).shape_mm < 0.1, "{seed}");
    }
}

#[test]
fn mirrored_pictures_are_named() {
    for seed in 60..64 {
        let lab = Lab::new(seed);
        let mut shots = lab.all();
        let turn = |shadow: &mut ShotShadow| shadow.image_px.x = 1535.0 - shadow.image_px.x;
        shots.iter_mut().for_each(|shot| shot.shadows.iter_mut().for_each(turn));
        match lab.measured(&shots) {
            Err(PhantomRefusal::MirroredPictures { beads, shots }) => {
                assert!(beads >= 9 && shots == lab.shots, "{beads} {shots}")
            }
            other => panic!("{seed}: {:?}", other.map(|phantom| phantom.rms_px)),
        }
    }
}

#[test]
fn shots_from_one_side_and_clouds_without_depth_are_refused() {
    let alike = Lab { orbit_deg: 2.0, ..Lab::new(70) };
    let refused = alike.measured(&alike.all());
    assert!(matches!(refused, Err(PhantomRefusal::TooAlike { angle_deg, .. }) if angle_deg < 8.0), "{refused:?}");
    assert!(matches!(alike.measured(&alike.all()[..2]), Err(PhantomRefusal::TooFewShots { found: 2, .. })));
    // A centimetre of beads through a long lens: turned inside out they look the same, only the joints tell.
    let mut mirrored = 0;
    for seed in 70..78 {
        let small = Lab { beads: beads(10, [45.0, 45.0, 40.0], seed), noise_px: 2.0, orbit_deg: 20.0, ..Lab::new(seed) };
        match small.measured(&small.all()) {
            Err(PhantomRefusal::Mirrored { found, mirrored: image }) => {
                assert!(image <= 2.0 * found + 50.0);
                mirrored += 1;
            }
            Err(_) => {}
            Ok(phantom) => {
                let compared = Compared::new(&phantom, &small.beads);
                assert!(
                    compared.shape_mm < 4.0 * phantom.shape_sigma_mm.max(0.2),
                    "{seed}: {compared:?} {}",
                    phantom.shape_sigma_mm
                );
            }
        }
    }
    assert!(mirrored >= 2, "{mirrored}");
}

#[test]
fn shadows_at_random_and_too_few_beads_give_no_layout() {
    let accepted = |lab: Lab| lab.measured(&lab.all()).is_ok();
    let none = |seed: u64| Lab { beads: Vec::new(), false_shadows: 12, ..Lab::new(seed) };
    let four = |seed: u64| Lab { beads: beads(4, [100.0; 3], seed), ..Lab::new(seed) };
    let found: Vec<u64> = (80..100u64).into_par_iter().filter(|seed| accepted(none(*seed)) || accepted(four(*seed))).collect();
    assert!(found.is_empty(), "{found:?}");
    // Control: with ten beads among them the same shots are.
    assert!((80..84u64).into_par_iter().all(|seed| accepted(Lab { false_shadows: 12, ..Lab::new(seed) })));
}

#[test]
fn a_grid_is_measured_rightly_or_refused() {
    let of = |n: i32| 25.0 * f64::from(n - 1);
    let grid: Vec<V> = (0..27).map(|n| [of(n % 3), of(n / 3 % 3), of(n / 9)]).collect();
    let lab = |seed| Lab { beads: grid.clone(), sags: true, sigma: nominal_sigma(), ..Lab::new(seed) };
    // Of three the first that is measured.
    let off = (110..113).find_map(|seed| {
        let lab = lab(seed);
        let phantom = lab.measured(&lab.all()).ok()?;
        let own: Vec<DVec3> = phantom.beads.iter().map(|bead| DVec3::from_array(bead.mm)).collect();
        // Every bead of a grid has a neighbour at the grid's step, apart from the scale that a nominal arm tells.
        let near = |p: &DVec3| own.iter().map(|q| q.distance(*p)).filter(|d| *d > 1.0).fold(f64::INFINITY, f64::min);
        Some(own.iter().map(|p| (near(p) / 25.0 - 1.0).abs()).fold(0.0, f64::max))
    });
    assert!(off.is_some_and(|off| off < 0.06), "{off:?}");
}

/// What is assumed of an arm as drawn.
fn nominal_sigma() -> sidecarm::calibrate::phantom::ArmSigma {
    sidecarm::calibrate::phantom::ArmSigma::of(&crate::calibrate_carm::nominal())
}

#[test]
fn an_arm_that_sags_unknown_gives_the_shape_and_says_how_well_the_scale() {
    let lab = |seed| Lab { shots: 8, sags: true, sigma: nominal_sigma(), ..Lab::new(seed) };
    // Shape, mm; scale's error in its standard deviations; that standard deviation.
    let of = |seed: u64| {
        let lab = lab(seed);
        let phantom = lab.measured(&lab.all()).unwrap_or_else(|refusal| panic!("{seed}: {refusal}"));
        let compared = Compared::new(&phantom, &lab.beads);
        [compared.shape_mm, compared.larger_by / phantom.scale.sigma, phantom.scale.sigma]
    };
    let runs: Vec<[f64; 3]> = (120..132u64).into_par_iter().map(of).collect();
    assert_eq!(runs.len(), 12);
    assert!(runs.iter().all(|[shape_mm, times, sigma]| *shape_mm < 0.2 && times.abs() < 3.5 && *sigma < 0.05), "{runs:.3?}");
}

#[test]
fn a_shadow_that_is_off_is_rejected_and_named_strays_are_counted() {
    let lab = Lab { missing: 0.0, ..Lab::new(140) };
    let mut shots = lab.all();
    // Three pixels: inside the gate of matching, forty standard deviations of the shadow.
    let last = shots[1].shadows.len() - 1;
    shots[1].shadows[last].image_px += DVec2::new(0.7, -0.6);
    let phantom = lab.measured(&shots).expect("measured");
    let strays = phantom.shots[1].strays;
    assert_eq!(strays, lab.false_shadows + 1, "{:?}", phantom.shots);
    let clean = lab.measured(&lab.all()).expect("measured");
    assert_eq!(clean.shots[1].strays, lab.false_shadows);
    assert!(Compared::new(&phantom, &lab.beads).shape_mm < 0.05);
}

/// The end of a rod was made a bead, its shadows fifty times as far from one point as the others'.
#[test]
fn shadows_that_are_not_those_of_one_point_make_no_bead() {
    let lab = Lab { missing: 0.0, ..Lab::new(140) };
    let mut shots = lab.all();
    let mut wandering = 0;
    for (n, shot) in shots.iter_mut().enumerate().filter(|(_, shot)| shot.shadows.len() == lab.beads.len() + lab.false_shadows) {
        let rod = shot.shadows.last_mut().expect("shadows");
        // It says itself that it is not known well, so that no shadow of it is a stray.
        rod.image_px += 0.6 * DVec2::from_angle(2.4 * n as f64);
        rod.noise_px2 = [0.25, 0.0, 0.25];
        wandering += 1;
    }
    assert!(wandering >= 4, "{wandering} shots show it");
    let phantom = lab.measured(&shots).expect("measured");
    assert_eq!(phantom.beads.len(), lab.beads.len() - 1, "{:?}", phantom.beads);
    let reasons: Vec<&str> = phantom.left_out_beads.iter().map(|bead| bead.reason.as_str()).collect();
    assert!(reasons.iter().any(|reason| reason.contains("is it a ball")), "{reasons:?}");
    assert!(Compared::new(&phantom, &lab.beads).shape_mm < 0.05);
}

#[test]
fn a_distance_or_the_radii_tell_the_scale_and_contradictions_are_refused() {
    let mut vague = Lab::new(150);
    vague.sigma.each_deg = 1.0;
    vague.sigma.each_mm = 25.0;
    vague.sigma.source_to_isocentre_mm = 60.0;
    // As large as stated: the arm of this lab stands by its own, the readings are as good as ever.
    let arm = Lab::new(150);
    let mut shots = arm.all();
    for (shot, wide) in shots.iter_mut().zip(vague.all()) {
        shot.covariance = wide.covariance;
    }
    let asked = vague.asked(&shots);
    match measure(&asked) {
        Err(PhantomRefusal::Scale { sigma, sources, .. }) => assert!(sigma > 0.05 && sources == ["joints of the C-arm"]),
        other => panic!("{:?}", other.map(|phantom| phantom.scale)),
    }
    let by_radii = measure(&Asked { bead_radius_mm: Some(RADIUS_MM), ..asked }).expect("radii tell");
    assert!(by_radii.scale.sigma < 0.035 && by_radii.scale.sources[0].source.starts_with("radii"), "{:?}", by_radii.scale);
    let compared = Compared::new(&by_radii, &arm.beads);
    assert!(compared.larger_by.abs() < 3.0 * by_radii.scale.sigma, "{compared:?}");

    let truth = |names: [usize; 2]| {
        let at = names.map(|n| DVec3::from_array(arm.beads[compared.of[n]]));
        at[0].distance(at[1])
    };
    let last = by_radii.beads.len() - 1;
    let stated =
        |mm: f64| [Distance { beads: [by_radii.beads[0].name.clone(), by_radii.beads[last].name.clone()], mm, sigma_mm: 0.1 }];
    let mm = truth([0, last]);
    let distances = stated(mm);
    let told = measure(&Asked { distances: &distances, ..asked }).expect("a distance tells");
    let compared = Compared::new(&told, &arm.beads);
    assert!(told.scale.sigma < 2.0 * 0.1 / mm && compared.rigid_mm < 0.15, "{:?} {compared:?}", told.scale);
    assert_eq!(told.scale.sources.len(), 2);

    let tight = Asked { distances: &stated(1.1 * mm), ..arm.asked(&shots) };
    let good = arm.all();
    match measure(&Asked { shots: &good, ..tight }) {
        Err(PhantomRefusal::ScaleContradicted { larger_by, times, .. }) => assert!((larger_by - 0.1).abs() < 0.02 && times > 4.0),
        other => panic!("{:?}", other.map(|phantom| phantom.scale)),
    }
    let nobody = [Distance { beads: ["bead-01".to_owned(), "apex".to_owned()], mm: 50.0, sigma_mm: 0.1 }];
    let unknown = measure(&Asked { distances: &nobody, ..arm.asked(&good) });
    assert!(matches!(unknown, Err(PhantomRefusal::NoSuchBead { name, .. }) if name == "apex"));
}

#[test]
fn a_flat_phantom_is_measured_and_said_to_be_flat() {
    let mut random = Stream::new(160, 52, 0, Purpose::Evaluation);
    let plate = beads(10, [150.0, 150.0, 100.0], 160).into_iter().map(|[x, y, _]| [x, y, 2.0 * random.normal()]).collect();
    let lab = Lab { beads: plate, ..Lab::new(160) };
    let phantom = lab.measured(&lab.all()).expect("measured");
    assert!(phantom.warnings.iter().any(|warning| warning.starts_with("flat")), "{:?}", phantom.warnings);
    assert!(Compared::new(&phantom, &lab.beads).shape_mm < 0.1);
}
