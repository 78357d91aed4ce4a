//! Acquired frames: files to pixels with a domain.
