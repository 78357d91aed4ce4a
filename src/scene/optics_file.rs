//! Beam shape and panel as a scene file writes them.

use serde::Deserialize;

use super::optics::{Axis, Towards};

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
