//! The entropy-coded bits of a JPEG, and the Huffman codes in them.

/// The data of a scan are not what an encoder writes.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum ScanFault {
    /// They end before the image does, where the file ends.
    Short,
    /// They end before the image does, at a marker, or hold a code or a number that cannot be.
    Broken,
}

/// Reads the bits of one scan; stops at markers.
pub(super) struct BitReader<'a> {
    bytes: &'a [u8],
    /// The next byte that is not in `held`.
    pub at: usize,
    /// The next bits, from the highest down.
    held: u64,
    /// How many bits are held, and how many of them are made up, for nothing is left.
    count: u32,
    made_up: u32,
}

impl<'a> BitReader<'a> {
    pub fn new(bytes: &'a [u8], at: usize) -> BitReader<'a> {
        BitReader { bytes, at, held: 0, count: 0, made_up: 0 }
    }

    #[inline]
    fn fill(&mut self) {
        while self.count <= 56 {
            let byte = match (self.bytes.get(self.at), self.bytes.get(self.at + 1)) {
                (Some(0xff), Some(0)) => {
                    self.at += 2;
                    0xff
                }
                (Some(0xff), Some(0xff)) => {
                    self.at += 1;
                    continue;
                }
                (Some(0xff), _) | (None, _) => {
                    self.made_up += 8;
                    0
                }
                (Some(&byte), _) => {
                    self.at += 1;
                    byte
                }
            };
            self.held |= u64::from(byte) << (56 - self.count);
            self.count += 8;
        }
    }

    /// The fault, where more bits were used than there are.
    #[inline]
    pub fn check(&self) -> Result<(), ScanFault> {
        if self.count >= self.made_up {
            return Ok(());
        }
        Err(if self.at + 1 >= self.bytes.len() { ScanFault::Short } else { ScanFault::Broken })
    }

    /// The next `n` bits, at most 16.
    #[inline]
    pub fn take(&mut self, n: u32) -> u32 {
        if n == 0 {
            return 0;
        }
        if self.count < n {
            self.fill();
        }
        let value = (self.held >> (64 - n)) as u32;
        self.held <<= n;
        self.count -= n;
        value
    }

    /// A number of `n` bits with its sign, as JPEG writes them.
    #[inline]
    pub fn signed(&mut self, n: u32) -> i32 {
        let value = self.take(n) as i32;
        if n > 0 && value < 1 << (n - 1) { value - (1 << n) + 1 } else { value }
    }

    /// Goes on after a restart marker, which must be the one of this number.
    pub fn restart(&mut self, number: u32) -> Result<(), ScanFault> {
        self.check()?;
        let left = self.leave();
        let here = (self.bytes.get(self.at), self.bytes.get(self.at + 1));
        let expected = 0xd0 + (number % 8) as u8;
        match here {
            (Some(0xff), Some(&marker)) if marker == expected && left == 0 => {
                *self = BitReader::new(self.bytes, self.at + 2);
                Ok(())
            }
            (None, _) | (_, None) => Err(ScanFault::Short),
            _ => Err(ScanFault::Broken),
        }
    }

    /// Whole bytes between here and the next marker; goes there.
    pub fn leave(&mut self) -> usize {
        let mut left = (self.count.saturating_sub(self.made_up) / 8) as usize;
        loop {
            match (self.bytes.get(self.at), self.bytes.get(self.at + 1)) {
                (Some(0xff), Some(0)) => self.at += 2,
                (Some(0xff), Some(0xff)) => {
                    self.at += 1;
                    continue;
                }
                (Some(0xff), _) | (None, _) => return left,
                _ => self.at += 1,
            }
            left += 1;
        }
    }
}

/// Bits that are looked up at once.
const FAST: u32 = 9;

/// A Huffman table.
#[derive(Clone)]
pub(super) struct HuffmanTable {
    /// By the next [`FAST`] bits: length and symbol of the code they begin with; length 0 where it is longer.
    fast: Vec<(u8, u8)>,
    /// Per length: the first code that is longer, moved up to 16 bits; and what to add to a code for its symbol's index.
    limit: [u32; 18],
    shift: [i32; 17],
    symbols: Vec<u8>,
}

impl HuffmanTable {
    /// From the counts of codes per length and the symbols in order.
    pub fn new(counts: &[u8; 16], symbols: &[u8]) -> Option<HuffmanTable> {
        let mut table = HuffmanTable {
            fast: vec![(0, 0); 1 << FAST],
            limit: [0; 18],
            shift: [0; 17],
            symbols: symbols.to_vec(),
        };
        let (mut code, mut index) = (0u32, 0usize);
        for length in 1..=16u32 {
            let count = usize::from(counts[length as usize - 1]);
            table.shift[length as usize] = index as i32 - code as i32;
            for k in 0..count {
                let symbol = *symbols.get(index + k)?;
                if length <= FAST {
                    let first = ((code + k as u32) << (FAST - length)) as usize;
                    let entries = table.fast.get_mut(first..first + (1 << (FAST - length)))?;
                    entries.fill((length as u8, symbol));
                }
            }
            (code, index) = (code + count as u32, index + count);
            if code > 1 << length {
                return None;
            }
            table.limit[length as usize] = code << (16 - length);
            code <<= 1;
        }
        table.limit[17] = u32::MAX;
        Some(table)
    }

    /// The next symbol.
    #[inline]
    pub fn next(&self, bits: &mut BitReader) -> Result<u8, ScanFault> {
        if bits.count < 16 {
            bits.fill();
        }
        let (length, symbol) = self.fast[(bits.held >> (64 - FAST)) as usize];
        if length > 0 {
            bits.held <<= length;
            bits.count -= u32::from(length);
            return Ok(symbol);
        }
        let ahead = (bits.held >> 48) as u32;
        let length = (FAST + 1..=17).find(|&l| ahead < self.limit[l as usize]).unwrap_or(17);
        if length > 16 {
            // Made-up bits are no code either.
            return bits.check().and(Err(ScanFault::Broken));
        }
        let code = bits.take(length) as i32;
        let symbol = self.symbols.get((code + self.shift[length as usize]) as usize);
        symbol.copied().ok_or(ScanFault::Broken)
    }
}
