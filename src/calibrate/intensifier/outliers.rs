//! Spots that do not belong: how far off one may be.

/// Spots further off than so many standard deviations, per axis and robustly measured, are left out …
const OUTLIER: f64 = 5.0;
/// … but none that are nearer than this: what the polynomial itself cannot follow at the rim belongs into the figure.
const LEAST_OUTLIER_PX: f64 = 1.0;
/// One in so many is left out at a time.
const AT_A_TIME: usize = 50;
/// Median length of a vector of two standard normals: √(2 ln 2).
const MEDIAN_LENGTH: f64 = 1.177_410_022_515_474_6;

/// The distance from its place up to which a spot stays this time, px, from how far all are off; `None` without any.
pub fn limit_px(off_px: impl Iterator<Item = f64>) -> Option<f64> {
    let mut lengths: Vec<f64> = off_px.collect();
    lengths.sort_by(f64::total_cmp);
    let sigma_px = lengths.get(lengths.len() / 2)? / MEDIAN_LENGTH;
    let most = (lengths.len() / AT_A_TIME).max(1);
    let worst_that_stays_px = lengths[(lengths.len() - 1).saturating_sub(most)];
    Some((OUTLIER * sigma_px).max(LEAST_OUTLIER_PX).max(worst_that_stays_px))
}
