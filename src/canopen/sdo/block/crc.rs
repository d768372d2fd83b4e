//! The CRC of block transfer (CiA 301, 7.2.4.3): x¹⁶ + x¹² + x⁵ + 1, from 0, most significant bit
//! first, nothing inverted; elsewhere CRC-16/XMODEM.

/// The CRC of `data`.
pub fn crc16(data: &[u8]) -> u16 {
    data.iter().fold(0, |crc, &byte| {
        (0..8).fold(crc ^ u16::from(byte) << 8, |crc, _| {
            let out = crc & 0x8000 != 0;
            crc << 1 ^ if out { 0x1021 } else { 0 }
        })
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The check value of CRC catalogues, and the sums in python-canopen's tests.
    #[test]
    fn known_sums() {
        assert_eq!(crc16(b"123456789"), 0x31c3);
        assert_eq!(crc16(b""), 0);
        assert_eq!(crc16(b"Tiny Node - Mega Domains !"), 0xe140);
        assert_eq!(crc16(b"A really really long string..."), 0x6945);
    }
}
