//! What shapes the beam before the object, and what the panel does to the signal behind it.
//!
//! Directions are those of `camera`: +x to increasing column, +y to increasing row, +z to the detector. Lengths on the detector are mm
//! from the principal point.

use glam::{DVec2, DVec3};

use super::physics::{Material, PhysicsError};
use crate::geometry::Intensifier;

/// A number that makes no sense: key, value, what would do.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Fault {
    /// Key in the scene file.
    pub key: &'static str,
    /// Found.
    pub value: f64,
    /// What would do.
    pub expected: &'static str,
}

fn want(good: bool, key: &'static str, value: f64, expected: &'static str) -> Result<(), Fault> {
    if good { Ok(()) } else { Err(Fault { key, value, expected }) }
}

/// Heel, bow-tie, collimation and focal spot; none of them by default.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct BeamShape {
    /// A filter whose thickness depends on the fan angle.
    pub bowtie: Option<BowTie>,
    /// Self-filtration of the anode.
    pub heel: Option<Heel>,
    /// Collimated field.
    pub field: Option<Field>,
    /// Full widths at half maximum of a Gaussian focal spot along columns' and rows' direction; 0 is a point.
    pub focal_spot_mm: [f64; 2],
}

impl BeamShape {
    /// The first number that makes no sense.
    ///
    /// # Errors
    /// Which one.
    pub fn check(&self) -> Result<(), Fault> {
        if let Some(bowtie) = &self.bowtie {
            let profile = &bowtie.thickness_mm;
            want(!profile.is_empty(), "beam.bowtie.thickness_mm: points", 0.0, "at least 1")?;
            for [angle_deg, mm] in profile {
                want(angle_deg.abs() < 90.0, "beam.bowtie.thickness_mm: an angle", *angle_deg, "degrees between -90 and 90")?;
                want(*mm >= 0.0 && *mm <= 1000.0, "beam.bowtie.thickness_mm: a thickness", *mm, "0 to 1000 mm")?;
            }
            for pair in profile.windows(2) {
                want(pair[1][0] > pair[0][0], "beam.bowtie.thickness_mm: an angle", pair[1][0], "one above the angle before it")?;
            }
            let density = bowtie.density_g_per_cm3;
            want(density > 0.0 && density < 1000.0, "beam.bowtie.density_g_per_cm3", density, "above 0, below 1000")?;
        }
        if let Some(field) = &self.field {
            field.check()?;
        }
        for fwhm_mm in self.focal_spot_mm {
            want((0.0..=20.0).contains(&fwhm_mm), "beam.focal_spot_mm", fwhm_mm, "0 to 20 mm")?;
        }
        Ok(())
    }

    /// Whether the spectrum differs from pixel to pixel.
    #[must_use]
    pub fn varies(&self) -> bool {
        self.bowtie.is_some() || self.heel.is_some()
    }
}

/// Which way across the detector.
#[derive(Clone, Copy, Debug, PartialEq, Eq, serde::Deserialize, serde::Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Axis {
    /// The profile varies with the column, along camera x.
    Column,
    /// The profile varies with the row, along camera y.
    Row,
}

/// A filter extruded across its fan: thickness along the ray by fan angle.
#[derive(Clone, Debug, PartialEq)]
pub struct BowTie {
    /// What it is made of.
    pub material: Material,
    /// Its density.
    pub density_g_per_cm3: f64,
    /// The direction along which it varies.
    pub axis: Axis,
    /// (fan angle in degrees, mm along the ray in the fan's plane), angles ascending; linear between, held beyond the ends.
    pub thickness_mm: Vec<[f64; 2]>,
}

impl BowTie {
    /// Area density (g/cm²) along a ray of the camera.
    // The fan angle is that of the ray's projection into the fan's plane; out of that plane the extruded filter is longer by the
    // ratio of the ray's length to its projection's.
    #[must_use]
    pub fn area_density(&self, ray: DVec3) -> f64 {
        let (along, across) = match self.axis {
            Axis::Column => (ray.x, ray.y),
            Axis::Row => (ray.y, ray.x),
        };
        let in_plane = along.hypot(ray.z);
        let thickness_mm = interpolate(&self.thickness_mm, along.atan2(ray.z).to_degrees());
        0.1 * self.density_g_per_cm3 * thickness_mm * (in_plane.hypot(across) / in_plane)
    }
}

fn interpolate(points: &[[f64; 2]], x: f64) -> f64 {
    let above = points.partition_point(|point| point[0] <= x);
    match (above.checked_sub(1).and_then(|below| points.get(below)), points.get(above)) {
        (Some([x0, y0]), Some([x1, y1])) => y0 + (y1 - y0) * (x - x0) / (x1 - x0),
        (Some([_, y]), None) | (None, Some([_, y])) => *y,
        (None, None) => 0.0,
    }
}

/// Where the anode lies, seen from the principal ray.
#[derive(Clone, Copy, Debug, PartialEq, Eq, serde::Deserialize, serde::Serialize)]
pub enum Towards {
    /// At high columns.
    #[serde(rename = "+column")]
    PlusColumn,
    /// At low columns.
    #[serde(rename = "-column")]
    MinusColumn,
    /// At high rows.
    #[serde(rename = "+row")]
    PlusRow,
    /// At low rows.
    #[serde(rename = "-row")]
    MinusRow,
}

impl Towards {
    /// Unit vector of the camera from cathode to anode.
    #[must_use]
    pub fn in_camera(self) -> DVec3 {
        match self {
            Self::PlusColumn => DVec3::X,
            Self::MinusColumn => DVec3::NEG_X,
            Self::PlusRow => DVec3::Y,
            Self::MinusRow => DVec3::NEG_Y,
        }
    }
}

/// The heel effect: a ray leaves the anode at its own take-off angle, and the tungsten tables at that angle give its spectrum.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Heel {
    /// Tube voltage.
    pub tube_kvp: f64,
    /// Take-off angle of the principal ray.
    pub anode_angle_deg: f64,
    /// Side of the anode.
    pub anode_towards: Towards,
}

impl Heel {
    /// Sine of the angle between a ray of the camera and the target's surface; ≤ 0 behind the heel, where nothing arrives.
    // The surface contains the direction that makes the anode angle α with the principal ray on the anode's side a, so its normal is
    // n = z sin α − a cos α, and a ray d leaves it at asin(n·d).
    #[must_use]
    pub fn sine_of_take_off(&self, ray: DVec3) -> f64 {
        let (sine, cosine) = self.anode_angle_deg.to_radians().sin_cos();
        (sine * DVec3::Z - cosine * self.anode_towards.in_camera()).dot(ray) / ray.length()
    }
}

/// The opening of the collimator as it is seen on the detector.
#[derive(Clone, Debug, PartialEq)]
pub enum Field {
    /// Sides parallel to rows and columns before it is turned.
    Rectangle {
        /// Along columns' and rows' direction.
        size_mm: DVec2,
        /// From the principal point.
        centre_mm: DVec2,
        /// From +x towards +y.
        rotation_deg: f64,
    },
    /// An iris.
    Circle {
        /// Of the whole circle.
        diameter_mm: f64,
        /// From the principal point.
        centre_mm: DVec2,
    },
    /// Any simple polygon; inside by the even–odd rule.
    Polygon {
        /// From the principal point.
        corners_mm: Vec<DVec2>,
    },
}

impl Field {
    /// Whether a point of the detector (mm from the principal point) is open.
    #[must_use]
    pub fn contains(&self, point_mm: DVec2) -> bool {
        match self {
            Self::Rectangle { size_mm, centre_mm, rotation_deg } => {
                let local = DVec2::from_angle(-rotation_deg.to_radians()).rotate(point_mm - *centre_mm);
                2.0 * local.x.abs() <= size_mm.x && 2.0 * local.y.abs() <= size_mm.y
            }
            Self::Circle { diameter_mm, centre_mm } => 2.0 * point_mm.distance(*centre_mm) <= *diameter_mm,
            Self::Polygon { corners_mm } => {
                let edges = corners_mm.iter().zip(corners_mm.iter().cycle().skip(1));
                let crossed = edges.filter(|(a, b)| {
                    (a.y > point_mm.y) != (b.y > point_mm.y) && point_mm.x < a.x + (b.x - a.x) * (point_mm.y - a.y) / (b.y - a.y)
                });
                crossed.count() % 2 == 1
            }
        }
    }

    fn check(&self) -> Result<(), Fault> {
        let size = |key, mm: f64| want(mm > 0.0 && mm <= 1e5, key, mm, "above 0, at most 1e5 mm");
        let place = |key, at: DVec2| want(at.abs().max_element() <= 1e5, key, at.x, "numbers within 1e5 mm");
        match self {
            Self::Rectangle { size_mm, centre_mm, rotation_deg } => {
                size("beam.field.rectangle.size_mm", size_mm.x)?;
                size("beam.field.rectangle.size_mm", size_mm.y)?;
                place("beam.field.rectangle.centre_mm", *centre_mm)?;
                let key = "beam.field.rectangle.rotation_deg";
                want(rotation_deg.abs() <= 360.0, key, *rotation_deg, "-360 to 360 degrees")
            }
            Self::Circle { diameter_mm, centre_mm } => {
                size("beam.field.circle.diameter_mm", *diameter_mm)?;
                place("beam.field.circle.centre_mm", *centre_mm)
            }
            Self::Polygon { corners_mm } => {
                let key = "beam.field.polygon.corners_mm";
                want(corners_mm.len() >= 3, "beam.field.polygon.corners_mm: corners", corners_mm.len() as f64, "at least 3")?;
                corners_mm.iter().try_for_each(|corner| place(key, *corner))
            }
        }
    }
}

/// Scintillator, grid, blur, saturation and digits; none of them by default.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Panel {
    /// What absorbs the photons; everything is absorbed without one.
    pub scintillator: Option<Scintillator>,
    /// Antiscatter grid.
    pub grid: Option<Grid>,
    /// Full width at half maximum of the spread of light, 0 for none.
    pub blur_fwhm_mm: f64,
    /// Largest signal of a pixel, in units of the unattenuated signal on the principal ray; acts on `counts`.
    pub saturation: Option<f64>,
    /// `counts` are whole numbers in [0, 2^bits − 1].
    pub bits: Option<u32>,
    /// What an image intensifier makes of the picture.
    pub intensifier: Option<Intensifier>,
}

impl Panel {
    /// The first number that makes no sense.
    ///
    /// # Errors
    /// Which one.
    pub fn check(&self) -> Result<(), Fault> {
        if let Some(scintillator) = &self.scintillator {
            let mm = scintillator.thickness_mm;
            want(mm > 0.0 && mm <= 1000.0, "detector.scintillator.thickness_mm", mm, "above 0, at most 1000 mm")?;
            let density = scintillator.density_g_per_cm3;
            want(density > 0.0 && density < 1000.0, "detector.scintillator.density_g_per_cm3", density, "above 0, below 1000")?;
        }
        if let Some(grid) = &self.grid {
            let share = grid.primary_transmission;
            want(share > 0.0 && share <= 1.0, "detector.grid.primary_transmission", share, "above 0, at most 1")?;
            let ratio = grid.strips.map_or(0.0, |strips| strips.ratio);
            want((0.0..=100.0).contains(&ratio), "detector.grid.strips.ratio", ratio, "0 to 100")?;
        }
        let fwhm_mm = self.blur_fwhm_mm;
        want((0.0..=100.0).contains(&fwhm_mm), "detector.blur_fwhm_mm", fwhm_mm, "0 to 100 mm")?;
        if let Some(most) = self.saturation {
            want(most > 0.0 && most.is_finite(), "detector.saturation", most, "a positive share of the unattenuated signal")?;
        }
        let bits = self.bits.unwrap_or(1);
        want((1..=24).contains(&bits), "detector.bits", f64::from(bits), "a whole number from 1 to 24")
    }
}

/// A layer in which photons are absorbed.
#[derive(Clone, Debug, PartialEq)]
pub struct Scintillator {
    /// What it is made of.
    pub material: Material,
    /// Its density.
    pub density_g_per_cm3: f64,
    /// Its thickness, crossed at right angles.
    pub thickness_mm: f64,
}

impl Scintillator {
    /// Share of the photons of `energy_kev` that interact: 1 − exp(−μ t).
    ///
    /// # Errors
    /// When the energy is outside the tables.
    pub fn absorption(&self, energy_kev: f64) -> Result<f64, PhysicsError> {
        let mu_per_cm = self.material.attenuation(energy_kev)?.total_cm2_per_g * self.density_g_per_cm3;
        Ok(-(-mu_per_cm * 0.1 * self.thickness_mm).exp_m1())
    }
}

/// An antiscatter grid.
#[derive(Clone, Copy, Debug, PartialEq, serde::Deserialize, serde::Serialize)]
#[serde(deny_unknown_fields)]
pub struct Grid {
    /// Share of the primary photons that it lets pass, at every energy and angle.
    pub primary_transmission: f64,
    /// What keeps scatter out; without it scatter passes like the primary. Only the Monte Carlo asks.
    #[serde(default)]
    pub strips: Option<Strips>,
}

/// Thin opaque strips of an antiscatter grid, each in line with the focal spot.
#[derive(Clone, Copy, Debug, PartialEq, serde::Deserialize, serde::Serialize)]
#[serde(deny_unknown_fields)]
pub struct Strips {
    /// Height of the strips over their distance.
    pub ratio: f64,
    /// The direction along which strip follows strip.
    pub across: Axis,
}

impl Strips {
    /// Share of what the primary would pass that a photon passes which meets the plane at `on_plane_mm` from the principal point in this
    /// direction of the camera, the detector being `sdd_mm` away.
    // Between strips at distance D and of height h = ratio · D, a ray whose slope differs by Δ from that of the strips moves by h·Δ across the
    // gap: the share 1 − ratio·|Δ| of such rays passes.
    #[must_use]
    pub fn share(&self, on_plane_mm: DVec2, direction: DVec3, sdd_mm: f64) -> f64 {
        let (place_mm, slope) = match self.across {
            Axis::Column => (on_plane_mm.x, direction.x / direction.z),
            Axis::Row => (on_plane_mm.y, direction.y / direction.z),
        };
        (1.0 - self.ratio * (slope - place_mm / sdd_mm).abs()).max(0.0)
    }
}
