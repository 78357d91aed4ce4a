//! A rendered image as a DICOM object that others open: Digital X-Ray (for processing), with the geometry that DICOM has words for, and
//! with P itself where it has none.
//!
//! | attribute | says |
//! |---|---|
//! | Imager Pixel Spacing, Distance Source to Detector | K, but for its principal point |
//! | Positioner Primary and Secondary Angle | the beam, as if the patient lay head first, supine |
//! | Pixel Intensity Relationship and its sign | `LIN` +1 of `intensity` and `counts`, `LOG` −1 of `line_integral` |
//! | Pixel Padding Value | 0: no valid pixel has it |
//! | Image Comments | JSON: quantity, stored values a unit, projection, intrinsics, camera_from_lps, size, stated error |
//!
//! Nothing in it depends on the time, and its identifiers are hashes of its content: the same image is the same object.

use std::path::Path;

use dicom_core::{DataElement, PrimitiveValue, Tag, VR};
use dicom_dictionary_std::{tags, uids};
use dicom_object::InMemDicomObject;
use glam::DVec3;

use super::{Quantity, RenderError, Rendered};
use crate::geometry::{AngleConvention, PatientPosition, View};
use crate::image::dicom::{file_bytes, grey_16, text, uid_of};
use crate::image::{sha256_bytes, write_atomically};
use crate::scene::model::Scene;

/// Stored values of 1 (the unattenuated signal), and of a neper; fewer where the image would not fit, and of an intensity as many times two more
/// as fit.
const PER_UNIT: f64 = 50_000.0;
const PER_NEPER: f64 = 4_000.0;
/// The largest stored value.
const MOST: f64 = 65_535.0;

/// Writes the first page as 16-bit DICOM.
///
/// # Errors
/// When the image is of a kind that DICOM has no word for (`area_density`), the scene has no view, or the file cannot be written.
pub fn write_dicom(path: &Path, rendered: &Rendered, scene: &Scene) -> Result<(), RenderError> {
    let view = scene.view.ok_or(RenderError::NoView)?;
    let failed = |detail: String| RenderError::Dicom { path: path.to_owned(), detail };
    let bytes = encoded(rendered, scene, &view).map_err(failed)?;
    Ok(write_atomically(path, |file| file.write_all(&bytes))?)
}

/// Skew that moves no place by as much, px, is none.
const LEAST_SKEW_PX: f64 = 0.01;

/// That the geometry tags leave out the skew of K, where there is some.
#[must_use]
pub fn unsaid_skew(view: &View) -> Option<String> {
    let k = &view.intrinsics;
    let rows = f64::from(view.size_px[1]);
    let moved_px = (k.skew / k.fy).abs() * (k.cy.abs() + rows);
    (moved_px > LEAST_SKEW_PX).then(|| {
        format!(
            "K has a skew of {} px, for which DICOM's geometry tags have no word: they describe the camera without it, Image Comments hold K as it is",
            k.skew
        )
    })
}

fn encoded(rendered: &Rendered, scene: &Scene, view: &View) -> Result<Vec<u8>, String> {
    let page = rendered.pages.first().ok_or("it has no page")?;
    let (relationship, sign, wanted) = match rendered.quantity {
        Quantity::Intensity => ("LIN", 1i16, PER_UNIT),
        Quantity::Counts => ("LIN", 1, 1.0),
        Quantity::LineIntegral => ("LOG", -1, PER_NEPER),
        Quantity::AreaDensity => {
            return Err("area densities are no radiograph; write intensity, line_integral or counts".to_owned());
        }
    };
    let is_valid = |n: usize| rendered.valid.pixels[n] == 1 && page.pixels[n].is_finite();
    let largest = (0..page.pixels.len()).filter(|n| is_valid(*n)).map(|n| f64::from(page.pixels[n])).fold(0.0, f64::max);
    let per_unit = stored_per_unit(rendered.quantity, wanted, largest);
    let stored = |n: usize| match is_valid(n) {
        true => (f64::from(page.pixels[n]) * per_unit).round().clamp(1.0, MOST) as u16,
        false => 0,
    };
    let values: Vec<u16> = (0..page.pixels.len()).map(stored).collect();
    let pixels: Vec<u8> = values.iter().flat_map(|value| value.to_le_bytes()).collect();
    let comments = serde_json::json!({
        "quantity": rendered.quantity,
        "stored_per_unit": per_unit,
        "projection": view.projection(),
        "intrinsics": view.intrinsics,
        "camera_from_lps": view.camera_from_lps,
        "size_px": view.size_px,
        "stated_error": rendered.stated_error,
    })
    .to_string();
    // Identifiers are of what is in the object: the same image is the same object.
    let content = sha256_bytes(&[&pixels, comments.as_bytes()].concat());
    let uid = |role: &str| uid_of(format!("{role} {content}").as_bytes());
    let instance = uid("instance");
    // A decimal string has sixteen characters at most.
    let decimal = |tag: Tag, value: f64| text(tag, VR::DS, &short(value));
    let empty = |tag: Tag, vr: VR| DataElement::new(tag, vr, PrimitiveValue::Empty);
    let none = |tag: Tag| DataElement::new(tag, VR::SQ, dicom_core::value::DataSetSequence::<InMemDicomObject>::empty());
    let pitch_mm = scene.detector.pitch_mm;
    let distance_mm = view.intrinsics.fx * pitch_mm;
    let row_mm = distance_mm / view.intrinsics.fy;
    let lps_from_camera = view.camera_from_lps.rotation.conjugate();
    let [primary_deg, secondary_deg, _] =
        AngleConvention::Dicom.angles(lps_from_camera, PatientPosition::HeadFirstSupine).to_degrees();
    let words = [
        text(tags::SOP_CLASS_UID, VR::UI, uids::DIGITAL_X_RAY_IMAGE_STORAGE_FOR_PROCESSING),
        text(tags::SOP_INSTANCE_UID, VR::UI, &instance),
        text(tags::STUDY_INSTANCE_UID, VR::UI, &uid("study")),
        text(tags::SERIES_INSTANCE_UID, VR::UI, &uid("series")),
        empty(tags::PATIENT_NAME, VR::PN),
        empty(tags::PATIENT_ID, VR::LO),
        empty(tags::PATIENT_BIRTH_DATE, VR::DA),
        empty(tags::PATIENT_SEX, VR::CS),
        empty(tags::STUDY_DATE, VR::DA),
        empty(tags::STUDY_TIME, VR::TM),
        empty(tags::STUDY_ID, VR::SH),
        empty(tags::ACCESSION_NUMBER, VR::SH),
        empty(tags::REFERRING_PHYSICIAN_NAME, VR::PN),
        text(tags::MODALITY, VR::CS, "DX"),
        text(tags::PRESENTATION_INTENT_TYPE, VR::CS, "FOR PROCESSING"),
        text(tags::SERIES_NUMBER, VR::IS, "1"),
        text(tags::INSTANCE_NUMBER, VR::IS, "1"),
        text(tags::MANUFACTURER, VR::LO, "Sidecarm"),
        text(tags::MANUFACTURER_MODEL_NAME, VR::LO, "simulated radiograph"),
        text(tags::SOFTWARE_VERSIONS, VR::LO, env!("CARGO_PKG_VERSION")),
        text(tags::IMAGE_TYPE, VR::CS, "DERIVED\\PRIMARY\\"),
        text(tags::DERIVATION_DESCRIPTION, VR::ST, "rendered from CT: no exposure of a patient"),
        text(tags::IMAGE_COMMENTS, VR::LT, &comments),
        text(
            tags::PATIENT_ORIENTATION,
            VR::CS,
            &format!("{}\\{}", towards(lps_from_camera * DVec3::X), towards(lps_from_camera * DVec3::Y)),
        ),
        text(tags::IMAGE_LATERALITY, VR::CS, "U"),
        none(tags::ANATOMIC_REGION_SEQUENCE),
        none(tags::ACQUISITION_CONTEXT_SEQUENCE),
        empty(tags::DETECTOR_TYPE, VR::CS),
        text(tags::IMAGER_PIXEL_SPACING, VR::DS, &format!("{}\\{}", short(row_mm), short(pitch_mm))),
        decimal(tags::DISTANCE_SOURCE_TO_DETECTOR, distance_mm),
        text(tags::POSITIONER_TYPE, VR::CS, "CARM"),
        decimal(tags::POSITIONER_PRIMARY_ANGLE, primary_deg),
        decimal(tags::POSITIONER_SECONDARY_ANGLE, secondary_deg),
        text(tags::PIXEL_INTENSITY_RELATIONSHIP, VR::CS, relationship),
        DataElement::new(tags::PIXEL_INTENSITY_RELATIONSHIP_SIGN, VR::SS, PrimitiveValue::from(sign)),
        text(tags::RESCALE_INTERCEPT, VR::DS, "0"),
        text(tags::RESCALE_SLOPE, VR::DS, "1"),
        text(tags::RESCALE_TYPE, VR::LO, "US"),
        text(tags::PRESENTATION_LUT_SHAPE, VR::CS, "IDENTITY"),
        text(tags::LOSSY_IMAGE_COMPRESSION, VR::CS, "00"),
        text(tags::BURNED_IN_ANNOTATION, VR::CS, "NO"),
        DataElement::new(tags::PIXEL_PADDING_VALUE, VR::US, PrimitiveValue::from(0u16)),
    ];
    let elements = words.into_iter().chain(grey_16([page.width, page.height], values));
    file_bytes(elements, uids::DIGITAL_X_RAY_IMAGE_STORAGE_FOR_PROCESSING, &instance)
}

/// Stored values a unit of an image whose largest value is `largest`.
fn stored_per_unit(quantity: Quantity, wanted: f64, largest: f64) -> f64 {
    match largest * wanted {
        most if most > MOST => MOST / largest,
        // Behind a thick body hardly a hundredth arrives: its steps are to be no coarser than those of air.
        most if most > 0.0 && quantity == Quantity::Intensity => wanted * (MOST / most).log2().floor().exp2(),
        _ => wanted,
    }
}

/// Where a direction in LPS goes, in DICOM's letters, the most first: `LH` is to the left and somewhat to the head.
fn towards(direction: DVec3) -> String {
    let mut axes = [(direction.x, ['L', 'R']), (direction.y, ['P', 'A']), (direction.z, ['H', 'F'])];
    axes.sort_by(|a, b| b.0.abs().total_cmp(&a.0.abs()));
    // Less than a degree is none.
    let told = axes.iter().filter(|(along, _)| along.abs() > 0.0175);
    told.map(|(along, [positive, negative])| if *along > 0.0 { positive } else { negative }).collect()
}

/// A number in at most sixteen characters.
fn short(value: f64) -> String {
    let plain = format!("{value:.6}");
    let trimmed = plain.trim_end_matches('0').trim_end_matches('.');
    if trimmed.len() <= 16 { trimmed.to_owned() } else { format!("{value:.8e}") }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::geometry::{Intrinsics, Rigid};

    #[test]
    fn a_skew_that_the_tags_leave_out_is_said() {
        let said = |skew: f64| {
            let intrinsics = Intrinsics { fx: 250.0, fy: 250.0, skew, cx: 23.3, cy: 17.1 };
            unsaid_skew(&View { size_px: [48, 36], intrinsics, camera_from_lps: Rigid::IDENTITY })
        };
        assert!(said(60.0).is_some_and(|words| words.contains("skew of 60 px")) && said(-60.0).is_some());
        assert_eq!([said(0.0), said(1e-9)], [None, None]);
    }

    #[test]
    fn a_dark_image_uses_the_bits_that_there_are() {
        let of = |quantity, wanted, largest| stored_per_unit(quantity, wanted, largest);
        for largest in [1.0, 0.5, 0.0126, 1e-4] {
            let most = largest * of(Quantity::Intensity, PER_UNIT, largest);
            assert!(most > 0.5 * MOST && most <= MOST, "{largest}: {most}");
        }
        assert_eq!(of(Quantity::Intensity, PER_UNIT, 1.0), PER_UNIT);
        assert_eq!(of(Quantity::LineIntegral, PER_NEPER, 0.2), PER_NEPER);
        assert_eq!(of(Quantity::Counts, 1.0, 1e6), MOST / 1e6);
        assert_eq!(of(Quantity::Intensity, PER_UNIT, 0.0), PER_UNIT);
    }
}
