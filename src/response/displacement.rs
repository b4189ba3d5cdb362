//! Where the scene lies in each frame, roughly: for shades, before anything is known that registration needs.

use super::shades::DARKEST;
use crate::exposure::Frame;
use crate::mask::CLIPPED;
use rayon::prelude::*;

/// A frame's longer side holds so many cells.
const CELLS: usize = 180;
/// Of large frames every so-manyth pixel is looked at, that a cell has about so many a side.
const SAMPLED: usize = 5;
/// Largest displacement from one frame to the next, in cells: an eighth of the longer side.
const REACH: isize = 22;
/// At least this part of the cells has to lie over each other and be exposed well in both.
const OVERLAP: f64 = 0.25;
/// What is left unexplained (1 - correlation) must fall to this part of what it is in place.
const WORTH_IT: f64 = 0.8;
/// Nothing is to be won where in place no more than this is left unexplained.
const IN_PLACE: f64 = 0.01;

/// Logarithms of the mean intensities of a frame's cells; NaN where one is clipped or black.
struct Thumbnail {
    columns: isize,
    rows: isize,
    values: Vec<f64>,
}

impl Thumbnail {
    fn new(frame: &Frame, cell: usize) -> Self {
        let planes = &frame.intensity.0;
        let (columns, rows) = (planes[0].width / cell, planes[0].height / cell);
        let stride = cell.div_ceil(SAMPLED);
        let one = |k: usize| {
            let (x0, y0) = (k % columns * cell, k / columns * cell);
            let (mut sum, mut n) = (0.0, 0.0);
            for y in (y0..y0 + cell).step_by(stride) {
                for x in (x0..x0 + cell).step_by(stride) {
                    for p in planes {
                        let z = p.at(x, y);
                        sum += if z < CLIPPED { f64::from(z) } else { f64::NAN };
                        n += 1.0;
                    }
                }
            }
            if sum / n > DARKEST { (sum / n).ln() } else { f64::NAN }
        };
        Self { columns: columns as isize, rows: rows as isize, values: (0..columns * rows).into_par_iter().map(one).collect() }
    }

    /// Correlation with `other` where the cell (x, y) of this one lies on (x + dx, y + dy) of the other; only every `step`th counts. `None` where too few do.
    fn correlation(&self, other: &Self, (dx, dy): (isize, isize), step: usize) -> Option<f64> {
        let [mut n, mut a1, mut b1, mut aa, mut bb, mut ab] = [0.0f64; 6];
        for y in (0.max(-dy)..self.rows.min(other.rows - dy)).step_by(step) {
            for x in (0.max(-dx)..self.columns.min(other.columns - dx)).step_by(step) {
                let a = self.values[(y * self.columns + x) as usize];
                let b = other.values[((y + dy) * other.columns + x + dx) as usize];
                if a.is_finite() && b.is_finite() {
                    n += 1.0;
                    a1 += a;
                    b1 += b;
                    aa += a * a;
                    bb += b * b;
                    ab += a * b;
                }
            }
        }
        let enough = OVERLAP * self.values.len() as f64 / (step * step) as f64;
        let (va, vb) = (n * aa - a1 * a1, n * bb - b1 * b1);
        (n > enough && va > 0.0 && vb > 0.0).then(|| (n * ab - a1 * b1) / (va * vb).sqrt())
    }

    /// Cells by which the scene lies farther right and down in `other`: translation alone, of the best correlation, which no exposure time and hardly a
    /// response changes.
    fn displacement(&self, other: &Self) -> (isize, isize) {
        let best = |list: Vec<(isize, isize)>, step: usize| {
            let found = list.into_par_iter().filter_map(|d| Some((self.correlation(other, d, step)?, d)));
            found.max_by(|a, b| a.0.total_cmp(&b.0).then(b.1.cmp(&a.1)))
        };
        let around = |c: (isize, isize), r: isize, step: usize| -> Vec<(isize, isize)> {
            (-r..=r).step_by(step).flat_map(|y| (-r..=r).step_by(step).map(move |x| (c.0 + x, c.1 + y))).collect()
        };
        let found = best(around((0, 0), REACH, 2), 2).and_then(|(_, d)| best(around(d, 2, 1), 1));
        let in_place = self.correlation(other, (0, 0), 1).unwrap_or(0.0);
        match found {
            Some((c, d)) if 1.0 - c < WORTH_IT * (1.0 - in_place) && 1.0 - in_place > IN_PLACE => d,
            _ => (0, 0),
        }
    }
}

/// Pixels by which the scene lies farther right and down in each of `frames` than in that of the shortest exposure time, to a cell (a 180th of the longer
/// side), rotation aside: each frame beside the one of the next shorter time, with which it shares most.
pub(super) fn displacements(frames: &[Frame]) -> Vec<(isize, isize)> {
    let mut out = vec![(0, 0); frames.len()];
    let mut order: Vec<usize> = (0..frames.len()).collect();
    order.sort_by(|&a, &b| frames[a].exposure_time.total_cmp(&frames[b].exposure_time));
    let Some((w, h)) = frames.first().map(|f| f.intensity.size()) else { return out };
    let cell = (w.max(h) / CELLS).max(1);
    let thumbnails: Vec<Thumbnail> = frames.iter().map(|f| Thumbnail::new(f, cell)).collect();
    for pair in order.windows(2) {
        let (dx, dy) = thumbnails[pair[0]].displacement(&thumbnails[pair[1]]);
        let (x, y) = out[pair[0]];
        out[pair[1]] = (x + dx * cell as isize, y + dy * cell as isize);
    }
    out
}
