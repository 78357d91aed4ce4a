//! What is agreed on with senders of DICOM objects: what radiographs come as, in encodings that are read here.

use dicom_dictionary_std::uids;

use super::dicom::is_readable;

/// What radiographs come as: XA, RF, DX and CR, and what consoles capture.
pub(super) const STORAGE_CLASSES: [&str; 8] = [
    uids::X_RAY_ANGIOGRAPHIC_IMAGE_STORAGE,
    uids::X_RAY_RADIOFLUOROSCOPIC_IMAGE_STORAGE,
    uids::DIGITAL_X_RAY_IMAGE_STORAGE_FOR_PRESENTATION,
    uids::DIGITAL_X_RAY_IMAGE_STORAGE_FOR_PROCESSING,
    uids::COMPUTED_RADIOGRAPHY_IMAGE_STORAGE,
    uids::SECONDARY_CAPTURE_IMAGE_STORAGE,
    uids::MULTI_FRAME_GRAYSCALE_BYTE_SECONDARY_CAPTURE_IMAGE_STORAGE,
    uids::MULTI_FRAME_GRAYSCALE_WORD_SECONDARY_CAPTURE_IMAGE_STORAGE,
];

/// Transfer syntaxes that are taken where their pixels are read ([`is_readable`]).
const TRANSFER_SYNTAXES: [&str; 7] = [
    uids::EXPLICIT_VR_LITTLE_ENDIAN,
    uids::IMPLICIT_VR_LITTLE_ENDIAN,
    uids::RLE_LOSSLESS,
    uids::JPEG_BASELINE8_BIT,
    uids::JPEG_EXTENDED12_BIT,
    uids::JPEG_LOSSLESS,
    uids::JPEG_LOSSLESS_SV1,
];

/// Those that are taken.
pub(super) fn transfer_syntaxes() -> impl Iterator<Item = &'static str> {
    TRANSFER_SYNTAXES.into_iter().filter(|syntax| is_readable(syntax))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_the_reader_decodes_is_agreed_on_and_nothing_else() {
        let taken: Vec<&str> = transfer_syntaxes().collect();
        assert!(taken.contains(&uids::IMPLICIT_VR_LITTLE_ENDIAN) && taken.contains(&uids::RLE_LOSSLESS), "{taken:?}");
        assert!(!is_readable(uids::JPEG2000_LOSSLESS), "no context is agreed on for it");
    }
}
