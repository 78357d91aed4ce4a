//! The polynomial from places in the frame to places on the grid, in cells.

use glam::{DMat2, DVec2, IVec2};
use nalgebra::{DMatrix, DVector};

use super::spots::Spot;
use crate::geometry::{term_count, terms};
use crate::mask::Disc;

/// A spot and the node of the grid that it shows.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Node {
    /// Centre in the frame.
    pub image_px: DVec2,
    /// Standard deviation per axis.
    pub sigma_px: f64,
    /// Column and row of the grid, from an origin of its own.
    pub cell: IVec2,
}

impl Node {
    /// `spot` as the node `cell`.
    pub fn new(spot: &Spot, cell: IVec2) -> Self {
        Self { image_px: spot.image_px, sigma_px: spot.sigma_px, cell }
    }
}

/// Cells from frame pixels.
#[derive(Clone, Debug)]
pub struct Polynomial {
    pub order: usize,
    disc: Disc,
    /// In the order of [`terms`].
    pub cells: Vec<DVec2>,
}

impl Polynomial {
    /// Fits `nodes` by weighted least squares; `None` when they are too few or lie on a curve of that order.
    pub fn fit<'a>(nodes: impl Iterator<Item = &'a Node>, disc: &Disc, order: usize) -> Option<Self> {
        Self::fit_with_leverage(nodes, disc, order).map(|(fit, _)| fit)
    }

    /// [`Polynomial::fit`], and how far each node pulls the fit to itself, 0 to 1: left out, it would be off by 1 / (1 − leverage) times as
    /// much.
    pub fn fit_with_leverage<'a>(nodes: impl Iterator<Item = &'a Node>, disc: &Disc, order: usize) -> Option<(Self, Vec<f64>)> {
        let nodes: Vec<&Node> = nodes.collect();
        let count = term_count(order);
        if nodes.len() < count {
            return None;
        }
        let mut design = DMatrix::zeros(nodes.len(), count);
        let mut cells = DMatrix::zeros(nodes.len(), 2);
        for (row, node) in nodes.iter().enumerate() {
            let weight = node.sigma_px.recip();
            for (column, term) in terms(order, normalised(node.image_px, disc)).enumerate() {
                design[(row, column)] = weight * term;
            }
            cells[(row, 0)] = weight * f64::from(node.cell.x);
            cells[(row, 1)] = weight * f64::from(node.cell.y);
        }
        let qr = design.qr();
        let (q, r) = (qr.q(), qr.r());
        let right = q.transpose() * cells;
        let diagonal: DVector<f64> = r.diagonal().abs();
        if !(diagonal.min() > 1e-9 * diagonal.max()) {
            return None;
        }
        let solved = r.solve_upper_triangular(&right)?;
        let cells: Vec<DVec2> = (0..count).map(|n| DVec2::new(solved[(n, 0)], solved[(n, 1)])).collect();
        let leverage = q.row_iter().map(|row| row.norm_squared()).collect();
        cells.iter().all(|cell| cell.is_finite()).then_some((Self { order, disc: *disc, cells }, leverage))
    }

    /// Cells at a place of the frame.
    pub fn at(&self, p: DVec2) -> DVec2 {
        terms(self.order, normalised(p, &self.disc)).zip(&self.cells).map(|(term, cells)| term * *cells).sum()
    }

    /// Where a node's spot lies, less its cell.
    pub fn off(&self, node: &Node) -> DVec2 {
        self.at(node.image_px) - node.cell.as_dvec2()
    }

    /// Undistorted pixels from cells such that the disc's centre stays where it is, and a pixel there keeps its area and direction.
    // With J the derivative at the centre, S J must have determinant 1 and no turn: S = Rᵀ / √det J where J = R U is J's polar form. In
    // two dimensions the turn of R is atan2(J₁₀ − J₀₁, J₀₀ + J₁₁).
    pub fn gauge(&self) -> Gauge {
        let by = |n: usize| self.cells.get(n).copied().unwrap_or_default() / self.disc.radius_px;
        let j = DMat2::from_cols(by(1), by(2));
        let turn = (j.x_axis.y - j.y_axis.x).atan2(j.x_axis.x + j.y_axis.y);
        let px_from_cells = DMat2::from_angle(-turn) * j.determinant().abs().sqrt().recip();
        let at_centre = self.cells.first().copied().unwrap_or_default();
        Gauge { px_from_cells, origin_px: self.disc.centre - px_from_cells * at_centre }
    }

    /// Coefficients of undistorted minus distorted.
    pub fn shift_px(&self, gauge: &Gauge) -> Vec<DVec2> {
        let mut shift: Vec<DVec2> = self.cells.iter().map(|cells| gauge.px_from_cells * *cells).collect();
        // p = c + R x.
        let own =
            [gauge.origin_px - self.disc.centre, DVec2::new(-self.disc.radius_px, 0.0), DVec2::new(0.0, -self.disc.radius_px)];
        shift.iter_mut().zip(own).for_each(|(shift, own)| *shift += own);
        shift
    }
}

/// Undistorted pixels from cells of the grid: a similarity.
#[derive(Clone, Copy, Debug)]
pub struct Gauge {
    pub px_from_cells: DMat2,
    pub origin_px: DVec2,
}

impl Gauge {
    /// Undistorted pixels along one cell.
    pub fn cell_px(&self) -> f64 {
        self.px_from_cells.x_axis.length()
    }
}

fn normalised(p: DVec2, disc: &Disc) -> DVec2 {
    (p - disc.centre) / disc.radius_px
}
