//! NRRD (`.nrrd`, or `.nhdr` beside its voxels): the header, by the definition of the format at teem.sourceforge.net/nrrd/format.html.

use std::collections::BTreeMap;

use glam::{DAffine3, DMat3, DVec3};

use super::head::{PlacedBy, VolumeFormat, VolumeHead, check_place, check_size};
use super::header_file::{DataPlace, HeaderPlan, next_line, numbers, shown};
use super::voxels::{ByteOrder, Encoding, NumberType, VoxelLayout};
use crate::foreign::Limits;

/// What every NRRD begins with; a digit that is its version follows.
pub(super) const MAGIC: &[u8] = b"NRRD000";

/// Axes that a file may have; those beyond three must have one sample.
const MOST_AXES: usize = 16;

/// Their names follow the header, or are numbered.
const SEVERAL_FILES: &str = "its voxels are in several files; save it in one";

/// What the header at the start of `bytes` says.
///
/// # Errors
/// One sentence, when it is damaged, no single volume of numbers, too large, or does not say where its voxels lie.
pub(super) fn plan_nrrd(bytes: &[u8], limits: &Limits) -> Result<HeaderPlan, String> {
    plan_of(&Header::of(bytes)?, limits)
}

/// Fields by their name in lower case without blanks: some are written both ways.
struct Header {
    fields: BTreeMap<String, String>,
    /// Keys and values that the format does not define.
    pairs: BTreeMap<String, String>,
    /// Bytes up to the voxels.
    bytes: u64,
}

impl Header {
    fn of(bytes: &[u8]) -> Result<Self, String> {
        let mut at = 0;
        let magic = next_line(bytes, &mut at).unwrap_or_default();
        if !magic.as_bytes().starts_with(MAGIC) {
            return Err("does not begin as an NRRD does (NRRD0004)".to_owned());
        }
        let (mut fields, mut pairs) = (BTreeMap::new(), BTreeMap::new());
        loop {
            let Some(line) = next_line(bytes, &mut at) else {
                // A header by itself needs no empty line at its end.
                let detached = fields.contains_key("datafile");
                return if detached { Ok(Self { fields, pairs, bytes: 0 }) } else { Err("its header has no end".to_owned()) };
            };
            if line.is_empty() {
                return Ok(Self { fields, pairs, bytes: at as u64 });
            }
            if line.starts_with('#') {
                continue;
            }
            let Some((key, value)) = line.split_once(':') else {
                return Err("a line of its header is neither 'field: value' nor 'key:=value': it is damaged".to_owned());
            };
            if let Some(value) = value.strip_prefix('=') {
                pairs.insert(key.to_owned(), value.to_owned());
            } else {
                let key = key.to_ascii_lowercase().replace(' ', "");
                let (key, value) = (if key == "centers" { "centerings".to_owned() } else { key }, value.trim().to_owned());
                if key == "datafile" && value.starts_with("LIST") {
                    return Err(SEVERAL_FILES.to_owned());
                }
                if fields.insert(key.clone(), value).is_some() {
                    return Err(format!("its header has {} twice", shown(&key)));
                }
            }
        }
    }

    fn field(&self, key: &str) -> Option<&str> {
        self.fields.get(key).map(String::as_str)
    }

    fn needed(&self, key: &str, words: &str) -> Result<&str, String> {
        self.field(key).ok_or_else(|| format!("its header does not have '{words}'"))
    }
}

fn plan_of(header: &Header, limits: &Limits) -> Result<HeaderPlan, String> {
    let axes = numbers::<usize>("dimension", header.needed("dimension", "dimension")?, 1)?[0];
    if !(1..=MOST_AXES).contains(&axes) {
        return Err(format!("{axes} axes, expected 3: the header is damaged"));
    }
    let sizes = numbers::<u64>("sizes", header.needed("sizes", "sizes")?, axes)?;
    let layout = layout_of(header)?;
    let (spatial, lps_from_voxel) = placement(header, &sizes)?;
    let size = check_size(spatial.map(|axis| sizes[axis]), limits)?;
    let (label_names, elsewhere) = segment_names(&header.pairs);
    let mut head = VolumeHead {
        format: VolumeFormat::Nrrd,
        size,
        lps_from_voxel,
        placed_by: PlacedBy::SpaceDirections,
        data_type: format!("{:?}", layout.number),
        unit: "millimetre".to_owned(),
        remarks: Vec::new(),
        label_names,
    };
    if elsewhere > 0 {
        let words = format!(
            "{elsewhere} segments lie in a layer beyond the first, and the file has one: their voxels are not in it, and their names \
             are left out; export the segmentation again, as one label map"
        );
        head.remarks.push((Some("labels".to_owned()), words));
    }
    let (unit_mm, unit) = unit(header)?;
    if unit_mm != 1.0 {
        head.lps_from_voxel = DAffine3::from_scale(DVec3::splat(unit_mm)) * head.lps_from_voxel;
        head.remarks.push((None, format!("lengths are multiplied by {unit_mm} to become millimetres")));
        head.unit = unit.to_owned();
    }
    head.doubt_spacing();
    Ok(HeaderPlan { head, layout, data: data_place(header, layout.encoding)? })
}

fn layout_of(header: &Header) -> Result<VoxelLayout, String> {
    let kind = header.needed("type", "type")?;
    let number = match kind.to_ascii_lowercase().as_str() {
        "signed char" | "int8" | "int8_t" => NumberType::Int8,
        "uchar" | "unsigned char" | "uint8" | "uint8_t" => NumberType::Uint8,
        "short" | "short int" | "signed short" | "signed short int" | "int16" | "int16_t" => NumberType::Int16,
        "ushort" | "unsigned short" | "unsigned short int" | "uint16" | "uint16_t" => NumberType::Uint16,
        "int" | "signed int" | "int32" | "int32_t" => NumberType::Int32,
        "uint" | "unsigned int" | "uint32" | "uint32_t" => NumberType::Uint32,
        "longlong" | "long long" | "long long int" | "signed long long" | "signed long long int" | "int64" | "int64_t" => {
            NumberType::Int64
        }
        "ulonglong" | "unsigned long long" | "unsigned long long int" | "uint64" | "uint64_t" => NumberType::Uint64,
        "float" => NumberType::Float32,
        "double" => NumberType::Float64,
        _ => return Err(format!("voxels are {}, expected integers or 32- or 64-bit floats", shown(kind))),
    };
    let named = header.needed("encoding", "encoding")?;
    let encoding = match named.to_ascii_lowercase().as_str() {
        "raw" => Encoding::Raw,
        "txt" | "text" | "ascii" => Encoding::Text,
        "gz" | "gzip" => Encoding::Gzip,
        _ => return Err(format!("voxels are encoded as {}, expected raw, gzip or text; save it again so", shown(named))),
    };
    let order = match header.field("endian").map(str::to_ascii_lowercase).as_deref() {
        Some("little") => ByteOrder::Little,
        Some("big") => ByteOrder::Big,
        None if number.bytes() == 1 || encoding == Encoding::Text => ByteOrder::Little,
        None => return Err("its header does not have 'endian', so that the order of bytes is not known".to_owned()),
        Some(other) => return Err(format!("'endian' of its header is {}, expected little or big", shown(other))),
    };
    Ok(VoxelLayout { number, order, encoding, slope: 1.0, intercept: 0.0 })
}

/// The three axes that lie in space, and where they lie.
fn placement(header: &Header, sizes: &[u64]) -> Result<([usize; 3], DAffine3), String> {
    const REMEDY: &str =
        "save it with a space of its own, as 3D Slicer does, or write 'space: left-posterior-superior' if it is that";
    let unplaced = |what: &str| format!("its header does not have '{what}', so that left and right are not known; {REMEDY}");
    let space = header.field("space").ok_or_else(|| unplaced("space"))?;
    let lps_from_space = match space.to_ascii_lowercase().as_str() {
        "left-posterior-superior" | "lps" => DVec3::new(1.0, 1.0, 1.0),
        "right-anterior-superior" | "ras" => DVec3::new(-1.0, -1.0, 1.0),
        "left-anterior-superior" | "las" => DVec3::new(1.0, -1.0, 1.0),
        _ => {
            return Err(format!(
                "its space is {}, expected left-posterior-superior, right-anterior-superior or left-anterior-superior; {REMEDY}",
                shown(space)
            ));
        }
    };
    let directions = header.field("spacedirections").ok_or_else(|| unplaced("space directions"))?;
    let directions = vectors("space directions", directions)?;
    let origin = header.field("spaceorigin").ok_or_else(|| unplaced("space origin"))?;
    let [Some(origin)] = vectors("space origin", origin)?[..] else {
        return Err("'space origin' of its header is no place".to_owned());
    };
    if directions.len() != sizes.len() {
        let (found, axes) = (directions.len(), sizes.len());
        return Err(format!("'space directions' of its header are {found}, one for each of {axes} axes was expected"));
    }
    let in_space: Vec<usize> = (0..sizes.len()).filter(|axis| directions[*axis].is_some()).collect();
    let elsewhere = (0..sizes.len()).find(|axis| directions[*axis].is_none() && sizes[*axis] != 1);
    let (Ok(spatial), None) = (<[usize; 3]>::try_from(in_space.as_slice()), elsewhere) else {
        let axes = sizes.len();
        return Err(format!(
            "{axes}-dimensional ({sizes:?}), {} axes in space: expected one volume; extract one",
            in_space.len()
        ));
    };
    if let Some(kinds) = header.field("kinds") {
        let kinds: Vec<&str> = kinds.split_whitespace().collect();
        let odd = |axis: &usize| !matches!(kinds.get(*axis), Some(&("domain" | "space" | "???" | "none")) | None);
        if let Some(axis) = spatial.into_iter().find(odd) {
            return Err(format!("axis {axis} is of kind {}, expected domain or space", shown(kinds[axis])));
        }
    }
    let [x, y, z] = spatial.map(|axis| directions[axis].unwrap_or(DVec3::NAN));
    let space_from_voxel = DAffine3 { matrix3: DMat3::from_cols(x, y, z), translation: origin };
    let lps_from_voxel = DAffine3::from_scale(lps_from_space) * space_from_voxel;
    check_place(&lps_from_voxel, PlacedBy::SpaceDirections.words())?;
    Ok((spatial, lps_from_voxel))
}

/// `(1,0,0) none (0,0,2.5)`.
fn vectors(key: &str, text: &str) -> Result<Vec<Option<DVec3>>, String> {
    let wrong = || format!("'{key}' of its header is {}, expected vectors as (1,0,0)", shown(text));
    let mut found = Vec::new();
    let mut rest = text.trim_start();
    while !rest.is_empty() {
        if let Some(after) = rest.strip_prefix("none") {
            (rest, _) = (after.trim_start(), found.push(None));
            continue;
        }
        let (inside, after) = rest.strip_prefix('(').and_then(|rest| rest.split_once(')')).ok_or_else(wrong)?;
        let parts: Option<Vec<f64>> = inside.split(',').map(|part| part.trim().parse().ok()).collect();
        let three = <[f64; 3]>::try_from(parts.ok_or_else(wrong)?).map_err(|_| wrong())?;
        found.push(Some(DVec3::from_array(three)));
        rest = after.trim_start();
    }
    Ok(found)
}

/// How many millimetres the unit of length has, and its name.
fn unit(header: &Header) -> Result<(f64, &str), String> {
    let Some(units) = header.field("spaceunits") else { return Ok((1.0, "mm")) };
    let mut names: Vec<&str> = units.split(['"', ' ']).filter(|name| !name.is_empty()).collect();
    names.dedup();
    let [name] = names[..] else { return Err("'space units' of its header differ from axis to axis".to_owned()) };
    match name.to_lowercase().as_str() {
        "mm" | "millimeter" | "millimetre" | "millimeters" | "millimetres" => Ok((1.0, name)),
        "cm" | "centimeter" | "centimetre" => Ok((10.0, name)),
        "m" | "meter" | "metre" => Ok((1000.0, name)),
        "um" | "µm" | "μm" | "micron" | "microns" | "micrometer" | "micrometre" => Ok((0.001, name)),
        _ => Err(format!("'space units' of its header are {}, expected mm, cm, m or um", shown(name))),
    }
}

fn data_place(header: &Header, encoding: Encoding) -> Result<DataPlace, String> {
    let skip = |key: &str, words: &str| -> Result<i64, String> {
        header.field(key).map_or(Ok(0), |text| Ok(numbers::<i64>(words, text, 1)?[0]))
    };
    let (lines, bytes) = (skip("lineskip", "line skip")?, skip("byteskip", "byte skip")?);
    let at_end = bytes == -1 && encoding == Encoding::Raw;
    let (Ok(skip_lines), Ok(skip_decoded_bytes)) = (u64::try_from(lines), u64::try_from(if at_end { 0 } else { bytes })) else {
        return Err(format!("'line skip' is {lines} and 'byte skip' {bytes}, expected 0 or more (byte skip -1 only for raw)"));
    };
    let file = header.field("datafile").map(str::to_owned);
    if let Some(name) = &file
        && name.contains('%')
    {
        return Err(SEVERAL_FILES.to_owned());
    }
    let skip_bytes = if file.is_some() { 0 } else { header.bytes };
    Ok(DataPlace { file, at_end, skip_bytes, skip_lines, skip_decoded_bytes })
}

/// Numbers and names of the segments that 3D Slicer writes into the header of a label volume, and how many more lie in another layer than the
/// first: those of one volume are all there.
fn segment_names(pairs: &BTreeMap<String, String>) -> (Vec<(u32, String)>, usize) {
    let number = |key: &str| -> Option<u32> { pairs.get(key)?.trim().parse().ok() };
    let segment = |key: &str| {
        let prefix = key.strip_suffix("_Name").filter(|prefix| prefix.starts_with("Segment"))?;
        let is_elsewhere = number(&format!("{prefix}_Layer")).is_some_and(|layer| layer > 0);
        Some((is_elsewhere, (number(&format!("{prefix}_LabelValue"))?, pairs.get(key)?.trim().to_owned())))
    };
    let (elsewhere, here): (Vec<_>, Vec<_>) =
        pairs.keys().filter_map(|key| segment(key)).partition(|(is_elsewhere, _)| *is_elsewhere);
    let mut names: Vec<(u32, String)> = here.into_iter().map(|(_, name)| name).collect();
    names.sort();
    (names, elsewhere.len())
}
