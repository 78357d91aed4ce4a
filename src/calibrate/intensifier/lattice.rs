//! Which spot is which node of a square grid, at any angle, bent by distortion, with spots that are missing and spots that are false.
//!
//! A cross of five spots near the middle begins; from each named spot its neighbours are expected one step on, the step being that which
//! led to it, so that it bends with the grid. What gaps and false spots leave is settled by polynomials: each names the spots near whole
//! cells, which makes the next one reach further.

use std::collections::{BTreeMap, BTreeSet, VecDeque};

use glam::{DVec2, IVec2};

use super::polynomial::{Node, Polynomial};
use super::spots::Spot;
use crate::geometry::term_count;
use crate::mask::Disc;

/// A neighbour lies within this share of a step from where it is expected.
const NEIGHBOUR: f64 = 0.22;
/// The arms of the first cross agree to this share of a step.
const CROSS: f64 = 0.2;
/// A spot shows a node when it lies within this share of a cell from it.
const ON_NODE: f64 = 0.2;
/// Crosses that are tried.
const MOST_CROSSES: usize = 16;
/// Spots next to the middle in which crosses are sought.
const MOST_SEEDS: usize = 200;
/// A grid that holds this share of the spots needs no other cross.
const CLEAR_SHARE: f64 = 0.7;
const ROUNDS: usize = 12;

/// Names spots by nodes; the fewest wanted are twice the terms of a polynomial of `order`.
///
/// # Errors
/// How many were named, when those are too few.
pub fn name(spots: &[Spot], disc: &Disc, order: usize) -> Result<Vec<Node>, usize> {
    let required = required(order);
    let mut seeds: Vec<usize> = (0..spots.len()).collect();
    let from_middle = |n: &usize| spots[*n].image_px.distance_squared(disc.centre);
    seeds.sort_by(|a, b| from_middle(a).total_cmp(&from_middle(b)));
    let crosses = seeds.into_iter().take(MOST_SEEDS).filter_map(|seed| Some((seed, cross(spots, seed)?))).take(MOST_CROSSES);
    let mut best: Vec<Node> = Vec::new();
    for (seed, steps) in crosses {
        let named = settle(spots, &grow(spots, seed, steps), disc, order);
        if named.len() > best.len() {
            best = named;
        }
        if best.len() as f64 >= CLEAR_SHARE * spots.len() as f64 {
            break;
        }
    }
    if best.len() >= required { Ok(best) } else { Err(best.len()) }
}

/// Fewest nodes that determine a polynomial of `order` with some to hold out.
pub fn required(order: usize) -> usize {
    2 * term_count(order)
}

fn nearest(spots: &[Spot], at: DVec2, within_px: f64) -> Option<usize> {
    let distance = |n: &usize| spots[*n].image_px.distance(at);
    (0..spots.len()).filter(|n| distance(n) <= within_px).min_by(|a, b| distance(a).total_cmp(&distance(b)))
}

/// Steps along the grid's two axes at a spot that has all four neighbours.
fn cross(spots: &[Spot], seed: usize) -> Option<[DVec2; 2]> {
    let middle = spots[seed].image_px;
    let mut near: Vec<DVec2> = spots.iter().map(|spot| spot.image_px - middle).filter(|step| step.length() > 0.0).collect();
    near.sort_by(|a, b| a.length_squared().total_cmp(&b.length_squared()));
    near.iter().take(4).find_map(|&step| {
        let arm = |expected: DVec2| nearest(spots, middle + expected, CROSS * step.length()).map(|n| spots[n].image_px - middle);
        let (back, up, down) = (arm(-step)?, arm(step.perp())?, arm(-step.perp())?);
        // A diagonal cross has the spots of the real one between its arms.
        let finer = arm(0.5 * (step + up)).is_some();
        (!finer).then_some([0.5 * (step - back), 0.5 * (up - down)])
    })
}

/// Named spots by cell, spreading from `seed`.
fn grow(spots: &[Spot], seed: usize, steps: [DVec2; 2]) -> BTreeMap<[i32; 2], usize> {
    let mut named = BTreeMap::from([([0, 0], seed)]);
    let mut taken = BTreeSet::from([seed]);
    let mut queue = VecDeque::from([(IVec2::ZERO, seed, steps)]);
    while let Some((cell, spot, steps)) = queue.pop_front() {
        for (axis, sign) in [(0, 1), (0, -1), (1, 1), (1, -1)] {
            let next = cell + sign * [IVec2::X, IVec2::Y][axis];
            if named.contains_key(&next.to_array()) {
                continue;
            }
            let here = spots[spot].image_px;
            let expected = here + f64::from(sign) * steps[axis];
            let Some(found) = nearest(spots, expected, NEIGHBOUR * steps[axis].length()).filter(|found| !taken.contains(found))
            else {
                continue;
            };
            let mut onward = steps;
            onward[axis] = f64::from(sign) * (spots[found].image_px - here);
            named.insert(next.to_array(), found);
            taken.insert(found);
            queue.push_back((next, found, onward));
        }
    }
    named
}

/// Names all spots by a polynomial through those that are named, until nothing changes.
fn settle(spots: &[Spot], grown: &BTreeMap<[i32; 2], usize>, disc: &Disc, order: usize) -> Vec<Node> {
    let mut nodes: Vec<Node> = grown.iter().map(|(cell, spot)| Node::new(&spots[*spot], IVec2::from_array(*cell))).collect();
    for round in 0..ROUNDS {
        // Low orders first: they reach beyond their nodes without swinging.
        let order = order.min(2 + round);
        let order = (1..=order).rev().find(|order| nodes.len() >= required(*order));
        let Some(polynomial) = order.and_then(|order| Polynomial::fit(nodes.iter(), disc, order)) else { return Vec::new() };
        let next = on_nodes(spots, &polynomial);
        if next == nodes && round + 3 > polynomial.order {
            break;
        }
        nodes = next;
    }
    nodes
}

/// Spots near whole cells; of several at one cell the nearest.
fn on_nodes(spots: &[Spot], polynomial: &Polynomial) -> Vec<Node> {
    let mut nearest: BTreeMap<[i32; 2], (f64, Node)> = BTreeMap::new();
    for spot in spots {
        let cells = polynomial.at(spot.image_px);
        let node = Node::new(spot, cells.round().as_ivec2());
        let off = (cells - cells.round()).length();
        if !(off <= ON_NODE) {
            continue;
        }
        let slot = nearest.entry(node.cell.to_array()).or_insert((off, node));
        if off < slot.0 {
            *slot = (off, node);
        }
    }
    nearest.into_values().map(|(_, node)| node).collect()
}
