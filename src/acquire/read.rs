//! From a file's bytes to frames: in this process for the helper, through a helper for everybody else.

use std::io::{Read, Write};
use std::path::Path;

use super::{AcquireError, Beside, Domain, Fault, FileKind, Frame, Raw, Settings, dicom::DicomImages, label, photo, raster};
use crate::foreign::{self, ForeignFault, ForeignReader, Kind, Limits, Message, OpenFile, Receiver, Request, Sender, WireError};
use crate::image::{Image, sha256_bytes};

/// Reads the one image in `path`. `domain_override` is the person's word (`--domain`) and beats all evidence.
///
/// # Errors
/// When the file is missing, damaged, truncated, of an unknown kind, in colour, empty, not finite, or holds several images.
pub fn read_frame(path: &Path, domain_override: Option<Domain>) -> Result<Frame, AcquireError> {
    let mut frames = read_frames(path, domain_override)?;
    match (frames.len(), frames.pop()) {
        (1, Some(frame)) => Ok(frame),
        (found, _) => {
            let fault = Fault::SeveralImages { found: found as u64 };
            Err(AcquireError::Refused { file: path.display().to_string(), fault })
        }
    }
}

/// Reads every image in `path`: the frames of a multi-frame DICOM file, the pages of a TIFF. Errors name `path` as it was given. Through the
/// installed reader (see [`foreign::install`]).
///
/// # Errors
/// As [`read_frame`], but several images are welcome.
pub fn read_frames(path: &Path, domain_override: Option<Domain>) -> Result<Vec<Frame>, AcquireError> {
    let shown = || path.display().to_string();
    let reader = foreign::installed();
    let open = foreign::open_regular(path, reader.limits(Kind::Frames).file_bytes)
        .map_err(|fault| AcquireError::from_open(shown(), fault))?;
    read_open(&reader, open, path, domain_override).map_err(|fault| AcquireError::Refused { file: shown(), fault })
}

/// Reads the one picture in `path`: a frame as [`read_frame`] has it, or a photograph (JPEG, PNG in colour), of which the brightness is
/// taken. Photographs show marks, and are no radiographs: nothing but tags is sought in them.
///
/// # Errors
/// As [`read_frame`], but JPEG and colour are welcome.
pub fn read_photo(path: &Path) -> Result<Frame, AcquireError> {
    let shown = || path.display().to_string();
    let reader = foreign::installed();
    let open = foreign::open_regular(path, reader.limits(Kind::Frames).file_bytes)
        .map_err(|fault| AcquireError::from_open(shown(), fault))?;
    let settings = Settings { domain: None, label: label::harmless(path), beside: Beside::of(path), photo: true };
    let refused = |fault| AcquireError::Refused { file: shown(), fault };
    let mut frames = read_with(&reader, open, settings).map_err(refused)?;
    match (frames.len(), frames.pop()) {
        (1, Some(frame)) => Ok(frame),
        (found, _) => Err(refused(Fault::SeveralImages { found: found as u64 })),
    }
}

/// Reads every image of an open file; `path` is only asked for a label and for the description beside it.
///
/// # Errors
/// When the file is no frame that can be used.
pub fn read_open(reader: &ForeignReader, open: OpenFile, path: &Path, domain: Option<Domain>) -> Result<Vec<Frame>, Fault> {
    read_with(reader, open, Settings { domain, label: label::harmless(path), beside: Beside::of(path), photo: false })
}

fn read_with(reader: &ForeignReader, open: OpenFile, settings: Settings) -> Result<Vec<Frame>, Fault> {
    let limits = reader.limits(Kind::Frames);
    let Some(helpers) = reader.helpers() else {
        let bytes = content(open.file, &limits)?;
        let mut frames = Vec::new();
        decode(&bytes, &settings, &limits, &mut |frame| {
            frames.push(frame);
            Ok(())
        })?;
        return Ok(frames);
    };
    let detail = serde_json::to_value(&settings).unwrap_or_default();
    let request = Request { kind: Kind::Frames, limits: limits.clone(), detail };
    match helpers.run(&request, open.file, move |messages| receive(messages, &limits)) {
        Ok(outcome) => outcome,
        Err(fault) => Err(Fault::Helper(fault)),
    }
}

fn content(file: impl Read, limits: &Limits) -> Result<Vec<u8>, Fault> {
    let mut bytes = Vec::new();
    let unreadable = |error: std::io::Error| Fault::Content { detail: error.kind().to_string() };
    file.take(limits.file_bytes + 1).read_to_end(&mut bytes).map_err(unreadable)?;
    if bytes.len() as u64 > limits.file_bytes {
        return Err(Fault::FileSize { bytes: bytes.len() as u64, limit: limits.file_bytes });
    }
    Ok(bytes)
}

/// Bytes to frames, given to `take` one at a time.
fn decode(
    bytes: &[u8],
    settings: &Settings,
    limits: &Limits,
    take: &mut dyn FnMut(Frame) -> Result<(), Fault>,
) -> Result<(), Fault> {
    let sha256 = sha256_bytes(bytes);
    let from_hash = label::of_hash(&sha256);
    let name = |label: &str, index: usize, count: usize| {
        if count > 1 { format!("{label}#{index:04}") } else { label.to_owned() }
    };
    if settings.photo && photo::is_photo(bytes) {
        let raw = photo::read(bytes, limits)?;
        return take(raw.into_frame(settings.label.clone().unwrap_or(from_hash), sha256, [0, 1])?);
    }
    match FileKind::of(bytes) {
        FileKind::Dicom => {
            let images = DicomImages::open(bytes, settings.domain, limits)?;
            let identity = images.identity();
            let harmless = settings.label.as_deref().filter(|label| !label::repeats(label, &identity));
            let (label, count, mut index) = (harmless.unwrap_or(&from_hash), images.count(), 0);
            images.each(&mut |raw| {
                let frame = raw.into_frame(name(label, index, count), sha256.clone(), [index, count])?;
                index += 1;
                take(frame)
            })
        }
        FileKind::Png => {
            let raw = raster::read_png(bytes, settings, limits)?;
            take(raw.into_frame(settings.label.clone().unwrap_or(from_hash), sha256, [0, 1])?)
        }
        FileKind::Tiff => {
            let label = settings.label.clone().unwrap_or(from_hash);
            let (count, mut index) = (std::cell::Cell::new(1), 0);
            let mut each = |raw: Raw| {
                let frame = raw.into_frame(name(&label, index, count.get()), sha256.clone(), [index, count.get()])?;
                index += 1;
                take(frame)
            };
            raster::read_tiff(bytes, settings, limits, &mut |pages| count.set(pages), &mut each)
        }
        FileKind::Other(found) => Err(Fault::NotAnImage { found }),
    }
}

/// The helper's work: frames from `file` to `out`, one header and its pixels after the other, then whether all went well.
///
/// # Errors
/// When the parent has gone.
pub fn serve(request: &Request, file: impl Read, out: impl Write) -> std::io::Result<()> {
    let settings: Settings = serde_json::from_value(request.detail.clone()).unwrap_or_default();
    let mut sender = Sender::new(out);
    let mut gone = None;
    let outcome = content(file, &request.limits).and_then(|bytes| {
        decode(&bytes, &settings, &request.limits, &mut |frame| {
            let sent = sender.json(&frame).and_then(|()| sender.numbers(&frame.pixels.pixels));
            sent.map_err(|error| {
                let detail = error.kind().to_string();
                gone = Some(error);
                Fault::Content { detail }
            })
        })
    });
    match gone {
        Some(error) => Err(error),
        None => sender.end(&outcome),
    }
}

/// The parent's side of [`serve`].
fn receive(messages: &mut Receiver<impl Read>, limits: &Limits) -> Result<Result<Vec<Frame>, Fault>, WireError> {
    let mut frames: Vec<Frame> = Vec::new();
    let mut total = 0u64;
    loop {
        match messages.receive()? {
            Message::Json(bytes) => {
                check_filled(frames.last())?;
                let frame: Frame = serde_json::from_slice(bytes).map_err(|_| WireError::Garbled("not a frame"))?;
                let [width, height] = frame.size_px.map(|n| n as u64);
                total = total.saturating_add(width.saturating_mul(height));
                if width.saturating_mul(height) > limits.image_pixels || total > limits.file_pixels {
                    return Err(WireError::Garbled("more pixels than the limit"));
                }
                frames.push(frame);
            }
            Message::Numbers(bytes) => {
                let frame = frames.last_mut().ok_or(WireError::Garbled("pixels without a frame"))?;
                let [width, height] = frame.size_px;
                Message::append(bytes, &mut frame.pixels.pixels, width * height)?;
            }
            Message::End(bytes) => {
                let outcome: Result<(), Fault> =
                    serde_json::from_slice(bytes).map_err(|_| WireError::Garbled("not an outcome"))?;
                if outcome.is_ok() {
                    check_filled(frames.last())?;
                    for frame in &mut frames {
                        let [width, height] = frame.size_px;
                        frame.pixels = Image { width, height, pixels: std::mem::take(&mut frame.pixels.pixels) };
                    }
                }
                return Ok(outcome.map(|()| frames));
            }
        }
    }
}

fn check_filled(frame: Option<&Frame>) -> Result<(), WireError> {
    match frame {
        Some(frame) if frame.pixels.pixels.len() != frame.size_px[0] * frame.size_px[1] => {
            Err(WireError::Garbled("fewer pixels than announced"))
        }
        _ => Ok(()),
    }
}

impl From<ForeignFault> for Fault {
    fn from(fault: ForeignFault) -> Self {
        Self::Helper(fault)
    }
}
