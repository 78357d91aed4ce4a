//! Squares of an image in which every pixel is cast, although elsewhere some are skipped.

use serde::{Deserialize, Serialize};

use super::bounds::Bounds;

/// Edge of a tile in pixels; a multiple of every step between cast pixels.
pub const TILE_PX: u32 = 16;

/// Which tiles of an image are cast in full. In files: four tiles a hexadecimal digit, the first in its highest bit, row by row.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(try_from = "Written", into = "Written")]
pub struct Tiles {
    size_px: [u32; 2],
    full: Vec<bool>,
}

#[derive(Serialize, Deserialize)]
struct Written {
    size_px: [u32; 2],
    tile_px: u32,
    full: String,
}

impl From<Tiles> for Written {
    fn from(tiles: Tiles) -> Self {
        let digit = |four: &[bool]| {
            let bits = four.iter().enumerate().fold(0u32, |bits, (i, full)| bits | u32::from(*full) << (3 - i));
            char::from_digit(bits, 16).unwrap_or('0')
        };
        Self { size_px: tiles.size_px, tile_px: TILE_PX, full: tiles.full.chunks(4).map(digit).collect() }
    }
}

impl TryFrom<Written> for Tiles {
    type Error = String;

    fn try_from(written: Written) -> Result<Self, String> {
        let tiles = written.size_px.map(|n| u64::from(n.div_ceil(TILE_PX)));
        let (digits, expected) = (written.full.len(), (tiles[0] * tiles[1]).div_ceil(4));
        if written.tile_px != TILE_PX || digits as u64 != expected {
            return Err(format!(
                "full_tiles: {digits} digits for tiles of {} px, expected {expected} for tiles of {TILE_PX} px",
                written.tile_px
            ));
        }
        // Only now, when there are as many digits, is memory taken for so many tiles.
        let mut tiles = Self::none(written.size_px);
        for (four, digit) in tiles.full.chunks_mut(4).zip(written.full.chars()) {
            let bits = digit.to_digit(16).ok_or_else(|| format!("full_tiles: '{digit}' is no hexadecimal digit"))?;
            four.iter_mut().enumerate().for_each(|(i, full)| *full = bits >> (3 - i) & 1 == 1);
        }
        Ok(tiles)
    }
}

impl Tiles {
    /// No tile of an image of so many columns and rows.
    #[must_use]
    pub fn none(size_px: [u32; 2]) -> Self {
        let [columns, rows] = size_px.map(|n| n.div_ceil(TILE_PX) as usize);
        Self { size_px, full: vec![false; columns * rows] }
    }

    /// Columns and rows of the image.
    #[must_use]
    pub fn size_px(&self) -> [u32; 2] {
        self.size_px
    }

    /// Number of tiles.
    #[must_use]
    pub fn count(&self) -> usize {
        self.full.len()
    }

    /// Pixels of tile number `index`: first and one past the last.
    #[must_use]
    pub fn bounds(&self, index: usize) -> Bounds {
        let columns = self.size_px[0].div_ceil(TILE_PX) as usize;
        let from = [index % columns, index / columns].map(|n| n as u32 * TILE_PX);
        Bounds { from, to: [0, 1].map(|axis| (from[axis] + TILE_PX).min(self.size_px[axis])) }
    }

    /// Whether tile number `index` is full.
    #[must_use]
    pub fn is_full(&self, index: usize) -> bool {
        self.full[index]
    }

    /// Makes tile number `index` full.
    pub fn fill(&mut self, index: usize) {
        self.full[index] = true;
    }

    /// Whether the tile around a pixel of the image is full.
    #[must_use]
    pub fn is_full_at(&self, [u, v]: [u32; 2]) -> bool {
        let columns = self.size_px[0].div_ceil(TILE_PX);
        self.full[(v / TILE_PX * columns + u / TILE_PX) as usize]
    }

    /// Makes the tiles full that see anything between two points, pixels; what lies outside the image does not count.
    pub fn fill_between(&mut self, from: [f64; 2], to: [f64; 2]) {
        let tile = f64::from(TILE_PX);
        let count = self.size_px.map(|n| n.div_ceil(TILE_PX) as usize);
        // Pixels are interpolated between cast ones up to the first pixel of the next tile.
        let first: [usize; 2] = std::array::from_fn(|axis| ((from[axis] - 0.5) / tile).ceil().max(1.0) as usize - 1);
        let end: [usize; 2] = std::array::from_fn(|axis| (((to[axis] + 0.5) / tile).floor() + 1.0).max(0.0) as usize);
        for row in first[1]..end[1].min(count[1]) {
            for column in first[0]..end[0].min(count[0]) {
                self.full[row * count[0] + column] = true;
            }
        }
    }

    /// Whether a pixel of a tile that is not full lies between two pixels, inclusive.
    #[must_use]
    pub fn skips_between(&self, from: [u32; 2], to: [u32; 2]) -> bool {
        let last = |axis: usize| to[axis].min(self.size_px[axis].saturating_sub(1)) / TILE_PX;
        let columns = self.size_px[0].div_ceil(TILE_PX);
        (from[1] / TILE_PX..=last(1))
            .any(|row| (from[0] / TILE_PX..=last(0)).any(|column| !self.full[(row * columns + column) as usize]))
    }

    /// Pixels in full tiles.
    #[must_use]
    pub fn pixels(&self) -> f64 {
        let pixels = |index: usize| {
            let Bounds { from, to } = self.bounds(index);
            f64::from(to[0] - from[0]) * f64::from(to[1] - from[1])
        };
        (0..self.full.len()).filter(|index| self.full[*index]).map(pixels).sum()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn tiles_come_back_from_a_file_as_they_were() {
        let mut tiles = Tiles::none([100, 50]);
        assert_eq!(tiles.count(), 28);
        tiles.fill_between([20.0, 17.0], [40.0, 30.0]);
        let text = serde_json::to_string(&tiles).expect("plain data");
        assert_eq!(serde_json::from_str::<Tiles>(&text).expect("the same"), tiles);
        assert_eq!(tiles.pixels(), 2.0 * 256.0);
        let longer = text.replace("\"full\":\"", "\"full\":\"0");
        assert!(serde_json::from_str::<Tiles>(&longer).is_err(), "a digit too many");
        assert!(serde_json::from_str::<Tiles>(&text.replace("\"tile_px\":16", "\"tile_px\":8")).is_err(), "other tiles");
    }

    #[test]
    fn a_point_just_right_of_a_tile_is_what_its_last_pixels_are_interpolated_from() {
        let mut tiles = Tiles::none([64, 64]);
        tiles.fill_between([16.0, 8.0], [16.0, 8.0]);
        assert!(tiles.is_full_at([15, 8]) && tiles.is_full_at([16, 8]));
        assert!(!tiles.is_full_at([15, 24]) && !tiles.is_full_at([40, 8]));
        assert!(tiles.skips_between([0, 0], [16, 16]) && !tiles.skips_between([0, 0], [31, 15]));
        tiles.fill_between([-90.0, -50.0], [-40.0, -10.0]);
        tiles.fill_between([f64::NEG_INFINITY, 50.0], [f64::INFINITY, 50.0]);
        assert_eq!(tiles.pixels(), 6.0 * 256.0, "outside there is nothing, and infinity is the border");
    }
}
