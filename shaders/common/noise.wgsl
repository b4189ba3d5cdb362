// Noise of one observation: mean and variance of an intensity that is clipped at black. No bindings, no entry points; the including
// kernel declares `params.noise`.

// Standard deviation at an exposure.
fn noise_of(exposure: f32) -> f32 {
    let s = sqrt(clamp(exposure, 0.0, 1.0)) * 255.0;
    let i = min(u32(s), 254u);
    let a = params.noise[i / 4u][i % 4u];
    let b = params.noise[(i + 1u) / 4u][(i + 1u) % 4u];
    return mix(a, b, s - f32(i));
}

// Standard normal density and distribution function (Abramowitz & Stegun 7.1.26, error below 1.5e-7).
fn normal_density(t: f32) -> f32 {
    return 0.3989423 * exp(-0.5 * t * t);
}

fn normal_distribution(t: f32) -> f32 {
    let z = abs(t) * 0.70710678;
    let k = 1.0 / (1.0 + 0.3275911 * z);
    let tail = 0.5 * k * (0.254829592 + k * (-0.284496736 + k * (1.421413741 + k * (-1.453152027 + k * 1.061405429)))) * exp(-z * z);
    return select(tail, 1.0 - tail, t >= 0.0);
}

struct Moments {
    mean: f32,
    slope: f32,     // d mean / d exposure
    variance: f32,
}

// Moments of max(0, exposure + s n), n standard normal: what is recorded of a dark pixel whose noise is clipped at black.
// Without this, dark pixels read too bright and their variance too low.
fn clipped_at_black(exposure: f32, s: f32) -> Moments {
    let t = exposure / s;
    if t > 5.0 {
        return Moments(exposure, 1.0, s * s);
    }
    let cdf = normal_distribution(t);
    let pdf = normal_density(t);
    let mean = exposure * cdf + s * pdf;
    let second = (exposure * exposure + s * s) * cdf + exposure * s * pdf;
    return Moments(mean, cdf, max(second - mean * mean, 0.05 * s * s));
}

// Whether a channel was clipped at a pixel and says nothing there: its exposure is marked by a value that none can have.
fn unseen(exposure: f32) -> bool {
    return exposure < -0.5;
}
