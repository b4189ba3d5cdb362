//! Files: frames, exposure times, OpenEXR, outputs.

use crate::support::files::{listing, shared, with_exif};
use image::DynamicImage;
use std::path::{Path, PathBuf};
use tempfile::tempdir;
use unshaken::image::{Plane, Rgb};
use unshaken::io::exr::{self, Radiometry};
use unshaken::io::output::{self, Output};
use unshaken::io::{ldr, metadata};

fn error_of(path: &Path) -> String {
    let error = ldr::read(path).unwrap_err().to_string();
    assert!(error.starts_with(&path.display().to_string()) && !error.contains('\n'), "{error}");
    error
}

fn radiometry() -> Radiometry {
    Radiometry { exposure_time: 0.2, frame: "b.png".into() }
}

#[test]
fn intensities_are_codes_over_the_largest_code() {
    let dir = tempdir().unwrap();
    let rgb8 = image::RgbImage::from_fn(5, 3, |x, y| image::Rgb([x as u8 * 50, y as u8 * 100, 255]));
    let rgb16 = image::ImageBuffer::from_fn(5, 3, |x, y| image::Rgb([x as u16 * 257 + 1, y as u16 * 30000, 65535]));
    for extension in ["png", "tif"] {
        let path = dir.path().join("rgb8").with_extension(extension);
        rgb8.save(&path).unwrap();
        let p = ldr::read(&path).unwrap();
        assert_eq!((p.levels, p.intensity.size()), (255, (5, 3)));
        assert_eq!(p.intensity.pixel(2 * 5 + 4), [200.0 / 255.0, 200.0 / 255.0, 1.0]);

        let path = dir.path().join("rgb16").with_extension(extension);
        DynamicImage::ImageRgb16(rgb16.clone()).save(&path).unwrap();
        let p = ldr::read(&path).unwrap();
        assert_eq!(p.levels, 65535);
        assert_eq!(p.intensity.pixel(5 + 3), [772.0 / 65535.0, 30000.0 / 65535.0, 1.0]);
    }
    let grey = dir.path().join("grey.png");
    image::GrayImage::from_fn(4, 2, |x, _| image::Luma([x as u8 * 60])).save(&grey).unwrap();
    assert_eq!(ldr::read(&grey).unwrap().intensity.pixel(3), [180.0 / 255.0; 3]);
    let alpha = dir.path().join("alpha.png");
    image::RgbaImage::from_fn(4, 2, |_, _| image::Rgba([10, 20, 30, 0])).save(&alpha).unwrap();
    assert_eq!(ldr::read(&alpha).unwrap().intensity.pixel(0), [10.0, 20.0, 30.0].map(|v: f32| v / 255.0));
}

#[test]
fn unreadable_frames_are_named_with_the_remedy() {
    let dir = tempdir().unwrap();
    let at = |name: &str| dir.path().join(name);
    assert!(error_of(&at("none.png")).contains("cannot be read (no such file"));
    assert!(error_of(dir.path()).contains("is a folder"));
    std::fs::write(at("empty.png"), "").unwrap();
    assert!(error_of(&at("empty.png")).contains("is empty"));
    std::fs::write(at("text.png"), "no picture").unwrap();
    assert!(error_of(&at("text.png")).contains("is not a picture"));
    std::fs::write(at("old.png"), b"GIF89a--------------").unwrap();
    assert!(error_of(&at("old.png")).contains("is a gif file; save the frame as"));
    let float = image::Rgb32FImage::from_pixel(4, 4, image::Rgb([0.5f32; 3]));
    DynamicImage::ImageRgb32F(float).save(at("float.tif")).unwrap();
    assert!(ldr::read(&at("float.tif")).unwrap().float, "floating-point numbers are linear");

    // Cut anywhere, a file is refused, never filled up.
    let noise = image::RgbImage::from_fn(64, 48, |x, y| image::Rgb([(x * 37 + y * 91) as u8, (x * y) as u8, (x * 5) as u8]));
    for name in ["whole.png", "whole.jpg", "whole.tif"] {
        noise.save(at(name)).unwrap();
        assert_eq!(ldr::read(&at(name)).unwrap().intensity.size(), (64, 48));
        let bytes = std::fs::read(at(name)).unwrap();
        let cut = at(&format!("cut-{name}"));
        for tenths in [1, 3, 5, 7, 9] {
            std::fs::write(&cut, &bytes[..bytes.len() * tenths / 10]).unwrap();
            let error = error_of(&cut);
            assert!(error.contains("copy it again") || error.contains("is not a picture"), "{tenths}/10: {error}");
        }
    }
}

#[test]
fn jpegs_may_carry_thumbnails_and_data_behind_their_end() {
    let dir = tempdir().unwrap();
    let picture = DynamicImage::ImageRgb8(image::RgbImage::from_fn(32, 16, |x, y| image::Rgb([x as u8, y as u8, 9])));
    let path = dir.path().join("a.jpg");
    // End markers inside the metadata must not pass for the picture's own.
    with_exif(&path, &picture, &[(exif::Tag::ImageDescription, exif::Value::Ascii(vec![vec![0xFF, 0xD9, 0xFF, 0xD9]]))]);
    let mut bytes = std::fs::read(&path).unwrap();
    std::fs::write(&path, &bytes[..bytes.len() - 40]).unwrap();
    assert!(error_of(&path).contains("truncated"));
    bytes.extend_from_slice(b"trailing data of a camera");
    std::fs::write(&path, &bytes).unwrap();
    assert_eq!(ldr::read(&path).unwrap().intensity.size(), (32, 16));
}

/// By the frame header of the picture itself, not of a thumbnail in its metadata.
#[test]
fn a_jpeg_that_holds_colour_coarsely_is_told() {
    let picture = DynamicImage::ImageRgb8(image::RgbImage::from_fn(32, 16, |x, y| image::Rgb([x as u8, 8 * y as u8, 9])));
    let dir = tempdir().unwrap();
    let path = dir.path().join("a.jpg");
    // SOF0 of a picture of 8 x 8 pixels with components of 2 x 2, 1 x 1 and 1 x 1 samples.
    let header = [0xFF, 0xC0, 0, 17, 8, 0, 8, 0, 8, 3, 1, 0x22, 0, 2, 0x11, 1, 3, 0x11, 1];
    with_exif(&path, &picture, &[(exif::Tag::ImageDescription, exif::Value::Ascii(vec![header.to_vec()]))]);
    let read = ldr::read(&path).unwrap();
    assert!(!read.chroma_subsampled, "4:4:4");
    let png = dir.path().join("a.png");
    picture.save(&png).unwrap();
    assert!(read.lossy && !ldr::read(&png).unwrap().lossy, "JPEG drops what is fine, PNG nothing");
    let mut bytes = std::fs::read(&path).unwrap();
    let tail = |bytes: &[u8], marker: [u8; 2]| bytes.windows(2).rposition(|w| w == marker).unwrap();
    let at = tail(&bytes, [0xFF, 0xC0]);
    assert_eq!(bytes[at + 9..at + 12], [3, bytes[at + 10], 0x11], "three components");
    // Four blocks of brightness for one of each colour, where the file has one: enough data for the first quarter of them.
    for samples in [0x22, 0x21] {
        bytes[at + 11] = samples;
        std::fs::write(&path, &bytes).unwrap();
        assert!(ldr::read(&path).unwrap().chroma_subsampled, "{samples:x}");
    }
}

#[test]
fn exposure_times_come_from_exif() {
    let dir = tempdir().unwrap();
    let picture = DynamicImage::ImageRgb8(image::RgbImage::new(8, 8));
    let time = |num, denom| (exif::Tag::ExposureTime, exif::Value::Rational(vec![exif::Rational { num, denom }]));
    for name in ["a.jpg", "a.png"] {
        let path = dir.path().join(name);
        with_exif(&path, &picture, &[time(1, 30)]);
        assert_eq!(metadata::exposure_time(&path).unwrap(), Some(1.0 / 30.0), "{name}");
        with_exif(&path, &picture, &[time(0, 1)]);
        assert_eq!(metadata::exposure_time(&path).unwrap(), Some(0.0), "{name}");
        with_exif(&path, &picture, &[time(0, 0), (exif::Tag::Orientation, exif::Value::Short(vec![1]))]);
        assert_eq!(metadata::exposure_time(&path).unwrap(), None, "{name}");
        let shutter = exif::Value::SRational(vec![exif::SRational { num: 3, denom: 1 }]);
        with_exif(&path, &picture, &[(exif::Tag::ShutterSpeedValue, shutter)]);
        assert_eq!(metadata::exposure_time(&path).unwrap(), Some(0.125), "{name}");
        picture.save(&path).unwrap();
        assert_eq!(metadata::exposure_time(&path).unwrap(), None, "{name}");
    }
    assert!(metadata::exposure_time(&dir.path().join("none.jpg")).is_err());
}

#[test]
fn real_frames_note_their_exposure_times() {
    let Some(folder) = shared("data/brackets/office") else { return };
    let times: Vec<_> = (1..=6).map(|i| metadata::exposure_time(&folder.join(format!("office_{i}.jpg"))).unwrap().unwrap()).collect();
    assert_eq!(times, [1.0 / 30.0, 0.1, 1.0 / 3.0, 0.625, 1.3, 4.0]);
}

#[test]
fn frames_are_read_upright() {
    let dir = tempdir().unwrap();
    let path = dir.path().join("portrait.jpg");
    // The left half is bright; turned clockwise by a quarter (orientation 6), the top is.
    let picture = image::RgbImage::from_fn(32, 16, |x, _| image::Rgb([if x < 16 { 240 } else { 10 }; 3]));
    with_exif(&path, &DynamicImage::ImageRgb8(picture), &[(exif::Tag::Orientation, exif::Value::Short(vec![6]))]);
    let p = ldr::read(&path).unwrap().intensity;
    assert_eq!(p.size(), (16, 32));
    assert!(p.0[0].at(8, 4) > 0.9 && p.0[0].at(8, 28) < 0.1);
}

#[test]
fn openexr_keeps_every_bit_and_states_the_rule() {
    let dir = tempdir().unwrap();
    let path = dir.path().join("a.exr");
    let image = Rgb([1.0f32, 0.3, 1e-9].map(|s| Plane::from_fn(37, 21, |x, y| s * (x as f32 + 0.1).powi(3) * (y as f32 + 0.7))));
    Output::check(&path, false).unwrap().stage_exr(&image, &radiometry()).unwrap().commit().unwrap();
    let (read, factor) = exr::read(&path).unwrap();
    assert_eq!(read, image);
    assert_eq!(factor, Some(f64::from(0.2f32)));

    let meta = ::exr::meta::MetaData::read_from_file(&path, false).unwrap();
    let header = &meta.headers[0];
    let comments = header.own_attributes.comments.as_ref().unwrap().to_string();
    assert_eq!(comments, "1.0 is the white of the reference frame b.png: value = irradiance x its exposure time (0.2 s)");
    assert_eq!(header.own_attributes.exposure, Some(0.2));
    assert!(header.own_attributes.software_name.as_ref().unwrap().to_string().starts_with("unshaken "));
    assert_eq!(header.shared_attributes.chromaticities.unwrap().red.x(), 0.64);
    assert!(header.channels.list.iter().all(|c| c.sample_type == ::exr::meta::attribute::SampleType::F32));
}

#[test]
fn half_float_openexr_is_read() {
    let Some(path) = shared("data/scenes/Desk.exr") else { return };
    let (image, factor) = exr::read(&path).unwrap();
    assert_eq!(factor, None);
    assert!(image.width() > 300 && image.0[1].data.iter().any(|v| *v > 1.0));
}

#[test]
fn pixels_that_are_no_irradiance_are_never_written() {
    let dir = tempdir().unwrap();
    let path = dir.path().join("a.exr");
    for wrong in [f32::NAN, f32::INFINITY, f32::NEG_INFINITY, -1e-20] {
        let mut image = Rgb::filled(7, 5, 0.5);
        image.0[1].data[2 * 7 + 3] = wrong;
        let error = Output::check(&path, false).unwrap().stage_exr(&image, &radiometry()).unwrap_err().to_string();
        assert!(error.contains("green at pixel (3, 2)") && error.contains("a.exr"), "{error}");
        assert!(listing(dir.path()).is_empty());
    }
}

#[test]
fn an_output_is_whole_or_untouched() {
    let dir = tempdir().unwrap();
    let path = dir.path().join("a.json");
    let output = Output::check(&path, false).unwrap();
    assert!(listing(dir.path()).is_empty(), "the check leaves nothing");
    output.stage_json(&[1, 2]).unwrap().commit().unwrap();
    assert_eq!(std::fs::read_to_string(&path).unwrap(), "[\n  1,\n  2\n]\n");

    assert!(Output::check(&path, false).unwrap_err().to_string().contains("exists; give --overwrite"));
    // It may also come into being while the work goes on.
    assert!(output.stage_json(&3).unwrap().commit().unwrap_err().to_string().contains("exists"));
    let replace = Output::check(&path, true).unwrap();
    let failed = replace.stage(|to| std::io::Write::write_all(to, b"half").map_err(|e| e.to_string()).and(Err("disk full".into())));
    assert!(failed.unwrap_err().to_string().contains("disk full"));
    drop(replace.stage_json(&4).unwrap());
    assert_eq!(std::fs::read_to_string(&path).unwrap(), "[\n  1,\n  2\n]\n");
    replace.stage_json(&5).unwrap().commit().unwrap();
    assert_eq!(std::fs::read_to_string(&path).unwrap(), "5\n");
    assert_eq!(listing(dir.path()), ["a.json"]);
    #[cfg(unix)]
    {
        use std::os::unix::fs::PermissionsExt;
        std::fs::write(dir.path().join("plain"), "").unwrap();
        let mode = |name: &str| std::fs::metadata(dir.path().join(name)).unwrap().permissions().mode();
        assert_eq!(mode("a.json"), mode("plain"), "permissions of any new file");
    }
}

#[test]
fn outputs_that_cannot_be_written_are_refused_before_the_work() {
    let dir = tempdir().unwrap();
    std::fs::write(dir.path().join("file"), "").unwrap();
    let check = |path: PathBuf| Output::check(&path, true).unwrap_err().to_string();
    assert!(check(dir.path().join("none/a.exr")).contains("does not exist; make it first"));
    assert!(check(dir.path().join("file/a.exr")).contains("is not a folder"));
    assert!(check(dir.path().into()).contains("is a folder"));
    if Path::new("/proc/self").exists() {
        // Even root cannot make a file here.
        assert!(check("/proc/a.exr".into()).contains("takes no new file"));
        assert!(check("/dev/null".into()).contains("not a plain file"));
    }
}

#[test]
fn outputs_and_inputs_are_distinct_files() {
    let dir = tempdir().unwrap();
    let (a, b) = (dir.path().join("a"), dir.path().join("b"));
    std::fs::write(&a, "").unwrap();
    std::fs::create_dir(dir.path().join("sub")).unwrap();
    let other = dir.path().join("sub/../b");
    assert!(output::check_distinct(&[("--output", &b)], &[("frame", &a)]).is_ok());
    let error = output::check_distinct(&[("--output", &b), ("--report", &other)], &[]).unwrap_err().to_string();
    assert!(error.contains("both --output and --report"), "{error}");
    let again = dir.path().join("sub/../a");
    let error = output::check_distinct(&[("--output", &again)], &[("frame", &a)]).unwrap_err().to_string();
    assert!(error.contains("--output would replace the frame"), "{error}");
}
