//! The live pipeline and its replay.
