//! Device clocks, samples in time, frames bound to exposures.
