//! Sparse non-negative least squares over very many candidate poses (eq. 6): only poses that the gradient asks for enter.

use crate::nonnegative::coordinate_descent;
use crate::sampling::wide;

/// Candidate poses as a box of `shape` = (x, y, angle); index = (angle · ny + y) · nx + x.
pub(super) struct ActiveSet {
    pub shape: (usize, usize, usize),
    /// λ of the L1 term as a part of the largest entry of Aᵀb.
    pub lambda: f64,
    /// Standard deviation of what the start leaves of the target, per row: λ is at least what the gradient of such noise does not exceed among all
    /// candidates, `√(2 ln n)` times a column's length.
    pub noise: f64,
    pub rounds: usize,
}

impl ActiveSet {
    /// `target` is b, `gradient(r)` returns Aᵀr for all candidates, `column(candidate)` a column of A. Starts at `start`. Each round adds
    /// up to 16 local maxima of the gradient, solves for the active ones by coordinate descent and drops what became zero; stops when
    /// no candidate's gradient exceeds λ by more than a tenth.
    pub fn solve(
        &self,
        start: &[usize],
        target: &[f32],
        mut gradient: impl FnMut(&[f32]) -> Vec<f64>,
        column: impl Fn(usize) -> Vec<f32>,
    ) -> Vec<(usize, f64)> {
        let c_all = gradient(target);
        let largest = c_all.iter().fold(0.0f64, |m, v| m.max(*v));
        if largest <= 0.0 {
            return Vec::new();
        }
        let length = |id: usize| {
            let column = column(id);
            dot(&column, &column).sqrt()
        };
        let least = start.get(start.len() / 2).map_or(0.0, |&id| self.noise * (2.0 * (c_all.len() as f64).ln()).sqrt() * length(id));
        let lambda = (self.lambda * largest).max(least);
        let mut ids: Vec<usize> = Vec::new();
        let mut columns: Vec<Vec<f32>> = Vec::new();
        let mut gram: Vec<Vec<f64>> = Vec::new();
        let mut h: Vec<f64> = Vec::new();
        let mut incoming: Vec<usize> = if start.is_empty() { self.maxima(&c_all, lambda, &ids) } else { start.to_vec() };
        for _ in 0..self.rounds {
            let first = columns.len();
            columns.extend(incoming.iter().map(|&id| column(id)));
            ids.extend(&incoming);
            h.resize(ids.len(), 0.0);
            let products = wide(
                #[inline(always)]
                || products(&columns, first),
            );
            for (i, row) in gram.iter_mut().enumerate() {
                row.extend(products.iter().map(|p| p[i]));
            }
            gram.extend(products);
            let flat: Vec<f64> = gram.iter().flatten().copied().collect();
            let c: Vec<f64> = ids.iter().map(|&i| c_all[i]).collect();
            coordinate_descent(&flat, &c, lambda, &mut h, 200, 1e-4);
            let keep: Vec<bool> = h.iter().map(|v| *v > 0.0).collect();
            retain(&mut ids, &keep);
            retain(&mut columns, &keep);
            retain(&mut gram, &keep);
            for row in &mut gram {
                retain(row, &keep);
            }
            retain(&mut h, &keep);
            let mut residual = target.to_vec();
            for (a, weight) in columns.iter().zip(&h) {
                let weight = *weight as f32;
                for (r, v) in residual.iter_mut().zip(a) {
                    *r -= weight * v;
                }
            }
            let g = gradient(&residual);
            let most = g.iter().fold(0.0f64, |m, v| m.max(*v)) - lambda;
            if most < 0.1 * lambda {
                break;
            }
            incoming = self.maxima(&g, lambda, &ids);
            if incoming.is_empty() {
                break;
            }
        }
        ids.into_iter().zip(h).collect()
    }

    /// Up to 16 local maxima of `g` above λ and above a fifth of the best, best first.
    fn maxima(&self, g: &[f64], lambda: f64, active: &[usize]) -> Vec<usize> {
        let (nx, ny, na) = self.shape;
        let top = g.iter().fold(0.0f64, |m, v| m.max(*v)) - lambda;
        let at = |x: usize, y: usize, a: usize| g[(a * ny + y) * nx + x];
        let mut found: Vec<usize> = Vec::new();
        for a in 0..na {
            for y in 0..ny {
                for x in 0..nx {
                    let v = at(x, y, a);
                    if v - lambda <= 0.2 * top || v <= lambda {
                        continue;
                    }
                    let near = |c: usize, n: usize| c.saturating_sub(1)..=(c + 1).min(n - 1);
                    let peak = near(a, na).all(|k| near(y, ny).all(|j| near(x, nx).all(|i| at(i, j, k) <= v)));
                    let id = (a * ny + y) * nx + x;
                    if peak && !active.contains(&id) {
                        found.push(id);
                    }
                }
            }
        }
        found.sort_by(|i, j| g[*j].total_cmp(&g[*i]));
        found.truncate(16);
        found
    }
}

fn retain<T>(v: &mut Vec<T>, keep: &[bool]) {
    let mut i = 0;
    v.retain(|_| {
        i += 1;
        keep[i - 1]
    });
}

/// Inner products of each of `columns` from the one numbered `first` on with all of them. In blocks of rows, so that what the processor's caches
/// hold is used for all pairs.
#[inline(always)]
fn products(columns: &[Vec<f32>], first: usize) -> Vec<Vec<f64>> {
    let new = &columns[first..];
    let mut sums = vec![vec![0.0f64; columns.len()]; new.len()];
    for from in (0..new.first().map_or(0, Vec::len)).step_by(ROWS) {
        for (i, old) in columns.iter().enumerate() {
            let rows = from..(from + ROWS).min(old.len());
            for (sums, new) in sums.iter_mut().zip(new) {
                sums[i] += dot(&old[rows.clone()], &new[rows.clone()]);
            }
        }
    }
    sums
}

/// Rows of a block of [`products`].
const ROWS: usize = 1024;

/// Inner product with a few f32 lanes per f64 sum: fast, and exact enough for a Gram matrix of 10⁵ rows.
#[inline(always)]
fn dot(a: &[f32], b: &[f32]) -> f64 {
    a.chunks(64)
        .zip(b.chunks(64))
        .map(|(p, q)| {
            let mut lanes = [0.0f32; 8];
            for (x, y) in p.chunks(8).zip(q.chunks(8)) {
                for (l, (u, v)) in lanes.iter_mut().zip(x.iter().zip(y)) {
                    *l += u * v;
                }
            }
            f64::from(lanes.iter().sum::<f32>())
        })
        .sum()
}
