//! The console's monitor: what a capture device gives of it while it is looked at, and a recording of it. Both without a codec: grey values
//! row by row, in a YUV4MPEG2 stream through a pipe, and in an AVI file (`Y800`).

use std::fs::File;
use std::io::{BufWriter, Write};
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Duration;

use rustix::fs::{CWD, Mode, mkfifoat};

use crate::MockError;
use crate::dicom::Drawn;
use crate::script::Script;

/// Pictures a second of the monitor, and of a recording of it.
pub const PER_S: u64 = 15;
/// See [`PER_S`].
pub const RECORDED_PER_S: u64 = 10;
/// Black to the left and to the right of the radiograph.
pub const BORDER_PX: usize = 50;
/// What is black on it, and the grey values from there to the brightest pixel of the frame.
const BLACK: u8 = 8;
const DARKEST: f64 = 16.0;
const RANGE: f64 = 230.0;
/// Of a file that programs read which take no AVI with more.
const MOST_BYTES: u64 = 1 << 30;

/// A picture of the whole monitor.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Screen {
    /// Columns and rows.
    pub size_px: [usize; 2],
    /// Row by row.
    pub grey: Vec<u8>,
}

impl Screen {
    /// The size of a monitor on which frames of `size_px` are shown as they are.
    fn size_for([columns, rows]: [usize; 2]) -> [usize; 2] {
        // An even number of columns: no row of any format has bytes to fill up.
        [(columns + 2 * BORDER_PX).next_multiple_of(2), rows]
    }

    /// Without a picture.
    #[must_use]
    pub fn empty(frame_px: [usize; 2]) -> Self {
        let size_px = Self::size_for(frame_px);
        Self { size_px, grey: vec![BLACK; size_px[0] * size_px[1]] }
    }

    /// A frame: the root of its signal, the brightest pixel of it at the top of the range.
    #[must_use]
    pub fn of(values: &[u16], frame_px: [usize; 2]) -> Self {
        let mut screen = Self::empty(frame_px);
        let brightest = f64::from(values.iter().copied().max().unwrap_or(0).max(1));
        for (row, values) in values.chunks(frame_px[0].max(1)).enumerate() {
            let start = row * screen.size_px[0] + BORDER_PX;
            for (grey, value) in screen.grey[start..].iter_mut().zip(values) {
                *grey = (DARKEST + RANGE * (f64::from(*value) / brightest).sqrt()).round() as u8;
            }
        }
        screen
    }
}

/// Columns from the left, rows from the top, width and height of the radiograph in the monitor's picture.
#[must_use]
pub fn crop_px([columns, rows]: [usize; 2]) -> [usize; 4] {
    [BORDER_PX, 0, columns, rows]
}

/// A pipe that stands for a capture device.
///
/// # Errors
/// When it cannot be made.
pub fn make_pipe(path: &Path) -> Result<(), MockError> {
    let _ = std::fs::remove_file(path);
    let mode = Mode::RUSR | Mode::WUSR;
    mkfifoat(CWD, path, mode).map_err(|errno| MockError::Io { what: path.display().to_string(), source: errno.into() })
}

/// What the monitor shows, to whoever opens the pipe, until the program ends.
pub struct Monitor(Arc<Looked>);

/// A monitor as it is looked at.
struct Looked {
    shown: Mutex<Arc<Screen>>,
    /// Somebody has looked for a second: readers take some pictures to find out what they are given.
    is_seen: AtomicBool,
}

impl Monitor {
    /// Empty at first.
    #[must_use]
    pub fn on(pipe: &Path, frame_px: [usize; 2]) -> Self {
        let shown = Mutex::new(Arc::new(Screen::empty(frame_px)));
        let looked = Arc::new(Looked { shown, is_seen: AtomicBool::new(false) });
        let (own, pipe) = (Arc::clone(&looked), pipe.to_owned());
        // Waits for a reader; when one has gone, for the next.
        std::thread::spawn(move || while own.stream(&pipe).is_ok() {});
        Self(looked)
    }

    /// Shows another picture from now on.
    pub fn show(&self, screen: Screen) {
        *self.0.shown.lock().unwrap_or_else(PoisonError::into_inner) = Arc::new(screen);
    }

    /// Whether somebody has opened the pipe, and taken the pictures of a second.
    #[must_use]
    pub fn is_seen(&self) -> bool {
        self.0.is_seen.load(Ordering::Relaxed)
    }
}

impl Looked {
    fn now(&self) -> Arc<Screen> {
        Arc::clone(&self.shown.lock().unwrap_or_else(PoisonError::into_inner))
    }

    /// Gives one reader of the pipe the monitor's pictures, until it goes.
    fn stream(&self, pipe: &Path) -> std::io::Result<()> {
        let mut out = File::options().write(true).open(pipe)?;
        let [columns, rows] = self.now().size_px;
        let mut written = out.write_all(format!("YUV4MPEG2 W{columns} H{rows} F{PER_S}:1 Ip A1:1 Cmono\n").as_bytes());
        let mut pictures = 0;
        while written.is_ok() {
            pictures += 1;
            self.is_seen.fetch_or(pictures > PER_S, Ordering::Relaxed);
            let screen = self.now();
            written = out.write_all(b"FRAME\n").and_then(|()| out.write_all(&screen.grey));
            std::thread::sleep(Duration::from_millis(1000 / PER_S));
        }
        Ok(())
    }
}

/// Records what the monitor shows while the script is played, from the first packet on.
///
/// # Errors
/// When the file cannot be written, or would be larger than readers take.
pub fn record(path: &Path, script: &Script, frames: &[Drawn]) -> Result<(), MockError> {
    let Some(first) = frames.first() else {
        return Err(MockError::Data { what: "--video recording".to_owned(), detail: "there is no exposure".to_owned() });
    };
    let frame_px = first.tags.size_px;
    let empty = Screen::empty(frame_px);
    let count = (script.end_s() * RECORDED_PER_S as f64).ceil() as u64;
    let bytes = count * empty.grey.len() as u64;
    if bytes > MOST_BYTES {
        let detail = format!("{count} pictures are {bytes} bytes, expected at most {MOST_BYTES}: shorten --duration-s");
        return Err(MockError::Data { what: "--video recording".to_owned(), detail });
    }
    let screens: Vec<Screen> = frames.iter().map(|frame| Screen::of(&frame.values, frame_px)).collect();
    let shown = |number: u64| {
        let at_s = number as f64 / RECORDED_PER_S as f64;
        let last = (0..frames.len()).rfind(|index| script.frame_s(*index) <= at_s);
        last.map_or(&empty, |index| &screens[index])
    };
    let written = File::create(path).and_then(|file| {
        let mut out = BufWriter::new(file);
        write_avi(&mut out, empty.size_px, count as u32, |number| shown(number.into()).grey.as_slice())?;
        out.flush()
    });
    written.map_err(MockError::io(path.display()))
}

/// An AVI file of `count` pictures of grey values (RIFF; `avih`, `strh` and a `BITMAPINFOHEADER` as Microsoft has them), with its index. Pictures
/// have an even number of bytes.
fn write_avi<'a>(
    out: &mut impl Write,
    [columns, rows]: [usize; 2],
    count: u32,
    picture: impl Fn(u32) -> &'a [u8],
) -> std::io::Result<()> {
    const HAS_INDEX: u32 = 0x10;
    const KEY_FRAME: u32 = 0x10;
    let chunk = |name: &[u8; 4], body: &[u8]| [&name[..], &(body.len() as u32).to_le_bytes(), body].concat();
    let words = |values: &[u32]| -> Vec<u8> { values.iter().flat_map(|value| value.to_le_bytes()).collect() };
    let (width, height, size, per_s) = (columns as u32, rows as u32, (columns * rows) as u32, RECORDED_PER_S as u32);
    let main = words(&[1_000_000 / per_s, size * per_s, 0, HAS_INDEX, count, 0, 1, size, width, height, 0, 0, 0, 0]);
    let head = words(&[0, 0, 0, 1, per_s, 0, count, size, u32::MAX, 0]);
    // The rectangle in which it is shown: four halves of words.
    let place = words(&[0, width | (height << 16)]);
    let bitmap = [words(&[40, width, height, 1 | (8 << 16)]), b"Y800".to_vec(), words(&[size, 0, 0, 0, 0])].concat();
    let stream = [chunk(b"strh", &[&b"vidsY800"[..], &head, &place].concat()), chunk(b"strf", &bitmap)].concat();
    let streams = chunk(b"LIST", &[&b"strl"[..], &stream].concat());
    let heads = chunk(b"LIST", &[&b"hdrl"[..], &chunk(b"avih", &main), &streams].concat());
    let movie_bytes = 4 + count * (8 + size);
    out.write_all(&[&b"RIFF"[..], &words(&[4 + heads.len() as u32 + 8 + movie_bytes + 8 + 16 * count])].concat())?;
    out.write_all(&[&b"AVI "[..], &heads, b"LIST", &words(&[movie_bytes]), b"movi"].concat())?;
    for number in 0..count {
        out.write_all(&[&b"00db"[..], &words(&[size])].concat())?;
        out.write_all(picture(number))?;
    }
    out.write_all(&[&b"idx1"[..], &words(&[16 * count])].concat())?;
    for number in 0..count {
        // Counted from the word `movi`.
        out.write_all(&[&b"00db"[..], &words(&[KEY_FRAME, 4 + number * (8 + size), size])].concat())?;
    }
    Ok(())
}

/// Where the pipe, or the recording, lies in the kit's folder.
#[must_use]
pub fn file_in(folder: &Path, is_recording: bool) -> PathBuf {
    folder.join(if is_recording { "monitor.avi" } else { "monitor.y4m" })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_frame_stands_in_the_middle_of_its_screen_and_its_brightest_pixel_is_bright() {
        let screen = Screen::of(&[0, 100, 400, 25, 4, 0], [3, 2]);
        assert_eq!((screen.size_px, screen.grey.len()), ([104, 2], 208));
        let row = |at: usize| &screen.grey[at * 104 + BORDER_PX - 1..][..5];
        assert_eq!(row(0), [8, 16, 131, 246, 8]);
        assert_eq!(row(1), [8, 74, 39, 16, 8]);
        assert_eq!(crop_px([3, 2]), [50, 0, 3, 2]);
    }

    #[test]
    fn whoever_opens_the_pipe_sees_what_is_shown() {
        use std::io::Read;
        let pipe = std::env::temp_dir().join(format!("mock-lab-{}-monitor.y4m", std::process::id()));
        make_pipe(&pipe).expect("a pipe");
        let monitor = Monitor::on(&pipe, [4, 2]);
        assert!(!monitor.is_seen());
        let mut reader = File::open(&pipe).expect("the monitor is there");
        let mut read = |count: usize| {
            let mut bytes = vec![0; count];
            reader.read_exact(&mut bytes).expect("pictures come");
            bytes
        };
        let head = format!("YUV4MPEG2 W104 H2 F{PER_S}:1 Ip A1:1 Cmono\n").into_bytes();
        assert_eq!(read(head.len()), head);
        let frame = |grey: &[u8]| [&b"FRAME\n"[..], grey].concat();
        assert_eq!(read(6 + 208), frame(&[BLACK; 208]));
        let screen = Screen::of(&[400; 8], [4, 2]);
        monitor.show(screen.clone());
        // Pictures that were on their way come first.
        let seen: Vec<Vec<u8>> = (0..20).map(|_| read(6 + 208)).collect();
        assert_eq!(seen.last(), Some(&frame(&screen.grey)));
        assert!(seen.iter().all(|picture| *picture == frame(&screen.grey) || *picture == frame(&[BLACK; 208])));
        assert!(monitor.is_seen(), "for a second");
        std::fs::remove_file(pipe).expect("removed");
    }

    #[test]
    fn a_recording_is_as_long_as_its_chunks_say_and_its_index_points_at_its_pictures() {
        let pictures = [[1u8; 8], [2; 8], [3; 8]];
        let mut bytes = Vec::new();
        write_avi(&mut bytes, [4, 2], 3, |number| &pictures[number as usize]).expect("written");
        let word = |at: usize| u32::from_le_bytes(bytes[at..at + 4].try_into().expect("four bytes")) as usize;
        let find = |name: &[u8]| bytes.windows(4).position(|window| window == name).expect("there");
        assert_eq!((word(4), &bytes[8..12]), (bytes.len() - 8, &b"AVI "[..]));
        let movie = find(b"movi");
        assert_eq!(word(movie - 4), 4 + 3 * 16);
        let index = find(b"idx1");
        assert_eq!((index, word(index + 4), bytes.len()), (movie + 4 + 3 * 16, 3 * 16, index + 8 + 3 * 16));
        for (number, picture) in pictures.iter().enumerate() {
            let entry = index + 8 + 16 * number;
            let at = movie + word(entry + 8);
            assert_eq!((&bytes[at..at + 4], word(at + 4), word(entry + 12)), (&b"00db"[..], 8, 8));
            assert_eq!(&bytes[at + 8..at + 16], picture);
        }
        // The heads lie one in the other, and end where the pictures begin.
        assert_eq!(20 + word(16), find(b"movi") - 8);
        let format = find(b"strf");
        assert_eq!((word(format + 4), word(format + 12), word(format + 16), word(format + 20)), (40, 4, 2, 1 | (8 << 16)));
        assert_eq!(&bytes[format + 24..format + 28], b"Y800");
    }
}
