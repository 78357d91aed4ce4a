//! A frame whose specimen is off that of the others in depth alone: the trace of a picture whose magnification is not what is stated of it.
//!
//! An arm that sags and sensors that err shift the specimen across the beam and turn it as well, more so from other directions; a specimen
//! that was moved is off across the beam of another direction. A picture that was enlarged, or a detector at another distance than is
//! told, is off along its own beam and in nothing else. Frames that agree with each other speak for one another; two that do not cannot
//! tell which of them is wrong.

use glam::DVec3;

use super::stand::{SAG_MM_PER_DEG, SIGMAS, Stand};
use crate::geometry::Rigid;

/// Less than this is no jump in depth, however well the poses are known.
const LEAST_MM: f64 = 2.0;
/// What encoders that nobody has calibrated make of a way along the lift or the longitudinal axis, as a share of it.
const TRAVEL_SHARE: f64 = 0.02;
/// Nothing but the depth differs where the specimen is turned by no more …
const STRAIGHT_DEG: f64 = 0.3;
/// … and across the beam no farther away than this, and that share of the depth: the centre of what was enlarged is not the beam's.
const STRAIGHT_MM: f64 = 0.5;
const STRAIGHT_SHARE: f64 = 0.1;
/// One frame with its beam so near is enough to be held against …
const NEAR_DEG: f64 = 10.0;
/// … and from here on two must agree: an arm that bends as it turns would show it between them.
const FAR_DEG: f64 = 30.0;
/// What the session declares counts as so many frames, where one agrees with it.
const DECLARED: usize = 2;
/// A frame with so many more on its side is not doubted.
const MAJORITY: usize = 2;

/// How far one frame puts the specimen from where something else has it.
#[derive(Clone, Copy, Debug)]
struct Apart {
    /// Along the frame's own beam.
    depth_mm: f64,
    across_mm: f64,
    turn_deg: f64,
    /// What is no jump, and what is no shift.
    limits_mm: [f64; 2],
}

impl Apart {
    fn is_straight(&self) -> bool {
        self.turn_deg <= STRAIGHT_DEG && self.across_mm <= self.limits_mm[1]
    }

    /// They differ, and in nothing else.
    fn is_depth_alone(&self) -> bool {
        self.depth_mm.abs() > self.limits_mm[0] && self.is_straight()
    }

    fn agrees(&self) -> bool {
        self.depth_mm.abs() <= 0.5 * self.limits_mm[0] && self.is_straight()
    }
}

/// A side of a disagreement: frames that agree with one of them, that one first.
#[derive(Clone, Debug)]
struct Side {
    numbers: Vec<u32>,
    /// And so does what the session declares.
    declared: bool,
    /// One agrees from another direction: pictures of a wrong scale would not.
    crossed: bool,
}

impl Side {
    fn weight(&self) -> usize {
        self.numbers.len() + usize::from(self.crossed) + if self.declared { DECLARED } else { 0 }
    }

    fn words(&self) -> String {
        let declared = if self.declared { " and world_from_lps of the session" } else { "" };
        format!("{}{declared}", frames(&self.numbers))
    }
}

/// What is held against what.
#[derive(Clone, Copy, Debug)]
pub(super) struct DepthJump {
    centre_lps_mm: DVec3,
    /// Where the session declares the specimen.
    declared: Option<Rigid>,
}

impl DepthJump {
    pub(super) fn new(centre_lps_mm: DVec3, declared: Option<Rigid>) -> Self {
        Self { centre_lps_mm, declared }
    }

    /// Whether the two differ in depth alone, along the beam of `now`.
    pub(super) fn is_between(&self, now: &Stand, other: &Stand) -> bool {
        self.apart(now, other).is_some_and(|apart| apart.is_depth_alone())
    }

    /// Whether most frames are on the side of `now`.
    pub(super) fn is_usual<'a>(&self, before: impl Iterator<Item = &'a Stand> + Clone, now: &Stand) -> bool {
        let own = self.side(before.clone(), now).weight();
        let mut against = before.clone().filter(|other| self.is_between(now, other));
        own >= 2 && against.all(|other| own >= self.side(before.clone(), other).weight() + MAJORITY)
    }

    /// That `now` is off earlier frames in depth alone; `None` where it is not, or where most are on its side.
    pub(super) fn of_now<'a>(&self, before: impl Iterator<Item = &'a Stand> + Clone, now: &Stand) -> Option<String> {
        let own = self.side(before.clone(), now);
        let jumps = before.clone().filter(|other| self.is_between(now, other));
        let against = jumps.map(|other| (self.side(before.clone(), other), other));
        let counts = |(side, other): &(Side, &Stand)| {
            let heard = side.weight() >= 2 || now.beams_deg(other) <= NEAR_DEG;
            heard && own.weight() < side.weight() + MAJORITY
        };
        let (side, other) = against.filter(counts).max_by(|(a, stand_a), (b, stand_b)| {
            let nearer = now.beams_deg(stand_b).total_cmp(&now.beams_deg(stand_a));
            a.weight().cmp(&b.weight()).then(nearer)
        })?;
        let apart = self.apart(now, other)?;
        let agreeing: Vec<u32> = own.numbers.iter().copied().filter(|number| *number != now.number).collect();
        let with_it = match agreeing.len() {
            0 => String::new(),
            1 => format!("; {} agrees with this one", frames(&agreeing)),
            _ => format!("; {} agree with this one", frames(&agreeing)),
        };
        let whose = if side.weight() >= own.weight() + MAJORITY {
            "this picture is likely the wrong one, and its pose is off by as much, unless the specimen, its table or the arm was moved along the beam"
        } else {
            "which of them is wrong they cannot tell, and one of the poses is off by as much, or the specimen was moved along the beam"
        };
        Some(format!(
            "its beads put the specimen {} than {}, and nothing but the depth differs: {}{with_it}; {whose}",
            off(apart.depth_mm),
            side.words(),
            looks_so(apart.depth_mm, now),
        ))
    }

    /// Earlier frames that are off `now`, and off another that agrees with it, in depth alone along their own beams; `is_told` says of which
    /// it has been said.
    pub(super) fn of_before<'a>(
        &self,
        before: impl Iterator<Item = &'a Stand> + Clone,
        now: &'a Stand,
        is_told: impl Fn(u32) -> bool,
    ) -> Option<(Vec<u32>, String)> {
        let own = self.side(before.clone(), now);
        let of_side = |stand: &&Stand| own.numbers.contains(&stand.number);
        let nearest = |wrong: &Stand| {
            let with_now = before.clone().filter(of_side).chain([now]);
            with_now.min_by(|a, b| wrong.beams_deg(a).total_cmp(&wrong.beams_deg(b)))
        };
        let found: Vec<(&'a Stand, f64)> = before
            .clone()
            .filter(|wrong| !own.numbers.contains(&wrong.number) && !is_told(wrong.number))
            .filter(|wrong| own.weight() >= 2 && own.weight() > self.side(before.clone(), wrong).weight())
            .filter_map(|wrong| Some((wrong, self.apart(wrong, nearest(wrong)?)?)))
            .filter(|(_, apart)| apart.is_depth_alone())
            .map(|(wrong, apart)| (wrong, apart.depth_mm))
            .collect();
        let (worst, depth_mm) = *found.iter().max_by(|a, b| a.1.abs().total_cmp(&b.1.abs()))?;
        let numbers: Vec<u32> = found.iter().map(|(wrong, _)| wrong.number).collect();
        let words = format!(
            "{} agree on where the specimen is; the beads of {} put it elsewhere (frame {}: {}), and nothing but the depth differs: {}; the poses \
             of {} are off by as much, unless the specimen was moved along the beam",
            own.words(),
            frames(&numbers),
            worst.number,
            off(depth_mm),
            looks_so(depth_mm, worst),
            frames(&numbers),
        );
        Some((numbers, words))
    }

    /// Those that agree with `stand`, itself first.
    fn side<'a>(&self, all: impl Iterator<Item = &'a Stand>, stand: &Stand) -> Side {
        let others = all.filter(|other| other.number != stand.number);
        let agree: Vec<&Stand> = others.filter(|other| self.apart(stand, other).is_some_and(|apart| apart.agrees())).collect();
        let numbers = [stand.number].into_iter().chain(agree.iter().map(|other| other.number)).collect();
        let declared = self.declared.is_some_and(|declared| self.apart_from(stand, &declared, [0.0; 2], 0.0).agrees());
        Side { numbers, declared, crossed: agree.iter().any(|other| stand.beams_deg(other) > NEAR_DEG) }
    }

    /// `None` where the beams are so far apart that the arm tells nothing.
    fn apart(&self, stand: &Stand, other: &Stand) -> Option<Apart> {
        let beams_deg = stand.beams_deg(other);
        let sigmas_mm = [other.sigma_depth_mm, other.sigma_across_mm()];
        let bent_mm = SAG_MM_PER_DEG * beams_deg + TRAVEL_SHARE * stand.travel_mm(other);
        (beams_deg <= FAR_DEG).then(|| self.apart_from(stand, &other.world_from_lps, sigmas_mm, bent_mm))
    }

    fn apart_from(&self, stand: &Stand, world_from_lps: &Rigid, [depth, across]: [f64; 2], bent_mm: f64) -> Apart {
        let place = |world_from_lps: &Rigid| world_from_lps.transform_point(self.centre_lps_mm);
        let shift_mm = place(&stand.world_from_lps) - place(world_from_lps);
        let depth_mm = shift_mm.dot(stand.beam_in_world);
        let sigma_mm = [stand.sigma_depth_mm.hypot(depth), stand.sigma_across_mm().hypot(across)];
        Apart {
            depth_mm,
            across_mm: (shift_mm - depth_mm * stand.beam_in_world).length(),
            turn_deg: stand.world_from_lps.angle_to_rad(world_from_lps).to_degrees(),
            limits_mm: [
                LEAST_MM + SIGMAS * sigma_mm[0] + bent_mm,
                STRAIGHT_MM + STRAIGHT_SHARE * depth_mm.abs() + SIGMAS * sigma_mm[1],
            ],
        }
    }
}

/// "6.1 mm nearer to the source".
fn off(farther_mm: f64) -> String {
    let way = if farther_mm < 0.0 { "nearer to the source" } else { "farther from the source" };
    format!("{:.1} mm {way}", farther_mm.abs())
}

/// What else looks so, of a picture that has the specimen so much farther away.
fn looks_so(farther_mm: f64, stand: &Stand) -> String {
    let share = -farther_mm / stand.depth_mm;
    let way = if share > 0.0 { "enlarged" } else { "reduced" };
    let told_mm = stand.joints.source_to_detector_mm;
    let distance = if told_mm > 0.0 {
        format!("telemetry says {told_mm:.0} mm from source to detector, the beads would fit {:.0} mm", told_mm * (1.0 + share))
    } else {
        "another distance from source to detector than is stated".to_owned()
    };
    format!("a picture {way} by {:.1} % on its way looks so (zoom, crop, pitch; {distance})", 100.0 * share.abs())
}

/// "frames 1, 2 and 4".
fn frames(numbers: &[u32]) -> String {
    let mut sorted = numbers.to_vec();
    sorted.sort_unstable();
    let names: Vec<String> = sorted.iter().map(u32::to_string).collect();
    match names.split_last() {
        Some((last, [])) => format!("frame {last}"),
        Some((last, others)) => format!("frames {} and {last}", others.join(", ")),
        None => String::new(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A frame whose picture puts the specimen farther along its own beam, of an arm that says 1020 mm.
    fn stand(number: u32, orbital_deg: f64, farther_mm: f64) -> Stand {
        let mut stand = Stand::at(number, orbital_deg, DVec3::ZERO, 0.1);
        stand.world_from_lps = Rigid::translation(stand.beam_in_world * farther_mm);
        stand.joints.source_to_detector_mm = 1020.0;
        stand.depth_mm = 625.7;
        stand
    }

    fn said(declared: Option<Rigid>, frames: &[Stand]) -> Vec<Option<String>> {
        let rule = DepthJump::new(DVec3::ZERO, declared);
        (0..frames.len()).map(|n| rule.of_now(frames[..n].iter(), &frames[n])).collect()
    }

    fn numbers(frames: &[Stand], said: &[Option<String>]) -> Vec<u32> {
        frames.iter().zip(said).filter(|(_, words)| words.is_some()).map(|(frame, _)| frame.number).collect()
    }

    /// The detector was 10 and 20 mm farther away than telemetry said, and poses 6 and 12 mm off were green.
    #[test]
    fn another_distance_than_telemetry_s_is_said_of_the_pictures_that_have_it() {
        let declared = Some(Rigid::IDENTITY);
        let frames =
            [stand(1, 0.0, 0.01), stand(4, 19.0, -6.01), stand(5, 28.0, -11.92), stand(3, -11.0, -6.12), stand(2, -20.0, 0.01)];
        let told = said(declared, &frames);
        assert_eq!(numbers(&frames, &told), [4, 5, 3], "{told:#?}");
        let words = told[3].clone().unwrap_or_default();
        for part in
            ["6.1 mm nearer to the source than frame 1 and world_from_lps", "enlarged by 1.0 %", "1020 mm", "1030 mm", "likely"]
        {
            assert!(words.contains(part), "{part} in {words}");
        }
        // Nobody declares anything: two that agree from two directions are needed.
        let in_order = [&frames[0], &frames[4], &frames[3], &frames[1], &frames[2]].map(Clone::clone);
        let told = said(None, &in_order);
        assert_eq!(numbers(&in_order, &told), [3, 4, 5], "{told:#?}");
        assert_eq!(
            numbers(&frames, &said(None, &frames)),
            [5],
            "as they came: of frame 4 it is 9 degrees away, of frame 1 that is 19"
        );
        let rule = DepthJump::new(DVec3::ZERO, None);
        let (wrong, words) = rule.of_before(frames[..4].iter(), &frames[4], |number| number == 5).expect("frames 1 and 2 agree");
        assert!(
            wrong == [4, 3] && words.contains("frames 1 and 2 agree") && words.contains("frames 3 and 4"),
            "{wrong:?} {words}"
        );
        assert!(rule.of_before(frames[..4].iter(), &frames[4], |_| true).is_none(), "said already");
    }

    /// The frame that came last, and was right, was called the one that was reduced, and the wrong one stayed without a word.
    #[test]
    fn which_of_two_is_wrong_a_third_says_and_else_nobody() {
        let frames = [stand(1, 15.0, 0.0), stand(4, 15.0, -6.01), stand(3, 15.0, -6.04), stand(2, 15.0, 0.0)];
        let told = said(Some(Rigid::IDENTITY), &frames);
        assert_eq!(numbers(&frames, &told), [4, 3], "the session's word is with frames 1 and 2: {told:#?}");
        let told = said(None, &frames);
        assert_eq!(numbers(&frames, &told), [4, 3, 2], "{told:#?}");
        let words = told[3].clone().unwrap_or_default();
        for part in [
            "farther from the source than frames 3 and 4",
            "frame 1 agrees with this one",
            "which of them is wrong they cannot tell",
        ] {
            assert!(words.contains(part), "{part} in {words}");
        }
        let most = [stand(1, 15.0, 0.0), stand(2, 15.0, -6.0), stand(3, 15.0, 0.0), stand(4, 15.0, 0.0)];
        assert_eq!(numbers(&most, &said(None, &most)), [2, 3], "three against one");
    }

    #[test]
    fn what_an_arm_does_is_no_jump() {
        // Across and in depth, as sensors and sag have it.
        let bent = |number: u32, orbital_deg: f64, [across, along]: [f64; 2], turn_deg: f64| {
            let mut stand = stand(number, orbital_deg, along);
            let sideways = stand.beam_in_world.cross(DVec3::Y) * across;
            let turn = Rigid::exp(DVec3::X * turn_deg.to_radians(), DVec3::ZERO);
            stand.world_from_lps = Rigid::translation(stand.world_from_lps.translation_mm + sideways) * turn;
            stand
        };
        let sagging = [(0.0, [0.0, 0.0], 0.0), (8.0, [2.0, 3.5], 0.4), (16.0, [-2.0, 6.0], 0.5), (24.0, [1.5, 9.0], 0.9)];
        let sagging: Vec<Stand> = (1..).zip(sagging).map(|(n, (deg, mm, turn))| bent(n, deg, mm, turn)).collect();
        assert!(said(None, &sagging).iter().all(Option::is_none));
        let turned = [stand(1, 0.0, 0.0), bent(2, 0.0, [0.0, -6.0], 2.0)];
        assert!(said(Some(Rigid::IDENTITY), &turned).iter().all(Option::is_none), "an enlargement cannot turn");
        let shifted = [stand(1, 0.0, 0.0), bent(2, 0.0, [5.0, -6.0], 0.0)];
        assert!(said(None, &shifted).iter().all(Option::is_none), "nor shift by as much");
        let unsure = [stand(1, 0.0, 0.0), Stand { sigma_mm: 2.0, sigma_depth_mm: 2.0, ..stand(2, 0.0, -6.0) }];
        assert!(said(None, &unsure).iter().all(Option::is_none), "a depth that is known to 2 mm");
        let far = [stand(1, 0.0, 0.0), stand(2, 2.0, 0.0), stand(3, 60.0, -8.0)];
        assert!(said(None, &far).iter().all(Option::is_none), "from another side an arm sags so");
        let lifted = |number, lift_mm, along_mm| {
            let mut stand = stand(number, 0.0, along_mm);
            stand.joints.lift_mm = lift_mm;
            stand
        };
        let lifts = [lifted(1, 0.0, 0.0), lifted(2, 400.0, -4.0)];
        assert!(said(None, &lifts).iter().all(Option::is_none), "an encoder that is 1 % off");
        let still = [lifted(1, 400.0, 0.0), lifted(2, 400.0, -4.0)];
        assert!(said(None, &still)[1].is_some(), "the control");
        let nowhere = [stand(1, 0.0, 0.0), stand(2, 0.0, f64::NAN)];
        assert!(said(None, &nowhere).iter().all(Option::is_none), "no place is no depth");
    }
}
