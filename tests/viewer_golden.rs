//! What the window looks like as a whole: pictures of it that somebody has looked at, in `tests/data/window`, as means over cells of 5 × 5
//! pixels.
//!
//! Another version of software Vulkan, or another processor, smooths edges otherwise: by some levels in a pixel, by a few in a cell. A word, a
//! mark or a colour that is another one changes several cells by more. Where that is meant, the pictures are made anew, as those of
//! egui_kittest are: [`HOW`].
#![cfg(feature = "viewer")]

use std::path::{Path, PathBuf};
use std::sync::Arc;

use image::ImageEncoder as _;
use image::codecs::png::{CompressionType, FilterType, PngEncoder};
use sidecarm::image::{Image, read_png_rgb, write_png_rgb};
use sidecarm::session::board::BoardState;
use sidecarm::viewer::Mark;

use crate::viewer_boards::{accepted, amber, board, refused};
use crate::viewer_drawn::Drawn;

/// Makes the pictures that are missing, or other ones by now.
const HOW: &str = "UPDATE_SNAPSHOTS=1 cargo test --test main viewer_golden -- --nocapture";

/// Pixels each way.
const CELL_PX: usize = 5;
/// By how much a cell may differ in any colour, of 255: twice a change by 6 levels in each of its pixels.
const LIMIT: f64 = 12.0;
/// Cells that may differ by more: two digits that are others are three.
const MOST_CELLS: usize = 2;
/// Cells are kept to so many levels, for files that are small …
const STEP: f64 = 4.0;
/// … namely no larger than this.
const MOST_BYTES: usize = 60_000;

/// What the window is shown in, and the name of the picture of it. The newest exposure is the one that is seen.
type State = (&'static str, fn() -> BoardState);

const STATES: [State; 4] = [
    ("live", || board(vec![refused(1), amber(2), accepted(3), accepted(4)])),
    ("replay", || BoardState { replayed: true, finished: true, ..board(vec![accepted(1), amber(2), accepted(3)]) }),
    ("amber", || board(vec![accepted(1), refused(2), amber(3)])),
    ("refused", || board(vec![accepted(1), amber(2), refused(3)])),
];

fn golden(name: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/data/window").join(format!("{name}.png"))
}

fn is_updating() -> bool {
    std::env::var("UPDATE_SNAPSHOTS").is_ok_and(|word| ["1", "true", "force"].contains(&word.as_str()))
}

/// Means over cells.
fn cells(seen: &Image<[u8; 3]>) -> Image<[f64; 3]> {
    let (width, height) = (seen.width / CELL_PX, seen.height / CELL_PX);
    let mean = |cell: usize| {
        let (left, top) = (CELL_PX * (cell % width), CELL_PX * (cell / width));
        let mut sums = [0.0; 3];
        for (row, column) in (top..top + CELL_PX).flat_map(|row| (left..left + CELL_PX).map(move |column| (row, column))) {
            sums.iter_mut().zip(seen.at(column, row)).for_each(|(sum, level)| *sum += f64::from(*level));
        }
        sums.map(|sum| sum / (CELL_PX * CELL_PX) as f64)
    };
    Image { width, height, pixels: (0..width * height).map(mean).collect() }
}

/// As cells are kept.
fn kept(cells: &Image<[f64; 3]>) -> Image<[u8; 3]> {
    let level = |mean: f64| ((mean / STEP).round() * STEP).min(255.0) as u8;
    cells.map(|means| means.map(level))
}

/// Where the window is another one, in pixels of it.
fn others(found: &Image<[f64; 3]>, golden: &Image<[u8; 3]>) -> Vec<[usize; 2]> {
    let is_other = |(means, levels): (&[f64; 3], &[u8; 3])| {
        means.iter().zip(levels).any(|(mean, level)| (mean - f64::from(*level)).abs() > LIMIT)
    };
    let at = |cell: usize| [CELL_PX * (cell % found.width), CELL_PX * (cell / found.width)];
    let pairs = found.pixels.iter().zip(&golden.pixels).enumerate();
    pairs.filter(|(_, pair)| is_other(*pair)).map(|(cell, _)| at(cell)).collect()
}

fn write(path: &Path, picture: &Image<[u8; 3]>) {
    let (levels, mut bytes) = (picture.pixels.concat(), Vec::<u8>::new());
    let encoder = PngEncoder::new_with_quality(&mut bytes, CompressionType::Best, FilterType::NoFilter);
    let (width, height) = (picture.width as u32, picture.height as u32);
    encoder.write_image(&levels, width, height, image::ExtendedColorType::Rgb8).expect("encoded");
    assert!(bytes.len() <= MOST_BYTES, "{}: {} bytes", path.display(), bytes.len());
    std::fs::create_dir_all(path.parent().expect("a folder")).expect("a folder");
    std::fs::write(path, bytes).expect("written");
}

/// Why the window is not as it was, and what to do.
fn complaint(name: &str, seen: &Image<[u8; 3]>) -> Option<String> {
    let (path, found) = (golden(name), cells(seen));
    let before = path.exists().then(|| read_png_rgb(&path).expect("a picture"));
    let differ = before.as_ref().map(|before| match before.same_size(&found) {
        true => others(&found, before),
        false => vec![[0, 0]; found.pixels.len()],
    });
    if differ.as_ref().is_some_and(|differ| differ.len() <= MOST_CELLS) {
        return None;
    }
    if is_updating() {
        write(&path, &kept(&found));
        println!("made, to be looked at: {}", path.display());
        return None;
    }
    let Some(differ) = differ else {
        return Some(format!("{name}.png is missing in tests/data/window: `{HOW}` makes it; look at it before you keep it"));
    };
    let own = Path::new(env!("CARGO_TARGET_TMPDIR")).join(format!("window-{name}.png"));
    write_png_rgb(&own, seen).expect("written");
    let (cells, [column, row], own) = (differ.len(), differ[0], own.display());
    Some(format!(
        "{name}: {cells} of {} cells are others, the first around pixel ({column}, {row}), {MOST_CELLS} may be; the window as it is: {own}; if \
         that is meant, `{HOW}`",
        found.pixels.len()
    ))
}

/// A window that nobody has looked at before.
fn picture(shown: &BoardState) -> Option<Image<[u8; 3]>> {
    Some(Drawn::open()?.picture(shown))
}

#[test]
fn the_window_is_as_somebody_has_seen_and_kept_it() {
    let mut complaints = Vec::new();
    for (name, state) in STATES {
        let Some(seen) = picture(&state()) else { return };
        complaints.extend(complaint(name, &seen));
    }
    assert!(complaints.is_empty(), "{}", complaints.join("\n"));
}

/// The control: pictures are told from each other, and the same window drawn again is the same.
#[test]
fn another_state_a_mark_less_and_other_words_are_other_pictures() {
    let [(_, live), rest @ ..] = STATES;
    let Some(mut drawn) = Drawn::open() else { return };
    let before = kept(&cells(&drawn.picture(&live())));
    let differ = |seen: &Image<[u8; 3]>| others(&cells(seen), &before).len();
    let again = picture(&live()).expect("it was there");
    assert_eq!(differ(&again), 0, "the same window");
    for (name, state) in rest {
        let cells = differ(&picture(&state()).expect("it was there"));
        assert!(cells > 100, "{name}: {cells} cells");
    }
    drawn.state.toggle(Mark::Residuals);
    let cells = differ(&drawn.picture(&live()));
    assert!(cells > MOST_CELLS, "without the arrows of residuals: {cells} cells");
    // Another number where the residual stands.
    let mut view = accepted(4);
    let mut pose = (*view.pose).clone();
    pose.rms_px = Some(13.88);
    (Arc::make_mut(&mut view.pair).rms_px, view.pose) = (Some(13.88), Arc::new(pose));
    let cells = differ(&picture(&board(vec![refused(1), amber(2), accepted(3), view])).expect("it was there"));
    assert!(cells > MOST_CELLS, "another residual: {cells} cells");
}
