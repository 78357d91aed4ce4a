//! The fit of one view: outliers out, residuals of spots held out.

use super::outliers::limit_px;
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
const ROUNDS: usize = 40;

impl ViewFit {
    /// Fits `nodes`, leaving out those that do not belong. `None` when the rest does not determine the polynomial.
    // A false spot at the rim draws the polynomial to itself, and good ones beside it off: judged is how far each would be off had it
    // been left out, and only the worst go at a time.
    pub fn new(nodes: &[Node], disc: &Disc, order: usize) -> Option<Self> {
        let mut kept = vec![true; nodes.len()];
        for _ in 0..ROUNDS {
            let chosen = || nodes.iter().zip(&kept).filter(|(_, kept)| **kept).map(|(node, _)| node);
            let (polynomial, leverage) = Polynomial::fit_with_leverage(chosen(), disc, order)?;
            let cell_px = polynomial.gauge().cell_px();
            let mut leverage = leverage.into_iter();
            let off_px: Vec<f64> = nodes
                .iter()
                .zip(&kept)
                .map(|(node, kept)| {
                    let pull = if *kept { leverage.next().unwrap_or(0.0) } else { 0.0 };
                    cell_px * polynomial.off(node).length() / (1.0 - pull).max(1e-6)
                })
                .collect();
            let limit_px = limit_px(off_px.iter().zip(&kept).filter(|(_, kept)| **kept).map(|(off, _)| *off))?;
            let next: Vec<bool> = off_px.iter().map(|off| *off <= limit_px).collect();
            if next == kept {
                return Some(Self { polynomial, nodes: chosen().copied().collect() });
            }
            kept = next;
        }
        let nodes: Vec<Node> = nodes.iter().zip(&kept).filter(|(_, kept)| **kept).map(|(node, _)| *node).collect();
        Some(Self { polynomial: Polynomial::fit(nodes.iter(), disc, order)?, nodes })
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

#[cfg(test)]
mod tests {
    use glam::{DVec2, IVec2};

    use super::*;
    use crate::random::{Purpose, Stream};

    /// 64 nodes and 21 terms: fitted to a node, the polynomial is off by √(1 − 21/64) of its noise there, without it by more than all of it.
    #[test]
    fn a_node_is_judged_by_a_fit_that_does_not_have_it() {
        let mut random = Stream::new(3, 0, 0, Purpose::Evaluation);
        let node = |n: i32| {
            let cell = IVec2::new(n % 8 - 4, n / 8 - 4);
            let noise = DVec2::new(random.normal(), random.normal());
            Node { image_px: DVec2::splat(100.0) + 20.0 * cell.as_dvec2() + 0.2 * noise, sigma_px: 0.2, cell }
        };
        let nodes: Vec<Node> = (0..64).map(node).collect();
        let disc = Disc { centre: DVec2::splat(90.0), radius_px: 100.0 };
        let fit = ViewFit::new(&nodes, &disc, 5).expect("determined");
        let gauge = fit.polynomial.gauge();
        let fitted: f64 = fit.nodes.iter().map(|node| (gauge.px_from_cells * fit.polynomial.off(node)).length_squared()).sum();
        let held_out = fit.held_out_px2(&gauge, &disc).expect("determined");
        assert!(fit.nodes.len() == 64 && held_out > 1.5 * fitted, "{held_out} {fitted}");
    }
}
