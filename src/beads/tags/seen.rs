//! The tags that a frame shows.

use glam::DVec2;

use super::family::Family;

/// The corners in the tag's frame, in halves of its side, in the order in which they are listed everywhere: lower left, lower right,
/// upper right, upper left of the tag as it is read.
pub const CORNERS: [[f64; 2]; 4] = [[-1.0, 1.0], [1.0, 1.0], [1.0, -1.0], [-1.0, -1.0]];

/// A tag in a frame.
#[derive(Clone, Debug, PartialEq, serde::Serialize)]
pub struct SeenTag {
    /// Number in its family.
    pub id: u32,
    /// The family.
    pub family: Family,
    /// Where its diagonals cross.
    pub centre_px: DVec2,
    /// Its corners, in the order of [`CORNERS`].
    pub corners_px: [DVec2; 4],
    /// Mean distance of its bits from the threshold, in 256 steps of the window.
    pub margin: f64,
    /// Bits that were put right.
    pub hamming: u32,
    /// It is light where the printed tag is dark.
    pub inverted: bool,
    /// It reads only in the mirror image: the frame is mirrored, or the tag is seen from behind. The corners are those of the frame as it is.
    pub mirrored: bool,
}

impl SeenTag {
    #[cfg(feature = "vision")]
    pub(super) fn is_finite(&self) -> bool {
        self.margin.is_finite() && self.centre_px.is_finite() && self.corners_px.iter().all(|corner| corner.is_finite())
    }

    /// Mean length of its sides.
    #[must_use]
    pub fn side_px(&self) -> f64 {
        (0..4).map(|n| self.corners_px[n].distance(self.corners_px[(n + 1) % 4])).sum::<f64>() / 4.0
    }
}

/// Why tags were not looked for.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum TagsError {
    /// Built without the feature `vision`.
    #[error("this build reads no tags: it was built without the feature `vision`")]
    NotBuilt,
    /// The library refused.
    #[error("the tag decoder failed: {detail}")]
    Library {
        /// What it said.
        detail: String,
    },
}
