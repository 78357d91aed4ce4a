//! Cameras in the words of other tools: one text in, one camera out, and back.
//!
//! Ours: `camera_from_lps` maps patient millimetres (`lps`) to the focal spot's frame (+z to the detector, +x to increasing column, +y
//! to increasing row); K maps that to pixels, the centre of the first pixel is (0, 0). What differs is converted here and nowhere else:
//!
//! | format | patient axes | camera axes | centre of the first pixel | keeps |
//! |---|---|---|---|---|
//! | `matrix` | lps | – (P = K [R\|t], any positive scale) | (0, 0) | K, pose |
//! | `kr` | lps | ours | (0, 0) | K, pose |
//! | `kr-json` | lps | ours | (0, 0) | all |
//! | `opencv` | lps | ours | (0, 0) | all |
//! | `rtk` | lps, as ITK reads the volume | +y up, +z to the source; detector in mm, v upwards | in mm: (−(c−1)/2 · p, +(r−1)/2 · p) | K, pose; needs pitch and size |
//! | `deepdrr` | ras (`--axes lps` for volumes loaded as LPS) | ours | (½, ½) | all |
//! | `xreg` | lps | three, named in the file; two of them see the picture mirrored | (0, 0) | all |
//! | `slicer` | lps, as every ITK file | ours | – | pose only |
//!
//! No input or output: text comes in, text goes out.

mod deepdrr;
mod error;
mod json;
mod matrix;
mod numbers;
mod opencv;
mod recognise;
mod rtk;
mod slicer;
mod xreg;
mod yaml;

use std::str::FromStr;

use glam::DQuat;

use super::{Intrinsics, Projection, Rigid};
pub use error::FormatError;
pub use recognise::recognise;
pub use rtk::RtkParameters;
pub use xreg::XregFrame;

/// How a camera is written.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Format {
    /// P, three rows of four numbers.
    Matrix,
    /// K, three rows of three numbers, then \[R|t\], three rows of four.
    Kr,
    /// The same as JSON.
    KrJson,
    /// `cv::FileStorage`, YAML.
    OpenCv,
    /// `rtk::ThreeDCircularProjectionGeometry`, XML.
    Rtk,
    /// The configuration of DeepDRR's `CameraProjection`, JSON.
    DeepDrr,
    /// The datasets of xReg's `cam-model` group, JSON; written in this frame.
    Xreg(XregFrame),
    /// An ITK transform in text, as 3D Slicer reads it.
    Slicer,
}

impl Format {
    /// All, in the order of the module's table.
    pub const ALL: [Self; 10] = [
        Self::Matrix,
        Self::Kr,
        Self::KrJson,
        Self::OpenCv,
        Self::Rtk,
        Self::DeepDrr,
        Self::Xreg(XregFrame::DetectorPositiveZ),
        Self::Xreg(XregFrame::DetectorNegativeZ),
        Self::Xreg(XregFrame::OriginOnDetector),
        Self::Slicer,
    ];

    /// As typed on a command line.
    #[must_use]
    pub fn name(self) -> &'static str {
        match self {
            Self::Matrix => "matrix",
            Self::Kr => "kr",
            Self::KrJson => "kr-json",
            Self::OpenCv => "opencv",
            Self::Rtk => "rtk",
            Self::DeepDrr => "deepdrr",
            Self::Xreg(XregFrame::DetectorPositiveZ) => "xreg",
            Self::Xreg(XregFrame::DetectorNegativeZ) => "xreg-neg-z",
            Self::Xreg(XregFrame::OriginOnDetector) => "xreg-on-detector",
            Self::Slicer => "slicer",
        }
    }

    /// The patient axes that the tool itself uses.
    #[must_use]
    pub fn usual_axes(self) -> PatientAxes {
        match self {
            Self::DeepDrr => PatientAxes::Ras,
            _ => PatientAxes::Lps,
        }
    }

    /// What a reader of the written file cannot know from it, in one sentence; `None` when everything is kept.
    #[must_use]
    pub fn loses(self) -> Option<&'static str> {
        match self {
            Self::Matrix | Self::Kr => {
                Some("image size and pixel pitch are not in the file: give --intrinsics K.json to read it back whole")
            }
            Self::Rtk => Some("image size and pixel pitch are not in the file: --intrinsics K.json is needed to read it back"),
            Self::Slicer => {
                Some("K, image size and pixel pitch are not in the file: --intrinsics K.json is needed to read it back")
            }
            Self::KrJson | Self::OpenCv | Self::DeepDrr | Self::Xreg(_) => None,
        }
    }

    /// Frames, units and the pixel's centre, in one sentence.
    #[must_use]
    pub fn convention(self) -> &'static str {
        match self {
            Self::Matrix => {
                "P maps patient mm to pixels (column, row), third coordinate the depth in mm, first pixel's centre (0, 0)"
            }
            Self::Kr | Self::KrJson => {
                "K in px, [R|t] maps patient mm to the camera (+z to the detector, +x along columns, +y along rows), first pixel's centre (0, 0)"
            }
            Self::OpenCv => {
                "rvec, tvec map patient mm to OpenCV's camera, which is ours; first pixel's centre (0, 0), no distortion"
            }
            Self::Rtk => {
                "mm about the volume's origin in ITK's (lps) coordinates; give the projection image the direction (1, 0; 0, -1) and the origin \
                 (-(columns-1)/2 * pitch, +(rows-1)/2 * pitch), since RTK's v points up and rows run down"
            }
            Self::DeepDrr => {
                "world is RAS unless --axes lps; camera3d is our camera; DeepDRR's first pixel has its centre at (0.5, 0.5)"
            }
            Self::Xreg(XregFrame::DetectorPositiveZ) => {
                "extrinsic maps lps mm to a camera with +z to the detector, which is ours; first pixel's centre (0, 0)"
            }
            Self::Xreg(_) => {
                "this xReg frame has +z to the source and sees the picture mirrored against ours: columns run the other way, flip the frame left-right"
            }
            Self::Slicer => {
                "ITK stores the transform from parent: patient (lps) to camera mm; applied in 3D Slicer it carries a model drawn in camera axes into the patient"
            }
        }
    }
}

impl std::fmt::Display for Format {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str(self.name())
    }
}

impl FromStr for Format {
    type Err = String;

    fn from_str(word: &str) -> Result<Self, String> {
        let known = || Self::ALL.map(Self::name).join(", ");
        Self::ALL.into_iter().find(|format| format.name() == word).ok_or_else(|| format!("expected one of {}", known()))
    }
}

/// The axes of a file's patient coordinates.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum PatientAxes {
    /// +x left, +y posterior, +z superior: DICOM, ITK.
    Lps,
    /// +x right, +y anterior, +z superior: NIfTI, the scene of 3D Slicer.
    Ras,
}

impl PatientAxes {
    /// From `lps` to these axes; its own inverse.
    fn rotation_from_lps(self) -> Rigid {
        match self {
            Self::Lps => Rigid::IDENTITY,
            Self::Ras => Rigid::rotation(DQuat::from_xyzw(0.0, 0.0, 1.0, 0.0)),
        }
    }
}

impl FromStr for PatientAxes {
    type Err = String;

    fn from_str(word: &str) -> Result<Self, String> {
        match word {
            "lps" => Ok(Self::Lps),
            "ras" => Ok(Self::Ras),
            _ => Err("expected lps or ras".to_owned()),
        }
    }
}

/// A camera as formats exchange it.
#[derive(Clone, Debug, PartialEq)]
pub struct ExchangedCamera {
    /// Pose of the specimen in the camera.
    pub camera_from_lps: Rigid,
    /// K, where the format has it.
    pub intrinsics: Option<Intrinsics>,
    /// Columns and rows, where the format has them.
    pub size_px: Option<[u32; 2]>,
    /// Distance of neighbouring columns and of neighbouring rows on the detector, where the format has it.
    pub pitch_mm: Option<[f64; 2]>,
    /// What a reader of the camera should know, one sentence each.
    pub notes: Vec<String>,
}

impl ExchangedCamera {
    /// A camera of which only the pose is known.
    #[must_use]
    pub fn placed(camera_from_lps: Rigid) -> Self {
        Self { camera_from_lps, intrinsics: None, size_px: None, pitch_mm: None, notes: Vec::new() }
    }

    /// P, where K is known.
    #[must_use]
    pub fn projection(&self) -> Option<Projection> {
        Some(Projection::compose(&self.intrinsics?, &self.camera_from_lps))
    }

    fn intrinsics_for(&self, format: Format) -> Result<Intrinsics, FormatError> {
        self.intrinsics.ok_or(FormatError::Needs { format, what: "K", remedy: "--intrinsics K.json" })
    }

    fn size_for(&self, format: Format) -> Result<[u32; 2], FormatError> {
        self.size_px.ok_or(FormatError::Needs {
            format,
            what: "the image size",
            remedy: "--intrinsics K.json with size_px, or --size COLUMNS,ROWS",
        })
    }

    fn pitch_for(&self, format: Format) -> Result<[f64; 2], FormatError> {
        self.pitch_mm.ok_or(FormatError::Needs {
            format,
            what: "the pixel pitch in mm",
            remedy: "--intrinsics K.json with pitch_mm, or --pitch MM",
        })
    }
}

/// What is known besides the text.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Known {
    /// K, for formats without it.
    pub intrinsics: Option<Intrinsics>,
    /// Columns and rows.
    pub size_px: Option<[u32; 2]>,
    /// Distance of neighbouring columns and rows.
    pub pitch_mm: Option<[f64; 2]>,
}

/// Reads a camera; what `text` does not say is taken from `known`.
///
/// # Errors
/// When the text is not of the format, holds unknown keys, wrong shapes, numbers that are not finite, or mirrors.
pub fn read(format: Format, text: &str, axes: PatientAxes, known: &Known) -> Result<ExchangedCamera, FormatError> {
    let mut camera = match format {
        Format::Matrix => matrix::read_projection(text)?,
        Format::Kr => matrix::read_kr(text)?,
        Format::KrJson => matrix::read_kr_json(text)?,
        Format::OpenCv => opencv::read(text)?,
        Format::Rtk => rtk::read(text, known)?,
        Format::DeepDrr => deepdrr::read(text)?,
        Format::Xreg(_) => xreg::read(text)?,
        Format::Slicer => slicer::read(text)?,
    };
    camera.camera_from_lps = camera.camera_from_lps * axes.rotation_from_lps();
    camera.intrinsics = camera.intrinsics.or(known.intrinsics);
    camera.size_px = camera.size_px.or(known.size_px);
    camera.pitch_mm = camera.pitch_mm.or(known.pitch_mm);
    Ok(camera)
}

/// Writes a camera.
///
/// # Errors
/// When the format needs K, size or pitch and the camera has none, or cannot express it.
pub fn write(format: Format, camera: &ExchangedCamera, axes: PatientAxes) -> Result<String, FormatError> {
    let mut camera = camera.clone();
    camera.camera_from_lps = camera.camera_from_lps * axes.rotation_from_lps();
    match format {
        Format::Matrix => matrix::write_projection(&camera),
        Format::Kr => matrix::write_kr(&camera),
        Format::KrJson => matrix::write_kr_json(&camera),
        Format::OpenCv => opencv::write(&camera),
        Format::Rtk => rtk::write(&camera),
        Format::DeepDrr => deepdrr::write(&camera),
        Format::Xreg(frame) => xreg::write(&camera, frame),
        Format::Slicer => Ok(slicer::write(&camera)),
    }
}
