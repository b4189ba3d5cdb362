//! Weights, residuals, smoothness, conjugate gradients, sums: each kernel entry by entry. K and Kᵀ are in `adjoint`.
//!
//! Tolerances count roundings of 2⁻²⁴: a sum of n terms by tree and stride carries at most (14 + n / 128) of them on the
//! sum of absolute values.

use crate::oracle::data::{self, Pixel};
use crate::oracle::linear;
use crate::oracle::solver::advance;
use crate::support::gpu::{POISON, buffer, gpu, kernels, planes, poisoned, read, run};
use crate::support::{assert_close, f64s, noise, uniform};
use unshaken::gpu::{Step, grid_1d};
use unshaken::kernels::{
    Kernels, Misfit, MisfitSource, NOISE_STEPS, SCALARS, SLOT_CURVATURE, SLOT_DATA, SLOT_ENERGY, SLOT_SMOOTHNESS, SLOTS, UNSEEN,
    WeightTarget, partials_1d, partials_2d,
};

const HALF_ULP: f64 = 1.0 / (1u64 << 24) as f64;
const SIZES: [(usize, usize); 8] = [(1, 1), (1, 7), (7, 1), (17, 9), (16, 8), (33, 65), (300, 5), (6001, 3)];
/// Around a workgroup, around a workgroup of workgroups.
const COUNTS: [usize; 9] = [1, 2, 127, 128, 129, 1000, 16383, 16384, 16500];
/// More values than one row of workgroups (4096 of 1024) holds.
const MANY: usize = 4096 * 1024 + 1003;

fn k() -> &'static Kernels {
    kernels()
}

/// Bound of the error of a sum of these terms, each itself within `each` roundings.
fn sum_tolerance(terms: &[f64], each: f64) -> f64 {
    HALF_ULP * (14.0 + terms.len() as f64 / 128.0 + each) * terms.iter().map(|t| t.abs()).sum::<f64>()
}

/// Sum of `count` partial sums that begin at `first` of `partials`; what lies before and behind must be untouched.
#[track_caller]
fn assert_partials(what: &str, partials: &[f32], first: usize, count: usize, terms: &[f64], each: f64) {
    assert!(partials[..first].iter().chain(&partials[first + count..]).all(|&v| v == POISON), "{what}: writes beyond its partial sums");
    let got: f64 = f64s(&partials[first..first + count]).iter().sum();
    let (expected, tolerance) = (terms.iter().sum::<f64>(), sum_tolerance(terms, each));
    assert!((got - expected).abs() <= tolerance, "{what}: sum {got}, expected {expected} within {tolerance:e}");
}

// Vectors.

#[test]
fn rows_of_workgroups_cover_every_count() {
    for (count, grid) in [(0, (1, 1)), (1, (1, 1)), (128, (1, 1)), (129, (2, 1)), (4096 * 128, (4096, 1)), (4096 * 128 + 1, (4096, 2))] {
        assert_eq!(grid_1d(count), grid, "{count}");
    }
}

fn check_multiply(count: usize) {
    let (a, b) = (noise(1, count + 3), noise(2, count + 3));
    let values = buffer(&b);
    run(&k().linear.multiply(gpu(), &buffer(&a), &values, count));
    // One product: correctly rounded. The last three values are not the kernel's.
    let expected: Vec<f64> = (0..count + 3).map(|i| f64::from(b[i]) * if i < count { f64::from(a[i]) } else { 1.0 }).collect();
    assert_close(&format!("multiply {count}"), &read(&values, count + 3), &expected, |i| HALF_ULP * expected[i].abs());
}

#[test]
fn multiply() {
    COUNTS.into_iter().for_each(check_multiply);
}

#[test]
fn scale() {
    for count in COUNTS {
        let (e, p, w) = (uniform(1, count, 0.1, 9.0), noise(2, count), uniform(3, count, 0.0, 50.0));
        let (scaled, back) = (poisoned(count + 3), poisoned(count + 3));
        run(&k().linear.scale(gpu(), &buffer(&e), &buffer(&p), &buffer(&w), &scaled, &back, count));
        let t: Vec<f64> = (0..count).map(|i| f64::from(e[i]) * f64::from(p[i])).collect();
        let wt: Vec<f64> = (0..count).map(|i| f64::from(w[i]) * t[i]).collect();
        for (what, buffer, expected) in [("E p", &scaled, &t), ("W E p", &back, &wt)] {
            let got = read(buffer, count + 3);
            assert_close(&format!("{what} {count}"), &got[..count], expected, |i| 2.0 * HALF_ULP * expected[i].abs() + 1e-38);
            assert_eq!(got[count..], [POISON; 3], "{what} {count}: writes beyond its end");
        }
    }
}

fn check_update(count: usize) {
    // A pixel at most quadruples or falls to 1 / e; twelve decades of irradiance, of which a few lie below the darkest.
    let (old, x, darkest) =
        (uniform(1, count, -14.0, 14.0).iter().map(|u| u.exp()).collect::<Vec<f32>>(), uniform(2, count, -6.0, 6.0), 2e-6f32);
    for step in [1.0, 0.25, 0.0f32] {
        let irradiance = poisoned(count + 3);
        run(&k().linear.update(gpu(), &buffer(&old), &buffer(&x), &irradiance, step, darkest, count));
        let advanced = |i: usize| advance(f64::from(old[i]).ln(), f64::from(step) * f64::from(x[i])).exp();
        let e: Vec<f64> = (0..count).map(|i| advanced(i).max(f64::from(darkest))).collect();
        let got = read(&irradiance, count + 3);
        // WGSL grants exp 3 + 2 |x| units in the last place, and |x| is 1 at most; two products and a sum.
        assert_close(&format!("E, step {step}"), &got[..count], &e, |i| 2.0 * HALF_ULP * 8.0 * e[i]);
        assert_eq!(got[count..], [POISON; 3], "E: writes beyond its end");
    }
}

#[test]
fn update() {
    COUNTS.into_iter().for_each(check_update);
}

// Data term.

fn check_residual(count: usize) {
    let (predicted, mut weight, b) = (uniform(1, count, 0.0, 4.0), uniform(2, count, 0.0, 900.0), uniform(3, count, 0.0, 4.0));
    // Masked pixels have W = 0 and W B = 0.
    weight.iter_mut().step_by(5).for_each(|w| *w = 0.0);
    let observation: Vec<f32> = weight.iter().zip(&b).map(|(w, b)| w * b).collect();
    let (first, n) = (7, partials_1d(gpu(), count));
    let (out, partials) = (poisoned(count + 3), poisoned(first + n + 3));
    run(&k().data.residual(gpu(), &buffer(&predicted), &buffer(&weight), &buffer(&observation), &out, &partials, first, count));
    let product = |i: usize| f64::from(weight[i]) * f64::from(predicted[i]);
    let r: Vec<f64> = (0..count).map(|i| f64::from(observation[i]) - product(i)).collect();
    let tolerance = |i: usize| 2.0 * HALF_ULP * (f64::from(observation[i]) + product(i));
    let got = read(&out, count + 3);
    assert_close(&format!("residual {count}"), &got[..count], &r, tolerance);
    assert_eq!(got[count..], [POISON; 3], "residual {count}: writes beyond its end");
    // The terms of what the kernel itself found as residual: its rounding is judged above.
    let terms: Vec<f64> =
        (0..count).map(|i| if weight[i] > 0.0 { 0.5 * f64::from(got[i]).powi(2) / f64::from(weight[i]) } else { 0.0 }).collect();
    assert_partials(&format!("data term {count}"), &read(&partials, first + n + 3), first, n, &terms, 4.0);
}

#[test]
fn residual() {
    COUNTS.into_iter().for_each(check_residual);
}

/// Noise curves that differ by channel: shot and read noise, and a hump as a response's slope makes it.
fn curves() -> [Vec<f32>; 3] {
    std::array::from_fn(|c| {
        let (read, shot) = (0.004 + 0.001 * c as f32, 0.0004 * (c + 1) as f32);
        (0..NOISE_STEPS)
            .map(|i| {
                let s = i as f32 / (NOISE_STEPS - 1) as f32;
                (read * read + shot * s * s).sqrt() * (1.0 + 0.3 * (9.0 * s + c as f32).sin())
            })
            .collect()
    })
}

/// One frame of `size` inside predictions with `offset` pixels on every side.
struct Frame {
    size: (usize, usize),
    offset: usize,
    predicted: [Vec<f32>; 3],
    exposure: [Vec<f32>; 3],
    /// Where the channel counts.
    seen: [Vec<bool>; 3],
    mask: Vec<f32>,
    noise: [Vec<f32>; 3],
    time: f32,
    black_clipped: bool,
}

impl Frame {
    fn new(size: (usize, usize), offset: usize, black_clipped: bool) -> Self {
        let (n, m) = ((size.0 + 2 * offset) * (size.1 + 2 * offset), size.0 * size.1);
        // Predictions below 0 (a cubic's undershoot), at black, and above white.
        let predicted = std::array::from_fn(|c| {
            let mut p = uniform(20 + c as u64, n, -0.2, 2.6);
            p.iter_mut().skip(c).step_by(3).for_each(|v| *v *= 0.02);
            p
        });
        let time = 0.5f32;
        let noise = curves();
        let stride = size.0 + 2 * offset;
        let exposure = std::array::from_fn(|c| {
            let jitter = crate::support::noise(30 + c as u64, m);
            let at = |i: usize| (i / size.0 + offset) * stride + i % size.0 + offset;
            let p: &[f32] = &(&predicted as &[Vec<f32>; 3])[c];
            (0..m).map(|i| (p[at(i)] * time + 0.02 * jitter[i]).clamp(0.0, 1.0)).collect()
        });
        let mut mask = uniform(40, m, 0.05, 1.0);
        mask.iter_mut().step_by(4).for_each(|v| *v = 0.0);
        let seen = std::array::from_fn(|c| uniform(50 + c as u64, m, 0.0, 1.0).iter().map(|&v| v > 0.3).collect());
        Self { size, offset, predicted, exposure, seen, mask, noise, time, black_clipped }
    }

    fn stride(&self) -> usize {
        self.size.0 + 2 * self.offset
    }

    /// Index of frame pixel `i` in the prediction.
    fn at(&self, i: usize) -> usize {
        (i / self.size.0 + self.offset) * self.stride() + i % self.size.0 + self.offset
    }

    fn pixel(&self, c: usize, i: usize) -> Pixel<'_> {
        Pixel {
            predicted: f64::from(self.predicted[c][self.at(i)]),
            exposure: self.seen[c][i].then_some(f64::from(self.exposure[c][i])),
            mask: f64::from(self.mask[i]),
            exposure_time: f64::from(self.time),
            black_clipped: self.black_clipped,
            noise: &self.noise[c],
        }
    }

    /// Calls `f` with each channel of the frame on the device.
    fn on_device(&self, mut f: impl FnMut(usize, &MisfitSource)) {
        let marked = |c: usize| self.exposure[c].iter().zip(&self.seen[c]).map(|(&x, &seen)| if seen { x } else { UNSEEN }).collect();
        let (predicted, exposure, mask) = (planes(&self.predicted), planes(&[0, 1, 2].map(marked)), buffer(&self.mask));
        for c in 0..3 {
            f(
                c,
                &MisfitSource {
                    size: self.size,
                    predicted: &predicted[c],
                    predicted_offset: self.offset,
                    predicted_size: (self.stride(), self.size.1 + 2 * self.offset),
                    exposure: &exposure[c],
                    mask: &mask,
                    exposure_time: self.time,
                    black_clipped: self.black_clipped,
                    noise: &self.noise[c],
                },
            );
        }
    }
}

fn misfit(count: usize) -> Misfit {
    Misfit { sum: poisoned(count + 2), counted: poisoned(count + 2) }
}

/// The first `count` values of both planes; what lies behind must be untouched.
fn read_misfit(misfit: &Misfit, count: usize) -> [Vec<f32>; 2] {
    [&misfit.sum, &misfit.counted].map(|plane| {
        let got = read(plane, count + 2);
        assert_eq!(got[count..], [POISON; 2], "writes beyond its end");
        got[..count].to_vec()
    })
}

const FRAMES: [((usize, usize), usize); 7] =
    [((1, 1), 0), ((1, 7), 2), ((7, 1), 0), ((17, 9), 5), ((16, 8), 0), ((33, 65), 1), ((6001, 3), 3)];

#[test]
fn misfit_of_each_pixel() {
    for (size, offset) in FRAMES {
        for black_clipped in [false, true] {
            let (frame, m) = (Frame::new(size, offset, black_clipped), size.0 * size.1);
            let out = misfit(m);
            frame.on_device(|c, source| run(&k().data.misfit(gpu(), source, &out, c > 0)));
            let (mut expected, mut tolerance) = ([Vec::new(), Vec::new()], Vec::new());
            for i in 0..m {
                let valid = f64::from(u8::from(frame.mask[i] > 0.0));
                let chi = [0, 1, 2].map(|c| frame.pixel(c, i).chi_squared());
                let sum = valid * chi.iter().map(|c| c.0).sum::<f64>() / 3.0;
                expected[0].push(sum);
                expected[1].push(valid * frame.seen.iter().filter(|s| s[i]).count() as f64 / 3.0);
                tolerance.push(valid * chi.iter().map(|c| c.1).sum::<f64>() / 3.0 + 3.0 * HALF_ULP * sum);
            }
            let [sum, counted] = read_misfit(&out, m);
            assert_close(&format!("misfit {size:?}, clipped {black_clipped}"), &sum, &expected[0], |i| tolerance[i]);
            assert_close(&format!("pixels {size:?}, clipped {black_clipped}"), &counted, &expected[1], |_| 2.0 * HALF_ULP);
        }
    }
}

#[test]
fn local_misfit_is_the_gaussian_sum_of_the_misfit() {
    for (size, offset) in FRAMES {
        let (frame, m) = (Frame::new(size, offset, true), size.0 * size.1);
        let (out, scratch) = (misfit(m), misfit(m));
        frame.on_device(|c, source| run(&k().data.misfit(gpu(), source, &out, c > 0)));
        let raw = read_misfit(&out, m);
        run(&k().data.local(gpu(), &out, &scratch, size));
        let pairs: Vec<[f64; 2]> = raw[0].iter().zip(&raw[1]).map(|(&a, &b)| [f64::from(a), f64::from(b)]).collect();
        let expected = data::gauss(&pairs, size, 2.0);
        for (k, got) in read_misfit(&out, m).iter().enumerate() {
            let expected: Vec<f64> = expected.iter().map(|p| p[k]).collect();
            // Two passes of 13 positive terms, exp good to a few units, products.
            assert_close(&format!("gauss {size:?}"), got, &expected, |i| 2.0 * (13.0 + 8.0) * HALF_ULP * expected[i] + 1e-9);
        }
    }
}

#[test]
fn weights_and_weighted_observations() {
    for (n, (size, offset)) in FRAMES.into_iter().enumerate() {
        for (black_clipped, robust, accumulate) in [(false, 0.0, false), (true, 2.0, true), (false, 0.7, true), (true, 0.0, false)] {
            let (frame, m) = (Frame::new(size, offset, black_clipped), size.0 * size.1);
            // The output's grid is another one than the prediction's.
            let margin = 3 - n % 3;
            let (stride, rows) = (size.0 + 2 * margin, size.1 + 2 * margin);
            let start: [Vec<f32>; 2] =
                if accumulate { [1, 2].map(|s| uniform(s, stride * rows, 0.0, 99.0)) } else { [1, 2].map(|_| vec![POISON; stride * rows]) };
            let sums: Vec<f32> = (0..m).map(|i| (i % 7) as f32 * 6.0).collect();
            let local = Misfit { sum: buffer(&sums), counted: buffer(&vec![10.0; m]) };
            frame.on_device(|c, source| {
                let [weight, observation] = start.each_ref().map(|s| buffer(s));
                let to = WeightTarget { weight: &weight, observation: &observation, offset: margin, size: (stride, rows), accumulate };
                run(&k().data.weights(gpu(), source, &local, robust, &to));
                let mut expected = start.each_ref().map(|s| f64s(s));
                let mut tolerance = [vec![0.0; stride * rows], vec![0.0; stride * rows]];
                for (i, &sum) in sums.iter().enumerate() {
                    let o = (i / size.0 + margin) * stride + i % size.0 + margin;
                    let pixel = frame.pixel(c, i);
                    let (w, wb, terms) = pixel.weight(Some((f64::from(sum), 10.0)), f64::from(robust));
                    let before = if accumulate { [f64::from(start[0][o]), f64::from(start[1][o])] } else { [0.0; 2] };
                    expected[0][o] = before[0] + w;
                    expected[1][o] = before[1] + wb;
                    // Noise between two samples of its curve: √exposure · 255 is good to 5e-5 of a step, the curve moves by
                    // less than 0.1 of itself per step; variance and slope add 5e-6 each, sums a rounding of their size.
                    tolerance[0][o] = 2e-5 * w + HALF_ULP * (before[0] + w);
                    tolerance[1][o] = 2e-5 * terms + HALF_ULP * (before[1] + wb.abs());
                }
                let what = format!("{size:?}, channel {c}, clipped {black_clipped}, robust {robust}, accumulate {accumulate}");
                assert_close(&format!("W, {what}"), &read(&weight, stride * rows), &expected[0], |i| tolerance[0][i]);
                assert_close(&format!("W B, {what}"), &read(&observation, stride * rows), &expected[1], |i| tolerance[1][i]);
            });
        }
    }
}

#[test]
fn masked_and_unseen_pixels_weigh_exactly_nothing() {
    let (size, m) = ((17, 9), 17 * 9);
    let frame = Frame::new(size, 0, true);
    let none = Misfit { sum: buffer(&vec![0.0; m]), counted: buffer(&vec![0.0; m]) };
    frame.on_device(|c, source| {
        let (weight, observation) = (poisoned(m), poisoned(m));
        let to = WeightTarget { weight: &weight, observation: &observation, offset: 0, size, accumulate: false };
        run(&k().data.weights(gpu(), source, &none, 0.0, &to));
        let (w, wb) = (read(&weight, m), read(&observation, m));
        for i in 0..m {
            let counts = frame.mask[i] > 0.0 && frame.seen[c][i];
            assert_eq!(!counts, w[i] == 0.0, "pixel {i}");
            assert!(counts || wb[i] == 0.0, "pixel {i}");
        }
    });
}

// Smoothness.

fn log_planes(n: usize) -> [Vec<f32>; 3] {
    // Flat runs, where ε rules, between edges.
    [1, 2, 3]
        .map(|s| uniform(s, n, -3.0, 3.0).into_iter().enumerate().map(|(i, v)| if i / 5 % 2 == 0 { 0.25 * s as f32 } else { v }).collect())
}

#[test]
fn edge_weights_and_smoothness_term() {
    for size in SIZES {
        let n = size.0 * size.1;
        let (irradiance, lambda, epsilon) = (log_planes(n).map(|u| u.iter().map(|u| u.exp()).collect::<Vec<f32>>()), 4.5f32, 0.01f32);
        let (edge, count) = (poisoned(n + 3), partials_2d(gpu(), size));
        let partials = poisoned(count + 3);
        run(&k().linear.edge_weight(gpu(), &planes(&irradiance), &edge, &partials, lambda, epsilon, size));
        let log = irradiance.each_ref().map(|e| e.iter().map(|&e| f64::from(e).ln()).collect::<Vec<f64>>());
        let lengths = linear::lengths(&log, f64::from(epsilon), size);
        let expected: Vec<f64> = lengths.iter().map(|l| f64::from(lambda) / l).collect();
        let got = read(&edge, n + 3);
        // WGSL grants log 3 units in the last place, and 2^-21 between 0.5 and 2; a quotient before it, 7 terms, root, division behind it.
        let off = |i: usize| 2f64.powi(-20) / lengths[i] + 20.0 * HALF_ULP;
        assert_close(&format!("edge weights {size:?}"), &got[..n], &expected, |i| off(i) * expected[i]);
        assert_eq!(got[n..], [POISON; 3], "writes beyond its end");
        // length - ε cancels: count the roundings on the length.
        let terms: Vec<f64> = lengths.iter().map(|l| f64::from(lambda) * (l - f64::from(epsilon))).collect();
        let got = f64s(&read(&partials, count + 3));
        assert!(got[count..].iter().all(|&v| v == f64::from(POISON)), "writes beyond its partial sums");
        let errors: f64 = (0..n).map(|i| off(i) * lengths[i]).sum();
        let tolerance = sum_tolerance(&terms, 2.0) + f64::from(lambda) * errors;
        let (sum, wanted) = (got[..count].iter().sum::<f64>(), terms.iter().sum::<f64>());
        assert!((sum - wanted).abs() <= tolerance, "smoothness term {size:?}: {sum}, expected {wanted}");
    }
}

/// |Dᵀ w D| |x|: what the roundings of Dᵀ w D x count on.
fn sizes_of_terms(entries: &[(usize, usize, f64)], x: &[f64]) -> Vec<f64> {
    let absolute: Vec<_> = entries.iter().map(|e| (e.0, e.1, e.2.abs())).collect();
    linear::apply(&absolute, &x.iter().map(|v| v.abs()).collect::<Vec<_>>())
}

fn check_normal(size: (usize, usize), direction: &[f32]) {
    let n = size.0 * size.1;
    let (e, back, edge) = (uniform(1, n, 0.1, 5.0), noise(2, n), uniform(3, n, 0.5, 400.0));
    let (product, first, count) = (poisoned(n + 3), 5, partials_2d(gpu(), size));
    let partials = poisoned(first + count + 3);
    run(&k().linear.normal(gpu(), &buffer(&e), &buffer(&back), &buffer(&edge), &buffer(direction), &product, &partials, first, size));
    let (entries, x) = (linear::smoothness(&f64s(&edge), size), f64s(direction));
    let (smooth, sizes) = (linear::apply(&entries, &x), sizes_of_terms(&entries, &x));
    let data = |i: usize| f64::from(e[i]) * f64::from(back[i]);
    let expected: Vec<f64> = (0..n).map(|i| data(i) + smooth[i]).collect();
    let got = read(&product, n + 3);
    // Four differences, products and sums, and one product more.
    assert_close(&format!("normal {size:?}"), &got[..n], &expected, |i| 8.0 * HALF_ULP * (sizes[i] + data(i).abs()));
    assert_eq!(got[n..], [POISON; 3], "writes beyond its end");
    let terms: Vec<f64> = (0..n).map(|i| x[i] * f64::from(got[i])).collect();
    assert_partials(&format!("curvature {size:?}"), &read(&partials, first + count + 3), first, count, &terms, 2.0);
}

#[test]
fn normal_product() {
    for size in SIZES {
        check_normal(size, &noise(4, size.0 * size.1));
    }
}

#[test]
fn columns_of_the_smoothness_matrix() {
    let (w, h) = (19, 10);
    for i in [0, w - 1, 15, 16, w * (h - 1), w * h - 1, 3 * w, 4 * w - 1, 7 * w + 15, 8 * w + 16] {
        let unit: Vec<f32> = (0..w * h).map(|j| if j == i { 1.0 } else { 0.0 }).collect();
        check_normal((w, h), &unit);
    }
}

#[test]
fn right_side_and_preconditioner() {
    for size in SIZES {
        let n = size.0 * size.1;
        let (e, back, edge) = (uniform(1, n, 0.1, 5.0), noise(2, n), uniform(3, n, 0.5, 400.0));
        let data_diagonal = uniform(5, n, -20.0, 90.0);
        let (right, diagonal) = (poisoned(n + 3), poisoned(n + 3));
        let [eb, bb, wb, db] = [&e, &back, &edge, &data_diagonal].map(|v| buffer(v));
        run(&k().linear.right_side(gpu(), &eb, &bb, &wb, &db, &right, &diagonal, size));
        let (entries, u) = (linear::smoothness(&f64s(&edge), size), e.iter().map(|&e| f64::from(e).ln()).collect::<Vec<f64>>());
        let (smooth, sizes) = (linear::apply(&entries, &u), sizes_of_terms(&entries, &u));
        let data = |i: usize| f64::from(e[i]) * f64::from(back[i]);
        let expected: Vec<f64> = (0..n).map(|i| data(i) - smooth[i]).collect();
        let got = read(&right, n + 3);
        // WGSL grants log 3 units in the last place, and 2^-21 between 0.5 and 2.
        let ones = sizes_of_terms(&entries, &vec![1.0; n]);
        let tolerance = |i: usize| 16.0 * HALF_ULP * (sizes[i] + data(i).abs()) + 2f64.powi(-21) * ones[i];
        assert_close(&format!("right side {size:?}"), &got[..n], &expected, tolerance);
        assert_eq!(got[n..], [POISON; 3], "right side: writes beyond its end");
        let smooth = linear::diagonal(&entries, n);
        let expected: Vec<f64> = (0..n).map(|i| f64::from(e[i]).powi(2) * f64::from(data_diagonal[i]).abs() + smooth[i]).collect();
        let got = read(&diagonal, n + 3);
        assert_close(&format!("preconditioner {size:?}"), &got[..n], &expected, |i| 8.0 * HALF_ULP * expected[i] + 2e-20);
        assert_eq!(got[n..], [POISON; 3], "preconditioner: writes beyond its end");
    }
}

#[test]
fn a_pixel_without_data_and_neighbours_has_a_positive_preconditioner() {
    let (zero, one) = (buffer(&[0.0]), buffer(&[1.0]));
    let (right, diagonal) = (poisoned(1), poisoned(1));
    run(&k().linear.right_side(gpu(), &one, &zero, &one, &zero, &right, &diagonal, (1, 1)));
    assert!(read(&diagonal, 1)[0] > 0.0);
    assert_eq!(read(&right, 1), [0.0]);
}

// Conjugate gradients.

/// The channel whose scalars these tests set.
const CHANNEL: usize = 2;

/// Scalars of [`CHANNEL`] between others.
fn scalars(values: [f32; SLOTS]) -> wgpu::Buffer {
    let mut all = [POISON; SCALARS];
    all[SLOTS * CHANNEL..SLOTS * (CHANNEL + 1)].copy_from_slice(&values);
    buffer(&all)
}

fn check_cg_start(count: usize) {
    let (r, d) = (noise(1, count), uniform(2, count, 0.3, 70.0));
    let (x, p, first, n) = (poisoned(count + 3), poisoned(count + 3), 6, partials_1d(gpu(), count));
    let partials = poisoned(first + n + 3);
    run(&k().linear.cg_start(gpu(), &buffer(&r), &buffer(&d), &x, &p, &partials, first, count));
    let got = read(&x, count + 3);
    assert!(got[..count].iter().all(|&v| v == 0.0), "x starts at 0");
    assert_eq!(got[count..], [POISON; 3], "x: writes beyond its end");
    let z: Vec<f64> = (0..count).map(|i| f64::from(r[i]) / f64::from(d[i])).collect();
    let got = read(&p, count + 3);
    // WGSL grants a division 2.5 units in the last place.
    assert_close(&format!("p {count}"), &got[..count], &z, |i| 5.0 * HALF_ULP * z[i].abs());
    assert_eq!(got[count..], [POISON; 3], "p: writes beyond its end");
    let terms: Vec<f64> = (0..count).map(|i| f64::from(r[i]) * z[i]).collect();
    assert_partials(&format!("<r, z> {count}"), &read(&partials, first + n + 3), first, n, &terms, 6.0);
}

#[test]
fn cg_start() {
    COUNTS.into_iter().for_each(check_cg_start);
}

fn check_cg_step(count: usize, curvature: f32) {
    let [p, q, x, r] = [1, 2, 3, 4].map(|s| noise(s, count + 3));
    let (d, energy) = (uniform(5, count, 0.3, 70.0), 1.75f32);
    let (solution, residual, first, n) = (buffer(&x), buffer(&r), 6, partials_1d(gpu(), count));
    let partials = poisoned(first + n + 3);
    let s = scalars([energy, curvature, POISON, POISON]);
    let [pb, qb, db] = [&p, &q, &d].map(|v| buffer(v));
    run(&k().linear.cg_step(gpu(), &s, CHANNEL, &pb, &qb, &db, &solution, &residual, &partials, first, count));
    let alpha = if curvature > 0.0 { f64::from(energy) / f64::from(curvature) } else { 0.0 };
    for (what, sign, start, step, out) in [("x", 1.0, &x, &p, &solution), ("r", -1.0, &r, &q, &residual)] {
        let change = |i: usize| if i < count { sign * alpha * f64::from(step[i]) } else { 0.0 };
        let expected: Vec<f64> = (0..count + 3).map(|i| f64::from(start[i]) + change(i)).collect();
        assert_close(&format!("{what} {count}"), &read(out, count + 3), &expected, |i| {
            HALF_ULP * (7.0 * change(i).abs() + f64::from(start[i]).abs())
        });
    }
    let r = read(&residual, count);
    let terms: Vec<f64> = (0..count).map(|i| f64::from(r[i]).powi(2) / f64::from(d[i])).collect();
    assert_partials(&format!("new <r, z> {count}"), &read(&partials, first + n + 3), first, n, &terms, 6.0);
}

#[test]
fn cg_step() {
    COUNTS.into_iter().for_each(|count| check_cg_step(count, 2.5));
}

#[test]
fn without_curvature_conjugate_gradients_stay_where_they_are() {
    check_cg_step(1000, 0.0);
    check_cg_step(1000, -1.0);
    check_cg_direction(1000, 0.0);
}

fn check_cg_direction(count: usize, energy_before: f32) {
    let (r, d, p) = (noise(1, count), uniform(2, count, 0.3, 70.0), noise(3, count + 3));
    let s = scalars([0.6, POISON, energy_before, POISON]);
    let direction = buffer(&p);
    run(&k().linear.cg_direction(gpu(), &s, CHANNEL, &buffer(&r), &buffer(&d), &direction, count));
    let beta = if energy_before > 0.0 { f64::from(0.6f32) / f64::from(energy_before) } else { 0.0 };
    let parts = |i: usize| (f64::from(r[i]) / f64::from(d[i]), beta * f64::from(p[i]));
    let expected: Vec<f64> = (0..count + 3).map(|i| if i < count { parts(i).0 + parts(i).1 } else { f64::from(p[i]) }).collect();
    assert_close(&format!("p {count}"), &read(&direction, count + 3), &expected, |i| {
        if i < count { 8.0 * HALF_ULP * (parts(i).0.abs() + parts(i).1.abs()) } else { 0.0 }
    });
}

#[test]
fn cg_direction() {
    COUNTS.into_iter().for_each(|count| check_cg_direction(count, 0.8));
}

#[test]
fn partial_sums_become_scalars() {
    for count in COUNTS {
        let partials = noise(1, 3 * count + 3);
        for (channels, slot, shift) in [
            (0..3, SLOT_ENERGY, true),
            (1..2, SLOT_ENERGY, true),
            (2..3, SLOT_ENERGY, false),
            (0..3, SLOT_CURVATURE, false),
            (1..3, SLOT_DATA, false),
            (0..1, SLOT_SMOOTHNESS, false),
        ] {
            let before: [f32; SCALARS] = std::array::from_fn(|i| 11.0 + i as f32);
            let s = buffer(&before);
            run(&[k().linear.sum(gpu(), &buffer(&partials), &s, channels.clone(), count, slot, shift)]);
            let (mut expected, mut tolerance) = (f64s(&before), vec![0.0; SCALARS]);
            for (k, c) in channels.clone().enumerate() {
                let (at, terms) = (slot + SLOTS * c, f64s(&partials[k * count..(k + 1) * count]));
                if shift {
                    expected[at + 2] = f64::from(before[at]);
                }
                (expected[at], tolerance[at]) = (terms.iter().sum(), sum_tolerance(&terms, 0.0));
            }
            let what = format!("scalars {count}, channels {channels:?}, slot {slot}");
            assert_close(&what, &read(&s, SCALARS), &expected, |i| tolerance[i]);
        }
    }
}

#[test]
fn slots_are_where_conjugate_gradients_look() {
    // Of each channel (<r, z>, <p, q>, <r, z> of the step before, data term), then the smoothness term.
    assert_eq!([SLOT_ENERGY, SLOT_CURVATURE, SLOT_DATA, SLOTS, SLOT_SMOOTHNESS, SCALARS], [0, 1, 3, 4, 12, 13]);
}

#[test]
fn vectors_longer_than_one_row_of_workgroups() {
    assert_eq!(partials_1d(gpu(), MANY), 8192);
    check_multiply(MANY);
    check_update_once(MANY);
    check_residual(MANY);
    check_cg_start(MANY);
    check_cg_step(MANY, 2.5);
    check_cg_direction(MANY, 0.8);
    let partials = noise(1, MANY);
    let s = buffer(&[0.0; SCALARS]);
    run(&[k().linear.sum(gpu(), &buffer(&partials), &s, 0..1, MANY, SLOT_DATA, false)]);
    let terms = f64s(&partials);
    let (got, expected) = (f64::from(read(&s, SCALARS)[SLOT_DATA]), terms.iter().sum::<f64>());
    assert!((got - expected).abs() <= sum_tolerance(&terms, 0.0), "{got} {expected}");
}

fn check_update_once(count: usize) {
    let (old, x) = (uniform(1, count, 0.2, 2.0), uniform(2, count, -1.0, 1.0));
    let [e, scaled, back] = [0; 3].map(|_| poisoned(count));
    let (ob, xb) = (buffer(&old), buffer(&x));
    run(&k().linear.update(gpu(), &ob, &xb, &e, 0.5, 1e-30, count));
    run(&k().linear.scale(gpu(), &ob, &xb, &ob, &scaled, &back, count));
    let expected: Vec<f64> = (0..count).map(|i| advance(f64::from(old[i]).ln(), 0.5 * f64::from(x[i])).exp()).collect();
    assert_close("E", &read(&e, count), &expected, |i| 16.0 * HALF_ULP * expected[i]);
    let scaled_expected: Vec<f64> = (0..count).map(|i| f64::from(old[i]) * f64::from(x[i])).collect();
    assert_close("scaled", &read(&scaled, count), &scaled_expected, |_| 4.0 * HALF_ULP);
}

// Steps.

#[test]
fn copies_and_clears_keep_their_place_between_dispatches() {
    let (a, b) = (buffer(&[2.0, 3.0]), buffer(&[5.0, 7.0]));
    let (kept, cleared) = (poisoned(2), buffer(&[1.0, 1.0]));
    let multiply = |a: &wgpu::Buffer, b: &wgpu::Buffer| k().linear.multiply(gpu(), a, b, 2).remove(0);
    run(&[multiply(&a, &b), Step::Copy(b.clone(), kept.clone()), multiply(&a, &b), Step::Clear(cleared.clone()), multiply(&b, &cleared)]);
    assert_eq!(read(&kept, 2), [10.0, 21.0]);
    assert_eq!(read(&b, 2), [20.0, 63.0]);
    assert_eq!(read(&cleared, 2), [0.0, 0.0]);
}

#[test]
fn more_steps_than_one_submission_holds_run_in_order() {
    let (a, b) = (buffer(&[-1.0, 1.0]), buffer(&[1.0, 1.0]));
    let step = k().linear.multiply(gpu(), &a, &b, 2);
    let last = k().linear.multiply(gpu(), &buffer(&[3.0, 3.0]), &b, 2);
    run(&[vec![step; 4097].concat(), last].concat());
    assert_eq!(read(&b, 2), [-3.0, 3.0]);
}
