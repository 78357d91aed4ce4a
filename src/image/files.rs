//! Image files: 32-bit float TIFF with pages, PNG for eyes, hashes; every write is all or nothing.

use std::io::{BufWriter, Read, Write};
use std::path::{Path, PathBuf};

use sha2::{Digest, Sha256};

use super::Image;
use super::new_file::{UNNAMED, sync_folder};
use super::temporary::{Temporary, temporary_file};
use crate::regular;

/// Why an image file could not be read or written.
#[derive(Debug, thiserror::Error)]
pub enum ImageFileError {
    /// The operating system refused.
    #[error("{path}: {source}", path = path.display())]
    Io {
        /// The file.
        path: PathBuf,
        /// What the system said.
        source: std::io::Error,
    },
    /// An output has no folder to lie in.
    #[error("{path}: cannot be written: {folder} is not a folder; create it or name another", path = path.display(), folder = folder.display())]
    NoFolder {
        /// The file.
        path: PathBuf,
        /// What should be a folder.
        folder: PathBuf,
    },
    /// An output has the name of a folder.
    #[error("{path}: cannot be written: it is a folder; name a file in it", path = path.display())]
    IsFolder {
        /// The folder.
        path: PathBuf,
    },
    /// Two outputs have one name.
    #[error("{path}: is named for two outputs; give each a name of its own", path = path.display())]
    NamedTwice {
        /// The name.
        path: PathBuf,
    },
    /// An output has the name of a device, a pipe or a socket.
    #[error("{path}: cannot be written: it is no file but a device or a pipe; name a file", path = path.display())]
    NoFile {
        /// What is there.
        path: PathBuf,
    },
    /// The operating system refused to write.
    #[error("{path}: cannot be written ({source})", path = path.display())]
    Write {
        /// The file.
        path: PathBuf,
        /// What the system said.
        source: std::io::Error,
    },
    /// An output is the same file as an input.
    #[error("{path}: would overwrite an input ({input}); choose another name", path = path.display(), input = input.display())]
    WouldOverwrite {
        /// The output.
        path: PathBuf,
        /// The input, as it was named.
        input: PathBuf,
    },
    /// Two inputs that each count hold the same bytes.
    #[error("{again}: has the same content as {first}, and would count twice; name each only once", again = again.display(), first = first.display())]
    SameContent {
        /// The input named first.
        first: PathBuf,
        /// The other one.
        again: PathBuf,
    },
    /// The file is not a TIFF, or a damaged one.
    #[error("{path}: not a readable TIFF ({detail})", path = path.display())]
    Tiff {
        /// The file.
        path: PathBuf,
        /// What the decoder said.
        detail: String,
    },
    /// The file shows its pixels in another order than it stores them.
    #[error("{path}: TIFF orientation (tag 274) is {found}, expected 1; write its columns and rows as they are shown", path = path.display())]
    Turned {
        /// The file.
        path: PathBuf,
        /// What the tag says.
        found: u16,
    },
    /// The file shows zero white.
    #[error("{path}: TIFF photometric interpretation (tag 262) is 0, white is zero, expected 1; write it with zero as black", path = path.display())]
    WhiteIsZero {
        /// The file.
        path: PathBuf,
    },
    /// The samples are not 32-bit float, or there are several per pixel.
    #[error("{path}: expected one 32-bit float per pixel, found {found}", path = path.display())]
    NotFloat {
        /// The file.
        path: PathBuf,
        /// What the file holds.
        found: String,
    },
    /// The image has no pixels.
    #[error("{path}: image of {width}x{height} pixels has nothing to write", path = path.display())]
    Empty {
        /// The file.
        path: PathBuf,
        /// Columns.
        width: usize,
        /// Rows.
        height: usize,
    },
}

/// Writes `path` through a temporary file beside it, so that readers see the old file or the whole new one, after a loss of power too. When it
/// returns, the new one is on the disk.
///
/// # Errors
/// When the folder is missing or not writable, or the disk is full; nothing is left behind then.
pub fn write_atomically(
    path: &Path,
    write: impl FnOnce(&mut dyn WriteSeek) -> std::io::Result<()>,
) -> Result<(), ImageFileError> {
    write_lasting(path, Lasting::AtOnce, write)
}

/// Whether the disk is waited for, which may take seconds.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Lasting {
    /// The file's new name comes after its bytes.
    AtOnce,
    /// After a loss of power the file may be empty: for pictures for eyes, and for what a session writes again and again and a replay of its log
    /// makes again.
    Later,
}

/// As [`write_atomically`], with or without waiting for the disk.
///
/// # Errors
/// As [`write_atomically`].
pub fn write_lasting(
    path: &Path,
    lasting: Lasting,
    write: impl FnOnce(&mut dyn WriteSeek) -> std::io::Result<()>,
) -> Result<(), ImageFileError> {
    let io = |source| ImageFileError::Write { path: path.to_owned(), source };
    let mut temporary = temporary_beside(path)?;
    {
        let mut buffered = BufWriter::new(temporary.as_file_mut());
        write(&mut buffered).map_err(io)?;
        buffered.flush().map_err(io)?;
    }
    #[cfg(unix)]
    {
        use std::os::unix::fs::PermissionsExt;
        temporary.as_file().set_permissions(std::fs::Permissions::from_mode(0o644)).map_err(io)?;
    }
    if lasting == Lasting::AtOnce {
        temporary.as_file().sync_all().map_err(io)?;
    }
    temporary.end_with(|file| file.persist(path).map_err(|error| io(error.error)))?;
    if lasting == Lasting::AtOnce {
        sync_folder(path);
    }
    Ok(())
}

/// `IMAGE.tif` → `IMAGE.tif.suffix`.
#[must_use]
pub fn beside(path: &Path, suffix: &str) -> PathBuf {
    let mut name = path.as_os_str().to_owned();
    name.push(".");
    name.push(suffix);
    PathBuf::from(name)
}

/// Refuses now what [`write_atomically`] would refuse later.
///
/// # Errors
/// When the folder is missing or not writable, or `path` is a folder.
pub fn check_writable(path: &Path) -> Result<(), ImageFileError> {
    temporary_beside(path).map(|_| ())
}

/// Refuses outputs that are the same file as an input, whatever the two are called: symbolic and hard links and `..` included.
/// What does not exist is no input and cannot be overwritten.
///
/// # Errors
/// When an output is an input.
pub fn refuse_overwrite<O: AsRef<Path>, I: AsRef<Path>>(outputs: &[O], inputs: &[I]) -> Result<(), ImageFileError> {
    let known: Vec<(&Path, Identity)> =
        inputs.iter().filter_map(|input| Some((input.as_ref(), Identity::of(input.as_ref())?))).collect();
    for output in outputs.iter().map(AsRef::as_ref) {
        let Some(identity) = Identity::of(output) else { continue };
        if let Some((input, _)) = known.iter().find(|(_, input)| *input == identity) {
            return Err(ImageFileError::WouldOverwrite { path: output.to_owned(), input: input.to_path_buf() });
        }
    }
    Ok(())
}

/// Refuses inputs of the same content where each counts as a measurement of its own. What cannot be read is left to whoever reads it.
///
/// # Errors
/// When two are the same.
pub fn refuse_same_content<I: AsRef<Path>>(inputs: &[I]) -> Result<(), ImageFileError> {
    let mut seen = std::collections::BTreeMap::new();
    for path in inputs.iter().map(AsRef::as_ref) {
        let Ok(hash) = sha256_file(path) else { continue };
        if let Some(first) = seen.insert(hash, path) {
            return Err(ImageFileError::SameContent { first: first.to_owned(), again: path.to_owned() });
        }
    }
    Ok(())
}

/// Refuses outputs of which the later would replace an earlier one.
///
/// # Errors
/// When two have the same name.
pub fn refuse_twice<O: AsRef<Path>>(outputs: &[O]) -> Result<(), ImageFileError> {
    let twice = |(index, output): (usize, &O)| outputs[..index].iter().any(|other| other.as_ref() == output.as_ref());
    match (0..).zip(outputs).find(|pair| twice(*pair)) {
        Some((_, output)) => Err(ImageFileError::NamedTwice { path: output.as_ref().to_owned() }),
        None => Ok(()),
    }
}

/// What a file is, rather than what it is called.
#[cfg(unix)]
#[derive(PartialEq)]
struct Identity {
    device: u64,
    inode: u64,
}

#[cfg(unix)]
impl Identity {
    fn of(path: &Path) -> Option<Self> {
        use std::os::unix::fs::MetadataExt;
        std::fs::metadata(path).ok().map(|found| Self { device: found.dev(), inode: found.ino() })
    }
}

/// What a file is, rather than what it is called: here its full path, so that hard links go unnoticed.
#[cfg(not(unix))]
#[derive(PartialEq)]
struct Identity(PathBuf);

#[cfg(not(unix))]
impl Identity {
    fn of(path: &Path) -> Option<Self> {
        path.canonicalize().ok().map(Self)
    }
}

fn temporary_beside(path: &Path) -> Result<Temporary<tempfile::NamedTempFile>, ImageFileError> {
    let folder = match path.parent() {
        Some(parent) if !parent.as_os_str().is_empty() => parent,
        _ => Path::new("."),
    };
    if path.is_dir() {
        return Err(ImageFileError::IsFolder { path: path.to_owned() });
    }
    // What replaces it would be a file in its place.
    if std::fs::metadata(path).is_ok_and(|found| !found.is_file()) {
        return Err(ImageFileError::NoFile { path: path.to_owned() });
    }
    if !folder.is_dir() {
        return Err(ImageFileError::NoFolder { path: path.to_owned(), folder: folder.to_owned() });
    }
    temporary_file(folder, UNNAMED, "").map_err(|source| ImageFileError::Write { path: path.to_owned(), source })
}

/// A file of this program in the user's cache folder, which need not exist; `None` where no such folder is known.
#[must_use]
pub fn cache_file(name: &str) -> Option<PathBuf> {
    let set = |name: &str| std::env::var_os(name).filter(|value| !value.is_empty()).map(PathBuf::from);
    let folder = set("XDG_CACHE_HOME").or_else(|| Some(set("HOME")?.join(".cache")))?;
    Some(folder.join("sidecarm").join(name))
}

/// A seekable writer, as the TIFF encoder needs it.
pub trait WriteSeek: Write + std::io::Seek {}
impl<T: Write + std::io::Seek> WriteSeek for T {}

/// Writes `pages` as one multi-page 32-bit float TIFF.
///
/// # Errors
/// When there is no page, a page is empty, or the file cannot be written.
pub fn write_tiff_f32(path: &Path, pages: &[Image<f32>]) -> Result<(), ImageFileError> {
    write_tiff_f32_lasting(path, Lasting::AtOnce, pages)
}

/// The same, with or without waiting for the disk.
///
/// # Errors
/// As [`write_tiff_f32`].
pub fn write_tiff_f32_lasting(path: &Path, lasting: Lasting, pages: &[Image<f32>]) -> Result<(), ImageFileError> {
    if let Some(page) = pages.iter().find(|page| page.pixels.is_empty()) {
        return Err(ImageFileError::Empty { path: path.to_owned(), width: page.width, height: page.height });
    }
    if pages.is_empty() {
        return Err(ImageFileError::Empty { path: path.to_owned(), width: 0, height: 0 });
    }
    write_lasting(path, lasting, |file| {
        let mut encoder = tiff::encoder::TiffEncoder::new(file).map_err(std::io::Error::other)?;
        for page in pages {
            encoder
                .write_image::<tiff::encoder::colortype::Gray32Float>(page.width as u32, page.height as u32, &page.pixels)
                .map_err(std::io::Error::other)?;
        }
        Ok(())
    })
}

/// TIFF 6.0, tag 262: zero is shown white.
pub const WHITE_IS_ZERO: u16 = 0;

/// Reads every page of a 32-bit float TIFF.
///
/// # Errors
/// When the file cannot be read, is damaged, holds other samples, or shows them turned.
pub fn read_tiff_f32(path: &Path) -> Result<Vec<Image<f32>>, ImageFileError> {
    let file = regular::open(path).map_err(|source| ImageFileError::Io { path: path.to_owned(), source })?;
    let damaged = |error: tiff::TiffError| ImageFileError::Tiff { path: path.to_owned(), detail: error.to_string() };
    let mut decoder = tiff::decoder::Decoder::new(std::io::BufReader::new(file)).map_err(damaged)?;
    let mut pages = Vec::new();
    loop {
        let (width, height) = decoder.dimensions().map_err(damaged)?;
        let colour = decoder.colortype().map_err(damaged)?;
        if let Some(found) = decoder.find_tag_unsigned(tiff::tags::Tag::Orientation).map_err(damaged)?.filter(|order| *order != 1)
        {
            return Err(ImageFileError::Turned { path: path.to_owned(), found });
        }
        // The decoder would turn the values round.
        if decoder.find_tag_unsigned(tiff::tags::Tag::PhotometricInterpretation).map_err(damaged)? == Some(WHITE_IS_ZERO) {
            return Err(ImageFileError::WhiteIsZero { path: path.to_owned() });
        }
        let samples = decoder.read_image().map_err(damaged)?;
        let page = match samples {
            tiff::decoder::DecodingResult::F32(pixels) => Image::from_pixels(width as usize, height as usize, pixels),
            _ => None,
        };
        let not_float = || ImageFileError::NotFloat { path: path.to_owned(), found: format!("{colour:?}") };
        pages.push(page.ok_or_else(not_float)?);
        if !decoder.more_images() {
            return Ok(pages);
        }
        decoder.next_image().map_err(damaged)?;
    }
}

/// Writes an 8-bit RGB PNG.
///
/// # Errors
/// When the image is empty or the file cannot be written.
pub fn write_png_rgb(path: &Path, image: &Image<[u8; 3]>) -> Result<(), ImageFileError> {
    if image.pixels.is_empty() {
        return Err(ImageFileError::Empty { path: path.to_owned(), width: image.width, height: image.height });
    }
    let bytes: Vec<u8> = image.pixels.iter().flatten().copied().collect();
    write_lasting(path, Lasting::Later, |file| {
        let encoder = image::codecs::png::PngEncoder::new(file);
        image::ImageEncoder::write_image(encoder, &bytes, image.width as u32, image.height as u32, image::ExtendedColorType::Rgb8)
            .map_err(std::io::Error::other)
    })
}

/// Reads an 8-bit RGB PNG of our own.
///
/// # Errors
/// When the file cannot be read.
pub fn read_png_rgb(path: &Path) -> Result<Image<[u8; 3]>, ImageFileError> {
    let io = |source| ImageFileError::Io { path: path.to_owned(), source };
    let bytes = regular::read(path).map_err(io)?;
    let read = image::load_from_memory(&bytes).map_err(|error| io(std::io::Error::other(error)))?.into_rgb8();
    let (width, height) = (read.width() as usize, read.height() as usize);
    let pixels = read.pixels().map(|pixel| pixel.0).collect();
    Image::from_pixels(width, height, pixels).ok_or_else(|| io(std::io::Error::other("its size is not that of its pixels")))
}

/// SHA-256 of `bytes`, lower-case hexadecimal.
#[must_use]
pub fn sha256_bytes(bytes: &[u8]) -> String {
    hex(&Sha256::digest(bytes))
}

/// SHA-256 of a file's content, lower-case hexadecimal.
///
/// # Errors
/// When the file cannot be read.
pub fn sha256_file(path: &Path) -> Result<String, ImageFileError> {
    let io = |source| ImageFileError::Io { path: path.to_owned(), source };
    let mut file = regular::open(path).map_err(io)?;
    let mut hasher = Sha256::new();
    let mut chunk = vec![0u8; 1 << 16];
    loop {
        let count = file.read(&mut chunk).map_err(io)?;
        if count == 0 {
            return Ok(hex(&hasher.finalize()));
        }
        hasher.update(&chunk[..count]);
    }
}

/// `bytes` in lower-case hexadecimal.
#[must_use]
pub fn hex(bytes: &[u8]) -> String {
    use std::fmt::Write as _;
    bytes.iter().fold(String::with_capacity(64), |mut text, byte| {
        let _ = write!(text, "{byte:02x}");
        text
    })
}
