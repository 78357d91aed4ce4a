// A bounded set of disjoint intervals per ray; what does not fit is flagged, never dropped in silence.

const CAPACITY: u32 = 24u;

var<private> covered: array<vec2<f32>, 24>;
var<private> covered_count: u32 = 0u;
var<private> overflow: bool = false;

// Adds [span.x, span.y], merging what it touches.
fn insert(span: vec2<f32>) {
    if !(span.y > span.x) { return; }
    var first = 0u;
    while first < covered_count && covered[first].y < span.x { first += 1u; }
    var last = first;
    var merged = span;
    while last < covered_count && covered[last].x <= span.y {
        merged = vec2<f32>(min(merged.x, covered[last].x), max(merged.y, covered[last].y));
        last += 1u;
    }
    let removed = last - first;
    if removed == 0u {
        if covered_count == CAPACITY { overflow = true; return; }
        for (var i = covered_count; i > first; i -= 1u) { covered[i] = covered[i - 1u]; }
        covered_count += 1u;
    } else if removed > 1u {
        for (var i = last; i < covered_count; i += 1u) { covered[i - removed + 1u] = covered[i]; }
        covered_count -= removed - 1u;
    }
    covered[first] = merged;
}

// The first uncovered part of [span.x, span.y]; empty (x >= y) when there is none.
fn first_gap(span: vec2<f32>) -> vec2<f32> {
    var start = span.x;
    for (var i = 0u; i < covered_count; i += 1u) {
        let other = covered[i];
        if other.y <= start { continue; }
        if other.x > start { return vec2<f32>(start, min(other.x, span.y)); }
        start = other.y;
    }
    return vec2<f32>(start, span.y);
}
