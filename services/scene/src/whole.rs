//! Records whose parts fit each other.
//!
//! A record of a run folder has a hash, which proves that it is as it was written, but not who wrote it. A record made by hand may
//! claim more pixels than it has. Such a record is refused where it is read, so that no other code has to check.

/// Reads a type as a record of the same fields, in the same bytes as its derived writer, and refuses it where `fits` is false.
macro_rules! read_whole {
    ($type:ident as $record:ident { $($field:ident: $of:ty),+ $(,)? } where $fits:expr, $what:literal) => {
        #[derive(wincode::SchemaRead)]
        struct $record {
            $($field: $of,)+
        }

        // SAFETY: the size is left dynamic, and `to` is written just before `Ok` is returned and in no other case.
        unsafe impl<'de, C: wincode::config::Config> wincode::SchemaRead<'de, C> for $type {
            type Dst = $type;

            fn read(
                from: impl wincode::io::Reader<'de>,
                to: &mut std::mem::MaybeUninit<$type>,
            ) -> wincode::ReadResult<()> {
                let $record { $($field),+ } = <$record as wincode::SchemaRead<'de, C>>::get(from)?;
                let value = $type { $($field),+ };
                let fits: fn(&$type) -> bool = $fits;
                if !fits(&value) {
                    return Err(wincode::error::ReadError::InvalidValue($what));
                }
                to.write(value);
                Ok(())
            }
        }
    };
}

pub(crate) use read_whole;

#[cfg(test)]
mod tests {
    use crate::{Embedding, Image, Mask, MaskSet, ScoredMask};
    use wincode::{SchemaRead, SchemaWrite, config::DefaultConfig};

    fn again<T>(value: &T) -> Option<T>
    where
        T: SchemaWrite<DefaultConfig, Src = T> + for<'de> SchemaRead<'de, DefaultConfig, Dst = T>,
    {
        wincode::deserialize(&wincode::serialize(value).unwrap()).ok()
    }

    /// The record of a mask with its first field, the width, changed.
    fn of_width(mask: &Mask, width: u32) -> Option<Mask> {
        let mut bytes = wincode::serialize(mask).unwrap();
        bytes[..4].copy_from_slice(&width.to_le_bytes());
        wincode::deserialize(&bytes).ok()
    }

    #[test]
    fn a_forged_mask_that_claims_more_pixels_than_it_has_is_refused() {
        let mask = Mask::from_fn(13, 7, |x, y| (x + y) % 3 == 0);
        assert_eq!(again(&mask), Some(mask.clone()));
        assert_eq!(of_width(&mask, 13), Some(mask.clone()));
        for width in [0, 1, 20, u32::MAX] {
            assert_eq!(of_width(&mask, width), None, "{width}");
        }
        // As many words, and bits beyond the last pixel.
        assert_eq!(of_width(&Mask::full(13, 7), 12), None);
        let scored = ScoredMask { mask, predicted_iou: 1.0, stability: 1.0 };
        let set = |width| MaskSet { width, height: 7, masks: vec![scored.clone()] };
        assert!(again(&set(13)).is_some() && again(&set(14)).is_none());
    }

    #[test]
    fn a_forged_image_or_embedding_that_claims_more_than_it_has_is_refused() {
        let image = |width| Image { width, height: 3, channels: 1, data: vec![0.5; 12] };
        assert!(
            again(&image(4)).is_some() && again(&image(5)).is_none() && again(&image(usize::MAX)).is_none()
        );
        let embedding = |channels| Embedding { width: 2, height: 2, channels, data: vec![0.5; 12] };
        assert!(again(&embedding(3)).is_some() && again(&embedding(4)).is_none());
    }
}
