//! The one least-squares core: poses, K, distortion, bead places and arm parameters, from bead images, priors and joint readings.
//!
//! A [`Problem`] holds parameter blocks and residuals. A pose block moves on SE(3), a vector block along chosen directions of its
//! numbers; either may be constant, and a vector block may be eliminated (Schur complement), as bead places with priors are. Every
//! residual says, at a state, how far the observed lies from the predicted, its information (inverse covariance), and its Jacobian per
//! block; a robust loss may discount it.
//!
//! [`Problem::solve`] runs Levenberg–Marquardt and gives an [`Estimate`]: state, χ², degrees of freedom, [`Covariance`] of all free
//! blocks, and what every residual would have been had it been left out. What the residuals leave undetermined is an error that names
//! the direction. Nothing here depends on thread order, hash order or time.
//!
//! A straight line needs none of this: [`Line`].
//!
//! Fits of one shadow to its pixels, or one ball to its voxels, take their steps by [`SmallSteps`], which says why.
//!
//! It is our own because neither apex-solver nor factrs leaves a residual out, nor weighs by what the state says; both find the same optimum.

mod motion;
mod block;
mod loss;
mod residual;
mod image_of_bead;
mod priors;
mod problem;
mod numeric;
mod error;
mod linearisation;
mod equations;
mod levenberg;
mod covariance;
mod left_out;
mod solution;
mod small_steps;
mod median;
mod line;

pub use block::{BlockId, Freedom, PoseBlock, State, VectorBlock};
pub use covariance::{Covariance, Rows};
pub use error::{Direction, EstimateError};
pub use image_of_bead::{BeadImage, Place, plane_by_lens};
pub use left_out::LeftOut;
pub use levenberg::{Settings, Stop};
pub use line::Line;
pub use loss::Loss;
pub use median::median;
pub use motion::{Motion, about, deviation, left_jacobian_inverse, turned};
pub use numeric::Numeric;
pub use priors::{PosePrior, Reading};
pub use problem::Problem;
pub use residual::{Evaluation, Residual};
pub use small_steps::SmallSteps;
pub use solution::Estimate;
