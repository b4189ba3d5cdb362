//! Raw files in makers' own formats, byte by byte as their cameras write them: NEF (12 bits, packed) and RAF (X-Trans, 14 bits).

use super::photos::{Entry, NEUTRAL, Notes, Tiff};
use unshaken::colour::{self, Matrix, Primaries};
use unshaken::image::Rgb;

/// Columns left and right of the picture, rows above and below it, that the sensor has besides.
type Margins = [usize; 4];

/// A sensor as its camera's notes describe it.
pub struct Sensor {
    model: &'static str,
    /// XYZ of D65 light to camera RGB, as DNG files of this camera note it.
    matrix: Matrix,
    margins: Margins,
    black: f64,
    pub white: f64,
    /// Channel of the site at column x, row y.
    filter: fn(usize, usize) -> usize,
}

pub const NIKON: Sensor = Sensor {
    model: "NIKON D610",
    matrix: [[0.8178, -0.2245, -0.0609], [-0.4857, 1.2394, 0.2776], [-0.1207, 0.2086, 0.7298]],
    margins: [8, 56, 6, 6],
    black: 0.0,
    white: 3880.0,
    filter: |x, y| [[0, 1], [1, 2]][y % 2][x % 2],
};

pub const FUJI: Sensor = Sensor {
    model: "X-T1",
    matrix: [[0.8458, -0.2451, -0.0855], [-0.4597, 1.2447, 0.2407], [-0.1475, 0.2482, 0.6526]],
    margins: [10, 60, 4, 8],
    black: 1024.0,
    white: 16383.0,
    filter: |x, y| {
        let at = 6 * (y % 6) + x % 6;
        b"RGB".iter().position(|c| *c == XTRANS[at]).unwrap()
    },
};
const XTRANS: &[u8; 36] = b"RBGBRGGGRGGBGGBGGRBRGRBGGGBGGRGGRGGB";

impl Sensor {
    /// Camera RGB of linear Rec. 709 whose 1 saturates green.
    pub fn sees(&self, pixel: [f32; 3]) -> [f64; 3] {
        let d65 = colour::adaptation(colour::D50, colour::D65).unwrap();
        let camera = colour::product(&self.matrix, &colour::product(&d65, &Primaries::Rec709.to_xyz()));
        let seen = colour::apply(&camera, pixel.map(f64::from));
        std::array::from_fn(|c| NEUTRAL[c] * seen[c] / camera[c].iter().sum::<f64>())
    }

    /// Width, height and values of all sites, in rows.
    fn sites(&self, scene: &Rgb) -> (usize, usize, Vec<u16>) {
        let (w, h) = scene.size();
        let [left, right, above, below] = self.margins;
        let (width, height) = (w + left + right, h + above + below);
        let value = |i: usize| {
            let (x, y) = (i % width, i / width);
            let inside = x.saturating_sub(left).min(w - 1) + w * y.saturating_sub(above).min(h - 1);
            let seen = self.sees(scene.pixel(inside))[(self.filter)(x, y)];
            (self.black + (self.white - self.black) * seen).round().clamp(0.0, self.white) as u16
        };
        (width, height, (0..width * height).map(value).collect())
    }
}

/// `place`'s value in the directory, which is known when the lengths are.
fn point(entries: &mut [Entry], place: u16, value: Entry) {
    entries.iter_mut().find(|e| e.0 == place).unwrap().1 = value.1;
}

/// A NEF file; big-endian, with a maker's note of its own byte order and white balance.
pub fn nef(scene: &Rgb, notes: &Notes) -> Vec<u8> {
    let (width, height, sites) = NIKON.sites(scene);
    let pixels: Vec<u8> =
        sites.chunks(2).flat_map(|p| [(p[0] >> 4) as u8, ((p[0] & 15) << 4 | p[1] >> 8) as u8, (p[1] & 255) as u8]).collect();
    let t = Tiff { big: true };
    let gains = [0, 2, 1, 1].map(|c| ((1000.0 / NEUTRAL[c]).round() as i64, 1000));
    let own = [(0x0001, (7, 4, b"0211".to_vec())), (0x000c, t.ratios(5, &gains))];
    let note = [b"Nikon\0\x02\x11\0\0MM\0*\0\0\0\x08".to_vec(), t.directory(&own, 8)].concat();
    let mut main = vec![
        (254u16, t.long(1)),
        (271, t.text("NIKON CORPORATION")),
        (272, t.text(NIKON.model)),
        (274, t.short(&[notes.orientation])),
        (330, t.long(0)),
        (34665, t.long(0)),
    ];
    main.splice(4..4, notes.artist.map(|a| (315, t.text(a))));
    let mut exif = notes.exposure(&t);
    exif.push((37500, (7, note.len() as u32, note)));
    let mut raw = vec![
        (254u16, t.long(0)),
        (256, t.long(width as u32)),
        (257, t.long(height as u32)),
        (258, t.short(&[12])),
        (259, t.short(&[1])),
        (262, t.short(&[32803])),
        (273, t.long(0)),
        (277, t.short(&[1])),
        (278, t.long(height as u32)),
        (279, t.long(pixels.len() as u32)),
        (284, t.short(&[1])),
        (33421, t.short(&[2, 2])),
        (33422, t.bytes(&[0, 1, 1, 2])),
    ];
    let exif_at = 8 + t.directory(&main, 8).len() as u32;
    let raw_at = exif_at + t.directory(&exif, exif_at).len() as u32;
    let pixels_at = raw_at + t.directory(&raw, raw_at).len() as u32;
    point(&mut main, 34665, (0, t.long(exif_at)));
    point(&mut main, 330, (0, t.long(raw_at)));
    point(&mut raw, 273, (0, t.long(pixels_at)));
    let directories = [t.directory(&main, 8), t.directory(&exif, exif_at), t.directory(&raw, raw_at)].concat();
    [b"MM\0*\0\0\0\x08".to_vec(), directories, pixels].concat()
}

/// [`raf_of`] a camera with an X-Trans sensor.
pub fn raf(scene: &Rgb, notes: &Notes) -> Vec<u8> {
    raf_of(FUJI.model, scene, notes)
}

/// A RAF file of a camera: a JPEG without picture that holds the notes, Fujifilm's own table, and the sites in a TIFF of their own.
pub fn raf_of(model: &str, scene: &Rgb, notes: &Notes) -> Vec<u8> {
    let (width, height, sites) = FUJI.sites(scene);
    let t = Tiff { big: false };
    let mut main = vec![(271u16, t.text("FUJIFILM")), (272, t.text(model)), (274, t.short(&[notes.orientation])), (34665, t.long(0))];
    main.splice(3..3, notes.artist.map(|a| (315, t.text(a))));
    let mut exif = notes.exposure(&t);
    exif.push((37500, (7, 18, b"FUJIFILM\x0c\0\0\0\0\0\0\0\0\0".to_vec())));
    let exif_at = 8 + t.directory(&main, 8).len() as u32;
    point(&mut main, 34665, (0, t.long(exif_at)));
    let block = [b"Exif\0\0II*\0\x08\0\0\0".to_vec(), t.directory(&main, 8), t.directory(&exif, exif_at)].concat();
    let mut jpeg = b"\xff\xd8\xff\xe1".to_vec();
    jpeg.extend((block.len() as u16 + 2).to_be_bytes());
    jpeg.extend(block);
    jpeg.extend(b"\xff\xd9");
    jpeg.resize(jpeg.len().next_multiple_of(4), 0);

    let (w, h) = scene.size();
    let short = |v: &[usize]| v.iter().flat_map(|v| (*v as u16).to_be_bytes()).collect::<Vec<u8>>();
    let layout: Vec<u8> = XTRANS.iter().rev().map(|c| b"RGB".iter().position(|d| d == c).unwrap() as u8).collect();
    let table: [(u16, Vec<u8>); 5] = [
        (0x0100, short(&[height, width])),
        (0x0110, short(&[FUJI.margins[2], FUJI.margins[0]])),
        (0x0111, short(&[h, w])),
        (0x0121, short(&[height, width])),
        (0x0131, layout),
    ];
    let mut own = (table.len() as u32).to_be_bytes().to_vec();
    for (tag, value) in table {
        own.extend(tag.to_be_bytes());
        own.extend((value.len() as u16).to_be_bytes());
        own.extend(value);
    }

    let pixels: Vec<u8> = sites.iter().flat_map(|v| v.to_le_bytes()).collect();
    let longs = |v: &[u32]| (4u16, v.len() as u32, v.iter().flat_map(|v| v.to_le_bytes()).collect::<Vec<u8>>());
    let gains = [1, 0, 2].map(|c: usize| (302.0 / NEUTRAL[c]).round() as u32);
    let mut raw = vec![
        (0xf001u16, longs(&[width as u32])),
        (0xf002, longs(&[height as u32])),
        (0xf003, longs(&[14])),
        (0xf007, longs(&[0])),
        (0xf008, longs(&[pixels.len() as u32])),
        (0xf00a, longs(&[FUJI.black as u32; 36])),
        (0xf00e, longs(&gains)),
    ];
    let place = [(0xf000u16, (13u16, 1u32, 26u32.to_le_bytes().to_vec()))];
    let behind = 26 + t.directory(&raw, 26).len() as u32;
    point(&mut raw, 0xf007, (0, longs(&[behind])));
    let cfa = [b"II*\0\x08\0\0\0".to_vec(), t.directory(&place, 8), t.directory(&raw, 26), pixels].concat();

    let mut file = b"FUJIFILMCCD-RAW 0201FF383501".to_vec();
    file.extend(model.as_bytes());
    file.resize(84, 0);
    let mut at = 160u32;
    for part in [&jpeg, &own, &cfa] {
        file.extend(at.to_be_bytes());
        file.extend((part.len() as u32).to_be_bytes());
        at += part.len() as u32;
    }
    file.resize(160, 0);
    [file, jpeg, own, cfa].concat()
}
