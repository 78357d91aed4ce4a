//! Images in memory and on disk: row-major, first pixel's centre at (0, 0).

mod files;
pub mod plot;
mod ticks;

pub use files::{
    ImageFileError, check_writable, read_tiff_f32, refuse_overwrite, sha256_bytes, sha256_file, write_atomically, write_png_rgb,
    write_tiff_f32,
};

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
