//! What tests share: the device, fixed-seed numbers, comparison.

pub mod files;
pub mod gpu;
pub mod photos;
pub mod raws;

use unshaken::image::Plane;

/// Numbers of -1..1 from a fixed seed (splitmix64).
pub fn noise(seed: u64, count: usize) -> Vec<f32> {
    let mut state = seed.wrapping_mul(0x9e37_79b9_7f4a_7c15) ^ 0x1234_5678;
    let mut next = || {
        state = state.wrapping_add(0x9e37_79b9_7f4a_7c15);
        let mut z = state;
        z = (z ^ (z >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
        (z ^ (z >> 31)) >> 40
    };
    (0..count).map(|_| next() as f32 / (1u64 << 23) as f32 - 1.0).collect()
}

/// Numbers of `low..high` from a fixed seed.
pub fn uniform(seed: u64, count: usize, low: f32, high: f32) -> Vec<f32> {
    noise(seed, count).iter().map(|v| low + (high - low) * 0.5 * (v + 1.0)).collect()
}

pub fn f64s(values: &[f32]) -> Vec<f64> {
    values.iter().map(|&v| f64::from(v)).collect()
}

/// Every entry of `got` within its own tolerance of `expected`.
#[track_caller]
pub fn assert_close(what: &str, got: &[f32], expected: &[f64], tolerance: impl Fn(usize) -> f64) {
    assert_eq!(got.len(), expected.len(), "{what}: length");
    // Written so that NaN is far from everything.
    let close = |i: &usize| (f64::from(got[*i]) - expected[*i]).abs() <= tolerance(*i);
    let far: Vec<_> = (0..got.len()).filter(|i| !close(i)).collect();
    if let Some(&i) = far.first() {
        panic!(
            "{what}: {} of {} entries are off; entry {i} is {}, expected {} within {:e}",
            far.len(),
            got.len(),
            got[i],
            expected[i],
            tolerance(i)
        );
    }
}

/// Texture that determines a blur: smoothed noise over a few scales, positive.
pub fn texture(width: usize, height: usize) -> Plane {
    let n = noise(7, width * height);
    let fine = Plane { width, height, data: n };
    let at = |x: usize, y: usize, r: isize| {
        let mut sum = 0.0;
        for j in -r..=r {
            for i in -r..=r {
                sum += fine.clamped(x as isize + i, y as isize + j);
            }
        }
        sum / (2 * r + 1) as f32
    };
    Plane::from_fn(width, height, |x, y| 2.0 + 0.5 * at(x, y, 1) + 0.5 * at(x, y, 3))
}
