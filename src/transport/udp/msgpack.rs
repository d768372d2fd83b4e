//! MessagePack, as far as one flat map of scalars needs it (<https://msgpack.org>, the format's
//! specification).

/// A scalar.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) enum Scalar<'a> {
    Nil,
    Boolean(bool),
    Unsigned(u64),
    Negative(i64),
    Float(f64),
    Text(&'a str),
    Bytes(&'a [u8]),
}

/// Why bytes are not what is expected.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
pub(super) enum MsgpackError {
    /// The bytes end within a value.
    #[error("it ends within a value, after {0} bytes")]
    Truncated(usize),
    /// An array, an extension, or a map where a scalar is expected.
    #[error("type {found:#04x} at byte {at}, expected {expected}")]
    Type { at: usize, found: u8, expected: &'static str },
    /// A string that is not UTF-8.
    #[error("the string at byte {0} is not UTF-8")]
    Utf8(usize),
}

/// Reads values one after the other. It borrows: nothing is allocated for what is read.
#[derive(Debug)]
pub(super) struct Reader<'a> {
    bytes: &'a [u8],
    at: usize,
}

impl<'a> Reader<'a> {
    pub(super) fn new(bytes: &'a [u8]) -> Self {
        Reader { bytes, at: 0 }
    }

    /// The head of a map: how many pairs of key and value follow.
    pub(super) fn map(&mut self) -> Result<u32, MsgpackError> {
        let at = self.at;
        match self.byte()? {
            head @ 0x80..=0x8F => Ok(u32::from(head & 0x0F)),
            0xDE => self.array().map(u16::from_be_bytes).map(u32::from),
            0xDF => self.array().map(u32::from_be_bytes),
            found => Err(MsgpackError::Type { at, found, expected: "a map" }),
        }
    }

    /// A string.
    pub(super) fn text(&mut self) -> Result<&'a str, MsgpackError> {
        let at = self.at;
        match self.scalar()? {
            Scalar::Text(text) => Ok(text),
            _ => {
                let found = self.bytes.get(at).copied().unwrap_or_default();
                Err(MsgpackError::Type { at, found, expected: "a string" })
            }
        }
    }

    /// Any scalar.
    pub(super) fn scalar(&mut self) -> Result<Scalar<'a>, MsgpackError> {
        let at = self.at;
        Ok(match self.byte()? {
            head @ 0x00..=0x7F => Scalar::Unsigned(head.into()),
            head @ 0xE0..=0xFF => Scalar::Negative(i64::from(head as i8)),
            head @ 0xA0..=0xBF => self.string(usize::from(head & 0x1F))?,
            0xC0 => Scalar::Nil,
            head @ (0xC2 | 0xC3) => Scalar::Boolean(head == 0xC3),
            0xC4 => {
                let len = self.array().map(u8::from_be_bytes)?;
                Scalar::Bytes(self.take(len.into())?)
            }
            0xC5 => {
                let len = self.array().map(u16::from_be_bytes)?;
                Scalar::Bytes(self.take(len.into())?)
            }
            0xCA => Scalar::Float(self.array().map(f32::from_be_bytes)?.into()),
            0xCB => Scalar::Float(self.array().map(f64::from_be_bytes)?),
            0xCC => Scalar::Unsigned(self.array().map(u8::from_be_bytes)?.into()),
            0xCD => Scalar::Unsigned(self.array().map(u16::from_be_bytes)?.into()),
            0xCE => Scalar::Unsigned(self.array().map(u32::from_be_bytes)?.into()),
            0xCF => Scalar::Unsigned(self.array().map(u64::from_be_bytes)?),
            0xD0 => Scalar::Negative(self.array().map(i8::from_be_bytes)?.into()),
            0xD1 => Scalar::Negative(self.array().map(i16::from_be_bytes)?.into()),
            0xD2 => Scalar::Negative(self.array().map(i32::from_be_bytes)?.into()),
            0xD3 => Scalar::Negative(self.array().map(i64::from_be_bytes)?),
            0xD9 => {
                let len = self.array().map(u8::from_be_bytes)?;
                self.string(len.into())?
            }
            0xDA => {
                let len = self.array().map(u16::from_be_bytes)?;
                self.string(len.into())?
            }
            found => return Err(MsgpackError::Type { at, found, expected: "a scalar" }),
        })
    }

    fn string(&mut self, len: usize) -> Result<Scalar<'a>, MsgpackError> {
        let at = self.at;
        let bytes = self.take(len)?;
        std::str::from_utf8(bytes).map(Scalar::Text).map_err(|_| MsgpackError::Utf8(at))
    }

    fn byte(&mut self) -> Result<u8, MsgpackError> {
        self.array::<1>().map(u8::from_be_bytes)
    }

    fn array<const N: usize>(&mut self) -> Result<[u8; N], MsgpackError> {
        let end = MsgpackError::Truncated(self.bytes.len());
        self.take(N)?.try_into().map_err(|_| end)
    }

    fn take(&mut self, len: usize) -> Result<&'a [u8], MsgpackError> {
        let end = MsgpackError::Truncated(self.bytes.len());
        let taken = self.bytes.get(self.at..self.at.saturating_add(len)).ok_or(end)?;
        self.at += len;
        Ok(taken)
    }
}

/// Appends values in their shortest form, as msgpack-python writes them.
#[derive(Debug, Default)]
pub(super) struct Writer(Vec<u8>);

impl Writer {
    /// The head of a map of `pairs`, at most 15.
    pub(super) fn map(pairs: u8) -> Self {
        Writer(vec![0x80 | (pairs & 0x0F)])
    }

    /// A key of at most 31 bytes, and its value.
    pub(super) fn pair(&mut self, key: &str, value: Scalar<'_>) {
        self.text(key);
        match value {
            Scalar::Nil => self.0.push(0xC0),
            Scalar::Boolean(value) => self.0.push(0xC2 | u8::from(value)),
            Scalar::Unsigned(value) => self.unsigned(value),
            Scalar::Negative(value) => {
                self.0.push(0xD3);
                self.0.extend(value.to_be_bytes());
            }
            Scalar::Float(value) => {
                self.0.push(0xCB);
                self.0.extend(value.to_be_bytes());
            }
            Scalar::Text(value) => self.text(value),
            Scalar::Bytes(value) => {
                // At most 255 bytes: CAN has 8.
                self.0.extend([0xC4, value.len() as u8]);
                self.0.extend(value);
            }
        }
    }

    pub(super) fn finish(self) -> Vec<u8> {
        self.0
    }

    fn text(&mut self, text: &str) {
        self.0.push(0xA0 | (text.len() as u8 & 0x1F));
        self.0.extend(text.as_bytes());
    }

    fn unsigned(&mut self, value: u64) {
        if value < 0x80 {
            self.0.push(value as u8);
        } else if let Ok(value) = u8::try_from(value) {
            self.0.extend([0xCC, value]);
        } else if let Ok(value) = u16::try_from(value) {
            self.0.push(0xCD);
            self.0.extend(value.to_be_bytes());
        } else if let Ok(value) = u32::try_from(value) {
            self.0.push(0xCE);
            self.0.extend(value.to_be_bytes());
        } else {
            self.0.push(0xCF);
            self.0.extend(value.to_be_bytes());
        }
    }
}
