// Where a line p + q t runs inside simple shapes: from and to, empty where the end is not beyond the start.

const FAR: f32 = 1e30;

// The point of closest approach comes first, so that the discriminant loses nothing to the distance.
fn quadric(p: vec3<f32>, q: vec3<f32>, radius: f32) -> vec2<f32> {
    let qq = dot(q, q);
    if qq <= 0.0 {
        return select(vec2<f32>(FAR, -FAR), vec2<f32>(-FAR, FAR), dot(p, p) < radius * radius);
    }
    let middle = -dot(p, q) / qq;
    let nearest = p + q * middle;
    let discriminant = radius * radius - dot(nearest, nearest);
    if !(discriminant > 0.0) { return vec2<f32>(FAR, -FAR); }
    let half = sqrt(discriminant / qq);
    return vec2<f32>(middle - half, middle + half);
}

fn slab(p: f32, q: f32, lo: f32, hi: f32) -> vec2<f32> {
    if q == 0.0 {
        return select(vec2<f32>(FAR, -FAR), vec2<f32>(-FAR, FAR), p >= lo && p <= hi);
    }
    let a = (lo - p) / q;
    let b = (hi - p) / q;
    return vec2<f32>(min(a, b), max(a, b));
}

fn meet(a: vec2<f32>, b: vec2<f32>) -> vec2<f32> {
    return vec2<f32>(max(a.x, b.x), min(a.y, b.y));
}

fn cuboid(p: vec3<f32>, q: vec3<f32>, lo: vec3<f32>, hi: vec3<f32>) -> vec2<f32> {
    return meet(meet(slab(p.x, q.x, lo.x, hi.x), slab(p.y, q.y, lo.y, hi.y)), slab(p.z, q.z, lo.z, hi.z));
}
