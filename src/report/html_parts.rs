//! What several parts of the page show: strips and numbers.

use base64::Engine as _;

use super::pair::Pair;
use super::session::SessionReport;

/// A strip as it stands in the page.
pub(super) struct Shown {
    pub base64: String,
    pub width: usize,
    pub height: usize,
}

/// The pair's strip, if there is a PNG of it.
pub(super) fn shown(report: &SessionReport, pair: &Pair) -> Option<Shown> {
    let bytes = report.pictures.get(pair.strip.as_ref()?)?;
    // Signature, then the length and name of IHDR, then width and height, big-endian.
    let number = |at: usize| bytes.get(at..at + 4).map(|four| u32::from_be_bytes([four[0], four[1], four[2], four[3]]) as usize);
    let signed = bytes.starts_with(b"\x89PNG\r\n\x1a\n");
    let (width, height) = (number(16)?, number(20)?);
    (signed && width > 0 && height > 0).then(|| Shown {
        base64: base64::engine::general_purpose::STANDARD.encode(bytes),
        width,
        height,
    })
}

/// With a true minus sign; a dash where there is none.
pub(super) fn number(value: Option<f64>, decimals: usize) -> String {
    value.map_or_else(|| "–".into(), |value| format!("{value:.decimals$}").replace('-', "−"))
}
