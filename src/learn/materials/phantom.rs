//! Phantoms: bones of surfaces or of simple shapes in soft tissue, with all that thresholding takes for bone, seen by a CT that blurs and is noisy.

use std::path::Path;

use glam::{DMat3, DVec3};

use super::distance::squared_mm2;
use super::solid::inside;
use crate::learn::draw::Draw;
use crate::learn::specimen::{LabelledSpecimen, METAL, rounded, upright};
use crate::random::{Purpose, Stream};
use crate::reporter::Reporter;
use crate::scene::{SceneError, read_closed_triangles};

/// Structures of a phantom.
const BONE: u8 = 1;
const CONTRAST: u8 = 2;
const TISSUE: u8 = 3;

/// A surface that phantoms have a bone of.
#[derive(Clone, Debug)]
pub struct PhantomMesh {
    /// Corners about the middle of its bounds, mm.
    triangles_mm: Vec<[DVec3; 3]>,
}

impl PhantomMesh {
    /// Reads an STL file, in mm.
    ///
    /// # Errors
    /// When it is damaged, or the surface has holes.
    pub fn read(path: &Path, reporter: &Reporter) -> Result<Self, SceneError> {
        let mut triangles_mm = read_closed_triangles(path, reporter)?;
        let (mut low, mut high) = (DVec3::INFINITY, DVec3::NEG_INFINITY);
        triangles_mm.iter().flatten().for_each(|corner| (low, high) = (low.min(*corner), high.max(*corner)));
        triangles_mm.iter_mut().flatten().for_each(|corner| *corner -= 0.5 * (low + high));
        Ok(Self { triangles_mm })
    }
}

/// A place in the middle `share` of the grid.
fn place(draw: &mut Draw, grid: &Fine, share: f64) -> DVec3 {
    let at = draw.between3(DVec3::ZERO, DVec3::ONE);
    grid.extent_mm() * (DVec3::splat(0.5) + (at - 0.5) * share)
}

/// The grid that a phantom is drawn on; its CT's is this one, or has thicker slices.
struct Fine {
    size: [usize; 3],
    spacing_mm: [f64; 3],
}

impl Fine {
    fn extent_mm(&self) -> DVec3 {
        DVec3::from_array(std::array::from_fn(|axis| self.size[axis] as f64 * self.spacing_mm[axis]))
    }

    fn voxels(&self) -> usize {
        self.size.iter().product()
    }

    fn centre(&self, index: usize) -> DVec3 {
        let at = [index % self.size[0], index / self.size[0] % self.size[1], index / (self.size[0] * self.size[1])];
        DVec3::from_array(std::array::from_fn(|axis| at[axis] as f64 * self.spacing_mm[axis]))
    }

    /// Voxels within `radius_mm` of the segment between two points, and how far each lies from it over the radius.
    fn near_segment(&self, from: DVec3, to: DVec3, radius_mm: f64, mut each: impl FnMut(usize)) {
        let (low, high) = (from.min(to) - radius_mm, from.max(to) + radius_mm);
        let range = |axis: usize| {
            let first = (low[axis] / self.spacing_mm[axis]).ceil().max(0.0) as usize;
            let end = ((high[axis] / self.spacing_mm[axis]).floor() + 1.0).clamp(0.0, self.size[axis] as f64) as usize;
            first..end
        };
        let along = to - from;
        for k in range(2) {
            for j in range(1) {
                for i in range(0) {
                    let index = i + self.size[0] * (j + self.size[1] * k);
                    let p = self.centre(index) - from;
                    let share = (p.dot(along) / along.length_squared().max(1e-12)).clamp(0.0, 1.0);
                    if (p - share * along).length_squared() <= radius_mm * radius_mm {
                        each(index);
                    }
                }
            }
        }
    }
}

/// The phantom of `seed`, named `phantom-SEED`, with a bone of one of `meshes` in most of them where there are any.
#[must_use]
pub fn phantom(seed: u64, meshes: &[PhantomMesh], origin: String) -> LabelledSpecimen {
    let mut draw = Draw(Stream::new(seed, 1, 0, Purpose::Training));
    let (in_plane, slice) = (draw.between(0.8, 2.5), draw.between(0.8, 3.0));
    // An odd number: the middle one lies where their mean does.
    let thin = (slice / 1.2).ceil() as usize | 1;
    let side = draw.between(110.0, 150.0);
    let slices = (side / slice) as usize;
    let columns = (side / in_plane) as usize;
    let grid = Fine { size: [columns, columns, slices * thin], spacing_mm: [in_plane, in_plane, slice / thin as f64] };
    let mut structure = vec![0_u8; grid.voxels()];
    let mut hu = tissue(&mut draw, &grid, &mut structure);
    bones(&mut draw, &grid, meshes, &mut hu, &mut structure);
    dense_tissue(&mut draw, &grid, &mut hu, &mut structure);
    metal(&mut draw, &grid, &mut hu, &mut structure);
    let fwhm_mm = draw.between(0.8, 2.0);
    for axis in 0..3 {
        blur(&mut hu, &grid, axis, fwhm_mm / 2.355);
    }
    let (hu, structure) = (thick(&hu, &grid, thin), middle_of(&structure, &grid, thin));
    let (noise_hu, shift_hu, gain) = (draw.between(3.0, 60.0), draw.between(-20.0, 20.0), draw.between(0.97, 1.03));
    // A CT saturates somewhere.
    let highest = if draw.chance(0.5) { 3071.0 } else { 8000.0 };
    let seen =
        |hu: f32, draw: &mut Draw| (f64::from(hu) * gain + shift_hu + noise_hu * draw.0.normal()).clamp(-1024.0, highest) as f32;
    let hu = hu.iter().map(|hu| rounded(seen(*hu, &mut draw))).collect();
    LabelledSpecimen {
        name: format!("phantom-{seed}"),
        is_phantom: true,
        grid: upright([columns, columns, slices], [in_plane, in_plane, slice]),
        hu,
        structure,
        bones: vec![BONE],
        origin,
    }
}

/// A body of muscle under fat, textured, in air.
fn tissue(draw: &mut Draw, grid: &Fine, structure: &mut [u8]) -> Vec<f32> {
    let middle = 0.5 * grid.extent_mm();
    let [a, b] = [0, 1].map(|axis| middle[axis] * draw.between(0.75, 1.6));
    let fat_share = 1.0 - draw.between(0.02, 0.3);
    let (muscle, fat) = (draw.between(30.0, 75.0), draw.between(-125.0, -80.0));
    let texture = Texture::new(draw, 3, [6.0, 40.0]);
    let lobes = Texture::new(draw, 3, [10.0, 30.0]);
    (0..grid.voxels())
        .map(|index| {
            let p = grid.centre(index);
            let far = ((p.x - middle.x) / a).hypot((p.y - middle.y) / b);
            if far > 1.0 {
                return -1000.0;
            }
            structure[index] = TISSUE;
            let is_fat = far > fat_share || lobes.at(p) > 1.4;
            (if is_fat { fat } else { muscle } + 12.0 * texture.at(p)) as f32
        })
        .collect()
}

/// Sums of waves: about normal, with mean 0 and deviation 1.
struct Texture(Vec<(DVec3, f64)>);

impl Texture {
    fn new(draw: &mut Draw, waves: usize, lengths_mm: [f64; 2]) -> Self {
        let wave = |draw: &mut Draw| {
            let length = draw.between(lengths_mm[0], lengths_mm[1]);
            (draw.direction() * std::f64::consts::TAU / length, draw.between(0.0, std::f64::consts::TAU))
        };
        Self((0..waves).map(|_| wave(draw)).collect())
    }

    fn at(&self, p: DVec3) -> f64 {
        let sum: f64 = self.0.iter().map(|(wave, phase)| (wave.dot(p) + phase).sin()).sum();
        sum * (2.0 / self.0.len() as f64).sqrt()
    }
}

/// One to three bones: a dense shell about spongy bone, with marrow where it is wide.
fn bones(draw: &mut Draw, grid: &Fine, meshes: &[PhantomMesh], hu: &mut [f32], structure: &mut [u8]) {
    for _ in 0..1 + draw.count(3) {
        let solid = if !meshes.is_empty() && draw.chance(0.6) { of_mesh(draw, grid, meshes) } else { of_shape(draw, grid) };
        let depth = squared_mm2(grid.size, grid.spacing_mm, |index| !solid[index]);
        let shell_mm = draw.between(0.8, 4.0);
        let marrow_mm = if draw.chance(0.5) { draw.between(4.0, 12.0) } else { f64::INFINITY };
        let (dense, spongy, marrow) = (draw.between(500.0, 1500.0), draw.between(60.0, 400.0), draw.between(-90.0, 60.0));
        let fine = Texture::new(draw, 6, [2.5, 9.0]);
        let wide = Texture::new(draw, 3, [10.0, 40.0]);
        let uneven = draw.between(10.0, 90.0);
        for index in (0..solid.len()).filter(|index| solid[*index]) {
            let (p, mm) = (grid.centre(index), f64::from(depth[index]).sqrt());
            structure[index] = BONE;
            let thickness = shell_mm * (1.0 + 0.4 * wide.at(p)).max(0.3);
            let value = if mm < thickness {
                dense + uneven * wide.at(p)
            } else if mm < marrow_mm + 2.0 * wide.at(p) {
                spongy + uneven * (fine.at(p) + 0.5 * wide.at(p))
            } else {
                marrow + 15.0 * fine.at(p)
            };
            hu[index] = value as f32;
        }
    }
}

fn of_mesh(draw: &mut Draw, grid: &Fine, meshes: &[PhantomMesh]) -> Vec<bool> {
    let mesh = &meshes[draw.count(meshes.len())];
    let mirror = DMat3::from_diagonal(DVec3::new(if draw.chance(0.5) { -1.0 } else { 1.0 }, 1.0, 1.0));
    let axes = draw.turn() * mirror * draw.between(0.8, 1.2);
    let corner = mesh.triangles_mm[draw.count(mesh.triangles_mm.len())][0];
    // Somewhere on its surface lies near the middle of the scan.
    let shift = place(draw, grid, 0.5) - axes * corner;
    let placed: Vec<[DVec3; 3]> = mesh.triangles_mm.iter().map(|triangle| triangle.map(|corner| axes * corner + shift)).collect();
    inside(&placed, grid.size, grid.spacing_mm)
}

/// A block such as a vertebra's, or a bent rod such as a rib.
fn of_shape(draw: &mut Draw, grid: &Fine) -> Vec<bool> {
    let mut solid = vec![false; grid.voxels()];
    if draw.chance(0.5) {
        let (centre, axes) = (place(draw, grid, 0.7), draw.turn());
        let sizes = DVec3::new(draw.between(8.0, 30.0), draw.between(8.0, 25.0), draw.between(6.0, 25.0));
        let power = draw.between(2.0, 6.0);
        for (index, is_inside) in solid.iter_mut().enumerate() {
            let p = (axes * (grid.centre(index) - centre) / sizes).abs();
            *is_inside = p.x.powf(power) + p.y.powf(power) + p.z.powf(power) < 1.0;
        }
    } else {
        let (centre, axes) = (place(draw, grid, 0.8), draw.turn());
        let (bend_mm, radius_mm) = (draw.between(40.0, 120.0), draw.between(3.0, 9.0));
        let on = |angle: f64| centre + axes * (bend_mm * DVec3::new(angle.cos() - 1.0, angle.sin(), 0.0));
        let half = draw.between(0.4, 1.5);
        for step in 0..24 {
            let angle = |step: usize| half * (step as f64 / 12.0 - 1.0);
            grid.near_segment(on(angle(step)), on(angle(step + 1)), radius_mm, |index| solid[index] = true);
        }
    }
    solid
}

/// What is as dense as bone and none: vessels and organs with contrast medium, and chalk.
fn dense_tissue(draw: &mut Draw, grid: &Fine, hu: &mut [f32], structure: &mut [u8]) {
    let mut fill = |index: usize, value: f32, hu: &mut [f32]| {
        if structure[index] == TISSUE {
            structure[index] = CONTRAST;
            hu[index] = value;
        }
    };
    for _ in 0..draw.count(5) {
        let value = draw.between(110.0, 450.0) as f32;
        let (mut from, radius_mm) = (place(draw, grid, 0.9), draw.between(1.5, 11.0));
        let mut heading = draw.direction();
        for _ in 0..6 {
            let to = from + 22.0 * heading;
            grid.near_segment(from, to, radius_mm, |index| fill(index, value, hu));
            heading = (heading + 0.5 * draw.direction()).normalize_or(DVec3::Z);
            from = to;
        }
    }
    for _ in 0..draw.count(3) {
        let value = draw.between(100.0, 400.0) as f32;
        let (centre, axes) = (place(draw, grid, 0.8), draw.turn());
        let sizes = DVec3::new(draw.between(8.0, 35.0), draw.between(8.0, 30.0), draw.between(8.0, 30.0));
        for index in 0..grid.voxels() {
            if (axes * (grid.centre(index) - centre) / sizes).length_squared() < 1.0 {
                fill(index, value, hu);
            }
        }
    }
    for _ in 0..draw.count(6) {
        let (value, at) = (draw.between(200.0, 1200.0) as f32, place(draw, grid, 0.8));
        let radius_mm = draw.between(0.8, 3.0);
        grid.near_segment(at, at, radius_mm, |index| fill(index, value, hu));
    }
}

/// Screws and rods in bone, beads on tissue.
fn metal(draw: &mut Draw, grid: &Fine, hu: &mut [f32], structure: &mut [u8]) {
    let mut put = |index: usize, value: f32| {
        (hu[index], structure[index]) = (value, METAL);
    };
    if draw.chance(0.3) {
        let (from, heading) = (place(draw, grid, 0.5), draw.direction());
        let (length_mm, radius_mm, value) =
            (draw.between(20.0, 90.0), draw.between(1.5, 6.0), draw.between(2500.0, 8000.0) as f32);
        grid.near_segment(from, from + length_mm * heading, radius_mm, |index| put(index, value));
    }
    if draw.chance(0.3) {
        for _ in 0..1 + draw.count(8) {
            let at = place(draw, grid, 0.9);
            grid.near_segment(at, at, 1.0, |index| put(index, 8000.0));
        }
    }
}

/// Blurs along `axis` by a normal distribution.
fn blur(values: &mut [f32], grid: &Fine, axis: usize, deviation_mm: f64) {
    let deviation = deviation_mm / grid.spacing_mm[axis];
    let reach = (3.0 * deviation).ceil() as usize;
    let raw: Vec<f64> = (0..=2 * reach).map(|at| (-0.5 * ((at as f64 - reach as f64) / deviation).powi(2)).exp()).collect();
    let sum: f64 = raw.iter().sum();
    let kernel: Vec<f32> = raw.iter().map(|share| (share / sum) as f32).collect();
    let (count, stride) = (grid.size[axis], [1, grid.size[0], grid.size[0] * grid.size[1]][axis]);
    let mut line = vec![0.0; count];
    for start in (0..values.len()).filter(|index| index / stride % count == 0) {
        (0..count).for_each(|at| line[at] = values[start + at * stride]);
        for at in 0..count {
            let about = kernel.iter().enumerate().map(|(k, share)| share * line[(at + k).saturating_sub(reach).min(count - 1)]);
            values[start + at * stride] = about.sum();
        }
    }
}

/// Means of `thin` slices each.
fn thick(values: &[f32], grid: &Fine, thin: usize) -> Vec<f32> {
    let slice = grid.size[0] * grid.size[1];
    let mean = |slices: &[f32]| {
        let column = |at: usize| (0..thin).map(|k| slices[at + slice * k]).sum::<f32>() / thin as f32;
        (0..slice).map(column).collect::<Vec<f32>>()
    };
    values.chunks_exact(slice * thin).flat_map(mean).collect()
}

/// The structures of the middle one of `thin` slices each; metal in any of them is metal.
fn middle_of(structure: &[u8], grid: &Fine, thin: usize) -> Vec<u8> {
    let slice = grid.size[0] * grid.size[1];
    let of = |slices: &[u8]| {
        let column = |at: usize| {
            let is_metal = (0..thin).any(|k| slices[at + slice * k] == METAL);
            if is_metal { METAL } else { slices[at + slice * (thin / 2)] }
        };
        (0..slice).map(column).collect::<Vec<u8>>()
    };
    structure.chunks_exact(slice * thin).flat_map(of).collect()
}
