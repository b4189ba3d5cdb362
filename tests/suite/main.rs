//! One test binary, so that wgpu is linked once.
