//! Networks on a GPU: what they learn and say there is what they learn and say on the processor.

use std::ops::ControlFlow;
use std::path::{Path, PathBuf};
use std::sync::OnceLock;

use sidecarm::gpu::{Device, DeviceChoice};
use sidecarm::infer::materials::LoadedMaterials;
use sidecarm::infer::{Input, LoadedNetwork, NetworkDevice, NetworkFiles, PIXELS, ScatterNetwork};
use sidecarm::learn::materials::phantom;
use sidecarm::learn::{HoldOut, LabelledSpecimen, Recipe, TrainOptions, Trained, train};
use sidecarm::random::{Purpose, Stream};
use sidecarm::reporter::Reporter;
use sidecarm::time::Stopwatch;
use sidecarm::transport::{CHANNELS, SCALARS};

use crate::materials_learn::middle_of;
use crate::network_samples as samples;

fn shared(device: &Device) -> NetworkDevice {
    NetworkDevice::of(device).unwrap_or_else(|error| panic!("{error}"))
}

/// Software Vulkan, or `None` with the reason printed.
fn software() -> Option<Device> {
    let opened = Device::open(DeviceChoice::SoftwareVulkan, &Reporter::silent());
    opened.map_err(|error| println!("skipped: {error}")).ok()
}

/// Software Vulkan as all but one test share it: what one has compiled is there for the next.
fn gpu() -> Option<NetworkDevice> {
    static SHARED: OnceLock<Option<NetworkDevice>> = OnceLock::new();
    SHARED.get_or_init(|| software().as_ref().map(shared)).clone()
}

/// A folder with so many samples.
fn folder_of(count: u64) -> tempfile::TempDir {
    let folder = tempfile::tempdir().expect("a folder");
    std::fs::create_dir(folder.path().join("samples")).expect("a folder");
    samples::write(&folder.path().join("samples"), count);
    folder
}

fn options(folder: &Path, name: &str, epochs: usize, device: NetworkDevice) -> TrainOptions {
    let hold_out = HoldOut::Specimens { names: vec!["hip".to_owned()] };
    let recipe = Recipe { epochs, batch: 2, hold_out, ..Recipe::default() };
    TrainOptions { device, ..TrainOptions::new(folder.join("samples"), folder.join(name), recipe) }
}

fn trained(options: &TrainOptions) -> (Trained, Vec<f32>) {
    let trained = train(options, &mut |_| ControlFlow::Continue(())).unwrap_or_else(|error| panic!("{error}"));
    let (_, parameters) = trained.files.network.read::<sidecarm::infer::Card>().expect("just written");
    (trained, parameters)
}

#[test]
fn a_gpu_trains_as_the_processor_does() {
    let Some(gpu) = gpu() else { return };
    // Two steps of two samples each.
    let folder = folder_of(8);
    let on = |name: &str, device: NetworkDevice| trained(&options(folder.path(), name, 1, device));
    let (processor, of_processor) = on("processor", NetworkDevice::default());
    let (on_gpu, of_gpu) = on("gpu", gpu.clone());
    assert!(
        on_gpu.card.training_devices == [gpu.name.as_str()] && !processor.card.training_devices.contains(&gpu.name),
        "{}",
        gpu.name
    );
    // Sums of f32 in another order, and what a few steps make of that.
    for (epoch, [a, b]) in processor.history.iter().zip(&on_gpu.history).map(|(a, b)| [a, b]).enumerate() {
        assert!((a.train_loss / b.train_loss - 1.0).abs() < 1e-3, "epoch {epoch}: {} {}", a.train_loss, b.train_loss);
        let [a, b] = [a, b].map(|record| record.held_out.expect("one is held out"));
        assert!((a / b - 1.0).abs() < 1e-2, "epoch {epoch}: {a} {b}");
    }
    let apart = of_processor.iter().zip(&of_gpu).map(|(a, b)| f64::from((a - b).abs())).sum::<f64>();
    let size = of_processor.iter().map(|value| f64::from(value.abs())).sum::<f64>();
    assert!(of_gpu.len() == of_processor.len() && apart / size < 1e-2, "{}", apart / size);
    // Other bits: it was computed elsewhere. And the same ones again.
    assert!(of_gpu != of_processor);
    assert!(of_gpu == on("again", gpu).1);
}

/// One that is lost, as by a driver's reset: a sentence, and what was done goes on elsewhere.
#[test]
fn a_training_on_a_lost_gpu_goes_on_from_the_last_epoch() {
    let Some(device) = software() else { return };
    let folder = folder_of(4);
    let lost = options(folder.path(), "lost", 2, shared(&device));
    let error = train(&lost, &mut |progress| {
        if let (Some(_), Device::Gpu(gpu)) = (progress.done, &device) {
            gpu.device.destroy();
        }
        ControlFlow::Continue(())
    });
    let error = error.expect_err("it is lost").to_string();
    assert!(error.contains(&lost.device.name) && error.contains("--resume"), "{error}");
    let resumed = TrainOptions { resume: true, ..options(folder.path(), "lost", 2, NetworkDevice::default()) };
    let (whole, _) = trained(&resumed);
    assert_eq!((whole.history.len(), whole.card.training_devices.len()), (2, 2), "{:?}", whole.card.training_devices);
}

#[test]
fn a_gpu_says_the_scatter_that_the_processor_says() {
    let Some(gpu) = gpu() else { return };
    let on = |device: &NetworkDevice| LoadedNetwork::shipped_on(device, &CHANNELS, &SCALARS).expect("it comes with the program");
    let networks = [NetworkDevice::default(), gpu].map(|device| on(&device));
    for number in 0..3 {
        let mut stream = Stream::new(7, 0, number, Purpose::Evaluation);
        let mut values = |count: usize| (0..count).map(|_| stream.uniform() as f32).collect::<Vec<f32>>();
        let input = Input { inputs: values(CHANNELS.len() * PIXELS), scalars: values(SCALARS.len()), scale: 0.1 };
        let [a, b] = [0, 1].map(|at| networks[at].predict(&input).expect("of its size"));
        let pairs = a.single.iter().zip(&b.single).chain(a.multiple.iter().zip(&b.multiple));
        let apart: Vec<f64> = pairs.map(|(a, b)| (a / b - 1.0).abs()).collect();
        assert!(apart.iter().all(|apart| *apart < 1e-3) && apart.iter().any(|apart| *apart > 0.0), "{apart:?}");
    }
}

#[test]
fn a_gpu_finds_the_bone_that_the_processor_finds() {
    let Some(gpu) = gpu() else { return };
    let specimen = middle_of(&phantom(3, &[], String::new()), 24);
    let [a, b] = [NetworkDevice::default(), gpu].map(|device| {
        let network = LoadedMaterials::shipped(device).expect("it comes with the program");
        network.bone(&specimen.volume(), &mut |_, _, _| {})
    });
    let bone = a.iter().filter(|bone| **bone).count();
    let apart = a.iter().zip(&b).filter(|(a, b)| a != b).count();
    assert!(bone > 200 && apart * 1000 <= bone, "{apart} of {bone}");
}

/// How long the networks take on this machine's processor and GPU (`SIDECARM_DEVICE=software-vulkan` for the other kind); `SIDECARM_SPECIMEN` is a
/// specimen of `sidecarm dataset materials`, `SIDECARM_MATERIALS` another materials network.
#[test]
#[ignore = "minutes long: scripts/evaluate network-speed runs it"]
fn speed() {
    let choice = match std::env::var("SIDECARM_DEVICE").as_deref() {
        Ok("software-vulkan") => DeviceChoice::SoftwareVulkan,
        _ => DeviceChoice::Gpu,
    };
    let path = |key: &str| std::env::var_os(key).map(PathBuf::from);
    let specimen = path("SIDECARM_SPECIMEN").map_or_else(
        || phantom(3, &[], String::new()),
        |path| LabelledSpecimen::read(&path).unwrap_or_else(|error| panic!("{error}")),
    );
    let gpu = Device::open(choice, &Reporter::silent()).unwrap_or_else(|error| panic!("{error}"));
    for device in [NetworkDevice::default(), shared(&gpu)] {
        println!("{}", device.name);
        let network = LoadedNetwork::shipped_on(&device, &CHANNELS, &SCALARS).expect("it comes with the program");
        let input = Input { inputs: vec![0.5; CHANNELS.len() * PIXELS], scalars: vec![1.0; SCALARS.len()], scale: 1.0 };
        let mut ms: Vec<f64> = (0..200)
            .map(|_| {
                let watch = Stopwatch::start();
                network.predict(&input).expect("of its size");
                watch.ms()
            })
            .collect();
        let first = ms[0];
        ms.sort_by(f64::total_cmp);
        println!("  scatter network: first {first:.1} ms, median of 200 {:.3} ms, least {:.3} ms", ms[100], ms[0]);
        let network = match path("SIDECARM_MATERIALS") {
            None => LoadedMaterials::shipped(device).expect("it comes with the program"),
            Some(name) => {
                let (card, parameters) = NetworkFiles::of(&name).read().unwrap_or_else(|error| panic!("{error}"));
                LoadedMaterials::new(card, &parameters, device)
            }
        };
        for turn in ["first", "second"] {
            let (watch, mut tiles) = (Stopwatch::start(), 0);
            let bone = network.bone(&specimen.volume(), &mut |_, done, of| tiles += if done == of { of } else { 0 });
            let voxels = bone.iter().filter(|bone| **bone).count();
            println!(
                "  materials network: {turn} {:.2} s, {:?} voxels, {tiles} tiles, {voxels} bone",
                watch.ms() / 1e3,
                specimen.grid.size
            );
        }
    }
}
