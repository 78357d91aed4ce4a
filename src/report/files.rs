//! A session's report as files of its folder.

use std::path::Path;

use super::html;
use super::pair::Pair;
use super::session::SessionReport;
use crate::image::{Image, ImageFileError, Lasting, write_lasting};
use crate::regular;

/// Why a report could not be written.
#[derive(Debug, thiserror::Error)]
pub enum ReportError {
    /// The file system refused.
    #[error("report: {0}")]
    File(#[from] ImageFileError),
}

/// Writes `pairs.json` and `report.html` into `folder`; each file is whole or absent. The page holds a small picture of each strip and
/// links to the strip itself; strips that `pictures` lacks are read from the folder, and the page says which is not there. Returns what could
/// not be written; the one does not keep the other from being tried.
pub fn write_session(folder: &Path, report: &SessionReport) -> Vec<ReportError> {
    let pairs = write_pairs(&folder.join("pairs.json"), &report.pairs);
    let strip = |path: &str| report.pictures.get(path).cloned().or_else(|| regular::read(&folder.join(path)).ok());
    let text = html::page(report, &strip);
    let page = write_lasting(&folder.join("report.html"), Lasting::Later, |file| file.write_all(text.as_bytes()));
    [pairs, page.map_err(ReportError::from)].into_iter().filter_map(Result::err).collect()
}

/// [`super::PairsFile`] as it is written, without a copy of all.
#[derive(serde::Serialize)]
struct Written<'a> {
    pairs: Vec<&'a Pair>,
}

/// Writes `pairs.json` alone, as a session does while it runs.
///
/// # Errors
/// When the file cannot be written.
pub fn write_pairs<'a>(path: &Path, pairs: impl IntoIterator<Item = &'a Pair>) -> Result<(), ReportError> {
    let written = Written { pairs: pairs.into_iter().collect() };
    write_lasting(path, Lasting::Later, |out| {
        serde_json::to_writer_pretty(&mut *out, &written)?;
        out.write_all(b"\n")
    })?;
    Ok(())
}

/// A picture as the bytes of a PNG file; empty when the picture is.
#[must_use]
pub fn png_bytes(picture: &Image<[u8; 3]>) -> Vec<u8> {
    let raw: Vec<u8> = picture.pixels.iter().flatten().copied().collect();
    let mut bytes = Vec::new();
    let encoder = image::codecs::png::PngEncoder::new(&mut bytes);
    let (width, height) = (picture.width as u32, picture.height as u32);
    match image::ImageEncoder::write_image(encoder, &raw, width, height, image::ExtendedColorType::Rgb8) {
        Ok(()) => bytes,
        // Writing to memory fails only for pictures without pixels.
        Err(_) => Vec::new(),
    }
}
