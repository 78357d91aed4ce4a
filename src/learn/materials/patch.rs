//! Patches of specimens as a pass sees them: turned, scaled, mirrored, with noise, on another scale, and with contrast medium where there was none.

use glam::{DMat3, DVec3};

use crate::infer::materials::{AIR, BEYOND_HU, BONE, CLASSES, DENSE_HU, Pass, Reduced, SOFT, windows};
use crate::learn::specimen::{LabelledSpecimen, METAL};
use crate::random::Stream;

/// What is thinner is air, or lung.
const AIR_BELOW_HU: f32 = -700.0;
/// Weight of points that are too thin for bone: what is said of them decides nothing.
const THIN_WEIGHT: f32 = 0.02;
/// Below this no average over a few voxels hides one that is dense enough.
const NEARLY_DENSE_HU: f32 = DENSE_HU - 30.0;
/// Shares of patches about a block of bone, and about a dense one that is none; the others are anywhere.
const AT_BONE: f64 = 0.5;
const AT_DENSE: f64 = 0.3;
/// Share of patches with contrast medium in places of its own.
const WITH_POOLS: f64 = 0.6;

/// A specimen, averaged to the resolution of a pass.
#[derive(Clone, Debug)]
pub(super) struct Prepared {
    hu: Reduced,
    /// Structure of each block's middle.
    structure: Vec<u8>,
    /// Shares of each block.
    air: Vec<f32>,
    bone: Vec<f32>,
    metal: Vec<f32>,
    /// Blocks that are mostly bone.
    bone_blocks: Vec<u32>,
    /// Blocks that are as dense, and no bone.
    dense_blocks: Vec<u32>,
    bones: Vec<u8>,
    is_phantom: bool,
}

/// One patch: row-major (z, y, x).
#[derive(Clone, Debug, PartialEq)]
pub(super) struct Patch {
    /// [2, n³].
    pub windows: Vec<f32>,
    /// Shares of the classes, [3, n³].
    pub truth: Vec<f32>,
    /// How much each point counts, [n³].
    pub weight: Vec<f32>,
}

impl Prepared {
    pub(super) fn new(specimen: &LabelledSpecimen, pass: &Pass) -> Self {
        let reduced = |value: &(dyn Fn(usize) -> f32 + Sync)| Reduced::of(&specimen.grid, pass.spacing_mm, value);
        let share = |is: bool| f32::from(u8::from(is));
        let hu = reduced(&|index| specimen.hu[index].max(BEYOND_HU));
        let bone = reduced(&|index| share(specimen.is_in_bone(index))).values;
        let structure = (0..hu.values.len()).map(|block| specimen.structure[hu.middle_voxel(block)]).collect();
        let blocks = |is: &dyn Fn(usize) -> bool| (0..bone.len()).filter(|block| is(*block)).map(|block| block as u32).collect();
        let bone_blocks = blocks(&|block| bone[block] > 0.5);
        let dense_blocks = blocks(&|block| bone[block] < 0.1 && hu.values[block] >= DENSE_HU);
        Self {
            air: reduced(&|index| share(specimen.hu[index] < AIR_BELOW_HU)).values,
            metal: reduced(&|index| share(specimen.structure[index] == METAL)).values,
            structure,
            bone_blocks,
            dense_blocks,
            bone,
            hu,
            bones: specimen.bones.clone(),
            is_phantom: specimen.is_phantom,
        }
    }

    /// A patch of `pass` that `stream` draws; with `changed`, as no scanner may have seen it.
    pub(super) fn patch(&self, pass: &Pass, stream: &mut Stream, changed: bool) -> Patch {
        let spacing_mm = DVec3::from_array(pass.spacing_mm);
        let side = pass.patch;
        let half = (side as f64 - 1.0) / 2.0;
        let (of, at) = (stream.uniform(), stream.uniform());
        let one_of = |blocks: &[u32]| blocks.get((at * blocks.len() as f64) as usize).map(|block| *block as usize);
        let block = match of {
            of if of < AT_BONE => one_of(&self.bone_blocks),
            of if of < AT_BONE + AT_DENSE => one_of(&self.dense_blocks),
            _ => None,
        };
        let block = block.unwrap_or((at * self.structure.len() as f64) as usize);
        let jitter = DVec3::new(stream.uniform(), stream.uniform(), stream.uniform()) - 0.5;
        let centre = self.hu.centre(block) + jitter * spacing_mm * side as f64 * 0.5;
        let axes = if changed { turned(stream) } else { DMat3::IDENTITY };
        let change = if changed { Change::drawn(stream, &self.bones, self.is_phantom) } else { Change::nothing() };
        let half_mm = spacing_mm * half;
        let pools = if changed && stream.uniform() < WITH_POOLS { Pool::some(stream, centre, half_mm) } else { Vec::new() };
        let points = pass.points();
        let (mut hu, mut weight) = (Vec::with_capacity(points), Vec::with_capacity(points));
        let mut truth = vec![0.0; CLASSES * points];
        for z in 0..side {
            for y in 0..side {
                for x in 0..side {
                    let step = DVec3::new(x as f64, y as f64, z as f64) - half;
                    let p = centre + axes * (step * spacing_mm);
                    let (mut value, mut air, mut bone, mut metal, mut beyond) = (0.0, 0.0, 0.0, 0.0, 1.0);
                    for (place, share) in self.hu.about(p).each() {
                        let change = change.of_structure[usize::from(self.structure[place])];
                        value += share * (self.hu.values[place] + if self.air[place] > 0.0 { 0.0 } else { change });
                        air += share * self.air[place];
                        bone += share * self.bone[place];
                        metal += share * self.metal[place];
                        beyond -= share;
                    }
                    (value, air) = (value + beyond * BEYOND_HU, air + beyond);
                    bone = bone.min(1.0 - air);
                    let soft = 1.0 - air - bone;
                    value += soft * pools.iter().map(|pool| pool.at(p)).fold(0.0, f32::max);
                    let noise = if change.noise_hu > 0.0 { change.noise_hu * stream.normal() as f32 } else { 0.0 };
                    let value = value * change.gain + change.shift_hu + noise;
                    let at = hu.len();
                    truth[AIR * points + at] = air;
                    truth[BONE * points + at] = bone;
                    truth[SOFT * points + at] = soft;
                    let known = 1.0 - metal;
                    weight.push(known * if value >= NEARLY_DENSE_HU { 1.0 } else { THIN_WEIGHT });
                    hu.push(value);
                }
            }
        }
        Patch { windows: windows(&hu).collect(), truth, weight }
    }
}

/// Turned about all axes by some 17°, left and right exchanged or not, scaled.
fn turned(stream: &mut Stream) -> DMat3 {
    let angle = |stream: &mut Stream| 0.3 * stream.normal();
    let turn =
        DMat3::from_rotation_x(angle(stream)) * DMat3::from_rotation_y(angle(stream)) * DMat3::from_rotation_z(angle(stream));
    let mirror = if stream.uniform() < 0.5 { -1.0 } else { 1.0 };
    let scale = (0.12 * stream.normal()).clamp(-0.3, 0.3).exp();
    turn * DMat3::from_diagonal(DVec3::new(mirror * scale, scale, scale))
}

/// Contrast medium where the specimen has none: a rounded body or a tube of it, in all but bone and air.
struct Pool {
    centre_mm: DVec3,
    /// To where the surface is at a distance of 1 from the centre, or from the axis z of a tube.
    unit_from_mm: DMat3,
    is_tube: bool,
    /// 1 / the share of the radius over which it ends.
    steepness: f32,
    hu: f32,
    /// Change of `hu` to the surface.
    slope: DVec3,
}

impl Pool {
    /// One to five of them within `half_mm` of `centre_mm`.
    fn some(stream: &mut Stream, centre_mm: DVec3, half_mm: DVec3) -> Vec<Self> {
        let between = |stream: &mut Stream, low: f64, high: f64| low + (high - low) * stream.uniform();
        let count = 1 + (5.0 * stream.uniform()) as usize;
        let pool = |stream: &mut Stream| {
            let is_tube = stream.uniform() < 0.5;
            let [low, high] = if is_tube { [1.5_f64, 14.0] } else { [4.0, 45.0] };
            let radius = |stream: &mut Stream| low * (high / low).powf(stream.uniform());
            let mean = radius(stream);
            let radii = DVec3::from_array(std::array::from_fn(|_| mean * between(stream, 0.6, 1.6)));
            let angle = |stream: &mut Stream| std::f64::consts::TAU * stream.uniform();
            let turn = DMat3::from_rotation_z(angle(stream))
                * DMat3::from_rotation_x(angle(stream))
                * DMat3::from_rotation_z(angle(stream));
            let offset = DVec3::new(stream.uniform(), stream.uniform(), stream.uniform()) * 2.0 - 1.0;
            let slope = DVec3::new(stream.normal(), stream.normal(), stream.normal());
            let hu = between(stream, 60.0, 450.0) as f32;
            Self {
                centre_mm: centre_mm + offset * half_mm,
                unit_from_mm: DMat3::from_diagonal(1.0 / radii) * turn,
                is_tube,
                steepness: (mean / between(stream, 0.8, 3.0)) as f32,
                hu,
                slope: slope * 0.1,
            }
        };
        (0..count).map(|_| pool(stream)).collect()
    }

    /// Hounsfield numbers that it adds at `p_mm`.
    fn at(&self, p_mm: DVec3) -> f32 {
        let q = self.unit_from_mm * (p_mm - self.centre_mm);
        let far = if self.is_tube { q.x.hypot(q.y) } else { q.length() } as f32;
        let share = ((1.0 - far) * self.steepness + 0.5).clamp(0.0, 1.0);
        share * self.hu * (1.0 + self.slope.dot(q) as f32).clamp(0.5, 1.5)
    }
}

/// What is done to the Hounsfield numbers of a patch.
struct Change {
    gain: f32,
    shift_hu: f32,
    noise_hu: f32,
    /// Added where a structure is.
    of_structure: [f32; 256],
}

impl Change {
    fn nothing() -> Self {
        Self { gain: 1.0, shift_hu: 0.0, noise_hu: 0.0, of_structure: [0.0; 256] }
    }

    fn drawn(stream: &mut Stream, bones: &[u8], is_phantom: bool) -> Self {
        let between = |stream: &mut Stream, low: f64, high: f64| (low + (high - low) * stream.uniform()) as f32;
        let mut of_structure = [0.0; 256];
        let (with_contrast, with_bone) = (stream.uniform() < 0.5, stream.uniform() < 0.4);
        let of_bone = between(stream, -90.0, 90.0);
        for (structure, change) in of_structure.iter_mut().enumerate().take(usize::from(METAL)).skip(1) {
            let (is_filled, contrast) = (stream.uniform() < 0.25, between(stream, 40.0, 350.0));
            if bones.contains(&(structure as u8)) {
                *change = if with_bone { of_bone } else { 0.0 };
            } else if with_contrast && is_filled && !is_phantom {
                *change = contrast;
            }
        }
        let is_noisy = stream.uniform() < 0.5;
        Self {
            gain: between(stream, 0.95, 1.05),
            shift_hu: between(stream, -20.0, 20.0),
            noise_hu: if is_noisy { between(stream, 0.0, 45.0) } else { 0.0 },
            of_structure,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::infer::materials::MaterialsArchitecture;
    use crate::learn::materials::phantom;
    use crate::random::Purpose;

    #[test]
    fn a_patch_is_that_of_its_stream_and_its_shares_are_whole() {
        let specimen = phantom(5, &[], String::new());
        let pass = &MaterialsArchitecture::Default.passes()[0];
        let prepared = Prepared::new(&specimen, pass);
        let draw = |number: u32, changed: bool| prepared.patch(pass, &mut Stream::new(1, 1, number, Purpose::Epoch), changed);
        for changed in [false, true] {
            let patch = draw(3, changed);
            assert!(patch == draw(3, changed) && patch != draw(4, changed));
            let points = pass.points();
            assert_eq!((patch.windows.len(), patch.truth.len(), patch.weight.len()), (2 * points, 3 * points, points));
            for at in 0..points {
                let shares: [f32; 3] = std::array::from_fn(|class| patch.truth[class * points + at]);
                assert!(
                    (shares.iter().sum::<f32>() - 1.0).abs() < 1e-4 && shares.iter().all(|share| *share > -1e-4),
                    "{shares:?}"
                );
            }
            assert!(patch.truth[BONE * points..].iter().any(|share| *share > 0.9));
        }
    }

    #[test]
    fn truth_lies_where_the_numbers_do() {
        // Unchanged patches: where a point is nearly all bone it is dense, and air is thin.
        let specimen = phantom(5, &[], String::new());
        let pass = &MaterialsArchitecture::Default.passes()[1];
        let prepared = Prepared::new(&specimen, pass);
        let points = pass.points();
        let (mut bone, mut tissue) = (Vec::new(), Vec::new());
        for number in 0..4 {
            let patch = prepared.patch(pass, &mut Stream::new(1, 2, number, Purpose::Epoch), false);
            for at in 0..points {
                let hu = 1000.0 * patch.windows[at];
                match [AIR, SOFT, BONE].map(|class| patch.truth[class * points + at] > 0.99) {
                    [true, ..] => assert!(hu < -600.0, "{hu}"),
                    [_, true, _] => tissue.push(hu),
                    [.., true] => bone.push(hu),
                    _ => {}
                }
            }
        }
        let mean = |values: &[f32]| values.iter().sum::<f32>() / values.len() as f32;
        assert!(mean(&bone) > mean(&tissue) + 50.0, "{} {}", mean(&bone), mean(&tissue));
    }
}
