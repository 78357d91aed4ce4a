//! The fit of one view: outliers out, residuals of spots held out.

use super::polynomial::{Gauge, Node, Polynomial};
use crate::mask::Disc;

/// The polynomial of one view, and the nodes that it rests on.
#[derive(Clone, Debug)]
pub struct ViewFit {
    pub polynomial: Polynomial,
    pub nodes: Vec<Node>,
}

/// Parts that are held out in turn.
const FOLDS: i32 = 10;
/// Spots further off than so many standard deviations, per axis and robustly measured, are left out …
const OUTLIER: f64 = 5.0;
/// … but none that are nearer than this.
const LEAST_OUTLIER_PX: f64 = 0.1;
/// Median length of a vector of two standard normals: √(2 ln 2).
const MEDIAN_LENGTH: f64 = 1.177_410_022_515_474_6;

impl ViewFit {
    /// Fits `nodes`, leaving out those that do not belong. `None` when the rest does not determine the polynomial.
    pub fn new(nodes: Vec<Node>, disc: &Disc, order: usize) -> Option<Self> {
        let mut kept = nodes.clone();
        let mut polynomial = Polynomial::fit(kept.iter(), disc, order)?;
        for _ in 0..8 {
            let cell_px = polynomial.gauge().cell_px();
            let off_px = |polynomial: &Polynomial, node: &Node| cell_px * polynomial.off(node).length();
            let mut lengths: Vec<f64> = kept.iter().map(|node| off_px(&polynomial, node)).collect();
            lengths.sort_by(f64::total_cmp);
            let sigma_px = lengths[lengths.len() / 2] / MEDIAN_LENGTH;
            let limit_px = (OUTLIER * sigma_px).max(LEAST_OUTLIER_PX);
            let next: Vec<Node> = nodes.iter().filter(|node| off_px(&polynomial, node) <= limit_px).copied().collect();
            if next == kept {
                break;
            }
            polynomial = Polynomial::fit(next.iter(), disc, order)?;
            kept = next;
        }
        Some(Self { polynomial, nodes: kept })
    }

    /// Sum of squared residuals, px², of every node against the fit to the other nine tenths; `None` when those determine none.
    pub fn held_out_px2(&self, gauge: &Gauge, disc: &Disc) -> Option<f64> {
        // Neighbours, and neighbours' neighbours, are of different parts.
        let fold = |node: &Node| (node.cell.x + 3 * node.cell.y).rem_euclid(FOLDS);
        let mut sum = 0.0;
        for held in 0..FOLDS {
            let fit = Polynomial::fit(self.nodes.iter().filter(|node| fold(node) != held), disc, self.polynomial.order)?;
            let out = self.nodes.iter().filter(|node| fold(node) == held);
            sum += out.map(|node| (gauge.px_from_cells * fit.off(node)).length_squared()).sum::<f64>();
        }
        Some(sum)
    }
}
