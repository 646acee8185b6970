//! Arrays of bytes as NumPy reads them.

/// Bytes before the array are a multiple of this, so that it can be mapped.
const ALIGNMENT: usize = 64;

/// The bytes of an `.npy` file (format 1.0) that holds a one-dimensional array of bytes.
pub(super) fn to_npy(values: &[u8]) -> Vec<u8> {
    const MAGIC: &[u8] = b"\x93NUMPY\x01\x00";
    let mut header = format!("{{'descr': '|u1', 'fortran_order': False, 'shape': ({},), }}", values.len());
    let before = MAGIC.len() + size_of::<u16>();
    let padded = (before + header.len() + 1).next_multiple_of(ALIGNMENT) - before;
    header += &" ".repeat(padded - header.len() - 1);
    header.push('\n');
    let length = u16::try_from(header.len()).expect("a header is short").to_le_bytes();
    [MAGIC, &length, header.as_bytes(), values].concat()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_header_is_what_numpy_writes() {
        // `numpy.save` of `numpy.arange(5, dtype=numpy.uint8)`, NumPy 2.4.
        let text = "{'descr': '|u1', 'fortran_order': False, 'shape': (5,), }";
        let written = to_npy(&[0, 1, 2, 3, 4]);
        assert_eq!(written[..8], *b"\x93NUMPY\x01\x00");
        assert_eq!(written[8..10], 118u16.to_le_bytes());
        assert_eq!(written[10..128], *format!("{text:<117}\n").as_bytes());
        assert_eq!(written[128..], [0, 1, 2, 3, 4]);
        assert!((to_npy(&[7; 1_000_000]).len() - 1_000_000).is_multiple_of(ALIGNMENT));
    }
}
