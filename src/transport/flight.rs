//! How far a photon flies, and how much of a beam arrives: box by box through the super-voxels.
//!
//! In a box of one material both are exact. In a mixture the flight is Woodcock's: tentative collisions at the box's majorant, each real
//! with the share of what is at its point (unbiased wherever matter lies inside the box, so shapes are exact). The transmission is the
//! residual ratio estimator (Novák et al. 2014): exp(−minorant · length) times the share that each tentative collision leaves. Where a box
//! holds shapes much denser than the rest of it, a ray is told where it runs through one, and knows no more than the rest elsewhere.

use glam::{BVec3, DVec3};

use super::cells::{CellBox, Cells, OUTSIDE, SEVERAL};
use super::contents::{Content, Mixture};
use super::matter::{Mix, Thing, draw_at};
use super::stream::Stream;

/// The matter of a scene, ready to fly through.
pub struct Space<'a> {
    pub(super) things: Vec<Thing<'a>>,
    pub(super) cells: Cells,
}

/// A point on its way.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Ray {
    /// Where it is, lps mm.
    pub position: DVec3,
    /// Unit vector.
    pub direction: DVec3,
    /// The box that it is in.
    pub in_box: u32,
}

/// How a flight ended.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum End {
    /// In a collision with this scene material; the ray stands there.
    Collision(u32),
    /// At the end of its path.
    Arrived,
    /// Beyond everything.
    Left,
}

/// Attenuation by scene material at the photon's energy, per mm at unit density, and scratch.
#[derive(Clone, Debug, Default)]
pub struct Medium {
    /// By scene material.
    pub per_mm: Vec<f64>,
    pub(super) mix: Mix,
}

/// Thickness by which two points of a mixture may differ before they are sampled closer, and how much closer at most.
const STEEP: f64 = 0.05;
const MOST_SPLIT: f64 = 16.0;

/// Dense shapes are taken to be longer by twice this at both ends of a ray's way through them, and what ends this far behind it is passed: no
/// rounding hides them from a ray, or keeps it there.
pub(super) const NEAR_MM: f64 = 0.01;

/// What a direction means for all boxes.
struct Way {
    /// 1/direction; far instead of infinite along an axis, so that no 0 · ∞ arises on a face.
    inverse: DVec3,
    forwards: BVec3,
}

impl Way {
    #[inline]
    fn new(direction: DVec3) -> Self {
        let inverse = direction.to_array().map(|d| if d.abs() < 1e-200 { 1e200_f64.copysign(d) } else { 1.0 / d });
        let inverse = DVec3::from_array(inverse);
        Self { inverse, forwards: inverse.cmpgt(DVec3::ZERO) }
    }
}

/// Where a ray leaves its box.
struct Exit {
    distance_mm: f64,
    axis: usize,
}

impl<'a> Space<'a> {
    /// Prepares `things`, the last of the scene first, seen along `beam`; `None` where there is nothing.
    #[must_use]
    pub fn new(things: Vec<Thing<'a>>, beam: DVec3) -> Option<Self> {
        let cells = Cells::new(&things, beam)?;
        Some(Self { things, cells })
    }

    /// Where a ray from `origin` first meets the scene's bounds, and after how many mm; `None` if it never does.
    #[inline]
    #[must_use]
    pub fn enter(&self, origin: DVec3, direction: DVec3) -> Option<(Ray, f64)> {
        let bounds = self.cells.bounds();
        let inverse = Way::new(direction).inverse;
        let (a, b) = ((bounds.low - origin) * inverse, (bounds.high - origin) * inverse);
        let (from, to) = (a.min(b).max_element().max(0.0), a.max(b).min_element());
        if !(from < to) {
            return None;
        }
        let position = (origin + direction * from).clamp(bounds.low, bounds.high);
        let cell = std::array::from_fn(|axis| self.cells.planes[axis].cell(position[axis]));
        Some((Ray { position, direction, in_box: self.cells.box_of(cell) }, from))
    }

    #[inline]
    fn exit(&self, ray: &Ray, way: &Way) -> Exit {
        let cell_box = &self.cells.boxes[ray.in_box as usize];
        let faces = DVec3::select(way.forwards, cell_box.high, cell_box.low);
        let DVec3 { x, y, z } = (faces - ray.position) * way.inverse;
        let (distance_mm, axis) = if x < y { (x, 0) } else { (y, 1) };
        let (distance_mm, axis) = if z < distance_mm { (z, 2) } else { (distance_mm, axis) };
        Exit { distance_mm: distance_mm.max(0.0), axis }
    }

    /// Steps across the face on `axis` that the ray has reached; false beyond the last box.
    #[inline]
    fn cross(&self, ray: &mut Ray, way: &Way, axis: usize) -> bool {
        let cell_box = &self.cells.boxes[ray.in_box as usize];
        let forwards = way.forwards.test(axis);
        let next = cell_box.neighbours[axis][usize::from(forwards)];
        ray.in_box = if next == SEVERAL { self.across(cell_box, ray.position, axis, forwards) } else { next };
        next != OUTSIDE
    }

    /// The box across a face at a point of it.
    // Along the face the cell is looked for within the box's own range, however the point was rounded, so that every step moves on.
    fn across(&self, cell_box: &CellBox, point: DVec3, axis: usize, forwards: bool) -> u32 {
        let (low, high) = (cell_box.low_cell.map(usize::from), cell_box.high_cell.map(usize::from));
        self.cells.box_of(std::array::from_fn(|n| match (n == axis, forwards) {
            (true, true) => high[n],
            (true, false) => low[n] - 1,
            (false, _) if high[n] - low[n] == 1 => low[n],
            (false, _) => self.cells.planes[n].cell(point[n]).clamp(low[n], high[n] - 1),
        }))
    }

    /// What there may be ahead of a ray in a mixture, and for how many mm of `step_mm` before that changes.
    #[inline]
    fn ahead<'m>(&self, mixture: &'m Mixture, ray: &Ray, step_mm: f64) -> (&'m Mixture, f64) {
        let Some(dense) = &mixture.dense else { return (mixture, step_mm) };
        let next = |index: &u32| self.things[*index as usize].body.next_stretch(ray.position, ray.direction, -NEAR_MM);
        match dense.shapes.iter().filter_map(next).min_by(|a, b| a.0.total_cmp(&b.0)) {
            None => (&dense.rest, step_mm),
            Some((from, _)) if from > 3.0 * NEAR_MM => (&dense.rest, step_mm.min(from - 2.0 * NEAR_MM)),
            Some((_, to)) => (mixture, step_mm.min(to + 2.0 * NEAR_MM)),
        }
    }

    /// Flies until a collision, the end of the scene, or `path_mm`.
    #[inline]
    pub fn fly(&self, ray: &mut Ray, path_mm: f64, medium: &mut Medium, stream: &mut Stream) -> End {
        let way = Way::new(ray.direction);
        let (mut left_mm, mut depth) = (path_mm, stream.exponential());
        loop {
            let exit = self.exit(ray, &way);
            let (mut step_mm, mut is_cut) = (exit.distance_mm.min(left_mm), false);
            let arrives = left_mm <= exit.distance_mm;
            match &self.cells.contents[self.cells.boxes[ray.in_box as usize].content as usize] {
                Content::Empty => {}
                Content::Uniform { material, density } => {
                    let per_mm = density * medium.per_mm[*material as usize];
                    if per_mm * step_mm > depth {
                        ray.position += ray.direction * (depth / per_mm);
                        return End::Collision(*material);
                    }
                    depth -= per_mm * step_mm;
                }
                Content::Mixed(mixture) => {
                    let (mixture, ahead_mm) = self.ahead(mixture, ray, step_mm);
                    (is_cut, step_mm) = (ahead_mm < step_mm, ahead_mm);
                    let majorant = majorant(mixture, &medium.per_mm);
                    while majorant * step_mm > depth {
                        let flown_mm = depth / majorant;
                        ray.position += ray.direction * flown_mm;
                        (step_mm, left_mm) = (step_mm - flown_mm, left_mm - flown_mm);
                        let per_mm = self.attenuation_at(mixture, ray.position, medium, stream);
                        let real = stream.uniform() * majorant;
                        if real < per_mm {
                            return End::Collision(struck(medium, real));
                        }
                        depth = stream.exponential();
                    }
                    depth -= majorant * step_mm;
                }
            }
            ray.position += ray.direction * step_mm;
            left_mm -= step_mm;
            if is_cut {
                continue;
            }
            if arrives {
                return End::Arrived;
            }
            if !self.cross(ray, &way, exit.axis) {
                return End::Left;
            }
        }
    }

    /// What a ray meets until `path_mm`: `met` hears the scene material, g/cm³ times mm, and how far along it is. One material in a box is told
    /// at once; a mixture at points about `step_mm` apart, drawn, or closer where they may differ by more than [`STEEP`] in what `medium`
    /// attenuates.
    pub fn sample(
        &self,
        mut ray: Ray,
        path_mm: f64,
        step_mm: f64,
        medium: &mut Medium,
        stream: &mut Stream,
        mut met: impl FnMut(u32, f64, f64),
    ) {
        let way = Way::new(ray.direction);
        let mut gone_mm = 0.0;
        loop {
            let exit = self.exit(&ray, &way);
            let through_mm = exit.distance_mm.min(path_mm - gone_mm);
            match &self.cells.contents[self.cells.boxes[ray.in_box as usize].content as usize] {
                Content::Empty => {}
                Content::Uniform { material, density } => {
                    // Two halves where mean and spread are those of the whole.
                    let off_mm = 0.5 * through_mm / 3f64.sqrt();
                    for at_mm in [0.5 * through_mm - off_mm, 0.5 * through_mm + off_mm] {
                        met(*material, 0.5 * density * through_mm, gone_mm + at_mm);
                    }
                }
                Content::Mixed(mixture) => {
                    let differs = (majorant(mixture, &medium.per_mm) - minorant(mixture, &medium.per_mm)) * step_mm;
                    let steps = (through_mm / step_mm * (differs / STEEP).clamp(1.0, MOST_SPLIT)).ceil().max(1.0);
                    let each_mm = through_mm / steps;
                    for step in 0..steps as usize {
                        let along_mm = (step as f64 + stream.uniform()) * each_mm;
                        let point = ray.position + ray.direction * along_mm;
                        draw_at(&self.things, &mixture.things, mixture.keeps_air, point, stream, &mut medium.mix);
                        for (material, density) in &medium.mix.parts {
                            met(*material, density * each_mm, gone_mm + along_mm);
                        }
                    }
                }
            }
            ray.position += ray.direction * through_mm;
            gone_mm += through_mm;
            if !(gone_mm < path_mm) || !self.cross(&mut ray, &way, exit.axis) {
                return;
            }
        }
    }

    /// An unbiased estimate of the share that arrives after `path_mm`; the truth where all boxes on the way hold one material.
    #[inline]
    pub fn transmission(&self, mut ray: Ray, path_mm: f64, medium: &mut Medium, stream: &mut Stream) -> f64 {
        let way = Way::new(ray.direction);
        let (mut left_mm, mut depth, mut share, mut next) = (path_mm, 0.0, 1.0, stream.exponential());
        loop {
            let exit = self.exit(&ray, &way);
            let (mut step_mm, mut is_cut) = (exit.distance_mm.min(left_mm), false);
            match &self.cells.contents[self.cells.boxes[ray.in_box as usize].content as usize] {
                Content::Empty => {}
                Content::Uniform { material, density } => depth += density * medium.per_mm[*material as usize] * step_mm,
                Content::Mixed(mixture) => {
                    let (mixture, ahead_mm) = self.ahead(mixture, &ray, step_mm);
                    (is_cut, step_mm) = (ahead_mm < step_mm, ahead_mm);
                    let most = majorant(mixture, &medium.per_mm);
                    let least = minorant(mixture, &medium.per_mm);
                    depth += least * step_mm;
                    // Above the minorant the box is crossed in units of what a tentative collision takes.
                    let (mut gone, all) = (next, (most - least) * step_mm);
                    while gone < all {
                        let at_mm = gone / (most - least);
                        let per_mm = self.attenuation_at(mixture, ray.position + ray.direction * at_mm, medium, stream);
                        share *= ((most - per_mm) / (most - least)).max(0.0);
                        gone += stream.exponential();
                    }
                    next = gone - all;
                    if share == 0.0 {
                        return 0.0;
                    }
                }
            }
            ray.position += ray.direction * step_mm;
            left_mm -= step_mm;
            if is_cut {
                continue;
            }
            if !(left_mm > 0.0) || !self.cross(&mut ray, &way, exit.axis) {
                return share * (-depth).exp();
            }
        }
    }

    #[inline]
    fn attenuation_at(&self, mixture: &Mixture, point: DVec3, medium: &mut Medium, stream: &mut Stream) -> f64 {
        draw_at(&self.things, &mixture.things, mixture.keeps_air, point, stream, &mut medium.mix);
        medium.mix.parts.iter().map(|(material, density)| density * medium.per_mm[*material as usize]).sum()
    }
}

/// Which of the materials at the point is struck where `real` lies in the sum of their attenuations.
fn struck(medium: &Medium, mut real: f64) -> u32 {
    let mut last = 0;
    for (material, density) in &medium.mix.parts {
        last = *material;
        real -= density * medium.per_mm[*material as usize];
        if real < 0.0 {
            break;
        }
    }
    last
}

#[inline]
fn majorant(mixture: &Mixture, per_mm: &[f64]) -> f64 {
    mixture.ranges.iter().fold(0.0, |most, range| f64::max(most, range.to * per_mm[range.material as usize]))
}

#[inline]
fn minorant(mixture: &Mixture, per_mm: &[f64]) -> f64 {
    if !mixture.is_full {
        return 0.0;
    }
    mixture.ranges.iter().fold(f64::INFINITY, |least, range| f64::min(least, range.from * per_mm[range.material as usize]))
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;

    use glam::DAffine3;

    use super::*;
    use crate::scene::model::{Matter, Shape, Volume};
    use crate::transport::fixture::{everything, scene, solid};
    use crate::transport::matter::things_of;

    /// Free paths in order.
    fn free_paths(turn: DVec3, draws: usize) -> Vec<f64> {
        let cube = Shape::Cuboid { half_size_mm: DVec3::splat(2000.0) };
        let scene = scene(
            &["water", "steel_316l"],
            vec![Matter::Solids(vec![
                solid(cube, DVec3::ZERO, turn, 0, 1.0),
                // Never reached, so that a mixture's majorant is above what is there.
                solid(Shape::Ellipsoid { semi_axes_mm: DVec3::splat(1e-3) }, DVec3::new(0.0, 3.0, 0.0), turn, 1, 8.0),
            ])],
        );
        let space = Space::new(things_of(&scene), DVec3::Z).expect("matter");
        let mut medium = Medium { per_mm: vec![1.0 / 48.57, 0.12], ..Medium::default() };
        let mut paths: Vec<f64> = (0..draws)
            .map(|draw| {
                let mut stream = Stream::new(31, draw as u64);
                let across = 0.2 * (stream.uniform() - 0.5);
                let (ray, _) = space.enter(DVec3::ZERO, DVec3::new(across, 1.0, 0.1).normalize()).expect("inside");
                let mut flown = ray;
                assert_eq!(space.fly(&mut flown, f64::INFINITY, &mut medium, &mut stream), End::Collision(0));
                flown.position.length()
            })
            .collect();
        paths.sort_unstable_by(f64::total_cmp);
        paths
    }

    /// Largest distance of the distribution of paths in order from the exponential one.
    fn kolmogorov_smirnov(paths: &[f64], mean_mm: f64) -> f64 {
        let count = paths.len() as f64;
        let distance = |(n, path): (usize, &f64)| {
            let share = 1.0 - (-path / mean_mm).exp();
            (share - n as f64 / count).abs().max((share - (n + 1) as f64 / count).abs())
        };
        paths.iter().enumerate().map(distance).fold(0.0, f64::max)
    }

    /// The Kolmogorov–Smirnov bound at 5 % is 1.36/√n; at 0.1 % it is 1.95/√n.
    #[test]
    fn free_paths_are_exponential_in_one_material_and_in_mixtures() {
        let draws = 400_000;
        let bound = 1.95 / (draws as f64).sqrt();
        for turn in [DVec3::ZERO, DVec3::new(0.3, 0.2, 0.1)] {
            let paths = free_paths(turn, draws);
            let found = kolmogorov_smirnov(&paths, 48.57);
            assert!(found < bound, "{turn}: {found}, bound {bound}");
            let off = kolmogorov_smirnov(&paths, 49.06);
            assert!(off > bound, "control: 1 % is told apart: {off}");
        }
    }

    /// The transmission's mean over draws is exp(−∫μ), here summed in small steps, through everything that a scene can hold; so is the
    /// share of flights that arrive.
    #[test]
    fn transmission_and_flight_agree_with_the_integral() {
        let scene = everything();
        let space = Space::new(things_of(&scene), DVec3::Z).expect("matter");
        let mut medium = Medium { per_mm: vec![0.008, 0.012, 0.03, 0.012, 0.02, 0.006], ..Medium::default() };
        let things = things_of(&scene);
        let all: Vec<u32> = (0..things.len() as u32).collect();
        let mut cases = 0;
        for n in 0..12u32 {
            let mut stream = Stream::new(41, u64::from(n));
            let mut place = |reach: f64| (DVec3::new(stream.uniform(), stream.uniform(), stream.uniform()) - 0.5) * reach;
            let (origin, to) = (place(60.0) + DVec3::new(0.0, 0.0, -150.0), place(60.0) + DVec3::new(0.0, 0.0, 150.0));
            let (direction, length_mm) = ((to - origin).normalize(), (to - origin).length());
            let (steps, mut mix) = (400_000, Mix::default());
            let at = |step: u32| origin + direction * (length_mm * (f64::from(step) + 0.5) / f64::from(steps));
            let mut depth = 0.0;
            for step in 0..steps {
                draw_at(&things, &all, true, at(step), &mut stream, &mut mix);
                let per_mm = mix.parts.iter().map(|(material, density)| density * medium.per_mm[*material as usize]).sum::<f64>();
                depth += per_mm * length_mm / f64::from(steps);
            }
            let (ray, gone_mm) = space.enter(origin, direction).expect("meets the scene");
            let (draws, truth) = (20_000, (-depth).exp());
            let (mut sum, mut squares, mut arrived) = (0.0, 0.0, 0.0);
            for _ in 0..draws {
                let share = space.transmission(ray, length_mm - gone_mm, &mut medium, &mut stream);
                (sum, squares) = (sum + share, squares + share * share);
                let end = space.fly(&mut ray.clone(), length_mm - gone_mm, &mut medium, &mut stream);
                arrived += f64::from(u8::from(!matches!(end, End::Collision(_))));
            }
            let count = f64::from(draws);
            let (mean, share) = (sum / count, arrived / count);
            let error = ((squares / count - mean * mean) / count).sqrt() + 2e-3 * truth;
            assert!((mean - truth).abs() < 4.5 * error, "ray {n}: {mean} ± {error}, {truth}");
            assert!(
                (share - truth).abs() < 4.5 * (truth * (1.0 - truth) / count).sqrt() + 2e-3 * truth,
                "ray {n}: {share}, {truth}"
            );
            let estimator_is_better = error < (truth * (1.0 - truth) / count).sqrt();
            cases += usize::from(estimator_is_better && truth > 0.0);
        }
        assert!(cases > 8, "{cases}");
    }

    /// Collisions are tried by the majorants. Those of boxes about a screw in a CT are steel's, and nobody else's: with one for all, every photon
    /// would try forty times as often.
    #[test]
    fn a_screw_slows_only_what_flies_past_it() {
        let mut stream = Stream::new(5, 0);
        let volume = Arc::new(Volume {
            size: [20; 3],
            lps_from_voxel: DAffine3::from_scale(DVec3::splat(10.0)),
            density_g_per_cm3: (0..8000).map(|_| (0.9 + 0.2 * stream.uniform()) as f32).collect(),
            class: vec![1; 8000],
            class_materials: vec![0],
            truncated_at_faces: false,
            unknown: Vec::new(),
        });
        let ct = || Matter::Volume(Arc::clone(&volume));
        let rod = Shape::Cylinder { length_mm: 80.0, radius_mm: 3.0, inner_radius_mm: 0.0 };
        let screw = solid(rod, DVec3::new(95.0, 95.0, 60.0), DVec3::new(0.3, 0.4, 0.0), 1, 8.0);
        // Of water and of steel at 60 keV, for 1 g/cm³.
        let per_mm = [0.0206, 0.12];
        let majorants = |matters: Vec<Matter>| {
            let scene = scene(&["water", "steel_316l"], matters);
            let space = Space::new(things_of(&scene), DVec3::Z).expect("matter");
            let (mut sum, mut whole, mut most) = (0.0, 0.0, 0.0_f64);
            for one in &space.cells.boxes {
                let here = match &space.cells.contents[one.content as usize] {
                    Content::Empty => 0.0,
                    Content::Uniform { material, density } => density * per_mm[*material as usize],
                    Content::Mixed(mixture) => majorant(mixture, &per_mm),
                };
                let volume_mm3 = (one.high - one.low).element_product();
                (sum, whole, most) = (sum + here * volume_mm3, whole + volume_mm3, most.max(here));
            }
            (sum / whole, most)
        };
        let (without, _) = majorants(vec![ct()]);
        let (with, most) = majorants(vec![ct(), Matter::Solids(vec![screw])]);
        assert!(with > without && with < 1.5 * without, "{with} {without}");
        assert!(most > 20.0 * without, "the control, one for all: {most} {without}");
    }

    #[test]
    fn rays_along_faces_edges_and_axes_end() {
        let scene = everything();
        let space = Space::new(things_of(&scene), DVec3::Z).expect("matter");
        let mut medium = Medium { per_mm: vec![1e-6; 6], ..Medium::default() };
        let bounds = space.cells.bounds();
        let (mut stream, mut left) = (Stream::new(1, 0), 0);
        for direction in
            [DVec3::X, DVec3::NEG_X, DVec3::Y, DVec3::NEG_Z, DVec3::new(1.0, -1.0, 0.0).normalize(), -DVec3::ONE.normalize()]
        {
            for (i, j) in (0..8).flat_map(|i| (0..8).map(move |j| (i, j))) {
                let plane = |axis: usize, n: usize| space.cells.planes[axis].at[n.min(space.cells.planes[axis].cells())];
                let start = DVec3::new(plane(0, i), plane(1, j), plane(2, i + j));
                let Some((ray, _)) = space.enter(start, direction) else { continue };
                assert!(ray.position.cmpge(bounds.low).all() && ray.position.cmple(bounds.high).all());
                left += usize::from(space.fly(&mut ray.clone(), f64::INFINITY, &mut medium, &mut stream) == End::Left);
                let share = space.transmission(ray, 1e6, &mut medium, &mut stream);
                assert!(share > 0.99 && share <= 1.0);
            }
        }
        assert!(left > 100, "{left}");
    }
}
