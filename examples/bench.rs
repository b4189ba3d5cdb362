use unshaken::{gpu::*, kernels::*, tsf::*};
fn main() {
    let file = TsfFile::parse(&std::fs::read_to_string("/work/shared/data/brackets/desk-shaken/truth_tsf.json").unwrap()).unwrap();
    let gpu = Gpu::new().unwrap();
    println!("{}", gpu.description);
    for interp in [Interpolation::Bicubic, Interpolation::Bilinear] {
        let k = Kernels::new(&gpu, interp);
        for e in &file.frames[3..] {
            let t = Tsf::new(e.focal_px, e.poses.clone()).unwrap();
            let (w, h) = (e.width, e.height);
            let t0 = std::time::Instant::now();
            let taps = TapSet::new(&t, w, h, interp);
            println!(
                "poses {} bases {} taps {} energy {:.4} in {:?}",
                t.poses.len(),
                taps.bases.len(),
                taps.taps.len(),
                taps.energy(),
                t0.elapsed()
            );
            let pad = 20;
            let b = Blur::new(&gpu, &k.blur, &taps, (w, h), pad);
            let s = Scratch::new(&gpu, b.scratch_wanted()).unwrap();
            let n = (w + 2 * pad) * (h + 2 * pad);
            let l = channels(&gpu, "l", n).unwrap();
            let f = channels(&gpu, "f", w * h).unwrap();
            for c in 0..3 {
                gpu.queue.write_buffer(&l[c], 0, bytemuck::cast_slice(&vec![1.0f32; n]));
            }
            for (name, steps) in [("K", b.forward(&gpu, &k.blur, &s, &l, &f)), ("KT", b.adjoint(&gpu, &k.blur, &s, &f, &l, 1.0))] {
                for (i, st) in steps.iter().enumerate() {
                    gpu.submit(std::slice::from_ref(st));
                    read(&gpu, &f[0], 1).unwrap();
                    let t0 = std::time::Instant::now();
                    for _ in 0..3 {
                        gpu.submit(std::slice::from_ref(st));
                    }
                    read(&gpu, &f[0], 1).unwrap();
                    println!("{name} step {i}: {:.1} ms", t0.elapsed().as_secs_f64() * 1000.0 / 3.0);
                }
            }
        }
    }
}
