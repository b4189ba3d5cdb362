//! Irradiance to display.
