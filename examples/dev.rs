use unshaken::{exposure::*, image::*, pipeline, response::Response, tsf::TsfFile};
fn main() {
    let a: Vec<String> = std::env::args().collect();
    // dev DIR OUT.f32 [tsf|-] [key=val...]
    let dir = &a[1];
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
    let bracket = Bracket::new(frames).unwrap();
    let mut s = pipeline::Settings::default();
    let mut tsf = None;
    let mut resp = Response::Srgb;
    for kv in &a[3..] {
        let (k, v) = kv.split_once('=').unwrap();
        match k {
            "tsf" => tsf = Some(TsfFile::parse(&std::fs::read_to_string(v).unwrap()).unwrap()),
            "lambda" => s.deblur.lambda = v.parse().unwrap(),
            "robust" => s.deblur.robust = v.parse().unwrap(),
            "after" => s.deblur.robust_after = v.parse().unwrap(),
            "outer" => s.deblur.outer = v.parse().unwrap(),
            "inner" => s.deblur.inner = v.parse().unwrap(),
            "eps" => s.deblur.epsilon = v.parse().unwrap(),
            "interp" => s.deblur.interpolation = serde_json::from_str(&format!("\"{v}\"")).unwrap(),
            "sharp" => s.sharp = Some(v.split(',').map(|x| x.parse::<usize>().unwrap() - 1).collect()),
            "exclude" => s.exclude = v.split(',').map(|x| x.parse::<usize>().unwrap() - 1).collect(),
            "gamma" => resp = Response::Gamma(v.parse().unwrap()),
            _ => panic!("{k}"),
        }
    }
    let t0 = std::time::Instant::now();
    let out = pipeline::merge(&bracket, &resp, &s, tsf.as_ref(), &mut |e| {
        match &e {
            pipeline::Event::Warning(w) => eprintln!("warning: {w}"),
            pipeline::Event::Progress { stage, fraction } => eprintln!("{:.1} {stage} {fraction:.2}", t0.elapsed().as_secs_f64()),
        };
        true
    })
    .unwrap();
    eprintln!("{:.1} s", t0.elapsed().as_secs_f64());
    let mut bytes = vec![];
    for i in 0..out.irradiance.0[0].data.len() {
        for c in 0..3 {
            bytes.extend(out.irradiance.0[c].data[i].to_le_bytes());
        }
    }
    std::fs::write(&a[2], bytes).unwrap();
    std::fs::write(format!("{}.json", a[2]), serde_json::to_string(&out.report).unwrap()).unwrap();
}
