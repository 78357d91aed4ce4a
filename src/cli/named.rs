//! Names that outputs may have: a picture under the name of something else takes the place of what was there, and opens in nothing.

use std::path::PathBuf;

/// Endings of what people look at, and of what other tools write images to: a TIFF under such a name is opened by nothing.
const OTHER_IMAGES: [&str; 11] = ["png", "jpg", "jpeg", "bmp", "gif", "webp", "exr", "dcm", "nii", "nrrd", "mha"];

/// A name for the TIFF.
pub(super) fn float_tiff(path: PathBuf) -> Result<PathBuf, String> {
    let ending = path.extension().map(|ending| ending.to_string_lossy().to_lowercase()).unwrap_or_default();
    if OTHER_IMAGES.contains(&ending.as_str()) {
        return Err(format!(
            "a 32-bit float TIFF is written here, name it .tif; --png {} writes a picture for eyes, --dicom a DICOM object",
            path.with_extension("png").display()
        ));
    }
    no_stream(path)
}

/// A name for a file.
pub(super) fn no_stream(path: PathBuf) -> Result<PathBuf, String> {
    if path.as_os_str() == "-" {
        return Err("standard output takes no image; name a file".to_owned());
    }
    Ok(path)
}

/// A name for a picture in SVG.
pub(super) fn svg(path: PathBuf) -> Result<PathBuf, String> {
    ends(path, "svg")
}

/// A name for a picture in PNG.
pub(super) fn png(path: PathBuf) -> Result<PathBuf, String> {
    ends(path, "png")
}

fn ends(path: PathBuf, ending: &str) -> Result<PathBuf, String> {
    if path.as_os_str() == "-" {
        return Err("standard output takes no image; name a file".to_owned());
    }
    if !path.extension().is_some_and(|found| found.eq_ignore_ascii_case(ending)) {
        return Err(format!("the picture is written as {}, name it .{ending}", ending.to_uppercase()));
    }
    Ok(path)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn pictures_are_named_for_what_they_are() {
        for name in ["k.nii", "plot", "plot.svg.nii", "plot.png", ""] {
            assert!(svg(PathBuf::from(name)).is_err_and(|words| words.contains("name it .svg")), "{name}");
        }
        assert!(png(PathBuf::from("-")).is_err_and(|words| words.contains("standard output")));
        assert!(svg(PathBuf::from("a/plot.SVG")).is_ok() && png(PathBuf::from("seen.png")).is_ok());
    }
}
