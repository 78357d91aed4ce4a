//! What several parts of the page show: strips and numbers.

use base64::Engine as _;
use maud::{Markup, html};

use crate::compare::NullScore;

/// A strip as it stands in the page: small, as JPEG.
pub(super) struct Shown {
    pub base64: String,
    /// Of the strip itself, px.
    pub width: usize,
    /// See `width`.
    pub height: usize,
}

/// No small picture is wider, px: a panel of it is as wide as a tile.
const WIDTH_PX: u32 = 960;
/// None has more bytes: ten frames make a page of less than a megabyte.
const MOST_BYTES: usize = 60_000;
/// Tried in this order.
const QUALITIES: [u8; 5] = [80, 65, 50, 35, 20];

/// The small picture of a strip, if `png` is one.
pub(super) fn shown(png: &[u8]) -> Option<Shown> {
    let strip = image::load_from_memory_with_format(png, image::ImageFormat::Png).ok()?.to_rgb8();
    let (width, height) = strip.dimensions();
    let mut wide = WIDTH_PX.min(width);
    loop {
        let high = (u64::from(height) * u64::from(wide) / u64::from(width.max(1))).max(1) as u32;
        let small = image::imageops::resize(&strip, wide, high, image::imageops::FilterType::Triangle);
        for quality in QUALITIES {
            let mut bytes = Vec::new();
            let encoder = image::codecs::jpeg::JpegEncoder::new_with_quality(&mut bytes, quality);
            small.write_with_encoder(encoder).ok()?;
            if bytes.len() <= MOST_BYTES {
                let base64 = base64::engine::general_purpose::STANDARD.encode(bytes);
                return Some(Shown { base64, width: width as usize, height: height as usize });
            }
        }
        wide = wide.div_ceil(2);
    }
}

/// A table in a box of the class `around`, which scrolls where it is too wide. Headings of numbers stand above them; those that begin with `<`
/// are of words and stand at the left. A heading may have two lines.
pub(super) fn table(around: &str, headings: &[&str], rows: &Markup) -> Markup {
    let parts = |heading: &&str| {
        let words = heading.trim_start_matches('<');
        let (first, second) = words.split_once('\n').map_or((words, None), |(first, second)| (first, Some(second)));
        (heading.starts_with('<').then_some("l"), first.to_owned(), second.map(str::to_owned))
    };
    html! {
        div class=(around) {
            table {
                thead {
                    tr {
                        @for (class, first, second) in headings.iter().map(parts) {
                            th class=[class] { (first) @if let Some(second) = second { br; (second) } }
                        }
                    }
                }
                tbody { (rows) }
            }
        }
    }
}

/// A table of so many columns that a narrow window shows each row as lines of cells, and with each cell its heading. Cells are a class and
/// what stands in them, in the order of `headings`.
pub(super) fn folding_table(headings: &[&str], rows: impl Iterator<Item = Vec<(&'static str, Markup)>>) -> Markup {
    let names: Vec<String> = headings.iter().map(|heading| heading.trim_start_matches('<').replace('\n', " ")).collect();
    let rows = html! {
        @for cells in rows {
            tr {
                @for ((class, cell), name) in cells.iter().zip(&names) {
                    td class=[(!class.is_empty()).then_some(class)] data-of=(name) { (cell) }
                }
            }
        }
    };
    table("fold", headings, &rows)
}

/// How a score at the stated pose stands to the best of the wrong ones, in words; both are of pictures of one size.
pub(super) fn margin_words(null: &NullScore) -> String {
    let Some((here, wrong)) = null.at_pose.zip(null.best_shifted) else { return "–".to_owned() };
    let by = (here - wrong).abs();
    let by = if by >= 1e-3 || by == 0.0 { number(Some(by), 4) } else { format!("{by:.0e}") };
    match null.discriminating {
        true => format!("better by {by}"),
        false if here == wrong => "as good at a wrong pose".to_owned(),
        false => format!("a wrong pose is better by {by}"),
    }
}

/// With a true minus sign; a dash where there is none.
pub(super) fn number(value: Option<f64>, decimals: usize) -> String {
    value.map_or_else(|| "–".into(), |value| format!("{value:.decimals$}").replace('-', "−"))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_small_picture_of_anything_is_small_and_a_broken_one_is_none() {
        let noisy = image::RgbImage::from_fn(1932, 640, |u, v| {
            let n = (u.wrapping_mul(2_654_435_761) ^ v.wrapping_mul(40_503)).wrapping_mul(1_664_525);
            image::Rgb([(n >> 24) as u8, (n >> 16) as u8, (n >> 8) as u8])
        });
        let mut png = std::io::Cursor::new(Vec::new());
        noisy.write_to(&mut png, image::ImageFormat::Png).expect("encodes");
        let small = shown(png.get_ref()).expect("a picture");
        assert_eq!((small.width, small.height), (1932, 640));
        assert!(small.base64.len() <= MOST_BYTES * 4 / 3 + 4, "{} characters", small.base64.len());
        assert!(png.get_ref().len() > 10 * MOST_BYTES, "control: noise itself is large");
        assert!(shown(&png.get_ref()[..100]).is_none());
    }
}
