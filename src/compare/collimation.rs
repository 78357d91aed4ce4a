//! Finds the collimated field of a frame: dark borders with straight edges, or an image intensifier's disc.

use glam::DVec2;

use super::filters::quantile;
use crate::image::Image;

/// What lies outside the field, penumbra included.
pub(super) struct Field {
    pub outside: Image<bool>,
    pub description: String,
}

/// Looked at along columns and rows this far apart.
const STEP_PX: usize = 2;
/// Share of the signal range below which a border is dark.
const DARK_SHARE: f64 = 0.06;
/// How far a point may lie from the straight line or circle.
const TOLERANCE_PX: f64 = 2.0;
/// Share of a side's points that must lie on its line.
const LINE_SHARE: f64 = 0.7;
/// Share of all points that must lie on the circle.
const CIRCLE_SHARE: f64 = 0.8;
/// Frames smaller than this are not searched.
const SMALLEST_PX: usize = 32;
/// The penumbra is at most this wide.
const WIDEST_PENUMBRA: usize = 24;

/// A line `depth = offset + slope · along` on one side: pixels with a smaller depth (from the border inwards) are outside.
#[derive(Clone, Copy)]
struct Edge {
    side: Side,
    offset: f64,
    slope: f64,
}

#[derive(Clone, Copy, Debug, PartialEq)]
enum Side {
    Left,
    Right,
    Top,
    Bottom,
}

const SIDES: [Side; 4] = [Side::Left, Side::Right, Side::Top, Side::Bottom];

impl Side {
    /// (position along the side, depth from the border) to (column, row).
    fn pixel(self, along: usize, depth: usize, width: usize, height: usize) -> (usize, usize) {
        match self {
            Self::Left => (depth, along),
            Self::Right => (width - 1 - depth, along),
            Self::Top => (along, depth),
            Self::Bottom => (along, height - 1 - depth),
        }
    }

    /// (length of the side, depth of the image behind it).
    fn extent(self, width: usize, height: usize) -> (usize, usize) {
        match self {
            Self::Left | Self::Right => (height, width),
            Self::Top | Self::Bottom => (width, height),
        }
    }
}

/// `None` when the frame shows no edge of a field.
pub(super) fn detect(pixels: &Image<f32>, larger_is_more_attenuation: bool) -> Option<Field> {
    let (width, height) = (pixels.width, pixels.height);
    if width < SMALLEST_PX || height < SMALLEST_PX {
        return None;
    }
    // In terms of the signal; a logarithmic frame is dark where it is most attenuated.
    let signal = pixels.map(|&v| if larger_is_more_attenuation { -v } else { v });
    let mut finite: Vec<f32> = signal.pixels.iter().copied().filter(|v| v.is_finite()).collect();
    let low = quantile(&mut finite, 0.001)?;
    let high = quantile(&mut finite, 0.99)?;
    if !(high > low) {
        return None;
    }
    let dark = (low + DARK_SHARE * (high - low)) as f32;
    let points: Vec<(Side, Vec<[f64; 2]>)> = SIDES.iter().map(|&side| (side, transitions(&signal, side, dark))).collect();
    // Four tangents of a disc would pass for edges of a rectangle near its poles, so the disc is tried first.
    if let Some(field) = disc(&signal, &points) {
        return Some(field);
    }
    let edges: Vec<Edge> = points.iter().filter_map(|(side, found)| straight(*side, found, width, height)).collect();
    if edges.is_empty() {
        return None;
    }
    let described: Vec<String> = edges
        .iter()
        .map(|edge| {
            let middle = edge.offset + edge.slope * (edge.side.extent(width, height).0 as f64 - 1.0) / 2.0;
            format!("{:?} edge {middle:.0} px deep", edge.side).to_lowercase()
        })
        .collect();
    let margins: Vec<f64> = edges.iter().map(|edge| penumbra(&signal, |depth| edge_line(*edge, depth, width, height))).collect();
    let mut outside = Image::filled(width, height, false);
    for (edge, margin) in edges.iter().zip(&margins) {
        let (length, depth_end) = edge.side.extent(width, height);
        for along in 0..length {
            let limit = edge.offset + edge.slope * along as f64 + margin;
            for depth in 0..depth_end.min(limit.ceil().max(0.0) as usize) {
                let (u, v) = edge.side.pixel(along, depth, width, height);
                *outside.at_mut(u, v) = true;
            }
        }
    }
    let widest = margins.iter().copied().fold(0.0, f64::max);
    Some(Field { outside, description: format!("{}; penumbra {widest:.0} px", described.join(", ")) })
}

/// From the border inwards, the first depth that is not dark, for each position along the side that starts dark and ends.
fn transitions(signal: &Image<f32>, side: Side, dark: f32) -> Vec<[f64; 2]> {
    let (length, depth_end) = side.extent(signal.width, signal.height);
    let at = |along: usize, depth: usize| {
        let (u, v) = side.pixel(along, depth, signal.width, signal.height);
        *signal.at(u, v)
    };
    (0..length)
        .step_by(STEP_PX)
        .filter_map(|along| {
            // Two bright pixels in a row: one may be noise or a letter's rim.
            let first = (0..depth_end - 1).find(|&depth| at(along, depth) > dark && at(along, depth + 1) > dark)?;
            (first >= 2).then_some([along as f64, first as f64])
        })
        .collect()
}

/// The straight line through most of a side's points: RANSAC over a fixed fan of pairs, then least squares on its inliers.
fn straight(side: Side, points: &[[f64; 2]], width: usize, height: usize) -> Option<Edge> {
    let (length, depth_end) = side.extent(width, height);
    // Points that run into an adjacent collimated side belong to that side: they lie deep. An edge spans a good part of its side.
    if points.len() * STEP_PX * 4 < length {
        return None;
    }
    let mut best: Option<(usize, [f64; 2])> = None;
    let count = points.len();
    for trial in 0..64usize {
        // A fixed sequence that spreads well: results never depend on random numbers.
        let (i, j) = ((trial * 37 + 11) % count, (trial * 101 + count / 2) % count);
        let ([x0, y0], [x1, y1]) = (points[i], points[j]);
        if (x1 - x0).abs() < 0.1 * length as f64 {
            continue;
        }
        let slope = (y1 - y0) / (x1 - x0);
        let offset = y0 - slope * x0;
        let inliers = points.iter().filter(|[x, y]| (y - offset - slope * x).abs() <= TOLERANCE_PX).count();
        if best.is_none_or(|(most, _)| inliers > most) {
            best = Some((inliers, [offset, slope]));
        }
    }
    let (inliers, [offset, slope]) = best?;
    // Steeper than 45° it is another side's edge.
    let shallow = slope.abs() <= 1.0;
    let reaches = offset + slope * (length as f64 - 1.0) / 2.0;
    let plausible = reaches < 0.6 * depth_end as f64;
    if !(shallow && plausible && inliers as f64 >= LINE_SHARE * count as f64) {
        return None;
    }
    let on: Vec<[f64; 2]> = points.iter().copied().filter(|[x, y]| (y - offset - slope * x).abs() <= TOLERANCE_PX).collect();
    let n = on.len() as f64;
    let (mean_x, mean_y) = on.iter().fold((0.0, 0.0), |(x, y), p| (x + p[0] / n, y + p[1] / n));
    let (sxx, sxy) =
        on.iter().fold((0.0, 0.0), |(xx, xy), p| (xx + (p[0] - mean_x).powi(2), xy + (p[0] - mean_x) * (p[1] - mean_y)));
    let slope = if sxx > 0.0 { sxy / sxx } else { 0.0 };
    Some(Edge { side, offset: mean_y - slope * mean_x, slope })
}

fn edge_line(edge: Edge, beyond: usize, width: usize, height: usize) -> Vec<(usize, usize)> {
    let (length, depth_end) = edge.side.extent(width, height);
    (length / 4..3 * length / 4)
        .step_by(STEP_PX)
        .filter_map(|along| {
            let depth = (edge.offset + edge.slope * along as f64).round() + beyond as f64;
            (depth >= 0.0 && depth < depth_end as f64).then(|| edge.side.pixel(along, depth as usize, width, height))
        })
        .collect()
}

/// How far beyond the edge the mean signal still rises to 90 % of what it is well inside.
fn penumbra(signal: &Image<f32>, line: impl Fn(usize) -> Vec<(usize, usize)>) -> f64 {
    let mean = |beyond: usize| {
        let pixels = line(beyond);
        pixels.iter().map(|&(u, v)| f64::from(*signal.at(u, v))).sum::<f64>() / pixels.len().max(1) as f64
    };
    let (outside, inside) = (mean(0), mean(WIDEST_PENUMBRA));
    let risen = (1..WIDEST_PENUMBRA).find(|&beyond| mean(beyond) >= outside + 0.9 * (inside - outside));
    risen.unwrap_or(2) as f64 + 2.0
}

/// An image intensifier's disc: most transition points of all sides lie on one circle, which the image does not contain wholly by chance.
fn disc(signal: &Image<f32>, points: &[(Side, Vec<[f64; 2]>)]) -> Option<Field> {
    let (width, height) = (signal.width, signal.height);
    let ring: Vec<DVec2> = points
        .iter()
        .flat_map(|(side, found)| {
            found.iter().map(|p| {
                let (u, v) = side.pixel(p[0] as usize, p[1] as usize, width, height);
                DVec2::new(u as f64, v as f64)
            })
        })
        .collect();
    // A disc darkens all four corners: there must be points on every side.
    if ring.len() < 40 || points.iter().any(|(_, found)| found.len() < 4) {
        return None;
    }
    let (mut centre, mut radius) = circle_through(&ring)?;
    for _ in 0..3 {
        let near: Vec<DVec2> =
            ring.iter().copied().filter(|p| (p.distance(centre) - radius).abs() <= 3.0 * TOLERANCE_PX).collect();
        (centre, radius) = circle_through(&near)?;
    }
    let on = ring.iter().filter(|p| (p.distance(centre) - radius).abs() <= TOLERANCE_PX).count();
    let small = width.min(height) as f64;
    if !(on as f64 >= CIRCLE_SHARE * ring.len() as f64 && radius > 0.25 * small && radius < 2.0 * small) {
        return None;
    }
    let circle = |beyond: usize| {
        let r = radius - beyond as f64;
        (0..180)
            .filter_map(|step| {
                let at = centre + r * DVec2::from_angle(f64::from(step) * 2f64.to_radians());
                let inside = at.x >= 0.0 && at.y >= 0.0 && at.x < width as f64 - 0.5 && at.y < height as f64 - 0.5;
                inside.then(|| (at.x.round() as usize, at.y.round() as usize))
            })
            .collect::<Vec<_>>()
    };
    let margin = penumbra(signal, circle);
    let mut outside = Image::filled(width, height, false);
    for v in 0..height {
        for u in 0..width {
            *outside.at_mut(u, v) = DVec2::new(u as f64, v as f64).distance(centre) > radius - margin;
        }
    }
    let description = format!("disc of radius {radius:.0} px about ({:.0}, {:.0}); penumbra {margin:.0} px", centre.x, centre.y);
    Some(Field { outside, description })
}

/// Algebraic least squares (Kåsa): x² + y² = 2ax + 2by + c.
fn circle_through(points: &[DVec2]) -> Option<(DVec2, f64)> {
    if points.len() < 8 {
        return None;
    }
    let n = points.len() as f64;
    let mean = points.iter().copied().sum::<DVec2>() / n;
    let (mut xx, mut xy, mut yy, mut xz, mut yz, mut z_sum) = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0);
    for p in points {
        let q = *p - mean;
        let z = q.length_squared();
        xx += q.x * q.x;
        xy += q.x * q.y;
        yy += q.y * q.y;
        xz += q.x * z;
        yz += q.y * z;
        z_sum += z;
    }
    let determinant = xx * yy - xy * xy;
    if !(determinant > 1e-9 * (xx + yy).powi(2)) {
        return None;
    }
    let centre = DVec2::new(0.5 * (xz * yy - yz * xy) / determinant, 0.5 * (yz * xx - xz * xy) / determinant);
    Some((centre + mean, (centre.length_squared() + z_sum / n).sqrt()))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn textured(width: usize, height: usize) -> Image<f32> {
        let pixels =
            (0..width * height).map(|at| 600.0 + 200.0 * ((at % width) as f32 * 0.05).sin() + (at / width) as f32).collect();
        Image::from_pixels(width, height, pixels).expect("size")
    }

    #[test]
    fn slanted_shutters_are_found_and_only_they() {
        let mut frame = textured(300, 240);
        for v in 0..240usize {
            for u in 0..300usize {
                if (u as f64) < 30.0 + 0.1 * v as f64 || v >= 210 {
                    *frame.at_mut(u, v) = 12.0 + ((u * 7 + v * 3) % 5) as f32;
                }
            }
        }
        let field = detect(&frame, false).expect("collimated");
        assert!(field.description.contains("left edge") && field.description.contains("bottom edge"), "{}", field.description);
        assert!(*field.outside.at(10, 10) && *field.outside.at(35, 120) && *field.outside.at(150, 212));
        assert!(!*field.outside.at(150, 100) && !*field.outside.at(290, 20) && !*field.outside.at(70, 190));
        assert!(detect(&textured(300, 240), false).is_none(), "control: no shutters");
    }

    #[test]
    fn an_intensifier_disc_is_a_disc() {
        let mut frame = textured(256, 256);
        for v in 0..256usize {
            for u in 0..256usize {
                if DVec2::new(u as f64 - 130.0, v as f64 - 126.0).length() > 120.0 {
                    *frame.at_mut(u, v) = 3.0;
                }
            }
        }
        let field = detect(&frame, false).expect("round");
        assert!(field.description.starts_with("disc of radius 1"), "{}", field.description);
        assert!(*field.outside.at(3, 3) && !*field.outside.at(130, 20) && !*field.outside.at(130, 126));
    }

    #[test]
    fn dark_anatomy_at_the_border_is_no_shutter() {
        // A dark blob reaching in from the left, as a thick hip does.
        let mut frame = textured(300, 240);
        for v in 0..240usize {
            for u in 0..300usize {
                if DVec2::new(u as f64, v as f64 - 120.0).length() < 90.0 {
                    *frame.at_mut(u, v) = 10.0;
                }
            }
        }
        assert!(detect(&frame, false).is_none());
    }
}
