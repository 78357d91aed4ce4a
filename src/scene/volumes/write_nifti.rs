//! A volume of this program's own as NIfTI-1, one file, for whoever looks at volumes.

use std::io::{self, Write};
use std::path::Path;

use flate2::Compression;
use flate2::write::GzEncoder;

use crate::geometry::VoxelGrid;
use crate::image::{ImageFileError, write_atomically};

/// Header, and four bytes that say that no extension follows.
const VOXELS_FROM: usize = 352;
const FLOAT_32: i16 = 16;
/// Millimetres.
const UNIT: u8 = 2;
/// Coordinates are the scanner's.
const SCANNER: i16 = 1;

/// Writes `values`, i fastest, as 32-bit floats on `grid`; compressed where `path` ends in `.gz`. The same values give the same bytes.
///
/// # Errors
/// When the file cannot be written, or the grid has more than 32767 voxels along an axis, or another number of values.
pub fn write_nifti(path: &Path, grid: &VoxelGrid, values: &[f32]) -> Result<(), ImageFileError> {
    let is_zipped = path.extension().is_some_and(|ending| ending.eq_ignore_ascii_case("gz"));
    write_atomically(path, |file| {
        let header = header(grid, values.len())?;
        let voxels: Vec<u8> = values.iter().flat_map(|value| value.to_le_bytes()).collect();
        if is_zipped {
            let mut zipped = GzEncoder::new(file, Compression::default());
            zipped.write_all(&header)?;
            zipped.write_all(&voxels)?;
            zipped.finish().map(|_| ())
        } else {
            file.write_all(&header)?;
            file.write_all(&voxels)
        }
    })
}

/// The header of `count` voxels on `grid`, little-endian.
fn header(grid: &VoxelGrid, count: usize) -> io::Result<[u8; VOXELS_FROM]> {
    let unfit = |what: String| io::Error::new(io::ErrorKind::InvalidInput, what);
    if grid.voxels() != count {
        return Err(unfit(format!("{count} values for {} voxels", grid.voxels())));
    }
    let mut header = [0; VOXELS_FROM];
    let mut put = |at: usize, bytes: &[u8]| header[at..at + bytes.len()].copy_from_slice(bytes);
    put(0, &348_i32.to_le_bytes());
    let mut dim = [1_i16; 8];
    dim[0] = 3;
    for (axis, size) in grid.size.into_iter().enumerate() {
        dim[axis + 1] = i16::try_from(size).map_err(|_| unfit(format!("{size} voxels along an axis, NIfTI takes 32767")))?;
    }
    let shorts = |values: &[i16]| values.iter().flat_map(|value| value.to_le_bytes()).collect::<Vec<u8>>();
    let floats = |values: &[f64]| values.iter().flat_map(|value| (*value as f32).to_le_bytes()).collect::<Vec<u8>>();
    put(40, &shorts(&dim));
    put(70, &shorts(&[FLOAT_32, 32]));
    let [x_mm, y_mm, z_mm] = grid.spacing_mm();
    put(76, &floats(&[1.0, x_mm, y_mm, z_mm, 1.0, 1.0, 1.0, 1.0]));
    // Where the voxels begin; slope and intercept of what they mean.
    put(108, &floats(&[VOXELS_FROM as f64, 1.0, 0.0]));
    put(123, &[UNIT]);
    put(254, &shorts(&[SCANNER]));
    // Rows of RAS from voxel: x and y run the other way than in LPS.
    let (axes, origin) = (grid.lps_from_voxel.matrix3, grid.lps_from_voxel.translation);
    for (row, sign) in [-1.0, -1.0, 1.0].into_iter().enumerate() {
        let of_row = [axes.x_axis[row], axes.y_axis[row], axes.z_axis[row], origin[row]];
        put(280 + 16 * row, &floats(&of_row.map(|value| sign * value)));
    }
    put(344, b"n+1\0");
    Ok(header)
}
