//! What the window looks like: drawn by software Vulkan into a picture, and looked at.
#![cfg(feature = "viewer")]

use eframe::egui::{self, Context, Pos2, RawInput, Rect, pos2, vec2};
use eframe::egui_wgpu::{Renderer, RendererOptions, ScreenDescriptor};
use sidecarm::gpu::{Device, DeviceChoice, Gpu};
use sidecarm::image::Image;
use sidecarm::reporter::Reporter;
use sidecarm::session::board::BoardState;
use sidecarm::viewer::{Arrangement, Mark, Overlay, ViewState, draw};

use crate::viewer_boards::{FOUND_PX, TIP_PX, accepted, amber, board, refused};

/// The size that the window opens with.
const SIZE: [u32; 2] = [1400, 900];

/// A window that is drawn into pictures.
pub struct Drawn {
    gpu: Box<Gpu>,
    renderer: Renderer,
    context: Context,
    pub state: ViewState,
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
        Some(Self { gpu, renderer, context: Context::default(), state: ViewState::default(), looks: 0.0 })
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
        let input = RawInput { screen_rect: Some(screen), time: Some(0.01 * self.looks), ..RawInput::default() };
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
fn picture_at(seen: &Image<[u8; 3]>, from: [usize; 2]) -> Rect {
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

fn mean(seen: &Image<[u8; 3]>, within: Rect) -> f64 {
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
fn near(seen: &Image<[u8; 3]>, at: Pos2, reach: f32, colour: [u8; 3]) -> usize {
    let like = |pixel: &[u8; 3]| pixel.iter().zip(colour).all(|(a, b)| a.abs_diff(b) < 60);
    let span = |middle: f32| (middle - reach) as usize..=(middle + reach) as usize;
    span(at.y).flat_map(|row| span(at.x).map(move |column| (column, row))).filter(|(u, v)| like(seen.at(*u, *v))).count()
}

const GREEN: [u8; 3] = [76, 195, 138];
const RED: [u8; 3] = [240, 106, 95];
const AMBER: [u8; 3] = [242, 184, 75];

/// In the middle of the upper left picture, where no mark is.
const IN_ACQUIRED: [usize; 2] = [560, 330];

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
