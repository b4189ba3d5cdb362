//! A gyroscope's record of a hand, as the cause of blur.

use crate::error::{Error, Result};

/// Angular rates of a camera over time.
#[derive(Clone, Debug, PartialEq)]
pub struct GyroRecord {
    /// (time in seconds from the first sample, orientation as the integral of the rates about x, y and z in degrees).
    orientation: Vec<(f64, [f64; 3])>,
}

impl GyroRecord {
    /// Reads a record: lines of four numbers, time in nanoseconds and rates in rad/s about x (pitch), y (yaw) and z (roll). Other lines
    /// (counts, remarks) are passed over.
    ///
    /// # Errors
    /// [`Error::Input`] for fewer than two samples, times that do not increase and numbers that are not finite.
    pub fn parse(text: &str) -> Result<Self> {
        let mut samples: Vec<(f64, [f64; 3])> = Vec::new();
        for line in text.lines() {
            let numbers: Option<Vec<f64>> = line.split_whitespace().map(|w| w.parse().ok()).collect();
            let Some([time, x, y, z]) = numbers.as_deref().and_then(|n| <[f64; 4]>::try_from(n).ok()) else { continue };
            if ![time, x, y, z].iter().all(|v| v.is_finite()) {
                return Err(Error::Input(format!("the line {line:?} holds a number that is not finite")));
            }
            let seconds = time * 1e-9;
            if samples.last().is_some_and(|s| seconds <= s.0) {
                return Err(Error::Input(format!(
                    "the time of the line {line:?} is not after that of the line before; sort the record by time"
                )));
            }
            samples.push((seconds, [x, y, z]));
        }
        if samples.len() < 2 {
            return Err(Error::Input(
                "is not a gyroscope's record: it needs two or more lines of four numbers (ns, then rad/s about x, y, z)".into(),
            ));
        }
        let start = samples[0].0;
        let mut orientation = vec![(0.0, [0.0; 3])];
        for pair in samples.windows(2) {
            let dt = pair[1].0 - pair[0].0;
            let last = orientation[orientation.len() - 1].1;
            // Trapezium rule; angles of a tremor are so small that rotations add.
            let next = std::array::from_fn(|d| last[d] + (0.5 * (pair[0].1[d] + pair[1].1[d]) * dt).to_degrees());
            orientation.push((pair[1].0 - start, next));
        }
        Ok(Self { orientation })
    }

    /// Length of the record in seconds.
    pub fn duration(&self) -> f64 {
        self.orientation[self.orientation.len() - 1].0
    }

    /// Orientation in degrees about x, y and z at `time` seconds. Beyond its ends the record runs backwards and forwards again, so that
    /// the path stays continuous.
    pub fn at(&self, time: f64) -> [f64; 3] {
        let t = time.rem_euclid(2.0 * self.duration());
        let t = if t > self.duration() { 2.0 * self.duration() - t } else { t };
        let i = self.orientation.partition_point(|s| s.0 <= t).clamp(1, self.orientation.len() - 1);
        let ((t0, a), (t1, b)) = (self.orientation[i - 1], self.orientation[i]);
        let k = ((t - t0) / (t1 - t0)).clamp(0.0, 1.0);
        std::array::from_fn(|d| a[d] + k * (b[d] - a[d]))
    }
}
