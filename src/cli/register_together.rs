//! `sidecarm register FRAME… --together`: several frames of one bead set.

use std::path::{Path, PathBuf};

use super::exit::LOSS;
use super::read_aloud::frame_aloud;
use super::register_args::{Given, RegisterArgs};
use super::register_error::RegisterError;
use super::register_seen::{Console, Seen};
use crate::image::{check_writable, refuse_same_content};
use crate::mask;
use crate::pose::{BeadVerdict, IntrinsicsPrior, Pose, SeveralViews, Together, ViewAlone, register_masked, register_together};
use crate::reporter::Reporter;

/// Standard deviation of a bead's place per axis where its description gives none, mm. A single frame trusts a layout more: it cannot
/// see that a bead is elsewhere.
const SIGMA_MM: f64 = 0.15;

/// Registers each frame, solves all together, writes and prints. Returns the exit code: 0 accepted, 1 refused, 3 accepted without some of the views.
///
/// # Errors
/// When an input cannot be read or does not fit the others, or an output cannot be written.
pub fn run(args: &RegisterArgs, reporter: &Reporter) -> Result<u8, RegisterError> {
    if args.distortion_file().is_some() {
        return Err(RegisterError::DistortedTogether);
    }
    let outputs = Outputs::of(args);
    // Of one picture two views would count as two.
    refuse_same_content(&args.frames)?;
    let mut given = Given::read(args, &outputs.all())?;
    given.tell_doubts(reporter);
    outputs.prepare()?;
    let mut assumed = 0;
    for bead in given.layout.beads.iter_mut().filter(|bead| bead.sigma_mm.is_none()) {
        bead.sigma_mm = Some(SIGMA_MM);
        assumed += 1;
    }
    let (mut views, mut intrinsics_prior, mut size_px) = (Vec::new(), None, None);
    let progress = reporter.progress("registering frames", args.frames.len() as u64);
    for (number, path) in args.frames.iter().enumerate() {
        let stored = frame_aloud(path, args.domain, reporter)?;
        let mut notes = stored.altered.clone();
        let console = match Console::of(args, &given, &stored, &mut notes)? {
            Ok(console) => console,
            Err(pose) => {
                let name = path.display().to_string();
                views.push(ViewAlone { name, pose: *pose, prior: None, round_field: None, is_k_of_header: false });
                progress.advance(1);
                continue;
            }
        };
        let seen = Seen::of(args, path, &stored, given.file.as_ref(), console.as_ref())?;
        let found = seen.frame.size_px.map(|n| n as u32);
        let expected = *size_px.get_or_insert(found);
        if expected != found {
            return Err(RegisterError::Sizes { path: path.clone(), expected, found });
        }
        let prior = given.priors.get(number).map(|prior| prior.turned(seen.turn_rad));
        let request = seen.request(args, &given, prior.as_ref());
        let masks = mask::of_frame(&seen.frame);
        let mut pose = register_masked(&request, &seen.frame, &masks);
        let round_field = request.round_field_of(&seen.frame, &masks);
        if let Some(words) = seen.off_header(&pose) {
            pose.doubt(words);
        }
        pose.hear_header(&seen.frame, false, IntrinsicsPrior::stated_focal_sigma_px(seen.prior.as_ref()));
        given.pass_doubt_on(number, &mut pose);
        pose.notes.extend(notes.into_iter().chain(seen.notes));
        if assumed > 0 {
            pose.notes.push(format!("{assumed} bead positions without sigma_mm are taken to be good to {SIGMA_MM} mm per axis"));
        }
        intrinsics_prior = seen.prior;
        let (name, is_k_of_header) = (path.display().to_string(), seen.is_k_of_header);
        views.push(ViewAlone { name, pose, prior, round_field, is_k_of_header });
        progress.advance(1);
    }
    let request = SeveralViews { layout: &given.layout, intrinsics_prior, landmarks: &given.landmarks, views: &views };
    let together = register_together(&request);
    outputs.write(&together)?;
    if args.json {
        match serde_json::to_string_pretty(&together) {
            Ok(text) => println!("{text}"),
            Err(error) => reporter.warn("json", format!("the poses cannot be printed: {error}")),
        }
    } else {
        print!("{}", summary(&together));
    }
    reporter.wrote(outputs.each.iter().chain([&outputs.all]));
    Ok(code(&together))
}

/// The exit code; which views are refused stands in the summary, and in each of them.
fn code(together: &Together) -> u8 {
    match (together.is_accepted(), together.views.iter().all(Pose::is_accepted)) {
        (false, _) => 1,
        (true, true) => 0,
        (true, false) => LOSS,
    }
}

/// Where results go.
struct Outputs {
    all: PathBuf,
    /// One for each frame, where `--out` is a folder.
    each: Vec<PathBuf>,
}

impl Outputs {
    /// What ends in .json is a file, all else a folder.
    fn of(args: &RegisterArgs) -> Self {
        let is_file = args.out.extension().is_some_and(|ending| ending.eq_ignore_ascii_case("json")) && !args.out.is_dir();
        if is_file {
            return Self { all: args.out.clone(), each: Vec::new() };
        }
        let name = |(n, frame): (usize, &PathBuf)| {
            let stem = frame.file_stem().map_or_else(|| "frame".to_owned(), |stem| stem.to_string_lossy().into_owned());
            args.out.join(format!("{:02}-{stem}.json", n + 1))
        };
        Self { all: args.out.join("POSES.json"), each: args.frames.iter().enumerate().map(name).collect() }
    }

    fn all(&self) -> Vec<&PathBuf> {
        std::iter::once(&self.all).chain(&self.each).collect()
    }

    /// Fails before the work where results could not be written after it.
    fn prepare(&self) -> Result<(), RegisterError> {
        if !self.each.is_empty() {
            let folder = self.all.parent().unwrap_or(Path::new("."));
            std::fs::create_dir_all(folder).map_err(|source| RegisterError::Folder { path: folder.to_owned(), source })?;
        }
        Ok(check_writable(&self.all)?)
    }

    fn write(&self, together: &Together) -> Result<(), RegisterError> {
        for (pose, path) in together.views.iter().zip(&self.each) {
            pose.write(path)?;
        }
        Ok(together.write(&self.all)?)
    }
}

/// Human words for several views.
fn summary(together: &Together) -> String {
    let mut lines = Vec::new();
    let accepted = together.views.iter().filter(|pose| pose.is_accepted()).count();
    if let Some(reason) = &together.reason {
        lines.push(format!("refused: {reason}"));
    } else {
        let times = together.chi2_per_dof.map_or(f64::NAN, f64::sqrt);
        let in_doubt = if together.doubt.is_some() { " in doubt" } else { "" };
        lines.push(format!(
            "accepted{in_doubt}: {accepted} of {} views together, residuals {times:.2} times what noise and bead positions give",
            together.views.len()
        ));
    }
    if let (Some(k), Some([f, _, x, y])) = (&together.intrinsics, together.intrinsics_sigma_px) {
        lines.push(format!("K solved: f {:.1} ± {f:.1} px, principal point {:.1} ± {x:.1}, {:.1} ± {y:.1} px", k.fx, k.cx, k.cy));
    }
    for (n, (pose, frame)) in together.views.iter().zip(&together.frames).enumerate() {
        let number = |value: Option<f64>| value.map_or("?".to_owned(), |value| format!("{value:.3}"));
        let used = pose.beads.iter().filter(|bead| bead.used).count();
        lines.push(match &pose.reason {
            Some(reason) => format!("view {}: {frame}: refused: {reason}", n + 1),
            None => {
                let sigma = pose.covariance_at_centroid.map_or([f64::NAN; 3], |rows| [3, 4, 5].map(|n| rows[n][n].sqrt()));
                format!(
                    "view {}: {frame}: {used} beads, rms {} px = {} mm, ± {:.3}, {:.3} mm across and {:.3} mm along the beam",
                    n + 1,
                    number(pose.rms_px),
                    number(pose.rms_mm),
                    sigma[0],
                    sigma[1],
                    sigma[2]
                )
            }
        });
    }
    if !together.beads.is_empty() {
        lines.push(format!("{:16} {:>9} {:>9} {:>9} {:>9} {:>6}", "bead", "x mm", "y mm", "z mm", "moved mm", "views"));
    }
    for bead in &together.beads {
        let verdict = match bead.verdict {
            BeadVerdict::InPlace => "",
            BeadVerdict::Migrated => "  migrated",
            BeadVerdict::Inconsistent => "  no one place explains it",
            BeadVerdict::Unclear => "  moved, or a shadow is off",
            BeadVerdict::NotSeen => "  not seen",
        };
        let p = bead.lps_mm;
        lines.push(format!(
            "{:16} {:9.3} {:9.3} {:9.3} {:9.3} {:>6}{verdict}",
            bead.name, p.x, p.y, p.z, bead.moved_mm, bead.views
        ));
    }
    lines.extend(together.cautions.iter().map(|caution| format!("caution: {caution}")));
    lines.join("\n") + "\n"
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn views_in_doubt_are_said_in_the_first_line() {
        let sure = Together::default();
        let doubted = Together { doubt: Some("view 1 (a.dcm) is in doubt: a mirror image".to_owned()), ..Together::default() };
        assert!(summary(&sure).starts_with("accepted: 0 of 0 views"), "{}", summary(&sure));
        assert!(summary(&doubted).starts_with("accepted in doubt: 0 of 0 views"), "{}", summary(&doubted));
    }
}
