//! Numbers in bytes: types, byte order, plain or compressed.

use std::io::{BufReader, Read};

use flate2::read::MultiGzDecoder;

use super::MOST_SAMPLES;
use crate::run::RunOptions;

/// A type of number.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Kind {
    I8,
    U8,
    I16,
    U16,
    I32,
    U32,
    I64,
    U64,
    F32,
    F64,
}

impl Kind {
    pub fn bytes(self) -> usize {
        match self {
            Self::I8 | Self::U8 => 1,
            Self::I16 | Self::U16 => 2,
            Self::I32 | Self::U32 | Self::F32 => 4,
            Self::I64 | Self::U64 | Self::F64 => 8,
        }
    }

    /// The number in as many bytes, least significant first.
    fn value(self, bytes: [u8; 8]) -> f32 {
        let [a, b, c, d, ..] = bytes;
        match self {
            Self::I8 => f32::from(a as i8),
            Self::U8 => f32::from(a),
            Self::I16 => f32::from(i16::from_le_bytes([a, b])),
            Self::U16 => f32::from(u16::from_le_bytes([a, b])),
            Self::I32 => i32::from_le_bytes([a, b, c, d]) as f32,
            Self::U32 => u32::from_le_bytes([a, b, c, d]) as f32,
            Self::I64 => i64::from_le_bytes(bytes) as f32,
            Self::U64 => u64::from_le_bytes(bytes) as f32,
            Self::F32 => f32::from_le_bytes([a, b, c, d]),
            Self::F64 => f64::from_le_bytes(bytes) as f32,
        }
    }
}

/// How the numbers of a file are written.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Encoding {
    Raw,
    Gzip,
    Text,
}

/// What deflate can shrink by at most (1032 : 1), and a little.
const MOST_DEFLATED: u64 = 1040;

/// Numbers to be read.
#[derive(Clone, Copy, Debug)]
pub(super) struct Samples {
    pub size: [usize; 3],
    pub kind: Kind,
    pub big_endian: bool,
    pub encoding: Encoding,
}

impl Samples {
    pub fn count(&self) -> Result<usize, String> {
        let count = self.size.iter().try_fold(1usize, |count, n| count.checked_mul(*n));
        count.filter(|n| (1..=MOST_SAMPLES).contains(n)).ok_or_else(|| format!("has impossible sizes {:?}", self.size))
    }

    /// Refuses what `bytes` of a file cannot hold, and what would need too much memory.
    pub fn reserve(&self, bytes: u64, run: &RunOptions) -> Result<Result<usize, String>, crate::error::EditError> {
        let count = match self.count() {
            Ok(count) => count,
            Err(problem) => return Ok(Err(problem)),
        };
        let needed = match self.encoding {
            Encoding::Raw => (count * self.kind.bytes()) as u64,
            Encoding::Gzip => (count * self.kind.bytes()) as u64 / MOST_DEFLATED,
            // A digit and a space.
            Encoding::Text => 2 * count as u64 - 1,
        };
        if needed > bytes {
            return Ok(Err(format!(
                "is truncated: {:?} samples need {needed} bytes, and there are {bytes}",
                self.size
            )));
        }
        run.reserve("reading a scan", count as u64 * 4, "take a smaller scan")?;
        Ok(Ok(count))
    }

    /// Reads the numbers after `skip` bytes of the decompressed stream. Never takes more memory than was read.
    pub fn read(&self, input: impl Read, skip: u64, run: &RunOptions) -> Result<Vec<f32>, String> {
        match self.encoding {
            Encoding::Raw => self.binary(input, skip, run),
            Encoding::Gzip => self.binary(MultiGzDecoder::new(BufReader::new(input)), skip, run),
            Encoding::Text => self.text(input),
        }
    }

    fn binary(&self, mut input: impl Read, skip: u64, run: &RunOptions) -> Result<Vec<f32>, String> {
        let failed = |e: std::io::Error| format!("cannot be read: {e}");
        std::io::copy(&mut (&mut input).take(skip), &mut std::io::sink()).map_err(failed)?;
        let (count, width) = (self.count()?, self.kind.bytes());
        let mut values: Vec<f32> = Vec::new();
        let mut buffer = vec![0; (1 << 16) * width];
        while values.len() < count {
            if run.is_cancelled() {
                return Err("was not read to its end: cancelled".into());
            }
            let wanted = (count - values.len()).min(1 << 16) * width;
            let got = fill(&mut input, &mut buffer[..wanted]).map_err(failed)?;
            values.extend(buffer[..got - got % width].chunks_exact(width).map(|chunk| {
                let mut bytes = [0; 8];
                for (k, b) in chunk.iter().enumerate() {
                    bytes[if self.big_endian { width - 1 - k } else { k }] = *b;
                }
                self.kind.value(bytes)
            }));
            if got < wanted {
                return Err(format!("is truncated: {} of {count} samples are there", values.len()));
            }
        }
        Ok(values)
    }

    fn text(&self, mut input: impl Read) -> Result<Vec<f32>, String> {
        let count = self.count()?;
        let mut text = String::new();
        input.read_to_string(&mut text).map_err(|e| format!("cannot be read: {e}"))?;
        let words = text.split(|c: char| c.is_whitespace() || c == ',').filter(|w| !w.is_empty());
        let values: Vec<f32> = words
            .take(count)
            .map(|w| w.parse().map_err(|_| format!("`{w}` is no number")))
            .collect::<Result<_, _>>()?;
        match values.len() == count {
            true => Ok(values),
            false => Err(format!("is truncated: {} of {count} samples are there", values.len())),
        }
    }
}

/// Reads until the buffer is full or the input ends.
fn fill(input: &mut impl Read, buffer: &mut [u8]) -> std::io::Result<usize> {
    let mut got = 0;
    while got < buffer.len() {
        match input.read(&mut buffer[got..]) {
            Ok(0) => break,
            Ok(n) => got += n,
            Err(e) if e.kind() == std::io::ErrorKind::Interrupted => {}
            Err(e) => return Err(e),
        }
    }
    Ok(got)
}
