//! The scripted session: where arm and robot are at a time, and what their devices say of it.

use rand::Rng;
use rand_distr::{Distribution, Normal};

use crate::lab::{Exposure, Lab};
use crate::wire::{CarmMessage, MetadataMessage, NO_COUNTER, RobotMessage};

/// For how long the arm is still before an exposure.
const STILL_S: f64 = 0.2;
/// How far the orbital angle goes, either way from where the picture is taken, in an exposure in which the arm moves.
const SWING_DEG: f64 = 1.0;
/// Tendon travel per degree of summed control angles.
const TENDON_MM_PER_DEG: f64 = 0.2;

/// A lab and how much of it is played. Times are seconds since the first packet.
#[derive(Clone, Copy, Debug)]
pub struct Script<'a> {
    /// The lab.
    pub lab: &'a Lab,
    /// Length of the session.
    pub duration_s: f64,
    /// Exposures played, at most all of the lab's.
    pub exposures: usize,
    /// The arm has an exposure counter.
    pub counter: bool,
}

impl Script<'_> {
    /// Exposures played.
    #[must_use]
    pub fn count(&self) -> usize {
        self.exposures.min(self.lab.exposures.len())
    }

    /// When X-ray goes on for the `index`-th exposure, from 0.
    #[must_use]
    pub fn start_s(&self, index: usize) -> f64 {
        self.lab.exposures[index].at * self.duration_s
    }

    /// When its file arrives.
    #[must_use]
    pub fn frame_s(&self, index: usize) -> f64 {
        self.start_s(index) + self.lab.exposure_s + self.lab.frame_delay_s
    }

    /// When nothing happens any more.
    #[must_use]
    pub fn end_s(&self) -> f64 {
        self.count().checked_sub(1).map_or(self.duration_s, |last| self.duration_s.max(self.frame_s(last) + 0.5))
    }

    /// Values of two exposures blended: still during an exposure and shortly before it, smooth in between.
    fn blend<const N: usize>(&self, at_s: f64, value: impl Fn(&Exposure) -> [f64; N]) -> [f64; N] {
        let exposures = &self.lab.exposures[..self.count()];
        let Some(after) = (0..exposures.len()).find(|index| self.start_s(*index) + self.lab.exposure_s > at_s) else {
            return exposures.last().map_or([0.0; N], value);
        };
        let target = value(&exposures[after]);
        let Some(before) = after.checked_sub(1) else { return target };
        let from_s = self.start_s(before) + self.lab.exposure_s;
        let to_s = self.start_s(after) - STILL_S;
        let t = ((at_s - from_s) / (to_s - from_s)).clamp(0.0, 1.0);
        let smooth = t * t * (3.0 - 2.0 * t);
        let start = value(&exposures[before]);
        std::array::from_fn(|i| start[i] + (target[i] - start[i]) * smooth)
    }

    /// How far the orbital angle is from that of the picture, in and around exposures in which the arm moves: it goes on evenly while the
    /// beam is on, is there in the middle, and comes from and returns to rest in the time in which it is still elsewhere.
    fn swing_deg(&self, at_s: f64) -> f64 {
        let half_s = 0.5 * self.lab.exposure_s;
        let swing = |index: &usize| {
            let from_middle_s = at_s - (self.start_s(*index) + half_s);
            let beyond_s = (from_middle_s.abs() - half_s).max(0.0);
            SWING_DEG * (from_middle_s / half_s).clamp(-1.0, 1.0) * (1.0 - beyond_s / STILL_S).max(0.0)
        };
        self.lab.arm_moves.iter().map(swing).sum()
    }

    fn exposure_at(&self, at_s: f64) -> Option<usize> {
        (0..self.count()).find(|index| (self.start_s(*index)..self.start_s(*index) + self.lab.exposure_s).contains(&at_s))
    }

    /// What the arm's encoders and generator report.
    #[must_use]
    pub fn carm(&self, at_s: f64, random: &mut impl Rng) -> CarmMessage {
        let [lift, wig_wag, longitudinal, angulation, at_rest, rotation] = self.blend(at_s, Exposure::joints);
        let orbital = at_rest + self.swing_deg(at_s);
        let (deg, mm) = (self.lab.encoder_noise.deg, self.lab.encoder_noise.mm);
        let joints = [
            lift + noise(mm, random),
            wig_wag + noise(deg, random),
            longitudinal + noise(mm, random),
            angulation + noise(deg, random),
            orbital + noise(deg, random),
            rotation,
            self.lab.carm["source_to_detector_mm"].as_f64().unwrap_or(f64::NAN),
        ];
        let exposed = self.exposure_at(at_s);
        let seen = (0..self.count()).filter(|index| self.start_s(*index) <= at_s).count();
        let field = exposed.and_then(|index| self.lab.exposures[index].field_mm).unwrap_or(self.lab.open_field_mm());
        CarmMessage {
            joints,
            tube_kvp: self.lab.tube_kvp,
            tube_ma: self.lab.tube_ma,
            pulse_width_ms: self.lab.pulse_width_ms,
            filter_mm: [self.lab.aluminium_mm as f32, 0.0],
            field_mm: field.map(|side| side as f32),
            xray_on: exposed.is_some(),
            exposure_counter: if self.counter { seen as u32 } else { NO_COUNTER },
            status: 0,
        }
    }

    /// What the robot's controller reports.
    #[must_use]
    pub fn robot(&self, at_s: f64, random: &mut impl Rng) -> RobotMessage {
        let control = self.blend(at_s, |exposure| exposure.control_deg);
        let travel_mm = |at_s: f64| TENDON_MM_PER_DEG * self.blend(at_s, |exposure| exposure.control_deg).iter().sum::<f64>();
        let (position_mm, step_s) = (travel_mm(at_s), 1e-3);
        let velocity_mm_per_s = (travel_mm(at_s + step_s) - travel_mm(at_s - step_s)) / (2.0 * step_s);
        // The pulling tendon carries the load, the other one stays taut.
        let tendon = |sign: f64| {
            let tension_n = (10.0 + 5.0 * sign * position_mm).max(2.0);
            [sign * position_mm, sign * velocity_mm_per_s, tension_n, 0.04 * tension_n].map(|value| value as f32)
        };
        let sigma = self.lab.encoder_noise.control_deg;
        RobotMessage {
            commanded_deg: control.map(|angle| angle as f32),
            sensed_deg: Some(control.map(|angle| (angle + noise(sigma, random)) as f32)),
            tendons: [tendon(1.0), tendon(-1.0)],
            tracker_from_base: None,
            drill_rpm: 0.0,
            status: 0,
        }
    }
}

fn noise(sigma: f64, random: &mut impl Rng) -> f64 {
    Normal::new(0.0, sigma).map_or(0.0, |normal| normal.sample(random))
}

/// Message 3 of the arm.
#[must_use]
pub fn carm_metadata() -> MetadataMessage {
    let limits =
        vec![[-100.0, 400.0], [-10.0, 10.0], [-100.0, 200.0], [-190.0, 190.0], [-90.0, 90.0], [-180.0, 180.0], [900.0, 1200.0]];
    MetadataMessage { kind: 2, texts: texts("MOCK-CARM-1", "carm.json", "mm,deg,kV,mA,ms"), limits }
}

/// Message 3 of the robot.
#[must_use]
pub fn robot_metadata() -> MetadataMessage {
    MetadataMessage { kind: 1, texts: texts("MOCK-SNAKE-1", "robot.json", "deg,mm,mm/s,N,A,rpm"), limits: vec![[-7.9, 7.9]; 5] }
}

fn texts(serial: &str, calibration: &str, units: &str) -> [String; 4] {
    [serial, "mock 1.0", calibration, units].map(str::to_owned)
}

#[cfg(test)]
mod tests {
    use super::*;
    use rand::SeedableRng;

    #[test]
    fn the_arm_is_still_while_x_ray_is_on_and_moves_in_between() {
        let mut lab = Lab::embedded().expect("embedded");
        (lab.encoder_noise.deg, lab.encoder_noise.mm) = (0.0, 0.0);
        let script = Script { lab: &lab, duration_s: 20.0, exposures: usize::MAX, counter: true };
        let mut random = rand_chacha::ChaCha8Rng::seed_from_u64(1);
        let (mut on, mut moved) = (0, 0);
        let mut before = script.carm(0.0, &mut random);
        for tick in 1..600 {
            let now = script.carm(f64::from(tick) / 30.0, &mut random);
            if now.xray_on {
                let index = now.exposure_counter as usize - 1;
                assert_eq!(now.joints[..6], lab.exposures[index].joints(), "exposure {index}");
                on += 1;
            } else if now.joints != before.joints {
                moved += 1;
            }
            assert!(now.exposure_counter >= before.exposure_counter);
            before = now;
        }
        assert_eq!(before.exposure_counter as usize, lab.exposures.len());
        assert!(on >= 9 * lab.exposures.len() && moved > 200, "{on} {moved}");
    }

    #[test]
    fn an_arm_that_moves_in_an_exposure_is_where_its_picture_is_taken_in_the_middle_of_it() {
        let mut lab = Lab::embedded().expect("embedded");
        (lab.encoder_noise.deg, lab.encoder_noise.mm) = (0.0, 0.0);
        lab.arm_moves = vec![1];
        let script = Script { lab: &lab, duration_s: 20.0, exposures: usize::MAX, counter: true };
        let mut random = rand_chacha::ChaCha8Rng::seed_from_u64(1);
        let mut orbital = |index: usize, share: f64| {
            script.carm(script.start_s(index) + share * lab.exposure_s, &mut random).joints[4] - lab.exposures[index].orbital_deg
        };
        for (share, deg) in [(0.0, -1.0), (0.25, -0.5), (0.5, 0.0), (0.75, 0.5), (0.999, 0.998)] {
            assert!((orbital(1, share) - deg).abs() < 1e-9, "{share}: {}", orbital(1, share));
            assert_eq!([0, 2].map(|index| orbital(index, share)), [0.0; 2], "the others' arm is still");
        }
    }

    #[test]
    fn without_a_counter_there_is_none() {
        let lab = Lab::embedded().expect("embedded");
        let script = Script { lab: &lab, duration_s: 20.0, exposures: usize::MAX, counter: false };
        let mut random = rand_chacha::ChaCha8Rng::seed_from_u64(1);
        assert_eq!(script.carm(10.0, &mut random).exposure_counter, NO_COUNTER);
    }
}
