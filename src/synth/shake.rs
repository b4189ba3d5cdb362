//! Hand tremor: a smooth random camera path, continuous in time, off every grid of poses.

use crate::error::Result;
use crate::maths::Portable;
use crate::pose::Pose;
use crate::random::Random;
use crate::tsf::Tsf;

/// Number of sine waves of each degree of freedom.
const WAVES: usize = 24;

/// One degree of freedom: drift and sine waves.
pub(super) struct Wander {
    drift: f64,
    waves: Vec<[f64; 3]>,
}

impl Wander {
    pub(super) fn new(random: &mut Random) -> Self {
        let waves = (0..WAVES)
            .map(|i| {
                let hz = 2.0 + 10.0 * i as f64 / (WAVES - 1) as f64;
                // Amplitudes fall with frequency as a hand's do: the muscles push a mass.
                [random.normal() / (hz / 2.0).power(1.8), std::f64::consts::TAU * hz, random.uniform(0.0, std::f64::consts::TAU)]
            })
            .collect();
        Self { drift: 2.5 * random.normal(), waves }
    }

    pub(super) fn at(&self, t: f64) -> f64 {
        self.drift * t + self.waves.iter().map(|[a, w, phase]| a * (w * t + phase).sine()).sum::<f64>()
    }
}

/// A hand's tremor during one exposure: 2 to 12 Hz and a drift, in (t_x, t_y, θ_z).
#[derive(Clone, Debug)]
pub struct Tremor {
    /// Largest extent of the translation in x or y, pixels.
    pub extent_px: f64,
    /// Extent of the roll, degrees.
    pub roll_deg: f64,
    /// The mean pose lies up to this far from the reference, pixels in x and in y.
    pub offset_px: f64,
    /// The mean roll lies up to this far from the reference's, degrees.
    pub offset_deg: f64,
}

impl Tremor {
    /// The TSF of a frame of `width` x `height` pixels exposed for `exposure_time` seconds: poses at equal steps of
    /// time, so close that no pixel moves by more than 0.25 px from one to the next.
    ///
    /// # Errors
    /// [`crate::error::Error::Input`] for settings that are not finite.
    pub fn tsf(&self, width: usize, height: usize, exposure_time: f64, seed: u64, stream: u64) -> Result<Tsf> {
        let mut random = Random::new(seed, stream);
        let wander: [Wander; 3] = std::array::from_fn(|_| Wander::new(&mut random));
        let duration = exposure_time.max(0.05);
        let sample = |n: usize| -> Vec<[f64; 3]> {
            (0..n).map(|i| std::array::from_fn(|d| wander[d].at(duration * ((i as f64 + 0.5) / n as f64 - 0.5)))).collect()
        };
        let probe = sample(4096);
        let range = |d: usize| {
            let (a, b) = probe.iter().fold((f64::MAX, f64::MIN), |(a, b), p| (a.min(p[d]), b.max(p[d])));
            (b - a).max(1e-9)
        };
        let shift = self.extent_px / range(0).max(range(1));
        let scale = [shift, shift, self.roll_deg / range(2)];
        let corner = 0.5 * (width as f64).length(height as f64);
        let steps = probe.windows(2).map(|w| {
            let d: [f64; 3] = std::array::from_fn(|i| (w[1][i] - w[0][i]) * scale[i]);
            d[0].length(d[1]) + d[2].abs().to_radians() * corner
        });
        let longest = steps.fold(0.0, f64::max);
        let n = ((longest * probe.len() as f64 / 0.25).ceil() as usize).max(2);
        let path = sample(n);
        let offset = [
            random.uniform(-1.0, 1.0) * self.offset_px,
            random.uniform(-1.0, 1.0) * self.offset_px,
            random.uniform(-1.0, 1.0) * self.offset_deg,
        ];
        let mean: [f64; 3] = std::array::from_fn(|d| path.iter().map(|p| p[d]).sum::<f64>() / n as f64);
        let place = |p: &[f64; 3], d: usize| (p[d] - mean[d]) * scale[d] + offset[d];
        let poses = path.iter().map(|p| Pose::planar(place(p, 0), place(p, 1), place(p, 2), 1.0)).collect();
        Tsf::new(focal_px(width), poses)
    }
}

/// The TSF of a frame of `width` pixels that did not move.
pub fn identity(width: usize) -> Tsf {
    Tsf { focal_px: focal_px(width), ..Tsf::identity() }
}

/// Focal length of the camera, pixels: a normal lens.
fn focal_px(width: usize) -> f64 {
    1.2 * width as f64
}
