//! Records: bincode's bytes, refusals in type, and no panic on hostile bytes.

use proptest::prelude::*;
use segwild_flow::codec::{self, CodecError, SIZE_LIMIT, StreamedRecord};
use std::path::Path;
use wincode::{SchemaRead, SchemaWrite};

#[derive(SchemaWrite, SchemaRead, Clone, Debug, PartialEq)]
enum TestShape {
    Point,
    Disc { radius: f32 },
    Named(String),
}

#[derive(SchemaWrite, SchemaRead, Clone, Debug, PartialEq)]
struct TestRecord {
    view: u32,
    name: String,
    values: Vec<f32>,
    shapes: Vec<TestShape>,
    parent: Option<Box<[u8; 4]>>,
}

fn record() -> TestRecord {
    TestRecord {
        view: 7,
        name: "façade".into(),
        values: vec![0.5, -1.0, f32::INFINITY],
        shapes: vec![TestShape::Point, TestShape::Disc { radius: 2.0 }, TestShape::Named("x".into())],
        parent: Some(Box::new([1, 2, 3, 4])),
    }
}

#[test]
fn the_payload_is_bincodes() {
    // What bincode 1 writes: fixed integers, u64 lengths, u32 tags, all little-endian.
    let mut expected = vec![7, 0, 0, 0];
    expected.extend(7u64.to_le_bytes());
    expected.extend("façade".bytes());
    expected.extend(3u64.to_le_bytes());
    [0.5f32, -1.0, f32::INFINITY].iter().for_each(|v| expected.extend(v.to_le_bytes()));
    expected.extend(3u64.to_le_bytes());
    expected.extend(0u32.to_le_bytes());
    expected.extend(1u32.to_le_bytes());
    expected.extend(2.0f32.to_le_bytes());
    expected.extend(2u32.to_le_bytes());
    expected.extend(1u64.to_le_bytes());
    expected.extend(*b"x\x01\x01\x02\x03\x04");
    let bytes = codec::encode("record/1", &record()).unwrap();
    let (kind, payload) = codec::open(&bytes).unwrap();
    assert_eq!((kind, payload), ("record/1", &expected[..]));
}

#[test]
fn more_than_four_mebibytes_travel() {
    let values: Vec<u32> = (0..3 << 20).collect();
    let bytes = codec::encode("many/1", &values).unwrap();
    assert!(codec::decode::<Vec<u32>>("many/1", &bytes).unwrap() == values);
}

#[test]
fn a_long_record_is_written_bit_by_bit_with_the_bytes_of_one_that_is_held() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("many.bin");
    // An array that passes the buffer by, between values that do not.
    let value = (vec![record(); 3000], (0..3 << 18).collect::<Vec<u32>>(), record());
    let hash = StreamedRecord::of("many/1", &value).unwrap().write_file(&path).unwrap();
    let (written, held) = (codec::read_file(&path).unwrap(), codec::encode("many/1", &value).unwrap());
    assert!(written == held);
    assert_eq!(hash, *blake3::hash(&held).as_bytes());
    let (mut file, bytes) = codec::open_file(&path).unwrap();
    assert_eq!((bytes, std::io::copy(&mut file, &mut std::io::sink()).unwrap()), (held.len() as u64, bytes));
    let refused = StreamedRecord::of("with blank", &value).err();
    assert!(matches!(refused, Some(CodecError::KindName(_))));
}

#[test]
fn a_full_disk_is_found_where_a_record_is_written_bit_by_bit() {
    let path = Path::new("/dev/full");
    let Ok(mut device) = std::fs::File::options().write(true).open(path) else {
        return println!("skipped: a_full_disk_is_found_where_a_record_is_written_bit_by_bit: no /dev/full");
    };
    let values = vec![0u32; 1 << 16];
    let record = StreamedRecord::of("many/1", &values).unwrap();
    assert_eq!(record.write(&mut device).unwrap_err().kind(), std::io::ErrorKind::StorageFull);
    // It ends within the payload.
    let mut few = [0u8; 1000];
    assert_eq!(record.write(&mut few[..]).unwrap_err().kind(), std::io::ErrorKind::WriteZero);
}

#[test]
fn more_than_the_limit_is_refused() {
    // Zeros that are never touched take no memory, but some systems promise no more than they have.
    if Vec::<u8>::new().try_reserve_exact(SIZE_LIMIT + 1).is_err() {
        return println!("skipped: more_than_the_limit_is_refused: this machine has less memory than that");
    }
    let mut zeros = vec![0u8; SIZE_LIMIT + 1];
    assert!(matches!(codec::encode("big/1", &zeros), Err(CodecError::TooLarge { .. })));
    zeros.truncate(SIZE_LIMIT);
    assert!(
        matches!(codec::encode("big/1", &zeros), Err(CodecError::TooLarge { .. })),
        "the header counts, too"
    );
}

#[test]
fn errors_name_what_is_wrong() {
    let whole = codec::encode("record/1", &record()).unwrap();
    let read = |bytes: &[u8]| codec::decode::<TestRecord>("record/1", bytes).unwrap_err();
    assert!(matches!(read(b""), CodecError::Truncated { .. }));
    assert!(matches!(read(b"PK\x03\x04"), CodecError::Foreign));
    assert!(matches!(read(&whole[..20]), CodecError::Truncated { .. }));
    assert!(matches!(read(&whole[..whole.len() - 1]), CodecError::Truncated { .. }));
    let longer = [&whole[..], &[0]].concat();
    assert!(matches!(read(&longer), CodecError::Corrupt { .. }));
    let mut newer = whole.clone();
    newer[8] = 2;
    assert!(matches!(read(&newer), CodecError::Version { found: 2 }));
    let other = codec::encode("other/1", &record()).unwrap();
    assert_eq!(read(&other).to_string(), "the record holds `other/1` where `record/1` was wanted");
    // A record renamed without its hash is damaged, not of the other kind.
    let mut renamed = other;
    renamed[11..18].copy_from_slice(b"recor/1");
    assert!(matches!(codec::open(&renamed), Err(CodecError::Corrupt { .. })));
    for bad in ["", "with blank", "ü", &"x".repeat(65)] {
        assert!(matches!(codec::encode(bad, &1u32), Err(CodecError::KindName(_))), "{bad}");
    }
}

/// A record whose hash is right, whatever its payload: what an attacker would write. An array of bytes has no
/// length before it, so arrays write any payload.
fn forged(payload: &[u8]) -> Vec<u8> {
    macro_rules! sized { ($($n:literal)*) => { match payload.len() {
        $($n => codec::encode("record/1", <&[u8; $n]>::try_from(payload).unwrap()).unwrap(),)*
        other => panic!("no payload of {other} bytes is tried"),
    } } }
    sized!(0 1 2 3 4 8 12 16 20 24 32 40 48 64)
}

#[test]
fn a_short_record_that_claims_a_long_sequence_is_refused_before_memory_is_taken() {
    // A name of no letters, then 2^27 values: half a gigabyte.
    let mut payload = [0; 64];
    payload[12..20].copy_from_slice(&(1u64 << 27).to_le_bytes());
    let refused = codec::decode::<TestRecord>("record/1", &forged(&payload)).unwrap_err().to_string();
    assert!(refused.contains("reallocation"), "{refused}");
    // What a record really holds may be much more than that of memory.
    let absent: Vec<Option<[u64; 7]>> = vec![None; 200_000];
    let bytes = codec::encode("absent/1", &absent).unwrap();
    assert!(codec::decode::<Vec<Option<[u64; 7]>>>("absent/1", &bytes).unwrap() == absent);
}

proptest! {
    #[test]
    fn any_record_returns(view: u32, name: String, values in prop::collection::vec(any::<f32>(), 0..50), tag in 0..3u8) {
        let shape = match tag { 0 => TestShape::Point, 1 => TestShape::Disc { radius: 1.5 }, _ => TestShape::Named(name.clone()) };
        let values: Vec<f32> = values.into_iter().filter(|v| !v.is_nan()).collect();
        let record = TestRecord { view, name, values, shapes: vec![shape], parent: None };
        let bytes = codec::encode("record/1", &record).unwrap();
        let (mut written, streamed) = (Vec::new(), StreamedRecord::of("record/1", &record).unwrap());
        prop_assert_eq!(streamed.bytes(), bytes.len() as u64);
        prop_assert_eq!(streamed.write(&mut written).unwrap(), *blake3::hash(&bytes).as_bytes());
        prop_assert!(written == bytes);
        prop_assert_eq!(codec::decode::<TestRecord>("record/1", &bytes).unwrap(), record);
    }

    #[test]
    fn a_changed_bit_is_found(bit in 0usize..8 * 180) {
        let mut bytes = codec::encode("record/1", &record()).unwrap();
        let bit = bit % (8 * bytes.len());
        bytes[bit / 8] ^= 1 << (bit % 8);
        prop_assert!(codec::decode::<TestRecord>("record/1", &bytes).is_err());
    }

    #[test]
    fn any_cut_is_found(cut in 0usize..180) {
        let bytes = codec::encode("record/1", &record()).unwrap();
        let cut = cut.min(bytes.len() - 1);
        prop_assert!(codec::decode::<TestRecord>("record/1", &bytes[..cut]).is_err());
    }

    #[test]
    fn noise_is_refused(bytes in prop::collection::vec(any::<u8>(), 0..200), headed: bool) {
        let bytes = if headed { [&codec::encode("record/1", &0u8).unwrap()[..24], &bytes].concat() } else { bytes };
        prop_assert!(codec::decode::<TestRecord>("record/1", &bytes).is_err());
    }

    #[test]
    fn hostile_payloads_with_a_right_hash_do_no_harm(
        mut bytes in prop::collection::vec(any::<u8>(), 64),
        size in prop::sample::select(vec![0usize, 1, 2, 3, 4, 8, 12, 16, 20, 24, 32, 40, 48, 64]),
        huge: bool,
    ) {
        if huge {
            // The name's length, then a plausible one for the values.
            bytes[4..12].copy_from_slice(&0u64.to_le_bytes());
            bytes[12..20].copy_from_slice(&u64::MAX.to_le_bytes());
        }
        // Either it happens to be a record, or it is refused; it neither panics nor exhausts the memory.
        if let Err(error) = codec::decode::<TestRecord>("record/1", &forged(&bytes[..size])) {
            let is_corrupt = matches!(error, CodecError::Corrupt { .. });
            prop_assert!(is_corrupt, "{error}");
        } else {
            prop_assert!(size >= 29 && !huge);
        }
    }
}
