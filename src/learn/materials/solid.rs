//! A closed surface of triangles as voxels.

use glam::DVec3;

/// Which voxels of a grid at the origin lie inside the surface, i fastest: those whose centre a ray along z has crossed it an odd number of
/// times before.
pub(super) fn inside(triangles_mm: &[[DVec3; 3]], size: [usize; 3], spacing_mm: [f64; 3]) -> Vec<bool> {
    let [width, height, depth] = size;
    let [dx, dy, dz] = spacing_mm;
    let mut crossings: Vec<Vec<f32>> = vec![Vec::new(); width * height];
    for [a, b, c] in triangles_mm {
        let low = a.min(*b).min(*c);
        let high = a.max(*b).max(*c);
        let range = |low: f64, high: f64, step: f64, count: usize| {
            let first = (low / step).ceil().max(0.0) as usize;
            let end = ((high / step).floor() + 1.0).clamp(0.0, count as f64) as usize;
            first..end
        };
        let area = (*b - *a).truncate().perp_dot((*c - *a).truncate());
        if area == 0.0 {
            continue;
        }
        for j in range(low.y, high.y, dy, height) {
            for i in range(low.x, high.x, dx, width) {
                let p = glam::DVec2::new(i as f64 * dx, j as f64 * dy);
                let share = |from: DVec3, to: DVec3| (to.truncate() - from.truncate()).perp_dot(p - from.truncate()) / area;
                let (of_c, of_a) = (share(*a, *b), share(*b, *c));
                let of_b = 1.0 - of_a - of_c;
                if of_a >= 0.0 && of_b >= 0.0 && of_c >= 0.0 {
                    crossings[i + width * j].push((of_a * a.z + of_b * b.z + of_c * c.z) as f32);
                }
            }
        }
    }
    let mut found = vec![false; width * height * depth];
    for (column, crossings) in crossings.iter_mut().enumerate() {
        crossings.sort_by(f32::total_cmp);
        for [enters, leaves] in crossings.as_chunks::<2>().0 {
            let first = (f64::from(*enters) / dz).ceil().max(0.0) as usize;
            let end = ((f64::from(*leaves) / dz).floor() + 1.0).clamp(0.0, depth as f64) as usize;
            (first..end).for_each(|k| found[column + width * height * k] = true);
        }
    }
    found
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_ball_of_triangles_is_a_ball_of_voxels() {
        let (centre, radius) = (DVec3::new(10.13, 9.47, 11.29), 7.0);
        let at = |ring: usize, turn: usize| {
            let (polar, around) = (ring as f64 * std::f64::consts::PI / 48.0, turn as f64 * std::f64::consts::TAU / 96.0);
            centre + radius * DVec3::new(polar.sin() * around.cos(), polar.sin() * around.sin(), polar.cos())
        };
        let mut triangles = Vec::new();
        for ring in 0..48 {
            for turn in 0..96 {
                let [a, b, c, d] = [at(ring, turn), at(ring + 1, turn), at(ring + 1, turn + 1), at(ring, turn + 1)];
                triangles.extend([[a, b, c], [a, c, d]]);
            }
        }
        let (size, spacing) = ([21, 20, 30], [1.0, 1.0, 0.8]);
        let found = inside(&triangles, size, spacing);
        let mut wrong = 0;
        for (index, found) in found.iter().enumerate() {
            let voxel = DVec3::new((index % 21) as f64, (index / 21 % 20) as f64, (index / 420) as f64 * 0.8);
            wrong += usize::from(*found != (voxel.distance(centre) < radius));
        }
        // Facets lie up to 0.02 mm below the sphere.
        assert!(wrong < 10, "{wrong} of {}", found.len());
        assert!(found.iter().filter(|inside| **inside).count() > 1500);
    }
}
