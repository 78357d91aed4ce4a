//! The pairs of a session as a video: their strips, one after the other.

use std::path::{Path, PathBuf};

use serde::Serialize;

use super::LogbookError;
use crate::image::{NewFile, UNNAMED, VideoFile, read_png_rgb, sync_folder, temporary_file};
use crate::regular;
use crate::report::PairsFile;
use crate::reporter::Reporter;

/// Pictures a second: strips stand still.
const PER_S: f64 = 2.0;
/// In real time, a pair stands for no less and no more than this.
const STANDS_S: (f64, f64) = (0.5, 10.0);

/// How long each pair is shown.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Pace {
    /// Each as long.
    Each {
        /// Seconds.
        s: f64,
    },
    /// Until the next exposure, from half a second to ten.
    RealTime,
}

/// What was written.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct VideoReport {
    /// The video.
    pub path: PathBuf,
    /// Pairs in it.
    pub pairs: usize,
    /// Pairs without a strip, which are not.
    pub without_strip: usize,
    /// How long it is.
    pub seconds: f64,
}

/// Writes the strips of the session that lies beside `log` to `out`, in the order of their exposures.
///
/// # Errors
/// When the session's pairs or strips are not there, or `out` exists or cannot be written.
pub fn write_video(log: &Path, out: &Path, pace: Pace, reporter: &Reporter) -> Result<VideoReport, LogbookError> {
    let failed = |path: &Path, detail: String| LogbookError::Video { path: path.to_owned(), detail };
    let folder = log.parent().filter(|folder| !folder.as_os_str().is_empty()).unwrap_or(Path::new("."));
    let pairs_path = folder.join("pairs.json");
    let text = regular::read(&pairs_path).map_err(|error| {
        let words =
            format!("cannot be read ({error}); `sidecarm replay {} --out DIR` makes pairs and strips anew", log.display());
        failed(&pairs_path, words)
    })?;
    let file: PairsFile = serde_json::from_slice(&text).map_err(|error| failed(&pairs_path, error.to_string()))?;
    let mut shown: Vec<(i64, PathBuf)> =
        file.pairs.iter().filter_map(|pair| Some((pair.time_us?, folder.join(pair.strip.as_ref()?)))).collect();
    shown.sort();
    let without_strip = file.pairs.len() - shown.len();
    if shown.is_empty() {
        return Err(failed(&pairs_path, "none of its pairs has a strip".to_owned()));
    }
    // That of a frame without a DRR is higher.
    let mut size_px = [0; 2];
    for (_, strip) in &shown {
        let picture = read_png_rgb(strip)?;
        size_px = [size_px[0].max(picture.width), size_px[1].max(picture.height)];
    }
    // It is written under another name, and appears when it is whole; the format goes by the ending.
    NewFile::refuse_existing(out)
        .map_err(|_| failed(out, "exists already, and is not written over; choose another --out".to_owned()))?;
    let out_folder = out.parent().filter(|folder| !folder.as_os_str().is_empty()).unwrap_or(Path::new("."));
    let made = temporary_file(out_folder, UNNAMED, ".avi");
    let (_, temporary) = made.map_err(|source| LogbookError::Out { path: out.to_owned(), source })?.into_parts();
    let mut video = VideoFile::create(&temporary, size_px, PER_S).map_err(|detail| failed(out, detail))?;
    let (bar, mut pictures) = (reporter.progress("pairs", shown.len() as u64), 0u32);
    for (index, (time_us, strip)) in shown.iter().enumerate() {
        let until_next_s = shown.get(index + 1).map_or(STANDS_S.0, |(next_us, _)| (next_us - time_us) as f64 * 1e-6);
        let s = match pace {
            Pace::Each { s } => s,
            Pace::RealTime => until_next_s.clamp(STANDS_S.0, STANDS_S.1),
        };
        let times = (s * PER_S).round().max(1.0) as u32;
        video.add(&read_png_rgb(strip)?, times).map_err(|detail| failed(out, detail))?;
        pictures += times;
        bar.advance(1);
    }
    video.finish().map_err(|detail| failed(out, detail))?;
    let named = temporary.end_with(|temporary| temporary.persist_noclobber(out).map_err(|error| error.error));
    named.map_err(|source| LogbookError::Out { path: out.to_owned(), source })?;
    sync_folder(out);
    Ok(VideoReport { path: out.to_owned(), pairs: shown.len(), without_strip, seconds: f64::from(pictures) / PER_S })
}
