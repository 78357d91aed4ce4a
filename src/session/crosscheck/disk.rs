//! Whether the session's folder can be written, how much fits and how fast.

use std::io::Write;
use std::path::{Path, PathBuf};

use super::finding::{Finding, Level};
use crate::time::Stopwatch;

const CHECK: &str = "disk";
/// What is written to learn the speed.
const SAMPLE_BYTES: usize = 16 << 20;
/// A 1536² frame with its DRR and strip is about 20 MB; several must fit into a burst.
const LEAST_BYTES: u64 = 1 << 30;
/// Ten hours with some hundred frames.
const AMPLE_BYTES: u64 = 10 << 30;
/// Below the first a burst of frames is written later than it comes; below the second telemetry is at risk.
const SLOW_MB_PER_S: f64 = 20.0;
const TOO_SLOW_MB_PER_S: f64 = 1.0;

/// Checks the folder that a session would create, whose frames come into `frames`; nothing stays behind. No path is told: folders are called
/// after persons.
#[must_use]
pub fn check_disk(out: &Path, frames: &Path) -> Vec<Finding> {
    if out.join("session.mcap").exists() {
        let detail = "there is a session in the session's folder already";
        return vec![Finding::fail(CHECK, detail, "choose another --out; logs are never written over")];
    }
    let Some(folder) = nearest_folder(out) else {
        return vec![Finding::fail(CHECK, "the session's folder would lie in no folder", "choose another --out")];
    };
    vec![among_frames(out, &folder, frames), writing(&folder), space(free_bytes(&folder))]
}

/// What is to be said where the session would take what it writes for frames, or frames for what it writes.
#[must_use]
pub fn refuse_among_frames(out: &Path, frames: &Path) -> Option<String> {
    let folder = nearest_folder(out)?;
    let Finding { level, detail, .. } = among_frames(out, &folder, frames);
    (level == Level::Fail).then_some(detail)
}

/// Whether the session would write into the folder in which it looks for frames; `folder` is the part of `out` that exists.
fn among_frames(out: &Path, folder: &Path, frames: &Path) -> Finding {
    const CHECK: &str = "own folder";
    const REMEDY: &str =
        "choose another --out: a folder that a console or a share fills may be emptied or copied away with all that is in it";
    let whole = |path: &Path| std::fs::canonicalize(path).ok();
    let rest = std::path::absolute(out).ok().and_then(|out| out.strip_prefix(folder).map(Path::to_owned).ok());
    let (Some(out), Some(frames)) = (whole(folder).zip(rest).map(|(folder, rest)| folder.join(rest)), whole(frames)) else {
        return Finding::pass(CHECK, "the frames' folder is not there yet");
    };
    if ["strips", "drr"].iter().any(|part| frames.starts_with(out.join(part))) {
        return Finding::fail(CHECK, "frames would be looked for among what the session writes", REMEDY);
    }
    match out.strip_prefix(&frames) {
        Ok(below) if below.as_os_str().is_empty() => {
            Finding::fail(CHECK, "the session's folder is the folder in which frames are looked for", REMEDY)
        }
        Ok(_) => Finding::warn(CHECK, "the session's folder lies in the folder in which frames are looked for", REMEDY),
        Err(_) => Finding::pass(CHECK, "apart from the frames' folder"),
    }
}

/// The folder itself, or the one in which it would be created; a file in its place is returned as it is, and writing fails there.
fn nearest_folder(out: &Path) -> Option<PathBuf> {
    let absolute = std::path::absolute(out).ok()?;
    absolute.ancestors().find(|path| path.exists()).map(Path::to_owned)
}

fn writing(folder: &Path) -> Finding {
    let sample: Vec<u8> = (0..SAMPLE_BYTES as u32).map(|n| (n.wrapping_mul(2_654_435_761) >> 24) as u8).collect();
    let write = || -> std::io::Result<f64> {
        let watch = Stopwatch::start();
        let mut file = tempfile::tempfile_in(folder)?;
        file.write_all(&sample)?;
        file.sync_all()?;
        Ok(watch.ms())
    };
    match write() {
        Err(error) => {
            // The system's whole words name a file.
            let detail = format!("the session's folder cannot be written ({})", error.kind());
            Finding::fail(CHECK, detail, "choose another --out, or make the folder writable and free space on its disk")
        }
        Ok(ms) => speed(SAMPLE_BYTES as f64 * 1e-6 / (ms.max(1e-3) * 1e-3)),
    }
}

/// Whether a disk that is written at `mb_per_s` is fast enough.
fn speed(mb_per_s: f64) -> Finding {
    let detail = format!("the session's folder is written at {mb_per_s:.0} MB/s");
    if !(mb_per_s >= TOO_SLOW_MB_PER_S) {
        Finding::fail(CHECK, detail, "write to a local disk and copy the session afterwards")
    } else if !(mb_per_s >= SLOW_MB_PER_S) {
        Finding::warn(CHECK, detail, "frames in quick succession are written late; a local disk is faster")
    } else {
        Finding::pass(CHECK, detail)
    }
}

/// Bytes that this user may still write.
#[cfg(unix)]
pub(crate) fn free_bytes(folder: &Path) -> Option<u64> {
    let found = rustix::fs::statvfs(folder).ok()?;
    found.f_bavail.checked_mul(found.f_frsize)
}

#[cfg(not(unix))]
pub(crate) fn free_bytes(_folder: &Path) -> Option<u64> {
    None
}

/// Whether `free` bytes are enough.
fn space(free: Option<u64>) -> Finding {
    const CHECK: &str = "disk space";
    let Some(free) = free else { return Finding::pass(CHECK, "the system does not say how much is free") };
    let detail = format!("{:.1} GB free where the session is written", free as f64 * 1e-9);
    if free < LEAST_BYTES {
        Finding::fail(CHECK, detail, "free at least 1 GB, or choose another --out")
    } else if free < AMPLE_BYTES {
        Finding::warn(CHECK, detail, "a long session with full-size frames needs 10 GB")
    } else {
        Finding::pass(CHECK, detail)
    }
}

#[cfg(test)]
mod tests {
    use super::super::finding::Level;
    use super::*;

    #[test]
    fn too_little_space_is_said_with_what_to_do_and_enough_is_not() {
        const GIB: u64 = 1 << 30;
        let mut cases = 0;
        for (free, level, shown, remedy) in [
            (0, Level::Fail, "0.0 GB free", Some("free at least 1 GB, or choose another --out")),
            (GIB - 1, Level::Fail, "1.1 GB free", Some("free at least 1 GB, or choose another --out")),
            (GIB, Level::Warn, "1.1 GB free", Some("a long session with full-size frames needs 10 GB")),
            (10 * GIB - 1, Level::Warn, "10.7 GB free", Some("a long session with full-size frames needs 10 GB")),
            (10 * GIB, Level::Pass, "10.7 GB free", None),
        ] {
            let found = space(Some(free));
            assert_eq!((found.check.as_str(), found.level, found.remedy.as_deref()), ("disk space", level, remedy), "{free}");
            assert_eq!(found.detail, format!("{shown} where the session is written"));
            cases += 1;
        }
        assert_eq!(cases, 5);
        assert_eq!(space(None).level, Level::Pass, "nobody knows");
    }

    #[test]
    fn a_slow_disk_is_said_with_what_to_do_and_a_fast_one_is_not() {
        const LOCAL: Option<&str> = Some("write to a local disk and copy the session afterwards");
        const LATE: Option<&str> = Some("frames in quick succession are written late; a local disk is faster");
        let mut cases = 0;
        for (mb_per_s, level, shown, remedy) in [
            (f64::NAN, Level::Fail, "NaN", LOCAL),
            (0.99, Level::Fail, "1", LOCAL),
            (1.0, Level::Warn, "1", LATE),
            (19.9, Level::Warn, "20", LATE),
            (20.0, Level::Pass, "20", None),
        ] {
            let found = speed(mb_per_s);
            assert_eq!((found.check.as_str(), found.level, found.remedy.as_deref()), ("disk", level, remedy), "{mb_per_s}");
            assert_eq!(found.detail, format!("the session's folder is written at {shown} MB/s"));
            cases += 1;
        }
        assert_eq!(cases, 5);
    }
}
