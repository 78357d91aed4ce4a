//! MetaImage (`.mha`, or `.mhd` beside its voxels): the header, read as ITK reads it.

use std::collections::BTreeMap;

use glam::{DAffine3, DMat3, DVec3};

use super::head::{PlacedBy, Remark, VolumeFormat, VolumeHead, check_place, check_size};
use super::header_file::{DataPlace, HeaderPlan, next_line, numbers, shown};
use super::voxels::{ByteOrder, Encoding, NumberType, VoxelLayout};
use crate::foreign::Limits;

/// Keys that a header may begin with.
pub(super) const FIRST_KEYS: [&[u8]; 3] = [b"ObjectType", b"NDims", b"Comment"];

/// What the header at the start of `bytes` says.
///
/// # Errors
/// One sentence, when it is damaged, no single volume of numbers, or too large.
pub(super) fn plan_metaimage(bytes: &[u8], limits: &Limits) -> Result<HeaderPlan, String> {
    plan_of(&Header::of(bytes)?, limits)
}

struct Header {
    fields: BTreeMap<String, String>,
    /// Bytes up to the voxels.
    bytes: u64,
}

impl Header {
    /// `Key = Value` lines up to the one that says where the voxels are.
    fn of(bytes: &[u8]) -> Result<Self, String> {
        let (mut fields, mut at) = (BTreeMap::new(), 0);
        while !fields.contains_key("ElementDataFile") {
            let line = next_line(bytes, &mut at).ok_or("its header does not say where its voxels are (ElementDataFile)")?;
            if line.trim().is_empty() {
                continue;
            }
            let (key, value) = line.split_once('=').ok_or("a line of its header is not 'Key = Value': it is damaged")?;
            if fields.insert(key.trim().to_owned(), value.trim().to_owned()).is_some() {
                return Err(format!("its header has {} twice", shown(key.trim())));
            }
        }
        Ok(Self { fields, bytes: at as u64 })
    }

    /// The first of `keys` that is there.
    fn field(&self, keys: &[&str]) -> Option<&str> {
        keys.iter().find_map(|key| self.fields.get(*key)).map(String::as_str)
    }

    fn numbers<T: std::str::FromStr>(&self, keys: &[&str], count: usize) -> Result<Option<Vec<T>>, String> {
        self.field(keys).map(|text| numbers(keys[0], text, count)).transpose()
    }

    fn needed<T: std::str::FromStr>(&self, keys: &[&str], count: usize) -> Result<Vec<T>, String> {
        self.numbers(keys, count)?.ok_or_else(|| format!("its header does not have '{}'", keys[0]))
    }

    fn is_true(&self, keys: &[&str]) -> Option<bool> {
        self.field(keys).map(|text| text.starts_with(['T', 't', '1']))
    }
}

fn plan_of(header: &Header, limits: &Limits) -> Result<HeaderPlan, String> {
    if let Some(kind) = header.field(&["ObjectType"]).filter(|kind| *kind != "Image") {
        return Err(format!("its header is that of {}, expected Image", shown(kind)));
    }
    let axes = header.needed::<usize>(&["NDims"], 1)?[0];
    if !(1..=8).contains(&axes) {
        return Err(format!("{axes} axes, expected 3: the header is damaged"));
    }
    let sizes: Vec<u64> = header.needed(&["DimSize"], axes)?;
    if axes < 3 || sizes[3..].iter().any(|n| *n != 1) {
        return Err(format!("{axes}-dimensional ({sizes:?}), expected one volume; extract one"));
    }
    if let Some(channels) = header.numbers::<u64>(&["ElementNumberOfChannels"], 1)?.filter(|channels| channels[0] != 1) {
        return Err(format!("{} numbers for each voxel, expected one", channels[0]));
    }
    if let Some(unit) = header.field(&["DistanceUnits"]).filter(|unit| !matches!(*unit, "mm" | "?" | "" | "millimeter")) {
        return Err(format!("'DistanceUnits' of its header are {}, expected mm", shown(unit)));
    }
    let layout = layout_of(header)?;
    let mut remarks = Vec::new();
    let lps_from_voxel = placement(header, axes, &mut remarks)?;
    let size = check_size([sizes[0], sizes[1], sizes[2]], limits)?;
    let scaled = |keys: &[&str], as_is: f64| -> Result<bool, String> {
        Ok(header.numbers::<f64>(keys, 1)?.is_some_and(|value| value[0] != as_is))
    };
    if scaled(&["ElementToIntensityFunctionSlope"], 1.0)? || scaled(&["ElementToIntensityFunctionOffset"], 0.0)? {
        let words = "values have a slope or offset of their own (ElementToIntensityFunction), which is not applied, as in ITK";
        remarks.push((Some("not HU".to_owned()), words.to_owned()));
    }
    let mut head = VolumeHead {
        format: VolumeFormat::MetaImage,
        size,
        lps_from_voxel,
        placed_by: PlacedBy::TransformMatrix,
        data_type: format!("{:?}", layout.number),
        unit: "millimetre".to_owned(),
        remarks,
        label_names: Vec::new(),
    };
    head.doubt_spacing();
    Ok(HeaderPlan { head, layout, data: data_place(header, layout.encoding)? })
}

fn layout_of(header: &Header) -> Result<VoxelLayout, String> {
    let kind = header.field(&["ElementType"]).ok_or("its header does not have 'ElementType'")?;
    let number = match kind {
        "MET_CHAR" => NumberType::Int8,
        "MET_UCHAR" => NumberType::Uint8,
        "MET_SHORT" => NumberType::Int16,
        "MET_USHORT" => NumberType::Uint16,
        // A long of MetaImage has four bytes on every machine.
        "MET_INT" | "MET_LONG" => NumberType::Int32,
        "MET_UINT" | "MET_ULONG" => NumberType::Uint32,
        "MET_LONG_LONG" => NumberType::Int64,
        "MET_ULONG_LONG" => NumberType::Uint64,
        "MET_FLOAT" => NumberType::Float32,
        "MET_DOUBLE" => NumberType::Float64,
        _ => return Err(format!("voxels are {}, expected integers or 32- or 64-bit floats", shown(kind))),
    };
    let most_first = header.is_true(&["BinaryDataByteOrderMSB", "ElementByteOrderMSB"]);
    let order = if most_first == Some(true) { ByteOrder::Big } else { ByteOrder::Little };
    let (binary, compressed) = (header.is_true(&["BinaryData"]), header.is_true(&["CompressedData"]));
    let encoding = match (binary.unwrap_or(true), compressed.unwrap_or(false)) {
        (true, false) => Encoding::Raw,
        (true, true) => Encoding::Zlib,
        (false, false) => Encoding::Text,
        (false, true) => return Err("voxels are text and compressed at once; save it again".to_owned()),
    };
    Ok(VoxelLayout { number, order, encoding, slope: 1.0, intercept: 0.0 })
}

/// The direction of axis n is *row* n of the matrix as it is written (ITK transposes it on reading); all is in `lps`, whatever the
/// anatomical orientation says, which is for people.
fn placement(header: &Header, axes: usize, remarks: &mut Vec<Remark>) -> Result<DAffine3, String> {
    let matrix = header.numbers::<f64>(&["TransformMatrix", "Rotation", "Orientation"], axes * axes)?;
    let offset = header.numbers::<f64>(&["Offset", "Position", "Origin"], axes)?;
    let spacing: Vec<f64> = match header.numbers(&["ElementSpacing"], axes)? {
        Some(spacing) => spacing,
        None => {
            header.numbers::<f64>(&["ElementSize"], axes)?.ok_or("its header has neither 'ElementSpacing' nor 'ElementSize'")?
        }
    };
    if let Some(mirrored) = spacing.iter().find(|spacing| **spacing < 0.0) {
        return Err(format!(
            "'ElementSpacing' of its header is {mirrored}, expected more than 0; mirror the axis in TransformMatrix"
        ));
    }
    if matrix.is_none() || offset.is_none() {
        let words = "without TransformMatrix or Offset: axes are taken as LPS, and the first voxel lies at its origin";
        remarks.push((Some("no orientation".to_owned()), words.to_owned()));
    }
    let axis = |row: usize| match &matrix {
        Some(matrix) => DVec3::new(matrix[row * axes], matrix[row * axes + 1], matrix[row * axes + 2]),
        None => DVec3::AXES[row],
    };
    let columns = [0, 1, 2].map(|row| axis(row) * spacing[row]);
    let translation = offset.map_or(DVec3::ZERO, |offset| DVec3::new(offset[0], offset[1], offset[2]));
    let matrix3 = DMat3::from_cols(columns[0], columns[1], columns[2]);
    let lps_from_voxel = DAffine3 { matrix3, translation };
    check_place(&lps_from_voxel, PlacedBy::TransformMatrix.words())?;
    Ok(lps_from_voxel)
}

fn data_place(header: &Header, encoding: Encoding) -> Result<DataPlace, String> {
    let named = header.field(&["ElementDataFile"]).unwrap_or_default();
    if named.starts_with("LIST") || named.contains('%') {
        return Err("its voxels are in several files; save it in one".to_owned());
    }
    let local = named.eq_ignore_ascii_case("LOCAL");
    let skip = header.numbers::<i64>(&["HeaderSize"], 1)?.map_or(0, |skip| skip[0]);
    let at_end = skip == -1 && encoding == Encoding::Raw;
    let Ok(skip) = u64::try_from(if at_end { 0 } else { skip }) else {
        return Err(format!(
            "'HeaderSize' of its header is {skip}, expected 0 or more, or -1 for voxels that are not compressed"
        ));
    };
    // From the start of the file, says ITK; others count from here.
    if local && skip > 0 && skip != header.bytes {
        return Err(format!(
            "'HeaderSize' of its header is {skip}, but 'ElementDataFile = LOCAL' puts its voxels after {} bytes, right behind the header; \
             save it again without HeaderSize",
            header.bytes
        ));
    }
    // The size of another file's header counts from its start; that of this one is known.
    let skip_bytes = if local { header.bytes } else { skip };
    Ok(DataPlace { file: (!local).then(|| named.to_owned()), at_end, skip_bytes, skip_lines: 0, skip_decoded_bytes: 0 })
}
