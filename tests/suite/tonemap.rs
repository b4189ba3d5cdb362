//! Tone mapping: degenerate images, shadows and highlights together, no halos.

use unshaken::image::{Plane, Rgb};
use unshaken::tonemap::{ToneMap, preview};

fn grey(width: usize, height: usize, f: impl Fn(usize, usize) -> f32) -> Rgb {
    let plane = Plane::from_fn(width, height, f);
    Rgb([plane.clone(), plane.clone(), plane])
}

#[test]
fn awkward_images_give_pictures() {
    for image in [
        Rgb::filled(1, 1, 0.0),
        Rgb::filled(1, 1, 3.0),
        Rgb::filled(40, 30, 0.0),
        Rgb::filled(1, 50, 1e30),
        Rgb::filled(33, 1, 1e-30),
        Rgb::filled(5, 5, f32::MAX),
        Rgb::filled(5, 5, f32::NAN),
        Rgb::filled(5, 5, f32::INFINITY),
        Rgb::filled(5, 5, -1.0),
        grey(64, 64, |x, y| if (x, y) == (9, 9) { 1e20 } else { 0.0 }),
        grey(64, 64, |x, _| 10f32.powf(x as f32 - 32.0)),
    ] {
        let picture = preview(&image);
        assert_eq!((picture.width() as usize, picture.height() as usize), image.size());
    }
    assert!(preview(&Rgb::filled(8, 8, 0.0)).pixels().all(|p| p.0 == [0; 3]), "black stays black");
    assert!(preview(&Rgb::filled(8, 8, 1.0)).pixels().all(|p| p.0[0] > 80 && p.0[0] < 180), "an even grey is a middle grey");
}

#[test]
fn a_channel_that_is_no_number_is_black() {
    for bad in [f32::NAN, f32::INFINITY, -3.0] {
        let mut image = Rgb::filled(6, 6, 1.0);
        image.0[0].data[7] = bad;
        let p = preview(&image).get_pixel(1, 1).0;
        assert!(p[0] == 0 && p[1] > 60 && p[1] == p[2], "{bad}: {p:?}");
    }
}

#[test]
fn four_decades_show_at_once() {
    // Nine steps of half a decade, 24 px each, with a fine texture of 20 %.
    let level = |x: usize| 10f32.powf(0.5 * (x / 24) as f32 - 2.0);
    let picture = preview(&grey(216, 64, |x, y| level(x) * if (x / 3 + y / 3) % 2 == 0 { 1.1 } else { 0.9 }));
    let mut last = 0.0;
    for step in 0..9 {
        let codes: Vec<f64> = (0..64)
            .flat_map(|y| (24 * step + 6..24 * step + 18).map(move |x| (x, y)))
            .map(|(x, y)| f64::from(picture.get_pixel(x, y).0[1]))
            .collect();
        let mean = codes.iter().sum::<f64>() / codes.len() as f64;
        let contrast = (codes.iter().map(|v| (v - mean).powi(2)).sum::<f64>() / codes.len() as f64).sqrt() / mean;
        assert!(mean > last + 4.0, "step {step}: {mean} after {last}");
        assert!(mean > 12.0 && mean < 250.0, "step {step}: {mean}");
        assert!(contrast > 0.015, "step {step}: the texture is lost, {contrast}");
        last = mean;
    }
}

#[test]
fn no_halo_at_a_strong_edge() {
    let picture = preview(&grey(240, 60, |x, _| if x < 120 { 0.01 } else { 30.0 }));
    for (range, far) in [(60..120, 10), (120..180, 230)] {
        for x in range {
            let (a, b) = (i32::from(picture.get_pixel(x, 30).0[0]), i32::from(picture.get_pixel(far, 30).0[0]));
            assert!((a - b).abs() <= 3, "x = {x}: {a}, far from the edge {b}");
        }
    }
}

#[test]
fn the_unit_of_irradiance_does_not_matter() {
    let image = |k: f32| grey(90, 70, move |x, y| k * (0.1 + (x * y) as f32));
    let (a, b) = (preview(&image(1.0)), preview(&image(1024.0)));
    assert!(a.pixels().zip(b.pixels()).all(|(a, b)| a.0[0].abs_diff(b.0[0]) <= 2));
}

#[test]
fn one_tone_map_serves_several_images() {
    let image = grey(50, 40, |x, _| 0.01 * (1 + x) as f32);
    let map = ToneMap::fit(&image);
    assert_eq!(map.apply(&image), preview(&image));
    let darker = map.apply(&image.map_planes(|p| p.map(|v| 0.1 * v)));
    assert!(darker.pixels().zip(map.apply(&image).pixels()).all(|(a, b)| a.0[0] < b.0[0]));
}

#[test]
fn colours_keep_their_hue() {
    let mut image = Rgb::filled(20, 20, 0.2);
    image.0[0] = Plane::filled(20, 20, 0.8);
    let p = preview(&image).get_pixel(10, 10).0;
    assert!(p[0] > p[1] && p[1] == p[2], "{p:?}");
}
