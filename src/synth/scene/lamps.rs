//! Lamps in a dark room: bulbs under shades, candles, a sign of light, a screen with text; between them almost nothing.

use super::Scene;
use super::canvas::{Canvas, EVERYWHERE, Ink, glow, grain, mix, paint, smooth, texture, times};
use crate::maths::Portable;
use crate::random::Random;

/// (x, y, strength, colour) of what lights the room.
const LIGHTS: [(f32, f32, f32, [f32; 3]); 4] = [
    (92.0, 150.0, 0.5, [1.0, 0.66, 0.34]),
    (262.0, 118.0, 0.16, [1.0, 0.72, 0.42]),
    (420.0, 96.0, 0.05, [0.9, 0.15, 0.25]),
    (352.0, 262.0, 0.03, [0.45, 0.65, 1.0]),
];

pub(super) fn lamps(width: usize, height: usize, margin: usize, oversampling: usize, seed: u64) -> Scene {
    let mut c = Canvas::new(width, height, margin, oversampling);
    let mut random = Random::new(seed, 12);
    let noise = random.uniform(0.0, 1e6) as u32;
    c.draw(
        EVERYWHERE,
        |_, _| -1.0,
        |x, y| {
            let stripe = 0.5 + 0.5 * (x * std::f32::consts::TAU / 17.0).sine();
            let dots = smooth(0.30, 0.18, ((x / 17.0).rem_euclid(1.0) - 0.5).length((y / 17.0).rem_euclid(1.0) - 0.5));
            let tone = 0.7 + 0.6 * texture(x / 5.0, y / 5.0, noise) - 0.2 * smooth(0.3, 0.7, stripe);
            paint(times(mix([0.24, 0.27, 0.33], [0.5, 0.42, 0.3], dots), tone))
        },
    );
    // A shelf of books in the dark, and a picture.
    for level in 0..3 {
        let floor = 226.0 + 52.0 * level as f32;
        let mut x = 396.0;
        while x < 640.0 {
            let (wide, tall) = (random.uniform(6.0, 13.0) as f32, random.uniform(30.0, 44.0) as f32);
            let dye = [random.uniform(0.05, 0.6) as f32, random.uniform(0.05, 0.5) as f32, random.uniform(0.05, 0.5) as f32];
            c.rect((x, floor - tall, x + wide, floor), |u, v| paint(times(dye, 0.7 + 0.6 * texture(u / 2.0, v / 2.0, noise + 3))));
            for v in [floor - tall + 4.0, floor - 8.0] {
                c.rect((x + 0.8, v, x + wide - 0.8, v + 1.2), |_, _| paint([0.7, 0.6, 0.35]));
            }
            x += wide + 0.4;
        }
        c.rect((390.0, floor, 1e4, floor + 4.0), |u, v| paint(times([0.3, 0.18, 0.09], 0.6 + 0.8 * texture(u / 30.0, v, noise + 4))));
    }
    c.rect((156.0, 60.0, 226.0, 112.0), |x, _| paint(times([0.5, 0.38, 0.15], 0.8 + 0.2 * (x * 0.7).sine())));
    c.rect((160.0, 64.0, 222.0, 108.0), |x, y| {
        let hills = 88.0 + 7.0 * (x / 11.0).sine() + 3.0 * (x / 4.0).sine();
        let t = smooth(hills - 0.7, hills + 0.7, y);
        paint(times(mix([0.35, 0.5, 0.7], [0.15, 0.3, 0.1], t), 0.6 + 0.8 * texture(x / 3.0, y / 3.0, noise + 5)))
    });
    // A table with a letter and a board of keys.
    c.rect((-1e4, 320.0, 1e4, 1e4), |x, y| {
        let plank = (x - 256.0) / (1.0 + (y - 320.0) / 70.0);
        let seam = smooth(0.02, 0.04, (plank / 52.0).rem_euclid(1.0));
        paint(times(mix([0.2, 0.1, 0.05], [0.38, 0.22, 0.1], texture(plank / 2.0, y / 25.0, noise + 6)), 0.3 + 0.7 * seam))
    });
    c.trapezium(112.0, (328.0, 62.0), (376.0, 80.0), |x, y| {
        paint(times([0.8, 0.78, 0.7], 0.93 + 0.07 * texture(x / 3.0, y / 3.0, noise + 7)))
    });
    for (k, text) in
        ["DEAR READER, THE LAMP BURNS LOW", "AND ALL THAT IS NOT LAMP IS NIGHT", "WRITTEN BY THE LIGHT OF IT"].into_iter().enumerate()
    {
        c.centred(text, 112.0, 334.0 + 13.0 * k as f32, 3.9 + 0.5 * k as f32, 0.4, paint([0.03, 0.03, 0.1]));
    }
    // The screen, with text on it.
    c.rect((306.0, 222.0, 396.0, 290.0), |_, _| paint([0.04; 3]));
    c.rect((310.0, 226.0, 392.0, 286.0), |_, y| glow(mix([0.10, 0.16, 0.30], [0.05, 0.09, 0.18], smooth(226.0, 286.0, y))));
    for (k, text) in ["UNSHAKEN MERGE", "FRAME 1 SHARP", "FRAME 2 SHARP", "FRAME 3 SHAKEN", "READY: 31.4 DB"].into_iter().enumerate() {
        c.text(text, 314.0, 231.0 + 10.5 * k as f32, 4.9, 0.45, false, glow([0.9, 1.6, 1.1]));
    }
    c.rect((344.0, 290.0, 358.0, 318.0), |_, _| paint([0.06; 3]));
    c.trapezium(351.0, (314.0, 22.0), (322.0, 30.0), |_, _| paint([0.06; 3]));
    // Two lamps: one with a shade, one that hangs bare behind glass.
    let (x0, y0) = (LIGHTS[0].0, LIGHTS[0].1);
    c.rect((x0 - 1.8, y0 + 10.0, x0 + 1.8, 330.0), |u, _| paint(times([0.7, 0.55, 0.25], 0.5 + 0.5 * smooth(-1.8, 0.6, u - x0))));
    c.disc(x0, y0, 5.5, |u, v| glow(times([1.0, 0.78, 0.5], 130.0 * (1.25 - 0.04 * ((u - x0) * (u - x0) + (v - y0) * (v - y0))).max(0.3))));
    c.trapezium(x0, (y0 - 58.0, 22.0), (y0 - 6.0, 44.0), |u, v| {
        let near = 1.0 / (1.0 + ((u - x0) / 28.0).powi(2) + ((v - y0 + 14.0) / 26.0).powi(2));
        let pleat = 0.8 + 0.2 * ((u - x0) / (22.0 + 22.0 * (v - y0 + 58.0) / 52.0) * 44.0).sine();
        glow(times([1.0, 0.6, 0.25], 4.0 * near * pleat * (0.9 + 0.2 * grain(1.4 * u, 1.4 * v, noise + 8))))
    });
    let (x1, y1) = (LIGHTS[1].0, LIGHTS[1].1);
    c.rect((x1 - 0.6, -1e4, x1 + 0.6, y1 - 14.0), |_, _| paint([0.08; 3]));
    c.disc(x1, y1, 15.0, |u, v| {
        let r = (u - x1).length(v - y1);
        // Frosted glass, ribbed, with the wire bright in the middle.
        glow(times([1.0, 0.74, 0.45], (1.2 + 18.0 / (1.0 + (r / 3.2).powi(4))) * (0.85 + 0.15 * ((u - x1) * 1.9).sine())))
    });
    // The sign: tubes of light, with the tube's dark end caps.
    for (text, x, y, tall, colour) in [("OPEN", 392.0, 78.0, 26.0, [14.0, 1.2, 2.6]), ("ALL NIGHT", 392.0, 116.0, 12.0, [1.6, 3.2, 9.0])] {
        c.text(text, x, y, tall, 1.5, false, glow(colour));
        c.text(text, x, y, tall, 0.6, false, glow(colour.map(|v| 2.2 * v + 2.0)));
    }
    // Candles on the table.
    for _ in 0..7 {
        let (x, y, tall) = (random.uniform(216.0, 300.0) as f32, random.uniform(322.0, 362.0) as f32, random.uniform(9.0, 22.0) as f32);
        c.rect((x - 2.4, y - tall, x + 2.4, y), |_, v| {
            let near = smooth(y, y - tall, v);
            Ink { light: 1.0, emission: times([1.0, 0.55, 0.22], 0.4 * near * near), albedo: [0.7, 0.66, 0.55] }
        });
        c.draw(
            (x - 3.0, y - tall - 10.0, x + 3.0, y - tall),
            |u, v| ((u - x) * 2.6).length(v - y + tall + 4.2) - 4.0,
            |_, v| glow(times(mix([1.0, 0.8, 0.4], [1.0, 0.45, 0.1], smooth(y - tall - 2.0, y - tall - 8.0, v)), 22.0)),
        );
    }
    // A string of points: each writes the path of the hand into a shaken frame.
    for i in 0..24 {
        let u = -20.0 + 24.0 * i as f32;
        let v = 24.0 + 6.0 * (u / 40.0).sine() + 0.0002 * (u - 256.0).powi(2);
        let colour = [[9.0, 1.0, 0.6], [8.0, 5.5, 0.8], [0.9, 6.5, 1.2], [0.9, 2.0, 9.0]][i % 4];
        c.disc(u, v, 1.5, |_, _| glow(times(colour, 1.4)));
    }
    c.lit(margin, oversampling, |x, y, ink| {
        let mut lit = [4e-4, 5e-4, 8e-4];
        for (i, (u, v, strength, colour)) in LIGHTS.into_iter().enumerate() {
            let away = 40.0;
            let (dx, dy) = (x - u, y - v);
            let r2 = dx * dx + dy * dy + away * away;
            // The shaded lamp shines up and down only.
            let cone = if i == 0 { 0.06 + smooth(0.35, 0.55, (dy / r2.sqrt()).abs()) } else { 1.0 };
            let k = strength * cone * away.powi(3) / r2.power(1.5);
            lit = std::array::from_fn(|c| lit[c] + k * colour[c]);
        }
        std::array::from_fn(|k| ink.albedo[k] * ink.light * lit[k] + ink.emission[k])
    })
}
