//! Kinds of foreign files.

/// Kinds of foreign files.
#[derive(Clone, Copy, Debug, PartialEq, Eq, serde::Serialize, serde::Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Kind {
    /// Radiographs: DICOM, PNG, TIFF.
    Frames,
    /// NIfTI: all voxels.
    Volume,
    /// NIfTI: what `info` says of it.
    VolumeFacts,
    /// STL: all triangles.
    Mesh,
}
