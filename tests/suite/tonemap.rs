//! Tone mapping: degenerate images, shadows and highlights together, no halos.

use unshaken::image::{Plane, Rgb};
use unshaken::tonemap::{Operator, ToneMap, preview};

fn grey(width: usize, height: usize, f: impl Fn(usize, usize) -> f32 + Sync) -> Rgb {
    let plane = Plane::from_fn(width, height, f);
    Rgb([plane.clone(), plane.clone(), plane])
}

/// Images of no light, too much, or no number; one pixel; a single light; a ramp beyond all displays.
fn awkward() -> Vec<Rgb> {
    vec![
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
        grey(67, 129, |x, _| 10f32.powf(x as f32 - 32.0)),
    ]
}

#[test]
fn awkward_images_give_pictures() {
    for image in awkward() {
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

#[test]
fn operators_are_parsed_with_their_parameters() {
    for name in Operator::names() {
        let plain = Operator::parse(name).unwrap();
        assert_eq!(Operator::parse(&plain.to_string()).unwrap(), plain, "{name}: what is shown can be given");
        assert_ne!(Operator::parse(&format!("{name}:exposure=1.5")).unwrap(), plain);
    }
    assert_eq!(Operator::default(), Operator::parse("filmic").unwrap());
    for (wrong, words) in [
        ("aces", ["no operator", "reinhard-local"]),
        ("reinhard:phi=3", ["no parameter \"phi\"", "white"]),
        ("reinhard:key=nan", ["key=nan", "from 0.01 to 1"]),
        ("fattal:beta", ["\"beta\"", "name=value"]),
        ("durand:contrast=9", ["contrast=9", "from 0.3 to 6"]),
    ] {
        let error = Operator::parse(wrong).unwrap_err();
        assert!(words.iter().all(|w| error.contains(w)), "{wrong}: {error}");
    }
}

fn all() -> Vec<Operator> {
    Operator::names().into_iter().map(|n| Operator::parse(n).unwrap()).collect()
}

#[test]
fn every_operator_takes_awkward_images() {
    for image in awkward() {
        for operator in all() {
            let picture = operator.apply(&image);
            assert_eq!((picture.width() as usize, picture.height() as usize), image.size(), "{operator}");
        }
    }
    for operator in all() {
        assert!(operator.apply(&Rgb::filled(8, 8, 0.0)).pixels().all(|p| p.0 == [0; 3]), "{operator}: black stays black");
    }
}

/// Rising light gives rising codes; the unit does not matter; one EV more is brighter; grey stays grey and hues stay.
#[test]
fn every_operator_keeps_order_and_hue() {
    // Even areas: between them local operators may bend, within them they may not.
    let steps = |k: f32| grey(320, 96, move |x, _| k * 10f32.powf((x / 40) as f32 * 0.4 - 1.0));
    for operator in all() {
        let picture = operator.apply(&steps(1.0));
        let codes: Vec<u8> = (0..8).map(|i| picture.get_pixel(40 * i + 20, 48).0[1]).collect();
        assert!(codes.windows(2).all(|w| w[1] > w[0]), "{operator}: {codes:?}");
        assert!(codes[7] > 170 && codes[0] < 110, "{operator}: {codes:?}");
        assert!(picture.pixels().all(|p| p.0[0] == p.0[1] && p.0[1] == p.0[2]), "{operator}: grey stays grey");
        let other = operator.apply(&steps(1024.0));
        assert!(picture.pixels().zip(other.pixels()).all(|(a, b)| a.0[0].abs_diff(b.0[0]) <= 2), "{operator}: the unit matters");
        let name = operator.to_string();
        let name = name.split(':').next().unwrap();
        let brighter = Operator::parse(&format!("{name}:exposure=1")).unwrap().apply(&steps(1.0));
        assert!(brighter.get_pixel(100, 48).0[1] > picture.get_pixel(100, 48).0[1] + 8, "{operator}: one EV more");
        let mut red = steps(1.0);
        red.0[0] = red.0[0].map(|v| 2.0 * v);
        let p = operator.apply(&red).get_pixel(140, 48).0;
        assert!(p[0] > p[1] && p[1] == p[2], "{operator}: {p:?}");
        let pale = Operator::parse(&format!("{name}:saturation=0")).unwrap().apply(&red).get_pixel(140, 48).0;
        assert!(pale[0].abs_diff(pale[1]) <= 1, "{operator}: {pale:?}");
    }
}

/// Local operators keep a texture visible from 10⁻² to 10², the global ones cannot everywhere.
#[test]
fn local_operators_keep_detail_in_shadows_and_lights() {
    let level = |x: usize| 10f32.powf((x / 48) as f32 - 2.0);
    let image = grey(240, 96, |x, y| level(x) * if (x / 3 + y / 3) % 2 == 0 { 1.15 } else { 0.85 });
    for name in ["durand", "fattal"] {
        let picture = Operator::parse(name).unwrap().apply(&image);
        for step in 0..5 {
            let codes: Vec<f64> = (30..66)
                .flat_map(|y| (48 * step + 12..48 * step + 36).map(move |x| (x, y)))
                .map(|(x, y)| f64::from(picture.get_pixel(x, y).0[1]))
                .collect();
            let mean = codes.iter().sum::<f64>() / codes.len() as f64;
            let deviation = (codes.iter().map(|v| (v - mean).powi(2)).sum::<f64>() / codes.len() as f64).sqrt();
            assert!(deviation > 1.5, "{name}, step {step}: the texture is lost, {deviation:.2} of {mean:.0}");
        }
    }
    // Reinhard's local operator holds back less around a light than his global one... and never wraps or rings.
    let lamp = grey(200, 120, |x, y| if (x as f32 - 100.0).hypot(y as f32 - 60.0) < 12.0 { 50.0 } else { 0.1 + 0.001 * x as f32 });
    let [global, local] = ["reinhard", "reinhard-local"].map(|n| Operator::parse(n).unwrap().apply(&lamp));
    assert!(local.get_pixel(100, 60).0[0] >= global.get_pixel(100, 60).0[0].saturating_sub(2));
    let (near, far) = (i32::from(local.get_pixel(100, 85).0[0]), i32::from(local.get_pixel(100, 110).0[0]));
    assert!((near - far).abs() < 12, "a halo: {near} beside the lamp, {far} away from it");
}

/// Without attenuation the gradient-domain operator gives back the picture that it took apart, whatever the size: one code per luminance.
#[test]
fn gradients_are_put_together_again() {
    for (width, height) in [(128, 64), (161, 97), (43, 222), (3, 50)] {
        let value = |x: usize, y: usize| ((x * 7 + y * 13 + x * y / 9) % 11) as f32;
        let picture = Operator::parse("fattal:beta=1").unwrap().apply(&grey(width, height, |x, y| 1.3f32.powf(value(x, y))));
        let mut ranges = [(255u8, 0u8); 11];
        for (x, y, p) in picture.enumerate_pixels() {
            let r = &mut ranges[value(x as usize, y as usize) as usize];
            *r = (r.0.min(p.0[1]), r.1.max(p.0[1]));
        }
        assert!(ranges.iter().all(|r| r.1 - r.0 <= 3), "{width} x {height}: {ranges:?}");
    }
}
