//! Drawing: what covers each point of a scene, in design units that do not depend on the size of the frame.

use super::Scene;
use crate::image::{Plane, Rgb};
use crate::maths::Portable;
use crate::synth::font;

pub(super) type Colour = [f32; 3];

/// What covers a point: diffuse reflectance, own radiance, and how much of the room's light reaches it.
#[derive(Clone, Copy)]
pub(super) struct Ink {
    pub(super) albedo: Colour,
    pub(super) emission: Colour,
    pub(super) light: f32,
}

pub(super) fn paint(albedo: Colour) -> Ink {
    Ink { albedo, emission: [0.0; 3], light: 1.0 }
}

pub(super) fn glow(emission: Colour) -> Ink {
    Ink { albedo: [0.0; 3], emission, light: 1.0 }
}

pub(super) fn times(c: Colour, k: f32) -> Colour {
    c.map(|v| v * k)
}

pub(super) fn mix(a: Colour, b: Colour, t: f32) -> Colour {
    std::array::from_fn(|i| a[i] + (b[i] - a[i]) * t)
}

pub(super) fn smooth(low: f32, high: f32, x: f32) -> f32 {
    let t = ((x - low) / (high - low)).clamp(0.0, 1.0);
    t * t * (3.0 - 2.0 * t)
}

/// Value noise in 0..=1 at (x, y), one cell per unit.
pub(super) fn grain(x: f32, y: f32, seed: u32) -> f32 {
    let hash = |i: i32, j: i32| {
        let mut h = (i as u32).wrapping_mul(0x9e37_79b1) ^ (j as u32).wrapping_mul(0x85eb_ca77) ^ seed.wrapping_mul(0xc2b2_ae3d);
        h = (h ^ (h >> 15)).wrapping_mul(0x2c1b_3c6d);
        h = (h ^ (h >> 12)).wrapping_mul(0x297a_2d39);
        ((h ^ (h >> 15)) >> 8) as f32 / (1u32 << 24) as f32
    };
    let (i, j) = (x.floor(), y.floor());
    let (a, b) = (smooth(0.0, 1.0, x - i), smooth(0.0, 1.0, y - j));
    let (i, j) = (i as i32, j as i32);
    let top = hash(i, j) * (1.0 - a) + hash(i + 1, j) * a;
    let low = hash(i, j + 1) * (1.0 - a) + hash(i + 1, j + 1) * a;
    top * (1.0 - b) + low * b
}

/// Several octaves of [`grain`], about 0.5.
pub(super) fn texture(x: f32, y: f32, seed: u32) -> f32 {
    (0..4).map(|o| grain(x * 2f32.powi(o), y * 2f32.powi(o), seed + o as u32) * 0.5f32.powi(o + 1)).sum::<f32>() / 0.9375
}

/// The picture while it is drawn. Design units: the frame is 512 x 384 about (256, 192).
pub(super) struct Canvas {
    pub(super) width: usize,
    pub(super) height: usize,
    /// Samples per design unit.
    pub(super) scale: f32,
    /// Design coordinates of sample 0.
    pub(super) origin: (f32, f32),
    pub(super) ink: Vec<Ink>,
}

pub(super) type Bounds = (f32, f32, f32, f32);

pub(super) const EVERYWHERE: Bounds = (-1e5, -1e5, 1e5, 1e5);

impl Canvas {
    /// A black canvas for frames of `width` x `height` pixels with `margin` pixels more on every side, `oversampling` samples per pixel
    /// and direction.
    pub(super) fn new(width: usize, height: usize, margin: usize, oversampling: usize) -> Self {
        let per_pixel = (512.0 / width.max(1) as f32).min(384.0 / height.max(1) as f32);
        let (w, h) = (oversampling * (width + 2 * margin), oversampling * (height + 2 * margin));
        let scale = oversampling as f32 / per_pixel;
        Self {
            width: w,
            height: h,
            scale,
            origin: (256.0 - 0.5 * (w as f32 - 1.0) / scale, 192.0 - 0.5 * (h as f32 - 1.0) / scale),
            ink: vec![paint([0.0; 3]); w * h],
        }
    }

    /// The scene whose radiance at (x, y) is `light(x, y, ink)`.
    pub(super) fn lit(&self, margin: usize, oversampling: usize, light: impl Fn(f32, f32, Ink) -> Colour) -> Scene {
        let radiance: Vec<Colour> = (0..self.width * self.height)
            .map(|i| {
                let (x, y) = ((i % self.width) as f32 / self.scale, (i / self.width) as f32 / self.scale);
                light(self.origin.0 + x, self.origin.1 + y, self.ink[i])
            })
            .collect();
        let plane = |k: usize| Plane { width: self.width, height: self.height, data: radiance.iter().map(|p| p[k]).collect() };
        Scene { samples: Rgb([plane(0), plane(1), plane(2)]), margin, oversampling }
    }

    /// Covers `bounds` (x0, y0, x1, y1) with `ink(x, y)` where the signed distance `shape(x, y)` is negative.
    pub(super) fn draw(&mut self, bounds: Bounds, shape: impl Fn(f32, f32) -> f32, ink: impl Fn(f32, f32) -> Ink) {
        let index = |v: f32, origin: f32, n: usize, grow: f32| ((v - origin) * self.scale + grow).clamp(0.0, n as f32) as usize;
        let (x0, x1) = (index(bounds.0, self.origin.0, self.width, -1.0), index(bounds.2, self.origin.0, self.width, 2.0));
        let (y0, y1) = (index(bounds.1, self.origin.1, self.height, -1.0), index(bounds.3, self.origin.1, self.height, 2.0));
        for j in y0..y1 {
            let y = self.origin.1 + j as f32 / self.scale;
            for i in x0..x1 {
                let x = self.origin.0 + i as f32 / self.scale;
                let cover = (0.5 - shape(x, y) * self.scale).clamp(0.0, 1.0);
                if cover > 0.0 {
                    let (below, above) = (self.ink[j * self.width + i], ink(x, y));
                    self.ink[j * self.width + i] = Ink {
                        albedo: mix(below.albedo, above.albedo, cover),
                        emission: mix(below.emission, above.emission, cover),
                        light: below.light + (above.light - below.light) * cover,
                    };
                }
            }
        }
    }

    pub(super) fn rect(&mut self, b: Bounds, ink: impl Fn(f32, f32) -> Ink) {
        self.draw(b, |x, y| (b.0 - x).max(x - b.2).max(b.1 - y).max(y - b.3), ink);
    }

    pub(super) fn disc(&mut self, x0: f32, y0: f32, r: f32, ink: impl Fn(f32, f32) -> Ink) {
        self.draw((x0 - r, y0 - r, x0 + r, y0 + r), |x, y| (x - x0).length(y - y0) - r, ink);
    }

    pub(super) fn line(&mut self, a: (f32, f32), b: (f32, f32), radius: f32, ink: Ink) {
        let bounds = (a.0.min(b.0) - radius, a.1.min(b.1) - radius, a.0.max(b.0) + radius, a.1.max(b.1) + radius);
        self.draw(bounds, |x, y| font::distance([a, b], x, y) - radius, |_, _| ink);
    }

    /// A trapezium from (y0, half width w0) to (y1, half width w1) about x.
    pub(super) fn trapezium(&mut self, x0: f32, (y0, w0): (f32, f32), (y1, w1): (f32, f32), ink: impl Fn(f32, f32) -> Ink) {
        let w = w0.max(w1);
        let half = |y: f32| w0 + (w1 - w0) * (y - y0) / (y1 - y0);
        self.draw((x0 - w, y0, x0 + w, y1), |x, y| ((x - x0).abs() - half(y)).max(y0 - y).max(y - y1), ink);
    }

    /// Text with its upper left corner at (x, y), or, `up`wards, its lower left corner there and running up.
    pub(super) fn text(&mut self, text: &str, x: f32, y: f32, height: f32, radius: f32, up: bool, ink: Ink) {
        for [a, b] in font::segments(text, height) {
            let place = |p: (f32, f32)| if up { (x + p.1, y - p.0) } else { (x + p.0, y + p.1) };
            self.line(place(a), place(b), radius, ink);
        }
    }

    /// Text of the largest height that fits `wide` but at most `height`, centred on x.
    pub(super) fn centred(&mut self, text: &str, x: f32, y: f32, height: f32, radius: f32, ink: Ink) {
        self.text(text, x - 0.5 * font::width(text, height), y, height, radius, false, ink);
    }
}
