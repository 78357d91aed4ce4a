//! Heel and bow-tie of the yardstick: what is left of each energy in one pixel, over the scene's spectrum.

use glam::{DQuat, DVec3};

use crate::render::RenderError;
use crate::scene::optics::{Axis, BeamShape, Heel};
use crate::scene::physics::{ANODE_ANGLES_DEG, Spectrum};

/// Tungsten output by energy at one take-off angle, photons per bin.
struct Output {
    ln_photons: Vec<(f64, f64)>,
}

impl Output {
    fn new(tube_kvp: f64, angle_deg: f64) -> Result<Self, RenderError> {
        let spectrum = Spectrum::tungsten_output(tube_kvp, angle_deg, &[])?;
        Ok(Self { ln_photons: spectrum.bins.iter().map(|bin| (bin.energy_kev, bin.fluence.ln())).collect() })
    }

    /// ln of the photons in the bin nearest to an energy.
    fn at(&self, energy_kev: f64) -> f64 {
        let nearest = self.ln_photons.iter().min_by(|a, b| (a.0 - energy_kev).abs().total_cmp(&(b.0 - energy_kev).abs()));
        nearest.map_or(f64::NEG_INFINITY, |(_, ln)| *ln)
    }
}

/// exp(−μ a) of the bow-tie times the output at the ray's take-off angle over that at the anode angle, for each energy; all 0 behind the
/// heel.
pub fn left_of(shape: &BeamShape, energies_kev: &[f64], ray: DVec3) -> Result<Vec<f64>, RenderError> {
    let mut left = vec![1.0; energies_kev.len()];
    if let Some(bowtie) = &shape.bowtie {
        let fan = match bowtie.axis {
            Axis::Column => DVec3::new(ray.x, 0.0, ray.z),
            Axis::Row => DVec3::new(0.0, ray.y, ray.z),
        };
        let angle_deg = ((fan.x + fan.y) / fan.z).atan().to_degrees();
        let points = &bowtie.thickness_mm;
        let (first, last) = (points[0], points[points.len() - 1]);
        let mut thickness_mm = if angle_deg < first[0] { first[1] } else { last[1] };
        for pair in points.windows(2) {
            if angle_deg >= pair[0][0] && angle_deg <= pair[1][0] {
                let share = (angle_deg - pair[0][0]) / (pair[1][0] - pair[0][0]);
                thickness_mm = (1.0 - share) * pair[0][1] + share * pair[1][1];
            }
        }
        // The profile is extruded at right angles to the fan's plane.
        let path_mm = thickness_mm / ray.angle_between(fan).cos();
        for (left, energy_kev) in left.iter_mut().zip(energies_kev) {
            let mu_per_mm = 0.1 * bowtie.density_g_per_cm3 * bowtie.material.attenuation(*energy_kev)?.total_cm2_per_g;
            *left *= (-mu_per_mm * path_mm).exp();
        }
    }
    if let Some(heel) = &shape.heel {
        let change = heel_change(heel, energies_kev, ray)?;
        left.iter_mut().zip(change).for_each(|(left, change)| *left *= change);
    }
    Ok(left)
}

fn heel_change(heel: &Heel, energies_kev: &[f64], ray: DVec3) -> Result<Vec<f64>, RenderError> {
    // The target's normal points to the cathode; turning it by the anode angle towards the beam makes that the principal ray's take-off.
    let to_cathode = -heel.anode_towards.in_camera();
    let turn = DQuat::from_axis_angle(to_cathode.cross(DVec3::Z), heel.anode_angle_deg.to_radians());
    let take_off_rad = std::f64::consts::FRAC_PI_2 - ray.angle_between(turn * to_cathode);
    if take_off_rad <= 0.0 {
        return Ok(vec![0.0; energies_kev.len()]);
    }
    let (first_deg, last_deg) = ANODE_ANGLES_DEG;
    let take_off_deg = take_off_rad.to_degrees();
    let centre = Output::new(heel.tube_kvp, heel.anode_angle_deg)?;
    if (first_deg..=last_deg).contains(&take_off_deg) {
        let here = Output::new(heel.tube_kvp, take_off_deg)?;
        return Ok(energies_kev.iter().map(|kev| (here.at(*kev) - centre.at(*kev)).exp()).collect());
    }
    // Beyond the tables ln of the output goes on as a straight line over 1/sin, through the last two whole degrees.
    let [near_deg, far_deg] = if take_off_deg < first_deg { [first_deg, first_deg + 1.0] } else { [last_deg, last_deg - 1.0] };
    let (near, far) = (Output::new(heel.tube_kvp, near_deg)?, Output::new(heel.tube_kvp, far_deg)?);
    let path = |degrees: f64| 1.0 / degrees.to_radians().sin();
    let step = (path(take_off_deg) - path(near_deg)) / (path(far_deg) - path(near_deg));
    // Larger angles never give less; single tabulated bins say otherwise by rounding.
    let sign = (far_deg - near_deg).signum();
    let slope = |kev: f64| sign * (sign * (far.at(kev) - near.at(kev))).max(0.0);
    let change = |kev: &f64| (near.at(*kev) + step * slope(*kev) - centre.at(*kev)).exp();
    Ok(energies_kev.iter().map(change).collect())
}
