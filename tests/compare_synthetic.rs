//! Comparison on closed-form images: spheres seen by a pinhole, so that any pose can be drawn without a renderer.

use glam::{DVec2, DVec3};
use sidecarm::acquire::{Domain, Frame};
use sidecarm::compare::{AirLevel, CommonDomain, CompareError, CompareInput, Compared, NullError, Tone, compare};
use sidecarm::geometry::{Intrinsics, Rigid, View};
use sidecarm::image::Image;
use sidecarm::mask::Cause;

/// A small uniform random number in [−1, 1) for an index; no generator state.
fn scatter(index: u32, salt: u32) -> f64 {
    let mut x = index.wrapping_mul(0x9E37_79B9) ^ salt.wrapping_mul(0x85EB_CA6B);
    x ^= x >> 16;
    x = x.wrapping_mul(0x7FEB_352D);
    x ^= x >> 15;
    x = x.wrapping_mul(0x846C_A68B);
    x ^= x >> 16;
    f64::from(x) / f64::from(u32::MAX) * 2.0 - 1.0
}

/// Centre (lps, mm), radius (mm) and attenuation (1/mm) of the spheres: a body and what is in it.
pub fn spheres() -> Vec<(DVec3, f64, f64)> {
    let mut found = vec![(DVec3::new(0.0, 2.0, 0.0), 27.0, 0.022)];
    for i in 0..26 {
        let at = DVec3::new(scatter(i, 1), scatter(i, 2), scatter(i, 3)) * DVec3::new(20.0, 16.0, 20.0);
        found.push((at, 2.5 + 2.0 * (1.0 + scatter(i, 4)), 0.03 + 0.02 * scatter(i, 5)));
    }
    found
}

/// The specimen 600 mm in front of the source, turned by `omega_rad`.
pub fn pose(omega_rad: DVec3) -> Rigid {
    Rigid::translation(DVec3::new(2.0, -1.0, 600.0)) * Rigid::exp(omega_rad, DVec3::ZERO)
}

pub fn view() -> View {
    View {
        size_px: [310, 240],
        intrinsics: Intrinsics { fx: 2628.0, fy: 2628.0, skew: 0.0, cx: 154.5, cy: 119.5 },
        camera_from_lps: pose(DVec3::new(0.2, -0.3, 0.1)),
    }
}

/// −ln of the intensity, exactly.
pub fn line_integral(view: &View) -> Image<f32> {
    line_integral_of(&spheres(), view)
}

/// The same of any spheres.
pub fn line_integral_of(spheres: &[(DVec3, f64, f64)], view: &View) -> Image<f32> {
    let source = view.source_in_lps();
    let [width, height] = view.size_px.map(|n| n as usize);
    let pixels = (0..width * height)
        .map(|at| {
            let ray = view.ray_in_lps(DVec2::new((at % width) as f64, (at / width) as f64)).normalize();
            spheres
                .iter()
                .map(|(centre, radius, mu)| {
                    let to = *centre - source;
                    let off = to.length_squared() - to.dot(ray).powi(2);
                    2.0 * mu * (radius * radius - off).max(0.0).sqrt()
                })
                .sum::<f64>() as f32
        })
        .collect();
    Image::from_pixels(width, height, pixels).expect("size")
}

/// A linear frame in units of the unattenuated signal, with relative noise of `noise`.
pub fn acquired(line_integral: &Image<f32>, noise: f64) -> Frame {
    let pixels = line_integral
        .pixels
        .iter()
        .enumerate()
        .map(|(at, l)| (f64::from(-l).exp() * (1.0 + noise * (0..4).map(|k| scatter(at as u32, 100 + k)).sum::<f64>())) as f32)
        .collect();
    let image = Image::from_pixels(line_integral.width, line_integral.height, pixels).expect("size");
    let mut frame = Frame::from_pixels("synthetic", image, Domain::Linear).expect("finite");
    frame.unit = Some("1".into());
    frame
}

fn with_pixels(frame: &Frame, f: impl FnMut(&f32) -> f32) -> Frame {
    Frame { pixels: frame.pixels.map(f), ..frame.clone() }
}

fn compared(input: &CompareInput) -> Compared {
    compare(input).expect("comparable")
}

#[test]
fn a_perfect_pair_has_perfect_scores() {
    let (view, simulated) = (view(), line_integral(&view()));
    let frame = acquired(&simulated, 0.0);
    let input = CompareInput { view: Some(&view), centre_lps_mm: Some(DVec3::ZERO), ..CompareInput::new(&frame, &simulated) };
    let found = compared(&input).comparison;
    assert_eq!(found.common_domain, CommonDomain::LineIntegral);
    let scores = &found.scores;
    for (name, least) in [("zncc", 0.9999), ("rank_ncc", 0.999), ("gradient_ncc", 0.9999), ("ssim", 0.9999), ("local_ncc", 0.999)]
    {
        let value = scores.get(name).unwrap_or_else(|| panic!("{name}: {:?}", scores.reasons));
        assert!(value > least, "{name} {value}");
    }
    assert!(scores.rmse_nepers.expect("absolute") < 1e-5 && scores.edge_distance_mm.expect("edges") < 1e-3);
    assert!((found.mm_per_px.expect("view") - 600.0 / 2628.0).abs() < 1e-2);
    // The control: another pose scores worse.
    let moved = View { camera_from_lps: Rigid::translation(DVec3::new(4.0, 0.0, 0.0)) * view.camera_from_lps, ..view };
    let wrong = compared(&CompareInput { simulated_line_integral: &line_integral(&moved), ..input }).comparison.scores;
    assert!(
        wrong.zncc.expect("z") < 0.99 && wrong.rmse_nepers.expect("r") > 0.05 && wrong.edge_distance_px.expect("e") > 1.0,
        "{wrong:?}"
    );
}

#[test]
fn gain_is_absorbed_by_tone_gain_and_by_open_air_but_never_claims_nepers_without_it() {
    let simulated = line_integral(&view());
    let mut frame = with_pixels(&acquired(&simulated, 0.004), |v| 733.0 * v);
    frame.unit = None;
    let input = CompareInput::new(&frame, &simulated);
    let open = compared(&input).comparison;
    assert_eq!(open.air.rule, "open");
    assert!((open.air.level.expect("open air in the corners") / 733.0 - 1.0).abs() < 2e-3, "{:?}", open.air);
    assert!(open.scores.rmse_nepers.expect("known air") < 0.01);
    let noise = open.scores.noise_nepers.expect("noise");
    let expected = 0.004 * (4.0f64 / 3.0).sqrt();
    assert!((noise / expected - 1.0).abs() < 0.1, "noise {noise}, put in {expected}");

    let unknown = compared(&CompareInput { air: AirLevel::Unknown, tone: Tone::Gain, ..input }).comparison;
    assert_eq!(unknown.common_domain, CommonDomain::RelativeLineIntegral);
    assert!(unknown.scores.rmse_nepers.is_none() && unknown.scores.reasons.contains_key("rmse_nepers"));
    assert!(unknown.scores.ssim.expect("gain fits the offset") > 0.9);
    assert!(unknown.scores_without_tone.ssim.is_none(), "control: without the gain there is no SSIM");
    assert!(unknown.scores.zncc.expect("z") > 0.999);

    let maximum = compared(&CompareInput { air: AirLevel::Maximum, ..input }).comparison;
    assert!(maximum.flags.iter().any(|flag| flag.contains("paper's rule")), "{:?}", maximum.flags);
}

#[test]
fn an_affine_tone_is_undone_and_scored_on_other_tiles() {
    let simulated = line_integral(&view());
    let pixels = simulated.map(|l| 0.25 + 0.9 * l);
    let mut frame = Frame::from_pixels("log", pixels, Domain::Log).expect("finite");
    frame.unit = Some("neper".into());
    let input = CompareInput::new(&frame, &simulated);
    let plain = compared(&input).comparison;
    let fitted = compared(&CompareInput { tone: Tone::LogAffine, ..input }).comparison;
    assert!(plain.scores.rmse_nepers.expect("known") > 0.05);
    assert!(fitted.scores.rmse_nepers.expect("known") < 1e-3, "{:?}", fitted.scores);
    assert_eq!(fitted.scores_without_tone.rmse_nepers.map(|r| r > 0.05), Some(true), "the scores without tone stay visible");
    assert!(fitted.tone.degrees_of_freedom == 2 && fitted.tone.fitted_pixels > 10_000 && fitted.tone.scored_pixels > 10_000);
}

/// What a logarithm is clipped at was scored as if it had been measured.
#[test]
fn the_clipped_dark_end_of_a_logarithm_is_left_out() {
    let simulated = line_integral(&view());
    let clip = 0.8 * simulated.pixels.iter().copied().fold(0.0, f32::max);
    let mut frame = Frame::from_pixels("log", simulated.map(|l| l.min(clip)), Domain::Log).expect("finite");
    frame.unit = Some("neper".into());
    let scored = compared(&CompareInput::new(&frame, &simulated)).comparison;
    assert!(scored.scores.rmse_nepers.expect("known") > 0.01, "control: floats are not known to be clipped");
    frame.clipping.black_at = Some(clip);
    let found = compared(&CompareInput::new(&frame, &simulated)).comparison;
    assert!(found.scores.rmse_nepers.expect("known") < 1e-6, "{:?}", found.scores);
    assert!(found.masks.causes.contains_key(&Cause::NoSignal), "{:?}", found.masks);
}

#[test]
fn a_monotone_tone_suits_display_frames_only_and_never_claims_nepers() {
    let simulated = line_integral(&view());
    let gray = simulated.map(|l| (200.0 * (-0.9 * l).exp().powf(0.6) + 20.0).round());
    let frame = Frame::from_pixels("display", gray, Domain::Display).expect("finite");
    let input = CompareInput::new(&frame, &simulated);
    let found = compared(&CompareInput { tone: Tone::Monotone, ..input }).comparison;
    assert!(found.scores.zncc.expect("toned") > 0.99 && found.tone.curve.len() <= 5);
    assert!(found.scores.rmse_nepers.is_none() && found.scores.noise_nepers.is_none());
    assert!(found.scores.reasons["rmse_nepers"].contains("gray values"), "{:?}", found.scores.reasons);
    let plain = compared(&input).comparison.scores;
    assert!(plain.zncc.is_none() && plain.rank_ncc.expect("rank") > 0.98 && plain.gradient_ncc.expect("gradient") > 0.9);
    let linear = acquired(&simulated, 0.0);
    let refused = compare(&CompareInput { tone: Tone::Monotone, ..CompareInput::new(&linear, &simulated) });
    assert!(matches!(refused, Err(CompareError::ToneNotPermitted { .. })));
    let refused = compare(&CompareInput { tone: Tone::Gain, ..input });
    assert!(matches!(refused, Err(CompareError::ToneNotPermitted { .. })));
}

#[test]
fn an_unknown_polarity_is_found_and_said() {
    let simulated = line_integral(&view());
    for sign in [1.0, -1.0] {
        let frame = Frame::from_pixels("unknown", simulated.map(|l| 100.0 + sign * 40.0 * l), Domain::Unknown).expect("finite");
        let found = compared(&CompareInput::new(&frame, &simulated)).comparison;
        assert!(found.scores.rank_ncc.expect("rank") > 0.99);
        let words = if sign > 0.0 { "more attenuation" } else { "more signal" };
        assert!(found.flags.iter().any(|flag| flag.contains(words)), "{:?}", found.flags);
    }
}

#[test]
fn each_cause_has_its_share_and_too_little_is_refused() {
    let simulated = line_integral(&view());
    let mut frame = acquired(&simulated, 0.0);
    let (width, height) = (310usize, 240usize);
    for v in 100..120 {
        for u in 40..80 {
            *frame.pixels.at_mut(u, v) = 4.0;
        }
    }
    frame.clipping.saturated_at = Some(4.0);
    let tool = Image { width, height, pixels: (0..width * height).map(|at| at % width >= 200 && at % width < 231).collect() };
    let extra = Image { width, height, pixels: (0..width * height).map(|at| at / width < 24).collect() };
    let mut valid = Image::filled(width, height, 1u8);
    valid.pixels[..310 * 12].fill(0);
    let beads = [(DVec2::new(150.0, 150.0), 4.0)];
    let input = CompareInput {
        tool: Some(&tool),
        extra_mask: Some(&extra),
        valid: Some(&valid),
        beads: &beads,
        ..CompareInput::new(&frame, &simulated)
    };
    let found = compared(&input).comparison;
    let share = |cause: Cause| found.masks.causes.get(&cause).copied().unwrap_or(0.0);
    assert!((share(Cause::Saturation) - 800.0 / 74_400.0).abs() < 1e-9);
    assert!(
        (share(Cause::Tool) - 0.1).abs() < 1e-9
            && (share(Cause::Extra) - 0.1).abs() < 1e-9
            && (share(Cause::Invalid) - 0.05).abs() < 1e-9
    );
    let disc = std::f64::consts::PI * 81.0 / 74_400.0;
    assert!((share(Cause::Beads) / disc - 1.0).abs() < 0.05, "{}", share(Cause::Beads));
    // 10 % + 10 % overlap by 1 %; invalid lies within extra.
    assert!((found.masks.masked - (0.19 + 800.0 / 74_400.0 + share(Cause::Beads))).abs() < 1e-3, "{:?}", found.masks);
    assert!(found.scores.zncc.expect("rest") > 0.9999, "what is masked does not count");
    assert!(found.scores_tool.expect("scored apart").zncc.expect("tool region") > 0.9999);

    let most = Image { width, height, pixels: (0..width * height).map(|at| at / width < 190).collect() };
    let refused = compare(&CompareInput { extra_mask: Some(&most), ..input });
    let Err(error @ CompareError::TooLittleLeft { .. }) = refused else { panic!("must be refused") };
    assert!(error.to_string().contains("extra mask 79.2 %"), "{error}");
}

#[test]
fn burned_in_letters_are_masked() {
    let simulated = line_integral(&view());
    let mut frame = Frame::from_pixels("text", simulated.map(|l| 3000.0 * (-l).exp()), Domain::Linear).expect("finite");
    for letter in 0..5usize {
        for v in 200..212usize {
            for u in 0..8usize {
                // The outline of a box: a letter O.
                if v == 200 || v == 211 || u == 0 || u == 7 {
                    *frame.pixels.at_mut(20 + 11 * letter + u, v) = 4095.0;
                }
            }
        }
    }
    frame.clipping.saturated_at = Some(4095.0);
    let masks = compared(&CompareInput::new(&frame, &simulated)).comparison.masks;
    assert!(masks.causes.get(&Cause::BurnedIn).is_some_and(|share| *share > 180.0 / 74_400.0), "{masks:?}");
    let clean = acquired(&simulated, 0.0);
    assert!(!compared(&CompareInput::new(&clean, &simulated)).comparison.masks.causes.contains_key(&Cause::BurnedIn), "control");
}

#[test]
fn the_null_tells_a_right_pose_from_a_wrong_one() {
    let truth = view();
    let frame = acquired(&line_integral(&truth), 0.01);
    let with_null = |stated: &View| {
        let simulated = line_integral(stated);
        let input =
            CompareInput { view: Some(stated), centre_lps_mm: Some(DVec3::ZERO), ..CompareInput::new(&frame, &simulated) };
        let mut found = compared(&input);
        let mut renders = 0;
        found
            .add_null(
                &mut |small| {
                    renders += 1;
                    assert!(small.size_px[0] <= 256);
                    Ok(line_integral(small))
                },
                &|| false,
            )
            .expect("null");
        // 45, without three half-turns of the layout that are as many negated axes, with two mirrored pictures.
        assert_eq!(renders, 44);
        found.comparison
    };
    let right = with_null(&truth);
    for name in ["zncc", "gradient_ncc", "rmse_nepers", "local_ncc"] {
        let null = &right.null[name];
        assert!(null.discriminating && null.rank == 1 && null.of == 42, "{name}: {null:?}");
    }
    // Stated 3 mm off along u: the null finds the way back.
    let stated = View { camera_from_lps: Rigid::translation(DVec3::new(3.0, 0.0, 0.0)) * truth.camera_from_lps, ..truth };
    let wrong = with_null(&stated);
    for name in ["zncc", "gradient_ncc", "rmse_nepers"] {
        let null = &wrong.null[name];
        assert!(!null.discriminating && null.rank > 1, "{name}");
        assert_eq!(null.best_shift.as_deref(), Some("u -3 mm"), "{name}");
    }
    assert!(wrong.flags.iter().any(|flag| flag.contains(": not discriminating")), "{:?}", wrong.flags);
    let back: sidecarm::compare::Comparison = serde_json::from_str(&serde_json::to_string(&wrong).expect("json")).expect("reads");
    assert_eq!(back.null["zncc"].best_shift, wrong.null["zncc"].best_shift);
}

#[test]
fn a_null_can_be_cancelled_and_a_failing_render_is_named() {
    let view = view();
    let simulated = line_integral(&view);
    let frame = acquired(&simulated, 0.0);
    let input = CompareInput { view: Some(&view), centre_lps_mm: Some(DVec3::ZERO), ..CompareInput::new(&frame, &simulated) };
    let mut found = compared(&input);
    // Asked before each render: a frame that waits gets the cores within one.
    let renders = std::cell::Cell::new(0);
    let counted = &mut |small: &View| {
        renders.set(renders.get() + 1);
        Ok(line_integral(small))
    };
    let cancelled = found.add_null(counted, &|| renders.get() == 7);
    assert_eq!((cancelled, renders.get()), (Err(NullError::Cancelled { done: 7, total: 44 }), 7));
    // And while they are scored, where nothing is rendered: the third time that it is asked after all hypotheses.
    let (hypotheses, asked) = (42, std::cell::Cell::new(0));
    renders.set(0);
    let while_scored = || renders.get() == hypotheses && asked.replace(asked.get() + 1) == 2;
    let cancelled = found.add_null(counted, &while_scored);
    assert_eq!((cancelled, renders.get()), (Err(NullError::Cancelled { done: hypotheses, total: 44 }), hypotheses));
    let failed = found.add_null(&mut |_| Err("device lost".into()), &|| false);
    assert!(failed.is_err_and(|error| error.to_string().contains("device lost")));
    assert!(found.comparison.null.is_empty());
    let mut blind = compared(&CompareInput::new(&frame, &simulated));
    assert_eq!(blind.add_null(&mut |small| Ok(line_integral(small)), &|| false), Err(NullError::NoView));
}

#[test]
fn nan_and_zero_pixels_are_masked_and_sizes_must_fit() {
    let mut simulated = line_integral(&view());
    let mut frame = acquired(&simulated, 0.0);
    simulated.pixels[310 * 60..310 * 90].fill(f32::NAN);
    frame.pixels.pixels[310 * 100..310 * 110].fill(f32::NAN);
    frame.pixels.pixels[310 * 120..310 * 130].fill(0.0);
    frame.pixels.pixels[5] = f32::INFINITY;
    let found = compared(&CompareInput::new(&frame, &simulated)).comparison;
    // 30 rows are unknown to the simulation; of 10 others, and one pixel more, the frame has nothing.
    assert!((found.masks.causes[&Cause::Invalid] - 30.0 / 240.0).abs() < 1e-9, "{:?}", found.masks);
    assert!((found.masks.causes[&Cause::NotMeasured] - (10.0 * 310.0 + 1.0) / 74_400.0).abs() < 1e-9, "{:?}", found.masks);
    assert!((found.masks.causes[&Cause::NoSignal] - 10.0 / 240.0).abs() < 1e-9);
    let json = serde_json::to_value(&found).expect("json");
    let shares = ["not_measured", "invalid"].map(|cause| json["masks"]["causes"][cause].as_f64().expect("its own share"));
    assert!(shares[0] < 0.05 && shares[1] > 0.12, "{shares:?}");
    assert!(json["scores"]["zncc"].as_f64().expect("a number") > 0.9999, "{}", json["scores"]);
    assert!(json["scores"]["edge_distance_px"].as_f64().expect("a number") < 0.1);

    let nothing = simulated.map(|_| f32::NAN);
    assert!(matches!(compare(&CompareInput::new(&frame, &nothing)), Err(CompareError::TooLittleLeft { .. })));
    let other = Image::filled(300, 240, 1.0f32);
    assert!(matches!(compare(&CompareInput::new(&frame, &other)), Err(CompareError::Size { .. })));
    let constant = Image::filled(310, 240, 1.0f32);
    let flat = compared(&CompareInput::new(&frame, &constant)).comparison.scores;
    assert!(flat.zncc.is_none() && flat.gradient_ncc.is_none() && flat.reasons.contains_key("zncc"), "{flat:?}");
}

#[test]
fn a_larger_frame_is_binned() {
    let small = view();
    let fine =
        View { size_px: [620, 480], intrinsics: Intrinsics { fx: 5256.0, fy: 5256.0, skew: 0.0, cx: 309.5, cy: 239.5 }, ..small };
    let frame = acquired(&line_integral(&fine), 0.0);
    let simulated = line_integral(&small);
    let found = compared(&CompareInput::new(&frame, &simulated)).comparison;
    assert_eq!((found.binning, found.size_px), (2, [310, 240]));
    assert!(found.scores.zncc.expect("z") > 0.9999 && found.scores.rmse_nepers.expect("r") < 0.01, "{:?}", found.scores);
}
