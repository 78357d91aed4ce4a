//! Logs: MCAP out and in.
