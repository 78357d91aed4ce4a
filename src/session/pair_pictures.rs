//! The pictures of a pair as the window draws them: values, not colours, so that it chooses the window and reads what lies under the cursor.

use std::sync::Arc;

use crate::acquire::Frame;
use crate::compare::Pictures;
use crate::image::Image;
use crate::mask::Masks;
use crate::report::{Alone, SignedDifference};

/// Widest small picture.
pub(super) const THUMBNAIL_PX: usize = 155;

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
}

#[derive(Clone, Debug)]
enum Source {
    Compared(Arc<Pictures>),
    Alone { shown: Image<f32>, usable: Image<bool>, shut_off: Image<bool> },
}

impl PairPictures {
    /// A frame of `size_px` that was compared.
    #[must_use]
    pub fn compared(size_px: [usize; 2], pictures: &Arc<Pictures>) -> Self {
        let (difference, _) = SignedDifference::of(pictures);
        let [window, window_of_drr] = difference.windows(pictures);
        let (difference, unit) = (Some(difference), pictures.unit.to_owned());
        Self { size_px, window, window_of_drr, difference, unit, source: Source::Compared(Arc::clone(pictures)) }
    }

    /// A frame that has no partner.
    #[must_use]
    pub fn alone(frame: &Frame, masks: &Masks) -> Self {
        let Alone { values: shown, unit, usable, shut_off, window } = Alone::of(frame, masks);
        let size_px = [shown.width, shown.height];
        let source = Source::Alone { shown, usable, shut_off };
        Self { size_px, window, window_of_drr: window, difference: None, unit, source }
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

    /// Whether only small pictures are left.
    #[must_use]
    pub fn is_small(&self) -> bool {
        self.acquired().width <= THUMBNAIL_PX
    }

    /// The same with small pictures.
    pub(super) fn small(&self) -> Self {
        let source = match &self.source {
            Source::Compared(pictures) => Source::Compared(Arc::new(Pictures {
                acquired: small(&pictures.acquired),
                simulated: small(&pictures.simulated),
                usable: small(&pictures.usable),
                shut_off: small(&pictures.shut_off),
                edges: small(&pictures.edges),
                unit: pictures.unit,
            })),
            Source::Alone { shown, usable, shut_off } => {
                Source::Alone { shown: small(shown), usable: small(usable), shut_off: small(shut_off) }
            }
        };
        Self { source, ..self.clone() }
    }
}

fn small<T: Clone>(image: &Image<T>) -> Image<T> {
    let step = image.width.div_ceil(THUMBNAIL_PX).max(1);
    let (width, height) = (image.width / step, image.height / step);
    let at = |index: usize| image.at(index % width * step, index / width * step).clone();
    Image { width, height, pixels: (0..width * height).map(at).collect() }
}
