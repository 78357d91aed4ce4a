//! Edges of an image, to a fraction of a pixel, and how far apart the edges of two images lie.

use rayon::prelude::*;

use super::filters::{Gradient, noise};
use super::seen::{SCORE_SIGMA_PX, Seen};
use crate::image::{Image, on_widest_vectors, quantile};

/// An edge is a local maximum of the gradient among the strongest quarter, or nearly as strong as the strongest: where an image has
/// nothing but equally strong edges, all of them count.
const STRONG: (f64, f64, f64) = (0.75, 0.97, 0.8);
/// Weaker edges are this many times as many as strong ones…
const WEAK_FACTOR: f64 = 2.5;
/// … and at least this share as strong.
const WEAK_FLOOR: f32 = 0.25;
/// For a picture half of the maxima are drawn: it should show the anatomy, not only what is strongest.
const DRAWN: f64 = 0.5;
/// A gradient counts where it exceeds what noise alone makes of it by this factor.
const ABOVE_NOISE: f64 = 4.5;
/// Shorter chains of edge pixels are noise.
const SHORTEST_PX: usize = 12;
/// Edges are sought this far around an edge of the other image; further counts as this far.
const REACH_PX: i64 = 12;

/// One edge point.
#[derive(Clone, Copy, Debug)]
pub(super) struct EdgePoint {
    /// Sub-pixel position.
    pub u: f32,
    pub v: f32,
    /// Unit normal (along the gradient).
    nu: f32,
    nv: f32,
    /// Looks for a partner; weak points are only found by others.
    strong: bool,
}

/// Edge points by pixel.
pub(super) struct EdgeMap {
    width: usize,
    height: usize,
    pub points: Vec<EdgePoint>,
    by_pixel: Vec<u32>,
}

const NOTHING: u32 = u32::MAX;

/// Local maxima of the gradient: index of the pixel, point, size; and what noise makes of the gradient.
pub(super) struct Maxima {
    width: usize,
    height: usize,
    found: Vec<(usize, EdgePoint, f32)>,
    noise: f32,
    /// σ of a pixel of the image, where it is known.
    pub sigma: Option<f64>,
}

/// The edges of both images, for scoring: as many strong ones in the acquired as in the simulated image, whatever the scales of the two,
/// and among weaker ones each strong edge may find its partner.
pub(super) fn of_both(acquired: &Maxima, simulated: &Maxima) -> (EdgeMap, EdgeMap) {
    let limit = simulated.limit(STRONG.0);
    let count = simulated.found.iter().filter(|(_, _, size)| *size >= limit).count();
    let weaker = (WEAK_FACTOR * count as f64) as usize;
    let map = |maxima: &Maxima| maxima.map(maxima.nth_largest(count), maxima.nth_largest(weaker));
    rayon::join(|| map(acquired), || map(simulated))
}

/// Where the gradient of an image is largest across its direction, within `usable`.
pub(super) fn maxima(seen: &Seen, usable: &Image<bool>) -> Maxima {
    let (width, height) = (seen.image.width, seen.image.height);
    let (found, sigma) = rayon::join(|| largest(seen), || noise(seen.image, usable));
    // White noise of σ becomes a gradient of σ / (s² √(8π)) per component after a Gaussian of s.
    let of_noise = sigma.unwrap_or(0.0) / (SCORE_SIGMA_PX.powi(2) * (8.0 * std::f64::consts::PI).sqrt());
    Maxima { width, height, found, noise: (ABOVE_NOISE * of_noise) as f32, sigma }
}

/// Row by row.
fn largest(seen: &Seen) -> Vec<(usize, EdgePoint, f32)> {
    let (width, height) = (seen.image.width, seen.image.height);
    if width < 5 || height < 5 {
        return Vec::new();
    }
    let Gradient { du, dv, .. } = &seen.gradient;
    let mut sizes = vec![0.0f32; width * height];
    let row = |v: usize| v * width..(v + 1) * width;
    sizes.par_chunks_mut(width).enumerate().for_each(|(v, out)| {
        on_widest_vectors(Sizes {
            out,
            du: &du.pixels[row(v)],
            dv: &dv.pixels[row(v)],
            known: &seen.gradient.known.pixels[row(v)],
        });
    });
    let in_rows = |first: usize| {
        let (mut found, mut steps) = (Vec::new(), vec![0i32; width]);
        for v in first..(first + ROWS).min(height - 2) {
            let (du, dv, here) = (&du.pixels[row(v)], &dv.pixels[row(v)], &sizes[row(v)]);
            on_widest_vectors(Steps { out: &mut steps, du, dv, sizes: here, width: width as i32 });
            for (u, step) in steps.iter().enumerate().take(width - 2).skip(2) {
                let at = v * width + u;
                let (here, step) = (sizes[at], *step as isize);
                let (a, b) = (sizes[at.wrapping_add_signed(step)], sizes[at.wrapping_add_signed(-step)]);
                // False as well where one of them is not known, and where there is no gradient.
                if here > b && here >= a {
                    let (nu, nv) = (du[u] / here, dv[u] / here);
                    let (su, sv) = (step_along(nu), step_along(nv));
                    // The parabola through the three has its top this share of a step ahead.
                    let shift = (0.5 * (a - b) / (2.0 * here - a - b).max(1e-12)).clamp(-0.5, 0.5);
                    let (u, v) = (u as f32 + shift * su as f32, v as f32 + shift * sv as f32);
                    found.push((at, EdgePoint { u, v, nu, nv, strong: false }, here));
                }
            }
        }
        found
    };
    let found: Vec<Vec<_>> = (2..height - 2).into_par_iter().step_by(ROWS).map(in_rows).collect();
    found.concat()
}

/// A core takes so many rows at a time.
const ROWS: usize = 32;

/// The size of a row's gradients; NaN where they are not known.
struct Sizes<'a> {
    out: &'a mut [f32],
    du: &'a [f32],
    dv: &'a [f32],
    known: &'a [bool],
}

impl pulp::NullaryFnOnce for Sizes<'_> {
    type Output = ();

    #[inline(always)]
    fn call(self) {
        for ((out, known), (du, dv)) in self.out.iter_mut().zip(self.known).zip(self.du.iter().zip(self.dv)) {
            let size = (du * du + dv * dv).sqrt();
            *out = if *known { size } else { f32::NAN };
        }
    }
}

/// One step along a row's gradients, on the grid: how far on the neighbour in the nearest of eight directions is stored.
struct Steps<'a> {
    out: &'a mut [i32],
    du: &'a [f32],
    dv: &'a [f32],
    sizes: &'a [f32],
    width: i32,
}

impl pulp::NullaryFnOnce for Steps<'_> {
    type Output = ();

    #[inline(always)]
    fn call(self) {
        for ((out, size), (du, dv)) in self.out.iter_mut().zip(self.sizes).zip(self.du.iter().zip(self.dv)) {
            // Without a gradient there is no step: the neighbour is the pixel itself.
            *out = step_along(dv / size) * self.width + step_along(du / size);
        }
    }
}

/// `component` of a unit vector times 1.3, rounded: of eight directions the nearest.
#[inline(always)]
fn step_along(component: f32) -> i32 {
    i32::from(component * 1.3 >= 0.5) - i32::from(component * 1.3 <= -0.5)
}

impl Maxima {
    /// The edges of a noise-free image, to be drawn over another.
    pub(super) fn to_draw(&self) -> Image<bool> {
        let limit = self.limit(DRAWN);
        self.map(limit, limit).picture()
    }

    /// The gradient that `weak_share` of the maxima fall short of, or nearly the strongest where all are alike.
    fn limit(&self, weak_share: f64) -> f32 {
        let mut sizes: Vec<f32> = self.found.iter().map(|(_, _, size)| *size).collect();
        let (_, top, near) = STRONG;
        let of_top = near * quantile(&mut sizes, top).unwrap_or(f64::INFINITY);
        quantile(&mut sizes, weak_share).unwrap_or(f64::INFINITY).min(of_top) as f32
    }

    /// The gradient that `count` of the maxima reach.
    fn nth_largest(&self, count: usize) -> f32 {
        let mut sizes: Vec<f32> = self.found.iter().map(|(_, _, size)| *size).collect();
        let share = 1.0 - count as f64 / sizes.len().max(1) as f64;
        quantile(&mut sizes, share).unwrap_or(f64::INFINITY) as f32
    }

    /// Keeps what reaches `weak`, exceeds noise and hangs together.
    fn map(&self, strong: f32, weak: f32) -> EdgeMap {
        let strong = strong.max(self.noise);
        let weak = weak.max(self.noise).max(WEAK_FLOOR * strong);
        let mut candidates = Image::filled(self.width, self.height, false);
        self.found.iter().filter(|(_, _, size)| *size >= weak).for_each(|(at, _, _)| candidates.pixels[*at] = true);
        self.drop_short_chains(&mut candidates);
        let mut map = EdgeMap {
            width: self.width,
            height: self.height,
            points: Vec::new(),
            by_pixel: vec![NOTHING; self.width * self.height],
        };
        for (at, point, size) in &self.found {
            if candidates.pixels[*at] {
                map.by_pixel[*at] = map.points.len() as u32;
                map.points.push(EdgePoint { strong: *size >= strong, ..*point });
            }
        }
        map
    }

    /// Clears what hangs together, corner to corner as well, and is shorter than a chain must be. Starts from the maxima, which are few of the
    /// pixels that `mask::components` would look at.
    fn drop_short_chains(&self, candidates: &mut Image<bool>) {
        let (width, height) = (self.width, self.height);
        let mut seen = vec![false; candidates.pixels.len()];
        let mut chain: Vec<usize> = Vec::new();
        for (start, ..) in &self.found {
            if seen[*start] || !candidates.pixels[*start] {
                continue;
            }
            seen[*start] = true;
            chain.clear();
            chain.push(*start);
            let mut next = 0;
            while let Some(&at) = chain.get(next) {
                next += 1;
                let (u, v) = (at % width, at / width);
                for row in v.saturating_sub(1)..(v + 2).min(height) {
                    for column in u.saturating_sub(1)..(u + 2).min(width) {
                        let beside = row * width + column;
                        if candidates.pixels[beside] && !seen[beside] {
                            seen[beside] = true;
                            chain.push(beside);
                        }
                    }
                }
            }
            if chain.len() < SHORTEST_PX {
                chain.iter().for_each(|&at| candidates.pixels[at] = false);
            }
        }
    }
}

impl EdgeMap {
    /// True on the pixels that carry an edge.
    pub(super) fn picture(&self) -> Image<bool> {
        Image { width: self.width, height: self.height, pixels: self.by_pixel.iter().map(|&i| i != NOTHING).collect() }
    }

    /// From `point` to the nearest edge here: along that edge's normal where they meet closely, else straight; at most the reach.
    fn distance_px(&self, point: &EdgePoint) -> f32 {
        let (cu, cv) = (point.u.round() as i64, point.v.round() as i64);
        let [width, height] = [self.width, self.height].map(|size| size as i64);
        let mut nearest: Option<(f32, &EdgePoint)> = None;
        for reach in 0..=REACH_PX {
            // Edges lie within half a pixel of where they are listed, and so does the point: further out nothing is nearer.
            if nearest.is_some_and(|(least, _)| least <= (reach - 1) as f32) {
                break;
            }
            for v in (cv - reach).max(0)..(cv + reach + 1).min(height) {
                let step = if (v - cv).abs() == reach { 1 } else { 2 * reach };
                for u in (cu - reach..=cu + reach).step_by(step.max(1) as usize).filter(|u| (0..width).contains(u)) {
                    let index = self.by_pixel[(v * width + u) as usize];
                    if index == NOTHING {
                        continue;
                    }
                    let other = &self.points[index as usize];
                    let straight = (other.u - point.u).hypot(other.v - point.v);
                    if nearest.is_none_or(|(least, _)| straight < least) {
                        nearest = Some((straight, other));
                    }
                }
            }
        }
        match nearest {
            None => REACH_PX as f32,
            Some((straight, other)) if straight < 2.0 => ((other.u - point.u) * other.nu + (other.v - point.v) * other.nv).abs(),
            Some((straight, _)) => straight.min(REACH_PX as f32),
        }
    }
}

/// Median over the strong edges of both images, within `scored`, of the distance to the nearest edge of the other, in pixels.
/// `None` when either has fewer than 30 edge points there.
pub(super) fn median_distance_px(a: &EdgeMap, b: &EdgeMap, scored: &Image<bool>) -> Option<f64> {
    let inside = |point: &&EdgePoint| {
        if !point.strong {
            return false;
        }
        let at = point.v.round() as usize * scored.width + point.u.round() as usize;
        scored.pixels.get(at).copied().unwrap_or(false)
    };
    let one_way =
        |from: &EdgeMap, to: &EdgeMap| -> Vec<f32> { from.points.iter().filter(inside).map(|p| to.distance_px(p)).collect() };
    let (mut ab, ba) = rayon::join(|| one_way(a, b), || one_way(b, a));
    if ab.len() < 30 || ba.len() < 30 {
        return None;
    }
    ab.extend(ba);
    quantile(&mut ab, 0.5)
}

#[cfg(test)]
mod tests {
    use super::super::seen::Ground;
    use super::*;

    fn disc(shift: f32) -> Image<f32> {
        let pixels = (0..160 * 160)
            .map(|at| {
                let r = ((at % 160) as f32 - 80.0 - shift).hypot((at / 160) as f32 - 80.0);
                1.0 / (1.0 + ((r - 50.0) / 1.5).exp())
            })
            .collect();
        Image::from_pixels(160, 160, pixels).expect("size")
    }

    /// Against the components of the mask, which know nothing of maxima.
    #[test]
    fn chains_that_are_too_short_are_dropped_and_no_others() {
        use crate::mask::components;
        use crate::random::{Purpose, Stream};
        let (width, height) = (60, 40);
        let mut random = Stream::new(5, 0, 0, Purpose::Evaluation);
        let pixels: Vec<bool> = (0..width * height).map(|_| random.next_u32().is_multiple_of(4)).collect();
        let mut mask = Image::from_pixels(width, height, pixels).expect("size");
        // A chain that goes on corner to corner.
        (0..30).for_each(|n| *mask.at_mut(n, n) = true);
        let point = EdgePoint { u: 0.0, v: 0.0, nu: 1.0, nv: 0.0, strong: false };
        let found = (0..width * height).filter(|at| mask.pixels[*at]).map(|at| (at, point, 1.0)).collect();
        let maxima = Maxima { width, height, found, noise: 0.0, sigma: None };
        let mut expected = mask.clone();
        let (short, long): (Vec<_>, Vec<_>) = components(&mask).into_iter().partition(|chain| chain.indices.len() < SHORTEST_PX);
        assert!(!short.is_empty() && !long.is_empty(), "{} and {}", short.len(), long.len());
        short.iter().flat_map(|chain| &chain.indices).for_each(|&at| expected.pixels[at] = false);
        maxima.drop_short_chains(&mut mask);
        assert_eq!(mask, expected);
    }

    /// As the definition has it, pixel by pixel: known, larger than the neighbour behind it, no smaller than the one ahead.
    #[test]
    fn maxima_are_those_of_pixels_whose_neighbours_along_the_gradient_are_known_and_smaller() {
        for (width, height) in [(4, 30), (90, 71)] {
            let pixels = (0..width * height).map(|at| ((at * 7919) % 211) as f32 * 0.02).collect();
            let image = Image::from_pixels(width, height, pixels).expect("size");
            // Holes, and a border that is flat.
            let usable = Image { width, height, pixels: (0..width * height).map(|at| (at * 31) % 173 != 0).collect() };
            let ground = Ground::of(usable);
            let seen = Seen::on(&ground, &image);
            let Gradient { du, dv, known } = &seen.gradient;
            let size = |at: usize| (du.pixels[at] * du.pixels[at] + dv.pixels[at] * dv.pixels[at]).sqrt();
            let is_maximum = |at: &usize| {
                let (u, v, here) = (at % width, at / width, size(*at));
                if u < 2 || v < 2 || u + 2 >= width || v + 2 >= height || !known.pixels[*at] || !(here > 0.0) {
                    return false;
                }
                let [su, sv] = [du, dv].map(|along| step_along(along.pixels[*at] / here) as isize);
                let [ahead, behind] = [1, -1].map(|way| at.wrapping_add_signed(way * (sv * width as isize + su)));
                known.pixels[ahead] && known.pixels[behind] && here > size(behind) && here >= size(ahead)
            };
            let expected: Vec<usize> = (0..width * height).filter(is_maximum).collect();
            let found = largest(&seen);
            assert_eq!(found.iter().map(|(at, ..)| *at).collect::<Vec<_>>(), expected);
            assert!(
                found.iter().all(|(at, point, here)| here.to_bits() == size(*at).to_bits() && point.nu == du.pixels[*at] / here)
            );
            assert!((found.len() > 200) == (width == 90) && known.pixels.contains(&false), "{}", found.len());
        }
    }

    #[test]
    fn edges_lie_on_the_circle_and_distances_are_sub_pixel() {
        let all = Image::filled(160, 160, true);
        let ground = Ground::of(all.clone());
        let (still, moved) = (disc(0.0), disc(1.0));
        let [still, moved] = [&still, &moved].map(|image| maxima(&Seen::on(&ground, image), &all));
        let (map, same) = of_both(&still, &still);
        assert!(map.points.len() > 150);
        for point in &map.points {
            let r = (point.u - 80.0).hypot(point.v - 80.0);
            assert!((r - 50.0).abs() < 0.35, "radius {r}");
        }
        assert!(median_distance_px(&map, &same, &all).expect("edges") < 1e-3);
        // A shift by s moves the normal distance by s |cos φ|, whose median is s cos 45°.
        let (a, b) = of_both(&still, &moved);
        let moved = median_distance_px(&a, &b, &all).expect("edges");
        assert!((moved - 0.707).abs() < 0.12, "{moved}");
    }
}
