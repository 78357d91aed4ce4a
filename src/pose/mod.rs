//! The projection matrix from beads.
