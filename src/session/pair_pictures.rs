//! The pictures of a pair as the window draws them: values, not colours, so that it chooses the window and reads what lies under the cursor.

use std::sync::Arc;

use crate::acquire::Frame;
use crate::compare::Pictures;
use crate::image::Image;
use crate::mask::Masks;
use crate::report::{Alone, SignedDifference};

/// Widest small picture.
const SMALL_PX: usize = 155;
/// Masks of a picture at most: what is usable, what is shut off, edges.
const MASKS: usize = 3;
/// Pixels whose masks share a number. Its two highest bits stay clear, so that it is never one that is none.
const PIXELS_A_NUMBER: usize = 10;

/// A matched DRR beside the frame, or a frame alone; larger is more attenuation.
#[derive(Clone, Debug)]
pub struct PairPictures {
    /// Columns and rows of the frame; the pictures may be smaller.
    pub size_px: [usize; 2],
    /// Gray values from black to white of the frame, where nobody chose others.
    pub window: [f64; 2],
    /// Those of the DRR that go with them.
    pub window_of_drr: [f64; 2],
    /// How acquired minus simulated is shown; absent without a matched DRR.
    pub difference: Option<SignedDifference>,
    /// Of the values.
    pub unit: String,
    source: Source,
    /// What stands for them where there is no room; absent in small ones.
    small: Option<Arc<PairPictures>>,
    /// They were read back from where whole pictures are put away.
    is_read_back: bool,
}

#[derive(Clone, Debug)]
enum Source {
    Compared(Arc<Pictures>),
    Alone { shown: Image<f32>, usable: Image<bool>, shut_off: Image<bool> },
}

/// The pixels of pictures that are put away.
pub(super) struct Pages<'a> {
    /// Of the frame, and of the DRR where there is one.
    pub(super) values: Vec<&'a Image<f32>>,
    /// What they mean, ten pixels to a number.
    pub(super) meanings: Image<f32>,
}

impl PairPictures {
    /// A frame of `size_px` that was compared.
    #[must_use]
    pub fn compared(size_px: [usize; 2], pictures: &Arc<Pictures>) -> Self {
        let (difference, _) = SignedDifference::of(pictures);
        let [window, window_of_drr] = difference.windows(pictures);
        let (difference, unit) = (Some(difference), pictures.unit.to_owned());
        let source = Source::Compared(Arc::clone(pictures));
        Self { size_px, window, window_of_drr, difference, unit, source, small: None, is_read_back: false }.with_small()
    }

    /// A frame that has no partner.
    #[must_use]
    pub fn alone(frame: &Frame, masks: &Masks) -> Self {
        let Alone { values: shown, unit, usable, shut_off, window } = Alone::of(frame, masks);
        let size_px = [shown.width, shown.height];
        let source = Source::Alone { shown, usable, shut_off };
        let (window_of_drr, difference) = (window, None);
        Self { size_px, window, window_of_drr, difference, unit, source, small: None, is_read_back: false }.with_small()
    }

    /// Small ones are made here, before anybody has to wait for them.
    fn with_small(self) -> Self {
        let small = Some(Arc::new(self.made_small()));
        Self { small, ..self }
    }

    /// Gray values of the DRR from black to white where the frame's are `window`: the same, moved and widened as they are by themselves.
    #[must_use]
    pub fn drr_window(&self, window: [f64; 2]) -> [f64; 2] {
        let ([from, to], [low, high]) = (self.window, self.window_of_drr);
        window.map(|end| low + (end - from) * ((high - low) / (to - from)))
    }

    /// The frame.
    #[must_use]
    pub fn acquired(&self) -> &Image<f32> {
        match &self.source {
            Source::Compared(pictures) => &pictures.acquired,
            Source::Alone { shown, .. } => shown,
        }
    }

    /// The matched DRR.
    #[must_use]
    pub fn simulated(&self) -> Option<&Image<f32>> {
        match &self.source {
            Source::Compared(pictures) => Some(&pictures.simulated),
            Source::Alone { .. } => None,
        }
    }

    /// Edges of the DRR.
    #[must_use]
    pub fn edges(&self) -> Option<&Image<bool>> {
        match &self.source {
            Source::Compared(pictures) => Some(&pictures.edges),
            Source::Alone { .. } => None,
        }
    }

    /// True where the pixels mean something, and are scored.
    #[must_use]
    pub fn usable(&self) -> &Image<bool> {
        match &self.source {
            Source::Compared(pictures) => &pictures.usable,
            Source::Alone { usable, .. } => usable,
        }
    }

    /// True behind the collimator: the frame shows nothing there.
    #[must_use]
    pub fn shut_off(&self) -> &Image<bool> {
        match &self.source {
            Source::Compared(pictures) => &pictures.shut_off,
            Source::Alone { shut_off, .. } => shut_off,
        }
    }

    /// Whether these are small pictures that stand for whole ones: no value in them is a pixel's.
    #[must_use]
    pub fn is_small(&self) -> bool {
        self.small.is_none()
    }

    /// The small pictures that stand for these; absent where these are small.
    pub(super) fn small(&self) -> Option<&Arc<Self>> {
        self.small.as_ref()
    }

    /// Whether they were read back from where whole pictures are put away.
    pub(super) fn is_read_back(&self) -> bool {
        self.is_read_back
    }

    /// Memory of the pixels.
    pub(super) fn bytes(&self) -> usize {
        let numbers = 1 + usize::from(self.simulated().is_some());
        let masks = 2 + usize::from(self.edges().is_some());
        self.acquired().pixels.len() * (numbers * size_of::<f32>() + masks)
    }

    /// The same with small pictures.
    fn made_small(&self) -> Self {
        let source = match &self.source {
            Source::Compared(pictures) => Source::Compared(Arc::new(Pictures {
                acquired: averaged(&pictures.acquired),
                simulated: averaged(&pictures.simulated),
                usable: thinned(&pictures.usable),
                shut_off: thinned(&pictures.shut_off),
                edges: thinned(&pictures.edges),
                unit: pictures.unit,
            })),
            Source::Alone { shown, usable, shut_off } => {
                Source::Alone { shown: averaged(shown), usable: thinned(usable), shut_off: thinned(shut_off) }
            }
        };
        Self { source, small: None, unit: self.unit.clone(), ..*self }
    }

    /// What of the whole pictures is not in the small ones.
    pub(super) fn pages(&self) -> Pages<'_> {
        let masks: Vec<&Image<bool>> = [self.usable(), self.shut_off()].into_iter().chain(self.edges()).collect();
        let meanings = packed(&masks, self.acquired().pixels.len());
        Pages { values: [self.acquired()].into_iter().chain(self.simulated()).collect(), meanings }
    }

    /// The whole pictures of which these are the small ones, from the values and meanings of their [`Pages`]; `None` where those are others'.
    pub(super) fn whole(self: &Arc<Self>, values: Vec<Image<f32>>, meanings: &Image<f32>) -> Option<Self> {
        let mut values = values.into_iter();
        let acquired = values.next()?;
        let size_px = [acquired.width, acquired.height];
        let (usable, shut_off) = (unpacked(meanings, 0, size_px)?, unpacked(meanings, 1, size_px)?);
        let source = match &self.source {
            Source::Compared(small) => {
                let (simulated, edges, unit) = (values.next()?, unpacked(meanings, 2, size_px)?, small.unit);
                Source::Compared(Arc::new(Pictures { acquired, simulated, usable, shut_off, edges, unit }))
            }
            Source::Alone { .. } => Source::Alone { shown: acquired, usable, shut_off },
        };
        let (small, unit) = (Some(Arc::clone(self)), self.unit.clone());
        Some(Self { source, small, is_read_back: true, unit, ..**self })
    }
}

/// Pixels of a whole picture to one of the small one along each side, and the size of that.
fn reduction<T>(image: &Image<T>) -> (usize, [usize; 2]) {
    let step = image.width.div_ceil(SMALL_PX).max(1);
    (step, [image.width, image.height].map(|side| (side / step).max(1).min(side)))
}

/// Means of blocks of the values that are numbers.
fn averaged(image: &Image<f32>) -> Image<f32> {
    let (step, [width, height]) = reduction(image);
    let mut sums = vec![(0.0f32, 0u32); width * height];
    for (row, values) in image.pixels.chunks(image.width.max(1)).enumerate().take(step * height) {
        for (column, value) in values.iter().enumerate().take(step * width).filter(|(_, value)| value.is_finite()) {
            let (sum, count) = &mut sums[row / step * width + column / step];
            *sum += value;
            *count += 1;
        }
    }
    let mean = |(sum, count): (f32, u32)| if count > 0 { sum / count as f32 } else { f32::NAN };
    Image { width, height, pixels: sums.into_iter().map(mean).collect() }
}

/// A pixel of each block.
fn thinned(image: &Image<bool>) -> Image<bool> {
    let (step, [width, height]) = reduction(image);
    let at = |index: usize| *image.at(index % width * step, index / width * step);
    Image { width, height, pixels: (0..width * height).map(at).collect() }
}

/// The masks of `count` pixels as numbers.
fn packed(masks: &[&Image<bool>], count: usize) -> Image<f32> {
    let number = |first: usize| {
        let mut bits = 0u32;
        for (n, mask) in masks.iter().enumerate() {
            let of_number = mask.pixels.iter().skip(first).take(PIXELS_A_NUMBER.min(count - first)).enumerate();
            of_number.filter(|(_, is_set)| **is_set).for_each(|(place, _)| bits |= 1 << (MASKS * place + n));
        }
        f32::from_bits(bits)
    };
    let pixels: Vec<f32> = (0..count).step_by(PIXELS_A_NUMBER).map(number).collect();
    Image { width: pixels.len(), height: 1, pixels }
}

/// The `n`th of the masks that numbers hold.
fn unpacked(numbers: &Image<f32>, n: usize, [width, height]: [usize; 2]) -> Option<Image<bool>> {
    let is_set = |at: usize| {
        let number = numbers.pixels.get(at / PIXELS_A_NUMBER)?;
        Some((number.to_bits() >> (MASKS * (at % PIXELS_A_NUMBER) + n)) & 1 == 1)
    };
    Some(Image { width, height, pixels: (0..width * height).map(is_set).collect::<Option<Vec<bool>>>()? })
}

#[cfg(test)]
mod tests {
    use super::*;

    fn whole() -> PairPictures {
        let image = |by: f32| Image { width: 620, height: 7, pixels: (0..620 * 7).map(|at| by * (at % 97) as f32).collect() };
        let mask = |every: usize| Image { width: 620, height: 7, pixels: (0..620 * 7).map(|at| at % every == 1).collect() };
        let (usable, shut_off, edges) = (mask(2), mask(3), mask(7));
        let pictures = Pictures { acquired: image(0.01), simulated: image(0.02), usable, shut_off, edges, unit: "nepers" };
        PairPictures::compared([620, 7], &Arc::new(pictures))
    }

    #[test]
    fn whole_pictures_come_back_from_small_ones_and_their_pages() {
        let whole = whole();
        let small = Arc::clone(whole.small().expect("made with it"));
        assert!(small.is_small() && !whole.is_read_back());
        let Pages { values, meanings } = whole.pages();
        assert!(meanings.pixels.iter().all(|number| number.is_finite()) && meanings.pixels.len() == 434);
        let again = small.whole(values.into_iter().cloned().collect(), &meanings).expect("they are its own");
        assert_eq!((again.acquired(), again.simulated()), (whole.acquired(), whole.simulated()));
        assert_eq!(again.edges(), whole.edges());
        assert_eq!((again.usable(), again.shut_off()), (whole.usable(), whole.shut_off()));
        assert_eq!((again.window, again.unit.as_str(), again.is_small()), (whole.window, "nepers", false));
        assert!(again.is_read_back() && again.small().is_some_and(|same| Arc::ptr_eq(same, &small)), "small ones are made once");
        assert!(small.whole(vec![whole.acquired().clone()], &meanings).is_none(), "half of them");
        let few = Image { width: 3, height: 1, pixels: vec![0.0; 3] };
        assert!(small.whole(vec![whole.acquired().clone(); 2], &few).is_none(), "those of another");
    }

    #[test]
    fn a_small_picture_has_the_means_of_what_it_stands_for() {
        let mut pixels: Vec<f32> = (0..620 * 8).map(|at| (at % 620) as f32).collect();
        pixels[0] = f32::NAN;
        pixels.iter_mut().skip(4 * 620).step_by(620).for_each(|value| *value = f32::NAN);
        let small = averaged(&Image { width: 620, height: 8, pixels });
        assert_eq!((small.width, small.height), (155, 2));
        // Columns 0 to 3 of four rows without the first pixel, and columns 4 to 7.
        assert!((small.pixels[0] - 24.0 / 15.0).abs() < 1e-6 && (small.pixels[1] - 5.5).abs() < 1e-6, "{:?}", &small.pixels[..2]);
        assert!((small.pixels[155] - 2.0).abs() < 1e-6, "columns 1 to 3: {}", small.pixels[155]);
        let low = averaged(&Image::filled(620, 2, 3.0f32));
        assert_eq!((low.width, low.height, low.pixels[154]), (155, 1, 3.0), "fewer rows than one needs");
        assert!(averaged(&Image::filled(310, 2, f32::NAN)).pixels[0].is_nan());
    }
}
