//! The synthetic brackets against the physics that they claim.

use unshaken::synth::{self, Camera, Tremor};

#[test]
#[ignore = "writes pictures to look at"]
fn look() {
    let t0 = std::time::Instant::now();
    let scene = synth::room(512, 384, 48, 1);
    eprintln!("scene {:?}", t0.elapsed());
    let tremor = |extent_px| Some(Tremor { extent_px, roll_deg: 1.0, offset_px: 1.5, offset_deg: 0.1 });
    let frames = [(1.0 / 30.0, None), (0.125, None), (0.2, None), (0.5, tremor(10.0)), (2.0, tremor(18.0))];
    let b = synth::capture(&scene, &Camera::default(), &frames, 0.06, 1).unwrap();
    eprintln!("all {:?} poses {:?}", t0.elapsed(), b.tsfs.iter().map(|t| t.poses.len()).collect::<Vec<_>>());
    unshaken::tonemap::preview(&b.truth).save("/tmp/bash_jobs.0/truth.png").unwrap();
    for f in b.bracket.frames() {
        let p = &f.intensity;
        image::RgbImage::from_fn(512, 384, |x, y| image::Rgb(p.pixel(y as usize * 512 + x as usize).map(|v| (v * 255.0).round() as u8)))
            .save(format!("/tmp/bash_jobs.0/{}", f.name))
            .unwrap();
        let clipped = p.0[0].data.iter().filter(|&&v| v >= 1.0).count();
        eprintln!("{} clipped {clipped}", f.name);
    }
    let mut l = b.truth.mean().data;
    l.sort_by(f32::total_cmp);
    eprintln!("{:?}", [0.0, 0.01, 0.1, 0.25, 0.5, 0.75, 0.9, 0.99, 0.999, 1.0].map(|q| l[((l.len() - 1) as f64 * q) as usize]));
}
