//! K that a session states, as it holds for one of its frames.

use crate::acquire::Frame;
use crate::geometry::{ConsoleGeometry, Intrinsics};
use crate::pose::{IntrinsicsFile, IntrinsicsPrior, off_header, whole_binning};

/// K of one frame.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct StatedK {
    /// In pixels of the oriented frame.
    pub intrinsics: Intrinsics,
    /// How sure it is; `None`: it is known.
    pub prior: Option<IntrinsicsPrior>,
    /// Side of one of the frame's pixels, where the file says the panel's.
    pub pitch_mm: Option<f64>,
    /// So many pixels of the panel each way were averaged into one, though no console says so.
    pub binning: u32,
}

impl StatedK {
    /// That the frame's header has another focal length, where it has one: the detector may stand elsewhere than when K was measured.
    pub(super) fn off_header(&self, frame: &Frame) -> Option<String> {
        let sigma_px = self.prior.map_or(0.0, |prior| prior.focal_sigma_px);
        off_header(frame, "of the session", self.intrinsics.fx, sigma_px)
    }
}

/// K of the frame called `name`, which was stored with `stored_px` columns and rows.
///
/// # Errors
/// In words, when `file` is for frames of another size, and neither `console` nor a whole binning explains it.
pub(super) fn stated_k(
    file: &IntrinsicsFile,
    console: Option<&ConsoleGeometry>,
    stored_px: [u32; 2],
    name: &str,
) -> Result<StatedK, String> {
    if let Some(console) = console {
        let window = match file.size_px {
            Some(panel_px) => console.window_on(panel_px, stored_px).map_err(|error| format!("K of the session: {error}"))?,
            None => console.window(stored_px),
        };
        let (intrinsics, _) = window.intrinsics(&file.intrinsics);
        let prior = file.prior().map(|prior| prior.seen_through(&window));
        return Ok(StatedK { intrinsics, prior, pitch_mm: file.pitch_mm.map(|pitch| pitch * window.step), binning: 1 });
    }
    let expected = file.size_px.unwrap_or(stored_px);
    let binning = whole_binning(expected, stored_px).ok_or_else(|| {
        format!(
            "K is for frames of {expected:?} px, {name} has {stored_px:?} px, which no binning gives: the console cropped or zoomed it; \
             give K of the frame as it is"
        )
    })?;
    if binning == 1 {
        return Ok(StatedK { intrinsics: file.intrinsics, prior: file.prior(), pitch_mm: file.pitch_mm, binning });
    }
    let factor = f64::from(binning);
    Ok(StatedK {
        intrinsics: file.intrinsics.binned(factor),
        prior: file.prior().map(|prior| prior.binned(factor)),
        pitch_mm: file.pitch_mm.map(|pitch| pitch * factor),
        binning,
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::acquire::Domain;
    use crate::image::Image;

    fn file() -> IntrinsicsFile {
        let json = r#"{"intrinsics": [[2600, 0, 309.5], [0, 2600, 239.5], [0, 0, 1]], "size_px": [620, 480], "pitch_mm": 0.4}"#;
        serde_json::from_str(json).expect("K")
    }

    #[test]
    fn k_follows_binning_and_console_and_fits_no_other_size() {
        let k = |console: Option<&ConsoleGeometry>, stored_px| stated_k(&file(), console, stored_px, "frame 1");
        let whole = k(None, [620, 480]).expect("its own size");
        assert_eq!((whole.intrinsics, whole.pitch_mm, whole.binning), (file().intrinsics, Some(0.4), 1));
        let binned = k(None, [310, 240]).expect("a whole binning");
        assert_eq!((binned.intrinsics.fx, binned.pitch_mm, binned.binning), (1300.0, Some(0.8), 2));
        let console = ConsoleGeometry { crop_px: Some([10, 20, 600, 440]), ..ConsoleGeometry::default() };
        let cropped = k(Some(&console), [600, 440]).expect("as declared").intrinsics;
        assert!((cropped.cx - 299.5).abs() < 1e-9 && (cropped.cy - 219.5).abs() < 1e-9, "{cropped:?}");
        let refused = k(None, [600, 470]).expect_err("no binning");
        for part in ["[620, 480]", "frame 1 has [600, 470] px, which no binning gives", "give K of the frame as it is"] {
            assert!(refused.contains(part), "{part} in {refused}");
        }
        assert!(k(Some(&console), [620, 480]).is_err(), "it is cropped");
        let sized = IntrinsicsFile { size_px: None, ..file() };
        assert!(stated_k(&sized, None, [600, 470], "f").is_ok(), "nobody says for which size");
    }

    #[test]
    fn a_detector_that_stands_elsewhere_by_the_header_is_told() {
        let told = |sid_mm: Option<f64>, prior: Option<IntrinsicsPrior>| {
            let mut frame = Frame::from_pixels("f", Image::filled(62, 48, 1.0f32), Domain::Linear).expect("a frame");
            (frame.tags.sid_mm, frame.tags.pitch_mm) = (sid_mm, Some([0.4; 2]));
            let k = stated_k(&file(), None, [620, 480], "f").expect("its own size");
            StatedK { prior, ..k }.off_header(&frame)
        };
        assert_eq!((told(None, None), told(Some(1040.0), None), told(Some(1060.0), None)), (None, None, None));
        let words = told(Some(1000.0), None).unwrap_or_default();
        assert!(words.contains("2500 px") && words.contains("4.0 % longer"), "{words}");
        let unsure = IntrinsicsPrior { mean: file().intrinsics, focal_sigma_px: 40.0, centre_sigma_px: [5.0; 2] };
        assert_eq!(told(Some(1000.0), Some(unsure)), None, "as stated");
    }
}
