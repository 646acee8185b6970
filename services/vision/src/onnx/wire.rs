//! The few rules of protobuf's binary form that it takes to walk through an ONNX file.

/// One field of a message.
pub(super) struct Field<'a> {
    pub number: u64,
    pub value: Value<'a>,
}

/// What a field holds.
pub(super) enum Value<'a> {
    Number(u64),
    Bytes(&'a [u8]),
}

impl<'a> Value<'a> {
    pub fn bytes(&self) -> &'a [u8] {
        match self {
            Value::Bytes(bytes) => bytes,
            Value::Number(_) => &[],
        }
    }

    pub fn text(&self) -> String {
        String::from_utf8_lossy(self.bytes()).into_owned()
    }

    /// The numbers of a repeated field: one, or several packed.
    pub fn numbers(&self) -> Result<Vec<u64>, String> {
        match self {
            Value::Number(n) => Ok(vec![*n]),
            Value::Bytes(bytes) => {
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
pub(super) fn fields(mut rest: &[u8]) -> impl Iterator<Item = Result<Field<'_>, String>> {
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

fn next<'a>(rest: &mut &'a [u8]) -> Result<Field<'a>, String> {
    let tag = varint(rest)?;
    let value = match tag & 7 {
        0 => Value::Number(varint(rest)?),
        1 => Value::Bytes(take(rest, 8)?),
        2 => {
            let length = varint(rest)?;
            Value::Bytes(take(rest, length)?)
        }
        5 => Value::Bytes(take(rest, 4)?),
        kind => return Err(format!("it holds a field of kind {kind}, which no network has")),
    };
    match tag >> 3 {
        0 => Err("it holds a field without a number".into()),
        number => Ok(Field { number, value }),
    }
}

fn take<'a>(rest: &mut &'a [u8], length: u64) -> Result<&'a [u8], String> {
    match usize::try_from(length).ok().and_then(|n| rest.split_at_checked(n)) {
        Some((taken, left)) => {
            *rest = left;
            Ok(taken)
        }
        None => Err(format!("it ends too early: {length} bytes are announced where {} are left", rest.len())),
    }
}

fn varint(rest: &mut &[u8]) -> Result<u64, String> {
    let mut value = 0u64;
    for (i, &byte) in rest.iter().take(10).enumerate() {
        value |= u64::from(byte & 127).checked_shl(7 * i as u32).unwrap_or(0);
        if byte < 128 {
            *rest = &rest[i + 1..];
            return Ok(value);
        }
    }
    Err("it ends too early, or holds a number of more than 64 bits".into())
}
