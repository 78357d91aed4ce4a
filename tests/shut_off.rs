//! What the collimator shuts off is calm, dim and tinted, in the window and in strips, and gray levels are those of the open field.

use std::ops::Range;

use sidecarm::acquire::Frame;
use sidecarm::compare::{CompareInput, OffsetRule, Pictures, compare};
use sidecarm::image::Image;
use sidecarm::mask::{Cause, Masks};
use sidecarm::report::{Standing, StripInput, strip};

use crate::compare_synthetic::{acquired, line_integral, view};

/// A frame of 310 × 240 px whose right half is shut off, with the noise about zero that is left there; and the masks that say so.
fn half_shut() -> (Frame, Masks) {
    let mut frame = acquired(&line_integral(&view()), 0.02);
    let is_shut = |at: usize| at % 310 >= 155;
    for (at, value) in frame.pixels.pixels.iter_mut().enumerate().filter(|(at, _)| is_shut(*at)) {
        *value = [2e-4, -3e-4, 6e-4, 0.02, 1e-3, 3e-3, 2e-4, 0.1][(at.wrapping_mul(2_654_435_761) >> 13) % 8];
    }
    let mut masks = Masks::default();
    masks.add(Cause::Collimation, Image { width: 310, height: 240, pixels: (0..310 * 240).map(is_shut).collect() });
    (frame, masks)
}

/// How restless a part of a picture is (standard deviation of its red), and how violet (mean of blue less green).
fn restless_and_violet(seen: &Image<[u8; 3]>, columns: Range<usize>, rows: Range<usize>) -> [f64; 2] {
    let part = seen.part(&[columns, rows]);
    let mean = |of: &dyn Fn(&[u8; 3]) -> f64| part.pixels.iter().map(of).sum::<f64>() / part.pixels.len() as f64;
    let red = mean(&|pixel| f64::from(pixel[0]));
    let variance = mean(&|pixel| (f64::from(pixel[0]) - red).powi(2));
    [variance.sqrt(), mean(&|pixel| f64::from(pixel[2]) - f64::from(pixel[1]))]
}

/// The noise of the shut half was the loudest thing in the window: its logarithm is black and white.
#[cfg(feature = "viewer")]
#[test]
fn the_window_shows_what_is_shut_off_calm_and_dim() {
    use crate::viewer_boards::{board, refused};
    use crate::viewer_drawn::{Drawn, IN_ACQUIRED, on_screen, picture_at};
    use sidecarm::session::board::PairPictures;

    let Some(mut drawn) = Drawn::open() else { return };
    let (frame, masks) = half_shut();
    let mut seen = |masks: &Masks| {
        let mut pair = refused(1);
        pair.pictures = std::sync::Arc::new(PairPictures::alone(&frame, masks));
        let [_, white] = pair.pictures.window;
        (drawn.picture(&board(vec![pair])), white)
    };
    let ((calm, of_field), (raw, of_all)) = (seen(&masks), seen(&Masks::default()));
    assert!(of_field < 4.0 && of_all > 7.0, "gray levels are those of the open field: {of_field}, control {of_all}");
    let picture = picture_at(&calm, IN_ACQUIRED);
    let (from, to) = (on_screen(picture, [175.0, 50.0]), on_screen(picture, [290.0, 180.0]));
    let half = |seen: &Image<[u8; 3]>| restless_and_violet(seen, from.x as usize..to.x as usize, from.y as usize..to.y as usize);
    let ([restless, violet], [control, gray]) = (half(&calm), half(&raw));
    assert!(restless < 8.0 && violet > 12.0, "{restless} {violet}");
    assert!(control > 30.0 && gray < 8.0, "control, where nobody knows that it is shut: {control} {gray}");
}

#[test]
fn strips_show_what_is_shut_off_calm_and_gray_levels_of_the_open_field() {
    let (frame, masks) = half_shut();
    let drawn = |pictures: Option<&Pictures>, masks: Option<&Masks>| {
        strip(&StripInput {
            acquired: &frame,
            pictures,
            masks,
            without: None,
            marks: None,
            standing: Standing::Refused,
            status: "",
            scores: &[],
            mm_per_px: None,
        })
    };
    // Alone: 620 × 480 px in the middle of the first two panels.
    let [calm, raw] = [Some(&masks), None].map(|masks| drawn(None, masks));
    let place = |u: usize, v: usize| (180 + 2 * u, 88 + 2 * v);
    let part = |seen: &Image<[u8; 3]>, columns: Range<usize>| {
        let ((left, top), (right, bottom)) = (place(columns.start, 50), place(columns.end, 190));
        restless_and_violet(seen, left..right, top..bottom)
    };
    let ([restless, violet], [control, _]) = (part(&calm, 175..290), part(&raw, 175..290));
    assert!(restless < 8.0 && violet > 12.0 && control > 30.0, "{restless} {violet}, control {control}");
    let (contrast, flat) = (part(&calm, 20..140)[0], part(&raw, 20..140)[0]);
    assert!(contrast > 1.5 * flat, "the open field has all grays: {contrast}, with those of all pixels {flat}");

    // Beside its DRR: four panels of 460 px, of which the first and the last show the frame.
    let simulated = line_integral(&view());
    let input = CompareInput { masks: Some(&masks), offset: OffsetRule::None, ..CompareInput::new(&frame, &simulated) };
    let compared = compare(&input).expect("comparable");
    let mut open = (*compared.pictures).clone();
    assert_eq!(open.shut_off.pixels.iter().filter(|shut| **shut).count(), 155 * 240);
    let calm = drawn(Some(&open), None);
    open.shut_off = open.shut_off.map(|_| false);
    let raw = drawn(Some(&open), None);
    let scale = 460.0 / 310.0;
    let at = |from: f64, px: f64| (from + scale * px) as usize;
    for panel in [0.0, 3.0] {
        let left = 22.0 + 476.0 * panel;
        let half =
            |seen: &Image<[u8; 3]>| restless_and_violet(seen, at(left, 175.0)..at(left, 290.0), at(88.0, 50.0)..at(88.0, 190.0));
        let ([restless, violet], [control, _]) = (half(&calm), half(&raw));
        assert!(restless < 8.0 && violet > 9.0 && control > 25.0, "panel {panel}: {restless} {violet}, control {control}");
    }
}
