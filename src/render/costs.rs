//! What the parts of rendering cost, and what a plan takes by that.

use serde::{Deserialize, Serialize};

use super::plan::Sampling;
use super::spectrum::LANES;

/// Nanoseconds of one core.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Costs {
    /// Machine and version that they hold for.
    pub machine: String,
    /// How many times they were measured; each is the least of all.
    pub rounds: u32,
    /// Cores that work at once.
    pub threads: usize,
    /// A ray and a slab, exact, for 1, 2 and up to 4 materials.
    pub exact_slab_ns: [f64; 3],
    /// The same in fixed point.
    pub fixed_slab_ns: [f64; 3],
    /// A ray and a slab of one material, exact and in fixed point, where the rays are [`FAR_CELLS`] apart: they share no cells.
    pub far_slab_ns: [f64; 2],
    /// A ray and a slab, walked cell by cell.
    pub walked_slab_ns: f64,
    /// A ray and a volume, however few its slabs: exact, fixed, walked.
    pub volume_ns: [f64; 3],
    /// A ray against a shape.
    pub solid_ns: f64,
    /// A ray against a mesh, for each doubling of its triangles.
    pub mesh_level_ns: f64,
    /// A pixel and a material, interpolated.
    pub between_ns: f64,
    /// A pixel and eight energies, in a scene of [`TIMED_MATERIALS`].
    pub energies_ns: f64,
    /// A pixel and eight energies behind a heel: with and without the object. The ray's own share of heel or bow-tie is as much again.
    pub shaped_ns: f64,
    /// An image behind a heel: its tables.
    pub heel_ms: f64,
    /// A ray against a face where a scan was cut off.
    pub face_ns: f64,
    /// A pixel's noise.
    pub noise_ns: f64,
    /// A pixel in which nothing is seen.
    pub pixel_ns: f64,
    /// An image, however small: cores are woken, memory is fetched.
    pub image_ms: f64,
}

impl Default for Costs {
    /// Of one 4 GHz core with AVX-512; ranks plans where nothing was measured.
    fn default() -> Self {
        Self {
            machine: "typical".to_owned(),
            rounds: 0,
            threads: 1,
            exact_slab_ns: [1.3, 2.0, 3.4],
            fixed_slab_ns: [0.7, 1.3, 2.5],
            far_slab_ns: [2.6, 1.4],
            walked_slab_ns: 28.0,
            volume_ns: [20.0, 20.0, 100.0],
            solid_ns: 12.0,
            mesh_level_ns: 40.0,
            between_ns: 3.0,
            energies_ns: 12.0,
            shaped_ns: 60.0,
            heel_ms: 0.5,
            face_ns: 40.0,
            noise_ns: 60.0,
            pixel_ns: 10.0,
            image_ms: 0.1,
        }
    }
}

/// What a plan does, in the units of [`Costs`].
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Work {
    /// Pixels of the image.
    pub pixels: f64,
    /// Bands of its rows, of which cores take one at a time to cast.
    pub bands: f64,
    /// Rays that are cast.
    pub rays: f64,
    /// Share of them that is `step_px` pixels from the next one; the others are one pixel from it.
    pub spread: f64,
    /// Pixels between rays where some are skipped.
    pub step_px: f64,
    /// Cells between the rays of neighbouring pixels.
    pub cells_apart: f64,
    /// Volumes that an average ray may cross.
    pub volumes_per_ray: f64,
    /// Slabs that an average ray crosses.
    pub slabs_per_ray: f64,
    /// Those among them that lie in bricks filled with one density.
    pub filled_per_ray: f64,
    /// Share of the rays through volumes that are walked cell by cell although others are crossed in slabs.
    pub walked_share: f64,
    /// Slabs of an average ray that are looked at cell by cell for what the volume displaces there.
    pub displacing_per_ray: f64,
    /// Shapes an average ray is tried against.
    pub solids_per_ray: f64,
    /// Doublings of triangles in the meshes that an average ray is tried against.
    pub mesh_levels_per_ray: f64,
    /// Pixels that are interpolated.
    pub interpolated: f64,
    /// Materials of the volume.
    pub materials: usize,
    /// Energies at which every pixel is evaluated; none where heel or bow-tie do it.
    pub energies: usize,
    /// Part of [`Costs::shaped_ns`] that beam shapes ask for at all energies of the spectrum; 0 where none varies from pixel to pixel.
    pub shaped: f64,
    /// Whether there is a heel.
    pub heel: bool,
    /// Materials of the scene, met or not: the spectrum is attenuated by all.
    pub listed: usize,
    /// Energies of the beam, at which its shapes are evaluated.
    pub shaped_energies: usize,
    /// How many times a ray is tried against a face where a scan was cut off.
    pub face_tests: f64,
    /// Whether noise is drawn.
    pub noise: bool,
}

/// Cells between rays with which slabs are timed first, and between rays that share none.
pub(super) const NEAR_CELLS: f64 = 0.5;
pub(super) const FAR_CELLS: f64 = 3.0;

/// Materials of the scene that is timed.
pub(super) const TIMED_MATERIALS: f64 = 4.0;

/// Slabs of the volume that is timed for what it costs to enter one.
pub(super) const FEW_SLABS: f64 = 6.0;

/// Pixels that a core takes at a time once rays are cast.
const CHUNK_PX: f64 = 512.0;

impl Costs {
    /// Milliseconds that `work` takes with `sampling`.
    #[must_use]
    pub fn predict_ms(&self, work: &Work, sampling: Sampling) -> f64 {
        let column = match work.materials {
            0 | 1 => 0,
            2 => 1,
            _ => 2,
        };
        let by_cell = self.walked_slab_ns * work.slabs_per_ray + self.volume_ns[2] * work.volumes_per_ray;
        let in_slabs = |slab_ns: f64, volume_ns: f64| {
            // Where a block of pixels meets other bricks as well, filled ones gain nothing.
            let bundled = slab_ns * (work.slabs_per_ray - 0.7 * work.filled_per_ray)
                + volume_ns * work.volumes_per_ray
                + self.walked_slab_ns * work.displacing_per_ray;
            (1.0 - work.walked_share) * bundled + work.walked_share * by_cell
        };
        // How much more a slab costs whose cells fewer rays share.
        let sparse = |far_ns: f64, near_ns: f64| {
            let times = (far_ns / near_ns).max(1.0);
            let at =
                |apart: f64| 1.0 + (times - 1.0) * ((apart / NEAR_CELLS).ln() / (FAR_CELLS / NEAR_CELLS).ln()).clamp(0.0, 1.0);
            at(work.cells_apart) * (1.0 - work.spread) + at(work.cells_apart * work.step_px) * work.spread
        };
        let [exact, fixed] = [self.exact_slab_ns, self.fixed_slab_ns];
        let volume = match sampling {
            Sampling::ExactSlabs => in_slabs(exact[column] * sparse(self.far_slab_ns[0], exact[0]), self.volume_ns[0]),
            Sampling::FixedSlabs => in_slabs(fixed[column] * sparse(self.far_slab_ns[1], fixed[0]), self.volume_ns[1]),
            Sampling::ExactCells | Sampling::PiecewiseConstant => by_cell,
            Sampling::None => 0.0,
        };
        let ray = volume + self.solid_ns * work.solids_per_ray + self.mesh_level_ns * work.mesh_levels_per_ray;
        let [blocks, shaped_blocks] = [work.energies, work.shaped_energies].map(|energies| energies.div_ceil(LANES) as f64);
        let listed = work.listed.max(1) as f64 / TIMED_MATERIALS;
        let pixel = self.pixel_ns
            + self.energies_ns * blocks * listed
            + work.shaped * self.shaped_ns * (shaped_blocks + 1.0)
            + if work.noise { self.noise_ns } else { 0.0 };
        let between = work.interpolated * self.between_ns * work.materials.max(1) as f64;
        // The last round leaves cores idle; what comes in one piece has one core.
        let cores = |pieces: f64| pieces / (pieces / self.threads as f64).ceil();
        let cast = (work.rays * ray + work.face_tests * self.face_ns) / cores(work.bands.max(1.0));
        let rest = (work.pixels * pixel + between) / cores((work.pixels / CHUNK_PX).ceil().max(1.0));
        (cast + rest) * 1e-6 + self.image_ms + if work.heel { self.heel_ms } else { 0.0 }
    }

    fn all_mut(&mut self) -> impl Iterator<Item = &mut f64> {
        let rays =
            [&mut self.walked_slab_ns, &mut self.solid_ns, &mut self.mesh_level_ns, &mut self.between_ns, &mut self.face_ns];
        let pixels = [
            &mut self.energies_ns,
            &mut self.shaped_ns,
            &mut self.noise_ns,
            &mut self.pixel_ns,
            &mut self.image_ms,
            &mut self.heel_ms,
        ];
        let slabs = self.exact_slab_ns.iter_mut().chain(&mut self.fixed_slab_ns).chain(&mut self.far_slab_ns);
        rays.into_iter().chain(pixels).chain(slabs).chain(&mut self.volume_ns)
    }

    /// Whatever of the two is less, cost by cost.
    pub(super) fn least(mut self, other: &Self) -> Self {
        self.rounds += other.rounds;
        // What a volume costs was found as what its few slabs leave of a time: the least time counts, not the least of such differences.
        let few_ns = |costs: &Self| {
            let slabs = [costs.exact_slab_ns[0], costs.fixed_slab_ns[0], costs.walked_slab_ns];
            [0, 1, 2].map(|way: usize| costs.volume_ns[way] + FEW_SLABS * slabs[way])
        };
        let (mine_ns, other_ns) = (few_ns(&self), few_ns(other));
        self.all_mut().zip(other.clone().all_mut()).for_each(|(mine, other)| *mine = mine.min(*other));
        let slabs = [self.exact_slab_ns[0], self.fixed_slab_ns[0], self.walked_slab_ns];
        self.volume_ns = [0, 1, 2].map(|way: usize| (mine_ns[way].min(other_ns[way]) - FEW_SLABS * slabs[way]).max(1e-3));
        self
    }

    pub(super) fn is_sound(&self) -> bool {
        self.threads > 0 && self.clone().all_mut().all(|cost| *cost > 0.0 && cost.is_finite())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    // With written costs: what a crowded machine measures may say anything of one part against another.
    #[test]
    fn more_work_costs_more() {
        let costs = Costs { threads: 2, ..Costs::default() };
        let work = Work { pixels: 1e5, rays: 1e5, slabs_per_ray: 100.0, materials: 2, listed: 2, energies: 8, ..Work::default() };
        let ms = costs.predict_ms(&work, Sampling::ExactSlabs);
        assert!(ms > 0.0);
        assert!(costs.predict_ms(&Work { listed: 9, ..work }, Sampling::ExactSlabs) > ms);
        assert!(costs.predict_ms(&Work { energies: 120, ..work }, Sampling::ExactSlabs) > ms);
        assert!(costs.predict_ms(&Work { noise: true, ..work }, Sampling::ExactSlabs) > ms);
        assert!(costs.predict_ms(&Work { shaped: 1.0, shaped_energies: 8, ..work }, Sampling::ExactSlabs) > ms);
        // A piece more than the cores take at a time: a second round.
        let chunks = |count: f64| costs.predict_ms(&Work { pixels: count * CHUNK_PX, rays: 0.0, ..work }, Sampling::ExactSlabs);
        let threads = costs.threads as f64;
        assert!(chunks(threads + 1.0) - costs.image_ms > 1.2 * (chunks(threads) - costs.image_ms));
        assert!(costs.predict_ms(&Work { bands: 2.0, ..work }, Sampling::ExactSlabs) < 0.6 * ms);
        assert!(costs.predict_ms(&Work { filled_per_ray: 80.0, ..work }, Sampling::ExactSlabs) < ms);
        assert!(costs.predict_ms(&Work { rays: 2.5e4, ..work }, Sampling::ExactSlabs) < ms);
        assert!(costs.predict_ms(&Work { walked_share: 0.5, ..work }, Sampling::ExactSlabs) > 2.0 * ms);
        assert!(costs.predict_ms(&Work { displacing_per_ray: 50.0, ..work }, Sampling::ExactSlabs) > ms);
        let sparse = Work { spread: 1.0, step_px: 4.0, cells_apart: 0.6, ..work };
        assert!(costs.predict_ms(&sparse, Sampling::ExactSlabs) > ms);
        assert!(costs.predict_ms(&Work { cells_apart: f64::NAN, ..sparse }, Sampling::ExactSlabs).is_nan());
        assert!(costs.predict_ms(&Work { mesh_levels_per_ray: 16.0, ..work }, Sampling::ExactSlabs) > ms);
        assert!(costs.predict_ms(&Work { face_tests: 1e5, ..work }, Sampling::ExactSlabs) > ms);
        assert!(costs.predict_ms(&Work { interpolated: 1e6, ..work }, Sampling::ExactSlabs) > ms);
    }

    /// Of two times 19 and 40 ns through six slabs, with slabs of 3 and 2 ns, the lesser is left by slabs of 2 ns.
    #[test]
    fn a_volume_costs_what_the_least_time_leaves() {
        let round = |slab_ns: f64, volume_ns: f64| Costs {
            exact_slab_ns: [slab_ns; 3],
            volume_ns: [volume_ns, 20.0, 100.0],
            rounds: 1,
            ..Costs::default()
        };
        let least = round(3.0, 1.0).least(&round(2.0, 28.0));
        assert_eq!((least.exact_slab_ns[0], least.volume_ns), (2.0, [7.0, 20.0, 100.0]));
    }
}
