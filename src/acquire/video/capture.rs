//! Pictures of a video, one after the other, in grey.

#[cfg(feature = "vision")]
pub(super) use with_opencv::Capture;
#[cfg(not(feature = "vision"))]
pub(super) use without::Capture;

/// Why there is no video.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub(super) enum CaptureError {
    /// This build has no OpenCV.
    #[cfg(not(feature = "vision"))]
    #[error("this build cannot read video: build it with the feature `vision` (OpenCV)")]
    NoVision,
    /// Nothing opens it.
    #[cfg(feature = "vision")]
    #[error(
        "it cannot be opened as a video: check that it is there, that no other program has it, and that its format is known to OpenCV"
    )]
    Open,
    /// Pictures that are none.
    #[cfg(feature = "vision")]
    #[error("its pictures have {channels} channels, expected grey or colour of 8 bits")]
    Channels {
        /// As found.
        channels: i32,
    },
}

#[cfg(feature = "vision")]
mod with_opencv {
    use opencv::core::{Mat, MatTraitConst, MatTraitConstManual, Vec3b};
    use opencv::videoio::{
        CAP_ANY, CAP_PROP_FOURCC, CAP_PROP_FPS, CAP_V4L2, VideoCapture, VideoCaptureTrait, VideoCaptureTraitConst,
    };

    use super::CaptureError;
    use crate::image::Image;

    /// Pictures a second of a recording that does not say it.
    const USUAL_PER_S: f64 = 25.0;

    /// Recordings whose pictures are told as differences from others, by the first letters of their four.
    const OF_DIFFERENCES: [&str; 13] =
        ["h26", "x26", "avc", "hev", "hvc", "mp4", "fmp4", "xvi", "div", "dx5", "mpg", "vp", "av0"];

    /// An open video.
    pub(in super::super) struct Capture {
        video: VideoCapture,
        picture: Mat,
        is_live: bool,
        per_s: f64,
    }

    impl Capture {
        /// Opens a device (by its path or number), a file, or a stream.
        pub(in super::super) fn open(from: &str) -> Result<Self, CaptureError> {
            let path = if from.bytes().all(|byte| byte.is_ascii_digit()) { format!("/dev/video{from}") } else { from.to_owned() };
            let backend = if path.starts_with("/dev/video") && cfg!(target_os = "linux") { CAP_V4L2 } else { CAP_ANY };
            let is_live = !std::path::Path::new(&path).is_file();
            let video = VideoCapture::from_file(&path, backend).map_err(|_| CaptureError::Open)?;
            if !video.is_opened().unwrap_or(false) {
                return Err(CaptureError::Open);
            }
            let per_s = video.get(CAP_PROP_FPS).ok().filter(|per_s| (1.0..=1000.0).contains(per_s)).unwrap_or(USUAL_PER_S);
            Ok(Self { video, picture: Mat::default(), is_live, per_s })
        }

        /// Pictures come when they are made, and without end: a device, a pipe, a stream.
        pub(in super::super) fn is_live(&self) -> bool {
            self.is_live
        }

        /// Pictures a second, as the video says.
        pub(in super::super) fn per_s(&self) -> f64 {
            self.per_s
        }

        /// Whether its pictures are compressed as differences: a recording's may be, a device's are not.
        pub(in super::super) fn is_of_differences(&self) -> bool {
            let code = self.video.get(CAP_PROP_FOURCC).unwrap_or(0.0) as u32;
            let letters = String::from_utf8_lossy(&code.to_le_bytes()).to_ascii_lowercase();
            !self.is_live && OF_DIFFERENCES.iter().any(|start| letters.starts_with(start))
        }

        /// The next picture; `None` at the end of a file, or when the device gives none.
        pub(in super::super) fn next(&mut self) -> Result<Option<Image<u8>>, CaptureError> {
            if !self.video.read(&mut self.picture).unwrap_or(false) || self.picture.empty() {
                return Ok(None);
            }
            let channels = self.picture.channels();
            let wrong = CaptureError::Channels { channels };
            let [width, height] = [self.picture.cols(), self.picture.rows()].map(|n| n.unsigned_abs() as usize);
            let pixels = match channels {
                1 => self.picture.data_typed::<u8>().map_err(|_| wrong.clone())?.to_vec(),
                3 => self.picture.data_typed::<Vec3b>().map_err(|_| wrong.clone())?.iter().map(grey).collect(),
                _ => return Err(wrong),
            };
            Image::from_pixels(width, height, pixels).map(Some).ok_or(wrong)
        }
    }

    /// Luma of blue, green and red (ITU-R BT.601), exact where all three are alike.
    fn grey(colour: &Vec3b) -> u8 {
        let [blue, green, red] = colour.0.map(u32::from);
        ((29 * blue + 150 * green + 77 * red + 128) >> 8) as u8
    }
}

#[cfg(not(feature = "vision"))]
mod without {
    use super::CaptureError;
    use crate::image::Image;

    /// Never there.
    pub(in super::super) enum Capture {}

    impl Capture {
        pub(in super::super) fn open(_from: &str) -> Result<Self, CaptureError> {
            Err(CaptureError::NoVision)
        }

        pub(in super::super) fn is_live(&self) -> bool {
            match *self {}
        }

        pub(in super::super) fn per_s(&self) -> f64 {
            match *self {}
        }

        pub(in super::super) fn is_of_differences(&self) -> bool {
            match *self {}
        }

        pub(in super::super) fn next(&mut self) -> Result<Option<Image<u8>>, CaptureError> {
            match *self {}
        }
    }
}
