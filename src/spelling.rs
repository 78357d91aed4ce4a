//! What somebody meant who wrote a name that is none.

/// Of `names` the one nearest to the lower-case `lower`, if one is near at all: part of it or the other way round, else two letters off.
pub fn nearest<'a>(lower: &str, names: impl Iterator<Item = &'a str>) -> Option<&'a str> {
    let names: Vec<&str> = names.collect();
    let contained = names.iter().find(|name| lower.len() >= 3 && (name.contains(lower) || lower.contains(*name)));
    contained.copied().or_else(|| {
        let best = names.iter().min_by_key(|name| edit_distance(lower, name))?;
        (edit_distance(lower, best) <= 2 && lower.len() > 3).then_some(*best)
    })
}

/// How many letters must be put in, left out or replaced to make one word of the other (Levenshtein 1966).
#[must_use]
pub fn edit_distance(a: &str, b: &str) -> usize {
    let mut row: Vec<usize> = (0..=b.len()).collect();
    for (i, x) in a.bytes().enumerate() {
        let mut diagonal = row[0];
        row[0] = i + 1;
        for (j, y) in b.bytes().enumerate() {
            let substituted = diagonal + usize::from(x != y);
            diagonal = row[j + 1];
            row[j + 1] = substituted.min(diagonal + 1).min(row[j] + 1);
        }
    }
    row[b.len()]
}
