//! How true estimated TSFs are, on folders with a bracket of known truth.
use glam::DVec2;
use rayon::prelude::*;
use std::path::Path;
use std::time::Instant;
use unshaken::exposure::{Bracket, Frame};
use unshaken::image::{Plane, Rgb};
use unshaken::pose::{PoseGrid, project};
use unshaken::response::Response;
use unshaken::tsf::{Interpolation, Model, Search, TapSet, Tsf, TsfFile, WholeFrame};
use unshaken::{io, mask, merge, noise};

fn f32s(path: &Path, size: (usize, usize)) -> Plane {
    let b = std::fs::read(path).unwrap();
    Plane::from_vec(size.0, size.1, b.chunks_exact(4).map(|c| f32::from_le_bytes(c.try_into().unwrap())).collect()).unwrap()
}

fn warp(e: &Plane, h: &glam::DMat3, margin: usize, kind: Interpolation) -> Plane {
    let inv = h.inverse();
    let c = DVec2::new((e.width as f64 - 1.0) / 2.0, (e.height as f64 - 1.0) / 2.0);
    let s = kind.support() as isize;
    let w = e.width + 2 * margin;
    let mut out = Plane::filled(w, e.height + 2 * margin, 0.0);
    out.data.par_chunks_exact_mut(w).enumerate().for_each(|(y, row)| {
        for (x, o) in row.iter_mut().enumerate() {
            let p = project(&inv, DVec2::new(x as f64 - margin as f64, y as f64 - margin as f64) - c) + c;
            let (fx, fy) = (p.x.floor(), p.y.floor());
            let mut wx = [0.0f32; 6];
            let mut wy = [0.0f32; 6];
            for k in 0..2 * s {
                wx[k as usize] = kind.weight((k - s + 1) as f64 - (p.x - fx)) as f32;
                wy[k as usize] = kind.weight((k - s + 1) as f64 - (p.y - fy)) as f32;
            }
            for j in 0..2 * s {
                for i in 0..2 * s {
                    *o += wx[i as usize] * wy[j as usize] * e.clamped(fx as isize + i - s + 1, fy as isize + j - s + 1);
                }
            }
        }
    });
    out
}

fn direct(e: &Plane, t: &Tsf, kind: Interpolation) -> Plane {
    let mut out = Plane::filled(e.width, e.height, 0.0);
    for p in &t.poses {
        let v = warp(e, &p.homography(t.focal_px), 0, kind);
        for (o, v) in out.data.iter_mut().zip(&v.data) {
            *o += p.weight as f32 * v;
        }
    }
    out
}

fn solver(e: &Plane, t: &Tsf, kind: Interpolation, fine: usize) -> (Plane, usize, usize) {
    let taps = TapSet::new(t, e.width * fine, e.height * fine, kind);
    let m = taps.taps.iter().map(|t| t.dx.abs().max(t.dy.abs())).max().unwrap() as usize;
    let mut out = Plane::filled(e.width, e.height, 0.0);
    for (b, h) in taps.bases.iter().enumerate() {
        let base = warp(e, h, m, kind);
        for t in taps.taps.iter().filter(|t| t.base == b) {
            for y in 0..e.height {
                for x in 0..e.width {
                    out.data[y * e.width + x] +=
                        t.weight as f32 * base.at((x as i32 - t.dx + m as i32) as usize, (y as i32 - t.dy + m as i32) as usize);
                }
            }
        }
    }
    (out, taps.bases.len(), taps.taps.len())
}

fn thin(t: &Tsf, n: usize) -> Tsf {
    let k = t.poses.len().div_ceil(n);
    Tsf::new(t.focal_px, t.poses.iter().step_by(k).copied().collect()).unwrap()
}

fn env(n: &str, d: f64) -> f64 {
    std::env::var(n).map_or(d, |v| v.parse().unwrap())
}

fn main() {
    let args: Vec<String> = std::env::args().skip(1).collect();
    let latent_kind = &args[0];
    let what = &args[1];
    for dir in &args[2..] {
        let dir = Path::new(dir);
        let size: Vec<usize> =
            std::fs::read_to_string(dir.join("size.txt")).unwrap().split(' ').map(|v| v.trim().parse().unwrap()).collect();
        let size = (size[0], size[1]);
        let json: serde_json::Value = serde_json::from_str(&std::fs::read_to_string(dir.join("bracket.json")).unwrap()).unwrap();
        let times: Vec<f64> = json["exposures"].as_array().unwrap().iter().map(|v| v.as_f64().unwrap()).collect();
        let frames: Vec<Frame> = times
            .iter()
            .enumerate()
            .map(|(i, &t)| {
                let p = io::ldr::read(&dir.join(format!("frame{i}.png"))).unwrap();
                Frame { name: format!("frame{i}.png"), intensity: p.intensity, levels: p.levels, exposure_time: t }
            })
            .collect();
        let bracket = Bracket::new(frames).unwrap();
        let frames = bracket.frames();
        let response = Response::Srgb;
        let exposures: Vec<Rgb> = frames.iter().map(|f| noise::exposure(f, &response)).collect();
        let model = noise::estimate(frames, &exposures, &response);
        let true_noise = noise::NoiseModel::from_electrons(json["full_well"].as_f64().unwrap(), json["read_noise"].as_f64().unwrap());
        let sharp: Vec<bool> = json["meta"].as_array().unwrap().iter().map(|m| m["sharp"].as_bool().unwrap()).collect();
        let masks = mask::masks(frames, &sharp, 0.3);
        let truth = f32s(&dir.join("truth.f32"), size);
        let file = TsfFile::parse(&std::fs::read_to_string(dir.join("truth_tsf.json")).unwrap()).unwrap();
        let latent = match latent_kind.as_str() {
            "truth" => truth.clone(),
            k => {
                let (rgb, factor) = io::exr::read(&dir.join(format!("{k}.exr"))).unwrap();
                let f = factor.unwrap_or(1.0) as f32;
                rgb.mean().map(|v| v / f)
            }
        };
        for i in (0..frames.len()).filter(|&i| !sharp[i] && (env("FRAME", 0.0) == 0.0 || env("FRAME", 0.0) == i as f64)) {
            let irr = f32s(&dir.join(format!("irr{i}.f32")), size);
            let t_true = file.find(&frames[i].name, size.0, size.1).unwrap().unwrap();
            let t_true = thin(&t_true, 400);
            let cache = dir.join(format!("ktrue{i}.f32"));
            let k_true = if cache.exists() {
                f32s(&cache, size)
            } else {
                let k = direct(&truth, &t_true, Interpolation::Bicubic);
                std::fs::write(&cache, k.data.iter().flat_map(|v| v.to_le_bytes()).collect::<Vec<u8>>()).unwrap();
                k
            };
            let dt = times[i] as f32;
            let exposure = exposures[i].mean();
            let local = merge::gradient_level(&latent, 4);
            let me = env("ME", 0.05) as f32;
            let weight = Plane {
                data: (0..exposure.data.len())
                    .map(|p| {
                        let m = masks[i].data[p];
                        let v = model.variance(f64::from(exposure.data[p])) as f32 / 3.0 / (dt * dt) + (me * local.data[p]).powi(2);
                        m * m / v
                    })
                    .collect(),
                ..exposure
            };
            let blurred = exposure.map(|v| v / dt);
            let b = 26;
            let inner = |f: &dyn Fn(usize) -> f64| -> f64 {
                (b..size.1 - b).flat_map(|y| (b..size.0 - b).map(move |x| y * size.0 + x)).map(f).sum::<f64>()
            };
            let err = |k: &Plane, t: &Plane| {
                100.0 * (inner(&|p| f64::from(k.data[p] - t.data[p]).powi(2)) / inner(&|p| f64::from(t.data[p]).powi(2))).sqrt()
            };
            let chi = |k: &Plane| {
                let q = |p: usize| {
                    let e = f64::from(k.data[p] * dt);
                    let v = true_noise.variance(e) / 3.0 + (1.0f64 / 255.0).powi(2) / 36.0;
                    (f64::from(exposure.data[p]) - e).powi(2) / v
                };
                let ok = |p: usize| masks[i].data[p] > 0.3 && k.data[p] * dt > 0.01;
                inner(&|p| if ok(p) { q(p) } else { 0.0 }) / inner(&|p| f64::from(u8::from(ok(p))))
            };
            let report = |name: &str, t: &Tsf, seconds: f64| {
                let c = direct(&truth, t, Interpolation::Bicubic);
                let mut line = format!(
                    "{:20} {i} {name:6} poses {:3} | exact {:.2}% irr {:.2}% chi2 {:.2}",
                    dir.file_name().unwrap().to_string_lossy(),
                    t.poses.len(),
                    err(&c, &k_true),
                    err(&c, &irr),
                    chi(&c)
                );
                for (label, kind, fine) in [
                    ("bil", Interpolation::Bilinear, 1),
                    ("cub", Interpolation::Bicubic, 1),
                    ("cub/2", Interpolation::Bicubic, 2),
                    ("cub/8", Interpolation::Bicubic, 8),
                    ("six/2", Interpolation::SixPoint, 2),
                ] {
                    if !what.contains("taps") && label != "cub" {
                        continue;
                    }
                    let (s, bases, taps) = solver(&truth, t, kind, fine);
                    line += &format!(" | {label} {:.2}% chi2 {:.2} ({bases}b {taps}t)", err(&s, &k_true), chi(&s));
                }
                println!("{line} | {seconds:.1}s");
            };
            if what.contains("true") {
                report("true", &t_true, 0.0);
            }
            let base = glam::DMat3::IDENTITY;
            let frame = WholeFrame { latent: &latent, pad: 0, blurred: &blurred, weight: &weight, base };
            if what.contains("old") {
                let start = Instant::now();
                let g = frame.fit_grid(&PoseGrid::new(size.0, size.1, 16, 2.0, 1.0), None).unwrap();
                report("grid", &g, start.elapsed().as_secs_f64());
                std::fs::write(dir.join(format!("grid{i}-{latent_kind}.json")), serde_json::to_string(&g.poses).unwrap()).unwrap();
                let start = Instant::now();
                let r = frame.refine(&g);
                report("old", &r, start.elapsed().as_secs_f64());
            }
            if what.contains("est") {
                for (name, m) in [("auto", Model::Auto), ("rigid", Model::Rigid), ("full", Model::Full)] {
                    if !what.contains(&format!("est-{name}")) {
                        continue;
                    }
                    let start = Instant::now();
                    let e = frame.estimate(&Search { model: m, focal_px: None }).unwrap();
                    report(name, &e.tsf, start.elapsed().as_secs_f64());
                    println!("    {:?} focal {} {} scale {} residual {:.3}", e.model, e.tsf.focal_px, e.focal, e.scale, e.residual);
                    for t in &e.trials {
                        println!("    {:?} {:.0} {:.4} {:.2}", t.model, t.focal_px, t.held_out, t.worse_by);
                    }
                }
            }
        }
    }
}
