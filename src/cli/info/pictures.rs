//! What is made for eyes: reports, drawings, videos, pictures in colour.

use std::path::Path;

use serde_json::json;

use super::found::{Found, InfoError, object};
use crate::regular;

/// How a PNG begins, and where its size stands.
pub(super) const PNG_START: &[u8] = b"\x89PNG\r\n\x1a\n";
const PNG_SIZE: [usize; 2] = [16, 20];

/// Whether it begins as a page of HTML does.
pub(super) fn is_html(head: &[u8]) -> bool {
    const START: &[u8] = b"<!doctype html";
    head.trim_ascii_start().get(..START.len()).is_some_and(|start| start.eq_ignore_ascii_case(START))
}

/// Whether it begins as an AVI does.
pub(super) fn is_avi(head: &[u8]) -> bool {
    head.starts_with(b"RIFF") && head.get(8..12) == Some(b"AVI ".as_slice())
}

/// A session's report, by the mark that its writer leaves.
pub(super) fn report(path: &Path) -> Result<Found, InfoError> {
    let text = read(path)?;
    let between = |start: &str, end: &str| text.split_once(start)?.1.split_once(end).map(|(inside, _)| unescaped(inside));
    let Some(version) = between("<meta name=\"generator\" content=\"sidecarm ", "\"") else {
        return Err(InfoError::Unknown { path: path.to_owned(), found: "a page of HTML of another program".into() });
    };
    let title = between("<title>", "</title>").map(|title| title.trim_end_matches(" · Sidecarm").to_owned());
    let is_whole = text.trim_end().ends_with("</html>");
    let losses = if is_whole { Vec::new() } else { vec!["the page does not end as pages do: it was cut".to_owned()] };
    let exposures = text.matches("<a class=\"tile ").count();
    let facts = json!({"format": "HTML", "title": title, "exposures": exposures, "version": version});
    Ok(("report", object(facts), losses))
}

/// Text as it was before it was put into HTML.
fn unescaped(text: &str) -> String {
    text.replace("&lt;", "<").replace("&gt;", ">").replace("&quot;", "\"").replace("&amp;", "&")
}

/// A drawing: what it is called, and its size in its own units.
pub(super) fn svg(path: &Path) -> Result<Found, InfoError> {
    let text = read(path)?;
    let damaged = |detail: String| InfoError::Damaged { path: path.to_owned(), kind: "SVG drawing", detail };
    // Some programs declare a document type.
    let options = roxmltree::ParsingOptions { allow_dtd: true, nodes_limit: 1_000_000, ..Default::default() };
    let document = roxmltree::Document::parse_with_options(&text, options).map_err(|error| damaged(error.to_string()))?;
    let root = document.root_element();
    if root.tag_name().name() != "svg" {
        return Err(damaged(format!("the outermost element is <{}>", root.tag_name().name())));
    }
    let first_text = || root.descendants().find(|node| node.tag_name().name() == "text").and_then(|node| node.text());
    let number = |word: &str| word.parse::<f64>().ok().filter(|number| number.is_finite());
    let size: Option<Vec<f64>> = match root.attribute("viewBox") {
        Some(view) => view.split_whitespace().skip(2).map(number).collect(),
        None => ["width", "height"].into_iter().map(|side| root.attribute(side).and_then(number)).collect(),
    };
    let facts = json!({"format": "SVG", "title": root.attribute("aria-label").or_else(first_text), "size": size});
    Ok(("drawing", object(facts), Vec::new()))
}

/// A video, by the headers at its beginning: `avih` has its pictures, `strh` how they are compressed.
pub(super) fn avi(path: &Path, bytes: u64, head: &[u8]) -> Result<Found, InfoError> {
    let damaged = |detail: &str| InfoError::Damaged { path: path.to_owned(), kind: "AVI video", detail: detail.to_owned() };
    if head.get(24..28) != Some(b"avih".as_slice()) {
        return Err(damaged("it does not begin with the header of a video"));
    }
    let number = |at: usize| head.get(at..)?.first_chunk().map(|word| u32::from_le_bytes(*word));
    let numbers = [4, 32, 48, 64, 68].map(number);
    let [Some(after_the_start), Some(step_us), Some(pictures), Some(width), Some(height)] = numbers else {
        return Err(damaged("it ends within its header"));
    };
    let named = head.get(112..116).filter(|_| head.get(108..112) == Some(b"vids".as_slice()));
    let whole = u64::from(after_the_start) + 8;
    let losses = if whole > bytes { vec![format!("{bytes} bytes, the header tells of {whole}")] } else { Vec::new() };
    let facts = json!({
        "format": "AVI",
        "compression": named.map(String::from_utf8_lossy),
        "size_px": [width, height],
        "pictures": pictures,
        "duration_s": f64::from(pictures) * f64::from(step_us) / 1e6,
    });
    Ok(("video", object(facts), losses))
}

/// A picture in colour, which the reader of frames has taken for whole.
pub(super) fn png(head: &[u8]) -> Found {
    let size_px = PNG_SIZE.map(|at| head.get(at..)?.first_chunk().map(|word| u32::from_be_bytes(*word)));
    let note = "in colour: a strip, an overlay or another picture for eyes, no radiograph";
    ("picture", object(json!({"format": "PNG", "size_px": size_px, "notes": [note]})), Vec::new())
}

fn read(path: &Path) -> Result<String, InfoError> {
    regular::read_text(path).map_err(|source| InfoError::Io { path: path.to_owned(), source })
}
