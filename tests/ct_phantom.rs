//! CTs with metal in them, drawn by summing: nothing here is shared with the program.
//!
//! A metal body is a cloud of points of equal volume; the scanner's point spread makes a Gaussian of each; a voxel averages its inside.
//! Balls sum a fine cloud once per distance, other shapes point by point. Then noise, clipping at a stored value, rounding.

use glam::{DAffine3, DVec3};

/// Numbers that are the same in every run.
pub struct Luck(u64);

impl Luck {
    pub fn new(seed: u64) -> Self {
        Self(seed.wrapping_mul(0xd134_2543_de82_ef95).wrapping_add(0x2545_f491_4f6c_dd1d))
    }

    pub fn unit(&mut self) -> f64 {
        self.0 ^= self.0 << 13;
        self.0 ^= self.0 >> 7;
        self.0 ^= self.0 << 17;
        (self.0 >> 11) as f64 / (1u64 << 53) as f64
    }

    pub fn between(&mut self, low: f64, high: f64) -> f64 {
        low + (high - low) * self.unit()
    }

    /// Sum of twelve: near enough to normal.
    pub fn normal(&mut self) -> f64 {
        (0..12).map(|_| self.unit()).sum::<f64>() - 6.0
    }

    pub fn vector(&mut self, half: f64) -> DVec3 {
        DVec3::new(self.between(-half, half), self.between(-half, half), self.between(-half, half))
    }
}

/// A CT being drawn.
pub struct Phantom {
    pub size: [usize; 3],
    pub lps_from_voxel: DAffine3,
    pub hu: Vec<f64>,
    /// σ of the scanner's point spread.
    pub blur_mm: f64,
    /// Where a ball is seen along a slice's normal, in slice spacings from its middle, all alike; a box where there are none.
    pub slice_profile: Vec<f64>,
    /// σ of a Gaussian that blurs balls in the slices' plane on top, where `slice_profile` says how they are seen along the normal.
    pub plane_blur_mm: f64,
}

impl Phantom {
    /// Tissue as `hu_at` has it at the voxels' centres (already blurred).
    pub fn new(size: [usize; 3], lps_from_voxel: DAffine3, blur_mm: f64, hu_at: impl Fn(DVec3) -> f64) -> Self {
        let mut phantom = Self { size, lps_from_voxel, hu: Vec::new(), blur_mm, slice_profile: Vec::new(), plane_blur_mm: 0.0 };
        phantom.hu = (0..size.iter().product()).map(|index| hu_at(phantom.place(index))).collect();
        phantom
    }

    pub fn place(&self, index: usize) -> DVec3 {
        let [i, j, k] = [index % self.size[0], index / self.size[0] % self.size[1], index / (self.size[0] * self.size[1])];
        self.lps_from_voxel.transform_point3(DVec3::new(i as f64, j as f64, k as f64))
    }

    /// Middle of the grid.
    pub fn middle(&self) -> DVec3 {
        self.lps_from_voxel.transform_point3(0.5 * (DVec3::from_array(self.size.map(|n| n as f64)) - 1.0))
    }

    /// Offsets inside a voxel, `per_axis` along each edge.
    fn inside(&self, per_axis: usize) -> Vec<DVec3> {
        let along = |n: usize| (n as f64 + 0.5) / per_axis as f64 - 0.5;
        (0..per_axis.pow(3))
            .map(|n| DVec3::new(along(n % per_axis), along(n / per_axis % per_axis), along(n / per_axis / per_axis)))
            .map(|offset| self.lps_from_voxel.matrix3 * offset)
            .collect()
    }

    /// Offsets in the plane of a slice, as `slice_profile` has them along its normal.
    fn seen_along_slices(&self) -> Vec<DVec3> {
        // Middles of seven equal parts of a Gaussian, spread to its variance.
        const SEVENTHS: [f64; 7] = [-1.608, -0.8685, -0.4017, 0.0, 0.4017, 0.8685, 1.608];
        let blurs: &[f64] = if self.plane_blur_mm > 0.0 { &SEVENTHS } else { &[0.0] };
        let [across, down] = [0, 1].map(|axis| {
            let side_mm = self.lps_from_voxel.matrix3.col(axis).length();
            let along = |n: usize| (n as f64 + 0.5) / 4.0 - 0.5;
            let blurred = |n: usize| blurs.iter().map(move |z| along(n) + z * self.plane_blur_mm / side_mm);
            (0..4).flat_map(blurred).collect::<Vec<f64>>()
        });
        let plane = down.iter().flat_map(|y| across.iter().map(move |x| DVec3::new(*x, *y, 0.0)));
        plane
            .flat_map(|offset| self.slice_profile.iter().map(move |z| offset.with_z(*z)))
            .map(|offset| self.lps_from_voxel.matrix3 * offset)
            .collect()
    }

    /// A ball of `contrast_hu` above what is there.
    pub fn ball(&mut self, centre: DVec3, radius_mm: f64, contrast_hu: f64) {
        let step = radius_mm / 10.0;
        let cloud: Vec<DVec3> =
            lattice(DVec3::splat(-radius_mm), DVec3::splat(radius_mm), step).filter(|p| p.length() <= radius_mm).collect();
        // Normalised to the ball's volume, which the cloud's cubes have only nearly.
        let volume = 4.0 / 3.0 * std::f64::consts::PI * radius_mm.powi(3);
        let reach = radius_mm + 5.0 * self.blur_mm;
        let along = |n: usize| n as f64 * 0.02;
        let gauss = |d: DVec3| (-0.5 * d.length_squared() / (self.blur_mm * self.blur_mm)).exp();
        let scale = volume / cloud.len() as f64 / (std::f64::consts::TAU.sqrt() * self.blur_mm).powi(3);
        let profile: Vec<f64> = (0..=(reach / 0.02) as usize + 2)
            .map(|n| scale * cloud.iter().map(|p| gauss(*p - DVec3::new(along(n), 0.0, 0.0))).sum::<f64>())
            .collect();
        let share = |d: f64| {
            let at = d / 0.02;
            let n = at as usize;
            let (Some(a), Some(b)) = (profile.get(n), profile.get(n + 1)) else { return 0.0 };
            a + (b - a) * at.fract()
        };
        let inside = if self.slice_profile.is_empty() { self.inside(5) } else { self.seen_along_slices() };
        let longest = self.slice_profile.iter().fold(1.0f64, |most, z| most.max(2.0 * z.abs()));
        let far = reach
            + 2.5 * self.plane_blur_mm
            + longest * self.lps_from_voxel.matrix3.to_cols_array().iter().map(|x| x * x).sum::<f64>().sqrt();
        for index in 0..self.hu.len() {
            let away = self.place(index) - centre;
            if away.length_squared() < far * far {
                self.hu[index] +=
                    contrast_hu * inside.iter().map(|o| share((away + *o).length())).sum::<f64>() / inside.len() as f64;
            }
        }
    }

    /// Any body inside a box, of `contrast_hu` above what is there.
    pub fn body(&mut self, low: DVec3, high: DVec3, contrast_hu: f64, is_in: impl Fn(DVec3) -> bool) {
        const STEP: f64 = 0.3;
        let scale = contrast_hu * STEP.powi(3) / (std::f64::consts::TAU.sqrt() * self.blur_mm).powi(3);
        let cloud: Vec<DVec3> = lattice(low, high, STEP).filter(|p| is_in(*p)).collect();
        let voxel_from_lps = self.lps_from_voxel.inverse();
        let sides_mm = [0, 1, 2].map(|axis| self.lps_from_voxel.matrix3.col(axis).length());
        let reach = 4.0 * self.blur_mm + 1.5;
        for point in cloud {
            let at = voxel_from_lps.transform_point3(point);
            // The Gaussian and a voxel's inside are products of what they are along its sides.
            let along = |axis: usize| {
                let half = (reach / sides_mm[axis]).ceil();
                let [from, to] =
                    [-half, half + 1.0].map(|off| (at[axis].round() + off).clamp(0.0, self.size[axis] as f64) as usize);
                let gauss = |voxels: f64| (-0.5 * (voxels * sides_mm[axis] / self.blur_mm).powi(2)).exp();
                let mean = |n: usize| {
                    let away = n as f64 - at[axis];
                    (gauss(away - 1.0 / 3.0) + gauss(away) + gauss(away + 1.0 / 3.0)) / 3.0
                };
                (from..to).map(|n| (n, mean(n))).collect::<Vec<(usize, f64)>>()
            };
            let [across, down, through] = [0, 1, 2].map(along);
            for (k, by_k) in &through {
                for (j, by_j) in &down {
                    for (i, by_i) in &across {
                        self.hu[i + self.size[0] * (j + self.size[1] * k)] += scale * by_i * by_j * by_k;
                    }
                }
            }
        }
    }

    /// A rod with round ends.
    pub fn rod(&mut self, from: DVec3, to: DVec3, radius_mm: f64, contrast_hu: f64) {
        let (low, high) = (from.min(to) - radius_mm, from.max(to) + radius_mm);
        let along = to - from;
        self.body(low, high, contrast_hu, |p| {
            let t = ((p - from).dot(along) / along.length_squared()).clamp(0.0, 1.0);
            (p - from - along * t).length() <= radius_mm
        });
    }

    /// With noise, clipped, rounded, as stored.
    pub fn stored(&self, noise_hu: f64, clip_hu: f64, luck: &mut Luck) -> Vec<f32> {
        self.hu.iter().map(|hu| (hu + noise_hu * luck.normal()).clamp(-1024.0, clip_hu).round() as f32).collect()
    }
}

fn lattice(low: DVec3, high: DVec3, step: f64) -> impl Iterator<Item = DVec3> {
    let count = ((high - low) / step).ceil();
    let [nx, ny, nz] = count.to_array().map(|n| n as usize);
    let start = 0.5 * (low + high) - 0.5 * step * (count - 1.0);
    (0..nx * ny * nz).map(move |n| start + step * DVec3::new((n % nx) as f64, (n / nx % ny) as f64, (n / nx / ny) as f64))
}
