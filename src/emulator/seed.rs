//! Random numbers that depend on a seed and a counter, not on the numbers drawn before.

/// Number `count` of the SplitMix64 sequence that starts at `seed`.
pub fn counted(seed: u64, count: u64) -> u64 {
    let z = seed.wrapping_add(count.wrapping_add(1).wrapping_mul(0x9E37_79B9_7F4A_7C15));
    let z = (z ^ (z >> 30)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
    let z = (z ^ (z >> 27)).wrapping_mul(0x94D0_49BB_1331_11EB);
    z ^ (z >> 31)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The first values of SplitMix64 from seed 1234567, as its reference gives them.
    #[test]
    fn is_splitmix64() {
        let values = [0, 1, 2].map(|count| counted(1_234_567, count));
        assert_eq!(
            values,
            [6_457_827_717_110_365_317, 3_203_168_211_198_807_973, 9_817_491_932_198_370_423]
        );
    }
}
