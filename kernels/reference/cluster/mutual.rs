use super::nearest::nearest;

/// Returns the patch of each view nearest to each of `x [views * patches, width]`, by view.
pub fn nearest_by_view(x: &[f64], width: usize, patches: usize) -> Vec<Vec<u32>> {
    x.chunks(patches * width).map(|view| nearest(x, view, width)).collect()
}

/// Returns the tokens, fewest mutual nearest neighbors in earlier views first. Ties are in
/// bit-reversed order of their indices.
pub fn order(nearest: &[Vec<u32>], patches: usize) -> Vec<u32> {
    let neighbors = |token: usize| {
        let view = token / patches;
        let is_mutual = |other: &usize| {
            let neighbor = other * patches + nearest[*other][token] as usize;
            view * patches + nearest[view][neighbor] as usize == token
        };
        (0..view).filter(is_mutual).count()
    };
    let fraction = |token: usize| (0..32).map(|bit| (token >> bit & 1) as f64 * 0.5f64.powi(bit + 1)).sum::<f64>();
    let mut tokens: Vec<u32> = (0..(nearest.len() * patches) as u32).collect();
    let key = |token: u32| (neighbors(token as usize), fraction(token as usize));
    tokens.sort_by(|a, b| key(*a).partial_cmp(&key(*b)).expect("finite"));
    tokens
}
