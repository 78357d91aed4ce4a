//! Bytes from the devices to samples.
