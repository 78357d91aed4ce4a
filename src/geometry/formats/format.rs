//! The formats by name: what each keeps, and in which axes.

use std::str::FromStr;

use crate::geometry::{RAS_FROM_LPS, Rigid};

/// Where xReg puts the camera's origin and axes.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum XregFrame {
    /// Origin at the focal spot, +z to the detector.
    DetectorPositiveZ,
    /// Origin at the focal spot, the detector at negative z: xReg's default.
    DetectorNegativeZ,
    /// Origin on the detector, +z to the source.
    OriginOnDetector,
}

impl XregFrame {
    pub(super) const ALL: [Self; 3] = [Self::DetectorPositiveZ, Self::DetectorNegativeZ, Self::OriginOnDetector];

    /// As in xReg's files.
    #[must_use]
    pub fn name(self) -> &'static str {
        match self {
            Self::DetectorPositiveZ => "origin-at-focal-pt-det-pos-z",
            Self::DetectorNegativeZ => "origin-at-focal-pt-det-neg-z",
            Self::OriginOnDetector => "origin-on-det",
        }
    }
}

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
    pub(super) fn rotation_from_lps(self) -> Rigid {
        match self {
            Self::Lps => Rigid::IDENTITY,
            Self::Ras => RAS_FROM_LPS,
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
