//! Which files a volume consists of: one, a header and the file with its voxels, or the slices of a DICOM series.

use std::io::Read;
use std::path::{Component, Path, PathBuf};

use super::ct_slice::FileHead;
use super::exchange::{HeaderFormat, Volume, Wanted, read_file_heads, read_header, read_voxels_of};
use super::header_file::HeaderPlan;
use super::series::{Series, arrange, more_slices};
use super::slices::SlicesWanted;
use super::{metaimage, nifti, nrrd};
use crate::acquire::{input_label, is_dicom};
use crate::foreign::{self, Input, Kind, Limits, OpenFault, OpenFile};
use crate::image::{sha256_bytes, sha256_file};
use crate::scene::SceneError;
use crate::scene::model::InputPart;

/// A volume that was found, its headers read and its files known.
#[derive(Clone, Debug)]
pub struct VolumeSource {
    path: PathBuf,
    form: Form,
}

#[derive(Clone, Debug)]
enum Form {
    /// NIfTI.
    Nifti,
    /// NRRD or MetaImage; `data` is another file than the header's, if it is one.
    Planned { plan: Box<HeaderPlan>, data: Option<PathBuf> },
    /// The files of the slices in order, and how they make a volume.
    Series { files: Vec<PathBuf>, wanted: Box<SlicesWanted> },
}

/// What a volume is, rather than what it is called.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct VolumeContent {
    /// Of one file, the hash of its bytes. Of several, that of their hashes in ascending order, each followed by a line feed: the same however
    /// files are called and slices are numbered. Lower-case hexadecimal.
    pub sha256: String,
    /// The files of a volume that has several or is DICOM, by their hashes, ascending; else none.
    pub parts: Vec<InputPart>,
}

/// Bytes of a file that say what it is.
const HEAD_BYTES: u64 = 512;
/// Entries of a folder that are looked at.
const MOST_ENTRIES: usize = 20_000;
/// Of a DICOM file, what is read to know its place: nothing before its pixels takes more.
const DICOM_HEAD_BYTES: u64 = 16 << 20;

impl VolumeSource {
    /// Finds out what `path` is: by its content, MetaImage also by its name. A folder is that of the slices of one series; a DICOM file is one
    /// slice of the series that is meant, among others perhaps.
    ///
    /// # Errors
    /// When it cannot be read, a header is damaged, or slices make no volume.
    pub fn open(path: &Path) -> Result<Self, SceneError> {
        let wrong = |detail: String| SceneError::Volume { path: path.to_owned(), detail };
        let found = |form: Form| Ok(Self { path: path.to_owned(), form });
        if path.is_dir() {
            return found(series(path, None).map_err(wrong)?);
        }
        let mut open = open(path)?;
        let mut head = Vec::new();
        (&mut open.file).take(HEAD_BYTES).read_to_end(&mut head).map_err(|source| io_error(path, source))?;
        let named = |ending: &str| path.extension().is_some_and(|found| found.eq_ignore_ascii_case(ending));
        let format = if is_dicom(&head) {
            let folder = path.parent().filter(|folder| !folder.as_os_str().is_empty()).unwrap_or(Path::new("."));
            return found(series(folder, path.file_name().map(Path::new)).map_err(wrong)?);
        } else if head.starts_with(nrrd::MAGIC) {
            HeaderFormat::Nrrd
        } else if named("mha") || named("mhd") || metaimage::FIRST_KEYS.iter().any(|key| head.starts_with(key)) {
            HeaderFormat::MetaImage
        } else {
            return found(Form::Nifti);
        };
        std::io::Seek::rewind(&mut open.file).map_err(|source| io_error(path, source))?;
        let plan = read_header(format, open.file).map_err(wrong)?;
        let data = plan.data.file.as_deref().map(|name| data_file(path, name)).transpose().map_err(wrong)?;
        found(Form::Planned { plan: Box::new(plan), data })
    }

    /// Content's hash, and the files that it is the hash of.
    ///
    /// # Errors
    /// When a file cannot be read.
    pub fn content(&self) -> Result<VolumeContent, SceneError> {
        let files: Vec<&Path> = match &self.form {
            Form::Nifti | Form::Planned { data: None, .. } => {
                // One that is too large for anything is not read to its end for a hash.
                return Ok(VolumeContent { sha256: hash(&self.path)?.sha256, parts: Vec::new() });
            }
            Form::Planned { data: Some(data), .. } => vec![&self.path, data],
            Form::Series { files, .. } => files.iter().map(PathBuf::as_path).collect(),
        };
        let mut parts = files.into_iter().map(hash).collect::<Result<Vec<InputPart>, SceneError>>()?;
        parts.sort_by(|a, b| (&a.sha256, &a.path).cmp(&(&b.sha256, &b.path)));
        let sha256 = match &parts[..] {
            [only] => only.sha256.clone(),
            all => sha256_bytes(all.iter().map(|part| format!("{}\n", part.sha256)).collect::<String>().as_bytes()),
        };
        Ok(VolumeContent { sha256, parts })
    }

    /// Where it was found.
    #[must_use]
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// Its voxels, or what all of them say.
    pub(super) fn read(&self, kind: Kind) -> Result<Volume, SceneError> {
        let wrong = |detail: String| SceneError::Volume { path: self.path.clone(), detail };
        let one = |path: &Path, wanted: &Wanted| read_voxels_of(wanted, open(path)?.file.into(), kind).map_err(wrong);
        match &self.form {
            Form::Nifti => one(&self.path, &Wanted::Nifti),
            Form::Planned { plan, data } => {
                // Names of labels are not needed to read voxels, and may be many.
                let mut plan = HeaderPlan::clone(plan);
                let names = std::mem::take(&mut plan.head.label_names);
                let (mut head, values, summary) = one(data.as_ref().unwrap_or(&self.path), &Wanted::Planned(plan))?;
                head.label_names = names;
                Ok((head, values, summary))
            }
            Form::Series { files, wanted } => {
                let input = many(files.clone(), Limits::of(kind).file_bytes);
                read_voxels_of(&Wanted::Slices(SlicesWanted::clone(wanted)), input, kind).map_err(wrong)
            }
        }
    }
}

/// Whether a file that begins with the 512 bytes `head` is a volume by its content, whatever it is called.
#[must_use]
pub fn is_volume(head: &[u8]) -> bool {
    head.starts_with(nrrd::MAGIC) || head.starts_with(metaimage::FIRST_KEYS[0]) || nifti::is_nifti(head)
}

/// Whether the DICOM file at `path` holds slices of a CT, which are a part of a volume.
#[must_use]
pub fn is_ct_slice(path: &Path) -> bool {
    let heads = read_file_heads(many(vec![path.to_owned()], DICOM_HEAD_BYTES), 1);
    heads.is_ok_and(|heads| matches!(heads[..], [FileHead::Ct(_)]))
}

fn io_error(path: &Path, source: std::io::Error) -> SceneError {
    SceneError::Io { path: path.to_owned(), source }
}

fn open(path: &Path) -> Result<OpenFile, SceneError> {
    let limits = foreign::installed().limits(Kind::Volume);
    foreign::open_regular(path, limits.file_bytes).map_err(|fault| match fault {
        OpenFault::Io(source) => io_error(path, source),
        other => SceneError::Volume { path: path.to_owned(), detail: other.to_string() },
    })
}

fn hash(path: &Path) -> Result<InputPart, SceneError> {
    let bytes = open(path)?.stamp.bytes;
    let sha256 = sha256_file(path).map_err(|error| io_error(path, std::io::Error::other(error.to_string())))?;
    Ok(InputPart { path: path.to_owned(), sha256, bytes })
}

/// The file with the voxels of the header at `path`, beside it or below. One elsewhere is not opened: a header may name anything.
fn data_file(path: &Path, name: &str) -> Result<PathBuf, String> {
    let named = Path::new(name);
    if !named.components().all(|part| matches!(part, Component::Normal(_) | Component::CurDir)) {
        return Err(
            "its header names a file in another folder for its voxels; lay it beside the header and name it so".to_owned()
        );
    }
    let data = path.parent().map_or_else(|| named.to_owned(), |folder| folder.join(named));
    if data.is_file() {
        return Ok(data);
    }
    let label = input_label(named, "");
    let shown = if label.starts_with("input-") { String::new() } else { format!(" {label}") };
    Err(format!("the file{shown} that its header names for its voxels is not beside it; copy it there"))
}

/// Contents of files up to `most` bytes of each, one after the other.
fn many(files: Vec<PathBuf>, most: u64) -> Input {
    Input::Many(Box::new(files.into_iter().map(move |path| {
        let open = foreign::open_regular(&path, u64::MAX).map_err(|fault| match fault {
            OpenFault::Io(source) => source,
            other => std::io::Error::other(other.to_string()),
        })?;
        Ok((open.file, most))
    })))
}

/// The series of a folder: the only one, or that of the file `named`.
fn series(folder: &Path, named: Option<&Path>) -> Result<Form, String> {
    let (files, folders) = dicom_files(folder)?;
    if files.is_empty() && !folders.is_empty() {
        return Err(format!("the folder holds no DICOM file, and {} folders; name that of the slices themselves", folders.len()));
    }
    let heads = read_file_heads(many(files.clone(), DICOM_HEAD_BYTES), files.len())?;
    let named = named.map(|named| {
        let found = files.iter().position(|file| file.file_name().map(Path::new) == Some(named));
        found.ok_or_else(|| "it is not among the files of its folder; try again".to_owned())
    });
    let name = |index: usize| {
        let label = input_label(&files[index], "");
        if label.starts_with("input-") { format!("file {} by name", index + 1) } else { label }
    };
    let limits = Limits::of(Kind::Volume);
    let Series { head, files: order } = arrange(&heads, named.transpose()?, &name, &limits)?;
    let below: Vec<PathBuf> = folders.iter().filter_map(|folder| dicom_files(folder).ok()).flat_map(|(files, _)| files).collect();
    let heads_below = read_file_heads(many(below.clone(), DICOM_HEAD_BYTES), below.len())?;
    let more = more_slices(&heads, &order, &heads_below);
    if more > 0 {
        return Err(format!("{more} more slices of this series lie in folders below; put all of them into one folder"));
    }
    let (in_order, slices_of_files): (Vec<PathBuf>, Vec<Vec<usize>>) =
        order.into_iter().map(|(file, slices)| (files[file].clone(), slices)).unzip();
    Ok(Form::Series { files: in_order, wanted: Box::new(SlicesWanted { head, slices_of_files }) })
}

/// The DICOM files of a folder in the order of their names, and the folders in it. What ends as a DICOM file does and is none
/// counts as one: it is damaged.
fn dicom_files(folder: &Path) -> Result<(Vec<PathBuf>, Vec<PathBuf>), String> {
    let unreadable = |error: std::io::Error| format!("cannot be read ({error})");
    let (mut files, mut folders) = (Vec::new(), Vec::new());
    for (count, entry) in std::fs::read_dir(folder).map_err(unreadable)?.enumerate() {
        if count >= MOST_ENTRIES {
            return Err(format!("the folder holds more than {MOST_ENTRIES} entries; name one that has the slices alone"));
        }
        let path = entry.map_err(unreadable)?.path();
        let Ok(metadata) = std::fs::metadata(&path) else { continue };
        if metadata.is_dir() {
            folders.push(path);
            continue;
        }
        let ends_so = path.extension().is_some_and(|ending| ending.eq_ignore_ascii_case("dcm"));
        if metadata.is_file() && (ends_so || begins_so(&path)) {
            files.push(path);
        }
    }
    files.sort();
    Ok((files, folders))
}

fn begins_so(path: &Path) -> bool {
    let mut head = Vec::new();
    let read = foreign::open_regular(path, u64::MAX).map(|open| open.file.take(HEAD_BYTES).read_to_end(&mut head));
    matches!(read, Ok(Ok(_))) && is_dicom(&head)
}
