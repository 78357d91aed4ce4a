//! Writing that the console burned into the pixels.

use crate::image::Image;

/// Pixels that are looked at together.
const PIECE_PX: usize = 64;

/// Letters are components of exactly one extreme value, a few to some dozen pixels high, in a row with at least two others of like
/// height. (A first form: writing in gray, or with a shadow, is not found; `--mask` takes it.)
pub(super) fn burned_in(ends: &[&Image<bool>; 2]) -> Image<bool> {
    let mut written = Image::filled(ends[0].width, ends[0].height, false);
    for end in ends {
        let components = components(end);
        let letters: Vec<&Component> = components.iter().filter(|c| c.looks_like_a_letter(end.height)).collect();
        for letter in &letters {
            let neighbours = letters.iter().filter(|other| letter.stands_in_line_with(other)).count();
            // The letter itself is one of them.
            if neighbours >= 3 {
                letter.indices.iter().for_each(|&at| written.pixels[at] = true);
            }
        }
    }
    if written.pixels.contains(&true) { dilate_once(&written) } else { written }
}

/// A connected set of pixels and its box (inclusive).
pub struct Component {
    /// Its pixels.
    pub indices: Vec<usize>,
    left: usize,
    right: usize,
    top: usize,
    bottom: usize,
}

impl Component {
    /// First and last column, first and last row.
    pub(super) fn bounds(&self) -> [usize; 4] {
        [self.left, self.right, self.top, self.bottom]
    }

    fn height(&self) -> usize {
        self.bottom - self.top + 1
    }

    fn looks_like_a_letter(&self, image_height: usize) -> bool {
        let limit = (image_height / 12).max(8);
        let (width, height) = (self.right - self.left + 1, self.height());
        let fill = self.indices.len() as f64 / (width * height) as f64;
        (5..=limit).contains(&height) && width <= 2 * limit && self.indices.len() >= 5 && (0.1..=0.95).contains(&fill)
    }

    fn stands_in_line_with(&self, other: &Self) -> bool {
        let (height, other_height) = (self.height(), other.height());
        let like = height.abs_diff(other_height) <= height.max(other_height) / 2;
        let level = self.bottom.abs_diff(other.bottom) <= height / 2;
        let gap = if self.left > other.right { self.left - other.right } else { other.left.saturating_sub(self.right) };
        like && level && gap <= 4 * height
    }
}

/// 8-connected components of the true pixels.
#[must_use]
pub fn components(mask: &Image<bool>) -> Vec<Component> {
    let (width, height) = (mask.width, mask.height);
    let mut found = Vec::new();
    if !mask.pixels.contains(&true) {
        return found;
    }
    let mut seen = vec![false; mask.pixels.len()];
    // Most pieces of most masks hold nothing.
    let pieces = mask.pixels.chunks(PIECE_PX).enumerate().filter(|(_, piece)| piece.contains(&true));
    for start in pieces.flat_map(|(n, piece)| n * PIECE_PX..n * PIECE_PX + piece.len()) {
        if seen[start] || !mask.pixels[start] {
            continue;
        }
        seen[start] = true;
        let mut indices = vec![start];
        let mut next = 0;
        let (mut left, mut right, mut top, mut bottom) = (width, 0, height, 0);
        while next < indices.len() {
            let at = indices[next];
            next += 1;
            let (u, v) = (at % width, at / width);
            (left, right, top, bottom) = (left.min(u), right.max(u), top.min(v), bottom.max(v));
            for row in v.saturating_sub(1)..(v + 2).min(height) {
                for column in u.saturating_sub(1)..(u + 2).min(width) {
                    let beside = row * width + column;
                    if mask.pixels[beside] && !seen[beside] {
                        seen[beside] = true;
                        indices.push(beside);
                    }
                }
            }
        }
        found.push(Component { indices, left, right, top, bottom });
    }
    found
}

fn dilate_once(mask: &Image<bool>) -> Image<bool> {
    let mut wide = mask.clone();
    for v in 0..mask.height {
        for u in 0..mask.width {
            if *mask.at(u, v) {
                for row in v.saturating_sub(1)..(v + 2).min(mask.height) {
                    for column in u.saturating_sub(1)..(u + 2).min(mask.width) {
                        *wide.at_mut(column, row) = true;
                    }
                }
            }
        }
    }
    wide
}
