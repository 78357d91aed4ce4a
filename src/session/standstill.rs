//! A frame against the earlier ones of its session: a specimen that moves while the arm stands still, and a picture whose magnification is
//! not that of the others.
//!
//! What sag and an uncalibrated arm explain is the same for two frames of one stand, so far less is allowed than between any two. Along
//! the beam sensors hardly tell: a depth that differs from that of similar directions by more than sag does is another focal length, a
//! picture that was enlarged or cropped on its way, if nothing was moved.

use std::collections::{BTreeSet, VecDeque};

use glam::DVec3;

use super::depth_jump::DepthJump;
use super::posed::Posed;
use super::stand::{SAG_MM_PER_DEG, SIGMAS, Stand};
use crate::estimate::median;
use crate::geometry::Rigid;

/// Sensors of ±0.2° in three joints, 630 mm away, twice.
const MOVED_MM: f64 = 6.0;
const MOVED_DEG: f64 = 1.5;
/// Along the beam, at one stand.
const NEARER_MM: f64 = 3.0;
/// Along the beam, between stands, with so many robust standard deviations of how far the others lie apart.
const OTHER_DEPTH: (f64, f64) = (4.0, 3.0);
/// So many others, those with the nearest beams, tell what is usual.
const USUAL: usize = 4;
/// Frames that are remembered.
const KEPT: usize = 32;

/// What the earlier frames say of one.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct Contradiction {
    pub(super) words: String,
    /// The frame's own pose may be wrong for it: a specimen that was moved is where its beads are, in a picture of another scale it is not.
    pub(super) of_its_depth: bool,
}

/// See the module.
#[derive(Clone, Debug)]
pub(super) struct Standstill {
    centre_lps_mm: DVec3,
    depth_jump: DepthJump,
    /// In the order in which they were registered.
    stands: VecDeque<Stand>,
    /// Frames of whose depth it was said.
    told: BTreeSet<u32>,
}

impl Standstill {
    /// `declared` is where the session has the specimen.
    pub(super) fn new(centre_lps_mm: DVec3, declared: Option<Rigid>) -> Self {
        let depth_jump = DepthJump::new(centre_lps_mm, declared);
        Self { centre_lps_mm, depth_jump, stands: VecDeque::new(), told: BTreeSet::new() }
    }

    /// Takes a posed frame and where its beads put the specimen; words where the earlier frames contradict it.
    pub(super) fn observe(&mut self, posed: &Posed, world_from_lps: Option<Rigid>) -> Option<Contradiction> {
        let (joints, world_from_lps) = posed.joints.zip(world_from_lps)?;
        // Of a pose that telemetry is fused into, what the beads alone say, and no surer than both together.
        let (camera_from_lps, variances) = match posed.pose.innovation.filter(|_| posed.pose.fused) {
            Some(off) => (off.camera_from_lps, off.sigma_mm.map(|sigma| sigma * sigma)),
            None => {
                let covariance = posed.pose.covariance_at_centroid?;
                (posed.pose.camera_from_lps?, [3, 4, 5].map(|n: usize| covariance[n][n]))
            }
        };
        let world_from_camera = world_from_lps * camera_from_lps.inverse();
        self.take(Stand {
            number: posed.number,
            joints,
            world_from_lps,
            beam_in_world: world_from_camera.transform_vector(DVec3::Z),
            depth_mm: camera_from_lps.transform_point(self.centre_lps_mm).z,
            sigma_mm: variances.iter().sum::<f64>().sqrt(),
            sigma_depth_mm: variances[2].sqrt(),
        })
    }

    fn take(&mut self, now: Stand) -> Option<Contradiction> {
        // One that is posed anew does not speak for itself, and it may be wrong anew.
        self.told.remove(&now.number);
        self.stands.retain(|before| before.number != now.number);
        let moved = self.stands.iter().rev().find(|before| before.is_where(&now)).and_then(|before| self.moved(before, &now));
        let is_usual = || self.depth_jump.is_usual(self.stands.iter(), &now);
        let of_its_depth =
            || self.enlarged(&now).filter(|_| !is_usual()).or_else(|| self.depth_jump.of_now(self.stands.iter(), &now));
        let said = moved.map(|words| Contradiction { words, of_its_depth: false });
        let said = said.or_else(|| of_its_depth().map(|words| Contradiction { words, of_its_depth: true }));
        let (mut wrong, mut of_before) = (Vec::new(), None);
        if said.is_none()
            && let Some((numbers, words)) =
                self.depth_jump.of_before(self.stands.iter(), &now, |number| self.told.contains(&number))
        {
            (wrong, of_before) = (numbers, Some(Contradiction { words, of_its_depth: false }));
        }
        self.told.extend(wrong);
        self.told.extend(said.as_ref().filter(|said| said.of_its_depth).map(|_| now.number));
        self.stands.push_back(now);
        if self.stands.len() > KEPT {
            self.stands.pop_front();
        }
        said.or(of_before)
    }

    fn moved(&self, before: &Stand, now: &Stand) -> Option<String> {
        let deg = before.world_from_lps.angle_to_rad(&now.world_from_lps).to_degrees();
        let shift_mm = self.place(now) - self.place(before);
        let (mm, depth_mm) = (shift_mm.length(), shift_mm.dot(now.beam_in_world));
        let allowed_mm = MOVED_MM + SIGMAS * before.sigma_mm.hypot(now.sigma_mm);
        let allowed_depth_mm = NEARER_MM + SIGMAS * before.sigma_depth_mm.hypot(now.sigma_depth_mm);
        // Which of two that differ in depth alone is wrong others may tell.
        let is_depth_alone = self.depth_jump.is_between(now, before);
        if is_depth_alone || (mm <= allowed_mm && deg <= MOVED_DEG && depth_mm.abs() <= allowed_depth_mm) {
            return None;
        }
        // An enlargement cannot turn.
        let may_be_enlarged = depth_mm.abs() > allowed_depth_mm && deg <= MOVED_DEG;
        Some(format!(
            "the specimen lies {mm:.1} mm and {deg:.1} degrees from where frame {} shows it, with the arm in the same place: specimen, \
             table or the arm's base was moved, or an encoder jumped{}",
            before.number,
            if may_be_enlarged { enlargement(depth_mm, now.depth_mm) } else { String::new() }
        ))
    }

    /// Words where the specimen is nearer, or farther away, than the frames from similar directions have it.
    fn enlarged(&self, now: &Stand) -> Option<String> {
        let turn_deg = |stand: &Stand| stand.beams_deg(now);
        // Of equal beams the latest.
        let mut others: Vec<&Stand> = self.stands.iter().rev().collect();
        others.sort_by(|a, b| turn_deg(a).total_cmp(&turn_deg(b)));
        others.truncate(USUAL);
        if others.len() < USUAL {
            return None;
        }
        let depths_mm = others.iter().map(|stand| (self.place(now) - self.place(stand)).dot(now.beam_in_world));
        let usual_mm = median(depths_mm.clone())?;
        let spread_mm = 1.4826 * median(depths_mm.map(|mm| (mm - usual_mm).abs()))?;
        let sigma_mm = median(others.iter().map(|stand| stand.sigma_depth_mm))?;
        let sag_mm = SAG_MM_PER_DEG * median(others.iter().map(|stand| turn_deg(stand)))?;
        let allowed_mm = OTHER_DEPTH.0 + OTHER_DEPTH.1 * spread_mm + SIGMAS * sigma_mm.hypot(now.sigma_depth_mm) + sag_mm;
        (!(usual_mm.abs() <= allowed_mm)).then(|| {
            let (mm, nearer) = (usual_mm.abs(), if usual_mm < 0.0 { "nearer to the source" } else { "farther from the source" });
            format!(
                "the specimen is {mm:.0} mm {nearer} than the {} frames from the nearest directions have it{}; or specimen or arm was moved",
                others.len(),
                enlargement(usual_mm, now.depth_mm)
            )
        })
    }

    /// Where the specimen is, in `world`.
    fn place(&self, stand: &Stand) -> DVec3 {
        stand.world_from_lps.transform_point(self.centre_lps_mm)
    }
}

/// What a picture would look like in which nothing but the magnification differs.
fn enlargement(farther_mm: f64, depth_mm: f64) -> String {
    let share = -farther_mm / depth_mm;
    let way = if share > 0.0 { "enlarged" } else { "reduced" };
    format!(
        ": a picture {way} by {:.1} % on its way looks so as well (zoom, crop, source-to-detector distance, pitch)",
        100.0 * share.abs()
    )
}

#[cfg(test)]
mod tests {
    use super::*;

    fn stand(number: u32, orbital_deg: f64, shift_mm: f64, sigma_mm: f64) -> Stand {
        Stand::at(number, orbital_deg, DVec3::new(0.0, shift_mm, 0.0), sigma_mm)
    }

    fn at(number: u32, orbital_deg: f64, place_mm: DVec3, sigma_mm: f64) -> Stand {
        Stand::at(number, orbital_deg, place_mm, sigma_mm)
    }

    impl Standstill {
        /// Of a session that declares nothing.
        fn undeclared() -> Self {
            Self::new(DVec3::ZERO, None)
        }

        fn words(&mut self, now: Stand) -> Option<String> {
            self.take(now).map(|said| said.words)
        }
    }

    #[test]
    fn a_specimen_that_slides_under_a_standing_arm_is_said_and_what_an_arm_explains_is_not() {
        let mut standstill = Standstill::undeclared();
        assert_eq!(standstill.words(stand(1, 30.0, 0.0, 0.3)), None);
        assert_eq!(standstill.words(stand(2, 30.3, 1.0, 0.3)), None, "sensors");
        let words = standstill.words(stand(3, 29.8, 9.5, 0.3)).expect("8.5 mm");
        assert!(words.contains("8.5 mm") && words.contains("frame 2"), "{words}");
        assert_eq!(standstill.words(stand(4, 30.0, 9.0, 0.3)), None, "it is said once");
        assert_eq!(standstill.words(stand(5, 75.0, 22.0, 0.3)), None, "the arm sags as it turns");
        assert_eq!(standstill.words(stand(6, 30.0, 18.0, 1.5)), None, "poses that are known to 1.5 mm each");
        assert!(standstill.words(stand(7, 75.0, f64::NAN, 0.3)).is_some(), "NaN is no place");
    }

    #[test]
    fn a_picture_that_was_enlarged_in_mid_session_is_said_and_an_arm_that_sags_is_not() {
        // 2 % larger: 14 mm nearer, along whatever beam.
        let along =
            |orbital_deg: f64, mm: f64| DVec3::new(orbital_deg.to_radians().sin(), 0.0, orbital_deg.to_radians().cos()) * mm;
        let turned = [0.0, 40.0, -30.0, 75.0, 20.0];
        let mut sound = Standstill::undeclared();
        for (number, deg) in (1..).zip(turned) {
            assert_eq!(sound.words(at(number, deg, along(deg, 0.3 * f64::from(number % 3)), 0.3)), None);
        }
        let words = sound.clone().words(at(6, 55.0, along(55.0, -14.0), 0.3)).expect("2 %");
        assert!(words.contains("14 mm nearer") && words.contains("enlarged by 2.0 %"), "{words}");
        assert_eq!(sound.clone().words(at(6, 55.0, along(55.0, -14.0), 3.0)), None, "depths that are known to 3 mm each");
        assert_eq!(sound.clone().words(at(6, -160.0, along(-160.0, -14.0), 0.3)), None, "an arm from the other side may sag so");
        assert!(sound.clone().words(at(6, 55.0, DVec3::NAN, 0.3)).is_some(), "NaN is no place");
        // At a stand of the session already one frame tells.
        let words = sound.words(at(6, 75.3, along(75.3, -5.6), 0.3)).expect("0.8 %");
        assert!(words.contains("frame 4") && words.contains("enlarged by 0.8 %"), "{words}");

        let mut sagging = Standstill::undeclared();
        for (number, (deg, mm)) in (1..).zip(turned.into_iter().zip([0.0, 6.0, 4.0, 11.0, 2.0])) {
            assert_eq!(sagging.words(at(number, deg, along(deg, mm), 0.3)), None);
        }
        assert_eq!(sagging.words(at(6, 90.0, along(90.0, 14.0), 0.3)), None, "as far apart as the others");
        let mut still = Standstill::undeclared();
        for number in 1..6 {
            still.words(at(number, 0.0, DVec3::ZERO, 0.3));
        }
        assert_eq!(still.words(at(6, 90.0, along(90.0, 12.0), 0.3)), None, "all the others from one direction");
    }

    #[test]
    fn an_enlargement_cannot_turn_and_what_differs_in_depth_alone_is_the_picture_s() {
        let mut standstill = Standstill::undeclared();
        assert_eq!(standstill.take(at(1, 30.0, DVec3::ZERO, 0.3)), None);
        let mut turned = at(2, 30.0, DVec3::ZERO, 0.3);
        turned.world_from_lps = Rigid::exp(DVec3::X * 0.5, turned.beam_in_world * -9.0);
        let said = standstill.clone().take(turned).expect("29 degrees");
        assert!(!said.of_its_depth && said.words.contains("28.6 degrees") && !said.words.contains("enlarged"), "{}", said.words);

        let enlarged = |number| {
            let mut stand = at(number, 30.0, DVec3::ZERO, 0.3);
            stand.world_from_lps = Rigid::translation(stand.beam_in_world * -6.0);
            stand
        };
        let said = standstill.take(enlarged(2)).expect("0.9 %");
        assert!(said.of_its_depth && said.words.contains("enlarged by 0.9 %"), "{}", said.words);
        let said = standstill.take(enlarged(2)).expect("posed anew it does not speak for itself");
        assert!(said.words.contains("than frame 1,"), "{}", said.words);
        assert!(standstill.take(enlarged(3)).is_some_and(|said| said.words.contains("frame 2 agrees with this one")));
    }

    /// The first frame had the wrong scale, and that was never said.
    #[test]
    fn of_an_earlier_frame_it_is_said_once_when_others_agree() {
        let mut standstill = Standstill::new(DVec3::ZERO, Some(Rigid::IDENTITY));
        let wrong = at(1, 0.0, DVec3::new(0.0, 0.0, -6.0), 0.3);
        assert_eq!(standstill.take(wrong), None, "nothing to hold it against but the session's word");
        let said = standstill.take(at(2, 12.0, DVec3::ZERO, 0.3)).expect("frame 1 is off");
        let agree = "frame 2 and world_from_lps of the session agree";
        assert!(
            !said.of_its_depth && said.words.contains(agree) && said.words.contains("(frame 1: 6.0 mm nearer"),
            "{}",
            said.words
        );
        assert_eq!(standstill.take(at(3, -14.0, DVec3::ZERO, 0.3)), None, "once");
    }

    /// The table was raised under a vertical beam, and all that came afterwards was said to be of a wrong scale.
    #[test]
    fn once_most_frames_are_on_the_new_side_none_is_said_of_a_specimen_that_was_moved_along_the_beam() {
        let mut standstill = Standstill::undeclared();
        let mut said = |number: u32, along_mm: f64| standstill.take(at(number, 0.0, DVec3::Z * along_mm, 0.3));
        for number in 1..=6 {
            assert_eq!(said(number, 0.0), None);
        }
        let first = said(7, 30.0).expect("raised by 30 mm");
        assert!(first.words.contains("moved"), "{}", first.words);
        let told: Vec<u32> = (8..=24).filter(|number| said(*number, 30.0).is_some_and(|said| said.of_its_depth)).collect();
        assert!(told.iter().all(|number| *number <= 14), "{told:?}");
    }
}
