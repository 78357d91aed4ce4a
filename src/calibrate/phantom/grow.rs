//! From three matched shots to all of them: the others join one by one, then beads that the first three did not show.

use glam::{DVec2, DVec3};

use super::adjust::{Adjustment, resected};
use super::seeds::{Gate, of_three};
use super::shot::{CameraErrors, PhantomShot};
use super::structure::{Structure, matched, seen};
use crate::geometry::Rigid;

/// Three shots are tried so many times, the best apart first.
const MOST_TRIOS: usize = 5;
/// Beams this far apart tell depth as well as any.
const APART: f64 = 0.6;
/// Matches of three shots that are followed up.
const FOLLOWED: usize = 2;
/// A rival has at least so large a share of the beads.
const RIVAL_BEADS: f64 = 0.7;
/// Moves of a picture that are tried when it joins.
const MOST_MOVES: usize = 12;
/// Squared deviation of a picture's move.
const MOST_MOVED: f64 = 16.0;
/// How the gate closes.
const CLOSING: [f64; 4] = [0.5, 0.2, 0.08, 0.0];
/// Fewest beads by which a shot joins.
const FEWEST: usize = 4;
/// Fewest shots of a bead.
pub(super) const FEWEST_SHOTS: usize = 3;
/// How many times the stated standard deviations a shot may be off: one that joins only so is found out later, by its own name.
const WIDE: f64 = 5.0;

/// All ways to match the shots, the one with most shadows first.
pub(super) fn matches(shots: &[PhantomShot], errors: &CameraErrors) -> Vec<Structure> {
    let (gates, wide) = (Gate::all(shots, errors, 1.0), Gate::all(shots, errors, WIDE));
    let mut found: Vec<Structure> = Vec::new();
    for of in trios(shots).into_iter().take(MOST_TRIOS) {
        let starts = of_three(shots, &gates, of);
        let most = starts.first().map_or(0, |best| best.points.len());
        let worthy = starts.into_iter().filter(|start| start.points.len() as f64 >= RIVAL_BEADS * most as f64);
        for start in worthy.take(FOLLOWED) {
            let Some(grown) = grown(shots, &gates, &wide, start) else { continue };
            match found.iter_mut().find(|known| known.alike(&grown) > 0.5) {
                Some(known) if known.observations() < grown.observations() => *known = grown,
                Some(_) => {}
                None => found.push(grown),
            }
        }
        // Two trios that lead to the same place are enough where all shots take part.
        let complete = |one: &Structure| one.shots().count() == shots.len();
        if found.len() == 1 && complete(&found[0]) && of != trios(shots)[0] {
            break;
        }
    }
    found.sort_by_key(|one| std::cmp::Reverse(one.observations()));
    found
}

/// Shots in threes, those whose beams are well apart first.
fn trios(shots: &[PhantomShot]) -> Vec<[usize; 3]> {
    let beams: Vec<DVec3> = shots.iter().map(|shot| shot.camera_from_world.inverse().transform_vector(DVec3::Z)).collect();
    let apart = |a: usize, b: usize| beams[a].cross(beams[b]).length().min(APART);
    let n = shots.len();
    let mut all: Vec<(f64, [usize; 3])> = Vec::new();
    for a in 0..n {
        for b in a + 1..n {
            for c in b + 1..n {
                let least = apart(a, b).min(apart(a, c)).min(apart(b, c));
                let most = shots[a].shadows.len().min(shots[b].shadows.len()).min(shots[c].shadows.len());
                // Too few shadows show too few beads, and a hundred are mostly false.
                all.push((least * (most as f64).min(12.0), [a, b, c]));
            }
        }
    }
    all.sort_by(|x, y| y.0.total_cmp(&x.0));
    // Each next trio brings in what those before it did not have.
    let mut ordered: Vec<[usize; 3]> = Vec::new();
    while ordered.len() < MOST_TRIOS && !all.is_empty() {
        let used = |n: usize| ordered.iter().filter(|trio| trio.contains(&n)).count() as f64;
        let worth = |(score, trio): &(f64, [usize; 3])| score / (1.0 + trio.iter().map(|n| used(*n)).sum::<f64>());
        let best = (0..all.len()).max_by(|a, b| worth(&all[*a]).total_cmp(&worth(&all[*b])).then(b.cmp(a)));
        let Some(best) = best else { break };
        ordered.push(all.remove(best).1);
    }
    ordered
}

fn grown(shots: &[PhantomShot], gates: &[Gate], wide: &[Gate], start: Structure) -> Option<Structure> {
    let mut structure = start;
    for (gates, times) in [(gates, 1.0), (wide, WIDE)] {
        loop {
            let missing = (0..shots.len()).filter(|n| structure.cameras[*n].is_none());
            let joins = missing.filter_map(|n| Some((n, joined(&shots[n], &gates[n], &structure.points, times)?)));
            let Some((shot, (camera, pairs))) = joins.max_by_key(|(n, (_, pairs))| (pairs.len(), std::cmp::Reverse(*n))) else {
                break;
            };
            structure.cameras[shot] = Some(camera);
            for (bead, shadow) in pairs {
                structure.tracks[bead][shot] = Some(shadow);
            }
            structure = Adjustment::plain(shots, &structure).improved()?;
            structure = rematched(shots, gates, &structure);
        }
    }
    for _ in 0..2 {
        structure = with_new_beads(shots, gates, &rematched(shots, gates, &structure));
        structure = Adjustment::plain(shots, &structure).improved()?;
    }
    structure = rematched(shots, gates, &structure);
    (structure.points.len() >= FEWEST).then_some(structure)
}

/// A shot's camera, and which of its shadows are which of the beads; `None` where too few agree.
fn joined(shot: &PhantomShot, gate: &Gate, points: &[DVec3], times: f64) -> Option<(Rigid, Vec<(usize, usize)>)> {
    let places = |camera: &Rigid, by: DVec2| -> Vec<Option<DVec2>> {
        points.iter().map(|point| seen(shot, camera, *point).map(|at| at + by)).collect()
    };
    let rough = places(&shot.camera_from_world, DVec2::ZERO);
    let mut trials: Vec<(f64, DVec2)> = Vec::new();
    for at in rough.iter().flatten() {
        for shadow in &shot.shadows {
            let by = shadow.image_px - *at;
            if gate.moved(by) > MOST_MOVED {
                continue;
            }
            let near = matched(&places(&shot.camera_from_world, by), shot, gate.fine_px, &|_| true);
            let worth: f64 = near.iter().map(|(_, _, off)| 1.0 - 0.5 * off / gate.fine_px).sum();
            trials.push((worth, by));
        }
    }
    trials.sort_by(|a, b| b.0.total_cmp(&a.0));
    let inside =
        |at: &DVec2| at.cmpge(DVec2::ZERO).all() && at.x < f64::from(shot.size_px[0]) && at.y < f64::from(shot.size_px[1]);
    let improved = |by: DVec2| {
        let mut camera = shot.camera_from_world;
        let mut pairs = matched(&places(&camera, by), shot, gate.fine_px, &|_| true);
        for share in CLOSING {
            if pairs.len() < FEWEST {
                return None;
            }
            let beads: Vec<(DVec3, usize)> = pairs.iter().map(|(bead, shadow, _)| (points[*bead], *shadow)).collect();
            camera = resected(shot, &camera, &beads, times)?;
            pairs = matched(&places(&camera, DVec2::ZERO), shot, (share * gate.fine_px).max(2.0 * gate.last_px), &|_| true);
        }
        let expected = places(&camera, DVec2::ZERO).iter().flatten().filter(|at| inside(at)).count();
        let enough = pairs.len() >= FEWEST && 2 * pairs.len() >= expected;
        let off: f64 = pairs.iter().map(|(_, _, off)| off).sum();
        enough.then(|| (camera, pairs.iter().map(|(bead, shadow, _)| (*bead, *shadow)).collect::<Vec<_>>(), off))
    };
    let best = trials.into_iter().take(MOST_MOVES).filter_map(|(_, by)| improved(by));
    let best = best.max_by(|a, b| a.1.len().cmp(&b.1.len()).then(b.2.total_cmp(&a.2)))?;
    Some((best.0, best.1))
}

/// Which shadow is whose, anew, by cameras and beads as they are.
fn rematched(shots: &[PhantomShot], gates: &[Gate], structure: &Structure) -> Structure {
    let mut next = structure.clone();
    for (shot, camera) in structure.shots() {
        let places: Vec<_> = structure.points.iter().map(|point| seen(&shots[shot], camera, *point)).collect();
        next.tracks.iter_mut().for_each(|track| track[shot] = None);
        for (bead, shadow, _) in matched(&places, &shots[shot], 2.0 * gates[shot].last_px, &|_| true) {
            next.tracks[bead][shot] = Some(shadow);
        }
    }
    next.drop_rare(FEWEST_SHOTS);
    next
}

/// A bead that the first three shots did not show.
struct NewBead {
    point: DVec3,
    /// Shot and shadow.
    shadows: Vec<(usize, usize)>,
    /// How far they are off, in all.
    off_px: f64,
}

/// Beads that shadows belonging to nothing agree on, in three shots or more.
fn with_new_beads(shots: &[PhantomShot], gates: &[Gate], structure: &Structure) -> Structure {
    let mut next = structure.clone();
    let posed: Vec<usize> = structure.shots().map(|(n, _)| n).collect();
    let strays = |structure: &Structure, shot: usize| -> Vec<usize> {
        let taken: std::collections::BTreeSet<usize> = structure.shadows_in(shot).map(|(_, shadow)| shadow).collect();
        (0..shots[shot].shadows.len()).filter(|n| !taken.contains(n)).collect()
    };
    loop {
        let free: Vec<(usize, Vec<usize>)> = posed.iter().map(|shot| (*shot, strays(&next, *shot))).collect();
        let mut best: Option<NewBead> = None;
        for (n, (a, in_a)) in free.iter().enumerate() {
            for (b, in_b) in &free[n + 1..] {
                for (i, j) in in_a.iter().flat_map(|i| in_b.iter().map(move |j| (*i, *j))) {
                    let Some(found) = agreed(shots, gates, &next, &free, [(*a, i), (*b, j)]) else { continue };
                    let better = |best: &NewBead| {
                        let (own, theirs) = (found.shadows.len(), best.shadows.len());
                        own > theirs || (own == theirs && found.off_px < best.off_px)
                    };
                    if best.as_ref().is_none_or(better) {
                        best = Some(found);
                    }
                }
            }
        }
        let Some(NewBead { point, shadows, .. }) = best else { return next };
        let mut track = vec![None; shots.len()];
        shadows.iter().for_each(|(shot, shadow)| track[*shot] = Some(*shadow));
        next.points.push(point);
        next.tracks.push(track);
    }
}

/// The bead of two shadows, if three shots or more show it; its shadows, and how far they are off in all.
fn agreed(
    shots: &[PhantomShot],
    gates: &[Gate],
    structure: &Structure,
    free: &[(usize, Vec<usize>)],
    pair: [(usize, usize); 2],
) -> Option<NewBead> {
    let point = structure.triangulated(shots, &pair)?;
    let off = |shot: usize, shadow: usize| {
        let at = structure.cameras[shot].as_ref().and_then(|camera| seen(&shots[shot], camera, point));
        at.map_or(f64::INFINITY, |at| at.distance(shots[shot].shadows[shadow].image_px))
    };
    let gate = |shot: usize| 2.0 * gates[shot].last_px;
    if !pair.iter().all(|(shot, shadow)| off(*shot, *shadow) <= gate(*shot)) {
        return None;
    }
    let nearest = free.iter().filter_map(|(shot, strays)| {
        let own = strays.iter().map(|shadow| (*shadow, off(*shot, *shadow)));
        let (shadow, off) = own.min_by(|x, y| x.1.total_cmp(&y.1)).filter(|(_, off)| *off <= gate(*shot))?;
        Some((*shot, shadow, off))
    });
    let all: Vec<(usize, usize, f64)> = nearest.collect();
    let off_px = all.iter().map(|(.., off)| off).sum();
    let shadows = || all.iter().map(|(shot, shadow, _)| (*shot, *shadow)).collect();
    (all.len() >= FEWEST_SHOTS).then(|| NewBead { point, shadows: shadows(), off_px })
}
