//! What a renderer had to make before it could cast, and keeps for other views.

use std::ops::Sub;

/// How much of it was made.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Made {
    /// Volumes whose cells were told apart.
    pub volumes: usize,
    /// Copies of volumes along an axis, for slabs.
    pub copies: usize,
    /// Energies that were fitted, or tried to.
    pub fits: usize,
}

impl Sub for Made {
    type Output = Self;

    /// What was made after `earlier`. Copies that were given up since are none.
    fn sub(self, earlier: Self) -> Self {
        Self {
            volumes: self.volumes.saturating_sub(earlier.volumes),
            copies: self.copies.saturating_sub(earlier.copies),
            fits: self.fits.saturating_sub(earlier.fits),
        }
    }
}
