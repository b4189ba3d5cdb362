//! Shared data, files and pictures that tests of files need.

use image::{DynamicImage, ImageEncoder};
use std::io::Cursor;
use std::path::{Path, PathBuf};
use unshaken::image::Plane;

/// `path` in the shared data: in the folder that UNSHAKEN_SHARED names, else in `../shared` beside the repository.
/// Without it, `None`, and the test says that it was skipped; in CI (CI=true) the test fails.
pub fn shared(path: &str) -> Option<PathBuf> {
    let root = std::env::var_os("UNSHAKEN_SHARED").map_or_else(|| Path::new(env!("CARGO_MANIFEST_DIR")).join("../shared"), PathBuf::from);
    let full = root.join(path);
    if full.exists() {
        return Some(full);
    }
    let missing = format!("{} is not there; set UNSHAKEN_SHARED to the folder with the shared data", full.display());
    assert!(std::env::var("CI").as_deref() != Ok("true"), "{missing}");
    // Past the test harness, which would swallow it in a test that passes.
    use std::io::Write;
    let _ = writeln!(std::io::stderr(), "SKIPPED {}: {missing}", std::thread::current().name().unwrap_or("test"));
    None
}

/// Names of what lies in a folder, sorted.
pub fn listing(folder: &Path) -> Vec<String> {
    let mut names: Vec<_> = std::fs::read_dir(folder).unwrap().map(|e| e.unwrap().file_name().into_string().unwrap()).collect();
    names.sort();
    names
}

/// An 8-bit RGB PNG of `value(x, y)` in all channels.
pub fn write_png(path: &Path, width: u32, height: u32, value: impl Fn(u32, u32) -> u8) {
    image::RgbImage::from_fn(width, height, |x, y| image::Rgb([value(x, y); 3])).save(path).unwrap();
}

/// A JPEG or PNG with the EXIF fields given.
pub fn with_exif(path: &Path, picture: &DynamicImage, fields: &[(exif::Tag, exif::Value)]) {
    let fields: Vec<_> =
        fields.iter().map(|(tag, value)| exif::Field { tag: *tag, ifd_num: exif::In::PRIMARY, value: value.clone() }).collect();
    let mut writer = exif::experimental::Writer::new();
    fields.iter().for_each(|f| writer.push_field(f));
    let mut blob = Cursor::new(Vec::new());
    writer.write(&mut blob, false).unwrap();
    let file = std::fs::File::create(path).unwrap();
    if path.extension().is_some_and(|e| e == "png") {
        let mut encoder = image::codecs::png::PngEncoder::new(file);
        encoder.set_exif_metadata(blob.into_inner()).unwrap();
        picture.write_with_encoder(encoder).unwrap();
    } else {
        let mut encoder = image::codecs::jpeg::JpegEncoder::new_with_quality(file, 95);
        encoder.set_exif_metadata(blob.into_inner()).unwrap();
        picture.write_with_encoder(encoder).unwrap();
    }
}

/// Uniform numbers in 0..1 from a fixed seed.
pub struct Noise(rand_pcg::Pcg64Mcg);

impl Noise {
    pub fn new(seed: u128) -> Self {
        Self(rand_pcg::Pcg64Mcg::new(seed | 1))
    }

    pub fn uniform(&mut self) -> f64 {
        use rand::Rng;
        (self.0.next_u64() >> 11) as f64 / (1u64 << 53) as f64
    }

    /// Mean 0, variance 1.
    pub fn normal(&mut self) -> f64 {
        (-2.0 * (1.0 - self.uniform()).ln()).sqrt() * (std::f64::consts::TAU * self.uniform()).cos()
    }
}

/// Smooth irradiance over `decades` decades below 1, with some texture, so that every shade occurs.
pub fn scene(width: usize, height: usize, decades: f64) -> Plane {
    Plane::from_fn(width, height, |x, y| {
        let (u, v) = (x as f64 / width as f64, y as f64 / height as f64);
        let t = 0.5 + 0.5 * (5.0 * u + 2.0 * (4.0 * v).sin()).cos() * (0.6 + 0.4 * (7.0 * v + 3.0 * u).sin());
        10f64.powf(decades * (t - 1.0)) as f32
    })
}
