//! The pictures of the README, made from mocked sessions: the window under Xvfb, a strip, the report.
#![cfg(all(feature = "viewer", target_os = "linux"))]

use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::time::Duration;

use base64::Engine as _;
use serde_json::{Value, json};
use sidecarm::acquire::read_frame;
use sidecarm::image::{Image, read_png_rgb, write_png_rgb};
use sidecarm::report::colour::{BACKGROUND, BAD, CAUTION, GOOD};

use crate::lab_truth::file_of;
use crate::live_lab::{HANG_S, Lab, Live, Signal, eventually};
use crate::viewer_real::{Screen, newest, window_of_replay};

type Rgb = [u8; 3];

/// Scores that a window shows: of most of them the null is known.
const MARKS: usize = 4;
/// The banner has more pixels; words and dots of its colour have fewer.
const BANNER_PX: usize = 5_000;
/// Colours of a bead's ring and of a residual's arrow (`src/report/figures.rs`).
const RING: Rgb = [40, 230, 80];
const ARROW: Rgb = [255, 110, 230];

fn is_like(pixel: &Rgb, colour: Rgb, most: u8) -> bool {
    pixel.iter().zip(colour).all(|(a, b)| a.abs_diff(b) <= most)
}

fn count(picture: &Image<Rgb>, colour: Rgb, most: u8) -> usize {
    picture.pixels.iter().filter(|pixel| is_like(pixel, colour, most)).count()
}

/// Whether the window's upper left corner says in this colour how the exposure came out; the timeline has all colours.
fn has_banner(picture: &Image<Rgb>, colour: Rgb) -> bool {
    let corner = picture.part(&[0..picture.width / 4, 0..picture.height / 4]);
    count(&corner, colour, 2) > BANNER_PX
}

/// Marks of the stated pose among wrong ones: thin upright strokes at the left of the window, in the colours that say whether a score tells
/// poses apart. There are none before the null is there.
fn marks(picture: &Image<Rgb>) -> usize {
    let mut found = 0;
    for colour in [GOOD, CAUTION] {
        let is = |u: usize, v: usize| u < picture.width && v < picture.height && is_like(picture.at(u, v), colour, 2);
        for u in 0..picture.width / 4 {
            let mut v = 0;
            while v < picture.height {
                let high = (v..picture.height).take_while(|row| is(u, *row)).count();
                let middle = v + high / 2;
                let begins_here = u == 0 || !is(u - 1, middle);
                let wide = (u..picture.width).take_while(|column| is(*column, middle)).count();
                found += usize::from((12..=16).contains(&high) && (1..=4).contains(&wide) && begins_here);
                v += high.max(1);
            }
        }
    }
    found
}

/// What the window shows once its banner has this colour, so many nulls are in it, and it stands still.
fn shown(screen: &Screen, banner: Rgb, least: usize, said: impl FnOnce() -> String) -> Image<Rgb> {
    let still = || screen.part(340..1390, 60..780);
    let found = eventually(HANG_S, || {
        let (picture, before) = (screen.picture(), still());
        let is_there = has_banner(&picture, banner) && marks(&picture) >= least;
        std::thread::sleep(Duration::from_millis(500));
        (is_there && still() == before).then_some(picture)
    });
    found.unwrap_or_else(|| panic!("never on the screen: {banner:?} with {least} nulls: {}", said()))
}

/// Ends a session with its report.
fn end(mut live: Live) {
    live.program.signal(Signal::TERM);
    assert!(live.program.end(HANG_S).is_some(), "{}", live.stderr());
}

/// The page in a browser that needs no screen, 1000 px wide; which one. `None` where there is none.
fn in_browser(page: &Path, to: &Path) -> Option<&'static str> {
    let address = format!("file://{}", page.display());
    let of_chromium = ["--headless", "--no-sandbox", "--disable-gpu", "--hide-scrollbars", "--window-size=1000,1400"];
    let of_firefox = ["--headless", "--window-size", "1000,1400", "--screenshot"];
    ["chromium", "google-chrome", "firefox", "firefox-esr"].into_iter().find(|browser| {
        let mut command = Command::new(browser);
        match browser.starts_with("firefox") {
            true => command.args(of_firefox).arg(to),
            false => command.args(of_chromium).arg(format!("--screenshot={}", to.display())),
        };
        command.arg(&address).stdin(Stdio::null()).stdout(Stdio::null()).stderr(Stdio::null());
        command.status().is_ok_and(|status| status.success()) && to.is_file()
    })
}

/// The small pictures that a page holds: strips with their overlays, as the page shows them.
fn held(page: &str) -> Vec<image::RgbImage> {
    let jpegs = page.split("data:image/jpeg;base64,").skip(1).filter_map(|rest| {
        let bytes = base64::engine::general_purpose::STANDARD.decode(rest.split(')').next()?).ok()?;
        image::load_from_memory_with_format(&bytes, image::ImageFormat::Jpeg).ok()
    });
    jpegs.map(|picture| picture.to_rgb8()).collect()
}

/// Pictures below each other.
fn stacked(pictures: &[image::RgbImage]) -> image::RgbImage {
    const GAP: u32 = 12;
    let width = pictures.iter().map(image::RgbImage::width).max().unwrap_or(1);
    let height = pictures.iter().map(|picture| picture.height() + GAP).sum::<u32>().saturating_sub(GAP).max(1);
    let (mut all, mut top) = (image::RgbImage::from_pixel(width, height, image::Rgb(BACKGROUND)), 0);
    for picture in pictures {
        image::imageops::replace(&mut all, picture, 0, i64::from(top));
        top += picture.height() + GAP;
    }
    all
}

/// A picture of the report; says of what it is made.
fn report(page: &Path, to: &Path) {
    if let Some(browser) = in_browser(page, to) {
        println!("the report's page, by {browser}: {}", to.display());
        return;
    }
    let all = held(&std::fs::read_to_string(page).expect("a page"));
    assert!(all.len() >= 3, "{} pictures in the page", all.len());
    let chosen = [&all[..2], &all[all.len() - 1..]].concat();
    stacked(&chosen).save(to).expect("written");
    println!("no browser that needs no screen: strips of the report's page: {}", to.display());
}

/// Folder of the pictures.
fn folder() -> PathBuf {
    let usual = concat!(env!("CARGO_MANIFEST_DIR"), "/docs/pictures");
    PathBuf::from(std::env::var("SIDECARM_OUT").unwrap_or_else(|_| usual.to_owned()))
}

#[test]
#[ignore = "makes pictures: scripts/evaluate gallery runs it"]
fn pictures() {
    let (screen, folder) = (Screen::required(), folder());
    let lab = || Lab::start(&["--duration-s", "40", "--faults", "none"]);
    let write = |name: &str, picture: &Image<Rgb>| write_png_rgb(&folder.join(name), picture).expect("written");

    let Some(first) = lab() else { return };
    let live = Live::windowed(&first.kit.join("session.json"), &first.kit.with_file_name("session"), &screen.display);
    let is_complete = |pair: &Value| pair["drr"].is_string() && pair["null"].as_object().is_some_and(|null| !null.is_empty());
    let accepted = newest(&live, |pair| pair["status"] == "accepted" && pair["number"].as_u64() >= Some(5) && is_complete(pair));
    write("window-live.png", &shown(&screen, GOOD, MARKS, || live.stderr()));
    // In the seventh exposure the collimator leaves too few beads: its pose is telemetry's.
    newest(&live, |pair| pair["status"] == "refused" && is_complete(pair));
    let (log, out) = (live.log.clone(), live.out.clone());
    end(live);
    let strip = out.join(accepted["strip"].as_str().expect("its strip"));
    let drawn = read_png_rgb(&strip).expect("a strip");
    // Residuals of hundredths of a pixel are dots, even twenty times enlarged.
    let (rings, arrows) = (count(&drawn, RING, 40), count(&drawn, ARROW, 70));
    assert!(rings > 100 && arrows > 0, "the strip shows its beads and their residuals: {rings} and {arrows} pixels");
    std::fs::copy(strip, folder.join("strip-demo.png")).expect("copied");
    report(&out.join("report.html"), &folder.join("report.png"));

    let again = first.kit.with_file_name("replayed");
    let mut replay = window_of_replay(&log, &["--rate", "8", "--out", again.to_str().expect("UTF-8")], &screen);
    let replayed = eventually(HANG_S, || std::fs::metadata(again.join("report.html")).ok());
    assert!(replayed.is_some(), "no report of the replay");
    write("window-replay.png", &shown(&screen, CAUTION, MARKS, || format!("{:?}", replay.0.try_wait())));
    drop(replay);

    // The session says that the specimen lies three centimetres beside where it does.
    let Some(second) = lab() else { return };
    let elsewhere = second.session("elsewhere.json", |session| {
        let x_mm = session["world_from_lps"][0][3].as_f64().expect("a place");
        session["world_from_lps"][0][3] = json!(x_mm + 30.0);
    });
    let live = Live::windowed(&elsewhere, &second.kit.with_file_name("elsewhere"), &screen.display);
    newest(&live, |pair| pair["status"] == "accepted_telemetry_disagrees" && is_complete(pair));
    write("window-amber.png", &shown(&screen, CAUTION, MARKS, || live.stderr()));
    end(live);

    // The only frame that comes is the one in which too few beads are seen, and nothing has tied the specimen to the room before it: telemetry
    // gives it no pose either.
    let Some(third) = lab() else { return };
    let received = third.kit.join("received");
    std::fs::create_dir(&received).expect("a folder");
    let untied = third.session("untied.json", |session| {
        session["world_from_lps"] = Value::Null;
        session["frames"]["folder"] = json!(received);
    });
    let live = Live::windowed(&untied, &third.kit.with_file_name("untied"), &screen.display);
    let taken = file_of(&third, 7);
    assert!(eventually(HANG_S, || read_frame(&taken, None).ok().map(drop)).is_some(), "no seventh frame: {}", live.stderr());
    let staged = third.kit.join("staged");
    std::fs::copy(&taken, &staged).expect("copied");
    std::fs::rename(&staged, received.join("frame-007.dcm")).expect("renamed");
    let refused = newest(&live, |pair| pair["status"] == "refused");
    let reason = refused["reason"].as_str().unwrap_or_default();
    assert!(refused["pose_source"] == "none" && reason.contains("too_few_shadows"), "{refused:#}");
    write("window-refused.png", &shown(&screen, BAD, 0, || live.stderr()));
    end(live);
}

/// The picture of a window was taken before its null was there: a pair in `pairs.json` is not yet one on the screen.
#[test]
fn marks_of_the_null_are_told_from_banners_buttons_and_words() {
    let mut picture = Image::filled(1400, 900, BACKGROUND);
    let mut fill = |[left, top, width, height]: [usize; 4], colour: Rgb| {
        for v in top..top + height {
            for u in left..left + width {
                *picture.at_mut(u, v) = colour;
            }
        }
        (marks(&picture), has_banner(&picture, GOOD))
    };
    assert_eq!(fill([320, 820, 900, 30], GOOD), (0, false), "a timeline");
    assert_eq!(fill([8, 8, 300, 84], GOOD), (0, true), "a banner");
    // Its letters leave narrow strokes between them, higher than a mark.
    assert_eq!(fill([60, 30, 20, 40], BACKGROUND), (0, true));
    assert_eq!(fill([83, 30, 40, 40], BACKGROUND), (0, true), "between two letters");
    assert_eq!(fill([10, 440, 9, 9], GOOD).0, 0, "the dot of a device");
    assert_eq!(fill([10, 470, 1, 10], CAUTION).0, 0, "a letter");
    assert_eq!(fill([600, 500, 3, 14], GOOD).0, 0, "in a picture");
    assert_eq!(fill([320, 780, 40, 14], GOOD).0, 0, "an exposure of a lower timeline");
    for row in 0..6 {
        assert_eq!(fill([220, 250 + 18 * row, 3, 14], [GOOD, CAUTION][row % 2]).0, row + 1);
    }
}

#[test]
fn the_report_s_pictures_are_found_in_its_page_and_stand_below_each_other() {
    let jpeg = |width: u32, level: u8| {
        let mut bytes = std::io::Cursor::new(Vec::new());
        let picture = image::RgbImage::from_pixel(width, 40, image::Rgb([level; 3]));
        picture.write_to(&mut bytes, image::ImageFormat::Jpeg).expect("encodes");
        base64::engine::general_purpose::STANDARD.encode(bytes.get_ref())
    };
    let rule = |number: u32, jpeg: &str| format!(".p{number}{{background-image:url(data:image/jpeg;base64,{jpeg})}}\n");
    let page = format!("<style>{}{}</style>", rule(0, &jpeg(96, 40)), rule(1, &jpeg(64, 200)));
    let found = held(&page);
    assert_eq!(found.iter().map(image::RgbImage::dimensions).collect::<Vec<_>>(), [(96, 40), (64, 40)]);
    let all = stacked(&found);
    assert_eq!(all.dimensions(), (96, 92));
    assert!(all.get_pixel(10, 10)[0] < 60 && all.get_pixel(10, 80)[0] > 180 && all.get_pixel(90, 80).0 == BACKGROUND);
    assert!(held("<p>no pictures</p>").is_empty());
}
