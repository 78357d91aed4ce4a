//! Beads in frames that nobody tuned on: every collimation, size, dose, domain and clutter that `mask_draw` draws, found behind the masks that
//! the frame itself gives, as `register` finds them.

use std::collections::BTreeMap;

use glam::DVec2;
use rayon::prelude::*;
use sidecarm::acquire::{Domain, Frame};
use sidecarm::beads::{Detection, Expectation, detect};
use sidecarm::mask;

use crate::mask_draw::{Drawn, DrawnBead, draw_beaded_frame};

/// Beads that any method should find: contrast over noise, and room beside the shadow.
pub const CLEAR_SNR: f64 = 20.0;
pub const FREE_PX: f64 = 4.0;
/// Steps of the values within a bead's depth.
pub const CLEAR_STEPS: f64 = 8.0;
/// Nepers in front of a bead beyond which it stands over an edge.
pub const PLAIN_NEPERS: f64 = 0.2;

struct Found {
    bead: DrawnBead,
    /// Column and row of the shadow off the truth, and the same over the stated deviations, where it was found.
    off: Option<([f64; 2], [f64; 2])>,
    flagged: bool,
}

struct Outcome {
    seed: u64,
    drawn: Drawn,
    beads: Vec<Found>,
    /// Shadows of nothing: clear ones, and ones that are flagged.
    extra: Vec<Detection>,
    flagged: usize,
    ms: f64,
}

fn is_clear(bead: &DrawnBead) -> bool {
    bead.snr >= CLEAR_SNR && bead.free_px >= FREE_PX && bead.steps >= CLEAR_STEPS
}

fn outcome(seed: u64) -> Outcome {
    // Every fourth frame is open.
    let drawn = draw_beaded_frame(seed, !seed.is_multiple_of(4));
    let domain = match drawn.domain {
        "display" => Domain::Display,
        "log" | "log clamped" => Domain::Log,
        _ => Domain::Linear,
    };
    let mut frame = Frame::from_pixels("drawn", drawn.pixels.clone(), domain).expect("a frame");
    if domain == Domain::Log {
        frame.unit = Some("neper".to_owned());
    }
    let watch = sidecarm::time::Stopwatch::start();
    let masks = mask::of_frame(&frame);
    let usable = masks.usable(frame.pixels.width, frame.pixels.height, &[]);
    let found = detect(&frame, Some(&usable), &Expectation::default()).found;
    let ms = watch.ms();
    let mut taken = vec![false; found.len()];
    let beads = drawn.beads.iter().map(|bead| {
        let at = DVec2::new(bead.sphere.u_px, bead.sphere.v_px);
        let nearest = (0..found.len()).min_by(|a, b| found[*a].image_px.distance(at).total_cmp(&found[*b].image_px.distance(at)));
        let own = nearest.filter(|n| found[*n].image_px.distance(at) < 3.0);
        own.iter().for_each(|n| taken[*n] = true);
        let off = own.map(|n| {
            let (px, covariance) = ((found[n].image_px - at).to_array(), found[n].covariance_px2);
            (px, [px[0] / covariance[0][0].sqrt(), px[1] / covariance[1][1].sqrt()])
        });
        Found { bead: *bead, off, flagged: own.is_some_and(|n| found[n].flags.any()) }
    });
    let beads = beads.collect();
    let of_nothing = found.iter().zip(&taken).filter(|(_, taken)| !**taken).map(|(shadow, _)| *shadow);
    let (flagged, extra): (Vec<_>, Vec<_>) = of_nothing.partition(|shadow| shadow.flags.any());
    Outcome { seed, drawn, beads, extra, flagged: flagged.len(), ms }
}

#[derive(Default)]
struct Row {
    frames: usize,
    plain: [usize; 2],
    edge: [usize; 2],
    extra: usize,
    flagged: usize,
    px: Vec<f64>,
    pulls: Vec<f64>,
    /// Of clear beads whose shadows are flagged.
    flagged_pulls: Vec<f64>,
    /// Masks and beads of each frame.
    ms: Vec<f64>,
}

fn median(values: &[f64]) -> f64 {
    let mut sorted = values.to_vec();
    sorted.sort_by(f64::total_cmp);
    sorted.get(sorted.len() / 2).copied().unwrap_or(f64::NAN)
}

fn rms(values: &[f64]) -> f64 {
    (values.iter().map(|x| x * x).sum::<f64>() / values.len().max(1) as f64).sqrt()
}

impl Row {
    fn take(&mut self, outcome: &Outcome) {
        self.frames += 1;
        self.extra += outcome.extra.len();
        self.flagged += outcome.flagged;
        self.ms.push(outcome.ms);
        for found in outcome.beads.iter().filter(|found| is_clear(&found.bead)) {
            let counts = if found.bead.relief < PLAIN_NEPERS { &mut self.plain } else { &mut self.edge };
            counts[1] += 1;
            counts[0] += usize::from(found.off.is_some());
            match found.off {
                Some((_, pulls)) if found.flagged => self.flagged_pulls.extend(pulls),
                Some((px, pulls)) => {
                    self.px.extend(px);
                    self.pulls.extend(pulls);
                }
                None => {}
            }
        }
    }

    fn recall(&self) -> f64 {
        self.plain[0] as f64 / self.plain[1].max(1) as f64
    }
}

/// All, then by dose beside a bead, by domain and by shape of the field.
fn table(outcomes: &[Outcome]) -> BTreeMap<String, Row> {
    let mut rows: BTreeMap<String, Row> = BTreeMap::new();
    for outcome in outcomes {
        let mut quanta: Vec<f64> =
            outcome.beads.iter().filter(|found| is_clear(&found.bead)).map(|found| found.bead.quanta).collect();
        quanta.sort_by(f64::total_cmp);
        let dose = match quanta.get(quanta.len() / 2) {
            None => "dose: no clear bead",
            Some(quanta) if *quanta < 200.0 => "dose: under 200",
            Some(quanta) if *quanta < 2000.0 => "dose: 200 to 2000",
            Some(_) => "dose: over 2000",
        };
        let names = [
            "all".to_owned(),
            dose.to_owned(),
            format!("values: {}", outcome.drawn.domain),
            format!("field: {}", outcome.drawn.shape),
        ];
        names.into_iter().for_each(|name| rows.entry(name).or_default().take(outcome));
    }
    println!(
        "{:24} frames  found/clear   over edges   of nothing, a frame    error, px   pull          unflagged  ms: median",
        ""
    );
    println!("{:24} {:26} {:16} unflagged  flagged   unflagged   unflagged  flagged   of found  and worst", "", "", "");
    for (name, row) in &rows {
        let (good, flagged) = (row.pulls.len(), row.flagged_pulls.len());
        println!(
            "{name:24} {:6} {:6}/{:<6} {:5}/{:<5} {:12.3} {:8.3} {:11.4} {:11.2} {:8.2} {:8.1} % {:7.0} {:5.0}",
            row.frames,
            row.plain[0],
            row.plain[1],
            row.edge[0],
            row.edge[1],
            row.extra as f64 / row.frames as f64,
            row.flagged as f64 / row.frames as f64,
            rms(&row.px),
            rms(&row.pulls),
            rms(&row.flagged_pulls),
            100.0 * good as f64 / (good + flagged).max(1) as f64,
            median(&row.ms),
            row.ms.iter().copied().fold(0.0, f64::max)
        );
    }
    rows
}

fn evaluate(first: u64, count: u64) -> BTreeMap<String, Row> {
    let outcomes: Vec<Outcome> = (first..first + count).into_par_iter().map(outcome).collect();
    for outcome in &outcomes {
        let missed: Vec<&DrawnBead> = outcome
            .beads
            .iter()
            .filter(|found| is_clear(&found.bead) && found.bead.relief < PLAIN_NEPERS && found.off.is_none())
            .map(|found| &found.bead)
            .collect();
        let far: Vec<f64> = outcome
            .beads
            .iter()
            .filter(|found| !found.flagged)
            .filter_map(|found| found.off)
            .flat_map(|(_, pulls)| pulls)
            .filter(|pull| !(pull.abs() < 5.0))
            .collect();
        if !missed.is_empty() || !outcome.extra.is_empty() || !far.is_empty() {
            println!("seed {}: {}", outcome.seed, outcome.drawn.note);
            missed.iter().for_each(|bead| println!("  missed {bead:.1?}"));
            far.iter().for_each(|pull| println!("  off by {pull:.1} of its deviation"));
            outcome.extra.iter().for_each(|shadow| {
                println!(
                    "  nothing at {:.1}, radius {:.1} px, snr {:.1}, misfit {:.3}, {:?}",
                    shadow.image_px, shadow.radius_px, shadow.snr, shadow.misfit, shadow.flags
                );
            });
        }
    }
    let rows = table(&outcomes);
    let all = &rows["all"];
    let a_frame = |count: usize| count as f64 / all.frames as f64;
    println!(
        "shadows of nothing: {:.3} unflagged and {:.3} flagged a frame (target 0.1); milliseconds of masks and beads are those of several frames \
         at once",
        a_frame(all.extra),
        a_frame(all.flagged)
    );
    rows
}

fn of(name: &str, default: u64) -> u64 {
    std::env::var(name).ok().and_then(|text| text.parse().ok()).unwrap_or(default)
}

#[test]
fn beads_are_found_behind_every_shutter_and_little_else_is() {
    let rows = evaluate(700, 24);
    let all = &rows["all"];
    assert!(all.plain[1] >= 60 && all.recall() >= 0.98, "{} of {}", all.plain[0], all.plain[1]);
    assert!(all.extra as f64 <= 0.2 * all.frames as f64, "{} shadows of nothing", all.extra);
}

/// Clear beads among many blobs: noise behind shutters that nobody finds and few quanta, where peaks of the smallest scale are the most.
#[test]
fn clear_beads_are_not_crowded_out_by_noise() {
    for seed in [20_188, 20_357, 20_596, 20_664] {
        let rows = evaluate(seed, 1);
        let all = &rows["all"];
        assert!(all.plain[1] > 0 && all.plain[0] == all.plain[1], "seed {seed}: {} of {}", all.plain[0], all.plain[1]);
    }
}

#[test]
#[ignore = "minutes long: scripts/evaluate varied runs it"]
fn many_varied_frames() {
    let rows = evaluate(of("SIDECARM_FIRST_SEED", 20_000), of("SIDECARM_FRAMES", 1000));
    let all = &rows["all"];
    assert!(all.recall() >= 0.995, "{} of {}", all.plain[0], all.plain[1]);
    assert!(all.extra as f64 <= 0.1 * all.frames as f64, "{} shadows of nothing", all.extra);
}
