//! Brackets with known truth.
