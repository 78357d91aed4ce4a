//! What a helper process may take.

use super::kind::Kind;

/// Limits of one helper and of what it may hand back.
#[derive(Clone, Debug, PartialEq, serde::Serialize, serde::Deserialize)]
pub struct Limits {
    /// Size of the file.
    pub file_bytes: u64,
    /// Address space of the helper.
    pub memory_bytes: u64,
    /// Processor time of the helper, whole seconds.
    pub cpu_s: u64,
    /// Time by the wall clock, after which the helper is killed.
    pub wall_s: f64,
    /// Pixels of one image.
    pub image_pixels: u64,
    /// Pixels, voxels or triangles of the file together.
    pub file_pixels: u64,
    /// Images in the file.
    pub images: u64,
}

impl Limits {
    /// The usual limits for `kind`: several times what a radiograph, a CT or a bone surface takes.
    #[must_use]
    pub fn of(kind: Kind) -> Self {
        match kind {
            Kind::Frames => Self {
                file_bytes: 1 << 30,
                memory_bytes: 3 << 30,
                cpu_s: 15,
                wall_s: 30.0,
                image_pixels: 1 << 26,
                file_pixels: 1 << 28,
                images: 4096,
            },
            Kind::Volume | Kind::VolumeFacts | Kind::VolumeHeader | Kind::Slices => Self {
                file_bytes: 9 << 30,
                memory_bytes: 3 << 30,
                cpu_s: 180,
                wall_s: 600.0,
                image_pixels: 1 << 30,
                file_pixels: 1 << 30,
                images: 1,
            },
            Kind::Mesh => Self {
                file_bytes: 2 << 30,
                memory_bytes: 3 << 30,
                cpu_s: 60,
                wall_s: 180.0,
                image_pixels: 10_000_000,
                file_pixels: 10_000_000,
                images: 1,
            },
        }
    }
}

/// Descriptors a helper may hold: its three and what its libraries open.
#[cfg(unix)]
const DESCRIPTORS: u64 = 64;

/// Imposes `limits` on this process; the first thing that a helper does. No core is ever dumped, because it would hold patient data, and no
/// file can be written.
///
/// # Errors
/// When the system refuses a limit.
#[cfg(unix)]
pub fn impose(limits: &Limits) -> std::io::Result<()> {
    impose_all(limits, rustix::process::Rlimit { current: Some(limits.cpu_s), maximum: Some(limits.cpu_s + 1) })
}

/// Imposes `limits` for the next of several files: processor time counts from here on, and all else is as [`impose`] has it.
///
/// # Errors
/// When the system refuses a limit.
#[cfg(unix)]
pub fn impose_on_next(limits: &Limits) -> std::io::Result<()> {
    use rustix::process::{Resource, Rlimit, getrlimit};
    use rustix::time::{ClockId, clock_gettime};
    let used_s = u64::try_from(clock_gettime(ClockId::ProcessCPUTime).tv_sec).unwrap_or(0);
    // What whoever started the session is given cannot be raised.
    let most = getrlimit(Resource::Cpu).maximum;
    let current_s = (used_s + limits.cpu_s + 1).min(most.unwrap_or(u64::MAX));
    impose_all(limits, Rlimit { current: Some(current_s), maximum: most })
}

#[cfg(unix)]
fn impose_all(limits: &Limits, cpu: rustix::process::Rlimit) -> std::io::Result<()> {
    use rustix::process::{Resource, Rlimit, setrlimit};
    let both = |most: u64| Rlimit { current: Some(most), maximum: Some(most) };
    setrlimit(Resource::Core, both(0))?;
    setrlimit(Resource::Fsize, both(0))?;
    setrlimit(Resource::Nofile, both(DESCRIPTORS))?;
    setrlimit(Resource::Cpu, cpu)?;
    // macOS has no limit on address space that it keeps.
    #[cfg(target_os = "linux")]
    setrlimit(Resource::As, both(limits.memory_bytes))?;
    Ok(())
}

/// Elsewhere only the wall clock and the checks of sizes protect.
///
/// # Errors
/// Never.
#[cfg(not(unix))]
pub fn impose(_limits: &Limits) -> std::io::Result<()> {
    Ok(())
}

/// As [`impose`].
///
/// # Errors
/// Never.
#[cfg(not(unix))]
pub fn impose_on_next(_limits: &Limits) -> std::io::Result<()> {
    Ok(())
}
