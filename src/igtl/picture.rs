//! IMAGE: pixels and where they lie (`Documents/Protocol/image.md`).

use glam::DVec3;

use super::header::float32;
use crate::geometry::Intrinsics;
use crate::image::Image;

/// Codes of the protocol: what a pixel is.
const UINT16: u8 = 5;
const FLOAT32: u8 = 10;
/// Byte order of the pixels; that of the header is always big-endian.
const LITTLE_ENDIAN: u8 = 2;
/// The code for RAS, at which receivers leave coordinates as they are; at the one for LPS they negate x and y, which is wrong in a camera's.
const AS_THEY_ARE: u8 = 1;

/// Where a picture lies, in the frame that its sender says.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Placement {
    /// From one column to the next, mm.
    pub column_step_mm: DVec3,
    /// From one row to the next, mm.
    pub row_step_mm: DVec3,
    /// Centre of the first pixel, mm.
    pub first_pixel_mm: DVec3,
}

impl Placement {
    /// Nowhere: pixels 1 apart, the centre of the first at the origin.
    pub const PIXELS: Self = Self { column_step_mm: DVec3::X, row_step_mm: DVec3::Y, first_pixel_mm: DVec3::ZERO };

    /// On the detector, in the camera's frame: at depth fx · pitch. `None` unless the pitch is positive.
    #[must_use]
    pub fn on_detector(k: &Intrinsics, pitch_mm: f64) -> Option<Self> {
        let depth_mm = k.fx * pitch_mm;
        let row_mm = depth_mm / k.fy;
        let first_pixel_mm = DVec3::new(-k.cx * pitch_mm, -k.cy * row_mm, depth_mm);
        let placement = Self { column_step_mm: DVec3::X * pitch_mm, row_step_mm: DVec3::Y * row_mm, first_pixel_mm };
        Some(placement).filter(|placement| pitch_mm > 0.0 && placement.is_finite())
    }

    /// Whether all of it is numbers.
    #[must_use]
    pub fn is_finite(&self) -> bool {
        self.column_step_mm.is_finite() && self.row_step_mm.is_finite() && self.first_pixel_mm.is_finite()
    }
}

/// A picture of one value a pixel.
#[derive(Clone, Debug, PartialEq)]
pub struct Picture {
    /// Columns and rows.
    size_px: [u16; 2],
    /// What a pixel is, by the protocol.
    scalar: u8,
    /// Little-endian, row by row.
    pixels: Vec<u8>,
    /// Where it lies.
    pub placement: Placement,
}

impl Picture {
    /// Of an image: uint16 where all pixels are whole numbers in its range, so that a detector's counts stay what they are, else float32.
    /// `None` where the protocol cannot hold its size.
    #[must_use]
    pub fn of(image: &Image<f32>, placement: Placement) -> Option<Self> {
        let size_px = [u16::try_from(image.width).ok()?, u16::try_from(image.height).ok()?];
        let is_count = |value: &f32| *value >= 0.0 && *value <= f32::from(u16::MAX) && value.fract() == 0.0;
        let (scalar, pixels) = match image.pixels.iter().all(is_count) {
            true => (UINT16, image.pixels.iter().flat_map(|value| (*value as u16).to_le_bytes()).collect()),
            false => (FLOAT32, image.pixels.iter().flat_map(|value| value.to_le_bytes()).collect()),
        };
        Some(Self { size_px, scalar, pixels, placement })
    }

    pub(super) fn write(&self, out: &mut Vec<u8>) {
        let [columns, rows] = self.size_px;
        // The version of this body; one value a pixel.
        out.extend(1u16.to_be_bytes());
        out.extend([1, self.scalar, LITTLE_ENDIAN, AS_THEY_ARE]);
        let size: Vec<u8> = [columns, rows, 1].into_iter().flat_map(u16::to_be_bytes).collect();
        out.extend(&size);
        let Placement { column_step_mm, row_step_mm, first_pixel_mm } = self.placement;
        // A slice 1 mm thick; the place is that of the middle between first and last pixel, as the library has it.
        let normal = column_step_mm.cross(row_step_mm).normalize_or_zero();
        let half = |count: u16| 0.5 * (f64::from(count) - 1.0);
        let middle_mm = first_pixel_mm + column_step_mm * half(columns) + row_step_mm * half(rows);
        let vectors = [column_step_mm, row_step_mm, normal, middle_mm];
        vectors.iter().flat_map(DVec3::to_array).for_each(|value| float32(out, value));
        // All of it, and not a part.
        out.extend([0; 6]);
        out.extend(size);
        out.extend(&self.pixels);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn counts_stay_whole_numbers_and_all_else_stays_as_it_is() {
        let scalar = |pixels: Vec<f32>| {
            let image = Image::from_pixels(pixels.len(), 1, pixels).expect("a row");
            Picture::of(&image, Placement::PIXELS).map(|picture| (picture.scalar, picture.pixels.len()))
        };
        assert_eq!(scalar(vec![0.0, 65535.0]), Some((UINT16, 4)));
        for odd in [0.5, -1.0, 65536.0, f32::NAN, f32::INFINITY] {
            assert_eq!(scalar(vec![1.0, odd]), Some((FLOAT32, 8)), "{odd}");
        }
        assert!(Picture::of(&Image::filled(70_000, 1, 0.0), Placement::PIXELS).is_none());
    }

    #[test]
    fn the_principal_ray_meets_the_detector_at_the_principal_point() {
        let k = Intrinsics { fx: 5000.0, fy: 4000.0, skew: 0.0, cx: 310.0, cy: 240.0 };
        let placement = Placement::on_detector(&k, 0.2).expect("a pitch");
        let at = |u: f64, v: f64| placement.first_pixel_mm + placement.column_step_mm * u + placement.row_step_mm * v;
        assert!(at(310.0, 240.0).distance(DVec3::new(0.0, 0.0, 1000.0)) < 1e-9);
        // Any pixel lies on its own ray.
        let p = at(17.0, 400.0);
        assert!((k.fx * p.x / p.z + k.cx - 17.0).abs() < 1e-9 && (k.fy * p.y / p.z + k.cy - 400.0).abs() < 1e-9);
        assert!(Placement::on_detector(&k, f64::NAN).is_none() && Placement::on_detector(&k, 0.0).is_none());
    }
}
