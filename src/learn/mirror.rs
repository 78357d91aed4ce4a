//! Mirror images of samples: physics does not know left from right.

use super::shard::ERRORS;
use super::{Dataset, Sample};
use crate::infer::{CELL_COLUMNS, COLUMNS};

/// A reflection of the detector.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Mirror {
    /// The order of the columns is reversed; `x_mm` changes sign.
    pub columns: bool,
    /// The order of the rows is reversed; `y_mm` changes sign.
    pub rows: bool,
}

impl Mirror {
    /// Whether the quantity `name` changes sign.
    pub(super) fn negates(self, name: &str) -> bool {
        (self.columns && name == "x_mm") || (self.rows && name == "y_mm")
    }

    /// Pages of `columns` columns, one behind the other, each of `values.len() / pages`.
    fn pages(self, values: &mut [f32], pages: usize, columns: usize) {
        for page in values.chunks_mut(values.len() / pages) {
            if self.rows {
                // Reversing all and then each row reverses the rows only.
                page.reverse();
            }
            if self.columns != self.rows {
                page.chunks_mut(columns).for_each(<[f32]>::reverse);
            }
        }
    }
}

impl Dataset {
    /// `sample` in the mirror.
    #[must_use]
    pub fn mirrored(&self, sample: &Sample, mirror: Mirror) -> Sample {
        let mut sample = sample.clone();
        if mirror == Mirror::default() {
            return sample;
        }
        let channels = self.channels.len();
        mirror.pages(&mut sample.input.inputs, channels, COLUMNS);
        let pages = sample.input.inputs.chunks_mut(crate::infer::PIXELS);
        for (_, page) in self.channels.iter().zip(pages).filter(|(name, _)| mirror.negates(name)) {
            page.iter_mut().for_each(|value| *value = -*value);
        }
        let scalars = self.scalar_names.iter().zip(&mut sample.input.scalars);
        scalars.filter(|(name, _)| mirror.negates(name)).for_each(|(_, value)| *value = -*value);
        mirror.pages(&mut sample.truth, crate::infer::PAGES, CELL_COLUMNS);
        mirror.pages(&mut sample.truth_error, ERRORS, CELL_COLUMNS);
        sample
    }
}
