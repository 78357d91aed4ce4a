//! How the commands on logs end, and how they count.

pub(super) use super::super::exit::{GOOD, LOSS};
use crate::reporter::Reporter;

/// Says what is lost from the log that was read; the exit code.
pub(super) fn say(losses: &[String], reporter: &Reporter) -> u8 {
    losses.iter().for_each(|loss| reporter.warn("loss", format!("lost from the log: {loss}")));
    if losses.is_empty() { GOOD } else { LOSS }
}

/// `1 frame`, `2 frames`.
pub(super) fn counted(count: usize, what: &str) -> String {
    if count == 1 { format!("1 {what}") } else { format!("{count} {what}s") }
}

/// Numbers in a row, for people.
pub(super) fn listed(numbers: &[u32]) -> String {
    const SHOWN: usize = 20;
    let shown = numbers.iter().take(SHOWN).map(u32::to_string).collect::<Vec<_>>().join(", ");
    if numbers.len() > SHOWN { format!("{shown}, … ({} in all)", numbers.len()) } else { shown }
}
