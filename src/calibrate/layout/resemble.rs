//! Whether a layout resembles itself, or its mirror image: then shadows can be named in more than one way.

use glam::DVec3;
use serde::Serialize;

use crate::geometry::Rigid;
use crate::pose::align_triangles;

/// A motion that puts beads onto beads.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct SelfMatch {
    /// How many.
    pub beads: usize,
    /// By how much the motion turns.
    pub angle_deg: f64,
    /// Root mean square distance of the pairs.
    pub rms_mm: f64,
    /// Which bead falls on which, by name.
    pub pairs: Vec<[String; 2]>,
}

/// Distances that are compared before the search is cut short: some for sixty scattered beads, far too few for a plate of a hundred.
const MOST_COMPARED: u64 = 300_000_000;
/// Triangles with a side, or a height, below this many tolerances fix no motion.
const SHARP: f64 = 4.0;

/// The motion with most pairs, of those the closest; not the one that leaves every bead where it is. Three beads of three others give the
/// motion, all are counted. `None` where there are fewer than three beads, or all lie on a line. Second: whether the search was cut short,
/// because the layout is so large, or so regular, that too many motions fit three beads; the first of them show what is regular.
#[must_use]
pub fn self_match(places: &[DVec3], names: &[&str], mirrored: bool, tolerance_mm: f64) -> (Option<SelfMatch>, bool) {
    let turned = |p: &DVec3| if mirrored { DVec3::new(-p.x, p.y, p.z) } else { *p };
    let from: Vec<DVec3> = places.iter().map(turned).collect();
    let n = places.len();
    let mut best: Option<Best> = None;
    let mut compared = 0u64;
    let near = |a: f64, b: f64| (a - b).abs() <= 2.0 * tolerance_mm;
    let triples = (0..n).flat_map(|i| (i + 1..n).flat_map(move |j| (j + 1..n).map(move |k| [i, j, k])));
    for [i, j, k] in triples {
        if compared > MOST_COMPARED {
            break;
        }
        let source = [from[i], from[j], from[k]];
        let sides = [source[0].distance(source[1]), source[0].distance(source[2]), source[1].distance(source[2])];
        let height = (source[1] - source[0]).cross(source[2] - source[0]).length() / sides.iter().copied().fold(0.0, f64::max);
        if !(height > SHARP * tolerance_mm) {
            continue;
        }
        for a in 0..n {
            for b in (0..n).filter(|b| *b != a && near(places[a].distance(places[*b]), sides[0])) {
                compared += n as u64;
                for c in (0..n).filter(|c| *c != a && *c != b) {
                    if ([i, j, k] == [a, b, c] && !mirrored)
                        || !near(places[a].distance(places[c]), sides[1])
                        || !near(places[b].distance(places[c]), sides[2])
                    {
                        continue;
                    }
                    let Some(motion) = align_triangles(&source, &[places[a], places[b], places[c]]) else { continue };
                    compared += (n * n) as u64;
                    let pairs = pairs(&from, places, &motion, tolerance_mm);
                    let squares: f64 =
                        pairs.iter().map(|(p, q)| motion.transform_point(from[*p]).distance_squared(places[*q])).sum();
                    let rms_mm = (squares / pairs.len().max(1) as f64).sqrt();
                    let better =
                        |best: &Best| pairs.len() > best.pairs.len() || (pairs.len() == best.pairs.len() && rms_mm < best.rms_mm);
                    if best.as_ref().is_none_or(better) {
                        best = Some(Best { pairs, rms_mm, motion });
                    }
                }
            }
        }
    }
    let found = best.map(|Best { pairs, rms_mm, motion }| SelfMatch {
        beads: pairs.len(),
        angle_deg: motion.angle_to_rad(&Rigid::IDENTITY).to_degrees(),
        rms_mm,
        pairs: pairs.into_iter().map(|(p, q)| [names[p].to_owned(), names[q].to_owned()]).collect(),
    });
    (found, compared > MOST_COMPARED)
}

/// The best so far.
struct Best {
    pairs: Vec<(usize, usize)>,
    rms_mm: f64,
    motion: Rigid,
}

/// One-to-one, each bead with the nearest place within the tolerance.
fn pairs(from: &[DVec3], to: &[DVec3], motion: &Rigid, tolerance_mm: f64) -> Vec<(usize, usize)> {
    let mut taken = vec![false; to.len()];
    let mut pairs = Vec::new();
    for (n, p) in from.iter().enumerate() {
        let at = motion.transform_point(*p);
        let distance = |m: &usize| to[*m].distance(at);
        let nearest = (0..to.len()).filter(|m| !taken[*m]).min_by(|a, b| distance(a).total_cmp(&distance(b)));
        if let Some(m) = nearest.filter(|m| distance(m) <= tolerance_mm) {
            taken[m] = true;
            pairs.push((n, m));
        }
    }
    pairs
}
