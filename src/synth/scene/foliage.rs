//! Leaves before a bright sky: glints between them, lit leaves above, deep shade under the bush; texture in every direction.

use super::Scene;
use super::canvas::{Canvas, EVERYWHERE, Ink, glow, mix, paint, smooth, texture, times};
use crate::maths::Portable;
use crate::random::Random;

const SUN: (f32, f32) = (150.0, 70.0);

/// One leaf: an almond with veins about (x, y), pointing along `angle`.
fn leaf(c: &mut Canvas, (x, y): (f32, f32), angle: f32, long: f32, wide: f32, tone: f32, dye: [[f32; 3]; 2]) {
    let (co, si) = (angle.cosine(), angle.sine());
    let axes = |u: f32, v: f32| ((u - x) * co + (v - y) * si, (v - y) * co - (u - x) * si);
    c.draw(
        (x - long, y - long, x + long, y + long),
        |u, v| {
            let (p, q) = axes(u, v);
            let t = p / (0.5 * long);
            q.abs() - wide * (1.0 - t * t).max(-1.0)
        },
        |u, v| {
            let (p, q) = axes(u, v);
            let vein = smooth(0.6, 0.2, q.abs()) + 0.6 * smooth(0.7, 0.95, ((p + q.abs()) * 1.9).sine());
            let side = if q > 0.0 { 1.0 } else { 0.6 };
            Ink { light: tone, ..paint(times(mix(dye[0], dye[1], vein.min(1.0)), side)) }
        },
    );
}

pub(super) fn foliage(width: usize, height: usize, margin: usize, oversampling: usize, seed: u64) -> Scene {
    let mut c = Canvas::new(width, height, margin, oversampling);
    let mut random = Random::new(seed, 13);
    let noise = random.uniform(0.0, 1e6) as u32;
    c.draw(
        EVERYWHERE,
        |_, _| -1.0,
        |x, y| {
            let cloud = smooth(0.42, 0.7, texture(x / 60.0, y / 34.0, noise));
            let sun = 1.0 / (1.0 + ((x - SUN.0) / 24.0).powi(2) + ((y - SUN.1) / 24.0).powi(2));
            glow(times(mix([1.1, 1.9, 3.6], [4.2, 4.1, 4.0], cloud), 1.0 + 6.0 * sun * sun))
        },
    );
    c.disc(SUN.0, SUN.1, 9.0, |_, _| glow([90.0, 82.0, 66.0]));
    // The bush behind: dense, with gaps that let the sky through.
    c.draw(
        (-1e4, 20.0, 1e4, 1e4),
        |x, y| {
            90.0 * (texture(x / 42.0, y / 30.0, noise + 40) - 0.38 - 0.0011 * (y - 20.0))
                .max(0.42 * texture(x / 9.0, y / 9.0, noise + 50) - 0.29)
        },
        |x, y| Ink { light: 0.004, ..paint(times([0.10, 0.24, 0.07], 0.3 + 1.4 * texture(x / 4.0, y / 4.0, noise + 60))) },
    );
    let span = (-60.0, 572.0);
    let scatter = |random: &mut Random, low: f64, high: f64| (random.uniform(span.0, span.1) as f32, random.uniform(low, high) as f32);
    // Trunks and branches.
    for _ in 0..9 {
        let (x, y) = scatter(&mut random, 300.0, 470.0);
        let (dx, thick) = (random.uniform(-120.0, 120.0) as f32, random.uniform(1.5, 6.0) as f32);
        let bark = Ink { light: 0.12, ..paint([0.16, 0.11, 0.07]) };
        c.line((x, y), (x + dx, y - random.uniform(150.0, 330.0) as f32), thick, bark);
    }
    // From the deep shade at the back to the sunlit leaves in front; few reach the sky at the top.
    let layers = [(900, 0.006, 90.0, 470.0), (900, 0.05, 60.0, 460.0), (700, 0.35, -60.0, 440.0), (420, 1.0, -80.0, 430.0)];
    for (layer, (count, tone, top, bottom)) in layers.into_iter().enumerate() {
        for _ in 0..count {
            let place = scatter(&mut random, top, bottom);
            let (angle, long) = (random.uniform(-3.2, 3.2) as f32, random.uniform(9.0, 21.0) as f32);
            let shade = random.uniform(0.5, 1.3) as f32;
            // Under the canopy even the front leaves are dark.
            let depth = 1.0 - 0.985 * smooth(215.0, 330.0, place.1);
            // The sky stays visible in the upper left, through gaps.
            let gap = texture(place.0 / 70.0, place.1 / 70.0, noise + 70);
            if gap > 0.60 - 0.1 * layer as f32 + place.1.max(0.0) / 700.0 {
                continue;
            }
            let autumn = random.uniform(0.0, 1.0) < 0.12;
            let dye = if autumn { [[0.36, 0.10, 0.03], [0.6, 0.34, 0.08]] } else { [[0.06, 0.22, 0.04], [0.28, 0.46, 0.14]] };
            leaf(&mut c, place, angle, long, long * random.uniform(0.14, 0.26) as f32, tone * shade * depth, dye);
        }
    }
    // Berries with glints, and a label on a post in the shade.
    for _ in 0..70 {
        let (x, y) = scatter(&mut random, 20.0, 400.0);
        let depth = 1.0 - 0.985 * smooth(215.0, 330.0, y);
        c.disc(x, y, 2.6, |u, v| Ink { light: depth * (1.2 - 0.25 * (u - x + v - y)), ..paint([0.55, 0.03, 0.05]) });
        c.disc(x - 0.9, y - 0.9, 0.6, |_, _| glow(times([2.5, 2.6, 3.0], depth)));
    }
    c.rect((330.0, 300.0, 424.0, 352.0), |x, y| Ink {
        light: 0.012,
        ..paint(times([0.5, 0.46, 0.36], 0.8 + 0.4 * texture(x / 3.0, y / 3.0, noise + 80)))
    });
    let ink = Ink { light: 0.012, ..paint([0.03, 0.03, 0.03]) };
    for (k, (text, tall)) in [("FICUS CARICA", 6.8), ("PLANTED 1913", 5.8), ("DO NOT SHAKE", 6.4)].into_iter().enumerate() {
        c.centred(text, 377.0, 308.0 + 14.0 * k as f32, tall, 0.1 * tall, ink);
    }
    c.lit(margin, oversampling, |x, y, ink| {
        // Flecks of sun on the leaves.
        let fleck = 0.35 + 1.3 * smooth(0.45, 0.62, texture(x / 26.0, y / 26.0, noise + 90));
        std::array::from_fn(|k| {
            ink.albedo[k] * (ink.light * fleck * 2.2 * [1.0, 0.94, 0.82][k] + 8e-4 * [0.7, 1.0, 1.2][k]) + ink.emission[k]
        })
    })
}
