//! What panel and console make of a rehearsed picture: stored values, turned and mirrored as declared, in a DICOM file.

use dicom_core::{DataElement, PrimitiveValue, VR};
use dicom_dictionary_std::{tags, uids};

use super::stand::Stand;
use crate::acquire::{DetectorCalibration, Domain, FrameTags};
use crate::geometry::PanelWindow;
use crate::image::Image;
use crate::image::dicom::{file_bytes, grey_16, text, uid_of};
use crate::session::declared::AirWord;
use crate::session::file::Setup;

/// The largest stored value that is aimed at; noise goes beyond.
const BRIGHTEST: f64 = 40_000.0;
/// A panel that saturates is exposed up to this share of it.
const SHARE_OF_SATURATION: f64 = 0.6;
/// Stored values of a neper, and of none, where the session says that its frames are logarithms.
const PER_NEPER: f64 = 4_000.0;
const AT_AIR: f64 = 4_000.0;
/// Signals below this are none.
const DARKEST: f64 = 1e-5;
/// Tube current times time where no air frame tells what to expect of it, µAs.
const SOME_UAS: f64 = 1_000.0;
const MOST_UAS: f64 = 1e9;

/// The file of `picture`, 1 in air, that was taken with this voltage and belongs to exposure `counter`.
///
/// # Errors
/// In words, when it cannot be encoded.
pub(super) fn stored_file(
    setup: &Setup,
    stand: &Stand,
    picture: &Image<f32>,
    kvp: Option<f64>,
    counter: u32,
) -> Result<Vec<u8>, String> {
    let sid_mm = stand.view.intrinsics.fx * stand.pitch_mm;
    let mut said = FrameTags { kvp, sid_mm: Some(sid_mm), exposure_uas: Some(SOME_UAS), ..FrameTags::default() };
    let is_log = setup.domain() == Some(Domain::Log);
    let (relationship, sign) = if is_log { ("LOG", -1i16) } else { ("LIN", 1) };
    let values = if is_log { logarithms(picture) } else { signals(setup, stand, picture, &mut said) };
    // Undoing it three times is doing it: four quarter turns, or two mirrorings, are none.
    let stored = match &setup.session.console {
        Some(console) => (0..3).fold(values, |picture, _| console.orient(&picture, false)),
        None => values,
    };
    let stored = stored.map(|value| value.round().clamp(0.0, 65_535.0) as u16);
    let bytes: Vec<u8> = stored.pixels.iter().flat_map(|value| value.to_le_bytes()).collect();
    let uid = |role: &[u8]| uid_of(&[role, &bytes[..]].concat());
    let instance = uid(b"instance");
    let decimal = |tag, value: f64| text(tag, VR::DS, &format!("{value:.6}"));
    let mut elements = vec![
        text(tags::SOP_CLASS_UID, VR::UI, uids::X_RAY_ANGIOGRAPHIC_IMAGE_STORAGE),
        text(tags::SOP_INSTANCE_UID, VR::UI, &instance),
        text(tags::STUDY_INSTANCE_UID, VR::UI, &uid(b"study")),
        text(tags::SERIES_INSTANCE_UID, VR::UI, &uid(b"series")),
        text(tags::MODALITY, VR::CS, "XA"),
        text(tags::PRESENTATION_INTENT_TYPE, VR::CS, "FOR PROCESSING"),
        text(tags::PIXEL_INTENSITY_RELATIONSHIP, VR::CS, relationship),
        DataElement::new(tags::PIXEL_INTENSITY_RELATIONSHIP_SIGN, VR::SS, PrimitiveValue::from(sign)),
        text(tags::BURNED_IN_ANNOTATION, VR::CS, "NO"),
        text(tags::ACQUISITION_NUMBER, VR::IS, &counter.to_string()),
        text(tags::IMAGER_PIXEL_SPACING, VR::DS, &format!("{0:.6}\\{0:.6}", stand.pitch_mm)),
        decimal(tags::DISTANCE_SOURCE_TO_DETECTOR, sid_mm),
        text(tags::EXPOSURE_INU_AS, VR::IS, &format!("{:.0}", said.exposure_uas.unwrap_or(SOME_UAS))),
    ];
    elements.extend(kvp.map(|kvp| decimal(tags::KVP, kvp)));
    if stand.by_positioner {
        elements.extend([tags::POSITIONER_PRIMARY_ANGLE, tags::POSITIONER_SECONDARY_ANGLE].map(|tag| decimal(tag, 0.0)));
    }
    elements.extend(grey_16([stored.width, stored.height], stored.pixels));
    file_bytes(elements, uids::X_RAY_ANGIOGRAPHIC_IMAGE_STORAGE, &instance)
}

/// More attenuation is a larger value.
fn logarithms(picture: &Image<f32>) -> Image<f32> {
    picture.map(|value| (AT_AIR - PER_NEPER * f64::from(*value).max(DARKEST).ln()) as f32)
}

/// Proportional to the signal as the session's detector calibration has it, or its air level; what the file must say of the exposure for that
/// is in `said`.
fn signals(setup: &Setup, stand: &Stand, picture: &Image<f32>, said: &mut FrameTags) -> Image<f32> {
    let most = picture.pixels.iter().copied().filter(|value| value.is_finite()).fold(0.0, f32::max);
    let declared = match setup.session.air_level {
        Some(AirWord::Value(value)) => Some(value),
        _ => None,
    };
    let of_panel = setup.detector.as_deref().filter(|_| matches!(setup.domain(), None | Some(Domain::Linear)));
    let Some(detector) = of_panel else {
        let air = declared.unwrap_or(BRIGHTEST / f64::from(most).max(DARKEST));
        return picture.map(|value| (air * f64::from(*value)) as f32);
    };
    let air = air_of(detector, said);
    let window = match (&setup.session.console, stand.stored_px) {
        (Some(console), Some(stored_px)) => console.window(stored_px),
        _ => PanelWindow::WHOLE,
    };
    detector.stored(picture, window, said, air)
}

/// The air level of a panel that is exposed as it should be; `said` gets the exposure for it.
fn air_of(detector: &DetectorCalibration, said: &mut FrameTags) -> f64 {
    let record = &detector.record;
    let offset = record.offset_value.unwrap_or(0.0);
    let wanted = record.saturation_value.map_or(BRIGHTEST, |end| (SHARE_OF_SATURATION * (end - offset)).min(BRIGHTEST));
    if let Some(of_some) = detector.air_value(said).filter(|_| !record.beams.is_empty()) {
        said.exposure_uas = Some((SOME_UAS * wanted / of_some).round().clamp(1.0, MOST_UAS));
    }
    detector.air_value(said).unwrap_or(wanted)
}
