//! The depth at which a pose tells its error in millimetres: that of the isocentre, where it is known.

use super::request::Registration;
use crate::acquire::FrameTags;

/// The specimen lies about the isocentre: on the table below it or at the panel's cover above it, which is this many times as far from the
/// source. Beads farther from it than that, and a distance that is told, are not of one exposure.
pub(super) const DEPTH_TIMES: f64 = 1.6;

/// From the source to the isocentre, mm, by a frame's header: its distance to the patient (0018,1111), which a C-arm's console states so.
/// `None` where there is none, or it is not before the detector.
#[must_use]
pub fn isocentre_of(tags: &FrameTags) -> Option<f64> {
    tags.sod_mm.filter(|sod_mm| *sod_mm > 0.0 && tags.sid_mm.is_none_or(|sid_mm| *sod_mm < sid_mm))
}

/// Whether two depths are apart by more than `times`.
pub(super) fn is_beyond(ratio: f64, times: f64) -> bool {
    !(1.0 / times..=times).contains(&ratio)
}

impl Registration<'_> {
    /// The isocentre's distance from the source, mm; `None` where it is not known, or where beads `depth_mm` from the source are not near it.
    pub(super) fn isocentre_beside(&self, depth_mm: f64) -> Option<f64> {
        self.source_to_isocentre_mm.filter(|told_mm| *told_mm > 0.0 && !is_beyond(depth_mm / told_mm, DEPTH_TIMES))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::beads::BeadLayout;

    #[test]
    fn the_isocentre_is_that_of_the_header_where_it_can_be_one() {
        let by = |sod_mm: Option<f64>, sid_mm: Option<f64>| isocentre_of(&FrameTags { sod_mm, sid_mm, ..FrameTags::default() });
        assert_eq!([by(Some(600.0), Some(1000.0)), by(Some(600.0), None)], [Some(600.0); 2]);
        for (sod_mm, sid_mm) in [(None, Some(1000.0)), (Some(1000.0), Some(1000.0)), (Some(0.0), None), (Some(f64::NAN), None)] {
            assert_eq!(by(sod_mm, sid_mm), None, "{sod_mm:?}, {sid_mm:?}");
        }
    }

    #[test]
    fn an_isocentre_far_from_the_beads_is_not_believed() {
        let layout = BeadLayout::none();
        let beside = |told_mm: Option<f64>, depth_mm: f64| {
            Registration { source_to_isocentre_mm: told_mm, ..Registration::new([64, 48], &layout) }.isocentre_beside(depth_mm)
        };
        assert_eq!([beside(Some(600.0), 600.0), beside(Some(600.0), 800.0)], [Some(600.0); 2]);
        for (told_mm, depth_mm) in [(None, 600.0), (Some(300.0), 600.0), (Some(1300.0), 600.0), (Some(f64::NAN), 600.0)] {
            assert_eq!(beside(told_mm, depth_mm), None, "{told_mm:?}, {depth_mm}");
        }
        assert_eq!(beside(Some(600.0), f64::NAN), None);
    }
}
