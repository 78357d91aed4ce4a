//! Exit codes of commands that end with a result.

/// A complete one.
pub const GOOD: u8 = 0;
/// One from which something is lost, or left out, which is said.
pub const LOSS: u8 = 3;
