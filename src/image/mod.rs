//! Images in memory and on disk: row-major, first pixel's centre at (0, 0).

pub mod dicom;
mod files;
pub mod fourier;
mod new_file;
pub mod plot;
mod quantile;
mod temporary;
mod ticks;
mod vectors;
mod video;

pub use files::{
    ImageFileError, Lasting, WHITE_IS_ZERO, beside, cache_file, check_writable, hex, read_png_rgb, read_tiff_f32,
    refuse_overwrite, refuse_same_content, refuse_twice, sha256_bytes, sha256_file, write_atomically, write_lasting,
    write_png_rgb, write_tiff_f32, write_tiff_f32_lasting,
};

pub use new_file::{NewFile, UNNAMED, sync_folder};
pub use quantile::{in_order, quantile};
pub use temporary::{Temporary, TemporaryFolder, remove_temporaries, temporary_file, temporary_folder};
pub use ticks::round_down;
pub use vectors::{exp, on_widest_vectors};
pub use video::VideoFile;

use rayon::prelude::*;

/// A row-major raster; the index of pixel (column, row) is `row * width + column`.
#[derive(Clone, Debug, PartialEq)]
pub struct Image<T> {
    /// Columns.
    pub width: usize,
    /// Rows.
    pub height: usize,
    /// `width * height` pixels, rows from top to bottom.
    pub pixels: Vec<T>,
}

impl<T: Clone> Image<T> {
    /// `width` × `height` pixels of `value`.
    #[must_use]
    pub fn filled(width: usize, height: usize, value: T) -> Self {
        Self { width, height, pixels: vec![value; width * height] }
    }
}

impl<T> Image<T> {
    /// Wraps `pixels`, or `None` unless there are `width * height`.
    #[must_use]
    pub fn from_pixels(width: usize, height: usize, pixels: Vec<T>) -> Option<Self> {
        (width.checked_mul(height) == Some(pixels.len())).then_some(Self { width, height, pixels })
    }

    /// The pixel at (`column`, `row`).
    ///
    /// # Panics
    /// When outside the image.
    #[must_use]
    pub fn at(&self, column: usize, row: usize) -> &T {
        assert!(column < self.width, "column {column} of {}", self.width);
        &self.pixels[row * self.width + column]
    }

    /// The pixel at (`column`, `row`), to be changed.
    ///
    /// # Panics
    /// When outside the image.
    pub fn at_mut(&mut self, column: usize, row: usize) -> &mut T {
        assert!(column < self.width, "column {column} of {}", self.width);
        &mut self.pixels[row * self.width + column]
    }

    /// A new image of `f(pixel)`.
    #[must_use]
    pub fn map<U>(&self, f: impl FnMut(&T) -> U) -> Image<U> {
        Image { width: self.width, height: self.height, pixels: self.pixels.iter().map(f).collect() }
    }

    /// Whether `other` has the same size.
    #[must_use]
    pub fn same_size<U>(&self, other: &Image<U>) -> bool {
        self.width == other.width && self.height == other.height
    }
}

impl<T: Copy> Image<T> {
    /// The given columns and rows, as far as the image has them.
    #[must_use]
    pub fn part(&self, [columns, rows]: &[std::ops::Range<usize>; 2]) -> Self {
        let within =
            |range: &std::ops::Range<usize>, end: usize| range.start.min(end)..range.end.min(end).max(range.start.min(end));
        let (columns, rows) = (within(columns, self.width), within(rows, self.height));
        let (width, height) = (columns.len(), rows.len());
        let pixels = rows.flat_map(|row| &self.pixels[row * self.width..][columns.clone()]).copied().collect();
        Self { width, height, pixels }
    }
}

impl Image<f32> {
    /// Bilinear interpolation at continuous (`u_px`, `v_px`); `None` outside the outermost pixel centres.
    #[must_use]
    pub fn bilinear(&self, u_px: f64, v_px: f64) -> Option<f64> {
        let inside = u_px >= 0.0 && v_px >= 0.0 && u_px <= (self.width as f64 - 1.0) && v_px <= (self.height as f64 - 1.0);
        if !inside {
            return None;
        }
        let (column, row) =
            ((u_px as usize).min(self.width.saturating_sub(2)), (v_px as usize).min(self.height.saturating_sub(2)));
        let (fu, fv) = (u_px - column as f64, v_px - row as f64);
        let (next_column, next_row) = ((column + 1).min(self.width - 1), (row + 1).min(self.height - 1));
        let at = |c: usize, r: usize| f64::from(*self.at(c, r));
        let top = at(column, row) * (1.0 - fu) + at(next_column, row) * fu;
        let bottom = at(column, next_row) * (1.0 - fu) + at(next_column, next_row) * fu;
        Some(top * (1.0 - fv) + bottom * fv)
    }
}

/// Pixel by pixel. Both images have the same size.
#[must_use]
pub fn zip<A, B, C>(a: &Image<A>, b: &Image<B>, f: impl Fn(&A, &B) -> C) -> Image<C> {
    debug_assert!(a.same_size(b), "images of one size");
    Image { width: a.width, height: a.height, pixels: a.pixels.iter().zip(&b.pixels).map(|(x, y)| f(x, y)).collect() }
}

/// Rows of blocks that a core takes at least.
const FEWEST_ROWS: usize = 4;

/// Means of `factor` × `factor` blocks over their usable pixels; a block is usable when at least half of it is. Whole blocks only.
#[must_use]
pub fn block_means(image: &Image<f32>, usable: &Image<bool>, factor: usize) -> (Image<f32>, Image<bool>) {
    let (width, height) = ((image.width / factor).max(1), (image.height / factor).max(1));
    let mut means = Image::filled(width, height, f32::NAN);
    let mut kept = Image::filled(width, height, false);
    let blocks = means.pixels.par_chunks_mut(width).zip(kept.pixels.par_chunks_mut(width)).with_min_len(FEWEST_ROWS);
    blocks.enumerate().for_each(|(v, (means, kept))| {
        let mut sums = vec![(0.0f64, 0usize, 0usize); width];
        for row in v * factor..((v + 1) * factor).min(image.height) {
            let row = row * image.width..(row + 1) * image.width;
            let in_blocks = image.pixels[row.clone()].chunks(factor).zip(usable.pixels[row].chunks(factor));
            for ((sum, count, total), (values, usable)) in sums.iter_mut().zip(in_blocks) {
                *total += values.len();
                for (value, _) in values.iter().zip(usable).filter(|(_, usable)| **usable) {
                    *sum += f64::from(*value);
                    *count += 1;
                }
            }
        }
        for ((mean, kept), (sum, count, total)) in means.iter_mut().zip(kept).zip(sums) {
            if count > 0 && 2 * count >= total {
                (*mean, *kept) = ((sum / count as f64) as f32, true);
            }
        }
    });
    (means, kept)
}
