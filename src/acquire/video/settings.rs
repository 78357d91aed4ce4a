//! What is known of a video output: where it comes from, which part of it is the picture, and when it stands still.

use serde::{Deserialize, Serialize};

/// Pixels of the video: columns from the left, rows from the top, width, height.
pub type Rectangle = [u32; 4];

/// The key `video` of a session's `frames`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct VideoSettings {
    /// A capture device (`/dev/video0`, or its number alone) or a video file, which is played once at its own pace.
    pub from: String,
    /// The radiograph within the video; all of it when absent.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub crop_px: Option<Rectangle>,
    /// Where the video changes while the picture stands: clocks, cursors, menus. They stay in the picture.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub masks_px: Vec<Rectangle>,
    /// Signal = (grey / 255)^gamma, for consoles that apply nothing else; frames are then linear. Without it they are for display.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub gamma: Option<f64>,
    /// Metal is shown white: larger values are fewer X-rays.
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    pub metal_white: bool,
    /// A picture that does not change for so long stands still.
    #[serde(default = "usual_still_s")]
    pub still_s: f64,
    /// Mean change of a block of 16 x 16 pixels from picture to picture, in grey values, up to which it stands still; learnt from the video
    /// when absent.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub change: Option<f64>,
}

/// Longer than any picture of fluoroscopy at one image a quarter of a second.
fn usual_still_s() -> f64 {
    0.3
}

impl VideoSettings {
    /// All of the video at `from`.
    #[must_use]
    pub fn of(from: &str) -> Self {
        Self {
            from: from.to_owned(),
            crop_px: None,
            masks_px: Vec::new(),
            gamma: None,
            metal_white: false,
            still_s: usual_still_s(),
            change: None,
        }
    }

    /// The first key that cannot be: its name, what it says, what would be right.
    #[must_use]
    pub fn wrong(&self) -> Option<(&'static str, String, &'static str)> {
        let within = |value: f64, low: f64, high: f64| value >= low && value <= high;
        let empty = |rectangle: &&Rectangle| rectangle[2] == 0 || rectangle[3] == 0;
        let shown = |rectangle: &Rectangle| format!("{rectangle:?}");
        let rectangle = "[columns from the left, rows from the top, width, height], the last two at least 1";
        let crop = self.crop_px.as_ref().filter(empty).map(|crop| ("crop_px", shown(crop), rectangle));
        let mask = self.masks_px.iter().find(empty).map(|mask| ("masks_px", shown(mask), rectangle));
        let gamma = self.gamma.filter(|gamma| !within(*gamma, 0.1, 10.0));
        let change = self.change.filter(|change| !within(*change, 0.1, 100.0));
        let still = Some(self.still_s).filter(|still_s| !within(*still_s, 0.05, 10.0));
        self.from
            .trim()
            .is_empty()
            .then(|| ("from", "empty".to_owned(), "a capture device (/dev/video0 or 0) or a video file"))
            .or(crop)
            .or(mask)
            .or(gamma.map(|gamma| ("gamma", gamma.to_string(), "0.1 to 10")))
            .or(still.map(|still_s| ("still_s", still_s.to_string(), "0.05 to 10 s")))
            .or(change.map(|change| ("change", change.to_string(), "0.1 to 100 grey values")))
    }
}
