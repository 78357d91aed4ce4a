//! The bone of a CT by a network, asked once for each CT: what it said is kept in the user's cache folder.

use std::io::{Read, Write};
use std::path::Path;

use flate2::Compression;
use flate2::read::ZlibDecoder;
use flate2::write::ZlibEncoder;
use sha2::{Digest, Sha256};

use super::volumes::VolumeFile;
use crate::image::{cache_file, hex, sha256_bytes, write_atomically};
use crate::infer::materials::{HuVolume, LoadedMaterials};
use crate::infer::{InferError, NetworkDevice};
use crate::memory;
use crate::regular;
use crate::reporter::{Progress, Reporter};
use crate::time::Stopwatch;

/// Changes when the same weights would say something else.
const VERSION: u32 = 1;

/// How the files of the cache begin.
const KEPT: &str = "bone-";
/// CTs whose bone is kept.
const MOST_KEPT: usize = 16;
/// Where no bar is shown, a line says how far it is as often as this.
const TOLD_EVERY_MS: f64 = 10e3;

/// A materials network, and what is asked of it.
pub(super) struct BoneNetwork(LoadedMaterials);

impl BoneNetwork {
    /// The network `name`, or the one that comes with the program.
    ///
    /// # Errors
    /// As [`LoadedMaterials::load`].
    pub fn open(name: Option<&Path>) -> Result<Self, InferError> {
        Ok(Self(match name {
            Some(name) => LoadedMaterials::load(name)?,
            None => LoadedMaterials::shipped(NetworkDevice::default())?,
        }))
    }

    /// SHA-256 of its weights, in hexadecimal.
    pub fn sha256(&self) -> &str {
        &self.0.card().weights_sha256
    }

    /// Which voxels of `ct`, called `name`, are bone, and the hash of that; a warning where it is unlike what the network was trained on.
    ///
    /// # Errors
    /// One sentence, when it takes more memory than is free.
    pub fn bone(&self, ct: &VolumeFile, name: &str, reporter: &Reporter) -> Result<(Vec<bool>, String), String> {
        if let Some(words) = self.0.card().outside(ct.spacing_mm) {
            reporter.warn("materials", format_args!("{name}: the network was not trained for this CT: {words}"));
        }
        let volume = HuVolume { grid: ct.grid(), hu: &ct.values };
        let what = format!("{name}: the grids of the network over voxels of {:.2?} mm", ct.spacing_mm);
        if let Some(refusal) = memory::refusal(&what, self.0.bytes(&volume), memory::available_bytes()) {
            return Err(refusal);
        }
        let kept = cache_file(&format!("{KEPT}{}.bits", self.key(ct)));
        let bone = kept.as_deref().and_then(|path| read(path, ct.values.len())).unwrap_or_else(|| {
            let bone = self.ask(&volume, name, reporter);
            // A cache that cannot be written is no error.
            if let Some(path) = &kept
                && write(path, &bone).is_ok()
            {
                forget(path);
            }
            bone
        });
        let hash = sha256_bytes(&bits(&bone));
        Ok((bone, hash))
    }

    fn ask(&self, volume: &HuVolume<'_>, name: &str, reporter: &Reporter) -> Vec<bool> {
        reporter.announce("asking the network for the bone of a CT: minutes on a processor, once; what it says is kept");
        let mut bar: Option<(&str, Progress, usize)> = None;
        let mut silent = Stopwatch::start();
        self.0.bone(volume, &mut |pass, done, all| {
            if bar.as_ref().is_none_or(|(of, ..)| *of != pass.name) {
                bar = Some((pass.name, reporter.progress(&format!("{name}: bone, {}", pass.name), all as u64), 0));
            }
            if let Some((_, bar, told)) = &mut bar {
                bar.advance((done - *told) as u64);
                *told = done;
                if !bar.is_shown() && silent.ms() >= TOLD_EVERY_MS {
                    silent = Stopwatch::start();
                    reporter.announce(format_args!("bone, {}: {done} of {all}", pass.name));
                }
            }
        })
    }

    /// What the answer hangs on.
    fn key(&self, ct: &VolumeFile) -> String {
        let mut hash = Sha256::new();
        hash.update(VERSION.to_le_bytes());
        hash.update(self.sha256());
        ct.size.iter().for_each(|size| hash.update((*size as u64).to_le_bytes()));
        ct.lps_from_voxel.to_cols_array().iter().for_each(|value| hash.update(value.to_le_bytes()));
        for values in ct.values.chunks(1 << 14) {
            let bytes: Vec<u8> = values.iter().flat_map(|value| value.to_le_bytes()).collect();
            hash.update(&bytes);
        }
        hex(&hash.finalize())
    }
}

/// One bit a voxel.
fn bits(bone: &[bool]) -> Vec<u8> {
    let eight = |eight: &[bool]| eight.iter().enumerate().map(|(at, is_bone)| u8::from(*is_bone) << at).sum();
    bone.chunks(8).map(eight).collect()
}

/// One bit a voxel and their hash, compressed, for nobody else to read: it has the shape of a person's bones.
fn write(path: &Path, bone: &[bool]) -> std::io::Result<()> {
    let bits = bits(bone);
    let mut encoder = ZlibEncoder::new(Vec::new(), Compression::fast());
    encoder.write_all(&Sha256::digest(&bits))?;
    encoder.write_all(&bits)?;
    let bytes = encoder.finish()?;
    if let Some(folder) = path.parent() {
        std::fs::create_dir_all(folder)?;
    }
    write_atomically(path, |file| file.write_all(&bytes)).map_err(std::io::Error::other)?;
    #[cfg(unix)]
    std::fs::set_permissions(path, std::os::unix::fs::PermissionsExt::from_mode(0o600))?;
    Ok(())
}

/// Removes what was said longest ago of other CTs, beside `path`, beyond the latest few.
fn forget(path: &Path) {
    let Some(folder) = path.parent().and_then(|folder| std::fs::read_dir(folder).ok()) else { return };
    let is_kept = |name: &str| name.starts_with(KEPT) && name.ends_with(".bits");
    let mut kept: Vec<_> = folder
        .filter_map(Result::ok)
        .filter(|entry| is_kept(&entry.file_name().to_string_lossy()))
        .filter_map(|entry| Some((entry.metadata().ok()?.modified().ok()?, entry.path())))
        .collect();
    kept.sort();
    let too_many = kept.len().saturating_sub(MOST_KEPT);
    kept.iter().take(too_many).for_each(|(_, path)| {
        let _ = std::fs::remove_file(path);
    });
}

/// What [`write`] left there of `count` voxels; `None` where it is not that.
fn read(path: &Path, count: usize) -> Option<Vec<bool>> {
    let file = regular::open(path).ok()?;
    let (hash_bytes, most) = (32, count.div_ceil(8));
    let mut bytes = Vec::new();
    ZlibDecoder::new(file).take((hash_bytes + most + 1) as u64).read_to_end(&mut bytes).ok()?;
    let (hash, bits) = bytes.split_at_checked(hash_bytes)?;
    let is_whole = bits.len() == most && Sha256::digest(bits).as_slice() == hash;
    is_whole.then(|| (0..count).map(|index| bits[index / 8] >> (index % 8) & 1 == 1).collect())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_was_said_comes_back_and_a_damaged_file_says_nothing() {
        let folder = tempfile::tempdir().expect("a folder");
        let path = folder.path().join("deep/bone.bits");
        let bone: Vec<bool> = (0..1003).map(|index| index % 7 == 0 || index % 31 == 3).collect();
        write(&path, &bone).expect("written");
        assert_eq!(read(&path, 1003), Some(bone));
        assert_eq!(read(&path, 1020), None, "of another CT");
        let bytes = std::fs::read(&path).expect("there");
        std::fs::write(&path, &bytes[..bytes.len() - 9]).expect("written");
        assert_eq!(read(&path, 1003), None, "cut off");
        let mut other = bytes.clone();
        other[60] ^= 4;
        std::fs::write(&path, &other).expect("written");
        assert_eq!(read(&path, 1003), None, "damaged");
        assert_eq!(read(&folder.path().join("none"), 1003), None);
    }

    #[test]
    fn the_latest_few_are_kept() {
        let folder = tempfile::tempdir().expect("a folder");
        let path = |number: usize| folder.path().join(format!("bone-{number:02}.bits"));
        std::fs::write(folder.path().join("speed.json"), "{}").expect("written");
        let start = std::time::SystemTime::UNIX_EPOCH + std::time::Duration::from_secs(1_000_000);
        for number in 0..MOST_KEPT + 3 {
            write(&path(number), &[true, false]).expect("written");
            let at = start + std::time::Duration::from_secs(number as u64);
            std::fs::File::options().write(true).open(path(number)).and_then(|file| file.set_modified(at)).expect("set");
        }
        forget(&path(0));
        let there: Vec<usize> = (0..MOST_KEPT + 3).filter(|number| path(*number).exists()).collect();
        assert_eq!(there, (3..MOST_KEPT + 3).collect::<Vec<_>>());
        assert!(folder.path().join("speed.json").exists());
    }
}
