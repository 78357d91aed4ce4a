//! The session's own engine and workshop, given what a rehearsed exposure brings.

use std::collections::VecDeque;
use std::path::Path;
use std::sync::Arc;
use std::sync::mpsc::channel;

use super::verdict::Drawn;
use crate::beads::BeadLayout;
use crate::render::Renderer;
use crate::reporter::Reporter;
use crate::scene::Scene;
use crate::session::SessionError;
use crate::session::developed::Developed;
use crate::session::engine::Engine;
use crate::session::file::Setup;
use crate::session::folder::{Collector, Times};
use crate::session::input::{Input, Output};
use crate::session::inputs::InputNames;
use crate::session::jobs::Order;
use crate::session::posed::Posed;
use crate::session::tracks::Tracks;
use crate::session::workshop::Workshop;

/// What the engine made of its inputs.
pub(super) struct Played {
    engine: Engine,
    tracks: Tracks,
    /// The frame with its pose.
    pub posed: Option<Posed>,
    /// What of the bytes was not understood.
    pub faults: Vec<String>,
}

/// Gives `inputs` to a new engine until `ended_us`.
pub(super) fn play(
    setup: Setup,
    layout: &BeadLayout,
    inputs: impl IntoIterator<Item = Input>,
    ended_us: i64,
    reporter: &Reporter,
) -> Played {
    let engine = Engine::new(Arc::new(setup), Some(Arc::new(layout.clone())), reporter.clone());
    let mut played = Played { engine, tracks: Tracks::new(), posed: None, faults: Vec::new() };
    for input in inputs {
        played.with_engine(|engine, sink| engine.push(input, sink));
    }
    played.with_engine(|engine, sink| engine.finish(ended_us, sink));
    // Not before: what ties a session's first frame to its exposure is certain at the end.
    let bound: Vec<u32> = played.engine.bound().collect();
    for number in bound {
        played.with_engine(|engine, sink| engine.push(Input::Develop { number }, sink));
    }
    played
}

impl Played {
    fn with_engine(&mut self, drive: impl FnOnce(&mut Engine, &mut dyn FnMut(Output))) {
        let mut outputs = VecDeque::new();
        drive(&mut self.engine, &mut |output| outputs.push_back(output));
        while let Some(output) = outputs.pop_front() {
            let mut sink = |output| outputs.push_back(output);
            match output {
                Output::Sample { host_us, sample, .. } => drop(self.tracks.sample(host_us, &sample)),
                Output::Fault { device, detail, .. } => self.faults.push(format!("{device}: {detail}")),
                Output::Job(job) => self.engine.registered(job.run(), &mut sink),
                Output::Posed(posed) => self.posed = Some(*posed),
                // Of pictures that were put away and of hands there are none.
                Output::Bound { .. }
                | Output::BoundLate { .. }
                | Output::PictureLost { .. }
                | Output::Edit(_)
                | Output::NotEdited { .. }
                | Output::Noted { .. } => {}
            }
        }
    }

    /// Renders and compares `posed`, and writes DRR, strip, pairs and report into `out`.
    ///
    /// # Errors
    /// When the folder cannot be written, or the thread dies.
    pub(super) fn draw(
        self,
        posed: Posed,
        (setup, layout): (&Setup, &BeadLayout),
        scene: &Scene,
        renderer: Renderer,
        out: &Path,
        reporter: &Reporter,
    ) -> Result<Drawn, SessionError> {
        let names = InputNames::of(setup, &scene.inputs);
        let scene = Scene { inputs: names.shown(), ..scene.clone() };
        let mut workshop = Workshop::with_scene((scene, names), Some(layout.clone()), setup, renderer, reporter)?;
        let mut collector = Collector::create(out, posed.time_us, Times::Told, &workshop)?;
        let (sender, pairs) = channel();
        // The first state of the pair is enough: what its null says of the scene's own picture is known.
        workshop.start(Order::AsHandedIn, move |developed: Developed| {
            let _ = sender.send(developed);
            false
        })?;
        let number = posed.number;
        workshop.submit(posed, None);
        // Without a bound of its own: whoever asks has one (`check --limit`), and says then, and at Ctrl-C, what was found so far.
        let developed = pairs.recv().map_err(|_| SessionError::WorkshopDied)?;
        workshop.join()?;
        let pair = developed.pair.clone();
        let compared = developed.compared.is_some();
        let mut unwritten = collector.take(developed);
        let folder = collector.finish(&self.engine, self.tracks, (Vec::new(), "free the disk"), reporter, None);
        unwritten.extend(folder.losses);
        let strip = out.join(format!("strips/{number:03}.png"));
        if !strip.exists() {
            unwritten.push("the strip was not written".to_owned());
        }
        Ok(Drawn { pair, compared, unwritten })
    }
}
