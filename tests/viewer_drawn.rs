//! What the window looks like: drawn by software Vulkan into a picture, and looked at.
#![cfg(feature = "viewer")]

use eframe::egui::{self, Context, Pos2, RawInput, Rect, pos2, vec2};
use eframe::egui_wgpu::{Renderer, RendererOptions, ScreenDescriptor};
use sidecarm::gpu::{Device, DeviceChoice, Gpu};
use sidecarm::image::Image;
use sidecarm::mask::{Cause, Masks};
use sidecarm::reporter::Reporter;
use sidecarm::session::board::{BoardState, PairPictures};
use sidecarm::viewer::{Arrangement, Mark, Overlay, ViewState, draw};

use crate::compare_synthetic::{acquired, line_integral, view};
use crate::viewer_boards::{FOUND_PX, LANDMARK_PX, LANDMARK_PX2, NOW_US, TIP_PX, accepted, amber, board, line, refused};

/// The size that the window opens with.
const SIZE: [u32; 2] = [1400, 900];

/// A window that is drawn into pictures.
pub struct Drawn {
    gpu: Box<Gpu>,
    renderer: Renderer,
    context: Context,
    pub state: ViewState,
    /// Where the pointer is.
    pub pointer: Option<Pos2>,
    looks: f64,
}

const FORMAT: wgpu::TextureFormat = wgpu::TextureFormat::Rgba8Unorm;

impl Drawn {
    /// `None` (said) where there is no software Vulkan.
    pub fn open() -> Option<Self> {
        let Ok(Device::Gpu(gpu)) = Device::open(DeviceChoice::SoftwareVulkan, &Reporter::silent()) else {
            println!("skipped: no software Vulkan on this machine; scripts/install installs mesa-vulkan-drivers");
            return None;
        };
        let renderer = Renderer::new(&gpu.device, FORMAT, RendererOptions { dithering: false, ..RendererOptions::default() });
        Some(Self { gpu, renderer, context: Context::default(), state: ViewState::default(), pointer: None, looks: 0.0 })
    }

    /// The window after a few looks at `board`.
    pub fn picture(&mut self, board: &BoardState) -> Image<[u8; 3]> {
        let mut last = None;
        for _ in 0..4 {
            last = Some(self.look(board));
        }
        let output = last.expect("looked");
        self.rastered(output)
    }

    fn look(&mut self, board: &BoardState) -> egui::FullOutput {
        self.looks += 1.0;
        let screen = Rect::from_min_size(Pos2::ZERO, vec2(SIZE[0] as f32, SIZE[1] as f32));
        let events = self.pointer.map(egui::Event::PointerMoved).into_iter().collect();
        let input = RawInput { screen_rect: Some(screen), time: Some(0.01 * self.looks), events, ..RawInput::default() };
        let Self { context, state, .. } = self;
        let mut output = context.run_ui(input, |ui| draw(ui, board, state));
        for (id, deltas) in output.textures_delta.set.drain() {
            for delta in deltas {
                self.renderer.update_texture(&self.gpu.device, &self.gpu.queue, id, &delta);
            }
        }
        output.textures_delta.free.drain().for_each(|id| self.renderer.free_texture(&id));
        output
    }

    fn rastered(&mut self, output: egui::FullOutput) -> Image<[u8; 3]> {
        let (device, queue) = (&self.gpu.device, &self.gpu.queue);
        let jobs = self.context.tessellate(output.shapes, 1.0);
        let screen = ScreenDescriptor { size_in_pixels: SIZE, pixels_per_point: 1.0 };
        let size = wgpu::Extent3d { width: SIZE[0], height: SIZE[1], depth_or_array_layers: 1 };
        let texture = device.create_texture(&wgpu::TextureDescriptor {
            label: None,
            size,
            mip_level_count: 1,
            sample_count: 1,
            dimension: wgpu::TextureDimension::D2,
            format: FORMAT,
            usage: wgpu::TextureUsages::RENDER_ATTACHMENT | wgpu::TextureUsages::COPY_SRC,
            view_formats: &[],
        });
        let view = texture.create_view(&wgpu::TextureViewDescriptor::default());
        let mut encoder = device.create_command_encoder(&wgpu::CommandEncoderDescriptor::default());
        let more = self.renderer.update_buffers(device, queue, &mut encoder, &jobs, &screen);
        {
            let attachment = wgpu::RenderPassColorAttachment {
                view: &view,
                resolve_target: None,
                ops: wgpu::Operations { load: wgpu::LoadOp::Clear(wgpu::Color::BLACK), store: wgpu::StoreOp::Store },
                depth_slice: None,
            };
            let described = wgpu::RenderPassDescriptor { color_attachments: &[Some(attachment)], ..Default::default() };
            let mut pass = encoder.begin_render_pass(&described).forget_lifetime();
            self.renderer.render(&mut pass, &jobs, &screen);
        }
        // Rows of a copied texture begin at multiples of 256 bytes.
        let row_bytes = (4 * SIZE[0]).next_multiple_of(256);
        let buffer = device.create_buffer(&wgpu::BufferDescriptor {
            label: None,
            size: u64::from(row_bytes * SIZE[1]),
            usage: wgpu::BufferUsages::COPY_DST | wgpu::BufferUsages::MAP_READ,
            mapped_at_creation: false,
        });
        let layout = wgpu::TexelCopyBufferLayout { offset: 0, bytes_per_row: Some(row_bytes), rows_per_image: None };
        let into = wgpu::TexelCopyBufferInfo { buffer: &buffer, layout };
        encoder.copy_texture_to_buffer(texture.as_image_copy(), into, size);
        queue.submit(more.into_iter().chain([encoder.finish()]));
        buffer.slice(..).map_async(wgpu::MapMode::Read, |mapped| mapped.expect("mapped"));
        device.poll(wgpu::PollType::wait_indefinitely()).expect("drawn");
        let bytes = buffer.slice(..).get_mapped_range().expect("mapped");
        let row = |row: usize| &bytes[row * row_bytes as usize..][..4 * SIZE[0] as usize];
        let pixels = (0..SIZE[1] as usize).flat_map(|at| row(at).chunks_exact(4).map(|p| [p[0], p[1], p[2]])).collect();
        Image { width: SIZE[0] as usize, height: SIZE[1] as usize, pixels }
    }
}

/// The largest rectangle of gray pixels, neither ground nor words, that grows from `from`: the picture of a pane.
pub fn picture_at(seen: &Image<[u8; 3]>, from: [usize; 2]) -> Rect {
    let is_ground = |[r, g, b]: [u8; 3]| (r, g, b) == (0x17, 0x1b, 0x21) || (r, g, b) == (0x0f, 0x12, 0x16);
    let along = |step: [isize; 2]| {
        let mut at = from;
        loop {
            let next = [at[0].saturating_add_signed(step[0]), at[1].saturating_add_signed(step[1])];
            if next == at || next[0] >= seen.width || next[1] >= seen.height || is_ground(*seen.at(next[0], next[1])) {
                return at;
            }
            at = next;
        }
    };
    let (left, right) = (along([-1, 0])[0], along([1, 0])[0]);
    let (top, bottom) = (along([0, -1])[1], along([0, 1])[1]);
    Rect::from_min_max(pos2(left as f32, top as f32), pos2(right as f32, bottom as f32))
}

/// Mean of what is red within a rectangle.
pub fn mean(seen: &Image<[u8; 3]>, within: Rect) -> f64 {
    let (mut sum, mut count) = (0.0, 0.0);
    for row in within.top() as usize..within.bottom() as usize {
        for column in within.left() as usize..within.right() as usize {
            sum += f64::from(seen.at(column, row)[0]);
            count += 1.0;
        }
    }
    sum / count
}

/// Pixels of about this colour within a few points of `at`.
pub fn near(seen: &Image<[u8; 3]>, at: Pos2, reach: f32, colour: [u8; 3]) -> usize {
    let like = |pixel: &[u8; 3]| pixel.iter().zip(colour).all(|(a, b)| a.abs_diff(b) < 60);
    let span = |middle: f32| (middle - reach) as usize..=(middle + reach) as usize;
    span(at.y).flat_map(|row| span(at.x).map(move |column| (column, row))).filter(|(u, v)| like(seen.at(*u, *v))).count()
}

pub const GREEN: [u8; 3] = [76, 195, 138];
const RED: [u8; 3] = [240, 106, 95];
pub const AMBER: [u8; 3] = [242, 184, 75];

/// In the middle of the upper left picture, where no mark is.
pub const IN_ACQUIRED: [usize; 2] = [560, 330];

#[test]
fn pictures_fill_most_of_the_window() {
    let Some(mut drawn) = Drawn::open() else { return };
    let seen = drawn.picture(&board(vec![accepted(1)]));
    // Neither ground nor letters: what is not in the left column and not flat.
    let flat = |[r, g, b]: &[u8; 3]| matches!((*r, *g, *b), (0x17, 0x1b, 0x21) | (0x0f, 0x12, 0x16));
    let column = 320;
    let shown = (0..seen.pixels.len()).filter(|at| at % seen.width >= column && !flat(&seen.pixels[*at])).count();
    let share = shown as f64 / seen.pixels.len() as f64;
    println!("pictures take {:.1} % of the window", 100.0 * share);
    assert!(share > 0.6, "{share}");
    let acquired = picture_at(&seen, IN_ACQUIRED);
    assert!(acquired.width() > 480.0, "acquired and DRR are large: {acquired:?}");
}

#[test]
fn the_state_is_told_by_its_colour_across_the_room() {
    let Some(mut drawn) = Drawn::open() else { return };
    let block = |seen: &Image<[u8; 3]>, colour: [u8; 3]| {
        (0..120usize)
            .flat_map(|row| (0..316usize).map(move |column| (column, row)))
            .filter(|(u, v)| seen.at(*u, *v).iter().zip(colour).all(|(a, b)| a.abs_diff(b) < 4))
            .count()
    };
    let mut seen = |pair| drawn.picture(&board(vec![pair]));
    let pictures = [(seen(accepted(1)), GREEN), (seen(refused(1)), RED), (seen(amber(1)), AMBER)];
    for (picture, own) in &pictures {
        for colour in [GREEN, RED, AMBER] {
            let large = block(picture, colour);
            assert_eq!(large > 15_000, colour == *own, "{own:?} {colour:?}: {large} pixels");
        }
    }
}

/// Whether a pixel is of some kind.
type Is = fn([u8; 3]) -> bool;

/// What a silent line said last stays, and must not pass for what it says.
#[test]
fn what_is_stale_is_gray() {
    let Some(mut drawn) = Drawn::open() else { return };
    let mut count = |(age_us, finished): (i64, bool), is: Is| {
        let links = vec![line(age_us)];
        let seen = drawn.picture(&BoardState { links, finished, now_us: NOW_US, ..BoardState::default() });
        let below_the_state = (110..880usize).flat_map(|row| (0..316usize).map(move |column| (column, row)));
        below_the_state.filter(|(u, v)| is(*seen.at(*u, *v))).count()
    };
    // Brighter than lesser words are.
    let bright = |pixel: [u8; 3]| pixel.iter().all(|level| *level > 160);
    let stale = |pixel: [u8; 3]| pixel.iter().zip([0x78u8, 0x80, 0x88]).all(|(a, b)| a.abs_diff(b) < 3);
    let lines = [(20_000, false), (2_000_000, false), (20_000, true)];
    let [live, gone, ended] = lines.map(|line| [bright as Is, stale].map(|is| count(line, is)));
    assert!(live[0] > 60, "{live:?}");
    for gray in [gone, ended] {
        assert_eq!(gray[0], 0, "values that are not of now: {live:?} {gray:?}");
        assert!(gray[1] > live[1] + 25, "the line's dot: {live:?} {gray:?}");
    }
}

#[test]
fn marks_lie_where_the_frame_has_them_and_vanish_when_they_are_not_wanted() {
    let Some(mut drawn) = Drawn::open() else { return };
    let one = board(vec![accepted(1)]);
    let seen = drawn.picture(&one);
    let picture = picture_at(&seen, IN_ACQUIRED);
    let place = |[u, v]: [f64; 2]| {
        let share = vec2((u as f32 + 0.5) / 310.0, (v as f32 + 0.5) / 240.0);
        picture.min + share * picture.size()
    };
    let (bead, tip) = (place(FOUND_PX), place(TIP_PX));
    assert!(near(&seen, bead, 24.0, [40, 230, 80]) > 40, "the ring of a bead that is used");
    assert!(near(&seen, tip, 10.0, [90, 190, 255]) > 15, "the drill's tip");
    // The residual, twenty times as long as it is.
    let end = place([FOUND_PX[0] + 19.0, FOUND_PX[1] + 9.5]);
    assert!(near(&seen, end, 6.0, [255, 110, 230]) > 4, "the end of a residual");
    [Mark::Beads, Mark::Names, Mark::Residuals, Mark::Robot].into_iter().for_each(|mark| drawn.state.toggle(mark));
    let bare = drawn.picture(&one);
    assert_eq!(near(&bare, bead, 24.0, [40, 230, 80]) + near(&bare, tip, 10.0, [90, 190, 255]), 0);
    assert_eq!(near(&bare, end, 6.0, [255, 110, 230]), 0);
}

/// A pair that was posed again had the new state over the old DRR: textures were known by number and width.
#[test]
fn a_pair_posed_again_shows_its_new_pictures() {
    let Some(mut drawn) = Drawn::open() else { return };
    drawn.state.arrangement = Arrangement::Two;
    let mut shown = board(vec![refused(7)]);
    let before = drawn.picture(&shown);
    let mut again = accepted(7);
    again.development = 1;
    shown.show(again);
    let after = drawn.picture(&shown);
    let right = Rect::from_min_max(pos2(900.0, 200.0), pos2(1350.0, 600.0));
    let (empty, drr) = (mean(&before, right), mean(&after, right));
    assert!(drr > empty + 40.0, "the DRR is there: {empty:.0}, {drr:.0}");
    // Once more, with other pictures of the same number and size.
    let mut other = accepted(7);
    other.development = 2;
    let mut pictures = (*other.pictures).clone();
    (pictures.window, pictures.window_of_drr) = ([-9.0, -8.0], [-9.0, -8.0]);
    other.pictures = std::sync::Arc::new(pictures);
    shown.show(other);
    let white = mean(&drawn.picture(&shown), right);
    assert!(white > drr + 40.0, "{white:.0} after {drr:.0}");
}

#[test]
fn overlays_and_gray_levels_change_what_is_seen() {
    let Some(mut drawn) = Drawn::open() else { return };
    drawn.state.arrangement = Arrangement::Overlay;
    let one = board(vec![accepted(1)]);
    let mut seen = Vec::new();
    for overlay in [Overlay::Edges, Overlay::Checkerboard, Overlay::Opacity] {
        drawn.state.overlay = overlay;
        seen.push(drawn.picture(&one));
    }
    let differ = |a: &Image<[u8; 3]>, b: &Image<[u8; 3]>| a.pixels.iter().zip(&b.pixels).filter(|(a, b)| a != b).count();
    assert!(differ(&seen[0], &seen[1]) > 20_000 && differ(&seen[1], &seen[2]) > 20_000);
    let middle = Rect::from_min_max(pos2(600.0, 250.0), pos2(1100.0, 600.0));
    let before = mean(&seen[2], middle);
    let pair = one.pairs[0].clone();
    drawn.state.shift_window(&pair, 0.5, 0.0);
    let darker = mean(&drawn.picture(&one), middle);
    assert!(darker < before - 20.0, "{darker:.0} after {before:.0}");
}

/// Where the acquired picture shows a pixel of a frame of 310 × 240 px.
pub fn on_screen(picture: Rect, [u, v]: [f64; 2]) -> Pos2 {
    picture.min + vec2((u as f32 + 0.5) / 310.0, (v as f32 + 0.5) / 240.0) * picture.size()
}

/// Ellipses lay along columns and rows, whichever way a landmark was uncertain.
#[test]
fn a_landmark_s_ellipse_lies_the_way_it_is_uncertain() {
    let Some(mut drawn) = Drawn::open() else { return };
    drawn.state.toggle(Mark::Names);
    let one = board(vec![accepted(1)]);
    let seen = drawn.picture(&one);
    let picture = picture_at(&seen, IN_ACQUIRED);
    let colour = [255, 170, 90];
    // Both directions are uncertain alike; their common part puts the long axis on the falling diagonal.
    let [[uu, uv], [vu, vv]] = LANDMARK_PX2;
    assert!(uu == vv && uv == vu && uv > 0.0);
    let axes = [uu + uv, uu - uv].map(|variance| 20.0 * variance.sqrt() / std::f64::consts::SQRT_2);
    let at = |du: f64, dv: f64| near(&seen, on_screen(picture, [LANDMARK_PX[0] + du, LANDMARK_PX[1] + dv]), 4.0, colour);
    for side in [1.0, -1.0] {
        let (long, narrow) = (side * axes[0], side * axes[1]);
        assert!(at(long, long) > 3, "the end of its long axis: {}", at(long, long));
        assert!(at(narrow, -narrow) > 3, "the end of its narrow axis: {}", at(narrow, -narrow));
        assert_eq!(at(long, -long), 0, "the mirrored ellipse would reach there");
    }
    drawn.state.toggle(Mark::Landmarks);
    let bare = drawn.picture(&one);
    let end = on_screen(picture, [LANDMARK_PX[0] + axes[0], LANDMARK_PX[1] + axes[0]]);
    assert_eq!(near(&bare, end, 4.0, colour), 0, "control: no landmarks, no ellipse");
}

#[test]
fn the_scale_bar_is_as_long_as_it_says() {
    let Some(mut drawn) = Drawn::open() else { return };
    // At most three tenths of 310 px are 18.6, 46.5 and 5.58 mm: bars of 10, 20 and 5 mm.
    let mut cases = 0;
    for (mm_per_px, length_mm) in [(0.2, 10.0), (0.5, 20.0), (0.06, 5.0)] {
        let mut pair = accepted(1);
        pair.mm_per_px = Some(mm_per_px);
        let seen = drawn.picture(&board(vec![pair]));
        let picture = picture_at(&seen, IN_ACQUIRED);
        let points_per_px = f64::from(picture.width() + 1.0) / 310.0;
        let expected = length_mm / mm_per_px * points_per_px;
        // In air at the lower left, ten points from both edges: white on dark.
        let (left, row) = (picture.left() as usize + 10, picture.bottom() as usize + 1 - 10);
        let is_white = |column: usize| (row - 2..=row + 2).any(|row| seen.at(column, row).iter().all(|level| *level > 170));
        let from = (left - 4..left + 5).find(|column| is_white(*column)).expect("a bar begins there");
        let length = (from..seen.width).take_while(|column| is_white(*column)).count() as f64;
        // Its end marks are two points wide.
        assert!((length - 2.0 - expected).abs() < 3.0, "{length} points for {expected:.1} at {mm_per_px} mm a pixel");
        cases += 1;
    }
    assert_eq!(cases, 3);
    let mut unknown = accepted(1);
    unknown.mm_per_px = None;
    let seen = drawn.picture(&board(vec![unknown]));
    let picture = picture_at(&seen, IN_ACQUIRED);
    let corner = pos2(picture.left() + 40.0, picture.bottom() - 10.0);
    assert_eq!(near(&seen, corner, 8.0, [231, 236, 241]), 0, "no bar without a scale");
}

#[test]
fn masked_pixels_are_tinted_and_others_are_not() {
    let Some(mut drawn) = Drawn::open() else { return };
    let frame = acquired(&line_integral(&view()), 0.02);
    let mut masks = Masks::default();
    masks.add(Cause::Extra, Image { width: 310, height: 240, pixels: (0..310 * 240).map(|at| at % 310 >= 155).collect() });
    let mut pair = refused(1);
    pair.pictures = std::sync::Arc::new(PairPictures::alone(&frame, &masks));
    let one = board(vec![pair]);
    assert!(!drawn.state.draws(Mark::Masks), "only where it is wanted");
    let plain = drawn.picture(&one);
    drawn.state.toggle(Mark::Masks);
    let tinted = drawn.picture(&one);
    let picture = picture_at(&plain, IN_ACQUIRED);
    let both = |at: [f64; 2]| {
        let at = on_screen(picture, at);
        [&plain, &tinted].map(|seen| seen.at(at.x as usize, at.y as usize).map(f64::from))
    };
    let mut cases = 0;
    for row in [180.0, 190.0, 200.0] {
        for column in [80.0, 110.0, 200.0, 230.0] {
            let [before, after] = both([column, row]);
            // A violet that covers 112 of 255 parts.
            let expected = match column < 155.0 {
                true => before,
                false => [0, 1, 2].map(|n| before[n] * (1.0 - 112.0 / 255.0) + [80.0, 24.0, 96.0][n]),
            };
            let off = (0..3).map(|n| (after[n] - expected[n]).abs()).fold(0.0, f64::max);
            assert!(off < 5.0, "({column}, {row}): {before:?} became {after:?}, expected {expected:?}");
            cases += 1;
        }
    }
    assert_eq!(cases, 12);
}

#[test]
fn the_blinking_overlay_shows_frame_and_drr_in_turn_and_wakes_the_window_for_each() {
    let Some(mut drawn) = Drawn::open() else { return };
    (drawn.state.arrangement, drawn.state.overlay) = (Arrangement::Overlay, Overlay::Blink);
    let mut pair = accepted(1);
    // A DRR that is black tells which of the two is seen.
    let mut pictures = (*pair.pictures).clone();
    pictures.window_of_drr = [90.0, 91.0];
    pair.pictures = std::sync::Arc::new(pictures);
    let one = board(vec![pair]);
    let middle = Rect::from_min_max(pos2(600.0, 250.0), pos2(1100.0, 600.0));
    let mut at_s = |time_s: f64| {
        drawn.looks = 100.0 * time_s;
        mean(&drawn.picture(&one), middle)
    };
    // Each is shown for half a second.
    let shown = [0.1, 0.3, 0.6, 0.9, 1.1, 1.6].map(&mut at_s);
    let bright = shown.map(|level| level > shown[2] + 40.0);
    assert_eq!(bright, [true, true, false, false, true, false], "{shown:?}");
    assert!((shown[0] - shown[4]).abs() < 1.0 && (shown[2] - shown[5]).abs() < 1.0, "{shown:?}");
    let rests_s = |drawn: &mut Drawn| drawn.look(&one).viewport_output[&egui::ViewportId::ROOT].repaint_delay.as_secs_f64();
    drawn.looks = 209.0;
    let rest = rests_s(&mut drawn);
    assert!(rest < 0.45, "at 2.1 s the next picture is due in 0.4 s: {rest}");
    drawn.state.overlay = Overlay::Edges;
    (0..3).for_each(|_| drop(drawn.look(&one)));
    let rest = rests_s(&mut drawn);
    assert!(rest > 0.45, "control: nothing is due where nothing blinks: {rest}");
}
