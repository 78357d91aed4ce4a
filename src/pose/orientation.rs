//! What a console did to a picture, solved where nobody states it: the way round in which the beads fit, with the rest of the turn from
//! the prior.
//!
//! Beads tell a mirror image, and with a free K also cropping and enlargement. They cannot tell a turned picture from a camera turned
//! about its beam: that is the prior's word, and no finer than it.

use glam::{DAffine2, DMat2, DVec2};

use super::case::PRIOR_SIGMA;
use super::prior::Prior;
use super::record::Pose;
use super::refusal::Refusal;
use super::register::register;
use super::request::Registration;
use crate::acquire::Frame;
use crate::geometry::{ConsoleGeometry, Flip, Intrinsics, quarters_and_rest};

/// A turn within so many standard deviations of the prior's from whole quarters is one of quarters.
const SURE: f64 = 3.0;

/// What is known of the panel.
#[derive(Clone, Copy, Debug)]
pub struct Panel {
    /// Its K.
    pub intrinsics: Intrinsics,
    /// Columns and rows of its pictures.
    pub size_px: [u32; 2],
    /// Where the camera whose axes are the panel's is expected.
    pub prior: Prior,
}

/// A console's doing, solved.
#[derive(Clone, Debug)]
pub struct SolvedConsole {
    /// What it did.
    pub console: ConsoleGeometry,
    /// Whether cropping and enlargement were solved with K, which then is no evidence of its own.
    pub with_intrinsics: bool,
    /// What was found, and how well it is known.
    pub words: String,
}

/// Finds how `frame`, as stored, was turned and mirrored, and where its size is not the panel's, cropped and enlarged. `request` is for
/// that frame; its prior, K and size are not looked at.
///
/// # Errors
/// When neither the picture nor its mirror image gives a pose without the prior, or both do.
pub fn solve_console(request: &Registration, frame: &Frame, panel: &Panel) -> Result<SolvedConsole, Refusal> {
    let [plain, mirrored] = [Flip::None, Flip::Horizontal].map(|flip| upright(request, frame, panel, flip));
    let reason = |pose: &Pose| pose.refusal.as_ref().map_or_else(String::new, Refusal::words_beside_prior);
    let (flip, found) = match (plain, mirrored) {
        (Ok(found), Err(_)) => (Flip::None, found),
        (Err(_), Ok(found)) => (Flip::Horizontal, found),
        (Err(one), Err(other)) => return Err(Refusal::NoOrientation { as_stored: reason(&one), mirrored: reason(&other) }),
        (Ok(one), Ok(other)) => {
            let fit =
                |found: &Upright| (found.pose.beads.iter().filter(|b| b.used).count(), found.pose.rms_px.unwrap_or(f64::NAN));
            let ((matched, rms_px), (other_matched, other_px)) = (fit(&one), fit(&other));
            return Err(Refusal::EitherOrientation { matched, rms_px, other_matched, other_px });
        }
    };
    Ok(found.solved(flip, frame, panel))
}

/// An accepted pose of a frame of which `turns` quarter turns were undone, and how far it is turned still against the prior.
struct Upright {
    pose: Pose,
    turns: u32,
    rest_rad: f64,
    binning: Option<u32>,
}

fn upright(request: &Registration, frame: &Frame, panel: &Panel, flip: Flip) -> Result<Upright, Box<Pose>> {
    let stored_px = frame.size_px.map(|side| side as u32);
    let mut refused = None;
    for turns in 0..4 {
        let console = ConsoleGeometry { rotation_deg: 90.0 * f64::from(turns), flip, ..ConsoleGeometry::default() };
        let size_px = console.stored_size(stored_px);
        let binning = whole_binning(panel.size_px, size_px);
        // Turned by a quarter it may have the panel's size.
        let other_way = whole_binning(panel.size_px, [size_px[1], size_px[0]]);
        if binning.is_none() && other_way.is_some() || binning.is_none() && turns > 0 {
            continue;
        }
        let intrinsics = binning.map(|factor| panel.intrinsics.binned(f64::from(factor)));
        let free = Registration { size_px, intrinsics, prior: None, fuse: false, ..*request };
        let pose = register(&free, &frame.oriented(&console, None));
        match pose.camera_from_lps.filter(|_| pose.is_accepted()) {
            Some(camera) => {
                let off = camera.rotation * panel.prior.camera_from_lps.rotation.inverse();
                // The part of it about the beam.
                let turned_rad = 2.0 * off.z.atan2(off.w);
                let (more, rest_rad) = quarters_and_rest(turned_rad);
                if more == 0 || binning.is_none() {
                    return Ok(Upright { pose, turns: (turns + more) % 4, rest_rad, binning });
                }
            }
            None => refused = Some(pose),
        }
    }
    Err(Box::new(refused.unwrap_or_default()))
}

impl Upright {
    fn solved(self, flip: Flip, frame: &Frame, panel: &Panel) -> SolvedConsole {
        let sigma_rad = panel.prior.covariance.map_or(PRIOR_SIGMA.0, |rows| rows[2][2].sqrt());
        let rest_rad = if self.rest_rad.abs() > SURE * sigma_rad { self.rest_rad } else { 0.0 };
        let turned_rad = f64::from(self.turns) * std::f64::consts::FRAC_PI_2 + rest_rad;
        let turned = if rest_rad == 0.0 {
            format!("turned by {} degrees", 90 * self.turns)
        } else {
            format!(
                "turned by {:.1} ± {:.1} degrees, as well as the prior knows",
                turned_rad.to_degrees(),
                sigma_rad.to_degrees()
            )
        };
        let mirrored = if flip == Flip::None { "" } else { ", then mirrored" };
        let words = format!("what the console did was solved: {turned}{mirrored}");
        if let Some(binning) = self.binning {
            let console = ConsoleGeometry { rotation_deg: turned_rad.to_degrees(), flip, binning, ..ConsoleGeometry::default() };
            return SolvedConsole { console, with_intrinsics: false, words };
        }
        let stored_px = frame.size_px.map(|side| side as u32);
        let only_flipped = ConsoleGeometry { flip, ..ConsoleGeometry::default() };
        let image = self.pose.intrinsics.unwrap_or(panel.intrinsics);
        let [to, from] = [image, panel.intrinsics].map(|k| DMat2::from_cols(DVec2::new(k.fx, 0.0), DVec2::new(k.skew, k.fy)));
        let linear = to * DMat2::from_angle(turned_rad) * from.inverse();
        let shift = DVec2::new(image.cx, image.cy) - linear * DVec2::new(panel.intrinsics.cx, panel.intrinsics.cy);
        let image_from_detector = DAffine2::from_mat2_translation(linear, shift);
        let detector_from_image = image_from_detector.inverse() * only_flipped.stored_from_oriented(stored_px).inverse();
        let zoom = image.fx / panel.intrinsics.fx;
        SolvedConsole {
            console: ConsoleGeometry::of_matrix(&detector_from_image),
            with_intrinsics: true,
            words: format!("{words}, {zoom:.4} times as large as on the panel, cropped: as well as K is solved from the beads"),
        }
    }
}

/// Whole number of panel pixels along the side of one of the frame's, if that is what makes the sizes differ; 1 where they do not.
#[must_use]
pub fn whole_binning(panel: [u32; 2], frame: [u32; 2]) -> Option<u32> {
    (1..=8).find(|factor| panel.map(|n| n / factor) == frame && panel.iter().zip(frame).all(|(n, m)| n - m * factor < *factor))
}
