//! What stands before the panel, through `live`: an image intensifier, tags in the specimen, shutters that telemetry tells of.

use glam::{DMat3, DVec2, DVec3};
use serde_json::{Value, json};
use sidecarm::image::Image;

use crate::calibrate_session::{errors_px, pictures, rows, session, write_png16};
use crate::live_lab::Lab;

/// r² (pincushion · x + S · x turned).
pub struct Bent {
    pub centre: DVec2,
    pub radius_px: f64,
    /// Pincushion and S at the rim.
    pub rim_px: (f64, f64),
}

/// The corners of the frame reach the rim.
const BENT: Bent = Bent { centre: DVec2::new(309.5, 239.5), radius_px: 420.0, rim_px: (-16.0, 9.0) };

impl Bent {
    pub fn undistorted(&self, p: DVec2) -> DVec2 {
        let x = (p - self.centre) / self.radius_px;
        p + x.length_squared() * (self.rim_px.0 * x + self.rim_px.1 * x.perp())
    }

    /// The same law as `calibrate intensifier` writes it: terms 6 to 9 of the third order are x³, x²y, xy², y³.
    pub fn calibration(&self, size_px: [u32; 2], angles_from: &str) -> Value {
        let (p, s) = self.rim_px;
        let row = |terms: [f64; 4]| [vec![0.0; 6], terms.to_vec()].concat();
        json!({
            "origin": "written by a test", "size_px": size_px, "disc_centre_px": self.centre.to_array(),
            "disc_radius_px": self.radius_px, "order": 3, "angles_from": angles_from,
            "views": [{"shift_u_px": row([p, -s, p, -s]), "shift_v_px": row([s, p, s, p])}]
        })
    }
}

fn seen_through(picture: &Image<f32>) -> Image<f32> {
    let at = |n: usize| {
        let from = BENT.undistorted(DVec2::new((n % picture.width) as f64, (n / picture.width) as f64));
        picture.bilinear(from.x, from.y).map_or(0.0, |value| value as f32)
    };
    Image { width: picture.width, height: picture.height, pixels: (0..picture.pixels.len()).map(at).collect() }
}

/// A session's frames were taken as straight: beads of a 20 px pincushion gave no pose, or one that was millimetres off.
#[test]
fn frames_of_an_intensifier_are_undistorted_and_their_drrs_distorted() {
    let Some(lab) = Lab::start(&["--kit-only", "--exposures", "2"]) else { return };
    let pictures = pictures(&lab);
    assert_eq!(pictures.len(), 2);
    let put = || {
        for (index, picture) in pictures.iter().enumerate() {
            write_png16(&lab.frames().join(format!("frame-{:03}.png", index + 1)), &seen_through(picture));
        }
    };
    put();
    let size_px = [pictures[0].width as u32, pictures[0].height as u32];
    std::fs::write(lab.kit.join("ii.json"), BENT.calibration(size_px, "given").to_string()).expect("written");
    let (poses, pairs, said) = session(&lab, |session| {
        session["domain"] = json!("linear");
        session["intensifier"] = json!("ii.json");
    });
    let errors = errors_px(&lab, &poses, |p| p);
    assert_eq!(errors.len(), 2, "{said}");
    assert!(errors.iter().all(|(_, px)| *px < 0.5), "{errors:?}");
    for pair in &pairs {
        assert!(pair["scores"]["zncc"].as_f64().is_some_and(|zncc| zncc > 0.98), "{}", pair["scores"]["zncc"]);
    }
    // The same frames, said to be those of a flat detector.
    put();
    std::fs::remove_dir_all(lab.kit.join("out")).expect("removed");
    let (poses, pairs, _) = session(&lab, |session| {
        session["domain"] = json!("linear");
        session["intensifier"] = json!("none");
    });
    let wrong = errors_px(&lab, &poses, |p| p);
    assert!(wrong.is_empty(), "{wrong:?}");
    assert!(pairs.iter().all(|pair| pair["reason"].to_string().contains("distorted: ")), "{pairs:#?}");
}

/// A plate of absorbing ink, from the picture's own projection.
#[cfg(feature = "vision")]
fn with_tag(picture: &mut Image<f32>, projection: &DMat3, id: usize, size_mm: f64) {
    let back = projection.inverse();
    for index in 0..picture.pixels.len() {
        let pixel = DVec2::new((index % picture.width) as f64, (index / picture.width) as f64);
        let mut shadow = 0.0;
        for (du, dv) in [(-0.25, -0.25), (0.25, -0.25), (-0.25, 0.25), (0.25, 0.25)] {
            let on_plate = back * (pixel + DVec2::new(du, dv)).extend(1.0);
            let (x, y) = (on_plate.x / on_plate.z, on_plate.y / on_plate.z);
            shadow += if crate::tags_drawn::dark(id, size_mm, x, y) == Some(true) { 0.25 } else { 0.0 };
        }
        picture.pixels[index] *= 1.0 - 0.6 * shadow as f32;
    }
}

#[cfg(feature = "vision")]
fn vector(row: &[f64]) -> DVec3 {
    DVec3::new(row[0], row[1], row[2])
}

/// `live` knew beads only.
#[cfg(feature = "vision")]
#[test]
fn tags_start_a_session_s_beads_and_stand_alone_where_there_are_none() {
    let Some(lab) = Lab::start(&["--kit-only", "--exposures", "2"]) else { return };
    let truth: Value = serde_json::from_slice(&std::fs::read(lab.kit.join("truth.json")).expect("truth")).expect("JSON");
    let beads: Value = serde_json::from_slice(&std::fs::read(lab.kit.join("beads.mrk.json")).expect("beads")).expect("JSON");
    let points = beads["markups"][0]["controlPoints"].as_array().expect("points").clone();
    let centre: DVec3 =
        points.iter().map(|point| vector(&rows(&json!([point["position"]]))[0])).sum::<DVec3>() / points.len() as f64;
    let pictures = pictures(&lab);
    let first = rows(&truth["frames"][0]["projection"]);
    let z = vector(&first[2]).normalize();
    let x = (vector(&first[0]) - vector(&first[0]).dot(z) * z).normalize();
    let facing = DMat3::from_cols(x, z.cross(x), z);
    // Two plates that are tilted against each other.
    let plates = [(0usize, 18.0, -30.0f64, -26.0), (3, 18.0, 30.0, 26.0)].map(|(id, size_mm, tilt_deg, along_mm)| {
        let turn = DMat3::from_axis_angle(facing.y_axis, tilt_deg.to_radians()) * facing;
        (id, size_mm, turn, centre + along_mm * facing.x_axis)
    });
    let tags = plates.map(|(id, size_mm, turn, at)| {
        let row = |n: usize| [turn.x_axis[n], turn.y_axis[n], turn.z_axis[n], at[n]];
        json!({"id": id, "size_mm": size_mm, "sigma_mm": 0.02, "lps_from_tag": [row(0), row(1), row(2), [0.0, 0.0, 0.0, 1.0]]})
    });
    std::fs::write(lab.kit.join("tags.json"), json!({"family": "tag36h11", "tags": tags}).to_string()).expect("written");
    let put = || {
        for (index, picture) in pictures.iter().enumerate() {
            let projection = rows(&truth["frames"][index]["projection"]);
            let mut shown = picture.clone();
            for (id, size_mm, turn, at) in plates {
                let column =
                    |v: DVec3, w: f64| DVec3::from_array([0, 1, 2].map(|n| vector(&projection[n]).dot(v) + projection[n][3] * w));
                with_tag(
                    &mut shown,
                    &DMat3::from_cols(column(turn.x_axis, 0.0), column(turn.y_axis, 0.0), column(at, 1.0)),
                    id,
                    size_mm,
                );
            }
            write_png16(&lab.frames().join(format!("frame-{:03}.png", index + 1)), &shown);
        }
    };
    put();
    let (poses, _, said) = session(&lab, |session| {
        session["domain"] = json!("linear");
        session["tags"] = json!("tags.json");
    });
    let errors = errors_px(&lab, &poses, |p| p);
    assert_eq!(errors.len(), 2, "{said}");
    assert!(errors.iter().all(|(_, px)| *px < 0.5), "{errors:?}");
    let started = poses.iter().filter(|pose| pose["pose"]["notes"].to_string().contains("tags put them")).count();
    assert!(
        started > 0 && poses.iter().all(|pose| pose["pose"]["tags"].as_array().is_some_and(|tags| !tags.is_empty())),
        "{poses:#?}"
    );
    // The same tags, bit for bit, come back from the log.
    let (log, again) = (lab.kit.join("out").join("session.mcap"), lab.kit.join("again"));
    let mut replay = std::process::Command::new(env!("CARGO_BIN_EXE_sidecarm"));
    let replayed = replay.arg("replay").arg(log).arg("--data").arg(&lab.kit).arg("--json").arg("--out").arg(again).output();
    let replayed = replayed.expect("runs");
    let found: Value = serde_json::from_slice(&replayed.stdout).unwrap_or_else(|_| panic!("{replayed:?}"));
    let different = found["poses_different"].as_array().map(Vec::len);
    assert_eq!((found["poses_identical"].as_u64(), different), (Some(poses.len() as u64), Some(0)), "{found:#}");

    put();
    std::fs::remove_dir_all(lab.kit.join("out")).expect("removed");
    let (poses, pairs, said) = session(&lab, |session| {
        session["domain"] = json!("linear");
        session["tags"] = json!("tags.json");
        session["beads"] = Value::Null;
    });
    let errors = errors_px(&lab, &poses, |p| p);
    assert_eq!(errors.len(), 2, "{said}");
    assert!(errors.iter().all(|(_, px)| *px < 3.0), "{errors:?}");
    assert!(pairs.iter().all(|pair| pair["flags"].to_string().contains("tags alone")), "{pairs:#?}");
}
