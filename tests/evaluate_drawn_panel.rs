//! Beam and panel of drawn scenes: every option that a scene file has for them, and what is made of the image.

use std::fmt::Write as _;

use glam::DVec2;
use sidecarm::geometry::{Distortion, Glare, Intensifier, term_count};
use sidecarm::render::Quantity;
use sidecarm::scene::Scene;
use sidecarm::scene::model::{Formation, Noise, ReadoutNoise, Response, ScatterModel};
use sidecarm::scene::optics::{Axis, BowTie, Field, Grid, Heel, Scintillator, Strips, Towards};
use sidecarm::scene::physics::{Material, Spectrum};

use crate::evaluate::Draw;

/// What may be drawn here.
pub const PARTS: [&str; 26] = [
    "mono",
    "csv",
    "heel",
    "bowtie",
    "bowtie by row",
    "circle",
    "rectangle",
    "polygon",
    "focal spot",
    "counting",
    "blur",
    "scintillator",
    "grid",
    "strips",
    "saturation",
    "bits",
    "gain",
    "crosstalk",
    "wide crosstalk",
    "readout",
    "naive",
    "intensifier",
    "glare",
    "noise",
    "network scatter",
    "photon scatter",
];

fn chance(draw: &mut Draw, share: f64) -> bool {
    draw.between(0.0, 1.0) < share
}

fn known(name: &str) -> Material {
    Material::parse(name).expect("known")
}

/// Of an image of the scene's view, mm on the detector.
fn across_mm(scene: &Scene) -> f64 {
    scene.detector.pitch_mm * scene.view.map_or(200.0, |view| f64::from(view.size_px[0]))
}

/// Spectrum, heel, bow-tie, an iris, focal spot, and the simpler parts of the panel.
pub fn beam(scene: &mut Scene, parts: &mut Vec<&'static str>, draw: &mut Draw) {
    let tube_kvp = draw.between(50.0, 130.0);
    let angle = draw.between(9.0, 16.0);
    let mono = chance(draw, 0.1);
    scene.beam.spectrum = if mono {
        parts.push("mono");
        Spectrum::mono(draw.between(30.0, 100.0)).expect("inside")
    } else {
        Spectrum::tungsten(tube_kvp, angle, &[(known("Al"), draw.between(2.0, 8.0))]).expect("inside")
    };
    let across_mm = across_mm(scene);
    let shape = &mut scene.beam.shape;
    if !mono && chance(draw, 0.25) {
        let anode_towards = draw.pick(&[Towards::PlusColumn, Towards::MinusColumn, Towards::PlusRow, Towards::MinusRow]);
        shape.heel = Some(Heel { tube_kvp, anode_angle_deg: angle, anode_towards });
        parts.push("heel");
    }
    if chance(draw, 0.25) {
        let thickness_mm = vec![[-12.0, draw.between(5.0, 20.0)], [0.0, 1.0], [12.0, draw.between(5.0, 20.0)]];
        shape.bowtie = Some(BowTie { material: known("Al"), density_g_per_cm3: 2.7, axis: Axis::Column, thickness_mm });
        parts.push("bowtie");
    }
    if chance(draw, 0.25) {
        let centre_mm = DVec2::new(draw.between(-0.1, 0.1), draw.between(-0.1, 0.1)) * across_mm;
        shape.field = Some(Field::Circle { diameter_mm: across_mm * draw.between(0.5, 1.2), centre_mm });
        parts.push("circle");
    }
    if chance(draw, 0.2) {
        shape.focal_spot_mm = [draw.between(0.2, 1.0), draw.between(0.2, 1.0)];
        parts.push("focal spot");
    }
    let detector = &mut scene.detector;
    detector.response = draw.pick(&[Response::Energy, Response::Counting]);
    parts.extend((detector.response == Response::Counting).then_some("counting"));
    if chance(draw, 0.25) {
        detector.panel.blur_fwhm_mm = (detector.pitch_mm * draw.between(0.5, 4.0)).min(100.0);
        parts.push("blur");
    }
    if chance(draw, 0.25) {
        let thickness_mm = draw.between(0.3, 0.8);
        detector.panel.scintillator = Some(Scintillator { material: known("CsI"), density_g_per_cm3: 4.51, thickness_mm });
        parts.push("scintillator");
    }
    if chance(draw, 0.2) {
        detector.panel.grid = Some(Grid { primary_transmission: draw.between(0.5, 0.9), strips: None });
        parts.push("grid");
    }
    if chance(draw, 0.2) {
        detector.panel.saturation = Some(draw.between(0.3, 2.0));
        parts.push("saturation");
    }
    if chance(draw, 0.2) {
        detector.panel.bits = Some(14);
        parts.push("bits");
    }
    if chance(draw, 0.2) {
        detector.crosstalk = vec![vec![0.0, 0.05, 0.0], vec![0.05, 0.8, 0.05], vec![0.0, 0.05, 0.0]];
        detector.readout_noise = Some(ReadoutNoise { sigma: 1e-3, row_correlation: 0.3 });
        parts.extend(["crosstalk", "readout"]);
    }
    if chance(draw, 0.05) {
        scene.model.formation = Formation::Naive;
        parts.push("naive");
    }
}

/// What was left out of [`beam`]: a spectrum from a file, other fields, electronics, an intensifier, noise and scatter. Also what is made
/// of the image.
pub fn panel(scene: &mut Scene, parts: &mut Vec<&'static str>, draw: &mut Draw) -> Quantity {
    let across_mm = across_mm(scene);
    // The heel's tables are those of a tube.
    if chance(draw, 0.12) && scene.beam.shape.heel.is_none() {
        parts.retain(|part| *part != "mono");
        scene.beam.spectrum = measured(draw);
        parts.push("csv");
    }
    scene.beam.photons_per_pixel = draw.log(10.0, 1e6);
    let shape = &mut scene.beam.shape;
    if let Some(bowtie) = shape.bowtie.as_mut().filter(|_| chance(draw, 0.4)) {
        bowtie.axis = Axis::Row;
        parts.push("bowtie by row");
    }
    if shape.field.is_none() && chance(draw, 0.3) {
        let centre_mm = DVec2::new(draw.between(-0.1, 0.1), draw.between(-0.1, 0.1)) * across_mm;
        let rectangle = chance(draw, 0.6);
        parts.push(if rectangle { "rectangle" } else { "polygon" });
        shape.field =
            Some(if rectangle { turned_rectangle(draw, across_mm, centre_mm) } else { star(draw, across_mm, centre_mm) });
    }
    let detector = &mut scene.detector;
    if let Some(grid) = detector.panel.grid.as_mut().filter(|_| chance(draw, 0.5)) {
        grid.strips = Some(Strips { ratio: draw.between(5.0, 15.0), across: draw.pick(&[Axis::Column, Axis::Row]) });
        parts.push("strips");
    }
    if chance(draw, 0.4) {
        (detector.gain, detector.offset) = (draw.log(0.01, 10.0), draw.between(0.0, 300.0));
        parts.push("gain");
    }
    if let Some(bits) = detector.panel.bits.as_mut() {
        *bits = draw.pick(&[8, 12, 14, 16]);
    }
    if chance(draw, 0.1) {
        let side = draw.pick(&[5usize, 7]);
        detector.crosstalk = vec![vec![1.0 / (side * side) as f64; side]; side];
        parts.push("wide crosstalk");
    }
    if chance(draw, 0.15) {
        let (sigma, row_correlation) = (draw.log(1e-5, 1e-2), draw.between(0.0, 0.9));
        detector.readout_noise = Some(ReadoutNoise { sigma, row_correlation });
        parts.push("readout");
    }
    if let Some(view) = scene.view.filter(|_| chance(draw, 0.15)) {
        let glare = chance(draw, 0.6);
        detector.panel.intensifier = Some(intensifier(draw, view.size_px, glare));
        parts.push("intensifier");
        parts.extend(glare.then_some("glare"));
    }
    if chance(draw, 0.5) {
        scene.model.noise = if chance(draw, 0.7) { Noise::True } else { Noise::Paper };
        scene.model.seed = u64::from(draw.0.next_u32());
        parts.push("noise");
    }
    let (model, part) = match draw.between(0.0, 1.0) {
        share if share < 0.12 => (ScatterModel::Network, "network scatter"),
        share if share < 0.16 => (ScatterModel::MonteCarlo, "photon scatter"),
        _ => (ScatterModel::Off, ""),
    };
    scene.model.scatter = model;
    parts.extend((model != ScatterModel::Off).then_some(part));
    draw.pick(&[Quantity::Intensity, Quantity::LineIntegral, Quantity::Counts])
}

/// A smooth spectrum with a line, read from a table in steps of its own.
fn measured(draw: &mut Draw) -> Spectrum {
    let (step_kev, count) = (draw.pick(&[0.5, 1.0, 2.5]), draw.between(15.0, 35.0));
    let (first_kev, line) = (draw.between(15.0, 30.0), draw.between(0.0, 1.0));
    let mut table = "# drawn\nenergy_kev,fluence\n".to_owned();
    for bin in 0..=count as usize {
        let share = bin as f64 / count;
        let fluence = share * (1.05 - share) + if bin == (line * count) as usize { 0.3 } else { 0.0 };
        let _ = writeln!(table, "{:.6},{fluence:.6}", first_kev + step_kev * bin as f64);
    }
    let folder = tempfile::tempdir().expect("temporary folder");
    let path = folder.path().join("spectrum.csv");
    std::fs::write(&path, table).expect("written");
    Spectrum::from_csv(&path).expect("a spectrum")
}

fn turned_rectangle(draw: &mut Draw, across_mm: f64, centre_mm: DVec2) -> Field {
    let size_mm = DVec2::new(draw.between(0.4, 1.2), draw.between(0.3, 1.0)) * across_mm;
    Field::Rectangle { size_mm, centre_mm, rotation_deg: draw.between(-45.0, 45.0) }
}

/// Corners at drawn distances all round.
fn star(draw: &mut Draw, across_mm: f64, centre_mm: DVec2) -> Field {
    let count = draw.pick(&[3usize, 4, 6, 9]);
    let corner = |n: usize| {
        let angle = std::f64::consts::TAU * n as f64 / count as f64;
        centre_mm + across_mm * draw.between(0.25, 0.7) * DVec2::from_angle(angle)
    };
    Field::Polygon { corners_mm: (0..count).map(corner).collect() }
}

/// Pincushion and S distortion about a disc near the middle of the picture.
fn intensifier(draw: &mut Draw, size_px: [u32; 2], glare: bool) -> Intensifier {
    let [width, height] = size_px.map(f64::from);
    let radius_px = width.max(height) * draw.between(0.4, 0.6);
    let centre_px = DVec2::new(width * draw.between(0.45, 0.55), height * draw.between(0.45, 0.55));
    let order = draw.pick(&[3usize, 5]);
    let (pincushion, turn) = (radius_px * draw.between(0.0, 0.08), radius_px * draw.between(-0.03, 0.03));
    let mut shift_px = vec![DVec2::ZERO; term_count(order)];
    // x³ + x y² and x² y + y³ are terms 6, 8, 7 and 9.
    for (term, radial, turned) in
        [(6, DVec2::X, DVec2::Y), (8, DVec2::X, DVec2::Y), (7, DVec2::Y, -DVec2::X), (9, DVec2::Y, -DVec2::X)]
    {
        shift_px[term] = turn * turned - pincushion * radial;
    }
    let distortion = Distortion::new(centre_px, radius_px, order, shift_px).expect("it does not fold");
    let scale_px = width * draw.between(0.05, 0.4);
    let glare = glare.then(|| Glare { fraction: draw.between(0.02, 0.3), scale_px });
    Intensifier { size_px, distortion, glare, note: None }
}
