//! Pictures of a video, one after the other, in grey: those that the program `sidecarm-video` reads.
//!
//! It is started with what is to be opened, and writes to its standard output, little-endian:
//!
//! | letter | what follows | meaning |
//! |---|---|---|
//! | `N` | nothing | it cannot be opened |
//! | `O` | live, of differences (a byte each), pictures a second (f64) | it is open |
//! | `P` | columns, rows (u32), a byte for each pixel | a picture |
//! | `C` | channels (i32) | its pictures are neither grey nor in colour |
//! | `E` | nothing | the end of a recording, or of what a device gives |

use std::io::{BufReader, Read};
use std::path::PathBuf;
use std::process::{Child, ChildStdout, Command, Stdio};
use std::sync::mpsc::{Receiver, RecvTimeoutError, channel};
use std::time::Duration;

use crate::image::Image;
use crate::time::Stopwatch;

/// The program, beside this one.
const PROGRAM: &str = "sidecarm-video";

/// One that was killed has ended by then, unless its driver has it.
const KILLED_MS: f64 = 1000.0;

/// No picture has more columns or rows.
const MOST_PX: u32 = 16_384;

/// Why there is no video.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub(super) enum CaptureError {
    /// The program that reads it is not there, or does not start.
    #[error(
        "the program sidecarm-video, which reads video, cannot be started ({detail}): it belongs beside sidecarm, `cargo build` makes it \
         where OpenCV is"
    )]
    Program {
        /// Why.
        detail: String,
    },
    /// It ended in the middle.
    #[error("the program sidecarm-video, which reads it, has ended in the middle of it")]
    Died,
    /// Pictures that no device gives.
    #[error("its pictures have {width} x {height} pixels, expected 1 to 16384 each way")]
    Size {
        /// Columns.
        width: u32,
        /// Rows.
        height: u32,
    },
    /// Neither open nor refused after so long.
    #[error("it has not opened within {limit_s} s: its driver hangs, or who would send it does not answer")]
    Late {
        /// How long was waited.
        limit_s: u64,
    },
    /// Nothing opens it.
    #[error(
        "it cannot be opened as a video: check that it is there, that no other program has it, and that its format is known to OpenCV"
    )]
    Open,
    /// Pictures that are none.
    #[error("its pictures have {channels} channels, expected grey or colour of 8 bits")]
    Channels {
        /// As found.
        channels: i32,
    },
}

/// The program that reads it; it ends with this.
struct Reader(Child);

impl Drop for Reader {
    fn drop(&mut self) {
        let _ = self.0.kill();
        let watch = Stopwatch::start();
        // In a call of its driver that nothing ends: nobody waits for that.
        while matches!(self.0.try_wait(), Ok(None)) && watch.ms() < KILLED_MS {
            std::thread::sleep(Duration::from_millis(1));
        }
    }
}

/// A video that is being opened, which may take long, or for ever.
pub(super) struct Opening {
    reader: Option<Reader>,
    opened: Receiver<Result<Opened, CaptureError>>,
}

/// What is said of an open video, and where its pictures come from.
struct Opened {
    said: Said,
    is_live: bool,
    is_of_differences: bool,
    per_s: f64,
}

/// An open video.
pub(super) struct Capture {
    /// Held: its pictures end with it.
    _reader: Reader,
    opened: Opened,
    is_over: bool,
}

/// What the program says.
struct Said(BufReader<ChildStdout>);

impl Said {
    fn read<const N: usize>(&mut self) -> Result<[u8; N], CaptureError> {
        let mut bytes = [0; N];
        self.fill(&mut bytes)?;
        Ok(bytes)
    }

    fn fill(&mut self, bytes: &mut [u8]) -> Result<(), CaptureError> {
        self.0.read_exact(bytes).map_err(|_| CaptureError::Died)
    }

    /// That it is open; waits for it.
    fn opened(mut self) -> Result<Opened, CaptureError> {
        match self.read()? {
            [b'O'] => {
                let [is_live, is_of_differences] = self.read::<2>()?.map(|byte| byte != 0);
                let per_s = f64::from_le_bytes(self.read()?);
                Ok(Opened { said: self, is_live, is_of_differences, per_s })
            }
            [b'N'] => Err(CaptureError::Open),
            _ => Err(CaptureError::Died),
        }
    }
}

/// Beside this program, or in the folder above, where this one is a test.
fn program() -> std::io::Result<PathBuf> {
    let own = std::env::current_exe()?;
    let folder = own.parent().filter(|folder| folder.ends_with("deps")).unwrap_or(&own);
    Ok(folder.with_file_name(format!("{PROGRAM}{}", std::env::consts::EXE_SUFFIX)))
}

impl Opening {
    /// Begins to open a device (by its path or number), a file, or a stream.
    ///
    /// # Errors
    /// When the program that reads it does not start.
    pub(super) fn of(from: &str) -> Result<Self, CaptureError> {
        let not_started = |error: std::io::Error| CaptureError::Program { detail: error.kind().to_string() };
        let mut command = Command::new(program().map_err(not_started)?);
        command.arg(from).stdin(Stdio::piped()).stdout(Stdio::piped());
        // What is less than a warning OpenCV writes to standard output, which only Unix lets the program keep for pictures.
        #[cfg(not(unix))]
        command.env("OPENCV_LOG_LEVEL", "WARNING");
        // Ctrl-C in the terminal is meant for this program.
        #[cfg(unix)]
        std::os::unix::process::CommandExt::process_group(&mut command, 0);
        let mut reader = Reader(command.spawn().map_err(not_started)?);
        let out = reader.0.stdout.take().ok_or(CaptureError::Died)?;
        let (sender, opened) = channel();
        // Ends with the program at the latest.
        std::thread::spawn(move || sender.send(Said(BufReader::new(out)).opened()));
        Ok(Self { reader: Some(reader), opened })
    }

    /// Waits for it, at most so long; `None` when it is not open by then.
    ///
    /// # Errors
    /// When it cannot be opened.
    pub(super) fn wait(&mut self, limit: Duration) -> Result<Option<Capture>, CaptureError> {
        match self.opened.recv_timeout(limit) {
            Ok(opened) => {
                let (opened, reader) = (opened?, self.reader.take().ok_or(CaptureError::Died)?);
                Ok(Some(Capture { _reader: reader, opened, is_over: false }))
            }
            Err(RecvTimeoutError::Timeout) => Ok(None),
            Err(RecvTimeoutError::Disconnected) => Err(CaptureError::Died),
        }
    }
}

impl Capture {
    /// Pictures come when they are made, and without end: a device, a pipe, a stream.
    pub(super) fn is_live(&self) -> bool {
        self.opened.is_live
    }

    /// Pictures a second, as the video says.
    pub(super) fn per_s(&self) -> f64 {
        self.opened.per_s
    }

    /// Whether its pictures are compressed as differences: a recording's may be, a device's are not.
    pub(super) fn is_of_differences(&self) -> bool {
        self.opened.is_of_differences
    }

    /// The next picture; `None` at the end of a file, or when the device gives none.
    pub(super) fn next(&mut self) -> Result<Option<Image<u8>>, CaptureError> {
        if self.is_over {
            return Ok(None);
        }
        let said = &mut self.opened.said;
        match said.read()? {
            [b'P'] => {
                let [width, height] = [u32::from_le_bytes(said.read()?), u32::from_le_bytes(said.read()?)];
                if [width, height].iter().any(|edge| !(1..=MOST_PX).contains(edge)) {
                    return Err(CaptureError::Size { width, height });
                }
                let [width, height] = [width, height].map(|edge| edge as usize);
                let mut pixels = vec![0; width * height];
                said.fill(&mut pixels)?;
                Ok(Image::from_pixels(width, height, pixels))
            }
            [b'C'] => Err(CaptureError::Channels { channels: i32::from_le_bytes(said.read()?) }),
            [b'E'] => {
                self.is_over = true;
                Ok(None)
            }
            _ => Err(CaptureError::Died),
        }
    }
}
