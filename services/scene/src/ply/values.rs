//! Values as a `.ply` file writes them: their types, and text or bytes of either order.

/// Type of a property.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Type {
    I8,
    U8,
    I16,
    U16,
    I32,
    U32,
    F32,
    F64,
}

impl Type {
    pub(super) fn from_name(name: &str) -> Option<Type> {
        Some(match name {
            "char" | "int8" => Type::I8,
            "uchar" | "uint8" => Type::U8,
            "short" | "int16" => Type::I16,
            "ushort" | "uint16" => Type::U16,
            "int" | "int32" => Type::I32,
            "uint" | "uint32" => Type::U32,
            "float" | "float32" => Type::F32,
            "double" | "float64" => Type::F64,
            _ => return None,
        })
    }

    pub(super) fn size(self) -> usize {
        match self {
            Type::I8 | Type::U8 => 1,
            Type::I16 | Type::U16 => 2,
            Type::I32 | Type::U32 | Type::F32 => 4,
            Type::F64 => 8,
        }
    }

    pub(super) fn parse(self, word: &str) -> Option<f64> {
        match self {
            // Through f32, so that text and binary give the same value.
            Type::F32 => word.parse::<f32>().ok().map(f64::from),
            Type::F64 => word.parse().ok(),
            // Some programs write whole numbers with a point.
            _ => word.parse::<i64>().map(|v| v as f64).or_else(|_| word.parse()).ok(),
        }
    }

    /// The value that the first bytes hold.
    ///
    /// # Panics
    /// If there are fewer bytes than [`Type::size`], or the format is text.
    pub(super) fn value(self, format: Format, bytes: &[u8]) -> f64 {
        let size = self.size();
        let mut word = [0u8; 8];
        word[..size].copy_from_slice(&bytes[..size]);
        if format == Format::Big {
            word[..size].reverse();
        }
        let [a, b, c, d, ..] = word;
        match self {
            Type::I8 => f64::from(a as i8),
            Type::U8 => f64::from(a),
            Type::I16 => f64::from(i16::from_le_bytes([a, b])),
            Type::U16 => f64::from(u16::from_le_bytes([a, b])),
            Type::I32 => f64::from(i32::from_le_bytes([a, b, c, d])),
            Type::U32 => f64::from(u32::from_le_bytes([a, b, c, d])),
            Type::F32 => f64::from(f32::from_le_bytes([a, b, c, d])),
            Type::F64 => f64::from_le_bytes(word),
        }
    }
}

#[derive(Clone, Copy, PartialEq, Eq)]
pub(crate) enum Format {
    Text,
    Little,
    Big,
}
