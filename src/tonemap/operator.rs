//! The operators that a user can name, and their parameters.

use super::{fattal, filter, luminance, srgb_code};
use crate::image::{Plane, Rgb};
use rayon::prelude::*;

/// A tone-mapping operator with its parameters; `filmic`, as [`Default`], unless said.
#[derive(Clone, Debug, PartialEq)]
pub struct Operator {
    kind: Kind,
    /// Values of the kind's parameters, in their order.
    values: Vec<f32>,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Kind {
    Filmic,
    Reinhard,
    ReinhardLocal,
    Durand,
    Fattal,
}

/// What automatic exposure looks at in an image, in its unit.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Light {
    /// Logarithmic mean of the luminance.
    pub middle: f32,
    /// 99.9th percentile of the luminance.
    pub high: f32,
}

impl Light {
    /// The light of `image` (linear Rec. 709).
    pub fn of(image: &Rgb) -> Self {
        let s = Statistics::of(&luminance(image));
        Self { middle: s.middle, high: s.high }
    }
}

/// An operator that treats every pixel alike, as numbers for whoever draws by itself: a luminance Y of the image shows as
/// c(gain · Y), with colours as [`Operator::apply`] keeps them.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Curve {
    /// Whether c is the filmic curve; otherwise Reinhard's.
    pub filmic: bool,
    /// Luminance to exposed luminance.
    pub gain: f32,
    /// Exposed luminance that becomes white.
    pub white: f32,
    /// 1 keeps the colours, 0 is grey.
    pub saturation: f32,
}

/// Name, default, smallest and largest value, meaning.
type Parameter = (&'static str, f32, f32, f32, &'static str);

const EXPOSURE: Parameter = ("exposure", 0.0, -20.0, 20.0, "EV added to the automatic exposure");
const SATURATION: Parameter = ("saturation", 1.0, 0.0, 2.0, "1 keeps the colours, 0 is grey");
/// Of operators that compress large areas: at full saturation the shadows that they lift glow.
const SOFTER: Parameter = ("saturation", 0.75, 0.0, 2.0, "1 keeps the colours, 0 is grey");
const KEY: Parameter = ("key", 0.18, 0.01, 1.0, "luminance of the middle of the picture");

impl Kind {
    const ALL: [Self; 5] = [Self::Filmic, Self::Reinhard, Self::ReinhardLocal, Self::Durand, Self::Fattal];

    fn name(self) -> &'static str {
        match self {
            Self::Filmic => "filmic",
            Self::Reinhard => "reinhard",
            Self::ReinhardLocal => "reinhard-local",
            Self::Durand => "durand",
            Self::Fattal => "fattal",
        }
    }

    fn parameters(self) -> &'static [Parameter] {
        const WHITE: Parameter = ("white", 0.0, 0.0, 1e6, "exposed luminance that becomes white; 0: the 99.9th percentile");
        match self {
            Self::Filmic => &[EXPOSURE, SATURATION, KEY, WHITE],
            Self::Reinhard => &[EXPOSURE, SATURATION, KEY, WHITE],
            Self::ReinhardLocal => &[
                EXPOSURE,
                SATURATION,
                KEY,
                ("phi", 8.0, 1.0, 50.0, "sharpening"),
                ("threshold", 0.05, 1e-3, 1.0, "contrast that ends an area"),
            ],
            Self::Durand => &[
                EXPOSURE,
                SOFTER,
                ("contrast", 1.8, 0.3, 6.0, "decades that large areas may span"),
                ("range", 0.4, 0.05, 4.0, "decades by which another area begins"),
                ("size", 0.02, 0.001, 0.5, "width of the filter, as a part of the picture's longer side"),
            ],
            Self::Fattal => &[
                EXPOSURE,
                SOFTER,
                ("alpha", 0.1, 0.01, 1.0, "gradient that is kept, over the mean one"),
                ("beta", 0.87, 0.5, 1.0, "power by which larger gradients are attenuated; 1: none"),
            ],
        }
    }
}

impl Default for Operator {
    fn default() -> Self {
        Self::of(Kind::Filmic)
    }
}

impl std::fmt::Display for Operator {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str(self.kind.name())?;
        for (i, (p, v)) in self.kind.parameters().iter().zip(&self.values).enumerate() {
            write!(f, "{}{}={v}", if i == 0 { ':' } else { ',' }, p.0)?;
        }
        Ok(())
    }
}

impl Operator {
    fn of(kind: Kind) -> Self {
        Self { kind, values: kind.parameters().iter().map(|p| p.1).collect() }
    }

    /// The names of all operators.
    pub fn names() -> Vec<&'static str> {
        Kind::ALL.into_iter().map(Kind::name).collect()
    }

    /// The operator that `words` name, such as `reinhard` or `reinhard:key=0.3,white=4`.
    ///
    /// # Errors
    /// What is wrong and what would be right, in words.
    pub fn parse(words: &str) -> Result<Self, String> {
        let (name, rest) = words.split_once(':').unwrap_or((words, ""));
        let Some(kind) = Kind::ALL.into_iter().find(|k| k.name() == name) else {
            return Err(format!("{name:?} is no operator; name one of {}", Self::names().join(", ")));
        };
        let mut operator = Self::of(kind);
        for word in rest.split(',').filter(|w| !w.is_empty()) {
            let (key, value) = word.split_once('=').ok_or_else(|| format!("{word:?} is not of the form name=value"))?;
            let Some(i) = kind.parameters().iter().position(|p| p.0 == key) else {
                let known = kind.parameters().iter().map(|p| format!("{} ({})", p.0, p.4)).collect::<Vec<_>>();
                return Err(format!("{name} has no parameter {key:?}; it has {}", known.join("; ")));
            };
            let (_, _, low, high, _) = kind.parameters()[i];
            operator.values[i] = value
                .parse()
                .ok()
                .filter(|v| (low..=high).contains(v))
                .ok_or_else(|| format!("{key}={value} of {name} is not a number from {low} to {high}"))?;
        }
        Ok(operator)
    }

    /// The operator's name, without its parameters.
    pub fn name(&self) -> &'static str {
        self.kind.name()
    }

    /// The value of a parameter; `None` where the operator has none of that name.
    pub fn parameter(&self, name: &str) -> Option<f32> {
        self.kind.parameters().iter().position(|p| p.0 == name).map(|i| self.values[i])
    }

    fn value(&self, name: &str) -> f32 {
        self.parameter(name).expect("a parameter of this operator")
    }

    /// Picture of `image` (linear Rec. 709, any unit); values that are not finite or are negative show as black. The exposure is automatic:
    /// the unit does not matter.
    pub fn apply(&self, image: &Rgb) -> image::RgbImage {
        let lum = luminance(image);
        let shown = match self.kind {
            Kind::Filmic => self.filmic(&lum),
            Kind::Reinhard => self.reinhard(&lum),
            Kind::ReinhardLocal => self.reinhard_local(&lum),
            Kind::Durand => self.durand(&lum),
            Kind::Fattal => self.fattal(&lum),
        };
        colour(image, &lum, &shown, self.value("saturation"))
    }

    /// The operator's curve under this light; `None` where a pixel's surroundings matter.
    pub fn curve(&self, light: &Light) -> Option<Curve> {
        if !matches!(self.kind, Kind::Filmic | Kind::Reinhard) {
            return None;
        }
        let gain = self.value("key") / light.middle * self.value("exposure").exp2();
        let statistics = Statistics { low: 0.0, middle: light.middle, high: light.high, gain };
        Some(Curve { filmic: self.kind == Kind::Filmic, gain, white: self.white(&statistics), saturation: self.value("saturation") })
    }

    /// Luminance over that which becomes the key, exposure included.
    fn exposed(&self, lum: &Plane) -> (Plane, Statistics) {
        let statistics = Statistics::of(lum);
        let gain = self.value("key") / statistics.middle * self.value("exposure").exp2();
        (lum.map(|v| (v * gain).min(1e12)), Statistics { gain, ..statistics })
    }

    fn white(&self, statistics: &Statistics) -> f32 {
        match self.value("white") {
            w if w > 0.0 => w,
            _ => (statistics.high * statistics.gain).clamp(1.0, 1e6),
        }
    }

    /// A toe, a straight part and a long shoulder (J. Hable, "Filmic Tonemapping Operators", 2010), of luminance, so that colours keep.
    fn filmic(&self, lum: &Plane) -> Plane {
        let (exposed, statistics) = self.exposed(lum);
        let curve = |x: f32| (x * (0.22 * x + 0.03) + 0.002) / (x * (0.22 * x + 0.3) + 0.06) - 0.002 / 0.06;
        let white = self.white(&statistics);
        // The curve turns the key darker than it was: twice the light makes up for it.
        let scale = 1.0 / curve(2.0 * white);
        exposed.map(|v| curve(2.0 * v.min(white)) * scale)
    }

    /// E. Reinhard et al., "Photographic Tone Reproduction for Digital Images", 2002, eq. 4.
    fn reinhard(&self, lum: &Plane) -> Plane {
        let (exposed, statistics) = self.exposed(lum);
        let white = self.white(&statistics);
        exposed.map(|v| v * (1.0 + v / (white * white)) / (1.0 + v))
    }

    /// The same, eq. 9: each pixel's shoulder follows the largest surround without strong contrast, of eight sizes that grow by 1.6.
    fn reinhard_local(&self, lum: &Plane) -> Plane {
        let (exposed, statistics) = self.exposed(lum);
        let (key, phi, threshold) = (self.value("key"), self.value("phi"), self.value("threshold"));
        const RATIO: f32 = 1.6;
        const SCALES: i32 = 8;
        // Before blurring, or a lamp's glow would darken a whole room.
        let limit = (statistics.high * statistics.gain).max(1.0);
        let limited = exposed.map(|v| v.min(limit));
        let size = |s: i32| RATIO.powi(s);
        let mut centre = filter::gaussian(&limited, 0.35 * size(0));
        let mut adapted = centre.clone();
        let mut settled = vec![false; lum.data.len()];
        for s in 0..SCALES {
            let surround = filter::gaussian(&limited, 0.35 * size(s + 1) * RATIO);
            let bias = phi.exp2() * key / (size(s) * size(s));
            (&mut adapted.data, &mut settled, &centre.data, &surround.data).into_par_iter().for_each(|(adapted, settled, c, o)| {
                if !*settled {
                    if ((c - o) / (bias + c)).abs() > threshold {
                        *settled = true;
                    } else {
                        *adapted = *c;
                    }
                }
            });
            centre = surround;
        }
        let white = limit;
        exposed.zip(&adapted, move |v, around| v * (1.0 + v / (white * white)) / (1.0 + around))
    }

    /// F. Durand and J. Dorsey, "Fast Bilateral Filtering for the Display of High-Dynamic-Range Images", 2002: large areas lose contrast,
    /// detail does not.
    fn durand(&self, lum: &Plane) -> Plane {
        let statistics = Statistics::of(lum);
        let log = lum.map(|v| v.max(statistics.low).log10());
        let size = (self.value("size") * lum.width.max(lum.height) as f32).max(2.0);
        let base = super::bilateral(&log, size, self.value("range"));
        let (low, high) = extremes(&base.data);
        let slope = (self.value("contrast") / (high - low).max(1e-3)).min(1.0);
        let exposure = self.value("exposure") * std::f32::consts::LOG10_2;
        // The brightest area is white, as in the paper; detail reaches beyond, and is clipped.
        log.zip(&base, move |l, b| 10f32.powf(slope * (b - high) + (l - b) + exposure))
    }

    /// R. Fattal, D. Lischinski and M. Werman, "Gradient Domain High Dynamic Range Compression", 2002.
    fn fattal(&self, lum: &Plane) -> Plane {
        let statistics = Statistics::of(lum);
        let log = lum.map(|v| v.max(statistics.low).ln());
        let mut shown = fattal::compress(&log, self.value("alpha"), self.value("beta"));
        // The gradients do not know the level: half a percent of the pixels become white, half a percent black.
        let (low, high) = percentiles(&shown.data, 0.005, 0.995);
        let exposure = self.value("exposure") * std::f32::consts::LN_2;
        // What the attenuation took beyond what a screen holds, two decades, is given back.
        let (darkest, brightest) = percentiles(&log.data, 0.005, 0.995);
        let scale = (brightest - darkest).clamp(1e-3, 2.0 * std::f32::consts::LN_10) / (high - low).max(1e-3);
        shown = shown.map(move |v| ((v - high) * scale + exposure).exp());
        shown
    }
}

/// What automatic exposure looks at.
struct Statistics {
    /// Smallest luminance that counts.
    low: f32,
    /// Logarithmic mean.
    middle: f32,
    /// 99.9th percentile.
    high: f32,
    gain: f32,
}

impl Statistics {
    fn of(lum: &Plane) -> Self {
        // A million pixels tell what all do.
        let step = (lum.data.len() / 1_000_000).max(1);
        let mut sample: Vec<f32> = lum.data.iter().copied().step_by(step).collect();
        sample.sort_unstable_by(f32::total_cmp);
        let at = |q: f32| sample.get(((sample.len().max(1) - 1) as f32 * q) as usize).copied().unwrap_or(0.0);
        let top = at(1.0).max(1e-30);
        let high = at(0.999).max(1e-6 * top);
        let low = (1e-6 * high).max(1e-36);
        let lit: Vec<f64> = sample.iter().filter(|v| **v > low).map(|v| f64::from(*v).ln()).collect();
        let middle = if lit.is_empty() { high } else { (lit.iter().sum::<f64>() / lit.len() as f64).exp() as f32 };
        Self { low, middle: middle.max(1e-36), high, gain: 1.0 }
    }
}

/// The colours of `image` at the luminances `shown` (1 is white) as sRGB codes.
fn colour(image: &Rgb, lum: &Plane, shown: &Plane, saturation: f32) -> image::RgbImage {
    let (width, height) = lum.size();
    let mut codes = vec![0u8; 3 * lum.data.len()];
    codes.par_chunks_exact_mut(3).enumerate().for_each(|(i, out)| {
        let (l, s) = (lum.data[i], shown.data[i]);
        if !(l > 0.0 && s > 0.0) {
            return;
        }
        let mut rgb = image.pixel(i).map(|v| {
            let ratio = if v.is_finite() && v > 0.0 { v.min(1e30) / l } else { 0.0 };
            let ratio = if saturation == 1.0 { ratio } else { ratio.powf(saturation) };
            s.min(4.0) * ratio
        });
        // A colour that a screen cannot show so bright pales instead of changing its hue.
        let brightest = rgb.into_iter().fold(0.0, f32::max);
        if brightest > 1.0 {
            let grey = s.min(1.0);
            let keep = if brightest > grey { (1.0 - grey) / (brightest - grey) } else { 0.0 };
            rgb = rgb.map(|v| grey + (v - grey) * keep);
        }
        for (code, v) in out.iter_mut().zip(rgb) {
            *code = srgb_code(v);
        }
    });
    image::RgbImage::from_raw(width as u32, height as u32, codes).expect("three bytes per pixel")
}

fn extremes(values: &[f32]) -> (f32, f32) {
    values.iter().fold((f32::MAX, f32::MIN), |(a, b), &v| (a.min(v), b.max(v)))
}

fn percentiles(values: &[f32], low: f32, high: f32) -> (f32, f32) {
    let mut sample: Vec<f32> = values.iter().copied().step_by((values.len() / 1_000_000).max(1)).collect();
    sample.sort_unstable_by(f32::total_cmp);
    let at = |q: f32| sample.get(((sample.len().max(1) - 1) as f32 * q) as usize).copied().unwrap_or(0.0);
    (at(low), at(high))
}
