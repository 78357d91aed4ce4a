//! What a rehearsed exposure says of the session.

use crate::report::{Pair, PairStatus};
use crate::session::crosscheck::{Finding, PoseDifference};

pub(super) const CHECK: &str = "synthetic exposure";
/// A pose from eight beads is a tenth of this off: degrees, mm across, mm in depth.
const TOLERANCE: (f64, f64, f64) = (0.5, 0.5, 5.0);
/// Noise and truncation leave more than this of a matched DRR.
const LEAST_ZNCC: f64 = 0.5;

/// What became of a pose.
pub(super) struct Drawn {
    pub pair: Pair,
    /// Its DRR was put against the frame.
    pub compared: bool,
    /// Files of the session's folder that are not there, a sentence each.
    pub unwritten: Vec<String>,
}

/// A pose, and what became of it.
pub(super) struct Rehearsed {
    pub drawn: Drawn,
    /// From the pose that was rendered.
    pub off: PoseDifference,
    /// Beads alone gave none; telemetry said where to look, with a place of the specimen that the session does not know.
    pub needs_prior: bool,
    /// What a session says of every frame that is imported so: kind and words.
    pub told: Vec<(String, String)>,
    /// Milliseconds by stage, and what could not be rehearsed.
    pub times: String,
}

/// That a part of the way is not passed.
pub(super) fn failed(detail: impl Into<String>, remedy: &str) -> Finding {
    Finding::fail(CHECK, detail, remedy)
}

/// A pose that was found, judged.
pub(super) fn verdict(rehearsed: &Rehearsed) -> Finding {
    let Rehearsed { drawn: Drawn { pair, compared, unwritten }, off, needs_prior, told, times } = rehearsed;
    let PoseDifference { angle_deg, shift_mm } = off;
    let (across_mm, depth_mm) = (shift_mm.truncate().length(), shift_mm.z.abs());
    let (most_deg, most_across_mm, most_depth_mm) = TOLERANCE;
    if !(*angle_deg <= most_deg && across_mm <= most_across_mm && depth_mm <= most_depth_mm) {
        let detail = format!(
            "the pose found is {angle_deg:.1} degrees, {across_mm:.1} mm across and {depth_mm:.1} mm in depth from the one that was rendered"
        );
        return failed(
            detail,
            "the beads are not where the scene has them, or their layout is nearly symmetric: see the other checks",
        );
    }
    if !unwritten.is_empty() {
        let detail = format!("its strip and report are not all written: {}", unwritten.join("; "));
        return failed(detail, "see to the temporary folder (TMPDIR): is its disk full, or not writable?");
    }
    let used = pair.beads.iter().filter(|bead| bead.used).count();
    let found = format!(
        "{used} of {} beads found, pose {angle_deg:.3} degrees and {across_mm:.3} mm from the one rendered",
        pair.beads.len()
    );
    let warn = |but: String, remedy: &str| Finding::warn(CHECK, format!("{found}, but {but}; {times}"), remedy);
    let why = || pair.reason.clone().or_else(|| pair.flags.last().cloned()).unwrap_or_else(|| "no reason given".to_owned());
    let zncc = pair.scores.zncc;
    if !compared {
        return warn(format!("not compared: {}", why()), "check that the CT covers the field of view");
    }
    if !zncc.is_some_and(|zncc| zncc >= LEAST_ZNCC) {
        let value = zncc.map_or("absent".to_owned(), |zncc| format!("{zncc:.3}"));
        return warn(
            format!("its ZNCC with the matched DRR is {value}"),
            "check photons_per_pixel and tube_kvp of the scene: the frames would be mostly noise",
        );
    }
    if *needs_prior {
        return warn(
            "only where telemetry says where to look, and the session has no world_from_lps".to_owned(),
            "give world_from_lps in the session, or more beads that are less alike: until two frames are accepted there is no pose",
        );
    }
    if pair.status != PairStatus::Accepted {
        return warn(format!("{}: {}", pair.standing().short(), why()), "check what the reason names before the session");
    }
    if let Some((kind, words)) = told.first() {
        return warn(format!("{kind}: {words}"), "a session says so of every frame: correct what it names");
    }
    Finding::pass(CHECK, format!("{found}, ZNCC {:.3}; {times}", zncc.unwrap_or(f64::NAN)))
}

#[cfg(test)]
mod tests {
    use glam::DVec3;

    use super::*;
    use crate::report::PoseSource;
    use crate::session::crosscheck::Level;

    fn rehearsed(change: impl FnOnce(&mut Rehearsed)) -> Finding {
        let mut pair = Pair::unmatched("rehearsed", "");
        (pair.status, pair.reason, pair.pose_source) = (PairStatus::Accepted, None, PoseSource::Beads);
        pair.scores.zncc = Some(0.98);
        let mut rehearsed = Rehearsed {
            drawn: Drawn { pair, compared: true, unwritten: Vec::new() },
            off: PoseDifference { angle_deg: 0.01, shift_mm: DVec3::new(0.01, 0.02, 0.1) },
            needs_prior: false,
            told: Vec::new(),
            times: "register 80 ms".to_owned(),
        };
        change(&mut rehearsed);
        verdict(&rehearsed)
    }

    #[test]
    fn each_verdict_has_its_words_and_all_but_one_a_remedy() {
        type Change = fn(&mut Rehearsed);
        let cases: [(Change, Level, &[&str]); 11] = [
            (|_| (), Level::Pass, &["ZNCC 0.980", "register 80 ms"]),
            (|r| r.off.angle_deg = 0.6, Level::Fail, &["0.6 degrees", "from the one that was rendered", "nearly symmetric"]),
            (|r| r.off.shift_mm.x = -14.0, Level::Fail, &["14.0 mm across", "where the scene has them"]),
            (|r| r.off.shift_mm.z = f64::NAN, Level::Fail, &["NaN mm in depth"]),
            (|r| r.drawn.unwritten.push("strips/001.png: no space".to_owned()), Level::Fail, &["no space", "TMPDIR"]),
            (
                |r| (r.drawn.compared, r.drawn.pair.flags) = (false, vec!["too little is left".to_owned()]),
                Level::Warn,
                &["not compared: too little is left", "covers the field of view"],
            ),
            (|r| r.drawn.pair.scores.zncc = Some(0.3), Level::Warn, &["0.300", "photons_per_pixel"]),
            (|r| r.drawn.pair.scores.zncc = None, Level::Warn, &["absent"]),
            (|r| r.needs_prior = true, Level::Warn, &["no world_from_lps", "give world_from_lps"]),
            (|r| r.drawn.pair.doubt("a twin fits"), Level::Warn, &["in doubt: a twin fits"]),
            (
                |r| r.told.push(("detector calibration".to_owned(), "it is for [4, 4] px".to_owned())),
                Level::Warn,
                &["detector calibration: it is for [4, 4] px", "of every frame"],
            ),
        ];
        for (change, level, words) in cases {
            let found = rehearsed(change);
            let sentence = found.sentence();
            assert!(found.level == level && found.remedy.is_some() == (level > Level::Pass), "{sentence}");
            words.iter().for_each(|word| assert!(sentence.contains(word), "'{word}' is not in: {sentence}"));
        }
    }
}
