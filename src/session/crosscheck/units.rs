//! Numbers that are right in another unit, and numbers that contradict each other: calibration, room, CT, beam.

use glam::DVec3;

use super::finding::Finding;
use super::metal::{air_share, cts, spacing_mm};
use crate::geometry::{CarmCalibration, CarmJoints, Rigid};
use crate::scene::Scene;
use crate::session::file::Setup;

/// Focal spot to isocentre.
const SOD_MM: (f64, f64) = (150.0, 2000.0);
/// Pixels of panels, binned ones included.
pub(super) const PITCH_MM: (f64, f64) = (0.02, 3.0);
/// Sides of frames.
const SIDE_PX: (u32, u32) = (32, 8192);
/// The specimen lies this close to the isocentre of an arm that stands at zero; arms travel.
const IN_ROOM_MM: f64 = 600.0;
/// Sides of what is put into a CT.
const CT_EXTENT_MM: (f64, f64) = (2.0, 3000.0);
/// Pitches that differ by more than this share are of different pixels.
pub(super) const PITCH_SHARE: f64 = 0.02;

/// Units taken for millimetres: how many mm they are.
const UNITS: [(f64, &str); 3] = [(1000.0, "metres"), (10.0, "centimetres"), (0.001, "microns")];

/// `value` in the unit in which it would be plausible.
fn other_unit(value: f64, (low, high): (f64, f64)) -> Option<&'static str> {
    UNITS.into_iter().find(|(factor, _)| value * factor >= low && value * factor <= high).map(|(_, unit)| unit)
}

/// A plausible length, or the finding that it is none.
pub(super) fn length(check: &str, what: &str, value_mm: f64, range: (f64, f64)) -> Option<Finding> {
    if value_mm >= range.0 && value_mm <= range.1 {
        return None;
    }
    let unit = other_unit(value_mm, range);
    let looks = unit.map(|unit| format!(": {unit} taken for millimetres?")).unwrap_or_default();
    let detail = format!("{what} is {value_mm} mm, expected {} to {} mm{looks}", range.0, range.1);
    Some(Finding::fail(check, detail, "write it in millimetres"))
}

/// The arm's focal length in words, checked.
pub(super) fn sid(check: &str, what: &str, value_mm: f64) -> Option<Finding> {
    length(check, what, value_mm, CarmJoints::SOURCE_TO_DETECTOR_MM)
}

/// The distance that telemetry tells, where no arm has it: that counts as not measured ([`CarmJoints::with_plausible_distance`]).
pub(super) fn told_sid(told_mm: f64, carm: Option<&CarmCalibration>) -> Option<Finding> {
    let mut found = sid("SID", "telemetry's source to detector", told_mm).filter(|_| told_mm.is_finite())?;
    found.detail += &match carm.and_then(|carm| carm.source_to_detector_mm) {
        Some(mm) => format!("; the calibration's {mm} mm are used"),
        None => "; it is not used".to_owned(),
    };
    Some(found)
}

/// Lengths and sizes of a C-arm's calibration.
#[must_use]
pub fn check_calibration(carm: &CarmCalibration) -> Vec<Finding> {
    const CHECK: &str = "calibration";
    let mut found = Vec::new();
    found.extend(carm.source_to_detector_mm.and_then(|sid_mm| sid(CHECK, "source_to_detector_mm", sid_mm)));
    found.extend(length(CHECK, "source_to_isocentre_mm", carm.source_to_isocentre_mm, SOD_MM));
    found.extend(length(CHECK, "pitch_mm", carm.pitch_mm, PITCH_MM));
    for (key, side) in [("columns_px", carm.columns_px), ("rows_px", carm.rows_px)] {
        if !(SIDE_PX.0..=SIDE_PX.1).contains(&side) {
            let detail = format!("{key} is {side}, expected {} to {}", SIDE_PX.0, SIDE_PX.1);
            found.push(Finding::fail(CHECK, detail, "write the size of the frames"));
        }
    }
    if let Some([cx, cy]) = carm.principal_point_px {
        let (width, height) = (f64::from(carm.columns_px), f64::from(carm.rows_px));
        if !(cx > 0.0 && cx < width && cy > 0.0 && cy < height) {
            let detail = format!("the principal point ({cx}, {cy}) px lies outside the frame of {width} x {height} px");
            found.push(Finding::warn(CHECK, detail, "check columns_px, rows_px and principal_point_px: binned together?"));
        }
    }
    if let Some(sid_mm) = carm.source_to_detector_mm.filter(|_| found.is_empty())
        && !(sid_mm > carm.source_to_isocentre_mm)
    {
        let detail = format!("the detector, at {sid_mm} mm, is not behind the isocentre, at {} mm", carm.source_to_isocentre_mm);
        found.push(Finding::fail(CHECK, detail, "check source_to_detector_mm and source_to_isocentre_mm"));
    }
    if found.is_empty() {
        let detail = format!(
            "{} x {} px of {} mm, isocentre at {} mm",
            carm.columns_px,
            carm.rows_px,
            readable(carm.pitch_mm),
            readable(carm.source_to_isocentre_mm)
        );
        found.push(Finding::pass(CHECK, detail));
    }
    found
}

/// A length in mm without the digits that nobody measured.
fn readable(mm: f64) -> f64 {
    (1e5 * mm).round() / 1e5
}

/// The scene's pitch and beam against the calibration and what is known of each.
#[must_use]
pub fn check_scene_detector(setup: &Setup, scene: &Scene) -> Option<Finding> {
    const CHECK: &str = "scene pitch";
    let carm = setup.carm.as_ref()?;
    let (of_scene, of_carm) = (scene.detector.pitch_mm, carm.pitch_mm);
    if (of_scene / of_carm - 1.0).abs() <= PITCH_SHARE {
        return Some(Finding::pass(CHECK, format!("{} mm, as the calibration has it", readable(of_scene))));
    }
    let unit = if (of_carm / of_scene).log10().abs() > 1.5 { ": metres or microns taken for millimetres?" } else { "" };
    let detail = format!("the scene's pitch is {of_scene} mm, the C-arm calibration's {of_carm} mm{unit}");
    Some(Finding::warn(CHECK, detail, "give both the pitch of the frames as they arrive (binned pixels are larger)"))
}

/// Where the specimen lies in the room, against where the arm looks.
#[must_use]
pub fn check_room(setup: &Setup, centre_lps_mm: Option<DVec3>) -> Option<Finding> {
    const CHECK: &str = "specimen in room";
    let world_from_lps = Rigid::from_rows(&setup.session.world_from_lps?).ok()?;
    let (carm, centre) = setup.carm.as_ref().zip(centre_lps_mm)?;
    let world_from_camera = carm.world_from_camera(&CarmJoints::ZERO).ok()?;
    let isocentre = world_from_camera.transform_point(DVec3::new(0.0, 0.0, carm.source_to_isocentre_mm));
    let apart = |place: &Rigid| place.transform_point(centre).distance(isocentre);
    let away_mm = apart(&world_from_lps);
    if away_mm <= IN_ROOM_MM {
        return Some(Finding::pass(CHECK, format!("{away_mm:.0} mm from the isocentre of an arm at zero")));
    }
    let scaled = |factor: f64| Rigid { translation_mm: factor * world_from_lps.translation_mm, ..world_from_lps };
    let likely = UNITS.into_iter().find(|(f, _)| apart(&scaled(*f)) <= IN_ROOM_MM);
    let detail = format!("world_from_lps puts the specimen {away_mm:.0} mm from the isocentre of an arm at zero");
    Some(match likely {
        Some((_, unit)) => Finding::fail(
            CHECK,
            format!("{detail}; its translation fits if it is in {unit}"),
            "write world_from_lps in millimetres, or null to have it solved from the first frames",
        ),
        None if apart(&world_from_lps.inverse()) <= IN_ROOM_MM => Finding::fail(
            CHECK,
            format!("{detail}; its inverse fits"),
            "write world_from_lps, which maps lps to the room, not lps_from_world",
        ),
        None => Finding::warn(
            CHECK,
            detail,
            "check world_from_lps and the calibration's column_to_isocentre_mm, or set world_from_lps to null",
        ),
    })
}

/// Extent and air of each CT.
#[must_use]
pub fn check_cts(scene: &Scene) -> Vec<Finding> {
    const CHECK: &str = "CT";
    let mut found = Vec::new();
    for volume in cts(scene) {
        let spacing = spacing_mm(volume);
        let extent = spacing * DVec3::from_array(volume.size.map(|n| n as f64));
        let (least, most) = CT_EXTENT_MM;
        let size = format!(
            "{} x {} x {} voxels of {:.3} x {:.3} x {:.3} mm",
            volume.size[0], volume.size[1], volume.size[2], spacing.x, spacing.y, spacing.z
        );
        let air = air_share(volume);
        if !(extent.max_element() >= least && extent.max_element() <= most) {
            let detail = format!("{size} reach over {:.3} mm: metres or microns taken for millimetres?", extent.max_element());
            found.push(Finding::fail(CHECK, detail, "write the volume's spacing in millimetres (NIfTI xyzt_units)"));
        } else if volume.class.len() > 1000 && air == 0.0 {
            let detail = format!("{size}, and none of them is air: was the rescale of -1024 left out?");
            found.push(Finding::warn(
                CHECK,
                detail,
                "convert the CT again with slope and intercept applied, so that air is -1000 HU",
            ));
        } else {
            found.push(Finding::pass(CHECK, format!("{size}, {:.0} % air", 100.0 * air)));
        }
    }
    found
}

/// Peak voltage of the scene's beam: its highest energy. `None` for a single energy.
#[must_use]
pub fn scene_kvp(scene: &Scene) -> Option<f64> {
    let bins = &scene.beam.spectrum.bins;
    let total: f64 = bins.iter().map(|bin| bin.fluence).sum();
    let (last, before) = (bins.last()?, bins.len().checked_sub(2).map(|index| &bins[index])?);
    let highest = bins.iter().rev().find(|bin| bin.fluence > 1e-9 * total)?;
    debug_assert!(last.energy_kev >= before.energy_kev);
    Some(highest.energy_kev + 0.5 * (last.energy_kev - before.energy_kev))
}
