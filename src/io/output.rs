//! Results: each is written beside its target and renamed, so that a target is either whole or untouched.

use super::exr::{self, Radiometry};
use super::metadata::Metadata;
use super::plain;
use crate::error::{Error, Result};
use crate::image::Rgb;
use std::fs::File;
use std::io::{BufWriter, Write};
use std::path::{Path, PathBuf};
use std::sync::Mutex;
use tempfile::NamedTempFile;

/// Files beside their targets that are not renamed yet, for [`abandon`]. Held while a set of results is renamed.
static UNFINISHED: Mutex<Vec<PathBuf>> = Mutex::new(Vec::new());

/// Removes every file that is not renamed to its target yet, and lets none be renamed from now on: for a process that is about to end
/// without its destructors. A set of results that is being renamed is renamed first.
pub fn abandon() {
    let Ok(files) = UNFINISHED.lock() else { return };
    for file in files.iter() {
        let _ = std::fs::remove_file(file);
    }
    // Whoever would rename now waits for ever, that is until the process ends.
    std::mem::forget(files);
}

/// Renames all results to their targets, with nothing in between that could be interrupted by [`abandon`].
///
/// # Errors
/// [`Error::Write`], see [`Staged::commit`]; those before it are renamed then.
pub fn commit_all(staged: Vec<Staged>) -> Result<()> {
    let mut unfinished = UNFINISHED.lock().unwrap_or_else(std::sync::PoisonError::into_inner);
    for file in staged {
        let at = file.file.path().to_path_buf();
        file.rename()?;
        unfinished.retain(|p| *p != at);
    }
    Ok(())
}

/// A target that can be written, as far as can be told before the work begins.
#[derive(Clone, Debug)]
pub struct Output {
    path: PathBuf,
    overwrite: bool,
}

/// A result that lies complete beside its target. Dropped without [`Staged::commit`], it vanishes.
#[derive(Debug)]
pub struct Staged {
    output: Output,
    file: NamedTempFile,
}

impl Output {
    /// Checks that `path` can be written: its folder exists and takes a file, and nothing stands there unless `overwrite`.
    ///
    /// # Errors
    /// [`Error::Write`] with the remedy.
    pub fn check(path: &Path, overwrite: bool) -> Result<Self> {
        let output = Self { path: path.into(), overwrite };
        if path.file_name().is_none() || path.as_os_str().to_string_lossy().ends_with(std::path::is_separator) {
            return Err(output.refuse("is not a file name; name a file"));
        }
        let folder = output.folder();
        if !folder.exists() {
            return Err(output.refuse(&format!("the folder {} does not exist; make it first", folder.display())));
        }
        if !folder.is_dir() {
            return Err(output.refuse(&format!("{} is not a folder; choose another place", folder.display())));
        }
        output.check_target()?;
        output.temporary()?;
        Ok(output)
    }

    /// The target.
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// Writes the whole result beside the target.
    ///
    /// # Errors
    /// [`Error::Write`] with the reason that `write` gives, or the system's.
    pub fn stage(&self, write: impl FnOnce(&mut BufWriter<&File>) -> std::result::Result<(), String>) -> Result<Staged> {
        let file = self.temporary()?;
        UNFINISHED.lock().unwrap_or_else(std::sync::PoisonError::into_inner).push(file.path().to_path_buf());
        let mut buffer = BufWriter::new(file.as_file());
        write(&mut buffer).map_err(|e| self.refuse(&e))?;
        buffer.flush().map_err(|e| self.refuse(&plain(&e)))?;
        drop(buffer);
        file.as_file().sync_all().map_err(|e| self.refuse(&plain(&e)))?;
        Ok(Staged { output: self.clone(), file })
    }

    /// Stages a linear OpenEXR image, see [`super::exr::write`].
    ///
    /// # Errors
    /// [`Error::Write`], also for pixels that are NaN, infinite or negative.
    pub fn stage_exr(&self, image: &Rgb, radiometry: &Radiometry) -> Result<Staged> {
        self.stage(|to| exr::write(to, image, radiometry))
    }

    /// Stages a value as JSON text, indented, with a line end.
    ///
    /// # Errors
    /// [`Error::Write`].
    pub fn stage_json(&self, value: &impl serde::Serialize) -> Result<Staged> {
        self.stage(|to| {
            serde_json::to_writer_pretty(&mut *to, value).map_err(|e| e.to_string())?;
            to.write_all(b"\n").map_err(|e| plain(&e))
        })
    }

    /// Stages an 8-bit sRGB PNG.
    ///
    /// # Errors
    /// [`Error::Write`].
    pub fn stage_png(&self, picture: &::image::RgbImage) -> Result<Staged> {
        self.stage(|to| super::picture::write_png(to, picture, None))
    }

    /// Stages a picture as PNG or, where the target's name ends so, as JPEG of `quality`; with the sRGB profile and what the camera noted.
    ///
    /// # Errors
    /// [`Error::Write`].
    pub fn stage_picture(&self, picture: &::image::RgbImage, quality: u8, noted: &Metadata) -> Result<Staged> {
        self.stage(|to| match ending(&self.path).as_str() {
            "jpg" | "jpeg" => super::picture::write_jpeg(to, picture, quality, Some(noted)),
            _ => super::picture::write_png(to, picture, Some(noted)),
        })
    }

    /// Stages a picture as JPEG of `quality` with the gain map that makes it look like `linear`, see [`super::gainmap::write()`].
    ///
    /// # Errors
    /// [`Error::Write`].
    pub fn stage_gain_map(&self, picture: &::image::RgbImage, linear: &Rgb, quality: u8, noted: &Metadata) -> Result<Staged> {
        self.stage(|to| super::gainmap::write(to, picture, linear, quality, Some(noted)))
    }

    /// Stages text.
    ///
    /// # Errors
    /// [`Error::Write`].
    pub fn stage_text(&self, text: &str) -> Result<Staged> {
        self.stage(|to| to.write_all(text.as_bytes()).map_err(|e| plain(&e)))
    }

    /// Stages a linear image in the format that the target's name ends with: `.hdr` Radiance (Rec. 709 only), `.tif` or `.tiff` TIFF
    /// (linear; floating point, or 16-bit integers of what is below 1 for [`exr::Style::half`]), else OpenEXR. Returns the share of the
    /// values that the format clips as well.
    ///
    /// # Errors
    /// [`Error::Write`], also for pixels that are NaN, infinite or negative.
    pub fn stage_linear(&self, image: &Rgb, radiometry: &Radiometry, style: &exr::Style) -> Result<(Staged, f64)> {
        use super::picture::{Depth, write_radiance, write_tiff};
        let mut clipped = 0.0;
        let staged = self.stage(|to| match ending(&self.path).as_str() {
            "hdr" => write_radiance(to, image),
            "tif" | "tiff" => {
                let depth = if style.half { Depth::Sixteen } else { Depth::Float };
                clipped = write_tiff(to, image, depth, style.primaries, &style.metadata)?;
                Ok(())
            }
            _ => exr::write_styled(to, image, radiometry, style),
        })?;
        Ok((staged, clipped))
    }

    /// Stages a JPEG of `quality` 1..=100, for pictures that noise makes large as PNG.
    ///
    /// # Errors
    /// [`Error::Write`].
    pub fn stage_jpeg(&self, picture: &::image::RgbImage, quality: u8) -> Result<Staged> {
        self.stage(|to| super::picture::write_jpeg(to, picture, quality, None))
    }

    fn folder(&self) -> &Path {
        match self.path.parent() {
            Some(p) if !p.as_os_str().is_empty() => p,
            _ => Path::new("."),
        }
    }

    /// Refuses a target that must not be replaced. Looked at twice, because a merge takes a while.
    fn check_target(&self) -> Result<()> {
        match std::fs::symlink_metadata(&self.path) {
            Err(_) => Ok(()),
            Ok(m) if m.is_dir() => Err(self.refuse("is a folder; name a file in it")),
            Ok(_) if !self.overwrite => Err(self.refuse("exists; give --overwrite to replace it, or another name")),
            Ok(m) if m.is_file() || m.is_symlink() => Ok(()),
            Ok(_) => Err(self.refuse("is not a plain file; choose another name")),
        }
    }

    /// An empty file beside the target, which vanishes when dropped, with the permissions of any new file.
    fn temporary(&self) -> Result<NamedTempFile> {
        let mut builder = tempfile::Builder::new();
        builder.prefix(".unshaken-").suffix(".part");
        #[cfg(unix)]
        builder.permissions(std::os::unix::fs::PermissionsExt::from_mode(0o666)); // lessened by the umask; a temporary file's own is 600
        builder.tempfile_in(self.folder()).map_err(|e| {
            let said = plain(e.get_ref().and_then(|x| x.downcast_ref::<std::io::Error>()).unwrap_or(&e));
            self.refuse(&format!("its folder takes no new file, {}; choose a folder that you may write to", before_path(&said)))
        })
    }

    fn refuse(&self, reason: &str) -> Error {
        Error::Write { path: self.path.clone(), reason: reason.into() }
    }
}

/// What the name ends with after its last point, in lower case.
pub fn ending(path: &Path) -> String {
    path.extension().map(|e| e.to_string_lossy().to_ascii_lowercase()).unwrap_or_default()
}

/// The system's words without the name of the temporary file behind them.
fn before_path(said: &str) -> &str {
    said.split(" at path").next().unwrap_or(said)
}

impl Staged {
    /// Renames the result to its target.
    ///
    /// # Errors
    /// [`Error::Write`] when the target has come into being meanwhile or the system refuses.
    pub fn commit(self) -> Result<()> {
        commit_all(vec![self])
    }

    fn rename(self) -> Result<()> {
        self.output.check_target()?;
        self.file.persist(&self.output.path).map_err(|e| self.output.refuse(&plain(&e.error)))?;
        Ok(())
    }
}

/// Checks that no two outputs are one file and that no output is an input. Each comes with the name of its option.
///
/// # Errors
/// [`Error::Input`] naming both.
pub fn check_distinct(outputs: &[(&str, &Path)], inputs: &[(&str, &Path)]) -> Result<()> {
    for (i, (option, path)) in outputs.iter().enumerate() {
        let same = |other: &&(&str, &Path)| is_same_file(path, other.1);
        if let Some((other, _)) = outputs[..i].iter().find(same) {
            return Err(Error::Input(format!("{}: both {other} and {option} would write it; give two names", path.display())));
        }
        if let Some((other, _)) = inputs.iter().find(same) {
            return Err(Error::Input(format!("{}: {option} would replace the {other} that is read; give another name", path.display())));
        }
    }
    Ok(())
}

/// Whether two names lead to one file, which need not exist.
pub fn is_same_file(a: &Path, b: &Path) -> bool {
    let real = |p: &Path| {
        std::fs::canonicalize(p).ok().or_else(|| {
            let folder = p.parent().filter(|f| !f.as_os_str().is_empty()).unwrap_or(Path::new("."));
            Some(std::fs::canonicalize(folder).ok()?.join(p.file_name()?))
        })
    };
    a == b || matches!((real(a), real(b)), (Some(x), Some(y)) if x == y)
}
