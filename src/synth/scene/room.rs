//! A room at night: lamps, a window, book spines, a test chart, a plant; about five decades of radiance.

use super::Scene;
use super::canvas::{Canvas, Colour, EVERYWHERE, Ink, glow, grain, mix, paint, smooth, texture, times};
use crate::maths::Portable;
use crate::random::Random;
use crate::synth::font;

/// The room, for frames of `width` x `height` pixels with `margin` pixels more on every side. Deterministic in `seed`.
pub(super) fn room(width: usize, height: usize, margin: usize, oversampling: usize, seed: u64) -> Scene {
    let mut c = Canvas::new(width, height, margin, oversampling);
    let mut random = Random::new(seed, 0);
    let grain_seed = random.uniform(0.0, 1e6) as u32;
    wall(&mut c, grain_seed);
    window(&mut c, &mut random);
    chart(&mut c);
    shelf(&mut c, &mut random, grain_seed);
    table(&mut c, grain_seed);
    plant(&mut c, &mut random);
    lamp(&mut c);
    light(&c, margin, oversampling)
}

const BULB: (f32, f32) = (268.0, 262.0);

fn wall(c: &mut Canvas, seed: u32) {
    c.draw(
        EVERYWHERE,
        |_, _| -1.0,
        |x, y| {
            let stripe = 0.5 + 0.5 * (x * std::f32::consts::TAU / 22.0).sine();
            let (u, v) = ((x / 22.0).fract().abs() - 0.5, ((y + 11.0 * (x / 22.0).floor()) / 22.0).rem_euclid(1.0) - 0.5);
            let flower = smooth(0.16, 0.10, u.length(v) * (1.0 + 0.35 * (5.0 * v.arctangent(u)).sine()));
            let tone = 0.85 + 0.3 * texture(x / 7.0, y / 7.0, seed) - 0.15 * smooth(0.4, 0.6, stripe);
            paint(times(mix([0.30, 0.36, 0.30], [0.52, 0.48, 0.30], flower), tone))
        },
    );
}

fn window(c: &mut Canvas, random: &mut Random) {
    let (x0, y0, x1, y1) = (212.0, -8.0, 338.0, 158.0);
    c.rect((x0 - 9.0, y0 - 9.0, x1 + 9.0, y1 + 9.0), |x, _| paint(times([0.62, 0.58, 0.5], 0.9 + 0.1 * (x * 0.9).sine())));
    c.rect((x0, y0, x1, y1), |_, y| {
        let t = (y - y0) / (y1 - y0);
        glow(mix([0.10, 0.20, 0.55], mix([0.35, 0.45, 0.75], [1.5, 0.72, 0.30], smooth(0.55, 1.0, t)), smooth(0.0, 0.8, t)))
    });
    c.disc(306.0, 34.0, 10.0, |x, y| glow(times([1.0, 0.96, 0.86], 9.0 + 5.0 * (texture(x / 5.0, y / 5.0, 7) - 0.5))));
    for _ in 0..40 {
        let (x, y) = (random.uniform(213.0, 337.0) as f32, random.uniform(-6.0, 80.0) as f32);
        c.disc(x, y, random.uniform(0.3, 0.6) as f32, |_, _| glow([4.0, 4.2, 5.0]));
    }
    let mut x = x0;
    while x < x1 {
        let (wide, tall) = (random.uniform(9.0, 20.0) as f32, random.uniform(22.0, 70.0) as f32);
        let right = (x + wide).min(x1);
        c.rect((x, y1 - tall, right, y1), |_, _| glow([0.02, 0.022, 0.035]));
        let mut y = y1 - tall + 3.0;
        while y < y1 - 3.0 {
            let mut u = x + 2.0;
            while u + 2.0 < right {
                if random.uniform(0.0, 1.0) < 0.45 {
                    let bright = random.uniform(0.6, 4.0) as f32;
                    c.rect((u, y, u + 1.6, y + 2.2), |_, _| glow(times([1.0, 0.75, 0.35], bright)));
                }
                u += 3.4;
            }
            y += 4.6;
        }
        x = right;
    }
    let bar = |x: f32, y: f32| paint(times([0.60, 0.56, 0.48], 0.9 + 0.1 * grain(x, y / 9.0, 3)));
    c.rect((272.5, y0, 277.5, y1), bar);
    for y in [48.0, 104.0] {
        c.rect((x0, y - 1.8, x1, y + 1.8), bar);
    }
    c.rect((x0 - 14.0, y1 + 5.0, x1 + 14.0, y1 + 12.0), bar);
    for (left, right, seed) in [(190.0, 222.0, 0.0), (328.0, 360.0, 2.0)] {
        c.draw(
            (left - 4.0, -200.0, right + 4.0, 190.0),
            |x, y| (left - x).max(x - right - 2.0 * (y / 30.0 + seed).sine()).max(y - 184.0 - 2.0 * (x / 3.0).sine()),
            |x, y| {
                let fold = 0.55 + 0.45 * (x * 0.9 + 0.5 * (y / 40.0).sine()).sine();
                let weave = 0.8 + 0.4 * grain(x * 1.3, y * 1.3, 11);
                paint(times([0.55, 0.09, 0.08], weave * (0.25 + 0.75 * fold)))
            },
        );
    }
}

fn chart(c: &mut Canvas) {
    let (x0, y0, x1, y1) = (380.0, 26.0, 494.0, 214.0);
    c.rect((x0 + 4.0, y0 + 5.0, x1 + 5.0, y1 + 6.0), |_, _| Ink { light: 0.25, ..paint([0.3, 0.3, 0.25]) });
    c.rect((x0 - 3.0, y0 - 3.0, x1 + 3.0, y1 + 3.0), |x, y| paint(times([0.30, 0.16, 0.07], 0.7 + 0.6 * grain(x / 9.0, y, 5))));
    c.rect((x0, y0, x1, y1), |x, y| paint(times([0.86, 0.85, 0.78], 0.95 + 0.05 * texture(x / 3.0, y / 3.0, 9))));
    let (middle, ink) = (0.5 * (x0 + x1), paint([0.03; 3]));
    let rows =
        [("E", 26.0), ("F P", 19.0), ("T O Z", 14.0), ("L P E D", 10.5), ("P E C F D", 8.2), ("E D F C Z P", 6.4), ("F E L O P Z D", 5.0)];
    let mut y = y0 + 7.0;
    for (i, (text, tall)) in rows.into_iter().enumerate() {
        c.centred(text, middle, y, tall, tall / 13.0, ink);
        c.text(&(i + 1).to_string(), x0 + 4.0, y + 0.5 * tall - 2.0, 4.0, 0.35, false, ink);
        y += tall + 5.5;
    }
    c.rect((x0 + 8.0, y - 2.0, x1 - 8.0, y - 0.6), |_, _| paint([0.65, 0.03, 0.03]));
    let (sx, sy) = (x0 + 26.0, y + 19.0);
    c.disc(sx, sy, 17.0, |x, y| {
        let a = (y - sy).arctangent(x - sx);
        // The star blends into grey where its spokes are finer than the samples.
        let sharp = (x - sx).length(y - sy) * 0.6;
        paint([0.445 + 0.415 * ((18.0 * a).sine() * sharp).clamp(-1.0, 1.0); 3])
    });
    let mut x = x0 + 50.0;
    for period in [6.0f32, 4.0, 3.0] {
        for k in 0..4 {
            let u = x + k as f32 * period;
            c.rect((u, y + 3.0, u + 0.5 * period, y + 17.0), |_, _| ink);
            c.rect((x, y + 20.0 + k as f32 * 0.95 * period, x + 3.5 * period, y + 20.0 + (k as f32 + 0.5) * 0.95 * period), |_, _| ink);
        }
        x += 4.0 * period + 4.0;
    }
    let colours = [[0.6, 0.05, 0.04], [0.75, 0.45, 0.03], [0.08, 0.42, 0.08], [0.03, 0.3, 0.55], [0.25, 0.06, 0.4]];
    for (k, colour) in colours.into_iter().enumerate() {
        let u = x0 + 8.0 + k as f32 * 20.0;
        c.rect((u, y1 - 12.0, u + 18.0, y1 - 5.0), |_, _| paint(colour));
    }
}

fn shelf(c: &mut Canvas, random: &mut Random, seed: u32) {
    let right = 186.0;
    let wood = |x: f32, y: f32| paint(times([0.26, 0.13, 0.055], 0.6 + 0.8 * texture(x / 40.0, y / 3.0, seed + 20)));
    c.rect((-1e4, -1e4, right, 1e4), |x, y| Ink { light: 0.35, ..wood(y, x) });
    let titles = [
        "OPTICS",
        "TENSOR",
        "NIGHT SKY",
        "LIGHT",
        "MAXWELL",
        "ATLAS",
        "HOLMES",
        "SHADOWS",
        "EULER",
        "ALHAZEN",
        "WAVES",
        "SONNETS",
        "KEPLER",
        "PRISM",
        "FOURIER",
        "COLOUR",
        "HERSCHEL",
        "ORCHIDS",
        "NEWTON",
        "LENSES",
        "DON JUAN",
        "HAMLET",
        "ODYSSEY",
        "MACBETH",
        "TIDES",
        "ALGEBRA",
    ];
    let dyes = [
        [0.42, 0.05, 0.04],
        [0.05, 0.14, 0.36],
        [0.06, 0.24, 0.09],
        [0.55, 0.36, 0.08],
        [0.30, 0.07, 0.25],
        [0.62, 0.58, 0.48],
        [0.04, 0.25, 0.28],
        [0.10, 0.09, 0.09],
        [0.58, 0.20, 0.05],
    ];
    let mut title = random.uniform(0.0, 26.0) as usize;
    for level in -1..6 {
        let floor = 62.0 + 76.0 * level as f32;
        let mut x = right - 12.0;
        while x > -90.0 {
            if random.uniform(0.0, 1.0) < 0.06 {
                x -= random.uniform(6.0, 14.0) as f32;
                continue;
            }
            let (wide, tall) = (random.uniform(8.5, 17.0) as f32, random.uniform(50.0, 65.0) as f32);
            let dye = dyes[random.uniform(0.0, dyes.len() as f64) as usize % dyes.len()];
            let left = x - wide;
            let bright = 0.2126 * dye[0] + 0.7152 * dye[1] + 0.0722 * dye[2] > 0.3;
            let foil = if bright { paint([0.06, 0.03, 0.02]) } else { paint([0.72, 0.58, 0.26]) };
            let middle = 0.5 * (left + x);
            c.rect((left, floor - tall, x, floor), |u, v| {
                let round = 1.0 - 0.55 * ((u - middle) / (0.5 * wide)).powi(4);
                let shade = smooth(floor - 70.0, floor - 50.0, v);
                Ink {
                    light: round * (0.35 + 0.65 * shade),
                    ..paint(times(dye, 0.75 + 0.5 * texture(u / 3.0, v / 3.0, seed + title as u32)))
                }
            });
            for v in [floor - tall + 4.0, floor - tall + 6.0, floor - 7.0, floor - 5.0] {
                c.rect((left + 0.8, v, x - 0.8, v + 0.8), |_, _| foil);
            }
            let text = titles[title % titles.len()];
            title += 7;
            let size = (0.5 * wide).min(6.5).min((tall - 18.0) / font::width(text, 1.0));
            c.text(text, middle - 0.5 * size, floor - 10.0, size, 0.09 * size, true, foil);
            x = left - 0.3;
        }
        c.rect((-1e4, floor, right, floor + 6.0), |x, y| Ink { light: if y > floor + 4.5 { 0.4 } else { 1.0 }, ..wood(x, y) });
    }
    c.rect((right - 9.0, -1e4, right, 1e4), |x, y| wood(y, x));
}

fn table(c: &mut Canvas, seed: u32) {
    let back = 322.0;
    c.rect((-1e4, back, 1e4, 1e4), |x, y| {
        let depth = (y - back) / 60.0;
        let plank = (x - 256.0) / (1.0 + 0.9 * depth);
        let seam = smooth(0.02, 0.04, (plank / 46.0).rem_euclid(1.0));
        let rings = texture(plank / 2.2, (y - back) / 30.0, seed + 40);
        paint(times(mix([0.20, 0.09, 0.035], [0.40, 0.21, 0.09], rings), 0.25 + 0.75 * seam))
    });
    c.rect((-1e4, back, 1e4, back + 1.2), |_, _| paint([0.5, 0.3, 0.15]));
    // A sheet with handwriting, seen flat.
    c.trapezium(210.0, (338.0, 58.0), (374.0, 76.0), |x, y| paint(times([0.80, 0.78, 0.68], 0.92 + 0.08 * texture(x / 4.0, y / 4.0, 31))));
    let ink = paint([0.04, 0.05, 0.16]);
    for (text, y, tall) in [
        ("BLUR IS THE PATH OF THE HAND", 342.5, 4.2),
        ("SHARP FRAMES ARE SHORT AND DIM", 350.5, 4.2),
        ("TOGETHER THEY ARE NEITHER", 358.5, 4.6),
        ("1/30 1/8 1/5 1/2 2 S", 367.0, 4.2),
    ] {
        c.centred(text, 210.0, y, tall, 0.4, ink);
    }
    // A box in the dark.
    c.rect((24.0, 296.0, 118.0, 352.0), |x, y| Ink {
        light: 0.45,
        ..paint(times([0.075, 0.06, 0.05], 0.8 + 0.4 * texture(x / 5.0, y / 5.0, 33)))
    });
    let faint = Ink { light: 0.45, ..paint([0.30, 0.27, 0.22]) };
    c.text("LOST IN", 34.0, 304.0, 10.0, 0.9, false, faint);
    c.text("SHADOW", 34.0, 319.0, 12.0, 1.1, false, faint);
    c.text("0123456789", 34.0, 338.0, 6.5, 0.6, false, faint);
    // A mug with stripes.
    let stripe = |x: f32, y: f32| {
        let round = ((x - 352.0) / 17.0).clamp(-1.0, 1.0);
        let red = smooth(-0.15, 0.15, ((y - 330.0) * 0.55).sine());
        Ink {
            light: 0.3 + 0.7 * (1.0 - round * round).sqrt() * (0.75 - 0.25 * round),
            ..paint(mix([0.75, 0.72, 0.66], [0.06, 0.20, 0.45], red))
        }
    };
    c.draw((360.0, 322.0, 384.0, 352.0), |x, y| ((x - 369.0).length(y - 336.0) - 8.5).abs() - 1.9, |_, _| paint([0.6, 0.58, 0.52]));
    c.trapezium(352.0, (318.0, 17.0), (354.0, 14.5), stripe);
    c.draw((334.0, 313.0, 370.0, 323.0), |x, y| ((x - 352.0).length(3.6 * (y - 318.0)) - 17.0) / 2.0, |_, _| paint([0.10, 0.06, 0.04]));
}

fn plant(c: &mut Canvas, random: &mut Random) {
    let root = (442.0, 300.0);
    let mut leaves: Vec<(f32, f32, f32, f32)> = (0..150)
        .map(|_| {
            let angle = random.uniform(-2.9, -0.25) as f32;
            let reach = random.uniform(12.0, 74.0) as f32;
            (angle, reach, random.uniform(9.0, 19.0) as f32, random.uniform(0.35, 1.25) as f32)
        })
        .collect();
    leaves.sort_by(|a, b| a.3.total_cmp(&b.3));
    for &(angle, reach, long, tone) in &leaves {
        let (x, y) = (root.0 + 0.85 * reach * angle.cosine(), root.1 + reach * angle.sine() + 0.006 * reach * reach * angle.cosine().abs());
        let (co, si) = ((angle + 0.7 * angle.cosine()).cosine(), (angle + 0.7 * angle.cosine()).sine());
        c.line(root, (x, y), 0.4, paint([0.05, 0.09, 0.03]));
        let wide = 0.2 * long;
        c.draw(
            (x - long, y - long, x + long, y + long),
            |u, v| {
                let (p, q) = ((u - x) * co + (v - y) * si, (v - y) * co - (u - x) * si);
                let t = p / (0.5 * long);
                q.abs().max(0.0) - wide * (1.0 - t * t).max(-1.0)
            },
            |u, v| {
                let (p, q) = ((u - x) * co + (v - y) * si, (v - y) * co - (u - x) * si);
                let vein = smooth(0.7, 0.25, q.abs()) + 0.5 * smooth(0.75, 0.95, ((p + q.abs()) * 1.6).sine());
                let side = if q > 0.0 { 1.0 } else { 0.7 };
                Ink { light: tone.min(1.0), ..paint(times(mix([0.07, 0.24, 0.05], [0.26, 0.42, 0.13], vein.min(1.0)), side * tone)) }
            },
        );
    }
    c.trapezium(442.0, (298.0, 25.0), (340.0, 18.0), |x, y| {
        let round = ((x - 442.0) / 25.0).clamp(-1.0, 1.0);
        let band = smooth(0.0, 0.3, ((y - 298.0) * 0.75).sine() * ((x - 442.0) * 0.45).sine());
        Ink {
            light: 0.25 + 0.75 * (1.0 - round * round).sqrt() * (0.7 - 0.3 * round),
            ..paint(mix([0.48, 0.17, 0.08], [0.70, 0.48, 0.25], band))
        }
    });
}

fn lamp(c: &mut Canvas) {
    let (x, y) = BULB;
    c.rect((x - 2.0, y + 8.0, x + 2.0, 330.0), |u, _| paint(times([0.75, 0.55, 0.2], 0.4 + 0.6 * smooth(-2.0, 0.5, u - x))));
    c.draw(
        (x - 22.0, 322.0, x + 22.0, 336.0),
        |u, v| ((u - x).length(3.4 * (v - 329.0)) - 20.0) / 2.5,
        |u, _| paint(times([0.75, 0.55, 0.2], 0.5 + 0.5 * smooth(-20.0, 4.0, u - x))),
    );
    c.disc(x, y, 4.6, |u, v| glow(times([1.0, 0.78, 0.48], 40.0 * (1.25 - 0.06 * ((u - x).length(v - y)).powi(2)).max(0.2))));
    c.trapezium(x, (206.0, 19.0), (256.0, 37.0), |u, v| {
        let near = 1.0 / (1.0 + ((u - x) / 26.0).powi(2) + ((v - 246.0) / 26.0).powi(2));
        let pleat = 0.82 + 0.18 * ((u - x) / (19.0 + 18.0 * (v - 206.0) / 50.0) * 40.0).sine();
        let weave = 0.9 + 0.2 * grain(u * 1.5, v * 1.5, 51);
        glow(times([1.0, 0.60, 0.24], 1.7 * near * pleat * weave))
    });
    for (v, half) in [(206.0, 19.0), (254.5, 37.0)] {
        c.rect((x - half, v, x + half, v + 1.8), |_, _| glow([0.30, 0.13, 0.04]));
    }
    // A string of small bulbs across the wall: points that write the path of the hand into a shaken frame.
    let wire = |x: f32| 190.0 + 0.0009 * (x - 300.0).powi(2) + 6.0 * (x / 31.0).sine();
    for i in 0..200 {
        let u = 186.0 + 2.0 * i as f32;
        c.line((u, wire(u)), (u + 2.0, wire(u + 2.0)), 0.45, paint([0.02, 0.03, 0.02]));
    }
    let colours = [[9.0, 1.0, 0.6], [8.0, 5.5, 0.8], [0.9, 6.5, 1.2], [0.9, 2.0, 9.0], [7.0, 1.2, 7.0]];
    for i in 0..13 {
        let u = 194.0 + 29.0 * i as f32;
        if (u - x).abs() < 38.0 {
            continue;
        }
        c.line((u, wire(u)), (u, wire(u) + 3.0), 1.0, paint([0.03, 0.04, 0.03]));
        c.disc(u, wire(u) + 4.4, 1.7, |_, _| glow(times(colours[i % 5], 1.5)));
    }
}

/// Lights what was drawn: the lamp's two cones and its shade's glow, the dusk from the window, moonlight from behind.
fn light(c: &Canvas, margin: usize, oversampling: usize) -> Scene {
    c.lit(margin, oversampling, |x, y, ink| {
        // The bulb hangs this far before the wall; inverse square times the cosine, 1 at the nearest point.
        let away = 62.0;
        let (dx, dy) = (x - BULB.0, y - BULB.1);
        let r2 = dx * dx + dy * dy + away * away;
        let falloff = away.powi(3) / r2.power(1.5);
        let up = smooth(0.50, 0.60, -(dy + 6.0) / r2.sqrt());
        let down = smooth(0.10, 0.26, (dy + 2.0) / r2.sqrt());
        let lamp = falloff * (0.16 + up.max(down));
        let dusk = 0.035 * (1.0 / (1.0 + ((x - 275.0) / 120.0).powi(2) + ((y - 250.0) / 110.0).powi(2)));
        let picture = 0.10 * smooth(90.0, 20.0, (x - 437.0).abs()) * smooth(330.0, 20.0, y) * smooth(-40.0, 30.0, y);
        let lit: Colour = std::array::from_fn(|k| {
            ink.light * (lamp * [1.0, 0.70, 0.40][k] + dusk * [0.8, 0.8, 1.0][k] + picture * [1.0, 0.88, 0.66][k])
                + 0.0025 * [0.7, 0.9, 1.3][k]
        });
        std::array::from_fn(|k| ink.albedo[k] * lit[k] + ink.emission[k] + 2e-5)
    })
}
