//! Seeded mutations of valid input against everything that reads bytes from outside: no panic, bounded memory, and
//! no wrong data accepted.
//!
//! Each target gets a few thousand cases by default. For an hour with another seed:
//!
//! ```sh
//! NEEDLE_FUZZ_CASES=1000000000 NEEDLE_FUZZ_SEED=7 timeout 1h cargo test --test pure fuzz:: -- --test-threads=16
//! ```
//!
//! There must be as many threads as targets, or the last targets do not get their turn.
//!
//! A case that fails prints its bytes. Make a test of them beside the code.

mod canopen;
mod openigtlink;
mod whole_run;

use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg64;
use std::fmt::Write;

/// The mutations of one corpus of valid inputs.
pub(crate) struct Mutator<'a> {
    corpus: &'a [Vec<u8>],
    rng: Pcg64,
}

/// Edge values of lengths and counts.
const EDGES: [u64; 8] = [0, 1, 0x7F, 0xFF, 0x7FFF_FFFF, 0xFFFF_FFFF, 1 << 63, u64::MAX];

impl<'a> Mutator<'a> {
    pub(crate) fn new(corpus: &'a [Vec<u8>], seed: u64) -> Self {
        Mutator { corpus, rng: Pcg64::seed_from_u64(seed) }
    }

    /// A number under `end`, or 0 if `end` is 0.
    pub(crate) fn below(&mut self, end: usize) -> usize {
        if end == 0 { 0 } else { self.rng.random_range(0..end) }
    }

    /// An input of the corpus with a few mutations.
    pub(crate) fn mutated(&mut self) -> Vec<u8> {
        let which = self.below(self.corpus.len());
        let mut input = self.corpus.get(which).cloned().unwrap_or_default();
        for _ in 0..=self.below(4) {
            self.mutate(&mut input);
        }
        input
    }

    fn mutate(&mut self, input: &mut Vec<u8>) {
        let at = self.below(input.len());
        match self.below(7) {
            0 => {
                let bit = 1 << self.below(8);
                input.iter_mut().skip(at).take(1).for_each(|byte| *byte ^= bit);
            }
            1 => {
                let value: u8 = self.rng.random();
                input.iter_mut().skip(at).take(1).for_each(|byte| *byte = value);
            }
            // An edge value in 1, 2, 4 or 8 bytes, like a length.
            2 => {
                let edge = EDGES[self.below(EDGES.len())].to_be_bytes();
                let width = 1 << self.below(4);
                let low = edge.iter().skip(8 - width);
                input.iter_mut().skip(at).zip(low).for_each(|(byte, edge)| *byte = *edge);
            }
            3 => input.truncate(at),
            4 => {
                let end = at + self.below(input.len() - at);
                input.drain(at..end);
            }
            5 => {
                let end = at + self.below((input.len() - at).min(256));
                let again = input[at..end].to_vec();
                input.splice(at..at, again);
            }
            _ => {
                let other = self.below(self.corpus.len());
                let other = self.corpus.get(other).cloned().unwrap_or_default();
                let from = self.below(other.len());
                input.splice(at.., other.into_iter().skip(from));
            }
        }
    }
}

/// Calls `target` with the corpus and then with `NEEDLE_FUZZ_CASES` mutations of it, which `NEEDLE_FUZZ_SEED`
/// repeats. The target may draw from the mutator, and panics if it finds an error.
pub(crate) fn fuzz(corpus: &[Vec<u8>], mut target: impl FnMut(&[u8], &mut Mutator<'_>)) {
    let number = |name: &str, otherwise: u64| match std::env::var(name) {
        Ok(text) => text.parse().unwrap_or_else(|_| panic!("{name}={text} is not a number")),
        Err(_) => otherwise,
    };
    let cases = number("NEEDLE_FUZZ_CASES", 5000);
    let mut mutator = Mutator::new(corpus, number("NEEDLE_FUZZ_SEED", 1));
    for input in corpus {
        target(input, &mut mutator);
    }
    for _ in 0..cases {
        let input = PrintedOnPanic(mutator.mutated());
        target(&input.0, &mut mutator);
    }
}

/// An input that is printed when its case panics.
struct PrintedOnPanic(Vec<u8>);

impl Drop for PrintedOnPanic {
    fn drop(&mut self) {
        if std::thread::panicking() {
            let hex = self.0.iter().fold(String::new(), |mut hex, byte| {
                let _ = write!(hex, "{byte:02x}");
                hex
            });
            eprintln!("the failed case: {hex}");
        }
    }
}

#[test]
fn mutations_are_the_same_for_the_same_seed_and_differ_from_the_corpus() {
    let corpus = [b"a valid input".to_vec(), b"and another one".to_vec()];
    let draw = |seed| {
        let mut mutator = Mutator::new(&corpus, seed);
        (0..500).map(|_| mutator.mutated()).collect::<Vec<_>>()
    };
    assert_eq!(draw(1), draw(1));
    assert_ne!(draw(1), draw(2));
    assert!(draw(1).iter().filter(|input| !corpus.contains(input)).count() > 400);
}
