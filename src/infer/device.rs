//! Where networks are computed: the processor, or the GPU that is open already.

use std::sync::{Arc, OnceLock};

use burn::tensor::{Device, Tensor};

use crate::gpu::{self, GpuError};

/// Where networks are computed.
#[derive(Clone, Debug)]
pub struct NetworkDevice {
    /// For tensors.
    pub device: Device,
    /// Its name, driver and version.
    pub name: String,
    /// What went wrong on it first.
    fault: Arc<OnceLock<String>>,
}

impl Default for NetworkDevice {
    /// The processor.
    fn default() -> Self {
        // However many threads it has, it comes to the same bits.
        let name = format!("processor, {}", std::env::consts::ARCH);
        Self { device: Device::flex(), name, fault: Arc::default() }
    }
}

impl NetworkDevice {
    /// Whether that is the processor.
    #[must_use]
    pub fn is_processor(&self) -> bool {
        is_processor(&self.device)
    }

    /// `device`, shared: nothing is opened twice. Call it once for each.
    ///
    /// # Errors
    /// When a GPU will not do.
    pub fn of(device: &gpu::Device) -> Result<Self, GpuError> {
        match device {
            gpu::Device::Cpu => Ok(Self::default()),
            gpu::Device::Gpu(gpu) => {
                let device = tensors_on(gpu)?;
                let fault = Arc::new(OnceLock::new());
                let first = Arc::clone(&fault);
                // In place of the panic that the tensors' own handler makes of it.
                gpu.device.on_uncaptured_error(Arc::new(move |error: wgpu::Error| drop(first.set(error.to_string()))));
                Ok(Self { device, name: gpu.adapter.clone(), fault })
            }
        }
    }

    /// What went wrong on it, such as that it has no memory left: then nothing that it says counts any more.
    #[must_use]
    pub fn fault(&self) -> Option<&str> {
        self.fault.get().map(String::as_str)
    }
}

/// The values of `tensor`; what the device says where it fails.
///
/// # Errors
/// When the device is lost.
pub fn fetched<const D: usize>(tensor: Tensor<D>) -> Result<Vec<f32>, String> {
    let data = tensor.try_into_data().map_err(|error| error.to_string())?;
    // A GPU's values may come only now.
    Ok(data.as_slice::<f32>().map_err(|error| error.to_string())?.to_vec())
}

/// Whether tensors of `device` are computed by the processor.
pub(super) fn is_processor(device: &Device) -> bool {
    device.clone().inner() == Device::flex()
}

#[cfg(feature = "learn-gpu")]
fn tensors_on(gpu: &gpu::Gpu) -> Result<Device, GpuError> {
    use burn::tensor::wgpu::WgpuSetup;

    let gpu::Gpu { instance, wgpu_adapter, device, queue, adapter, .. } = gpu;
    let setup = WgpuSetup {
        instance: instance.clone(),
        adapter: wgpu_adapter.clone(),
        device: device.clone(),
        queue: queue.clone(),
        backend: wgpu_adapter.get_info().backend,
    };
    let open = |detail: String| GpuError::Open { adapter: adapter.clone(), detail };
    Device::wgpu_options().setup(setup).init().map_err(|error| open(error.to_string()))
}

#[cfg(not(feature = "learn-gpu"))]
fn tensors_on(gpu: &gpu::Gpu) -> Result<Device, GpuError> {
    let detail = "this program was built without the feature learn-gpu; use --device cpu".to_owned();
    Err(GpuError::Open { adapter: gpu.adapter.clone(), detail })
}
