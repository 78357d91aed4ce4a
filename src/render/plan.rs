//! The plan: a plain description of what will be executed. Live logs it, replay executes it again without planning.

use serde::{Deserialize, Serialize};

pub use super::plan_parts::{Choice, Executor, Fitted, Node, Sampling};
use super::spectrum::whole_spectrum;
use super::tiles::Tiles;
use super::{Quantity, chain};
use crate::scene::model::{Formation, Matter, Motion, Noise, ScatterModel, Scene};

/// Everything that decides what an image looks like, apart from the scene.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Plan {
    /// Which executor.
    pub executor: Executor,
    /// What is made.
    pub quantity: Quantity,
    /// Columns, rows.
    pub size_px: [u32; 2],
    /// Image formation.
    pub formation: Formation,
    /// How volumes are sampled.
    pub sampling: Sampling,
    /// Names of the materials, one path image each.
    pub materials: Vec<String>,
    /// Energies at which Beer–Lambert is evaluated; empty for `area_density`.
    pub energy_nodes: Vec<Node>,
    /// Whether later objects displace earlier ones anywhere.
    pub displacement: bool,
    /// `off`, `paper` or `true`.
    pub noise: String,
    /// Keys of the random numbers.
    pub seed: u64,
    /// See `seed`.
    pub frame_index: u32,
    /// Every which pixel is cast along columns and rows; the others are interpolated. 1 casts all.
    #[serde(default = "every")]
    pub step_px: u32,
    /// Tiles in which every pixel is cast, where `step_px` skips some elsewhere.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub full_tiles: Option<Tiles>,
    /// g/cm² of each material beyond which a pixel is evaluated with every bin of the spectrum; empty when all are.
    #[serde(default)]
    pub fitted_up_to_g_per_cm2: Vec<f64>,
    /// Bound of |Δ line_integral| / max(1, line_integral), noise off; its parts stand in `error_parts`.
    pub stated_error: f64,
    /// What the bound consists of.
    #[serde(default)]
    pub error_parts: ErrorParts,
    /// Milliseconds by the cost model of this machine, from rays to page, preparation of volumes aside; `None` where there is no model.
    #[serde(default)]
    pub predicted_ms: Option<f64>,
    /// Milliseconds by the cost model of a typical core, which ranks plans for an error; `None` where there is no model.
    #[serde(default)]
    pub typical_ms: Option<f64>,
    /// What is modelled, what is left out.
    pub choices: Vec<Choice>,
}

/// Parts of a plan's stated error.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct ErrorParts {
    /// Sampling of volumes and rounding of paths.
    pub sampling: f64,
    /// Energies, and rounding of their sum.
    pub energies: f64,
    /// Interpolation between cast pixels.
    pub interpolation: f64,
}

fn every() -> u32 {
    1
}

/// What to say where scatter is asked for, and nobody found out about it for this image.
#[must_use]
pub fn scatter_left_out(scene: &Scene, quantity: Quantity) -> Option<&'static str> {
    match (scene.model.scatter, quantity) {
        (ScatterModel::Off, _) => None,
        (_, _) if scene.model.formation == Formation::Naive => {
            Some("naive formation (Eq. 8) has no scatter: model.scatter is left out; formation \"deepdrr\" has it")
        }
        (_, Quantity::AreaDensity) => Some("area density is that of the objects alone"),
        (ScatterModel::MonteCarlo, _) => {
            Some("scatter is left out of this image: nobody has followed photons, which takes seconds")
        }
        (ScatterModel::Network, _) => Some("scatter is left out of this image: nobody has asked the network"),
    }
}

impl Plan {
    /// The same with every pixel cast, in exact slabs in place of fixed point, whose windows suit pixels as small as the plan's, and
    /// without noise: for small images of the same scene.
    #[must_use]
    pub fn whole(&self) -> Self {
        let sampling = if self.sampling == Sampling::FixedSlabs { Sampling::ExactSlabs } else { self.sampling };
        let (predicted_ms, typical_ms, noise) = (None, None, "off".to_owned());
        Self { sampling, step_px: 1, full_tiles: None, predicted_ms, typical_ms, noise, ..self.clone() }
    }

    /// What `scene` needs and nothing else: every bin of the spectrum, and the most exact sampling of `executor`; `cpu_because` says
    /// why a GPU that is there stays unused.
    #[must_use]
    pub fn new(
        scene: &Scene,
        size_px: [u32; 2],
        quantity: Quantity,
        executor: Executor,
        frame_index: u32,
        cpu_because: Option<&str>,
    ) -> Self {
        let mut choices = Vec::new();
        let mut choose = |what: &str, modelled: bool, why: String| {
            choices.push(Choice { what: what.to_owned(), modelled, why });
        };
        let volumes: usize = scene.objects.iter().map(|object| object.matter.volumes().len()).sum();
        let shapes: usize =
            scene.objects.iter().map(|object| if let Matter::Solids(s) = &object.matter { s.len() } else { 0 }).sum();
        let meshes = scene.objects.iter().filter(|object| matches!(object.matter, Matter::Mesh(_))).count();
        let displacement = volumes + shapes + meshes > 1;
        choose(
            "displacement",
            displacement,
            if displacement {
                format!(
                    "{volumes} volumes, {shapes} shapes, {meshes} meshes: later ones mask earlier ones along the same ray, exactly"
                )
            } else {
                "there is nothing that could displace anything".to_owned()
            },
        );
        if let Some((moved, words)) = bodies(scene) {
            choose("bodies", moved, words);
        }
        choose("path images", true, format!("one for each of {} materials", scene.materials.len()));
        let sampling = Sampling::of(scene, volumes);
        if volumes > 0 {
            choose("volumes", true, sampling.why().into());
        }
        if shapes > 0 {
            choose("shapes", true, format!("{shapes} intersected exactly, each only inside its bounds on the screen"));
        }
        let area = quantity == Quantity::AreaDensity;
        let nodes: Vec<Node> = if area { Vec::new() } else { whole_spectrum(scene) };
        if area {
            choose("spectrum", false, "area density does not depend on energy".into());
        } else if scene.model.formation == Formation::Naive {
            choose("spectrum", false, "naive formation: one mean attenuation for every material (Eq. 8)".into());
        } else {
            let all = scene.beam.spectrum.bins.len();
            choose("spectrum", true, format!("{} of {all} bins hold photons, each is evaluated", nodes.len()));
        }
        let noisy = noise_applies(scene, quantity);
        let noise = match (noisy, scene.model.noise) {
            (false, _) | (_, Noise::Off) => "off",
            (true, Noise::Paper) => "paper",
            (true, Noise::True) => "true",
        };
        let why_no_noise = if scene.model.noise == Noise::Off {
            "not asked for: no random numbers are drawn"
        } else if area {
            "area density is noise-free"
        } else {
            scene.model.noise_left_out().unwrap_or_default()
        };
        choose(
            "quantum noise",
            noisy,
            if noisy { format!("'{noise}', {} photons a pixel", scene.beam.photons_per_pixel) } else { why_no_noise.to_owned() },
        );
        let kernel = noisy && scene.detector.crosstalk.len() > 1;
        choose(
            "crosstalk",
            kernel,
            if kernel { "correlates the quantum noise".into() } else { "no kernel, or no noise".to_owned() },
        );
        let readout = noisy && scene.detector.readout_noise.is_some();
        choose("readout noise", readout, if readout { "of the detector".into() } else { "not given, or no noise".to_owned() });
        if let Some(reason) = cpu_because {
            choose("GPU", false, format!("{reason}: the CPU executor renders this scene"));
        }
        choose("scatter", false, scatter_left_out(scene, quantity).unwrap_or("not asked for").into());
        choices.extend(chain::choices(scene, quantity));
        Self {
            executor,
            quantity,
            size_px,
            formation: scene.model.formation,
            sampling,
            materials: scene.materials.iter().map(|material| material.name.clone()).collect(),
            energy_nodes: nodes,
            displacement,
            noise: noise.to_owned(),
            seed: scene.model.seed,
            frame_index,
            step_px: 1,
            full_tiles: None,
            fitted_up_to_g_per_cm2: Vec::new(),
            stated_error: executor.stated_error(),
            error_parts: ErrorParts { sampling: executor.stated_error(), ..ErrorParts::default() },
            predicted_ms: None,
            typical_ms: None,
            choices,
        }
    }

    /// Replaces what was said about an ingredient, or adds it.
    pub fn say(&mut self, what: &str, modelled: bool, why: String) {
        let choice = Choice { what: what.to_owned(), modelled, why };
        match self.choices.iter_mut().find(|choice| choice.what == what) {
            Some(said) => *said = choice,
            None => self.choices.push(choice),
        }
    }

    /// What `--explain` prints: what is modelled, what is left out and why.
    #[must_use]
    pub fn explain(&self) -> String {
        use std::fmt::Write as _;
        let mut text =
            format!("plan: {:?} executor, {} x {} px, {:?}\n", self.executor, self.size_px[0], self.size_px[1], self.quantity);
        for (title, wanted) in [("modelled", true), ("left out", false)] {
            let _ = writeln!(text, "{title}:");
            for choice in self.choices.iter().filter(|choice| choice.modelled == wanted) {
                let _ = writeln!(text, "  {}: {}", choice.what, choice.why);
            }
        }
        let parts = self.error_parts;
        let _ = writeln!(
            text,
            "stated error: {:.1e} of max(1, line integral), noise aside (sampling {:.1e}, energies {:.1e}, interpolation {:.1e})",
            self.stated_error, parts.sampling, parts.energies, parts.interpolation
        );
        if let Some(ms) = self.predicted_ms {
            let _ = writeln!(text, "predicted: {ms:.1} ms, planning and preparation of volumes aside");
        }
        text
    }
}

/// What is said of the specimen's rigid parts: whether any has moved, and each; `None` where nobody said where they are.
fn bodies(scene: &Scene) -> Option<(bool, String)> {
    let motions = &scene.bodies.motions;
    let words = |motion: &Motion| match (motion.is_moved(), motion.filled_cm3) {
        (false, _) => format!("{} unmoved", motion.body),
        (true, filled_cm3) => {
            let filled = if filled_cm3 > 0.0 {
                format!(", {filled_cm3:.1} cm3 that it left filled with what surrounds it")
            } else {
                String::new()
            };
            format!("{} moved by {:.2} deg and {:.2} mm{filled}", motion.body, motion.angle_deg(), motion.shift_mm)
        }
    };
    let all: Vec<String> = motions.iter().map(words).collect();
    (!all.is_empty()).then(|| (motions.iter().any(Motion::is_moved), all.join("; ")))
}

/// Whether random numbers are drawn.
pub(super) fn noise_applies(scene: &Scene, quantity: Quantity) -> bool {
    scene.model.noise != Noise::Off && quantity != Quantity::AreaDensity && scene.model.noise_left_out().is_none()
}
