//! Where the specimen lies in the room: declared by the session, else learnt from frames that agree, and given up when later ones do not.

use glam::DVec3;

use crate::geometry::Rigid;

/// Two frames agree when the specimen's beads lie within this of each other in the room: a joint sensor of ±0.2° alone is 2 mm, uncorrected
/// sag of a mobile C-arm up to 16 mm.
const AGREE_MM: f64 = 20.0;
/// Same, for its orientation.
const AGREE_DEG: f64 = 3.0;
/// So many frames in a row that disagree with the tie, and agree with each other, replace it.
const REPLACED_BY: usize = 2;
/// So many files in a row that disagree with the tie, each also with the one before, end it: where the specimen lies nobody knows then.
const GIVEN_UP_AFTER: usize = 3;

/// How far two ideas of the specimen in the room lie apart.
#[derive(Clone, Copy, Debug, PartialEq, serde::Serialize, serde::Deserialize)]
pub struct Disagreement {
    /// At the centroid of the beads.
    pub mm: f64,
    /// Of the orientation.
    pub deg: f64,
}

impl Disagreement {
    fn between(a: &Rigid, b: &Rigid, centre_lps_mm: DVec3) -> Self {
        let mm = a.transform_point(centre_lps_mm).distance(b.transform_point(centre_lps_mm));
        Self { mm, deg: a.rotation.angle_between(b.rotation).to_degrees() }
    }

    /// How far the two are apart, where they do not agree.
    pub(super) fn where_they_disagree(a: &Rigid, b: &Rigid, centre_lps_mm: DVec3) -> Option<Self> {
        Some(Self::between(a, b, centre_lps_mm)).filter(|apart| !apart.agrees())
    }

    /// NaN does not agree.
    fn agrees(self) -> bool {
        self.mm <= AGREE_MM && self.deg <= AGREE_DEG
    }
}

/// What a frame's pose means for the tie.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct TieVerdict {
    /// How far the frame is from the tie that held before it, and without one from the frame before; `None` where it agrees, and of the first.
    pub disagreement: Option<Disagreement>,
    /// What changed, or what is wrong, for a person.
    pub words: Option<String>,
}

/// A frame and where it puts the specimen.
#[derive(Clone, Debug)]
struct Witness {
    number: u32,
    /// Hash of its file: the images of one run are one witness.
    content: String,
    world_from_lps: Rigid,
    /// Its pose may be another: it may end a tie, and ties nothing.
    in_doubt: bool,
}

/// See the module.
#[derive(Clone, Debug)]
pub struct SpecimenTie {
    declared: bool,
    tied: Option<Rigid>,
    centre_lps_mm: DVec3,
    /// Frames that the tie rests on.
    tied_by: Vec<u32>,
    /// Latest frames that do not support the tie.
    dissenting: Vec<Witness>,
}

impl SpecimenTie {
    /// `declared` is the session's word; `centre_lps_mm` is where distances are taken.
    #[must_use]
    pub fn new(declared: Option<Rigid>, centre_lps_mm: DVec3) -> Self {
        Self { declared: declared.is_some(), tied: declared, centre_lps_mm, tied_by: Vec::new(), dissenting: Vec::new() }
    }

    /// Where the specimen lies; `None` until the session or two frames say so.
    #[must_use]
    pub fn world_from_lps(&self) -> Option<Rigid> {
        self.tied
    }

    /// Whether the latest frame contradicts where the specimen is taken to lie.
    #[must_use]
    pub fn is_disputed(&self) -> bool {
        self.tied.is_some() && !self.dissenting.is_empty()
    }

    /// Frames without which the tie, or the next one, would be another.
    pub fn rests_on(&self) -> impl Iterator<Item = u32> + '_ {
        self.tied_by.iter().copied().chain(self.dissenting.iter().map(|witness| witness.number))
    }

    /// Takes where an accepted frame of the file `content` puts the specimen; `in_doubt` when its pose may be another. What is in doubt ties
    /// nothing: a reading that is wrong in one view is as wrong in the next, and the two agree. It may end a tie that it is far from.
    /// A frame that `jumps` is too far from the tie for the arm as it was measured: however near, it disagrees.
    pub fn observe(&mut self, number: u32, content: &str, world_from_lps: Rigid, in_doubt: bool, jumps: bool) -> TieVerdict {
        if in_doubt && self.tied.is_none() {
            let words = "its pose is in doubt and does not tie the specimen to the room".to_owned();
            return TieVerdict { disagreement: None, words: Some(words) };
        }
        let apart = self.tied.map(|tied| Disagreement::between(&tied, &world_from_lps, self.centre_lps_mm));
        if !jumps && apart.is_some_and(Disagreement::agrees) {
            self.dissenting.clear();
            return TieVerdict::default();
        }
        let agrees =
            |other: &&Witness| Disagreement::between(&other.world_from_lps, &world_from_lps, self.centre_lps_mm).agrees();
        let others = self.dissenting.iter().rev().filter(|other| other.content != content);
        let supporters: Vec<u32> = others.take_while(agrees).map(|other| other.number).collect();
        // Without a tie, one of two that contradict each other is wrong; which one nobody knows.
        let latest = self.dissenting.iter().rev().find(|other| other.content != content).filter(|_| self.tied.is_none());
        let before = latest.map(|other| Disagreement::between(&other.world_from_lps, &world_from_lps, self.centre_lps_mm));
        let before = before.filter(|before| !before.agrees());
        let mut words = match (apart, supporters.len() + 1 >= REPLACED_BY, self.declared) {
            (Some(apart), _, true) => Some(format!(
                "its beads put the specimen {:.1} mm and {:.1} degrees from where the session's world_from_lps and telemetry do: check \
                 world_from_lps, the C-arm's calibration and its encoders",
                apart.mm, apart.deg
            )),
            (Some(apart), true, false) => Some(format!(
                "the specimen was tied to the room anew: this frame and frame {} agree with each other and put it {:.1} mm and {:.1} \
                 degrees from where it was; it was moved, or telemetry is wrong",
                supporters[0], apart.mm, apart.deg
            )),
            (Some(apart), false, false) => Some(format!(
                "its beads put the specimen {:.1} mm and {:.1} degrees from where earlier frames and telemetry do: was it moved, or is \
                 telemetry wrong?",
                apart.mm, apart.deg
            )),
            (None, true, _) => None,
            (None, false, _) => before.map(|before| {
                format!(
                    "it does not agree with the frame before on where the specimen lies in the room ({:.1} mm, {:.1} degrees apart): check the \
                     C-arm's calibration, its joints' signs and which frame belongs to which exposure; there is no pose from telemetry until \
                     two frames agree",
                    before.mm, before.deg
                )
            }),
        };
        if supporters.len() + 1 >= REPLACED_BY && !self.declared {
            self.tied = Some(world_from_lps);
            self.tied_by = supporters.into_iter().chain([number]).collect();
            self.dissenting.clear();
        } else {
            let witness = Witness { number, content: content.to_owned(), world_from_lps, in_doubt };
            if self.gives_up_after(witness) {
                words = words.map(|words| {
                    format!("{words}; the specimen is no longer tied to the room: three files in a row put it elsewhere, no two alike in a row")
                });
            }
        }
        TieVerdict { disagreement: apart.or(before), words }
    }

    /// A frame was refused because its beads contradict where the specimen is expected: nobody knows where they have it. What changed, for a
    /// person.
    pub fn contradict(&mut self, number: u32, content: &str) -> Option<String> {
        self.tied?;
        let nowhere = Rigid { translation_mm: DVec3::NAN, ..Rigid::IDENTITY };
        let witness = Witness { number, content: content.to_owned(), world_from_lps: nowhere, in_doubt: true };
        let words = "the specimen is no longer tied to the room: three files in a row contradict where it is taken to lie";
        self.gives_up_after(witness).then(|| words.to_owned())
    }

    /// Takes a frame that does not support the tie; whether the tie has ended with it.
    fn gives_up_after(&mut self, witness: Witness) -> bool {
        self.dissenting.retain(|other| other.content != witness.content);
        self.dissenting.push(witness);
        if self.dissenting.len() > GIVEN_UP_AFTER {
            self.dissenting.remove(0);
        }
        let gives_up = self.dissenting.len() == GIVEN_UP_AFTER && self.tied.is_some() && !self.declared;
        if gives_up {
            self.tied = None;
            self.tied_by.clear();
            self.dissenting.retain(|other| !other.in_doubt);
        }
        gives_up
    }

    /// A frame turned out to be wrong: what rests on it is given up. Returns what changed, for a person.
    pub fn retract(&mut self, number: u32, because: &str) -> Option<String> {
        self.dissenting.retain(|other| other.number != number);
        if self.declared || !self.tied_by.contains(&number) {
            return None;
        }
        self.tied = None;
        self.tied_by.clear();
        Some(format!("the specimen is no longer tied to the room: {because}"))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Each number is a file of its own.
    fn observe(tie: &mut SpecimenTie, number: u32, world_from_lps: Rigid) -> TieVerdict {
        tie.observe(number, &number.to_string(), world_from_lps, false, false)
    }

    #[test]
    fn poses_in_doubt_agree_with_each_other_and_tie_nothing() {
        let mut tie = SpecimenTie::new(None, DVec3::ZERO);
        for number in 1..5 {
            let verdict = tie.observe(number, &number.to_string(), at(0.0), true, false);
            assert!(verdict.words.is_some_and(|words| words.contains("in doubt")));
        }
        assert_eq!(tie.world_from_lps(), None);
        observe(&mut tie, 5, at(60.0));
        observe(&mut tie, 6, at(61.0));
        assert_eq!(tie.world_from_lps(), Some(at(61.0)), "what is in doubt contradicts nothing");
        // A specimen that was moved is found far from where it was expected, which is a doubt.
        tie.observe(7, "7", at(200.0), true, false);
        tie.observe(8, "8", at(201.0), true, false);
        assert_eq!(tie.world_from_lps(), Some(at(201.0)));
    }

    #[test]
    fn the_images_of_one_run_are_one_witness() {
        let mut tie = SpecimenTie::new(None, DVec3::ZERO);
        (1..9).for_each(|number| drop(tie.observe(number, "run", at(0.0), false, false)));
        assert_eq!(tie.world_from_lps(), None);
        tie.observe(9, "another", at(1.0), false, false);
        assert_eq!(tie.world_from_lps(), Some(at(1.0)));
    }

    fn at(x: f64) -> Rigid {
        Rigid::translation(DVec3::new(x, 0.0, 0.0))
    }

    #[test]
    fn one_frame_does_not_tie_the_specimen_and_two_that_agree_do() {
        let mut tie = SpecimenTie::new(None, DVec3::ZERO);
        assert_eq!(observe(&mut tie, 1, at(0.0)), TieVerdict::default());
        assert_eq!(tie.world_from_lps(), None);
        let contradiction = observe(&mut tie, 2, at(500.0));
        assert!(contradiction.words.is_some() && contradiction.disagreement.is_some(), "a contradiction is said");
        assert_eq!(tie.world_from_lps(), None);
        observe(&mut tie, 3, at(501.0));
        assert_eq!(tie.world_from_lps(), Some(at(501.0)));
    }

    #[test]
    fn a_tie_survives_one_outlier_and_is_replaced_by_two_frames_that_agree() {
        let mut tie = SpecimenTie::new(None, DVec3::ZERO);
        observe(&mut tie, 1, at(0.0));
        observe(&mut tie, 2, at(1.0));
        let outlier = observe(&mut tie, 3, at(170.0));
        assert_eq!(outlier.disagreement.map(|apart| apart.mm), Some(169.0));
        assert_eq!(tie.world_from_lps(), Some(at(1.0)));
        observe(&mut tie, 4, at(0.0));
        assert!(observe(&mut tie, 5, at(171.0)).disagreement.is_some());
        assert_eq!(tie.world_from_lps(), Some(at(1.0)), "the outlier before an agreeing frame does not count");
        assert!(observe(&mut tie, 6, at(172.0)).words.is_some());
        assert_eq!(tie.world_from_lps(), Some(at(172.0)));
        assert_eq!(tie.retract(1, "why"), None, "an old frame no longer matters");
        assert!(tie.retract(5, "why").is_some());
        assert_eq!(tie.world_from_lps(), None);
    }

    #[test]
    fn a_tie_that_nothing_supports_any_more_is_given_up() {
        let mut tie = SpecimenTie::new(None, DVec3::ZERO);
        observe(&mut tie, 1, at(0.0));
        observe(&mut tie, 2, at(1.0));
        let [_, second, third] = [(3, 100.0), (4, 200.0), (5, 300.0)].map(|(number, x)| observe(&mut tie, number, at(x)));
        assert!(second.words.is_some_and(|words| !words.contains("no longer tied")));
        assert!(third.words.is_some_and(|words| words.contains("no longer tied")));
        assert_eq!(tie.world_from_lps(), None);
        observe(&mut tie, 6, at(301.0));
        assert_eq!(tie.world_from_lps(), Some(at(301.0)), "the next two that agree tie it");
        // The images of one run count once.
        (7..20).for_each(|number| drop(tie.observe(number, "run", at(100.0 * f64::from(number)), false, false)));
        assert_eq!(tie.world_from_lps(), Some(at(301.0)));
    }

    /// Else a specimen that was moved would be sought for ever where it lay.
    #[test]
    fn frames_that_are_refused_for_what_is_expected_of_them_end_the_tie() {
        let mut tie = SpecimenTie::new(None, DVec3::ZERO);
        assert_eq!((tie.contradict(1, "1"), tie.is_disputed()), (None, false), "nothing is tied");
        observe(&mut tie, 2, at(0.0));
        observe(&mut tie, 3, at(1.0));
        assert_eq!((tie.contradict(4, "4"), tie.contradict(5, "run"), tie.contradict(6, "run")), (None, None, None));
        assert!(tie.is_disputed());
        observe(&mut tie, 7, at(1.0));
        assert!(!tie.is_disputed(), "a frame supports it");
        assert_eq!((tie.contradict(8, "8"), tie.contradict(9, "9")), (None, None));
        assert!(tie.contradict(10, "10").is_some());
        assert_eq!(tie.world_from_lps(), None);
        let mut declared = SpecimenTie::new(Some(at(0.0)), DVec3::ZERO);
        assert!((1..9).all(|number| declared.contradict(number, &number.to_string()).is_none()));
        assert_eq!(declared.world_from_lps(), Some(at(0.0)));
    }

    #[test]
    fn the_sessions_word_is_not_overruled_but_its_contradiction_is_said() {
        let mut tie = SpecimenTie::new(Some(at(0.0)), DVec3::ZERO);
        for number in 1..5 {
            assert!(observe(&mut tie, number, at(100.0)).words.is_some());
        }
        assert_eq!(tie.world_from_lps(), Some(at(0.0)));
        assert!(observe(&mut tie, 9, at(f64::NAN)).disagreement.is_some(), "NaN does not agree");
    }
}
