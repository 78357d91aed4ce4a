//! K of a file as it holds for one frame: seen through what a console did, or binned.

use super::by_header::{Focal, OFF_HEADER, off_header};
use super::intrinsics_file::IntrinsicsFile;
use super::orientation::whole_binning;
use super::solve::IntrinsicsPrior;
use crate::acquire::Frame;
use crate::geometry::{ConsoleError, ConsoleGeometry, Intrinsics};

/// K of one frame.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct FrameK {
    /// In pixels of the oriented frame.
    pub intrinsics: Intrinsics,
    /// How sure it is; `None`: it is known.
    pub prior: Option<IntrinsicsPrior>,
    /// Side of one of the frame's pixels, where the file says the panel's.
    pub pitch_mm: Option<f64>,
    /// From the panel's axes to the frame's, about the beam.
    pub turn_rad: f64,
    /// So many pixels of the panel each way were averaged into one, though no console says so.
    pub binning: u32,
    /// K is that of the file as it stands: no console and no binning has changed it.
    pub is_whole: bool,
}

/// Why a file's K is not that of a frame.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum OtherSize {
    /// The console, as declared, does not give frames of this size.
    #[error(transparent)]
    Console(#[from] ConsoleError),
    /// No console is declared, and no whole binning does.
    #[error("K is for frames of {expected:?} px, and this one has {found:?} px, which no binning gives")]
    NoBinning {
        /// Columns and rows that K is for.
        expected: [u32; 2],
        /// Of the frame as stored.
        found: [u32; 2],
    },
}

/// What probably made a frame of `found` columns and rows from one of `expected`, for which K is, and what to do about it, in words that go on after
/// both; `declare`: how keys of a console's geometry are stated.
#[must_use]
pub fn why_other_size(expected: [u32; 2], found: [u32; 2], declare: fn(&str) -> String) -> String {
    let [columns, rows] = found;
    if let Some(binning) = whole_binning(expected, [rows, columns]) {
        let (binned, key) = if binning > 1 {
            (format!(" and binned it {binning} x {binning}"), format!("\"binning\": {binning}, "))
        } else {
            (String::new(), String::new())
        };
        return format!(
            "columns and rows the other way round: the console probably turned it by a quarter{binned}, clockwise or (270) counter-clockwise; {}",
            declare(&format!("{{{key}\"rotation_deg\": 90}}"))
        );
    }
    let same = (expected[0] == columns, expected[1] == rows);
    if !matches!(same, (true, false) | (false, true)) {
        return "which no binning gives: the console cropped or zoomed it; give K of the frame as it is".to_owned();
    }
    let side = if same.0 { "height" } else { "width" };
    let cropped = if columns <= expected[0] && rows <= expected[1] {
        format!(" or cropped; where it was cropped {}", declare(&format!("{{\"crop_px\": [left, top, {columns}, {rows}]}}")))
    } else {
        String::new()
    };
    format!(
        "which no binning gives: its {side} alone is another, it was probably stretched{cropped}; where it was stretched give K of the frame as it is, \
         with its own fx and fy"
    )
}

impl IntrinsicsFile {
    /// K of a frame that was stored with `stored_px` columns and rows: through `console` where one is declared, else binned where that is what
    /// makes the sizes differ.
    ///
    /// # Errors
    /// When the file is for frames of another size, and neither explains it.
    pub fn of_frame(&self, console: Option<&ConsoleGeometry>, stored_px: [u32; 2]) -> Result<FrameK, OtherSize> {
        if let Some(console) = console {
            let window = match self.size_px {
                Some(panel_px) => console.window_on(panel_px, stored_px)?,
                None => console.window(stored_px),
            };
            let (intrinsics, turn_rad) = window.intrinsics(&self.intrinsics);
            let prior = self.prior().map(|prior| prior.seen_through(&window));
            let pitch_mm = self.pitch_mm.map(|pitch_mm| pitch_mm * window.step);
            return Ok(FrameK { intrinsics, prior, pitch_mm, turn_rad, binning: 1, is_whole: false });
        }
        let expected = self.size_px.unwrap_or(stored_px);
        let binning = whole_binning(expected, stored_px).ok_or(OtherSize::NoBinning { expected, found: stored_px })?;
        let (intrinsics, prior, pitch_mm) = (self.intrinsics, self.prior(), self.pitch_mm);
        let whole = FrameK { intrinsics, prior, pitch_mm, turn_rad: 0.0, binning, is_whole: binning == 1 };
        if binning == 1 {
            return Ok(whole);
        }
        let factor = f64::from(binning);
        Ok(FrameK {
            intrinsics: whole.intrinsics.binned(factor),
            prior: whole.prior.map(|prior| prior.binned(factor)),
            pitch_mm: whole.pitch_mm.map(|pitch_mm| pitch_mm * factor),
            ..whole
        })
    }
}

impl FrameK {
    /// That the frame's header has another focal length, where it has one, or other pixels: the detector may stand elsewhere than when K, `whose`
    /// it is, was measured, or a console has enlarged the picture.
    #[must_use]
    pub fn off_header(&self, frame: &Frame, whose: &str) -> Option<String> {
        let sigma_px = IntrinsicsPrior::stated_focal_sigma_px(self.prior.as_ref());
        let focal = Focal { px: self.intrinsics.fx, sigma_px, pitch_mm: self.pitch_mm };
        off_header(frame, whose, &focal).or_else(|| self.off_pitch(frame))
    }

    /// That the pixels of K are not those of the frame's header, for a frame of the size and place that K is for: consoles that bin or enlarge leave
    /// the header's as it was.
    #[must_use]
    pub fn off_pitch(&self, frame: &Frame) -> Option<String> {
        let (own, [tagged, _]) = self.pitch_mm.filter(|_| self.is_whole).zip(frame.tags.pitch_mm)?;
        (!((own / tagged - 1.0).abs() <= OFF_HEADER)).then(|| {
            format!(
                "the frame's own header says pixels of {tagged} mm, the intrinsics {own} mm: one of the two is not this panel's, and all that is said \
                 in mm at the detector, SID among it, goes wrong by as much"
            )
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::acquire::Domain;
    use crate::image::Image;

    fn file() -> IntrinsicsFile {
        let json = r#"{"intrinsics": [[2600, 0, 309.5], [0, 2600, 239.5], [0, 0, 1]], "size_px": [620, 480], "pitch_mm": 0.4,
            "sigma": {"source_to_detector_mm": 4.0, "principal_point_px": 6.0}}"#;
        serde_json::from_str(json).expect("K")
    }

    #[test]
    fn numbers_of_k_go_together_through_binning_and_console() {
        let k = |console: Option<&ConsoleGeometry>, stored_px| file().of_frame(console, stored_px);
        let sigma_px = |k: FrameK| IntrinsicsPrior::stated_focal_sigma_px(k.prior.as_ref());
        let told = |k: FrameK| [k.intrinsics.fx, k.prior.map_or(0.0, |prior| prior.mean.fx), sigma_px(k)];
        let whole = k(None, [620, 480]).expect("its own size");
        assert_eq!((whole.intrinsics, whole.pitch_mm, whole.turn_rad, whole.binning), (file().intrinsics, Some(0.4), 0.0, 1));
        assert!((sigma_px(whole) - 10.0).abs() < 1e-9, "{whole:?}");
        assert_eq!(IntrinsicsPrior::stated_focal_sigma_px(None), 0.0, "K that is known");
        let scaled = [told(whole).map(|px| 0.5 * px), told(whole).map(|px| 2.0 * px)];
        let binned = k(None, [310, 240]).expect("a whole binning");
        assert_eq!((binned.pitch_mm, binned.binning), (Some(0.8), 2));
        let declared = ConsoleGeometry { binning: 2, ..ConsoleGeometry::default() };
        let by_console = k(Some(&declared), [310, 240]).expect("as declared");
        assert_eq!((by_console.pitch_mm, by_console.binning), (Some(0.8), 1), "nothing is assumed");
        let zoom = ConsoleGeometry { zoom: 2.0, crop_px: Some([155, 120, 310, 240]), ..ConsoleGeometry::default() };
        let zoomed = k(Some(&zoom), [620, 480]).expect("as declared");
        assert_eq!(zoomed.pitch_mm, Some(0.2));
        for (k, expected) in [(binned, scaled[0]), (by_console, scaled[0]), (zoomed, scaled[1])] {
            assert!(told(k).iter().zip(expected).all(|(px, expected)| (px - expected).abs() < 1e-9), "{k:?}");
            // Wherever its pixels are, the detector stands where it stood.
            assert!((k.intrinsics.fx * k.pitch_mm.unwrap_or(0.0) - 1040.0).abs() < 1e-9, "{k:?}");
        }
        let turned = ConsoleGeometry { rotation_deg: 10.0, ..ConsoleGeometry::default() };
        assert!(k(Some(&turned), [620, 480]).expect("as declared").turn_rad.abs() > 0.17);
    }

    #[test]
    fn k_of_another_size_is_refused_with_both() {
        let refused = file().of_frame(None, [600, 470]).expect_err("no binning");
        assert_eq!(refused, OtherSize::NoBinning { expected: [620, 480], found: [600, 470] });
        let crop = ConsoleGeometry { crop_px: Some([10, 20, 600, 440]), ..ConsoleGeometry::default() };
        assert!(matches!(file().of_frame(Some(&crop), [620, 480]), Err(OtherSize::Console(_))), "it is cropped");
        let sized = IntrinsicsFile { size_px: None, ..file() };
        assert!(sized.of_frame(None, [600, 470]).is_ok(), "nobody says for which size");
    }

    /// Of a picture that was turned by a quarter it was said that it was cropped or zoomed.
    #[test]
    fn a_size_says_whether_the_picture_was_turned_stretched_or_cropped() {
        let why = |found: [u32; 2]| why_other_size([640, 498], found, |keys| format!("declare {keys}"));
        for (found, says) in [
            ([498, 640], "turned it by a quarter, clockwise or (270) counter-clockwise; declare {\"rotation_deg\": 90}"),
            (
                [249, 320],
                "a quarter and binned it 2 x 2, clockwise or (270) counter-clockwise; declare {\"binning\": 2, \"rotation_deg\": 90}",
            ),
            (
                [640, 480],
                "its height alone is another, it was probably stretched or cropped; where it was cropped declare {\"crop_px\": [left, top, 640, 480]}",
            ),
            ([600, 498], "its width alone is another"),
            ([600, 480], "which no binning gives: the console cropped or zoomed it; give K of the frame as it is"),
        ] {
            assert!(why(found).contains(says), "{found:?}: {}", why(found));
        }
        let larger = why([640, 640]);
        assert!(
            larger.contains("probably stretched;") && larger.ends_with("with its own fx and fy"),
            "no crop enlarges: {larger}"
        );
        assert!(!why([600, 480]).contains("turned") && !why([498, 600]).contains("turned"), "the controls");
    }

    /// A console that enlarges a picture and says so in its pixels, beside no distance, told it to `register` alone.
    #[test]
    fn pixels_that_the_header_has_otherwise_are_told_of_a_frame_as_k_is_for() {
        let told = |header_mm: Option<f64>, console: Option<&ConsoleGeometry>| {
            let mut frame = Frame::from_pixels("f", Image::filled(62, 48, 1.0f32), Domain::Linear).expect("a frame");
            frame.tags.pitch_mm = header_mm.map(|mm| [mm; 2]);
            file().of_frame(console, [620, 480]).expect("its own size").off_header(&frame, "of the session")
        };
        let words = told(Some(0.374), None).unwrap_or_default();
        assert!(words.contains("pixels of 0.374 mm, the intrinsics 0.4 mm"), "{words}");
        let zoom = ConsoleGeometry { zoom: 2.0, crop_px: Some([155, 120, 310, 240]), ..ConsoleGeometry::default() };
        assert_eq!([told(Some(0.4), None), told(None, None), told(Some(0.4), Some(&zoom))], [None, None, None]);
    }

    #[test]
    fn a_detector_that_stands_elsewhere_by_the_header_is_told() {
        let told = |sid_mm: Option<f64>, header_mm: Option<f64>, change: fn(&mut FrameK)| {
            let mut frame = Frame::from_pixels("f", Image::filled(62, 48, 1.0f32), Domain::Linear).expect("a frame");
            (frame.tags.sid_mm, frame.tags.pitch_mm) = (sid_mm, header_mm.map(|mm| [mm; 2]));
            let mut k = IntrinsicsFile { sigma: None, ..file() }.of_frame(None, [620, 480]).expect("its own size");
            change(&mut k);
            k.off_header(&frame, "of the session")
        };
        let known = |_: &mut FrameK| ();
        assert_eq!([told(None, Some(0.4), known), told(Some(1040.0), Some(0.4), known)], [None, None]);
        assert_eq!(told(Some(1060.0), Some(0.4), known), None, "2 %");
        let words = told(Some(1000.0), Some(0.4), known).unwrap_or_default();
        assert!(words.contains("2500 px") && words.contains("K of the session is 4.0 % longer"), "{words}");
        // The header has no pitch, and the file has one.
        let words = told(Some(1000.0), None, known).unwrap_or_default();
        assert!(words.contains("over K's own pitch of 0.400 mm") && words.contains("4.0 % longer"), "{words}");
        assert_eq!(told(Some(1000.0), None, |k| k.pitch_mm = None), None, "nobody knows one");
        let unsure = |k: &mut FrameK| {
            k.prior = Some(IntrinsicsPrior { mean: k.intrinsics, focal_sigma_px: 40.0, centre_sigma_px: [5.0; 2] });
        };
        assert_eq!(told(Some(1000.0), Some(0.4), unsure), None, "as stated");
    }
}
