//! A sunlit window in a dark wall: street and sky outside, pictures, letters and a chair that only the window lights.

use super::Scene;
use super::canvas::{Canvas, EVERYWHERE, Ink, glow, grain, mix, paint, smooth, texture, times};
use crate::maths::Portable;
use crate::random::Random;

/// Left, top, right, bottom of the opening.
const OPENING: (f32, f32, f32, f32) = (40.0, 30.0, 246.0, 262.0);

pub(super) fn window(width: usize, height: usize, margin: usize, oversampling: usize, seed: u64) -> Scene {
    let mut c = Canvas::new(width, height, margin, oversampling);
    let mut random = Random::new(seed, 14);
    let noise = random.uniform(0.0, 1e6) as u32;
    // The wall: plaster with a printed pattern.
    c.draw(
        EVERYWHERE,
        |_, _| -1.0,
        |x, y| {
            let (u, v) = ((x / 26.0).rem_euclid(1.0) - 0.5, ((y + 13.0 * (x / 26.0).floor()) / 26.0).rem_euclid(1.0) - 0.5);
            let lily = smooth(0.22, 0.13, u.length(v) * (1.0 + 0.4 * (6.0 * v.arctangent(u)).sine()));
            paint(times(mix([0.28, 0.20, 0.22], [0.5, 0.4, 0.3], lily), 0.75 + 0.5 * texture(x / 6.0, y / 6.0, noise)))
        },
    );
    outside(&mut c, &mut random, noise);
    // Frame, bars and sill, dark against the light.
    let (x0, y0, x1, y1) = OPENING;
    let wood = |x: f32, y: f32| Ink { light: 0.5, ..paint(times([0.3, 0.24, 0.18], 0.7 + 0.6 * grain(x, y / 8.0, noise + 1))) };
    for bounds in
        [(x0 - 10.0, y0 - 10.0, x0, y1 + 8.0), (x1, y0 - 10.0, x1 + 10.0, y1 + 8.0), (x0, y0 - 10.0, x1, y0), (x0, y1, x1, y1 + 8.0)]
    {
        c.rect(bounds, wood);
    }
    c.rect((141.0, y0, 146.0, y1), wood);
    for y in [106.0, 184.0] {
        c.rect((x0, y - 2.0, x1, y + 2.0), wood);
    }
    c.rect((x0 - 20.0, y1 + 8.0, x1 + 20.0, y1 + 16.0), |x, y| Ink { light: 2.5, ..wood(x, y) });
    inside(&mut c, &mut random, noise);
    c.lit(margin, oversampling, |x, y, ink| {
        // Light that the window throws: grazing along the wall, a bright patch on the floor, and next to nothing else.
        let (dx, dy) = ((x - OPENING.2).max(0.0) + (OPENING.0 - x).max(0.0), (y - OPENING.3).max(0.0) + (OPENING.1 - y).max(0.0));
        let graze = 0.02 / (1.0 + (dx * dx + dy * dy) / 900.0);
        let patch = smooth(4.0, -4.0, (x - 0.8 * (y - 330.0) - 210.0).abs() - 52.0) * smooth(330.0, 336.0, y);
        let bar = smooth(1.5, 4.0, (x - 0.8 * (y - 330.0) - 210.0).abs());
        let lit =
            |k: usize| ink.light * (graze * [0.9, 0.95, 1.0][k] + 3.0 * patch * bar * [1.0, 0.93, 0.8][k]) + 3e-4 * [1.0, 0.9, 0.8][k];
        std::array::from_fn(|k| ink.albedo[k] * lit(k) + ink.emission[k])
    })
}

fn outside(c: &mut Canvas, random: &mut Random, noise: u32) {
    let (x0, y0, x1, y1) = OPENING;
    c.rect(OPENING, |x, y| {
        let cloud = smooth(0.45, 0.7, texture(x / 40.0, y / 20.0, noise + 2));
        glow(times(mix([3.0, 5.5, 10.0], [15.0, 15.0, 14.5], cloud), 1.0 - 0.4 * smooth(y0, y1, y)))
    });
    c.disc(204.0, 58.0, 10.0, |_, _| glow([320.0, 300.0, 250.0]));
    // Houses opposite, sunlit, with dark windows and a sign.
    let mut x = x0;
    let mut n = 0;
    while x < x1 {
        let right = (x + random.uniform(30.0, 58.0) as f32).min(x1);
        let top = random.uniform(92.0, 160.0) as f32;
        let wall = [[6.0, 4.2, 2.8], [5.0, 4.6, 4.0], [4.6, 2.2, 1.5], [3.6, 4.0, 4.4]][n % 4];
        c.rect((x, top, right, y1), |u, v| glow(times(wall, 0.8 + 0.4 * texture(u / 3.0, v / 3.0, noise + 3))));
        c.rect((x, top - 4.0, right, top), |_, _| glow([1.2, 0.6, 0.4]));
        let mut v = top + 6.0;
        while v < 222.0 {
            let mut u = x + 4.0;
            while u + 7.0 < right {
                c.rect((u, v, u + 6.0, v + 9.0), |_, w| glow(mix([0.12, 0.16, 0.22], [0.5, 0.7, 1.0], smooth(v + 5.0, v, w))));
                c.rect((u - 0.5, v + 9.0, u + 6.5, v + 10.2), |_, _| glow([7.0, 6.6, 6.0]));
                u += 10.5;
            }
            v += 17.0;
        }
        (x, n) = (right, n + 1);
    }
    for (text, x, y, tall, radius) in
        [("CAFE", 58.0, 208.0, 10.0, 0.9), ("BOOKS", 100.0, 212.0, 8.0, 0.7), ("BAKERY", 166.0, 210.0, 9.0, 0.8)]
    {
        c.rect((x - 3.0, y - 3.0, x + 0.9 * tall * text.len() as f32 + 4.0, y + tall + 3.0), |_, _| glow([0.5, 0.12, 0.08]));
        c.text(text, x, y, tall, radius, false, glow([9.0, 8.4, 6.0]));
    }
    c.rect((x0, 232.0, x1, y1), |u, v| glow(times([2.2, 2.1, 2.0], 0.7 + 0.6 * texture(u / 2.0, v / 2.0, noise + 4))));
    for _ in 0..46 {
        let (x, y) = (random.uniform(60.0, 84.0) as f32, random.uniform(140.0, 200.0) as f32);
        let bright = random.uniform(0.3, 3.0) as f32;
        c.disc(x, y, 3.6, |_, _| glow(times([0.35, 0.8, 0.2], bright)));
    }
    c.rect((71.0, 196.0, 74.0, 240.0), |_, _| glow([0.3, 0.2, 0.12]));
}

fn inside(c: &mut Canvas, random: &mut Random, noise: u32) {
    // Curtain on the right of the window, in folds.
    c.draw(
        (242.0, -20.0, 280.0, 300.0),
        |x, y| (246.0 - x).max(x - 268.0 - 3.0 * (y / 34.0).sine()).max(y - 288.0 - 2.0 * (x / 3.0).sine()),
        |x, y| {
            let fold = 0.5 + 0.5 * (x * 0.8 + 0.4 * (y / 45.0).sine()).sine();
            paint(times([0.5, 0.4, 0.12], (0.3 + 0.7 * fold) * (0.8 + 0.4 * grain(1.3 * x, 1.3 * y, noise + 5))))
        },
    );
    // Frames on the wall: text and patterns in the dark.
    for (k, (x, y, w, h)) in [(300.0, 40.0, 86.0, 64.0), (402.0, 34.0, 92.0, 112.0), (304.0, 124.0, 78.0, 92.0)].into_iter().enumerate() {
        c.rect((x - 5.0, y - 5.0, x + w + 5.0, y + h + 5.0), |u, v| {
            paint(times([0.45, 0.32, 0.12], 0.6 + 0.8 * grain(u / 2.0, v / 2.0, noise + 6)))
        });
        c.rect((x, y, x + w, y + h), |u, v| match k {
            0 => paint(times(mix([0.6, 0.5, 0.4], [0.2, 0.25, 0.4], smooth(0.45, 0.55, texture(u / 12.0, v / 12.0, noise + 7))), 1.0)),
            1 => paint([0.75, 0.73, 0.68]),
            _ => {
                let ring = (u - x - 0.5 * w).length(v - y - 0.5 * h);
                paint(mix([0.7, 0.66, 0.6], [0.1, 0.08, 0.2], smooth(-0.4, 0.4, (ring * 0.85).sine())))
            }
        });
    }
    let ink = paint([0.04; 3]);
    let verses = ["THE WINDOW", "HOLDS THE DAY", "THE WALL KEEPS", "WHAT THE NIGHT", "HAS WRITTEN", "IN THE DARK"];
    for (k, text) in verses.into_iter().enumerate() {
        c.centred(text, 448.0, 44.0 + 16.0 * k as f32, if k == 0 { 8.0 } else { 5.8 }, 0.6, ink);
    }
    // A table with boxes under the pictures.
    c.rect((286.0, 276.0, 1e4, 284.0), |x, y| paint(times([0.34, 0.2, 0.1], 0.6 + 0.8 * texture(x / 26.0, y / 2.0, noise + 8))));
    let mut x = 296.0;
    for text in ["TEA", "SALT", "RICE", "OATS", "PLUM", "NUTS"] {
        let (wide, tall) = (random.uniform(24.0, 33.0) as f32, random.uniform(26.0, 42.0) as f32);
        let dye = [random.uniform(0.1, 0.6) as f32, random.uniform(0.1, 0.5) as f32, random.uniform(0.1, 0.5) as f32];
        c.rect((x, 276.0 - tall, x + wide, 276.0), |u, v| paint(times(dye, 0.8 + 0.4 * texture(u / 4.0, v / 4.0, noise + 9))));
        c.rect((x + 2.0, 262.0 - 0.4 * tall, x + wide - 2.0, 275.0 - 0.4 * tall), |_, _| paint([0.7, 0.68, 0.6]));
        c.centred(text, x + 0.5 * wide, 265.0 - 0.4 * tall, 5.2, 0.5, ink);
        x += wide + 3.0;
    }
    // The floor, of boards.
    c.rect((-1e4, 322.0, 1e4, 1e4), |x, y| {
        let plank = (x - 256.0) / (1.0 + (y - 322.0) / 60.0);
        let seam = smooth(0.02, 0.05, (plank / 30.0).rem_euclid(1.0));
        paint(times(mix([0.22, 0.12, 0.06], [0.42, 0.26, 0.13], texture(plank / 2.0, y / 22.0, noise + 10)), 0.25 + 0.75 * seam))
    });
    c.rect((-1e4, 314.0, 1e4, 322.0), |x, y| paint(times([0.3, 0.26, 0.2], 0.8 + 0.4 * grain(x, y, noise + 11))));
}
