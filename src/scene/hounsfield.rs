//! Numbers that hardly are Hounsfield units, and grids that hardly show anatomy: said, and taken as they are.

use rayon::prelude::*;

use super::density::DensityCurve;
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
/// Below any matter; noise, the ringing of an interpolation at an edge and metal's streaks go below, the fewer voxels the deeper.
const NOTHING_HU: f32 = -1200.0;
/// Wrong bits, bytes or a wrong scale have as many values below this as between the two.
const DEEP_HU: usize = 1600;
/// Above bone and what twelve bits hold with an intercept of -1024.
const TWELVE_BITS_HU: f32 = 3071.0;
/// So many voxels at that end are no accident.
const MANY_CLIPPED: usize = 20;
/// Values below [`NOTHING_HU`] are counted by whole numbers down to this; those below count as one.
const LOWEST_HU: usize = 1 << 16;
/// Voxels that are counted at once.
const CHUNK: usize = 1 << 22;
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
    below: usize,
}

impl Spread {
    const NOTHING: Self = Self {
        low: f32::INFINITY,
        high: f32::NEG_INFINITY,
        whole: true,
        air: 0,
        air_below: 0,
        tissue_above: 0,
        dense: 0,
        below: 0,
    };

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
            below: self.below + usize::from(value < NOTHING_HU),
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
            below: self.below + other.below,
        }
    }
}

/// What the values of a CT say of it.
pub(super) struct Heard {
    pub highest_hu: f32,
    /// What to doubt: a kind and words each.
    pub doubts: Vec<(&'static str, String)>,
    /// What to know.
    pub note: Option<String>,
}

/// Values below [`NOTHING_HU`] by whole numbers: how many different ones there are, which is the most common, how many voxels have it, how
/// many the next, and how many have others that are deep.
struct Below {
    different: usize,
    usual_hu: f32,
    usual: usize,
    second: usize,
    deep: usize,
}

impl Below {
    fn of(values: &[f32]) -> Self {
        let counted = |chunk: &[f32]| {
            let mut counts = vec![0usize; LOWEST_HU];
            for value in chunk.iter().filter(|value| **value < NOTHING_HU) {
                // The cast ends at zero and at the largest number.
                counts[(-value.round() as usize).min(LOWEST_HU - 1)] += 1;
            }
            counts
        };
        let none = || vec![0usize; LOWEST_HU];
        let add = |a: Vec<usize>, b: Vec<usize>| a.iter().zip(&b).map(|(a, b)| a + b).collect::<Vec<usize>>();
        let counts = values.par_chunks(CHUNK).map(counted).reduce(none, add);
        let different = counts.iter().filter(|count| **count > 0).count();
        let (hu, usual) = counts.iter().enumerate().max_by_key(|(_, count)| **count).map_or((0, 0), |(hu, count)| (hu, *count));
        let deep = counts[DEEP_HU..].iter().sum::<usize>() - if hu >= DEEP_HU { usual } else { 0 };
        let others = counts.iter().enumerate().filter(|(other, _)| *other != hu);
        let second = others.map(|(_, count)| *count).max().unwrap_or(0);
        Self { different, usual_hu: -(hu as f32), usual, second, deep }
    }
}

/// What `ct` says of itself.
#[must_use]
pub(super) fn heard(ct: &VolumeFile) -> Heard {
    let spread =
        ct.values.par_iter().fold(|| Spread::NOTHING, |all, value| all.with(*value)).reduce(|| Spread::NOTHING, Spread::and);
    let Spread { low, high, .. } = spread;
    let share = |count: usize| count as f64 / ct.values.len() as f64;
    let below = (share(spread.below) > NONE).then(|| Below::of(&ct.values));
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
        below.as_ref().and_then(|below| damage(below, &spread, ct.values.len()))
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
    let note = below.as_ref().filter(|_| share(spread.air) < NONE).and_then(|below| outside(below, ct.values.len()));
    Heard { highest_hu: high, doubts, note }
}

/// What to say of voxels beyond the twelve bits of most scanners, or many at their end: metal, which the density curve takes for bone.
#[must_use]
pub(super) fn metal(values: &[f32]) -> Option<String> {
    let above = values.par_iter().filter(|value| **value > TWELVE_BITS_HU).count();
    let at_end = values.par_iter().filter(|value| **value == TWELVE_BITS_HU).count();
    if above > 0 {
        let highest = values.par_iter().copied().reduce(|| f32::NEG_INFINITY, f32::max);
        let density = DensityCurve::shipped().density_g_per_cm3(f64::from(highest));
        return Some(format!(
            "{above} voxels are above {TWELVE_BITS_HU} HU (up to {highest}), as metal is; without labels they count as bone, of up to {density:.1} \
             g/cm3: metal as an object of its own displaces them"
        ));
    }
    (at_end >= MANY_CLIPPED).then(|| {
        format!("{at_end} voxels are at {TWELVE_BITS_HU} HU, where scanners clip: metal there is denser than its number says, and counts as bone")
    })
}

/// What to say of many values where no matter is. One or two are padding, and what lies between padding and matter an interpolation left at
/// its edge: fewer voxels than the padding has, and air stays where it is.
fn damage(below: &Below, spread: &Spread, voxels: usize) -> Option<String> {
    let others = spread.below.saturating_sub(below.usual);
    let is_scaled = (spread.air as f64) < NONE * voxels as f64 && spread.high > TWELVE_BITS_HU;
    let is_deep = below.deep as f64 > NONE * voxels as f64 && 2 * below.deep > others;
    let is_damage = is_deep && (others - below.second > below.usual || is_scaled);
    let (count, low, different) = (spread.below, spread.low, below.different);
    is_damage.then(|| {
        format!(
            "{count} voxels have {different} different values below {NOTHING_HU} HU (down to {low}), where no matter is: are stored bits, \
             byte order and rescale right?"
        )
    })
}

/// What to say where air is no air by its number.
fn outside(below: &Below, voxels: usize) -> Option<String> {
    let share = below.usual as f64 / voxels as f64;
    let is_unknown = f64::from(below.usual_hu) <= DensityCurve::shipped().unknown_at_most_hu;
    (is_unknown && share > MUCH).then(|| {
        format!(
            "hardly a voxel is near -1000 HU, and the {:.0} % at {} HU count as outside of the scan, not as air: pixels that look through them \
             are invalid; set them to -1000 if they are air",
            100.0 * share,
            below.usual_hu
        )
    })
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
            let found = heard(&ct([8, 4, 4], [1.0; 3], value)).doubts;
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

    /// Bits, bytes or a scale read wrong leave values all over the range below air; they passed for padding, one and all.
    #[test]
    fn many_values_where_no_matter_is_are_damage_and_padding_is_none() {
        let words = |value: &dyn Fn(usize) -> f32| {
            let found = heard(&ct([16, 16, 8], [1.0; 3], value)).doubts;
            found.into_iter().map(|(_, words)| words).collect::<Vec<_>>()
        };
        let noise = |n: usize| (n * 37 % 23) as f32 - 11.0;
        let padded = |n: usize| [-3024.0, -2000.0, hu(n)][n % 3];
        // An interpolation between padding and air, and its ringing.
        let rim = |n: usize| if n.is_multiple_of(16) { -1030.0 - 120.0 * (n / 16 % 18) as f32 } else { padded(n) };
        let ringing = |n: usize| hu(n) + if n.is_multiple_of(3) { 30.0 * noise(n) } else { 0.0 };
        for quiet in [&padded as &dyn Fn(usize) -> f32, &rim, &ringing] {
            assert_eq!(words(quiet), Vec::<String>::new());
        }
        let swapped = |n: usize| f32::from(((hu(n) + noise(n)) as i16).swap_bytes());
        let wrapped = |n: usize| if n.is_multiple_of(40) { -2900.0 + 7.0 * (n / 40 % 19) as f32 } else { hu(n) };
        let tenfold = |n: usize| 10.0 * (hu(n) + noise(n));
        let flat_tenfold = |n: usize| if n.is_multiple_of(20) { -8500.0 } else { 10.0 * [-1000.0, 40.0, 900.0][n % 3] };
        for damaged in [&swapped as &dyn Fn(usize) -> f32, &wrapped, &tenfold, &flat_tenfold] {
            let found = words(damaged);
            assert!(found.len() == 1 && found[0].contains("different values below -1200 HU"), "{found:?}");
        }
    }

    #[test]
    fn air_that_is_padding_by_its_number_is_noted() {
        let note = |value: &dyn Fn(usize) -> f32| heard(&ct([8, 8, 8], [1.0; 3], value)).note;
        let air = |hu: f32| move |n: usize| [hu, hu, hu, 40.0, 50.0, 900.0][n % 6];
        let words = note(&air(-3024.0)).expect("noted");
        assert!(words.contains("50 % at -3024 HU count as outside of the scan"), "{words}");
        assert_eq!(note(&air(-1000.0)), None, "the control");
        assert_eq!(note(&air(-1300.0)), None, "not known to be padding");
        assert_eq!(note(&|n| if n.is_multiple_of(3) { -3024.0 } else { hu(n) }), None, "air beside padding");
    }

    /// 30000 HU were taken for bone of 16.7 g/cm3 without a word.
    #[test]
    fn metal_is_said_and_bone_is_not() {
        let with = |value: f32, count: usize| metal(&(0..512).map(|n| if n < count { value } else { hu(n) }).collect::<Vec<_>>());
        assert_eq!((with(3070.0, 100), with(3071.0, 5)), (None, None), "the controls");
        let words = with(30000.0, 3).expect("said");
        assert!(words.starts_with("3 voxels are above 3071 HU (up to 30000)") && words.contains("16.7 g/cm3"), "{words}");
        let words = with(3071.0, 100).expect("said");
        assert!(words.starts_with("100 voxels are at 3071 HU, where scanners clip"), "{words}");
    }

    #[test]
    fn a_slice_and_thick_slices_are_said() {
        let kinds = |size, spacing_mm| heard(&ct(size, spacing_mm, hu)).doubts.iter().map(|(kind, _)| *kind).collect::<Vec<_>>();
        assert_eq!(kinds([8, 8, 2], [0.7, 0.7, 3.0]), Vec::<&str>::new(), "the control");
        assert_eq!(kinds([8, 8, 1], [0.7, 0.7, 3.0]), ["single slice"]);
        assert_eq!(kinds([64, 1, 1], [0.7, 0.7, 3.0]), Vec::<&str>::new());
        assert_eq!(kinds([8, 8, 2], [0.7, 0.7, 5.0]), ["coarse CT"]);
    }
}
