//! Which device renders: a hardware GPU where there is one, else the CPU executor; software Vulkan serves to test the shaders.

mod dispatch;
mod shaders;

pub use dispatch::{compile, dispatch, finish, flat_groups, wait};
pub use shaders::{STEMS, source};

use crate::reporter::Reporter;

/// What the user asked for.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, serde::Serialize, serde::Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum DeviceChoice {
    /// A hardware GPU if present, else the CPU.
    #[default]
    Auto,
    /// A hardware GPU.
    Gpu,
    /// Native code on all cores.
    Cpu,
    /// A Vulkan implementation on the CPU; slower than `Cpu`, runs the shaders.
    SoftwareVulkan,
}

/// Why there is no such device, or no longer.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum GpuError {
    /// No adapter of the wanted kind.
    #[error("no {wanted} found among {found} adapters; {remedy}")]
    NotThere {
        /// What was asked for.
        wanted: &'static str,
        /// Adapters that exist, of other kinds.
        found: usize,
        /// What to do about it.
        remedy: &'static str,
    },
    /// The adapter exists but refuses to open.
    #[error("{adapter}: cannot be opened: {detail}")]
    Open {
        /// Its name.
        adapter: String,
        /// What the driver said.
        detail: String,
    },
    /// The device was lost while working.
    #[error("{adapter}: device lost: {detail}; render again, or use --device cpu")]
    Lost {
        /// Its name.
        adapter: String,
        /// What the driver said.
        detail: String,
    },
    /// The device has no room left.
    #[error("{adapter}: no room for {what} of {needed_mib} MiB; close what else uses the device, or use --device cpu")]
    Memory {
        /// Its name.
        adapter: String,
        /// What does not fit.
        what: &'static str,
        /// MiB that it needs.
        needed_mib: u64,
    },
    /// More is needed than the device offers.
    #[error("{adapter}: {what} needs {needed}, the device allows {limit}; use --device cpu")]
    Limit {
        /// Its name.
        adapter: String,
        /// What is too large.
        what: &'static str,
        /// How much is needed.
        needed: u64,
        /// How much is possible.
        limit: u64,
    },
}

/// An open device.
#[derive(Debug)]
pub struct Gpu {
    /// What it was found through, for those who share it.
    pub instance: wgpu::Instance,
    /// Of which it is a device.
    pub wgpu_adapter: wgpu::Adapter,
    /// The device.
    pub device: wgpu::Device,
    /// Its queue.
    pub queue: wgpu::Queue,
    /// Name, driver and driver version, for provenance.
    pub adapter: String,
    /// Whether it runs on the CPU.
    pub software: bool,
}

/// What will render.
#[derive(Debug)]
pub enum Device {
    /// Native code on all cores.
    Cpu,
    /// The shaders.
    Gpu(Box<Gpu>),
}

impl Device {
    /// Opens what `choice` names; says aloud when `auto` falls back to the CPU.
    ///
    /// # Errors
    /// When a device was asked for that is not there, or cannot be opened.
    pub fn open(choice: DeviceChoice, reporter: &Reporter) -> Result<Self, GpuError> {
        match choice {
            DeviceChoice::Cpu => Ok(Self::Cpu),
            DeviceChoice::Auto => match open_gpu(false) {
                Ok(gpu) => Ok(Self::Gpu(Box::new(gpu))),
                Err(GpuError::NotThere { .. }) => {
                    reporter.note(format_args!("no hardware GPU found: rendering on {}", cpu_name_with_threads()));
                    Ok(Self::Cpu)
                }
                Err(error) => {
                    reporter.warn("gpu", format_args!("{error}: rendering on {}", cpu_name_with_threads()));
                    Ok(Self::Cpu)
                }
            },
            DeviceChoice::Gpu => Ok(Self::Gpu(Box::new(open_gpu(false)?))),
            DeviceChoice::SoftwareVulkan => Ok(Self::Gpu(Box::new(open_gpu(true)?))),
        }
    }

    /// Name, driver and version, for provenance.
    #[must_use]
    pub fn name(&self) -> String {
        match self {
            Self::Cpu => cpu_name(),
            Self::Gpu(gpu) => gpu.adapter.clone(),
        }
    }

    /// The same beside times: how long the CPU takes depends on its threads, what it draws does not.
    #[must_use]
    pub fn name_with_threads(&self) -> String {
        match self {
            Self::Cpu => cpu_name_with_threads(),
            Self::Gpu(gpu) => gpu.adapter.clone(),
        }
    }
}

/// The CPU executor's name with how many threads it has.
#[must_use]
pub fn cpu_name_with_threads() -> String {
    format!("{} ({} threads)", cpu_name(), rayon::current_num_threads())
}

/// The CPU executor's name, for files that are the same however many threads made them.
#[must_use]
pub fn cpu_name() -> String {
    #[cfg(target_arch = "x86_64")]
    let wide = std::is_x86_feature_detected!("avx512vl") && std::is_x86_feature_detected!("avx512dq");
    #[cfg(not(target_arch = "x86_64"))]
    let wide = false;
    let instructions = if wide { ", AVX-512" } else { "" };
    format!("CPU executor, {}{instructions}", std::env::consts::ARCH)
}

fn open_gpu(software: bool) -> Result<Gpu, GpuError> {
    let instance = wgpu::Instance::new(wgpu::InstanceDescriptor::new_without_display_handle());
    let adapters = pollster::block_on(instance.enumerate_adapters(wgpu::Backends::PRIMARY));
    let found = adapters.len();
    let is_wanted = |kind: wgpu::DeviceType| match kind {
        wgpu::DeviceType::Cpu => software,
        wgpu::DeviceType::Other => false,
        _ => !software,
    };
    let rank = |adapter: &wgpu::Adapter| match adapter.get_info().device_type {
        wgpu::DeviceType::DiscreteGpu => 0,
        wgpu::DeviceType::IntegratedGpu => 1,
        _ => 2,
    };
    let adapter = adapters.into_iter().filter(|adapter| is_wanted(adapter.get_info().device_type)).min_by_key(rank);
    let Some(adapter) = adapter else {
        return Err(if software {
            GpuError::NotThere {
                wanted: "software Vulkan",
                found,
                remedy: "install it (Debian: apt-get install mesa-vulkan-drivers libvulkan1)",
            }
        } else {
            GpuError::NotThere {
                wanted: "hardware GPU",
                found,
                remedy: "install its Vulkan driver and the loader (Debian: apt-get install libvulkan1 mesa-vulkan-drivers, \
                         or nvidia-driver), or use --device cpu",
            }
        });
    };
    let info = adapter.get_info();
    let name = format!("{} ({:?}, {} {})", info.name, info.backend, info.driver, info.driver_info);
    let request = adapter.request_device(&wgpu::DeviceDescriptor {
        required_features: adapter.features() & wanted_features(),
        required_limits: adapter.limits(),
        ..wgpu::DeviceDescriptor::default()
    });
    let (device, queue) =
        pollster::block_on(request).map_err(|error| GpuError::Open { adapter: name.clone(), detail: error.to_string() })?;
    Ok(Gpu { instance, wgpu_adapter: adapter, device, queue, adapter: name, software })
}

/// Beyond the standard, where the adapter has them: timestamps, and what the networks' kernels take for granted on an adapter that has it.
fn wanted_features() -> wgpu::Features {
    use wgpu::Features as F;
    let for_networks = if cfg!(feature = "learn-gpu") {
        F::SUBGROUP | F::SHADER_INT64 | F::SHADER_F64 | F::SHADER_F16 | F::SHADER_FLOAT32_ATOMIC
    } else {
        F::empty()
    };
    F::TIMESTAMP_QUERY | for_networks
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Reports and plans of two replays of one log differed in nothing but the number of threads.
    #[test]
    fn the_executors_name_in_files_is_the_same_with_any_number_of_threads() {
        let named = |threads: usize| {
            let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().expect("a pool");
            pool.install(|| (Device::Cpu.name(), Device::Cpu.name_with_threads()))
        };
        let ((one, one_timed), (two, two_timed)) = (named(1), named(2));
        assert_eq!(one, two);
        assert!(one_timed.ends_with("(1 threads)") && two_timed.ends_with("(2 threads)"), "{one_timed}; {two_timed}");
    }
}
