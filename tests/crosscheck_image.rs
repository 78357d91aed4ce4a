//! Image against pose: frames of the mocked laboratory, whose poses are known, at right and at wrong poses.

use std::io::Write;
use std::path::{Path, PathBuf};
use std::process::Command;

use glam::{DQuat, DVec2, DVec3};
use sidecarm::acquire::{Domain, Frame, read_frame};
use sidecarm::beads::read_markups;
use sidecarm::compare::{CompareInput, Compared, Elsewhere, compare, elsewhere};
use sidecarm::geometry::{Projection, Rigid, View};
use sidecarm::gpu::DeviceChoice;
use sidecarm::image::Image;
use sidecarm::random::{Purpose, Stream};
use sidecarm::render::{Goal, Options, Quantity, Renderer};
use sidecarm::reporter::Reporter;
use sidecarm::scene::{self, Scene};

use crate::live_lab::drawn;
use crate::session_demo::mock_is_built;

/// The kit of the mocked laboratory, with its frames, as `more` asks for it.
pub fn kit(folder: &Path, more: &[&str]) -> PathBuf {
    let lab = folder.join("lab");
    let program = Path::new(env!("CARGO_BIN_EXE_sidecarm")).with_file_name(format!("mock-lab{}", std::env::consts::EXE_SUFFIX));
    let run = Command::new(program).arg("--out").arg(&lab).arg("--drawn").arg(drawn()).arg("--kit-only").args(more).output();
    let run = run.expect("mock-lab starts");
    assert!(run.status.success(), "{}", String::from_utf8_lossy(&run.stderr));
    lab
}

pub fn json(path: &Path) -> serde_json::Value {
    serde_json::from_str(&std::fs::read_to_string(path).expect("readable")).expect("JSON")
}

/// A frame, its scene and where it really was seen from.
struct Known {
    frame: Frame,
    scene: Scene,
    view: View,
    beads: Vec<DVec3>,
    centre: DVec3,
}

/// Renders and compares as a session does.
struct Lab {
    renderer: Renderer,
}

impl Lab {
    fn compare(&mut self, known: &Known, camera_from_lps: Rigid) -> Option<Compared> {
        let view = View { camera_from_lps, ..known.view };
        let scene = known.scene.with_view(view);
        let options = Options { quantity: Quantity::LineIntegral, goal: Some(Goal::MaxError(1e-3)), ..Options::default() };
        let rendered = self.renderer.render(&scene, &options).expect("rendered");
        let projection = view.projection();
        let mark = |lps: DVec3| {
            let (at, depth): (DVec2, f64) = projection.project(lps);
            (at, 0.75 * view.intrinsics.fx / depth + 1.5)
        };
        let beads: Vec<(DVec2, f64)> = known.beads.iter().map(|bead| mark(*bead)).collect();
        let mut input = CompareInput::new(&known.frame, &rendered.pages[0]);
        input.valid = Some(&rendered.valid);
        input.beads = &beads;
        input.view = Some(&view);
        input.centre_lps_mm = Some(known.centre);
        // A pose that is far off may leave too little to compare; a session says so.
        let mut compared = compare(&input).ok()?;
        let renderer = &mut self.renderer;
        let mut rerender = |small: &View| {
            let rendered = renderer.render(&scene.with_binned_view(*small), &options).map_err(|error| error.to_string())?;
            let valid = rendered.valid.pixels.clone();
            let mut page: Image<f32> = rendered.pages.into_iter().next().expect("a page");
            page.pixels.iter_mut().zip(valid).filter(|(_, valid)| *valid == 0).for_each(|(pixel, _)| *pixel = f32::NAN);
            Ok(page)
        };
        compared.add_null(&mut rerender, &|| false).expect("a null");
        Some(compared)
    }

    fn prefers(&mut self, known: &Known, camera_from_lps: Rigid) -> Option<Elsewhere> {
        let compared = self.compare(known, camera_from_lps)?;
        elsewhere(&compared.comparison.null)
    }
}

/// All frames of a kit, each with the scene as it was.
fn open(lab: &Path) -> (Lab, Vec<Known>) {
    let reporter = Reporter::silent();
    let scene = scene::load(&lab.join("scene.json"), false, &reporter).expect("loads");
    let layout = read_markups(&lab.join("beads.mrk.json")).expect("beads");
    let truth = json(&lab.join("truth.json"));
    let frames = truth["frames"].as_array().expect("frames");
    let known = |row: &serde_json::Value| {
        let frame =
            read_frame(&lab.join("frames").join(row["frame"].as_str().expect("name")), Some(Domain::Linear)).expect("frame");
        let projection: Projection = serde_json::from_value(row["projection"].clone()).expect("3 x 4");
        let (intrinsics, camera_from_lps) = projection.decompose().expect("a camera");
        let angles: [f64; 5] = serde_json::from_value(row["control_angles_deg"].clone()).expect("five");
        let size_px = frame.size_px.map(|n| n as u32);
        let scene = scene.with_robot(angles, None).expect("a robot");
        let beads = layout.beads.iter().map(|bead| bead.lps_mm).collect();
        Known { frame, scene, view: View { size_px, intrinsics, camera_from_lps }, beads, centre: layout.centroid_lps_mm() }
    };
    let known: Vec<Known> = frames.iter().map(known).collect();
    assert!(known.len() >= 6);
    (Lab { renderer: Renderer::new(DeviceChoice::Cpu, &reporter).expect("CPU") }, known)
}

/// The stated pose that is off by a shift (mm, camera axes) and a turn about the centroid.
fn off(view: &View, centre_lps: DVec3, shift_mm: DVec3, axis: DVec3, degrees: f64) -> Rigid {
    let centre = view.camera_from_lps.transform_point(centre_lps);
    let turn = Rigid::rotation(DQuat::from_axis_angle(axis, degrees.to_radians()));
    Rigid::translation(centre + shift_mm) * turn * Rigid::translation(-centre) * view.camera_from_lps
}

/// A direction, evenly over the sphere.
fn direction(stream: &mut Stream) -> DVec3 {
    let z = 2.0 * stream.uniform() - 1.0;
    let angle = std::f64::consts::TAU * stream.uniform();
    let r = (1.0 - z * z).sqrt();
    DVec3::new(r * angle.cos(), r * angle.sin(), z)
}

#[test]
fn right_poses_are_not_doubted_and_wrong_ones_are() {
    if !mock_is_built() {
        return;
    }
    let folder = tempfile::tempdir().expect("temporary folder");
    let (mut lab, frames) = open(&kit(folder.path(), &[]));
    let centre = frames[0].centre;
    let mut doubted = Vec::new();
    // Every other one, the collimated one among them; `scripts/evaluate doubt` takes all.
    for known in frames.iter().step_by(2) {
        doubted.extend(lab.prefers(known, known.view.camera_from_lps).map(|found| format!("{}: {found}", known.frame.name)));
    }
    assert!(doubted.is_empty(), "{doubted:#?}");
    let known = &frames[0];
    let wrong = [
        ("5 mm across", off(&known.view, centre, DVec3::new(3.0, -4.0, 0.0), DVec3::X, 0.0)),
        ("3 degrees", off(&known.view, centre, DVec3::ZERO, DVec3::new(0.8, 0.0, 0.6), 3.0)),
        ("half-turn in the plane", off(&known.view, centre, DVec3::ZERO, DVec3::Z, 180.0)),
        ("RAS for LPS", known.view.camera_from_lps * Rigid::rotation(DQuat::from_rotation_z(std::f64::consts::PI))),
    ];
    for (name, pose) in wrong {
        let found = lab.prefers(known, pose);
        assert!(found.is_some(), "{name} passed for right");
        println!("{name}: {}", found.expect("found"));
    }
}

/// A pose drawn from a kind of mistake, given the right view and the centre.
type Draw = Box<dyn Fn(&View, DVec3, &mut Stream) -> Rigid>;

fn mistakes() -> Vec<(&'static str, Draw)> {
    let random = |mm: f64, degrees: f64| -> Draw {
        Box::new(move |view, centre, stream| {
            let (shift, axis) = (direction(stream) * mm, direction(stream));
            off(view, centre, shift, axis, degrees)
        })
    };
    let about = |axis: DVec3| -> Draw { Box::new(move |view, centre, _| off(view, centre, DVec3::ZERO, axis, 180.0)) };
    let negated = |axis: DVec3| -> Draw {
        Box::new(move |view, centre, _| {
            // About the centre, because a CT's origin may lie far from what is in the field.
            let turn = Rigid::rotation(DQuat::from_axis_angle(axis, std::f64::consts::PI));
            view.camera_from_lps * Rigid::translation(centre) * turn * Rigid::translation(-centre)
        })
    };
    vec![
        ("right, 0.1 mm and 0.05 deg", random(0.1, 0.05)),
        ("right, 0.5 mm and 0.2 deg", random(0.5, 0.2)),
        ("2 mm", random(2.0, 0.0)),
        ("5 mm", random(5.0, 0.0)),
        ("10 mm", random(10.0, 0.0)),
        ("20 mm", random(20.0, 0.0)),
        ("3 deg", random(0.0, 3.0)),
        ("5 deg", random(0.0, 5.0)),
        ("10 deg", random(0.0, 10.0)),
        ("5 mm and 3 deg", random(5.0, 3.0)),
        ("half-turn u", about(DVec3::X)),
        ("half-turn v", about(DVec3::Y)),
        ("half-turn depth", about(DVec3::Z)),
        ("x, y negated", negated(DVec3::Z)),
        ("x, z negated", negated(DVec3::Y)),
        ("y, z negated", negated(DVec3::X)),
    ]
}

fn number(name: &str, otherwise: usize) -> usize {
    std::env::var(name).ok().and_then(|n| n.parse().ok()).unwrap_or(otherwise)
}

/// Prints, by kind of mistake, how often the image was found to disagree.
fn count(lab: &mut Lab, frames: &[Known], first_seed: usize) {
    let wanted = std::env::var("SIDECARM_KIND").unwrap_or_default();
    let mut dump = std::env::var("SIDECARM_DUMP")
        .ok()
        .map(|path| std::fs::File::options().append(true).create(true).open(path).expect("a file"));
    let seeds = first_seed..first_seed + number("SIDECARM_DRAWS", 2);
    for (name, draw) in mistakes().iter().filter(|(name, _)| name.contains(&wanted)) {
        let (mut doubted, mut asked, mut uncompared, mut words) = (0, 0, 0, Vec::new());
        for (index, known) in frames.iter().enumerate() {
            for seed in seeds.clone() {
                let mut stream = Stream::new(seed as u64, index as u32, 0, Purpose::Evaluation);
                let pose = draw(&known.view, known.centre, &mut stream);
                let Some(compared) = lab.compare(known, pose) else {
                    uncompared += 1;
                    continue;
                };
                asked += 1;
                if let Some(dump) = &mut dump {
                    writeln!(
                        dump,
                        "{}",
                        serde_json::json!({"kind": name, "frame": known.frame.name, "null": compared.comparison.null})
                    )
                    .expect("written");
                }
                let found = elsewhere(&compared.comparison.null);
                doubted += usize::from(found.is_some());
                if found.is_some() == name.starts_with("right") {
                    let score = |name: &&str| {
                        let null = compared.comparison.null.get(*name)?;
                        Some(format!(
                            "{name} {:.4} best {:.4} {}",
                            null.at_pose?,
                            null.best_shifted?,
                            null.best_shift.as_deref()?
                        ))
                    };
                    let all: Vec<String> =
                        ["zncc", "gradient_ncc", "local_ncc", "edge_distance_px"].iter().filter_map(score).collect();
                    words.push(format!("{}: {}", known.frame.name, all.join("; ")));
                }
            }
        }
        println!("{name}: doubted {doubted} of {asked} ({uncompared} not compared)");
        words.iter().take(5).for_each(|words| println!("    {words}"));
    }
}

/// How often right and wrong poses of the mocked laboratory are doubted.
#[test]
#[ignore = "minutes long: scripts/evaluate doubt runs it"]
fn figures_of_the_mocked_laboratory() {
    let folder = tempfile::tempdir().expect("temporary folder");
    let (mut lab, frames) = open(&kit(folder.path(), &[]));
    count(&mut lab, &frames, number("SIDECARM_SEED", 0));
}

/// The same of a real pelvis with what a session does not model: scatter as strong as the primary, another voltage, noise.
#[test]
#[ignore = "minutes long: scripts/evaluate doubt runs it"]
fn figures_of_a_pelvis_with_scatter() {
    let ct = Path::new(env!("CARGO_MANIFEST_DIR")).join("../shared/data/ct-pelvis/ct.nii.gz");
    if !ct.exists() {
        println!("skipped: {} is not here", ct.display());
        return;
    }
    let reporter = Reporter::silent();
    let text = |kvp: u32| {
        serde_json::json!({
            "objects": [{"ct": {"path": ct, "materials": "threshold"}}],
            "beam": {"tube_kvp": kvp, "anode_angle_deg": 12, "filtration_mm": {"aluminium": 4.3}},
            "detector": {"pitch_mm": 0.388}
        })
        .to_string()
    };
    let load = |kvp| scene::load_text(&text(kvp), Path::new("pelvis.json"), false, &reporter).expect("loads");
    let (assumed, real) = (load(90), load(78));
    let (low, high) = assumed.bounds_lps_mm().expect("a CT");
    let mut lab = Lab { renderer: Renderer::new(DeviceChoice::Cpu, &reporter).expect("CPU") };
    let mut frames = Vec::new();
    for (index, (orbital, angulation, x)) in
        [(0.0f64, 0.0f64, 0.3), (20.0, 5.0, 0.3), (-25.0, 0.0, 0.7), (10.0, -12.0, 0.6), (60.0, 0.0, 0.4)].into_iter().enumerate()
    {
        let centre = low + (high - low) * DVec3::new(x, 0.5, 0.35);
        let anterior = DQuat::from_mat3(&glam::DMat3::from_cols(DVec3::X, DVec3::Z, -DVec3::Y));
        let rotation = DQuat::from_rotation_y(orbital.to_radians()) * DQuat::from_rotation_x(angulation.to_radians()) * anterior;
        let camera_from_lps = Rigid { rotation, translation_mm: DVec3::new(0.0, 0.0, 640.0) - rotation * centre };
        let intrinsics =
            sidecarm::geometry::Intrinsics { fx: 1020.0 / 0.388, fy: 1020.0 / 0.388, skew: 0.0, cx: 309.5, cy: 239.5 };
        let view = View { size_px: [620, 480], intrinsics, camera_from_lps };
        let rendered = lab.renderer.render(&real.with_view(view), &Options::default()).expect("rendered");
        let primary: Vec<f64> = rendered.pages[0].pixels.iter().map(|v| f64::from(*v)).collect();
        let mut scatter = primary.clone();
        sidecarm::render::blur::blur(&mut scatter, [620, 480], [70.0, 70.0]);
        let share: f64 = std::env::var("SIDECARM_SCATTER").ok().and_then(|n| n.parse().ok()).unwrap_or(1.0);
        let mut stream = Stream::new(index as u64, 99, 0, Purpose::Evaluation);
        let pixels = primary
            .iter()
            .zip(&scatter)
            .map(|(p, s)| {
                let noise: f64 = (0..4).map(|_| 2.0 * stream.uniform() - 1.0).sum::<f64>() * 0.866;
                let signal = p + share * s;
                (signal + 0.006 * signal.sqrt() * noise).max(1e-5) as f32
            })
            .collect();
        let mut frame =
            Frame::from_pixels(&format!("pelvis-{index}"), Image::from_pixels(620, 480, pixels).expect("size"), Domain::Linear)
                .expect("finite");
        frame.unit = Some("1".to_owned());
        frames.push(Known { frame, scene: assumed.clone(), view, beads: vec![centre], centre });
    }
    count(&mut lab, &frames, number("SIDECARM_SEED", 0));
}
