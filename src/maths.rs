//! Functions whose last bit does not depend on the machine: the system's mathematical library may round another way, and a seed would
//! make another bracket there.

/// Elementary functions in software, the same everywhere. Names differ from the standard library's, whose methods would win.
pub(super) trait Portable: Copy {
    /// Sine of an angle in radians.
    fn sine(self) -> Self;
    /// Cosine of an angle in radians.
    fn cosine(self) -> Self;
    /// Angle of (`x`, `self`) in radians.
    fn arctangent(self, x: Self) -> Self;
    /// Length of (`self`, `y`).
    fn length(self, y: Self) -> Self;
    /// `self` to the power `p`.
    fn power(self, p: Self) -> Self;
    /// Natural logarithm.
    fn logarithm(self) -> Self;
    /// Natural exponential.
    fn exponential(self) -> Self;
}

macro_rules! portable {
    ($t:ty, $sin:ident, $cos:ident, $atan2:ident, $pow:ident, $log:ident, $exp:ident) => {
        impl Portable for $t {
            fn sine(self) -> Self {
                libm::$sin(self)
            }
            fn cosine(self) -> Self {
                libm::$cos(self)
            }
            fn arctangent(self, x: Self) -> Self {
                libm::$atan2(self, x)
            }
            fn length(self, y: Self) -> Self {
                (self * self + y * y).sqrt()
            }
            fn power(self, p: Self) -> Self {
                libm::$pow(self, p)
            }
            fn logarithm(self) -> Self {
                libm::$log(self)
            }
            fn exponential(self) -> Self {
                libm::$exp(self)
            }
        }
    };
}

portable!(f32, sinf, cosf, atan2f, powf, logf, expf);
portable!(f64, sin, cos, atan2, pow, log, exp);
