//! Radiographs that share no code with this program: rod and wire in view, false beads, rectangular shutters, and the prior beside.

use std::path::{Path, PathBuf};

use glam::{DMat2, DVec2, DVec3};
use sidecarm::acquire::{Domain, Frame, read_frame};
use sidecarm::beads::{BeadLayout, Landmark, read_markups};
use sidecarm::geometry::Projection;
use sidecarm::image::Image;
use sidecarm::pose::{IntrinsicsFile, Pose, Prior, Registration, register};
use sidecarm::random::{Purpose, Stream};

use crate::pose_synthetic::poisson;

/// What is stored for no signal, and for all of the air's.
const PEDESTAL: f32 = 4000.0;
const AIR: f32 = 2.5e6;
/// Stored values of one quantum, by how noise grows with the signal; beside the beads there are some 600 quanta.
const QUANTUM: f64 = 15.0;
/// Squared error in standard deviations that a pose of true ones reaches once in ten thousand times: χ² with six degrees of freedom, which
/// bounds that of any place.
const ONCE_IN_TEN_THOUSAND: f64 = 27.9;
/// Errors of so many pixels are beyond the deviations of any pose that is accepted here.
const CONTROL_PX: f64 = 10.0;

/// One of the radiographs with all that comes with it.
struct Case {
    name: String,
    folder: PathBuf,
    layout: BeadLayout,
    k: IntrinsicsFile,
    prior: Prior,
    truth: Projection,
    anatomy: Vec<Landmark>,
}

impl Case {
    /// All of them; none where the folder is absent.
    fn all() -> Vec<Self> {
        let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("../shared/data/bead-frames");
        if !folder.exists() {
            println!("skipped: {} is absent", folder.display());
            return Vec::new();
        }
        ["case-00", "case-01", "case-02"].into_iter().map(|name| Self::read(name, folder.join(name))).collect()
    }

    fn read(name: &str, folder: PathBuf) -> Self {
        let text = std::fs::read(folder.join("truth.json")).expect("readable");
        let truth: serde_json::Value = serde_json::from_slice(&text).expect("JSON");
        let places: Vec<DVec3> = serde_json::from_value(truth["anatomy_lps_mm"].clone()).expect("places");
        let landmark = |(n, lps_mm): (usize, &DVec3)| Landmark { name: format!("p{n}"), lps_mm: *lps_mm };
        let anatomy: Vec<Landmark> = places.iter().enumerate().map(landmark).collect();
        assert!(anatomy.len() >= 20, "{name}: {} places", anatomy.len());
        Self {
            name: name.to_owned(),
            layout: read_markups(&folder.join("beads.mrk.json")).expect("beads"),
            k: IntrinsicsFile::read(&folder.join("k.json")).expect("K"),
            prior: Prior::read(&folder.join("prior.json")).expect("a prior"),
            truth: serde_json::from_value(truth["projection"].clone()).expect("P"),
            anatomy,
            folder,
        }
    }

    fn stored(&self) -> Frame {
        read_frame(&self.folder.join("frame_pedestal4000_u16.tif"), Some(Domain::Linear)).expect("a frame")
    }

    fn pose(&self, frame: &Frame) -> Pose {
        let request = Registration {
            intrinsics: Some(self.k.intrinsics),
            pitch_mm: self.k.pitch_mm,
            prior: Some(&self.prior),
            landmarks: &self.anatomy,
            ..Registration::new(frame.size_px.map(|n| n as u32), &self.layout)
        };
        register(&request, frame)
    }

    /// The largest error over the anatomy, px, and the largest in stated standard deviations, squared; each place off by `more` besides.
    fn worst(&self, pose: &Pose, more: DVec2) -> [f64; 2] {
        assert_eq!(pose.landmarks.len(), self.anatomy.len());
        pose.landmarks.iter().fold([0.0; 2], |[px, squares], landmark| {
            let seen = DVec2::from_array(landmark.image_px.expect("before the source"));
            let off = seen + more - self.truth.project(landmark.lps_mm).0;
            let covariance = DMat2::from_cols_array_2d(&landmark.covariance_px2.expect("asked for"));
            [px.max(off.length()), squares.max(off.dot(covariance.inverse() * off))]
        })
    }

    /// The error of an accepted pose, px; panics where it is beyond its deviations, or where those forbid nothing.
    fn checked(&self, pose: &Pose, what: &str) -> f64 {
        let [px, squares] = self.worst(pose, DVec2::ZERO);
        let name = &self.name;
        assert!(squares < ONCE_IN_TEN_THOUSAND, "{name} {what}: {px:.2} px at the anatomy, {:.1} σ", squares.sqrt());
        let [_, control] = self.worst(pose, DVec2::new(CONTROL_PX, 0.0));
        assert!(control > ONCE_IN_TEN_THOUSAND, "{name} {what}: {CONTROL_PX} px are {:.1} σ", control.sqrt());
        px
    }
}

fn share(stored: &Frame) -> Image<f32> {
    stored.pixels.map(|value| (value - PEDESTAL) / AIR)
}

fn frame_of(pixels: Image<f32>) -> Frame {
    Frame::from_pixels("float", pixels, Domain::Linear).expect("a frame")
}

/// As they are stored, with the readout noise about zero behind the shutters, and with NaN there.
#[test]
fn independent_radiographs_give_p_however_the_shutters_are_stored() {
    let cases = Case::all();
    let mut count = 0;
    for case in &cases {
        let stored = case.stored();
        let share = share(&stored);
        let (width, height) = (share.width, share.height);
        let open = |n: usize| (82..width - 82).contains(&(n % width)) && (42..height - 42).contains(&(n / width));
        let nan = Image {
            width,
            height,
            pixels: share.pixels.iter().enumerate().map(|(n, v)| if open(n) { *v } else { f32::NAN }).collect(),
        };
        let cut = read_frame(&case.folder.join("frame_u16.png"), Some(Domain::Linear)).expect("a frame");
        let ways = [("stored", stored), ("signed", frame_of(share)), ("NaN", frame_of(nan)), ("cut at zero", cut)];
        // Each way for the first; the others as they are stored.
        let chosen = if case.name == "case-00" { ways.len() } else { 1 };
        for (way, frame) in ways.into_iter().take(chosen) {
            let pose = case.pose(&frame);
            assert!(pose.is_accepted(), "{} {way}: {:?}", case.name, pose.reason);
            let found = pose.projection.expect("accepted");
            let off = |lps_mm: DVec3| found.project(lps_mm).0.distance(case.truth.project(lps_mm).0);
            let at_beads_px = case.layout.beads.iter().map(|bead| off(bead.lps_mm)).fold(0.0, f64::max);
            let at_anatomy_px = case.checked(&pose, way);
            println!("{} {way}: {at_beads_px:.3} px at the beads, {at_anatomy_px:.3} px at the anatomy", case.name);
            assert!(at_beads_px < 0.3 && at_anatomy_px < 0.5, "{} {way}: {at_beads_px:.3}, {at_anatomy_px:.3} px", case.name);
            count += 1;
        }
    }
    assert!(cases.is_empty() || count == 6, "{count}");
}

/// With a tenth and a hundredth of the quanta, readout noise as it is.
#[test]
fn independent_radiographs_of_few_quanta_are_refused_or_within_their_deviations() {
    let cases = Case::all();
    for (part, least) in [(0.1, 2), (0.01, 0)] {
        let mut accepted = 0;
        for (number, case) in (0..).zip(&cases) {
            let pose = case.pose(&frame_of(of_fewer_quanta(&case.stored().pixels, part, number)));
            let quanta = (600.0 * part).round();
            match pose.is_accepted() {
                true => {
                    let px = case.checked(&pose, "of few quanta");
                    let used = pose.beads.iter().filter(|bead| bead.used).count();
                    println!("{}, about {quanta} quanta: {used} beads, {px:.2} px at the anatomy, {:?}", case.name, pose.doubt);
                    accepted += 1;
                }
                false => println!("{}, about {quanta} quanta: {:?}", case.name, pose.reason),
            }
        }
        assert!(cases.is_empty() || accepted >= least, "{accepted} of {} accepted at {part} of the dose", cases.len());
    }
}

/// The same exposure with `part` of its quanta, as transmitted share. What it already has of noise stays: a share of `part` too much.
fn of_fewer_quanta(stored: &Image<f32>, part: f64, seed: u64) -> Image<f32> {
    let (width, height) = (stored.width, stored.height);
    let quantum = QUANTUM / part;
    let pixels = (0..width * height).map(|n| {
        let (column, row) = (n % width, n / width);
        let (columns, rows) = (column.saturating_sub(1)..(column + 2).min(width), row.saturating_sub(1)..(row + 2).min(height));
        let around = rows.flat_map(|row| columns.clone().map(move |column| row * width + column));
        let (sum, count) = around.fold((0.0, 0.0), |(sum, count), n| (sum + f64::from(stored.pixels[n] - PEDESTAL), count + 1.0));
        let expected = (sum / count).max(0.0) / quantum;
        let noise = quantum * (poisson(expected, &mut Stream::new(seed, 8, n as u32, Purpose::Evaluation)) - expected);
        (stored.pixels[n] - PEDESTAL + noise as f32) / AIR
    });
    Image { width, height, pixels: pixels.collect() }
}
