//! Kinds of foreign files.

/// Kinds of foreign files.
#[derive(Clone, Copy, Debug, PartialEq, Eq, serde::Serialize, serde::Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Kind {
    /// Radiographs: DICOM, PNG, TIFF.
    Frames,
    /// Volumes: all voxels.
    Volume,
    /// Volumes: what `info` says of them.
    VolumeFacts,
    /// Headers of text (NRRD, MetaImage): where and how the voxels are stored.
    VolumeHeader,
    /// Headers of DICOM files: which slices they hold.
    Slices,
    /// STL: all triangles.
    Mesh,
}
