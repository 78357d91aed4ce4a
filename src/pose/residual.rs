//! The part of each bead and each tag in a pose, and by how much the pose misses it.

use glam::DVec3;
use serde::de::Error as _;
use serde::{Deserialize, Deserializer, Serialize};

use crate::beads::tags::Family;
use crate::beads::{Detection, PlaceCovariance, is_covariance_px2};

/// A bead's part in a pose.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct BeadResidual {
    /// As in the layout.
    pub name: String,
    /// The rigid part it is fixed to.
    pub body: String,
    /// Its place in the layout.
    pub lps_mm: DVec3,
    /// Covariance of that place, where the layout states one, or a standard deviation.
    #[serde(skip_serializing_if = "Option::is_none", default)]
    pub covariance_mm2: Option<PlaceCovariance>,
    /// Its projection as observed (bias of the shadow's centre corrected); absent when no shadow was matched.
    pub image_px: Option<[f64; 2]>,
    /// Where P puts it.
    pub predicted_px: Option<[f64; 2]>,
    /// Observed minus predicted.
    pub residual_px: Option<[f64; 2]>,
    /// Standard deviation of the observed centre per axis, the mean of both.
    pub sigma_px: Option<f64>,
    /// Covariance of the observed centre, columns and rows, from the image alone. A file that states one that is none cannot be read.
    #[serde(skip_serializing_if = "Option::is_none", default, deserialize_with = "covariance_px2")]
    pub covariance_px2: Option<[[f64; 2]; 2]>,
    /// Observed minus predicted by the pose of all other used beads: what an unseen point would have shown.
    pub left_out_px: Option<[f64; 2]>,
    /// Of a bead without a shadow: the shadow next to its place that is no other's, minus predicted. The bead may have moved.
    #[serde(skip_serializing_if = "Option::is_none", default)]
    pub beside_px: Option<[f64; 2]>,
    /// Of `left_out_px` where P rests on the bead, of `residual_px` or `beside_px` elsewhere: how many standard deviations of observation,
    /// place and prediction it is.
    #[serde(skip_serializing_if = "Option::is_none", default)]
    pub off_sigmas: Option<f64>,
    /// Whether P rests on it.
    pub used: bool,
    /// Why not, if not.
    pub reason: Option<String>,
    /// It has the role `check`.
    #[serde(skip_serializing_if = "std::ops::Not::not", default)]
    pub check: bool,
}

/// Reads a covariance of a centre, by rows in px², or none.
pub(super) fn covariance_px2<'de, D: Deserializer<'de>>(from: D) -> Result<Option<[[f64; 2]; 2]>, D::Error> {
    let stated = Option::<[[f64; 2]; 2]>::deserialize(from)?;
    match stated {
        Some(rows) if !is_covariance_px2(&rows) => {
            Err(D::Error::custom(format_args!("{rows:?} px² is no covariance: symmetric, and positive along every direction")))
        }
        stated => Ok(stated),
    }
}

/// uu, uv, vv of a centre whose covariance is stated and is one, else of `sigma_px` along both axes.
pub(super) fn noise_px2(stated: Option<[[f64; 2]; 2]>, sigma_px: f64) -> [f64; 3] {
    Detection { sigma_px, covariance_px2: stated.unwrap_or_default(), ..Detection::default() }.noise_px2()
}

impl BeadResidual {
    /// Covariance of the observed centre, uu, uv, vv in px²: as it is stated, else of `sigma_px` along both axes; `None` of no shadow.
    #[must_use]
    pub fn noise_px2(&self) -> Option<[f64; 3]> {
        self.sigma_px.map(|sigma_px| noise_px2(self.covariance_px2, sigma_px))
    }
}

/// A tag's part in a pose.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct TagResidual {
    /// Number in its family.
    pub id: u32,
    /// The family.
    pub family: Family,
    /// Lower left, lower right, upper right, upper left of the tag as it is read.
    pub corners_px: [[f64; 2]; 4],
    /// Mean distance of its bits from the threshold, in 256 steps of the window.
    pub margin: f64,
    /// It is light where the printed tag is dark.
    pub inverted: bool,
    /// It reads only in the mirror image.
    pub mirrored: bool,
    /// √mean(dx² + dy²) of its corners against P; absent without a pose, or when the tag is not listed.
    pub residual_px: Option<f64>,
    /// Whether it started the search or P rests on it, and P agrees with it.
    pub used: bool,
    /// Why not, if not.
    pub reason: Option<String>,
}
