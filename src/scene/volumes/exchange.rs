//! What is asked of a helper about volumes, and both sides of the answer: what it hands over is checked here.

use std::cell::RefCell;
use std::fs::File;
use std::io::{Read, Write};

use super::ct_slice::{FileHead, file_head};
use super::head::{VolumeHead, VoxelSummary};
use super::header_file::{HeaderPlan, decode_planned, plan_of_file};
use super::metaimage::plan_metaimage;
use super::nifti::decode_nifti;
use super::nrrd::plan_nrrd;
use super::slices::{SlicesWanted, decode_slices};
use crate::foreign::{self, Fed, ForeignFault, Input, Kind, Limits, Message, Receiver, Request, Sender, WireError};

/// What a helper is told besides the kind of its work.
#[derive(Clone, Debug, serde::Serialize, serde::Deserialize)]
pub(super) enum Wanted {
    /// A NIfTI volume, all in one file.
    Nifti,
    /// The voxels of a header that was read before.
    Planned(HeaderPlan),
    /// The slices of a series that was looked at before.
    Slices(SlicesWanted),
    /// A header of text.
    Header(HeaderFormat),
    /// What DICOM files are.
    FileHeads,
}

/// Formats with a header of text.
#[derive(Clone, Copy, Debug, PartialEq, Eq, serde::Serialize, serde::Deserialize)]
pub(super) enum HeaderFormat {
    Nrrd,
    MetaImage,
}

/// Header, voxels (none where only facts were asked for), and what all of them say.
pub(super) type Volume = (VolumeHead, Vec<f32>, VoxelSummary);

/// Reads a header of text.
///
/// # Errors
/// One sentence.
pub(super) fn read_header(format: HeaderFormat, file: File) -> Result<HeaderPlan, String> {
    let reader = foreign::installed();
    let limits = reader.limits(Kind::VolumeHeader);
    let Some(helpers) = reader.helpers() else { return plan(format, file, &limits) };
    let request = request(Kind::VolumeHeader, &limits, &Wanted::Header(format))?;
    let plan =
        helpers.run(&request, file, |messages| receive_all(messages, 1)).map_err(|fault: ForeignFault| fault.to_string())??;
    plan.into_iter().next().ok_or_else(|| "its header was not read".to_owned())
}

/// Looks at the headers of DICOM files.
///
/// # Errors
/// One sentence.
pub(super) fn read_file_heads(files: Input, count: usize) -> Result<Vec<FileHead>, String> {
    let reader = foreign::installed();
    let limits = reader.limits(Kind::Slices);
    let heads = match reader.helpers() {
        Some(helpers) => {
            let request = request(Kind::Slices, &limits, &Wanted::FileHeads)?;
            helpers
                .run(&request, files, move |messages| receive_all(messages, count))
                .map_err(|fault: ForeignFault| fault.to_string())??
        }
        None => {
            let mut heads = Vec::new();
            let mut next = contents(files);
            while let Some(bytes) = next()? {
                heads.push(file_head(&bytes));
            }
            heads
        }
    };
    if heads.len() == count { Ok(heads) } else { Err("its files changed while they were read; try again".to_owned()) }
}

/// Reads the voxels; `kind` says whether they are kept.
///
/// # Errors
/// One sentence.
pub(super) fn read_voxels_of(wanted: &Wanted, input: Input, kind: Kind) -> Result<Volume, String> {
    let reader = foreign::installed();
    let limits = reader.limits(kind);
    match reader.helpers() {
        Some(helpers) => {
            let (request, most) = (request(kind, &limits, wanted)?, limits.file_pixels);
            helpers
                .run(&request, input, move |messages| receive_volume(messages, kind, most))
                .map_err(|fault: ForeignFault| fault.to_string())?
        }
        None => {
            let (mut head, mut values) = (None, Vec::new());
            let mut start = |found: &VolumeHead| {
                head = Some(found.clone());
                Ok(())
            };
            let mut take = |block: &[f32]| keep(kind, block, &mut values);
            let summary = match input {
                Input::One(file) => decode_one(wanted, file, &limits, &mut start, &mut take),
                many @ Input::Many(_) => decode_many(wanted, &mut contents(many), &limits, &mut start, &mut take),
            };
            summary.and_then(|summary| Ok((head.ok_or("no header")?, values, summary)))
        }
    }
}

fn request(kind: Kind, limits: &Limits, wanted: &Wanted) -> Result<Request, String> {
    let detail = serde_json::to_value(wanted).map_err(|error| format!("it cannot be asked for ({error})"))?;
    Ok(Request { kind, limits: limits.clone(), detail })
}

fn keep(kind: Kind, block: &[f32], values: &mut Vec<f32>) -> Result<(), String> {
    if kind == Kind::Volume {
        values.try_reserve(block.len()).map_err(|_| "its voxels do not fit the memory".to_owned())?;
        values.extend_from_slice(block);
    }
    Ok(())
}

/// The contents of files in this process, one by one.
fn contents(input: Input) -> impl FnMut() -> Result<Option<Vec<u8>>, String> {
    let mut files: Box<dyn Iterator<Item = std::io::Result<(File, u64)>> + Send> = match input {
        Input::One(file) => Box::new(std::iter::once(Ok((file, u64::MAX)))),
        Input::Many(files) => files,
    };
    move || {
        let Some(file) = files.next() else { return Ok(None) };
        let mut bytes = Vec::new();
        let read = file.and_then(|(file, most)| file.take(most).read_to_end(&mut bytes));
        read.map(|_| Some(bytes)).map_err(|error| ForeignFault::Fed { detail: error.to_string() }.to_string())
    }
}

type Start<'a> = &'a mut dyn FnMut(&VolumeHead) -> Result<(), String>;
type Take<'a> = &'a mut dyn FnMut(&[f32]) -> Result<(), String>;

fn decode_one(wanted: &Wanted, file: File, limits: &Limits, start: Start, take: Take) -> Result<VoxelSummary, String> {
    match wanted {
        Wanted::Nifti => decode_nifti(file, limits, start, take),
        Wanted::Planned(plan) => decode_planned(file, plan, start, take),
        Wanted::Slices(_) | Wanted::Header(_) | Wanted::FileHeads => Err("one file was given for many".to_owned()),
    }
}

fn decode_many(
    wanted: &Wanted,
    next: &mut dyn FnMut() -> Result<Option<Vec<u8>>, String>,
    limits: &Limits,
    start: Start,
    take: Take,
) -> Result<VoxelSummary, String> {
    match wanted {
        Wanted::Slices(slices) => decode_slices(slices, next, limits, start, take),
        _ => Err("many files were given for one".to_owned()),
    }
}

fn plan(format: HeaderFormat, file: File, limits: &Limits) -> Result<HeaderPlan, String> {
    match format {
        HeaderFormat::Nrrd => plan_of_file(file, limits, plan_nrrd),
        HeaderFormat::MetaImage => plan_of_file(file, limits, plan_metaimage),
    }
}

/// The helper's work on volumes: headers and voxels from `file` to `out`, then whether all went well.
///
/// # Errors
/// When the parent has gone.
pub(in crate::scene) fn serve(request: &Request, file: File, out: impl Write) -> std::io::Result<()> {
    let wanted: Wanted = serde_json::from_value(request.detail.clone())?;
    let (sender, gone) = (RefCell::new(Sender::new(out)), RefCell::new(None));
    let sent = |outcome: std::io::Result<()>| {
        outcome.map_err(|error| {
            *gone.borrow_mut() = Some(error);
            String::new()
        })
    };
    let mut start = |head: &VolumeHead| sent(sender.borrow_mut().json(head));
    let mut take = |block: &[f32]| {
        if request.kind == Kind::Volume { sent(sender.borrow_mut().numbers(block)) } else { Ok(()) }
    };
    let end = match &wanted {
        Wanted::Nifti | Wanted::Planned(_) => {
            serde_json::to_value(decode_one(&wanted, file, &request.limits, &mut start, &mut take))?
        }
        Wanted::Slices(_) => {
            let mut fed = Fed::new(file, request.limits.file_bytes);
            let mut next = || fed.next_file().map_err(|error| format!("a slice cannot be read ({error})"));
            serde_json::to_value(decode_many(&wanted, &mut next, &request.limits, &mut start, &mut take))?
        }
        Wanted::Header(format) => {
            let plan = plan(*format, file, &request.limits);
            serde_json::to_value(plan.and_then(|plan| sent(sender.borrow_mut().json(&plan))))?
        }
        Wanted::FileHeads => {
            let mut fed = Fed::new(file, request.limits.file_bytes);
            let outcome = loop {
                match fed.next_file().map_err(|error| format!("a file cannot be read ({error})")) {
                    Ok(Some(bytes)) => match sent(sender.borrow_mut().json(&file_head(&bytes))) {
                        Ok(()) => {}
                        gone => break gone,
                    },
                    Ok(None) => break Ok(()),
                    Err(detail) => break Err(detail),
                }
            };
            serde_json::to_value(outcome)?
        }
    };
    match gone.take() {
        Some(error) => Err(error),
        None => sender.borrow_mut().end(&end),
    }
}

/// Documents of one kind, at most `most`.
fn receive_all<T: serde::de::DeserializeOwned>(
    messages: &mut Receiver<impl Read>,
    most: usize,
) -> Result<Result<Vec<T>, String>, WireError> {
    let mut found = Vec::new();
    loop {
        match messages.receive()? {
            Message::Json(bytes) if found.len() < most => {
                found.push(serde_json::from_slice(bytes).map_err(|_| WireError::Garbled("not a header"))?);
            }
            Message::Json(_) | Message::Numbers(_) => return Err(WireError::Garbled("more than was asked for")),
            Message::End(bytes) => {
                let end: Result<(), String> = serde_json::from_slice(bytes).map_err(|_| WireError::Garbled("not an outcome"))?;
                return Ok(end.map(|()| found));
            }
        }
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
