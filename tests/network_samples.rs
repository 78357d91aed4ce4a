//! Samples whose scatter follows from their inputs by a simple rule.

use std::path::Path;

use sidecarm::infer::{CELL_COLUMNS, CELL_ROWS, COLUMNS, ROWS};
use sidecarm::learn::Shard;
use sidecarm::random::{Purpose, Stream};

pub const CHANNELS: [&str; 9] =
    ["transmission", "compton", "rayleigh", "photo", "height_mm", "spread_mm", "open", "x_mm", "y_mm"];
pub const SCALARS: [&str; 6] = ["sdd_mm", "mean_kev", "width_mm", "height_mm", "grid_ratio", "softer_response"];

/// `count` samples with seeds from `first` on, of the specimens `knee` and `hip` by turns.
pub fn shard(first: u64, count: u64) -> Shard {
    let mut shard = Shard {
        channels: CHANNELS.map(str::to_owned).to_vec(),
        scalar_names: SCALARS.map(str::to_owned).to_vec(),
        grid_px: [COLUMNS, ROWS],
        truth_px: [CELL_COLUMNS, CELL_ROWS],
        ..Shard::default()
    };
    for seed in first..first + count {
        let mut stream = Stream::new(seed, 0, 0, Purpose::Evaluation);
        let mut between = |low: f64, high: f64| low + (high - low) * stream.uniform();
        let (x0, y0, width, depth) = (between(-60.0, 60.0), between(-40.0, 40.0), between(30.0, 80.0), between(1.0, 4.0));
        let (kev, height) = (between(40.0, 70.0), between(150.0, 350.0));
        let pixel_mm = 300.0 / COLUMNS as f64;
        let thickness = |x: f64, y: f64| depth * (-((x - x0).powi(2) + (y - y0).powi(2)) / (2.0 * width * width)).exp();
        let mut pages = vec![Vec::new(); CHANNELS.len()];
        for row in 0..ROWS {
            for column in 0..COLUMNS {
                let x = (column as f64 + 0.5 - COLUMNS as f64 / 2.0) * pixel_mm;
                let y = (row as f64 + 0.5 - ROWS as f64 / 2.0) * pixel_mm;
                let t = thickness(x, y);
                let values = [(-t).exp(), 0.7 * t, 0.1 * t, 0.2 * t, height + 0.1 * t, 20.0 * t, 1.0, x, y];
                pages.iter_mut().zip(values).for_each(|(page, value)| page.push(value as f32));
            }
        }
        shard.inputs.extend(pages.into_iter().flatten());
        shard.scalars.extend([1000.0, kev as f32, 300.0, 225.0, 0.0, 1.1]);
        let scale = 0.1 * depth;
        shard.scale.push(scale as f32);
        let mut of_sum = vec![0.0_f32; CELL_ROWS * CELL_COLUMNS];
        for multiple in [false, true] {
            for (cell, of_sum) in of_sum.iter_mut().enumerate() {
                let x = ((cell % CELL_COLUMNS) as f64 + 0.5 - CELL_COLUMNS as f64 / 2.0) * 4.0 * pixel_mm;
                let y = ((cell / CELL_COLUMNS) as f64 + 0.5 - CELL_ROWS as f64 / 2.0) * 4.0 * pixel_mm;
                let t = thickness(x, y);
                let value =
                    if multiple { 0.5 * scale * (50.0 / kev) * (0.3 * t).exp() } else { scale * (0.2 + t) * (-0.5 * t).exp() };
                shard.truth.push((value * (1.0 + 0.02 * stream.normal())) as f32);
                shard.truth_error.push((0.02 * value) as f32);
                *of_sum = of_sum.hypot((0.02 * value) as f32);
            }
        }
        shard.truth_error.extend(of_sum);
        shard.specimens.push(if seed % 2 == 0 { "knee" } else { "hip" }.to_owned());
        shard.seeds.push(seed);
    }
    shard
}

/// A folder with two files of samples.
pub fn write(folder: &Path, count: u64) {
    shard(0, count / 2).write(&folder.join("a.safetensors")).expect("the test's own files");
    shard(count / 2, count - count / 2).write(&folder.join("b.safetensors")).expect("the test's own files");
}
