//! The checksum of OpenIGTLink bodies.

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

/// CRC-64 of `bytes` as OpenIGTLink uses it: ECMA-182 polynomial, not reflected, zero at the start
/// and no final inversion.
pub fn crc64(bytes: &[u8]) -> u64 {
    bytes.iter().fold(0, |crc, byte| (crc << 8) ^ TABLE[usize::from((crc >> 56) as u8 ^ byte)])
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_check_value_of_the_catalogue() {
        // CRC-64/ECMA-182 in the RevEng catalogue of parametrised CRC algorithms.
        assert_eq!(crc64(b"123456789"), 0x6C40_DF5F_0B49_7347);
    }
}
