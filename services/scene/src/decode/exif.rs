//! The size in EXIF data.

/// Width and height that the camera wrote into them.
fn size(exif: &[u8]) -> Option<(u32, u32)> {
    let big = match exif.get(..4)? {
        b"II*\0" => false,
        b"MM\0*" => true,
        _ => return None,
    };
    let two = |at: usize| -> Option<u32> {
        let b = exif.get(at..at.checked_add(2)?)?.try_into().ok()?;
        Some(u32::from(if big { u16::from_be_bytes(b) } else { u16::from_le_bytes(b) }))
    };
    let four = |at: usize| -> Option<u32> {
        let b = exif.get(at..at.checked_add(4)?)?.try_into().ok()?;
        Some(if big { u32::from_be_bytes(b) } else { u32::from_le_bytes(b) })
    };
    // The value of a tag in the directory at an offset.
    let find = |directory: u32, tag: u32| -> Option<u32> {
        let at = directory as usize;
        let entry = (0..two(at)? as usize).map(|k| at + 2 + 12 * k).find(|&e| two(e) == Some(tag))?;
        if two(entry + 2)? == 3 { two(entry + 8) } else { four(entry + 8) }
    };
    const SUB_DIRECTORY: u32 = 0x8769;
    const WIDTH: u32 = 0xa002;
    const HEIGHT: u32 = 0xa003;
    let sub = find(four(4)?, SUB_DIRECTORY)?;
    Some((find(sub, WIDTH)?, find(sub, HEIGHT)?))
}

/// Whether the data are of a landscape image while this one is portrait, or the other way round.
pub(super) fn lies_otherwise(exif: &[u8], width: u32, height: u32) -> bool {
    size(exif)
        .is_some_and(|(w, h)| w > 0 && h > 0 && (w > h) != (width > height) && w != h && width != height)
}
