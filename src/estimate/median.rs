//! What most values are like, whatever a few of them are.

/// The middle one of `values`, of an even number the upper; `None` where there are none.
pub fn median(values: impl IntoIterator<Item = f64>) -> Option<f64> {
    let mut values: Vec<f64> = values.into_iter().collect();
    let middle = values.len() / 2;
    (!values.is_empty()).then(|| *values.select_nth_unstable_by(middle, f64::total_cmp).1)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_median_is_one_of_the_values_and_of_two_the_upper() {
        assert_eq!(median([]), None);
        assert_eq!([median([3.0]), median([2.0, 1.0]), median([9.0, 1.0, 4.0])], [Some(3.0), Some(2.0), Some(4.0)]);
        assert_eq!(median([-1.0, f64::NAN, 7.0, 5.0]), Some(7.0), "what is no number is beyond all");
    }
}
