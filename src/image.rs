//! Images in memory: [`Plane`] (one `f32` channel, row-major) and [`Rgb`] (three planes of one size).

use crate::error::{Error, Result};
use rayon::prelude::*;

/// A choice of red, green and blue, at least one of them.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Channels([bool; 3]);

impl Channels {
    /// Red, green and blue.
    pub const ALL: Self = Self([true; 3]);

    /// Red, green and blue, one at a time.
    pub const EACH: [Self; 3] = [Self([true, false, false]), Self([false, true, false]), Self([false, false, true])];

    /// Every choice there is, all three first.
    pub fn choices() -> impl Iterator<Item = Self> {
        (1..8u8).rev().map(|bits| Self(std::array::from_fn(|c| bits & (4 >> c) != 0)))
    }

    /// Which of the channels 0, 1 and 2 are in it.
    pub fn indices(self) -> impl Iterator<Item = usize> {
        (0..3).filter(move |&c| self.0[c])
    }

    /// How many they are.
    pub fn count(self) -> usize {
        self.indices().count()
    }

    /// Their names.
    pub fn names(self) -> Vec<&'static str> {
        self.indices().map(|c| ["red", "green", "blue"][c]).collect()
    }
}

/// Values from which several threads share the work.
const LARGE: usize = 1 << 16;
/// Columns of a strip of [`Plane::box_sum`].
const STRIP: usize = 64;

/// One channel, `width * height` values, row-major, pixel centres at integers.
#[derive(Clone, Debug, PartialEq)]
pub struct Plane {
    /// Pixels per row.
    pub width: usize,
    /// Rows.
    pub height: usize,
    /// `width * height` values.
    pub data: Vec<f32>,
}

impl Plane {
    /// A plane of one value.
    pub fn filled(width: usize, height: usize, value: f32) -> Self {
        Self { width, height, data: vec![value; width * height] }
    }

    /// A plane whose value at (x, y) is `f(x, y)`, which several threads ask for where it is large.
    pub fn from_fn(width: usize, height: usize, f: impl Fn(usize, usize) -> f32 + Sync) -> Self {
        Self::from_rows(width, height, |y, row| row.iter_mut().enumerate().for_each(|(x, v)| *v = f(x, y)))
    }

    /// A plane whose rows `f` makes of rows of zeros, several threads at a time where it is large.
    pub fn from_rows(width: usize, height: usize, f: impl Fn(usize, &mut [f32]) + Sync) -> Self {
        let mut data = vec![0.0; width * height];
        let chunk = width.max(1);
        if data.len() < LARGE {
            data.chunks_exact_mut(chunk).enumerate().for_each(|(y, row)| f(y, row));
        } else {
            data.par_chunks_exact_mut(chunk).enumerate().for_each(|(y, row)| f(y, row));
        }
        Self { width, height, data }
    }

    /// A plane whose value at (x, y) is `f(x, y)`, called for one pixel after the other, row by row.
    pub fn in_order(width: usize, height: usize, mut f: impl FnMut(usize, usize) -> f32) -> Self {
        let data = (0..width * height).map(|p| f(p % width, p / width)).collect();
        Self { width, height, data }
    }

    /// Takes `data` as the pixels of a plane.
    ///
    /// # Errors
    /// [`Error::Input`] when `data` does not hold `width * height` values.
    pub fn from_vec(width: usize, height: usize, data: Vec<f32>) -> Result<Self> {
        if data.len() != width * height {
            return Err(Error::Input(format!("a {width} x {height} plane needs {} values, not {}", width * height, data.len())));
        }
        Ok(Self { width, height, data })
    }

    /// Value at (x, y).
    #[inline]
    pub fn at(&self, x: usize, y: usize) -> f32 {
        self.data[y * self.width + x]
    }

    /// The values of row `y`.
    #[inline]
    pub fn row(&self, y: usize) -> &[f32] {
        &self.data[y * self.width..(y + 1) * self.width]
    }

    /// Value at (x, y), the nearest pixel's outside the plane.
    #[inline]
    pub fn clamped(&self, x: isize, y: isize) -> f32 {
        self.at(x.clamp(0, self.width as isize - 1) as usize, y.clamp(0, self.height as isize - 1) as usize)
    }

    /// A new plane with `f` applied to each value.
    pub fn map(&self, f: impl Fn(f32) -> f32 + Sync) -> Self {
        Self::from_rows(self.width, self.height, |y, row| row.iter_mut().zip(self.row(y)).for_each(|(to, &v)| *to = f(v)))
    }

    /// A new plane with `f` applied to each pair of values.
    ///
    /// # Panics
    /// When the sizes differ.
    pub fn zip(&self, other: &Self, f: impl Fn(f32, f32) -> f32 + Sync) -> Self {
        assert_eq!(self.size(), other.size(), "planes of one size");
        Self::from_rows(self.width, self.height, |y, row| {
            row.iter_mut().zip(self.row(y)).zip(other.row(y)).for_each(|((to, &a), &b)| *to = f(a, b));
        })
    }

    /// (width, height).
    pub fn size(&self) -> (usize, usize) {
        (self.width, self.height)
    }

    /// The `width` x `height` part whose first pixel is (x, y).
    ///
    /// # Panics
    /// When the part leaves the plane.
    pub fn crop(&self, x: usize, y: usize, width: usize, height: usize) -> Self {
        assert!(x + width <= self.width && y + height <= self.height, "crop inside the plane");
        Self::from_fn(width, height, |i, j| self.at(x + i, y + j))
    }

    /// Half the size through the binomial filter [1 3 3 1]/8: means over squares let through what the coarser grid cannot hold, and no warp is
    /// true to that.
    #[must_use]
    pub fn halved(&self) -> Self {
        let (w, h) = (self.width / 2, self.height / 2);
        let f = [0.125f32, 0.375, 0.375, 0.125];
        let along = |x: usize, y: usize| (0..4).map(|k| f[k] * self.clamped(2 * x as isize + k as isize - 1, y as isize)).sum();
        let rows = Self::from_fn(w, self.height, along);
        Self::from_fn(w, h, |x, y| (0..4).map(|k| f[k] * rows.clamped(x as isize, 2 * y as isize + k as isize - 1)).sum())
    }

    /// Sums over squares of side 2 r + 1, clipped at the edges.
    pub fn box_sum(&self, r: usize) -> Self {
        let (w, h) = self.size();
        let rows = Self::from_rows(w, h, |y, out| {
            let row = self.row(y);
            let mut sum: f32 = row[..r.min(w)].iter().sum();
            for x in 0..w {
                if x + r < w {
                    sum += row[x + r];
                }
                out[x] = sum;
                if x >= r {
                    sum -= row[x - r];
                }
            }
        });
        // Strips of columns, each from the top down: a sum of its own in every column, whatever the number of threads.
        let strip = |n: usize| {
            let columns = n * STRIP..((n + 1) * STRIP).min(w);
            let mut out = Vec::with_capacity(h * columns.len());
            let mut sum = [0.0f32; STRIP];
            let row = |y: usize| &rows.row(y)[columns.clone()];
            for y in 0..r.min(h) {
                sum.iter_mut().zip(row(y)).for_each(|(s, v)| *s += v);
            }
            for y in 0..h {
                if y + r < h {
                    sum.iter_mut().zip(row(y + r)).for_each(|(s, v)| *s += v);
                }
                out.extend_from_slice(&sum[..columns.len()]);
                if y >= r {
                    sum.iter_mut().zip(row(y - r)).for_each(|(s, v)| *s -= v);
                }
            }
            out
        };
        let strips: Vec<Vec<f32>> = (0..w.div_ceil(STRIP)).into_par_iter().map(strip).collect();
        Self::from_rows(w, h, |y, out| {
            for (to, from) in out.chunks_mut(STRIP).zip(&strips) {
                to.copy_from_slice(&from[y * to.len()..(y + 1) * to.len()]);
            }
        })
    }

    /// The plane with `pad` more pixels on every side, each a copy of the nearest edge pixel.
    pub fn padded(&self, pad: usize) -> Self {
        Self::from_fn(self.width + 2 * pad, self.height + 2 * pad, |x, y| {
            self.clamped(x as isize - pad as isize, y as isize - pad as isize)
        })
    }
}

/// Three planes of one size: red, green, blue.
#[derive(Clone, Debug, PartialEq)]
pub struct Rgb(pub [Plane; 3]);

impl Rgb {
    /// Image of one value in all channels.
    pub fn filled(width: usize, height: usize, value: f32) -> Self {
        Self(std::array::from_fn(|_| Plane::filled(width, height, value)))
    }

    /// (width, height).
    pub fn size(&self) -> (usize, usize) {
        self.0[0].size()
    }

    /// Pixels per row.
    pub fn width(&self) -> usize {
        self.0[0].width
    }

    /// Rows.
    pub fn height(&self) -> usize {
        self.0[0].height
    }

    /// `f` applied to each plane.
    pub fn map_planes(&self, mut f: impl FnMut(&Plane) -> Plane) -> Self {
        Self(std::array::from_fn(|c| f(&self.0[c])))
    }

    /// The `width` x `height` part whose first pixel is (x, y).
    ///
    /// # Panics
    /// When the part leaves the image.
    pub fn crop(&self, x: usize, y: usize, width: usize, height: usize) -> Self {
        self.map_planes(|p| p.crop(x, y, width, height))
    }

    /// Mean of the three channels.
    pub fn mean(&self) -> Plane {
        self.mean_of(Channels::ALL)
    }

    /// Mean of the given channels.
    pub fn mean_of(&self, channels: Channels) -> Plane {
        self.weighted(channels, [1.0; 3]).map(|v| v / channels.count() as f32)
    }

    /// Sum of the given channels, each times its weight.
    pub fn weighted(&self, channels: Channels, weights: [f32; 3]) -> Plane {
        Plane::from_rows(self.width(), self.height(), |y, row| {
            for c in channels.indices() {
                row.iter_mut().zip(self.0[c].row(y)).for_each(|(to, v)| *to += weights[c] * v);
            }
        })
    }

    /// Interleaved `[r, g, b]` of pixel `i` (row-major).
    pub fn pixel(&self, i: usize) -> [f32; 3] {
        std::array::from_fn(|c| self.0[c].data[i])
    }
}
