//! Checksums. Whoever forges a file can compute them, so a changed input gets right ones: else nothing but the checksum is
//! tried.

use segwild_flow::codec::FORMAT_VERSION;

/// Bytes of a record before its kind: magic, version, length of the kind.
const KIND_AT: usize = 8 + 2 + 1;

/// Leaves an input as it is.
pub fn nothing(_: &mut [u8]) {}

/// Puts version, length and hash of a record of [`segwild_flow::codec`] right.
pub fn record(bytes: &mut [u8]) {
    let Some(&kind) = bytes.get(KIND_AT - 1) else { return };
    let tail = KIND_AT + usize::from(kind);
    let header = tail + 8 + 32;
    if bytes.len() < header {
        return;
    }
    bytes[8..10].copy_from_slice(&FORMAT_VERSION.to_le_bytes());
    let length = (bytes.len() - header) as u64;
    bytes[tail..tail + 8].copy_from_slice(&length.to_le_bytes());
    let mut hasher = blake3::Hasher::new_derive_key("segwild record 1");
    hasher.update(&[kind]).update(&bytes[KIND_AT..tail]).update(&bytes[header..]);
    let hash = *hasher.finalize().as_bytes();
    bytes[tail + 8..header].copy_from_slice(&hash);
}

/// Puts the CRC of every chunk of a PNG right, as far as the chunks can be followed.
pub fn png(bytes: &mut [u8]) {
    let mut at = 8;
    while let Some(head) = bytes.get(at..at + 8) {
        let length = u32::from_be_bytes([head[0], head[1], head[2], head[3]]) as usize;
        let Some(body) = bytes.get(at + 4..(at + 8).saturating_add(length)) else { return };
        let crc = crc32(body).to_be_bytes();
        let end = at + 8 + length;
        if let Some(field) = bytes.get_mut(end..end + 4) {
            field.copy_from_slice(&crc);
        }
        at = end + 4;
    }
}

/// Puts the CRC of every stored file of a zip archive right, as far as its list can be followed.
pub fn zip(bytes: &mut [u8]) {
    let Some(end) = bytes.windows(4).rposition(|word| word == b"PK\x05\x06") else { return };
    let Some(mut at) = little(bytes, end + 16, 4) else { return };
    while bytes.get(at..at + 4) == Some(&b"PK\x01\x02"[..]) {
        let field = |offset: usize, size: usize| little(bytes, at + offset, size).unwrap_or(0);
        let next = at + 46 + field(28, 2) + field(30, 2) + field(32, 2);
        let (own, packed) = (field(42, 4), field(20, 4));
        let start = little(bytes, own + 26, 2).zip(little(bytes, own + 28, 2));
        let data = start.and_then(|(name, extra)| {
            let start = own + 30 + name + extra;
            bytes.get(start..start + packed)
        });
        let crc = data.map(|data| crc32(data).to_le_bytes());
        if let (Some(crc), Some(to)) = (crc, bytes.get_mut(at + 16..at + 20)) {
            to.copy_from_slice(&crc);
        }
        at = next;
    }
}

/// The number of so many bytes at a position, the lowest first.
fn little(bytes: &[u8], at: usize, size: usize) -> Option<usize> {
    let bytes = bytes.get(at..at + size)?;
    Some(bytes.iter().rev().fold(0, |value, byte| value << 8 | usize::from(*byte)))
}

fn crc32(bytes: &[u8]) -> u32 {
    let bit = |crc: u32| if crc & 1 == 1 { (crc >> 1) ^ 0xedb8_8320 } else { crc >> 1 };
    let byte = |crc: u32, b: &u8| (0..8).fold(crc ^ u32::from(*b), |crc, _| bit(crc));
    !bytes.iter().fold(u32::MAX, byte)
}

#[cfg(test)]
mod tests {
    use super::{crc32, record};
    use segwild_flow::codec;

    #[test]
    fn a_sealed_record_is_read_again() {
        let mut bytes = codec::encode("numbers/1", &vec![1u32, 2, 3]).expect("it is small");
        let last = bytes.len() - 4;
        bytes[last] = 9;
        assert!(codec::decode::<Vec<u32>>("numbers/1", &bytes).is_err());
        record(&mut bytes);
        assert_eq!(codec::decode("numbers/1", &bytes), Ok(vec![1u32, 2, 9]));
    }

    #[test]
    fn the_checksum_of_png_is_the_known_one() {
        assert_eq!(crc32(b"123456789"), 0xcbf4_3926);
    }
}
