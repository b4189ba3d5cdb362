//! Linear RGB of one kind to another: primaries, white points, 3 x 3 matrices. No files, no pixels but those it is given.
//!
//! Everything meets in CIE XYZ relative to D50, as in ICC profiles; white points are adapted by the linear Bradford transform.

use crate::image::Rgb;
use rayon::prelude::*;

/// A 3 x 3 matrix, row by row.
pub type Matrix = [[f64; 3]; 3];

/// Chromaticity (x, y) of a light.
pub type Chromaticity = [f64; 2];

/// The white of XYZ as ICC profiles count it.
pub const D50: Chromaticity = [0.3457, 0.3585];
/// The white of Rec. 709, Rec. 2020 and Display P3.
pub const D65: Chromaticity = [0.3127, 0.3290];

/// RGB primaries and white point that a result can have.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Default, serde::Serialize)]
#[serde(rename_all = "kebab-case")]
pub enum Primaries {
    /// Rec. 709, those of sRGB; white D65.
    #[default]
    Rec709,
    /// Rec. 2020; white D65.
    Rec2020,
    /// Display P3; white D65.
    DisplayP3,
    /// ACEScg (AP1); white near D60.
    AcesCg,
}

impl Primaries {
    /// All of them.
    pub const ALL: [Self; 4] = [Self::Rec709, Self::Rec2020, Self::DisplayP3, Self::AcesCg];

    /// The word that names it on the command line.
    pub fn name(self) -> &'static str {
        match self {
            Self::Rec709 => "rec709",
            Self::Rec2020 => "rec2020",
            Self::DisplayP3 => "p3",
            Self::AcesCg => "acescg",
        }
    }

    /// The name of the Color Interop Forum for linear, scene-referred pixels of these primaries.
    pub fn interop_id(self) -> &'static str {
        match self {
            Self::Rec709 => "lin_rec709_scene",
            Self::Rec2020 => "lin_rec2020_scene",
            Self::DisplayP3 => "lin_p3d65_scene",
            Self::AcesCg => "lin_ap1_scene",
        }
    }

    /// The primaries that `word` names.
    pub fn named(word: &str) -> Option<Self> {
        Self::ALL.into_iter().find(|p| p.name() == word)
    }

    /// Chromaticities of red, green, blue and white.
    pub fn chromaticities(self) -> [Chromaticity; 4] {
        match self {
            Self::Rec709 => [[0.64, 0.33], [0.30, 0.60], [0.15, 0.06], D65],
            Self::Rec2020 => [[0.708, 0.292], [0.170, 0.797], [0.131, 0.046], D65],
            Self::DisplayP3 => [[0.680, 0.320], [0.265, 0.690], [0.150, 0.060], D65],
            Self::AcesCg => [[0.713, 0.293], [0.165, 0.830], [0.128, 0.044], [0.32168, 0.33767]],
        }
    }

    /// Linear RGB to XYZ relative to D50.
    pub fn to_xyz(self) -> Matrix {
        from_chromaticities(self.chromaticities()).expect("none of the standard primaries are on one line")
    }
}

/// Linear RGB with these chromaticities of red, green, blue and white to XYZ relative to D50. `None` where they span no triangle.
pub fn from_chromaticities([r, g, b, w]: [Chromaticity; 4]) -> Option<Matrix> {
    if [r, g, b, w].iter().any(|c| !(c[0].is_finite() && c[1].is_finite() && c[1].abs() > 1e-6)) {
        return None;
    }
    let columns = [xyz(r), xyz(g), xyz(b)];
    let primaries: Matrix = std::array::from_fn(|i| std::array::from_fn(|j| columns[j][i]));
    // Amounts of the three that make white.
    let amounts = apply(&inverse(&primaries)?, xyz(w));
    let native: Matrix = std::array::from_fn(|i| std::array::from_fn(|j| primaries[i][j] * amounts[j]));
    Some(product(&adaptation(w, D50)?, &native))
}

/// XYZ of a chromaticity at Y = 1.
pub fn xyz([x, y]: Chromaticity) -> [f64; 3] {
    [x / y, 1.0, (1.0 - x - y) / y]
}

/// The linear Bradford transform of XYZ from one white to another (K. M. Lam 1985, as in ICC.1:2010, annex E).
pub fn adaptation(from: Chromaticity, to: Chromaticity) -> Option<Matrix> {
    const CONES: Matrix = [[0.8951, 0.2664, -0.1614], [-0.7502, 1.7135, 0.0367], [0.0389, -0.0685, 1.0296]];
    let (a, b) = (apply(&CONES, xyz(from)), apply(&CONES, xyz(to)));
    let gain = diagonal(std::array::from_fn(|i| b[i] / a[i]));
    Some(product(&inverse(&CONES)?, &product(&gain, &CONES)))
}

/// The matrix with `d` on its diagonal.
pub fn diagonal(d: [f64; 3]) -> Matrix {
    std::array::from_fn(|i| std::array::from_fn(|j| if i == j { d[i] } else { 0.0 }))
}

/// a b.
pub fn product(a: &Matrix, b: &Matrix) -> Matrix {
    std::array::from_fn(|i| std::array::from_fn(|j| (0..3).map(|k| a[i][k] * b[k][j]).sum()))
}

/// m v.
pub fn apply(m: &Matrix, v: [f64; 3]) -> [f64; 3] {
    std::array::from_fn(|i| (0..3).map(|k| m[i][k] * v[k]).sum())
}

/// m⁻¹; `None` for a singular matrix.
pub fn inverse(m: &Matrix) -> Option<Matrix> {
    let minor = |r: usize, c: usize| {
        let (a, b, d, e) = ((r + 1) % 3, (r + 2) % 3, (c + 1) % 3, (c + 2) % 3);
        m[a][d] * m[b][e] - m[a][e] * m[b][d]
    };
    let determinant: f64 = (0..3).map(|c| m[0][c] * minor(0, c)).sum();
    let scale = m.iter().flatten().fold(0.0f64, |a, v| a.max(v.abs()));
    // NaN is refused with the rest.
    let regular = determinant.abs() > 1e-12 * scale.powi(3);
    regular.then(|| std::array::from_fn(|i| std::array::from_fn(|j| minor(j, i) / determinant)))
}

/// Whether `m` leaves every colour as it is, to one part in 10⁴.
pub fn is_identity(m: &Matrix) -> bool {
    (0..3).all(|i| (0..3).all(|j| (m[i][j] - f64::from(u8::from(i == j))).abs() < 1e-4))
}

/// Applies `m` to every pixel. Colours that the target cannot hold would be negative: they become 0, and the share of the pixels to
/// which that happened by more than a thousandth of their largest channel comes back.
pub fn convert(image: &mut Rgb, m: &Matrix) -> f64 {
    if is_identity(m) {
        return 0.0;
    }
    let m: [[f32; 3]; 3] = m.map(|row| row.map(|v| v as f32));
    let [r, g, b] = &mut image.0;
    let outside: usize = (&mut r.data, &mut g.data, &mut b.data)
        .into_par_iter()
        .map(|(r, g, b)| {
            let v = [*r, *g, *b];
            let w: [f32; 3] = std::array::from_fn(|i| m[i][0] * v[0] + m[i][1] * v[1] + m[i][2] * v[2]);
            [*r, *g, *b] = w.map(|x| x.max(0.0));
            let (low, high) = w.into_iter().fold((f32::MAX, f32::MIN), |(a, b), x| (a.min(x), b.max(x)));
            usize::from(low < -1e-3 * high.max(0.0))
        })
        .sum();
    outside as f64 / image.0[0].data.len().max(1) as f64
}
