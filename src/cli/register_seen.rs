//! A frame as it lies on the panel, with its K: what `register` makes of a file before it looks for beads.

use std::path::Path;

use super::register_args::{Given, RegisterArgs};
use super::register_error::RegisterError;
use crate::acquire::{DetectorCalibration, Frame};
use crate::geometry::{AnglesFrom, ConsoleGeometry, Intensifier, IntensifierCalibration, Intrinsics, PanelWindow};
use crate::pose::{
    Focal, FrameK, IntrinsicsFile, IntrinsicsPrior, OtherSize, Panel, Pose, Prior, Registration, intrinsics_of, isocentre_of,
    off_header, read_console, solve_console,
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
    /// K is the header's: nobody has measured it.
    pub is_k_of_header: bool,
    /// How sure K is; `None`: it is known, or solved.
    pub prior: Option<IntrinsicsPrior>,
    pub pitch_mm: Option<f64>,
    /// From the panel's axes to the frame's, about the beam.
    pub turn_rad: f64,
    /// That the intrinsics' pixels are not those of the frame's header.
    pub off_pitch: Option<String>,
    /// What was done and assumed.
    pub notes: Vec<String>,
}

impl Seen {
    fn plain(frame: Frame, intrinsics: Option<Intrinsics>, prior: Option<IntrinsicsPrior>, pitch_mm: Option<f64>) -> Self {
        Self { frame, intrinsics, is_k_of_header: false, prior, pitch_mm, turn_rad: 0.0, off_pitch: None, notes: Vec::new() }
    }

    /// The frame stored at `path`, oriented and corrected, with K of the file, or of the header, as the console left it.
    pub fn of(
        args: &RegisterArgs,
        path: &Path,
        stored: &Frame,
        file: Option<&IntrinsicsFile>,
        console: Option<&Console>,
    ) -> Result<Self, RegisterError> {
        if args.distortion_file().is_some() && console.is_some_and(|console| console.solve_intrinsics) {
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
        let mut undone = frame.correction.as_ref().map(|correction| correction.console.clone()).unwrap_or_default();
        if let Some(calibration) = &args.detector {
            frame = DetectorCalibration::apply_file(calibration, &frame, window)?;
            undone.extend(frame.correction.as_ref().and_then(|correction| correction.flood_doubt.clone()));
        }
        let tagged_pitch_mm = frame.tags.pitch_mm.map(|pitch| pitch[0]);
        let Some(file) = file else {
            let (words, intrinsics, pitch_mm) = match intrinsics_of(&frame) {
                Some((intrinsics, pitch_mm, words)) => {
                    (format!("{words}; give --intrinsics for a calibrated K"), Some(intrinsics), Some(pitch_mm))
                }
                None => {
                    let words = "no --intrinsics, and no SID with pixel spacing in the header: K is solved from the beads";
                    (words.to_owned(), None, tagged_pitch_mm)
                }
            };
            let notes = [undone, vec![words]].concat();
            let is_k_of_header = intrinsics.is_some();
            return Ok(Self {
                is_k_of_header,
                turn_rad: window.turned_rad,
                notes,
                ..Self::plain(frame, intrinsics, None, pitch_mm)
            });
        };
        let of_frame = file.of_frame(console.map(|console| &console.geometry), found);
        let k = of_frame.map_err(|error| match error {
            OtherSize::Console(error) => console_error(error),
            OtherSize::NoBinning { expected, found } => {
                RegisterError::Size { path: args.intrinsics.clone().unwrap_or_default(), expected, frame: path.to_owned(), found }
            }
        })?;
        let off_pitch = k.off_pitch(&frame);
        let FrameK { intrinsics, prior, pitch_mm, turn_rad, binning, .. } = k;
        let solved = console.is_some_and(|console| console.solve_intrinsics);
        let (intrinsics, prior) = if solved { (None, None) } else { (Some(intrinsics), prior) };
        let mut notes = undone;
        if binning > 1 {
            let expected = panel_px.unwrap_or(found);
            notes.push(format!("K is for {expected:?} px: the frame is taken as binned {binning} x {binning}"));
        }
        let pitch_mm = pitch_mm.or(tagged_pitch_mm);
        Ok(Self { turn_rad, off_pitch, notes, ..Self::plain(frame, intrinsics, prior, pitch_mm) })
    }

    /// That K is not that of the frame's own header, where the header has one. Pixels of header and K are those of the picture as stored.
    pub fn off_header(&self, pose: &Pose) -> Option<String> {
        let k = pose.intrinsics.filter(|_| pose.is_accepted())?;
        self.off_focal(pose, &k).or_else(|| self.off_pitch.clone())
    }

    fn off_focal(&self, pose: &Pose, k: &Intrinsics) -> Option<String> {
        let (whose, focal_px, sigma_px) = match (pose.intrinsics_source.as_deref(), &self.prior) {
            (Some("given"), _) => ("as given", k.fx, 0.0),
            // Solved K lies between what is stated and what the beads say, and hides how far the former is off.
            (Some("solved with priors"), Some(prior)) => ("as stated", prior.mean.fx, prior.focal_sigma_px),
            _ => ("as solved from the beads", k.fx, pose.intrinsics_sigma_px.map_or(0.0, |[sigma_px, ..]| sigma_px)),
        };
        off_header(&self.frame, whose, &Focal { px: focal_px, sigma_px, pitch_mm: self.pitch_mm })
    }

    /// The request for one frame.
    pub fn request<'a>(&self, args: &RegisterArgs, given: &'a Given, prior: Option<&'a Prior>) -> Registration<'a> {
        Registration {
            intrinsics: self.intrinsics,
            is_k_of_header: self.is_k_of_header,
            intrinsics_prior: self.prior,
            pitch_mm: self.pitch_mm,
            source_to_isocentre_mm: isocentre_of(&self.frame.tags),
            prior,
            ignore_prior: args.ignore_prior,
            one_body: args.one_body,
            landmarks: &given.landmarks,
            is_flat: args.is_flat(),
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

#[cfg(test)]
mod tests {
    use super::*;
    use crate::acquire::Domain;
    use crate::geometry::{Projection, Rigid};
    use crate::image::Image;

    fn k(focal_px: f64) -> Intrinsics {
        Intrinsics { fx: focal_px, fy: focal_px, skew: 0.0, cx: 31.5, cy: 23.5 }
    }

    /// A frame whose header, if it has one, says 5000 px, and K stated as 5250 px where a `sigma_px` is.
    fn seen(with_header: bool, sigma_px: Option<f64>) -> Seen {
        let mut frame = Frame::from_pixels("f", Image::filled(64, 48, 1.0f32), Domain::Linear).expect("a frame");
        if with_header {
            (frame.tags.sid_mm, frame.tags.pitch_mm) = (Some(1000.0), Some([0.2; 2]));
        }
        let prior = sigma_px.map(|sigma| IntrinsicsPrior { mean: k(5250.0), focal_sigma_px: sigma, centre_sigma_px: [5.0; 2] });
        Seen::plain(frame, None, prior, None)
    }

    fn pose(focal_px: f64, source: &str, sigma_px: Option<f64>) -> Pose {
        let camera_from_lps = Rigid::IDENTITY;
        Pose {
            projection: Some(Projection::compose(&k(focal_px), &camera_from_lps)),
            intrinsics: Some(k(focal_px)),
            intrinsics_source: Some(source.to_owned()),
            intrinsics_sigma_px: sigma_px.map(|sigma| [sigma, sigma, 5.0, 5.0]),
            camera_from_lps: Some(camera_from_lps),
            ..Pose::default()
        }
    }

    #[test]
    fn k_that_is_not_that_of_the_header_is_told_however_it_came_about() {
        let plain = seen(true, None);
        assert_eq!(plain.off_header(&pose(5100.0, "given", None)), None, "2 % are nobody's concern");
        let words = plain.off_header(&pose(5250.0, "given", None)).unwrap_or_default();
        assert!(words.contains("5000 px (SID 1000 mm)") && words.contains("as given is 5.0 % longer"), "{words}");
        let words = plain.off_header(&pose(4750.0, "solved", Some(20.0))).unwrap_or_default();
        assert!(words.contains("solved from the beads is 5.0 % shorter"), "{words}");
        assert_eq!(plain.off_header(&pose(4750.0, "solved", Some(100.0))), None, "no better than that is it solved");
        let words = seen(true, Some(20.0)).off_header(&pose(5010.0, "solved with priors", Some(15.0))).unwrap_or_default();
        assert!(words.contains("as stated is 5.0 % longer"), "{words}");
        assert_eq!(seen(true, Some(100.0)).off_header(&pose(5010.0, "solved with priors", Some(15.0))), None, "as stated");
        assert_eq!(seen(false, None).off_header(&pose(5250.0, "given", None)), None, "the header says nothing");
        let mut without_pitch = Seen { pitch_mm: Some(0.2), ..seen(false, None) };
        without_pitch.frame.tags.sid_mm = Some(1000.0);
        let words = without_pitch.off_header(&pose(5250.0, "given", None)).unwrap_or_default();
        assert!(words.contains("K's own pitch of 0.200 mm") && words.contains("5.0 % longer"), "{words}");
        without_pitch.pitch_mm = None;
        assert_eq!(without_pitch.off_header(&pose(5250.0, "given", None)), None, "nobody knows a pitch");
        let refused = pose(5250.0, "given", None).refused_for(crate::pose::Refusal::Fault { detail: "a test".to_owned() });
        assert_eq!(plain.off_header(&refused), None, "there is nothing to doubt");
    }
}
