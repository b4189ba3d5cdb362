//! A chart of text, a star and gratings on white board: the left in lamplight, the right in deep shadow, a bare bulb above.

use super::Scene;
use super::canvas::{Canvas, EVERYWHERE, Ink, glow, grain, mix, paint, smooth, texture, times};
use crate::maths::Portable;
use crate::random::Random;

const BULB: (f32, f32) = (96.0, 40.0);
const LINES: [(&str, f32); 11] = [
    ("HAND HELD", 30.0),
    ("SHARP AND SHAKEN", 19.0),
    ("EXPOSURE 1/30 1/8 1/5 S", 13.0),
    ("THE QUICK BROWN FOX JUMPS", 10.5),
    ("OVER THE LAZY DOG 0123456789", 8.6),
    ("SPHINX OF BLACK QUARTZ, JUDGE MY VOW", 7.2),
    ("PACK MY BOX WITH FIVE DOZEN LIQUOR JUGS", 6.2),
    ("HOW VEXINGLY QUICK DAFT ZEBRAS JUMP (1+1=2)", 5.2),
    ("THE FIVE BOXING WIZARDS JUMP QUICKLY 3.14159265", 4.6),
    ("WALTZ, BAD NYMPH, FOR QUICK JIGS VEX - 2.71828", 4.0),
    ("GLIB JOCKS QUIZ NYMPH TO VEX DWARF! 1.41421", 3.6),
];

pub(super) fn chart(width: usize, height: usize, margin: usize, oversampling: usize, seed: u64) -> Scene {
    let mut c = Canvas::new(width, height, margin, oversampling);
    let mut random = Random::new(seed, 11);
    let noise = random.uniform(0.0, 1e6) as u32;
    // The wall round the board, brick by brick.
    c.draw(
        EVERYWHERE,
        |_, _| -1.0,
        |x, y| {
            let row = (y / 14.0).floor();
            let u = (x / 30.0 + 0.5 * row.rem_euclid(2.0)).rem_euclid(1.0) * 30.0;
            let joint = smooth(0.6, 1.4, u.min(30.0 - u).min((y / 14.0).rem_euclid(1.0) * 14.0));
            let tone = 0.6 + 0.8 * texture(x / 6.0, y / 6.0, noise);
            paint(times(mix([0.30, 0.29, 0.27], [0.42, 0.17, 0.10], joint), tone))
        },
    );
    let board = (30.0, 62.0, 482.0, 372.0);
    c.rect((board.0 + 5.0, board.1 + 6.0, board.2 + 6.0, board.3 + 7.0), |_, _| Ink { light: 0.2, ..paint([0.2, 0.12, 0.1]) });
    c.rect(board, |x, y| paint(times([0.86, 0.85, 0.80], 0.94 + 0.12 * (texture(x / 3.0, y / 3.0, noise + 9) - 0.5))));
    let black = paint([0.03; 3]);
    let mut y = board.1 + 9.0;
    for (text, tall) in LINES {
        c.text(text, board.0 + 10.0, y, tall, tall / 13.0, false, black);
        // The same words in the shadowed half, from the right edge.
        y += tall + 5.0;
    }
    // Lines of small text up the right edge, in the shadow.
    for (k, text) in ["IN THE SHADOW ONLY", "THE SHAKEN FRAMES", "CAN READ THIS LINE", "0123456789 ABCDEF"].into_iter().enumerate() {
        c.text(text, 408.0 + 17.0 * k as f32, 246.0, 10.0 - 1.5 * k as f32, 0.75 - 0.1 * k as f32, true, black);
    }
    for (sx, sy, r) in [(120.0, 318.0, 42.0), (430.0, 312.0, 42.0)] {
        c.disc(sx, sy, r, |x, y| {
            let a = (y - sy).arctangent(x - sx);
            // The star blends into grey where its spokes are finer than the samples.
            let sharp = (x - sx).length(y - sy) * 0.5;
            paint([0.445 + 0.415 * ((36.0 * a).sine() * sharp).clamp(-1.0, 1.0); 3])
        });
    }
    let mut x = 176.0;
    for period in [8.0f32, 6.0, 4.0, 3.0] {
        for k in 0..5 {
            let u = x + k as f32 * period;
            c.rect((u, 286.0, u + 0.5 * period, 312.0), |_, _| black);
            let v = 320.0 + k as f32 * period;
            c.rect((x, v, x + 4.5 * period, v + 0.5 * period), |_, _| black);
        }
        x += 5.0 * period + 7.0;
    }
    // A slanted edge, five degrees off upright.
    c.draw(
        (326.0, 284.0, 372.0, 364.0),
        |x, y| (x - 349.0 + 0.0875 * (y - 324.0)).max(326.0 - x).max(284.0 - y).max(y - 364.0),
        |_, _| black,
    );
    for k in 0..12 {
        let colour = [[0.6, 0.05, 0.04], [0.75, 0.45, 0.03], [0.08, 0.42, 0.08], [0.03, 0.3, 0.55], [0.25, 0.06, 0.4], [0.5; 3]][k % 6];
        let u = 64.0 + 24.0 * k as f32;
        c.rect((u, 364.0, u + 21.0, 370.0), |x, y| paint(times(colour, 0.9 + 0.2 * grain(x, y, noise))));
    }
    c.rect((BULB.0 - 0.7, -1e4, BULB.0 + 0.7, BULB.1 - 6.0), |_, _| paint([0.05; 3]));
    c.disc(BULB.0, BULB.1 - 8.0, 4.0, |_, _| paint([0.4, 0.35, 0.3]));
    c.disc(BULB.0, BULB.1, 6.5, |x, y| {
        glow(times([1.0, 0.82, 0.55], 60.0 * (1.2 - 0.025 * ((x - BULB.0) * (x - BULB.0) + (y - BULB.1) * (y - BULB.1))).max(0.2)))
    });
    c.lit(margin, oversampling, |x, y, ink| {
        let (dx, dy) = (x - BULB.0, y - BULB.1);
        let r2 = dx * dx + dy * dy + 70.0 * 70.0;
        // A screen beside the lamp throws a slanted, soft-edged shadow over the right half.
        let open = smooth(14.0, -14.0, x - 285.0 - 0.45 * (y - 62.0));
        let lamp = 343_000.0 / r2.power(1.5) * open;
        let lit = |k: usize| ink.light * lamp * [1.0, 0.76, 0.48][k] + 0.0012 * [0.7, 0.9, 1.3][k];
        std::array::from_fn(|k| ink.albedo[k] * lit(k) + ink.emission[k])
    })
}
