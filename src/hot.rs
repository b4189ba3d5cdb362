//! Hot pixels: sites of the sensor that are bright whatever falls on them.
//!
//! A hot pixel is a bright spot at the same place of the sensor in every frame. Where two frames are displaced against each other the scene is not: a star or a lamp that one frame shows
//! at p is shown by the other at q, and what the other shows at p the first shows at q'. Of a hot pixel each frame shows more at p than at where the scene would have it. Of two lamps
//! that meet at p by chance neither can be the brighter one in both frames, so that the comparison needs no line. Where q or q' is outside the frame the other one decides. Frames in
//! one place tell nothing, and keep what they show.

use crate::error::Result;
use crate::exposure::{Bracket, Frame};
use crate::image::Plane;
use crate::pose::project;
use glam::{DMat3, DVec2};
use rayon::prelude::*;

/// Distance in pixels of the ring that a spot is compared with: farther than demosaicing and an engine spread one site.
const RING: isize = 3;
/// Standard deviations of the ring, from the median of its absolute deviations, by which a spot is brighter than that.
const CLEAR: f64 = 12.0;
/// Least excess of a spot over its ring, part of white: what is less hardly shows.
const LEAST: f64 = 0.08;
/// Most of that excess that pixels at a distance of 2 have on average.
const SPREAD: f64 = 0.3;
/// Displacement in pixels from which two frames show different parts of the scene at one place of the sensor.
const DISPLACED: f64 = 4.0;
/// How many times as much a frame shows at a hot pixel's place as where the scene would have it.
const BRIGHTER: f64 = 1.5;

/// Pixels at the Chebyshev distance `r` from the centre.
fn ring(r: isize) -> impl Iterator<Item = (isize, isize)> {
    (-r..=r).flat_map(move |j| (-r..=r).map(move |i| (i, j))).filter(move |(i, j)| i.abs().max(j.abs()) == r)
}

fn median(v: &mut [f64]) -> f64 {
    let middle = v.len() / 2;
    *v.select_nth_unstable_by(middle, f64::total_cmp).1
}

/// How much brighter than the ring around it the pixel (x, y) is, and the ring's standard deviation.
fn excess(z: &Plane, x: isize, y: isize) -> (f64, f64) {
    let at = |i: isize, j: isize| f64::from(z.clamped(x + i, y + j));
    let mut around: Vec<f64> = ring(RING).map(|(i, j)| at(i, j)).collect();
    let level = median(&mut around);
    around.iter_mut().for_each(|v| *v = (*v - level).abs());
    (at(0, 0) - level, 1.4826 * median(&mut around))
}

/// The most that any of the 3 x 3 pixels around (x, y) is brighter than the ring around it.
fn most_excess(z: &Plane, x: isize, y: isize) -> f64 {
    (-1..=1).flat_map(|j| (-1..=1).map(move |i| (i, j))).map(|(i, j)| excess(z, x + i, y + j).0).fold(f64::MIN, f64::max)
}

/// Pixels of one channel that are isolated bright spots.
fn spots(z: &Plane) -> Vec<usize> {
    let (w, h) = (z.width as isize, z.height as isize);
    let is_spot = |x: isize, y: isize| {
        let v = z.clamped(x, y);
        if ring(1).any(|(i, j)| z.clamped(x + i, y + j) > v) {
            return false;
        }
        let far = [(RING, 0), (-RING, 0), (0, RING), (0, -RING)].map(|(i, j)| f64::from(z.clamped(x + i, y + j)));
        if f64::from(v) - far.iter().sum::<f64>() / 4.0 < 0.5 * LEAST {
            return false;
        }
        let (over, deviation) = excess(z, x, y);
        let beside = ring(2).map(|(i, j)| f64::from(z.clamped(x + i, y + j))).sum::<f64>() / 16.0;
        over > LEAST.max(CLEAR * deviation) && beside - (f64::from(v) - over) < SPREAD * over
    };
    (0..h).into_par_iter().flat_map_iter(|y| (0..w).filter(move |&x| is_spot(x, y)).map(move |x| (y * w + x) as usize)).collect()
}

/// Places of hot pixels that the frames `ids`, which lie at `motions` from the reference (centred pixels), show.
pub fn find(frames: &[Frame], ids: &[usize], motions: &[DMat3]) -> Vec<usize> {
    let Some(first) = ids.first() else { return Vec::new() };
    let (w, h) = frames[*first].intensity.size();
    let centre = 0.5 * DVec2::new(w as f64 - 1.0, h as f64 - 1.0);
    let displaced = |i: usize, k: usize| {
        let motion = motions[k] * motions[i].inverse();
        [DVec2::ZERO, centre, -centre].iter().any(|p| project(&motion, *p).distance(*p) >= DISPLACED)
    };
    if !ids.iter().any(|&i| ids.iter().any(|&k| k > i && displaced(i, k))) {
        return Vec::new();
    }
    let mut places: Vec<usize> = (0..3)
        .flat_map(|c| {
            let of: Vec<Vec<usize>> = ids.iter().map(|&i| spots(&frames[i].intensity.0[c])).collect();
            let near = |k: usize, p: usize| {
                let (x, y) = (p % w, p / w);
                (y.saturating_sub(1)..=y + 1).any(|j| {
                    let row = of[k].partition_point(|&s| s < j * w + x.saturating_sub(1))..;
                    of[k][row].first().is_some_and(|&s| s <= j * w + x + 1)
                })
            };
            // Of frame `a` at the place that shows in it what frame `b` shows at (x, y); `None` outside it or too near.
            let elsewhere = |a: usize, b: usize, x: isize, y: isize| -> Option<f64> {
                let motion = motions[ids[a]] * motions[ids[b]].inverse();
                let p = DVec2::new(x as f64, y as f64);
                let q = project(&motion, p - centre) + centre;
                let inside = q.x >= 1.0 && q.y >= 1.0 && q.x <= w as f64 - 2.0 && q.y <= h as f64 - 2.0;
                let far = q.distance(p) >= DISPLACED;
                (inside && far).then(|| most_excess(&frames[ids[a]].intensity.0[c], q.x.round() as isize, q.y.round() as isize))
            };
            let is_hot = |a: usize, p: usize| {
                let (x, y) = ((p % w) as isize, (p / w) as isize);
                let here = |k: usize| most_excess(&frames[ids[k]].intensity.0[c], x, y);
                (0..ids.len()).filter(|&b| b != a && near(b, p)).any(|b| {
                    let compared = [(a, elsewhere(a, b, x, y)), (b, elsewhere(b, a, x, y))];
                    compared.iter().any(|c| c.1.is_some()) && compared.iter().all(|&(k, of)| of.is_none_or(|v| here(k) > BRIGHTER * v))
                })
            };
            (0..ids.len()).flat_map(|a| of[a].iter().copied().filter(|&p| is_hot(a, p)).collect::<Vec<_>>()).collect::<Vec<_>>()
        })
        .collect();
    places.sort_unstable();
    places.dedup();
    places
}

/// The bracket with what demosaicing, and an engine where the files are lossy, spread of the hot pixels at `places` replaced by what is around.
///
/// # Errors
/// As [`Bracket::new`], if a frame held nothing else.
pub fn repaired(bracket: &Bracket, places: &[usize]) -> Result<Bracket> {
    let one = |frame: &Frame| {
        let radius = if frame.lossy { 2 } else { 1 };
        let intensity = frame.intensity.map_planes(|z| without(z, places, radius));
        Frame { intensity, name: frame.name.clone(), ..*frame }
    };
    Bracket::new(bracket.frames().par_iter().map(one).collect())
}

/// `z` with the pixels up to `radius` from `places` as the pixels around those, the nearer the more.
fn without(z: &Plane, places: &[usize], radius: isize) -> Plane {
    let (w, h) = (z.width as isize, z.height as isize);
    let mut spoilt = vec![false; z.data.len()];
    let around = |p: usize, r: isize| {
        let (x, y) = (p as isize % w, p as isize / w);
        (-r..=r).flat_map(move |j| (-r..=r).map(move |i| (x + i, y + j))).filter(move |&(i, j)| i >= 0 && j >= 0 && i < w && j < h)
    };
    for &p in places {
        around(p, radius).for_each(|(i, j)| spoilt[(j * w + i) as usize] = true);
    }
    let mut out = z.clone();
    for &p in places {
        let known: Vec<(isize, isize, f64)> = around(p, radius + 1)
            .filter(|&(i, j)| !spoilt[(j * w + i) as usize])
            .map(|(i, j)| (i, j, f64::from(z.data[(j * w + i) as usize])))
            .collect();
        for (x, y) in around(p, radius).filter(|_| !known.is_empty()) {
            let (sum, total) = known.iter().fold((0.0, 0.0), |(sum, total), &(i, j, v)| {
                let weight = 1.0 / ((i - x).pow(2) + (j - y).pow(2)) as f64;
                (sum + weight * v, total + weight)
            });
            out.data[(y * w + x) as usize] = (sum / total) as f32;
        }
    }
    out
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::image::Rgb;

    const SIZE: (usize, usize) = (80, 60);

    /// A frame of a dim ramp with spots of 3 x 3 pixels, which demosaicing makes of one site.
    fn frame(exposure_time: f64, spots: &[(f64, f64, f32)]) -> Frame {
        let plane = Plane::from_fn(SIZE.0, SIZE.1, |x, y| {
            let ramp = 0.1 + 0.001 * x as f32 + 0.003 * ((x * 7 + y * 13) % 5) as f32;
            spots.iter().fold(ramp, |v, (i, j, height)| {
                let near = |d: f64| (1.0 - 0.5 * d.abs()).max(0.0) as f32;
                let d = ((x as f64 - i), (y as f64 - j));
                v + if d.0.abs() < 2.0 && d.1.abs() < 2.0 { height * near(d.0) * near(d.1) } else { 0.0 }
            })
        });
        let intensity = Rgb([plane.clone(), plane.clone(), plane]);
        Frame { name: "f".into(), intensity, levels: 65535, chroma_subsampled: false, lossy: false, speed: None, exposure_time }
    }

    fn place(x: usize, y: usize) -> usize {
        y * SIZE.0 + x
    }

    #[test]
    fn a_hot_pixel_stays_in_place_and_a_star_moves_with_the_scene() {
        // The second frame shows the scene 9 px to the right.
        let motions = [DMat3::IDENTITY, DMat3::from_translation(DVec2::new(9.0, 0.0))];
        let frames = [frame(0.1, &[(30.0, 20.0, 0.7), (50.0, 40.0, 0.6)]), frame(0.4, &[(30.0, 20.0, 0.7), (59.0, 40.0, 0.8)])];
        assert_eq!(find(&frames, &[0, 1], &motions), [place(30, 20)]);
        let repaired = repaired(&Bracket::new(frames.to_vec()).unwrap(), &[place(30, 20)]).unwrap();
        let kept = &repaired.frames()[0].intensity.0[1];
        assert!((kept.at(30, 20) - 0.13).abs() < 0.02 && (kept.at(31, 21) - 0.13).abs() < 0.02, "{}", kept.at(30, 20));
        assert!(kept.at(50, 40) > 0.7, "the star stays");
    }

    #[test]
    fn lamps_that_meet_by_chance_stay() {
        // A chain of lamps as far apart as the frames are displaced: every place but the ends' shows one in both.
        let motions = [DMat3::IDENTITY, DMat3::from_translation(DVec2::new(10.0, 0.0))];
        let lamps = |from: f64| -> Vec<(f64, f64, f32)> {
            [0.7, 0.4, 0.6, 0.5].iter().enumerate().map(|(k, v)| (from + 10.0 * k as f64, 30.0, *v)).collect()
        };
        let frames = [frame(0.1, &lamps(15.0)), frame(0.2, &lamps(25.0))];
        assert_eq!(find(&frames, &[0, 1], &motions), Vec::<usize>::new());
    }

    #[test]
    fn frames_in_one_place_tell_nothing() {
        let frames = [frame(0.1, &[(30.0, 20.0, 0.7)]), frame(0.4, &[(30.0, 20.0, 0.8)])];
        assert_eq!(find(&frames, &[0, 1], &[DMat3::IDENTITY; 2]), Vec::<usize>::new());
    }

    #[test]
    fn what_is_around_fills_the_place_at_borders_too() {
        let one = Plane::from_fn(5, 1, |x, _| if x == 0 { 1.0 } else { 0.25 });
        assert_eq!(without(&one, &[0], 1).data, [0.25; 5]);
        let only = Plane::from_fn(1, 1, |_, _| 1.0);
        assert_eq!(without(&only, &[0], 1).data, [1.0], "nothing is known");
    }
}
