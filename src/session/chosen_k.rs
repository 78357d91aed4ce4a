//! Which K a frame of a session is registered with, of all that are known.

use super::remedy::K_REMEDY;
use crate::acquire::Frame;
use crate::geometry::Intrinsics;
use crate::pose::{Focal, FrameK, IntrinsicsPrior, off_header};
use crate::report::KSource;

/// What is known of K before the beads are looked at.
#[derive(Default)]
pub(super) struct KnownK {
    /// Of the arm's calibration, where the frame's size fits it and the distance is known.
    pub of_arm: Option<Intrinsics>,
    /// Side of a pixel by that calibration, whether the distance is known or not.
    pub arm_pitch_mm: Option<f64>,
    /// Telemetry tells how far the detector was.
    pub is_measured: bool,
    /// What the session states of frames that the arm's telemetry tells nothing of, or why it does not hold for this one.
    pub stated: Option<Result<FrameK, String>>,
    /// K and pitch of the frame's header, with what was assumed; where nobody calibrated an arm.
    pub header: Option<(Intrinsics, f64, String)>,
}

/// The K that is taken.
#[derive(Debug, Default, PartialEq)]
pub(super) struct ChosenK {
    /// `None`: it is solved from the beads.
    pub intrinsics: Option<Intrinsics>,
    /// How sure it is; `None`: it is known, or solved.
    pub prior: Option<IntrinsicsPrior>,
    pub pitch_mm: Option<f64>,
    /// `None` where K is not known before the beads are looked at.
    pub source: Option<KSource>,
    /// What was assumed.
    pub note: Option<String>,
    /// That what the session states is not used, and what is.
    pub warning: Option<String>,
    /// The session states K, and nothing that is for frames of this size: in words.
    pub misfit: Option<String>,
    /// That K is not that of the frame's header.
    pub off_header: Option<String>,
}

impl KnownK {
    /// What the session states goes before the header and, where telemetry does not tell the distance, before the arm's calibration: that is
    /// taken instead of what is stated for frames of another size.
    pub fn choose(self, frame: &Frame) -> ChosenK {
        let Self { of_arm, arm_pitch_mm, is_measured, stated, header } = self;
        let tagged_pitch_mm = frame.tags.pitch_mm.map(|[across, _]| across);
        let (stated, warning) = match stated {
            Some(Err(words)) if of_arm.is_some() => {
                (None, Some(format!("{words}; K of the C-arm's calibration, which is for frames of this size, is taken instead")))
            }
            stated => (stated, None),
        };
        match (stated, header) {
            (Some(Ok(k)), _) => ChosenK {
                intrinsics: Some(k.intrinsics),
                prior: k.prior,
                pitch_mm: k.pitch_mm.or(tagged_pitch_mm),
                source: Some(KSource::Intrinsics),
                note: (k.binning > 1)
                    .then(|| format!("K is for a larger picture: the frame is taken as binned {0} x {0}", k.binning)),
                off_header: k.off_header(frame, "of the session"),
                ..ChosenK::default()
            },
            (Some(Err(words)), _) => ChosenK { misfit: Some(words), ..ChosenK::default() },
            (None, Some((k, pitch_mm, words))) => ChosenK {
                intrinsics: Some(k),
                pitch_mm: Some(pitch_mm),
                source: Some(KSource::Header),
                note: Some(format!("{words}; for a calibrated K {K_REMEDY}")),
                ..ChosenK::default()
            },
            (None, None) => {
                // What telemetry measures of an exposure is laid beside its header with all else that it tells.
                let focal = of_arm.filter(|_| !is_measured).map(|k| Focal { px: k.fx, sigma_px: 0.0, pitch_mm: arm_pitch_mm });
                ChosenK {
                    intrinsics: of_arm,
                    pitch_mm: arm_pitch_mm,
                    source: of_arm.map(|_| KSource::Carm),
                    warning,
                    off_header: focal.and_then(|focal| off_header(frame, "of the C-arm's calibration", &focal)),
                    ..ChosenK::default()
                }
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::acquire::Domain;
    use crate::image::Image;
    use crate::pose::intrinsics_of;

    fn k(focal_px: f64) -> Intrinsics {
        Intrinsics { fx: focal_px, fy: focal_px, skew: 0.0, cx: 31.5, cy: 23.5 }
    }

    fn frame(sid_mm: Option<f64>, pitch_mm: Option<f64>) -> Frame {
        let mut frame = Frame::from_pixels("f", Image::filled(64, 48, 1.0f32), Domain::Linear).expect("a frame");
        (frame.tags.sid_mm, frame.tags.pitch_mm) = (sid_mm, pitch_mm.map(|mm| [mm; 2]));
        frame
    }

    fn stated() -> FrameK {
        FrameK { intrinsics: k(5100.0), prior: None, pitch_mm: None, turn_rad: 0.0, binning: 1, is_whole: true }
    }

    /// A frame of the size of the arm's calibration was refused, because the session's own K was for another.
    #[test]
    fn the_arm_s_calibration_stands_in_for_k_of_another_size() {
        let choose = |of_arm: Option<f64>, stated: Result<FrameK, String>| {
            let (of_arm, arm_pitch_mm) = (of_arm.map(k), of_arm.map(|_| 0.2));
            KnownK { of_arm, arm_pitch_mm, stated: Some(stated), ..KnownK::default() }.choose(&frame(None, None))
        };
        let misfit = || Err("K is for frames of another size".to_owned());
        let arm = choose(Some(5000.0), misfit());
        assert_eq!((arm.intrinsics, arm.pitch_mm, arm.source), (Some(k(5000.0)), Some(0.2), Some(KSource::Carm)));
        let words = arm.warning.unwrap_or_default();
        assert!(words.starts_with("K is for frames of another size; K of the C-arm's calibration"), "{words}");
        assert_eq!(arm.misfit, None);
        let refused = choose(None, misfit());
        assert_eq!((refused.intrinsics, refused.source, refused.warning), (None, None, None));
        assert_eq!(refused.misfit.as_deref(), Some("K is for frames of another size"), "there is no other");
        let fits = choose(Some(5000.0), Ok(stated()));
        assert_eq!((fits.intrinsics, fits.source, fits.warning), (Some(k(5100.0)), Some(KSource::Intrinsics), None));
    }

    /// A person with a session in hand was told of an option of `register`.
    #[test]
    fn the_header_s_k_names_the_key_of_the_session() {
        let frame = frame(Some(1000.0), Some(0.2));
        let chosen = KnownK { header: intrinsics_of(&frame), ..KnownK::default() }.choose(&frame);
        assert_eq!((chosen.source, chosen.pitch_mm), (Some(KSource::Header), Some(0.2)));
        let note = chosen.note.unwrap_or_default();
        assert!(note.contains("K is taken from the header") && note.ends_with(K_REMEDY) && !note.contains("--"), "{note}");
    }

    #[test]
    fn a_header_with_another_distance_is_laid_beside_k_over_its_own_pitch() {
        let frame = frame(Some(900.0), None);
        let arm = |is_measured: bool| {
            let (of_arm, arm_pitch_mm) = (Some(k(5000.0)), Some(0.2));
            KnownK { of_arm, arm_pitch_mm, is_measured, ..KnownK::default() }.choose(&frame)
        };
        let words = arm(false).off_header.unwrap_or_default();
        assert!(words.contains("of the C-arm's calibration is 11.1 % longer"), "{words}");
        assert_eq!(arm(true).off_header, None, "telemetry's is looked at with all else that it tells");
        let session = |pitch_mm: Option<f64>| {
            let stated = Some(Ok(FrameK { pitch_mm, ..stated() }));
            KnownK { stated, ..KnownK::default() }.choose(&frame).off_header
        };
        assert!(session(Some(0.2)).is_some_and(|words| words.contains("of the session is 13.3 % longer")));
        assert_eq!(session(None), None, "nobody knows a pitch");
    }
}
