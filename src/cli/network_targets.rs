//! How good a scatter network is by its card, beside what it ought to be.

use std::collections::BTreeMap;
use std::fmt::Write as _;

/// A figure of a card, of images that the network was not trained on, and what it ought to be.
struct Target {
    /// Its key. That of one specimen has ` of SPECIMEN` behind it.
    key: &'static str,
    /// What it is, for people.
    what: &'static str,
    /// What it may be at most, whatever its sign.
    most: f64,
    /// Whether its sign says something.
    is_signed: bool,
}

const TARGETS: [Target; 3] = [
    Target { key: "nmse", what: "normalised squared error", most: 0.03, is_signed: false },
    Target { key: "mean_rms", what: "error of an image's mean scatter", most: 0.05, is_signed: false },
    // None is asked for; of less than a per cent nobody can tell.
    Target { key: "edge_bias", what: "bias where tools and dense bone end", most: 0.01, is_signed: true },
];

impl Target {
    /// Per cent.
    fn shown(&self, value: f64) -> String {
        let percent = 100.0 * value;
        if self.is_signed { format!("{percent:+.1} %") } else { format!("{percent:.1} %") }
    }

    /// The figure over all specimens and whether it is as good as it ought to be, with every specimen of which it is not.
    fn words(&self, figures: &BTreeMap<String, f64>) -> String {
        let Self { key, what, most, .. } = self;
        // NaN misses.
        let is_met = |value: f64| value.abs() <= *most;
        let Some(value) = figures.get(*key).copied() else { return format!("{what} not in its card") };
        let met = if is_met(value) { "met" } else { "missed" };
        let mut words = format!("{what} {} (the target of {:.0} % is {met}", self.shown(value), 100.0 * most);
        for (name, value) in figures {
            let of = name.strip_prefix(key).and_then(|rest| rest.strip_prefix(" of "));
            if let Some(specimen) = of.filter(|_| !is_met(*value)) {
                let _ = write!(words, ", missed with {specimen}: {}", self.shown(*value));
            }
        }
        words + ")"
    }
}

/// How good a network is to whom it says scatter: `relative_error` of the scatter's root mean square, and the figures of its card.
pub(super) fn goodness(relative_error: f64, figures: Option<&BTreeMap<String, f64>>) -> String {
    let cells = format!("good to {:.0} % of the scatter's root mean square", 100.0 * relative_error);
    let none = BTreeMap::new();
    let figures = figures.unwrap_or(&none);
    let targets: Vec<String> = TARGETS.iter().map(|target| target.words(figures)).collect();
    format!("{cells}; of images that it was not trained on: {}", targets.join("; "))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn of(figures: &[(&str, f64)]) -> String {
        goodness(0.17, Some(&figures.iter().map(|(name, value)| ((*name).to_owned(), *value)).collect()))
    }

    /// Only the error of the cells and of the mean was told, and neither the squared error nor the edges, which miss their targets too.
    #[test]
    fn how_good_a_network_is_is_told_with_every_target() {
        let said = of(&[("nmse", 0.0287), ("mean_rms", 0.1265), ("edge_bias", -0.0116)]);
        for words in [
            "good to 17 % of the scatter's root mean square",
            "normalised squared error 2.9 % (the target of 3 % is met)",
            "error of an image's mean scatter 12.7 % (the target of 5 % is missed)",
            "bias where tools and dense bone end -1.2 % (the target of 1 % is missed)",
        ] {
            assert!(said.contains(words), "{words}: {said}");
        }
        let said = of(&[("nmse", 0.031), ("mean_rms", 0.04), ("edge_bias", 0.002)]);
        assert_eq!((said.matches("missed").count(), said.matches("met)").count()), (1, 2), "{said}");
        assert!(of(&[("nmse", f64::NAN)]).contains("is missed)"));
        // What nobody has measured is not taken to be good.
        assert!(of(&[]).matches("not in its card").count() == 3 && goodness(0.17, None) == of(&[]));
    }

    /// A mean over specimens may hide the one that a user's own is like.
    #[test]
    fn a_specimen_of_which_a_target_is_missed_is_named() {
        let said = of(&[("nmse", 0.0287), ("nmse of chest", 0.0259), ("nmse of pelvis", 0.0313), ("nmse_raw of chest", 0.2)]);
        assert!(said.contains("2.9 % (the target of 3 % is met, missed with pelvis: 3.1 %)"), "{said}");
        assert!(!said.contains("chest"), "{said}");
    }
}
