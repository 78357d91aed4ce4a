//! Volumes and surfaces are foreign files: a helper process decodes them, and what it hands over is checked here.

use std::io::{BufRead, Read, Seek, Write};
use std::path::Path;

use glam::DAffine3;

use super::SceneError;
use super::volume_file::{PlacedBy, VolumeHead, VoxelSummary, decode_volume};
use super::voxel_grid::VoxelGrid;
use crate::foreign::{self, ForeignFault, Kind, Limits, Message, OpenFault, OpenFile, Receiver, Request, Sender, WireError};
use crate::reporter::Reporter;

/// A volume as its file has it, in `lps` and mm.
#[derive(Clone, Debug)]
pub struct VolumeFile {
    /// Voxels along i, j, k.
    pub size: [usize; 3],
    /// Continuous voxel index to `lps`.
    pub lps_from_voxel: DAffine3,
    /// Scaled values, i fastest.
    pub values: Vec<f32>,
    /// Which form placed it.
    pub placed_by: PlacedBy,
    /// Distance of voxel centres along i, j, k.
    pub spacing_mm: [f64; 3],
    /// Numbers and names of labels, where the file has a table of them.
    pub label_names: Vec<(u32, String)>,
}

impl VolumeFile {
    /// Its size and place.
    #[must_use]
    pub fn grid(&self) -> VoxelGrid {
        VoxelGrid { size: self.size, lps_from_voxel: self.lps_from_voxel }
    }
}

/// What `info` says of a volume.
#[derive(Clone, Debug)]
pub struct VolumeFacts {
    /// Voxels along i, j, k.
    pub size: [usize; 3],
    /// Continuous voxel index to `lps`.
    pub lps_from_voxel: DAffine3,
    /// Distance of voxel centres along i, j, k.
    pub spacing_mm: [f64; 3],
    /// Which form placed it.
    pub placed_by: PlacedBy,
    /// Type of the stored values.
    pub data_type: String,
    /// Unit of length in the header.
    pub unit: String,
    /// Smallest and largest finite value.
    pub range: Option<[f32; 2]>,
    /// Voxels that are NaN or infinite.
    pub not_finite: u64,
}

/// A triangle: three corners of three coordinates, mm.
pub type Triangle = [[f32; 3]; 3];

/// Reads a NIfTI-1 volume (`.nii` or `.nii.gz`), see [`super::volume_file`], and reports what is odd about it.
///
/// # Errors
/// When the file cannot be read, is damaged or cut short, is no single volume of numbers, holds NaN or infinity, or lies nowhere.
pub fn read_volume(path: &Path, reporter: &Reporter) -> Result<VolumeFile, SceneError> {
    let wrong = |detail: String| SceneError::Volume { path: path.to_owned(), detail };
    let (head, values, summary) = volume(path, Kind::Volume)?;
    for (kind, words) in &head.remarks {
        match kind {
            Some(kind) => reporter.warn(kind, format_args!("{}: {words}", path.display())),
            None => reporter.note(format_args!("{}: {words}", path.display())),
        }
    }
    if summary.not_finite > 0 {
        return Err(wrong(format!(
            "{} of {} voxels are NaN or infinite; replace them (air is -1000 HU) and try again",
            summary.not_finite,
            head.voxels()
        )));
    }
    let spacing_mm = head.spacing_mm();
    let VolumeHead { size, lps_from_voxel, placed_by, label_names, .. } = head;
    Ok(VolumeFile { size, lps_from_voxel, values, placed_by, spacing_mm, label_names })
}

/// Header and range of a NIfTI-1 volume, whose voxels are decoded but not kept.
///
/// # Errors
/// As [`read_volume`], but NaN and infinity are counted.
pub fn read_volume_facts(path: &Path) -> Result<VolumeFacts, SceneError> {
    let (head, _, VoxelSummary { range, not_finite }) = volume(path, Kind::VolumeFacts)?;
    let spacing_mm = head.spacing_mm();
    let VolumeHead { size, lps_from_voxel, placed_by, data_type, unit, .. } = head;
    Ok(VolumeFacts { size, lps_from_voxel, spacing_mm, placed_by, data_type, unit, range, not_finite })
}

/// All triangles of an STL file (binary or ASCII), as they stand there.
///
/// # Errors
/// When the file cannot be read or is damaged.
pub fn read_triangles(path: &Path) -> Result<Vec<Triangle>, SceneError> {
    let wrong = |detail: String| SceneError::Mesh { path: path.to_owned(), detail };
    let reader = foreign::installed();
    let limits = reader.limits(Kind::Mesh);
    let open = open(path, &limits, &wrong)?;
    let numbers = match reader.program() {
        Some(program) => {
            let request = Request { kind: Kind::Mesh, limits: limits.clone(), detail: serde_json::Value::Null };
            let most = limits.file_pixels as usize * 9;
            foreign::run(program, &request, open.file, move |messages| receive_mesh(messages, most))
                .map_err(|fault: ForeignFault| wrong(fault.to_string()))?
        }
        None => {
            let mut numbers = Vec::new();
            decode_mesh(open.file, &limits, &mut |triangle| {
                numbers.extend_from_slice(triangle.as_flattened());
                Ok(())
            })
            .map(|()| numbers)
        }
    };
    let triangle = |nine: &[f32]| [[nine[0], nine[1], nine[2]], [nine[3], nine[4], nine[5]], [nine[6], nine[7], nine[8]]];
    Ok(numbers.map_err(wrong)?.chunks_exact(9).map(triangle).collect())
}

fn open(path: &Path, limits: &Limits, wrong: &dyn Fn(String) -> SceneError) -> Result<OpenFile, SceneError> {
    foreign::open_regular(path, limits.file_bytes).map_err(|fault| match fault {
        OpenFault::Io(source) => SceneError::Io { path: path.to_owned(), source },
        other => wrong(other.to_string()),
    })
}

type Volume = (VolumeHead, Vec<f32>, VoxelSummary);

fn volume(path: &Path, kind: Kind) -> Result<Volume, SceneError> {
    let wrong = |detail: String| SceneError::Volume { path: path.to_owned(), detail };
    let reader = foreign::installed();
    let limits = reader.limits(kind);
    let open = open(path, &limits, &wrong)?;
    match reader.program() {
        Some(program) => {
            let request = Request { kind, limits: limits.clone(), detail: serde_json::Value::Null };
            let most = limits.file_pixels;
            foreign::run(program, &request, open.file, move |messages| receive_volume(messages, kind, most))
                .map_err(|fault: ForeignFault| wrong(fault.to_string()))?
        }
        None => {
            let (mut head, mut values) = (None, Vec::new());
            let mut start = |found: &VolumeHead| {
                head = Some(found.clone());
                Ok(())
            };
            let mut take = |block: &[f32]| keep(kind, block, &mut values);
            let summary = decode_volume(open.file, &limits, &mut start, &mut take);
            summary.and_then(|summary| Ok((head.ok_or("no header")?, values, summary)))
        }
    }
    .map_err(wrong)
}

fn keep(kind: Kind, block: &[f32], values: &mut Vec<f32>) -> Result<(), String> {
    if kind == Kind::Volume {
        values.try_reserve(block.len()).map_err(|_| "its voxels do not fit the memory".to_owned())?;
        values.extend_from_slice(block);
    }
    Ok(())
}

fn decode_mesh(
    file: std::fs::File,
    limits: &Limits,
    take: &mut dyn FnMut(&Triangle) -> Result<(), String>,
) -> Result<(), String> {
    let damaged = |error: std::io::Error| format!("not a readable STL ({error})");
    let length = file.metadata().map_err(damaged)?.len();
    let mut reader = std::io::BufReader::new(file);
    let mut count = 0u64;
    let mut solid = |mut reader: &mut dyn ReadSeek| {
        for triangle in stl_io::create_stl_reader(&mut reader).map_err(damaged)? {
            count += 1;
            if count > limits.file_pixels {
                return Err(format!("more than {} triangles; simplify it", limits.file_pixels));
            }
            take(&triangle.map_err(damaged)?.vertices.map(|vertex| vertex.0))?;
        }
        Ok(())
    };
    let mut head = Vec::new();
    let read = reader.by_ref().take(STL_HEAD).read_to_end(&mut head).map_err(damaged)? as u64;
    head.resize(STL_HEAD as usize, 0);
    reader.rewind().map_err(damaged)?;
    let triangles = u32::from_le_bytes([head[80], head[81], head[82], head[83]]);
    let binary_length = STL_HEAD + STL_TRIANGLE * u64::from(triangles);
    let is_text = head[..5].eq_ignore_ascii_case(b"solid") && !(read == STL_HEAD && length == binary_length);
    if !is_text {
        if length >= binary_length + STL_TRIANGLE {
            let more = length - binary_length;
            return Err(format!("says that it holds {triangles} triangles, but {more} bytes follow them; export it again"));
        }
        if u64::from(triangles) <= limits.file_pixels && head[..5].eq_ignore_ascii_case(b"solid") {
            // The reader takes the word for that of a text.
            let mut bytes = Vec::new();
            reader.read_to_end(&mut bytes).map_err(damaged)?;
            bytes[..5].fill(b' ');
            return solid(&mut std::io::Cursor::new(bytes));
        }
        return solid(&mut reader);
    }
    // A file may hold several solids, one after the other.
    let (mut text, mut line) = (Vec::new(), Vec::new());
    while reader.read_until(b'\n', &mut line).map_err(damaged)? > 0 {
        text.append(&mut line.to_ascii_lowercase());
        let ends = line.trim_ascii_start().get(..8).is_some_and(|word| word.eq_ignore_ascii_case(b"endsolid"));
        line.clear();
        if ends {
            solid(&mut std::io::Cursor::new(std::mem::take(&mut text)))?;
        }
    }
    if text.trim_ascii().is_empty() { Ok(()) } else { Err("ends before its last solid does: cut off?".into()) }
}

/// Bytes before the triangles of a binary STL, the last four their number; and those of each triangle.
const STL_HEAD: u64 = 84;
const STL_TRIANGLE: u64 = 50;

trait ReadSeek: Read + Seek {}
impl<T: Read + Seek> ReadSeek for T {}

/// The helper's work on volumes and meshes: header and numbers from `file` to `out`, then whether all went well.
///
/// # Errors
/// When the parent has gone.
pub fn serve(request: &Request, file: std::fs::File, out: impl Write) -> std::io::Result<()> {
    let sender = std::cell::RefCell::new(Sender::new(out));
    let gone = std::cell::RefCell::new(None);
    let sent = |outcome: std::io::Result<()>| {
        outcome.map_err(|error| {
            *gone.borrow_mut() = Some(error);
            String::new()
        })
    };
    let end = if request.kind == Kind::Mesh {
        let mut block: Vec<f32> = Vec::new();
        let decoded = decode_mesh(file, &request.limits, &mut |triangle| {
            block.extend_from_slice(triangle.as_flattened());
            if block.len() < 1 << 16 {
                return Ok(());
            }
            let outcome = sent(sender.borrow_mut().numbers(&block));
            block.clear();
            outcome
        });
        let outcome = decoded.and_then(|()| sent(sender.borrow_mut().numbers(&block)));
        serde_json::to_value(outcome)?
    } else {
        let mut start = |head: &VolumeHead| sent(sender.borrow_mut().json(head));
        let mut take = |block: &[f32]| {
            if request.kind == Kind::Volume { sent(sender.borrow_mut().numbers(block)) } else { Ok(()) }
        };
        serde_json::to_value(decode_volume(file, &request.limits, &mut start, &mut take))?
    };
    match gone.take() {
        Some(error) => Err(error),
        None => sender.borrow_mut().end(&end),
    }
}

fn receive_volume(messages: &mut Receiver<impl Read>, kind: Kind, most: u64) -> Result<Result<Volume, String>, WireError> {
    let mut head: Option<VolumeHead> = None;
    let mut values = Vec::new();
    loop {
        match messages.receive()? {
            Message::Json(bytes) => {
                let found: VolumeHead = serde_json::from_slice(bytes).map_err(|_| WireError::Garbled("not a volume"))?;
                if head.is_some() || found.size.contains(&0) || found.voxels() > most || !found.lps_from_voxel.is_finite() {
                    return Err(WireError::Garbled("not a volume within the limits"));
                }
                if kind == Kind::Volume && values.try_reserve_exact(found.voxels() as usize).is_err() {
                    return Ok(Err("its voxels do not fit the memory".to_owned()));
                }
                head = Some(found);
            }
            Message::Numbers(bytes) => {
                let head = head.as_ref().ok_or(WireError::Garbled("voxels without a header"))?;
                Message::append(bytes, &mut values, head.voxels() as usize)?;
            }
            Message::End(bytes) => {
                let end: Result<VoxelSummary, String> =
                    serde_json::from_slice(bytes).map_err(|_| WireError::Garbled("not an outcome"))?;
                return match (end, head) {
                    (Err(detail), _) => Ok(Err(detail)),
                    (Ok(summary), Some(head)) if kind != Kind::Volume || values.len() as u64 == head.voxels() => {
                        Ok(Ok((head, values, summary)))
                    }
                    _ => Err(WireError::Garbled("fewer voxels than announced")),
                };
            }
        }
    }
}

fn receive_mesh(messages: &mut Receiver<impl Read>, most: usize) -> Result<Result<Vec<f32>, String>, WireError> {
    let mut numbers = Vec::new();
    loop {
        match messages.receive()? {
            Message::Json(_) => return Err(WireError::Garbled("a header")),
            Message::Numbers(bytes) => Message::append(bytes, &mut numbers, most)?,
            Message::End(bytes) => {
                let end: Result<(), String> = serde_json::from_slice(bytes).map_err(|_| WireError::Garbled("not an outcome"))?;
                return Ok(end.map(|()| numbers));
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Triangles of a file of these bytes, or why it is refused.
    fn triangles(bytes: &[u8]) -> Result<usize, String> {
        let mut file = tempfile::tempfile().expect("a temporary file");
        file.write_all(bytes).and_then(|()| file.rewind()).expect("writes");
        let mut count = 0;
        decode_mesh(file, &Limits::of(Kind::Mesh), &mut |_| {
            count += 1;
            Ok(())
        })?;
        Ok(count)
    }

    fn text(name: &str) -> String {
        let corners = "vertex 0 0 0\n vertex 1 0 0\n vertex 0 1 1.5E+0\n";
        format!("solid {name}\n facet normal 0 0 1\n outer loop\n {corners} endloop\n endfacet\nendsolid {name}\n")
    }

    #[test]
    fn every_solid_of_a_text_is_read_and_one_that_is_cut_off_is_refused() {
        let two = text("guide") + &text("sleeve");
        assert_eq!(triangles(text("one").as_bytes()), Ok(1));
        assert_eq!(triangles(two.as_bytes()), Ok(2));
        assert_eq!(triangles(two.to_ascii_uppercase().as_bytes()), Ok(2));
        assert_eq!(triangles((two.clone() + "\n \n").as_bytes()), Ok(2));
        let cut = &two[..two.len() - 30];
        assert!(triangles(cut.as_bytes()).expect_err("cut off").contains("cut off"));
    }

    #[test]
    fn a_binary_file_with_more_than_it_says_is_refused() {
        let binary = |says: u32, holds: usize| {
            let mut bytes = vec![0u8; 80];
            bytes.extend(says.to_le_bytes());
            bytes.extend(std::iter::repeat_n([0u8; 50], holds).flatten());
            bytes
        };
        assert_eq!(triangles(&binary(3, 3)), Ok(3));
        assert!(triangles(&binary(2, 3)).expect_err("one more").contains("2 triangles, but 50 bytes follow"));
        assert!(triangles(&binary(4, 3)).is_err());
        // Some programs begin the header of a binary file with the word of a text.
        let mut named = binary(3, 3);
        named[..11].copy_from_slice(b"solid robot");
        assert_eq!(triangles(&named), Ok(3));
    }
}
