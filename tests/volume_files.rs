//! One volume in every format that is read, written from the definitions of the formats; nothing here uses the readers.

use std::path::{Path, PathBuf};

use dicom_core::{DataElement, PrimitiveValue, Tag, VR};
use dicom_dictionary_std::{tags, uids};
use dicom_object::{FileMetaTableBuilder, InMemDicomObject};
use glam::{DAffine3, DMat3, DVec3};

use super::scene_support::NiftiFile;

/// A volume of stored 16-bit numbers, i fastest.
#[derive(Clone)]
pub struct Sample {
    pub size: [usize; 3],
    pub lps_from_voxel: DAffine3,
    pub hu: Vec<i16>,
}

/// Directions times spacings, for those whose products have few binary digits: a format that writes the two apart then gives the same matrix
/// as one that writes it whole, in single precision even.
pub fn affine(directions: [DVec3; 3], spacing_mm: [f64; 3], translation: DVec3) -> DAffine3 {
    let axis = |n: usize| (directions[n] * spacing_mm[n] * 64.0).round() / 64.0;
    DAffine3 { matrix3: DMat3::from_cols(axis(0), axis(1), axis(2)), translation }
}

impl Sample {
    /// A block of tissue with bone and a hole, air around it, no two voxels of tissue alike.
    pub fn block(lps_from_voxel: DAffine3) -> Self {
        let size = [7, 6, 5];
        let hu = (0..size.iter().product()).map(|index: usize| {
            let at = [index % 7, index / 7 % 6, index / 42];
            let inside = (0..3).all(|axis| at[axis] > 0 && at[axis] + 1 < size[axis]);
            match (inside, at) {
                (false, _) => -1000,
                (true, [2, 2, 2]) => -800,
                (true, [4, 3, _]) => 900 + index as i16,
                _ => index as i16 - 60,
            }
        });
        Self { size, lps_from_voxel, hu: hu.collect() }
    }

    pub fn spacing_mm(&self) -> [f64; 3] {
        let m = self.lps_from_voxel.matrix3;
        [m.x_axis, m.y_axis, m.z_axis].map(|axis| axis.length())
    }

    /// The same matter, its slices counted from the other end: the other handedness.
    pub fn turned_round(&self) -> Self {
        let last = self.size[2] - 1;
        let slice = self.size[0] * self.size[1];
        let m = self.lps_from_voxel;
        let matrix3 = DMat3::from_cols(m.matrix3.x_axis, m.matrix3.y_axis, -m.matrix3.z_axis);
        let translation = m.translation + m.matrix3.z_axis * last as f64;
        let hu = (0..=last).rev().flat_map(|k| self.hu[k * slice..(k + 1) * slice].to_vec()).collect();
        Self { size: self.size, lps_from_voxel: DAffine3 { matrix3, translation }, hu }
    }

    pub fn little(&self) -> Vec<u8> {
        self.hu.iter().flat_map(|value| value.to_le_bytes()).collect()
    }

    pub fn big(&self) -> Vec<u8> {
        self.hu.iter().flat_map(|value| value.to_be_bytes()).collect()
    }

    pub fn nifti(&self, path: &Path) {
        let mut file = NiftiFile::int16(self.size.map(|n| n as i16), &self.hu);
        let m = self.lps_from_voxel;
        let columns = [m.matrix3.x_axis, m.matrix3.y_axis, m.matrix3.z_axis, m.translation];
        let row = |r: usize, sign: f64| columns.map(|column| (sign * column[r]) as f32);
        file.sform = Some([row(0, -1.0), row(1, -1.0), row(2, 1.0)]);
        let [i, j, k] = self.spacing_mm().map(|mm| mm as f32);
        file.pixdim = [1.0, i, j, k, 1.0, 1.0, 1.0, 1.0];
        file.write(path);
    }

    /// The fields of an NRRD header in `space`, whose axes have these signs in `lps`.
    pub fn nrrd_header(&self, space: &str, signs: [f64; 3], more: &str) -> String {
        let vector = |v: DVec3| format!("({},{},{})", v.x * signs[0], v.y * signs[1], v.z * signs[2]);
        let m = self.lps_from_voxel;
        let [i, j, k] = self.size;
        let [x, y, z] = [m.matrix3.x_axis, m.matrix3.y_axis, m.matrix3.z_axis].map(vector);
        format!(
            "NRRD0004\n# made by a test\ntype: short\ndimension: 3\nspace: {space}\nsizes: {i} {j} {k}\nspace directions: {x} {y} {z}\n\
             kinds: domain domain domain\nspace origin: {}\n{more}",
            vector(m.translation)
        )
    }

    /// The lines of a MetaImage header up to the last.
    pub fn metaimage_header(&self, more: &str) -> String {
        let m = self.lps_from_voxel;
        let [i, j, k] = self.size;
        let spacing = self.spacing_mm();
        // A row of the matrix as it is written is the direction of an axis.
        let rows: Vec<String> = [m.matrix3.x_axis, m.matrix3.y_axis, m.matrix3.z_axis]
            .iter()
            .zip(spacing)
            .map(|(axis, mm)| format!("{} {} {}", axis.x / mm, axis.y / mm, axis.z / mm))
            .collect();
        format!(
            "ObjectType = Image\nNDims = 3\nBinaryData = True\n{more}TransformMatrix = {}\nOffset = {} {} {}\nCenterOfRotation = 0 0 0\n\
             AnatomicalOrientation = RAI\nElementSpacing = {} {} {}\nDimSize = {i} {j} {k}\nElementType = MET_SHORT\n",
            rows.join(" "),
            m.translation.x,
            m.translation.y,
            m.translation.z,
            spacing[0],
            spacing[1],
            spacing[2]
        )
    }

    /// The slices of a series in order, as a scanner stores them: unsigned with an intercept of −1024.
    pub fn slices(&self) -> Vec<InMemDicomObject> {
        (0..self.size[2]).map(|k| self.slice(k)).collect()
    }

    fn slice(&self, k: usize) -> InMemDicomObject {
        let mut object = ct_object(&format!("2.25.100{k}"));
        let [columns, rows, _] = self.size;
        let [across_mm, down_mm, _] = self.spacing_mm();
        let m = self.lps_from_voxel;
        let place = m.transform_point3(DVec3::new(0.0, 0.0, k as f64));
        let (along_row, along_column) = (m.matrix3.x_axis / across_mm, m.matrix3.y_axis / down_mm);
        let words = |all: &[f64]| all.iter().map(f64::to_string).collect::<Vec<_>>().join("\\");
        put(&mut object, tags::IMAGE_POSITION_PATIENT, VR::DS, &words(&place.to_array()));
        let cosines = [along_row.to_array(), along_column.to_array()].concat();
        put(&mut object, tags::IMAGE_ORIENTATION_PATIENT, VR::DS, &words(&cosines));
        put(&mut object, tags::PIXEL_SPACING, VR::DS, &words(&[down_mm, across_mm]));
        put(&mut object, tags::RESCALE_SLOPE, VR::DS, "1");
        put(&mut object, tags::RESCALE_INTERCEPT, VR::DS, "-1024");
        number(&mut object, tags::ROWS, rows as u16);
        number(&mut object, tags::COLUMNS, columns as u16);
        let slice = &self.hu[k * columns * rows..(k + 1) * columns * rows];
        let stored: Vec<u16> = slice.iter().map(|hu| (i32::from(*hu) + 1024) as u16).collect();
        object.put(DataElement::new(tags::PIXEL_DATA, VR::OW, PrimitiveValue::U16(stored.into())));
        object
    }
}

/// A CT slice of a named patient without place and pixels.
fn ct_object(instance: &str) -> InMemDicomObject {
    let mut object = InMemDicomObject::new_empty();
    put(&mut object, tags::SOP_CLASS_UID, VR::UI, uids::CT_IMAGE_STORAGE);
    put(&mut object, tags::SOP_INSTANCE_UID, VR::UI, instance);
    put(&mut object, tags::MODALITY, VR::CS, "CT");
    put(&mut object, tags::IMAGE_TYPE, VR::CS, "ORIGINAL\\PRIMARY\\AXIAL");
    put(&mut object, tags::PATIENT_NAME, VR::PN, "Quaxwelk^Annegrund");
    put(&mut object, tags::PATIENT_ID, VR::LO, "PFRIEMK-77");
    put(&mut object, tags::SERIES_INSTANCE_UID, VR::UI, "2.25.7777777");
    put(&mut object, tags::SERIES_NUMBER, VR::IS, "3");
    put(&mut object, tags::SERIES_DESCRIPTION, VR::LO, "hip of Annegrund");
    put(&mut object, tags::PHOTOMETRIC_INTERPRETATION, VR::CS, "MONOCHROME2");
    number(&mut object, tags::SAMPLES_PER_PIXEL, 1);
    number(&mut object, tags::BITS_ALLOCATED, 16);
    number(&mut object, tags::BITS_STORED, 12);
    number(&mut object, tags::HIGH_BIT, 11);
    number(&mut object, tags::PIXEL_REPRESENTATION, 0);
    object
}

pub fn put(object: &mut InMemDicomObject, tag: Tag, vr: VR, value: &str) {
    object.put(DataElement::new(tag, vr, PrimitiveValue::from(value)));
}

pub fn number(object: &mut InMemDicomObject, tag: Tag, value: u16) {
    object.put(DataElement::new(tag, VR::US, PrimitiveValue::from(value)));
}

/// Writes a DICOM file.
pub fn save(object: &InMemDicomObject, path: &Path) {
    let text = |tag: Tag| object.get(tag).and_then(|element| element.to_str().ok()).unwrap_or_default().into_owned();
    let meta = FileMetaTableBuilder::new()
        .transfer_syntax(uids::EXPLICIT_VR_LITTLE_ENDIAN)
        .media_storage_sop_class_uid(text(tags::SOP_CLASS_UID))
        .media_storage_sop_instance_uid(text(tags::SOP_INSTANCE_UID));
    object.clone().with_meta(meta).expect("meta is complete").write_to_file(path).expect("file is written");
}

/// Writes slices into a folder under names that are not in their order; gives the files in the order of the slices.
pub fn save_series(slices: &[InMemDicomObject], folder: &Path) -> Vec<PathBuf> {
    std::fs::create_dir_all(folder).expect("a folder");
    let name = |index: usize| folder.join(format!("IM_{:04}.dcm", (index * 400 + 3) % 1009));
    slices
        .iter()
        .enumerate()
        .map(|(index, slice)| {
            save(slice, &name(index));
            name(index)
        })
        .collect()
}

pub fn zlib(bytes: &[u8]) -> Vec<u8> {
    let mut zipped = flate2::write::ZlibEncoder::new(Vec::new(), flate2::Compression::fast());
    std::io::Write::write_all(&mut zipped, bytes).expect("memory");
    zipped.finish().expect("memory")
}

pub fn gzip(bytes: &[u8]) -> Vec<u8> {
    let mut zipped = flate2::write::GzEncoder::new(Vec::new(), flate2::Compression::fast());
    std::io::Write::write_all(&mut zipped, bytes).expect("memory");
    zipped.finish().expect("memory")
}

pub fn write(path: &Path, parts: &[&[u8]]) {
    std::fs::write(path, parts.concat()).expect("written");
}
