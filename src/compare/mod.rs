//! Acquired against simulated.
