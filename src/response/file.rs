//! Response files: `{"format":"unshaken-response","version":1,"inverse":{"red":[256 values],...},"provenance":{...}}`.

use super::Response;
use crate::error::{Error, Result};
use serde::{Deserialize, Serialize};

/// A calibrated response as it stands in a file.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct ResponseFile {
    /// Always `unshaken-response`.
    pub format: String,
    /// Always 1.
    pub version: u32,
    /// f⁻¹ per channel.
    pub inverse: InverseTables,
    /// How the tables came about.
    #[serde(default)]
    pub provenance: Provenance,
}

/// f⁻¹ per channel at the intensities 0/255, 1/255, ..., 1: relative exposure x, never decreasing, x = 1 at the end.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct InverseTables {
    /// 256 values.
    pub red: Vec<f64>,
    /// 256 values.
    pub green: Vec<f64>,
    /// 256 values.
    pub blue: Vec<f64>,
}

/// How a response came about. For the reader; the program does not use it.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Provenance {
    /// Program and version.
    #[serde(default)]
    pub program: String,
    /// Method in words.
    #[serde(default)]
    pub method: String,
    /// Names of the frames.
    #[serde(default)]
    pub frames: Vec<String>,
    /// Their exposure times, seconds.
    #[serde(default)]
    pub exposure_times: Vec<f64>,
}

impl ResponseFile {
    /// `format` of every response file.
    pub const FORMAT: &'static str = "unshaken-response";
    /// The version that this program reads and writes.
    pub const VERSION: u32 = 1;

    /// A file that holds f⁻¹ of `response` at 256 intensities.
    pub fn new(response: &Response, provenance: Provenance) -> Self {
        let table = |c| (0..256).map(|k| response.inverse(c, f64::from(k) / 255.0)).collect();
        let inverse = InverseTables { red: table(0), green: table(1), blue: table(2) };
        Self { format: Self::FORMAT.into(), version: Self::VERSION, inverse, provenance }
    }

    /// Reads the text of a response file.
    ///
    /// # Errors
    /// [`Error::Input`] for text of another kind or version, and for tables that are no inverse response (other than 256
    /// values, not finite, negative, decreasing, not 1 at the end), naming the channel.
    pub fn parse(text: &str) -> Result<Self> {
        const REMEDY: &str = "make one with 'unshaken calibrate'";
        let value: serde_json::Value =
            serde_json::from_str(text).map_err(|e| Error::Input(format!("is not a response file ({e}); {REMEDY}")))?;
        match value.get("format").and_then(|f| f.as_str()) {
            Some(Self::FORMAT) => {}
            Some(other) => return Err(Error::Input(format!("is a file of kind {other:?}, not {:?}; {REMEDY}", Self::FORMAT))),
            None => return Err(Error::Input(format!("is not a response file (it holds no \"format\"); {REMEDY}"))),
        }
        if value.get("version").and_then(|v| v.as_u64()) != Some(Self::VERSION.into()) {
            return Err(Error::Input(format!("is a response file of another version than {}; {REMEDY}", Self::VERSION)));
        }
        let file: Self = serde_json::from_value(value).map_err(|e| Error::Input(format!("is a damaged response file ({e}); {REMEDY}")))?;
        for (name, t) in [("red", &file.inverse.red), ("green", &file.inverse.green), ("blue", &file.inverse.blue)] {
            let wrong = if t.len() != 256 {
                format!("has {} values instead of 256", t.len())
            } else if t.iter().any(|v| !v.is_finite() || *v < 0.0) {
                "holds a value that is negative or not finite".into()
            } else if t.windows(2).any(|w| w[1] < w[0]) {
                "decreases".into()
            } else if (t[255] - 1.0).abs() > 1e-6 {
                format!("ends at {} instead of 1", t[255])
            } else {
                continue;
            };
            return Err(Error::Input(format!("is a damaged response file (the {name} table {wrong}); {REMEDY}")));
        }
        Ok(file)
    }

    /// The response that the tables describe.
    pub fn response(&self) -> Response {
        Response::Table([self.inverse.red.clone(), self.inverse.green.clone(), self.inverse.blue.clone()])
    }
}
