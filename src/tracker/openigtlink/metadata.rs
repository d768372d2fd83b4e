//! The extended header and metadata of version 2 bodies.
//!
//! A version 2 body is: extended header (size, metadata index size, metadata text size, message
//! id), content, metadata index (count, then key size, encoding and value size of each entry),
//! metadata text (each key followed by its value).

use super::header::printable;

/// Bytes of the extended header, as all known senders write it. A longer one is allowed.
const EXTENDED_HEADER_LEN: usize = 12;
const ENTRY_LEN: usize = 8;

/// A body without content and metadata: the extended header, and an index of no entries.
pub(super) const WITHOUT_CONTENT: [u8; 14] = [0, 12, 0, 2, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0];

/// Key and value pairs.
type Metadata = Vec<(String, String)>;

/// Splits a version 2 body into content and metadata, and checks every size that it states.
pub(super) fn split(body: &[u8]) -> Result<(&[u8], Metadata), String> {
    let Some(&[s0, s1, i0, i1, t0, t1, t2, t3, _, _, _, _]) = body.first_chunk() else {
        let len = body.len();
        return Err(format!(
            "a version 2 body of {len} bytes; its extended header alone has {EXTENDED_HEADER_LEN}"
        ));
    };
    let size = usize::from(u16::from_be_bytes([s0, s1]));
    let index_len = usize::from(u16::from_be_bytes([i0, i1]));
    let text_len = u32::from_be_bytes([t0, t1, t2, t3]) as usize;
    let len = body.len();
    if !(EXTENDED_HEADER_LEN..=len).contains(&size) {
        return Err(format!(
            "extended header of {size} bytes (expected {EXTENDED_HEADER_LEN}, at most the body's {len})"
        ));
    }
    let after_header = &body[size..];
    let metadata_len = index_len.saturating_add(text_len);
    let content_len = after_header.len().checked_sub(metadata_len).ok_or_else(|| {
        let available = after_header.len();
        format!("{metadata_len} bytes of metadata, but {available} follow the extended header")
    })?;
    let (content, metadata) = after_header.split_at(content_len);
    let (index, text) = metadata.split_at(index_len);
    Ok((content, entries(index, text)?))
}

/// The key and value pairs of a metadata index and its text.
fn entries(index: &[u8], mut text: &[u8]) -> Result<Metadata, String> {
    let Some((count, index)) = index.split_first_chunk() else {
        return Ok(Vec::new()); // No count, so no metadata; a lone byte is ignored.
    };
    let count = usize::from(u16::from_be_bytes(*count));
    let sizes = index.as_chunks::<ENTRY_LEN>().0.get(..count).ok_or_else(|| {
        format!("{count} metadata entries in an index of {} bytes", index.len() + 2)
    })?;
    let text_len = text.len();
    let mut take = |len: usize| {
        let (head, rest) = text.split_at_checked(len)?;
        text = rest;
        Some(printable(head))
    };
    sizes
        .iter()
        .enumerate()
        .map(|(n, &[k0, k1, _, _, v0, v1, v2, v3])| {
            // The value's character set is ignored: UTF-8 includes ASCII, and other sets only lose
            // their accents.
            let mut entry = || {
                let key = take(usize::from(u16::from_be_bytes([k0, k1])))?;
                Some((key, take(u32::from_be_bytes([v0, v1, v2, v3]) as usize)?))
            };
            entry().ok_or_else(|| {
                format!("metadata entry {n} goes beyond the {text_len} bytes of metadata text")
            })
        })
        .collect()
}

#[cfg(test)]
mod tests {
    use super::super::header::TEXT_MAX;
    use super::*;
    use proptest::prelude::*;

    proptest! {
        #[test]
        fn any_bytes_are_split_or_refused(body in prop::collection::vec(any::<u8>(), 0..80)) {
            if let Ok((content, _)) = split(&body) {
                prop_assert!(content.len() <= body.len() - EXTENDED_HEADER_LEN);
            }
        }
    }

    #[test]
    fn a_longer_extended_header_is_skipped() {
        let body = [&[0, 14, 0, 0, 0, 0, 0, 0, 0, 0, 0, 7, 0xAA, 0xBB][..], b"content"].concat();
        assert_eq!(split(&body).expect("well formed"), (&b"content"[..], Vec::new()));
    }

    #[test]
    fn a_long_value_is_cut() {
        let value_len = 100_000_u32;
        let index = [&[0, 1, 0, 1, 0, 3][..], &value_len.to_be_bytes()].concat();
        let text_len = value_len + 1;
        let extended = [&[0, 12, 0, 10][..], &text_len.to_be_bytes(), &[0; 4]].concat();
        let body = [extended, index, vec![b'k'; text_len as usize]].concat();
        let (_, metadata) = split(&body).expect("well formed");
        let value = format!("{}…", "k".repeat(TEXT_MAX - 1));
        assert_eq!(metadata, [("k".to_owned(), value)]);
    }

    #[test]
    fn sizes_that_go_beyond_the_body_are_refused_with_numbers() {
        let extended = |size: u8, index: u8, text: u32| {
            let mut body = vec![0, size, 0, index];
            body.extend_from_slice(&text.to_be_bytes());
            body.extend_from_slice(&[0; 4]);
            body
        };
        let problem = |body: &[u8]| split(body).err().unwrap_or_default();
        assert_eq!(
            problem(&[0; 11]),
            "a version 2 body of 11 bytes; its extended header alone has 12"
        );
        for size in [11, 13] {
            assert_eq!(
                problem(&extended(size, 0, 0)),
                format!("extended header of {size} bytes (expected 12, at most the body's 12)")
            );
        }
        let too_much = u64::from(u32::MAX) + 2;
        assert_eq!(
            problem(&extended(12, 2, u32::MAX)),
            format!("{too_much} bytes of metadata, but 0 follow the extended header")
        );
        let count_too_large = [&extended(12, 2, 0)[..], &[0, 1]].concat();
        assert_eq!(problem(&count_too_large), "1 metadata entries in an index of 2 bytes");
        let value_too_long = [&extended(12, 10, 1)[..], &[0, 1, 0, 1, 0, 3, 0, 0, 0, 1, b'k']];
        assert_eq!(
            problem(&value_too_long.concat()),
            "metadata entry 0 goes beyond the 1 bytes of metadata text"
        );
    }
}
