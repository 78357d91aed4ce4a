//! From voxels to matter: classes by threshold or label, densities by the curve.

use std::path::Path;

use rayon::prelude::*;

use super::SceneError;
use super::ambient::AmbientAir;
use super::density::{DensityCurve, ThresholdClass};
use super::model::Volume;
use super::volumes::VolumeFile;

/// A class of voxels: what its voxels are made of, and where their density comes from.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Class {
    /// Index into whatever list the caller numbers materials by.
    pub material: usize,
    /// Density of every voxel; from the Hounsfield number if absent.
    pub density_g_per_cm3: Option<f64>,
}

/// How voxels find their class.
#[derive(Clone, Debug)]
pub(super) struct Classes {
    /// Up to the upper threshold, lung and gas included; `None`: nothing.
    pub soft_tissue: Option<Class>,
    /// Above, or where a network saw it.
    pub bone: Option<Class>,
    /// Which voxels are bone, where no threshold says it.
    pub seen_bone: Option<Vec<bool>>,
    /// Labels, which go before thresholds.
    pub labelled: Option<Labelled>,
}

/// Voxels whose class does not hang on their Hounsfield number.
#[derive(Clone, Debug)]
pub(super) struct Labelled {
    /// Label of each voxel.
    pub numbers: Vec<u32>,
    /// Named labels, ascending. A named label is what it is named whatever its Hounsfield number (lung is thin), `None`: nothing.
    pub map: Vec<(u32, Option<Class>)>,
}

/// What becomes of voxels below the air threshold that no label names.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) enum Air {
    /// All of them are nothing.
    Drop,
    /// Room air is nothing; what is within the body keeps its density, as soft tissue.
    DropAmbient,
    /// Room air is of this class.
    Keep(Class),
}

/// Turns a CT into densities and classes; with it go the classes that occur, the only ones to keep a number, in the order in which they
/// are given, and the number of slices whose room air is doubtful ([`AmbientAir::doubtful_slices`]).
///
/// # Errors
/// When there are more classes than fit.
pub(super) fn from_ct(
    place: &str,
    ct: VolumeFile,
    classes: &Classes,
    air: Air,
) -> Result<(Volume, Vec<Class>, usize), SceneError> {
    let curve = DensityCurve::shipped();
    let kept_air = if let Air::Keep(class) = air { Some(class) } else { None };
    let labels = classes.labelled.as_ref();
    let mapped = labels.iter().flat_map(|labelled| labelled.map.iter().filter_map(|(_, class)| *class));
    let mut order: Vec<Class> = Vec::new();
    for class in [kept_air, classes.soft_tissue, classes.bone].into_iter().flatten().chain(mapped) {
        if !order.contains(&class) {
            order.push(class);
        }
    }
    if order.len() > 255 {
        return Err(SceneError::TooManyClasses { place: place.to_owned(), found: order.len() });
    }
    let number = |class: Option<Class>| {
        class.and_then(|class| order.iter().position(|known| *known == class)).map_or(0, |index| index as u8 + 1)
    };
    let (air_number, soft, bone) = (number(kept_air), number(classes.soft_tissue), number(classes.bone));
    let known: Vec<(u32, u8)> = labels
        .iter()
        .flat_map(|labelled| labelled.map.iter())
        .map(|(label, class)| (*label, class.map_or(air_number, |class| number(Some(class)))))
        .collect();
    let named = |index: usize| {
        let label = labels?.numbers[index];
        known.binary_search_by_key(&label, |(known, _)| *known).ok().map(|at| known[at].1)
    };
    let ambient = (air != Air::Drop && ct.values.par_iter().any(|hu| curve.class(f64::from(*hu)) == ThresholdClass::Thin))
        .then(|| AmbientAir::find(&ct.grid(), &ct.values, curve.air_below_hu, &|index| named(index).is_some()));
    let by_threshold = |index: usize, hu: f64| match curve.class(hu) {
        ThresholdClass::Thin if ambient.as_ref().is_none_or(|ambient| ambient.holds(index)) => air_number,
        ThresholdClass::Thin => soft,
        ThresholdClass::SoftTissue | ThresholdClass::Bone => match &classes.seen_bone {
            Some(seen) if seen[index] => bone,
            Some(_) => soft,
            None if curve.class(hu) == ThresholdClass::Bone => bone,
            None => soft,
        },
    };
    // Labels name what is there; dropped air is not, lungs neither.
    let dropped = |hu: f64| air == Air::Drop && curve.class(hu) == ThresholdClass::Thin;
    let classify = |index: usize, hu: f64| match named(index) {
        Some(class) if !dropped(hu) => class,
        _ => by_threshold(index, hu),
    };
    let mut class = vec![0u8; ct.values.len()];
    let mut density = ct.values;
    let is_unknown = |value: f32| f64::from(value) <= curve.unknown_at_most_hu;
    let unknown = if density.par_iter().any(|value| is_unknown(*value)) {
        density.par_iter().map(|value| is_unknown(*value)).collect()
    } else {
        Vec::new()
    };
    density.par_iter_mut().zip(class.par_iter_mut()).enumerate().for_each(|(index, (value, class))| {
        let hu = f64::from(*value);
        // What was not reconstructed is air, whatever a label says of it.
        *class = if is_unknown(*value) { air_number } else { classify(index, hu) };
        let fixed = class.checked_sub(1).map(|index| order[usize::from(index)].density_g_per_cm3);
        *value = match fixed {
            None => 0.0,
            Some(fixed) => fixed.unwrap_or_else(|| curve.density_g_per_cm3(hu)) as f32,
        };
    });
    let doubtful_slices = ambient.as_ref().map_or(0, |ambient| ambient.doubtful_slices);
    let order = keep_occurring(&mut class, order);
    let volume = Volume {
        size: ct.size,
        lps_from_voxel: ct.lps_from_voxel,
        density_g_per_cm3: density,
        class,
        class_materials: order.iter().map(|class| class.material).collect(),
        truncated_at_faces: true,
        unknown,
    };
    Ok((volume, order, doubtful_slices))
}

/// Drops classes without voxels and renumbers the others: a scene's materials are those that are there.
fn keep_occurring(class: &mut [u8], order: Vec<Class>) -> Vec<Class> {
    let occurs = class
        .par_chunks(1 << 16)
        .map(|chunk| {
            let mut seen = [false; 256];
            chunk.iter().for_each(|class| seen[usize::from(*class)] = true);
            seen
        })
        .reduce(|| [false; 256], |a, b| std::array::from_fn(|i| a[i] || b[i]));
    let mut renumbered = [0u8; 256];
    let mut kept = Vec::new();
    for (index, entry) in order.into_iter().enumerate() {
        if occurs[index + 1] {
            kept.push(entry);
            renumbered[index + 1] = kept.len() as u8;
        }
    }
    class.par_iter_mut().for_each(|class| *class = renumbered[usize::from(*class)]);
    kept
}

/// Turns volume fractions into densities of one material.
///
/// # Errors
/// When a fraction lies outside 0–1 (by more than rounding).
pub(super) fn from_fractions(
    path: &Path,
    file: VolumeFile,
    material: usize,
    density_g_per_cm3: f64,
) -> Result<Volume, SceneError> {
    const ROUNDING: f32 = 1e-3;
    let outside = file.values.par_iter().filter(|fraction| !(-ROUNDING..=1.0 + ROUNDING).contains(*fraction)).count();
    if outside > 0 {
        let detail =
            format!("{outside} of {} volume fractions lie outside 0 to 1; scale the file to fractions", file.values.len());
        return Err(SceneError::Volume { path: path.to_owned(), detail });
    }
    let class = file.values.par_iter().map(|fraction| u8::from(*fraction > 0.0)).collect();
    let mut density = file.values;
    density.par_iter_mut().for_each(|value| *value = (f64::from(value.clamp(0.0, 1.0)) * density_g_per_cm3) as f32);
    Ok(Volume {
        size: file.size,
        lps_from_voxel: file.lps_from_voxel,
        density_g_per_cm3: density,
        class,
        class_materials: vec![material],
        truncated_at_faces: false,
        unknown: Vec::new(),
    })
}

/// Labels on the grid of the CT, whatever the order of their axes.
///
/// # Errors
/// When size or place differ, or a value is no label.
pub(super) fn labels_on_grid(
    (ct_path, ct): (&Path, &VolumeFile),
    (labels_path, labels): (&Path, VolumeFile),
) -> Result<Vec<u32>, SceneError> {
    let labels = labels.in_order_of(&ct.grid());
    let differ = |detail: String| SceneError::Grid { labels: labels_path.to_owned(), ct: ct_path.to_owned(), detail };
    if labels.size != ct.size {
        return Err(differ(format!("size {:?}, the CT has {:?}", labels.size, ct.size)));
    }
    let last = glam::DVec3::from_array(ct.size.map(|n| n as f64 - 1.0));
    let corner = |bits: u32| glam::DVec3::new(f64::from(bits & 1), f64::from(bits >> 1 & 1), f64::from(bits >> 2)) * last;
    let apart = |bits| {
        let point = corner(bits);
        ct.lps_from_voxel.transform_point3(point).distance(labels.lps_from_voxel.transform_point3(point))
    };
    let worst_mm = (0..8).map(apart).fold(0.0, f64::max);
    let limit_mm = 0.02 * ct.spacing_mm.iter().copied().fold(f64::INFINITY, f64::min);
    if !(worst_mm <= limit_mm) {
        return Err(differ(format!("a corner lies {worst_mm:.3} mm apart, limit {limit_mm:.3} mm")));
    }
    let wrong = labels.values.par_iter().filter(|v| !(**v >= 0.0 && **v <= 16_777_215.0 && v.fract() == 0.0)).count();
    if wrong > 0 {
        let detail = format!("{wrong} voxels are no labels; expected whole numbers from 0 up");
        return Err(SceneError::Volume { path: labels_path.to_owned(), detail });
    }
    Ok(labels.values.par_iter().map(|value| *value as u32).collect())
}
