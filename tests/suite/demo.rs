//! The demo's bracket and its before/after picture.

use unshaken::baseline;
use unshaken::cli::demo;
use unshaken::io::output::Output;
use unshaken::metrics::{Judge, score};
use unshaken::response::Response;
use unshaken::tonemap::ToneMap;

#[test]
fn the_bracket_is_one_that_deblurring_helps() {
    let s = demo::bracket().unwrap();
    let (width, height) = s.bracket.size();
    assert!(width >= 512 && height >= 384);
    assert_eq!(s.sharp, [true, true, true, false, false]);
    let judge = Judge { limit: Some(0.98 * 30.0), ..Judge::default() };
    let of = |frames: &[usize]| score(&baseline::merge(&s.bracket, &Response::Srgb, frames), &s.truth, &judge).unwrap();
    let (plain, sharp) = (of(&[0, 1, 2, 3, 4]), of(&[0, 1, 2]));
    // The shaken frames blur the plain merge; the sharp ones alone are noisy: both leave much to win.
    assert!(plain.edge_ratio < 0.6 && plain.pu_psnr < 26.0, "{plain:?}");
    assert!(sharp.pu_psnr > plain.pu_psnr && sharp.pu_psnr < 30.0, "{sharp:?}");
    let clipped = s.bracket.frames()[0].intensity.mean().data.iter().filter(|&&v| v >= 1.0).count();
    assert!(clipped < width * height / 100, "the shortest frame clips {clipped} pixels");

    let shaken = demo::as_taken(&s.bracket.frames()[4], &Response::Srgb, &s.truth);
    let map = ToneMap::fit(&s.truth);
    let merged = |frames: &[usize]| baseline::merge(&s.bracket, &Response::Srgb, frames);
    let (plain, sharp) = (merged(&[0, 1, 2, 3, 4]), merged(&[0, 1, 2]));
    let columns = [("SHAKEN, 2 S", &shaken), ("ALL FRAMES MERGED", &plain), ("SHARP FRAMES ONLY", &sharp), ("UNSHAKEN", &s.truth)];
    let picture = demo::comparison(&columns, &map);
    assert!(picture.width() > 1600 && picture.height() > 900);
    // What the README shows: small enough for a web page, and readable.
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("before-after.jpg");
    Output::check(&path, false).unwrap().stage_jpeg(&picture, demo::JPEG_QUALITY).unwrap().commit().unwrap();
    let bytes = std::fs::metadata(&path).unwrap().len();
    assert!((100_000..400_000).contains(&bytes), "{bytes} bytes");
    assert_eq!(image::open(&path).unwrap().into_rgb8().dimensions(), picture.dimensions());
    let label = picture.enumerate_pixels().filter(|(_, y, p)| *y < 28 && p.0[0] > 200).count();
    assert!(label > 300, "labels are drawn: {label} light pixels");
}
