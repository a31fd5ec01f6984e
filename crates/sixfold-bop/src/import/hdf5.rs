//! Datasets of an HDF5 file as h5py writes them by default: superblock 0, one group with a symbol table, contiguous or compact
//! datasets of integers, floating-point numbers or booleans.
//!
//! NOL's scripts write this form, and only this form is read: chunks, compression, nested groups and the newer file format
//! (`libver="latest"`) are refused with a message. Layout: HDF5 File Format Specification 1.1 (The HDF Group), whose sections are
//! named below. Nothing is read outside the file, and no loop is longer than the file.

use std::collections::BTreeMap;

/// Why a file cannot be read, and where.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Hdf5Error {
    /// The dataset, or a part of the file.
    pub field: String,
    pub found: String,
    pub expected: &'static str,
}

type Result<T> = std::result::Result<T, Hdf5Error>;

const SIGNATURE: &[u8] = b"\x89HDF\r\n\x1a\n";
const CHUNKS: &str =
    "a dataset without chunks or compression: write it again with create_dataset(name, data=...) alone";
const OLD: &str = "a file of h5py's default version (superblock 0): write it again without libver";
/// Longest name of a dataset, bytes.
const MAX_NAME: usize = 256;
/// Messages of an object header (section IV.A.2).
const DATASPACE: u16 = 0x01;
const DATATYPE: u16 = 0x03;
const LAYOUT: u16 = 0x08;
const CONTINUATION: u16 = 0x10;
const SYMBOL_TABLE: u16 = 0x11;

/// A file whose datasets are listed.
pub(super) struct Hdf5File<'a> {
    bytes: &'a [u8],
    /// Addresses of object headers by name.
    datasets: BTreeMap<String, u64>,
}

/// A dataset: its shape, and its elements as numbers, row by row.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Dataset {
    pub shape: Vec<usize>,
    pub values: Vec<f64>,
    /// Whether the elements are integers or booleans.
    pub whole: bool,
}

/// The type of the elements.
#[derive(Debug, Clone, Copy, PartialEq)]
struct Element {
    float: bool,
    signed: bool,
    big_endian: bool,
    size: usize,
}

fn wrong<T>(field: &str, found: impl Into<String>, expected: &'static str) -> Result<T> {
    Err(Hdf5Error { field: field.to_owned(), found: found.into(), expected })
}

/// `length` bytes of the file from `start`; an error where the file is shorter.
fn at<'a>(bytes: &'a [u8], field: &str, start: u64, length: u64) -> Result<&'a [u8]> {
    let end = start.checked_add(length).filter(|end| *end <= bytes.len() as u64);
    let Some(end) = end else {
        let found = format!("{length} bytes at {start} of a file of {}", bytes.len());
        return wrong(field, found, "bytes within the file; it may be cut off: get it again");
    };
    Ok(&bytes[start as usize..end as usize])
}

/// The unsigned number of `size` bytes at `start`.
fn number(bytes: &[u8], field: &str, start: u64, size: u64) -> Result<u64> {
    Ok(at(bytes, field, start, size)?
        .iter()
        .rev()
        .fold(0u64, |number, byte| (number << 8) | u64::from(*byte)))
}

impl<'a> Hdf5File<'a> {
    /// Lists the datasets of the file's root.
    pub(super) fn parse(bytes: &'a [u8]) -> Result<Hdf5File<'a>> {
        if !bytes.starts_with(SIGNATURE) {
            return wrong("(start)", "another signature", "an HDF5 file");
        }
        let head = at(bytes, "superblock", 0, 96)?;
        if head[8] != 0 || head[13] != 8 || head[14] != 8 {
            return wrong(
                "superblock",
                format!("version {}, sizes {} and {}", head[8], head[13], head[14]),
                OLD,
            );
        }
        let mut file = Hdf5File { bytes, datasets: BTreeMap::new() };
        // Section II.A: the root's symbol table entry begins at byte 56, its object header's address at 64.
        let root = number(bytes, "superblock", 64, 8)?;
        let messages = file.messages("root", root)?;
        let Some(table) = messages.iter().find(|m| m.0 == SYMBOL_TABLE) else {
            return wrong("root", "a group without a symbol table", OLD);
        };
        let (tree, heap) = (number(table.1, "root", 0, 8)?, number(table.1, "root", 8, 8)?);
        // Section III.D: the local heap's data segment.
        if at(bytes, "heap", heap, 32)?.get(..4) != Some(&b"HEAP"[..]) {
            return wrong("heap", "another signature", "HEAP");
        }
        let names = (number(bytes, "heap", heap + 24, 8)?, number(bytes, "heap", heap + 8, 8)?);
        let mut budget = bytes.len();
        file.tree(tree, names, &mut budget)?;
        Ok(file)
    }

    /// The datasets of a B-tree of version 1 (section III.A.1); `budget`: bytes that its nodes may still take.
    fn tree(&mut self, node: u64, names: (u64, u64), budget: &mut usize) -> Result<()> {
        let mut open = vec![node];
        while let Some(node) = open.pop() {
            if *budget < 24 {
                return wrong("B-tree", "a loop", "a tree");
            }
            *budget -= 24;
            match at(self.bytes, "B-tree", node, 8)? {
                [b'T', b'R', b'E', b'E', 0, ..] => {
                    let used = number(self.bytes, "B-tree", node + 6, 2)?;
                    for entry in (0..used).rev() {
                        // Signature to right sibling: 24 bytes; then keys and children alternate.
                        open.push(number(self.bytes, "B-tree", node + 24 + 16 * entry + 8, 8)?);
                        *budget = budget.saturating_sub(16);
                    }
                }
                [b'S', b'N', b'O', b'D', 1, ..] => {
                    *budget = budget.saturating_sub(40 * self.symbols(node, names)?);
                }
                _ => return wrong("B-tree", "another signature", "TREE or SNOD"),
            }
        }
        Ok(())
    }

    /// The datasets of a symbol table node (section III.B), and how many there are.
    fn symbols(&mut self, node: u64, (segment, size): (u64, u64)) -> Result<usize> {
        let count = number(self.bytes, "symbols", node + 6, 2)?;
        for entry in 0..count {
            let start = node + 8 + 40 * entry;
            let offset = number(self.bytes, "symbols", start, 8)?;
            let address = number(self.bytes, "symbols", start + 8, 8)?;
            let names = at(self.bytes, "names", segment, size)?;
            let rest =
                usize::try_from(offset).ok().and_then(|offset| names.get(offset..)).unwrap_or_default();
            let Some(end) = rest.iter().take(MAX_NAME).position(|byte| *byte == 0) else {
                return wrong("names", format!("offset {offset} in {size} bytes"), "a name that ends");
            };
            self.datasets.insert(String::from_utf8_lossy(&rest[..end]).into_owned(), address);
        }
        Ok(count as usize)
    }

    /// The messages of an object header of version 1 (section IV.A.1.a), with those of its continuations.
    fn messages(&self, field: &str, header: u64) -> Result<Vec<(u16, &'a [u8])>> {
        let version = number(self.bytes, field, header, 1)?;
        if version != 1 {
            return wrong(field, format!("an object header of version {version}"), OLD);
        }
        let size = number(self.bytes, field, header + 8, 4)?;
        let mut blocks = vec![(header + 16, size)];
        let mut messages = vec![];
        // Each block is part of the file: if the blocks take more bytes than the file has, there is a loop.
        let mut budget = self.bytes.len() as u64;
        while let Some((start, length)) = blocks.pop() {
            at(self.bytes, field, start, length)?;
            if length >= budget {
                return wrong(field, "more messages than the file can hold", "an object header");
            }
            budget -= length.max(1);
            let mut from = start;
            while from + 8 <= start + length {
                let kind = number(self.bytes, field, from, 2)? as u16;
                let size = number(self.bytes, field, from + 2, 2)?;
                let data = at(self.bytes, field, from + 8, size)?;
                if kind == CONTINUATION {
                    blocks.push((number(data, field, 0, 8)?, number(data, field, 8, 8)?));
                }
                messages.push((kind, data));
                from += 8 + size;
            }
        }
        Ok(messages)
    }

    /// Reads a dataset of the root.
    pub(super) fn dataset(&self, name: &str) -> Result<Dataset> {
        let Some(header) = self.datasets.get(name) else {
            let known: Vec<&str> = self.datasets.keys().map(String::as_str).take(20).collect();
            return wrong(name, format!("only {}", known.join(", ")), "a dataset of this name");
        };
        let messages = self.messages(name, *header)?;
        let message = |kind: u16| match messages.iter().find(|m| m.0 == kind) {
            Some((_, data)) => Ok(*data),
            None => wrong(name, format!("no message {kind:#x}"), "a dataset"),
        };
        let shape = shape(name, message(DATASPACE)?)?;
        let element = element(name, message(DATATYPE)?)?;
        let count = shape.iter().try_fold(1u64, |count, side| count.checked_mul(*side));
        let Some(length) = count.and_then(|count| count.checked_mul(element.size as u64)) else {
            return wrong(name, format!("a shape of {shape:?}"), "a dataset that fits a file");
        };
        let data = self.data(name, message(LAYOUT)?, length)?;
        let values = data.chunks_exact(element.size).map(|bytes| element.number(bytes)).collect();
        let shape = shape.iter().map(|side| *side as usize).collect();
        Ok(Dataset { shape, values, whole: !element.float })
    }

    /// The bytes that a layout message refers to (section IV.A.2.i).
    fn data(&self, name: &str, layout: &'a [u8], length: u64) -> Result<&'a [u8]> {
        match (number(layout, name, 0, 1)?, number(layout, name, 1, 1)?) {
            (3, 0) => {
                let size = number(layout, name, 2, 2)?;
                at(layout, name, 4, size.min(length))
            }
            (3, 1) => at(self.bytes, name, number(layout, name, 2, 8)?, length),
            (3, _) => wrong(name, "chunks", CHUNKS),
            (version, _) => wrong(name, format!("a layout of version {version}"), OLD),
        }
        .and_then(|data| {
            let whole = data.len() as u64 == length;
            if whole {
                Ok(data)
            } else {
                wrong(name, format!("{} bytes", data.len()), "as many as the shape has")
            }
        })
    }
}

/// The dimensions in a dataspace message (section IV.A.2.b).
fn shape(name: &str, message: &[u8]) -> Result<Vec<u64>> {
    let (version, rank) = (number(message, name, 0, 1)?, number(message, name, 1, 1)?);
    let first = match version {
        1 => 8,
        2 => 4,
        _ => return wrong(name, format!("a dataspace of version {version}"), OLD),
    };
    (0..rank).map(|axis| number(message, name, first + 8 * axis, 8)).collect()
}

/// The element type in a datatype message (section IV.A.2.d).
fn element(name: &str, message: &[u8]) -> Result<Element> {
    const KNOWN: &str = "integers, 32 or 64 bit floating-point numbers, or booleans";
    let class = number(message, name, 0, 1)? & 0x0f;
    let bits = number(message, name, 1, 3)?;
    let size = number(message, name, 4, 4)? as usize;
    let element = match class {
        0 if matches!(size, 1 | 2 | 4 | 8) => {
            Element { float: false, signed: bits & 8 != 0, big_endian: bits & 1 != 0, size }
        }
        1 => {
            // Widths of exponent and mantissa.
            let widths = (number(message, name, 13, 1)?, number(message, name, 15, 1)?);
            if !matches!((size, widths), (4, (8, 23)) | (8, (11, 52))) {
                return wrong(name, format!("floating-point numbers of {size} bytes"), KNOWN);
            }
            Element { float: true, signed: true, big_endian: bits & 1 != 0, size }
        }
        // h5py's booleans are an enumeration of bytes.
        8 if size == 1 => Element { float: false, signed: false, big_endian: false, size },
        _ => return wrong(name, format!("a datatype of class {class} with {size} bytes"), KNOWN),
    };
    Ok(element)
}

impl Element {
    fn number(self, element: &[u8]) -> f64 {
        let big = element.iter().fold(0u64, |bits, byte| (bits << 8) | u64::from(*byte));
        let unused = 64 - 8 * self.size;
        let bits = if self.big_endian { big } else { big.swap_bytes() >> unused };
        match (self.float, self.size) {
            (true, 8) => f64::from_bits(bits),
            (true, _) => f64::from(f32::from_bits(bits as u32)),
            (false, _) if self.signed => (((bits << unused) as i64) >> unused) as f64,
            (false, _) => bits as f64,
        }
    }
}
