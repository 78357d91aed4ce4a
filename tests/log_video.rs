//! `sidecarm log video`: the strips of a session one after the other, as anybody's player sees them.
#![cfg(all(unix, feature = "vision"))]

use std::path::Path;

use opencv::core::{Mat, MatTraitConstManual, Vec3b};
use opencv::videoio::{CAP_ANY, VideoCapture, VideoCaptureTrait};
use serde_json::Value;
use sidecarm::image::{Image, read_png_rgb};

use crate::log_lab::{recorded, sidecarm, text};

/// The pictures of a video.
fn pictures(path: &Path) -> Vec<Image<[u8; 3]>> {
    let mut video = VideoCapture::from_file(text(path), CAP_ANY).expect("opens");
    let (mut picture, mut found) = (Mat::default(), Vec::new());
    while video.read(&mut picture).expect("reads") {
        use opencv::core::MatTraitConst;
        let pixels = picture.data_typed::<Vec3b>().expect("colours").iter().map(|pixel| [pixel.0[2], pixel.0[1], pixel.0[0]]);
        found.push(Image::from_pixels(picture.cols() as usize, picture.rows() as usize, pixels.collect()).expect("a picture"));
    }
    found
}

/// Root of the mean square of what two pictures differ by.
fn apart(a: &Image<[u8; 3]>, b: &Image<[u8; 3]>) -> f64 {
    assert_eq!([a.width, a.height], [b.width, b.height]);
    let squares = a.pixels.iter().flatten().zip(b.pixels.iter().flatten()).map(|(a, b)| f64::from(a.abs_diff(*b)).powi(2));
    (squares.sum::<f64>() / (3 * a.pixels.len()) as f64).sqrt()
}

#[test]
fn the_strips_of_a_session_follow_each_other_in_the_order_of_their_exposures() {
    let Some(session) = recorded() else { return };
    let (log, folder) = (&session.logs[0], tempfile::tempdir().expect("a folder"));
    let out = folder.path().join("pairs.avi");
    let ran = sidecarm(&["log", "video", text(log), "--out", text(&out), "--pair-s", "1", "--json"]);
    assert_eq!(ran.code, Some(0), "{}{}", ran.stdout, ran.stderr);
    let home = log.parent().expect("a folder");
    let pairs: Value = serde_json::from_slice(&std::fs::read(home.join("pairs.json")).expect("pairs")).expect("JSON");
    let mut shown: Vec<(i64, String)> = Vec::new();
    for pair in pairs["pairs"].as_array().expect("a list") {
        shown.push((pair["time_us"].as_i64().expect("a time"), pair["strip"].as_str().expect("a strip").to_owned()));
    }
    shown.sort();
    let told = ran.json();
    assert_eq!((&told["pairs"], &told["seconds"]), (&shown.len().into(), &(shown.len() as f64).into()));
    let found = pictures(&out);
    // Two pictures a second.
    assert_eq!(found.len(), 2 * shown.len());
    let strips: Vec<_> = shown.iter().map(|(_, strip)| read_png_rgb(&home.join(strip)).expect("a strip")).collect();
    for (index, picture) in found.iter().enumerate() {
        let own = apart(picture, &strips[index / 2]);
        let others = (0..strips.len()).filter(|other| *other != index / 2).map(|other| apart(picture, &strips[other]));
        let nearest = others.fold(f64::INFINITY, f64::min);
        assert!(own < 12.0 && own < 0.7 * nearest, "picture {index}: {own} from its strip, {nearest} from another");
    }
    let again = sidecarm(&["log", "video", text(log), "--out", text(&out)]);
    assert!(again.code == Some(1) && again.stderr.contains("exists already"), "{}", again.stderr);
    let alone = folder.path().join("alone.mcap");
    std::fs::copy(log, &alone).expect("copied");
    let ran = sidecarm(&["log", "video", text(&alone), "--out", text(&folder.path().join("other.avi"))]);
    assert!(ran.code == Some(1) && ran.stderr.contains("sidecarm replay"), "{}", ran.stderr);
    let left: Vec<_> = std::fs::read_dir(folder.path()).expect("listed").flatten().map(|entry| entry.file_name()).collect();
    assert_eq!(left.len(), 2, "{left:?}");
}
