//! What the directories of a TIFF-like file make rawler read, found out before rawler reads it: it follows a directory that names itself as
//! the next one without end, and one that is named often as often as that, until there is no memory.

/// Values that all directories together may hold, as a multiple of the file: they hold each part of it once, or a few times where a tag that
/// is no directory passes for one.
const TIMES: usize = 4;
/// What they may hold besides, bytes.
const SLACK: usize = 1 << 20;
/// Bytes that an entry takes beside its value.
const ENTRY: usize = 128;
/// Entries of a directory that rawler reads.
const MOST_ENTRIES: usize = 4096;
/// After as many entries in a row whose values the file does not hold, rawler takes what follows for the next directory's place.
const MOST_FAULTS: usize = 5;

const SUB_DIRECTORIES: [usize; 3] = [330, 34665, 34853];
/// rawler reads a colour profile as if it were a directory. What it finds there proves nothing of the file.
const PROFILE: usize = 34675;

/// Refuses directories whose entries claim more values than the file has bytes, and such as are named again and again, in files that are built
/// like TIFF, and in the parts of a CR3 file that are.
///
/// # Errors
/// What is wrong, with the remedy, in words that follow the file's name.
pub(super) fn check(bytes: &[u8]) -> Result<(), String> {
    let damaged = || "is truncated or damaged (a directory that cannot be); copy it again from the camera".to_string();
    let mut parts = vec![bytes];
    if bytes.get(4..8) == Some(b"ftyp") {
        for at in (4..bytes.len().saturating_sub(4)).filter(|at| &bytes[*at..at + 3] == b"CMT" && (b'1'..=b'4').contains(&bytes[at + 3])) {
            let size = u32::from_be_bytes([bytes[at - 4], bytes[at - 3], bytes[at - 2], bytes[at - 1]]) as usize;
            // The compressed picture may hold these letters as well: then no file begins behind them.
            let Some(part) = bytes.get(at + 4..).filter(|p| p.starts_with(b"II*\0") || p.starts_with(b"MM\0*")) else { continue };
            parts.push(size.checked_sub(8).and_then(|n| part.get(..n)).ok_or_else(damaged)?);
        }
    }
    parts.into_iter().try_for_each(|part| File::of(part).map_or(Some(()), |mut f| f.walk()).ok_or_else(damaged))
}

struct File<'a> {
    bytes: &'a [u8],
    little: bool,
    /// Bytes that may still be read.
    left: usize,
}

impl<'a> File<'a> {
    /// `None` when it is not built like TIFF.
    fn of(bytes: &'a [u8]) -> Option<Self> {
        let little = match bytes.get(..2)? {
            b"II" => true,
            b"MM" => false,
            _ => return None,
        };
        Some(Self { bytes, little, left: TIMES * bytes.len() + SLACK })
    }

    fn number(&self, at: usize, length: usize) -> Option<usize> {
        let part = self.bytes.get(at..at.checked_add(length)?)?;
        let join = |n: usize, b: &u8| n << 8 | usize::from(*b);
        Some(if self.little { part.iter().rev().fold(0, join) } else { part.iter().fold(0, join) })
    }

    /// All that rawler reads, one directory after the other; `None` when it is more than can be.
    fn walk(&mut self) -> Option<()> {
        let mut next = self.number(4, 4)?;
        while next != 0 {
            let (behind, below) = self.directory(next, true, self.bytes.len())?;
            for (at, most) in below {
                self.directory(at, most <= self.bytes.len(), most)?;
            }
            next = behind;
        }
        Some(())
    }

    /// Reads one directory: where the next is (0: nowhere), and those below it with the most that an entry of them may claim. `whole`: an
    /// entry that lies beyond the file is a fault of the file.
    fn directory(&mut self, at: usize, whole: bool, most: usize) -> Option<(usize, Vec<(usize, usize)>)> {
        self.take(ENTRY)?;
        let Some(entries) = self.number(at, 2) else { return Some((0, Vec::new())) };
        let (mut behind, mut faults, mut below) = (at + 2, 0, Vec::new());
        for entry in (0..entries.min(MOST_ENTRIES)).map(|i| at + 2 + 12 * i) {
            let fields = (self.number(entry, 2), self.number(entry + 2, 2), self.number(entry + 4, 4), self.number(entry + 8, 4));
            let (Some(tag), Some(kind), Some(count), Some(value)) = fields else {
                if whole {
                    return None;
                }
                return Some((0, below));
            };
            let size = match kind {
                3 | 8 => 2,
                4 | 9 | 11 => 4,
                5 | 10 | 12 => 8,
                _ => 1,
            };
            let length = count * size;
            if length > most {
                return None;
            }
            let place = if length <= 4 { entry + 8 } else { value };
            if place == u32::MAX as usize || place + length > self.bytes.len() {
                behind = if place == u32::MAX as usize { entry + 12 } else { self.bytes.len() };
                faults += 1;
                if faults == MOST_FAULTS {
                    break;
                }
                continue;
            }
            (behind, faults) = (entry + 12, 0);
            self.take(ENTRY + length)?;
            if SUB_DIRECTORIES.contains(&tag) || tag == PROFILE {
                let most = if tag == PROFILE { self.bytes.len().max(1 << 30) } else { self.bytes.len() };
                match kind {
                    4 => below.extend((0..count).filter_map(|i| Some((self.number(place + 4 * i, 4)?, most)))),
                    7 => below.push((place, most)),
                    1..=12 => {}
                    // Of what it does not know, rawler takes the first byte.
                    _ => below.extend(self.number(place, 1).map(|n| (n, most))),
                }
            }
        }
        Some((self.number(behind, 4).unwrap_or(0), below))
    }

    fn take(&mut self, bytes: usize) -> Option<()> {
        self.left = self.left.checked_sub(bytes)?;
        Some(())
    }
}
