//! A detector calibration's maps: pixel by pixel, beside the JSON as a 32-bit TIFF, or packed into the text of a log.

use std::io::{Read, Write};
use std::path::Path;

use base64::Engine;
use serde::{Deserialize, Serialize};

use crate::image::{Image, read_tiff_f32, sha256_file};

/// Responds to less than half, or more than one and a half times, of what its neighbours see.
pub const DEAD: u8 = 1;
/// Dark signal far above its neighbours'.
pub const HOT: u8 = 2;
/// Varies from frame to frame far more than quanta and electronics explain.
pub const UNSTABLE: u8 = 4;
/// At the upper end of the frame's scale.
pub const SATURATED: u8 = 8;
/// Written into by the console, as declared.
pub const BURNED_IN: u8 = 16;
/// At the lower end of the frame's scale.
pub const AT_LOW_END: u8 = 32;

/// Maps at the panel's size. Shape: columns × rows of the calibration each.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct PanelMaps {
    /// Stored value without X-rays; one page or none.
    pub offset_value: Option<Image<f32>>,
    /// Signal of each beam with nothing in it, relative to its median over the panel; one page per beam that has a map.
    pub air_share: Vec<Image<f32>>,
    /// Flags [`DEAD`], [`HOT`], [`UNSTABLE`].
    pub bad: Option<Image<u8>>,
}

/// Why maps cannot be read.
#[derive(Debug, thiserror::Error)]
pub enum MapsError {
    /// The TIFF.
    #[error(transparent)]
    Image(#[from] crate::image::ImageFileError),
    /// The TIFF is another one than the JSON was written with.
    #[error(
        "{path} is not the file that the calibration was written with (SHA-256 {found}, expected {expected}); copy both again"
    )]
    Changed {
        /// The TIFF.
        path: String,
        /// Found.
        found: String,
        /// In the JSON.
        expected: String,
    },
    /// A page is missing, or has another size than the panel.
    #[error("{path}: {detail}")]
    Pages {
        /// The TIFF.
        path: String,
        /// What is wrong.
        detail: String,
    },
}

impl PanelMaps {
    /// Pages in the order of the TIFF: offset, bad pixels, then one per beam; always all of them.
    #[must_use]
    pub fn pages(&self, size_px: [usize; 2]) -> Vec<Image<f32>> {
        let [width, height] = size_px;
        let offset = self.offset_value.clone().unwrap_or_else(|| Image::filled(width, height, 0.0));
        let bad = self.bad.as_ref().map_or_else(|| Image::filled(width, height, 0.0), |bad| bad.map(|flag| f32::from(*flag)));
        [vec![offset, bad], self.air_share.clone()].concat()
    }

    /// Reads what [`PanelMaps::pages`] became; `sha256` is that of the file, `beams` the number of beams.
    ///
    /// # Errors
    /// When the file is missing, changed or damaged, or a page has another size.
    pub fn read(path: &Path, sha256: &str, size_px: [usize; 2], beams: usize) -> Result<Self, MapsError> {
        let shown = || path.file_name().unwrap_or_default().to_string_lossy().into_owned();
        let found = sha256_file(path)?;
        if found != sha256 {
            return Err(MapsError::Changed { path: shown(), found, expected: sha256.to_owned() });
        }
        let pages = read_tiff_f32(path)?;
        let wrong = |detail: String| MapsError::Pages { path: shown(), detail };
        if pages.len() != 2 + beams {
            return Err(wrong(format!("holds {} pages, expected {} (offset, bad pixels, one per beam)", pages.len(), 2 + beams)));
        }
        for (index, page) in pages.iter().enumerate() {
            if [page.width, page.height] != size_px {
                return Err(wrong(format!("page {index} is {}x{} px, the panel {size_px:?}", page.width, page.height)));
            }
            if let Some(at) = page.pixels.iter().position(|value| !value.is_finite()) {
                let (column, row) = (at % page.width, at / page.width);
                return Err(wrong(format!("page {index} is not finite at column {column}, row {row}")));
            }
        }
        let mut pages = pages.into_iter();
        let offset_value = pages.next();
        let bad = pages.next().map(|page| page.map(|flag| *flag as u8));
        Ok(Self { offset_value, bad, air_share: pages.collect() })
    }
}

/// One map as text: columns, rows, and base64 of deflated little-endian bytes, all first bytes before all second ones.
#[derive(Serialize, Deserialize)]
struct PackedMap {
    columns_px: usize,
    rows_px: usize,
    deflated_f32: String,
}

#[derive(Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct Packed {
    offset_value: Option<PackedMap>,
    air_share: Vec<PackedMap>,
    bad: Option<PackedMap>,
}

fn pack(map: &Image<f32>) -> std::io::Result<PackedMap> {
    let count = map.pixels.len();
    let mut planes = vec![0u8; 4 * count];
    for (at, value) in map.pixels.iter().enumerate() {
        for (byte, plane) in value.to_le_bytes().into_iter().zip(0..) {
            planes[plane * count + at] = byte;
        }
    }
    let mut encoder = flate2::write::ZlibEncoder::new(Vec::new(), flate2::Compression::fast());
    encoder.write_all(&planes)?;
    let deflated_f32 = base64::engine::general_purpose::STANDARD.encode(encoder.finish()?);
    Ok(PackedMap { columns_px: map.width, rows_px: map.height, deflated_f32 })
}

/// A panel has fewer pixels than this.
const MOST_PIXELS: usize = 1 << 26;

fn unpack(packed: &PackedMap) -> Result<Image<f32>, String> {
    let count = packed.columns_px.checked_mul(packed.rows_px).filter(|count| *count <= MOST_PIXELS);
    let count = count.ok_or_else(|| format!("a map of {}x{} px is larger than any panel", packed.columns_px, packed.rows_px))?;
    let deflated = base64::engine::general_purpose::STANDARD.decode(&packed.deflated_f32).map_err(|error| error.to_string())?;
    let mut planes = Vec::new();
    let limit = 4 * count as u64 + 1;
    flate2::read::ZlibDecoder::new(deflated.as_slice())
        .take(limit)
        .read_to_end(&mut planes)
        .map_err(|error| error.to_string())?;
    if planes.len() != 4 * count {
        return Err(format!("a map holds {} bytes, expected {}", planes.len(), 4 * count));
    }
    let value = |at: usize| f32::from_le_bytes(std::array::from_fn(|plane| planes[plane * count + at]));
    Ok(Image { width: packed.columns_px, height: packed.rows_px, pixels: (0..count).map(value).collect() })
}

impl Serialize for PanelMaps {
    fn serialize<S: serde::Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        let packed = |map: &Image<f32>| pack(map).map_err(serde::ser::Error::custom);
        Packed {
            offset_value: self.offset_value.as_ref().map(packed).transpose()?,
            air_share: self.air_share.iter().map(packed).collect::<Result<_, _>>()?,
            bad: self.bad.as_ref().map(|bad| packed(&bad.map(|flag| f32::from(*flag)))).transpose()?,
        }
        .serialize(serializer)
    }
}

impl<'de> Deserialize<'de> for PanelMaps {
    fn deserialize<D: serde::Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        let packed = Packed::deserialize(deserializer)?;
        let map = |packed: &PackedMap| unpack(packed).map_err(serde::de::Error::custom);
        Ok(Self {
            offset_value: packed.offset_value.as_ref().map(map).transpose()?,
            air_share: packed.air_share.iter().map(map).collect::<Result<_, _>>()?,
            bad: packed.bad.as_ref().map(map).transpose()?.map(|page| page.map(|flag| *flag as u8)),
        })
    }
}
