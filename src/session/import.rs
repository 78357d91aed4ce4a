//! From a frame as it was read to the frame that is registered and compared: the console's geometry undone, the panel calibrated.
//! The log keeps frames as read; live and replay import them alike.

use std::sync::Arc;

use super::file::Setup;
use crate::acquire::{DetectorCalibration, Frame};
use crate::geometry::{CarmCalibration, ConsoleGeometry, PanelWindow};

/// What a session knows about its console and panel.
#[derive(Clone, Debug)]
pub struct Import {
    carm: Option<CarmCalibration>,
    console: Option<ConsoleGeometry>,
    detector: Option<Box<DetectorCalibration>>,
}

/// A frame ready to be registered.
#[derive(Clone, Debug)]
pub struct Imported {
    /// As it lies on the panel; [`Frame::correction`] says what was done to it.
    pub frame: Arc<Frame>,
    /// Size, pitch and principal point of this frame; `None` without a calibration, or when the frame's size does not fit it.
    pub carm: Option<CarmCalibration>,
    /// Kind and sentence of what a person must know.
    pub warnings: Vec<(&'static str, String)>,
}

impl Import {
    /// For the frames of a session.
    #[must_use]
    pub fn of(setup: &Setup) -> Self {
        Self { carm: setup.carm.clone(), console: setup.session.console.clone(), detector: setup.detector.clone() }
    }

    /// Imports one frame.
    #[must_use]
    pub fn frame(&self, read: &Arc<Frame>) -> Imported {
        let mut warnings = Vec::new();
        let undeclared = ConsoleGeometry::default();
        let console = self.console.as_ref().unwrap_or(&undeclared);
        self.question_tags(read, &mut warnings);
        let stored_px = read.size_px.map(|side| side as u32);
        let carm = self.carm.as_ref().and_then(|carm| {
            let fitted = console.calibration_of(carm, stored_px);
            fitted.map_err(|error| warnings.push(("frame size", format!("{}: {error}", read.name)))).ok()
        });
        let mut frame = Arc::clone(read);
        if let Some(console) = &self.console {
            frame = Arc::new(frame.oriented(console, self.carm.as_ref().map(|carm| [carm.columns_px, carm.rows_px])));
        }
        if let Some(detector) = &self.detector {
            let window = self.console.as_ref().map_or(PanelWindow::WHOLE, |console| console.window(stored_px));
            match detector.correct(&frame, window) {
                Ok(corrected) => frame = Arc::new(corrected),
                Err(reason) => warnings.push(("detector calibration", format!("{}: {reason}", read.name))),
            }
        }
        Imported { frame, carm, warnings }
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
