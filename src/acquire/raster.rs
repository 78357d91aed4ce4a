//! PNG and TIFF: grey samples, and the meaning that a sidecar `IMAGE.tif.json` gives them.

use std::io::Cursor;

use image::DynamicImage;
use tiff::tags::Tag;

use super::{Fault, FrameTags, PLATEAU_SHARE, Raw, Settings, check_image, check_total, whole};
use crate::foreign::Limits;
use crate::geometry::{ConsoleGeometry, Flip};
use crate::image::{Image, WHITE_IS_ZERO};

/// Reads a grey PNG.
pub(super) fn read_png(bytes: &[u8], settings: &Settings, limits: &Limits) -> Result<Raw, Fault> {
    let [width, height] = whole::png_size(bytes)?;
    check_image(width, height, limits)?;
    whole::check_png_end(bytes)?;
    // The decoder's own words stay here, because they may repeat what the file says.
    let broken = |_| Fault::Raster { kind: "PNG".into(), detail: "its compressed pixels do not decode".into() };
    let mut reader = image::ImageReader::with_format(Cursor::new(bytes), image::ImageFormat::Png);
    reader.no_limits();
    let decoded = reader.decode().map_err(broken)?;
    let (width, height) = (decoded.width() as usize, decoded.height() as usize);
    let mut notes = Vec::new();
    let (pixels, high): (Vec<f32>, f32) = match decoded {
        DynamicImage::ImageLuma8(grey) => (grey.into_raw().into_iter().map(f32::from).collect(), 255.0),
        DynamicImage::ImageLuma16(grey) => (grey.into_raw().into_iter().map(f32::from).collect(), 65535.0),
        DynamicImage::ImageLumaA8(grey) => {
            notes.push("the alpha channel was ignored".into());
            (grey.pixels().map(|pixel| f32::from(pixel.0[0])).collect(), 255.0)
        }
        DynamicImage::ImageLumaA16(grey) => {
            notes.push("the alpha channel was ignored".into());
            (grey.pixels().map(|pixel| f32::from(pixel.0[0])).collect(), 65535.0)
        }
        DynamicImage::ImageRgb8(colour) if colour.pixels().all(|p| p.0[0] == p.0[1] && p.0[1] == p.0[2]) => {
            notes.push("stored in colour, but every pixel is grey".into());
            (colour.pixels().map(|pixel| f32::from(pixel.0[0])).collect(), 255.0)
        }
        other => return Err(Fault::Colour { found: format!("{:?}", other.color()) }),
    };
    Ok(raw(Image { width, height, pixels }, Some([0.0, high]), settings, notes))
}

/// Reads every page of a grey TIFF; `start` hears how many there are, then `take` gets them in order.
pub(super) fn read_tiff(
    bytes: &[u8],
    settings: &Settings,
    limits: &Limits,
    start: &mut dyn FnMut(usize),
    take: &mut dyn FnMut(Raw) -> Result<(), Fault>,
) -> Result<(), Fault> {
    let pages = check_pages(bytes, limits)?;
    start(pages);
    let mut decoder = tiff::decoder::Decoder::new(Cursor::new(bytes)).map_err(fault)?;
    for page in 0..pages {
        if page > 0 {
            decoder.next_image().map_err(fault)?;
        }
        let (width, height) = decoder.dimensions().map_err(fault)?;
        let colour = decoder.colortype().map_err(fault)?;
        let unsupported = || Fault::Samples { found: format!("{colour:?}") };
        let (pixels, ends): (Vec<f32>, Option<[f32; 2]>) = match decoder.read_image().map_err(fault)? {
            tiff::decoder::DecodingResult::U8(values) => (values.into_iter().map(f32::from).collect(), Some([0.0, 255.0])),
            tiff::decoder::DecodingResult::U16(values) => (values.into_iter().map(f32::from).collect(), Some([0.0, 65535.0])),
            tiff::decoder::DecodingResult::I16(values) => {
                (values.into_iter().map(f32::from).collect(), Some([-32768.0, 32767.0]))
            }
            tiff::decoder::DecodingResult::F32(values) => (values, None),
            _ => return Err(unsupported()),
        };
        let image = Image::from_pixels(width as usize, height as usize, pixels).ok_or_else(unsupported)?;
        let order = decoder.find_tag_unsigned::<u16>(Tag::Orientation).map_err(fault)?.unwrap_or(1);
        let (image, altered) = as_shown(image, order);
        let mut raw = Raw { altered, ..raw(image, ends, settings, Vec::new()) };
        if decoder.find_tag_unsigned::<u16>(Tag::PhotometricInterpretation).map_err(fault)? == Some(WHITE_IS_ZERO) {
            from_white(&mut raw);
        }
        // Of logarithms the most signal is at 0, whatever the other end is.
        if raw.scale_ends.is_none() && raw.domain != super::Domain::Log {
            raw.scale_ends = ends_of_digits(&raw.pixels.pixels);
            // Air that is flat because somebody scaled it to there looks alike.
            raw.notes.extend(raw.scale_ends.map(|[low, high]| {
                format!(
                    "the values are floats without ends of their own, and many stand at {high}, the most that {} bits hold: {low} and {high} are taken \
                     for the ends, and what stands at {high} for saturated; where it is air that was scaled to there, scale it to another value",
                    (high + 1.0).log2()
                )
            }));
        }
        take(raw)?;
    }
    Ok(())
}

/// Bits of a pixel's digits.
const BITS: std::ops::RangeInclusive<u32> = 8..=16;

/// The ends of the digits that values kept as floats were before, where they end in a spike at the highest of them.
fn ends_of_digits(pixels: &[f32]) -> Option<[f32; 2]> {
    let high = pixels.iter().copied().fold(f32::MIN, f32::max);
    let is_end = BITS.map(|bits| ((1u32 << bits) - 1) as f32).any(|end| end == high);
    let is_counted = is_end && pixels.iter().all(|value| !(*value < 0.0));
    let spike = pixels.iter().filter(|value| **value == high).count();
    (is_counted && spike as f64 >= PLATEAU_SHARE * pixels.len() as f64).then_some([0.0, high])
}

/// Says what the decoder did to values whose zero is white: it turned them round, integers about the ends of their type and floats about 1/2.
/// That is undone where the numbers mean something by themselves: as with MONOCHROME1 of DICOM, grey levels and signals stand the other way
/// round than what is stored, logarithms as they are stored.
fn from_white(raw: &mut Raw) {
    const SAID: &str = "TIFF photometric interpretation (tag 262) is 0, white is zero";
    let ends = raw.scale_ends.map(|ends| ends.map(f64::from));
    let about = ends.map_or(1.0, |[low, high]| low + high);
    raw.altered.push(match ends {
        Some([low, high]) if raw.domain != super::Domain::Log => {
            raw.turned_about = Some(about);
            format!(
                "{SAID}: turned round about {low} and {high}, the ends of what can be stored; nothing says at which value there is no signal"
            )
        }
        _ => {
            raw.pixels.pixels.iter_mut().for_each(|value| *value = (about - f64::from(*value)) as f32);
            // The smallest step of a float that survives the way there and back.
            let good_to = if ends.is_none() { format!(", good to {:.0e}", f32::EPSILON / 2.0) } else { String::new() };
            format!("{SAID}: the stored values were taken as they are{good_to}")
        }
    });
}

/// The picture that the file asks to be shown, of pixels stored in this order (TIFF 6.0, tag 274), and what was done for it: a picture's
/// columns and rows are those that people, poses and a declared console speak of, not those in which some program wrote it down.
fn as_shown(stored: Image<f32>, order: u16) -> (Image<f32>, Vec<String>) {
    // Clockwise, then mirrored, from the picture to what is stored.
    let (rotation_deg, flip, start) = match order {
        1 => return (stored, Vec::new()),
        2 => (0.0, Flip::Horizontal, "top right"),
        3 => (180.0, Flip::None, "bottom right"),
        4 => (0.0, Flip::Vertical, "bottom left"),
        5 => (90.0, Flip::Horizontal, "top left, columns first"),
        6 => (270.0, Flip::None, "top right, columns first"),
        7 => (270.0, Flip::Horizontal, "bottom right, columns first"),
        8 => (90.0, Flip::None, "bottom left, columns first"),
        _ => {
            let words =
                format!("TIFF orientation (tag 274) is {order}, expected 1 to 8: the pixels were taken in the order of the file");
            return (stored, vec![words]);
        }
    };
    let words = format!(
        "TIFF orientation (tag 274) is {order}, stored from the {start}: the pixels were put in the order in which the picture is shown, \
         and columns and rows are counted there"
    );
    let console = ConsoleGeometry { rotation_deg, flip, ..ConsoleGeometry::default() };
    (console.orient(&stored, false), vec![words])
}

/// Looks at all pages before any is decoded: how many, how large, and whether their strips are in the file.
fn check_pages(bytes: &[u8], limits: &Limits) -> Result<usize, Fault> {
    let mut decoder = tiff::decoder::Decoder::new(Cursor::new(bytes)).map_err(fault)?;
    let (mut pages, mut pixels) = (0u64, 0u64);
    loop {
        let (width, height) = decoder.dimensions().map_err(fault)?;
        check_image(width.into(), height.into(), limits)?;
        pages += 1;
        pixels += u64::from(width) * u64::from(height);
        check_total(pages, pixels, limits)?;
        let colour = decoder.colortype().map_err(fault)?;
        if !matches!(colour, tiff::ColorType::Gray(_)) {
            return Err(Fault::Colour { found: format!("{colour:?}") });
        }
        let (offsets, counts) = match decoder.get_chunk_type() {
            tiff::decoder::ChunkType::Strip => (Tag::StripOffsets, Tag::StripByteCounts),
            tiff::decoder::ChunkType::Tile => (Tag::TileOffsets, Tag::TileByteCounts),
        };
        let (offsets, counts) =
            (decoder.get_tag_u64_vec(offsets).map_err(fault)?, decoder.get_tag_u64_vec(counts).map_err(fault)?);
        whole::check_strips(&offsets, &counts, bytes.len() as u64)?;
        if !decoder.more_images() {
            return Ok(pages as usize);
        }
        decoder.next_image().map_err(fault)?;
    }
}

/// What the decoder found; its own words stay here, because they may repeat what the file says.
fn fault(error: tiff::TiffError) -> Fault {
    let damaged = |detail: &str| Fault::Raster { kind: "TIFF".into(), detail: detail.into() };
    match error {
        tiff::TiffError::UnsupportedError(_) => Fault::Samples { found: "of a kind or compression that is not read".into() },
        tiff::TiffError::IoError(_) => damaged("it ends early"),
        tiff::TiffError::LimitsExceeded | tiff::TiffError::IntSizeError => {
            damaged("its header asks for more than any image takes")
        }
        _ => damaged("its structure is not that of a TIFF"),
    }
}

fn raw(pixels: Image<f32>, scale_ends: Option<[f32; 2]>, settings: &Settings, mut notes: Vec<String>) -> Raw {
    let beside = &settings.beside;
    let mut evidence = beside.evidence.clone();
    let tags = FrameTags { pitch_mm: beside.pitch_mm, ..FrameTags::default() };
    if let Some(declared) = settings.domain {
        evidence.insert(0, format!("declared by the user: {declared}"));
    } else if beside.domain == super::Domain::Unknown {
        notes.push("nothing states what the values mean; say so with --domain".into());
    }
    let domain = settings.domain.unwrap_or(beside.domain);
    let unit = if domain == beside.domain { beside.unit.clone() } else { None };
    Raw {
        pixels,
        domain,
        evidence,
        unit,
        turned_about: None,
        unmirrored: false,
        tags,
        scale_ends,
        padded: 0,
        altered: Vec::new(),
        notes,
    }
}
