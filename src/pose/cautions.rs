//! What a person should look at before an accepted pose is used, and which of it means that the pose may be another one altogether,
//! or is no measure of what was asked for.

/// What is said of a pose that is uncertain at a landmark, or off its beads' plane.
pub(super) const LOOSELY: &str = "the beads hold the pose loosely";

/// Whether a caution or a doubt is that one: it falls where telemetry or other views hold the pose as well.
pub(super) fn is_of_looseness(words: &str) -> bool {
    words.contains(LOOSELY)
}

/// What is said of a picture that an image intensifier may have bent.
pub(super) const ROUND_FIELD: &str = "the frame's field is round";

/// Whether a caution or a doubt is that one: with telemetry fused, or other views, it is told anew.
pub(super) fn is_of_round_field(words: &str) -> bool {
    words.contains(ROUND_FIELD)
}

/// What is said of K that the header alone says.
pub(super) const HEADER_K: &str = "nobody has measured K, which is the header's";

/// Whether a caution, a doubt or a note is that one: it, too, is told anew.
pub(super) fn is_of_header_k(words: &str) -> bool {
    words.contains(HEADER_K)
}

/// χ² per degree of freedom from which residuals are said to be larger than expected.
const LARGER_CHI2_PER_DOF: f64 = 1.5;
/// What is said of them, behind how many times.
const LARGER: &str = "times what was expected; all uncertainties are scaled up by that";

/// What is said of residuals that noise and bead places do not explain; `None` where they do.
pub(super) fn larger_residuals(chi2_per_dof: f64) -> Option<String> {
    (!(chi2_per_dof <= LARGER_CHI2_PER_DOF)).then(|| format!("residuals are {:.1} {LARGER}", chi2_per_dof.sqrt()))
}

/// Whether a note is of one solution's residuals: another solution has others.
pub(super) fn is_of_residuals(words: &str) -> bool {
    words.contains(LARGER)
}

/// Gathered while a match is judged.
#[derive(Clone, Debug, Default, PartialEq)]
pub(super) struct Cautions {
    /// All of them, a sentence each.
    pub(super) words: Vec<String>,
    /// The first that leaves open whether the pose is this one: another reading, another scale, a mirror image; or how it lies at a landmark.
    pub(super) doubt: Option<String>,
    /// How many of them do.
    pub(super) doubts: usize,
    /// One of these: the pose is far from the prior.
    pub(super) is_far_from_prior: bool,
    /// Beads that are not seen although their places are clear.
    pub(super) missing: usize,
}

impl Cautions {
    /// Something that makes a good pose less certain, or that a person should know.
    pub(super) fn say(&mut self, words: impl Into<String>) {
        self.words.push(words.into());
    }

    /// Something that leaves open whether the pose is this one.
    pub(super) fn doubt(&mut self, words: impl Into<String>) {
        let words = words.into();
        self.doubt.get_or_insert_with(|| words.clone());
        self.doubts += 1;
        self.words.push(words);
    }
}
