//! Two-dimensional real Fourier transforms, for correlations over whole frames.

use realfft::num_complex::Complex;
use realfft::{ComplexToReal, RealFftPlanner, RealToComplex};
use rustfft::{Fft, FftPlanner};
use std::sync::Arc;

/// Transforms of one size.
pub(crate) struct Fft2 {
    pub(crate) width: usize,
    pub(crate) height: usize,
    rows: Arc<dyn RealToComplex<f32>>,
    rows_back: Arc<dyn ComplexToReal<f32>>,
    columns: Arc<dyn Fft<f32>>,
    columns_back: Arc<dyn Fft<f32>>,
}

/// The next size without prime factors above 5, even.
fn smooth(mut n: usize) -> usize {
    n = n.max(2).next_multiple_of(2);
    loop {
        let mut m = n;
        for p in [2, 3, 5] {
            while m.is_multiple_of(p) {
                m /= p;
            }
        }
        if m == 1 {
            return n;
        }
        n += 2;
    }
}

/// Half spectrum, transposed: column-major so that column transforms are contiguous.
pub(crate) type Spectrum = Vec<Complex<f32>>;

impl Fft2 {
    /// Transforms of at least this size.
    pub(crate) fn new(width: usize, height: usize) -> Self {
        let (width, height) = (smooth(width), smooth(height));
        let (mut real, mut complex) = (RealFftPlanner::new(), FftPlanner::new());
        Self {
            width,
            height,
            rows: real.plan_fft_forward(width),
            rows_back: real.plan_fft_inverse(width),
            columns: complex.plan_fft_forward(height),
            columns_back: complex.plan_fft_inverse(height),
        }
    }

    /// Spectrum of a `w`-wide image at the origin, zero elsewhere.
    pub(crate) fn forward(&self, image: &[f32], w: usize) -> Spectrum {
        let half = self.width / 2 + 1;
        let mut out = vec![Complex::default(); half * self.height];
        let mut line = vec![0.0; self.width];
        let mut spectrum = self.rows.make_output_vec();
        for (y, row) in image.chunks_exact(w).enumerate() {
            line[..w].copy_from_slice(row);
            line[w..].fill(0.0);
            self.rows.process(&mut line, &mut spectrum).expect("buffers have the planned lengths");
            for (x, v) in spectrum.iter().enumerate() {
                out[x * self.height + y] = *v;
            }
        }
        self.columns.process(&mut out);
        out
    }

    /// Real image of a spectrum, `width * height` values, scaled so that it undoes [`Fft2::forward`].
    pub(crate) fn inverse(&self, mut spectrum: Spectrum) -> Vec<f32> {
        let half = self.width / 2 + 1;
        self.columns_back.process(&mut spectrum);
        let scale = 1.0 / (self.width * self.height) as f32;
        let mut out = vec![0.0; self.width * self.height];
        let mut line = vec![Complex::default(); half];
        for (y, row) in out.chunks_exact_mut(self.width).enumerate() {
            for (x, v) in line.iter_mut().enumerate() {
                *v = spectrum[x * self.height + y] * scale;
            }
            // A real image's spectrum is real at both ends; rounding leaves a trace that the transform refuses.
            line[0].im = 0.0;
            line[half - 1].im = 0.0;
            self.rows_back.process(&mut line, row).expect("buffers have the planned lengths");
        }
        out
    }
}
