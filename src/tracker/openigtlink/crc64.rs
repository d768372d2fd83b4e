//! The checksum of OpenIGTLink bodies.

/// CRC-64 as OpenIGTLink uses it: ECMA-182 polynomial, not reflected, zero at the start and no
/// final inversion. It can be fed in pieces.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Crc64(u64);

const POLYNOMIAL: u64 = 0x42F0_E1EB_A9EA_3693;

/// The checksum's change for each value of the leading byte.
static TABLE: [u64; 256] = table();

const fn table() -> [u64; 256] {
    let mut table = [0; 256];
    let mut byte = 0;
    while byte < 256 {
        let mut crc = (byte as u64) << 56;
        let mut bit = 0;
        while bit < 8 {
            crc = if crc >> 63 == 1 { (crc << 1) ^ POLYNOMIAL } else { crc << 1 };
            bit += 1;
        }
        table[byte] = crc;
        byte += 1;
    }
    table
}

impl Crc64 {
    /// The checksum of `bytes`.
    pub fn of(bytes: &[u8]) -> u64 {
        let mut crc = Crc64::default();
        crc.update(bytes);
        crc.value()
    }

    /// Takes in the next bytes.
    pub fn update(&mut self, bytes: &[u8]) {
        self.0 = bytes
            .iter()
            .fold(self.0, |crc, byte| (crc << 8) ^ TABLE[usize::from((crc >> 56) as u8 ^ byte)]);
    }

    /// The checksum of all bytes so far.
    pub fn value(self) -> u64 {
        self.0
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_check_value_of_the_catalogue() {
        // CRC-64/ECMA-182 in the RevEng catalogue of parametrised CRC algorithms.
        assert_eq!(Crc64::of(b"123456789"), 0x6C40_DF5F_0B49_7347);
    }

    #[test]
    fn pieces_give_what_the_whole_gives() {
        let bytes: Vec<u8> = (0..=255).collect();
        let mut crc = Crc64::default();
        for piece in bytes.chunks(7) {
            crc.update(piece);
        }
        assert_eq!(crc.value(), Crc64::of(&bytes));
    }
}
