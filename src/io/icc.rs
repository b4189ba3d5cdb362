//! ICC profiles of frames: the curve and the primaries of matrix profiles, which all cameras and nearly all editors embed.

use crate::colour::Matrix;
use crate::response::Response;
use moxcms::{ColorProfile, DataColorSpace, ProfileText, ToneReprCurve};

/// What a profile says of a frame's pixels.
#[derive(Clone, Debug, PartialEq)]
pub struct Profile {
    /// The profile's own description.
    pub name: String,
    /// Its curve, code to light, as a response. [`Response::Srgb`] where it is that curve.
    pub response: Response,
    /// Linear RGB to XYZ relative to D50.
    pub to_xyz: Matrix,
}

/// Samples of a curve. At 4096 steps linear interpolation of a power of 2.4 is off by less than 10⁻⁷.
const STEPS: usize = 4096;
/// Largest difference of linear light by which a curve still counts as sRGB's: tables of 16-bit numbers, and rounded parameters.
const SAME: f64 = 1e-3;

/// Reads a profile.
///
/// # Errors
/// Why it cannot be used, in words that follow the file's name.
pub fn parse(bytes: &[u8]) -> Result<Profile, String> {
    const REMEDY: &str = "convert the frame to sRGB";
    let profile =
        ColorProfile::new_from_slice(bytes).map_err(|_| format!("holds a damaged ICC profile; {REMEDY}, or remove the profile"))?;
    let name = match profile.description.as_ref() {
        Some(ProfileText::PlainString(s)) => s.clone(),
        Some(ProfileText::Localizable(l)) => l.first().map(|s| s.value.clone()).unwrap_or_default(),
        Some(ProfileText::Description(d)) => d.ascii_string.clone(),
        None => String::new(),
    };
    let name = name.trim_matches(|c: char| c == '\0' || c.is_whitespace()).to_string();
    let name = if name.is_empty() { "unnamed".to_string() } else { name };
    let refuse = |why: &str| format!("holds the ICC profile \"{name}\", {why}; {REMEDY}");
    let (curves, to_xyz) = match profile.color_space {
        DataColorSpace::Rgb => {
            let (Some(r), Some(g), Some(b)) = (&profile.red_trc, &profile.green_trc, &profile.blue_trc) else {
                return Err(refuse("which is a table of colours and not three primaries with a curve"));
            };
            let m = profile.colorant_matrix().v;
            ([r, g, b].map(table), m)
        }
        DataColorSpace::Gray => {
            let Some(grey) = &profile.gray_trc else { return Err(refuse("which has no curve")) };
            (std::array::from_fn(|_| table(grey)), crate::colour::Primaries::Rec709.to_xyz())
        }
        _ => return Err(refuse("which is neither RGB nor grey")),
    };
    let [Some(r), Some(g), Some(b)] = curves else { return Err(refuse("whose curve does not rise from black to white")) };
    if crate::colour::inverse(&to_xyz).is_none() {
        return Err(refuse("whose primaries span no colours"));
    }
    let srgb = |t: &Vec<f64>| t.iter().enumerate().all(|(i, v)| (v - Response::Srgb.inverse(0, i as f64 / STEPS as f64)).abs() < SAME);
    let response = if [&r, &g, &b].into_iter().all(srgb) { Response::Srgb } else { Response::Table([r, g, b]) };
    Ok(Profile { name, response, to_xyz })
}

/// Code to light at equal steps, from 0 to 1; `None` for what is no rising curve.
fn table(curve: &ToneReprCurve) -> Option<Vec<f64>> {
    let at: Box<dyn Fn(f64) -> f64> = match curve {
        ToneReprCurve::Lut(t) => match t.as_slice() {
            [] => Box::new(|x| x),
            [gamma] => {
                let gamma = f64::from(*gamma) / 256.0;
                Box::new(move |x| x.powf(gamma))
            }
            t => Box::new(move |x| {
                let s = x * (t.len() - 1) as f64;
                let i = (s as usize).min(t.len() - 2);
                let (a, b) = (f64::from(t[i]), f64::from(t[i + 1]));
                (a + (b - a) * (s - i as f64)) / 65535.0
            }),
        },
        // ICC.1:2010, table 65.
        ToneReprCurve::Parametric(p) => {
            let p: Vec<f64> = p.iter().map(|v| f64::from(*v)).collect();
            let at = |i: usize| p.get(i).copied().unwrap_or(0.0);
            let (g, a, b, c, d) = (at(0), at(1), at(2), at(3), at(4));
            match p.len() {
                1 => Box::new(move |x| x.powf(g)),
                3 => Box::new(move |x| if x >= -b / a { (a * x + b).powf(g) } else { 0.0 }),
                4 => Box::new(move |x| if x >= -b / a { (a * x + b).powf(g) + c } else { c }),
                5 => Box::new(move |x| if x >= d { (a * x + b).powf(g) } else { c * x }),
                7 => {
                    let (e, f) = (at(5), at(6));
                    Box::new(move |x| if x >= d { (a * x + b).powf(g) + e } else { c * x + f })
                }
                _ => return None,
            }
        }
    };
    let mut values: Vec<f64> = (0..=STEPS).map(|i| at(i as f64 / STEPS as f64)).collect();
    let (first, last) = (values[0], values[STEPS]);
    if !values.iter().all(|v| v.is_finite()) || last - first < 0.1 || values.windows(2).any(|w| w[1] < w[0] - 1e-6) {
        return None;
    }
    let mut low = 0.0f64;
    for v in &mut values {
        // Black is 0 and white is 1, and rounding may not make it fall.
        low = low.max((*v - first) / (last - first));
        *v = low;
    }
    Some(values)
}
