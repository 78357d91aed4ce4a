//! The `sidecarm-video` program: opens a video with OpenCV and hands its pictures to `sidecarm`, which starts it.
//!
//! A program of its own, since OpenCV's video brings 250 shared libraries: each start of `sidecarm` would wait a third of a second for them.
//! What it writes to its standard output is that of `src/acquire/video/capture.rs`; what libraries and drivers would write there goes to standard
//! error. It ends when its standard input does.

use std::io::{BufWriter, Read, Write};

use opencv::core::{Mat, MatTraitConst, MatTraitConstManual, Vec3b};
use opencv::videoio::{
    CAP_ANY, CAP_PROP_FOURCC, CAP_PROP_FPS, CAP_V4L2, VideoCapture, VideoCaptureTrait, VideoCaptureTraitConst,
};

/// Pictures a second of a recording that does not say it.
const USUAL_PER_S: f64 = 25.0;

/// Recordings whose pictures are told as differences from others, by the first letters of their four.
const OF_DIFFERENCES: [&str; 13] = ["h26", "x26", "avc", "hev", "hvc", "mp4", "fmp4", "xvi", "div", "dx5", "mpg", "vp", "av0"];

/// Pictures that fail in a row until a device counts as gone.
const FAILURES: u32 = 10;
/// Between two of them.
const SHORTLY: std::time::Duration = std::time::Duration::from_millis(20);

fn main() -> std::process::ExitCode {
    let Some(from) = std::env::args().nth(1) else {
        eprintln!("sidecarm-video is started by sidecarm; see `sidecarm grab --help`");
        return std::process::ExitCode::from(2);
    };
    std::thread::spawn(|| {
        let _ = std::io::stdin().read_to_end(&mut Vec::new());
        leave();
    });
    let out = match out_for_pictures() {
        Ok(out) => out,
        Err(error) => {
            eprintln!("sidecarm-video: standard output cannot be kept for pictures ({error})");
            return std::process::ExitCode::FAILURE;
        }
    };
    // Who does not listen any more needs no word.
    let _ = tell(&from, &mut BufWriter::new(out));
    std::process::ExitCode::SUCCESS
}

/// Standard output under another number. Its own number is standard error's from now on: a word of a library among the pictures would be taken
/// for a part of one.
#[cfg(unix)]
fn out_for_pictures() -> std::io::Result<std::fs::File> {
    use std::os::fd::AsFd;
    let out = std::io::stdout().as_fd().try_clone_to_owned()?;
    rustix::stdio::dup2_stdout(std::io::stderr())?;
    Ok(std::fs::File::from(out))
}

/// Standard output, in which libraries write as well.
#[cfg(not(unix))]
fn out_for_pictures() -> std::io::Result<std::io::StdoutLock<'static>> {
    Ok(std::io::stdout().lock())
}

/// Whoever started it is gone. What libraries do when a process exits may wait for the very driver that hangs: none of it is done.
fn leave() -> ! {
    #[cfg(unix)]
    let _ = rustix::process::kill_process(rustix::process::getpid(), rustix::process::Signal::KILL);
    std::process::exit(0)
}

fn tell(from: &str, out: &mut impl Write) -> std::io::Result<()> {
    // A device, by its path or number, a file, or a stream.
    let path = if from.bytes().all(|byte| byte.is_ascii_digit()) { format!("/dev/video{from}") } else { from.to_owned() };
    let backend = if path.starts_with("/dev/video") && cfg!(target_os = "linux") { CAP_V4L2 } else { CAP_ANY };
    let is_live = !std::path::Path::new(&path).is_file();
    let opened = VideoCapture::from_file(&path, backend).ok().filter(|video| video.is_opened().unwrap_or(false));
    let Some(mut video) = opened else {
        out.write_all(b"N")?;
        return out.flush();
    };
    let per_s = video.get(CAP_PROP_FPS).ok().filter(|per_s| (1.0..=1000.0).contains(per_s)).unwrap_or(USUAL_PER_S);
    let code = video.get(CAP_PROP_FOURCC).unwrap_or(0.0) as u32;
    let letters = String::from_utf8_lossy(&code.to_le_bytes()).to_ascii_lowercase();
    let is_of_differences = !is_live && OF_DIFFERENCES.iter().any(|start| letters.starts_with(start));
    out.write_all(b"O")?;
    out.write_all(&[u8::from(is_live), u8::from(is_of_differences)])?;
    out.write_all(&per_s.to_le_bytes())?;
    out.flush()?;
    let (mut picture, mut failures) = (Mat::default(), 0);
    loop {
        if !video.read(&mut picture).unwrap_or(false) || picture.empty() {
            failures += 1;
            if !is_live || failures >= FAILURES {
                break;
            }
            std::thread::sleep(SHORTLY);
            continue;
        }
        failures = 0;
        let pixels = match picture.channels() {
            1 => picture.data_typed::<u8>().map(<[u8]>::to_vec),
            3 => picture.data_typed::<Vec3b>().map(|colours| colours.iter().map(grey).collect()),
            _ => Ok(Vec::new()),
        };
        match pixels {
            Ok(pixels) if !pixels.is_empty() => {
                out.write_all(b"P")?;
                for edge in [picture.cols(), picture.rows()] {
                    out.write_all(&edge.unsigned_abs().to_le_bytes())?;
                }
                out.write_all(&pixels)?;
            }
            _ => {
                out.write_all(b"C")?;
                out.write_all(&picture.channels().to_le_bytes())?;
                return out.flush();
            }
        }
        out.flush()?;
    }
    out.write_all(b"E")?;
    out.flush()
}

/// Luma of blue, green and red (ITU-R BT.601), exact where all three are alike.
fn grey(colour: &Vec3b) -> u8 {
    let [blue, green, red] = colour.0.map(u32::from);
    ((29 * blue + 150 * green + 77 * red + 128) >> 8) as u8
}
