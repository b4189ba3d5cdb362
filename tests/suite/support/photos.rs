//! Photographs as cameras write them: DNG files byte by byte, JPEG files with EXIF.

use exif::{Field, In, Rational, SRational, Tag, Value};
use std::path::Path;
use unshaken::image::Rgb;

/// What a camera notes.
#[derive(Clone)]
pub struct Notes {
    pub time: Option<(u32, u32)>,
    pub f_number: Option<(u32, u32)>,
    pub iso: Option<u16>,
    pub bias: Option<(i32, i32)>,
    pub taken: Option<&'static str>,
    pub orientation: u16,
    pub artist: Option<&'static str>,
    pub copyright: Option<&'static str>,
    pub lens: Option<&'static str>,
    pub model: &'static str,
    /// NoiseProfile of a DNG file: pairs S, O.
    pub noise: Option<Vec<f64>>,
}

impl Default for Notes {
    fn default() -> Self {
        Self {
            time: Some((1, 8)),
            f_number: Some((56, 10)),
            iso: Some(200),
            bias: None,
            taken: None,
            orientation: 1,
            artist: None,
            copyright: None,
            lens: None,
            model: "Model 1",
            noise: None,
        }
    }
}

impl Notes {
    fn fields(&self) -> Vec<Field> {
        let field = |tag, value| Field { tag, ifd_num: In::PRIMARY, value };
        let text = |t: &str| Value::Ascii(vec![t.as_bytes().to_vec()]);
        let mut all = vec![
            field(Tag::Make, text("Maker")),
            field(Tag::Model, text(self.model)),
            field(Tag::Orientation, Value::Short(vec![self.orientation])),
            field(Tag::XResolution, Value::Rational(vec![Rational { num: 300, denom: 1 }])),
            field(Tag::PixelXDimension, Value::Long(vec![4321])),
            field(Tag::GPSLatitudeRef, text("S")),
            field(Tag::GPSLatitude, Value::Rational([33, 30, 0].map(|num| Rational { num, denom: 1 }).to_vec())),
        ];
        let ratio = |(num, denom)| Value::Rational(vec![Rational { num, denom }]);
        all.extend(self.time.map(|t| field(Tag::ExposureTime, ratio(t))));
        all.extend(self.f_number.map(|n| field(Tag::FNumber, ratio(n))));
        all.extend(self.iso.map(|s| field(Tag::PhotographicSensitivity, Value::Short(vec![s]))));
        all.extend(self.bias.map(|(num, denom)| field(Tag::ExposureBiasValue, Value::SRational(vec![SRational { num, denom }]))));
        all.extend(self.taken.map(|t| field(Tag::DateTimeOriginal, text(t))));
        all.extend(self.artist.map(|t| field(Tag::Artist, text(t))));
        all.extend(self.copyright.map(|t| field(Tag::Copyright, text(t))));
        all.extend(self.lens.map(|t| field(Tag::LensModel, text(t))));
        all
    }

    /// An EXIF block.
    pub fn exif(&self) -> Vec<u8> {
        let fields = self.fields();
        let mut writer = exif::experimental::Writer::new();
        fields.iter().for_each(|f| writer.push_field(f));
        let mut block = std::io::Cursor::new(Vec::new());
        writer.write(&mut block, false).unwrap();
        block.into_inner()
    }
}

/// A JPEG with an EXIF block.
pub fn write_jpeg(path: &Path, picture: &image::RgbImage, notes: &Notes) {
    use image::ImageEncoder;
    let mut encoder = image::codecs::jpeg::JpegEncoder::new_with_quality(std::fs::File::create(path).unwrap(), 95);
    encoder.set_exif_metadata(notes.exif()).unwrap();
    picture.write_with_encoder(encoder).unwrap();
}

/// What the camera of [`dng`] sees of white: its sensor is less sensitive to red and blue.
pub const NEUTRAL: [f64; 3] = [0.5, 1.0, 0.625];
pub const BLACK: f64 = 512.0;
pub const WHITE: f64 = 15360.0;

/// A DNG file of a camera with an RGGB filter whose colours are Rec. 709's: site = black + (white - black) · value · [`NEUTRAL`], clipped.
/// `scene`: linear Rec. 709, 1 saturates green.
pub fn dng(scene: &Rgb, notes: &Notes) -> Vec<u8> {
    let (w, h) = scene.size();
    let mut pixels = Vec::with_capacity(2 * w * h);
    for y in 0..h {
        for x in 0..w {
            let c = [[0, 1], [1, 2]][y % 2][x % 2];
            let value = BLACK + (WHITE - BLACK) * f64::from(scene.0[c].at(x, y)) * NEUTRAL[c];
            pixels.extend((value.round().clamp(0.0, WHITE) as u16).to_le_bytes());
        }
    }
    // XYZ of D65 to Rec. 709 (IEC 61966-2-1).
    let matrix: [f64; 9] = [3.2406, -1.5372, -0.4986, -0.9689, 1.8758, 0.0415, 0.0557, -0.2040, 1.0570];
    let short = |v: &[u16]| (3u16, v.len() as u32, v.iter().flat_map(|v| v.to_le_bytes()).collect::<Vec<u8>>());
    let long = |v: u32| (4u16, 1u32, v.to_le_bytes().to_vec());
    let bytes = |v: &[u8]| (1u16, v.len() as u32, v.to_vec());
    let text = |t: &str| (2u16, t.len() as u32 + 1, [t.as_bytes(), &[0]].concat());
    let ratios = |kind: u16, v: &[(i64, i64)]| {
        (
            kind,
            v.len() as u32,
            v.iter().flat_map(|(a, b)| [(*a as u32).to_le_bytes(), (*b as u32).to_le_bytes()].concat()).collect::<Vec<u8>>(),
        )
    };
    let ten_thousandths = |v: &[f64]| v.iter().map(|v| ((v * 10_000.0).round() as i64, 10_000)).collect::<Vec<_>>();
    let mut exif = Vec::new();
    exif.extend(notes.time.map(|(a, b)| (33434u16, ratios(5, &[(i64::from(a), i64::from(b))]))));
    exif.extend(notes.f_number.map(|(a, b)| (33437, ratios(5, &[(i64::from(a), i64::from(b))]))));
    exif.extend(notes.iso.map(|s| (34855, short(&[s]))));
    exif.extend(notes.taken.map(|t| (36867, text(t))));
    let mut main = vec![
        (254u16, long(0)),
        (256, long(w as u32)),
        (257, long(h as u32)),
        (258, short(&[16])),
        (259, short(&[1])),
        (262, short(&[32803])),
        (271, text("Maker")),
        (272, text("Model 1")),
        (273, long(0)),
        (274, short(&[notes.orientation])),
        (277, short(&[1])),
        (278, long(h as u32)),
        (279, long(pixels.len() as u32)),
        (284, short(&[1])),
        (33421, short(&[2, 2])),
        (33422, bytes(&[0, 1, 1, 2])),
        (34665, long(0)),
        (50706, bytes(&[1, 4, 0, 0])),
        (50708, text("Maker Model 1")),
        (50714, short(&[BLACK as u16])),
        (50717, short(&[WHITE as u16])),
        (50721, ratios(10, &ten_thousandths(&matrix))),
        (50728, ratios(5, &ten_thousandths(&NEUTRAL))),
        (50778, short(&[21])),
    ];
    main.extend(notes.artist.map(|a| (315, text(a))));
    main.extend(
        notes.noise.as_ref().map(|v| (51041, (12u16, v.len() as u32, v.iter().flat_map(|v| v.to_le_bytes()).collect::<Vec<u8>>()))),
    );
    main.sort_by_key(|t| t.0);
    type Entry = (u16, (u16, u32, Vec<u8>));
    let directory = |entries: &[Entry], at: u32| {
        let (mut table, mut more) = ((entries.len() as u16).to_le_bytes().to_vec(), Vec::new());
        let behind = at + 2 + 12 * entries.len() as u32 + 4;
        for (tag, (kind, count, data)) in entries {
            table.extend(tag.to_le_bytes());
            table.extend(kind.to_le_bytes());
            table.extend(count.to_le_bytes());
            if data.len() <= 4 {
                table.extend([data.as_slice(), &[0; 4]].concat()[..4].iter());
            } else {
                table.extend((behind + more.len() as u32).to_le_bytes());
                more.extend(data);
                more.resize(more.len().next_multiple_of(2), 0);
            }
        }
        table.extend(0u32.to_le_bytes());
        table.extend(more);
        table
    };
    let exif_at = 8 + directory(&main, 8).len() as u32;
    let pixels_at = exif_at + directory(&exif, exif_at).len() as u32;
    for (tag, value) in [(273, pixels_at), (34665, exif_at)] {
        main.iter_mut().find(|e| e.0 == tag).unwrap().1 = long(value);
    }
    let mut file = b"II*\0\x08\0\0\0".to_vec();
    file.extend(directory(&main, 8));
    file.extend(directory(&exif, exif_at));
    file.extend(pixels);
    file
}
