//! What each ray of a coarse raster meets on its way to the detector: what a scatter network is told of a scene.
//!
//! Materials come as what they do to a photon of the beam's mean energy, so that any material can be told; depths come with them, for
//! scatter from near the detector is sharp and strong, and from afar neither.

use rayon::prelude::*;

use super::flight::Medium;
use super::simulation::Simulation;
use super::stream::Stream;

/// Names of the channels, in their order: what arrives unscattered, as a share of the unattenuated signal without heel and bow-tie; optical
/// thickness of Compton scattering, Rayleigh scattering, and absorption; mean and standard deviation of the height above the detector plane of
/// what scatters; share of the photons that collimator, heel and bow-tie leave; place on the detector, from the principal point.
pub const CHANNELS: [&str; 9] =
    ["transmission", "compton", "rayleigh", "photo", "height_mm", "spread_mm", "open", "x_mm", "y_mm"];

/// Names of the numbers that hold for the whole image, in their order: source to detector; mean energy of the beam; sides of the image on
/// the detector; ratio of an antiscatter grid whose strips follow each other along columns' direction, and along rows', 0 for none; response at
/// four fifths of the mean energy over that at the mean energy; opening of the collimator over the image's area.
pub const SCALARS: [&str; 8] = [
    "sdd_mm",
    "mean_kev",
    "image_width_mm",
    "image_height_mm",
    "grid_ratio_across_columns",
    "grid_ratio_across_rows",
    "softer_response",
    "field_over_image",
];

/// Thickness beyond which nothing arrives, and more of it means nothing.
const MOST_THICKNESS: f32 = 8.0;
/// Steps through mixed matter: a voxel or less.
const STEP_MM: f64 = 2.0;
/// Energies by which the primary is summed, at most.
const ENERGIES: usize = 16;

/// The raster, and what holds for all of it.
#[derive(Clone, Debug, PartialEq)]
pub struct Columns {
    /// Columns and rows.
    pub grid_px: [usize; 2],
    /// By channel of [`CHANNELS`], row by row.
    pub channels: [Vec<f32>; CHANNELS.len()],
    /// As [`SCALARS`].
    pub scalars: [f32; SCALARS.len()],
    /// A rough mean of the scattered signal, in units of the unattenuated signal without heel and bow-tie; more than 0.
    pub scale: f32,
}

impl Simulation<'_> {
    /// What the rays through the middles of the cells of a raster of `grid_px` meet.
    #[must_use]
    pub fn columns(&self, grid_px: [usize; 2]) -> Columns {
        let world = self.world();
        let (panel, source) = (&world.panel, &world.source);
        let [columns, rows] = grid_px;
        let mean_kev = source.mean_kev();
        let groups = source.grouped(panel, ENERGIES);
        // By energy, then scene material: attenuation per mm at unit density.
        let attenuations: Vec<Vec<f64>> = groups
            .energies_kev
            .iter()
            .map(|kev| world.materials.iter().map(|material| material.attenuation.per_mm_at_unit_density(*kev)).collect())
            .collect();
        // Per mm at unit density and the mean energy: Compton, Rayleigh, absorption.
        let kinds: Vec<[f64; 3]> = world
            .materials
            .iter()
            .map(|material| {
                let (all, shares) =
                    (material.attenuation.per_mm_at_unit_density(mean_kev), material.attenuation.shares(mean_kev));
                [all * (shares.photo_or_compton - shares.photo), all * (1.0 - shares.photo_or_compton), all * shares.photo]
            })
            .collect();
        let cell = |cell: usize| {
            let share =
                glam::DVec2::new(((cell % columns) as f64 + 0.5) / columns as f64, ((cell / columns) as f64 + 0.5) / rows as f64);
            let at = panel.at_share(share);
            let mut met = Met { density_mm: vec![0.0; kinds.len()], ..Met::default() };
            if let Some(space) = &world.space {
                let way = panel.in_lps(at) - panel.source;
                let (path_mm, cosine) = (way.length(), panel.distance_mm / way.length());
                let entered = space.enter(panel.source, way / path_mm);
                if let Some((ray, gone_mm)) = entered.filter(|(_, gone_mm)| *gone_mm < path_mm) {
                    // Not the numbers of a history.
                    let mut stream = Stream::new(!self.histories().seed, cell as u64);
                    let per_mm = kinds.iter().map(|[compton, rayleigh, photo]| compton + rayleigh + photo).collect();
                    let mut medium = Medium { per_mm, ..Medium::default() };
                    space.sample(ray, path_mm - gone_mm, STEP_MM, &mut medium, &mut stream, |material, density_mm, along_mm| {
                        let [compton, rayleigh, _] = kinds[material as usize];
                        met.add(material, density_mm, (compton + rayleigh) * density_mm, (path_mm - gone_mm - along_mm) * cosine);
                    });
                }
            }
            let of_kind = |kind: usize| met.density_mm.iter().zip(&kinds).map(|(mm, by)| mm * by[kind]).sum::<f64>() as f32;
            let open = source.open_share(panel, at);
            let thickness = |per_mm: &Vec<f64>| per_mm.iter().zip(&met.density_mm).map(|(a, b)| a * b).sum::<f64>();
            let direct = || {
                source
                    .shares(&groups, panel, at)
                    .iter()
                    .zip(&attenuations)
                    .map(|(share, by)| share * (-thickness(by)).exp())
                    .sum()
            };
            let transmission: f64 = if open > 0.0 { direct() } else { 0.0 };
            let (height, spread) = met.heights();
            [
                transmission as f32,
                of_kind(0).min(MOST_THICKNESS),
                of_kind(1).min(MOST_THICKNESS),
                of_kind(2).min(MOST_THICKNESS),
                height as f32,
                spread as f32,
                open as f32,
                at.x as f32,
                at.y as f32,
            ]
        };
        let cells: Vec<[f32; CHANNELS.len()]> = (0..columns * rows).into_par_iter().map(cell).collect();
        let channels = std::array::from_fn(|channel| cells.iter().map(|cell| cell[channel]).collect());
        let corner = panel.at_share(glam::DVec2::ONE) - panel.at_share(glam::DVec2::ZERO);
        let softer = panel.response(0.8 * mean_kev) / panel.response(mean_kev);
        let [across_columns, across_rows] = panel.grid_ratios();
        let field = source.open_mm2() / panel.area_mm2;
        let sides = [panel.distance_mm, mean_kev, corner.x.abs(), corner.y.abs(), across_columns, across_rows, softer, field];
        let scale = (rough(&cells, panel.area_mm2) / (1.0 + STOPPED * across_columns.max(across_rows))) as f32;
        Columns { grid_px, channels, scalars: sides.map(|value| value as f32), scale }
    }
}

/// What one ray met.
#[derive(Clone, Debug, Default)]
struct Met {
    /// By scene material, mm at unit density.
    density_mm: Vec<f64>,
    scatters: f64,
    scatters_height: f64,
    scatters_height2: f64,
}

impl Met {
    fn add(&mut self, material: u32, density_mm: f64, scatters: f64, height_mm: f64) {
        self.density_mm[material as usize] += density_mm;
        self.scatters += scatters;
        self.scatters_height += scatters * height_mm;
        self.scatters_height2 += scatters * height_mm * height_mm;
    }

    /// Mean and standard deviation, mm; 0 where nothing scatters.
    fn heights(&self) -> (f64, f64) {
        if !(self.scatters > 0.0) {
            return (0.0, 0.0);
        }
        let mean = self.scatters_height / self.scatters;
        (mean, (self.scatters_height2 / self.scatters - mean * mean).max(0.0).sqrt())
    }
}

/// What an antiscatter grid keeps out, roughly: by its ratio, scatter becomes less by 1 + STOPPED · ratio.
const STOPPED: f64 = 0.3;
/// Of the thickness that the primary crosses, what scatter has to.
const BEHIND: f64 = 0.6;

/// What is scattered and gets out, spread evenly over a sphere around its mean height: mean share that meets the image. A
/// unit for a network to start from: what it learns is the ratio to this.
fn rough(cells: &[[f32; CHANNELS.len()]], area_mm2: f64) -> f64 {
    let (mut scattered, mut heights) = (0.0, 0.0);
    for [transmission, compton, rayleigh, _, height, _, open, ..] in cells.iter().map(|cell| cell.map(f64::from)) {
        let thickness = if open > 0.0 { (transmission / open).max(1e-9) } else { 0.0 };
        let out = open * thickness.powf(BEHIND) * (compton + rayleigh).min(2.0);
        scattered += out;
        heights += out * height;
    }
    let height_mm = (heights / scattered).max(30.0);
    let seen = area_mm2 / (4.0 * std::f64::consts::PI * height_mm * height_mm);
    let found = 1.33 * scattered / cells.len() as f64 * seen.min(0.5);
    // Where nothing scatters any unit will do.
    if found > 1e-6 { found } else { 1e-6 }
}

#[cfg(test)]
mod tests {
    use glam::{DQuat, DVec2, DVec3};

    use super::*;
    use crate::geometry::{Intrinsics, Rigid, View};
    use crate::scene::model::{Matter, Scene, Shape};
    use crate::scene::optics::{Axis, BowTie, Field, Grid, Heel, Scintillator, Strips, Towards};
    use crate::scene::physics::{Material, Spectrum};
    use crate::transport::fixture::{everything, scene, solid};
    use crate::transport::{Histories, Page};

    /// A camera at the origin that looks along +z, 100 × 80 pixels of 1 mm, the detector 1000 mm away.
    fn view() -> View {
        let intrinsics = Intrinsics { fx: 1000.0, fy: 1000.0, skew: 0.0, cx: 49.5, cy: 39.5 };
        View { size_px: [100, 80], intrinsics, camera_from_lps: Rigid::IDENTITY }
    }

    fn simulation<'a>(scene: &'a Scene, view: &View, count: u64) -> Simulation<'a> {
        Simulation::new(scene, view, Histories { count, grid_px: [10, 8], ..Histories::default() }).expect("prepared")
    }

    /// A slab of water across the beam from 500 to 600 mm: everything about it is known.
    #[test]
    fn a_slab_is_what_it_is_everywhere() {
        let slab = Shape::Cuboid { half_size_mm: DVec3::new(200.0, 200.0, 50.0) };
        let mut scene =
            scene(&["water"], vec![Matter::Solids(vec![solid(slab, DVec3::new(0.0, 0.0, 550.0), DVec3::ZERO, 0, 1.0)])]);
        let size_mm = DVec2::new(40.0, 200.0);
        scene.beam.shape.field = Some(Field::Rectangle { size_mm, centre_mm: DVec2::ZERO, rotation_deg: 0.0 });
        let strips = Some(Strips { ratio: 10.0, across: Axis::Row });
        scene.detector.panel.grid = Some(Grid { primary_transmission: 0.7, strips });
        let found = simulation(&scene, &view(), 1).columns([20, 16]);
        let water = scene.materials[0].attenuation(60.0).expect("inside");
        for cell in 0..20 * 16 {
            let value = |name: &str| {
                f64::from(found.channels[CHANNELS.iter().position(|known| *known == name).expect("a channel")][cell])
            };
            let (x, y) = ((cell % 20) as f64 * 5.0 + 2.5 - 50.0, (cell / 20) as f64 * 5.0 + 2.5 - 40.0);
            let path_cm = 10.0 * DVec3::new(x, y, 1000.0).length() / 1000.0;
            let open = f64::from(u8::from(x.abs() <= 20.0));
            let expected = [
                ("transmission", open * (-water.total_cm2_per_g * path_cm).exp(), 1e-4),
                ("compton", water.compton_cm2_per_g * path_cm, 1e-3),
                ("rayleigh", water.rayleigh_cm2_per_g * path_cm, 1e-3),
                ("photo", water.photo_cm2_per_g * path_cm, 1e-3),
                ("height_mm", 450.0, 1e-5),
                ("spread_mm", 100.0 / 12f64.sqrt(), 1e-3),
                ("open", open, 0.0),
                ("x_mm", x, 1e-5),
                ("y_mm", y, 1e-5),
            ];
            for (name, expected, share) in expected {
                let found = value(name);
                assert!(
                    (found - expected).abs() <= share * expected.abs() + 1e-6,
                    "{name} of cell {cell}: {found}, not {expected}"
                );
            }
        }
        assert_eq!(found.scalars[..6], [1000.0, 60.0, 100.0, 80.0, 0.0, 10.0]);
        // Half of the field lies beside the image; its solid angle is a little less than its area's.
        assert!((found.scalars[6] - 0.8).abs() < 1e-6 && (found.scalars[7] - 1.0).abs() < 0.02 && found.scale > 0.0);
    }

    /// Everything that a scene can hold, from the side: the primary is what photons find, material by material.
    #[test]
    fn the_primary_is_what_photons_find() {
        let scene = everything();
        let camera_from_lps =
            Rigid { rotation: DQuat::from_scaled_axis(DVec3::new(0.7, -0.4, 0.2)), translation_mm: DVec3::Z * 600.0 };
        let simulation = simulation(&scene, &View { camera_from_lps, ..view() }, 250_000);
        let mut tally = simulation.tally();
        simulation.run(&mut tally, |_| Ok::<(), ()>(())).expect("nothing stops it");
        // Many rays a cell: what photons find is a mean over it.
        let fine = 8;
        let found = simulation.columns([10 * fine, 8 * fine]);
        let mut worst: f64 = 0.0;
        for cell in 0..80 {
            let (column, row) = (cell % 10 * fine, cell / 10 * fine);
            let rays = (0..fine * fine).map(|n| found.channels[0][(row + n / fine) * 10 * fine + column + n % fine]);
            let mean = rays.map(f64::from).sum::<f64>() / (fine * fine) as f64;
            let primary = tally.signal(Page::Primary, cell);
            let (truth, error) =
                (primary.mean / simulation.unattenuated()[cell], primary.standard_error / simulation.unattenuated()[cell]);
            // The exponential of a drawn thickness is high by half its variance: no matter where hardly anything arrives.
            worst = worst.max((mean - truth).abs() / (error + 0.03 * truth + 1e-3));
        }
        assert!(worst < 3.5, "{worst} standard errors");
    }

    /// A polychromatic beam with a heel and a bow-tie onto a scintillator, through shapes: the primary is what photons find, to a share that
    /// grouping its energies costs.
    #[test]
    fn sixteen_energies_are_a_spectrum() {
        let block = Shape::Cuboid { half_size_mm: DVec3::new(30.0, 200.0, 60.0) };
        let rod = Shape::Cylinder { length_mm: 400.0, radius_mm: 8.0, inner_radius_mm: 0.0 };
        let solids = vec![
            solid(block, DVec3::new(10.0, 0.0, 600.0), DVec3::ZERO, 0, 1.0),
            solid(rod, DVec3::new(20.0, 200.0, 600.0), DVec3::new(1.57, 0.0, 0.0), 1, 1.9),
        ];
        let mut scene = scene(&["water", "bone_cortical"], vec![Matter::Solids(solids)]);
        let aluminium = Material::parse("aluminium").expect("known");
        scene.beam.spectrum = Spectrum::tungsten(90.0, 12.0, &[(aluminium.clone(), 3.0)]).expect("a beam");
        scene.beam.shape.heel = Some(Heel { tube_kvp: 90.0, anode_angle_deg: 12.0, anode_towards: Towards::PlusColumn });
        let thickness_mm = vec![[-3.0, 9.0], [0.0, 1.0], [3.0, 9.0]];
        scene.beam.shape.bowtie = Some(BowTie { material: aluminium, density_g_per_cm3: 2.7, axis: Axis::Row, thickness_mm });
        let csi = Material::parse("csi").expect("known");
        scene.detector.panel.scintillator = Some(Scintillator { material: csi, density_g_per_cm3: 4.5, thickness_mm: 0.5 });
        let simulation = simulation(&scene, &view(), 2_000_000);
        let mut tally = simulation.tally();
        simulation.run(&mut tally, |_| Ok::<(), ()>(())).expect("nothing stops it");
        let fine = 8;
        let (found, unit) = (simulation.columns([10 * fine, 8 * fine]), simulation.unshaped());
        for (cell, unit) in unit.iter().enumerate() {
            let (column, row) = (cell % 10 * fine, cell / 10 * fine);
            let rays = (0..fine * fine).map(|n| found.channels[0][(row + n / fine) * 10 * fine + column + n % fine]);
            let mean = rays.map(f64::from).sum::<f64>() / (fine * fine) as f64;
            let primary = tally.signal(Page::Primary, cell);
            let (truth, error) = (primary.mean / unit, primary.standard_error / unit);
            assert!((mean - truth).abs() < 4.0 * error + 0.01 * truth, "cell {cell}: {mean}, photons find {truth} ± {error}");
        }
    }

    /// Nothing in the beam, and something behind the detector only.
    #[test]
    fn nothing_scatters_where_nothing_is() {
        let ball = Shape::Ellipsoid { semi_axes_mm: DVec3::splat(50.0) };
        let cube = Shape::Cuboid { half_size_mm: DVec3::splat(50.0) };
        let behind = |shape: Shape| Matter::Solids(vec![solid(shape, DVec3::new(0.0, 0.0, 1100.0), DVec3::ZERO, 0, 1.0)]);
        for matters in [vec![], vec![behind(ball)], vec![behind(cube)]] {
            let scene = scene(&["water"], matters);
            let found = simulation(&scene, &view(), 1).columns([8, 6]);
            assert!(found.channels[0].iter().all(|share| (*share - 1.0).abs() < 1e-6), "{:?}", found.channels[0]);
            assert!(found.channels[1..6].iter().flatten().all(|value| *value == 0.0));
            assert!(found.scale > 0.0 && found.scale < 1e-5);
        }
    }
}
