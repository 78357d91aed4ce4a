//! Triples of beads tried side by side against one triple of shadows: plain loops over columns, of which the compiler makes vectors. Every
//! number is the one that the functions of `triangle` give of one triple alone.
//!
//! Flags are u64: columns of one width are seen not to overlap.

use super::bead_triples::Windows;
use super::support::{Seen, Supported, WIDE, part};
use super::tables::Depths;
use super::triangle::{Images, MOST_STEPS, Rough, Step, agree, are_finite};
use crate::image::on_widest_vectors;

/// Triples of beads in a block.
const MOST: usize = 128;
/// Depths: each has a pose and its twin.
const TWICE: usize = 2 * MOST;

/// See the module.
pub(super) struct Block {
    count: usize,
    beads: [[u32; 3]; MOST],
    squares_mm2: [[f64; MOST]; 3],
    /// Of the first, which twins share, and of the two others of each twin.
    first_mm: [f64; MOST],
    others_mm: [[[f64; MOST]; 2]; 2],
    spread: [f64; MOST],
    may_count: [[u64; MOST]; 2],
    starts: Starts,
}

/// Depths on their way to exact ones.
struct Starts {
    count: usize,
    beads: [[u32; 3]; TWICE],
    squares_mm2: [[f64; TWICE]; 3],
    depths_mm: [[f64; TWICE]; 3],
    stepped_mm: [[f64; TWICE]; 3],
    spread: [f64; TWICE],
    counts: [u64; TWICE],
    is_done: [u64; TWICE],
    is_too_long: [u64; TWICE],
}

impl Block {
    pub fn new() -> Box<Self> {
        Box::new(Self {
            count: 0,
            beads: [[0; 3]; MOST],
            squares_mm2: [[1.0; MOST]; 3],
            first_mm: [0.0; MOST],
            others_mm: [[[0.0; MOST]; 2]; 2],
            spread: [0.0; MOST],
            may_count: [[0; MOST]; 2],
            starts: Starts {
                count: 0,
                beads: [[0; 3]; TWICE],
                squares_mm2: [[1.0; TWICE]; 3],
                depths_mm: [[1.0; TWICE]; 3],
                stepped_mm: [[1.0; TWICE]; 3],
                spread: [0.0; TWICE],
                counts: [0; TWICE],
                is_done: [0; TWICE],
                is_too_long: [0; TWICE],
            },
        })
    }

    pub fn clear(&mut self) {
        self.count = 0;
    }

    pub fn is_full(&self) -> bool {
        self.count == MOST
    }

    /// Adds three beads, with the squares of the distances of 1 and 2, 1 and 3, 2 and 3, where the block is not full.
    #[inline]
    pub fn push(&mut self, beads: [usize; 3], squares_mm2: [f64; 3]) {
        let n = self.count;
        if n < MOST {
            self.beads[n] = beads.map(|bead| bead as u32);
            for (column, square_mm2) in self.squares_mm2.iter_mut().zip(squares_mm2) {
                column[n] = square_mm2;
            }
            self.count += 1;
        }
    }

    /// Takes the exact depths of all that have any within the windows.
    pub fn solve(&mut self, images: &Images, windows: &Windows) {
        on_widest_vectors(RoughDepths { block: self, images, widest: &windows.widest });
        self.keep_rough(windows);
        let starts = &mut self.starts;
        on_widest_vectors(FirstSteps { starts, images, widest: &windows.widest });
        starts.shorten(images, &windows.widest);
        starts.keep(|own, n| {
            own.copy_stepped(n);
            windows.are_alike || windows.may_contain(own.beads[n], own.depths(n), Rough::stepped_factor(own.spread[n]))
        });
        on_widest_vectors(LastSteps { starts, images, widest: &windows.widest });
        starts.keep(|own, n| windows.are_alike || windows.may_contain(own.beads[n], own.depths(n), 1.0));
    }

    fn keep_rough(&mut self, windows: &Windows) {
        // First which, without a branch that nobody could predict.
        let (mut list, mut listed) = ([0u16; TWICE], 0);
        for n in 0..self.count.min(MOST) {
            for twin in 0..2 {
                list[listed % TWICE] = (2 * n + twin) as u16;
                listed += self.may_count[twin][n] as usize;
            }
        }
        let starts = &mut self.starts;
        starts.count = 0;
        for of in &list[..listed.min(TWICE)] {
            let (n, twin) = (usize::from(of / 2) % MOST, usize::from(of % 2));
            let depths_mm = [self.first_mm[n], self.others_mm[twin][0][n], self.others_mm[twin][1][n]];
            let (beads, spread) = (self.beads[n], self.spread[n]);
            if windows.are_alike || windows.may_contain(beads, depths_mm, Rough::factor(spread)) {
                let to = starts.count % TWICE;
                (starts.beads[to], starts.spread[to]) = (beads, spread);
                for (side, depth_mm) in depths_mm.into_iter().enumerate() {
                    starts.squares_mm2[side][to] = self.squares_mm2[side][n];
                    starts.depths_mm[side][to] = depth_mm;
                }
                starts.count += 1;
            }
        }
    }

    /// How many are solved.
    pub fn solved(&self) -> usize {
        self.starts.count
    }

    /// Keeps of those that are solved the ones that are `wanted`, by their beads and depths.
    pub fn retain(&mut self, wanted: impl Fn([usize; 3], [f64; 3]) -> bool) {
        let starts = &mut self.starts;
        starts.counts[..starts.count].fill(1);
        starts.keep(|own, n| wanted(own.beads(n), own.depths(n)));
    }

    /// Gives of those that are solved the ones that put at least so many other beads where a shadow may be near, and all before the camera.
    pub fn each_supported(&mut self, seen: &Seen, needed: usize, mut take: impl FnMut([usize; 3], [f64; 3])) {
        let starts = &mut self.starts;
        let Starts { count, beads, depths_mm, counts, .. } = starts;
        let depths_mm = depths_mm.each_ref().map(|column| &column[..]);
        on_widest_vectors(Supported { count: *count, beads, depths_mm, counts, seen, needed: needed as i64 });
        starts.keep(|_, _| true);
        (0..starts.count).for_each(|n| take(starts.beads(n), starts.depths(n)));
    }
}

impl Starts {
    fn beads(&self, n: usize) -> [usize; 3] {
        self.beads[n].map(|bead| bead as usize)
    }

    #[inline(always)]
    fn squares(&self, n: usize) -> [f64; 3] {
        [self.squares_mm2[0][n], self.squares_mm2[1][n], self.squares_mm2[2][n]]
    }

    #[inline(always)]
    fn depths(&self, n: usize) -> [f64; 3] {
        [self.depths_mm[0][n], self.depths_mm[1][n], self.depths_mm[2][n]]
    }

    fn copy_stepped(&mut self, n: usize) {
        (0..3).for_each(|side| self.depths_mm[side][n] = self.stepped_mm[side][n]);
    }

    /// Takes again, shortened, the first steps that were too long.
    #[cold]
    #[inline(never)]
    fn shorten_all(&mut self, images: &Images, widest: &[Depths; 3]) {
        for n in (0..self.count).filter(|n| self.is_too_long[*n] != 0).collect::<Vec<usize>>() {
            let step = Step::new(self.squares(n), images, self.depths(n));
            let to = step.taken(self.depths(n));
            let counts = step.is_defined() & are_finite(to) & may_contain(widest, to, Rough::stepped_factor(self.spread[n]));
            self.counts[n] = u64::from(counts);
            (0..3).for_each(|side| self.stepped_mm[side][n] = to[side]);
        }
    }

    fn shorten(&mut self, images: &Images, widest: &[Depths; 3]) {
        if self.is_too_long[..self.count].iter().fold(0, |any, one| any | one) != 0 {
            self.shorten_all(images, widest);
        }
    }

    /// Moves those that count, and that `also` says so of, to the front.
    fn keep(&mut self, mut also: impl FnMut(&mut Self, usize) -> bool) {
        let (mut list, mut listed) = ([0u16; TWICE], 0);
        for n in 0..self.count.min(TWICE) {
            list[listed % TWICE] = n as u16;
            listed += self.counts[n] as usize;
        }
        self.count = 0;
        for n in &list[..listed.min(TWICE)] {
            let n = usize::from(*n) % TWICE;
            if also(self, n) {
                let to = self.count % TWICE;
                (self.beads[to], self.is_done[to]) = (self.beads[n], self.is_done[n]);
                for side in 0..3 {
                    self.squares_mm2[side][to] = self.squares_mm2[side][n];
                    self.depths_mm[side][to] = self.depths_mm[side][n];
                }
                self.count += 1;
            }
        }
    }
}

/// Whether depths that may be off by a factor are among these.
#[inline(always)]
fn may_contain(widest: &[Depths; 3], depths_mm: [f64; 3], factor: f64) -> bool {
    let [first, second, third] = widest;
    first.may_contain(depths_mm[0], factor) & second.may_contain(depths_mm[1], factor) & third.may_contain(depths_mm[2], factor)
}

/// All of so many, and what fills the last vector.
#[inline(always)]
fn filled(count: usize, most: usize) -> usize {
    count.next_multiple_of(WIDE).min(most)
}

struct RoughDepths<'b> {
    block: &'b mut Block,
    images: &'b Images,
    widest: &'b [Depths; 3],
}

impl pulp::NullaryFnOnce for RoughDepths<'_> {
    type Output = ();

    #[inline(always)]
    fn call(self) {
        let (block, images, widest) = (self.block, *self.images, *self.widest);
        for n in 0..filled(block.count, MOST) {
            let rough = Rough::new([block.squares_mm2[0][n], block.squares_mm2[1][n], block.squares_mm2[2][n]], &images);
            let (is_real, factor) = (rough.is_real(), Rough::factor(rough.spread));
            let [one, twin] = rough.depths_mm;
            block.first_mm[n] = one[0];
            block.others_mm[0][0][n] = one[1];
            block.others_mm[0][1][n] = one[2];
            block.others_mm[1][0][n] = twin[1];
            block.others_mm[1][1][n] = twin[2];
            block.spread[n] = rough.spread;
            block.may_count[0][n] = u64::from(is_real & may_contain(&widest, one, factor));
            block.may_count[1][n] = u64::from(is_real & may_contain(&widest, twin, factor));
        }
    }
}

struct FirstSteps<'b> {
    starts: &'b mut Starts,
    images: &'b Images,
    widest: &'b [Depths; 3],
}

impl pulp::NullaryFnOnce for FirstSteps<'_> {
    type Output = ();

    #[inline(always)]
    fn call(self) {
        let (starts, images, widest) = (self.starts, *self.images, *self.widest);
        for n in 0..filled(starts.count, TWICE) {
            let step = Step::new(starts.squares(n), &images, starts.depths(n));
            let to = step.whole(starts.depths(n));
            let counts = step.is_defined() & are_finite(to) & may_contain(&widest, to, Rough::stepped_factor(starts.spread[n]));
            starts.stepped_mm[0][n] = to[0];
            starts.stepped_mm[1][n] = to[1];
            starts.stepped_mm[2][n] = to[2];
            starts.counts[n] = u64::from(counts);
            starts.is_done[n] = u64::from(step.is_last());
            starts.is_too_long[n] = u64::from(step.is_too_long());
        }
    }
}

struct LastSteps<'b> {
    starts: &'b mut Starts,
    images: &'b Images,
    widest: &'b [Depths; 3],
}

impl pulp::NullaryFnOnce for LastSteps<'_> {
    type Output = ();

    #[inline(always)]
    fn call(self) {
        let (starts, images, widest) = (self.starts, *self.images, *self.widest);
        let count = starts.count.min(TWICE);
        for first in (0..count).step_by(WIDE) {
            let [a1, a2, a3] = starts.squares_mm2.each_ref().map(|column| part(column, first));
            let [mut x, mut y, mut z] = starts.depths_mm.each_ref().map(|column| part(column, first));
            let mut is_running = part(&starts.is_done, first);
            for (l, running) in is_running.iter_mut().enumerate() {
                *running = u64::from(first + l < count && *running == 0);
            }
            let mut is_lost = [0u64; WIDE];
            for _ in 1..MOST_STEPS {
                if is_running.iter().fold(0, |any, one| any | one) == 0 {
                    break;
                }
                let from = [x, y, z];
                let mut is_long = [0u64; WIDE];
                for l in 0..WIDE {
                    let step = Step::new([a1[l], a2[l], a3[l]], &images, [x[l], y[l], z[l]]);
                    let to = step.whole([x[l], y[l], z[l]]);
                    let is_fine = step.is_defined() & are_finite(to);
                    let runs = is_running[l] != 0;
                    x[l] = if runs { to[0] } else { x[l] };
                    y[l] = if runs { to[1] } else { y[l] };
                    z[l] = if runs { to[2] } else { z[l] };
                    is_long[l] = is_running[l] & u64::from(step.is_too_long());
                    is_lost[l] |= is_running[l] & u64::from(!is_fine);
                    is_running[l] &= u64::from(is_fine & !step.is_last());
                }
                if is_long.iter().fold(0, |any, one| any | one) != 0 {
                    for l in (0..WIDE).filter(|l| is_long[*l] != 0) {
                        let depths = [from[0][l], from[1][l], from[2][l]];
                        let step = Step::new([a1[l], a2[l], a3[l]], &images, depths);
                        let to = step.taken(depths);
                        let is_fine = step.is_defined() & are_finite(to);
                        [x[l], y[l], z[l]] = to;
                        (is_lost[l], is_running[l]) = (u64::from(!is_fine), u64::from(is_fine));
                    }
                }
            }
            let counts = &mut starts.counts[first..][..WIDE];
            for l in 0..WIDE {
                let depths = [x[l], y[l], z[l]];
                let is_found = agree([a1[l], a2[l], a3[l]], &images, depths) & may_contain(&widest, depths, 1.0);
                counts[l] = u64::from(is_found & (is_lost[l] == 0));
            }
            for (column, found) in starts.depths_mm.iter_mut().zip([x, y, z]) {
                column[first..][..WIDE].copy_from_slice(&found);
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use glam::{DMat3, DVec2, DVec3};

    use super::super::occupancy::Occupancy;
    use super::super::tables::Target;
    use super::super::triangle;
    use super::*;
    use crate::beads::Detection;
    use crate::geometry::Intrinsics;
    use crate::random::{Purpose, Stream};

    /// Blocks that are full and not, windows of all beads and of each, triangles that fit nothing: bit for bit what one triple alone gives, in order.
    #[test]
    fn side_by_side_is_one_by_one() {
        let mut random = Stream::new(13, 0, 0, Purpose::Evaluation);
        let intrinsics = Intrinsics { fx: 3500.0, fy: 3490.0, skew: 0.3, cx: 511.5, cy: 500.5 };
        let mut block = Block::new();
        let (mut solved, mut supported, mut unsupported) = (0, 0, 0);
        for round in 0..60usize {
            let mut between = |low: f64, high: f64| low + (high - low) * random.uniform();
            let mut place = |z: f64| DVec3::new(between(-70.0, 70.0), between(-70.0, 70.0), between(-70.0, 70.0) + z);
            let places: Vec<DVec3> = (0..9).map(|_| place(0.0)).collect();
            let (at, others) = ([place(700.0), place(700.0), place(700.0)], [(); 30].map(|()| place(700.0)));
            let target = |lps_mm: &DVec3| Target { lps_mm: *lps_mm, sigma_mm: 0.1, place_mm2: DMat3::IDENTITY, radius_mm: None };
            let targets: Vec<Target> = places.iter().map(target).collect();
            let shadows = others.map(|p| Detection { image_px: intrinsics.project(p), ..Detection::default() });
            let shadows = Occupancy::new(&shadows, 24.0);
            let images = Images::new(at.map(|p| DVec2::new(p.x / p.z, p.y / p.z)));
            let window = |bead: usize, n: usize| match round % 3 {
                0 => Depths { near: 450.0, far: 900.0 },
                1 => Depths { near: 450.0 + 20.0 * bead as f64, far: 1000.0 - 30.0 * n as f64 },
                _ => Depths { near: 0.0, far: f64::INFINITY },
            };
            let windows = Windows::new(&[(); 3].map(|()| vec![true; 9]), window);
            block.clear();
            let mut alone = Vec::new();
            for beads in (0..729).map(|n: usize| [n / 81, n / 9 % 9, n % 9]) {
                let [i, j, k] = beads;
                if i == j || i == k || j == k || block.is_full() || (round % 5 == 4 && block.count == 21) {
                    continue;
                }
                let squares_mm2 = [(i, j), (i, k), (j, k)].map(|(a, b)| places[a].distance_squared(places[b]));
                block.push(beads, squares_mm2);
                let Some(rough) = triangle::rough_depths(squares_mm2, &images) else { continue };
                let counts = |depths: [f64; 3], factor: f64| windows.may_contain(beads.map(|bead| bead as u32), depths, factor);
                for start in rough.depths_mm.into_iter().filter(|start| counts(*start, Rough::factor(rough.spread))) {
                    let stepped = |depths: &[f64; 3]| counts(*depths, Rough::stepped_factor(rough.spread));
                    let exact = triangle::depths(squares_mm2, &images, start, stepped);
                    alone.extend(exact.filter(|depths| counts(*depths, 1.0)).map(|depths| (beads, depths)));
                }
            }
            block.solve(&images, &windows);
            let of_block = |block: &Block| -> Vec<_> {
                (0..block.solved()).map(|n| (block.starts.beads(n), block.starts.depths(n))).collect()
            };
            assert_eq!(of_block(&block), alone, "round {round}");
            solved += alone.len();
            if round.is_multiple_of(2) {
                let is_wanted = |beads: [usize; 3], depths: [f64; 3]| beads[1].is_multiple_of(2) && depths[0] < 800.0;
                block.retain(is_wanted);
                alone.retain(|(beads, depths)| is_wanted(*beads, *depths));
                assert_eq!(of_block(&block), alone, "round {round}");
            }
            let needed = 1 + round % 4;
            let before = alone.len();
            alone.retain(|(beads, depths)| {
                let (turn, shift_mm) = triangle::turn_and_shift(&beads.map(|bead| places[bead]), &images, *depths);
                let others = (0..9).filter(|bead| !beads.contains(bead)).map(|bead| turn * places[bead] + shift_mm);
                let near = others.clone().filter(|p| !shadows.near(intrinsics.project(*p)).is_empty()).count();
                near >= needed && others.clone().all(|p| p.z > 1.0)
            });
            let seen = Seen { targets: &targets, images: &images, intrinsics: &intrinsics, shadows: &shadows };
            let mut found = Vec::new();
            block.each_supported(&seen, needed, |beads, depths| found.push((beads, depths)));
            assert_eq!(found, alone, "round {round}");
            supported += found.len();
            unsupported += before - found.len();
        }
        assert!(solved > 2000 && supported > 200 && unsupported > 200, "{solved}, {supported}, {unsupported}");
    }
}
