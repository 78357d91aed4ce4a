//! The workshop: a thread that turns posed frames into pairs and makes their nulls; in a session the newest first, and nulls when no frame waits.

use std::collections::VecDeque;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::Arc;

use super::SessionError;
use super::background::stand_back;
use super::busy::{Busy, Task};
use super::crosscheck::{self, check_session};
use super::declared::Declared;
use super::develop::Bench;
use super::developed::Developed;
use super::fault;
use super::file::Setup;
use super::inputs::InputNames;
use super::jobs::{Job, Next, Order, Shared, next};
use super::posed::Posed;
use crate::beads::{BeadLayout, parse_markups};
use crate::gpu::DeviceChoice;
use crate::render::{Plan, Renderer};
use crate::reporter::Reporter;
use crate::scene::model::ScatterModel;
use crate::scene::{self, Robot, Scene};
use crate::transport::NetworkScatter;

/// Pairs that wait for their null, with pictures; an older one is completed without.
const MOST_NULLS: usize = 12;

/// Renders and compares on a thread of its own.
pub struct Workshop {
    bench: Option<Bench>,
    shared: Arc<Shared>,
    thread: Option<std::thread::JoinHandle<()>>,
    layout: Option<Arc<BeadLayout>>,
    robot: Option<Robot>,
    adapter: String,
    network_sha256: Option<String>,
    names: InputNames,
}

impl Workshop {
    /// Loads the scene and the beads, chooses a renderer.
    ///
    /// # Errors
    /// When scene or beads are wrong, or the renderer is not available.
    pub fn open(setup: &Setup, device: DeviceChoice, reporter: &Reporter) -> Result<Self, SessionError> {
        // What is said of the scene's files waits until it is known what they may be called; an error names them as they were typed.
        let held = reporter.holding();
        let scene = scene::load_text_with(&setup.scene_json, &setup.scene_path, &setup.places, false, &held);
        let mut scene = scene.inspect_err(|_| held.release(str::to_owned))?;
        let names = InputNames::of(setup, &scene.inputs);
        held.release(|words| names.hide(words));
        // From here on files have the names that may be shown.
        scene.inputs = names.shown();
        let mut layout = match &setup.beads {
            Some((path, text)) => Some(
                parse_markups(path, text.as_bytes())
                    .map_err(|error| SessionError::Beads { path: path.display().to_string(), detail: error.to_string() })?,
            ),
            None => None,
        };
        let findings = check_session(setup, &scene, layout.as_ref());
        crosscheck::tell(&findings, reporter);
        if let Some(layout) = &mut layout {
            layout.refused = crosscheck::refusal(&findings);
        }
        Self::with_scene((scene, names), layout, setup, Renderer::new(device, reporter)?, reporter)
    }

    /// With a scene that is loaded, and what its files may be called.
    ///
    /// # Errors
    /// When the network that the scene asks for its scatter is not there.
    pub(super) fn with_scene(
        (scene, names): (Scene, InputNames),
        layout: Option<BeadLayout>,
        setup: &Setup,
        renderer: Renderer,
        reporter: &Reporter,
    ) -> Result<Self, SessionError> {
        let adapter = renderer.adapter();
        let declared = Declared::of(setup);
        let robot = scene.robot.clone();
        let asks = scene.model.possible_scatter() == ScatterModel::Network;
        let network = if asks { Some(NetworkScatter::open(None)?) } else { None };
        let network_sha256 = network.as_ref().map(NetworkScatter::sha256);
        let (setup, layout_of_bench, reporter) = (setup.clone(), layout.clone(), reporter.clone());
        let bench = Bench { scene, setup, declared, layout: layout_of_bench, network, renderer, reporter, with_null: None };
        let layout = layout.map(Arc::new);
        Ok(Self { bench: Some(bench), shared: Arc::default(), thread: None, layout, robot, adapter, network_sha256, names })
    }

    /// Starts the thread; `sink` gets each pair when it can be shown and once more with its null, and says whether it wants more.
    ///
    /// # Errors
    /// When the thread cannot be started, or was.
    pub fn start(&mut self, order: Order, sink: impl FnMut(Developed) -> bool + Send + 'static) -> Result<(), SessionError> {
        let bench = self.bench.take().ok_or(SessionError::WorkshopDied)?;
        self.shared.change(|queue| queue.order = order);
        let shared = Arc::clone(&self.shared);
        let thread = std::thread::Builder::new().name("workshop".to_owned()).spawn(move || {
            let _ended = Ended(&shared);
            stand_back();
            let mut bench = bench;
            if order == Order::NewestFirst {
                let _at_work = shared.busy.begin(Task::Warming);
                // A fault in it shows again with the first frame.
                let waits = || !shared.lock().jobs.is_empty();
                let _ = catch_unwind(AssertUnwindSafe(|| bench.warm(waits)));
            }
            work(bench, &shared, sink);
        });
        self.thread = Some(thread.map_err(|source| SessionError::Thread { source })?);
        Ok(())
    }

    /// The specimen's beads.
    #[must_use]
    pub fn layout(&self) -> Option<&Arc<BeadLayout>> {
        self.layout.as_ref()
    }

    /// The robot as the scene has it.
    #[must_use]
    pub fn robot(&self) -> Option<&Robot> {
        self.robot.as_ref()
    }

    /// What renders.
    #[must_use]
    pub fn adapter(&self) -> &str {
        &self.adapter
    }

    /// SHA-256 of the weights of the network that says the scatter, where one is asked.
    #[must_use]
    pub fn network_sha256(&self) -> Option<&str> {
        self.network_sha256.as_deref()
    }

    /// Files that went into the scene, and what they are called.
    #[must_use]
    pub fn names(&self) -> &InputNames {
        &self.names
    }

    /// Hands in a frame; `plan` is executed as it is where there is one, else the renderer plans. Where the thread has ended nobody takes it.
    pub fn submit(&self, posed: Posed, plan: Option<Plan>) {
        self.shared.change(|queue| {
            if queue.ended {
                return;
            }
            // Of a frame that is edited step by step, the last step is looked at.
            let may_pass = queue.order == Order::NewestFirst;
            queue.jobs.retain(|Job { posed: other, plan }| {
                // What a log has a plan for was drawn in its session.
                let is_older = plan.is_none() && other.number == posed.number && other.development < posed.development;
                !(may_pass && is_older && [other, &posed].iter().any(|posed| posed.pose.edited.is_some()))
            });
            queue.jobs.push(Job { posed, plan });
        });
    }

    /// Frames that wait or are being developed.
    #[must_use]
    pub fn open_jobs(&self) -> usize {
        let queue = self.shared.lock();
        queue.jobs.len() + usize::from(queue.busy)
    }

    /// Whether frames are on their way here, for which nulls are put off.
    pub(super) fn await_frames(&self, are_coming: bool) {
        let is_news = self.shared.lock().awaits != are_coming;
        if is_news {
            self.shared.change(|queue| queue.awaits = are_coming);
        }
    }

    /// Whether the thread has ended, for whatever reason.
    #[must_use]
    pub fn has_ended(&self) -> bool {
        self.shared.lock().ended
    }

    /// What the session's threads are at.
    pub(super) fn busy(&self) -> &Busy {
        &self.shared.busy
    }

    /// No more frames: the thread ends when every pair and its null are made.
    pub fn close(&self) {
        self.shared.change(|queue| queue.closed = true);
    }

    /// What is left is not wanted: the thread ends after the render that runs.
    pub fn abandon(&self) {
        self.shared.change(|queue| queue.abandoned = true);
    }

    /// Waits until the thread has ended.
    ///
    /// # Errors
    /// When it died.
    pub fn join(&mut self) -> Result<(), SessionError> {
        match self.thread.take().map(std::thread::JoinHandle::join) {
            Some(Err(_)) => Err(SessionError::WorkshopDied),
            _ => Ok(()),
        }
    }
}

/// Says that the thread has ended, however it ends.
struct Ended<'a>(&'a Shared);

impl Drop for Ended<'_> {
    fn drop(&mut self) {
        self.0.change(|queue| {
            queue.ended = true;
            queue.busy = false;
            queue.jobs.clear();
        });
    }
}

fn work(mut bench: Bench, shared: &Shared, mut sink: impl FnMut(Developed) -> bool) {
    let mut nulls: VecDeque<Developed> = VecDeque::new();
    loop {
        let developed = match next(shared, !nulls.is_empty()) {
            Next::Frame(job) => {
                let Job { posed, plan } = *job;
                fault::breaks("workshop", posed.number);
                // An earlier pair of the same frame is replaced: it needs no null any more.
                nulls.retain(|waiting| waiting.posed.number != posed.number);
                let at_work = shared.busy.begin(Task::Developing(posed.number));
                let attempt = catch_unwind(AssertUnwindSafe(|| {
                    fault::hangs("render");
                    bench.develop(posed.clone(), plan)
                }));
                drop(at_work);
                let developed =
                    attempt.unwrap_or_else(|_| bench.failed(posed, "rendering or comparing it failed (a fault of this program)"));
                if !developed.complete {
                    nulls.push_back(developed.clone());
                }
                developed
            }
            Next::Null => {
                let Some(developed) = nulls.pop_back() else { continue };
                let cancelled = || shared.lock().puts_nulls_off();
                let at_work = shared.busy.begin(Task::Null(developed.posed.number));
                let attempt = catch_unwind(AssertUnwindSafe(|| bench.add_null(developed.clone(), &cancelled)));
                drop(at_work);
                match attempt {
                    Ok(Some(with_null)) => with_null,
                    Ok(None) => {
                        nulls.push_back(developed);
                        continue;
                    }
                    Err(_) => developed.without_null("making it failed (a fault of this program)"),
                }
            }
            Next::End => return,
        };
        if !sink(developed) {
            return;
        }
        // In a burst the pictures of pairs that wait for their null would fill the memory.
        if nulls.len() > MOST_NULLS
            && let Some(oldest) = nulls.pop_front()
            && !sink(oldest.without_null("other frames waited; a replay makes it"))
        {
            return;
        }
    }
}
