//! Hot pixels: sites of the sensor that are bright whatever falls on them.
//!
//! A hot pixel is a bright spot at the same place of the sensor in every frame. Where two frames are displaced against each other the scene is not: a star or a lamp that one frame shows
//! at p is shown by the other at q, and what the other shows at p the first shows at q'. Of a hot pixel each frame shows more at p than at where the scene would have it. Of two lamps
//! that meet at p by chance neither can be the brighter one in both frames, so that the comparison needs no line. Where q or q' is outside the frame the other one decides. Frames in
//! one place tell nothing, and keep what they show.

use crate::error::Result;
use crate::exposure::{Bracket, Frame};
use crate::image::{Plane, Rgb};
use crate::noise;
use crate::pose::nearest_pixel;
use crate::register;
use glam::DMat3;
use rayon::prelude::*;
use std::collections::BTreeSet;

/// Distance in pixels of the ring that a spot is compared with: farther than demosaicing and an engine spread one site.
const RING: isize = 3;
/// Standard deviations by which a spot is brighter than its ring, those of the noise at the ring's level and of the ring itself together: noise that is estimated six times too low still leaves five.
const CLEAR: f64 = 12.0;
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

/// Values of the ring around (x, y).
fn around(plane: &Plane, x: isize, y: isize) -> Vec<f64> {
    ring(RING).map(|(i, j)| f64::from(plane.clamped(x + i, y + j))).collect()
}

/// The most that any of the 3 x 3 pixels around the pixel `p` is brighter than the ring around it.
fn excess(plane: &Plane, p: usize) -> f64 {
    let (x, y) = ((p % plane.width) as isize, (p / plane.width) as isize);
    let one = |i: isize, j: isize| f64::from(plane.clamped(i, j)) - median(&mut around(plane, i, j));
    (y - 1..=y + 1).flat_map(|j| (x - 1..=x + 1).map(move |i| (i, j))).map(|(i, j)| one(i, j)).fold(f64::MIN, f64::max)
}

/// Pixels of one channel, whose noise has the standard deviations `curve`, that are isolated bright spots.
fn spots(plane: &Plane, curve: &[f32]) -> Vec<usize> {
    let (w, h) = (plane.width as isize, plane.height as isize);
    let is_spot = |x: isize, y: isize| {
        let v = plane.clamped(x, y);
        if ring(1).any(|(i, j)| plane.clamped(x + i, y + j) > v) {
            return false;
        }
        let v = f64::from(v);
        if v - f64::from(plane.clamped(x + RING, y)) < CLEAR * f64::from(noise::at(curve, 0.0)) {
            return false;
        }
        let mut around = around(plane, x, y);
        // With the spot itself: one photon in 25 pixels is no level of 0.
        let mean = (v + around.iter().sum::<f64>()) / (1 + around.len()) as f64;
        let level = median(&mut around);
        around.iter_mut().for_each(|v| *v = (*v - level).abs());
        let deviation = f64::from(noise::at(curve, mean as f32)).hypot(1.4826 * median(&mut around));
        let beside = ring(2).map(|(i, j)| f64::from(plane.clamped(x + i, y + j))).sum::<f64>() / 16.0;
        v - level > CLEAR * deviation && beside - level < SPREAD * (v - level)
    };
    (0..h).into_par_iter().flat_map_iter(|y| (0..w).filter(move |&x| is_spot(x, y)).map(move |x| (y * w + x) as usize)).collect()
}

/// Places of hot pixels that `exposures` show, of the frames `ids`, which lie at `motions` from the reference (centred pixels). `curves`: the standard deviations of their noise, see
/// [`noise::curves`].
pub fn find(exposures: &[Rgb], curves: &[[Vec<f32>; 3]], ids: &[usize], motions: &[DMat3]) -> Vec<usize> {
    let Some(first) = ids.first() else { return Vec::new() };
    let (w, h) = exposures[*first].size();
    let displaced = |i: usize, k: usize| register::distance(&motions[i], &motions[k], w, h).1 >= DISPLACED;
    if !ids.iter().any(|&i| displaced(*first, i)) {
        return Vec::new();
    }
    let of_channel = |c: usize| {
        let planes: Vec<&Plane> = ids.iter().map(|&i| &exposures[i].0[c]).collect();
        let spots: Vec<Vec<usize>> = ids.iter().map(|&i| spots(&exposures[i].0[c], &curves[i][c])).collect();
        let near = |k: usize, p: usize| {
            let (x, y) = (p % w, p / w);
            (y.saturating_sub(1)..=y + 1).any(|j| {
                let next = spots[k].partition_point(|&s| s < j * w + x.saturating_sub(1));
                spots[k].get(next).is_some_and(|&s| s <= j * w + x + 1)
            })
        };
        // The excess of frame `a` where it shows what frame `b` shows at `p`; `None` outside it or too near.
        let elsewhere = |a: usize, b: usize, p: usize| {
            let q = nearest_pixel(&(motions[ids[a]] * motions[ids[b]].inverse()), w, h, p % w, p / w)?;
            let (dx, dy) = ((q % w) as f64 - (p % w) as f64, (q / w) as f64 - (p / w) as f64);
            (dx.hypot(dy) >= DISPLACED).then(|| excess(planes[a], q))
        };
        let stays = |a: usize, b: usize, p: usize| {
            let compared = [(a, elsewhere(a, b, p)), (b, elsewhere(b, a, p))];
            let brighter = |&(k, scene): &(usize, Option<f64>)| scene.is_none_or(|v| excess(planes[k], p) > BRIGHTER * v);
            compared.iter().any(|c| c.1.is_some()) && compared.iter().all(brighter)
        };
        let frames = 0..ids.len();
        let hot = |a: usize, p: usize| frames.clone().any(|b| b != a && near(b, p) && stays(a, b, p));
        frames.clone().flat_map(|a| spots[a].iter().copied().filter(|&p| hot(a, p)).collect::<Vec<_>>()).collect::<Vec<_>>()
    };
    let mut places: Vec<usize> = (0..3).flat_map(of_channel).collect();
    places.sort_unstable();
    places.dedup();
    places
}

/// How many sites of a sensor `width` pixels wide show at `places`: demosaicing and an engine make spots of some, which differ between the channels by a pixel or two.
pub fn sites(places: &[usize], width: usize) -> usize {
    let near = |a: usize, b: usize| (a % width).abs_diff(b % width).max((a / width).abs_diff(b / width)) <= 2;
    let mut kept: Vec<usize> = Vec::new();
    for &p in places {
        if !kept.iter().any(|&k| near(k, p)) {
            kept.push(p);
        }
    }
    kept.len()
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
    let square = |p: usize, r: isize| {
        let (x, y) = (p as isize % w, p as isize / w);
        (-r..=r).flat_map(move |j| (-r..=r).map(move |i| (x + i, y + j))).filter(move |&(i, j)| i >= 0 && j >= 0 && i < w && j < h)
    };
    let spoilt: BTreeSet<(isize, isize)> = places.iter().flat_map(|&p| square(p, radius)).collect();
    let mut out = z.clone();
    for &p in places {
        let known: Vec<(isize, isize)> = square(p, radius + 1).filter(|q| !spoilt.contains(q)).collect();
        for (x, y) in square(p, radius).filter(|_| !known.is_empty()) {
            let (sum, total) = known.iter().fold((0.0, 0.0), |(sum, total), &(i, j)| {
                let weight = 1.0 / ((i - x).pow(2) + (j - y).pow(2)) as f64;
                (sum + weight * f64::from(z.clamped(i, j)), total + weight)
            });
            out.data[(y * w + x) as usize] = (sum / total) as f32;
        }
    }
    out
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::noise::NoiseModel;
    use crate::random::Random;
    use crate::response::Response;
    use glam::DVec2;

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

    const CLEAN: NoiseModel = NoiseModel { shot: 1e-5, read: 1e-7 };

    /// What [`find`] makes of two linear `frames` of so much noise that lie at `motions`.
    fn found(frames: &[Frame; 2], level: NoiseModel, motions: &[DMat3; 2]) -> Vec<usize> {
        let exposures = frames.each_ref().map(|f| noise::exposure(f, &Response::Linear));
        find(&exposures, &noise::curves(frames, &Response::Linear, &noise::alike(2, level)), &[0, 1], motions)
    }

    fn place(x: usize, y: usize) -> usize {
        y * SIZE.0 + x
    }

    #[test]
    fn a_hot_pixel_stays_in_place_and_a_star_moves_with_the_scene() {
        // The second frame shows the scene 9 px to the right.
        let motions = [DMat3::IDENTITY, DMat3::from_translation(DVec2::new(9.0, 0.0))];
        let frames = [frame(0.1, &[(30.0, 20.0, 0.7), (50.0, 40.0, 0.6)]), frame(0.4, &[(30.0, 20.0, 0.7), (59.0, 40.0, 0.8)])];
        assert_eq!(found(&frames, CLEAN, &motions), [place(30, 20)]);
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
        assert_eq!(found(&frames, CLEAN, &motions), Vec::<usize>::new());
    }

    #[test]
    fn frames_in_one_place_tell_nothing() {
        let frames = [frame(0.1, &[(30.0, 20.0, 0.7)]), frame(0.4, &[(30.0, 20.0, 0.8)])];
        assert_eq!(found(&frames, CLEAN, &[DMat3::IDENTITY; 2]), Vec::<usize>::new());
    }

    #[test]
    fn a_site_counts_once() {
        let spot = [place(30, 20), place(29, 21), place(31, 21), place(30, 22)];
        assert_eq!(sites(&spot, SIZE.0), 1);
        assert_eq!(sites(&[place(79, 20), place(0, 21), place(40, 50)], SIZE.0), 3, "the next row begins at the other side");
    }

    #[test]
    fn what_is_around_fills_the_place_at_borders_too() {
        let one = Plane::from_fn(5, 1, |x, _| if x == 0 { 1.0 } else { 0.25 });
        assert_eq!(without(&one, &[0], 1).data, [0.25; 5]);
        let only = Plane::from_fn(1, 1, |_, _| 1.0);
        assert_eq!(without(&only, &[0], 1).data, [1.0], "nothing is known");
    }

    /// In a dark frame at a high speed most pixels read 0 and the rest are spikes, which meet by chance.
    #[test]
    fn noise_clipped_at_black_has_no_hot_pixels() {
        let frame = |seed: u64| {
            let mut random = Random::new(seed, 0);
            let mut plane = || Plane {
                width: SIZE.0,
                height: SIZE.1,
                data: (0..SIZE.0 * SIZE.1).map(|_| 0.02 * random.poisson(0.05) as f32).collect(),
            };
            Frame { intensity: Rgb([plane(), plane(), plane()]), ..frame(0.1, &[]) }
        };
        let (frames, motions) = ([frame(1), frame(2)], [DMat3::IDENTITY, DMat3::from_translation(DVec2::new(9.0, 0.0))]);
        assert_eq!(found(&frames, NoiseModel { shot: 0.02, read: 1e-6 }, &motions), Vec::<usize>::new());
        assert!(!found(&frames, CLEAN, &motions).is_empty(), "spikes that the noise does not explain pass for hot pixels");
    }
}
