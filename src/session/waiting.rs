//! Bound frames that wait to be registered: the newest with their pictures, those of the others on the disk of the session's folder.

use std::collections::BTreeMap;
use std::path::Path;
use std::sync::Arc;

use super::bound::Bound;
use super::park::{Park, Parked};
use crate::acquire::Frame;
use crate::image::Image;
use crate::reporter::Reporter;

/// Pictures that wait in memory, up to this much.
const MOST_BYTES: usize = 256 << 20;

/// See the module.
pub(super) struct Waiting {
    frames: BTreeMap<u32, (Bound, Option<Parked>)>,
    /// Absent where there is no folder: all wait in memory.
    park: Option<Park>,
    most_bytes: usize,
    reporter: Reporter,
}

impl Waiting {
    /// All in memory.
    pub(super) fn new(reporter: Reporter) -> Self {
        Self { frames: BTreeMap::new(), park: None, most_bytes: MOST_BYTES, reporter }
    }

    /// From now on in `folder`, where there are many.
    pub(super) fn park_in(&mut self, folder: &Path) {
        self.park = Park::start(folder, &self.reporter).map_err(|error| self.reporter.warn("many frames wait", error)).ok();
    }

    /// Numbers of the frames, in order.
    pub(super) fn numbers(&self) -> impl DoubleEndedIterator<Item = u32> + '_ {
        self.frames.keys().copied()
    }

    /// Whether [`Waiting::take`] gives a frame without waiting for the disk, which is asked for its picture where it has it.
    pub(super) fn is_ready(&self, number: u32) -> bool {
        self.frames.get(&number).is_some_and(|(_, parked)| parked.as_ref().is_none_or(Parked::is_here))
    }

    /// Binds a frame that waits anew, wherever its picture is; `None` where it does not wait.
    pub(super) fn rebind(&mut self, number: u32, bind: impl FnOnce(Arc<Frame>) -> Bound) -> Option<&Bound> {
        let (bound, _) = self.frames.get_mut(&number)?;
        *bound = bind(Arc::clone(bound.frame()));
        Some(bound)
    }

    /// Takes a frame.
    pub(super) fn insert(&mut self, number: u32, bound: Bound) {
        self.frames.insert(number, (bound, None));
        let Some(park) = &self.park else { return };
        let mut kept_bytes = 0;
        for (bound, parked) in self.frames.values_mut().rev() {
            kept_bytes += size_of_val(bound.frame().pixels.pixels.as_slice());
            if kept_bytes > self.most_bytes && parked.is_none() {
                let none = Image { width: 0, height: 0, pixels: Vec::new() };
                *parked = Some(park.put(bound.replace_pixels(none)));
            }
        }
    }

    /// Gives a frame out, with its picture; without one, and with the reason, where it cannot be read back.
    pub(super) fn take(&mut self, number: u32) -> Option<(Bound, Option<String>)> {
        let (mut bound, parked) = self.frames.remove(&number)?;
        let Some(parked) = parked else { return Some((bound, None)) };
        let [width, height] = bound.frame().size_px;
        let (pixels, lost) = match parked.take() {
            Ok(pixels) => (Arc::unwrap_or_clone(pixels), None),
            Err(error) => {
                let words = format!("its picture, which waited on the disk, cannot be read back ({error})");
                (Image::filled(width, height, f32::NAN), Some(words))
            }
        };
        drop(bound.replace_pixels(pixels));
        Some((bound, lost))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::acquire::Domain;
    use crate::timeline::{Binding, Timeline};

    fn bound(value: f32) -> Bound {
        let image = Image { width: 4, height: 3, pixels: (0..12).map(|n| value + n as f32).collect() };
        let frame = Frame::from_pixels("a", image, Domain::Linear).expect("a frame");
        Bound::new(Arc::new(frame), 0, Binding::default(), &Timeline::new())
    }

    fn waiting(folder: &Path) -> Waiting {
        let mut waiting = Waiting { most_bytes: 100, ..Waiting::new(Reporter::silent()) };
        waiting.park_in(folder);
        (1..=5).for_each(|number| waiting.insert(number, bound(100.0 * number as f32)));
        waiting
    }

    #[test]
    fn of_many_frames_the_newest_wait_in_memory_and_all_come_back_whole() {
        let folder = tempfile::tempdir().expect("a folder");
        let mut waiting = waiting(folder.path());
        let in_memory = |waiting: &Waiting| -> Vec<u32> {
            let there = waiting.frames.iter().filter(|(_, (bound, _))| !bound.frame().pixels.pixels.is_empty());
            there.map(|(number, _)| *number).collect()
        };
        assert_eq!(in_memory(&waiting), [4, 5], "48 bytes each");
        assert!(waiting.is_ready(5) && !waiting.is_ready(9));
        // One that is bound anew keeps its picture, on the disk as well.
        for number in [2, 5] {
            let again = waiting.rebind(number, |frame| Bound::new(frame, 77, Binding::default(), &Timeline::new()));
            assert!(again.is_some());
        }
        assert!(waiting.rebind(9, |frame| Bound::new(frame, 0, Binding::default(), &Timeline::new())).is_none());
        let firsts: Vec<f32> = [5, 2, 1, 3, 4]
            .into_iter()
            .map(|number| {
                let (bound, lost) = waiting.take(number).expect("there");
                assert_eq!(lost, None);
                let frame = bound.frame().clone();
                assert_eq!((frame.pixels.pixels.len(), frame.pixels.width, frame.pixels.height), (12, 4, 3));
                frame.pixels.pixels[0]
            })
            .collect();
        assert_eq!(firsts, [500.0, 200.0, 100.0, 300.0, 400.0]);
        assert!(waiting.take(1).is_none() && waiting.numbers().next().is_none());
    }

    #[test]
    fn where_nothing_can_be_written_frames_wait_in_memory() {
        let folder = tempfile::tempdir().expect("a folder");
        let mut waiting = waiting(&folder.path().join("none"));
        let (first, lost) = waiting.take(1).expect("there");
        assert_eq!((first.frame().pixels.pixels[0], lost), (100.0, None));
    }
}
