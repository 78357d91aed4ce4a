//! The estimation core against finite differences, brute force and statistics.

use glam::{DMat3, DVec2, DVec3};
use nalgebra::{DMatrix, Matrix6, Vector6};
use sidecarm::estimate::{
    BeadImage, EstimateError, Freedom, Loss, Motion, Numeric, Place, PoseBlock, PosePrior, Problem, Reading, Residual, Settings,
    Stop, VectorBlock, about, deviation,
};
use sidecarm::geometry::Rigid;
use sidecarm::random::{Purpose, Stream};

const K: [f64; 5] = [5257.0, 5257.0, 0.0, 511.5, 511.5];
const SIGMA_PX: f64 = 0.05;
const SIGMA_MM: f64 = 0.05;

fn vector(random: &mut Stream, scale: f64) -> DVec3 {
    DVec3::new(random.normal(), random.normal(), random.normal()) * scale
}

fn project(k: &[f64], p: DVec3) -> DVec2 {
    DVec2::new((k[0] * p.x + k[2] * p.y) / p.z + k[3], k[1] * p.y / p.z + k[4])
}

/// Eight beads over 160×160×120 mm about 600 mm from the source, their images with noise, and where they are said to be.
struct Shot {
    truth: Rigid,
    said_mm: Vec<DVec3>,
    image_px: Vec<DVec2>,
}

fn shot(seed: u64, frame: u32) -> Shot {
    let mut random = Stream::new(seed, frame, 0, Purpose::Evaluation);
    let turn = Rigid::exp(vector(&mut random, 0.25), DVec3::ZERO);
    let truth = Rigid::translation(DVec3::new(0.0, 0.0, 600.0) + vector(&mut random, 8.0)) * turn;
    let said_mm: Vec<DVec3> = (0..8)
        .map(|n| {
            let side = |bit: u32| if n >> bit & 1 == 1 { 1.0 } else { -1.0 };
            DVec3::new(80.0 * side(0), 80.0 * side(1), 60.0 * side(2)) * (0.75 + 0.25 * random.uniform())
        })
        .collect();
    let image_px = said_mm
        .iter()
        .map(|place| {
            let moved = *place + vector(&mut random, SIGMA_MM);
            project(&K, truth.transform_point(moved)) + DVec2::new(random.normal(), random.normal()) * SIGMA_PX
        })
        .collect();
    Shot { truth, said_mm, image_px }
}

const COVARIANCE_PX2: [f64; 3] = [SIGMA_PX * SIGMA_PX, 0.0, SIGMA_PX * SIGMA_PX];

fn known(body_mm: DVec3, share: f64) -> Place {
    Place::Known { body_mm, covariance_mm2: DMat3::from_diagonal(DVec3::splat(SIGMA_MM * SIGMA_MM)), share }
}

/// A problem with the pose free, 3° and some mm off.
fn posed<'a>(shot: &Shot, freedom: Freedom, loss: Loss) -> (Problem<'a>, PoseBlock, VectorBlock) {
    let mut problem = Problem::new();
    let off = Motion { pose: shot.truth, pivot_mm: DVec3::ZERO }.moved(&[0.03, -0.04, 0.02, 5.0, -4.0, 20.0]);
    let camera = problem.pose("camera_from_lps", off.pose, DVec3::ZERO, true);
    let k = problem.vector("intrinsics", &K, freedom);
    for (place, image) in shot.said_mm.iter().zip(&shot.image_px) {
        problem.add(BeadImage::new(camera, k, known(*place, 1.0), *image, COVARIANCE_PX2), loss);
    }
    (problem, camera, k)
}

#[test]
fn regions_contain_the_truth_as_often_as_they_say() {
    // χ² of six and two degrees of freedom, 95 %.
    const LIMITS: (f64, f64) = (12.5916, 5.9915);
    const RUNS: u32 = 2000;
    for fused in [false, true] {
        let (mut poses, mut images) = (0, 0);
        for n in 0..RUNS {
            let shot = shot(101 + u64::from(fused), n);
            let (mut problem, camera, k) = posed(&shot, Freedom::Constant, Loss::None);
            if fused {
                let mut random = Stream::new(7, n, 1, Purpose::Evaluation);
                let sigmas = [1e-3, 1e-3, 1e-3, 0.3, 0.3, 1.0];
                let to_centre = about(shot.truth.translation_mm);
                let own = Matrix6::from_diagonal(&Vector6::from_fn(|i, _| f64::powi(sigmas[i], -2)));
                let drawn = Vector6::from_fn(|i, _| sigmas[i] * random.normal());
                let xi = about(-shot.truth.translation_mm) * drawn;
                let error = Rigid::exp(DVec3::new(xi[0], xi[1], xi[2]), DVec3::new(xi[3], xi[4], xi[5]));
                let information = to_centre.transpose() * own * to_centre;
                problem.add(PosePrior::new(camera, error.inverse() * shot.truth, information), Loss::None);
            }
            let estimate = problem.solve(&Settings::default()).expect("solved");
            assert_eq!(estimate.stop(), Stop::Converged);
            assert_eq!(estimate.degrees_of_freedom(), if fused { 16 } else { 10 });
            let covariance = estimate.covariance().expect("regular");
            let motion = estimate.state().motion(camera);
            let xi = about(motion.centre_mm()) * deviation(&shot.truth, &motion.pose);
            let own = covariance.of(&[camera.id()]);
            let xi = nalgebra::DVector::from_column_slice(xi.as_slice());
            poses += u32::from(xi.dot(&own.cholesky().expect("positive").solve(&xi)) < LIMITS.0);
            // A landmark's image, 40 mm off the beads' middle.
            let place = DVec3::new(30.0, -20.0, 15.0);
            let p = motion.pose.transform_point(place);
            let by_point = DMatrix::from_row_slice(
                2,
                3,
                &[K[0] / p.z, 0.0, -K[0] * p.x / (p.z * p.z), 0.0, K[1] / p.z, -K[1] * p.y / (p.z * p.z)],
            );
            let arm = p - motion.centre_mm();
            let by_pose = DMatrix::from_fn(3, 6, |i, j| sidecarm::estimate::turned(DVec3::AXES[i], arm)[j]);
            let spread = covariance.propagate(&[(camera.id(), &(by_point * by_pose)), (k.id(), &DMatrix::zeros(2, 5))]);
            let off = project(&K, shot.truth.transform_point(place)) - project(&K, p);
            let off = nalgebra::DVector::from_column_slice(&off.to_array());
            images += u32::from(off.dot(&spread.cholesky().expect("positive").solve(&off)) < LIMITS.1);
        }
        for (what, count) in [("pose", poses), ("landmark", images)] {
            // Four standard deviations of a binomial share of 0.95 among 2000 are 1.95 %.
            let share = f64::from(count) / f64::from(RUNS);
            assert!((share - 0.95).abs() < 0.02, "{what}, fused {fused}: {share}");
        }
    }
}

#[test]
fn a_left_out_residual_is_what_the_others_predict() {
    let shot = shot(3, 0);
    let mean = Motion { pose: shot.truth, pivot_mm: DVec3::ZERO }.moved(&[1e-3, 0.0, -1e-3, 0.2, 0.1, -0.5]).pose;
    let with = |skipped: Option<usize>| {
        let mut shot = Shot { truth: shot.truth, said_mm: shot.said_mm.clone(), image_px: shot.image_px.clone() };
        shot.image_px[5] += DVec2::new(3.0, -2.0);
        let own = skipped.map(|n| (shot.said_mm.remove(n), shot.image_px.remove(n)));
        let (mut problem, camera, k) = posed(&shot, Freedom::Constant, Loss::None);
        problem.add(PosePrior::new(camera, mean, Matrix6::from_diagonal_element(1.0) * 10.0), Loss::None);
        (problem, camera, k, own)
    };
    let (problem, ..) = with(None);
    let estimate = problem.solve(&Settings::default()).expect("solved");
    let covariance = estimate.covariance().expect("regular");
    let mut largest = (0, 0.0);
    for n in 0..8 {
        let found = estimate.left_out(n).expect("seven beads are enough");
        let (others, camera, _, own) = with(Some(n));
        let (place, image) = own.expect("was there");
        let brute = others.solve(&Settings::default()).expect("solved");
        let p = brute.state().pose(camera).transform_point(place);
        let off = image - project(&K, p);
        assert!((found.offset[0] - off.x).abs() < 1e-6 && (found.offset[1] - off.y).abs() < 1e-6, "{n}: {} {off}", found.offset);
        let by_point = DMatrix::from_row_slice(
            2,
            3,
            &[K[0] / p.z, 0.0, -K[0] * p.x / (p.z * p.z), 0.0, K[1] / p.z, -K[1] * p.y / (p.z * p.z)],
        );
        let arm = p - brute.state().motion(camera).centre_mm();
        let by_pose = DMatrix::from_fn(3, 6, |i, j| sidecarm::estimate::turned(DVec3::AXES[i], arm)[j]);
        let spread = brute.covariance().expect("regular").propagate(&[(camera.id(), &(&by_point * by_pose))]);
        assert!((&spread - &found.of_prediction).norm() < 1e-6 * spread.norm(), "{n}");
        let own = DMatrix::identity(2, 2) * SIGMA_PX.powi(2) + &by_point * by_point.transpose() * SIGMA_MM.powi(2);
        let off = nalgebra::DVector::from_column_slice(&off.to_array());
        let chi2 = off.dot(&(spread + own).try_inverse().expect("positive").clone().mul_vec(&off));
        assert!((chi2 / found.chi2 - 1.0).abs() < 1e-4, "{n}: {chi2} {}", found.chi2);
        let linear = estimate.left_out_linear(&covariance, n).expect("seven beads are enough");
        assert!(
            (&linear.offset - &found.offset).norm() < 0.02 * found.offset.norm() + 1e-3,
            "{n}: {} {}",
            linear.offset,
            found.offset
        );
        if found.chi2 > largest.1 {
            largest = (n, found.chi2);
        }
    }
    assert_eq!(largest.0, 5, "the moved bead is the worst");
    // The prior is a residual like any other.
    let prior = estimate.left_out(8).expect("the beads are enough");
    assert!(prior.chi2.is_finite() && prior.offset.len() == 6 && prior.offset.norm() > 0.0);
    assert!(matches!(estimate.left_out(9), Err(EstimateError::NoSuchResidual { residual: 9, count: 9 })));
}

/// Matrix times vector, readable after `clone()`.
trait MulVec {
    fn mul_vec(self, v: &nalgebra::DVector<f64>) -> nalgebra::DVector<f64>;
}

impl MulVec for DMatrix<f64> {
    fn mul_vec(self, v: &nalgebra::DVector<f64>) -> nalgebra::DVector<f64> {
        self * v
    }
}

#[test]
fn what_nothing_determines_is_named() {
    // Beads in a row: rotation about the row is free.
    let mut row = shot(5, 0);
    row.said_mm = (0..8).map(|n| DVec3::new(0.0, 15.0 * (f64::from(n) - 3.5), 0.0)).collect();
    row.truth = Rigid::translation(DVec3::new(2.0, 3.0, 600.0));
    row.image_px = row.said_mm.iter().map(|p| project(&K, row.truth.transform_point(*p))).collect();
    let (problem, ..) = posed(&row, Freedom::Constant, Loss::None);
    let error = problem.solve(&Settings::default()).and_then(|estimate| estimate.covariance()).expect_err("one turn is free");
    let EstimateError::Undetermined { rank: 5, columns: 6, directions } = &error else { panic!("{error}") };
    // ω about y, the row's direction in the camera, up to the few degrees by which the solution may have turned.
    let (block, name, coordinate, share) = directions[0].components[0];
    assert!(
        (block, name) == (directions[0].components[0].0, "camera_from_lps") && coordinate < 3 && share.abs() > 0.05,
        "{error}"
    );
    assert!(directions[0].components.iter().any(|c| c.2 == 1 && c.3.abs() == 1.0), "{error}");

    // A number that nothing observes.
    let shot = shot(5, 1);
    let (mut problem, ..) = posed(&shot, Freedom::Constant, Loss::None);
    let idle = problem.vector("idle", &[1.0, 2.0], Freedom::Only(vec![1]));
    let error = problem.solve(&Settings::default()).and_then(|estimate| estimate.covariance()).expect_err("idle is free");
    let EstimateError::Undetermined { rank: 6, columns: 7, directions } = &error else { panic!("{error}") };
    assert_eq!(directions[0].components, vec![(idle.id(), "idle", 0, 1.0)]);
    assert!(error.to_string().contains("idle#2[0] +1.000"), "{error}");

    // A bead solved from one view without a prior: its depth is free, though it is eliminated.
    let (mut problem, camera, k) = posed(&shot, Freedom::Constant, Loss::None);
    let bead = problem.eliminated("bead", &[1.0, 2.0, 3.0]);
    let image = project(&K, shot.truth.transform_point(DVec3::new(1.5, 2.0, 3.0)));
    problem.add(BeadImage::new(camera, k, Place::Solved(bead), image, COVARIANCE_PX2), Loss::None);
    let error = problem.solve(&Settings::default()).and_then(|estimate| estimate.covariance()).expect_err("depth is free");
    let EstimateError::Undetermined { rank: 8, columns: 9, directions } = &error else { panic!("{error}") };
    assert!(directions[0].components.iter().all(|c| c.0 == bead.id()), "{error}");

    // With one bead fewer than three, leaving out another says so too.
    let mut few = shot;
    few.said_mm.truncate(3);
    few.image_px.truncate(3);
    let (problem, ..) = posed(&few, Freedom::Constant, Loss::None);
    let estimate = problem.solve(&Settings::default()).expect("solved");
    let covariance = estimate.covariance().expect("three beads determine a pose");
    assert!(matches!(estimate.left_out(0), Err(EstimateError::Undetermined { .. })));
    assert!(matches!(estimate.left_out_linear(&covariance, 0), Err(EstimateError::Undetermined { .. })));
}

#[test]
fn bead_places_eliminated_kept_and_as_noise_agree() {
    let mut cases = 0;
    for n in 0..20 {
        let shot = shot(9, n);
        let solved = |eliminated: bool| {
            let mut problem = Problem::new();
            let off = Motion { pose: shot.truth, pivot_mm: DVec3::ZERO }.moved(&[0.03, -0.04, 0.02, 5.0, -4.0, 20.0]);
            let camera = problem.pose("camera_from_lps", off.pose, DVec3::ZERO, true);
            let k = problem.vector("intrinsics", &K, Freedom::Constant);
            let mut ids = vec![camera.id()];
            for (place, image) in shot.said_mm.iter().zip(&shot.image_px) {
                let at = place.to_array();
                let bead = if eliminated { problem.eliminated("bead", &at) } else { problem.vector("bead", &at, Freedom::All) };
                problem.add(BeadImage::new(camera, k, Place::Solved(bead), *image, COVARIANCE_PX2), Loss::None);
                problem.add(Reading::of_all(bead, &at, DMatrix::identity(3, 3) * SIGMA_MM.powi(-2)), Loss::None);
                ids.push(bead.id());
            }
            let estimate = problem.solve(&Settings::default()).expect("solved");
            assert_eq!(estimate.degrees_of_freedom(), 10);
            let left_out = estimate.left_out(4).expect("determined");
            let linear = estimate.left_out_linear(&estimate.covariance().expect("regular"), 4).expect("determined");
            assert!((linear.chi2 / left_out.chi2 - 1.0).abs() < 0.05);
            let covariance = estimate.covariance().expect("regular").of(&ids);
            (*estimate.state().motion(camera), covariance, estimate.chi2_sum(), left_out.chi2)
        };
        let (eliminated, kept) = (solved(true), solved(false));
        let apart = deviation(&eliminated.0.pose, &kept.0.pose);
        assert!(apart.norm() < 1e-7, "{apart}");
        assert!((&eliminated.1 - &kept.1).norm() < 1e-9 * kept.1.norm());
        assert!((eliminated.3 / kept.3 - 1.0).abs() < 1e-6);

        let (problem, camera, _) = posed(&shot, Freedom::Constant, Loss::None);
        let estimate = problem.solve(&Settings::default()).expect("solved");
        let inflated = estimate.covariance().expect("regular").of(&[camera.id()]);
        let own = eliminated.1.view((0, 0), (6, 6)).into_owned();
        // To first order in the beads' displacement (0.05 of 600 mm) they are the same.
        assert!((&inflated - &own).norm() < 0.003 * own.norm(), "{}", (&inflated - &own).norm() / own.norm());
        let xi = about(eliminated.0.centre_mm()) * deviation(estimate.state().pose(camera), &eliminated.0.pose);
        let xi = nalgebra::DVector::from_column_slice(xi.as_slice());
        let sigmas = xi.dot(&own.cholesky().expect("positive").solve(&xi)).sqrt();
        assert!(sigmas < 0.02, "{sigmas}");
        assert!((estimate.chi2_sum() / eliminated.2 - 1.0).abs() < 0.01);
        cases += 1;
    }
    assert_eq!(cases, 20);
}

#[test]
fn weights_by_a_share_of_the_noise_keep_the_whole_noise_in_the_covariance() {
    let shot = shot(13, 0);
    let covariance = |share: f64| {
        let mut problem = Problem::new();
        let camera = problem.pose("camera_from_lps", shot.truth, DVec3::ZERO, true);
        let k = problem.vector("intrinsics", &K, Freedom::Constant);
        for (place, image) in shot.said_mm.iter().zip(&shot.image_px) {
            problem.add(BeadImage::new(camera, k, known(*place, share), *image, COVARIANCE_PX2), Loss::None);
        }
        problem.solve(&Settings::default()).expect("solved").covariance().expect("regular").of(&[camera.id()])
    };
    let (whole, part) = (covariance(1.0), covariance(0.3));
    for n in 0..6 {
        // Other weights than the noise's own lose a little, and must not win anything.
        let ratio = (part[(n, n)] / whole[(n, n)]).sqrt();
        assert!((0.999..1.1).contains(&ratio), "{n}: {ratio}");
    }
}

#[test]
fn a_prior_alone_gives_itself_back() {
    let mean = Rigid::exp(DVec3::new(0.3, -0.2, 0.7), DVec3::new(9.0, -12.0, 620.0));
    let mut random = Stream::new(17, 0, 0, Purpose::Evaluation);
    let root = Matrix6::from_fn(|i, j| if i == j { 2.0 } else { 0.2 * random.normal() });
    let information = root.transpose() * root;
    let mut problem = Problem::new();
    let start = Rigid::exp(DVec3::new(0.1, 0.1, 0.3), DVec3::new(20.0, 5.0, 500.0));
    let camera = problem.pose("camera_from_lps", start, DVec3::new(4.0, 50.0, -30.0), true);
    problem.add(PosePrior::new(camera, mean, information), Loss::None);
    let estimate = problem.solve(&Settings::default()).expect("solved");
    assert_eq!((estimate.stop(), estimate.degrees_of_freedom()), (Stop::Converged, 0));
    assert!(deviation(estimate.state().pose(camera), &mean).norm() < 1e-7);
    let own = estimate.covariance().expect("regular").of(&[camera.id()]);
    let to_origin = about(-estimate.state().motion(camera).centre_mm());
    let about_origin = to_origin * Matrix6::from_fn(|i, j| own[(i, j)]) * to_origin.transpose();
    let expected = information.try_inverse().expect("regular");
    assert!((about_origin - expected).norm() < 1e-6 * expected.norm());
    // A prior that says nothing about two directions counts four.
    let half = Matrix6::from_diagonal(&Vector6::new(1.0, 1.0, 1.0, 0.5, 0.0, 0.0));
    assert_eq!(PosePrior::new(camera, mean, half).degrees(), 4);
}

#[test]
fn gross_errors_move_a_robust_estimate_little() {
    for (loss, at_most) in [(Loss::Cauchy(3.0), 0.8), (Loss::Huber(2.0), 3.0)] {
        let mut shot = shot(19, 0);
        shot.image_px[2] += DVec2::new(40.0, 25.0);
        let sigmas = |loss: Loss| {
            let (problem, camera, _) = posed(&shot, Freedom::Constant, loss);
            let estimate = problem.solve(&Settings::default()).expect("solved");
            assert_eq!(estimate.stop(), Stop::Converged);
            let xi = deviation(estimate.state().pose(camera), &shot.truth);
            (xi.fixed_rows::<3>(0).norm() / 2e-4, estimate.weight(2))
        };
        let (robust, plain) = (sigmas(loss), sigmas(Loss::None));
        assert!(plain.0 > 10.0, "least squares is led astray: {}", plain.0);
        assert!(robust.0 < at_most * 3.0 && robust.1 < 0.05, "{loss:?}: {} with weight {}", robust.0, robust.1);
    }
}

/// A C-arm reduced to what matters here: two angles with encoders, two angle offsets and the distance from source to isocentre.
fn camera_from_world(angles: &[f64], arm: &[f64]) -> Rigid {
    let turn = |axis: DVec3, angle: f64| Rigid::exp(axis * angle, DVec3::ZERO);
    let world_from_camera =
        turn(DVec3::X, angles[0] + arm[0]) * turn(DVec3::Y, angles[1] + arm[1]) * Rigid::translation(DVec3::Z * -arm[2]);
    world_from_camera.inverse()
}

/// Ten shots of twelve beads, all places, the specimen's pose, the joints and the arm solved together.
fn bundle(seed: u64) -> (Vec<f64>, Vec<f64>, f64, i64) {
    let mut random = Stream::new(seed, 0, 0, Purpose::Evaluation);
    let truth = [0.01, -0.015, 604.0];
    let world_from_lps = Rigid::exp(DVec3::new(0.1, 0.2, -0.1), DVec3::new(10.0, -5.0, 8.0));
    let said: Vec<DVec3> = (0..12).map(|_| vector(&mut random, 40.0)).collect();
    let there: Vec<DVec3> = said.iter().map(|p| *p + vector(&mut random, 0.1)).collect();
    let mut problem = Problem::new();
    let arm = problem.vector("arm", &[0.0, 0.0, 600.0], Freedom::All);
    let specimen = problem.pose("world_from_lps", Rigid::IDENTITY, DVec3::ZERO, true);
    let beads: Vec<VectorBlock> = said.iter().map(|p| problem.eliminated("bead", &p.to_array())).collect();
    for (bead, place) in beads.iter().zip(&said) {
        problem.add(Reading::of_all(*bead, &place.to_array(), DMatrix::identity(3, 3) * 100.0), Loss::None);
    }
    // Offsets and the specimen's turn are told apart by the table, which is level to a tenth of a degree or so.
    problem.add(
        PosePrior::new(specimen, world_from_lps, Matrix6::from_diagonal(&Vector6::new(1e6, 1e6, 1e6, 1e-2, 1e-2, 1e-2))),
        Loss::None,
    );
    for n in 0..10 {
        let angles = [0.09 * f64::from(n) - 0.4, 0.8 * (0.7 * f64::from(n)).sin()];
        let read = angles.map(|angle| angle + 3.5e-4 * random.normal());
        let joints = problem.vector("joints", &read, Freedom::All);
        problem.add(Reading::with_sigmas(joints, &read, &[3.5e-4, 3.5e-4]), Loss::None);
        for (bead, place) in beads.iter().zip(&there) {
            let p = (camera_from_world(&angles, &truth) * world_from_lps).transform_point(*place);
            let seen = project(&K, p) + DVec2::new(random.normal(), random.normal()) * SIGMA_PX;
            let (blocks, bead) = ([arm.id(), specimen.id(), joints.id(), bead.id()], *bead);
            let residual = Numeric::new(
                &problem,
                &blocks,
                &seen.to_array(),
                DMatrix::identity(2, 2) * SIGMA_PX.powi(-2),
                move |state, out| {
                    let camera = camera_from_world(state.vector(joints), state.vector(arm)) * *state.pose(specimen);
                    let p = camera.transform_point(state.point(bead));
                    out.copy_from_slice(&project(&K, p).to_array());
                    p.z > 1.0
                },
            );
            problem.add(residual, Loss::None);
        }
    }
    let estimate = problem.solve(&Settings::default()).expect("solved");
    assert_eq!(estimate.stop(), Stop::Converged, "{} steps", estimate.iterations());
    let covariance = estimate.covariance().expect("regular").of(&[arm.id()]);
    let found = estimate.state().vector(arm);
    let pulls = (0..3).map(|n| (found[n] - truth[n]) / covariance[(n, n)].sqrt()).collect();
    (found.to_vec(), pulls, estimate.chi2_sum(), estimate.degrees_of_freedom())
}

#[test]
fn ten_shots_of_twelve_beads_calibrate_an_arm() {
    let (found, pulls, chi2, degrees) = bundle(23);
    assert!(pulls.iter().all(|pull| pull.abs() < 4.0), "{found:?} {pulls:?}");
    assert!((found[2] - 604.0).abs() < 0.5, "{found:?}");
    // 240 images, 20 readings, 36 + 6 of priors; 3 + 6 + 20 + 36 unknowns. Five standard deviations of χ².
    assert_eq!(degrees, 302 - 65);
    assert!((chi2 / degrees as f64 - 1.0).abs() < 5.0 * (2.0 / degrees as f64).sqrt(), "{chi2} of {degrees}");
}

#[test]
fn the_same_problem_gives_the_same_bits() {
    assert_eq!(bundle(29), bundle(29));
    assert_ne!(bundle(29).0, bundle(30).0);
}

#[test]
fn numbers_that_are_none_are_errors() {
    let mut nan = shot(31, 0);
    nan.image_px[3].x = f64::NAN;
    let (problem, ..) = posed(&nan, Freedom::Constant, Loss::None);
    assert_eq!(problem.solve(&Settings::default()).err(), Some(EstimateError::NotFinite { residual: 3 }));

    let shot = shot(31, 0);
    let (mut problem, camera, _) = posed(&shot, Freedom::Constant, Loss::None);
    problem.set_pose(camera, Rigid::translation(DVec3::new(0.0, 0.0, -600.0)));
    let error = problem.solve(&Settings::default()).and_then(|estimate| estimate.covariance()).err();
    assert_eq!(error, Some(EstimateError::Infeasible { residual: 0 }), "behind the source nothing is seen");
}
