//! Mutations: a seed of the format with a few bytes, numbers or parts changed.

use rand::RngExt;
use rand_chacha::ChaCha8Rng;

/// Numbers that are difficult for parsers.
const NUMBERS: [&str; 14] = [
    "0",
    "-1",
    "1e308",
    "-1e309",
    "1e-320",
    "nan",
    "inf",
    "4294967296",
    "9223372036854775808",
    "99999999999999999999",
    "0.0000001",
    "",
    "null",
    "[]",
];
/// The same for counts and offsets of binary files.
const WORDS: [u32; 7] = [0, 1, 0x7f, 0xffff, 0x7fff_ffff, 0x8000_0000, 0xffff_ffff];
/// An input grows by at most this many bytes.
const GROWTH: usize = 4096;

/// One of the seeds with one to six mutations.
pub fn mutated(seeds: &[Vec<u8>], random: &mut ChaCha8Rng) -> Vec<u8> {
    let pick = |random: &mut ChaCha8Rng| match seeds.len() {
        0 => Vec::new(),
        count => seeds[random.random_range(0..count)].clone(),
    };
    let mut bytes = pick(random);
    let limit = bytes.len() + GROWTH;
    for _ in 0..random.random_range(1..=6) {
        match random.random_range(0..9u32) {
            0 => change_bit(&mut bytes, random),
            1 => change_byte(&mut bytes, random),
            2 => insert(&mut bytes, random),
            3 => remove(&mut bytes, random),
            4 => repeat(&mut bytes, random),
            5 => splice(&mut bytes, &pick(random), random),
            6 => change_word(&mut bytes, random),
            7 => change_number(&mut bytes, random),
            _ => truncate(&mut bytes, random),
        }
    }
    bytes.truncate(limit);
    bytes
}

/// The bytes with the last eight replaced by the FNV-1a sum of those before, as our binary files end, so that a mutation
/// passes the check and reaches the reader.
pub fn with_checksum(mut bytes: Vec<u8>) -> Vec<u8> {
    let Some(end) = bytes.len().checked_sub(8) else { return bytes };
    let sum = sixfold_io::fnv1a(&bytes[..end]);
    bytes[end..].copy_from_slice(&sum.to_le_bytes());
    bytes
}

/// The bytes with the right checksum after every chunk of a PNG: the same for images.
pub(crate) fn with_png_checksums(mut bytes: Vec<u8>) -> Vec<u8> {
    let mut at = 8;
    while let Some(head) = bytes.get(at..at + 4) {
        let length = u32::from_be_bytes([head[0], head[1], head[2], head[3]]) as usize;
        let end = at + 8 + length;
        let Some(content) = bytes.get(at + 4..end) else { break };
        let sum = !content.iter().fold(!0u32, |sum, b| {
            (0..8).fold(sum ^ u32::from(*b), |c, _| if c & 1 == 1 { 0xedb8_8320 ^ (c >> 1) } else { c >> 1 })
        });
        if let Some(place) = bytes.get_mut(end..end + 4) {
            place.copy_from_slice(&sum.to_be_bytes());
        }
        at = end + 4;
    }
    bytes
}

/// A random range of the bytes; empty if there are none.
fn part(bytes: &[u8], longest: usize, random: &mut ChaCha8Rng) -> std::ops::Range<usize> {
    if bytes.is_empty() {
        return 0..0;
    }
    let start = random.random_range(0..bytes.len());
    let end = (start + random.random_range(1..=longest)).min(bytes.len());
    start..end
}

fn change_bit(bytes: &mut [u8], random: &mut ChaCha8Rng) {
    if !bytes.is_empty() {
        bytes[random.random_range(0..bytes.len())] ^= 1 << random.random_range(0..8u32);
    }
}

fn change_byte(bytes: &mut [u8], random: &mut ChaCha8Rng) {
    const TOKENS: &[u8] = b"\0\x01\x7f\x80\xff \n\t,-+.eE0179[]{}\":/#\\";
    if !bytes.is_empty() {
        bytes[random.random_range(0..bytes.len())] = TOKENS[random.random_range(0..TOKENS.len())];
    }
}

fn insert(bytes: &mut Vec<u8>, random: &mut ChaCha8Rng) {
    let at = random.random_range(0..=bytes.len());
    let new: Vec<u8> = (0..random.random_range(1..=16)).map(|_| random.random_range(0..=255u8)).collect();
    bytes.splice(at..at, new);
}

fn remove(bytes: &mut Vec<u8>, random: &mut ChaCha8Rng) {
    bytes.drain(part(bytes, 64, random));
}

fn repeat(bytes: &mut Vec<u8>, random: &mut ChaCha8Rng) {
    let copied = bytes[part(bytes, 64, random)].to_vec();
    let at = random.random_range(0..=bytes.len());
    for _ in 0..random.random_range(1..=8) {
        bytes.splice(at..at, copied.iter().copied());
    }
}

fn splice(bytes: &mut Vec<u8>, other: &[u8], random: &mut ChaCha8Rng) {
    let at = random.random_range(0..=bytes.len());
    bytes.splice(at..at, other[part(other, 256, random)].iter().copied());
}

fn change_word(bytes: &mut [u8], random: &mut ChaCha8Rng) {
    if let Some(last) = bytes.len().checked_sub(4) {
        let at = random.random_range(0..=last);
        let word = WORDS[random.random_range(0..WORDS.len())];
        bytes[at..at + 4].copy_from_slice(&word.to_le_bytes());
    }
}

/// Replaces the number at, or next after, a random position of a text.
fn change_number(bytes: &mut Vec<u8>, random: &mut ChaCha8Rng) {
    let of_number = |b: &u8| b.is_ascii_digit() || matches!(b, b'.' | b'-' | b'+' | b'e' | b'E');
    let from = part(bytes, 1, random).start;
    let Some(start) = bytes[from..].iter().position(|b| b.is_ascii_digit()).map(|k| from + k) else { return };
    let end = bytes[start..].iter().position(|b| !of_number(b)).map_or(bytes.len(), |k| start + k);
    let number = NUMBERS[random.random_range(0..NUMBERS.len())];
    bytes.splice(start..end, number.bytes());
}

fn truncate(bytes: &mut Vec<u8>, random: &mut ChaCha8Rng) {
    bytes.truncate(random.random_range(0..=bytes.len()));
}

#[cfg(test)]
mod tests {
    use super::*;
    use rand::SeedableRng;

    #[test]
    fn the_same_seed_gives_the_same_inputs_and_any_seed_file_will_do() {
        for seeds in [vec![], vec![vec![]], vec![b"{\"a\": 12.5}".to_vec(), vec![0; 300]]] {
            let inputs = |seed| {
                let mut random = ChaCha8Rng::seed_from_u64(seed);
                (0..200).map(|_| mutated(&seeds, &mut random)).collect::<Vec<_>>()
            };
            assert_eq!(inputs(7), inputs(7));
            assert!(inputs(7).iter().all(|i| i.len() <= 300 + GROWTH));
        }
    }
}
