//! The checksum of OpenIGTLink bodies.

use std::sync::LazyLock;

const POLYNOMIAL: u64 = 0x42F0_E1EB_A9EA_3693;

/// The checksum's change for each value of the leading byte.
static TABLE: LazyLock<[u64; 256]> = LazyLock::new(|| {
    std::array::from_fn(|byte| {
        (0..8).fold((byte as u64) << 56, |crc, _| match crc >> 63 {
            1 => (crc << 1) ^ POLYNOMIAL,
            _ => crc << 1,
        })
    })
});

/// CRC-64 of `bytes` as OpenIGTLink uses it: ECMA-182 polynomial, not reflected, zero at the start
/// and no final inversion.
pub fn crc64(bytes: &[u8]) -> u64 {
    let table = &*TABLE;
    bytes.iter().fold(0, |crc, byte| (crc << 8) ^ table[usize::from((crc >> 56) as u8 ^ byte)])
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
