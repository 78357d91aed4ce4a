//! Several fits: which are of one shadow, which disturb each other, which look alike.

use super::model::Fit;

/// Structure in the residual above which a shadow is no sphere's, as a share of its depth.
pub(super) const MOST_MISFIT: f64 = 0.17;
/// First fits so near to each other, in radii, and of radii so alike are of one shadow.
const ALIKE_RADII: f64 = 0.15;
/// Share of a shadow's significance below which a neighbour is too doubtful to be taken out of it.
pub(super) const DISTURBING: f64 = 0.2;
/// Error of a centre as a share of the radius where two shadows lie over each other entirely: shadows of 14 px at one radius from each other
/// were off by 1.7 to 2.5 px.
const OVERLAP_SHARE: f64 = 0.25;

/// Whether two fits are of one shadow.
pub(super) fn same(a: &Fit, b: &Fit) -> bool {
    (a.u_px - b.u_px).hypot(a.v_px - b.v_px) < 0.5 * a.radius_px.max(b.radius_px)
}

/// Whether the shadow of `b` reaches into that of `a`.
pub(super) fn overlap(a: &Fit, b: &Fit) -> bool {
    let distance = (a.u_px - b.u_px).hypot(a.v_px - b.v_px);
    distance > 0.0 && b.snr > DISTURBING * a.snr && distance < a.radius_px + b.radius_px + a.blur_px + b.blur_px
}

/// Standard deviation that neighbours add to a centre: how far two shadows lie over each other, 0 to 1, times a share of the radius. What is
/// fitted to one of them is in part the other.
pub(super) fn disturbed_px(fit: &Fit, fits: &[Fit]) -> f64 {
    let over = |other: &&Fit| {
        let distance = (fit.u_px - other.u_px).hypot(fit.v_px - other.v_px);
        1.0 - distance / (fit.radius_px + other.radius_px)
    };
    let deepest = fits.iter().filter(|other| overlap(fit, other)).map(|other| over(&other)).fold(0.0, f64::max);
    OVERLAP_SHARE * deepest * fit.radius_px
}

/// How much a fit explains.
fn worth(fit: &Fit) -> f64 {
    fit.snr * (1.1 - fit.misfit / MOST_MISFIT)
}

/// Of first fits that went to the same shadow from blobs of several sizes, the best one: the others would end where it does.
pub(super) fn once_per_place(mut screened: Vec<Option<Fit>>) -> Vec<Option<Fit>> {
    let mut order: Vec<usize> = (0..screened.len()).collect();
    let rank = |first: &Option<Fit>| first.as_ref().map_or(f64::NEG_INFINITY, worth);
    order.sort_by(|a, b| rank(&screened[*b]).total_cmp(&rank(&screened[*a])));
    let mut taken: Vec<Fit> = Vec::new();
    for index in order {
        let Some(fit) = screened[index] else { continue };
        let alike = |other: &Fit| {
            let apart_px = (fit.u_px - other.u_px).hypot(fit.v_px - other.v_px);
            apart_px < ALIKE_RADII * fit.radius_px.min(other.radius_px)
                && (fit.radius_px / other.radius_px).ln().abs() < ALIKE_RADII
        };
        if taken.iter().any(alike) {
            screened[index] = None;
        } else {
            taken.push(fit);
        }
    }
    screened
}

/// One fit per place: the one that explains most.
pub(super) fn distinct(mut fits: Vec<Fit>) -> Vec<Fit> {
    fits.sort_by(|a, b| worth(b).total_cmp(&worth(a)));
    let mut kept: Vec<Fit> = Vec::new();
    for fit in fits {
        if !kept.iter().any(|other| same(other, &fit)) {
            kept.push(fit);
        }
    }
    kept
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::beads::flags::Flags;
    use crate::beads::model::Model;

    fn fit(u_px: f64, radius_px: f64, snr: f64) -> Fit {
        Fit {
            model: Model::Transmission,
            u_px,
            v_px: 30.0,
            radius_px,
            radius_sigma_ln: 0.02,
            blur_px: 0.8,
            contrast: 1.0,
            depth: 1.0,
            snr,
            covariance_px2: [[1e-4, 0.0], [0.0, 1e-4]],
            chi2_per_dof: 1.0,
            dof: 500.0,
            misfit: 0.02,
            coverage: 1.0,
            structure_px: 0.0,
            flags: Flags::default(),
        }
    }

    #[test]
    fn of_first_fits_that_agree_the_best_goes_on_and_those_beside_it_as_well() {
        let screened = vec![
            Some(fit(20.0, 8.0, 30.0)),
            // The same shadow from larger blobs.
            Some(fit(20.5, 8.6, 50.0)),
            None,
            // A smaller shadow in its middle, one beside it, and one that is no number.
            Some(fit(20.4, 5.0, 9.0)),
            Some(fit(23.0, 8.2, 20.0)),
            Some(fit(f64::NAN, 8.0, 40.0)),
        ];
        let left: Vec<bool> = once_per_place(screened).iter().map(Option::is_some).collect();
        assert_eq!(left, [false, true, false, true, true, true]);
    }
}
