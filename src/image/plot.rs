//! Line plots as SVG text, for files and reports.

use std::fmt::Write as _;

/// One axis.
#[derive(Clone, Debug, PartialEq)]
pub struct Axis {
    /// With its unit: `energy (keV)`.
    pub label: String,
    /// Logarithmic; values that are not positive are left out.
    pub logarithmic: bool,
}

/// One line.
#[derive(Clone, Debug, PartialEq)]
pub struct Series {
    /// For the legend; empty for none.
    pub label: String,
    /// (x, y) in order of x; points that are not finite interrupt the line.
    pub points: Vec<(f64, f64)>,
}

const SIZE: (f64, f64) = (760.0, 460.0);
const FRAME: (f64, f64, f64, f64) = (74.0, 44.0, 736.0, 408.0); // left, top, right, bottom
const COLOURS: [&str; 6] = ["#2f6fb0", "#c8553d", "#4a8f5a", "#8a63a8", "#b58a2a", "#5b6770"];

/// Draws `series` as one SVG document of 760 × 460 px.
#[must_use]
pub fn line_plot(title: &str, x: &Axis, y: &Axis, series: &[Series]) -> String {
    let scale = |axis: &Axis, value: f64| if axis.logarithmic { value.log10() } else { value };
    let scaled: Vec<Vec<(f64, f64)>> =
        series.iter().map(|s| s.points.iter().map(|(a, b)| (scale(x, *a), scale(y, *b))).collect()).collect();
    let finite: Vec<(f64, f64)> = scaled.iter().flatten().copied().filter(|(a, b)| a.is_finite() && b.is_finite()).collect();
    let range = |pick: fn(&(f64, f64)) -> f64, from_zero: bool| {
        let low = finite.iter().map(pick).fold(f64::INFINITY, f64::min);
        let high = finite.iter().map(pick).fold(f64::NEG_INFINITY, f64::max);
        let low = if from_zero { low.min(0.0) } else { low };
        if low < high { (low, high) } else { (low.min(0.0) - 0.5, high.max(0.0) + 0.5) }
    };
    let (x_range, y_range) = if finite.is_empty() {
        ((0.0, 1.0), (0.0, 1.0))
    } else {
        (range(|p| p.0, false), range(|p| p.1, !y.logarithmic))
    };
    let (left, top, right, bottom) = FRAME;
    let at_x = |value: f64| left + (value - x_range.0) / (x_range.1 - x_range.0) * (right - left);
    let at_y = |value: f64| bottom - (value - y_range.0) / (y_range.1 - y_range.0) * (bottom - top);
    let mut out = String::new();
    let (width, height) = SIZE;
    let _ = write!(
        out,
        r##"<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width} {height}" width="{width}" height="{height}" font-family="system-ui, sans-serif" font-size="12"><rect width="100%" height="100%" fill="#ffffff"/><text x="{left}" y="26" font-size="15" font-weight="600" fill="#222">{}</text>"##,
        escaped(title)
    );
    for (value, label) in ticks(x_range, x.logarithmic) {
        let u = at_x(value);
        let _ = write!(
            out,
            r##"<line x1="{u:.1}" y1="{top}" x2="{u:.1}" y2="{bottom}" stroke="#e4e6ea"/><text x="{u:.1}" y="{:.1}" text-anchor="middle" fill="#555">{label}</text>"##,
            bottom + 18.0
        );
    }
    for (value, label) in ticks(y_range, y.logarithmic) {
        let v = at_y(value);
        let _ = write!(
            out,
            r##"<line x1="{left}" y1="{v:.1}" x2="{right}" y2="{v:.1}" stroke="#e4e6ea"/><text x="{:.1}" y="{:.1}" text-anchor="end" fill="#555">{label}</text>"##,
            left - 8.0,
            v + 4.0
        );
    }
    let _ = write!(
        out,
        r##"<path d="M{left} {top}V{bottom}H{right}" fill="none" stroke="#888"/><text x="{:.1}" y="{:.1}" text-anchor="middle" fill="#333">{}</text><text transform="translate(18 {:.1}) rotate(-90)" text-anchor="middle" fill="#333">{}</text>"##,
        0.5 * (left + right),
        bottom + 38.0,
        escaped(&x.label),
        0.5 * (top + bottom),
        escaped(&y.label)
    );
    for (index, points) in scaled.iter().enumerate() {
        let colour = COLOURS[index % COLOURS.len()];
        let mut path = String::new();
        let mut pen_down = false;
        for (a, b) in points {
            if !(a.is_finite() && b.is_finite()) {
                pen_down = false;
                continue;
            }
            let _ = write!(path, "{}{:.2} {:.2}", if pen_down { 'L' } else { 'M' }, at_x(*a), at_y(*b));
            pen_down = true;
        }
        let _ = write!(out, r##"<path d="{path}" fill="none" stroke="{colour}" stroke-width="1.8" stroke-linejoin="round"/>"##);
        if !series[index].label.is_empty() {
            let v = top + 16.0 + 18.0 * index as f64;
            let _ = write!(
                out,
                r##"<line x1="{:.1}" y1="{:.1}" x2="{:.1}" y2="{:.1}" stroke="{colour}" stroke-width="2.5"/><text x="{:.1}" y="{v:.1}" text-anchor="end" fill="#333">{}</text>"##,
                right - 30.0,
                v - 4.0,
                right - 8.0,
                v - 4.0,
                right - 36.0,
                escaped(&series[index].label)
            );
        }
    }
    out.push_str("</svg>\n");
    out
}

/// Places and labels of about six ticks.
fn ticks((low, high): (f64, f64), logarithmic: bool) -> Vec<(f64, String)> {
    if logarithmic {
        let decades = low.floor() as i32..=high.ceil() as i32;
        let many = high - low > 2.5;
        let steps: &[f64] = if many { &[1.0] } else { &[1.0, 2.0, 5.0] };
        let values = decades.flat_map(|decade| steps.iter().map(move |step| (f64::from(decade) + step.log10(), decade, *step)));
        let label = |decade: i32, step: f64| {
            let value = step * 10f64.powi(decade);
            if (-3..4).contains(&decade) { format!("{value}") } else { format!("{step}e{decade}") }
        };
        return values.filter(|(v, ..)| *v >= low - 1e-9 && *v <= high + 1e-9).map(|(v, d, s)| (v, label(d, s))).collect();
    }
    let rough = (high - low) / 6.0;
    let power = 10f64.powf(rough.log10().floor());
    let step = [1.0, 2.0, 5.0, 10.0].into_iter().map(|m| m * power).find(|s| *s >= rough).unwrap_or(10.0 * power);
    let digits = (-step.log10().floor()).max(0.0) as usize;
    let first = (low / step).ceil() as i64;
    let last = (high / step).floor() as i64;
    (first..=last).map(|n| (n as f64 * step, format!("{:.digits$}", n as f64 * step))).collect()
}

fn escaped(text: &str) -> String {
    text.replace('&', "&amp;").replace('<', "&lt;").replace('>', "&gt;")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_plot_holds_its_labels_and_survives_nonsense() {
        let axis = |label: &str, logarithmic| Axis { label: label.to_owned(), logarithmic };
        let series = Series { label: "a < b".to_owned(), points: vec![(1.0, 10.0), (2.0, f64::NAN), (10.0, 1e-3), (20.0, -1.0)] };
        let svg = line_plot("title & more", &axis("x (keV)", true), &axis("y (cm2/g)", true), &[series]);
        assert!(svg.contains("x (keV)") && svg.contains("a &lt; b") && svg.contains("title &amp; more"));
        assert!(!svg.contains("NaN") && !svg.contains("inf"));
        let empty = line_plot("none", &axis("x", false), &axis("y", false), &[]);
        assert!(empty.ends_with("</svg>\n") && !empty.contains("NaN"));
    }
}
