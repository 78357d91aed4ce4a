//! The laboratory's data: `mocks/data/lab.json` and `mocks/data/phantom.json`.

use serde::Deserialize;

use crate::MockError;
use crate::fault::FaultKind;
use crate::matrix::{Mat4, Vec3};

/// `lab.json`.
#[derive(Clone, Debug, Deserialize)]
pub struct Lab {
    /// The C-arm's nominal calibration, as the receiver gets it.
    pub carm: serde_json::Value,
    /// The robot's model, as the receiver gets it.
    pub robot: serde_json::Value,
    /// Nominal place of the specimen.
    pub world_from_lps: Mat4,
    /// How far the truth is from nominal: nobody measured it.
    pub setup_error: Displacement,
    /// How the specimen slides on the table where somebody moves it in mid-session.
    pub specimen_move: Displacement,
    /// The exposure, from 0, from which on it lies there; absent where nobody moves it.
    #[serde(skip)]
    pub moved_from: Option<usize>,
    /// Exposures, from 0, in which the arm moves while the beam is on.
    #[serde(skip)]
    pub arm_moves: Vec<usize>,
    /// Standard deviations of the encoders.
    pub encoder_noise: EncoderNoise,
    /// Photons per pixel in air.
    pub photons_per_pixel: f64,
    /// Pixel value in air.
    pub air_value: f64,
    /// Electronic noise in units of the air signal.
    pub readout_sigma: f64,
    /// Tube voltage of `spectrum.csv`.
    pub tube_kvp: f32,
    /// Tube current.
    pub tube_ma: f32,
    /// Pulse width.
    pub pulse_width_ms: f32,
    /// Filter of `spectrum.csv`.
    pub aluminium_mm: f64,
    /// Device clocks.
    pub clock: Clocks,
    /// Length of an exposure.
    pub exposure_s: f64,
    /// From the end of an exposure to its file.
    pub frame_delay_s: f64,
    /// The exposures in order.
    pub exposures: Vec<Exposure>,
    /// Faults in order.
    pub faults: Vec<Fault>,
}

/// A tilt and a shift of the specimen on the table.
#[derive(Clone, Copy, Debug, Deserialize)]
pub struct Displacement {
    /// About the specimen's own x, y, z, in that order.
    pub rotation_deg: Vec3,
    /// Along x, y, z of the world.
    pub translation_mm: Vec3,
}

/// Standard deviations.
#[derive(Clone, Copy, Debug, Deserialize)]
pub struct EncoderNoise {
    /// Of angles.
    pub deg: f64,
    /// Of lengths.
    pub mm: f64,
    /// Of the robot's sensed control angles.
    pub control_deg: f64,
}

/// How the devices' clocks run.
#[derive(Clone, Copy, Debug, Deserialize)]
pub struct Clocks {
    /// Drift.
    pub carm_ppm: f64,
    /// Drift.
    pub robot_ppm: f64,
    /// Reading at the start.
    pub carm_epoch_us: u64,
    /// Reading at the start.
    pub robot_epoch_us: u64,
}

/// One exposure.
#[derive(Clone, Debug, Deserialize)]
pub struct Exposure {
    /// When it starts, as a share of the session.
    pub at: f64,
    /// See `PROTOCOL.md`.
    pub orbital_deg: f64,
    /// See `PROTOCOL.md`.
    pub angulation_deg: f64,
    /// See `PROTOCOL.md`.
    pub wig_wag_deg: f64,
    /// See `PROTOCOL.md`.
    pub lift_mm: f64,
    /// See `PROTOCOL.md`.
    pub longitudinal_mm: f64,
    /// The robot's control angles.
    pub control_deg: [f64; 5],
    /// Collimated field at the detector; open when absent.
    #[serde(default)]
    pub field_mm: Option<[f64; 4]>,
}

impl Exposure {
    /// Lift, wig-wag, longitudinal, angulation, orbital, detector rotation; mm and degrees.
    #[must_use]
    pub fn joints(&self) -> [f64; 6] {
        [self.lift_mm, self.wig_wag_deg, self.longitudinal_mm, self.angulation_deg, self.orbital_deg, 0.0]
    }
}

/// Who sends on a line.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Deserialize, serde::Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Device {
    /// The C-arm.
    Carm,
    /// The snake robot.
    Robot,
}

impl Device {
    /// The name in files, events and on the command line.
    #[must_use]
    pub fn name(self) -> &'static str {
        match self {
            Self::Carm => "carm",
            Self::Robot => "robot",
        }
    }
}

/// A scheduled fault.
#[derive(Clone, Debug, PartialEq, Deserialize)]
pub struct Fault {
    /// On whose line.
    pub device: Device,
    /// As a share of the session.
    pub at: f64,
    /// What.
    pub kind: FaultKind,
}

impl Lab {
    /// The embedded laboratory.
    ///
    /// # Errors
    /// When the embedded data are wrong.
    pub fn embedded() -> Result<Self, MockError> {
        parse("mocks/data/lab.json", include_str!("../data/lab.json"))
    }

    /// The lab with its exposures played `times` times, one round after the other.
    #[must_use]
    pub fn repeated(mut self, times: usize) -> Self {
        let once = std::mem::take(&mut self.exposures);
        for round in 0..times {
            let moved = |exposure: &Exposure| Exposure { at: (round as f64 + exposure.at) / times as f64, ..exposure.clone() };
            self.exposures.extend(once.iter().map(moved));
        }
        self
    }

    /// The lab with its exposures taken at these `stands`, numbers of exposures from 1: arm and field are those of the stand, time and robot stay.
    ///
    /// # Errors
    /// When there are more of them than exposures, or one that is none of the exposures.
    pub fn at_stands(mut self, stands: &[usize]) -> Result<Self, MockError> {
        let scripted = self.exposures.clone();
        let wrong = |detail: String| MockError::Data { what: "--stands".to_owned(), detail };
        if stands.len() > scripted.len() {
            return Err(wrong(format!("{} of them, expected at most {}", stands.len(), scripted.len())));
        }
        for (exposure, number) in self.exposures.iter_mut().zip(stands) {
            let stand = number.checked_sub(1).and_then(|index| scripted.get(index));
            let stand = stand.ok_or_else(|| wrong(format!("{number}, expected 1 to {}", scripted.len())))?;
            *exposure = Exposure { at: exposure.at, control_deg: exposure.control_deg, ..stand.clone() };
        }
        Ok(self)
    }

    /// The lab with a square panel as high as its own, of `side_px` by `side_px` pixels and as many photons for its area.
    #[must_use]
    pub fn with_square_panel(mut self, side_px: u32) -> Self {
        let number = |key: &str| self.carm[key].as_f64().unwrap_or(1.0);
        let (before_mm, height_mm) = (number("pitch_mm"), number("rows_px") * number("pitch_mm"));
        let pitch_mm = height_mm / f64::from(side_px);
        let middle = 0.5 * f64::from(side_px) - 0.5;
        self.photons_per_pixel *= (pitch_mm / before_mm).powi(2);
        for key in ["columns_px", "rows_px"] {
            self.carm[key] = side_px.into();
        }
        self.carm["pitch_mm"] = pitch_mm.into();
        self.carm["principal_point_px"] = serde_json::json!([middle, middle]);
        self
    }

    /// Left, top, right, bottom of the panel at the detector, from its middle.
    #[must_use]
    pub fn open_field_mm(&self) -> [f64; 4] {
        let half = |key: &str| 0.5 * self.carm[key].as_f64().unwrap_or(0.0) * self.carm["pitch_mm"].as_f64().unwrap_or(0.0);
        let (x, y) = (half("columns_px"), half("rows_px"));
        [-x, -y, x, y]
    }

    /// A number of the C-arm's calibration.
    ///
    /// # Errors
    /// When it is not there.
    pub fn carm_number(&self, key: &str) -> Result<f64, MockError> {
        self.carm[key].as_f64().ok_or_else(|| MockError::Data { what: "lab.json".to_owned(), detail: format!("no carm.{key}") })
    }
}

/// Parses embedded JSON.
pub(crate) fn parse<T: serde::de::DeserializeOwned>(what: &str, text: &str) -> Result<T, MockError> {
    serde_json::from_str(text).map_err(|error| MockError::Data { what: what.to_owned(), detail: error.to_string() })
}
