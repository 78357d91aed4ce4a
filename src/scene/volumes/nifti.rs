//! NIfTI-1: header and voxels of a stream, checked as they come.

use std::fs::File;
use std::io::{BufRead, BufReader, Read};

use ::nifti::{Endianness, NiftiHeader, NiftiType};
use glam::{DAffine3, DMat3, DVec3};

use super::head::{PlacedBy, Remark, VolumeFormat, VolumeHead, VoxelSummary, check_place, check_size};
use super::label_table::label_names;
use super::voxels::{ByteOrder, Encoding, NumberType, VoxelLayout, cut_short, read_voxels, surplus};
use crate::foreign::Limits;

/// What the header takes in the file; NIfTI-2's is longer.
const HEADER_BYTES: usize = 348;
const NIFTI_2_BYTES: i32 = 540;
/// Where the header ends, and says what it is: voxels follow, or are in another file.
const MAGICS: [&[u8]; 2] = [b"n+1\0", b"ni1\0"];
/// Numbers of axes that the standard knows.
const AXES: std::ops::RangeInclusive<i16> = 1..=7;
/// A share by which sizes of voxels may differ from each other: they are rounded to single precision, and some tools to three digits.
const SAME_SPACING: f64 = 0.01;

/// Whether a file that begins with these bytes is NIfTI-1, compressed or not.
pub(super) fn is_nifti(head: &[u8]) -> bool {
    let is_header = |bytes: &[u8]| bytes.get(HEADER_BYTES - 4..HEADER_BYTES).is_some_and(|magic| MAGICS.contains(&magic));
    if !head.starts_with(&[0x1f, 0x8b]) {
        return is_header(head);
    }
    // The head of a compressed file ends within its stream: what came out until then is there all the same.
    let mut bytes = Vec::new();
    let _ = flate2::read::GzDecoder::new(head).take(HEADER_BYTES as u64).read_to_end(&mut bytes);
    is_header(&bytes)
}

/// Reads a NIfTI-1 volume (`.nii` or `.nii.gz`): `start` hears the header, `take` the scaled voxels, i fastest, block by block. sform before
/// qform before spacing alone; RAS becomes LPS; metres and microns become mm.
///
/// # Errors
/// One sentence, when the file is damaged or cut short, no single volume of numbers, too large, lies nowhere, or `take` gives up.
pub(super) fn decode_nifti(
    file: File,
    limits: &Limits,
    start: &mut dyn FnMut(&VolumeHead) -> Result<(), String>,
    take: &mut dyn FnMut(&[f32]) -> Result<(), String>,
) -> Result<VoxelSummary, String> {
    let unreadable = |error: std::io::Error| format!("cannot be read ({error})");
    let file_bytes = file.metadata().map_err(unreadable)?.len();
    let mut buffered = BufReader::with_capacity(1 << 18, file);
    let zipped = buffered.fill_buf().map_err(unreadable)?.starts_with(&[0x1f, 0x8b]);
    let mut stream: Box<dyn BufRead> = if zipped {
        Box::new(BufReader::with_capacity(1 << 18, flate2::bufread::MultiGzDecoder::new(buffered)))
    } else {
        Box::new(buffered)
    };
    let header = header_of(&mut stream)?;
    let number = check_kind(&header)?;
    let size = checked_size(&header)?;
    let voxels = size.iter().product::<u64>();
    let offset = header.vox_offset;
    if !(HEADER_BYTES as f32..=1e6).contains(&offset) {
        return Err(format!("voxels start at byte {offset}, expected 348 to 1000000: the header is damaged"));
    }
    let skip = offset as u64 - HEADER_BYTES as u64;
    let needed = voxels * number.bytes() as u64 + offset as u64;
    if !zipped && file_bytes < needed {
        return Err(format!("cut short: the header promises {needed} bytes, the file has {file_bytes}; copy it again"));
    }
    let mut head = describe(&header, check_size(size, limits)?, number)?;
    let mut extensions = Vec::new();
    (&mut stream).take(skip).read_to_end(&mut extensions).map_err(|error| cut_short(&error, 0, voxels))?;
    head.label_names = label_names(&extensions, header.endianness);
    start(&head)?;

    let (slope, intercept) = scaling(&header)?;
    let order = match header.endianness {
        Endianness::Little => ByteOrder::Little,
        Endianness::Big => ByteOrder::Big,
    };
    let encoding = if zipped { Encoding::Gzip } else { Encoding::Raw };
    let mut summary = read_voxels(&mut stream, voxels, &VoxelLayout { number, order, encoding, slope, intercept }, take)?;
    if !zipped {
        summary.remarks.extend(surplus(file_bytes - needed, voxels, number));
    }
    Ok(summary)
}

fn describe(header: &NiftiHeader, size: [usize; 3], number: NumberType) -> Result<VolumeHead, String> {
    let mut remarks = Vec::new();
    let (lps_from_voxel, placed_by) = placement(header, &mut remarks)?;
    let unit = header.xyzt_to_space().map(|unit| format!("{unit:?}").to_lowercase()).unwrap_or_else(|_| "unknown".into());
    let mut head = VolumeHead {
        format: VolumeFormat::Nifti,
        size,
        lps_from_voxel,
        placed_by,
        data_type: format!("{number:?}"),
        unit,
        remarks,
        label_names: Vec::new(),
    };
    head.doubt_spacing();
    Ok(head)
}

/// The header, and nothing more, from the start of `stream`.
fn header_of(stream: &mut dyn Read) -> Result<NiftiHeader, String> {
    let none = |error: &dyn std::fmt::Display| {
        format!("no NIfTI-1 header ({error}); expected a NIfTI, NRRD or MetaImage file or a DICOM slice")
    };
    let mut bytes = [0u8; HEADER_BYTES];
    stream.read_exact(&mut bytes).map_err(|error| match error.kind() {
        std::io::ErrorKind::UnexpectedEof => none(&"it ends too early"),
        _ => none(&error),
    })?;
    // Its own size comes first, in either order of bytes; a parser of NIfTI-1 finds nothing but nonsense in the longer one.
    let size = i32::from_le_bytes([bytes[0], bytes[1], bytes[2], bytes[3]]);
    if size == NIFTI_2_BYTES || size.swap_bytes() == NIFTI_2_BYTES {
        return Err("this is NIfTI-2; convert it to NIfTI-1 (.nii or .nii.gz)".to_owned());
    }
    // The number of axes tells the parser the order of bytes, and one that is none leaves it without words.
    let axes = i16::from_le_bytes([bytes[40], bytes[41]]);
    let is_nifti = [size, size.swap_bytes()].contains(&(HEADER_BYTES as i32));
    if is_nifti && ![axes, axes.swap_bytes()].iter().any(|axes| AXES.contains(axes)) {
        let axes = if size == HEADER_BYTES as i32 { axes } else { axes.swap_bytes() };
        return Err(wrong_axes(i64::from(axes)));
    }
    NiftiHeader::from_reader(bytes.as_slice()).map_err(|error| none(&error))
}

fn check_kind(header: &NiftiHeader) -> Result<NumberType, String> {
    if header.magic != *b"n+1\0" {
        return Err("header and voxels are not in one file (.hdr/.img); convert it to .nii or .nii.gz".to_owned());
    }
    let kind = header.data_type().map_err(|error| error.to_string())?;
    let number = match kind {
        NiftiType::Int8 => NumberType::Int8,
        NiftiType::Uint8 => NumberType::Uint8,
        NiftiType::Int16 => NumberType::Int16,
        NiftiType::Uint16 => NumberType::Uint16,
        NiftiType::Int32 => NumberType::Int32,
        NiftiType::Uint32 => NumberType::Uint32,
        NiftiType::Int64 => NumberType::Int64,
        NiftiType::Uint64 => NumberType::Uint64,
        NiftiType::Float32 => NumberType::Float32,
        NiftiType::Float64 => NumberType::Float64,
        other => return Err(format!("voxels are {other:?}, expected integers or 32- or 64-bit floats")),
    };
    // Zero is written by tools that leave the field alone.
    if header.bitpix != 0 && number.bytes() * 8 != usize::from(header.bitpix.unsigned_abs()) {
        return Err(format!(
            "voxels are {number:?} of {} bits by one field of the header and of {} bits by another: it is damaged",
            number.bytes() * 8,
            header.bitpix
        ));
    }
    Ok(number)
}

fn wrong_axes(axes: i64) -> String {
    format!("{axes} axes (dim[0]), expected 3: the header is damaged; export it again")
}

fn checked_size(header: &NiftiHeader) -> Result<[u64; 3], String> {
    let axes = usize::from(header.dim[0]);
    if !(1..=7).contains(&axes) {
        return Err(wrong_axes(axes as i64));
    }
    let dim = |axis: usize| if axis <= axes { header.dim[axis] } else { 1 };
    let all: Vec<u16> = (1..=7).map(dim).collect();
    if let Some(axis) = all.iter().position(|n| *n == 0 || *n > 32767) {
        return Err(format!("{} voxels along axis {}, expected 1 to 32767", all[axis] as i16, axis + 1));
    }
    if all[3..].iter().any(|n| *n > 1) {
        return Err(format!("{axes}-dimensional ({:?}), expected one volume; extract one", &all[..axes]));
    }
    Ok([all[0], all[1], all[2]].map(u64::from))
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

fn placement(header: &NiftiHeader, remarks: &mut Vec<Remark>) -> Result<(DAffine3, PlacedBy), String> {
    let mut warn = |kind: &str, words: String| remarks.push((Some(kind.to_owned()), words));
    // Some tools set its code and leave it empty.
    let is_empty = header.sform_code > 0 && header.qform_code > 0 && sform(header).matrix3 == DMat3::ZERO;
    if is_empty {
        warn("sform and qform", "the sform is all zero; the qform is used".into());
    }
    let has_sform = header.sform_code > 0 && !is_empty;
    let (ras_from_voxel, placed_by) = if has_sform {
        (sform(header), PlacedBy::Sform)
    } else if header.qform_code > 0 {
        (qform(header), PlacedBy::Qform)
    } else {
        let spacing = DVec3::from_array([1, 2, 3].map(|axis| f64::from(header.pixdim[axis]).abs()));
        warn("no orientation", "neither sform nor qform: placed by spacing alone, axes taken as RAS".into());
        (DAffine3::from_scale(spacing), PlacedBy::SpacingOnly)
    };
    let mut disagree = false;
    if has_sform && header.qform_code > 0 {
        let disagreement_mm = corner_distance(&sform(header), &qform(header), header);
        if !(disagreement_mm <= 1.0) {
            let words = format!("sform and qform disagree by up to {disagreement_mm:.1} units; the sform is used");
            warn("sform and qform", words);
            disagree = true;
        }
    }
    if has_sform && !disagree {
        remarks.extend(other_spacing(header, &ras_from_voxel).map(|words| (None, words)));
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
    check_place(&lps_from_voxel, placed_by.words())?;
    Ok((lps_from_voxel, placed_by))
}

/// What to say where the sizes of voxels are others than those of the sform; tools that leave them alone write zeros.
fn other_spacing(header: &NiftiHeader, ras_from_voxel: &DAffine3) -> Option<String> {
    let stated = [1, 2, 3].map(|axis| f64::from(header.pixdim[axis]).abs());
    let matrix = ras_from_voxel.matrix3;
    let placed = [matrix.x_axis, matrix.y_axis, matrix.z_axis].map(|axis| axis.length());
    let differs = |axis: usize| stated[axis] != 0.0 && !((placed[axis] / stated[axis] - 1.0).abs() <= SAME_SPACING);
    let axis = (0..3).find(|axis| differs(*axis))?;
    let (placed, stated, axis) = (placed[axis], stated[axis], axis + 1);
    Some(format!("voxels are {placed:.4} units long along axis {axis} by the sform and {stated:.4} by pixdim; the sform is used"))
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
