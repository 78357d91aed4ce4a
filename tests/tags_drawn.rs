//! Tags drawn by a generator of its own: no projection, code or noise of the program is used to make them.

use glam::{DMat3, DQuat, DVec2, DVec3};
use nalgebra::{Matrix6, Vector6};
use sidecarm::acquire::{Domain, Frame};
use sidecarm::beads::tags::{Family, SeenTag, Tag, TagLayout, find_tags, read_tags};
use sidecarm::beads::{Bead, BeadLayout};
use sidecarm::geometry::{Intrinsics, Rigid};
use sidecarm::image::Image;
use sidecarm::mask;
use sidecarm::pose::{Pose, Prior, Refusal, Registration, register_tagged};

const WIDTH: usize = 640;
const HEIGHT: usize = 512;
const F_PX: f64 = 4000.0;
const CENTRE: [f64; 2] = [322.0, 250.0];
/// Codes of the first ids of tag36h11: 36 bits, most significant first.
const CODES: [u64; 6] = [0xd_7e00_984b, 0xd_da66_4ca7, 0xd_c4a1_c821, 0xe_17b4_70e9, 0xe_f91d_01b1, 0xf_429c_dd73];

/// The family's bits run along the top edge, then along the right, bottom and left one, each quarter being the first one turned.
fn is_white(id: usize, column: i32, row: i32) -> bool {
    const QUARTER: [(i32, i32); 9] = [(0, 0), (1, 0), (2, 0), (3, 0), (4, 0), (1, 1), (2, 1), (3, 1), (2, 2)];
    for turn in 0..4u32 {
        let at = |(x, y): (i32, i32)| (0..turn).fold((x, y), |(x, y), _| (5 - y, x));
        if let Some(n) = QUARTER.iter().position(|cell| at(*cell) == (column, row)) {
            return CODES[id] >> (35 - (9 * turn as usize + n)) & 1 == 1;
        }
    }
    false
}

/// Whether the plate is dark at (x, y) mm from its centre; `None` off the plate.
pub fn dark(id: usize, size_mm: f64, x: f64, y: f64) -> Option<bool> {
    let cell = |v: f64| ((v / size_mm + 0.5) * 8.0).floor() as i32;
    let (column, row) = (cell(x), cell(y));
    if !(-1..9).contains(&column) || !(-1..9).contains(&row) {
        return None;
    }
    if !(0..8).contains(&column) || !(0..8).contains(&row) {
        return Some(false);
    }
    let inside = (1..7).contains(&column) && (1..7).contains(&row);
    Some(!(inside && is_white(id, column - 1, row - 1)))
}

/// Noise that repeats.
struct Dice(u64);

impl Dice {
    fn uniform(&mut self) -> f64 {
        self.0 = self.0.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        ((self.0 >> 33) as f64 + 0.5) / (1u64 << 31) as f64
    }

    fn normal(&mut self) -> f64 {
        (-2.0 * self.uniform().ln()).sqrt() * (std::f64::consts::TAU * self.uniform()).cos()
    }
}

/// Where a plate lies in the specimen.
#[derive(Clone, Copy)]
struct Plate {
    id: usize,
    size_mm: f64,
    turn: DMat3,
    at: DVec3,
}

struct Scene {
    plates: Vec<Plate>,
    /// Centres of spheres of 0.75 mm radius.
    beads: Vec<DVec3>,
    /// Rotation and translation of the specimen in the camera.
    turn: DMat3,
    shift: DVec3,
    blur_px: f64,
}

fn turned(axis: DVec3, degrees: f64) -> DMat3 {
    DMat3::from_axis_angle(axis.normalize(), degrees.to_radians())
}

impl Scene {
    /// Two plates in planes 50° apart, the camera turned as `pose` says.
    fn two(pose: u32) -> Self {
        let n = f64::from(pose);
        let plate = |id, degrees: f64, x: f64, y: f64, z: f64| Plate {
            id,
            size_mm: 12.0,
            turn: turned(DVec3::new(0.2, 1.0, 0.1), degrees),
            at: DVec3::new(x, y, z),
        };
        Self {
            plates: vec![plate(1, 25.0, -26.0, -8.0, 10.0), plate(4, -25.0, 24.0, 10.0, -12.0)],
            beads: Vec::new(),
            turn: turned(DVec3::new(1.0, 0.4 * (n - 3.0), 0.3), 6.0 * n - 15.0) * turned(DVec3::Z, 37.0 * n),
            shift: DVec3::new(2.0 - n, 0.7 * n - 2.0, 690.0 + 8.0 * n),
            blur_px: 0.5 + 0.1 * n,
        }
    }

    fn project(&self, p: DVec3) -> DVec2 {
        let q = self.turn * p + self.shift;
        DVec2::new(F_PX * q.x / q.z + CENTRE[0], F_PX * q.y / q.z + CENTRE[1])
    }

    fn corners(&self, plate: &Plate) -> [DVec2; 4] {
        let half = 0.5 * plate.size_mm;
        [(-half, half), (half, half), (half, -half), (-half, -half)]
            .map(|(x, y)| self.project(plate.at + plate.turn * DVec3::new(x, y, 0.0)))
    }

    /// Share of each pixel's area that is dark on a plate, and the spheres' depth in nepers; blurred.
    fn attenuation(&self, tag_nepers: f64) -> Vec<f64> {
        const SUB: usize = 4;
        let mut sum = vec![0.0; WIDTH * HEIGHT];
        for plate in &self.plates {
            let (turn, at) = (self.turn * plate.turn, self.turn * plate.at + self.shift);
            let middle = self.project(plate.at);
            let reach = 0.95 * plate.size_mm * F_PX / at.z;
            for row in (middle.y - reach).max(0.0) as usize..((middle.y + reach) as usize).min(HEIGHT) {
                for column in (middle.x - reach).max(0.0) as usize..((middle.x + reach) as usize).min(WIDTH) {
                    for n in 0..SUB * SUB {
                        let part = |n: usize| (n as f64 + 0.5) / SUB as f64 - 0.5;
                        let (u, v) = (column as f64 + part(n % SUB), row as f64 + part(n / SUB));
                        // The ray d through (u, v) meets the plane through `at` with normal turn·z.
                        let d = DVec3::new((u - CENTRE[0]) / F_PX, (v - CENTRE[1]) / F_PX, 1.0);
                        let p = d * (turn.z_axis.dot(at) / turn.z_axis.dot(d)) - at;
                        if dark(plate.id, plate.size_mm, turn.x_axis.dot(p), turn.y_axis.dot(p)) == Some(true) {
                            sum[row * WIDTH + column] += tag_nepers / (SUB * SUB) as f64;
                        }
                    }
                }
            }
        }
        for bead in &self.beads {
            let (centre, z) = (self.project(*bead), (self.turn * *bead + self.shift).z);
            let radius = 0.75 * F_PX / z;
            for row in (centre.y - radius - 1.0).max(0.0) as usize..((centre.y + radius + 2.0) as usize).min(HEIGHT) {
                for column in (centre.x - radius - 1.0).max(0.0) as usize..((centre.x + radius + 2.0) as usize).min(WIDTH) {
                    let d = DVec2::new(column as f64, row as f64).distance(centre) / radius;
                    sum[row * WIDTH + column] += 1.3 * (1.0 - d * d).max(0.0).sqrt();
                }
            }
        }
        blurred(&sum, self.blur_px)
    }

    /// A photograph: 8 bits, light plate with dark marks, some noise.
    fn photo(&self, seed: u64, is_inverted: bool) -> Frame {
        let mut dice = Dice(seed);
        let grey = self.attenuation(1.0).into_iter().map(|share| {
            let value = (190.0 - 130.0 * share + 3.0 * dice.normal()).round().clamp(0.0, 255.0);
            if is_inverted { 255.0 - value } else { value }
        });
        frame(grey.map(|value| value as f32).collect(), Domain::Display)
    }

    /// A radiograph: thin marks before a body that attenuates 0.8 to 3 nepers, 20 000 quanta in air.
    fn radiograph(&self, seed: u64) -> Frame {
        let mut dice = Dice(seed);
        let signal = self.attenuation(0.35).into_iter().enumerate().map(|(n, nepers)| {
            let (x, y) = ((n % WIDTH) as f64 / WIDTH as f64 - 0.5, (n / WIDTH) as f64 / HEIGHT as f64 - 0.4);
            let body = 3.0 - 6.0 * x * x - 3.0 * y * y + 0.2 * (9.0 * x + 4.0 * y).sin();
            let quanta = 20_000.0 * (-(nepers + body)).exp();
            (quanta + quanta.sqrt() * dice.normal()).max(0.0) as f32
        });
        frame(signal.collect(), Domain::Linear)
    }

    fn tags(&self) -> TagLayout {
        let tag = |plate: &Plate| Tag {
            id: plate.id as u32,
            size_mm: plate.size_mm,
            lps_from_tag: Rigid { rotation: DQuat::from_mat3(&plate.turn), translation_mm: plate.at },
            body: "specimen".to_owned(),
            sigma_mm: 0.0,
        };
        TagLayout { family: Family::Tag36h11, tags: self.plates.iter().map(tag).collect() }
    }

    fn layout(&self) -> BeadLayout {
        let bead =
            |(n, at): (usize, &DVec3)| Bead { radius_mm: Some(0.75), sigma_mm: Some(0.05), ..Bead::new(format!("B{n}"), *at) };
        BeadLayout { beads: self.beads.iter().enumerate().map(bead).collect(), ..BeadLayout::none() }
    }

    fn pose(&self) -> Rigid {
        Rigid { rotation: DQuat::from_mat3(&self.turn), translation_mm: self.shift }
    }
}

fn frame(pixels: Vec<f32>, domain: Domain) -> Frame {
    Frame::from_pixels("drawn", Image { width: WIDTH, height: HEIGHT, pixels }, domain).expect("a frame")
}

fn blurred(values: &[f64], sigma_px: f64) -> Vec<f64> {
    let reach = (3.0 * sigma_px).ceil() as i64;
    let weight: Vec<f64> = (-reach..=reach).map(|n| (-0.5 * (n as f64 / sigma_px).powi(2)).exp()).collect();
    let total: f64 = weight.iter().sum();
    let pass = |from: &[f64], step: usize, last: usize, place: &dyn Fn(usize) -> usize| -> Vec<f64> {
        (0..from.len())
            .map(|n| {
                let own = place(n) as i64;
                let term = |(k, w): (usize, &f64)| {
                    let by = (own + k as i64 - reach).clamp(0, last as i64) - own;
                    w * from[(n as i64 + by * step as i64) as usize]
                };
                weight.iter().enumerate().map(term).sum::<f64>() / total
            })
            .collect()
    };
    let across = pass(values, 1, WIDTH - 1, &|n| n % WIDTH);
    pass(&across, WIDTH, HEIGHT - 1, &|n| n / WIDTH)
}

fn mirrored(frame: &Frame) -> Frame {
    let pixels = frame.pixels.pixels.chunks_exact(WIDTH).flat_map(|row| row.iter().rev().copied()).collect();
    self::frame(pixels, frame.domain)
}

fn intrinsics() -> Intrinsics {
    Intrinsics { fx: F_PX, fy: F_PX, skew: 0.0, cx: CENTRE[0], cy: CENTRE[1] }
}

fn register(frame: &Frame, beads: &BeadLayout, tags: &TagLayout, prior: Option<&Prior>) -> Pose {
    let seen = find_tags(frame, tags.family).expect("tags are built in");
    let request = Registration {
        intrinsics: Some(intrinsics()),
        pitch_mm: Some(0.25),
        prior,
        ..Registration::new([WIDTH as u32, HEIGHT as u32], beads)
    };
    register_tagged(&request, frame, &mask::of_frame(frame), tags, &seen)
}

/// ξ of the truth about the pose, in the covariance's words, and its squared length under the covariance.
fn error(pose: &Pose, truth: &Rigid) -> (Vector6<f64>, f64, Matrix6<f64>) {
    let found = pose.camera_from_lps.expect("accepted");
    let (turn, shift) = (*truth * found.inverse()).log();
    let xi = Vector6::new(turn.x, turn.y, turn.z, shift.x, shift.y, shift.z);
    let rows = pose.covariance.expect("with covariance");
    let covariance = Matrix6::from_fn(|i, j| rows[i][j]);
    let inverse = covariance.try_inverse().expect("a covariance");
    (xi, (xi.transpose() * inverse * xi)[(0, 0)], covariance)
}

/// Offsets of all corners from where they were drawn.
fn offsets(scene: &Scene, seen: &[SeenTag]) -> Vec<DVec2> {
    let plates = scene.plates.iter().filter_map(|plate| {
        let own = seen.iter().find(|tag| tag.id == plate.id as u32)?;
        let drawn = scene.corners(plate);
        Some((0..4).map(move |n| own.corners_px[n] - drawn[n]).collect::<Vec<_>>())
    });
    plates.flatten().collect()
}

fn mean(offsets: &[DVec2]) -> DVec2 {
    offsets.iter().copied().sum::<DVec2>() / offsets.len() as f64
}

#[test]
fn corners_are_where_they_were_drawn_dark_on_light_and_light_on_dark() {
    let mut all = Vec::new();
    for pose in 0..6 {
        let scene = Scene::two(pose);
        for is_inverted in [false, true] {
            let seen = find_tags(&scene.photo(7 + u64::from(pose), is_inverted), Family::Tag36h11).expect("built in");
            assert_eq!(seen.iter().map(|tag| tag.id).collect::<Vec<_>>(), [1, 4], "pose {pose}, inverted {is_inverted}");
            assert!(seen.iter().all(|tag| tag.inverted == is_inverted && !tag.mirrored && tag.hamming == 0));
            all.extend(offsets(&scene, &seen));
        }
    }
    assert_eq!(all.len(), 96);
    let rms = (all.iter().map(|off| off.length_squared()).sum::<f64>() / (2.0 * all.len() as f64)).sqrt();
    println!("corners: rms {rms:.3} px per axis, mean {:.3}", mean(&all));
    assert!(rms < 0.2, "rms {rms} px per axis");
    assert!(mean(&all).abs().max_element() < 0.06, "mean {}", mean(&all));
    // The control: corners counted from the first pixel's corner are half a pixel off, and that is seen.
    let uncorrected: Vec<DVec2> = all.iter().map(|off| *off + 0.5).collect();
    assert!(mean(&uncorrected).abs().min_element() > 0.4);
}

#[test]
fn tags_alone_give_a_pose_within_three_standard_deviations() {
    let (mut cases, mut sum) = (0, 0.0);
    for pose in 0..6 {
        let scene = Scene::two(pose);
        let found = register(&scene.radiograph(3 + u64::from(pose)), &BeadLayout::none(), &scene.tags(), None);
        assert!(found.is_accepted(), "pose {pose}: {:?}", found.reason);
        let (xi, squared, covariance) = error(&found, &scene.pose());
        println!("pose {pose}: {squared:.2}, turn {:.3}°", xi.fixed_rows::<3>(0).norm().to_degrees());
        for n in 0..6 {
            assert!(
                xi[n].abs() <= 3.0 * covariance[(n, n)].sqrt(),
                "pose {pose}, component {n}: {} σ",
                xi[n] / covariance[(n, n)].sqrt()
            );
        }
        assert_eq!(found.tags.iter().filter(|tag| tag.used).count(), 2);
        assert!(found.tags.iter().all(|tag| tag.residual_px.is_some_and(|off| off < 0.6)), "{:?}", found.tags);
        sum += squared;
        cases += 1;
    }
    assert_eq!(cases, 6);
    // Six degrees of freedom: neither far too sure nor far too modest.
    assert!((0.5..=14.0).contains(&(sum / 6.0)), "mean {}", sum / 6.0);
}

#[test]
fn half_a_pixel_is_found_in_the_pose() {
    let scene = Scene::two(2);
    let tags = scene.tags();
    let frame = scene.radiograph(5);
    let empty = BeadLayout::none();
    let request = Registration { intrinsics: Some(intrinsics()), ..Registration::new([WIDTH as u32, HEIGHT as u32], &empty) };
    let masks = mask::of_frame(&frame);
    let seen = find_tags(&frame, tags.family).expect("built in");
    let shifted: Vec<SeenTag> =
        seen.iter().map(|tag| SeenTag { corners_px: tag.corners_px.map(|corner| corner + 0.5), ..tag.clone() }).collect();
    let across = |seen: &[SeenTag]| {
        let pose = register_tagged(&request, &frame, &masks, &tags, seen);
        let (xi, squared, _) = error(&pose, &scene.pose());
        (xi, squared)
    };
    assert!(across(&seen).1 < 25.0);
    assert!(across(&shifted).1 > 25.0, "half a pixel hides in the covariance");
}

#[test]
fn a_mirrored_frame_is_called_mirrored() {
    let scene = Scene::two(1);
    let found = register(&mirrored(&scene.radiograph(4)), &BeadLayout::none(), &scene.tags(), None);
    assert!(matches!(found.refusal, Some(Refusal::MirroredTags { ref tags }) if tags == &[1, 4]), "{:?}", found.reason);
    assert!(found.reason.is_some_and(|words| words.starts_with("mirrored")));
    assert!(found.tags.iter().all(|tag| tag.mirrored && !tag.used) && found.projection.is_none());
}

#[test]
fn tags_that_disagree_and_a_tag_that_could_be_tilted_either_way_are_refused() {
    let scene = Scene::two(2);
    let frame = scene.radiograph(6);
    let none = BeadLayout::none();
    let mut wrong = scene.tags();
    wrong.tags[1].lps_from_tag.translation_mm += DVec3::new(0.0, 6.0, 0.0);
    let found = register(&frame, &none, &wrong, None);
    assert!(matches!(found.refusal, Some(Refusal::TagsDisagree { agreeing: 1, .. })), "{:?}", found.reason);

    let far = Scene { plates: vec![Plate { size_mm: 5.0, ..scene.plates[0] }], ..Scene::two(2) };
    let found = register(&far.radiograph(6), &none, &far.tags(), None);
    assert!(matches!(found.refusal, Some(Refusal::FlatTags { .. } | Refusal::Uncertain { .. })), "{:?}", found.reason);

    let mut other = scene.tags();
    other.tags.iter_mut().for_each(|tag| tag.id += 100);
    let found = register(&frame, &none, &other, None);
    assert!(matches!(found.refusal, Some(Refusal::NoTags { listed: 2, ref others }) if others == &[1, 4]), "{:?}", found.reason);
    assert_eq!(found.tags.len(), 2, "what was seen is said");
}

fn with_beads() -> Scene {
    let beads = [
        (-38.0, -30.0, 20.0),
        (-12.0, -33.0, -25.0),
        (14.0, -28.0, 5.0),
        (36.0, -24.0, -30.0),
        (-40.0, 20.0, -15.0),
        (-20.0, 30.0, 25.0),
        (2.0, 33.0, -5.0),
        (0.0, 0.0, 30.0),
        (41.0, 30.0, 15.0),
    ];
    let turn = turned(DVec3::new(1.0, 0.4, 0.2), 8.0);
    Scene { beads: beads.map(DVec3::from).to_vec(), turn, ..Scene::two(3) }
}

#[test]
fn tags_start_the_beads_and_the_beads_give_the_precision() {
    let scene = with_beads();
    let frame = scene.radiograph(8);
    let found = register(&frame, &scene.layout(), &scene.tags(), None);
    assert!(found.is_accepted(), "{:?} {:?}", found.reason, found.notes);
    assert!(found.beads.iter().filter(|bead| bead.used).count() >= 8);
    assert!(found.notes.iter().any(|note| note.contains("sought where 2 tags put them")), "{:?}", found.notes);
    assert!(found.cautions.is_empty(), "{:?}", found.cautions);
    assert!(error(&found, &scene.pose()).1 < 30.0);
    let alone = register(&frame, &BeadLayout::none(), &scene.tags(), None);
    let depth = |pose: &Pose| pose.covariance_at_centroid.expect("has one")[5][5].sqrt();
    assert!(2.0 * depth(&found) < depth(&alone), "beads {} mm, tags {} mm", depth(&found), depth(&alone));
}

#[test]
fn tags_that_contradict_the_beads_are_said_with_both() {
    let scene = with_beads();
    let frame = scene.radiograph(9);
    let mut moved = scene.tags();
    moved.tags.iter_mut().for_each(|tag| tag.lps_from_tag.translation_mm += DVec3::new(4.0, 0.0, 0.0));
    let found = register(&frame, &scene.layout(), &moved, None);
    assert!(
        matches!(found.refusal, Some(Refusal::TagsContradicted { ref tags, beads, .. }) if tags.len() == 2 && beads >= 7),
        "{:?}",
        found.reason
    );
    // One of two: the beads are believed, and it is named.
    let mut one = scene.tags();
    one.tags[1].lps_from_tag.translation_mm += DVec3::new(4.0, 0.0, 0.0);
    let found = register(&frame, &scene.layout(), &one, None);
    assert!(found.is_accepted(), "{:?}", found.reason);
    assert!(found.cautions.iter().any(|caution| caution.contains("[4]")), "{:?}", found.cautions);
    assert!(found.tags.iter().any(|tag| tag.id == 4 && !tag.used && tag.reason.is_some()));
}

#[test]
fn a_prior_that_tags_contradict_refuses() {
    let scene = Scene::two(2);
    let away = Rigid::translation(DVec3::new(200.0, 0.0, 0.0)) * scene.pose();
    let prior = Prior { camera_from_lps: away, covariance: None };
    let found = register(&scene.radiograph(6), &BeadLayout::none(), &scene.tags(), Some(&prior));
    assert!(matches!(found.refusal, Some(Refusal::PriorAgainstTags { .. })), "{:?}", found.reason);
    let right = Prior { camera_from_lps: scene.pose(), covariance: None };
    assert!(register(&scene.radiograph(6), &BeadLayout::none(), &scene.tags(), Some(&right)).is_accepted());
}

#[test]
fn frames_without_tags_show_none() {
    let mut frames = 0;
    let empty = Scene { plates: Vec::new(), ..with_beads() };
    for (seed, family) in [Family::Tag36h11, Family::Tag25h9, Family::TagStandard41h12].into_iter().enumerate() {
        let seen = find_tags(&empty.radiograph(seed as u64), family).expect("built in");
        assert!(seen.is_empty(), "{family}: {seen:?}");
        frames += 1;
    }
    assert_eq!(frames, 3);
    let tiny = Frame::from_pixels("tiny", Image::filled(3, 2, 1.0f32), Domain::Unknown).expect("a frame");
    assert!(find_tags(&tiny, Family::Tag36h11).expect("built in").is_empty());
}

#[test]
fn what_is_wrong_with_a_list_of_tags_is_named_with_its_place() {
    let folder = tempfile::tempdir().expect("a folder");
    let path = folder.path().join("tags.json");
    let unit = "[[1,0,0,0],[0,1,0,0],[0,0,1,0],[0,0,0,1]]";
    let words = |tags: &str| {
        std::fs::write(&path, format!("{{\"family\": \"tag36h11\", \"tags\": [{tags}]}}")).expect("written");
        read_tags(&path).map(|layout| layout.tags.len()).map_err(|error| error.to_string())
    };
    let good = format!("{{\"id\": 3, \"size_mm\": 12.0, \"lps_from_tag\": {unit}}}");
    assert_eq!(words(&good), Ok(1));
    let cases = [
        (good.replace("size_mm", "size"), "size"),
        (good.replace("12.0", "-1"), "tags[0].size_mm"),
        (good.replace(": 3", ": 587"), "tags[0].id"),
        (format!("{good}, {good}"), "tags[1].id"),
        (good.replace("[[1,", "[[-1,"), "lps_from_tag"),
        (String::new(), "no tags"),
    ];
    for (text, expected) in &cases {
        let said = words(text).expect_err(text);
        assert!(said.contains(expected), "{said} does not name {expected}");
    }
}
