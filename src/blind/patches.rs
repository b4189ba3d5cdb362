//! The paper's path (section III-B): PSFs of pairs of patches by eq. (12), aligned within the reference frame and across frames, and a TSF for
//! each frame from its PSFs by eq. (6).

use super::joint::fix_warp;
use super::luminance::Frame;
use crate::image::Plane;
use crate::pose::PoseGrid;
use crate::psf::{self, Pair, Patch, Psf};
use crate::tsf::{self, Tsf};
use rayon::prelude::*;

/// How to look at the patches.
#[derive(Clone, Copy, Debug)]
pub struct PatchSetup {
    /// Patches of each pair of frames.
    pub count: usize,
    /// Side of a patch in pixels.
    pub side: usize,
    /// The estimate of a pair.
    pub pair: psf::Setup,
}

impl Default for PatchSetup {
    fn default() -> Self {
        Self { count: 9, side: 120, pair: psf::Setup::default() }
    }
}

/// What the patches said.
#[derive(Clone, Debug)]
pub struct Patches {
    /// One TSF per frame; the mean pose of the reference frame is the identity.
    pub tsfs: Vec<Tsf>,
    /// The aligned PSFs of each frame.
    pub psfs: Vec<Vec<(Patch, Psf)>>,
    /// `Σ_l ‖h_l - M_l h_T‖² / Σ_l ‖h_l‖²` of the reference frame.
    pub error: f64,
}

/// Why there are no TSFs.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Lack {
    /// The caller ended the work.
    Cancelled,
    /// A frame, by its place in the list, shares no patch of enough texture with the reference frame.
    Texture(usize),
}

/// TSFs of `frames` (two or more, of one size) from patches that each shares with the frame `reference`. `progress` receives the part that is
/// done and ends the work by returning `false`.
///
/// # Errors
/// [`Lack`], for what cannot be found.
pub fn from_patches(
    frames: &[Frame],
    reference: usize,
    setup: &PatchSetup,
    progress: &mut dyn FnMut(f32) -> bool,
) -> Result<Patches, Lack> {
    let (w, h) = frames[reference].blurred.size();
    let partners: Vec<usize> = (0..frames.len()).filter(|&k| k != reference).collect();
    let weight = |f: &Frame| f.mask.zip(&f.variance, |m, v| if m > 0.0 { m * m / v } else { 0.0 });
    let own = weight(&frames[reference]);
    let mut seen: Vec<(Patch, Psf)> = Vec::new();
    let mut of_partner: Vec<Vec<(Patch, Psf)>> = Vec::new();
    let mut both: Vec<Plane> = Vec::new();
    for (n, &k) in partners.iter().enumerate() {
        let other = weight(&frames[k]);
        // The inverse variance of a difference of the two.
        let joint = own.zip(&other, |a, b| if a > 0.0 && b > 0.0 { a * b / (a + b) } else { 0.0 });
        let patches = psf::choose(&frames[reference].blurred, &joint, setup.side.min(w).min(h), setup.count);
        let mut pairs: Vec<(Patch, Pair)> = Vec::new();
        for (i, part) in patches.chunks(3).enumerate() {
            let cut = |p: &Plane, at: &Patch| p.crop(at.x, at.y, at.size, at.size);
            let found: Vec<(Patch, Option<Pair>)> = part
                .par_iter()
                .map(|p| {
                    let weights = [&cut(&own, p), &cut(&other, p)];
                    (*p, psf::estimate_pair(&cut(&frames[reference].blurred, p), &cut(&frames[k].blurred, p), weights, &setup.pair))
                })
                .collect();
            pairs.extend(found.into_iter().filter_map(|(p, pair)| Some((p, pair?))));
            let done = (3 * i + part.len()) as f32 / patches.len() as f32;
            if !progress(0.95 * (n as f32 + done) / partners.len() as f32) {
                return Err(Lack::Cancelled);
            }
        }
        if pairs.is_empty() {
            return Err(Lack::Texture(k));
        }
        seen.extend(pairs.iter().map(|(p, pair)| (*p, pair.psfs[0].clone())));
        of_partner.push(pairs.into_iter().map(|(p, pair)| (p, pair.psfs[1].clone())).collect());
        both.push(joint);
    }
    let grid = PoseGrid::new(w, h, setup.pair.radius, DEGREES, 1.0);
    let within = tsf::align_within(&seen, &grid, w, h).ok_or(Lack::Texture(reference))?;
    let mut tsfs = vec![within.tsf.clone(); frames.len()];
    let mut psfs: Vec<Vec<(Patch, Psf)>> = vec![Vec::new(); frames.len()];
    let moved = |psfs: &[(Patch, Psf)], shifts: &[(f64, f64)]| -> Vec<(Patch, Psf)> {
        psfs.iter().zip(shifts).map(|((p, h), s)| (*p, tsf::shifted(h, *s))).collect()
    };
    psfs[reference] = moved(&seen, &within.shifts);
    for ((&k, own), joint) in partners.iter().zip(&of_partner).zip(&both) {
        let shifts = tsf::align_across(own, &within.tsf, (&frames[reference].blurred, &frames[k].blurred), joint);
        let aligned = moved(own, &shifts);
        tsfs[k] = tsf::from_psfs(&aligned, &grid, w, h).ok_or(Lack::Texture(k))?;
        psfs[k] = aligned;
    }
    fix_warp(&mut tsfs, reference);
    if progress(1.0) { Ok(Patches { tsfs, psfs, error: within.error }) } else { Err(Lack::Cancelled) }
}

/// Largest roll of the poses, degrees.
const DEGREES: f64 = 2.0;
