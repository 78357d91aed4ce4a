//! What speaks against taking a shadow's centre for as good as its noise.

use serde::Serialize;

/// Warnings of one detection; its standard deviation holds with them.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize)]
pub struct Flags {
    /// The core lies at the end of the frame's grey values, so that its depth is not known.
    pub clipped: bool,
    /// Another shadow reaches into it.
    pub overlapping: bool,
    /// Part of it lies behind a mask or outside the frame.
    pub at_mask: bool,
    /// Something that is no smooth background lies under or beside it (a bone's rim, a wire, a tool) and may move the centre by more
    /// than a few thousandths of the radius.
    pub over_structure: bool,
}

impl Flags {
    /// Whether any is raised.
    #[must_use]
    pub fn any(self) -> bool {
        self.clipped || self.overlapping || self.at_mask || self.over_structure
    }
}
