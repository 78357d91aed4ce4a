//! Pictures that `compare` is given beside the acquired frame: the simulated one, and what is left out of both.

use std::path::Path;

use super::compare_error::CompareCommandError;
use crate::foreign::read_small;
use crate::geometry::ConsoleGeometry;
use crate::image::{Image, beside, read_tiff_f32};

/// Of a mask with transparent pixels: programs draw both what is left out and what is kept so.
const TRANSPARENT: &str = "it is transparent in places, which says neither what is left out nor what is kept; flatten it: white where pixels are left \
                           out, black elsewhere";
/// Of a mask without a pixel that is not zero.
const EXCLUDES_NONE: &str = "the mask excludes no pixel: what is not zero is left out, and all of it is zero";

/// What `render` wrote about an image; null where there is nothing.
pub(super) fn described(path: &Path) -> serde_json::Value {
    let bytes = read_small(&beside(path, "json")).ok();
    bytes.and_then(|bytes| serde_json::from_slice(&bytes).ok()).unwrap_or_default()
}

/// The simulated line integral; what has no logarithm is NaN.
pub(super) fn read_simulated(path: &Path, quantity: Option<&str>) -> Result<Image<f32>, CompareCommandError> {
    let described = described(path)["quantity"].as_str().map(str::to_owned);
    if let (Some(declared), Some(found)) = (quantity, described.clone())
        && declared != found
    {
        return Err(CompareCommandError::OtherQuantity { path: path.to_owned(), declared: declared.to_owned(), found });
    }
    let found = quantity.map(str::to_owned).or(described).unwrap_or_else(|| "not known".into());
    let mut pages = read_tiff_f32(path)?;
    let image = match (pages.len(), pages.pop()) {
        (1, Some(image)) => image,
        (found, _) => return Err(CompareCommandError::Pages { path: path.to_owned(), found }),
    };
    match found.as_str() {
        "line_integral" => Ok(image),
        "intensity" => Ok(image.map(|&i| if i > 0.0 { -i.ln() } else { f32::NAN })),
        _ => Err(CompareCommandError::Quantity { path: path.to_owned(), found }),
    }
}

/// What `render` writes beside an image where some pixels are invalid, or show a guess: 1 where the picture is white.
pub(super) fn read_flags(path: &Path) -> Result<Option<Image<u8>>, CompareCommandError> {
    if !path.exists() {
        return Ok(None);
    }
    Ok(Some(read_mask(path)?.map(|valid| u8::from(*valid))))
}

/// True where a pixel is not zero.
pub(super) fn read_mask(path: &Path) -> Result<Image<bool>, CompareCommandError> {
    let unreadable = |detail: String| CompareCommandError::Mask { path: path.to_owned(), detail };
    let bytes = read_small(path).map_err(|source| CompareCommandError::Io { path: path.to_owned(), source })?;
    // An image of our own kind has floating-point pixels, which nobody's pictures have.
    if let Ok(mut pages) = read_tiff_f32(path) {
        return match (pages.len(), pages.pop()) {
            (1, Some(page)) => Ok(page.map(|value| *value != 0.0)),
            (found, _) => Err(CompareCommandError::Pages { path: path.to_owned(), found }),
        };
    }
    let decoded = image::load_from_memory(&bytes).map_err(|error| unreadable(error.to_string()))?;
    if decoded.color().has_alpha() && decoded.to_luma_alpha16().pixels().any(|pixel| pixel.0[1] != u16::MAX) {
        return Err(unreadable(TRANSPARENT.to_owned()));
    }
    let decoded = decoded.to_luma16();
    let (width, height) = (decoded.width() as usize, decoded.height() as usize);
    let pixels = decoded.into_raw().into_iter().map(|value| value != 0).collect();
    Image::from_pixels(width, height, pixels).ok_or_else(|| unreadable("pixels are missing".into()))
}

/// A mask drawn over the acquired frame as its file stores it, `stored_px` columns and rows, put in the order in which the frame is compared,
/// and what was done to it. One of another size is taken as it is.
pub(super) fn mask_as_compared(
    mask: Image<bool>,
    stored_px: [usize; 2],
    unmirrored: bool,
    console: Option<&ConsoleGeometry>,
) -> (Image<bool>, Option<String>) {
    if [mask.width, mask.height] != stored_px {
        return (mask, None);
    }
    let mut compared = mask.clone();
    if unmirrored {
        compared.pixels.chunks_exact_mut(mask.width).for_each(<[bool]>::reverse);
    }
    if let Some(console) = console {
        compared = console.orient(&compared, unmirrored);
    }
    let words = "the mask was turned as the frame was: it is taken as drawn over the frame as it is stored";
    let moved = (compared != mask).then(|| words.to_owned());
    (compared, moved)
}

/// What to say of a mask that leaves everything in: somebody meant it to leave something out.
pub(super) fn excludes_none(mask: &Image<bool>) -> Option<&'static str> {
    (!mask.pixels.contains(&true)).then_some(EXCLUDES_NONE)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::geometry::Flip;

    #[test]
    fn an_image_of_our_own_kind_is_a_mask_as_well() {
        let folder = tempfile::tempdir().expect("folder");
        let path = folder.path().join("mask.tif");
        let mut drawn = Image::filled(6, 4, 0.0f32);
        (*drawn.at_mut(1, 0), *drawn.at_mut(2, 3)) = (0.25, f32::NAN);
        crate::image::write_tiff_f32(&path, std::slice::from_ref(&drawn)).expect("writes");
        let mask = read_mask(&path).expect("one page");
        assert!(*mask.at(1, 0) && *mask.at(2, 3) && mask.pixels.iter().filter(|excluded| **excluded).count() == 2);
        std::fs::write(&path, b"no picture").expect("writes");
        assert!(read_mask(&path).is_err_and(|error| error.to_string().contains("not a readable mask")));
    }

    #[test]
    fn a_mask_goes_with_the_frame_that_it_was_drawn_over() {
        let mut drawn = Image::filled(6, 4, false);
        *drawn.at_mut(1, 0) = true;
        let (as_it_is, words) = mask_as_compared(drawn.clone(), [6, 4], false, None);
        assert!(as_it_is == drawn && words.is_none());
        let (mirrored, words) = mask_as_compared(drawn.clone(), [6, 4], true, None);
        assert!(*mirrored.at(4, 0) && !*mirrored.at(1, 0) && words.is_some());
        // The console says the same of the columns as the file: that is undone once.
        let flipped = ConsoleGeometry { flip: Flip::Horizontal, ..ConsoleGeometry::default() };
        let (once, _) = mask_as_compared(drawn.clone(), [6, 4], true, Some(&flipped));
        assert!(*once.at(4, 0));
        let about = ConsoleGeometry { rotation_deg: 180.0, ..ConsoleGeometry::default() };
        let (turned, words) = mask_as_compared(drawn.clone(), [6, 4], false, Some(&about));
        assert!(*turned.at(4, 3) && words.is_some());
        // Of the simulated image's size.
        let (other, words) = mask_as_compared(drawn.clone(), [12, 8], true, Some(&about));
        assert!(other == drawn && words.is_none());
    }

    /// Only the colour was looked at: black strokes on a transparent ground left nothing out, and a transparent ground that was white left out all.
    #[test]
    fn a_mask_with_transparent_pixels_is_refused_and_an_opaque_one_is_read() {
        let folder = tempfile::tempdir().expect("folder");
        let path = folder.path().join("mask.png");
        let written = |alpha: u8| {
            let mut drawn = image::RgbaImage::from_pixel(6, 4, image::Rgba([0, 0, 0, alpha]));
            drawn.put_pixel(1, 0, image::Rgba([255, 255, 255, 255]));
            drawn.save(&path).expect("writes");
            read_mask(&path)
        };
        let mask = written(255).expect("opaque");
        assert!(*mask.at(1, 0) && excludes_none(&mask).is_none());
        assert_eq!(mask.pixels.iter().filter(|excluded| **excluded).count(), 1);
        for alpha in [0, 254] {
            let error = written(alpha).expect_err("transparent").to_string();
            assert!(error.contains("mask.png") && error.contains("flatten it"), "{alpha}: {error}");
        }
        assert!(excludes_none(&Image::filled(6, 4, false)).is_some_and(|words| words.contains("excludes no pixel")));
    }
}
