//! The seam to the AprilTag library: 8-bit pixels in, quadrilaterals that decode out.

#[cfg(feature = "vision")]
use glam::DVec2;

use super::family::Family;
use super::seen::{SeenTag, TagsError};
use crate::image::Image;

/// Images smaller than this hold no tag, and the library's tiles do not fit into them.
const LEAST_SIDE_PX: usize = 24;
/// Larger images are searched for quadrilaterals at half the resolution; corners are refined on all pixels.
const MOST_PIXELS: usize = 3_000_000;
/// The library's first pixel has its corner at (0, 0), this program's its centre.
#[cfg(feature = "vision")]
const HALF_PIXEL: f64 = 0.5;

/// Finds and decodes tags of one family; `sigma_px` is the blur against noise while quadrilaterals are sought. The order of tags is the
/// library's.
#[cfg(feature = "vision")]
pub fn decode(grey: &Image<u8>, family: Family, sigma_px: f32) -> Result<Vec<SeenTag>, TagsError> {
    use apriltag::{DetectorBuilder, Image as GreyImage};

    if grey.width < LEAST_SIDE_PX || grey.height < LEAST_SIDE_PX {
        return Ok(Vec::new());
    }
    let library = |error: apriltag::Error| TagsError::Library { detail: error.to_string() };
    let mut image =
        GreyImage::zeros_with_alignment(grey.width, grey.height, apriltag::image_buf::DEFAULT_ALIGNMENT_U8).map_err(library)?;
    let stride = image.stride();
    for (row, own) in image.as_slice_mut().chunks_exact_mut(stride).zip(grey.pixels.chunks_exact(grey.width)) {
        row[..own.len()].copy_from_slice(own);
    }
    let named: apriltag::Family = family.as_str().parse().map_err(library)?;
    let mut detector = DetectorBuilder::new().add_family_bits(named, family.corrected_bits()).build().map_err(library)?;
    // One thread: with more of them the order of what is found depends on which is first.
    detector.set_thread_number(1);
    detector.set_decimation(if grey.width * grey.height > MOST_PIXELS { 2.0 } else { 1.0 });
    detector.set_refine_edges(true);
    detector.set_sigma(sigma_px);
    let place = |p: [f64; 2]| DVec2::from_array(p) - HALF_PIXEL;
    let found = detector.detect(&image);
    let tags = found.iter().filter_map(|tag| {
        let seen = SeenTag {
            id: u32::try_from(tag.id()).ok()?,
            family,
            centre_px: place(tag.center()),
            corners_px: tag.corners().map(place),
            margin: f64::from(tag.decision_margin()),
            hamming: u32::try_from(tag.hamming()).ok()?,
            inverted: false,
            mirrored: false,
        };
        seen.is_finite().then_some(seen)
    });
    Ok(tags.collect())
}

/// Without the feature `vision` nothing is read.
#[cfg(not(feature = "vision"))]
pub fn decode(grey: &Image<u8>, _family: Family, _sigma_px: f32) -> Result<Vec<SeenTag>, TagsError> {
    let _ = (grey, LEAST_SIDE_PX, MOST_PIXELS);
    Err(TagsError::NotBuilt)
}
