//! From a frame as it was read to the frame that is registered and compared: the console's geometry undone, the panel calibrated.
//! The log keeps frames as read; live and replay import them alike.

use std::sync::Arc;

use super::file::Setup;
use super::stated_k::stated_k;
use crate::acquire::{DetectorCalibration, Frame};
use crate::geometry::{CarmCalibration, ConsoleGeometry, PanelWindow};
use crate::pose::{FrameK, IntrinsicsFile, whole_binning};
use crate::telemetry::CarmSample;

/// What a session knows about its console and panel.
#[derive(Clone, Debug)]
pub struct Import {
    carm: Option<CarmCalibration>,
    console: Option<ConsoleGeometry>,
    detector: Option<Box<DetectorCalibration>>,
    intrinsics: Option<IntrinsicsFile>,
}

/// A frame ready to be registered.
#[derive(Clone, Debug)]
pub struct Imported {
    /// As it lies on the panel; [`Frame::correction`] says what was done to it.
    pub frame: Arc<Frame>,
    /// Size, pitch and principal point of this frame; `None` without a calibration, or when the frame's size does not fit it.
    pub carm: Option<CarmCalibration>,
    /// Why a pose of the frame may be wrong however well it fits: its size is not that of the calibration, and K with it is not known.
    pub doubt: Option<String>,
    /// K that the session states, as it holds for this frame, or why it does not; `None` where it states none.
    pub stated: Option<Result<FrameK, String>>,
    /// Kind and sentence of what a person must know.
    pub warnings: Vec<(&'static str, String)>,
}

/// What a frame's size makes of console and calibration.
struct Fitted {
    console: Option<ConsoleGeometry>,
    carm: Option<CarmCalibration>,
    doubt: Option<String>,
}

impl Import {
    /// For the frames of a session.
    #[must_use]
    pub fn of(setup: &Setup) -> Self {
        let (console, detector) = (setup.session.console.clone(), setup.detector.clone());
        Self { carm: setup.carm.clone(), console, detector, intrinsics: setup.intrinsics }
    }

    /// Imports one frame; `told` is what telemetry says of its exposure, where it is bound to one.
    #[must_use]
    pub fn frame(&self, read: &Arc<Frame>, told: Option<&CarmSample>) -> Imported {
        let mut warnings = Vec::new();
        self.question_tags(read, &mut warnings);
        let stored_px = read.size_px.map(|side| side as u32);
        let Fitted { console, carm, doubt } = self.fitted(read, stored_px, &mut warnings);
        let mut frame = Arc::clone(read);
        if let Some(console) = &console {
            let of_carm = self.carm.as_ref().map(|carm| [carm.columns_px, carm.rows_px]);
            frame = Arc::new(frame.oriented(console, of_carm.or(self.intrinsics.and_then(|file| file.size_px))));
        }
        if let Some(detector) = &self.detector {
            let window = console.as_ref().map_or(PanelWindow::WHOLE, |console| console.window(stored_px));
            match detector.correct_told(&frame, window, told) {
                Ok(corrected) => {
                    let doubt = corrected.correction.as_ref().and_then(|correction| correction.flood_doubt.as_ref());
                    warnings.extend(doubt.map(|doubt| ("flood of another filter", format!("{}: {doubt}", read.name))));
                    frame = Arc::new(corrected);
                }
                Err(reason) => warnings.push(("detector calibration", format!("{}: {reason}", read.name))),
            }
        }
        let stated = self.intrinsics.map(|file| stated_k(&file, self.console.as_ref(), stored_px, &read.name));
        Imported { frame, carm, doubt, stated, warnings }
    }

    /// The console as declared; where none is, a frame whose size is a whole binning of the calibration's is taken for that.
    fn fitted(&self, read: &Frame, stored_px: [u32; 2], warnings: &mut Vec<(&'static str, String)>) -> Fitted {
        let console = self.console.clone();
        let Some(carm) = &self.carm else { return Fitted { console, carm: None, doubt: None } };
        let error = match console.clone().unwrap_or_default().calibration_of(carm, stored_px) {
            Ok(fitted) => return Fitted { console, carm: Some(fitted), doubt: None },
            Err(error) => error,
        };
        let factor = whole_binning([carm.columns_px, carm.rows_px], stored_px).filter(|_| console.is_none());
        let binned = factor.and_then(|binning| {
            let console = ConsoleGeometry { binning, ..ConsoleGeometry::default() };
            let fitted = console.calibration_of(carm, stored_px).ok()?;
            Some((binning, console, fitted))
        });
        if let Some((binning, console, fitted)) = binned {
            let words = format!("{}: {error}; undeclared, it is taken as binned {binning} x {binning}", read.name);
            warnings.push(("frame size", words));
            return Fitted { console: Some(console), carm: Some(fitted), doubt: None };
        }
        warnings.push(("frame size", format!("{}: {error}", read.name)));
        let doubt = Some(format!("K is not the calibrated one but solved from the beads alone: {error}"));
        Fitted { console, carm: None, doubt }
    }

    /// A file that says how its console turned the picture must not contradict the session.
    fn question_tags(&self, read: &Frame, warnings: &mut Vec<(&'static str, String)>) {
        let Some(tagged) = read.tags.field_of_view_rotation_deg.map(|deg| deg.rem_euclid(360.0)) else { return };
        // A matrix says it all, and more finely than a tag.
        if self.console.as_ref().is_some_and(|console| console.detector_from_image.is_some()) {
            return;
        }
        let declared = self.console.as_ref().map(|console| console.rotation_deg);
        if declared.unwrap_or(0.0).rem_euclid(360.0) == tagged {
            return;
        }
        let said = declared.map_or("declares no console".to_owned(), |deg| format!("declares rotation_deg {deg}"));
        warnings.push((
            "console geometry",
            format!(
                "{}: the file says that the console turned it by {tagged} degrees, the session {said}; declare \"console\": \
                 {{\"rotation_deg\": {tagged}}} if the file is right",
                read.name
            ),
        ));
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::acquire::Domain;
    use crate::image::Image;

    fn carm() -> CarmCalibration {
        serde_json::from_str(include_str!("../../calibration/carm/live-620x480.json")).expect("a calibration")
    }

    fn imported([columns, rows]: [usize; 2]) -> Imported {
        let import = Import { carm: Some(carm()), console: None, detector: None, intrinsics: None };
        let frame = Frame::from_pixels("f", Image::filled(columns, rows, 1.0f32), Domain::Linear).expect("a frame");
        import.frame(&Arc::new(frame), None)
    }

    #[test]
    fn a_whole_binning_is_taken_for_that_and_another_size_is_in_doubt() {
        let whole = imported([620, 480]);
        assert!(whole.warnings.is_empty() && whole.doubt.is_none() && whole.frame.correction.is_none(), "the control");
        assert_eq!(whole.carm.map(|carm| carm.pitch_mm), Some(carm().pitch_mm));
        for ([columns, rows], factor) in [([310, 240], 2.0), ([206, 160], 3.0)] {
            let binned = imported([columns, rows]);
            assert!(binned.doubt.is_none() && binned.warnings.len() == 1, "{:?}", binned.warnings);
            assert!(binned.warnings[0].1.contains(&format!("binned {factor} x {factor}")), "{:?}", binned.warnings);
            let fitted = binned.carm.expect("it fits");
            assert_eq!([fitted.columns_px as usize, fitted.rows_px as usize], [columns, rows]);
            assert!((fitted.pitch_mm - factor * carm().pitch_mm).abs() < 1e-12, "{}", fitted.pitch_mm);
            let stored = binned.frame.correction.as_ref().and_then(|correction| correction.stored.as_ref()).expect("it says so");
            let step = stored.console.window(stored.size_px).step;
            assert!((step - factor).abs() < 1e-12, "{step}");
        }
        let cropped = imported([600, 470]);
        assert!(cropped.carm.is_none(), "nobody knows its K");
        let doubt = cropped.doubt.unwrap_or_default();
        assert!(doubt.contains("[600, 470]") && doubt.contains("[620, 480]"), "{doubt}");
    }

    fn told(copper_mm: f64) -> CarmSample {
        CarmSample { tube_kvp: 90.0, filter_mm_cu: copper_mm, ..CarmSample::UNTOLD }
    }

    /// The air map was the first of that voltage, whatever was in the beam, and of a file without a voltage the first of all.
    #[test]
    fn the_flood_of_a_file_that_says_nothing_is_that_of_the_beam_that_telemetry_tells() {
        let beam = |kvp: f64, filter: &str, gain: f64| crate::acquire::AirBeam {
            tube_kvp: Some(kvp),
            added_filter: filter.parse().ok(),
            gain_value_per_quantum: Some(gain),
            ..Default::default()
        };
        let mut record: crate::acquire::DetectorRecord =
            serde_json::from_value(serde_json::json!({"origin": "test", "columns_px": 620, "rows_px": 480})).expect("a record");
        record.beams = vec![beam(70.0, "none", 1.0), beam(90.0, "none", 2.0), beam(90.0, "copper=0.2", 3.0)];
        let detector = Some(Box::new(DetectorCalibration { record, maps: Default::default() }));
        let import = Import { carm: None, console: None, detector, intrinsics: None };
        let frame = Frame::from_pixels("f", Image::filled(620, 480, 1.0f32), Domain::Linear).expect("a frame");
        let frame = Arc::new(frame);
        let by = |told: Option<CarmSample>| {
            let Imported { frame, warnings, .. } = import.frame(&frame, told.as_ref());
            let gain = frame.correction.as_ref().and_then(|correction| correction.gain_value_per_quantum);
            (gain, warnings.into_iter().map(|(kind, words)| format!("{kind}: {words}")).collect::<String>())
        };
        assert_eq!(by(Some(told(0.2))), (Some(3.0), String::new()));
        assert_eq!(by(Some(told(0.0))), (Some(2.0), String::new()));
        for (told, word) in [(None, "does not say which was in"), (Some(told(0.6)), "taken with 0.60 mm of copper")] {
            let (_, words) = by(told);
            assert!(words.starts_with("flood of another filter: f: ") && words.contains(word), "{words}");
        }
    }
}
