//! Photographs of marks beside the detector: JPEG, or PNG with 8 bits.

use std::io::Cursor;

use image::ImageFormat;

use super::{Domain, Fault, FileKind, FrameTags, Raw, check_image, whole};
use crate::foreign::Limits;
use crate::image::Image;

const JPEG_START: &[u8] = b"\xff\xd8\xff";
/// Where a PNG's header says how many bits a sample has.
const PNG_BITS: usize = 24;

/// Whether [`read`] is the one to read it. A PNG of 16 bits is a frame.
pub(super) fn is_photo(bytes: &[u8]) -> bool {
    bytes.starts_with(JPEG_START) || FileKind::of(bytes) == FileKind::Png && bytes.get(PNG_BITS) == Some(&8)
}

/// The brightness (ITU-R BT.709) of each pixel, as stored: an orientation noted beside the pixels is not applied.
pub(super) fn read(bytes: &[u8], limits: &Limits) -> Result<Raw, Fault> {
    let (format, kind) = if bytes.starts_with(JPEG_START) { (ImageFormat::Jpeg, "JPEG") } else { (ImageFormat::Png, "PNG") };
    // The decoder's own words stay here, because they may repeat what the file says.
    let broken = |_| Fault::Raster { kind: kind.into(), detail: "its compressed pixels do not decode".into() };
    if format == ImageFormat::Png {
        whole::check_png_end(bytes)?;
    }
    let (width, height) = image::ImageReader::with_format(Cursor::new(bytes), format).into_dimensions().map_err(broken)?;
    check_image(width.into(), height.into(), limits)?;
    let mut reader = image::ImageReader::with_format(Cursor::new(bytes), format);
    reader.no_limits();
    let luma = reader.decode().map_err(broken)?.into_luma8();
    let pixels = luma.into_raw().into_iter().map(f32::from).collect();
    Ok(Raw {
        pixels: Image { width: width as usize, height: height as usize, pixels },
        domain: Domain::Display,
        evidence: vec![format!("a photograph ({kind})")],
        unit: None,
        turned_about: None,
        unmirrored: false,
        tags: FrameTags::default(),
        scale_ends: Some([0.0, 255.0]),
        padded: 0,
        altered: Vec::new(),
        notes: Vec::new(),
    })
}
