//! Bead layouts and bead detection.
