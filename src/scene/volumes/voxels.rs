//! Voxels from a stream: types, orders of bytes, encodings. Nothing here keeps more than one block of them.

use std::io::{BufRead, Read};

use super::head::{Remark, VoxelSummary};

/// Types of stored voxels.
#[derive(Clone, Copy, Debug, PartialEq, Eq, serde::Serialize, serde::Deserialize)]
pub(super) enum NumberType {
    Int8,
    Uint8,
    Int16,
    Uint16,
    Int32,
    Uint32,
    Int64,
    Uint64,
    Float32,
    Float64,
}

impl NumberType {
    /// Bytes of one number.
    pub fn bytes(self) -> usize {
        match self {
            Self::Int8 | Self::Uint8 => 1,
            Self::Int16 | Self::Uint16 => 2,
            Self::Int32 | Self::Uint32 | Self::Float32 => 4,
            Self::Int64 | Self::Uint64 | Self::Float64 => 8,
        }
    }
}

/// Which byte of a number comes first.
#[derive(Clone, Copy, Debug, PartialEq, Eq, serde::Serialize, serde::Deserialize)]
pub(super) enum ByteOrder {
    Little,
    Big,
}

/// How voxels were written.
#[derive(Clone, Copy, Debug, PartialEq, Eq, serde::Serialize, serde::Deserialize)]
pub(super) enum Encoding {
    /// As they are in memory.
    Raw,
    /// As decimal numbers with white space between them.
    Text,
    /// Compressed as gzip does.
    Gzip,
    /// Compressed as zlib does.
    Zlib,
}

/// Everything that tells voxels from bytes.
#[derive(Clone, Copy, Debug, PartialEq, serde::Serialize, serde::Deserialize)]
pub(super) struct VoxelLayout {
    pub number: NumberType,
    pub order: ByteOrder,
    pub encoding: Encoding,
    /// A value is `slope` times what is stored, plus `intercept`.
    pub slope: f64,
    pub intercept: f64,
}

/// Voxels are read in blocks of this many.
const BLOCK: usize = 1 << 18;
/// What may follow the voxels in a stream whose length is not known.
const TRAILING_BYTES: u64 = 1 << 20;
/// The kind of warning about what follows.
const MORE_BYTES: &str = "more bytes";
/// More than any number in a text takes.
const MOST_DIGITS: usize = 64;

/// Reads `voxels` voxels from the start of `stream`, which is decoded already, and gives them to `take` block by block.
///
/// # Errors
/// One sentence, when the stream is cut short or damaged, or `take` gives up.
pub(super) fn read_voxels(
    stream: &mut dyn BufRead,
    voxels: u64,
    layout: &VoxelLayout,
    take: &mut dyn FnMut(&[f32]) -> Result<(), String>,
) -> Result<VoxelSummary, String> {
    let mut summary = VoxelSummary::default();
    let mut values: Vec<f32> = Vec::with_capacity(BLOCK.min(voxels as usize));
    let mut chunk = Vec::new();
    let mut at = 0u64;
    while at < voxels {
        let count = (voxels - at).min(BLOCK as u64) as usize;
        values.clear();
        let mut push = |stored: f64| {
            let value = (stored * layout.slope + layout.intercept) as f32;
            summary.count(value);
            values.push(value);
        };
        if layout.encoding == Encoding::Text {
            for index in 0..count as u64 {
                push(number_of_text(stream, at + index, voxels)?);
            }
        } else {
            chunk.resize(count * layout.number.bytes(), 0u8);
            stream.read_exact(&mut chunk).map_err(|error| cut_short(&error, at, voxels))?;
            chunk.chunks_exact(layout.number.bytes()).for_each(|raw| push(decode(layout.number, layout.order, raw)));
        }
        take(&values)?;
        at += count as u64;
    }
    match layout.encoding {
        // The length of the file says what follows.
        Encoding::Raw => {}
        Encoding::Text => summary.remarks.extend(numbers_behind(stream, voxels)?),
        // To the end of the stream: only there does a compressed one say whether what came out is what went in.
        Encoding::Gzip | Encoding::Zlib => {
            let behind = std::io::copy(&mut stream.take(TRAILING_BYTES + 1), &mut std::io::sink());
            let behind = behind.map_err(|error| damaged_behind(&error, voxels))?;
            if behind > TRAILING_BYTES {
                return Err(format!("more than {TRAILING_BYTES} bytes follow the {voxels} voxels: the header is damaged"));
            }
            summary.remarks.extend(surplus(behind, voxels, layout.number));
        }
    }
    Ok(summary)
}

/// What to say of `more` bytes behind `voxels` voxels. No format has anything there, and no tool pads: one byte is said, too.
pub(super) fn surplus(more: u64, voxels: u64, number: NumberType) -> Option<Remark> {
    if more == 0 {
        return None;
    }
    let bytes = number.bytes() as u64;
    let wider = [2, 4, 8].into_iter().find(|wide| *wide > bytes && voxels.checked_mul(wide - bytes) == Some(more));
    let words = match wider {
        Some(wide) => format!(
            "{more} bytes follow the voxels, which is what they would fill with {wide} bytes each instead of {bytes}: the type \
             ({number:?}) is probably wrong, and with it every value"
        ),
        None => format!("{more} bytes follow the voxels: does the header say their size and type right?"),
    };
    Some((Some(MORE_BYTES.to_owned()), words))
}

/// What to say of numbers behind the voxels of a text, where white space is nothing.
fn numbers_behind(stream: &mut dyn BufRead, voxels: u64) -> Result<Option<Remark>, String> {
    let mut behind = Vec::new();
    stream.take(TRAILING_BYTES).read_to_end(&mut behind).map_err(|error| damaged_behind(&error, voxels))?;
    let is_space = |byte: &u8| byte.is_ascii_whitespace() || *byte == b',';
    let words = behind.split(is_space).filter(|word| !word.is_empty()).count();
    let more = if behind.len() as u64 == TRAILING_BYTES { " or more" } else { "" };
    let said = format!("{words} numbers{more} follow the voxels: does the header say their size right?");
    Ok((words > 0).then(|| (Some(MORE_BYTES.to_owned()), said)))
}

/// Why a stream cannot be read to its end, all of whose voxels came out.
fn damaged_behind(error: &std::io::Error, voxels: u64) -> String {
    match error.kind() {
        std::io::ErrorKind::UnexpectedEof => {
            format!("cut short behind the last of {voxels} voxels: the checksum is missing that proves them; copy it again")
        }
        _ => format!("damaged behind the last of {voxels} voxels ({error}); copy it again"),
    }
}

/// Why a stream of `voxels` voxels ended after `at` of them.
pub(super) fn cut_short(error: &std::io::Error, at: u64, voxels: u64) -> String {
    match error.kind() {
        std::io::ErrorKind::UnexpectedEof => {
            format!("cut short: {voxels} voxels promised, it ends after {at}; copy it again")
        }
        _ => format!("damaged after {at} of {voxels} voxels ({error}); copy it again"),
    }
}

/// The next number of a text.
fn number_of_text(stream: &mut dyn BufRead, at: u64, voxels: u64) -> Result<f64, String> {
    let mut word = Vec::new();
    loop {
        let buffer = stream.fill_buf().map_err(|error| cut_short(&error, at, voxels))?;
        if buffer.is_empty() && word.is_empty() {
            return Err(cut_short(&std::io::ErrorKind::UnexpectedEof.into(), at, voxels));
        }
        let is_space = |byte: &u8| byte.is_ascii_whitespace() || *byte == b',';
        let skipped = if word.is_empty() { buffer.iter().take_while(|byte| is_space(byte)).count() } else { 0 };
        let length = buffer[skipped..].iter().take_while(|byte| !is_space(byte)).count();
        word.extend_from_slice(&buffer[skipped..skipped + length]);
        // A word may go on in the next buffer.
        let is_whole = skipped + length < buffer.len() || buffer.is_empty();
        stream.consume(skipped + length);
        if word.len() > MOST_DIGITS {
            return Err(format!("voxel {at} of {voxels} is no number: the file is damaged"));
        }
        if is_whole && !word.is_empty() {
            let number = std::str::from_utf8(&word).ok().and_then(|word| word.parse().ok());
            return number.ok_or_else(|| format!("voxel {at} of {voxels} is no number: the file is damaged"));
        }
    }
}

fn decode(number: NumberType, order: ByteOrder, raw: &[u8]) -> f64 {
    macro_rules! number {
        ($kind:ty) => {{
            let mut bytes = [0u8; size_of::<$kind>()];
            bytes.copy_from_slice(raw);
            match order {
                ByteOrder::Little => <$kind>::from_le_bytes(bytes),
                ByteOrder::Big => <$kind>::from_be_bytes(bytes),
            }
        }};
    }
    match number {
        NumberType::Uint8 => f64::from(raw[0]),
        NumberType::Int8 => f64::from(raw[0] as i8),
        NumberType::Int16 => f64::from(number!(i16)),
        NumberType::Uint16 => f64::from(number!(u16)),
        NumberType::Int32 => f64::from(number!(i32)),
        NumberType::Uint32 => f64::from(number!(u32)),
        NumberType::Int64 => number!(i64) as f64,
        NumberType::Uint64 => number!(u64) as f64,
        NumberType::Float32 => f64::from(number!(f32)),
        NumberType::Float64 => number!(f64),
    }
}
