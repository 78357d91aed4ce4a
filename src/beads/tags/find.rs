//! Looks for tags in a frame.

use std::cmp::Ordering;

use glam::DVec2;

use super::family::Family;
use super::seen::{SeenTag, TagsError};
use super::{decoder, grey};
use crate::acquire::Frame;
use crate::image::Image;

/// Mean distance of the bits from the threshold, in 256 steps of the window, below which a reading is taken for noise.
const LEAST_MARGIN: f64 = 12.0;
/// Blur, px, with which quadrilaterals are sought: none first, then some against quantum noise.
const SIGMAS_PX: [f32; 2] = [0.0, 0.8];
/// In larger pictures, which are photographs, one look without blur is enough where it finds anything.
const MOST_PIXELS: usize = 4_000_000;
/// Readings whose centres lie closer, in shares of the side, are of one tag.
const SAME: f64 = 0.5;

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
