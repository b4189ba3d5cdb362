//! Total variation and its derivatives from an explicit list of differences.

/// Forward differences of a `size` grid as (pixel, its right or lower neighbour): none crosses the border.
pub fn differences(size: (usize, usize)) -> Vec<(usize, usize)> {
    let at = |x, y| y * size.0 + x;
    let right = (0..size.1).flat_map(|y| (1..size.0).map(move |x| (at(x - 1, y), at(x, y))));
    let down = (1..size.1).flat_map(|y| (0..size.0).map(move |x| (at(x, y - 1), at(x, y))));
    right.chain(down).collect()
}

/// √(Σ_c |D u_c|² + ε²) of each pixel.
pub fn lengths(log: &[Vec<f64>; 3], epsilon: f64, size: (usize, usize)) -> Vec<f64> {
    let mut squared = vec![epsilon * epsilon; size.0 * size.1];
    for (i, j) in differences(size) {
        for u in log {
            squared[i] += (u[j] - u[i]).powi(2);
        }
    }
    squared.into_iter().map(f64::sqrt).collect()
}

/// Dᵀ w D as (row, column, value), `w` by the pixel whose forward differences it weighs.
pub fn smoothness(edge: &[f64], size: (usize, usize)) -> Vec<(usize, usize, f64)> {
    differences(size).into_iter().flat_map(|(i, j)| [(i, i, edge[i]), (j, j, edge[i]), (i, j, -edge[i]), (j, i, -edge[i])]).collect()
}

/// A matrix of (row, column, value) times a vector.
pub fn apply(entries: &[(usize, usize, f64)], x: &[f64]) -> Vec<f64> {
    let mut y = vec![0.0; x.len()];
    for &(i, j, v) in entries {
        y[i] += v * x[j];
    }
    y
}

/// Its diagonal.
pub fn diagonal(entries: &[(usize, usize, f64)], n: usize) -> Vec<f64> {
    let mut d = vec![0.0; n];
    for &(i, j, v) in entries {
        if i == j {
            d[i] += v;
        }
    }
    d
}
