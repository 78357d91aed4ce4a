//! The tags that a frame shows.

use std::cmp::Ordering;

use glam::DVec2;

use super::{Family, decoder, grey};
use crate::acquire::Frame;
use crate::image::Image;

/// The corners in the tag's frame, in halves of its side, in the order in which they are listed everywhere: lower left, lower right,
/// upper right, upper left of the tag as it is read.
pub const CORNERS: [[f64; 2]; 4] = [[-1.0, 1.0], [1.0, 1.0], [1.0, -1.0], [-1.0, -1.0]];

/// Mean distance of the bits from the threshold, in 256 steps of the window, below which a reading is taken for noise.
const LEAST_MARGIN: f64 = 12.0;
/// Blur, px, with which quadrilaterals are sought: none first, then some against quantum noise.
const SIGMAS_PX: [f32; 2] = [0.0, 0.8];
/// In larger pictures, which are photographs, one look without blur is enough where it finds anything.
const MOST_PIXELS: usize = 4_000_000;
/// Readings whose centres lie closer, in shares of the side, are of one tag.
const SAME: f64 = 0.5;

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

/// All tags of one family in a frame, by id and place. Dark on light and light on dark, in the plain window and in one from which the
/// neighbourhood's mean is taken off; in the mirror image only where nothing reads as it is.
///
/// # Errors
/// When this build has no decoder, or it fails.
pub fn find_tags(frame: &Frame, family: Family) -> Result<Vec<SeenTag>, TagsError> {
    let values = grey::values(frame);
    let plain = grey::windowed(&values);
    let mut found = Vec::new();
    if plain.pixels.len() > MOST_PIXELS {
        found = in_views(std::slice::from_ref(&plain), &SIGMAS_PX[..1], family)?;
    }
    let views = [plain, grey::windowed(&grey::flattened(&values))];
    if found.is_empty() {
        found = in_views(&views, &SIGMAS_PX, family)?;
    }
    if found.is_empty() {
        let last = frame.size_px[0].saturating_sub(1) as f64;
        found = in_views(&views.each_ref().map(grey::mirrored), &SIGMAS_PX, family)?;
        for tag in &mut found {
            let back = |p: DVec2| DVec2::new(last - p.x, p.y);
            *tag =
                SeenTag { mirrored: true, centre_px: back(tag.centre_px), corners_px: tag.corners_px.map(back), ..tag.clone() };
        }
    }
    let order = |a: &SeenTag, b: &SeenTag| -> Ordering {
        let place = a.centre_px.y.total_cmp(&b.centre_px.y).then(a.centre_px.x.total_cmp(&b.centre_px.x));
        a.id.cmp(&b.id).then(place)
    };
    found.sort_by(order);
    Ok(found)
}

fn in_views(views: &[Image<u8>], sigmas_px: &[f32], family: Family) -> Result<Vec<SeenTag>, TagsError> {
    let mut found: Vec<SeenTag> = Vec::new();
    for view in views {
        for inverted in [false, true] {
            let turned = inverted.then(|| grey::inverted(view));
            for sigma_px in sigmas_px {
                for tag in decoder::decode(turned.as_ref().unwrap_or(view), family, *sigma_px)? {
                    let apart = |other: &SeenTag| tag.centre_px.distance(other.centre_px) > SAME * tag.side_px();
                    if tag.margin >= LEAST_MARGIN && found.iter().all(apart) {
                        found.push(SeenTag { inverted, ..tag });
                    }
                }
            }
        }
    }
    Ok(found)
}
