//! What a frame's header says against its pose, however well the beads fit: an image intensifier whose distortion nobody undid, pixels of another
//! shape than K's, a specimen at another depth, beads where the collimator is shut.

use glam::DVec2;

use super::isocentre::{DEPTH_TIMES, is_beyond, isocentre_of};
use super::record::Pose;
use super::refusal::taller_words;
use super::register::intrinsics_of;
use crate::acquire::{CollimatorTags, Frame, FrameTags};
use crate::geometry::Intrinsics;
use crate::mask::opening_in_frame;

/// Pixels are as high as wide to within this share where both are rounded: half a percent of a frame is more than beads are seen to.
const PIXEL_SHAPE: f64 = 0.01;
/// The sides of a picture that is turned by more than this, quarters aside, are not those of its pixels.
const TURNED_RAD: f64 = 1e-3;
/// Magnification is of the patient's skin or middle, a hand's breadth and a half from the isocentre that the distance is of.
const MAGNIFICATION_TIMES: f64 = 1.25;
/// Share of the frame's longer side by which a shutter may be indicated elsewhere than it is: 2 % of the distance to the detector (21 CFR
/// 1020.31), seen on a panel of three tenths of that.
const SHUTTER_SHARE: f64 = 0.07;
/// The focal length of a calibrated panel, and its pitch, are hardly off by more than this share of what the frame's header says …
pub(super) const OFF_HEADER: f64 = 0.03;
/// … nor by more standard deviations, where it is stated or solved with one.
const OFF_SIGMAS: f64 = 3.0;

/// The focal length of a K, and what is known with it.
#[derive(Clone, Copy, Debug)]
pub struct Focal {
    /// Itself.
    pub px: f64,
    /// Standard deviation with which it is stated or solved; 0: it is known.
    pub sigma_px: f64,
    /// Side of one of the frame's pixels, where the file that states K, or the arm's calibration, says it.
    pub pitch_mm: Option<f64>,
}

/// Another focal length, by a frame's own header.
#[derive(Clone, Copy, Debug)]
pub(super) struct OtherFocal {
    pub header_px: f64,
    pub sid_mm: f64,
    /// The header has no pitch: its distance was divided by K's own.
    pub own_pitch_mm: Option<f64>,
    /// K's over the header's, less 1.
    pub off: f64,
}

impl Focal {
    /// The header's, where it is another than this: one rule for poses that are accepted and refused. `None` where the header has no distance,
    /// or nobody knows a pitch, or the distance over K's own gives K.
    pub(super) fn other_by(&self, frame: &Frame) -> Option<OtherFocal> {
        let sid_mm = frame.tags.sid_mm.filter(|sid_mm| *sid_mm > 0.0)?;
        let off = |header_px: f64| self.px / header_px - 1.0;
        let differs = |header_px: f64| !(off(header_px).abs() <= OFF_HEADER.max(OFF_SIGMAS * self.sigma_px / header_px));
        // Consoles that bin or enlarge leave the header's pixels as they were; those that K comes with are the frame's.
        let own_pitch_mm = self.pitch_mm.filter(|pitch_mm| *pitch_mm > 0.0);
        if own_pitch_mm.is_some_and(|pitch_mm| !differs(sid_mm / pitch_mm)) {
            return None;
        }
        let (header_px, own_pitch_mm) = match intrinsics_of(frame) {
            Some((header, ..)) => (header.fx, None),
            None => (sid_mm / own_pitch_mm?, own_pitch_mm),
        };
        differs(header_px).then_some(OtherFocal { header_px, sid_mm, own_pitch_mm, off: off(header_px) })
    }
}

/// That the focal length of K, `whose` it is, is not that of the frame's own header, where it has one.
#[must_use]
pub fn off_header(frame: &Frame, whose: &str, focal: &Focal) -> Option<String> {
    let OtherFocal { header_px, sid_mm, own_pitch_mm, off } = focal.other_by(frame)?;
    let over = own_pitch_mm.map_or(String::new(), |pitch_mm| format!(" over K's own pitch of {pitch_mm:.3} mm"));
    Some(format!(
        "the frame's own header says a focal length of {header_px:.0} px (SID {sid_mm:.0} mm{over}), K {whose} is {:.1} % {}: one of the two is not \
         this panel's at this distance, and depth goes wrong by as much",
        100.0 * off.abs(),
        if off > 0.0 { "longer" } else { "shorter" }
    ))
}

impl Pose {
    /// Doubts and cautions of an accepted pose, by what the header of its frame says; with a refusal, what else may be its cause.
    /// `is_undistorted`: places are those of the undistorted picture; `focal_sigma_px`: with which K's focal length is stated, 0 where it is known.
    pub fn hear_header(&mut self, frame: &Frame, is_undistorted: bool, focal_sigma_px: f64) {
        if !self.is_accepted() {
            self.hear_refused(frame, focal_sigma_px);
            return;
        }
        let tags = &frame.tags;
        let doubts = [distorted(tags), self.intrinsics.and_then(|k| other_pixels(frame, &k))];
        // A grid, or a phantom, has measured both.
        for words in doubts.into_iter().flatten().filter(|_| !is_undistorted) {
            self.doubt(words);
        }
        let depth_mm = self.camera_from_lps.zip(self.centroid_lps_mm).map(|(camera, centre)| camera.transform_point(centre).z);
        self.cautions.extend(depth_mm.and_then(|depth_mm| other_depth(tags, depth_mm)));
        let shut = tags.collimator.as_ref().map_or(0, |opening| self.beads_outside(opening, frame));
        if shut > 0 {
            self.cautions.push(format!(
                "{shut} of the used beads lie where the frame's header has the collimator shut (0018,1700): header and picture are not of one \
                 exposure, or the picture was turned or cropped since; check where the file comes from, and declare the console"
            ));
        }
        let hidden = tags.display_shutter.as_ref().map_or(0, |opening| self.beads_outside(opening, frame));
        if hidden > 0 {
            self.notes.push(format!(
                "{hidden} of the used beads lie outside the display shutter of the frame's header (0018,1600): a console hides them, and the \
                 picture has them"
            ));
        }
    }

    /// How many used beads lie outside an opening of the header.
    fn beads_outside(&self, opening: &CollimatorTags, frame: &Frame) -> usize {
        let open = opening_in_frame(opening, frame);
        let slack_px = SHUTTER_SHARE * frame.size_px.into_iter().max().unwrap_or(0) as f64;
        let seen = self.beads.iter().filter(|bead| bead.used).filter_map(|bead| bead.image_px);
        seen.filter(|at| open.depth_px(DVec2::from_array(*at)) < -slack_px).count()
    }
}

/// An intensifier's picture that nobody straightened.
fn distorted(tags: &FrameTags) -> Option<String> {
    let evidence = tags.names_intensifier()?;
    Some(format!(
        "the frame is of an image intensifier by its header ({evidence}), and no distortion is undone: away from the middle places are off by \
         pixels, however well the beads fit; measure it with `sidecarm calibrate intensifier` and give its file (--distortion FILE with one frame, \
         \"intensifier\" in a session)"
    ))
}

/// Pixels that are not as high, for their width, as K's.
fn other_pixels(frame: &Frame, k: &Intrinsics) -> Option<String> {
    let stored = frame.correction.as_ref().and_then(|correction| correction.stored.as_ref());
    let turned_rad = stored.map_or(0.0, |stored| stored.console.window(stored.size_px).turned_rad);
    if !(turned_rad.abs() <= TURNED_RAD) {
        return None;
    }
    let tags = &frame.tags;
    // 1:1 is written by habit, beside spacings that say better.
    let is_spaced = tags.pitch_mm.is_some() || tags.pixel_spacing_mm.is_some();
    let aspect = tags.pixel_aspect.filter(|[across, down]| !(is_spaced && across == down));
    let stated = [
        ("imager pixel spacing (0018,1164)", tags.pitch_mm),
        ("pixel spacing (0028,0030)", tags.pixel_spacing_mm),
        ("pixel aspect ratio (0028,0034)", aspect),
    ];
    // f in pixels is f over a pixel's width in fx, and over its height in fy.
    let height_by_k = k.fx / k.fy;
    stated.into_iter().find_map(|(what, sides)| {
        let [across, down] = sides?;
        let taller = down / across / height_by_k;
        (!((taller - 1.0).abs() <= PIXEL_SHAPE)).then(|| {
            format!(
                "the frame's pixels are {:.1} % {} by the {what} of its header than by K: one of the two is not this picture's, and places go wrong \
                 by as much; undo what stretched it on its way (a video grabber, an export), or give K with fx and fy of this picture",
                100.0 * (taller - 1.0).abs(),
                taller_words(taller)
            )
        })
    })
}

/// A specimen that is at another depth by the header, or at two.
fn other_depth(tags: &FrameTags, depth_mm: f64) -> Option<String> {
    // A patient who is not before the detector, or is not magnified, is what is written where nothing is known.
    let by_distance_mm = isocentre_of(tags);
    let magnified = tags.sid_mm.zip(tags.magnification.filter(|times| *times > 1.0));
    let by_magnification_mm = magnified.map(|(sid_mm, times)| sid_mm / times);
    if let (Some(distance_mm), Some(magnified_mm)) = (by_distance_mm, by_magnification_mm)
        && is_beyond(distance_mm / magnified_mm, MAGNIFICATION_TIMES)
    {
        return Some(format!(
            "the frame's header contradicts itself: the patient is {distance_mm:.0} mm from the source (0018,1111), and {magnified_mm:.0} mm by SID \
             (0018,1110) and magnification (0018,1114); read SID off the arm, because depth goes wrong with it"
        ));
    }
    let by_header_mm = by_distance_mm.or(by_magnification_mm)?;
    is_beyond(depth_mm / by_header_mm, DEPTH_TIMES).then(|| {
        format!(
            "the beads are {depth_mm:.0} mm from the source, and the patient is {by_header_mm:.0} mm by the frame's header (0018,1111 or 1114): check \
             K, SID, and the scale of the layout"
        )
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::acquire::Domain;
    use crate::geometry::{ConsoleGeometry, Projection, Rigid};
    use crate::image::Image;
    use crate::pose::Refusal;
    use glam::DVec3;

    /// A pose of pixels that are `taller` than wide, with its beads 650 mm from the source.
    fn pose(taller: f64) -> Pose {
        let k = Intrinsics { fx: 5000.0, fy: 5000.0 / taller, skew: 0.0, cx: 31.5, cy: 23.5 };
        let camera_from_lps = Rigid::translation(DVec3::new(0.0, 0.0, 650.0));
        Pose {
            projection: Some(Projection::compose(&k, &camera_from_lps)),
            intrinsics: Some(k),
            camera_from_lps: Some(camera_from_lps),
            centroid_lps_mm: Some(DVec3::ZERO),
            ..Pose::default()
        }
    }

    fn frame(change: impl FnOnce(&mut FrameTags)) -> Frame {
        let mut frame = Frame::from_pixels("f", Image::filled(64, 48, 1.0f32), Domain::Linear).expect("a frame");
        change(&mut frame.tags);
        frame
    }

    /// Doubt and cautions.
    fn heard(mut pose: Pose, frame: &Frame, is_undistorted: bool) -> (Option<String>, Vec<String>) {
        pose.hear_header(frame, is_undistorted, 0.0);
        (pose.doubt, pose.cautions)
    }

    /// A header with a distance and no pixel spacing said nothing, though the file of K says how large its pixels are.
    #[test]
    fn a_header_without_a_pitch_is_read_over_k_s_own() {
        let told = |sid_mm: Option<f64>, header_mm: Option<f64>, own_mm: Option<f64>, sigma_px: f64| {
            let frame = frame(|tags| (tags.sid_mm, tags.pitch_mm) = (sid_mm, header_mm.map(|mm| [mm; 2])));
            off_header(&frame, "as given", &Focal { px: 5000.0, sigma_px, pitch_mm: own_mm })
        };
        let words = told(Some(900.0), None, Some(0.2), 0.0).unwrap_or_default();
        assert!(words.contains("4500 px (SID 900 mm over K's own pitch of 0.200 mm), K as given is 11.1 % longer"), "{words}");
        // Its own spacing goes before K's, unless it is of before a console binned the picture.
        let words = told(Some(900.0), Some(0.25), Some(0.3), 0.0).unwrap_or_default();
        assert!(words.contains("3600 px (SID 900 mm), K as given is 38.9 % longer"), "{words}");
        assert_eq!(told(Some(900.0), Some(0.09), Some(0.18), 0.0), None, "binned by two");
        for (sid_mm, own_mm, sigma_px) in [
            (Some(900.0), None, 0.0),
            (None, Some(0.2), 0.0),
            (Some(0.0), Some(0.2), 0.0),
            (Some(900.0), Some(0.0), 0.0),
            (Some(990.0), Some(0.2), 0.0),
            (Some(900.0), Some(0.2), 170.0),
        ] {
            assert_eq!(told(sid_mm, None, own_mm, sigma_px), None, "{sid_mm:?}, {own_mm:?}, {sigma_px}");
        }
    }

    /// A picture of an intensifier was registered as that of a panel, without a word.
    #[test]
    fn an_intensifier_s_picture_is_in_doubt_until_its_distortion_is_undone() {
        let sized = frame(|tags| tags.intensifier_mm = Some(229.0));
        let (doubt, cautions) = heard(pose(1.0), &sized, false);
        let words = doubt.expect("a doubt");
        for part in ["(0018,1162) is 229 mm", "calibrate intensifier", "--distortion FILE"] {
            assert!(words.contains(part), "{part} in {words}");
        }
        assert_eq!(cautions, [words]);
        assert_eq!(heard(pose(1.0), &sized, true), (None, Vec::new()), "undone");
        let panel = frame(|tags| {
            (tags.intensifier_mm, tags.receptor) = (Some(229.0), Some("DIGITAL_DETECTOR".to_owned()));
        });
        for quiet in [panel, frame(|_| ())] {
            assert_eq!(heard(pose(1.0), &quiet, false), (None, Vec::new()), "{quiet:?}");
        }
        let refused = pose(1.0).refused_for(Refusal::Unsolved);
        assert_eq!(heard(refused, &sized, false), (None, Vec::new()), "there is nothing to doubt");
    }

    #[test]
    fn pixels_of_another_shape_than_k_s_are_in_doubt() {
        let aspect = |across: f64, down: f64| frame(move |tags| tags.pixel_aspect = Some([across, down]));
        let words = heard(pose(1.0), &aspect(11.0, 12.0), false).0.expect("a doubt");
        assert!(words.contains("9.1 % taller by the pixel aspect ratio (0028,0034)"), "{words}");
        let spaced = frame(|tags| tags.pitch_mm = Some([0.3, 0.2]));
        let words = heard(pose(1.0), &spaced, false).0.expect("a doubt");
        assert!(words.contains("33.3 % wider by the imager pixel spacing (0018,1164)"), "{words}");
        // K that has them as they are; squares; 1:1 by habit beside spacings that K has; and a picture that a calibration has straightened.
        let habit = frame(|tags| (tags.pitch_mm, tags.pixel_aspect) = (Some([0.2, 0.3]), Some([1.0; 2])));
        for (taller, quiet) in
            [(12.0 / 11.0, aspect(11.0, 12.0)), (1.0, aspect(1.0, 1.0)), (1.0, aspect(1000.0, 1005.0)), (1.5, habit)]
        {
            assert_eq!(heard(pose(taller), &quiet, false).0, None, "{quiet:?}");
        }
        assert_eq!(heard(pose(1.0), &spaced, true).0, None);
        // Turned by a quarter, width and height change places, in a square picture as well.
        let console = ConsoleGeometry { rotation_deg: 90.0, ..ConsoleGeometry::default() };
        let square = Frame { pixels: Image::filled(48, 48, 1.0f32), size_px: [48; 2], ..spaced.clone() };
        let turned = square.oriented(&console, None);
        assert_eq!((heard(pose(1.5), &turned, false).0, heard(pose(2.0 / 3.0), &turned, false).0.is_some()), (None, true));
    }

    #[test]
    fn depth_by_the_header_is_a_caution_where_no_isocentre_explains_it() {
        let told = |sod_mm: Option<f64>, magnification: Option<f64>| {
            let frame = frame(|tags| (tags.sid_mm, tags.sod_mm, tags.magnification) = (Some(1000.0), sod_mm, magnification));
            let (doubt, cautions) = heard(pose(1.0), &frame, false);
            assert_eq!(doubt, None, "a header's distance is no reason to doubt a pose");
            cautions.concat()
        };
        assert!(
            told(Some(300.0), None).contains("650 mm from the source, and the patient is 300 mm"),
            "{}",
            told(Some(300.0), None)
        );
        assert!(told(None, Some(4.0)).contains("is 250 mm by the frame's header"), "{}", told(None, Some(4.0)));
        assert!(told(Some(600.0), Some(3.0)).contains("contradicts itself"), "{}", told(Some(600.0), Some(3.0)));
        // The isocentre, the table, and what is written where nothing is known.
        for (sod_mm, magnification) in
            [(None, None), (Some(785.0), Some(1.4)), (Some(500.0), None), (Some(1000.0), Some(1.0)), (None, Some(1.2))]
        {
            assert_eq!(told(sod_mm, magnification), "", "{sod_mm:?}, {magnification:?}");
        }
    }
}
