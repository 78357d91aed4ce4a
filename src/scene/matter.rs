//! From voxels to matter: classes by threshold or label, densities by the curve.

use std::path::Path;

use rayon::prelude::*;

use super::SceneError;
use super::density::{DensityCurve, ThresholdClass};
use super::foreign_files::VolumeFile;
use super::model::Volume;
use crate::reporter::Reporter;

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
pub(super) enum Classes {
    /// By Hounsfield number.
    Threshold {
        /// Between the thresholds.
        soft_tissue: Class,
        /// Above.
        bone: Class,
    },
    /// By label.
    Labels {
        /// Label of each voxel.
        labels: Vec<u32>,
        /// Labels that are not named, where they are not air by threshold.
        default: Class,
        /// Named labels, ascending. A named label is what it is named whatever its Hounsfield number (lung is thin), `None`: nothing.
        map: Vec<(u32, Option<Class>)>,
    },
}

/// Turns a CT into densities and classes. Only classes that occur keep a number, in the order of `order`.
/// `air`: the class of air that is kept as matter, `None` where air is nothing.
///
/// # Errors
/// When there are more classes than fit.
pub(super) fn from_ct(
    place: &str,
    ct: VolumeFile,
    classes: &Classes,
    air: Option<Class>,
) -> Result<(Volume, Vec<Class>), SceneError> {
    let curve = DensityCurve::shipped();
    let mut order: Vec<Class> = air.into_iter().collect();
    match classes {
        Classes::Threshold { soft_tissue, bone } => order.extend([*soft_tissue, *bone]),
        Classes::Labels { default, map, .. } => {
            for class in std::iter::once(*default).chain(map.iter().filter_map(|(_, class)| *class)) {
                if !order.contains(&class) {
                    order.push(class);
                }
            }
        }
    }
    if order.len() > 255 {
        return Err(SceneError::TooManyClasses { place: place.to_owned(), found: order.len() });
    }
    let number = |class: Class| order.iter().position(|known| *known == class).map_or(0, |index| index as u8 + 1);
    let air_number = air.map_or(0, number);
    let by_threshold = |hu: f64, soft: u8, bone: u8| match curve.class(hu) {
        ThresholdClass::Air => air_number,
        ThresholdClass::SoftTissue => soft,
        ThresholdClass::Bone => bone,
    };
    let classify: Box<dyn Fn(usize, f64) -> u8 + Sync> = match classes {
        Classes::Threshold { soft_tissue, bone } => {
            let (soft, bone) = (number(*soft_tissue), number(*bone));
            Box::new(move |_, hu| by_threshold(hu, soft, bone))
        }
        Classes::Labels { labels, default, map } => {
            let default = number(*default);
            let named: Vec<(u32, u8)> = map.iter().map(|(label, class)| (*label, class.map_or(air_number, number))).collect();
            Box::new(move |index, hu| {
                let label = labels[index];
                match named.binary_search_by_key(&label, |(known, _)| *known) {
                    Ok(at) => named[at].1,
                    Err(_) => by_threshold(hu, default, default),
                }
            })
        }
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
    drop(classify);
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
    Ok((volume, order))
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

/// Labels on the grid of the CT.
///
/// # Errors
/// When size or place differ, or a value is no label.
pub(super) fn labels_on_grid(
    (ct_path, ct): (&Path, &VolumeFile),
    (labels_path, labels): (&Path, VolumeFile),
) -> Result<Vec<u32>, SceneError> {
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

/// Warns where numbers hardly are Hounsfield units.
pub(super) fn check_hounsfield(path: &Path, ct: &VolumeFile, reporter: &Reporter) {
    let (low, high) = ct
        .values
        .par_iter()
        .fold(|| (f32::INFINITY, f32::NEG_INFINITY), |(low, high), v| (low.min(*v), high.max(*v)))
        .reduce(|| (f32::INFINITY, f32::NEG_INFINITY), |a, b| (a.0.min(b.0), a.1.max(b.1)));
    let shown = path.display();
    if low >= 0.0 && high <= 2.0 && high > 0.0 {
        reporter.warn(
            "not HU",
            format_args!("{shown}: values from {low} to {high} hardly are Hounsfield numbers: fractions or attenuation?"),
        );
    } else if low >= 0.0 && high > 900.0 {
        reporter.warn("not HU", format_args!("{shown}: no value below 0 HU (up to {high}): was the rescale of -1024 left out?"));
    }
}
