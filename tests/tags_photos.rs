//! Photographs of printed tags, taken and measured by others.

use std::path::{Path, PathBuf};

use glam::DVec2;
use sidecarm::acquire::read_photo;
use sidecarm::beads::tags::{Family, SeenTag, find_tags};

fn photo(name: &str) -> Option<PathBuf> {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("../shared/data/apriltag-photos").join(name);
    if path.exists() {
        return Some(path);
    }
    println!("skipped: {name} is not beside the project (../shared/data/apriltag-photos)");
    None
}

fn tags_of(path: &Path) -> Vec<SeenTag> {
    find_tags(&read_photo(path).expect("a photograph"), Family::Tag36h11).expect("tags are built in")
}

/// Lines of `id, (u v), (u v), (u v), (u v)`, counted from the first pixel's corner.
fn expected(text: &str) -> Vec<(u32, Vec<DVec2>)> {
    let line = |line: &str| {
        let (id, corners) = line.split_once(',')?;
        let numbers: Vec<f64> =
            corners.split(|c: char| !c.is_ascii_digit() && c != '.').filter_map(|word| word.parse().ok()).collect();
        let corners = numbers.chunks_exact(2).map(|pair| DVec2::new(pair[0], pair[1])).collect();
        Some((id.trim().parse().ok()?, corners))
    };
    text.lines().filter_map(line).collect()
}

#[test]
fn all_forty_tags_of_the_printed_grid_are_read() {
    let Some(path) = photo("taggridphoto.jpg") else { return };
    let seen = tags_of(&path);
    assert_eq!(seen.iter().map(|tag| tag.id).collect::<Vec<_>>(), (1..=40).collect::<Vec<_>>());
    assert!(seen.iter().all(|tag| tag.hamming == 0 && !tag.inverted && !tag.mirrored));
    // Five to a column, eight columns: the ids run down the sheet.
    assert!(seen.windows(2).all(|pair| pair[1].id % 5 == 1 || pair[1].centre_px.y > pair[0].centre_px.y));
}

#[test]
fn corners_agree_with_those_measured_by_others_and_the_half_pixel_is_seen() {
    let (Some(image), Some(text)) = (photo("33369213973_9d9bb4cc96_c.jpg"), photo("33369213973_9d9bb4cc96_c.txt")) else {
        return;
    };
    let seen = tags_of(&image);
    let measured = expected(&std::fs::read_to_string(text).expect("text"));
    assert_eq!((measured.len(), seen.len()), (12, 12));
    let mut offsets = Vec::new();
    for (id, corners) in &measured {
        assert_eq!(corners.len(), 4);
        let distance = |tag: &&SeenTag| tag.corners_px.iter().zip(corners).map(|(a, b)| a.distance(*b)).sum::<f64>();
        let own = seen.iter().filter(|tag| tag.id == *id);
        let own = own.min_by(|a, b| distance(a).total_cmp(&distance(b))).expect("of the same id");
        offsets.extend(own.corners_px.iter().zip(corners).map(|(found, there)| *found - (*there - 0.5)));
    }
    let worst = offsets.iter().map(|off| off.length()).fold(0.0, f64::max);
    let mean = |shift: f64| offsets.iter().map(|off| *off + shift).sum::<DVec2>() / offsets.len() as f64;
    println!("{} corners, worst {worst:.3} px, mean {:.3}", offsets.len(), mean(0.0));
    assert!(worst < 1.0, "{worst} px");
    assert!(mean(0.0).abs().max_element() < 0.15, "{}", mean(0.0));
    assert!(mean(0.5).abs().min_element() > 0.3, "the control");
}

#[test]
fn an_upright_photograph_is_read_and_its_mirror_image_is_called_one() {
    let Some(path) = photo("tagtest.jpg") else { return };
    let mut frame = read_photo(&path).expect("a photograph");
    let upright = find_tags(&frame, Family::Tag36h11).expect("built in");
    assert!([5, 6].iter().all(|id| upright.iter().any(|tag| tag.id == *id && !tag.mirrored)), "{upright:?}");
    let width = frame.size_px[0];
    frame.pixels.pixels.chunks_exact_mut(width).for_each(<[f32]>::reverse);
    let mirrored = find_tags(&frame, Family::Tag36h11).expect("built in");
    assert_eq!(mirrored.len(), upright.len());
    for (there, here) in mirrored.iter().zip(&upright) {
        assert!(there.mirrored && there.id == here.id);
        let back = DVec2::new((width - 1) as f64 - there.centre_px.x, there.centre_px.y);
        assert!(back.distance(here.centre_px) < 0.1, "{back} {}", here.centre_px);
    }
}
