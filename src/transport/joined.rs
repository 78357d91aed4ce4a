//! Cells that are cheaper to cross as one: a flight pays for every face, and for tentative collisions where it is told of more matter than there is.

use std::collections::HashMap;

use super::bounds::Range;
use super::contents::{Content, Mixture};
use super::planes::Planes;

/// Cells are joined, two by two along each axis, and those again, where a flight through them meets so many tentative collisions more at most, with
/// all matter as thick as water at 60 keV. What is much denser than its surroundings, such as a screw, stays apart.
const MORE_COLLISIONS: f64 = 0.5;
const WATER_PER_MM: f64 = 0.02;
const LEVELS: u32 = 2;

/// Gives blocks of cells what they have together where that is cheaper; `number_of` puts a content into `contents`, once.
pub(super) fn join(
    content_of_cell: &mut [u32],
    planes: &[Planes; 3],
    contents: &mut Vec<Content>,
    mut number_of: impl FnMut(Content, &mut Vec<Content>) -> u32,
) {
    for level in 0..LEVELS {
        join_blocks(content_of_cell, planes, contents, &mut number_of, 1 << level);
    }
}

/// Gives all cells of a block of blocks, `side` cells wide each, what they have together where that costs less than their faces.
fn join_blocks(
    content_of_cell: &mut [u32],
    planes: &[Planes; 3],
    contents: &mut Vec<Content>,
    number_of: &mut impl FnMut(Content, &mut Vec<Content>) -> u32,
    side: usize,
) {
    let size: [usize; 3] = std::array::from_fn(|axis| planes[axis].cells());
    let index = |[i, j, k]: [usize; 3]| i + size[0] * (j + size[1] * k);
    let mut sums: HashMap<(Vec<u32>, u64), Option<u32>> = HashMap::new();
    for at in cells_between([0; 3], size.map(|cells| cells / (2 * side))) {
        let low = at.map(|n| n * 2 * side);
        let high = low.map(|at| at + 2 * side);
        let part = |cell: [usize; 3]| content_of_cell[index(cell)];
        let parts: Vec<u32> =
            cells_between([0; 3], [2; 3]).map(|at| part(std::array::from_fn(|n| low[n] + side * at[n]))).collect();
        // Only what the level below has joined whole.
        let is_whole = |(at, content): ([usize; 3], &u32)| {
            let first = std::array::from_fn(|n| low[n] + side * at[n]);
            cells_between(first, first.map(|cell| cell + side)).all(|cell| part(cell) == *content)
        };
        if parts.iter().all(|content| *content == parts[0]) || !cells_between([0; 3], [2; 3]).zip(&parts).all(is_whole) {
            continue;
        }
        let width_mm = (0..3).map(|axis| planes[axis].at[high[axis]] - planes[axis].at[low[axis]]).fold(0.0, f64::max);
        let block = (parts, width_mm.to_bits());
        let mixtures = || {
            block.0.iter().map(|content| match &contents[*content as usize] {
                Content::Mixed(mixture) => Some(mixture),
                Content::Empty | Content::Uniform { .. } => None,
            })
        };
        let sum = match sums.get(&block) {
            Some(sum) => *sum,
            None => {
                let sum = mixtures().collect::<Option<Vec<_>>>().and_then(|mixtures| {
                    let sum = together(&mixtures);
                    let mean = mixtures.iter().map(|mixture| densest(mixture)).sum::<f64>() / mixtures.len() as f64;
                    ((densest(&sum) - mean) * WATER_PER_MM * width_mm < MORE_COLLISIONS).then_some(sum)
                });
                let sum = sum.map(|sum| number_of(Content::Mixed(sum), contents));
                sums.insert(block, sum);
                sum
            }
        };
        if let Some(sum) = sum {
            for cell in cells_between(low, high) {
                content_of_cell[index(cell)] = sum;
            }
        }
    }
}

fn densest(mixture: &Mixture) -> f64 {
    mixture.ranges.iter().map(|range| range.to).fold(0.0, f64::max)
}

/// What holds in each of them.
fn together(mixtures: &[&Mixture]) -> Mixture {
    let mut ranges: Vec<Range> = Vec::new();
    for range in mixtures.iter().flat_map(|mixture| &mixture.ranges) {
        match ranges.iter_mut().find(|known| known.material == range.material) {
            Some(known) => (known.from, known.to) = (known.from.min(range.from), known.to.max(range.to)),
            None => ranges.push(*range),
        }
    }
    ranges.sort_unstable_by_key(|range| range.material);
    let mut things: Vec<u32> = mixtures.iter().flat_map(|mixture| &mixture.things).copied().collect();
    things.sort_unstable();
    things.dedup();
    let keeps_air = mixtures.iter().any(|mixture| mixture.keeps_air);
    Mixture { things, keeps_air, ranges, is_full: mixtures.iter().all(|mixture| mixture.is_full) }
}

/// Cells from one corner to before another.
pub(super) fn cells_between(from: [usize; 3], to: [usize; 3]) -> impl Iterator<Item = [usize; 3]> {
    (from[2]..to[2]).flat_map(move |k| (from[1]..to[1]).flat_map(move |j| (from[0]..to[0]).map(move |i| [i, j, k])))
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Cells 8 mm wide, four along each axis, each with bone of `to(cell)` at most.
    fn joined(to: impl Fn([usize; 3]) -> f64) -> (Vec<u32>, Vec<Content>) {
        let planes: [Planes; 3] = std::array::from_fn(|_| Planes::new((0..5).map(|n| 8.0 * f64::from(n)).collect()));
        let mut contents = Vec::new();
        let mut of_cell = Vec::new();
        for (number, cell) in cells_between([0; 3], [4; 3]).enumerate() {
            let ranges = vec![Range { material: 3, from: 1.0 - 1e-3 * number as f64, to: to(cell) }];
            contents.push(Content::Mixed(Mixture {
                things: vec![number as u32 % 2],
                keeps_air: number == 9,
                ranges,
                is_full: number != 7,
            }));
            of_cell.push(number as u32);
        }
        join(&mut of_cell, &planes, &mut contents, |content, contents| {
            contents.push(content);
            contents.len() as u32 - 1
        });
        (of_cell, contents)
    }

    /// Noise of tissue is one box, which holds what each cell held; a screw's cell and its block stay as they were, the other blocks are joined.
    #[test]
    fn tissue_is_joined_and_a_screw_stays_apart() {
        let (of_cell, contents) = joined(|[i, ..]| 1.1 + 0.1 * i as f64);
        let Content::Mixed(all) = &contents[of_cell[0] as usize] else { panic!("a mixture") };
        assert!(of_cell.iter().all(|content| *content == of_cell[0]));
        assert_eq!((all.things.as_slice(), all.keeps_air, all.is_full), ([0, 1].as_slice(), true, false));
        let [Range { material: 3, from, to }] = all.ranges[..] else { panic!("{:?}", all.ranges) };
        assert!((from - (1.0 - 0.063)).abs() < 1e-12 && (to - 1.4).abs() < 1e-12, "{from} {to}");
        let (of_cell, contents) = joined(|cell| if cell == [1, 0, 3] { 8.0 } else { 1.1 });
        let distinct: std::collections::BTreeSet<u32> = of_cell.iter().copied().collect();
        assert_eq!(distinct.len(), 8 + 7, "eight cells about the screw, seven blocks");
        let screw = of_cell[1 + 4 * 4 * 3] as usize;
        assert!(screw < 64 && matches!(&contents[screw], Content::Mixed(mixture) if mixture.ranges[0].to == 8.0));
    }
}
