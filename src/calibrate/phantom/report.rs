//! What is written of a measured phantom.

use serde::{Deserialize, Serialize};
use serde_json::Value;

use super::scale::Scale;
use crate::calibrate::beads::point_list;

/// A bead.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct MeasuredBead {
    /// bead-01 and on, by their place along the third axis.
    pub name: String,
    /// Its centre in the layout's own frame.
    pub mm: [f64; 3],
    /// Standard deviation per axis against the other beads, the scale's share included.
    pub sigma_mm: f64,
    /// The same, apart from the scale.
    pub shape_sigma_mm: f64,
    /// Of its centre against the other beads, the scale's share included.
    pub covariance_mm2: [[f64; 3]; 3],
    /// Shots that show it.
    pub shots: usize,
    /// √mean(dx² + dy²) of its shadows after the fit.
    pub rms_px: f64,
    /// The same, each shadow predicted by all others.
    pub left_out_px: f64,
}

/// A shot that the layout rests on.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ShotUsed {
    /// Its name.
    pub shot: String,
    /// Beads that it shows.
    pub beads: usize,
    /// Shadows that belong to no bead.
    pub strays: usize,
    /// √mean(dx² + dy²) of its beads after the fit, px.
    pub rms_px: f64,
    /// Its camera against where it was stated, in standard deviations, √mean over six numbers.
    pub camera_off_sigma: f64,
}

/// A shot that does not belong to the others.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct LeftOutShot {
    /// Which.
    pub shot: String,
    /// Why, in words.
    pub reason: String,
}

/// A bead that is not in the layout.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct LeftOutBead {
    /// About where it is, in the layout's own frame.
    pub mm: [f64; 3],
    /// Shots in which it was taken for one.
    pub shots: usize,
    /// Why, in words.
    pub reason: String,
}

/// A measured phantom.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Phantom {
    /// Where the axes come from and where the origin lies.
    pub frame: String,
    /// The beads.
    pub beads: Vec<MeasuredBead>,
    /// How well the size is known.
    pub scale: Scale,
    /// Root mean square standard deviation of the beads per axis, apart from the scale.
    pub shape_sigma_mm: f64,
    /// √mean(dx² + dy²) over all shadows after the fit.
    pub rms_px: f64,
    /// The same, each shadow predicted by all others: the headline.
    pub left_out_px: f64,
    /// Squares of the shadows over their degrees of freedom.
    pub chi2_per_dof: f64,
    /// Squares of the cameras against where they were stated, over their degrees of freedom.
    pub cameras_chi2_per_dof: f64,
    /// Squares of the cloud mirrored in depth over those of the layout; absent where its mirror image has no solution.
    pub mirrored_over_found: Option<f64>,
    /// log₁₀ of accidental matches expected.
    pub log10_chance: f64,
    /// Largest angle between two beams.
    pub beams_deg: f64,
    /// Shots used.
    pub shots: Vec<ShotUsed>,
    /// Shots left out.
    pub left_out_shots: Vec<LeftOutShot>,
    /// Beads left out.
    pub left_out_beads: Vec<LeftOutBead>,
    /// What speaks against the layout as one to register by.
    pub warnings: Vec<String>,
    /// Software that wrote it.
    pub version: String,
}

/// The document that 3D Slicer opens and `beads::read_markups` reads. A description holds `radius_mm` (where stated), `sigma_mm` per axis
/// with the scale's share and `shape_sigma_mm` without, the number of shots, the left-out error in px, and the covariance's six numbers
/// `xx:xy:xz:yy:yz:zz` in mm².
#[must_use]
pub fn markups(phantom: &Phantom, radius_mm: Option<f64>) -> Value {
    let radius = radius_mm.map_or_else(String::new, |mm| format!("radius_mm={mm:.3} "));
    let point = |bead: &MeasuredBead| {
        let [[xx, xy, xz], [_, yy, yz], [_, _, zz]] = bead.covariance_mm2;
        let covariance = [xx, xy, xz, yy, yz, zz].map(|value| format!("{value:.3e}")).join(":");
        let description = format!(
            "{radius}sigma_mm={:.4} shape_sigma_mm={:.4} shots={} left_out_px={:.3} scale_sigma={:.5} covariance_mm2={covariance} body=specimen",
            bead.sigma_mm, bead.shape_sigma_mm, bead.shots, bead.left_out_px, phantom.scale.sigma
        );
        (bead.name.clone(), bead.mm, description)
    };
    point_list(phantom.beads.iter().map(point))
}
