//! RTK's circular geometry: nine numbers a projection, in the XML that itk-rtk writes and reads.
//!
//! RTK turns patient points p by R = Rz(−in-plane) · Rx(−out-of-plane) · Ry(−gantry) into a frame p' in which the source stands at
//! (sx, sy, SID) and the detector is the plane z' = SID − SDD, so +z' points to the source. A point is seen at
//!
//! u = SDD (x' − sx)/(SID − z') + sx − ox,   v = SDD (y' − sy)/(SID − z') + sy − oy   (mm on the detector),
//!
//! with (ox, oy) the projection offsets. Seen from the source, u runs to the right and v upwards, as z' points to the viewer. Our camera
//! has rows running down and z away: R = diag(1, −1, −1) · R_camera. The panel's millimetres have their origin in its middle:
//! u = (column − (columns − 1)/2) · pitch, v = −(row − (rows − 1)/2) · pitch, the centre of the first pixel being (0, 0). An ITK image says
//! so with direction (1, 0; 0, −1) and origin (−(columns − 1)/2 · pitch, +(rows − 1)/2 · pitch).

use glam::{DMat3, DQuat, DVec3};

use super::numbers::{line, matrix, number, numbers, positive, right_angled, show};
use super::{ExchangedCamera, Format, FormatError, Known};
use crate::geometry::{Intrinsics, Rigid};

/// One projection of RTK's circular geometry.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct RtkParameters {
    /// Source to isocentre (the patient axes' origin), along the detector's normal.
    pub source_to_isocentre_mm: f64,
    /// Source to detector, along the detector's normal.
    pub source_to_detector_mm: f64,
    /// About the patient's y.
    pub gantry_rad: f64,
    /// About x.
    pub out_of_plane_rad: f64,
    /// About z.
    pub in_plane_rad: f64,
    /// Of the source, in the turned frame.
    pub source_offset_mm: [f64; 2],
    /// Of the detector's origin, in the turned frame.
    pub projection_offset_mm: [f64; 2],
}

impl RtkParameters {
    /// Of a camera; the panel's pitch between rows follows from the focal lengths, since both are the same distance.
    ///
    /// # Errors
    /// When the camera has skew, which RTK's detector cannot have.
    pub fn of_camera(k: &Intrinsics, camera_from_lps: &Rigid, size_px: [u32; 2], pitch_mm: f64) -> Result<Self, FormatError> {
        right_angled(k, "0: RTK's detector has right angles")?;
        let turn = DMat3::from_diagonal(DVec3::new(1.0, -1.0, -1.0)) * camera_from_lps.rotation_matrix();
        let [gantry_rad, out_of_plane_rad, in_plane_rad] = angles(turn);
        let t = camera_from_lps.translation_mm;
        let source = [-t.x, t.y];
        let pitch_y_mm = pitch_mm * k.fx / k.fy;
        let middle = size_px.map(|n| 0.5 * (f64::from(n) - 1.0));
        Ok(Self {
            source_to_isocentre_mm: t.z,
            source_to_detector_mm: k.fx * pitch_mm,
            gantry_rad,
            out_of_plane_rad,
            in_plane_rad,
            source_offset_mm: source,
            projection_offset_mm: [source[0] - (k.cx - middle[0]) * pitch_mm, source[1] + (k.cy - middle[1]) * pitch_y_mm],
        })
    }

    /// The camera that sees the same on a panel of this size and pitch (between columns, between rows).
    ///
    /// # Errors
    /// When the distance or a pitch is not positive, or a number is not finite.
    pub fn camera(&self, size_px: [u32; 2], pitch_mm: [f64; 2]) -> Result<(Intrinsics, Rigid), FormatError> {
        let sdd = positive(self.source_to_detector_mm, "SourceToDetectorDistance")?;
        let [pitch_x, pitch_y] = [positive(pitch_mm[0], "pitch")?, positive(pitch_mm[1], "pitch")?];
        let middle = size_px.map(|n| 0.5 * (f64::from(n) - 1.0));
        let ([sx, sy], [ox, oy]) = (self.source_offset_mm, self.projection_offset_mm);
        let intrinsics = Intrinsics {
            fx: sdd / pitch_x,
            fy: sdd / pitch_y,
            skew: 0.0,
            cx: middle[0] + (sx - ox) / pitch_x,
            cy: middle[1] - (sy - oy) / pitch_y,
        };
        let half_turn = DQuat::from_xyzw(1.0, 0.0, 0.0, 0.0);
        let rotation = (half_turn * self.turn()).normalize();
        let translation_mm = DVec3::new(-sx, sy, self.source_to_isocentre_mm);
        if !(rotation.is_finite() && translation_mm.is_finite() && intrinsics.cx.is_finite() && intrinsics.cy.is_finite()) {
            return Err(FormatError::NotFinite { what: "geometry".to_owned() });
        }
        Ok((intrinsics, Rigid { rotation, translation_mm }))
    }

    /// R.
    fn turn(&self) -> DQuat {
        DQuat::from_rotation_z(-self.in_plane_rad)
            * DQuat::from_rotation_x(-self.out_of_plane_rad)
            * DQuat::from_rotation_y(-self.gantry_rad)
    }

    /// The 3×4 matrix as RTK states it: patient mm to detector mm, third coordinate the negative depth.
    #[must_use]
    pub fn matrix(&self) -> [[f64; 4]; 3] {
        let r = DMat3::from_quat(self.turn());
        let ([sx, sy], [ox, oy]) = (self.source_offset_mm, self.projection_offset_mm);
        let (sid, sdd) = (self.source_to_isocentre_mm, self.source_to_detector_mm);
        let third = [r.x_axis.z, r.y_axis.z, r.z_axis.z, -sid];
        let first = [r.x_axis.x, r.y_axis.x, r.z_axis.x, -sx];
        let second = [r.x_axis.y, r.y_axis.y, r.z_axis.y, -sy];
        [
            std::array::from_fn(|j| -sdd * first[j] + (sx - ox) * third[j]),
            std::array::from_fn(|j| -sdd * second[j] + (sy - oy) * third[j]),
            third,
        ]
    }
}

/// Gantry, out-of-plane and in-plane angle of a rotation, in [0, 2π).
///
/// R = Rz(c) · Rx(a) · Ry(b) has the last row (−cos a sin b, sin a, cos a cos b); what remains after Ry(b) is undone has the first column
/// (cos c, sin c, 0). So c takes up the whole turn where cos a vanishes.
fn angles(turn: DMat3) -> [f64; 3] {
    let [x, y, z] = [turn.x_axis.z, turn.y_axis.z, turn.z_axis.z];
    let a = y.atan2(x.hypot(z));
    let b = if x.hypot(z) > 1e-12 { (-x).atan2(z) } else { 0.0 };
    let rest = turn * DMat3::from_rotation_y(-b);
    let c = rest.x_axis.y.atan2(rest.x_axis.x);
    [-b, -a, -c].map(|angle| angle.rem_euclid(std::f64::consts::TAU))
}

const LENGTHS: [&str; 6] = [
    "SourceToIsocenterDistance",
    "SourceToDetectorDistance",
    "SourceOffsetX",
    "SourceOffsetY",
    "ProjectionOffsetX",
    "ProjectionOffsetY",
];
const ANGLES: [&str; 4] = ["GantryAngle", "Angle", "OutOfPlaneAngle", "InPlaneAngle"];
/// Known, but no part of a pose.
const UNUSED: [&str; 4] = ["CollimationUInf", "CollimationUSup", "CollimationVInf", "CollimationVSup"];

/// Sets what `key` says; whether it is known.
fn set(parameters: &mut RtkParameters, key: &str, value: f64) -> bool {
    let slot = match key {
        "SourceToIsocenterDistance" => &mut parameters.source_to_isocentre_mm,
        "SourceToDetectorDistance" => &mut parameters.source_to_detector_mm,
        "SourceOffsetX" => &mut parameters.source_offset_mm[0],
        "SourceOffsetY" => &mut parameters.source_offset_mm[1],
        "ProjectionOffsetX" => &mut parameters.projection_offset_mm[0],
        "ProjectionOffsetY" => &mut parameters.projection_offset_mm[1],
        "GantryAngle" | "Angle" => &mut parameters.gantry_rad,
        "OutOfPlaneAngle" => &mut parameters.out_of_plane_rad,
        "InPlaneAngle" => &mut parameters.in_plane_rad,
        _ => return false,
    };
    *slot = if ANGLES.contains(&key) { value.to_radians() } else { value };
    true
}

/// The one projection of a geometry file.
fn parse(text: &str) -> Result<RtkParameters, FormatError> {
    let wrong = |detail: String| FormatError::Syntax { expected: "an RTK geometry", detail };
    // RTK's files declare a document type without a body.
    let options = roxmltree::ParsingOptions { allow_dtd: true, nodes_limit: 100_000, ..Default::default() };
    let document = roxmltree::Document::parse_with_options(text, options).map_err(|error| wrong(error.to_string()))?;
    let root = document.root_element();
    if root.tag_name().name() != "RTKThreeDCircularGeometry" {
        return Err(wrong(format!("the outermost element is <{}>", root.tag_name().name())));
    }
    if !matches!(root.attribute("version"), Some("2" | "3")) {
        let found = root.attribute("version").unwrap_or("absent").to_owned();
        return Err(FormatError::Unsupported { key: "version".to_owned(), found, expected: "2 or 3" });
    }
    let projections = root.children().filter(|node| node.has_tag_name("Projection")).count();
    if projections != 1 {
        return Err(if projections == 0 {
            FormatError::MissingKey { key: "Projection" }
        } else {
            FormatError::Several { found: projections }
        });
    }
    let mut parameters = RtkParameters::default();
    let mut stated = None;
    let inner = root.children().filter(|node| node.has_tag_name("Projection")).flat_map(|node| node.children());
    for node in root.children().chain(inner).filter(|node| node.is_element() && !node.has_tag_name("Projection")) {
        let (key, content) = (node.tag_name().name(), node.text().unwrap_or_default().trim());
        if key == "Matrix" {
            let values = numbers(content, "Matrix")?;
            let rows: Vec<Vec<f64>> = values.chunks(4).map(<[f64]>::to_vec).collect();
            stated = Some(matrix::<3, 4>(&rows, "Matrix", "3 rows of 4 numbers")?);
            continue;
        }
        let value = number(content, key);
        if key == "RadiusCylindricalDetector" {
            if value? != 0.0 {
                let found = content.to_owned();
                return Err(FormatError::Unsupported { key: key.to_owned(), found, expected: "0: a flat detector" });
            }
        } else if !UNUSED.contains(&key)
            && !set(&mut parameters, key, if LENGTHS.contains(&key) || ANGLES.contains(&key) { value? } else { 0.0 })
        {
            let expected = [&LENGTHS[..], &ANGLES, &UNUSED, &["Matrix", "RadiusCylindricalDetector"]].concat().join(", ");
            return Err(FormatError::UnknownKey { key: key.to_owned(), expected });
        }
    }
    if parameters.source_to_detector_mm == 0.0 {
        let (key, found) = ("SourceToDetectorDistance".to_owned(), "0".to_owned());
        return Err(FormatError::Unsupported { key, found, expected: "positive: parallel beams have no focal spot" });
    }
    if let Some(stated) = stated {
        // As far as RTK itself lets the two differ.
        const LIMIT: f64 = 1e-3;
        let own = parameters.matrix();
        let pairs = stated.iter().flatten().zip(own.iter().flatten());
        let difference = pairs.map(|(a, b)| (a - b).abs()).fold(0.0f64, f64::max);
        if !(difference <= LIMIT) {
            return Err(FormatError::Inconsistent { what: "Matrix and parameters", difference, limit: LIMIT });
        }
    }
    Ok(parameters)
}

pub(super) fn read(text: &str, known: &Known) -> Result<ExchangedCamera, FormatError> {
    let parameters = parse(text)?;
    let panel = ExchangedCamera { size_px: known.size_px, pitch_mm: known.pitch_mm, ..ExchangedCamera::placed(Rigid::IDENTITY) };
    let size_px = panel.size_for(Format::Rtk)?;
    let mut pitch_mm = panel.pitch_for(Format::Rtk)?;
    // One pitch beside a K of unequal focal lengths is the pitch between columns.
    if let Some(k) = known.intrinsics
        && pitch_mm[0] == pitch_mm[1]
    {
        pitch_mm[1] = pitch_mm[0] * k.fx / k.fy;
    }
    let (intrinsics, camera_from_lps) = parameters.camera(size_px, pitch_mm)?;
    let mut camera = ExchangedCamera {
        intrinsics: Some(intrinsics),
        size_px: Some(size_px),
        pitch_mm: Some(pitch_mm),
        ..ExchangedCamera::placed(camera_from_lps)
    };
    if !(parameters.source_to_isocentre_mm > 0.0) {
        camera.notes.push("the volume's origin lies behind the source: was the geometry made from a mirrored matrix?".to_owned());
    }
    if let Some(k) = known.intrinsics {
        let off = [k.fx - intrinsics.fx, k.fy - intrinsics.fy, k.cx - intrinsics.cx, k.cy - intrinsics.cy];
        let worst = off.into_iter().fold(0.0f64, |worst, x| worst.max(x.abs()));
        if !(worst <= 0.01) {
            camera.notes.push(format!("K of the geometry was used; it differs from the given K by up to {worst:.2} px"));
        }
    }
    Ok(camera)
}

pub(super) fn write(camera: &ExchangedCamera) -> Result<String, FormatError> {
    let k = camera.intrinsics_for(Format::Rtk)?;
    let size_px = camera.size_for(Format::Rtk)?;
    let [pitch_mm, _] = camera.pitch_for(Format::Rtk)?;
    let p = RtkParameters::of_camera(&k, &camera.camera_from_lps, size_px, pitch_mm)?;
    let pitch_y_mm = pitch_mm * k.fx / k.fy;
    let [columns, rows] = size_px.map(f64::from);
    let mut text = format!(
        "<?xml version=\"1.0\"?>\n<!DOCTYPE RTKGEOMETRY>\n<!-- projection image: {columns} x {rows} px, spacing ({}, {}) mm, direction (1, 0; 0, -1), \
         origin ({}, {}) mm -->\n<RTKThreeDCircularGeometry version=\"3\">\n",
        show(pitch_mm),
        show(pitch_y_mm),
        show(-0.5 * (columns - 1.0) * pitch_mm),
        show(0.5 * (rows - 1.0) * pitch_y_mm)
    );
    let mut element = |key: &str, value: f64| text += &format!("    <{key}>{}</{key}>\n", show(value));
    element("SourceToIsocenterDistance", p.source_to_isocentre_mm);
    element("SourceToDetectorDistance", p.source_to_detector_mm);
    element("SourceOffsetX", p.source_offset_mm[0]);
    element("SourceOffsetY", p.source_offset_mm[1]);
    element("ProjectionOffsetX", p.projection_offset_mm[0]);
    element("ProjectionOffsetY", p.projection_offset_mm[1]);
    element("InPlaneAngle", p.in_plane_rad.to_degrees());
    element("OutOfPlaneAngle", p.out_of_plane_rad.to_degrees());
    text += &format!("  <Projection>\n    <GantryAngle>{}</GantryAngle>\n    <Matrix>\n", show(p.gantry_rad.to_degrees()));
    for row in p.matrix() {
        text += &format!("        {}\n", line(&row));
    }
    text += "    </Matrix>\n  </Projection>\n</RTKThreeDCircularGeometry>\n";
    Ok(text)
}
