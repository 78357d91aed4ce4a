//! Images that plainly do not show the same thing, and values that cannot be nepers.

use sidecarm::acquire::{Domain, Frame};
use sidecarm::compare::Scores;
use sidecarm::compare::{AirLevel, CommonDomain, CompareInput, Comparison, Disagreement, OffsetRule, Tone, compare};
use sidecarm::image::Image;
use sidecarm::mask::{Cause, MaskShares, Masks};
use sidecarm::report::{Pair, PairStatus, PoseSource};

use crate::compare_synthetic::{acquired, line_integral, view};

fn compared(input: &CompareInput) -> Comparison {
    compare(input).expect("comparable").comparison
}

/// A correlation of −0.98 passed without a word.
#[test]
fn a_frame_with_inverted_contrast_is_said_to_be_so_whatever_tone_absorbs_it() {
    let simulated = line_integral(&view());
    let right = acquired(&simulated, 0.004);
    let inverted = Frame { pixels: right.pixels.map(|v| 1.1 - v), unit: None, ..right.clone() };
    let shown = simulated.map(|l| 20.0 + 100.0 * l);
    let display = Frame::from_pixels("display", shown, Domain::Display).expect("finite");
    // A bright specimen before a dark ground may pass for a collimated field.
    let (mut cases, unmasked) = (0, Masks::default());
    for (frame, tone) in
        [(&inverted, Tone::None), (&inverted, Tone::LogAffine), (&display, Tone::None), (&display, Tone::Monotone)]
    {
        let found = compared(&CompareInput {
            tone,
            air: AirLevel::Unknown,
            masks: Some(&unmasked),
            ..CompareInput::new(frame, &simulated)
        });
        let said = &found.disagreements[..];
        assert!(matches!(said, [Disagreement::InvertedContrast { rank_ncc }] if *rank_ncc < -0.9), "{tone:?}: {said:?}");
        assert!(found.flags.iter().any(|flag| flag.contains("looks inverted")), "{:?}", found.flags);
        let json = serde_json::to_value(&found).expect("json");
        assert_eq!(json["disagreements"][0]["kind"], "inverted_contrast");
        cases += 1;
    }
    assert_eq!(cases, 4);
    let found = compared(&CompareInput::new(&right, &simulated));
    assert!(found.disagreements.is_empty(), "control: {:?}", found.disagreements);
}

/// So did values that were 10 nepers apart, and a frame of something else.
#[test]
fn values_nepers_apart_and_unrelated_images_are_said_and_scatter_is_not() {
    let simulated = line_integral(&view());
    let (right, unmasked) = (acquired(&simulated, 0.0), Masks::default());
    let darker = |nepers: f32| {
        let frame = Frame { pixels: right.pixels.map(|v| v * (-nepers).exp()), ..right.clone() };
        compared(&CompareInput { masks: Some(&unmasked), ..CompareInput::new(&frame, &simulated) }).disagreements
    };
    let far = darker(10.0);
    let [Disagreement::FarApart { rmse_nepers, bias_nepers }] = far[..] else { panic!("{far:?}") };
    assert!((rmse_nepers - 10.0).abs() < 1e-3 && bias_nepers > 9.9, "{far:?}");
    assert!(darker(-1.2).is_empty(), "scatter of twice the primary");
    let column = |at: usize| 0.2 + 0.6 * ((at % 310) as f32 * 0.9).sin().abs();
    let columns = Image { width: 310, height: 240, pixels: (0..310 * 240).map(column).collect() };
    let other = Frame { pixels: columns, ..right.clone() };
    let found = compared(&CompareInput { masks: Some(&unmasked), ..CompareInput::new(&other, &simulated) });
    assert!(matches!(found.disagreements[..], [Disagreement::Unrelated { .. }]), "{:?}", found.disagreements);
    assert!(found.flags.iter().any(|flag| flag.contains("hardly correlate")), "{:?}", found.flags);
    // A pair of which the beads are sure is not plainly accepted then.
    let mut pair = Pair::unmatched("a", "");
    (pair.status, pair.pose_source) = (PairStatus::Accepted, PoseSource::Beads);
    pair.judge_image();
    assert_eq!(pair.status, PairStatus::Accepted, "the control");
    pair.set_comparison(&found);
    pair.judge_image();
    assert_eq!(pair.status, PairStatus::AcceptedImageDisagrees);
    assert!(pair.reason.is_some_and(|reason| reason.contains("hardly correlate")));
}

/// An eighth of the frame was open air that read twice the level that was stated, and nothing was said.
#[test]
fn an_air_level_that_much_of_the_frame_exceeds_is_said() {
    let simulated = line_integral(&view());
    let unmasked = Masks::default();
    let right = acquired(&simulated, 0.05);
    let stored = Frame { pixels: right.pixels.map(|v| 10_000.0 * v), unit: None, ..right };
    let told = |level: f64| {
        compared(&CompareInput {
            air: AirLevel::Value(level),
            offset: OffsetRule::None,
            masks: Some(&unmasked),
            ..CompareInput::new(&stored, &simulated)
        })
    };
    for level in [10_000.0, 9000.0, 20_000.0] {
        let found = told(level).disagreements;
        assert!(found.is_empty(), "heel, gain and scatter may do as much: {level}: {found:?}");
    }
    let found = told(5000.0);
    let [Disagreement::AboveAir { declared, share, times }] = found.disagreements[..] else { panic!("{found:?}") };
    assert!(declared == 5000.0 && share > 0.05 && times > 1.5 && times < 2.1, "{found:?}");
    assert!(found.flags.iter().any(|flag| flag.contains("air level 5000 is not this frame's")), "{:?}", found.flags);
    // The level that the frame itself shows is contradicted by nothing.
    let open =
        compared(&CompareInput { offset: OffsetRule::None, masks: Some(&unmasked), ..CompareInput::new(&stored, &simulated) });
    assert!(open.disagreements.is_empty(), "{:?}", open.disagreements);
}

/// Fourteen bits of data in sixteen bits stored, larger meaning fewer X-rays: turned round about 65535, its dark level lay at 49152, and
/// logarithms of that were given out as nepers.
#[test]
fn a_linear_frame_that_was_turned_round_has_no_nepers_until_its_dark_level_is_known() {
    let simulated = line_integral(&view());
    let stored = acquired(&simulated, 0.0).pixels.map(|transmitted| 16_383.0 - 9000.0 * transmitted);
    let mut frame = Frame::from_pixels("turned", stored.map(|v| 65_535.0 - v), Domain::Linear).expect("finite");
    (frame.inverted, frame.turned_about) = (true, Some(65_535.0));
    let input = CompareInput::new(&frame, &simulated);
    let guessed = compared(&input);
    assert_eq!(guessed.common_domain, CommonDomain::RelativeLineIntegral);
    assert!(guessed.scores.rmse_nepers.is_none() && guessed.air.level.is_none());
    assert!(guessed.scores.reasons["rmse_nepers"].contains("--offset"), "{:?}", guessed.scores.reasons);
    // The stored values of no X-rays and of air, as a person reads them in the file.
    for air in [AirLevel::Open, AirLevel::Value(7383.0)] {
        let told = compared(&CompareInput { offset: OffsetRule::Value(16_383.0), air, ..input });
        assert!((told.air.level.expect("known") - 9000.0).abs() < 9.0, "{:?}", told.air);
        assert!(told.scores.rmse_nepers.expect("absolute") < 0.01, "{:?}", told.scores);
    }
    let believed = compared(&CompareInput { offset: OffsetRule::None, ..input });
    assert!(believed.scores.rmse_nepers.expect("declared to start at the end of the scale") > 0.1, "control");
    // Without the turn the same values are ordinary.
    let plain = Frame { inverted: false, turned_about: None, ..frame.clone() };
    assert!(compared(&CompareInput::new(&plain, &simulated)).air.level.is_some(), "control");
}

/// A robot drawn 20 to 300 mm beside its place was accepted without a word: its tip was sought near by only.
#[test]
fn a_robot_that_is_not_where_it_is_drawn_is_said() {
    let with = |drawn: f64, zncc: Option<f64>| {
        let mut pair = Pair::unmatched("a", "");
        let masks = MaskShares { causes: [(Cause::Tool, drawn)].into(), ..MaskShares::default() };
        (pair.masks, pair.scores_tool) = (Some(masks), Some(Scores { zncc, ..Scores::default() }));
        pair.robot_unseen()
    };
    assert!(Pair::unmatched("a", "").robot_unseen().is_none(), "nothing was compared");
    assert!(with(0.014, Some(0.98)).is_none() && with(0.014, None).is_none());
    assert!(with(0.014, Some(-0.22)).is_some_and(|(_, words)| words.contains("does not show the robot")));
    assert!(with(0.0, None).is_some_and(|(kind, _)| kind.contains("outside")));
}
