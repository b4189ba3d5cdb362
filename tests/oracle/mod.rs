//! Each kernel and the solver in f64, written from the equations: explicit matrix rows where the GPU gathers, quadrature
//! where it uses closed forms, dense algebra where it iterates. Slow and plain; knows nothing of `unshaken::kernels`.

pub mod blur;
pub mod collaborative;
pub mod data;
pub mod linear;
pub mod solver;
