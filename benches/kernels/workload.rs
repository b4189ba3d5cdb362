//! The fixed motion that K and Kᵀ are timed with, and frames under it.

use unshaken::deblur::Observation;
use unshaken::image::{Plane, Rgb};
use unshaken::kernels::NOISE_STEPS;
use unshaken::pose::Pose;
use unshaken::tsf::{Tap, TapSet, Tsf};

/// 64 poses: 13 angles 1/4 degree apart, about 5 whole-pixel shifts of a random walk at each.
pub fn workload() -> TapSet {
    let mut state = 1u32;
    let mut next = |n: u32| {
        state = state.wrapping_mul(747_796_405).wrapping_add(2_891_336_453);
        ((state >> 16) % n) as i32
    };
    let (mut taps, mut x, mut y) = (Vec::new(), 0, 0);
    for base in 0..13 {
        let count = if base == 6 { 4 } else { 5 };
        let mut at = std::collections::BTreeSet::new();
        while at.len() < count {
            at.insert((y, x));
            x = (x + next(3) - 1).clamp(-12, 12);
            y = (y + next(3) - 1).clamp(-12, 12);
        }
        taps.extend(at.into_iter().map(|(dy, dx)| Tap { base, dx, dy, weight: 1.0 / 64.0 }));
    }
    let bases = (-6..=6).map(|k| Pose::planar(0.0, 0.0, 0.25 * f64::from(k), 1.0).rotation(1000.0)).collect();
    TapSet { bases, taps }
}

/// The workload's motion as a TSF.
pub fn motion() -> Tsf {
    let pose = |t: &Tap| Pose::planar(f64::from(t.dx), f64::from(t.dy), 0.25 * (t.base as f64 - 6.0), t.weight);
    Tsf::new(1000.0, workload().taps.iter().map(pose).collect()).expect("a motion")
}

/// A square frame of values from 0 to 1, `side` pixels wide, that moved by `tsf`.
pub fn observation(side: usize, image: [&[f32]; 3], tsf: Tsf) -> Observation {
    let plane = |values: &[f32]| Plane::from_vec(side, side, values.iter().map(|v| 0.1 + 0.8 * v).collect()).expect("the frame's size");
    Observation {
        exposure: Rgb(image.map(plane)),
        mask: Plane::filled(side, side, 1.0),
        exposure_time: 1.0,
        noise: std::array::from_fn(|_| vec![0.02; NOISE_STEPS]),
        black_clipped: false,
        tsf,
    }
}

/// Values from 0 to 1 without order.
pub fn noise(seed: u32, count: usize) -> Vec<f32> {
    let mut state = seed;
    let mut next = || {
        state = state.wrapping_mul(747_796_405).wrapping_add(2_891_336_453);
        (state >> 8) as f32 / (1u32 << 24) as f32
    };
    (0..count).map(|_| next()).collect()
}
