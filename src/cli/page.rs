//! `--report-html`: one self-contained page that shows what was done and how well. No script or picture from elsewhere.

use crate::baseline;
use crate::colour::{self, Matrix};
use crate::exposure::{Bracket, Frame};
use crate::image::{Plane, Rgb};
use crate::layers;
use crate::merge::resampled;
use crate::pipeline::Outcome;
use crate::response::Response;
use crate::tonemap::ToneMap;
use base64::Engine;
use base64::engine::general_purpose::STANDARD;
use image::{RgbImage, imageops};
use serde_json::Value;
use std::fmt::Write;

/// What the page shows.
pub(super) struct Page<'a> {
    pub bracket: &'a Bracket,
    pub response: &'a Response,
    pub outcome: &'a Outcome,
    /// The result in linear Rec. 709.
    pub display: &'a Rgb,
    /// From the frames' linear RGB to Rec. 709.
    pub to_display: Matrix,
    pub warnings: &'a [String],
    /// Frames were reduced to one over this.
    pub divisor: usize,
    pub settings: Vec<(String, String)>,
}

/// Longest side of the large pictures and of the small ones, pixels.
const LARGE: u32 = 1400;
const SMALL: u32 = 320;
/// Width and height of a plot, pixels.
const PLOT: (f64, f64) = (340.0, 220.0);

impl Page<'_> {
    /// The page's text.
    pub fn html(&self) -> String {
        let mut out = String::new();
        let size = self.bracket.size();
        let title = self.settings.iter().find(|s| s.0 == "--output").map_or("", |s| s.1.as_str());
        // Writing to a string does not fail.
        let _ = writeln!(
            out,
            "<!DOCTYPE html>\n<html lang=\"en\"><head><meta charset=\"utf-8\"><title>{t} - unshaken</title><style>{STYLE}</style></head><body>\n\
             <h1>{t}</h1>\n<p>{} x {} pixels{} from {} frames; reference frame {}. {}</p>",
            size.0,
            size.1,
            if self.divisor > 1 {
                format!(" (the frames reduced to 1/{}; places and lengths are in its pixels)", self.divisor)
            } else {
                String::new()
            },
            self.bracket.frames().len(),
            escaped(&self.bracket.frames()[self.outcome.reference].name),
            escaped(concat!("unshaken ", env!("CARGO_PKG_VERSION"))),
            t = escaped(title)
        );
        for w in self.warnings {
            let _ = writeln!(out, "<p class=\"warning\">{}</p>", escaped(w));
        }
        self.slider(&mut out);
        self.frames(&mut out);
        self.gain(&mut out);
        self.convergence(&mut out);
        let rows =
            self.settings.iter().map(|(k, v)| format!("<tr><th>{}</th><td>{}</td></tr>", escaped(k), escaped(v))).collect::<String>();
        let _ = writeln!(out, "<h2>Settings</h2>\n<table class=\"settings\">{rows}</table>");
        let pretty = serde_json::to_string_pretty(&without_bulk(&self.outcome.report)).unwrap_or_default();
        let _ = writeln!(out, "<details><summary>Everything that was estimated</summary><pre>{}</pre></details>", escaped(&pretty));
        let _ = writeln!(out, "<script>{SCRIPT}</script>\n</body></html>");
        out
    }

    /// The plain merge of all frames under the result, with a handle to move between them.
    fn slider(&self, out: &mut String) {
        let all: Vec<usize> = (0..self.bracket.frames().len()).filter(|&i| self.outcome.misfit[i].is_some()).collect();
        let scale = self.bracket.frames()[self.outcome.reference].exposure_time as f32;
        let mut before = baseline::merge(&self.registered(), self.response, &all).map_planes(|p| p.map(|v| v * scale));
        colour::convert(&mut before, &self.to_display);
        let map = ToneMap::fit(self.display);
        let picture = |image: &Rgb| data_url(&shrunk(&map.apply(image), LARGE), 88);
        let _ = writeln!(
            out,
            "<h2>Before and after</h2>\n<div class=\"slider\" id=\"slider\" style=\"aspect-ratio:{w}/{h}\">\
             <img alt=\"plain merge of the registered frames\" src=\"{}\"><div class=\"after\" id=\"after\"><img alt=\"unshaken\" src=\"{}\"></div>\
             <span class=\"tag left\">plain merge</span><span class=\"tag right\">unshaken</span>\
             <input id=\"handle\" aria-label=\"before and after\" type=\"range\" min=\"0\" max=\"1000\" value=\"500\"></div>",
            picture(&before),
            picture(self.display),
            w = self.bracket.size().0,
            h = self.bracket.size().1
        );
    }

    /// The frames where registration places them, as a plain merge would have them.
    fn registered(&self) -> Bracket {
        let frames = self.bracket.frames().iter().zip(&self.outcome.places).map(|(f, place)| {
            if *place == glam::DMat3::IDENTITY {
                return f.clone();
            }
            let everywhere = f.intensity.0[0].map(|_| 1.0);
            Frame { intensity: resampled(&f.intensity, &everywhere, place, 0).0, ..f.clone() }
        });
        // Sizes and exposure times are those of a bracket.
        Bracket::new(frames.collect()).unwrap_or_else(|_| self.bracket.clone())
    }

    /// Each frame: picture, mask, residual, registration, blur.
    fn frames(&self, out: &mut String) {
        out.push_str("<h2>Frames</h2>\n<p>Each picture lies on its frame's own pixels; the result lies on the reference frame's.</p>\n");
        let report = self.outcome.report["frames"].as_array().cloned().unwrap_or_default();
        for (i, frame) in self.bracket.frames().iter().enumerate() {
            let entry = report.get(i).unwrap_or(&Value::Null);
            let used = self.outcome.misfit[i].is_some();
            let state = match (used, entry["sharp"] == true) {
                (false, _) => "left out",
                (true, true) => "sharp",
                (true, false) => "shaken, deblurred",
            };
            let chi = entry["chi_squared"].as_f64().map_or(String::new(), |c| format!("; residual {c:.2} times its noise"));
            let reason = entry["judgement"]["reason"].as_str().unwrap_or_default();
            let _ = write!(
                out,
                "<section><h3>{}: {}</h3><p>{} s; {state}{chi}. {}</p><div class=\"row\">",
                i + 1,
                escaped(&frame.name),
                number(frame.exposure_time),
                escaped(reason)
            );
            figure(out, "intensity", &data_url(&shrunk(&codes(&frame.intensity), SMALL), 85));
            if used {
                figure(out, "mask: white counts", &data_url(&shrunk(&grey(&self.outcome.masks[i], |v| v), SMALL), 85));
            }
            if let Some(misfit) = &self.outcome.misfit[i] {
                // From black at 0 over grey at what noise explains to white at sixteen times that.
                figure(
                    out,
                    "residual over noise: grey is 1, white 16",
                    &data_url(&shrunk(&grey(misfit, |v| (v.max(0.0).sqrt() / 4.0).sqrt()), SMALL), 85),
                );
            }
            out.push_str("</div>\n");
            registration(out, &entry["registration"]);
            psfs(out, &entry["blur"]["patches"]);
            if entry["sharp"] != true {
                tsf(out, &entry["tsf"]["poses"]);
            }
            out.push_str("</section>\n");
        }
    }

    /// By brightness, how much less noise the shaken frames leave than deleting them would.
    fn gain(&self, out: &mut String) {
        let grounds = layers::grounds(self.bracket, self.response, self.outcome);
        let report = &self.outcome.report["frames"];
        let luminance = &self.outcome.irradiance.0[1].data;
        const ZONES: i32 = 14;
        let (mut all, mut kept, mut pixels) = (vec![0f64; ZONES as usize], vec![0f64; ZONES as usize], vec![0usize; ZONES as usize]);
        for (p, v) in luminance.iter().enumerate() {
            let zone = (v.max(1e-9).log2().floor() as i32 + ZONES - 2).clamp(0, ZONES - 1) as usize;
            pixels[zone] += 1;
            for (i, plane) in &grounds.information {
                all[zone] += f64::from(plane.data[p]);
                if report[*i]["sharp"] == true {
                    kept[zone] += f64::from(plane.data[p]);
                }
            }
        }
        out.push_str(
            "<h2>Gain over deleting the shaken frames</h2>\n<p>By brightness, in stops below the reference frame's white: how much the noise falls \
             because the shaken frames are used, as the noise model foresees it.</p>\n<table><tr><th>zone</th><th>pixels</th><th>gain</th></tr>",
        );
        for zone in (0..ZONES as usize).rev().filter(|&z| pixels[z] > 0) {
            let gain = match (all[zone] > 0.0, kept[zone] > 0.0) {
                (true, true) => format!("{:+.1} dB", 10.0 * (all[zone] / kept[zone]).log10()),
                (true, false) => "no sharp frame sees it".into(),
                _ => "clipped in all".into(),
            };
            let share = 100.0 * pixels[zone] as f64 / luminance.len() as f64;
            let _ = write!(out, "<tr><td>{} EV</td><td>{share:.1} %</td><td>{gain}</td></tr>", zone as i32 + 2 - ZONES);
        }
        out.push_str("</table>\n");
    }

    fn convergence(&self, out: &mut String) {
        let solver = &self.outcome.report["solver"];
        let history = solver["history"].as_array().cloned().unwrap_or_default();
        let mut values: Vec<f64> = history.iter().filter_map(|h| h["before"].as_f64()).collect();
        values.extend(history.last().and_then(|h| h["after"].as_f64()));
        let _ = writeln!(
            out,
            "<h2>Convergence</h2>\n<p>Objective after each outer iteration; the weights change between them. It stopped: {}.</p>",
            escaped(solver["stop"].as_str().unwrap_or("unknown"))
        );
        let points: Vec<(f64, f64)> = values.iter().enumerate().map(|(i, v)| (i as f64, v.abs().max(1e-30).log10())).collect();
        plot(out, "outer iteration", "log10 objective", &[points], true);
    }
}

fn figure(out: &mut String, caption: &str, url: &str) {
    let _ = write!(out, "<figure><img alt=\"{c}\" src=\"{url}\"><figcaption>{c}</figcaption></figure>", c = escaped(caption));
}

/// What registration found, as the report has it.
fn registration(out: &mut String, entry: &Value) {
    let Some(fields) = entry.as_object() else { return };
    let rows = fields.iter().map(|(k, v)| {
        let text = v.as_str().map_or_else(|| v.to_string(), str::to_string);
        format!("<tr><th>{}</th><td>{}</td></tr>", escaped(k), escaped(&text))
    });
    let _ = write!(out, "<h4>Registration</h4><table>{}</table>", rows.collect::<String>());
}

/// Local PSFs, in the order of their places.
fn psfs(out: &mut String, patches: &Value) {
    let Some(patches) = patches.as_array().filter(|p| !p.is_empty()) else { return };
    out.push_str("<h4>Local blur (PSF) at each patch</h4><div class=\"row\">");
    for p in patches {
        let values: Vec<f32> =
            p["psf"]["values"].as_array().map(|v| v.iter().filter_map(Value::as_f64).map(|v| v as f32).collect()).unwrap_or_default();
        let side = (values.len() as f64).sqrt() as usize;
        if side == 0 || side * side != values.len() {
            continue;
        }
        let largest = values.iter().copied().fold(f32::MIN_POSITIVE, f32::max);
        let plane = Plane { width: side, height: side, data: values };
        let picture = grey(&plane, |v| (v / largest).max(0.0).sqrt());
        let large = imageops::resize(&picture, 96, 96, imageops::FilterType::Nearest);
        figure(out, &format!("at {}, {}", p["x"], p["y"]), &data_url(&large, 90));
    }
    out.push_str("</div>\n");
}

/// The TSF in three projections; the size of a dot is its weight.
fn tsf(out: &mut String, poses: &Value) {
    let Some(poses) = poses.as_array().filter(|p| p.len() > 1) else { return };
    let field = |name: &str| poses.iter().map(|p| p[name].as_f64().unwrap_or(0.0)).collect::<Vec<f64>>();
    let (x, y, roll, weight) = (field("t_x"), field("t_y"), field("theta_z_deg"), field("weight"));
    let _ = write!(out, "<h4>Camera motion (TSF), {} poses</h4><div class=\"row\">", poses.len());
    for (a, b, name_a, name_b) in
        [(&x, &y, "right, px", "down, px"), (&x, &roll, "right, px", "roll, deg"), (&y, &roll, "down, px", "roll, deg")]
    {
        scatter(out, name_a, name_b, a, b, &weight);
    }
    out.push_str("</div>\n");
}

fn range(values: impl Iterator<Item = f64> + Clone) -> (f64, f64) {
    let (low, high) = values.fold((f64::INFINITY, f64::NEG_INFINITY), |(a, b), v| (a.min(v), b.max(v)));
    if !(low.is_finite() && high.is_finite()) {
        return (0.0, 1.0);
    }
    let margin = if high - low > 1e-9 { 0.06 * (high - low) } else { 0.5 };
    (low - margin, high + margin)
}

/// The frame of a plot, and where a point of it lies.
fn axes(
    out: &mut String,
    name_x: &str,
    name_y: &str,
    (x0, x1): (f64, f64),
    (y0, y1): (f64, f64),
    down: bool,
) -> impl Fn(f64, f64) -> (f64, f64) + use<> {
    let (w, h) = PLOT;
    let (left, top, right, bottom) = (56.0, 8.0, w - 8.0, h - 36.0);
    let _ = write!(
        out,
        "<svg class=\"plot\" viewBox=\"0 0 {w} {h}\" width=\"{w}\" height=\"{h}\" role=\"img\"><rect x=\"{left}\" y=\"{top}\" width=\"{}\" height=\"{}\" fill=\"none\" stroke=\"#888\"/>\
         <text x=\"{}\" y=\"{}\" text-anchor=\"middle\">{}</text><text x=\"12\" y=\"{m}\" text-anchor=\"middle\" transform=\"rotate(-90 12 {m})\">{}</text>\
         <text x=\"{left}\" y=\"{b}\">{}</text><text x=\"{right}\" y=\"{b}\" text-anchor=\"end\">{}</text>\
         <text x=\"{l}\" y=\"{}\" text-anchor=\"end\">{}</text><text x=\"{l}\" y=\"{bottom}\" text-anchor=\"end\">{}</text>",
        right - left,
        bottom - top,
        0.5 * (left + right),
        h - 6.0,
        escaped(name_x),
        escaped(name_y),
        number(x0),
        number(x1),
        top + 10.0,
        number(if down { y0 } else { y1 }),
        number(if down { y1 } else { y0 }),
        m = 0.5 * (top + bottom),
        b = bottom + 14.0,
        l = left - 4.0
    );
    move |x, y| {
        let v = (y - y0) / (y1 - y0);
        (left + (right - left) * (x - x0) / (x1 - x0), if down { top + (bottom - top) * v } else { bottom - (bottom - top) * v })
    }
}

fn scatter(out: &mut String, name_x: &str, name_y: &str, x: &[f64], y: &[f64], weight: &[f64]) {
    let place = axes(out, name_x, name_y, range(x.iter().copied()), range(y.iter().copied()), true);
    let largest = weight.iter().copied().fold(f64::MIN_POSITIVE, f64::max);
    for i in 0..x.len() {
        let (cx, cy) = place(x[i], y[i]);
        let _ = write!(out, "<circle cx=\"{cx:.1}\" cy=\"{cy:.1}\" r=\"{:.1}\"/>", 0.8 + 5.0 * (weight[i] / largest).max(0.0).sqrt());
    }
    out.push_str("</svg>");
}

fn plot(out: &mut String, name_x: &str, name_y: &str, lines: &[Vec<(f64, f64)>], dots: bool) {
    let points = || lines.iter().flatten();
    let place = axes(out, name_x, name_y, range(points().map(|p| p.0)), range(points().map(|p| p.1)), false);
    for line in lines {
        let at: Vec<(f64, f64)> = line.iter().map(|p| place(p.0, p.1)).collect();
        let path = at.iter().map(|(x, y)| format!("{x:.1},{y:.1} ")).collect::<String>();
        let _ = write!(out, "<polyline points=\"{}\" fill=\"none\"/>", path.trim_end());
        for (x, y) in at.iter().filter(|_| dots) {
            let _ = write!(out, "<circle cx=\"{x:.1}\" cy=\"{y:.1}\" r=\"3\"/>");
        }
    }
    out.push_str("</svg>\n");
}

/// A few digits, none that say nothing.
fn number(v: f64) -> String {
    let text = if v.abs() >= 100.0 { format!("{v:.0}") } else { format!("{v:.3}") };
    if text.contains('.') { text.trim_end_matches('0').trim_end_matches('.').to_string() } else { text }
}

/// Without the lists that fill pages.
fn without_bulk(report: &Value) -> Value {
    let mut report = report.clone();
    for frame in report["frames"].as_array_mut().into_iter().flatten() {
        for list in ["tsf", "blur"] {
            if !frame[list].is_null() {
                frame[list] = Value::String("in the JSON report (--report)".into());
            }
        }
    }
    report
}

/// A frame as it was.
fn codes(z: &Rgb) -> RgbImage {
    let (w, h) = z.size();
    RgbImage::from_fn(w as u32, h as u32, |x, y| {
        image::Rgb(z.pixel(y as usize * w + x as usize).map(|v| (255.0 * v.clamp(0.0, 1.0)).round() as u8))
    })
}

fn grey(plane: &Plane, shade: impl Fn(f32) -> f32) -> RgbImage {
    RgbImage::from_fn(plane.width as u32, plane.height as u32, |x, y| {
        let v = shade(plane.at(x as usize, y as usize));
        image::Rgb([if v.is_finite() { (255.0 * v.clamp(0.0, 1.0)).round() as u8 } else { 0 }; 3])
    })
}

fn shrunk(picture: &RgbImage, side: u32) -> RgbImage {
    let longest = picture.width().max(picture.height());
    if longest <= side {
        return picture.clone();
    }
    let scaled = |n: u32| (u64::from(n) * u64::from(side) / u64::from(longest)).max(1) as u32;
    imageops::thumbnail(picture, scaled(picture.width()), scaled(picture.height()))
}

fn data_url(picture: &RgbImage, quality: u8) -> String {
    let mut bytes = Vec::new();
    // A picture of a page is small and in memory: encoding it does not fail.
    let _ = crate::io::picture::write_jpeg(&mut bytes, picture, quality, None);
    format!("data:image/jpeg;base64,{}", STANDARD.encode(bytes))
}

fn escaped(text: &str) -> String {
    text.replace('&', "&amp;").replace('<', "&lt;").replace('>', "&gt;").replace('"', "&quot;")
}

const STYLE: &str = "body{font:15px/1.5 system-ui,sans-serif;max-width:1100px;margin:2em auto;padding:0 1em;color:#ddd;background:#191919}\
h1{font-size:1.5em}h2{margin-top:2em;border-bottom:1px solid #444}h4{margin:.8em 0 .3em}\
.slider{position:relative;width:100%;overflow:hidden}.slider img{position:absolute;inset:0;width:100%;height:100%;object-fit:fill}\
.after{position:absolute;inset:0;clip-path:inset(0 0 0 50%);border:0}.slider input{position:absolute;inset:0;width:100%;height:100%;opacity:0;cursor:ew-resize;margin:0}\
.slider::after{content:'';position:absolute;top:0;bottom:0;left:var(--at,50%);width:2px;background:#fff;pointer-events:none}\
.tag{position:absolute;bottom:8px;background:#000a;padding:2px 8px;pointer-events:none}.left{left:8px}.right{right:8px}\
.row{display:flex;flex-wrap:wrap;gap:10px}figure{margin:0}figcaption{font-size:12px;color:#aaa}\
table{border-collapse:collapse}td,th{padding:1px 12px 1px 0;text-align:left;font-weight:normal;vertical-align:top}th{color:#aaa}\
.warning{background:#5a3b00;padding:6px 10px}pre{overflow:auto;background:#222;padding:1em}\
.plot{background:#222}.plot text{font:11px system-ui,sans-serif;fill:#bbb}.plot circle{fill:#6cf}.plot polyline{stroke:#6cf;stroke-width:1.5}";

const SCRIPT: &str = "const h=document.getElementById('handle'),a=document.getElementById('after'),s=document.getElementById('slider');\
function move(){const v=h.value/10;a.style.clipPath='inset(0 0 0 '+v+'%)';s.style.setProperty('--at',v+'%');}\
h.addEventListener('input',move);\
s.addEventListener('pointerdown',e=>{const r=s.getBoundingClientRect();h.value=1000*(e.clientX-r.left)/r.width;move();});move();";
