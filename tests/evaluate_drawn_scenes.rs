//! Scenes drawn from everything that a scene can hold: wires, screws, meshes, the robot, tables, implants, second volumes, kept air, in
//! images from 10 px up to the live size.

use std::path::Path;
use std::sync::Arc;

use glam::{DQuat, DVec3};
use sidecarm::geometry::{Intrinsics, Rigid, View};
use sidecarm::random::{Purpose, Stream};
use sidecarm::render::Quantity;
use sidecarm::reporter::Reporter;
use sidecarm::scene::Scene;
use sidecarm::scene::model::{Matter, Mesh, Shape, Solid};

use crate::evaluate::Draw;
use crate::evaluate_drawn_panel::{beam, panel};
use crate::render_scenes::{With, empty, placed, solids, volume};

const MATERIALS: [&str; 8] = ["soft_tissue", "bone_cortical", "titanium", "steel_316l", "water", "nitinol", "adipose", "air"];
const METALS: [(usize, f64); 3] = [(2, 4.5), (3, 8.0), (5, 6.45)];

/// One scene of so many is 512³ voxels, seen in the live size.
const LARGE_EVERY: u64 = 130;
/// One of so many is seen in the live size.
const LIVE_EVERY: u64 = 25;
/// Columns and rows of that.
const LIVE_PX: [u32; 2] = [620, 480];

fn is_large(seed: u64) -> bool {
    seed % LARGE_EVERY == LARGE_EVERY - 1
}

fn is_live(seed: u64) -> bool {
    is_large(seed) || seed % LIVE_EVERY == LIVE_EVERY - 1
}

/// A scene, what it holds, what is made of it, and further numbers of its seed.
pub struct Drawn {
    pub scene: Scene,
    pub parts: Vec<&'static str>,
    pub quantity: Quantity,
    pub draw: Draw,
}

struct Drawing {
    draw: Draw,
    centre: DVec3,
    /// Millimetres across what is seen.
    extent: f64,
    scene: Scene,
    parts: Vec<&'static str>,
}

impl Drawing {
    fn chance(&mut self, share: f64) -> bool {
        self.draw.between(0.0, 1.0) < share
    }

    fn add(&mut self, part: &'static str, matter: Matter) {
        self.parts.push(part);
        self.scene = std::mem::replace(&mut self.scene, empty(&MATERIALS)).with(matter);
    }

    fn pose(&mut self, reach: f64) -> Rigid {
        let rotation = DQuat::from_scaled_axis(self.draw.point(2.0));
        Rigid { rotation, translation_mm: self.centre + self.draw.point(reach) }
    }

    fn ct(&mut self, seed: u64, part: &'static str) {
        let large = part == "ct" && is_large(seed);
        let size = [0, 1, 2].map(|_| if large { 512 } else { self.draw.log(6.0, 80.0) as usize });
        let mut spacing = DVec3::splat(self.extent / *size.iter().max().expect("three") as f64);
        spacing[self.draw.pick(&[0, 1, 2])] *= self.draw.pick(&[1.0, 1.0, 3.0]);
        let (grain, rough) = (self.draw.0.next_u32() as usize, self.draw.pick(&[0.0, 0.02, 0.2]));
        let pin = self.chance(0.3).then(|| [self.draw.between(0.2, 0.8), self.draw.between(0.2, 0.8)]);
        let air = self.chance(0.06);
        let filled = |at: [usize; 3]| {
            let u: [f64; 3] = std::array::from_fn(|axis| (at[axis] as f64 + 0.5) / size[axis] as f64 - 0.5);
            let r = u.iter().map(|x| x * x).sum::<f64>().sqrt();
            let noise = rough * ((at[0] * 7919 + at[1] * 104_729 + at[2] * 1_299_709 + grain) % 1009) as f32 / 1009.0;
            let in_pin = pin.is_some_and(|[x, y]| {
                at[0] == (x * size[0] as f64) as usize && at[1] == (y * size[1] as f64) as usize && u[2].abs() < 0.4
            });
            match r {
                _ if in_pin => (3, 4.5),
                r if r < 0.18 => (2, 1.6 + noise),
                r if r < 0.22 => (2, 1.9 + noise),
                r if r < 0.46 => (1, 1.0 + noise),
                _ if air => (4, 0.0012),
                _ => (0, 0.0),
            }
        };
        let classes: &[usize] = if air { &[0, 1, 2, 7] } else { &[0, 1, 2] };
        let middle = if part == "ct" { self.centre } else { self.centre + self.draw.point(0.6 * self.extent) };
        let turn = if self.chance(0.3) { DQuat::IDENTITY } else { DQuat::from_scaled_axis(self.draw.point(2.0)) };
        let mut ct = volume(size, placed(size, middle, spacing, turn), classes, filled);
        ct.truncated_at_faces = self.chance(0.5);
        self.add(part, Matter::Volume(Arc::new(ct)));
    }

    fn wire(&mut self) {
        let shape = Shape::Cylinder {
            length_mm: self.extent * self.draw.between(0.3, 2.0),
            radius_mm: self.extent * self.draw.log(2e-4, 2e-2),
            inner_radius_mm: 0.0,
        };
        let (material, density_g_per_cm3) = self.draw.pick(&METALS);
        let lps_from_local = self.pose(0.3 * self.extent);
        self.add("wire", solids(&[Solid { shape, lps_from_local, material, density_g_per_cm3 }]));
    }

    fn shape(&mut self) {
        let radius_mm = self.extent * self.draw.log(0.02, 0.3);
        let shape = match self.draw.pick(&[0, 1, 2]) {
            0 => Shape::Ellipsoid { semi_axes_mm: DVec3::splat(radius_mm) + self.draw.point(0.7 * radius_mm) },
            1 => Shape::Cuboid { half_size_mm: DVec3::splat(radius_mm) + self.draw.point(0.7 * radius_mm) },
            _ => Shape::Cylinder {
                length_mm: 3.0 * radius_mm,
                radius_mm,
                inner_radius_mm: self.draw.pick(&[0.0, 0.8]) * radius_mm,
            },
        };
        let (material, density) = self.draw.pick(&[(2, 4.5), (4, 1.0), (6, 0.95)]);
        let density_g_per_cm3 = density * (20.0 / radius_mm).min(1.0);
        let lps_from_local = self.pose(0.4 * self.extent);
        self.add("shape", solids(&[Solid { shape, lps_from_local, material, density_g_per_cm3 }]));
    }

    fn table(&mut self) {
        let shape = Shape::Cuboid { half_size_mm: self.extent * DVec3::new(0.8, 0.04, 1.5) };
        let mut lps_from_local = self.pose(0.1 * self.extent);
        lps_from_local.translation_mm += DVec3::Y * 0.5 * self.extent;
        self.add("table", solids(&[Solid { shape, lps_from_local, material: 6, density_g_per_cm3: 0.3 }]));
    }

    /// A bar whose radius goes up and down along it and around it: threads.
    fn screw(&mut self) {
        let (length, radius) = (self.extent * self.draw.between(0.1, 0.6), self.extent * self.draw.log(5e-3, 0.06));
        let turns = self.draw.between(2.0, 15.0);
        let (around, along) = (24u32, 60u32);
        let pose = self.pose(0.2 * self.extent);
        let point = |index: u32| {
            let (ring, place) = (f64::from(index / around) / f64::from(along), f64::from(index % around) / f64::from(around));
            let angle = std::f64::consts::TAU * place;
            let r = radius * (1.0 + 0.2 * (std::f64::consts::TAU * (turns * ring - place)).sin());
            pose.transform_point(DVec3::new(r * angle.cos(), r * angle.sin(), (ring - 0.5) * length))
        };
        let mut vertices_lps_mm: Vec<DVec3> = (0..around * (along + 1)).map(point).collect();
        let mut triangles = Vec::new();
        for ring in 0..along {
            for place in 0..around {
                let next = (place + 1) % around;
                let [a, b, c, d] =
                    [ring * around + place, ring * around + next, (ring + 1) * around + next, (ring + 1) * around + place];
                triangles.extend([[a, b, c], [a, c, d]]);
            }
        }
        for (ring, z, flip) in [(0, -0.5, false), (along, 0.5, true)] {
            let cap = vertices_lps_mm.len() as u32;
            vertices_lps_mm.push(pose.transform_point(DVec3::Z * z * length));
            for place in 0..around {
                let (a, b) = (ring * around + place, ring * around + (place + 1) % around);
                triangles.push(if flip { [cap, a, b] } else { [cap, b, a] });
            }
        }
        let mesh = Mesh { vertices_lps_mm, triangles, material: 2, density_g_per_cm3: 4.5 };
        self.add("screw", Matter::Mesh(Arc::new(mesh)));
    }

    fn robot(&mut self) {
        let angles: [f64; 5] = std::array::from_fn(|_| self.draw.between(-7.0, 7.0));
        let pose = self.pose(0.2 * self.extent);
        let rows: Vec<Vec<f64>> = {
            let m = pose.rotation_matrix();
            let row = |r: usize| vec![m.row(r).x, m.row(r).y, m.row(r).z, pose.translation_mm[r]];
            (0..3).map(row).chain([vec![0.0, 0.0, 0.0, 1.0]]).collect()
        };
        let text = serde_json::json!({
            "objects": [{"robot": {"model": "calibration/robot/cdm.json", "lps_from_base": rows, "control_angles_deg": angles}}],
            "beam": {"mono_kev": 60, "photons_per_pixel": 1e5}, "detector": {"response": "energy", "pitch_mm": 1.0},
            "model": {"formation": "deepdrr"}
        });
        let place = Path::new(env!("CARGO_MANIFEST_DIR")).join("scene.json");
        let loaded = sidecarm::scene::load_text(&text.to_string(), &place, false, &Reporter::silent()).expect("a robot");
        let Matter::Solids(mut parts) = loaded.objects[0].matter.clone() else { panic!("shapes") };
        for part in &mut parts {
            let material = loaded.materials[part.material].clone();
            part.material = self.scene.material_index(material);
        }
        self.add("robot", Matter::Solids(parts));
    }
}

/// The scene of a seed. Its matter, beam and wish come from one stream of numbers, most of its panel from another.
pub fn drawn(seed: u64) -> Drawn {
    let mut draw = Draw(Stream::new(seed, 9, 0, Purpose::Evaluation));
    let extent = draw.log(40.0, 500.0);
    let distance = draw.between(1.2, 4.0) * extent;
    let across_px = draw.log(10.0, 220.0);
    let size_px = [across_px as u32, (across_px * draw.pick(&[1.0, 0.77])) as u32];
    let (across_px, size_px) = if is_live(seed) { (f64::from(LIVE_PX[0]), LIVE_PX) } else { (across_px, size_px) };
    let fx = across_px * distance / (extent * draw.log(0.3, 1.3));
    let mut drawing = Drawing { draw, centre: DVec3::Z * distance, extent, scene: empty(&MATERIALS), parts: Vec::new() };
    drawing.scene.view = Some(View {
        size_px,
        intrinsics: Intrinsics { fx, fy: fx, skew: 0.0, cx: 0.5 * across_px + 3.0, cy: 0.4 * across_px },
        camera_from_lps: Rigid { rotation: DQuat::from_rotation_z(0.3), translation_mm: DVec3::ZERO },
    });
    drawing.scene.detector.pitch_mm = (distance + 1.2 * extent) / fx;
    if drawing.chance(0.25) {
        drawing.table();
    }
    if drawing.chance(0.1) {
        drawing.shape();
    }
    if drawing.chance(0.93) {
        drawing.ct(seed, "ct");
    }
    if drawing.chance(0.15) {
        drawing.ct(seed, "second");
    }
    type Part = fn(&mut Drawing);
    let more: [(f64, Part); 5] =
        [(0.4, Drawing::wire), (0.3, Drawing::wire), (0.25, Drawing::shape), (0.2, Drawing::screw), (0.15, Drawing::robot)];
    for (share, part) in more {
        if drawing.chance(share) {
            part(&mut drawing);
        }
    }
    let Drawing { mut draw, mut scene, mut parts, .. } = drawing;
    beam(&mut scene, &mut parts, &mut draw);
    let quantity = panel(&mut scene, &mut parts, &mut Draw(Stream::new(seed, 10, 0, Purpose::Evaluation)));
    parts.extend(is_live(seed).then_some("live size"));
    parts.extend(is_large(seed).then_some("512^3"));
    Drawn { scene, parts, quantity, draw }
}

/// Each option of the file format is drawn by some seed of a run, and left out by some.
#[test]
fn every_option_of_beam_and_panel_is_drawn() {
    const SEEDS: u64 = 400;
    // Matter takes long to draw, and tells nothing of what is drawn besides.
    let mut seen = std::collections::BTreeMap::new();
    for seed in 0..SEEDS {
        let (mut scene, mut parts) = (empty(&MATERIALS), Vec::new());
        beam(&mut scene, &mut parts, &mut Draw(Stream::new(seed, 9, 0, Purpose::Evaluation)));
        panel(&mut scene, &mut parts, &mut Draw(Stream::new(seed, 10, 0, Purpose::Evaluation)));
        parts.sort_unstable();
        parts.dedup();
        parts.into_iter().for_each(|part| *seen.entry(part).or_insert(0) += 1);
    }
    for part in crate::evaluate_drawn_panel::PARTS {
        let count = seen.remove(part).unwrap_or(0);
        assert!(count > 0 && count < SEEDS, "{part}: {count} of {SEEDS}");
    }
    assert!(seen.is_empty(), "not listed: {seen:?}");
}
