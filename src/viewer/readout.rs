//! What lies under the cursor, in a line.

use crate::report::short;
use crate::session::board::PairView;

/// Place in pixels and millimetres, and the values of both pictures there.
pub(super) fn under_cursor(pair: &PairView, [u, v]: [f64; 2]) -> Option<String> {
    let pictures = &pair.pictures;
    let [width, height] = pictures.size_px.map(|side| side as f64);
    if !(u >= -0.5 && v >= -0.5 && u < width - 0.5 && v < height - 0.5) {
        return None;
    }
    let mut parts = vec![format!("column {u:.0}, row {v:.0}")];
    if let Some(mm) = pair.mm_per_px {
        let from_middle = |at: f64, side: f64| short((at - 0.5 * (side - 1.0)) * mm, 10.0);
        parts.push(format!("{}, {} mm from the middle", from_middle(u, width), from_middle(v, height)));
    }
    if pictures.is_small() {
        // What it shows there is no pixel's value.
        parts.push("small picture, no values".to_owned());
        return Some(parts.join("  ·  "));
    }
    let acquired = pictures.acquired();
    // A picture may be smaller than its frame.
    let share = [(u + 0.5) / width, (v + 0.5) / height];
    let column = ((share[0] * acquired.width as f64) as usize).min(acquired.width.saturating_sub(1));
    let row = ((share[1] * acquired.height as f64) as usize).min(acquired.height.saturating_sub(1));
    let at = row * acquired.width + column;
    let value = |image: &crate::image::Image<f32>| image.pixels.get(at).map(|value| f64::from(*value)).filter(|v| v.is_finite());
    let word = |value: Option<f64>| value.map_or_else(|| "no value".to_owned(), |value| short(value, 1.0));
    parts.push(format!("acquired {}", word(value(acquired))));
    if let Some(simulated) = pictures.simulated() {
        parts.push(format!("DRR {}", word(value(simulated))));
        let both = value(acquired).zip(value(simulated));
        let shown = pictures.difference.filter(|scale| scale.comparable);
        if let Some(((acquired, simulated), scale)) = both.zip(shown) {
            let difference = short(acquired - simulated - scale.offset, 1.0);
            let without = if scale.offset == 0.0 { String::new() } else { format!(" without {}", short(scale.offset, 1.0)) };
            parts.push(format!("difference {difference}{without}"));
        }
    }
    parts.push(pictures.unit.clone());
    if pictures.usable().pixels.get(at) == Some(&false) {
        parts.push("masked".to_owned());
    }
    Some(parts.join("  ·  "))
}
