//! Whether pictures come of the video output that a session names.

use std::path::Path;

use super::super::file::Setup;
use super::finding::Finding;
use crate::acquire::video::{Grabbed, probe};

/// So much of the video is looked at.
const LOOK_S: f64 = 3.0;

/// Looks at the video for a moment; its pictures go to a temporary folder in `within`.
#[must_use]
pub fn check_video(setup: &Setup, within: &Path) -> Option<Finding> {
    let video = setup.session.frames.video.as_ref()?;
    let remedy = "name a capture device or a file under frames.video.from, and end the program that has it";
    let events = match probe(video, LOOK_S, within) {
        Ok(events) => events,
        Err(error) => return Some(Finding::fail("video", error.to_string(), remedy)),
    };
    let lost = events.iter().find(|event| matches!(event, Grabbed::Lost { .. }));
    let Some(opened) = events.iter().find(|event| matches!(event, Grabbed::Opened { .. })) else {
        let detail = lost.map_or_else(|| "it gives no pictures".to_owned(), Grabbed::to_string);
        return Some(Finding::fail("video", format!("{}: {detail}", video.from), remedy));
    };
    let stands = events.iter().any(|event| matches!(event, Grabbed::Picture { .. }));
    Some(if stands {
        Finding::pass("video", format!("{opened}; a picture stands still"))
    } else {
        let remedy = "if the screen was empty or the beam on, this is right; else find crop and masks with `sidecarm grab`";
        Finding::warn("video", format!("{opened}; nothing stood still for {LOOK_S:.0} s"), remedy)
    })
}
