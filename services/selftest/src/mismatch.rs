//! How results of a device differ from those of the host.

/// How results of a device differ from those of the host by more than rounding.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum Mismatch {
    /// An array has another length.
    #[error("{what}: {got} numbers, not {wanted}")]
    Length {
        /// The array.
        what: String,
        /// Its length.
        got: usize,
        /// The length of the host's.
        wanted: usize,
    },
    /// A number is off.
    #[error("{what}: number {index} is {got} where {wanted} is right")]
    Number {
        /// The array.
        what: String,
        /// Which number of it.
        index: usize,
        /// The device's.
        got: f32,
        /// The host's.
        wanted: f32,
    },
    /// An integer is another one.
    #[error("{what}: number {index} is {got} where {wanted} is right")]
    Integer {
        /// The array.
        what: String,
        /// Which number of it.
        index: usize,
        /// The device's.
        got: u32,
        /// The host's.
        wanted: u32,
    },
    /// More numbers are off than the tolerance allows to lie on the other side of a cut-off.
    #[error("{what}: {off} of {length} are off, the worst by {worst}")]
    Share {
        /// The array.
        what: String,
        /// How many of its numbers are off.
        off: usize,
        /// Its length.
        length: usize,
        /// The largest error, in units of the number's size plus the array's root mean square.
        worst: f32,
    },
    /// These splats are culled by one engine and not by the other.
    #[error("culled by one engine only: {0:?}")]
    Culled(Vec<usize>),
    /// A list of a view is wrong.
    #[error(transparent)]
    List(#[from] ListMismatch),
    /// Rows that were uploaded are not there.
    #[error("nothing was kept")]
    NotResident,
    /// An upload has changed the splats.
    #[error("shapes and sums: they changed on the device")]
    Changed,
    /// After density control some splats have the numbers of others.
    #[error("{splats} splats, reshaped: the numbers of some are another's")]
    Reshaped {
        /// Splats before.
        splats: usize,
    },
    /// A difference in one of several test cases.
    #[error("{case}: {mismatch}")]
    Case {
        /// Name of the test case.
        case: &'static str,
        /// The difference.
        mismatch: Box<Mismatch>,
    },
}

impl Mismatch {
    /// The same difference, with the name of its test case.
    pub(crate) fn of_case(self, case: &'static str) -> Mismatch {
        Mismatch::Case { case, mismatch: Box::new(self) }
    }
}

/// What is wrong with the lists that a view keeps on the device: its splats, the entries of its tiles, its buckets.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum ListMismatch {
    /// A splat has another opacity at a pixel than it has when it is rendered alone.
    #[error("splat {splat} covers pixel {pixel} by {got} where {wanted} is right")]
    Opacity {
        /// The splat.
        splat: usize,
        /// The pixel, row by row.
        pixel: usize,
        /// By the device's list.
        got: f32,
        /// By the host's render.
        wanted: f32,
    },
    /// A tile has entries that there are not.
    #[error("tile {tile} has entries {from} to {to} of {entries}")]
    Entries {
        /// The tile.
        tile: usize,
        /// Its first entry.
        from: u32,
        /// The entry after its last one.
        to: u32,
        /// Entries of all tiles.
        entries: usize,
    },
    /// A tile has a splat that there is not.
    #[error("tile {tile} has splat {splat} of {splats}")]
    NoSplat {
        /// The tile.
        tile: usize,
        /// The splat.
        splat: usize,
        /// Splats of the scene.
        splats: usize,
    },
    /// The splats of a tile are not sorted by depth.
    #[error("tile {tile} has splat {first} before the nearer {nearer}")]
    Order {
        /// The tile.
        tile: usize,
        /// The splat that comes first.
        first: usize,
        /// The splat that should.
        nearer: usize,
    },
    /// A tile has a splat twice, or lacks one that reaches it.
    #[error("tile {tile} has splat {splat} {times} times where once is right")]
    Times {
        /// The tile.
        tile: usize,
        /// The splat.
        splat: usize,
        /// How often it is in the list.
        times: usize,
    },
    /// The buckets of a tile start elsewhere.
    #[error("tile {tile} has bucket {first} first where {wanted} is right")]
    FirstBucket {
        /// The tile.
        tile: usize,
        /// Its first bucket by the device's list.
        first: u32,
        /// Its first bucket.
        wanted: usize,
    },
    /// A tile has an entry after the last one.
    #[error("tile {tile} ends at entry {to} of {entries}")]
    End {
        /// The tile.
        tile: usize,
        /// The entry after its last one.
        to: u32,
        /// Entries of all tiles.
        entries: usize,
    },
    /// A bucket is another one: tile, first entry, entries, 0.
    #[error("bucket {bucket} is {got:?} where {wanted:?} is right")]
    Bucket {
        /// Which.
        bucket: usize,
        /// The device's.
        got: [u32; 4],
        /// What it should be.
        wanted: [u32; 4],
    },
    /// There are too few buckets.
    #[error("{0} buckets are missing")]
    Buckets(usize),
}
