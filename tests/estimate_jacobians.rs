//! What residuals of the estimation core write: their Jacobians against finite differences.

use std::cell::RefCell;
use std::rc::Rc;

use glam::{DVec2, DVec3};
use nalgebra::{DMatrix, Matrix6};
use sidecarm::estimate::{
    BeadImage, BlockId, Evaluation, Freedom, Loss, Motion, Place, PosePrior, Problem, Reading, Residual, Settings, State,
};
use sidecarm::geometry::Rigid;

/// Offset and Jacobians (by block) that a residual wrote last.
type Written = Rc<RefCell<(Vec<f64>, Vec<Vec<f64>>)>>;

/// Hands on a residual and keeps what it wrote.
struct Spy<R> {
    inner: R,
    written: Written,
}

impl<R: Residual> Residual for Spy<R> {
    fn dimension(&self) -> usize {
        self.inner.dimension()
    }

    fn blocks(&self) -> &[BlockId] {
        self.inner.blocks()
    }

    fn evaluate(&self, state: &State, out: &mut Evaluation) -> bool {
        let fine = self.inner.evaluate(state, out);
        let offset = out.offset().to_vec();
        let jacobians = (0..self.blocks().len()).map(|place| out.jacobian(place).map_or(Vec::new(), |j| j.to_vec())).collect();
        *self.written.borrow_mut() = (offset, jacobians);
        fine
    }
}

/// Start values: two poses and five vectors, all of which a bead's image may depend on.
#[derive(Clone)]
struct Start {
    camera: Motion,
    body: Motion,
    vectors: [Vec<f64>; 3],
}

fn start() -> Start {
    Start {
        camera: Motion {
            pose: Rigid::exp(DVec3::new(0.3, -0.2, 0.7), DVec3::new(9.0, -12.0, 620.0)),
            pivot_mm: DVec3::new(20.0, 5.0, -8.0),
        },
        body: Motion {
            pose: Rigid::exp(DVec3::new(-0.1, 0.4, 0.2), DVec3::new(3.0, 7.0, -5.0)),
            pivot_mm: DVec3::new(-6.0, 2.0, 1.0),
        },
        vectors: [vec![5257.0, 5240.0, 3.0, 509.0, 515.0], vec![50.0, -40.0, 30.0], vec![0.8, -3.0, 0.02, -0.01, 0.6]],
    }
}

/// Evaluates one residual of each kind at `start`; `which` chooses.
fn evaluated(start: &Start, which: usize) -> (Vec<f64>, Vec<Vec<f64>>) {
    let written: Written = Rc::default();
    let mut problem = Problem::new();
    let camera = problem.pose("camera", start.camera.pose, start.camera.pivot_mm, true);
    let body = problem.pose("body", start.body.pose, start.body.pivot_mm, true);
    let [k, bead, lens] = [0, 1, 2].map(|n| problem.vector("vector", &start.vectors[n], Freedom::All));
    let mean = Rigid::exp(DVec3::new(0.35, -0.1, 0.6), DVec3::new(5.0, -2.0, 600.0));
    match which {
        0 => {
            let inner = BeadImage::new(camera, k, Place::Solved(bead), DVec2::new(300.0, 400.0), [0.01, 0.0, 0.01]);
            problem.add(Spy { inner: inner.on_body(body).through(lens), written: written.clone() }, Loss::None);
        }
        _ => {
            let inner = PosePrior::new(camera, mean, Matrix6::identity());
            problem.add(Spy { inner, written: written.clone() }, Loss::None);
        }
    }
    let _ = problem.solve(&Settings { iterations: 0, ..Settings::default() }).expect("finite");
    written.borrow().clone()
}

#[test]
fn jacobians_are_finite_differences() {
    // The blocks of each residual, in its own order: 0 camera, 1 body, 2 K, 3 bead, 4 lens.
    let orders: [&[usize]; 2] = [&[0, 2, 3, 1, 4], &[0]];
    let mut compared = 0;
    for (which, order) in orders.into_iter().enumerate() {
        let (offset, jacobians) = evaluated(&start(), which);
        for (place, block) in order.iter().enumerate() {
            let width = jacobians[place].len() / offset.len();
            assert!(width > 0, "block {block} of residual {which} moves");
            for k in 0..width {
                let h = if *block < 2 && k < 3 || *block == 4 { 1e-6 } else { 1e-4 };
                let at = |by: f64| {
                    let mut near = start();
                    let mut xi = [0.0; 6];
                    match block {
                        0 | 1 => {
                            xi[k] = by;
                            let motion = if *block == 0 { &mut near.camera } else { &mut near.body };
                            *motion = motion.moved(&xi);
                        }
                        _ => near.vectors[block - 2][k] += by,
                    }
                    evaluated(&near, which).0
                };
                let (above, below) = (at(h), at(-h));
                for i in 0..offset.len() {
                    // The offset is observed minus predicted.
                    let slope = -(above[i] - below[i]) / (2.0 * h);
                    let own = jacobians[place][k * offset.len() + i];
                    assert!(
                        (slope - own).abs() <= 1e-5 * (1.0 + own.abs()),
                        "residual {which}, block {block}, {k}, {i}: {slope} {own}"
                    );
                    compared += 1;
                }
            }
        }
    }
    assert_eq!(compared, 2 * 25 + 36);
    // Linear: readings of K's cx, fx and skew, short by the lens's fourth, first and third number.
    let mut problem = Problem::new();
    let joints = problem.vector("joints", &[10.0, 20.0, 30.0], Freedom::All);
    let offsets = problem.vector("offsets", &[1.0, 2.0, 3.0], Freedom::Constant);
    let values = [f64::NAN, 17.5, 26.0];
    let reading = Reading::with_sigmas(joints, &values, &[0.1, 0.1, 0.1]).behind(offsets);
    assert_eq!(reading.dimension(), 2, "a joint without encoder is left out");
    problem.add(reading, Loss::None);
    problem.add(Reading::of_some(joints, vec![0], &[11.0], DMatrix::identity(1, 1)), Loss::None);
    let estimate = problem.solve(&Settings::default()).expect("solved");
    let expected = [11.0, 19.5, 29.0];
    for (found, expected) in estimate.state().vector(joints).iter().zip(expected) {
        assert!((found - expected).abs() < 1e-9, "{found} {expected}");
    }
}
