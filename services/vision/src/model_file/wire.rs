//! A reader of protobuf's wire format: as much of it as walking through an ONNX file needs.

/// Why bytes are no protobuf message.
#[derive(Debug, thiserror::Error)]
pub enum WireError {
    /// A field has a wire type that protobuf does not use any more, or never did.
    #[error("it holds a field of kind {0}, which no network has")]
    Kind(u64),
    /// A field has the number 0.
    #[error("it holds a field without a number")]
    NoNumber,
    /// A field is longer than the rest of the bytes.
    #[error("it ends too early: {announced} bytes are announced where {left} are left")]
    CutShort {
        /// Bytes that the field is to have.
        announced: u64,
        /// Bytes that are left for it.
        left: usize,
    },
    /// A variable-length number does not end within its ten bytes, or within the bytes that are left.
    #[error("it ends too early, or holds a number of more than 64 bits")]
    Number,
}

/// One field of a message.
pub(super) struct WireField<'a> {
    pub number: u64,
    pub value: WireValue<'a>,
}

/// What a field holds.
pub(super) enum WireValue<'a> {
    Number(u64),
    Bytes(&'a [u8]),
}

impl<'a> WireValue<'a> {
    pub fn bytes(&self) -> &'a [u8] {
        match self {
            WireValue::Bytes(bytes) => bytes,
            WireValue::Number(_) => &[],
        }
    }

    pub fn text(&self) -> String {
        String::from_utf8_lossy(self.bytes()).into_owned()
    }

    /// The numbers of a repeated field: one, or several packed.
    pub fn numbers(&self) -> Result<Vec<u64>, WireError> {
        match self {
            WireValue::Number(n) => Ok(vec![*n]),
            WireValue::Bytes(bytes) => {
                let (mut rest, mut all) = (*bytes, Vec::new());
                while !rest.is_empty() {
                    all.push(varint(&mut rest)?);
                }
                Ok(all)
            }
        }
    }
}

/// The fields of a message in order. An error ends them.
pub(super) fn fields(mut rest: &[u8]) -> impl Iterator<Item = Result<WireField<'_>, WireError>> {
    std::iter::from_fn(move || {
        if rest.is_empty() {
            return None;
        }
        let field = next(&mut rest);
        if field.is_err() {
            rest = &[];
        }
        Some(field)
    })
}

fn next<'a>(rest: &mut &'a [u8]) -> Result<WireField<'a>, WireError> {
    let tag = varint(rest)?;
    let value = match tag & 7 {
        0 => WireValue::Number(varint(rest)?),
        1 => WireValue::Bytes(take(rest, 8)?),
        2 => {
            let length = varint(rest)?;
            WireValue::Bytes(take(rest, length)?)
        }
        5 => WireValue::Bytes(take(rest, 4)?),
        kind => return Err(WireError::Kind(kind)),
    };
    match tag >> 3 {
        0 => Err(WireError::NoNumber),
        number => Ok(WireField { number, value }),
    }
}

fn take<'a>(rest: &mut &'a [u8], length: u64) -> Result<&'a [u8], WireError> {
    match usize::try_from(length).ok().and_then(|n| rest.split_at_checked(n)) {
        Some((taken, left)) => {
            *rest = left;
            Ok(taken)
        }
        None => Err(WireError::CutShort { announced: length, left: rest.len() }),
    }
}

fn varint(rest: &mut &[u8]) -> Result<u64, WireError> {
    let mut value = 0u64;
    for (i, &byte) in rest.iter().take(10).enumerate() {
        value |= u64::from(byte & 127).checked_shl(7 * i as u32).unwrap_or(0);
        if byte < 128 {
            *rest = &rest[i + 1..];
            return Ok(value);
        }
    }
    Err(WireError::Number)
}
