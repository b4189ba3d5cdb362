//! JPEG files with a gain map (ISO 21496-1, "Ultra HDR"): a picture that any program shows, and beside it a small map by which a screen that
//! can show more makes its highlights brighter.
//!
//! The file is two JPEG files in one: the picture, then the map. A Multi-Picture directory (CIPA DC-007) and an XMP packet (Adobe's `hdrgm`
//! and the container directory that Android reads) in the first tell where the second is; XMP and the binary block of ISO 21496-1 in
//! the second tell what its codes mean.

use super::metadata::Metadata;
use super::picture;
use crate::image::Rgb;
use ::image::codecs::jpeg::JpegEncoder;
use ::image::{ExtendedColorType, RgbImage};
use rayon::prelude::*;
use std::fmt::Write as _;
use std::io::Write;

/// Added to both luminances before their ratio is taken, so that black has one.
const OFFSET: f64 = 1.0 / 64.0;
/// Most stops by which the map brightens: more than any screen shows.
const MOST_STOPS: f64 = 6.0;
/// Most stops by which it darkens.
const LEAST_STOPS: f64 = -4.0;
/// Pixels of the picture, each way, to one of the map.
const SHRINK: usize = 2;
/// Quality of the map as JPEG: its errors are multiplied by the whole range of gains.
const MAP_QUALITY: u8 = 95;
/// Luminances of the picture between which it shall be as bright with the map as without: neither its shadows nor its highlights.
const MIDDLE: (f64, f64) = (0.02, 0.4);

/// Luminance gains of a picture, one for each square of 2 x 2 pixels.
#[derive(Clone, Debug, PartialEq)]
pub struct GainMap {
    /// Pixels of the map, each way.
    pub size: (usize, usize),
    /// Codes 0..=255, rows first: from [`Self::range`]'s first to its second number in equal steps.
    pub codes: Vec<u8>,
    /// Gains in stops of the codes 0 and 255; the second is at least 0.1 above the first.
    pub range: (f64, f64),
}

impl GainMap {
    /// The map that makes `picture` (8-bit sRGB) look like `linear` (linear Rec. 709, any unit): log2 of the ratio of their luminances, each
    /// increased by 1/64. The unit is such that the picture's middle tones keep their brightness.
    pub fn between(picture: &RgbImage, linear: &Rgb) -> Self {
        let (w, h) = linear.size();
        let curve: Vec<f64> = (0..256).map(|i| crate::response::Response::Srgb.inverse(0, f64::from(i) / 255.0)).collect();
        let shown = |x: usize, y: usize| luminance(picture.get_pixel(x as u32, y as u32).0.map(|c| curve[usize::from(c)]));
        let meant =
            |x: usize, y: usize| luminance(linear.pixel(y * w + x).map(|v| if v.is_finite() { f64::from(v.max(0.0)) } else { 0.0 }));
        let (mut sum, mut count) = (0.0, 0.0);
        for y in (0..h).step_by(SHRINK) {
            for x in (0..w).step_by(SHRINK) {
                let (a, b) = (shown(x, y), meant(x, y));
                if (MIDDLE.0..MIDDLE.1).contains(&a) && b > 0.0 {
                    sum += (a / b).ln();
                    count += 1.0;
                }
            }
        }
        let unit = if count > 0.0 { (sum / count).exp() } else { 1.0 };
        let (nw, nh) = (w.div_ceil(SHRINK), h.div_ceil(SHRINK));
        let gain = |i: usize| {
            let (x0, y0) = (i % nw * SHRINK, i / nw * SHRINK);
            let square = (y0..(y0 + SHRINK).min(h)).flat_map(|y| (x0..(x0 + SHRINK).min(w)).map(move |x| (x, y)));
            let (sum, n) = square
                .fold((0.0, 0.0), |(sum, n), (x, y)| (sum + ((meant(x, y) * unit + OFFSET) / (shown(x, y) + OFFSET)).log2(), n + 1.0));
            (sum / n).clamp(LEAST_STOPS, MOST_STOPS) as f32
        };
        let gains: Vec<f32> = (0..nw * nh).into_par_iter().map(gain).collect();
        let (low, high) = gains.iter().fold((0f32, 0f32), |(a, b), g| (a.min(*g), b.max(*g)));
        let range = (f64::from(low), f64::from(high).max(f64::from(low) + 0.1));
        let code = |g: &f32| ((f64::from(*g) - range.0) / (range.1 - range.0) * 255.0).round() as u8;
        Self { size: (nw, nh), codes: gains.iter().map(code).collect(), range }
    }

    /// Stops above its white that a screen must show for the whole gain.
    pub fn headroom(&self) -> f64 {
        self.range.1.max(0.1)
    }

    /// The map as a JPEG file with its meaning.
    fn jpeg(&self) -> Result<Vec<u8>, String> {
        let mut bytes = Vec::new();
        let encoder = &mut JpegEncoder::new_with_quality(&mut bytes, MAP_QUALITY);
        encoder.encode(&self.codes, self.size.0 as u32, self.size.1 as u32, ExtendedColorType::L8).map_err(|e| e.to_string())?;
        let (low, high) = self.range;
        let xmp = xmp(&format!(
            "hdrgm:GainMapMin=\"{low:.6}\" hdrgm:GainMapMax=\"{high:.6}\" hdrgm:Gamma=\"1\" hdrgm:OffsetSDR=\"{OFFSET}\" \
             hdrgm:OffsetHDR=\"{OFFSET}\" hdrgm:HDRCapacityMin=\"0\" hdrgm:HDRCapacityMax=\"{:.6}\" hdrgm:BaseRenditionIsHDR=\"False\"/>",
            self.headroom()
        ));
        let segments = [segment(0xE1, &xmp)?, segment(0xE2, &self.iso())?].concat();
        Ok(inserted(&bytes, &segments))
    }

    /// ISO 21496-1, annex C: versions, flags (one channel, the picture's own primaries), headrooms and the numbers of the map as fractions.
    fn iso(&self) -> Vec<u8> {
        const DENOMINATOR: u32 = 1_000_000;
        let mut block = [ISO_NAME, &[0, 0, 0, 0, 0x40]].concat();
        let mut fraction = |v: f64| {
            block.extend(((v * f64::from(DENOMINATOR)).round() as i32).to_be_bytes());
            block.extend(DENOMINATOR.to_be_bytes());
        };
        [0.0, self.headroom(), self.range.0, self.range.1, 1.0, OFFSET, OFFSET].into_iter().for_each(&mut fraction);
        block
    }
}

const ISO_NAME: &[u8] = b"urn:iso:std:iso:ts:21496:-1\0";

/// Rec. 709.
fn luminance([r, g, b]: [f64; 3]) -> f64 {
    0.2126 * r + 0.7152 * g + 0.0722 * b
}

/// Writes `picture` as a JPEG of `quality` 1..=100 with the gain map that makes it look like `linear`; see [`GainMap::between`].
///
/// # Errors
/// What `to` refuses, and pictures of more than 65535 pixels a side.
pub fn write(mut to: impl Write, picture: &RgbImage, linear: &Rgb, quality: u8, noted: Option<&Metadata>) -> Result<(), String> {
    let map = GainMap::between(picture, linear).jpeg()?;
    let mut base = Vec::new();
    picture::write_jpeg(&mut base, picture, quality, noted)?;
    let container = "xmlns:Container=\"http://ns.google.com/photos/1.0/container/\" xmlns:Item=\"http://ns.google.com/photos/1.0/container/item/\">\
         <Container:Directory><rdf:Seq>\
         <rdf:li rdf:parseType=\"Resource\"><Container:Item Item:Semantic=\"Primary\" Item:Mime=\"image/jpeg\"/></rdf:li>";
    let mut rest = String::from(container);
    let _ = write!(
        rest,
        "<rdf:li rdf:parseType=\"Resource\"><Container:Item Item:Semantic=\"GainMap\" Item:Mime=\"image/jpeg\" Item:Length=\"{}\"/></rdf:li>\
         </rdf:Seq></Container:Directory></rdf:Description>",
        map.len()
    );
    let before = [segment(0xE1, &xmp(&rest))?, segment(0xE2, &[ISO_NAME, &[0; 4]].concat())?].concat();
    // The directory counts from its own byte-order mark, eight bytes behind the segment's marker; its own size does not depend on them.
    let directory_size = 4 + directory(0, 0, 0).len();
    let place = first_of_picture(&base);
    let total = base.len() + before.len() + directory_size;
    let mark = place + before.len() + 8;
    let directory = segment(0xE2, &directory(total, total - mark, map.len()))?;
    let whole = [inserted(&base, &[before, directory].concat()), map].concat();
    to.write_all(&whole).map_err(|e| super::plain(&e))
}

/// An XMP packet; `rest` ends the description that holds the gain map's version.
fn xmp(rest: &str) -> Vec<u8> {
    let end = if rest.ends_with("/>") { "" } else { "\n" };
    let text = format!(
        "http://ns.adobe.com/xap/1.0/\0<x:xmpmeta xmlns:x=\"adobe:ns:meta/\" x:xmptk=\"unshaken\">\
         <rdf:RDF xmlns:rdf=\"http://www.w3.org/1999/02/22-rdf-syntax-ns#\"><rdf:Description rdf:about=\"\" \
         xmlns:hdrgm=\"http://ns.adobe.com/hdr-gain-map/1.0/\" hdrgm:Version=\"1.0\" {rest}{end}</rdf:RDF></x:xmpmeta>"
    );
    text.into_bytes()
}

/// A Multi-Picture directory of two pictures: the first of `first` bytes, the second of `second` bytes `offset` bytes behind the directory's
/// byte-order mark.
fn directory(first: usize, offset: usize, second: usize) -> Vec<u8> {
    let mut d = b"MPF\0MM\0*\0\0\0\x08\0\x03".to_vec();
    let mut entry = |tag: u16, kind: u16, count: u32, value: [u8; 4]| {
        d.extend([&tag.to_be_bytes()[..], &kind.to_be_bytes(), &count.to_be_bytes(), &value].concat());
    };
    entry(0xB000, 7, 4, *b"0100");
    entry(0xB001, 4, 1, 2u32.to_be_bytes());
    // Behind the mark: 8 bytes, the number of entries, three entries, no next directory.
    entry(0xB002, 7, 32, 50u32.to_be_bytes());
    d.extend([0; 4]);
    for (attribute, size, at) in [(0x0003_0000u32, first, 0), (0, second, offset)] {
        d.extend(attribute.to_be_bytes());
        d.extend((size as u32).to_be_bytes());
        d.extend((at as u32).to_be_bytes());
        d.extend([0; 4]);
    }
    d
}

/// A segment with its marker and length.
fn segment(marker: u8, content: &[u8]) -> Result<Vec<u8>, String> {
    let length = u16::try_from(content.len() + 2).map_err(|_| "a segment of the gain map is too long".to_string())?;
    Ok([&[0xFF, marker][..], &length.to_be_bytes(), content].concat())
}

/// Where the application segments of a JPEG file end.
fn first_of_picture(jpeg: &[u8]) -> usize {
    let mut at = 2;
    while at + 4 <= jpeg.len() && jpeg[at] == 0xFF && (0xE0..=0xEF).contains(&jpeg[at + 1]) {
        at += 2 + usize::from(u16::from_be_bytes([jpeg[at + 2], jpeg[at + 3]]));
    }
    at
}

/// The JPEG file with `segments` behind its application segments.
fn inserted(jpeg: &[u8], segments: &[u8]) -> Vec<u8> {
    let (head, tail) = jpeg.split_at(first_of_picture(jpeg));
    [head, segments, tail].concat()
}
