//! Numbers that hardly are Hounsfield units, and grids that hardly show anatomy: said, and taken as they are.

use rayon::prelude::*;

use super::volumes::VolumeFile;

/// Anything in g/cm³, and any attenuation per cm, is below; without metal, and by how much noise and padding may be negative.
const MOST_DENSITY: f32 = 25.0;
const USUAL_DENSITY: f32 = 4.5;
const MOST_FRACTION: f32 = 2.0;
/// What a picture of 8 bits holds.
const EIGHT_BITS: f32 = 255.0;
/// Where water, muscle and fat are, HU; and by how much a scale without its intercept, or with it twice, is off.
const TISSUE_HU: f32 = 200.0;
const INTERCEPT_HU: f32 = 1024.0;
/// Air, and how far a scanner has it from there: padding is farther off.
const AIR_HU: f32 = -1000.0;
const AIR_WITHIN_HU: f32 = 15.0;
/// Next to nothing, something, plenty: shares of the voxels.
const NONE: f64 = 1e-3;
const SOME: f64 = 0.02;
const MUCH: f64 = 0.15;
/// Of what is denser than any tissue, the share that lies where tissue is without the intercept: bone spreads wider.
const DENSE_HU: f32 = 300.0;
const MOST_OF_IT: f64 = 0.7;
/// Voxels in which cortical bone is not seen any more.
const COARSE_MM: f64 = 4.0;

/// What of a CT's voxels is looked at.
#[derive(Clone, Copy, Debug, PartialEq)]
struct Spread {
    low: f32,
    high: f32,
    whole: bool,
    air: usize,
    air_below: usize,
    tissue_above: usize,
    dense: usize,
}

impl Spread {
    const NOTHING: Self =
        Self { low: f32::INFINITY, high: f32::NEG_INFINITY, whole: true, air: 0, air_below: 0, tissue_above: 0, dense: 0 };

    fn with(self, value: f32) -> Self {
        let near = |hu: f32, within: f32| usize::from((value - hu).abs() <= within);
        Self {
            low: self.low.min(value),
            high: self.high.max(value),
            whole: self.whole && value.fract() == 0.0,
            air: self.air + near(AIR_HU, AIR_WITHIN_HU),
            air_below: self.air_below + near(AIR_HU - INTERCEPT_HU, AIR_WITHIN_HU),
            tissue_above: self.tissue_above + near(INTERCEPT_HU, TISSUE_HU),
            dense: self.dense + usize::from(value > DENSE_HU),
        }
    }

    fn and(self, other: Self) -> Self {
        Self {
            low: self.low.min(other.low),
            high: self.high.max(other.high),
            whole: self.whole && other.whole,
            air: self.air + other.air,
            air_below: self.air_below + other.air_below,
            tissue_above: self.tissue_above + other.tissue_above,
            dense: self.dense + other.dense,
        }
    }
}

/// The highest value of `ct`, and what to doubt about it: a kind and words each.
#[must_use]
pub(super) fn doubts(ct: &VolumeFile) -> (f32, Vec<(&'static str, String)>) {
    let spread =
        ct.values.par_iter().fold(|| Spread::NOTHING, |all, value| all.with(*value)).reduce(|| Spread::NOTHING, Spread::and);
    let Spread { low, high, .. } = spread;
    let share = |count: usize| count as f64 / ct.values.len() as f64;
    // Whole numbers so small may be anything.
    let is_density = (low >= 0.0 && high <= MOST_DENSITY) || (low >= -USUAL_DENSITY && high <= USUAL_DENSITY);
    let is_small = (is_density && !spread.whole) || (low >= 0.0 && high <= MOST_FRACTION);
    let scale = if is_small && high > 0.0 {
        Some(format!("values from {low} to {high} hardly are Hounsfield numbers: densities, fractions or attenuation?"))
    } else if spread.whole && low >= 0.0 && high > 0.5 * EIGHT_BITS && high <= EIGHT_BITS {
        Some(format!("whole numbers from {low} to {high} hardly are Hounsfield numbers: grey levels of 8 bits?"))
    } else if low >= 0.0 && high > 900.0 {
        Some(format!("no value below 0 HU (up to {high}): was the rescale of -1024 left out?"))
    } else if share(spread.air) < NONE
        && share(spread.tissue_above) > SOME
        && spread.tissue_above as f64 > MOST_OF_IT * spread.dense as f64
    {
        Some("no air near -1000 HU, but much near 1024: was the rescale of -1024 left out?".to_owned())
    } else if share(spread.air_below) > MUCH {
        // Tissue then lies where air does.
        Some("much lies near -2024 HU, where air is after a rescale of -1024 that was applied twice".to_owned())
    } else {
        None
    };
    let mut doubts: Vec<_> = scale.map(|words| ("not HU", words)).into_iter().collect();
    let spacing_mm = ct.spacing_mm;
    // A row of voxels is nobody's slice.
    let alone: Vec<usize> = (0..3).filter(|axis| ct.size[*axis] == 1).collect();
    if let [axis] = alone[..] {
        let mm = spacing_mm[axis];
        doubts.push(("single slice", format!("one slice only: it is taken as {mm} mm thick, with nothing known on either side")));
    }
    let coarse = spacing_mm.iter().copied().fold(0.0, f64::max);
    if coarse > COARSE_MM {
        let words = format!("voxels of {coarse:.1} mm: thin bone is spread over them and partly counts as soft tissue");
        doubts.push(("coarse CT", words));
    }
    (high, doubts)
}

#[cfg(test)]
mod tests {
    use glam::{DAffine3, DMat3, DVec3};

    use super::*;
    use crate::scene::volumes::PlacedBy;

    fn ct(size: [usize; 3], spacing_mm: [f64; 3], value: impl Fn(usize) -> f32) -> VolumeFile {
        VolumeFile {
            size,
            lps_from_voxel: DAffine3::from_mat3(DMat3::from_diagonal(DVec3::from_array(spacing_mm))),
            values: (0..size.iter().product()).map(value).collect(),
            placed_by: PlacedBy::Sform,
            spacing_mm,
            label_names: Vec::new(),
        }
    }

    /// Air, tissue and bone, as a CT of HU has them.
    fn hu(n: usize) -> f32 {
        [-1000.0, -990.5, 40.0, 55.0, -90.0, 30.0, 20.0, 900.0][n % 8]
    }

    #[test]
    fn numbers_that_are_no_hounsfield_units_are_doubted_by_what_they_look_like() {
        let words = |value: &dyn Fn(usize) -> f32| {
            let (_, found) = doubts(&ct([8, 4, 4], [1.0; 3], value));
            found.iter().map(|(kind, words)| format!("{kind}: {words}")).collect::<Vec<_>>()
        };
        assert_eq!(words(&hu), Vec::<String>::new(), "the control");
        assert_eq!(words(&|n| hu(n).max(0.0) / 9.0), Vec::<String>::new(), "water and plastic in a bath");
        let padded = |n: usize| if n.is_multiple_of(3) { -2000.0 } else { hu(n) };
        assert_eq!(words(&padded), Vec::<String>::new(), "padding is no shift");
        let bone = |n: usize| if n.is_multiple_of(4) { (380 + 97 * n % 1400) as f32 } else { -1024.0 };
        assert_eq!(words(&bone), Vec::<String>::new(), "a bone cut out");
        let knee = |n: usize| if n.is_multiple_of(7) { hu(n / 7) + 1024.0 } else { 24.0 };
        for (value, part) in [
            (&knee as &dyn Fn(usize) -> f32, "left out"),
            (&|n| (hu(n) + 1000.0) / 5000.0 - 0.01, "attenuation"),
            (&|n| if n.is_multiple_of(5) { -2000.0 } else { knee(n) }, "left out"),
            (&(|n| (hu(n) + 1000.0) / 1000.0) as &dyn Fn(usize) -> f32, "densities, fractions"),
            (&|n| (n * 37 % 256) as f32, "8 bits"),
            (&|n| hu(n) + 1024.0, "left out"),
            (&|n| if n.is_multiple_of(50) { -1024.0 } else { hu(n) + 1024.0 }, "left out"),
            (&|n| hu(n) - 1024.0, "applied twice"),
        ] {
            let found = words(value);
            assert!(found.len() == 1 && found[0].starts_with("not HU") && found[0].contains(part), "{part}: {found:?}");
        }
    }

    #[test]
    fn a_slice_and_thick_slices_are_said() {
        let kinds = |size, spacing_mm| doubts(&ct(size, spacing_mm, hu)).1.iter().map(|(kind, _)| *kind).collect::<Vec<_>>();
        assert_eq!(kinds([8, 8, 2], [0.7, 0.7, 3.0]), Vec::<&str>::new(), "the control");
        assert_eq!(kinds([8, 8, 1], [0.7, 0.7, 3.0]), ["single slice"]);
        assert_eq!(kinds([64, 1, 1], [0.7, 0.7, 3.0]), Vec::<&str>::new());
        assert_eq!(kinds([8, 8, 2], [0.7, 0.7, 5.0]), ["coarse CT"]);
    }
}
