//! The pictures of one pair as textures: made when they are first drawn, and made anew when the pair, or its window, is another.

use std::sync::Arc;

use eframe::egui::{Color32, ColorImage, Context, TextureHandle, TextureOptions};

use super::theme::{EDGE, WELL, rgb};
use crate::image::Image;
use crate::report::{self, SignedDifference};
use crate::session::board::PairPictures;

/// Which picture; the acquired one is calm and dim behind the collimator.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Picture {
    Acquired,
    Drr,
    Difference,
    /// Edges of the DRR, clear elsewhere.
    Edges,
    /// A tint where pixels mean nothing, clear elsewhere.
    Masks,
}

const ALL: usize = 5;
/// Over what is masked.
const TINT: Color32 = Color32::from_rgba_premultiplied(0x50, 0x18, 0x60, 0x70);

/// See the module. Holding the pictures is what makes their identity certain: an address may be another pair's later.
#[derive(Default)]
pub(super) struct PictureCache {
    pictures: Option<Arc<PairPictures>>,
    window: [f64; 2],
    textures: [Option<TextureHandle>; ALL],
}

impl PictureCache {
    /// From now on those of `pictures`, gray between the two values of `window`.
    pub(super) fn show(&mut self, pictures: &Arc<PairPictures>, window: [f64; 2]) {
        if !self.pictures.as_ref().is_some_and(|shown| Arc::ptr_eq(shown, pictures)) {
            self.pictures = Some(Arc::clone(pictures));
            self.textures = Default::default();
        }
        if self.window != window {
            self.window = window;
            self.textures[Picture::Acquired as usize] = None;
            self.textures[Picture::Drr as usize] = None;
        }
    }

    /// A texture; `None` where the pair has no such picture.
    pub(super) fn texture(&mut self, context: &Context, picture: Picture) -> Option<TextureHandle> {
        let slot = &mut self.textures[picture as usize];
        if slot.is_none() {
            let most = context.input(|input| input.max_texture_side);
            let made = made(self.pictures.as_ref()?, picture, self.window, most)?;
            *slot = Some(context.load_texture(format!("{picture:?}"), made, TextureOptions::LINEAR));
        }
        slot.clone()
    }
}

fn made(pictures: &PairPictures, picture: Picture, window: [f64; 2], most: usize) -> Option<ColorImage> {
    Some(match picture {
        Picture::Acquired => {
            let shut_off = pictures.shut_off();
            let calm = report::calm(pictures.acquired(), shut_off, window);
            let seen: &Image<f32> = &calm;
            coloured(seen, most, |at| match shut_off.pixels[at] {
                true => dim(gray(seen.pixels[at], window)),
                false => gray(seen.pixels[at], window),
            })
        }
        Picture::Drr => {
            let (simulated, window) = (pictures.simulated()?, pictures.drr_window(window));
            coloured(simulated, most, |at| gray(simulated.pixels[at], window))
        }
        Picture::Difference => {
            let scale = pictures.difference.filter(|difference| difference.comparable)?;
            let (acquired, simulated, usable) = (pictures.acquired(), pictures.simulated()?, pictures.usable());
            coloured(acquired, most, |at| match usable.pixels[at] {
                true => signed(&scale, acquired.pixels[at], simulated.pixels[at]),
                false => WELL,
            })
        }
        Picture::Edges => {
            let edges = pictures.edges()?;
            coloured(edges, most, |at| if edges.pixels[at] { EDGE } else { Color32::TRANSPARENT })
        }
        Picture::Masks => {
            let usable = pictures.usable();
            coloured(usable, most, |at| if usable.pixels[at] { Color32::TRANSPARENT } else { TINT })
        }
    })
}

/// As [`report::gray`] has it, in single precision.
fn gray(value: f32, [low, high]: [f64; 2]) -> Color32 {
    if value.is_nan() {
        return WELL;
    }
    let share = (value - low as f32) / (high - low) as f32;
    Color32::from_gray((10.5 + 240.0 * share.clamp(0.0, 1.0)) as u8)
}

/// As [`report::dimmed`] has what is shut off.
fn dim(colour: Color32) -> Color32 {
    rgb(report::dimmed([colour.r(), colour.g(), colour.b()], 1.0))
}

fn signed(scale: &SignedDifference, acquired: f32, simulated: f32) -> Color32 {
    let [red, green, blue] = report::diverging(scale.between(acquired, simulated) / scale.limit as f32);
    Color32::from_rgb(red, green, blue)
}

/// A picture of the colours that `at` gives for an index of `image`; every nth pixel where the whole is more than `most` wide or high.
fn coloured<T>(image: &Image<T>, most: usize, at: impl Fn(usize) -> Color32) -> ColorImage {
    let step = image.width.max(image.height).div_ceil(most.max(1)).max(1);
    let size = [image.width / step, image.height / step];
    let pixels = match step {
        1 => (0..image.pixels.len()).map(at).collect(),
        _ => {
            let places = (0..size[1]).flat_map(|row| (0..size[0]).map(move |column| (column, row)));
            places.map(|(column, row)| at(row * step * image.width + column * step)).collect()
        }
    };
    ColorImage::new(size, pixels)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn grays_are_those_of_the_strips() {
        for value in [-3.0f32, 0.0, 0.11, 0.5, 0.999, 7.0] {
            let [level, ..] = report::gray(value, [0.0, 1.3]);
            assert!(gray(value, [0.0, 1.3]).r().abs_diff(level) <= 1, "{value}");
        }
        assert_eq!(gray(f32::NAN, [0.0, 1.0]), WELL);
    }

    #[test]
    fn a_picture_too_large_for_a_texture_is_thinned() {
        let image = Image { width: 9, height: 4, pixels: (0..36u8).collect() };
        let small = coloured(&image, 4, |at| Color32::from_gray(image.pixels[at]));
        assert_eq!((small.size, small.pixels[2]), ([3, 1], Color32::from_gray(6)));
    }
}
