use super::support::gpu::gpu;
use super::support::uniform;
use unshaken::gpu::Gpu;
use unshaken::image::{Plane, Rgb};
use unshaken::kernels::{Display, DisplayParams, Part, Place};
use unshaken::tonemap::{Light, Operator};

const SAME: [[f32; 4]; 3] = [[1.0, 0.0, 0.0, 0.0], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0]];
const VIEW: u32 = 64;

fn lit(width: usize, height: usize) -> Rgb {
    // Neighbours differ by up to two stops.
    let values = uniform(7, width * height * 3, 0.0, 1.0);
    Rgb(std::array::from_fn(|c| Plane::from_fn(width, height, |x, y| 4f32.powf(values[3 * (y * width + x) + c]))))
}

/// What a view shows of `image`, whose planes have `pad` pixels around them, from a texture of one over `shrunk` of its size; rows of
/// sRGB codes.
fn view(gpu: &Gpu, image: &Rgb, params: DisplayParams, pad: usize, shrunk: u32) -> Vec<[u8; 3]> {
    let (width, height) = image.size();
    let place = Place::padded(width, height, pad);
    let mut values = vec![f32::MAX; place.stride as usize * (height + 2 * pad)];
    let planes = image.0.each_ref().map(|p| {
        for (row, to) in p.data.chunks(width).zip(values.chunks_mut(place.stride as usize).skip(pad)) {
            to[pad..pad + width].copy_from_slice(row);
        }
        gpu.upload("picture", &values).unwrap()
    });
    let mut display = Display::new(&gpu.device, wgpu::TextureFormat::Rgba8Unorm);
    let mut encoder = gpu.device.create_command_encoder(&Default::default());
    let room = display.room(&gpu.device, &Place { size: place.size.map(|n| n.div_ceil(shrunk)), ..place });
    display.picture(&gpu.device, &mut encoder, &planes, &place, &SAME, &room);
    let target = display.view(&gpu.device, [VIEW, VIEW]);
    let parts = [Part { columns: 0..VIEW, params, picture: Some(&room) }];
    display.draw(&gpu.device, &mut encoder, &target, &parts, None);
    let bytes = gpu.plane("view", (VIEW * VIEW) as usize).unwrap();
    let layout = wgpu::TexelCopyBufferLayout { offset: 0, bytes_per_row: Some(4 * VIEW), rows_per_image: None };
    encoder.copy_texture_to_buffer(target.as_image_copy(), wgpu::TexelCopyBufferInfo { buffer: &bytes, layout }, target.size());
    gpu.queue.submit([encoder.finish()]);
    let codes = unshaken::gpu::read(gpu, &bytes, (VIEW * VIEW) as usize).unwrap();
    codes.iter().map(|v| v.to_ne_bytes()).map(|[r, g, b, _]| [r, g, b]).collect()
}

/// Mean of `n` x `n` samples in the square of side `step` about `p`, each the pixel that it lies in.
fn mean(image: &Rgb, p: [f64; 2], step: f64, n: usize) -> [f32; 3] {
    let (width, height) = image.size();
    let mut sum = [0.0; 3];
    for j in 0..n {
        for i in 0..n {
            let at = |k: usize, p: f64, most: usize| {
                let q = p + step * ((k as f64 + 0.5) / n as f64 - 0.5);
                (q.floor().max(0.0) as usize).min(most - 1)
            };
            let v = image.pixel(at(j, p[1], height) * width + at(i, p[0], width));
            sum = std::array::from_fn(|c| sum[c] + v[c] / (n * n) as f32);
        }
    }
    sum
}

#[test]
fn a_pixel_of_the_screen_shows_the_mean_of_what_it_covers() {
    let gpu = gpu();
    // (size, pixels of the frame per pixel of the screen, corner, samples per side, pixels of the frame per texel)
    let cases = [
        ((61, 47), 0.25, [3.0, 5.0], 1, 1),
        ((61, 47), 1.0, [-9.0, 2.0], 1, 1),
        ((75, 49), 1.3, [-4.2, -1.9], 2, 1),
        ((97, 101), 1.83, [0.37, 0.21], 2, 1),
        ((128, 96), 2.0, [0.0, 0.0], 2, 1),
        ((128, 96), 4.0, [0.0, 0.0], 4, 1),
        ((128, 64), 8.0, [0.0, 0.0], 8, 1),
        ((128, 96), 2.0, [0.0, 0.0], 2, 2),
        ((126, 96), 6.0, [0.0, 0.0], 6, 3),
    ];
    for (i, ((width, height), per_pixel, pan, samples, shrunk)) in cases.into_iter().enumerate() {
        let image = lit(width, height);
        let light = Light::of(&image);
        for words in ["filmic:exposure=0.4", "reinhard:saturation=0.6"] {
            let operator = Operator::parse(words).unwrap();
            let curve = operator.curve(&light).unwrap();
            let params = DisplayParams {
                pan,
                frame: [width as f32, height as f32],
                per_pixel,
                gain: curve.gain,
                white: curve.white,
                saturation: curve.saturation,
                curve: u32::from(curve.filmic),
                background: 1.0,
                ..Default::default()
            };
            let shown = view(gpu, &image, params, 3 * (i % 2), shrunk);
            let mut seen = 0;
            for y in 0..VIEW {
                for x in 0..VIEW {
                    let p = [
                        f64::from(pan[0]) + f64::from(per_pixel) * (f64::from(x) + 0.5),
                        f64::from(pan[1]) + f64::from(per_pixel) * (f64::from(y) + 0.5),
                    ];
                    let codes = shown[(y * VIEW + x) as usize];
                    if p[0] < 0.0 || p[1] < 0.0 || p[0] >= width as f64 || p[1] >= height as f64 {
                        assert_eq!(codes, [255; 3], "beyond the frame");
                        continue;
                    }
                    let linear = mean(&image, p, f64::from(per_pixel), samples);
                    let wanted = toned(&operator, &curve, linear);
                    seen += 1;
                    // Half precision is a twentieth of a code, rounding the rest.
                    assert!(
                        (0..3).all(|c| codes[c].abs_diff(wanted[c]) <= 1),
                        "{words} case {i} at {x}, {y}: {codes:?}, {wanted:?} wanted"
                    );
                }
            }
            assert!(seen >= 128, "case {i}: {seen} pixels");
        }
    }
}

/// A pixel by the equations of the operator in f64.
fn toned(operator: &Operator, curve: &unshaken::tonemap::Curve, linear: [f32; 3]) -> [u8; 3] {
    let linear = linear.map(f64::from);
    let y = 0.2126 * linear[0] + 0.7152 * linear[1] + 0.0722 * linear[2];
    let (v, white) = (y * f64::from(curve.gain), f64::from(curve.white));
    let hable = |x: f64| (x * (0.22 * x + 0.03) + 0.002) / (x * (0.22 * x + 0.3) + 0.06) - 0.002 / 0.06;
    let s = match operator.name() {
        "filmic" => hable(2.0 * v.min(white)) / hable(2.0 * white),
        _ => v * (1.0 + v / (white * white)) / (1.0 + v),
    };
    let mut rgb = linear.map(|l| s * (l / y).powf(f64::from(curve.saturation)));
    let brightest = rgb.into_iter().fold(0.0, f64::max);
    if brightest > 1.0 {
        let grey = s.min(1.0);
        let keep = if brightest > grey { (1.0 - grey) / (brightest - grey) } else { 0.0 };
        rgb = rgb.map(|v| grey + (v - grey) * keep);
    }
    rgb.map(|x| (255.0 * if x <= 0.003_130_8 { 12.92 * x } else { 1.055 * x.powf(1.0 / 2.4) - 0.055 }).round().clamp(0.0, 255.0) as u8)
}

#[test]
fn a_picture_that_is_toned_keeps_its_codes() {
    let gpu = gpu();
    let decode = |z: f32| if z <= 0.04045 { z / 12.92 } else { ((z + 0.055) / 1.055).powf(2.4) };
    let code = |x: usize, y: usize, c: usize| ((x + 64 * y) / [1, 5, 16][c] % 256) as u8;
    let image = Rgb(std::array::from_fn(|c| Plane::from_fn(64, 64, |x, y| decode(f32::from(code(x, y, c)) / 255.0))));
    let params = DisplayParams { frame: [64.0, 64.0], per_pixel: 1.0, curve: 2, saturation: 0.3, gain: 7.0, ..Default::default() };
    for (i, codes) in view(gpu, &image, params, 0, 1).into_iter().enumerate() {
        let wanted = std::array::from_fn(|c| code(i % 64, i / 64, c));
        assert_eq!(codes, wanted, "{i}");
    }
}

#[test]
fn between_the_pixels_of_a_reduced_picture_lie_their_means() {
    let image = Rgb(std::array::from_fn(|_| Plane::from_fn(32, 32, |x, _| x as f32 / 31.0)));
    let params = DisplayParams { frame: [64.0, 64.0], per_pixel: 1.0, curve: 2, ..Default::default() };
    let shown = view(gpu(), &image, params, 0, 1);
    for x in 1..63 {
        let linear = (0.5 * (f64::from(x as u32) + 0.5) - 0.5) / 31.0;
        let code = if linear <= 0.003_130_8 { 12.92 * linear } else { 1.055 * linear.powf(1.0 / 2.4) - 0.055 };
        assert!((f64::from(shown[64 * 20 + x][1]) - 255.0 * code).abs() <= 1.0, "{x}");
    }
}
