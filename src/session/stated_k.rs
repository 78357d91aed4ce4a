//! K that a session states, for one of its frames.

use crate::geometry::ConsoleGeometry;
use crate::pose::{FrameK, IntrinsicsFile, OtherSize, why_other_size};

/// K of the frame called `name`, which was stored with `stored_px` columns and rows.
///
/// # Errors
/// In words, when `file` is for frames of another size, and neither `console` nor a whole binning explains it.
pub(super) fn stated_k(
    file: &IntrinsicsFile,
    console: Option<&ConsoleGeometry>,
    stored_px: [u32; 2],
    name: &str,
) -> Result<FrameK, String> {
    file.of_frame(console, stored_px).map_err(|error| match error {
        OtherSize::Console(error) => format!("K of the session: {error}"),
        OtherSize::NoBinning { expected, found } => format!(
            "K is for frames of {expected:?} px, {name} has {found:?} px, {}",
            why_other_size(expected, found, |keys| format!("declare \"console\": {keys} in the session file"))
        ),
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn k_that_fits_no_frame_of_that_size_says_what_to_give() {
        let json = r#"{"intrinsics": [[2600, 0, 309.5], [0, 2600, 239.5], [0, 0, 1]], "size_px": [620, 480], "pitch_mm": 0.4}"#;
        let file: IntrinsicsFile = serde_json::from_str(json).expect("K");
        assert_eq!(stated_k(&file, None, [310, 240], "frame 1").map(|k| k.binning), Ok(2), "the control");
        let refused = stated_k(&file, None, [600, 470], "frame 1").expect_err("no binning");
        for part in ["[620, 480]", "frame 1 has [600, 470] px, which no binning gives", "give K of the frame as it is"] {
            assert!(refused.contains(part), "{part} in {refused}");
        }
        let turned = stated_k(&file, None, [480, 620], "frame 1").expect_err("turned");
        assert!(
            turned.contains("counter-clockwise; declare \"console\": {\"rotation_deg\": 90} in the session file"),
            "{turned}"
        );
        let console = ConsoleGeometry { crop_px: Some([10, 20, 600, 440]), ..ConsoleGeometry::default() };
        let refused = stated_k(&file, Some(&console), [620, 480], "frame 1").expect_err("it is cropped");
        assert!(refused.starts_with("K of the session: "), "{refused}");
    }
}
