//! Predicted uncertainty over planned views, as a picture.

use std::fmt::Write as _;

use super::predict::PlannedView;

/// Side of a cell and margins, px.
const CELL: (f64, f64) = (76.0, 44.0);
const LEFT: f64 = 92.0;
const TOP: f64 = 58.0;
const BELOW: f64 = 46.0;
/// Dark is good: from the smallest to the largest value on the map.
const RAMP: [[f64; 3]; 4] = [[68.0, 1.0, 84.0], [49.0, 104.0, 142.0], [53.0, 183.0, 121.0], [253.0, 231.0, 37.0]];

/// What a cell shows: the worst landmark, else the worse of the two directions across the beam at the beads; mm.
fn sigma_mm(view: &PlannedView) -> Option<f64> {
    let worst = view.landmarks_mm.iter().map(|(_, sigma)| *sigma).fold(f64::NAN, f64::max);
    let at_beads = view.centroid_mm.map(|[x, y, _]| x.max(y));
    at_beads.map(|at_beads| if worst.is_finite() { worst } else { at_beads }).filter(|sigma| sigma.is_finite())
}

/// An SVG with a cell for each view: orbital angles along, angulations upwards. `None` without views.
#[must_use]
pub fn map(views: &[PlannedView]) -> Option<String> {
    let distinct = |of: fn(&PlannedView) -> f64| {
        let mut angles: Vec<f64> = views.iter().map(of).collect();
        angles.sort_by(f64::total_cmp);
        angles.dedup();
        angles
    };
    let (orbitals, angulations) = (distinct(|view| view.orbital_deg), distinct(|view| view.angulation_deg));
    if views.is_empty() {
        return None;
    }
    let sigmas: Vec<f64> = views.iter().filter_map(sigma_mm).collect();
    let (low, high) = (sigmas.iter().copied().fold(f64::INFINITY, f64::min), sigmas.iter().copied().fold(0.0, f64::max));
    let (width, height) = (LEFT + CELL.0 * orbitals.len() as f64 + 20.0, TOP + CELL.1 * angulations.len() as f64 + BELOW);
    let at_landmarks = views.iter().any(|view| !view.landmarks_mm.is_empty());
    let what = if at_landmarks { "worst landmark, across its ray" } else { "bead centroid, across the beam" };
    let mut svg = format!(
        "<svg xmlns=\"http://www.w3.org/2000/svg\" width=\"{width:.0}\" height=\"{height:.0}\" font-family=\"sans-serif\" font-size=\"12\">\n\
         <rect width=\"100%\" height=\"100%\" fill=\"white\"/>\n\
         <text x=\"{LEFT}\" y=\"22\" font-size=\"14\">predicted standard deviation, mm: {what}</text>\n\
         <text x=\"{LEFT}\" y=\"42\">in brackets: beads in the frame; grey: no pose</text>\n"
    );
    let column = |n: usize| LEFT + CELL.0 * n as f64;
    let row = |n: usize| TOP + CELL.1 * (angulations.len() - 1 - n) as f64;
    for view in views {
        let place = |angles: &[f64], angle: f64| angles.iter().position(|other| *other == angle).unwrap_or(0);
        let (x, y) = (column(place(&orbitals, view.orbital_deg)), row(place(&angulations, view.angulation_deg)));
        let sigma = sigma_mm(view);
        let share = sigma.map(|sigma| if high > low { (sigma / low).ln() / (high / low).ln() } else { 0.0 });
        let fill = share.map_or_else(|| "rgb(200,200,200)".to_owned(), colour);
        let ink = if share.is_some_and(|share| share < 0.6) { "white" } else { "black" };
        let words = sigma.map_or_else(|| "no pose".to_owned(), |sigma| format!("{sigma:.3}"));
        let (middle, first, second) = (x + 0.5 * CELL.0, y + 19.0, y + 35.0);
        let _ = write!(
            svg,
            "<rect x=\"{x:.0}\" y=\"{y:.0}\" width=\"{:.0}\" height=\"{:.0}\" fill=\"{fill}\" stroke=\"white\"/>\n\
             <text x=\"{middle:.0}\" y=\"{first:.0}\" text-anchor=\"middle\" fill=\"{ink}\">{words}</text>\n\
             <text x=\"{middle:.0}\" y=\"{second:.0}\" text-anchor=\"middle\" fill=\"{ink}\" font-size=\"10\">({})</text>\n",
            CELL.0, CELL.1, view.in_view
        );
    }
    let below = TOP + CELL.1 * angulations.len() as f64;
    for (n, angle) in orbitals.iter().enumerate() {
        let _ = writeln!(
            svg,
            "<text x=\"{:.0}\" y=\"{:.0}\" text-anchor=\"middle\">{angle}</text>",
            column(n) + 0.5 * CELL.0,
            below + 16.0
        );
    }
    for (n, angle) in angulations.iter().enumerate() {
        let _ = writeln!(svg, "<text x=\"{:.0}\" y=\"{:.0}\" text-anchor=\"end\">{angle}</text>", LEFT - 8.0, row(n) + 27.0);
    }
    let _ = write!(
        svg,
        "<text x=\"{LEFT}\" y=\"{:.0}\">orbital, degrees: 0 from the front, 90 from the side</text>\n\
         <text transform=\"translate(20,{:.0}) rotate(-90)\">angulation, degrees</text>\n</svg>\n",
        below + 36.0,
        below
    );
    Some(svg)
}

fn colour(share: f64) -> String {
    let at = share.clamp(0.0, 1.0) * (RAMP.len() - 1) as f64;
    let first = (at as usize).min(RAMP.len() - 2);
    let along = at - first as f64;
    let [r, g, b] = [0, 1, 2].map(|n| RAMP[first][n] + along * (RAMP[first + 1][n] - RAMP[first][n]));
    format!("rgb({r:.0},{g:.0},{b:.0})")
}

#[cfg(test)]
mod tests {
    use super::*;

    fn view(orbital_deg: f64, angulation_deg: f64, across_mm: Option<f64>) -> PlannedView {
        let centroid_mm = across_mm.map(|mm| [mm, 0.5 * mm, 9.0]);
        PlannedView { orbital_deg, angulation_deg, in_view: 7, turn_deg: None, centroid_mm, landmarks_mm: Vec::new() }
    }

    #[test]
    fn every_view_has_its_cell_and_its_number() {
        assert_eq!(map(&[]), None);
        let views = [view(-30.0, 0.0, Some(0.125)), view(0.0, 0.0, Some(0.25)), view(0.0, 20.0, None)];
        let svg = map(&views).expect("a map");
        for said in [">0.125<", ">0.250<", ">no pose<", ">-30<", ">20<", "bead centroid"] {
            assert!(svg.contains(said), "{said}: {svg}");
        }
        assert!(svg.contains("rgb(68,1,84)") && svg.contains("rgb(253,231,37)") && svg.contains("rgb(200,200,200)"), "{svg}");
        let mut with = views.clone();
        with[0].landmarks_mm = vec![("hip".to_owned(), 0.75)];
        assert!(map(&with).is_some_and(|svg| svg.contains(">0.750<") && svg.contains("worst landmark")));
    }
}
