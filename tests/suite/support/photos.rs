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

    /// Time, aperture, speed and date, as entries of an EXIF directory.
    pub fn exposure(&self, t: &Tiff) -> Vec<Entry> {
        let mut entries = Vec::new();
        entries.extend(self.time.map(|(a, b)| (33434, t.ratios(5, &[(i64::from(a), i64::from(b))]))));
        entries.extend(self.f_number.map(|(a, b)| (33437, t.ratios(5, &[(i64::from(a), i64::from(b))]))));
        entries.extend(self.iso.map(|s| (34855, t.short(&[s]))));
        entries.extend(self.taken.map(|d| (36867, t.text(d))));
        entries
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

/// Tag, and kind, count and bytes of its value.
pub type Entry = (u16, (u16, u32, Vec<u8>));

/// Directories of TIFF files in either byte order.
pub struct Tiff {
    pub big: bool,
}

impl Tiff {
    fn two(&self, v: u16) -> [u8; 2] {
        if self.big { v.to_be_bytes() } else { v.to_le_bytes() }
    }

    fn four(&self, v: u32) -> [u8; 4] {
        if self.big { v.to_be_bytes() } else { v.to_le_bytes() }
    }

    pub fn short(&self, v: &[u16]) -> (u16, u32, Vec<u8>) {
        (3, v.len() as u32, v.iter().flat_map(|v| self.two(*v)).collect())
    }

    pub fn long(&self, v: u32) -> (u16, u32, Vec<u8>) {
        (4, 1, self.four(v).to_vec())
    }

    pub fn bytes(&self, v: &[u8]) -> (u16, u32, Vec<u8>) {
        (1, v.len() as u32, v.to_vec())
    }

    pub fn text(&self, t: &str) -> (u16, u32, Vec<u8>) {
        (2, t.len() as u32 + 1, [t.as_bytes(), &[0]].concat())
    }

    /// Fractions, of kind 5 or 10.
    pub fn ratios(&self, kind: u16, v: &[(i64, i64)]) -> (u16, u32, Vec<u8>) {
        (kind, v.len() as u32, v.iter().flat_map(|(a, b)| [self.four(*a as u32), self.four(*b as u32)].concat()).collect())
    }

    /// One directory that lies at `at`, and behind it what does not fit into its entries.
    pub fn directory(&self, entries: &[Entry], at: u32) -> Vec<u8> {
        let (mut table, mut more) = (self.two(entries.len() as u16).to_vec(), Vec::new());
        let behind = at + 2 + 12 * entries.len() as u32 + 4;
        for (tag, (kind, count, data)) in entries {
            table.extend(self.two(*tag));
            table.extend(self.two(*kind));
            table.extend(self.four(*count));
            if data.len() <= 4 {
                table.extend([data.as_slice(), &[0; 4]].concat()[..4].iter());
            } else {
                table.extend(self.four(behind + more.len() as u32));
                more.extend(data);
                more.resize(more.len().next_multiple_of(2), 0);
            }
        }
        table.extend([0; 4]);
        table.extend(more);
        table
    }
}

/// What the cameras of raw files see of white: their sensors are less sensitive to red and blue.
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
    let t = Tiff { big: false };
    // XYZ of D65 to Rec. 709 (IEC 61966-2-1).
    let matrix: [f64; 9] = [3.2406, -1.5372, -0.4986, -0.9689, 1.8758, 0.0415, 0.0557, -0.2040, 1.0570];
    let ten_thousandths = |v: &[f64]| v.iter().map(|v| ((v * 10_000.0).round() as i64, 10_000)).collect::<Vec<_>>();
    let exif = notes.exposure(&t);
    let mut main = vec![
        (254u16, t.long(0)),
        (256, t.long(w as u32)),
        (257, t.long(h as u32)),
        (258, t.short(&[16])),
        (259, t.short(&[1])),
        (262, t.short(&[32803])),
        (271, t.text("Maker")),
        (272, t.text("Model 1")),
        (273, t.long(0)),
        (274, t.short(&[notes.orientation])),
        (277, t.short(&[1])),
        (278, t.long(h as u32)),
        (279, t.long(pixels.len() as u32)),
        (284, t.short(&[1])),
        (33421, t.short(&[2, 2])),
        (33422, t.bytes(&[0, 1, 1, 2])),
        (34665, t.long(0)),
        (50706, t.bytes(&[1, 4, 0, 0])),
        (50708, t.text("Maker Model 1")),
        (50714, t.short(&[BLACK as u16])),
        (50717, t.short(&[WHITE as u16])),
        (50721, t.ratios(10, &ten_thousandths(&matrix))),
        (50728, t.ratios(5, &ten_thousandths(&NEUTRAL))),
        (50778, t.short(&[21])),
    ];
    main.extend(notes.artist.map(|a| (315, t.text(a))));
    main.extend(
        notes.noise.as_ref().map(|v| (51041, (12u16, v.len() as u32, v.iter().flat_map(|v| v.to_le_bytes()).collect::<Vec<u8>>()))),
    );
    main.sort_by_key(|t| t.0);
    let exif_at = 8 + t.directory(&main, 8).len() as u32;
    let pixels_at = exif_at + t.directory(&exif, exif_at).len() as u32;
    for (tag, value) in [(273, pixels_at), (34665, exif_at)] {
        main.iter_mut().find(|e| e.0 == tag).unwrap().1 = t.long(value);
    }
    let mut file = b"II*\0\x08\0\0\0".to_vec();
    file.extend(t.directory(&main, 8));
    file.extend(t.directory(&exif, exif_at));
    file.extend(pixels);
    file
}
