//! How the window says things: numbers, counts, and the reasons of refusals, which scripts and the command line have in other words.

use crate::pose::Refusal;
use crate::session::board::PairView;

/// A value with so many decimals: its minus is one, and there is none before zero.
pub(super) fn fixed(value: f64, decimals: usize) -> String {
    let words = format!("{value:.decimals$}");
    match words.strip_prefix('-') {
        Some(size) if size.chars().all(|c| matches!(c, '0' | '.')) => size.to_owned(),
        Some(size) => format!("−{size}"),
        None => words,
    }
}

/// The same with a plus before what is above zero.
pub(super) fn signed(value: f64, decimals: usize) -> String {
    let words = fixed(value, decimals);
    if words.starts_with('−') || words.chars().all(|c| matches!(c, '0' | '.')) { words } else { format!("+{words}") }
}

/// `1 frame`, `2 frames`.
pub(super) fn count(n: usize, what: &str) -> String {
    format!("{n} {what}{}", if n == 1 { "" } else { "s" })
}

/// Why a pose is refused or doubted. Of a refusal's sentence neither the code, by which scripts go, nor, where what to do is said beside it,
/// what follows the semicolon: that is said again, and for a command line.
pub(super) fn reason(view: &PairView) -> &str {
    let whole = view.pair.reason.as_deref().unwrap_or_default();
    match &view.pose.refusal {
        // These have no code.
        None | Some(Refusal::Layout { .. } | Refusal::Fault { .. }) => return whole,
        Some(_) => {}
    }
    let is_code = |word: &str| word.chars().all(|c| c.is_ascii_lowercase() || c == '_');
    let Some((_, sentence)) = whole.split_once(": ").filter(|(word, _)| is_code(word)) else { return whole };
    if view.remedy.is_some() { before_semicolon(sentence) } else { sentence }
}

/// Up to the first semicolon outside parentheses.
fn before_semicolon(sentence: &str) -> &str {
    let mut open = 0;
    for (at, c) in sentence.char_indices() {
        match c {
            '(' => open += 1,
            ')' => open -= 1,
            ';' if open == 0 => return &sentence[..at],
            _ => {}
        }
    }
    sentence
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn zero_has_no_sign_and_one_is_no_plural() {
        assert_eq!([fixed(-0.04, 1), fixed(-0.05001, 1), fixed(0.04, 1), fixed(-1020.0, 0)], ["0.0", "−0.1", "0.0", "−1020"]);
        assert_eq!([signed(-0.04, 1), signed(0.26, 1), signed(-3.0, 1)], ["0.0", "+0.3", "−3.0"]);
        assert_eq!([count(0, "frame"), count(1, "frame"), count(2, "frame")], ["0 frames", "1 frame", "2 frames"]);
    }

    #[test]
    fn what_is_to_be_done_is_cut_off_outside_parentheses_only() {
        assert_eq!(
            before_semicolon("3 shadows, 4 are needed; open the collimator, or check --bead-radius"),
            "3 shadows, 4 are needed"
        );
        assert_eq!(
            before_semicolon("no pose as stored (two; three) nor mirrored (x); state it"),
            "no pose as stored (two; three) nor mirrored (x)"
        );
        assert_eq!(before_semicolon("nothing to do"), "nothing to do");
    }
}
