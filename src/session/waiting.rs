//! Bound frames that wait to be registered: the newest with their pictures, those of the others on the disk of the session's folder.

use std::collections::BTreeMap;
use std::path::Path;
use std::sync::Arc;

use super::park::{Park, Slot};
use super::posing::Bound;
use crate::acquire::Frame;
use crate::image::Image;
use crate::reporter::Reporter;

/// Pictures that wait in memory, up to this much.
const MOST_BYTES: usize = 256 << 20;

/// See the module.
pub(super) struct Waiting {
    frames: BTreeMap<u32, (Bound, Option<Slot>)>,
    /// Absent where there is no folder, or it cannot be written: all wait in memory.
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
        self.park = Some(Park::new(folder));
    }

    /// Numbers of the frames, in order.
    pub(super) fn numbers(&self) -> impl DoubleEndedIterator<Item = u32> + '_ {
        self.frames.keys().copied()
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
        let Self { frames, park, most_bytes, reporter } = self;
        let mut kept_bytes = 0;
        for (bound, slot) in frames.values_mut().rev() {
            let pixels = &bound.frame().pixels;
            kept_bytes += size_of_val(pixels.pixels.as_slice());
            let Some(parking) = park.as_mut().filter(|_| kept_bytes > *most_bytes && slot.is_none()) else { continue };
            match parking.put(pixels) {
                Ok(taken) => {
                    *slot = Some(taken);
                    bound.set_pixels(Image { width: 0, height: 0, pixels: Vec::new() });
                }
                Err(error) => {
                    let words = format!("frames that wait stay in memory, the session's folder does not take them: {error}");
                    reporter.warn("many frames wait", words);
                    return;
                }
            }
        }
    }

    /// Gives a frame out, with its picture.
    pub(super) fn take(&mut self, number: u32) -> Option<Bound> {
        let (mut bound, slot) = self.frames.remove(&number)?;
        if let (Some(slot), Some(park)) = (slot, &mut self.park) {
            let [width, height] = bound.frame().size_px;
            let pixels = park.take(slot).unwrap_or_else(|error| {
                let words =
                    format!("frame {number}: its picture cannot be read back ({error}); a replay of the log makes its pair");
                self.reporter.warn("picture lost meanwhile", words);
                Image::filled(width, height, f32::NAN)
            });
            bound.set_pixels(pixels);
        }
        Some(bound)
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
        // One that is bound anew keeps its picture, on the disk as well.
        for number in [2, 5] {
            let again = waiting.rebind(number, |frame| Bound::new(frame, 77, Binding::default(), &Timeline::new()));
            assert!(again.is_some());
        }
        assert!(waiting.rebind(9, |frame| Bound::new(frame, 0, Binding::default(), &Timeline::new())).is_none());
        let firsts: Vec<f32> = [5, 2, 1, 3, 4]
            .into_iter()
            .map(|number| {
                let frame = waiting.take(number).expect("there").frame().clone();
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
        assert_eq!(waiting.reporter.warnings()["many frames wait"].count, 3);
        assert_eq!(waiting.take(1).expect("there").frame().pixels.pixels[0], 100.0);
    }
}
