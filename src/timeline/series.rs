//! Whether the console's stamps name series of exposures instead of single ones.
//!
//! Then one frame after the other comes promptly, each after another exposure, all with the stamp of the first. A second picture of an
//! exposure has its stamp as well, but hardly ever comes right after the next exposure and before that one's own picture.

/// Beyond what the stamp resolves, exposures of one stamp are not farther apart than this.
const APART_US: i64 = 1_000_000;
/// Steps to another exposure with the same stamp that show it, and their least share among all steps: one in so many.
const NEEDED: u32 = 2;
const SHARE: u32 = 4;

/// Steps from one prompt frame to the next.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct SeriesStamps {
    /// Stamp of the latest frame and the end of the last exposure before it.
    latest: Option<(i64, i64)>,
    steps: u32,
    same: u32,
    found: bool,
}

impl SeriesStamps {
    /// The next frame with a stamp came promptly; the last exposure before it ended at `end_us`.
    pub(super) fn meet(&mut self, console_us: i64, resolution_us: i64, end_us: i64) {
        if let Some((before_us, last_us)) = self.latest.replace((console_us, end_us))
            && end_us.saturating_sub(last_us) > resolution_us.saturating_add(APART_US)
        {
            self.steps += 1;
            self.same += u32::from(before_us == console_us);
            self.found |= self.same >= NEEDED && self.same.saturating_mul(SHARE) >= self.steps;
        }
    }

    /// Stamps tell nothing of single exposures.
    pub(super) fn found(self) -> bool {
        self.found
    }
}
