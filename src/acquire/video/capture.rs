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

use crate::image::Image;

/// The program, beside this one.
const PROGRAM: &str = "sidecarm-video";

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

/// An open video.
pub(super) struct Capture {
    child: Child,
    said: BufReader<ChildStdout>,
    is_live: bool,
    is_of_differences: bool,
    per_s: f64,
    is_over: bool,
}

impl Drop for Capture {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

/// Beside this program, or in the folder above, where this one is a test.
fn program() -> std::io::Result<PathBuf> {
    let own = std::env::current_exe()?;
    let folder = own.parent().filter(|folder| folder.ends_with("deps")).unwrap_or(&own);
    Ok(folder.with_file_name(format!("{PROGRAM}{}", std::env::consts::EXE_SUFFIX)))
}

impl Capture {
    /// Opens a device (by its path or number), a file, or a stream.
    pub(super) fn open(from: &str) -> Result<Self, CaptureError> {
        let not_started = |error: std::io::Error| CaptureError::Program { detail: error.kind().to_string() };
        let mut command = Command::new(program().map_err(not_started)?);
        command.arg(from).stdin(Stdio::piped()).stdout(Stdio::piped());
        // What is less than a warning OpenCV writes to standard output, among the pictures.
        command.env("OPENCV_LOG_LEVEL", "WARNING");
        // Ctrl-C in the terminal is meant for this program.
        #[cfg(unix)]
        std::os::unix::process::CommandExt::process_group(&mut command, 0);
        let mut child = command.spawn().map_err(not_started)?;
        let out = child.stdout.take().ok_or(CaptureError::Died)?;
        let (said, is_over) = (BufReader::new(out), false);
        let mut capture = Self { child, said, is_live: false, is_of_differences: false, per_s: 0.0, is_over };
        match capture.read()? {
            [b'O'] => {
                let [is_live, is_of_differences] = capture.read()?;
                (capture.is_live, capture.is_of_differences) = (is_live != 0, is_of_differences != 0);
                capture.per_s = f64::from_le_bytes(capture.read()?);
                Ok(capture)
            }
            [b'N'] => Err(CaptureError::Open),
            _ => Err(CaptureError::Died),
        }
    }

    fn read<const N: usize>(&mut self) -> Result<[u8; N], CaptureError> {
        let mut bytes = [0; N];
        self.said.read_exact(&mut bytes).map_err(|_| CaptureError::Died)?;
        Ok(bytes)
    }

    /// Pictures come when they are made, and without end: a device, a pipe, a stream.
    pub(super) fn is_live(&self) -> bool {
        self.is_live
    }

    /// Pictures a second, as the video says.
    pub(super) fn per_s(&self) -> f64 {
        self.per_s
    }

    /// Whether its pictures are compressed as differences: a recording's may be, a device's are not.
    pub(super) fn is_of_differences(&self) -> bool {
        self.is_of_differences
    }

    /// The next picture; `None` at the end of a file, or when the device gives none.
    pub(super) fn next(&mut self) -> Result<Option<Image<u8>>, CaptureError> {
        if self.is_over {
            return Ok(None);
        }
        match self.read()? {
            [b'P'] => {
                let [width, height] = [u32::from_le_bytes(self.read()?), u32::from_le_bytes(self.read()?)];
                if [width, height].iter().any(|edge| !(1..=MOST_PX).contains(edge)) {
                    return Err(CaptureError::Size { width, height });
                }
                let [width, height] = [width, height].map(|edge| edge as usize);
                let mut pixels = vec![0; width * height];
                self.said.read_exact(&mut pixels).map_err(|_| CaptureError::Died)?;
                Ok(Image::from_pixels(width, height, pixels))
            }
            [b'C'] => Err(CaptureError::Channels { channels: i32::from_le_bytes(self.read()?) }),
            [b'E'] => {
                self.is_over = true;
                Ok(None)
            }
            _ => Err(CaptureError::Died),
        }
    }
}
