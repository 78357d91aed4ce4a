//! Why there is no pose: what was expected, and what was found.

use serde::{Deserialize, Serialize};

/// Which points a degenerate layout is made of.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Points {
    /// All beads of the layout.
    Layout,
    /// Those that were matched.
    Matched,
}

impl std::fmt::Display for Points {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str(match self {
            Self::Layout => "of the layout",
            Self::Matched => "that were matched",
        })
    }
}

/// Of pixels whose height is `taller` times that of K.
pub(super) fn taller_words(taller: f64) -> &'static str {
    if taller > 1.0 { "taller" } else { "wider" }
}

/// A pose that fits as well as the one that was found.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Rival {
    /// The same or other shadows, named otherwise.
    OtherNames,
    /// The beads' plane mirrored about the line of sight.
    Flat,
    /// Shadows that the first reading leaves over.
    SecondSet,
}

/// One of K's numbers.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum IntrinsicsNumber {
    /// In px: the distance from source to detector over the pitch.
    FocalLength,
    /// Column of the principal point.
    PrincipalColumn,
    /// Row of the principal point.
    PrincipalRow,
}

impl std::fmt::Display for IntrinsicsNumber {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str(match self {
            Self::FocalLength => "focal length",
            Self::PrincipalColumn => "principal point's column",
            Self::PrincipalRow => "principal point's row",
        })
    }
}

/// A refusal. In a pose's file it is an object with the key `code`.
#[derive(Clone, Debug, PartialEq, thiserror::Error, Serialize, Deserialize)]
#[serde(tag = "code", rename_all = "snake_case")]
pub enum Refusal {
    /// The session has no layout, or its checks refused it.
    #[error("{detail}")]
    Layout { detail: String },
    /// Registering failed: a fault of this program.
    #[error("{detail}")]
    Fault { detail: String },
    /// Too few places in the layout, or among the matched.
    #[error("too_few_beads: {points_words} {found} distinct beads, {required} are needed {why}", points_words = has(*points), why = why_so_many(*intrinsics_known))]
    TooFewBeads { points: Points, found: usize, required: usize, intrinsics_known: bool },
    /// On a line.
    #[error(
        "collinear: beads {points} lie on a line (extents {first_mm:.1}, {second_mm:.2} mm): rotation about it is not determined"
    )]
    Collinear { points: Points, first_mm: f64, second_mm: f64 },
    /// In a plane, with K unknown.
    #[error(
        "coplanar: beads {points} lie in a plane (extents {first_mm:.1}, {second_mm:.1}, {third_mm:.2} mm): without intrinsics the focal length is not determined; give --intrinsics (intrinsics in a session)"
    )]
    Coplanar { points: Points, first_mm: f64, second_mm: f64, third_mm: f64 },
    /// The prior's covariance is none, or there is no prior to fuse.
    #[error("prior: {detail}")]
    Prior { detail: String },
    /// The prior looks the other way.
    #[error(
        "behind_source: the prior puts the bead centroid at depth {depth_mm:.1} mm, behind the source; check its direction (camera_from_lps) and units"
    )]
    BehindSource { depth_mm: f64 },
    /// Correspondences that cannot be kept.
    #[error("correspondences: {detail}")]
    Correspondences { detail: String },
    /// What a hand said of a bead, and what the others say.
    #[error(
        "by_hand: {bead}, which a hand put or named at ({:.1}, {:.1}) px, {}; undo that edit, or correct it", image_px[0], image_px[1], against_others(*off_px)
    )]
    ByHand {
        bead: String,
        /// Of the frame.
        image_px: [f64; 2],
        /// From where the pose of the others has it; absent where that is nowhere.
        off_px: Option<f64>,
    },
    /// The picture is not straight.
    #[error(
        "distorted: the beads agree to {bent_px:.2} px instead of {given_px:.2} px if the picture is distorted by {shift_px:.1} px at the outermost of them; calibrate the intensifier or lens (calibrate intensifier) and give --distortion"
    )]
    Distorted { given_px: f64, bent_px: f64, shift_px: f64 },
    /// Pixels that are not those of K.
    #[error(
        "pixels: the beads agree to {bent_px:.2} px instead of {given_px:.2} px if pixels are {:.1} % {} than K says; was the picture stretched on its way (a video grabber, an export)? undo that, or give K with fx and fy of this picture", 100.0 * (taller - 1.0).abs(), taller_words(*taller)
    )]
    Pixels {
        given_px: f64,
        bent_px: f64,
        /// Height of a pixel over its width, by K's.
        taller: f64,
    },
    /// What the image intensifier did to the frame is not known.
    #[error("distortion: {detail}")]
    Distortion { detail: String },
    /// K is stated for pictures of another size.
    #[error("other_size: {detail}")]
    OtherSize { detail: String },
    /// Hardly anything in the frame.
    #[error(
        "too_few_shadows: {found} bead-like shadows in the frame, {required} are needed; {remedy}", remedy = more_shadows(prior_puts_into_frame.as_ref(), hidden_by)
    )]
    TooFewShadows {
        found: usize,
        required: usize,
        /// How many beads the prior puts into the frame, and how many there are; absent without a prior or K.
        #[serde(default, skip_serializing_if = "Option::is_none")]
        prior_puts_into_frame: Option<[usize; 2]>,
        /// What in the picture may hide them, and what to do about it, in words.
        #[serde(default, skip_serializing_if = "Vec::is_empty")]
        hidden_by: Vec<String>,
    },
    /// Nothing matches.
    #[error("no_match: {shadows} bead-like shadows, but no pose puts four of the {beads} beads on them")]
    NoMatch { shadows: usize, beads: usize },
    /// No linear value is one of X-rays.
    #[error(
        "no_signal: of linear values, which are above zero where X-rays arrived, the highest in the open field is {highest}; give --domain log if these \
         are logarithms, or export the frame without its offset taken off"
    )]
    NoSignal { highest: f64 },
    /// The only match is where the prior says it cannot be.
    #[error(
        "prior_contradicted: the only match, {matched} beads to {rms_px:.2} px, is {angle_deg:.1}° and {shift_mm:.1} mm away from the prior, more than that allows; check prior, K, and the layout's scale, or leave the prior out (--ignore-prior)"
    )]
    PriorContradicted { matched: usize, rms_px: f64, angle_deg: f64, shift_mm: f64 },
    /// Singular equations.
    #[error("unsolved: the equations of the matched beads are singular")]
    Unsolved,
    /// As good as an accident.
    #[error(
        "chance: {matched} of {in_view} beads agree to {rms_px:.2} px, but {expected:.2e} such matches are expected by accident among {shadows} shadows (limit {limit}); bring more beads into view{remedy}", remedy = or_prior(*prior_given)
    )]
    Chance { matched: usize, in_view: usize, rms_px: f64, expected: f64, shadows: usize, limit: f64, prior_given: bool },
    /// The residuals are too large.
    #[error(
        "residual: {matched} beads agree only to {rms_px:.2} px, {times:.1} times what noise and bead positions allow (limit {limit:.0}); the layout may have moved, or K is wrong"
    )]
    Residual { matched: usize, rms_px: f64, times: f64, limit: f64 },
    /// The residuals are large, and shadows lie beside the places of their beads.
    #[error(
        "residual: {matched} beads agree only to {rms_px:.2} px, {times:.1} times what noise and bead positions allow, and the shadows of {names} lie beside their places; the layout may have moved or be stretched, its sigma_mm be too small, or K or the picture's geometry be wrong", names = displaced.join(", ")
    )]
    Displaced { matched: usize, rms_px: f64, times: f64, displaced: Vec<String> },
    /// The shadows have another size than the beads at their depth.
    #[error(
        "radii: the shadows are {percent:.0} % {way} than the beads' radii give at the depth of this pose; check the layout's scale and radius_mm{slip}", percent = 100.0 * (ratio - 1.0).abs(), way = if *ratio < 1.0 { "smaller" } else { "larger" }, slip = slip_of_radius(*ratio)
    )]
    Radii { ratio: f64 },
    /// The beads match the other way round: metal is not where the frame's domain says that it is.
    #[error(
        "sense: {matched} beads match shadows that are {found}, and in {domain} values metal is {expected}: the frame was inverted, or its values are others (--domain)", found = sense(!*dark), expected = sense(*dark)
    )]
    Sense { matched: usize, domain: String, dark: bool },
    /// The layout with x and y negated is where the prior says.
    #[error(
        "axes: the only match, {matched} beads, is turned by half a turn about the patient's long axis from the prior, and with x and y of the layout negated it agrees with it: the layout's file says LPS and holds RAS, or the reverse"
    )]
    Axes { matched: usize },
    /// Another pose fits as well.
    #[error("ambiguous: {}", ambiguous(*rival, *angle_deg, *shift_mm, (*matched, *fit), (*other_matched, *other_fit), *prior_given))]
    Ambiguous {
        rival: Rival,
        angle_deg: f64,
        shift_mm: f64,
        matched: usize,
        /// Rms in px; χ² for flat layouts.
        fit: f64,
        other_matched: usize,
        /// As `fit`.
        other_fit: f64,
        prior_given: bool,
    },
    /// Beads that should be seen are not, and shadows belong to none.
    #[error(
        "missing: {matched} beads match, but {count} that the pose puts into the open field are not there ({names}) and {unexplained} clear shadows belong to no bead; check the layout, the prior, and whether the frame is mirrored", count = missing.len(), names = missing.join(", ")
    )]
    Missing { matched: usize, missing: Vec<String>, unexplained: usize },
    /// Another K fits far better.
    #[error(
        "intrinsics: the beads fit to {given_px:.2} px with K as given, to {freed_px:.2} px with a focal length {percent:.0} % {way} and the principal point {shift_px:.0} px away; check K, SID, pitch, and whether the frame is binned or cropped",
        percent = 100.0 * (focal_ratio - 1.0).abs(), way = if *focal_ratio < 1.0 { "shorter" } else { "longer" }
    )]
    Intrinsics { given_px: f64, freed_px: f64, focal_ratio: f64, shift_px: f64 },
    /// The beads contradict what is stated of K with its standard deviations.
    #[error(
        "intrinsics_contradicted: the beads put the {number} {off_px:+.1} px from where it is stated to be within {sigma_px:.1} px, {times:.1} standard deviations of what they can tell (limit {limit:.0}); check K, SID, pitch, their sigma, and whether the frame is binned or cropped"
    )]
    IntrinsicsContradicted { number: IntrinsicsNumber, off_px: f64, sigma_px: f64, times: f64, limit: f64 },
    /// The mirror image fits better.
    #[error(
        "mirrored: {mirrored} beads fit the frame's mirror image to {rms_px:.2} px, {matched} the frame itself; un-mirror it at the console, state the console's geometry in the session, or correct the layout if its axes are negated"
    )]
    Mirrored { mirrored: usize, rms_px: f64, matched: usize },
    /// A plate from its other side.
    #[error(
        "seen_from_behind: the beads lie in a plane, and {matched} of them match, {angle_deg:.1}° and {shift_mm:.1} mm from the prior, only as seen from the other side than it says; a mirrored picture and a layout with a negated axis look just so: check console, layout and prior, or leave the prior out (--ignore-prior)"
    )]
    SeenFromBehind { matched: usize, angle_deg: f64, shift_mm: f64 },
    /// No way of turning and mirroring the picture gives a pose.
    #[error(
        "console: the picture gives no pose however it is turned, neither as it is stored ({as_stored}) nor mirrored ({mirrored}); state what the console did"
    )]
    NoOrientation { as_stored: String, mirrored: String },
    /// The picture and its mirror image both give one.
    #[error(
        "ambiguous: the layout fits the picture as it is stored ({matched} beads, {rms_px:.2} px) and mirrored ({other_matched} beads, {other_px:.2} px); state what the console did"
    )]
    EitherOrientation { matched: usize, rms_px: f64, other_matched: usize, other_px: f64 },
    /// A body has moved, and the request takes all as one.
    #[error(
        "bodies: {body} has moved against {reference} since the scan, by {angle_deg:.2}° and {shift_mm:.2} mm, and both are to be one rigid specimen; leave --one-body out, or register on the beads of one body"
    )]
    Bodies { body: String, reference: String, angle_deg: f64, shift_mm: f64 },
    /// A body's beads do not fit the others, and are too few for a pose of their own.
    #[error(
        "bodies: {left_out} of {seen} beads of {body} do not fit the pose of the others: it has moved since the scan, and {seen} beads are too few to say where to; register on the beads of one body"
    )]
    BodySplit { body: String, left_out: usize, seen: usize },
    /// K is solved, and the focal length is not determined.
    #[error(
        "focal_degenerate: the focal length is {focal_px:.0} ± {sigma_px:.0} px: beads of so little depth do not determine it; give --intrinsics (intrinsics in a session)"
    )]
    FocalDegenerate { focal_px: f64, sigma_px: f64 },
    /// The pose is too uncertain to be of use.
    #[error(
        "uncertain: standard deviation at the beads is {turn_deg:.2}°, {across_mm:.2} mm across and {along_mm:.1} mm along the beam (limits {:.0}°, {:.0} mm, {:.0} mm)", limits[0], limits[1], limits[2]
    )]
    Uncertain { turn_deg: f64, across_mm: f64, along_mm: f64, limits: [f64; 3] },
    /// Tags give a pose only to a known camera.
    #[error("tags_without_intrinsics: tags give a pose only where K is known; give --intrinsics (intrinsics in a session)")]
    TagsWithoutIntrinsics,
    /// None of the listed tags is seen.
    #[error("no_tags: none of the {listed} listed tags reads in the frame{}", others_seen(others))]
    NoTags { listed: usize, others: Vec<u32> },
    /// Tags read only in the mirror image.
    #[error(
        "mirrored: tags {tags:?} read only in the frame's mirror image: the frame is mirrored (un-mirror it at the console), or they are seen from behind, which beads would tell"
    )]
    MirroredTags { tags: Vec<u32> },
    /// Too few tags agree.
    #[error(
        "tags_disagree: {agreeing} of the tags {tags:?} agree on a pose; check their ids, size_mm and lps_from_tag, and K; one tag alone must read without a corrected bit"
    )]
    TagsDisagree { tags: Vec<u32>, agreeing: usize },
    /// Corners that are no square's.
    #[error(
        "tag_corners: the corners of tags {tags:?} fit {times:.1} times worse than they are measured (limit {limit:.0}); check size_mm, lps_from_tag and K"
    )]
    TagCorners { tags: Vec<u32>, times: f64, limit: f64 },
    /// The two poses of a plane.
    #[error(
        "ambiguous: the corners of tags {tags:?} lie in a plane, and the pose tilted the other way, {angle_deg:.1}° and {shift_mm:.1} mm away, fits nearly as well (χ² {worse:.1} more, {limit:.0} are needed); bring beads or a tag in another plane into view"
    )]
    FlatTags { tags: Vec<u32>, angle_deg: f64, shift_mm: f64, worse: f64, limit: f64 },
    /// Tags against the prior.
    #[error(
        "prior_contradicted: the pose of tags {tags:?} is {angle_deg:.1}° and {shift_mm:.1} mm away from the prior, more than it allows; check both, or leave the prior out (--ignore-prior)"
    )]
    PriorAgainstTags { tags: Vec<u32>, angle_deg: f64, shift_mm: f64 },
    /// Tags against beads.
    #[error(
        "tags_contradicted: {beads} beads agree on a pose that puts the corners of tags {tags:?} up to {off_px:.1} px off, and the tags agree on one {angle_deg:.1}° and {shift_mm:.1} mm away; have the tags moved against the beads, or is lps_from_tag or size_mm wrong?"
    )]
    TagsContradicted { tags: Vec<u32>, off_px: f64, beads: usize, angle_deg: f64, shift_mm: f64 },
}

fn others_seen(others: &[u32]) -> String {
    if others.is_empty() { String::new() } else { format!("; others do: {others:?}") }
}

fn against_others(off_px: Option<f64>) -> String {
    match off_px {
        Some(off_px) => format!("is {off_px:.1} px from where the other beads have it"),
        None => "has no place in the pose of the other beads".to_owned(),
    }
}

/// What may bring more shadows into the picture.
fn more_shadows(prior_puts_into_frame: Option<&[usize; 2]>, hidden_by: &[String]) -> String {
    let aim = prior_puts_into_frame.filter(|[inside, all]| inside * 2 < *all).map(|[inside, all]| {
        format!(
            "by the prior (or telemetry) only {inside} of the {all} beads lie in the frame: aim at the beads, or check where the prior, or world_from_lps, puts them"
        )
    });
    let words: Vec<&str> = aim.iter().chain(hidden_by).map(String::as_str).collect();
    if words.is_empty() { "open the collimator, raise the dose, or check --bead-radius".to_owned() } else { words.join("; ") }
}

/// What was probably stated where shadows are so many times as large as the radii give.
fn slip_of_radius(ratio: f64) -> &'static str {
    let is = |factor: f64| (0.8..=1.25).contains(&(ratio / factor));
    if is(0.5) {
        " (a diameter, where the radius is asked for?)"
    } else if is(10.0) {
        " (centimetres, or a decimal point in the wrong place?)"
    } else if is(0.1) {
        " (a decimal point in the wrong place?)"
    } else {
        ""
    }
}

fn sense(dark: bool) -> &'static str {
    if dark { "dark" } else { "bright" }
}

fn has(points: Points) -> &'static str {
    match points {
        Points::Layout => "the layout has",
        Points::Matched => "there are",
    }
}

fn why_so_many(intrinsics_known: bool) -> &'static str {
    if intrinsics_known { "with known intrinsics (three leave several poses)" } else { "when the intrinsics are not known" }
}

fn or_prior(given: bool) -> &'static str {
    if given { "" } else { " or give --prior" }
}

fn ambiguous(
    rival: Rival,
    angle_deg: f64,
    shift_mm: f64,
    (matched, fit): (usize, f64),
    (other, other_fit): (usize, f64),
    prior_given: bool,
) -> String {
    let remedy = if prior_given { "a prior with a smaller covariance tells them apart" } else { "give --prior" };
    match rival {
        Rival::OtherNames => format!(
            "another pose, {angle_deg:.1}° and {shift_mm:.1} mm away, puts {other} beads within {other_fit:.2} px where this one puts {matched} within {fit:.2} px; {remedy}, or break the layout's symmetry"
        ),
        Rival::Flat => format!(
            "the beads are nearly flat, and the mirrored pose, {angle_deg:.1}° and {shift_mm:.1} mm away, fits as well (χ² {other_fit:.1} against {fit:.1}); {remedy}"
        ),
        Rival::SecondSet => format!(
            "{other} other shadows fit the layout as well, to {other_fit:.2} px, with the pose {angle_deg:.1}° and {shift_mm:.1} mm away; a second set of beads, or a prior that is off?"
        ),
    }
}

impl Refusal {
    /// In words, where there is a prior that beads are not sought by: nobody is told to give one, nor a better one.
    pub(super) fn words_beside_prior(&self) -> String {
        let mut told = self.clone();
        if let Self::Chance { prior_given, .. } = &mut told {
            *prior_given = true;
        }
        let words = told.to_string();
        match told {
            // What is advised is all about priors and the layout's symmetry, and stands behind.
            Self::Ambiguous { .. } => words.split_once("; ").map_or(words.as_str(), |(what, _)| what).to_owned(),
            _ => words,
        }
    }

    /// Its kind in one word, as in a pose's file.
    #[must_use]
    pub fn code(&self) -> String {
        let value = serde_json::to_value(self).unwrap_or_default();
        value["code"].as_str().unwrap_or_default().to_owned()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Whoever had given a prior was told to give one.
    #[test]
    fn a_prior_is_not_advised_beside_one() {
        let (matched, rms_px, prior_given) = (4, 0.8, false);
        let chance = Refusal::Chance { matched, in_view: 8, rms_px, expected: 1.8, shadows: 6, limit: 0.01, prior_given };
        let (angle_deg, shift_mm, fit, other_matched, other_fit) = (9.0, 12.0, 0.5, 4, 0.6);
        for rival in [Rival::OtherNames, Rival::Flat, Rival::SecondSet] {
            let ambiguous =
                Refusal::Ambiguous { rival, angle_deg, shift_mm, matched, fit, other_matched, other_fit, prior_given };
            let (plain, beside) = (ambiguous.to_string(), ambiguous.words_beside_prior());
            assert!(plain.contains("prior") && !beside.contains("prior"), "{beside}");
            assert!(plain.starts_with(&beside) && beside.contains("12.0 mm"), "{beside}");
        }
        assert!(chance.to_string().contains("or give --prior"), "the control");
        assert!(chance.words_beside_prior().ends_with("bring more beads into view"), "{}", chance.words_beside_prior());
        let few = Refusal::NoMatch { shadows: 9, beads: 9 };
        assert_eq!(few.words_beside_prior(), few.to_string());
    }
}
