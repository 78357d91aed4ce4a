//! Beam shape and panel as a scene file writes them.

use glam::DVec2;
use serde::Deserialize;

use super::SceneError;
use super::file::{BeamFile, DetectorFile};
use super::files::Files;
use super::optics::{Axis, BeamShape, BowTie, Fault, Field, Heel, Panel, Scintillator, Towards};
use super::physics::Material;
use crate::geometry::{Intensifier, IntensifierCalibration};

/// `beam.bowtie`.
#[derive(Clone, Debug, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct BowTieFile {
    /// Name, formula or mass fractions.
    pub material: String,
    /// The nominal one if absent.
    #[serde(default)]
    pub density_g_per_cm3: Option<f64>,
    /// The direction along which the thickness varies.
    pub axis: Axis,
    /// (fan angle in degrees from the principal ray, mm along the ray), angles ascending.
    pub thickness_mm: Vec<[f64; 2]>,
}

/// `beam.heel`.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct HeelFile {
    /// The side of the image on which the anode lies.
    pub anode_towards: Towards,
}

/// `beam.field`, named by its shape.
#[derive(Clone, Debug, PartialEq, Deserialize)]
#[serde(rename_all = "snake_case", deny_unknown_fields)]
pub enum FieldFile {
    /// A turned rectangle.
    Rectangle(RectangleFile),
    /// An iris.
    Circle(CircleFile),
    /// Corners in order.
    Polygon(PolygonFile),
}

/// `beam.field.rectangle`.
#[derive(Clone, Debug, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct RectangleFile {
    /// Along columns' and rows' direction, on the detector.
    pub size_mm: [f64; 2],
    /// From the principal point.
    #[serde(default)]
    pub centre_mm: [f64; 2],
    /// From +x towards +y.
    #[serde(default)]
    pub rotation_deg: f64,
}

/// `beam.field.circle`.
#[derive(Clone, Debug, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct CircleFile {
    /// On the detector.
    pub diameter_mm: f64,
    /// From the principal point.
    #[serde(default)]
    pub centre_mm: [f64; 2],
}

/// `beam.field.polygon`.
#[derive(Clone, Debug, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct PolygonFile {
    /// On the detector, from the principal point.
    pub corners_mm: Vec<[f64; 2]>,
}

/// `beam.focal_spot_mm`: one width, or one along columns' and one along rows' direction.
#[derive(Clone, Copy, Debug, PartialEq, Deserialize)]
#[serde(untagged, expecting = "expected a width in mm, or [width, height]")]
pub enum FocalSpotFile {
    /// Round.
    Round(f64),
    /// Width and height.
    Oval([f64; 2]),
}

/// `detector.scintillator`.
#[derive(Clone, Debug, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ScintillatorFile {
    /// Name, formula or mass fractions.
    pub material: String,
    /// The nominal one if absent.
    #[serde(default)]
    pub density_g_per_cm3: Option<f64>,
    /// Of the layer.
    pub thickness_mm: f64,
}

/// `detector.intensifier`.
#[derive(Clone, Debug, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct IntensifierFile {
    /// A file of `calibrate intensifier`.
    pub calibration: String,
    /// Angle of the C-arm along the C, as the calibration means it; needed where that has several views.
    #[serde(default)]
    pub orbital_deg: Option<f64>,
    /// Angle of the C-arm about its axis.
    #[serde(default)]
    pub angulation_deg: Option<f64>,
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
pub(super) fn beam_shape(file: &BeamFile, anode_angle_deg: f64, files: &Files) -> Result<BeamShape, SceneError> {
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
pub(super) fn panel(file: &DetectorFile, files: &mut Files) -> Result<Panel, SceneError> {
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
        None => material.nominal_density_g_per_cm3().map_err(physics)?,
    };
    Ok((material, density))
}

fn refused(fault: Fault, files: &Files) -> SceneError {
    SceneError::Value { place: files.place(fault.key), found: fault.value.to_string(), expected: fault.expected.to_owned() }
}
