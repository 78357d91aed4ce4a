//! The fuzz targets on their corpus, on seeded mutations of it and on a share of what coverage has grown: a quick part of what
//! `scripts/evaluate fuzz` runs for as long as asked.

use std::collections::{BTreeMap, BTreeSet};
use std::io::Read;
use std::panic::catch_unwind;
use std::path::{Path, PathBuf};

use sidecarm::random::{Purpose, Stream};
use sidecarm::record::{Level, Provenance, Recorder};
use sidecarm::time::Stopwatch;

use crate::telemetry_frames::{GOLDEN_CARM, GOLDEN_METADATA, GOLDEN_ROBOT, bytes};

#[path = "../fuzz/src/lib.rs"]
mod targets;

type Target = (&'static str, fn(&[u8]));

const TARGETS: [Target; 13] = [
    ("decoder", targets::decoder),
    ("lines", targets::lines),
    ("adapter", targets::adapter),
    ("nifti", targets::nifti),
    ("nrrd", targets::nrrd),
    ("metaimage", targets::metaimage),
    ("slices", targets::slices),
    ("dicom", targets::dicom),
    ("stl", targets::stl),
    ("markups", targets::markups),
    ("scene", targets::scene),
    ("pose", targets::pose),
    ("mcap", targets::mcap),
];

fn corpus(target: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("fuzz/corpus").join(target)
}

/// The corpus in the order of its names, and what only this program can make.
fn seeds(target: &str) -> Vec<Vec<u8>> {
    let mut paths: Vec<PathBuf> =
        std::fs::read_dir(corpus(target)).map(|list| list.flatten().map(|entry| entry.path()).collect()).unwrap_or_default();
    paths.sort();
    let mut seeds: Vec<Vec<u8>> = paths.iter().map(|path| std::fs::read(path).expect("readable")).collect();
    match target {
        "decoder" => seeds.push([GOLDEN_ROBOT, GOLDEN_CARM, GOLDEN_METADATA].iter().flat_map(|hex| bytes(hex)).collect()),
        "mcap" => seeds.push(small_log()),
        _ => {}
    }
    assert!(!seeds.is_empty(), "{target} has no corpus");
    seeds
}

fn small_log() -> Vec<u8> {
    let folder = tempfile::tempdir().expect("folder");
    let path = folder.path().join("small.mcap");
    let recorder = Recorder::create(&path, &Provenance::of_this_program(1, serde_json::json!({}))).expect("created");
    recorder.raw_bytes("carm", 1, 2, &bytes(GOLDEN_CARM)).expect("recorded");
    recorder.json("/pose", 3, &serde_json::json!({"rms_px": 0.5})).expect("recorded");
    recorder.event(Level::Info, "begun", 4).expect("recorded");
    let image = sidecarm::image::Image { width: 2, height: 1, pixels: vec![0.5, 1.5] };
    recorder.drr("1", &image, 5).expect("recorded");
    recorder.attach("a.json", "application/json", 6, b"{}").expect("recorded");
    recorder.finish().expect("finished");
    std::fs::read(&path).expect("bytes")
}

/// Numbers that programs trip over.
const TEXTS: [&str; 14] = [
    "0",
    "-1",
    "-0.0",
    "1e308",
    "-1e309",
    "1e-320",
    "4294967296",
    "9223372036854775808",
    "NaN",
    "null",
    "[]",
    "{}",
    "\"\\u0000\"",
    "[[[[[[[[",
];
const WORDS: [u32; 8] = [0, 1, 0x7f, 0x80, 0xffff, 0x7fff_ffff, 0x8000_0000, 0xffff_ffff];

fn mutated(seeds: &[Vec<u8>], draw: &mut Stream) -> Vec<u8> {
    let mut below = |n: usize| (draw.uniform() * n as f64) as usize;
    let mut out = seeds[below(seeds.len())].clone();
    for _ in 0..=below(6) {
        let at = below(out.len().max(1));
        let until = (at + 1 + below(32)).min(out.len());
        match below(9) {
            0 if !out.is_empty() => out[at] ^= 1 << below(8),
            1 if !out.is_empty() => out[at] = below(256) as u8,
            2 => {
                let word = WORDS[below(WORDS.len())].to_le_bytes();
                out.iter_mut().skip(at).zip(word).for_each(|(byte, new)| *byte = new);
            }
            3 => out.truncate(at),
            4 => drop(out.drain(at..until)),
            5 => {
                let piece = out[at..until.max(at)].to_vec();
                let copies = 1 + below(4);
                (0..copies).for_each(|_| drop(out.splice(at..at, piece.iter().copied())));
            }
            6 => {
                let other = &seeds[below(seeds.len())];
                let from = below(other.len().max(1));
                out.truncate(at);
                out.extend_from_slice(&other[from.min(other.len())..]);
            }
            // A number in a text becomes another one.
            7 | 8 => {
                let digit = |byte: &u8| byte.is_ascii_digit() || b"-.eE".contains(byte);
                if let Some(start) = out.iter().skip(at).position(u8::is_ascii_digit).map(|offset| at + offset) {
                    let length = out[start..].iter().take_while(|byte| digit(byte)).count();
                    let text = TEXTS[below(TEXTS.len())];
                    drop(out.splice(start..start + length, text.bytes()));
                }
            }
            _ => {}
        }
    }
    out.truncate(1 << 20);
    out
}

/// Runs a target on its corpus, then on mutations until `seconds` or `most` inputs have passed. Gives their number and the failures.
fn fuzz((name, target): Target, seed: u64, seconds: f64, most: u64) -> (u64, Vec<Vec<u8>>) {
    let seeds = seeds(name);
    let mut draw = Stream::new(seed, 11, 0, Purpose::Evaluation);
    let mut found: Vec<Vec<u8>> = Vec::new();
    let watch = Stopwatch::start();
    let mut runs = 0;
    while runs < most && (runs < seeds.len() as u64 || watch.ms() < seconds * 1e3) && found.len() < 5 {
        let data = match seeds.get(runs as usize) {
            Some(seed) => seed.clone(),
            None => mutated(&seeds, &mut draw),
        };
        if breaks(target, &data) {
            found.push(data);
        }
        runs += 1;
    }
    (runs, found)
}

/// Whether a target panics, or takes as long as what hangs.
fn breaks(target: fn(&[u8]), data: &[u8]) -> bool {
    let lap = Stopwatch::start();
    catch_unwind(|| target(data)).is_err() || lap.ms() > HANG_S * 1e3
}

/// What coverage has grown, by target, in the order of its names: `fuzz/grown.tar.gz`, as `scripts/evaluate fuzz` unpacks it. An archive is
/// blocks of 512 bytes: a header with name, length and kind, then the content.
fn grown() -> BTreeMap<String, Vec<Vec<u8>>> {
    let packed = std::fs::File::open(Path::new(env!("CARGO_MANIFEST_DIR")).join("fuzz/grown.tar.gz")).expect("the archive");
    let mut bytes = Vec::new();
    flate2::read::MultiGzDecoder::new(packed).read_to_end(&mut bytes).expect("unpacks");
    let mut files: BTreeMap<(String, String), Vec<u8>> = BTreeMap::new();
    let mut at = 0;
    // Blocks of zeros end it.
    while let Some(header) = bytes.get(at..at + 512).filter(|header| header[0] != 0) {
        let text = |from: usize, to: usize| {
            let field = header[from..to].split(|byte| *byte == 0).next().unwrap_or_default();
            std::str::from_utf8(field).expect("text").trim()
        };
        let (name, length) = (text(0, 100), usize::from_str_radix(text(124, 136), 8).expect("an octal length"));
        let content = bytes.get(at + 512..at + 512 + length).expect("the archive is whole");
        if header[156] == b'0' {
            let (target, input) = name.trim_start_matches("./").split_once('/').expect("TARGET/HASH");
            files.insert((target.to_owned(), input.to_owned()), content.to_vec());
        }
        at += 512 + length.next_multiple_of(512);
    }
    let mut inputs: BTreeMap<String, Vec<Vec<u8>>> = BTreeMap::new();
    files.into_iter().for_each(|((target, _), content)| inputs.entry(target).or_default().push(content));
    inputs
}

/// At most this many of what is grown for a target are run, evenly spread, and no more once its time is over.
const MOST_GROWN: usize = 300;
/// All thirteen together within four seconds.
const GROWN_S: f64 = 0.3;
/// What takes so long hangs.
const HANG_S: f64 = 20.0;

/// Every k-th of them.
fn share(inputs: &[Vec<u8>]) -> impl Iterator<Item = &Vec<u8>> {
    inputs.iter().step_by(inputs.len().div_ceil(MOST_GROWN).max(1))
}

/// Runs a target on its share of what is grown for it, for `seconds` at most. Gives how many were run, and those that it does not survive.
fn run_grown(target: fn(&[u8]), inputs: &[Vec<u8>], seconds: f64) -> (usize, Vec<Vec<u8>>) {
    let watch = Stopwatch::start();
    let (mut runs, mut found) = (0, Vec::new());
    for data in share(inputs) {
        runs += 1;
        if breaks(target, data) {
            found.push(data.clone());
        }
        if watch.ms() > seconds * 1e3 {
            break;
        }
    }
    (runs, found)
}

#[test]
fn every_reader_survives_its_corpus_and_some_mutations() {
    let mut total = 0;
    for target in TARGETS {
        let (runs, found) = fuzz(target, 1, 0.4, 1_500);
        assert!(
            found.is_empty(),
            "{}: {} inputs, the first: {:02x?}",
            target.0,
            found.len(),
            &found[0][..found[0].len().min(400)]
        );
        total += runs;
    }
    assert!(total > 100, "{total}");
}

/// What coverage led to, no mutation of the small corpus finds within seconds.
#[test]
fn every_reader_survives_a_share_of_what_coverage_has_grown() {
    let grown = grown();
    let known: BTreeSet<&str> = TARGETS.iter().map(|(name, _)| *name).collect();
    assert_eq!(grown.keys().map(String::as_str).collect::<BTreeSet<_>>(), known, "something is grown for each");
    let mut total = 0;
    for (name, target) in TARGETS {
        let (runs, found) = run_grown(target, &grown[name], GROWN_S);
        println!("{name}: {runs} of {} inputs", grown[name].len());
        let first = found.first().map(|data| &data[..data.len().min(400)]);
        assert!(found.is_empty(), "{name}: {} of {runs} inputs, the first: {first:02x?}", found.len());
        assert!((1..=MOST_GROWN).contains(&runs), "{name}: {runs} inputs");
        total += runs;
    }
    assert!(total > 100, "{total}");
}

/// The control: of the inputs that are run, exactly those are found over which a reader trips.
#[test]
fn a_reader_that_panics_on_what_is_grown_is_found() {
    const MARK: &[u8] = b"a mark that nothing grows";
    fn trips(data: &[u8]) {
        assert!(!data.windows(MARK.len()).any(|part| part == MARK), "tripped");
    }
    let mut inputs = grown().remove("decoder").expect("inputs of the decoder");
    let last = inputs.len() - 1;
    assert!(inputs.len() <= MOST_GROWN && inputs[0] != inputs[last], "all of them are run");
    assert_eq!(run_grown(trips, &inputs, HANG_S), (inputs.len(), Vec::new()));
    inputs[last] = [&b"before"[..], MARK, b"behind"].concat();
    assert_eq!(run_grown(trips, &inputs, HANG_S), (inputs.len(), vec![inputs[last].clone()]));
    // Of many, so many are run from the first to near the last.
    let many: Vec<Vec<u8>> = (0..10 * MOST_GROWN + 1).map(|n| n.to_le_bytes().to_vec()).collect();
    let shared: Vec<&Vec<u8>> = share(&many).collect();
    assert!(shared.len() <= MOST_GROWN && shared.len() > MOST_GROWN / 2, "{}", shared.len());
    assert_eq!(shared[..2], [&many[0], &many[11]], "every eleventh");
}

/// The control: a reader that trips over a byte is caught.
#[test]
fn a_reader_that_panics_is_found() {
    fn trips(data: &[u8]) {
        assert!(!data.contains(&0x80), "tripped");
    }
    assert!(!fuzz(("decoder", trips), 1, 10.0, 20_000).1.is_empty());
}

/// Every input that was found is written beside the corpus.
#[test]
#[ignore = "as long as asked: scripts/evaluate fuzz runs it"]
fn mutations_for_as_long_as_asked() {
    let number = |name: &str, default: f64| std::env::var(name).ok().and_then(|text| text.parse().ok()).unwrap_or(default);
    let (seconds, seed) = (number("SIDECARM_FUZZ_SECONDS", 60.0), number("SIDECARM_FUZZ_SEED", 2.0) as u64);
    let wanted = std::env::var("SIDECARM_FUZZ_TARGET").ok();
    let mut failed = 0;
    for target in TARGETS.into_iter().filter(|(name, _)| wanted.as_deref().is_none_or(|wanted| wanted == *name)) {
        let (runs, found) = fuzz(target, seed, seconds, u64::MAX);
        println!("{}: {runs} inputs in {seconds} s (seed {seed}), {} failures", target.0, found.len());
        for data in &found {
            let path = corpus(target.0).join(format!("found-{}", &sidecarm::image::sha256_bytes(data)[..12]));
            std::fs::write(&path, data).expect("written");
            println!("  kept in {}", path.display());
        }
        failed += found.len();
    }
    assert_eq!(failed, 0, "inputs that a reader does not survive");
}
