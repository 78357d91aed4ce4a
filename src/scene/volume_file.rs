//! NIfTI-1: header and voxels of a stream, checked as they come. Nothing here keeps more than one block of voxels.

use std::fs::File;
use std::io::{BufRead, BufReader, Read};

use ::nifti::{Endianness, NiftiHeader, NiftiType};
use glam::{DAffine3, DMat3, DVec3};

use super::label_table::label_names;
use crate::foreign::Limits;
use crate::memory;

/// What a volume's header says.
#[derive(Clone, Debug, PartialEq, serde::Serialize, serde::Deserialize)]
pub(super) struct VolumeHead {
    /// Voxels along i, j, k.
    pub size: [usize; 3],
    /// Continuous voxel index to `lps`, mm.
    pub lps_from_voxel: DAffine3,
    /// What placed it.
    pub placed_by: PlacedBy,
    /// Type of the stored values.
    pub data_type: String,
    /// Unit of length in the header.
    pub unit: String,
    /// What a person should hear: a kind of warning, or none for a note, and the words.
    pub remarks: Vec<(Option<String>, String)>,
    /// Numbers and names of labels, where the file has a table of them.
    pub label_names: Vec<(u32, String)>,
}

impl VolumeHead {
    /// All voxels.
    pub fn voxels(&self) -> u64 {
        self.size.iter().map(|n| *n as u64).product()
    }

    /// Distance of voxel centres along i, j, k.
    pub fn spacing_mm(&self) -> [f64; 3] {
        let axes = self.lps_from_voxel.matrix3;
        [axes.x_axis, axes.y_axis, axes.z_axis].map(|axis| axis.length())
    }
}

/// What of a header places its volume.
#[derive(Clone, Copy, Debug, PartialEq, Eq, serde::Serialize, serde::Deserialize)]
pub enum PlacedBy {
    /// The affine matrix.
    #[serde(rename = "sform")]
    Sform,
    /// The quaternion.
    #[serde(rename = "qform")]
    Qform,
    /// Nothing but the sizes of voxels.
    #[serde(rename = "voxel sizes only")]
    SpacingOnly,
}

impl PlacedBy {
    /// In words.
    #[must_use]
    pub fn words(self) -> &'static str {
        match self {
            Self::Sform => "sform",
            Self::Qform => "qform",
            Self::SpacingOnly => "voxel sizes only",
        }
    }
}

/// What all voxels together say.
#[derive(Clone, Copy, Debug, PartialEq, serde::Serialize, serde::Deserialize)]
pub(super) struct VoxelSummary {
    /// Smallest and largest finite value; `None` without any.
    pub range: Option<[f32; 2]>,
    /// Voxels that are NaN or infinite.
    pub not_finite: u64,
}

/// What a voxel takes once it is rendered: density, class, whether it is known, and the kind of its cell.
const BYTES_PER_VOXEL: u64 = 7;
/// What the header takes in the file; NIfTI-2's is longer.
const HEADER_BYTES: usize = 348;
const NIFTI_2_BYTES: i32 = 540;
/// Voxels are read in blocks of this many.
const BLOCK: usize = 1 << 18;
/// What may follow the voxels in a file.
const TRAILING_BYTES: u64 = 1 << 20;

/// Voxel sizes outside this are probably metres or microns taken for millimetres.
const PLAUSIBLE_SPACING_MM: (f64, f64) = (0.005, 20.0);

/// Reads a NIfTI-1 volume (`.nii` or `.nii.gz`): `start` hears the header, `take` the scaled voxels, i fastest, block by block. sform before
/// qform before spacing alone; RAS becomes LPS; metres and microns become mm.
///
/// # Errors
/// One sentence, when the file is damaged or cut short, no single volume of numbers, too large, lies nowhere, or `take` gives up.
pub(super) fn decode_volume(
    file: File,
    limits: &Limits,
    start: &mut dyn FnMut(&VolumeHead) -> Result<(), String>,
    take: &mut dyn FnMut(&[f32]) -> Result<(), String>,
) -> Result<VoxelSummary, String> {
    let unreadable = |error: std::io::Error| format!("cannot be read ({error})");
    let file_bytes = file.metadata().map_err(unreadable)?.len();
    let mut buffered = BufReader::with_capacity(1 << 18, file);
    let zipped = buffered.fill_buf().map_err(unreadable)?.starts_with(&[0x1f, 0x8b]);
    let mut stream: Box<dyn Read> =
        if zipped { Box::new(flate2::bufread::MultiGzDecoder::new(buffered)) } else { Box::new(buffered) };
    let header = header_of(&mut stream)?;
    let kind = check_kind(&header)?;
    let size = checked_size(&header)?;
    let voxels = size.iter().map(|n| *n as u64).product::<u64>();
    let offset = header.vox_offset;
    if !(HEADER_BYTES as f32..=1e6).contains(&offset) {
        return Err(format!("voxels start at byte {offset}, expected 348 to 1000000: the header is damaged"));
    }
    let (skip, bytes_per_voxel) = (offset as u64 - HEADER_BYTES as u64, kind.size_of());
    let needed = voxels * bytes_per_voxel as u64 + offset as u64;
    if !zipped && file_bytes < needed {
        return Err(format!("cut short: the header promises {needed} bytes, the file has {file_bytes}; copy it again"));
    }
    let what = format!("{} x {} x {} voxels", size[0], size[1], size[2]);
    if let Some(refused) = memory::refusal(&what, voxels * BYTES_PER_VOXEL, memory::available_bytes()) {
        return Err(format!("{refused}; crop or resample it, or free memory"));
    }
    if voxels > limits.file_pixels {
        return Err(format!("{what} are {voxels}, at most {} are read; crop or resample it", limits.file_pixels));
    }
    let mut head = describe(&header, size, kind)?;
    let cut = |error: std::io::Error, at: u64| match error.kind() {
        std::io::ErrorKind::UnexpectedEof => format!("cut short: {voxels} voxels promised, it ends after {at}; copy it again"),
        _ => format!("damaged after {at} of {voxels} voxels ({error}); copy it again"),
    };
    let mut extensions = Vec::new();
    (&mut stream).take(skip).read_to_end(&mut extensions).map_err(|error| cut(error, 0))?;
    head.label_names = label_names(&extensions, header.endianness);
    start(&head)?;

    let (slope, intercept) = scaling(&header)?;
    let mut summary = VoxelSummary { range: None, not_finite: 0 };
    let mut values: Vec<f32> = Vec::with_capacity(BLOCK);
    let mut chunk = vec![0u8; BLOCK * bytes_per_voxel];
    let mut at = 0u64;
    while at < voxels {
        let count = (voxels - at).min(BLOCK as u64);
        let bytes = &mut chunk[..count as usize * bytes_per_voxel];
        stream.read_exact(bytes).map_err(|error| cut(error, at))?;
        values.clear();
        for raw in bytes.chunks_exact(bytes_per_voxel) {
            let value = (decode(kind, header.endianness, raw) * slope + intercept) as f32;
            if value.is_finite() {
                let [low, high] = summary.range.unwrap_or([value, value]);
                summary.range = Some([low.min(value), high.max(value)]);
            } else {
                summary.not_finite += 1;
            }
            values.push(value);
        }
        take(&values)?;
        at += count;
    }
    // To the end of the file: only there does gzip say whether what came out is what went in.
    if zipped {
        let trailing =
            std::io::copy(&mut stream.take(TRAILING_BYTES + 1), &mut std::io::sink()).map_err(|error| cut(error, voxels))?;
        if trailing > TRAILING_BYTES {
            return Err(format!("more than {TRAILING_BYTES} bytes follow the {voxels} voxels: the header is damaged"));
        }
    }
    Ok(summary)
}

fn describe(header: &NiftiHeader, size: [usize; 3], kind: NiftiType) -> Result<VolumeHead, String> {
    let mut remarks = Vec::new();
    let (lps_from_voxel, placed_by) = placement(header, &mut remarks)?;
    let unit = header.xyzt_to_space().map(|unit| format!("{unit:?}").to_lowercase()).unwrap_or_else(|_| "unknown".into());
    let mut head =
        VolumeHead { size, lps_from_voxel, placed_by, data_type: format!("{kind:?}"), unit, remarks, label_names: Vec::new() };
    let spacing_mm = head.spacing_mm();
    let (low, high) = PLAUSIBLE_SPACING_MM;
    if !spacing_mm.iter().all(|mm| (low..=high).contains(mm)) {
        let words = format!("voxels of {spacing_mm:?} mm: metres or microns taken for millimetres?");
        head.remarks.push((Some("voxel size".to_owned()), words));
    }
    Ok(head)
}

/// The header, and nothing more, from the start of `stream`.
fn header_of(stream: &mut dyn Read) -> Result<NiftiHeader, String> {
    let none = |error: &dyn std::fmt::Display| format!("no NIfTI-1 header ({error}); expected a .nii or .nii.gz file");
    let mut bytes = [0u8; HEADER_BYTES];
    stream.read_exact(&mut bytes).map_err(|error| none(&error))?;
    // Its own size comes first, in either order of bytes; a parser of NIfTI-1 finds nothing but nonsense in the longer one.
    let size = i32::from_le_bytes([bytes[0], bytes[1], bytes[2], bytes[3]]);
    if size == NIFTI_2_BYTES || size.swap_bytes() == NIFTI_2_BYTES {
        return Err("this is NIfTI-2; convert it to NIfTI-1 (.nii or .nii.gz)".to_owned());
    }
    NiftiHeader::from_reader(bytes.as_slice()).map_err(|error| none(&error))
}

fn check_kind(header: &NiftiHeader) -> Result<NiftiType, String> {
    if header.magic != *b"n+1\0" {
        return Err("header and voxels are not in one file (.hdr/.img); convert it to .nii or .nii.gz".to_owned());
    }
    let kind = header.data_type().map_err(|error| error.to_string())?;
    match kind {
        NiftiType::Complex64
        | NiftiType::Complex128
        | NiftiType::Complex256
        | NiftiType::Rgb24
        | NiftiType::Rgba32
        | NiftiType::Float128 => Err(format!("voxels are {kind:?}, expected integers or 32- or 64-bit floats")),
        // Zero is written by tools that leave the field alone.
        kind if header.bitpix != 0 && kind.size_of() * 8 != usize::from(header.bitpix.unsigned_abs()) => Err(format!(
            "voxels are {kind:?} of {} bits by one field of the header and of {} bits by another: it is damaged",
            kind.size_of() * 8,
            header.bitpix
        )),
        kind => Ok(kind),
    }
}

fn checked_size(header: &NiftiHeader) -> Result<[usize; 3], String> {
    let axes = usize::from(header.dim[0]);
    if !(1..=7).contains(&axes) {
        return Err(format!("{axes} axes, expected 3: the header is damaged"));
    }
    let dim = |axis: usize| if axis <= axes { header.dim[axis] } else { 1 };
    let all: Vec<u16> = (1..=7).map(dim).collect();
    if let Some(axis) = all.iter().position(|n| *n == 0 || *n > 32767) {
        return Err(format!("{} voxels along axis {}, expected 1 to 32767", all[axis] as i16, axis + 1));
    }
    if all[3..].iter().any(|n| *n > 1) {
        return Err(format!("{axes}-dimensional ({:?}), expected one volume; extract one", &all[..axes]));
    }
    Ok([usize::from(all[0]), usize::from(all[1]), usize::from(all[2])])
}

/// Slope and intercept; a slope of 0 (or none at all) means that the values are not scaled.
fn scaling(header: &NiftiHeader) -> Result<(f64, f64), String> {
    let (slope, intercept) = (f64::from(header.scl_slope), f64::from(header.scl_inter));
    if slope == 0.0 || slope.is_nan() {
        return Ok((1.0, 0.0));
    }
    if !(slope.is_finite() && intercept.is_finite()) {
        return Err(format!("values are scaled by {slope} and {intercept}, expected finite numbers"));
    }
    Ok((slope, intercept))
}

fn placement(header: &NiftiHeader, remarks: &mut Vec<(Option<String>, String)>) -> Result<(DAffine3, PlacedBy), String> {
    let mut warn = |kind: &str, words: String| remarks.push((Some(kind.to_owned()), words));
    let (ras_from_voxel, placed_by) = if header.sform_code > 0 {
        (sform(header), PlacedBy::Sform)
    } else if header.qform_code > 0 {
        (qform(header), PlacedBy::Qform)
    } else {
        let spacing = DVec3::from_array([1, 2, 3].map(|axis| f64::from(header.pixdim[axis]).abs()));
        warn("no orientation", "neither sform nor qform: placed by spacing alone, axes taken as RAS".into());
        (DAffine3::from_scale(spacing), PlacedBy::SpacingOnly)
    };
    if header.sform_code > 0 && header.qform_code > 0 {
        let disagreement_mm = corner_distance(&sform(header), &qform(header), header);
        if !(disagreement_mm <= 1.0) {
            let words = format!("sform and qform disagree by up to {disagreement_mm:.1} units; the sform is used");
            warn("sform and qform", words);
        }
    }
    let unit_mm = match header.xyzt_units & 7 {
        0 | 2 => 1.0,
        1 => 1000.0,
        3 => 0.001,
        other => return Err(format!("unit of length has code {other}, expected metres, millimetres or microns")),
    };
    if unit_mm != 1.0 {
        remarks.push((None, format!("lengths are multiplied by {unit_mm} to become millimetres")));
    }
    let lps_from_voxel = DAffine3::from_scale(DVec3::new(-unit_mm, -unit_mm, unit_mm)) * ras_from_voxel;
    if !lps_from_voxel.is_finite() {
        return Err(format!("{} holds a number that is not finite", placed_by.words()));
    }
    let m = lps_from_voxel.matrix3;
    let relative = m.determinant().abs() / (m.x_axis.length() * m.y_axis.length() * m.z_axis.length());
    if !(relative > 1e-6) {
        return Err(format!("{} is singular: its axes have no volume", placed_by.words()));
    }
    Ok((lps_from_voxel, placed_by))
}

fn sform(header: &NiftiHeader) -> DAffine3 {
    let rows = [header.srow_x, header.srow_y, header.srow_z].map(|row| row.map(f64::from));
    let column = |c: usize| DVec3::new(rows[0][c], rows[1][c], rows[2][c]);
    DAffine3 { matrix3: DMat3::from_cols(column(0), column(1), column(2)), translation: column(3) }
}

/// Method 2 of the NIfTI-1 standard: a unit quaternion, spacings, and a third axis mirrored where `pixdim[0]` is negative.
fn qform(header: &NiftiHeader) -> DAffine3 {
    let [b, c, d] = [header.quatern_b, header.quatern_c, header.quatern_d].map(f64::from);
    let rest = 1.0 - (b * b + c * c + d * d);
    let (a, b, c, d) = if rest < 1e-7 {
        let length = (b * b + c * c + d * d).sqrt();
        (0.0, b / length, c / length, d / length)
    } else {
        (rest.sqrt(), b, c, d)
    };
    let x = DVec3::new(a * a + b * b - c * c - d * d, 2.0 * (b * c + a * d), 2.0 * (b * d - a * c));
    let y = DVec3::new(2.0 * (b * c - a * d), a * a + c * c - b * b - d * d, 2.0 * (c * d + a * b));
    let z = DVec3::new(2.0 * (b * d + a * c), 2.0 * (c * d - a * b), a * a + d * d - c * c - b * b);
    let [sx, sy, sz] = [1, 2, 3].map(|axis| f64::from(header.pixdim[axis]).abs());
    let handedness = if header.pixdim[0] < 0.0 { -1.0 } else { 1.0 };
    let offset = [header.quatern_x, header.quatern_y, header.quatern_z].map(f64::from);
    DAffine3 { matrix3: DMat3::from_cols(x * sx, y * sy, z * (sz * handedness)), translation: DVec3::from_array(offset) }
}

fn corner_distance(a: &DAffine3, b: &DAffine3, header: &NiftiHeader) -> f64 {
    let last = DVec3::from_array([1, 2, 3].map(|axis| f64::from(header.dim[axis]) - 1.0));
    let corner = |bits: u32| DVec3::new(f64::from(bits & 1), f64::from(bits >> 1 & 1), f64::from(bits >> 2)) * last;
    (0..8).map(|bits| a.transform_point3(corner(bits)).distance(b.transform_point3(corner(bits)))).fold(0.0, f64::max)
}

fn decode(kind: NiftiType, endianness: Endianness, raw: &[u8]) -> f64 {
    macro_rules! number {
        ($kind:ty) => {{
            let mut bytes = [0u8; size_of::<$kind>()];
            bytes.copy_from_slice(raw);
            match endianness {
                Endianness::Little => <$kind>::from_le_bytes(bytes),
                Endianness::Big => <$kind>::from_be_bytes(bytes),
            }
        }};
    }
    match kind {
        NiftiType::Uint8 => f64::from(raw[0]),
        NiftiType::Int8 => f64::from(raw[0] as i8),
        NiftiType::Int16 => f64::from(number!(i16)),
        NiftiType::Uint16 => f64::from(number!(u16)),
        NiftiType::Int32 => f64::from(number!(i32)),
        NiftiType::Uint32 => f64::from(number!(u32)),
        NiftiType::Int64 => number!(i64) as f64,
        NiftiType::Uint64 => number!(u64) as f64,
        NiftiType::Float32 => f64::from(number!(f32)),
        NiftiType::Float64 => number!(f64),
        // Refused by `check_kind`.
        _ => f64::NAN,
    }
}
