//! `beam` and `detector` of a scene file.

use glam::DVec2;

use super::SceneError;
use super::builder::GIVE_DENSITY;
use super::file::{BeamFile, DetectorFile, FieldFile, FocalSpotFile, IntensifierFile};
use super::files::Files;
use super::model::{Beam, Detector, Response};
use super::optics::{BeamShape, BowTie, Fault, Field, Heel, Panel, Scintillator};
use super::physics::{Material, PhysicsError, Spectrum};
use crate::geometry::{Intensifier, IntensifierCalibration};
use crate::reporter::Reporter;

/// N₀ where the scene gives none: the paper's.
const PHOTONS_PER_PIXEL: f64 = 5e5;
/// Largest N₀. Neighbouring f32 are 2¹⁶ apart there, a fifteenth of the noise √N₀ = 10⁶: rounding adds 2³²/12/N₀ < 0.04 % to its variance. At 10¹⁵
/// they are 2²⁶ apart, twice the noise.
const MOST_PHOTONS: f64 = 1e12;
/// Anode angle where the scene gives none.
const ANODE_ANGLE_DEG: f64 = 12.0;

/// The spectrum behind its filters, and N₀.
pub(super) fn beam(file: &BeamFile, files: &mut Files, reporter: &Reporter) -> Result<Beam, SceneError> {
    let keys = |detail: &str, files: &Files| SceneError::Keys { place: files.place("beam"), detail: detail.to_owned() };
    let sources = [file.tube_kvp.is_some(), file.mono_kev.is_some(), file.spectrum_csv.is_some()];
    if sources.iter().filter(|there| **there).count() != 1 {
        return Err(keys("expected exactly one of tube_kvp, mono_kev, spectrum_csv", files));
    }
    if file.anode_angle_deg.is_some() && file.tube_kvp.is_none() {
        return Err(keys("anode_angle_deg goes with tube_kvp only", files));
    }
    let mut filtration = Vec::with_capacity(file.filtration_mm.len());
    for (name, thickness_mm) in &file.filtration_mm {
        let place = || files.place(&format!("beam.filtration_mm.{name}"));
        let material = Material::parse(name).map_err(|source| SceneError::Physics { place: place(), source })?;
        material.nominal_density_g_per_cm3().map_err(|source| SceneError::Physics { place: place(), source })?;
        if !(*thickness_mm >= 0.0 && thickness_mm.is_finite()) {
            let source = PhysicsError::Filter { material: name.clone(), thickness_mm: *thickness_mm };
            return Err(SceneError::Physics { place: place(), source });
        }
        filtration.push((material, *thickness_mm));
    }
    let (key, spectrum) = if let Some(kvp) = file.tube_kvp {
        let angle_deg = file.anode_angle_deg.unwrap_or(ANODE_ANGLE_DEG);
        if file.filtration_mm.is_empty() {
            reporter.note("beam: no filtration_mm given: the spectrum is that of the bare anode");
        }
        ("beam.tube_kvp", Spectrum::tungsten(kvp, angle_deg, &filtration))
    } else if let Some(energy_kev) = file.mono_kev {
        let filtered = Spectrum::mono(energy_kev).and_then(|spectrum| spectrum.filtered(&filtration)?.normalised());
        ("beam.mono_kev", filtered)
    } else {
        let name = file.spectrum_csv.clone().unwrap_or_default();
        let path = files.find("beam.spectrum_csv", &name)?;
        let filtered = Spectrum::from_csv(&path).and_then(|spectrum| spectrum.filtered(&filtration)?.normalised());
        ("beam.spectrum_csv", filtered)
    };
    let spectrum = spectrum.map_err(|source| SceneError::Physics { place: files.place(key), source })?;
    let photons_per_pixel = file.photons_per_pixel.unwrap_or(PHOTONS_PER_PIXEL);
    check(
        photons_per_pixel > 0.0 && photons_per_pixel <= MOST_PHOTONS,
        files,
        "beam.photons_per_pixel",
        photons_per_pixel,
        "above 0, at most 1e12: of more, 32-bit floats round away the noise",
    )?;
    let shape = beam_shape(file, file.anode_angle_deg.unwrap_or(ANODE_ANGLE_DEG), files)?;
    Ok(Beam { spectrum, photons_per_pixel, shape })
}

/// The detector; its pitch is NaN where the file gives none.
pub(super) fn detector(file: &DetectorFile, files: &mut Files) -> Result<Detector, SceneError> {
    if let Some(pitch_mm) = file.pitch_mm {
        check(pitch_mm > 0.0 && pitch_mm <= 100.0, files, "detector.pitch_mm", pitch_mm, "above 0, at most 100 mm")?;
    }
    let gain = file.gain.unwrap_or(1.0);
    // Counts are written as 32-bit floats: at most 1e12 photons of 150 keV, times gain.
    check(gain > 0.0 && gain <= 1e12, files, "detector.gain", gain, "above 0, at most 1e12")?;
    let offset = file.offset.unwrap_or(0.0);
    check(offset.abs() <= 1e12, files, "detector.offset", offset, "between -1e12 and 1e12")?;
    if let Some(noise) = &file.readout_noise {
        let key = "detector.readout_noise.sigma";
        check(noise.sigma >= 0.0 && noise.sigma.is_finite(), files, key, noise.sigma, "0 or more")?;
        let key = "detector.readout_noise.row_correlation";
        check((0.0..1.0).contains(&noise.row_correlation), files, key, noise.row_correlation, "in [0, 1)")?;
    }
    let crosstalk = file.crosstalk.clone().unwrap_or_else(|| vec![vec![1.0]]);
    let side = crosstalk.len();
    if side.is_multiple_of(2) || side > 15 || crosstalk.iter().any(|row| row.len() != side) {
        return Err(SceneError::Value {
            place: files.place("detector.crosstalk"),
            found: format!("{side} rows of {:?}", crosstalk.iter().map(Vec::len).collect::<Vec<_>>()),
            expected: "an odd square, at most 15 by 15".to_owned(),
        });
    }
    for weight in crosstalk.iter().flatten() {
        const EXPECTED: &str = "0 or more: light goes to neighbours, it takes none from them";
        check(*weight >= 0.0, files, "a number of detector.crosstalk", *weight, EXPECTED)?;
    }
    let sum: f64 = crosstalk.iter().flatten().sum();
    check((sum - 1.0).abs() <= 1e-6, files, "the sum of detector.crosstalk", sum, "1 within 1e-6")?;
    Ok(Detector {
        response: file.response.unwrap_or(Response::Energy),
        pitch_mm: file.pitch_mm.unwrap_or(f64::NAN),
        crosstalk,
        readout_noise: file.readout_noise,
        gain,
        offset,
        panel: panel(file, files)?,
    })
}

fn check(good: bool, files: &Files, key: &str, found: f64, expected: &str) -> Result<(), SceneError> {
    if good {
        return Ok(());
    }
    Err(SceneError::Value { place: files.place(key), found: found.to_string(), expected: expected.to_owned() })
}

/// The intensifier's calibration at its angle.
fn intensifier(file: &IntensifierFile, files: &mut Files) -> Result<Intensifier, SceneError> {
    let key = "detector.intensifier";
    let angles_deg = match (file.orbital_deg, file.angulation_deg) {
        (Some(orbital), Some(angulation)) => Some([orbital, angulation]),
        (None, None) => None,
        _ => {
            let detail = "orbital_deg and angulation_deg go together".to_owned();
            return Err(SceneError::Keys { place: files.place(key), detail });
        }
    };
    let calibration: IntensifierCalibration = files.read_json(&format!("{key}.calibration"), &file.calibration)?;
    let at = calibration.check().and_then(|()| calibration.at(angles_deg));
    at.map_err(|source| SceneError::Intensifier { place: files.place(key), source: Box::new(source) })
}

/// Heel, bow-tie, field and focal spot of `beam`, checked.
fn beam_shape(file: &BeamFile, anode_angle_deg: f64, files: &Files) -> Result<BeamShape, SceneError> {
    let heel = match (&file.heel, file.tube_kvp) {
        (Some(heel), Some(tube_kvp)) => Some(Heel { tube_kvp, anode_angle_deg, anode_towards: heel.anode_towards }),
        (Some(_), None) => {
            return Err(SceneError::Keys {
                place: files.place("beam.heel"),
                detail: "goes with tube_kvp only: it is read from the tungsten spectra".to_owned(),
            });
        }
        (None, _) => None,
    };
    let bowtie = file.bowtie.as_ref().map(|bowtie| {
        let (material, density_g_per_cm3) = dense("beam.bowtie.material", &bowtie.material, bowtie.density_g_per_cm3, files)?;
        Ok(BowTie { material, density_g_per_cm3, axis: bowtie.axis, thickness_mm: bowtie.thickness_mm.clone() })
    });
    let field = file.field.as_ref().map(|field| match field {
        FieldFile::Rectangle(r) => Field::Rectangle {
            size_mm: DVec2::from_array(r.size_mm),
            centre_mm: DVec2::from_array(r.centre_mm),
            rotation_deg: r.rotation_deg,
        },
        FieldFile::Circle(c) => Field::Circle { diameter_mm: c.diameter_mm, centre_mm: DVec2::from_array(c.centre_mm) },
        FieldFile::Polygon(p) => {
            Field::Polygon { corners_mm: p.corners_mm.iter().map(|corner| DVec2::from_array(*corner)).collect() }
        }
    });
    let focal_spot_mm = match file.focal_spot_mm {
        Some(FocalSpotFile::Round(width)) => [width, width],
        Some(FocalSpotFile::Oval(widths)) => widths,
        None => [0.0, 0.0],
    };
    let shape = BeamShape { bowtie: bowtie.transpose()?, heel, field, focal_spot_mm };
    shape.check().map_err(|fault| refused(fault, files))?;
    Ok(shape)
}

/// Scintillator, grid, blur, saturation and digits of `detector`, checked.
fn panel(file: &DetectorFile, files: &mut Files) -> Result<Panel, SceneError> {
    let intensifier = file.intensifier.as_ref().map(|file| intensifier(file, files)).transpose()?;
    let scintillator = file.scintillator.as_ref().map(|layer| {
        let (material, density_g_per_cm3) =
            dense("detector.scintillator.material", &layer.material, layer.density_g_per_cm3, files)?;
        Ok(Scintillator { material, density_g_per_cm3, thickness_mm: layer.thickness_mm })
    });
    let bits = match file.bits {
        Some(bits) if bits.fract() == 0.0 && (1.0..=24.0).contains(&bits) => Some(bits as u32),
        Some(value) => {
            return Err(refused(Fault { key: "detector.bits", value, expected: "a whole number from 1 to 24" }, files));
        }
        None => None,
    };
    let panel = Panel {
        scintillator: scintillator.transpose()?,
        grid: file.grid,
        blur_fwhm_mm: file.blur_fwhm_mm.unwrap_or(0.0),
        saturation: file.saturation,
        bits,
        intensifier,
    };
    panel.check().map_err(|fault| refused(fault, files))?;
    Ok(panel)
}

/// A material with its density: the one given, else the nominal one.
fn dense(key: &str, name: &str, density: Option<f64>, files: &Files) -> Result<(Material, f64), SceneError> {
    let physics = |source| SceneError::Physics { place: files.place(key), source };
    let material = Material::parse(name).map_err(physics)?;
    let density = match density {
        Some(density) => density,
        None => material.nominal_density_or(GIVE_DENSITY).map_err(physics)?,
    };
    Ok((material, density))
}

fn refused(fault: Fault, files: &Files) -> SceneError {
    SceneError::Value { place: files.place(fault.key), found: fault.value.to_string(), expected: fault.expected.to_owned() }
}
