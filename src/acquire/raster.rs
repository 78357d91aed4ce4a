//! PNG and TIFF: grey samples, and the meaning that a sidecar `IMAGE.tif.json` gives them.

use std::io::Cursor;
use std::path::{Path, PathBuf};

use image::DynamicImage;

use super::{AcquireError, Domain, FrameTags, Raw};
use crate::image::Image;

/// Reads a grey PNG.
pub(super) fn read_png(path: &Path, bytes: &[u8], declared: Option<Domain>) -> Result<Raw, AcquireError> {
    let decoded = image::load_from_memory_with_format(bytes, image::ImageFormat::Png).map_err(|error| AcquireError::Raster {
        path: path.to_owned(),
        kind: "PNG",
        detail: error.to_string(),
    })?;
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
        other => return Err(AcquireError::Colour { path: path.to_owned(), found: format!("{:?}", other.color()) }),
    };
    Ok(raw(path, Image { width, height, pixels }, Some([0.0, high]), declared, notes))
}

/// Reads every page of a grey TIFF.
pub(super) fn read_tiff(path: &Path, bytes: &[u8], declared: Option<Domain>) -> Result<Vec<Raw>, AcquireError> {
    let damaged = |error: tiff::TiffError| match error {
        tiff::TiffError::UnsupportedError(detail) => AcquireError::Samples { path: path.to_owned(), found: detail.to_string() },
        other => AcquireError::Raster { path: path.to_owned(), kind: "TIFF", detail: other.to_string() },
    };
    let mut decoder = tiff::decoder::Decoder::new(Cursor::new(bytes)).map_err(damaged)?;
    let mut pages = Vec::new();
    loop {
        let (width, height) = decoder.dimensions().map_err(damaged)?;
        let (width, height) = (width as usize, height as usize);
        if width == 0 || height == 0 {
            return Err(AcquireError::Empty { path: path.to_owned(), width, height });
        }
        let colour = decoder.colortype().map_err(damaged)?;
        if !matches!(colour, tiff::ColorType::Gray(_)) {
            return Err(AcquireError::Colour { path: path.to_owned(), found: format!("{colour:?}") });
        }
        let unsupported = || AcquireError::Samples { path: path.to_owned(), found: format!("{colour:?}") };
        let (pixels, ends): (Vec<f32>, Option<[f32; 2]>) = match decoder.read_image().map_err(damaged)? {
            tiff::decoder::DecodingResult::U8(values) => (values.into_iter().map(f32::from).collect(), Some([0.0, 255.0])),
            tiff::decoder::DecodingResult::U16(values) => (values.into_iter().map(f32::from).collect(), Some([0.0, 65535.0])),
            tiff::decoder::DecodingResult::I16(values) => {
                (values.into_iter().map(f32::from).collect(), Some([-32768.0, 32767.0]))
            }
            tiff::decoder::DecodingResult::F32(values) => (values, None),
            _ => return Err(unsupported()),
        };
        let page = Image::from_pixels(width, height, pixels).ok_or_else(unsupported)?;
        pages.push(raw(path, page, ends, declared, Vec::new()));
        if !decoder.more_images() {
            return Ok(pages);
        }
        decoder.next_image().map_err(damaged)?;
    }
}

/// Path of the sidecar that describes `path`: the file name with `.json` appended.
fn sidecar_path(path: &Path) -> PathBuf {
    let mut name = path.as_os_str().to_owned();
    name.push(".json");
    PathBuf::from(name)
}

fn raw(path: &Path, pixels: Image<f32>, scale_ends: Option<[f32; 2]>, declared: Option<Domain>, mut notes: Vec<String>) -> Raw {
    let mut evidence = Vec::new();
    let mut tags = FrameTags::default();
    let (described, unit) = match Sidecar::beside(path, &mut evidence) {
        Some(sidecar) => {
            tags.pitch_mm = sidecar.pitch_mm;
            (sidecar.domain, sidecar.unit)
        }
        None => (Domain::Unknown, None),
    };
    if let Some(declared) = declared {
        evidence.insert(0, format!("declared by the user: {declared}"));
    } else if described == Domain::Unknown {
        notes.push("nothing states what the values mean; say so with --domain".into());
    }
    let domain = declared.unwrap_or(described);
    let unit = if domain == described { unit } else { None };
    Raw { pixels, domain, evidence, unit, inverted: false, unmirrored: false, tags, scale_ends, notes }
}

/// What `IMAGE.tif.json` says.
struct Sidecar {
    domain: Domain,
    unit: Option<String>,
    pitch_mm: Option<[f64; 2]>,
}

impl Sidecar {
    fn beside(path: &Path, evidence: &mut Vec<String>) -> Option<Self> {
        let sidecar = sidecar_path(path);
        let name = sidecar.file_name().map(|name| name.to_string_lossy().into_owned()).unwrap_or_default();
        let text = match std::fs::read_to_string(&sidecar) {
            Ok(text) => text,
            Err(error) if error.kind() == std::io::ErrorKind::NotFound => {
                evidence.push("the file has no header for radiographs and no sidecar .json".into());
                return None;
            }
            Err(error) => {
                evidence.push(format!("{name} could not be read: {error}"));
                return None;
            }
        };
        let json: serde_json::Value = match serde_json::from_str(&text) {
            Ok(json) => json,
            Err(error) => {
                evidence.push(format!("{name} is not valid JSON: {error}"));
                return None;
            }
        };
        let Some(quantity) = json.get("quantity").and_then(serde_json::Value::as_str) else {
            evidence.push(format!("{name} names no quantity"));
            return None;
        };
        evidence.push(format!("{name} says quantity {quantity}"));
        let domain = match quantity {
            "intensity" | "counts" => Domain::Linear,
            "line_integral" => Domain::Log,
            _ => Domain::Unknown,
        };
        let unit = json.get("unit").and_then(serde_json::Value::as_str).map(str::to_owned);
        let pitch = ["/pitch_mm", "/detector/pitch_mm", "/view/pitch_mm"].iter().find_map(|at| json.pointer(at)?.as_f64());
        let pitch_mm = pitch.filter(|pitch| *pitch > 0.0).map(|pitch| [pitch, pitch]);
        Some(Self { domain, unit, pitch_mm })
    }
}
