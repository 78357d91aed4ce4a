//! What the parts of rendering cost, and what a plan takes by that.

use serde::{Deserialize, Serialize};

use super::panel_costs::{PanelCosts, PanelWork};
use super::plan::Sampling;
use super::ray_counts::RayCounts;
use super::spectrum::LANES;
use super::timed_scenes::{FAR_CELLS, NEAR_CELLS, cells_per_slab};

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
    /// A ray and a cell, walked one by one.
    pub walked_cell_ns: f64,
    /// The same where the rays are [`FAR_CELLS`] apart.
    pub far_cell_ns: f64,
    /// A line of memory that no cache holds.
    pub line_ns: f64,
    /// A ray and a volume, however few its slabs: exact, fixed, walked.
    pub volume_ns: [f64; 3],
    /// A ray against a shape that it passes by, and against one that it meets.
    pub solid_ns: [f64; 2],
    /// A ray against a box or triangle of a mesh.
    pub mesh_test_ns: f64,
    /// A pixel and a material of the scene, interpolated.
    pub between_ns: f64,
    /// A pixel and eight energies, in a scene of [`TIMED_MATERIALS`].
    pub energies_ns: f64,
    /// The same with what noise needs to know of the photons that arrive.
    pub moments_ns: f64,
    /// A pixel and eight energies behind a heel: without an object, and with it. The ray's own share of heel or bow-tie is as much again.
    pub shaped_ns: [f64; 2],
    /// An image behind a heel: its tables.
    pub heel_ms: f64,
    /// A ray against a face where a scan was cut off.
    pub face_ns: f64,
    /// A pixel in which nothing is seen.
    pub pixel_ns: f64,
    /// An image, however small: cores are woken, memory is fetched.
    pub image_ms: f64,
    /// What comes after attenuation.
    pub panel: PanelCosts,
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
            walked_cell_ns: 20.0,
            far_cell_ns: 30.0,
            line_ns: 20.0,
            volume_ns: [20.0, 20.0, 100.0],
            solid_ns: [5.0, 12.0],
            mesh_test_ns: 5.0,
            between_ns: 1.0,
            energies_ns: 12.0,
            moments_ns: 16.0,
            shaped_ns: [24.0, 36.0],
            heel_ms: 0.5,
            face_ns: 40.0,
            pixel_ns: 10.0,
            image_ms: 0.1,
            panel: PanelCosts::default(),
        }
    }
}

/// Rays that are cast at once.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Casting {
    /// How many.
    pub rays: f64,
    /// Pixels from one to the next.
    pub step_px: f64,
    /// Bands of rows, of which cores take one at a time.
    pub bands: f64,
    /// What some of them meet.
    pub drawn: Vec<RayCounts>,
}

/// What a plan does, in the units of [`Costs`].
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Work {
    /// Pixels of the image.
    pub pixels: f64,
    /// Rays, one cast after the other.
    pub castings: Vec<Casting>,
    /// Pixels that are interpolated.
    pub interpolated: f64,
    /// Materials of the volume.
    pub materials: usize,
    /// Energies at which every pixel is evaluated; none where heel or bow-tie do it.
    pub energies: usize,
    /// How many times heel or bow-tie ask for [`Costs::shaped_ns`] at all energies of the spectrum: without an object, and with it.
    pub shaped: [f64; 2],
    /// Whether there is a heel.
    pub heel: bool,
    /// Materials of the scene, met or not: the spectrum is attenuated by all, and all are interpolated.
    pub listed: usize,
    /// Energies of the beam, at which its shapes are evaluated.
    pub shaped_energies: usize,
    /// How many times a ray is tried against a face where a scan was cut off.
    pub face_tests: f64,
    /// Whether noise needs to know of the photons that arrive.
    pub moments: bool,
    /// What comes after attenuation.
    pub panel: PanelWork,
}

/// Materials of the scene that is timed.
pub(super) const TIMED_MATERIALS: f64 = 4.0;

/// Slabs of the volume that is timed for what it costs to enter one.
pub(super) const FEW_SLABS: f64 = 6.0;

/// Lines that a slab or cell adds to those of the one before.
const LINES: f64 = 2.0;

/// Times that cores are woken for another casting, in those of an image.
const WAKES_FOR_CASTING: f64 = 0.5;

/// Pixels that a core takes at a time once rays are cast.
const CHUNK_PX: f64 = 512.0;

impl Costs {
    /// Milliseconds that `work` takes with `sampling`.
    #[must_use]
    pub fn predict_ms(&self, work: &Work, sampling: Sampling) -> f64 {
        let [blocks, shaped_blocks] = [work.energies, work.shaped_energies].map(|energies| energies.div_ceil(LANES) as f64);
        let listed = work.listed.max(1) as f64;
        let energies_ns = if work.moments { self.moments_ns } else { self.energies_ns };
        let shaped_ns: f64 = work.shaped.iter().zip(self.shaped_ns).map(|(passes, ns)| passes * ns).sum();
        let pixel = self.pixel_ns + energies_ns * blocks * listed / TIMED_MATERIALS + shaped_ns * (shaped_blocks + 1.0);
        let between = work.interpolated * self.between_ns * listed;
        let cast = |casting: &Casting| casting.rays * self.ray_ns(casting, work.materials, sampling) / self.cores(casting.bands);
        let rest = (work.pixels * pixel + between + work.face_tests * self.face_ns) / self.cores_of(work.pixels);
        // Each further casting wakes the cores to cast and to interpolate.
        let woken = 1.0 + WAKES_FOR_CASTING * (work.castings.len().max(1) - 1) as f64;
        let ms = (work.castings.iter().map(cast).sum::<f64>() + rest) * 1e-6;
        let heel_ms = if work.heel { self.heel_ms } else { 0.0 };
        ms + self.image_ms * woken + heel_ms + self.panel_ms(&work.panel)
    }

    /// Milliseconds of them that what comes after attenuation takes: the same whatever was cast, and with a GPU as well.
    #[must_use]
    pub fn panel_ms(&self, panel: &PanelWork) -> f64 {
        let by_pixel = panel.pixels * self.panel.pixel_ns(panel) / self.cores_of(panel.pixels);
        // Pairs are many wherever there are any.
        let spread = panel.block_pairs * self.panel.block_pair_ns / self.threads as f64;
        (by_pixel + spread) * 1e-6
    }

    /// Cores that are at work on so many pieces, on average: the last round leaves some idle, and what comes in one piece has one.
    fn cores(&self, pieces: f64) -> f64 {
        let pieces = pieces.max(1.0);
        pieces / (pieces / self.threads as f64).ceil()
    }

    /// The same on so many pixels.
    fn cores_of(&self, pixels: f64) -> f64 {
        self.cores((pixels / CHUNK_PX).ceil())
    }

    /// Nanoseconds of an average ray through volumes of so many `materials`.
    fn ray_ns(&self, casting: &Casting, materials: usize, sampling: Sampling) -> f64 {
        let column = match materials {
            0 | 1 => 0,
            2 => 1,
            _ => 2,
        };
        let ns = |ray: &RayCounts| {
            // Where rays share fewer cells, each costs more to fetch, however many materials it holds.
            let log_apart = (ray.apart * casting.step_px / NEAR_CELLS).ln() / (FAR_CELLS / NEAR_CELLS).ln();
            let far = if ray.slabs > 0.0 { log_apart.clamp(0.0, 1.0) } else { 0.0 };
            let fetched = |far_ns: f64, near_ns: f64| far * ((far_ns - near_ns).max(0.0) + LINES * self.line_ns * ray.remote);
            let cell_ns = self.walked_cell_ns + fetched(self.far_cell_ns, self.walked_cell_ns);
            let by_cell = cell_ns * ray.cells + self.volume_ns[2] * ray.volumes;
            // Where a block of pixels meets other bricks as well, filled ones gain nothing; far apart, it always does.
            let in_slabs = |near_ns: [f64; 3], far_ns: f64, volume_ns: f64| {
                let slab_ns = near_ns[column] + fetched(far_ns, near_ns[0]);
                slab_ns * (ray.slabs - 0.7 * (1.0 - far) * ray.filled) + volume_ns * ray.volumes + cell_ns * ray.displacing
            };
            let volume = match sampling {
                Sampling::ExactSlabs if !ray.walked => in_slabs(self.exact_slab_ns, self.far_slab_ns[0], self.volume_ns[0]),
                Sampling::FixedSlabs if !ray.walked => in_slabs(self.fixed_slab_ns, self.far_slab_ns[1], self.volume_ns[1]),
                Sampling::None => 0.0,
                _ => by_cell,
            };
            let [tried, met] = ray.solids;
            volume + self.solid_ns[0] * (tried - met) + self.solid_ns[1] * met + self.mesh_test_ns * ray.mesh_tests
        };
        casting.drawn.iter().map(ns).sum::<f64>() / casting.drawn.len().max(1) as f64
    }

    fn all_mut(&mut self) -> impl Iterator<Item = &mut f64> {
        let rays =
            [&mut self.walked_cell_ns, &mut self.far_cell_ns, &mut self.mesh_test_ns, &mut self.between_ns, &mut self.face_ns];
        let pixels = [
            &mut self.energies_ns,
            &mut self.moments_ns,
            &mut self.pixel_ns,
            &mut self.image_ms,
            &mut self.heel_ms,
            &mut self.line_ns,
        ];
        let slabs = self.exact_slab_ns.iter_mut().chain(&mut self.fixed_slab_ns).chain(&mut self.far_slab_ns);
        let pairs = self.solid_ns.iter_mut().chain(&mut self.shaped_ns);
        rays.into_iter().chain(pixels).chain(slabs).chain(&mut self.volume_ns).chain(pairs).chain(self.panel.all_mut())
    }

    /// Whatever of the two is less, cost by cost.
    pub(super) fn least(mut self, other: &Self) -> Self {
        self.rounds += other.rounds;
        // What a volume costs was found as what its few slabs leave of a time: the least time counts, not the least of such differences.
        let slabs_ns = |costs: &Self| {
            [costs.exact_slab_ns[0], costs.fixed_slab_ns[0], costs.walked_cell_ns * cells_per_slab()].map(|ns| FEW_SLABS * ns)
        };
        let few_ns = |costs: &Self| [0, 1, 2].map(|way: usize| costs.volume_ns[way] + slabs_ns(costs)[way]);
        let (mine_ns, other_ns) = (few_ns(&self), few_ns(other));
        self.all_mut().zip(other.clone().all_mut()).for_each(|(mine, other)| *mine = mine.min(*other));
        let slabs_ns = slabs_ns(&self);
        self.volume_ns = [0, 1, 2].map(|way: usize| (mine_ns[way].min(other_ns[way]) - slabs_ns[way]).max(1e-3));
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
        let ray = RayCounts { volumes: 1.0, slabs: 100.0, cells: 140.0, apart: 0.4, ..RayCounts::default() };
        let cast = |rays: f64, ray: RayCounts| Casting { rays, step_px: 1.0, bands: 2.0, drawn: vec![ray] };
        let work = Work { pixels: 1e5, castings: vec![cast(1e5, ray)], materials: 2, listed: 2, energies: 8, ..Work::default() };
        let predict = |work: &Work| costs.predict_ms(work, Sampling::ExactSlabs);
        let ms = predict(&work);
        assert!(ms > 0.0);
        assert!(predict(&Work { listed: 9, ..work.clone() }) > ms);
        assert!(predict(&Work { energies: 120, ..work.clone() }) > ms);
        assert!(predict(&Work { moments: true, ..work.clone() }) > ms);
        for shaped in [[1.0, 0.0], [0.0, 1.0]] {
            assert!(predict(&Work { shaped, shaped_energies: 8, ..work.clone() }) > ms);
        }
        assert!(predict(&Work { face_tests: 1e5, ..work.clone() }) > ms);
        assert!(predict(&Work { interpolated: 1e6, ..work.clone() }) > ms);
        // A piece more than the cores take at a time: a second round.
        let chunks = |count: f64| predict(&Work { pixels: count * CHUNK_PX, castings: Vec::new(), ..work.clone() });
        let threads = costs.threads as f64;
        assert!(chunks(threads + 1.0) - costs.image_ms > 1.2 * (chunks(threads) - costs.image_ms));
        let with = |casting: Casting| predict(&Work { castings: vec![casting], ..work.clone() });
        assert!(with(Casting { bands: 1.0, ..cast(1e5, ray) }) > 1.6 * ms);
        assert!(with(cast(2.5e4, ray)) < ms);
        let of = |ray: RayCounts| with(cast(1e5, ray));
        assert!(of(RayCounts { filled: 80.0, ..ray }) < ms);
        assert!(of(RayCounts { walked: true, ..ray }) > 2.0 * ms);
        let apart = RayCounts { apart: 2.0, ..ray };
        assert!(of(apart) > ms && of(RayCounts { remote: 1.0, ..apart }) > of(apart));
        assert!(of(RayCounts { walked: true, cells: 200.0, ..ray }) > of(RayCounts { walked: true, ..ray }));
        assert!(of(RayCounts { displacing: 50.0, ..ray }) > ms);
        assert!(of(RayCounts { mesh_tests: 40.0, ..ray }) > ms);
        let passed = of(RayCounts { solids: [9.0, 0.0], ..ray });
        assert!(passed > ms && of(RayCounts { solids: [9.0, 9.0], ..ray }) > passed);
        let sparse = Casting { step_px: 4.0, ..cast(1e5, ray) };
        assert!(with(sparse.clone()) > ms);
        assert!(with(Casting { drawn: vec![RayCounts { apart: f64::NAN, ..ray }], ..sparse.clone() }).is_nan());
        // What is cast twice costs both, and another waking.
        let twice = predict(&Work { castings: vec![cast(1e5, ray), sparse.clone()], ..work.clone() });
        assert!(twice > ms + with(sparse) - predict(&Work { castings: Vec::new(), ..work.clone() }));
    }

    /// The panel took as long as the rest of an image, and no prediction held any of it.
    #[test]
    fn an_image_takes_as_much_longer_as_its_panel_does() {
        let costs = Costs { threads: 2, ..Costs::default() };
        let ray = RayCounts { volumes: 1.0, slabs: 100.0, ..RayCounts::default() };
        let cast = Casting { rays: 1e5, step_px: 1.0, bands: 2.0, drawn: vec![ray] };
        let bare = Work { pixels: 1e5, castings: vec![cast], materials: 2, listed: 2, energies: 8, ..Work::default() };
        let predict = |panel: PanelWork| costs.predict_ms(&Work { panel, ..bare.clone() }, Sampling::ExactSlabs);
        let page = PanelWork { pixels: 1e5, plain_page: true, ..PanelWork::default() };
        // 1e5 pixels and 25 weights of 1.5 ns and 25 of 0.7 ns on two cores.
        let blurred = PanelWork { weights: [25.0; 2], ..page };
        let weights = costs.panel.weight_ns.iter().sum::<f64>() * 25.0 * 1e5 / 2.0 * 1e-6;
        assert!((predict(blurred) - predict(page) - weights).abs() < 0.02 * weights);
        let glaring = PanelWork { block_pairs: 4e7, ..page };
        let spread = costs.panel.block_pair_ns * 4e7 / 2.0 * 1e-6;
        assert!(predict(glaring) - predict(page) > spread);
        // It is the same part whatever is cast.
        let part = costs.panel_ms(&blurred);
        let alone = costs.predict_ms(&Work { panel: blurred, ..Work::default() }, Sampling::None);
        let nothing = costs.predict_ms(&Work::default(), Sampling::None);
        assert!((alone - nothing - part).abs() < 1e-9 && part > 0.0);
        assert_eq!(costs.panel_ms(&PanelWork::default()), 0.0);
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
        assert_eq!(least.exact_slab_ns[0], 2.0);
        for (found, expected) in least.volume_ns.into_iter().zip([7.0, 20.0, 100.0]) {
            assert!((found - expected).abs() < 1e-9, "{:?}", least.volume_ns);
        }
    }
}
