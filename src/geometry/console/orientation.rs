//! How a stored picture lies: quarter turns and mirroring, undone on the pixels.

use glam::{DAffine2, DMat2, DVec2};

use super::declared::{ConsoleGeometry, Flip, affine};
use crate::image::Image;

/// A turn in parts: whole quarters clockwise, and what is left of it, within an eighth of a turn.
#[must_use]
pub fn quarters_and_rest(turned_rad: f64) -> (u32, f64) {
    let quarters = (turned_rad / std::f64::consts::FRAC_PI_2).round();
    (quarters.rem_euclid(4.0) as u32, turned_rad - quarters * std::f64::consts::FRAC_PI_2)
}

/// How a picture lies besides where: `turns` quarters clockwise and `turned_rad` more, then its columns reversed if `mirrored`.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Lie {
    pub turns: u32,
    pub turned_rad: f64,
    pub mirrored: bool,
}

impl ConsoleGeometry {
    pub(super) fn lie(&self) -> Lie {
        let Some(rows) = &self.detector_from_image else {
            let (turns, turned_rad) = quarters_and_rest(self.rotation_deg.to_radians());
            // A vertical flip is half a turn and a horizontal one.
            let (half, mirrored) = match self.flip {
                Flip::None => (0, false),
                Flip::Horizontal => (0, true),
                Flip::Vertical => (2, true),
            };
            let exact = self.rotation_deg.rem_euclid(90.0) == 0.0;
            return Lie { turns: (turns + half) % 4, turned_rad: if exact { 0.0 } else { turned_rad }, mirrored };
        };
        let matrix = affine(rows).matrix2;
        let mirrored = matrix.determinant() < 0.0;
        let x = if mirrored { -matrix.x_axis } else { matrix.x_axis };
        // The matrix turns back.
        let (turns, turned_rad) = quarters_and_rest(-x.y.atan2(x.x));
        Lie { turns, turned_rad, mirrored }
    }

    /// Whether columns and rows of the stored picture are those of a mirror image.
    #[must_use]
    pub fn is_mirrored(&self) -> bool {
        self.lie().mirrored
    }

    /// Columns and rows as stored of a picture that has `oriented` columns and rows on the panel.
    #[must_use]
    pub fn stored_size<N: Copy>(&self, oriented: [N; 2]) -> [N; 2] {
        let [columns, rows] = oriented;
        if self.lie().turns % 2 == 1 { [rows, columns] } else { [columns, rows] }
    }

    /// The picture as it lies on the panel: an exact permutation of the pixels. `unmirrored`: the columns were put back in order at
    /// import already, because the file itself says that they were reversed.
    #[must_use]
    pub fn orient<T: Clone>(&self, stored: &Image<T>, unmirrored: bool) -> Image<T> {
        let Lie { turns, mirrored, .. } = self.lie();
        let mirrored = mirrored && !unmirrored;
        let [width, height] = self.stored_size([stored.width, stored.height]);
        let mut pixels = Vec::with_capacity(stored.pixels.len());
        for v in 0..height {
            for u in 0..width {
                // A clockwise quarter turn takes the top row to the last column.
                let (column, row) = match turns {
                    0 => (u, v),
                    1 => (height - 1 - v, u),
                    2 => (width - 1 - u, height - 1 - v),
                    _ => (v, width - 1 - u),
                };
                let column = if mirrored { stored.width - 1 - column } else { column };
                pixels.push(stored.pixels[row * stored.width + column].clone());
            }
        }
        Image { width, height, pixels }
    }

    /// Pixels of the oriented frame to those of the stored one of `stored_px` columns and rows.
    #[must_use]
    pub fn stored_from_oriented(&self, stored_px: [u32; 2]) -> DAffine2 {
        let Lie { turns, mirrored, .. } = self.lie();
        let [width, height] = self.stored_size(stored_px).map(f64::from);
        let (x, y, origin) = match turns {
            0 => (DVec2::X, DVec2::Y, DVec2::ZERO),
            1 => (DVec2::Y, -DVec2::X, DVec2::new(height - 1.0, 0.0)),
            2 => (-DVec2::X, -DVec2::Y, DVec2::new(width - 1.0, height - 1.0)),
            _ => (-DVec2::Y, DVec2::X, DVec2::new(0.0, width - 1.0)),
        };
        let turned = DAffine2::from_mat2_translation(DMat2::from_cols(x, y), origin);
        if !mirrored {
            return turned;
        }
        let last = f64::from(stored_px[0]) - 1.0;
        DAffine2::from_mat2_translation(DMat2::from_diagonal(DVec2::new(-1.0, 1.0)), DVec2::new(last, 0.0)) * turned
    }

    /// What is undone, in words; empty when there is nothing to undo.
    #[must_use]
    pub fn words(&self) -> Vec<String> {
        let mut words = Vec::new();
        if let Some(rows) = &self.detector_from_image {
            let Lie { turns, turned_rad, mirrored } = self.lie();
            let step = affine(rows).matrix2.determinant().abs().sqrt();
            words.push(format!(
                "detector_from_image undone: turned by {:.3} degrees{}, {:.4} times as large",
                90.0 * f64::from(turns) + turned_rad.to_degrees(),
                if mirrored { ", then mirrored" } else { "" },
                1.0 / step
            ));
        }
        if self.rotation_deg != 0.0 {
            words.push(format!("turned back by {} degrees", self.rotation_deg));
        }
        if self.flip != Flip::None {
            words.push(format!("un-mirrored ({})", if self.flip == Flip::Horizontal { "horizontal" } else { "vertical" }));
        }
        if let Some(crop) = self.crop_px {
            words.push(format!("cropped by the console to {crop:?}"));
        }
        if self.binning != 1 || self.zoom != 1.0 {
            words.push(format!("binned by {} and enlarged {} times by the console", self.binning, self.zoom));
        }
        words
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Three columns, two rows, no two pixels alike.
    fn asymmetric() -> Image<u8> {
        Image { width: 3, height: 2, pixels: vec![1, 2, 3, 4, 5, 6] }
    }

    fn stored(rotation_deg: i32, flip: Flip) -> (ConsoleGeometry, Image<u8>) {
        // Written down by hand from the picture 123/456: what a person sees after turning it clockwise, then mirroring.
        let rows: &[&[u8]] = match (rotation_deg, flip) {
            (0, Flip::None) => &[&[1, 2, 3], &[4, 5, 6]],
            (90, Flip::None) => &[&[4, 1], &[5, 2], &[6, 3]],
            (180, Flip::None) => &[&[6, 5, 4], &[3, 2, 1]],
            (270, Flip::None) => &[&[3, 6], &[2, 5], &[1, 4]],
            (0, Flip::Horizontal) => &[&[3, 2, 1], &[6, 5, 4]],
            (90, Flip::Horizontal) => &[&[1, 4], &[2, 5], &[3, 6]],
            (180, Flip::Horizontal) => &[&[4, 5, 6], &[1, 2, 3]],
            (270, Flip::Horizontal) => &[&[6, 3], &[5, 2], &[4, 1]],
            (0, Flip::Vertical) => &[&[4, 5, 6], &[1, 2, 3]],
            (90, Flip::Vertical) => &[&[6, 3], &[5, 2], &[4, 1]],
            (180, Flip::Vertical) => &[&[3, 2, 1], &[6, 5, 4]],
            _ => &[&[1, 4], &[2, 5], &[3, 6]],
        };
        let image = Image { width: rows[0].len(), height: rows.len(), pixels: rows.concat() };
        (ConsoleGeometry { rotation_deg: f64::from(rotation_deg), flip, ..ConsoleGeometry::default() }, image)
    }

    #[test]
    fn every_orientation_comes_back_pixel_by_pixel() {
        let mut cases = 0;
        for rotation_deg in [0, 90, 180, 270] {
            for flip in [Flip::None, Flip::Horizontal, Flip::Vertical] {
                let (console, picture) = stored(rotation_deg, flip);
                assert_eq!(console.orient(&picture, false), asymmetric(), "{rotation_deg} {flip:?}");
                if flip != Flip::None {
                    let mut read = picture.clone();
                    read.pixels.chunks_exact_mut(picture.width).for_each(<[u8]>::reverse);
                    assert_eq!(console.orient(&read, true), asymmetric(), "un-mirrored at import: {rotation_deg} {flip:?}");
                }
                cases += 1;
            }
        }
        assert_eq!(cases, 12);
        let (quarter, picture) = stored(90, Flip::None);
        let wrong = ConsoleGeometry { rotation_deg: 270.0, ..quarter };
        assert_ne!(wrong.orient(&picture, false), asymmetric(), "control: the other way round");
    }
}
