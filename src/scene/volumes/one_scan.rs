//! Whether the slices of a series are of one scan, and all of it: what their headers say beside their places.

use std::collections::HashSet;

use super::ct_slice::{CtHead, ScanHead, SliceHead};
use super::head::Remark;

/// From this many times their thickness apart, slices leave matter unmeasured between them.
const GAP: f64 = 1.5;
/// The same where their numbers go in steps, too: more than rounding.
const GAP_IN_STEPS: f64 = 1.05;
/// A share by which a distance that is stated may be off: it is rounded, or that of another reconstruction of the same scan.
const SAME_DISTANCE: f64 = 0.05;
/// A length of one decimal, mm.
const ROUNDED_MM: f64 = 0.051;

/// Refuses files of different patients, places or postures; what else differs, or is no CT by its own word, is remarked.
///
/// # Errors
/// One sentence, without a word of what the headers say: it may name a person.
pub(super) fn check_one_scan(heads: &[&CtHead]) -> Result<Vec<Remark>, String> {
    if let Some(count) = several(heads, |scan| scan.patient.as_deref()) {
        return Err(format!("its slices are of {count} patients (patient ID 0010,0020); export the series of one patient again"));
    }
    let frames = several(heads, |scan| scan.frame_of_reference.as_deref());
    // Two or three are scans that were put together; some exports give each file one of its own.
    let each_its_own = frames.is_some_and(|count| count == heads.len() && count > 2);
    if let Some(count) = frames.filter(|_| !each_its_own) {
        return Err(format!(
            "its slices are placed in {count} frames of reference (0020,0052), between which nothing is known; export one scan alone"
        ));
    }
    if let Some(count) = several(heads, |scan| scan.patient_position.as_deref()) {
        return Err(format!("its slices are of {count} postures of the patient (0018,5100); export one scan alone"));
    }
    let mut remarks = Vec::new();
    let mut warn = |kind: &str, words: String| remarks.push((Some(kind.to_owned()), words));
    if each_its_own {
        let words =
            "each of its files names a frame of reference of its own (0020,0052), as some exports do: are they of one scan?";
        warn("frames of reference", words.to_owned());
    }
    if let Some(count) = several(heads, |scan| scan.study.as_deref()) {
        let words = format!("its slices are of {count} studies (0020,000d), though of one series: are they of one scan?");
        warn("several studies", words);
    }
    let all = heads.len();
    let other = heads.iter().filter(|head| head.scan.is_other_modality).count();
    if other > 0 {
        let words = format!("{other} of {all} files are of another modality than CT by their own word (0008,0060): hardly HU");
        warn("not HU", words);
    }
    let projections = heads.iter().filter(|head| head.scan.is_projection).count();
    if projections > 0 {
        let words = format!(
            "{projections} of {all} files are projections by their own word (image type 0008,0008), which show matter where none is; \
             export the slices that they were made of"
        );
        warn("projections", words);
    }
    Ok(remarks)
}

/// How many different names the files say, if more than one; one that says none is of any.
fn several(heads: &[&CtHead], of: fn(&ScanHead) -> Option<&str>) -> Option<usize> {
    let known: HashSet<&str> = heads.iter().filter_map(|head| of(&head.scan)).collect();
    Some(known.len()).filter(|count| *count > 1)
}

/// What to say of slices at different places that are called the same.
pub(super) fn same_images(slices: &[&SliceHead]) -> Option<Remark> {
    let known: HashSet<&str> = slices.iter().map(|slice| slice.image.as_str()).collect();
    let (all, same) = (slices.len(), slices.len() - known.len());
    let words = || {
        format!(
            "{same} of its {all} slices are the same image as another by their own word (0008,0018), at another place: was one \
             exported over the other?"
        )
    };
    // One name for all of them is nobody's word: that of a program that takes identities out.
    (same > 0 && known.len() > 1).then(|| (Some("same image".to_owned()), words()))
}

/// What to say of slices in order that lie `along_mm` apart where their headers tell of others between them.
pub(super) fn left_out(slices: &[&SliceHead], along_mm: f64) -> Option<Remark> {
    let thickness_mm = stated(slices, |slice| slice.thickness_mm).map(|all| all.into_iter().fold(0.0, f64::max));
    // Some write the gap between the slices' faces, less than half of one; and a decimal is rounded.
    let is_same = |mm: &f64| {
        let rounded_mm = (SAME_DISTANCE * along_mm).max(ROUNDED_MM);
        let with_slice_mm = thickness_mm.filter(|thick_mm| *mm < 0.5 * thick_mm).map(|thick_mm| mm + thick_mm);
        [Some(*mm), with_slice_mm].into_iter().flatten().any(|mm| (mm - along_mm).abs() <= rounded_mm)
    };
    // Where one slice says what its place says, the others may be rounded.
    let between_mm = stated(slices, |slice| slice.between_mm).filter(|all| !all.iter().any(is_same));
    let between_mm = between_mm.and_then(|all| all.first().copied());
    let steps = steps(slices);
    let limit = if steps.is_some() { GAP_IN_STEPS } else { GAP };
    let thin_mm = thickness_mm.filter(|mm| !(along_mm <= limit * mm));
    let steps = steps.filter(|_| thin_mm.is_some() || thickness_mm.is_none());
    let denser = thin_mm.is_some() || steps.is_some() || between_mm.is_some_and(|mm| mm < along_mm);
    let reasons: Vec<String> = [
        thin_mm.map(|mm| format!("are {mm:.3} mm thick (0018,0050)")),
        between_mm.map(|mm| format!("lie {mm:.3} mm apart by their own word (0018,0088)")),
        steps.map(|steps| format!("count in steps of {steps} (0020,0013)")),
    ]
    .into_iter()
    .flatten()
    .collect();
    if reasons.is_empty() {
        return None;
    }
    let why = if denser {
        "were some left out? What lies between them is guessed; export every slice"
    } else {
        "one of the two is wrong, and their places are used"
    };
    let words = format!("slices lie {along_mm:.3} mm apart, but {}: {why}", reasons.join(" and "));
    Some((Some(if denser { "slices left out" } else { "slice distance" }.to_owned()), words))
}

/// A length that every slice states.
fn stated(slices: &[&SliceHead], of: fn(&SliceHead) -> Option<f64>) -> Option<Vec<f64>> {
    slices.iter().map(|slice| of(slice)).collect()
}

/// By how much the numbers of slices go on from each to the next, where that is the same everywhere and more than one.
fn steps(slices: &[&SliceHead]) -> Option<i64> {
    let numbers: Vec<i64> = slices.iter().map(|slice| slice.number.map(i64::from)).collect::<Option<_>>()?;
    let steps: HashSet<i64> = numbers.windows(2).map(|pair| pair[1] - pair[0]).collect();
    let step = steps.iter().next().filter(|_| steps.len() == 1 && numbers.len() > 2)?.abs();
    (step > 1).then_some(step)
}

#[cfg(test)]
mod tests {
    use glam::DVec3;

    use super::*;

    fn slices(thickness_mm: Option<f64>, between_mm: Option<f64>, step: i32) -> Vec<SliceHead> {
        let slice = |k: i32| SliceHead {
            image: k.to_string(),
            size_px: [4, 4],
            first_pixel_in_lps: DVec3::Z * f64::from(k),
            along_row: DVec3::X,
            along_column: DVec3::Y,
            pitch_mm: [1.0; 2],
            thickness_mm,
            between_mm,
            number: Some(7 - step * k),
        };
        (0..5).map(slice).collect()
    }

    #[test]
    fn slices_that_were_left_out_are_said_and_what_scanners_write_is_not() {
        let said = |thickness_mm, between_mm, step, along_mm| {
            let slices = slices(thickness_mm, between_mm, step);
            left_out(&slices.iter().collect::<Vec<_>>(), along_mm).map(|(_, words)| words).unwrap_or_default()
        };
        // Alike, overlapping, without a thickness, sparse by less than is remarkable; numbers of every second slice of two that are alike.
        let usual = [
            (Some(4.5), None, 1, 4.5),
            (Some(5.0), Some(2.5), 1, 2.5),
            (None, None, 1, 9.0),
            (Some(4.0), Some(5.0), -1, 5.0),
            (Some(4.5), None, 2, 4.5),
            (Some(2.0), Some(0.5), 1, 2.5),
            (Some(0.75), Some(0.8), 1, 0.75),
        ];
        for (thickness_mm, between_mm, step, along_mm) in usual {
            assert_eq!(said(thickness_mm, between_mm, step, along_mm), "", "{thickness_mm:?} {between_mm:?} {step} {along_mm}");
        }
        let cases = [
            (Some(4.5), None, 1, 9.0, "but are 4.500 mm thick (0018,0050): were some left out?"),
            (Some(4.5), Some(4.5), 2, 9.0, "and lie 4.500 mm apart by their own word (0018,0088) and count in steps of 2"),
            (Some(4.5), None, 2, 6.0, "count in steps of 2"),
            (None, None, -3, 9.0, "but count in steps of 3 (0020,0013): were some left out?"),
            (Some(4.5), Some(9.0), 1, 4.5, "but lie 9.000 mm apart by their own word (0018,0088): one of the two is wrong"),
        ];
        for (thickness_mm, between_mm, step, along_mm, words) in cases {
            let found = said(thickness_mm, between_mm, step, along_mm);
            assert!(found.contains(words), "{words}: {found}");
        }
    }
}
