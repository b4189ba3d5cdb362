use unshaken::{exposure::*, image::*, noise, response::Response, triage};
fn main() {
    for dir in std::env::args().skip(1) {
        let b: serde_json::Value = serde_json::from_str(&std::fs::read_to_string(format!("{dir}/bracket.json")).unwrap()).unwrap();
        let mut frames = vec![];
        for (f, t) in b["frames"].as_array().unwrap().iter().zip(b["exposures"].as_array().unwrap()) {
            let im = image::open(format!("{dir}/{}", f.as_str().unwrap())).unwrap().to_rgb8();
            let (w, h) = im.dimensions();
            let ch = |c: usize| Plane::from_fn(w as usize, h as usize, |x, y| im.get_pixel(x as u32, y as u32)[c] as f32 / 255.0);
            frames.push(Frame {
                name: f.as_str().unwrap().into(),
                intensity: Rgb([ch(0), ch(1), ch(2)]),
                levels: 255,
                exposure_time: t.as_f64().unwrap(),
            });
        }
        let r = Response::Srgb;
        let x: Vec<Rgb> = frames.iter().map(|f| noise::exposure(f, &r)).collect();
        let n = noise::estimate(&frames, &x, &r);
        let v = triage::triage(&frames, &x, &n, &vec![false; frames.len()], None);
        println!("{} fw {:.0} rn {:.1}", dir.split('/').last().unwrap(), 1.0 / n.shot, n.read.sqrt() / n.shot);
        for (v, m) in v.iter().zip(b["meta"].as_array().unwrap()) {
            println!("   true {} found {} detail {:.3} steep {:.3}", m["sharp"], v.sharp, v.detail, v.steepness);
        }
    }
}
