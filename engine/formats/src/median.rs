/// Returns the upper median, or `None` without values.
pub fn median(values: impl IntoIterator<Item = f64>) -> Option<f64> {
    let mut values: Vec<f64> = values.into_iter().collect();
    let middle = values.len() / 2;
    (!values.is_empty()).then(|| *values.select_nth_unstable_by(middle, f64::total_cmp).1)
}

#[cfg(test)]
mod tests {
    use super::median;

    #[test]
    fn of_an_even_number_the_upper_one() {
        let medians = [&[][..], &[3.0], &[4.0, 1.0], &[2.0, 9.0, 1.0]].map(|values| median(values.iter().copied()));
        assert_eq!(medians, [None, Some(3.0), Some(4.0), Some(2.0)]);
    }
}
