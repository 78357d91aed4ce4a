//! A video of pictures, as Motion-JPEG in AVI, which everything plays.

use std::path::Path;

use opencv::core::{CV_8UC3, Mat, MatTraitManual, Scalar, Size, Vec3b};
use opencv::videoio::{CAP_OPENCV_MJPEG, VideoWriter, VideoWriterTrait, VideoWriterTraitConst};

use super::Image;

/// Writes pictures one after the other; those of another size than the first stand in its upper left corner, cut where they are larger.
pub struct VideoFile {
    writer: VideoWriter,
    canvas: Mat,
    size: [usize; 2],
}

impl VideoFile {
    /// Begins a video of `per_s` pictures of `size` (columns, rows) a second at `path`, which is written as it goes.
    ///
    /// # Errors
    /// One sentence, when it cannot be written.
    pub fn create(path: &Path, size: [usize; 2], per_s: f64) -> Result<Self, String> {
        let failed = |_| "it cannot be written as a video".to_owned();
        let fourcc = VideoWriter::fourcc('M', 'J', 'P', 'G').map_err(failed)?;
        let [columns, rows] = size.map(|n| i32::try_from(n).unwrap_or(i32::MAX));
        let name = path.to_str().ok_or("its name is not UTF-8")?;
        // OpenCV's own writer: the same file wherever it is made.
        let backend = CAP_OPENCV_MJPEG;
        let writer =
            VideoWriter::new_with_backend(name, backend, fourcc, per_s, Size::new(columns, rows), true).map_err(failed)?;
        if !writer.is_opened().unwrap_or(false) {
            return Err("it cannot be written as a video; is the folder there, and writable?".to_owned());
        }
        let canvas = Mat::new_rows_cols_with_default(rows, columns, CV_8UC3, Scalar::all(0.0)).map_err(failed)?;
        Ok(Self { writer, canvas, size })
    }

    /// Adds a picture, `times` over.
    ///
    /// # Errors
    /// One sentence, when it cannot be written.
    pub fn add(&mut self, picture: &Image<[u8; 3]>, times: u32) -> Result<(), String> {
        let failed = |_| "a picture of it cannot be written".to_owned();
        let [columns, _] = self.size;
        let pixels = self.canvas.data_typed_mut::<Vec3b>().map_err(failed)?;
        for (index, pixel) in pixels.iter_mut().enumerate() {
            let (column, row) = (index % columns, index / columns);
            let inside = column < picture.width && row < picture.height;
            let [red, green, blue] = if inside { *picture.at(column, row) } else { [0; 3] };
            *pixel = Vec3b::from([blue, green, red]);
        }
        (0..times).try_for_each(|_| self.writer.write(&self.canvas).map_err(failed))
    }

    /// Closes the file.
    ///
    /// # Errors
    /// One sentence, when it cannot be written.
    pub fn finish(mut self) -> Result<(), String> {
        self.writer.release().map_err(|_| "it cannot be closed".to_owned())
    }
}
