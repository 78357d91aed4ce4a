//! `sidecarm info FILE`: what a file is, and what this program makes of it.

mod cameras;
mod described;
mod documents;
mod found;
mod frames;
mod kinds;
mod logs;
mod pictures;
mod tables;
mod volumes;

use std::path::{Path, PathBuf};

use serde_json::{Map, Value};

use super::exit::{GOOD, LOSS};
use crate::acquire::{AcquireError, Fault, is_dicom};
use crate::regular::{self, NotRegular};
use crate::reporter::{Reporter, printable};
use crate::scene::{is_ct_slice, is_volume};

use found::Found;
pub use found::InfoError;

/// A text that is longer describes no single thing.
const LONGEST_TEXT: u64 = 1 << 20;

/// Says what a file is and what is in it.
///
/// Knows frames (DICOM, PNG, TIFF), logs (MCAP), volumes (NIfTI, NRRD, MetaImage, the folder or one slice of a DICOM
/// series), beads and landmarks (.mrk.json, .fcsv), meshes (STL), tables (CSV), networks (safetensors), reports (HTML),
/// drawings (SVG), videos (AVI), cameras as `pose convert` writes them, and this program's own JSON files: sessions, scenes,
/// poses, pairs, calibrations, adapters of telemetry and what else a command writes. Patient data are never shown.
#[derive(Debug, clap::Args)]
#[command(
    after_help = "Example:\n  sidecarm info frame-01.dcm\n  sidecarm info session.mcap --json\n\nExit codes: 0 good, 1 unreadable, 3 readable with losses (said which)."
)]
pub struct InfoArgs {
    /// The file.
    pub file: PathBuf,
    /// One JSON object on standard output instead of text.
    #[arg(long)]
    pub json: bool,
}

/// What is known about a file.
#[derive(Clone, Debug, PartialEq)]
pub struct Info {
    /// `kind`, `path`, `bytes`, then whatever the kind has.
    pub facts: Map<String, Value>,
    /// What is lost from the file, one sentence each.
    pub losses: Vec<String>,
}

/// Prints what `args.file` is; gives the exit code.
///
/// # Errors
/// When the file cannot be read or is of no known kind.
pub fn run(args: &InfoArgs, reporter: &Reporter) -> Result<u8, InfoError> {
    let info = examine(&args.file)?;
    let facts = Value::Object(info.facts);
    if args.json {
        println!("{facts:#}");
    } else {
        print!("{}", printable(&text(&facts, 0)));
    }
    for loss in &info.losses {
        reporter.warn("loss", format!("{}: {loss}", args.file.display()));
    }
    Ok(if info.losses.is_empty() { GOOD } else { LOSS })
}

/// Finds out what `path` is, by its content first and its name second.
///
/// # Errors
/// When the file cannot be read or is of no known kind.
pub fn examine(path: &Path) -> Result<Info, InfoError> {
    let io = |source| InfoError::Io { path: path.to_owned(), source };
    let metadata = std::fs::metadata(path).map_err(io)?;
    if metadata.is_dir() {
        return Ok(whole(path, None, volumes::examine(path)?));
    }
    if let Some(other) = NotRegular::of(&metadata) {
        return Err(InfoError::Unknown { path: path.to_owned(), found: other.words().into() });
    }
    let head = head(path).map_err(io)?;
    let name = path.file_name().map(|name| name.to_string_lossy().to_lowercase()).unwrap_or_default();
    let found = if mcap::MAGIC.starts_with(&head[..head.len().min(8)]) && !head.is_empty() {
        logs::examine(path)?
    } else if [".nii", ".nii.gz", ".mha", ".mhd"].iter().any(|ending| name.ends_with(ending)) || is_volume(&head) {
        volumes::examine(path)?
    } else if name.ends_with(".stl") {
        volumes::stl(path)?
    } else if name.ends_with(".csv") {
        tables::csv(path)?
    } else if name.ends_with(".safetensors") || (name.ends_with(".checkpoint") && !head.starts_with(b"{")) {
        tables::tensors(path)?
    } else if name.ends_with(".fcsv") || name.ends_with(".json") || head.trim_ascii_start().starts_with(b"{") {
        documents::examine(path, &name)?
    } else if pictures::is_html(&head) {
        pictures::report(path)?
    } else if name.ends_with(".svg") || head.trim_ascii_start().starts_with(b"<svg") {
        pictures::svg(path)?
    } else if pictures::is_avi(&head) {
        pictures::avi(path, metadata.len(), &head)?
    } else if is_dicom(&head) && is_ct_slice(path) {
        volumes::of_slice(path)?
    } else {
        match frames::examine(path) {
            Err(InfoError::Frame(AcquireError::Refused { fault: Fault::NotAnImage { found }, .. })) => {
                let text = short_text(path, metadata.len());
                let camera = cameras::examine(path, &text)?;
                camera.or_else(|| tables::trade(&text)).ok_or_else(|| InfoError::Unknown { path: path.to_owned(), found })?
            }
            Err(InfoError::Frame(AcquireError::Refused { fault: Fault::Colour { .. }, .. }))
                if head.starts_with(pictures::PNG_START) =>
            {
                pictures::png(&head)
            }
            other => other?,
        }
    };
    Ok(whole(path, Some(metadata.len()), found))
}

fn whole(path: &Path, bytes: Option<u64>, (kind, mut facts, losses): Found) -> Info {
    let mut all = Map::new();
    all.insert("kind".into(), kind.into());
    all.insert("path".into(), path.display().to_string().into());
    all.extend(bytes.map(|bytes| ("bytes".to_owned(), bytes.into())));
    all.append(&mut facts);
    if !losses.is_empty() {
        all.insert("losses".into(), losses.clone().into());
    }
    Info { facts: all, losses }
}

/// A text of one thing; empty where the file is none.
fn short_text(path: &Path, bytes: u64) -> String {
    (bytes <= LONGEST_TEXT).then(|| regular::read_text(path).ok()).flatten().unwrap_or_default()
}

fn head(path: &Path) -> std::io::Result<Vec<u8>> {
    use std::io::Read;
    let mut head = Vec::new();
    regular::open(path)?.take(512).read_to_end(&mut head)?;
    Ok(head)
}

/// Facts as indented lines; short lists of plain values stay on one line.
fn text(value: &Value, depth: usize) -> String {
    let indent = "  ".repeat(depth);
    let plain = |value: &Value| match value {
        Value::String(text) => text.clone(),
        other => other.to_string(),
    };
    let mut lines = String::new();
    match value {
        Value::Object(map) => {
            for (key, value) in map {
                match value {
                    Value::Null => {}
                    Value::Array(items) if items.is_empty() => {}
                    Value::Object(map) if map.is_empty() => {}
                    Value::Array(items) if items.iter().all(|item| item.is_number() || item.is_boolean()) => {
                        let row = items.iter().map(plain).collect::<Vec<_>>().join(", ");
                        lines.push_str(&format!("{indent}{key}: [{row}]\n"));
                    }
                    Value::Object(_) | Value::Array(_) => lines.push_str(&format!("{indent}{key}:\n{}", text(value, depth + 1))),
                    _ => lines.push_str(&format!("{indent}{key}: {}\n", plain(value))),
                }
            }
        }
        Value::Array(items) => {
            for item in items {
                match item {
                    Value::Array(row) if row.iter().all(|cell| !cell.is_array() && !cell.is_object()) => {
                        lines.push_str(&format!("{indent}[{}]\n", row.iter().map(plain).collect::<Vec<_>>().join(", ")));
                    }
                    Value::Object(_) | Value::Array(_) => {
                        let block = text(item, depth + 1);
                        lines.push_str(&format!("{indent}- {}", block.trim_start()));
                    }
                    _ => lines.push_str(&format!("{indent}- {}\n", plain(item))),
                }
            }
        }
        other => lines.push_str(&format!("{indent}{}\n", plain(other))),
    }
    lines
}
