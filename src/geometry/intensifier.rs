//! The calibration of an image intensifier: distortion by C-arm angle, the round mask, veiling glare.

use std::path::Path;

use glam::DVec2;
use serde::{Deserialize, Serialize};

use super::distortion::{Distortion, DistortionError};
use super::panel_window::PanelWindow;
use crate::foreign::read_small;
use crate::json::{JsonFault, parse_json};

/// Orbital and angulation angle of a C-arm, degrees.
pub type AnglesDeg = [f64; 2];
/// Angles that differ by less are one: no arm is read better.
const SAME_ANGLE_DEG: f64 = 0.1;

/// Whether both were taken at one angle of the C-arm.
#[must_use]
pub fn same_angle(a: AnglesDeg, b: AnglesDeg) -> bool {
    (0..2).all(|axis| (a[axis] - b[axis]).abs() < SAME_ANGLE_DEG)
}

/// Why a calibration cannot be used.
#[derive(Debug, thiserror::Error)]
pub enum IntensifierError {
    /// The operating system refused.
    #[error("cannot be read ({source})")]
    Read {
        /// What the system said.
        source: std::io::Error,
    },
    /// It is not JSON, or has the wrong keys.
    #[error("{place}: {detail}")]
    Json {
        /// Where in it.
        place: String,
        /// What is wrong.
        detail: String,
    },
    /// A view's numbers are no distortion.
    #[error("views[{view}]: {source}")]
    View {
        /// Its place in the list.
        view: usize,
        /// What is wrong.
        source: DistortionError,
    },
    /// A number makes no sense.
    #[error("{key} is {found}, expected {expected}")]
    Number {
        /// Its key.
        key: &'static str,
        /// Found.
        found: String,
        /// What would be right.
        expected: &'static str,
    },
    /// There are several views and nobody says at which angle the frame was taken.
    #[error("the distortion was measured at {views} angles: give the angle of this frame")]
    AngleUnknown {
        /// Views of the calibration.
        views: usize,
    },
    /// The frame is of another size.
    #[error(
        "the distortion was measured in frames of {expected:?} px, here are {found:?} px, which is no other size of the same picture"
    )]
    Size {
        /// Measured.
        expected: [u32; 2],
        /// The frame's.
        found: [u32; 2],
    },
}

/// Light scattered in the intensifier: a share of each point's light is spread about it by e^(−r/k)/(2πkr).
///
/// Seibert, Nalcioglu, Roeck (1984), "Characterization of the veiling glare PSF in x-ray image intensified fluoroscopy", Med. Phys. 11.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Glare {
    /// Share of the light that is spread.
    pub fraction: f64,
    /// k, in pixels of the frame as it is acquired.
    pub scale_px: f64,
}

/// Where the C-arm's angles come from: the same for calibration and use.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum AnglesFrom {
    /// Positioner primary (orbital) and secondary (angulation) angle of DICOM frames, with DICOM's signs.
    Positioner,
    /// Typed by a person.
    Given,
    /// One view, whose angle nobody states.
    Unknown,
}

/// The distortion at one angle.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct IntensifierView {
    /// The frame it was measured in.
    #[serde(default)]
    pub frame: String,
    /// Along the C.
    #[serde(default)]
    pub orbital_deg: Option<f64>,
    /// About the arm's axis.
    #[serde(default)]
    pub angulation_deg: Option<f64>,
    /// Spots that were used.
    #[serde(default)]
    pub spots: usize,
    /// Spots that fit no node of the grid, or badly.
    #[serde(default)]
    pub left_out: usize,
    /// √mean(dx² + dy²) of spots against a fit without them.
    #[serde(default)]
    pub held_out_rms_px: Option<f64>,
    /// Mean length of the shift at the spots: what the distortion amounts to.
    #[serde(default)]
    pub raw_mean_px: Option<f64>,
    /// Distance of the outermost spot used from the centre, over the disc's radius: beyond it the polynomial is extrapolated.
    #[serde(default)]
    pub reach: Option<f64>,
    /// Coefficients of undistorted minus distorted column: of 1, x, y, x², xy, y², … with x, y from the disc's centre over its radius.
    pub shift_u_px: Vec<f64>,
    /// The same of rows.
    pub shift_v_px: Vec<f64>,
}

impl IntensifierView {
    fn angles_deg(&self) -> Option<AnglesDeg> {
        Some([self.orbital_deg?, self.angulation_deg?])
    }

    fn shift_px(&self) -> Vec<DVec2> {
        // A list that is too short shows as NaN, which is refused.
        let v = self.shift_v_px.iter().copied().chain(std::iter::repeat(f64::NAN));
        let longer = self.shift_v_px.len().saturating_sub(self.shift_u_px.len());
        let u = self.shift_u_px.iter().copied().chain(std::iter::repeat_n(f64::NAN, longer));
        u.zip(v).map(|(u, v)| DVec2::new(u, v)).collect()
    }
}

/// The calibration of an image intensifier, a file of `calibration/carm/`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct IntensifierCalibration {
    /// Who measured, when, with what.
    pub origin: String,
    /// Columns and rows of the frames.
    pub size_px: [u32; 2],
    /// Centre of the round mask.
    pub disc_centre_px: [f64; 2],
    /// Radius of the round mask.
    pub disc_radius_px: f64,
    /// Order of the polynomials.
    pub order: usize,
    /// √mean(dx² + dy²) over the held-out spots of all views: what is left of the distortion.
    #[serde(default)]
    pub held_out_rms_px: Option<f64>,
    /// Where the angles come from.
    pub angles_from: AnglesFrom,
    /// Side of an undistorted pixel on the plate with the grid, if the grid's pitch was given.
    #[serde(default)]
    pub plate_pitch_mm: Option<f64>,
    /// Veiling glare; `null`: not measured.
    #[serde(default)]
    pub veiling_glare: Option<Glare>,
    /// The distortion by angle.
    pub views: Vec<IntensifierView>,
    /// What a person should know.
    #[serde(default)]
    pub notes: Vec<String>,
}

/// What an intensifier does to one picture.
#[derive(Clone, Debug, PartialEq)]
pub struct Intensifier {
    /// Columns and rows for which it holds.
    pub size_px: [u32; 2],
    /// Geometry and mask.
    pub distortion: Distortion,
    /// Veiling glare, if measured.
    pub glare: Option<Glare>,
    /// How it was interpolated, for people, and what is not in it; `None` where it was measured so.
    pub note: Option<String>,
}

/// The note of a part of the picture that glares.
const BEYOND_THE_PICTURE: &str = "veiling glare of what the console cut off is not drawn";

impl Intensifier {
    /// The same for a picture of `size_px`, binned or enlarged.
    ///
    /// # Errors
    /// When that is no other size of the same picture.
    pub fn for_size(&self, size_px: [u32; 2]) -> Result<Self, IntensifierError> {
        let scale = scale(self.size_px, size_px)?;
        Ok(Self {
            size_px,
            distortion: self.distortion.scaled(scale),
            glare: self.glare.map(|glare| Glare { scale_px: scale * glare.scale_px, ..glare }),
            note: self.note.clone(),
        })
    }

    /// The same for a picture of `size_px` whose pixels lie on the panel's as `window` says: what a console cropped, binned, enlarged or
    /// turned. `panel_px` are the panel's columns and rows, as many as it was measured in where nobody states them.
    ///
    /// # Errors
    /// When the panel's picture is no other size of the one it was measured in.
    pub fn through_window(
        &self,
        window: &PanelWindow,
        panel_px: Option<[u32; 2]>,
        size_px: [u32; 2],
    ) -> Result<Self, IntensifierError> {
        if *window == PanelWindow::WHOLE {
            return self.for_size(size_px);
        }
        let whole = self.for_size(panel_px.unwrap_or(self.size_px))?;
        let distortion = whole.distortion.through_window(window);
        // A frame that reaches beyond the picture is of another panel; corners of a turned one may.
        let share = if window.turned_rad == 0.0 { 1.0 } else { 0.5 };
        let end = share * DVec2::new(f64::from(size_px[0]), f64::from(size_px[1])) - 0.5;
        let end = window.detector_from_oriented().transform_point2(end) + 0.5;
        let reaches = |axis: usize| !(end[axis] < f64::from(whole.size_px[axis]) + 1.0);
        if panel_px.is_none() && (reaches(0) || reaches(1)) {
            return Err(IntensifierError::Size { expected: whole.size_px, found: end.to_array().map(|side| side as u32) });
        }
        let (centre, reach) = (distortion.centre_px(), DVec2::splat(distortion.radius_px()));
        let last = DVec2::new(f64::from(size_px[0]), f64::from(size_px[1])) - 0.5;
        let is_cut = (centre - reach).min_element() < -0.5 || (centre + reach - last).max_element() > 0.0;
        let glares = whole.glare.filter(|_| is_cut).map(|_| BEYOND_THE_PICTURE.to_owned());
        let notes: Vec<String> = whole.note.into_iter().chain(glares).collect();
        Ok(Self {
            size_px,
            distortion,
            glare: whole.glare.map(|glare| Glare { scale_px: glare.scale_px / window.step, ..glare }),
            note: Some(notes.join("; ")).filter(|words| !words.is_empty()),
        })
    }
}

/// How much larger one size of a picture is than another.
fn scale(expected: [u32; 2], found: [u32; 2]) -> Result<f64, IntensifierError> {
    let scale = f64::from(found[0]) / f64::from(expected[0]);
    let rows = f64::from(expected[1]) * scale;
    // Binning drops what is left over: less than a pixel.
    let same = scale > 0.0 && (rows - f64::from(found[1])).abs() < 1.0;
    if same { Ok(scale) } else { Err(IntensifierError::Size { expected, found }) }
}

impl IntensifierCalibration {
    /// Whether pictures of `size_px` are another size of those it was measured in.
    ///
    /// # Errors
    /// When they are not.
    pub fn check_size(&self, size_px: [u32; 2]) -> Result<(), IntensifierError> {
        scale(self.size_px, size_px).map(drop)
    }

    /// Reads a file, which errors leave to the caller to name.
    ///
    /// # Errors
    /// When it cannot be read, holds unknown keys, or a number makes no sense.
    pub fn read(path: &Path) -> Result<Self, IntensifierError> {
        let bytes = read_small(path).map_err(|source| IntensifierError::Read { source })?;
        let json = |JsonFault { place, detail }| IntensifierError::Json { place, detail };
        let file: Self = parse_json(&bytes).map_err(json)?;
        file.check()?;
        Ok(file)
    }

    /// Whether the numbers are a calibration: every view invertible over the disc, angles stated where there are several views.
    ///
    /// # Errors
    /// Which number is not.
    pub fn check(&self) -> Result<(), IntensifierError> {
        let number = |key, found: String, expected| Err(IntensifierError::Number { key, found, expected });
        if self.size_px.contains(&0) {
            return number("size_px", format!("{:?}", self.size_px), "positive numbers");
        }
        if self.views.is_empty() {
            return number("views", "an empty list".to_owned(), "one view at least");
        }
        if let Some(glare) = self.veiling_glare
            && !((0.0..1.0).contains(&glare.fraction) && glare.scale_px > 0.0 && glare.scale_px.is_finite())
        {
            return number("veiling_glare", format!("{glare:?}"), "a fraction in [0, 1) and a positive scale");
        }
        let stated = |view: &IntensifierView| view.angles_deg().is_some_and(|angles| angles.iter().all(|a| a.is_finite()));
        if self.views.len() > 1 && !self.views.iter().all(stated) {
            return number(
                "views",
                "without orbital_deg or angulation_deg".to_owned(),
                "both in every view where there are several",
            );
        }
        for (view, numbers) in self.views.iter().enumerate() {
            self.distortion(numbers.shift_px()).map_err(|source| IntensifierError::View { view, source })?;
        }
        Ok(())
    }

    fn distortion(&self, shift_px: Vec<DVec2>) -> Result<Distortion, DistortionError> {
        Distortion::new(DVec2::from_array(self.disc_centre_px), self.disc_radius_px, self.order, shift_px)
    }

    /// What the intensifier does at an angle of the C-arm. Coefficients are interpolated linearly in the orbital angle between the views
    /// of one angulation, then linearly in angulation between such rows (the other way round where that gives fewer rows); beyond the
    /// measured angles those of the nearest hold, and the note says so.
    ///
    /// # Errors
    /// When there are several views and no angle, or what was interpolated cannot be inverted.
    pub fn at(&self, angles_deg: Option<AnglesDeg>) -> Result<Intensifier, IntensifierError> {
        let (shift_px, note) = match (self.views.as_slice(), angles_deg) {
            ([only], None) => (only.shift_px(), None),
            (views, None) => return Err(IntensifierError::AngleUnknown { views: views.len() }),
            ([only], Some(asked)) => (only.shift_px(), only.angles_deg().and_then(|there| held_note(asked, there))),
            (views, Some(asked)) if asked.iter().all(|angle| angle.is_finite()) => {
                let measured: Vec<(AnglesDeg, Vec<DVec2>)> =
                    views.iter().filter_map(|view| Some((view.angles_deg()?, view.shift_px()))).collect();
                interpolate(&measured, asked)
            }
            (views, Some(_)) => return Err(IntensifierError::AngleUnknown { views: views.len() }),
        };
        let distortion = self.distortion(shift_px).map_err(|source| IntensifierError::View { view: 0, source })?;
        Ok(Intensifier { size_px: self.size_px, distortion, glare: self.veiling_glare, note })
    }
}

/// Says by how much the angle asked for lies outside those measured.
fn held_note(asked: AnglesDeg, held: AnglesDeg) -> Option<String> {
    (!same_angle(asked, held)).then(|| {
        format!(
            "the distortion at orbital {:.1}°, angulation {:.1}° was not measured: that of {:.1}°, {:.1}° is used",
            asked[0], asked[1], held[0], held[1]
        )
    })
}

fn interpolate(measured: &[(AnglesDeg, Vec<DVec2>)], asked: AnglesDeg) -> (Vec<DVec2>, Option<String>) {
    let by = |axis: usize| rows(measured, axis);
    let (along_orbital, along_angulation) = (by(1), by(0));
    let (rows, across) = if along_orbital.len() <= along_angulation.len() { (along_orbital, 1) } else { (along_angulation, 0) };
    let along = 1 - across;
    let mut held = asked;
    // Only of rows that are used: one of them may be shorter than the other.
    let mut in_row = |row: &Row| {
        let knots: Vec<(f64, &[DVec2])> = row.views.iter().map(|(angles, shift)| (angles[along], shift.as_slice())).collect();
        let (shift, at) = linear(&knots, asked[along]);
        if (at - asked[along]).abs() > (held[along] - asked[along]).abs() {
            held[along] = at;
        }
        shift
    };
    let above = rows.partition_point(|row| row.at_deg < asked[across]);
    let (low, high) = (above.saturating_sub(1), above.min(rows.len() - 1));
    let ends = [(rows[low].at_deg, in_row(&rows[low])), (rows[high].at_deg, in_row(&rows[high]))];
    let knots: Vec<(f64, &[DVec2])> = ends.iter().map(|(at, shift)| (*at, shift.as_slice())).take(1 + high - low).collect();
    let (shift, at) = linear(&knots, asked[across]);
    held[across] = at;
    (shift, held_note(asked, held))
}

/// Views of one angle on the other axis.
struct Row<'a> {
    at_deg: f64,
    views: Vec<&'a (AnglesDeg, Vec<DVec2>)>,
}

fn rows(measured: &[(AnglesDeg, Vec<DVec2>)], axis: usize) -> Vec<Row<'_>> {
    let mut sorted: Vec<&(AnglesDeg, Vec<DVec2>)> = measured.iter().collect();
    sorted.sort_by(|a, b| a.0[axis].total_cmp(&b.0[axis]));
    let mut rows: Vec<Row> = Vec::new();
    for view in sorted {
        match rows.last_mut().filter(|row| view.0[axis] - row.at_deg < SAME_ANGLE_DEG) {
            Some(row) => row.views.push(view),
            None => rows.push(Row { at_deg: view.0[axis], views: vec![view] }),
        }
    }
    rows.iter_mut().for_each(|row| row.views.sort_by(|a, b| a.0[1 - axis].total_cmp(&b.0[1 - axis])));
    rows
}

/// Between ascending knots; beyond them the nearest. Also the place for which it holds.
fn linear(knots: &[(f64, &[DVec2])], x: f64) -> (Vec<DVec2>, f64) {
    let above = knots.partition_point(|(at, _)| *at < x);
    match (above.checked_sub(1).map(|below| knots[below]), knots.get(above)) {
        (Some((x0, low)), Some((x1, high))) => {
            let share = (x - x0) / (x1 - x0);
            (low.iter().zip(*high).map(|(a, b)| a.lerp(*b, share)).collect(), x)
        }
        (Some((at, shift)), None) => (shift.to_vec(), at),
        (None, Some((at, shift))) => (shift.to_vec(), *at),
        (None, None) => (Vec::new(), x),
    }
}
