//! How long each pass took by the device's own clock.

use crate::gpu::Gpu;

/// Passes of a submission that are timed, at most.
const MOST_PASSES: u32 = 32;

/// Two timestamps a pass.
#[derive(Debug)]
pub struct PassTimes {
    set: wgpu::QuerySet,
    resolved: wgpu::Buffer,
    names: Vec<&'static str>,
    ns_per_tick: f64,
}

impl PassTimes {
    /// `None` where the device has no timestamps.
    #[must_use]
    pub fn new(gpu: &Gpu) -> Option<Self> {
        if !gpu.device.features().contains(wgpu::Features::TIMESTAMP_QUERY) {
            return None;
        }
        let count = 2 * MOST_PASSES;
        let set = gpu.device.create_query_set(&wgpu::QuerySetDescriptor {
            label: Some("pass times"),
            ty: wgpu::QueryType::Timestamp,
            count,
        });
        let resolved = gpu.device.create_buffer(&wgpu::BufferDescriptor {
            label: Some("pass times"),
            size: u64::from(count) * 8,
            usage: wgpu::BufferUsages::QUERY_RESOLVE | wgpu::BufferUsages::COPY_SRC,
            mapped_at_creation: false,
        });
        Some(Self { set, resolved, names: Vec::new(), ns_per_tick: f64::from(gpu.queue.get_timestamp_period()) })
    }

    /// Words that [`PassTimes::resolve`] makes ready to be copied.
    #[must_use]
    pub fn words(&self) -> usize {
        4 * MOST_PASSES as usize
    }

    /// Forgets the passes of the last submission.
    pub fn begin(&mut self) {
        self.names.clear();
    }

    /// Where the next pass writes its times; `None` beyond [`MOST_PASSES`].
    pub fn next(&mut self, name: &'static str) -> Option<wgpu::ComputePassTimestampWrites<'_>> {
        let first = 2 * self.names.len() as u32;
        if first >= 2 * MOST_PASSES {
            return None;
        }
        self.names.push(name);
        Some(wgpu::ComputePassTimestampWrites {
            query_set: &self.set,
            beginning_of_pass_write_index: Some(first),
            end_of_pass_write_index: Some(first + 1),
        })
    }

    /// Makes the times of all passes so far ready to be copied.
    pub fn resolve(&self, commands: &mut wgpu::CommandEncoder) -> &wgpu::Buffer {
        commands.resolve_query_set(&self.set, 0..2 * self.names.len() as u32, &self.resolved, 0);
        &self.resolved
    }

    /// Milliseconds by pass, from the words of the resolved buffer.
    #[must_use]
    pub fn ms(&self, words: &[f32]) -> Vec<(&'static str, f64)> {
        let (pairs, _) = words.as_chunks::<2>();
        let ticks: Vec<u64> =
            pairs.iter().map(|[low, high]| u64::from(low.to_bits()) | u64::from(high.to_bits()) << 32).collect();
        let (passes, _) = ticks.as_chunks::<2>();
        let ms = |[begin, end]: &[u64; 2]| end.saturating_sub(*begin) as f64 * self.ns_per_tick * 1e-6;
        self.names.iter().copied().zip(passes.iter().map(ms)).collect()
    }
}
