//! Families of network files: names, licences, and stems of file names.

/// Where a network comes from.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Family {
    /// Segment Anything (Kirillov et al. 2023).
    Sam,
    /// MobileSAM (Zhang et al. 2023).
    MobileSam,
    /// EfficientSAM (Xiong et al. 2023).
    EfficientSam,
    /// SAM 2 and 2.1 (Ravi et al. 2024).
    Sam2,
    /// SAM 3 (Carion et al. 2025).
    Sam3,
    /// Learned boundaries.
    Edges,
    /// Sky as one probability.
    Sky,
    /// DeepLab over the classes of Cityscapes.
    Deeplab,
    /// CLIP (Radford et al. 2021) and models of the same interface.
    Clip,
}

impl Family {
    /// Its name.
    pub fn name(self) -> &'static str {
        match self {
            Family::Sam => "SAM",
            Family::MobileSam => "MobileSAM",
            Family::EfficientSam => "EfficientSAM",
            Family::Sam2 => "SAM 2",
            Family::Sam3 => "SAM 3",
            Family::Edges => "edge network",
            Family::Sky => "sky network",
            Family::Deeplab => "DeepLab over Cityscapes",
            Family::Clip => "CLIP",
        }
    }

    /// The terms, as far as they are known.
    pub fn licence(self) -> &'static str {
        match self {
            Family::Sam | Family::MobileSam | Family::EfficientSam | Family::Sam2 => {
                "Apache-2.0 (code and weights)"
            }
            Family::Sam3 => "SAM License (terms of its own, with limits of use)",
            Family::Edges => "research use (trained on BSDS500)",
            Family::Sky => "not stated: ask where the file came from",
            Family::Deeplab => "trained on Cityscapes, whose terms are non-commercial",
            Family::Clip => "that of the weights, as the page says where they came from",
        }
    }
}

/// Pairs of networks by the stem of their names, in the order of search: those that a CPU can run come first.
const PAIRS: [(&str, Family); 23] = [
    ("mobile_sam", Family::MobileSam),
    ("mobilesam", Family::MobileSam),
    ("efficient_sam_vitt", Family::EfficientSam),
    ("efficientsam_ti", Family::EfficientSam),
    ("efficient_sam_vits", Family::EfficientSam),
    ("efficientsam_s", Family::EfficientSam),
    ("sam2.1_hiera_tiny", Family::Sam2),
    ("sam2.1_tiny", Family::Sam2),
    ("sam2_hiera_tiny", Family::Sam2),
    ("sam2.1_hiera_small", Family::Sam2),
    ("sam2_hiera_small", Family::Sam2),
    ("sam2.1_hiera_base_plus", Family::Sam2),
    ("sam2_hiera_base_plus", Family::Sam2),
    ("sam_vit_b", Family::Sam),
    ("sam_vit_b_01ec64", Family::Sam),
    ("sam2.1_hiera_large", Family::Sam2),
    ("sam2_hiera_large", Family::Sam2),
    ("sam_vit_l", Family::Sam),
    ("sam_vit_l_0b3195", Family::Sam),
    ("sam_vit_h", Family::Sam),
    ("sam_vit_h_4b8939", Family::Sam),
    ("sam", Family::Sam),
    ("sam3", Family::Sam3),
];

/// Starts of stems whose families are known though the table has no such stem.
const STARTS: [(&str, Family); 7] = [
    ("mobile_sam", Family::MobileSam),
    ("efficient_sam", Family::EfficientSam),
    ("efficientsam", Family::EfficientSam),
    ("sam2", Family::Sam2),
    ("sam_2", Family::Sam2),
    ("sam3", Family::Sam3),
    ("sam_vit", Family::Sam),
];

/// Networks of one file each.
pub(crate) const EDGES: &str = "edges_bsds.onnx";
/// See [`EDGES`].
pub(crate) const SKY: &str = "sky_small_384.onnx";
/// See [`EDGES`].
pub(crate) const DEEPLAB: &str = "deeplab_cityscapes_513.onnx";
/// See [`EDGES`].
pub(crate) const SINGLE: [(&str, Family, &str); 3] =
    [(EDGES, Family::Edges, "boundaries"), (SKY, Family::Sky, "sky"), (DEEPLAB, Family::Deeplab, "sky")];

/// The family of a stem, going by its name.
pub(crate) fn family_of(stem: &str) -> Option<Family> {
    let exact = PAIRS.iter().find(|(known, _)| *known == stem);
    let starts = || STARTS.iter().find(|(start, _)| stem.starts_with(*start));
    exact.or_else(starts).map(|(_, family)| *family)
}

/// Whether a stem is one of a known family.
pub(crate) fn is_known(stem: &str) -> bool {
    family_of(stem).is_some()
}

/// The order of search: stems of the table, then others of a known family, SAM 3's last.
pub(crate) fn search_rank(stem: &str) -> usize {
    match PAIRS.iter().position(|(known, _)| *known == stem) {
        Some(k) => k,
        None => PAIRS.len() + usize::from(family_of(stem) == Some(Family::Sam3)),
    }
}
