//! From the slices of a folder to one volume: which belong together, in which order, and whether they fill a grid. No file is opened here.

use std::collections::HashSet;

use glam::{DAffine3, DMat3, DVec3};

use super::ct_slice::{CtHead, FileHead, SliceHead};
use super::head::{PlacedBy, Remark, VolumeFormat, VolumeHead, check_place, check_size};
use super::one_scan::{check_one_scan, left_out, same_images};
use crate::foreign::Limits;

/// A series in order.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct Series {
    pub head: VolumeHead,
    /// Files in the order in which they are read, by their index among those that were looked at, and the slices of each, by theirs in it.
    pub files: Vec<(usize, Vec<usize>)>,
}

/// Slices closer than this lie at one place.
const SAME_PLACE_MM: f64 = 1e-3;
/// From this many times the usual distance on, slices are missing.
const GAP: f64 = 1.5;
/// How far a slice may lie from its place on the grid: positions are written with one decimal or more.
const OFF_GRID_MM: f64 = 0.06;
/// The same as a share of the distance of slices, where that is more.
const OFF_GRID_SHARE: f64 = 0.05;
/// From this on it is said.
const OFF_GRID_SAID_MM: f64 = 0.01;
/// Slices that are stacked at a slant of more than this, and more than [`OFF_GRID_MM`] from first to last, are those of a tilted gantry.
const TILT_DEG: f64 = 0.1;
/// Series of a folder that are listed.
const MOST_LISTED: usize = 6;
/// Slices agree in direction and pitch within this.
const AGREE: f64 = 1e-4;

/// Finds the series that is meant: the only one, or that of the file `named`. `names` says how each file may be called.
///
/// # Errors
/// One sentence: several series, or slices that are no volume.
pub(super) fn arrange(
    files: &[FileHead],
    named: Option<usize>,
    names: &dyn Fn(usize) -> String,
    limits: &Limits,
) -> Result<Series, String> {
    let damaged = files.iter().filter(|file| matches!(file, FileHead::Damaged)).count();
    let chosen = match named {
        Some(index) => match &files[index] {
            FileHead::Ct(head) => head.series.as_str(),
            FileHead::Localizer => return Err("this is a localizer (scout), not a slice; name a slice of the CT".to_owned()),
            FileHead::Other => return Err("this DICOM file is no CT slice; name a slice of the CT".to_owned()),
            FileHead::Damaged => return Err("this DICOM file is damaged; copy it again".to_owned()),
        },
        None => only_series(files, names)?,
    };
    if damaged > 0 {
        let all = files.len();
        return Err(format!("{damaged} of {all} DICOM files of the folder are damaged: slices may be missing; copy it again"));
    }
    let (mut slices, mut places, mut of_series) = (Vec::new(), Vec::new(), Vec::new());
    for (file, head) in
        files.iter().enumerate().filter_map(|(index, file)| Some((index, ct(file)?))).filter(|(_, head)| head.series == chosen)
    {
        let heads = head.slices.as_ref().map_err(|lacks| format!("{} {lacks}; export the series again", names(file)))?;
        places.extend((0..heads.len()).map(|slice| (file, slice)));
        slices.extend(heads.iter());
        of_series.push(head);
    }
    let mut remarks = Vec::new();
    let left_out = files.iter().filter(|file| !matches!(file, FileHead::Ct(_))).count();
    if left_out > 0 {
        let localizers = files.iter().filter(|file| matches!(file, FileHead::Localizer)).count();
        remarks.push((None, format!("{left_out} DICOM files that are no slices are left out, {localizers} of them localizers")));
    }
    remarks.extend(check_one_scan(&of_series)?);
    check_alike(&slices)?;
    let order = order(&slices)?;
    remarks.extend(same_images(&slices));
    let lps_from_voxel = grid(&order.iter().map(|slice| slices[*slice]).collect::<Vec<_>>(), &mut remarks)?;
    check_place(&lps_from_voxel, PlacedBy::ImagePositions.words())?;
    let [columns, rows] = slices[0].size_px.map(|n| n as u64);
    let size = check_size([columns, rows, slices.len() as u64], limits)?;
    let mut head = VolumeHead {
        format: VolumeFormat::DicomSeries,
        size,
        lps_from_voxel,
        placed_by: PlacedBy::ImagePositions,
        data_type: "CT image".to_owned(),
        unit: "millimetre".to_owned(),
        remarks,
        label_names: Vec::new(),
    };
    head.doubt_spacing();
    Ok(Series { head, files: by_file(order.into_iter().map(|slice| places[slice]))? })
}

/// How many slices of `below` belong to the series that `chosen` of `files` are of, and are none of these.
pub(super) fn more_slices(files: &[FileHead], chosen: &[(usize, Vec<usize>)], below: &[FileHead]) -> usize {
    let known: Vec<&CtHead> = chosen.iter().filter_map(|(file, _)| ct(&files[*file])).collect();
    let Some(first) = known.first() else { return 0 };
    let images_known: HashSet<&str> = known.iter().flat_map(|head| images(head)).collect();
    let same_series = below.iter().filter_map(ct).filter(|head| head.series == first.series);
    same_series.flat_map(images).filter(|image| !images_known.contains(image)).count()
}

fn ct(file: &FileHead) -> Option<&CtHead> {
    if let FileHead::Ct(head) = file { Some(head) } else { None }
}

fn images(head: &CtHead) -> impl Iterator<Item = &str> {
    head.slices.iter().flatten().map(|slice| slice.image.as_str())
}

/// The series of a folder with one.
fn only_series<'a>(files: &'a [FileHead], names: &dyn Fn(usize) -> String) -> Result<&'a str, String> {
    let mut series: Vec<(&CtHead, usize, usize)> = Vec::new();
    for (index, file) in files.iter().enumerate() {
        let FileHead::Ct(head) = file else { continue };
        let slices = head.slices.as_ref().map_or(1, Vec::len);
        match series.iter_mut().find(|(known, ..)| known.series == head.series) {
            Some((_, count, _)) => *count += slices,
            None => series.push((head, slices, index)),
        }
    }
    match series[..] {
        [(only, ..)] => Ok(only.series.as_str()),
        [] => {
            let localizers = files.iter().filter(|file| matches!(file, FileHead::Localizer)).count();
            Err(match files.len() {
                0 => "the folder holds no DICOM file; name the folder that has the slices themselves".to_owned(),
                all => format!("the folder holds no CT slice ({all} DICOM files, {localizers} of them localizers)"),
            })
        }
        _ => {
            let one = |(head, slices, first): &(&CtHead, usize, usize)| {
                let number = head.series_number.map_or("without a number".to_owned(), |number| format!("number {number}"));
                let size = head.slices.as_ref().ok().and_then(|slices| slices.first()).map(|slice| slice.size_px);
                let size = size.map_or(String::new(), |[columns, rows]| format!(" of {columns} x {rows}"));
                format!("{number}: {slices} slices{size}, as {}", names(*first))
            };
            let mut listed: Vec<String> = series.iter().take(MOST_LISTED).map(one).collect();
            listed.extend((series.len() > MOST_LISTED).then(|| format!("and {} more", series.len() - MOST_LISTED)));
            Err(format!("the folder holds {} series ({}); name one file of the wanted one", series.len(), listed.join("; ")))
        }
    }
}

/// Size, pitch and direction of all slices are those of the first.
fn check_alike(slices: &[&SliceHead]) -> Result<(), String> {
    let Some((first, others)) = slices.split_first() else { return Err("it has no slice".to_owned()) };
    if others.is_empty() {
        return Err(
            "it is one slice, a volume needs two or more; name a folder or a file with the other slices beside it".to_owned()
        );
    }
    let differ = |what: &str, of: &dyn Fn(&SliceHead) -> String, alike: &dyn Fn(&SliceHead) -> bool| {
        let odd: Vec<&&SliceHead> = others.iter().filter(|slice| !alike(slice)).collect();
        odd.first().map_or(Ok(()), |slice| {
            let (all, count) = (slices.len(), odd.len());
            let (here, there) = (of(first), of(slice));
            Err(format!("its slices differ in {what}: {here} and {there} ({count} of {all}); export one reconstruction alone"))
        })
    };
    let size = |slice: &SliceHead| format!("{} x {} pixels", slice.size_px[0], slice.size_px[1]);
    differ("size", &size, &|slice| slice.size_px == first.size_px)?;
    let pitch = |slice: &SliceHead| format!("{} x {} mm", slice.pitch_mm[0], slice.pitch_mm[1]);
    let same = |a: f64, b: f64| (a / b - 1.0).abs() <= AGREE;
    differ("pixel spacing", &pitch, &|slice| (0..2).all(|axis| same(slice.pitch_mm[axis], first.pitch_mm[axis])))?;
    let turned = |slice: &SliceHead| {
        let of = |direction: DVec3| format!("{:.4} {:.4} {:.4}", direction.x, direction.y, direction.z);
        format!("[{}, {}]", of(slice.along_row), of(slice.along_column))
    };
    let parallel = |slice: &SliceHead| {
        slice.along_row.distance(first.along_row).max(slice.along_column.distance(first.along_column)) <= AGREE
    };
    differ("orientation", &turned, &parallel)
}

/// The slices by their place along the normal.
fn order(slices: &[&SliceHead]) -> Result<Vec<usize>, String> {
    let normal = normal(slices[0]);
    let place_mm = |slice: usize| slices[slice].first_pixel_in_lps.dot(normal);
    let mut order: Vec<usize> = (0..slices.len()).collect();
    order.sort_by(|a, b| place_mm(*a).total_cmp(&place_mm(*b)));
    let same: Vec<&[usize]> = order.windows(2).filter(|pair| !(place_mm(pair[1]) - place_mm(pair[0]) > SAME_PLACE_MM)).collect();
    if let Some(pair) = same.first() {
        let (all, count, at_mm) = (slices.len(), same.len(), place_mm(pair[0]));
        let copies = same.iter().all(|pair| slices[pair[0]].image == slices[pair[1]].image);
        let why = if copies { "they are copies; remove them" } else { "two phases or reconstructions in one; export one alone" };
        return Err(format!("{count} of its {all} slices lie at the place of another (the first at {at_mm:.2} mm): {why}"));
    }
    Ok(order)
}

fn normal(slice: &SliceHead) -> DVec3 {
    slice.along_row.cross(slice.along_column)
}

/// The grid of slices in order, from the first and the last of them.
fn grid(slices: &[&SliceHead], remarks: &mut Vec<Remark>) -> Result<DAffine3, String> {
    let (first, last) = (slices[0], slices[slices.len() - 1]);
    let normal = normal(first);
    let places_mm: Vec<f64> = slices.iter().map(|slice| slice.first_pixel_in_lps.dot(normal)).collect();
    check_gaps(&places_mm)?;
    let step = (last.first_pixel_in_lps - first.first_pixel_in_lps) / (slices.len() - 1) as f64;
    let along_mm = step.dot(normal);
    let aside_mm = (step - normal * along_mm).length();
    let tilt_deg = aside_mm.atan2(along_mm).to_degrees();
    if !(tilt_deg <= TILT_DEG || aside_mm * (slices.len() - 1) as f64 <= OFF_GRID_MM) {
        return Err(format!(
            "its slices are stacked at a slant of {tilt_deg:.1} deg, as a tilted gantry leaves them; resample it to a right-angled grid"
        ));
    }
    let off_mm =
        |(index, slice): (usize, &&SliceHead)| slice.first_pixel_in_lps.distance(first.first_pixel_in_lps + step * index as f64);
    let (worst, worst_mm) =
        slices.iter().enumerate().map(off_mm).enumerate().fold((0, 0.0), |a, b| if a.1 >= b.1 { a } else { b });
    let limit_mm = OFF_GRID_MM.max(OFF_GRID_SHARE * along_mm);
    if !(worst_mm <= limit_mm) {
        let at_mm = places_mm[worst];
        let gaps = places_mm.windows(2).map(|pair| pair[1] - pair[0]);
        let (least_mm, most_mm) = gaps.fold((f64::INFINITY, 0.0f64), |(least, most), gap| (least.min(gap), most.max(gap)));
        return Err(format!(
            "its slices are unevenly spaced: {least_mm:.3} to {most_mm:.3} mm apart, slice {} of {} (at {at_mm:.2} mm) lies {worst_mm:.2} \
             mm from its place in an even stack (limit {limit_mm:.2}); resample it",
            worst + 1,
            slices.len()
        ));
    }
    if worst_mm > OFF_GRID_SAID_MM {
        let words = format!("slices lie up to {worst_mm:.3} mm from their places in an even stack of {along_mm:.4} mm: rounding");
        remarks.push((None, words));
    }
    remarks.extend(left_out(slices, along_mm));
    let [across_mm, down_mm] = first.pitch_mm;
    let matrix3 = DMat3::from_cols(first.along_row * across_mm, first.along_column * down_mm, step);
    Ok(DAffine3 { matrix3, translation: first.first_pixel_in_lps })
}

/// Whether slices are missing between others.
fn check_gaps(places_mm: &[f64]) -> Result<(), String> {
    let gaps_mm: Vec<f64> = places_mm.windows(2).map(|pair| pair[1] - pair[0]).collect();
    let mut sorted = gaps_mm.clone();
    sorted.sort_by(f64::total_cmp);
    let usual_mm = sorted[(sorted.len() - 1) / 2];
    let wide: Vec<usize> = (0..gaps_mm.len()).filter(|gap| !(gaps_mm[*gap] <= GAP * usual_mm)).collect();
    let Some(gap) = wide.first() else { return Ok(()) };
    let missing: f64 = wide.iter().map(|gap| (gaps_mm[*gap] / usual_mm).round() - 1.0).sum();
    let more = if wide.len() > 1 { format!(", and {} more such gaps", wide.len() - 1) } else { String::new() };
    Err(format!(
        "slices are missing, about {missing}: {:.3} mm lie between slices {} and {} of {} (at {:.2} and {:.2} mm), {usual_mm:.3} mm \
         between others{more}; export the whole series",
        gaps_mm[*gap],
        gap + 1,
        gap + 2,
        places_mm.len(),
        places_mm[*gap],
        places_mm[gap + 1]
    ))
}

/// Slices in order, gathered by their file.
fn by_file(slices: impl Iterator<Item = (usize, usize)>) -> Result<Vec<(usize, Vec<usize>)>, String> {
    let mut files: Vec<(usize, Vec<usize>)> = Vec::new();
    let mut seen = HashSet::new();
    for (file, slice) in slices {
        match files.last_mut() {
            Some((last, slices)) if *last == file => slices.push(slice),
            _ if seen.insert(file) => files.push((file, vec![slice])),
            _ => {
                return Err("the slices of its files lie between each other; export it in one file, or a slice a file".to_owned());
            }
        }
    }
    Ok(files)
}
