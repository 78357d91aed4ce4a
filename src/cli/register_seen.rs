//! A frame as it lies on the panel, with its K: what `register` makes of a file before it looks for beads.

use std::path::Path;

use super::register_args::{Given, RegisterArgs};
use super::register_error::RegisterError;
use crate::acquire::{DetectorCalibration, Frame};
use crate::geometry::{AnglesFrom, ConsoleGeometry, Intensifier, IntensifierCalibration, Intrinsics, PanelWindow};
use crate::pose::{
    IntrinsicsFile, IntrinsicsPrior, Panel, Pose, Prior, Registration, intrinsics_of, read_console, solve_console, whole_binning,
};

/// What the console did.
pub(super) struct Console {
    pub geometry: ConsoleGeometry,
    /// Cropping and enlargement were solved with K, which is solved again with the pose.
    pub solve_intrinsics: bool,
}

impl Console {
    /// What the console did, as stated, or from the beads; a pose that says why not where they do not tell.
    pub fn of(
        args: &RegisterArgs,
        given: &Given,
        stored: &Frame,
        notes: &mut Vec<String>,
    ) -> Result<Result<Option<Self>, Box<Pose>>, RegisterError> {
        let Some(path) = args.console.as_deref() else { return Ok(Ok(None)) };
        if path.as_os_str() != "solve" {
            return Ok(Ok(Some(Self { geometry: read_console(path)?, solve_intrinsics: false })));
        }
        let panel = given
            .file
            .as_ref()
            .zip(given.priors.first())
            .and_then(|(file, prior)| Some(Panel { intrinsics: file.intrinsics, size_px: file.size_px?, prior: *prior }));
        let panel = panel.ok_or(RegisterError::SolveWhat)?;
        let as_stored = Seen::plain(stored.clone(), None, None, None);
        let request = as_stored.request(args, given, None);
        Ok(match solve_console(&request, stored, &panel) {
            Ok(found) => {
                notes.push(found.words);
                Ok(Some(Self { geometry: found.console, solve_intrinsics: found.with_intrinsics }))
            }
            Err(refusal) => Err(Box::new(request.refuse(&refusal))),
        })
    }
}

/// A frame as it lies on the panel, with its K.
pub(super) struct Seen {
    pub frame: Frame,
    pub intrinsics: Option<Intrinsics>,
    /// How sure K is; `None`: it is known, or solved.
    pub prior: Option<IntrinsicsPrior>,
    pub pitch_mm: Option<f64>,
    /// From the panel's axes to the frame's, about the beam.
    pub turn_rad: f64,
    /// What was done and assumed.
    pub notes: Vec<String>,
}

impl Seen {
    fn plain(frame: Frame, intrinsics: Option<Intrinsics>, prior: Option<IntrinsicsPrior>, pitch_mm: Option<f64>) -> Self {
        Self { frame, intrinsics, prior, pitch_mm, turn_rad: 0.0, notes: Vec::new() }
    }

    /// The frame stored at `path`, oriented and corrected, with K of the file, or of the header, as the console left it.
    pub fn of(
        args: &RegisterArgs,
        path: &Path,
        stored: &Frame,
        file: Option<&IntrinsicsFile>,
        console: Option<&Console>,
    ) -> Result<Self, RegisterError> {
        if args.distortion.is_some() && console.is_some_and(|console| console.solve_intrinsics) {
            return Err(RegisterError::DistortedAndSolved);
        }
        let found = stored.size_px.map(|n| n as u32);
        let panel_px = file.and_then(|file| file.size_px);
        let console_error = |error| RegisterError::Console { path: args.console.clone().unwrap_or_default(), error };
        let window = match (console, panel_px) {
            (Some(console), Some(panel_px)) => console.geometry.window_on(panel_px, found).map_err(console_error)?,
            (Some(console), None) => console.geometry.window(found),
            (None, _) => PanelWindow::WHOLE,
        };
        let mut frame = console.map_or_else(|| stored.clone(), |console| stored.oriented(&console.geometry, panel_px));
        let undone = frame.correction.as_ref().map(|correction| correction.console.clone()).unwrap_or_default();
        if let Some(calibration) = &args.detector {
            frame = DetectorCalibration::apply_file(calibration, &frame, window)?;
        }
        let tagged_pitch_mm = frame.tags.pitch_mm.map(|pitch| pitch[0]);
        let Some(file) = file else {
            let (words, intrinsics, pitch_mm) = match intrinsics_of(&frame) {
                Some((intrinsics, pitch_mm, words)) => (words, Some(intrinsics), Some(pitch_mm)),
                None => {
                    let words = "no --intrinsics, and no SID with pixel spacing in the header: K is solved from the beads";
                    (words.to_owned(), None, tagged_pitch_mm)
                }
            };
            let notes = [undone, vec![words]].concat();
            return Ok(Self { turn_rad: window.turned_rad, notes, ..Self::plain(frame, intrinsics, None, pitch_mm) });
        };
        if let Some(console) = console {
            let (intrinsics, turn_rad) = window.intrinsics(&file.intrinsics);
            let (intrinsics, prior) = if console.solve_intrinsics {
                (None, None)
            } else {
                (Some(intrinsics), file.prior().map(|prior| prior.seen_through(&window)))
            };
            let pitch_mm = file.pitch_mm.map(|pitch| pitch * window.step).or(tagged_pitch_mm);
            return Ok(Self { turn_rad, notes: undone, ..Self::plain(frame, intrinsics, prior, pitch_mm) });
        }
        let expected = file.size_px.unwrap_or(found);
        let size =
            || RegisterError::Size { path: args.intrinsics.clone().unwrap_or_default(), expected, frame: path.to_owned(), found };
        let factor = whole_binning(expected, found).ok_or_else(size)?;
        if factor == 1 {
            return Ok(Self::plain(frame, Some(file.intrinsics), file.prior(), file.pitch_mm.or(tagged_pitch_mm)));
        }
        let notes = vec![format!("K is for {expected:?} px: the frame is taken as binned {factor} x {factor}")];
        let factor = f64::from(factor);
        let pitch_mm = file.pitch_mm.map(|pitch| pitch * factor).or(tagged_pitch_mm);
        let prior = file.prior().map(|prior| prior.binned(factor));
        Ok(Self { notes, ..Self::plain(frame, Some(file.intrinsics.binned(factor)), prior, pitch_mm) })
    }

    /// The request for one frame.
    pub fn request<'a>(&self, args: &RegisterArgs, given: &'a Given, prior: Option<&'a Prior>) -> Registration<'a> {
        Registration {
            intrinsics: self.intrinsics,
            intrinsics_prior: self.prior,
            pitch_mm: self.pitch_mm,
            prior,
            ignore_prior: args.ignore_prior,
            one_body: args.one_body,
            landmarks: &given.landmarks,
            bead_radius_mm: args.bead_radius,
            ..Registration::new(self.frame.size_px.map(|n| n as u32), &given.layout)
        }
    }

    /// What the image intensifier did to the frame, in the frame's own pixels.
    pub fn intensifier(&self, path: &Path, typed_deg: &[f64]) -> Result<Intensifier, RegisterError> {
        let at = || {
            let calibration = IntensifierCalibration::read(path)?;
            let tags = &self.frame.tags;
            let tagged = tags.primary_deg.zip(tags.secondary_deg).filter(|_| calibration.angles_from == AnglesFrom::Positioner);
            let angles_deg = match typed_deg {
                [orbital, angulation] => Some([*orbital, *angulation]),
                _ => tagged.map(|(primary, secondary)| [primary, secondary]),
            };
            self.frame.seen_through(&calibration.at(angles_deg)?)
        };
        at().map_err(|source| RegisterError::Distortion { path: path.to_owned(), source: Box::new(source) })
    }
}
