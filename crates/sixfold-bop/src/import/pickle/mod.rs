//! Python's pickles as data: dictionaries with text, numbers and numpy arrays, as HO3D's `meta/*.pkl` are.
//!
//! A pickle is a program that may call any function of Python. Here nothing is called: names of functions stay names. Only numpy's
//! constructors of arrays, types and scalars are interpreted; the result of any other function is an opaque value. Every step of
//! the program makes at most one value, values are shared and never copied: a file takes memory in proportion to its length.
//! Opcodes: CPython's `Lib/pickletools.py`, protocols 0 to 5; numpy's part: `ndarray.__reduce__` and `numpy.dtype.__reduce__`.

mod steps;

use std::cell::Cell;
use std::collections::BTreeMap;

use super::numpy::{Array, ElementType};

/// Why a pickle cannot be read, and where.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct PickleError {
    /// Byte of the file.
    pub at: usize,
    pub found: String,
    pub expected: &'static str,
}

type Result<T> = std::result::Result<T, PickleError>;

/// Limit on copied bytes, as a multiple of the pickle's length: arrays are copied from its bytes, usually once.
const COPIES: usize = 4;
/// Maximum number of dimensions of an array: numpy's limit.
const MAX_DIMENSIONS: usize = 64;

/// A value's index among all values that the pickle made.
type Id = usize;

#[derive(Debug, Clone)]
enum Node {
    Mark,
    None,
    Number(f64),
    Bytes(Vec<u8>),
    Text(String),
    List(Vec<Id>),
    Dict(Vec<(Id, Id)>),
    Name(String),
    /// `_reconstruct(ndarray, ...)` before its state arrives.
    EmptyArray,
    Type(ElementType),
    Array(Array),
    /// The result of an unknown function.
    Opaque,
}

/// A value of a dictionary.
#[derive(Debug, Clone, PartialEq)]
pub(super) enum Item<'a> {
    None,
    Number(f64),
    Text(&'a str),
    Array(&'a Array),
    Other(&'static str),
}

/// A pickle whose value is a dictionary.
#[derive(Debug)]
pub(super) struct PickledDict {
    nodes: Vec<Node>,
    entries: Vec<(Id, Id)>,
}

impl PickledDict {
    /// Reads a pickle.
    pub(super) fn parse(bytes: &[u8]) -> Result<PickledDict> {
        let mut machine = Machine {
            bytes,
            at: 0,
            op: 0,
            nodes: vec![],
            stack: vec![],
            memo: BTreeMap::new(),
            budget: Cell::new(COPIES * bytes.len() + 4096),
        };
        let root = machine.run()?;
        let Node::Dict(entries) = &machine.nodes[root] else {
            let found = machine.nodes[root].what().to_owned();
            return Err(PickleError { at: 0, found, expected: "a dictionary" });
        };
        Ok(PickledDict { entries: entries.clone(), nodes: machine.nodes })
    }

    /// The last value under a key; `None` where there is no such key.
    pub(super) fn get(&self, key: &str) -> Option<Item<'_>> {
        let named = |id: &Id| match &self.nodes[*id] {
            Node::Text(text) => text == key,
            // Strings of Python 2.
            Node::Bytes(bytes) => bytes == key.as_bytes(),
            _ => false,
        };
        let (_, value) = self.entries.iter().rev().find(|(name, _)| named(name))?;
        Some(match &self.nodes[*value] {
            Node::None => Item::None,
            Node::Number(number) => Item::Number(*number),
            Node::Text(text) => Item::Text(text),
            Node::Bytes(bytes) => std::str::from_utf8(bytes).map_or(Item::Other("bytes"), Item::Text),
            Node::Array(array) => Item::Array(array),
            other => Item::Other(other.what()),
        })
    }
}

impl Node {
    fn what(&self) -> &'static str {
        match self {
            Node::Mark => "a mark",
            Node::None => "None",
            Node::Number(_) => "a number",
            Node::Bytes(_) => "bytes",
            Node::Text(_) => "text",
            Node::List(_) => "a list or tuple",
            Node::Dict(_) => "a dictionary",
            Node::Name(_) => "the name of a function or class",
            Node::EmptyArray => "an array without content",
            Node::Type(_) => "an array's type",
            Node::Array(_) => "an array",
            Node::Opaque => "an object of an unknown class",
        }
    }
}

struct Machine<'a> {
    bytes: &'a [u8],
    /// The next byte.
    at: usize,
    /// Position of the current opcode.
    op: usize,
    nodes: Vec<Node>,
    stack: Vec<Id>,
    memo: BTreeMap<u64, Id>,
    /// Bytes that may still be copied.
    budget: Cell<usize>,
}

impl Machine<'_> {
    fn wrong<T>(&self, found: impl Into<String>, expected: &'static str) -> Result<T> {
        Err(PickleError { at: self.op, found: found.into(), expected })
    }

    /// Subtracts a copy from the budget: a pickle can refer to the same bytes any number of times.
    fn pay(&self, bytes: usize) -> Result<()> {
        match self.budget.get().checked_sub(bytes) {
            Some(left) => self.budget.set(left),
            None => return self.wrong("the same bytes used very often", "each array's bytes once"),
        }
        Ok(())
    }

    fn take(&mut self, count: u64) -> Result<&[u8]> {
        let left = self.bytes.len() - self.at;
        let Some(count) = usize::try_from(count).ok().filter(|count| *count <= left) else {
            return self.wrong(
                format!("the end of the file, {left} bytes on"),
                "a whole pickle: get the file again",
            );
        };
        self.at += count;
        Ok(&self.bytes[self.at - count..self.at])
    }

    /// An unsigned little-endian number of this many bytes.
    fn unsigned(&mut self, bytes: u64) -> Result<u64> {
        Ok(self.take(bytes)?.iter().rev().fold(0u64, |number, byte| (number << 8) | u64::from(*byte)))
    }

    fn line(&mut self) -> Result<String> {
        let rest = &self.bytes[self.at..];
        let Some(length) = rest.iter().position(|byte| *byte == b'\n') else {
            return self.wrong("a line without an end", "a whole pickle: get the file again");
        };
        self.at += length + 1;
        Ok(String::from_utf8_lossy(&rest[..length]).into_owned())
    }

    fn push(&mut self, node: Node) {
        self.nodes.push(node);
        self.stack.push(self.nodes.len() - 1);
    }

    fn pop(&mut self) -> Result<Id> {
        match self.stack.pop() {
            Some(id) if !matches!(self.nodes[id], Node::Mark) => Ok(id),
            _ => self.wrong("no value", "a value for this step"),
        }
    }

    fn top(&self) -> Result<Id> {
        match self.stack.last() {
            Some(id) if !matches!(self.nodes[*id], Node::Mark) => Ok(*id),
            _ => self.wrong("no value", "a value for this step"),
        }
    }

    /// Removes and returns the values above the last mark, and removes the mark.
    fn above_mark(&mut self) -> Result<Vec<Id>> {
        let Some(mark) = self.stack.iter().rposition(|id| matches!(self.nodes[*id], Node::Mark)) else {
            return self.wrong("no mark", "a mark before these values");
        };
        let values = self.stack.split_off(mark + 1);
        self.stack.pop();
        Ok(values)
    }

    fn text(&mut self, length: u64) -> Result<()> {
        let text = String::from_utf8_lossy(self.take(length)?).into_owned();
        self.push(Node::Text(text));
        Ok(())
    }

    fn sequence(&mut self, length: u64) -> Result<()> {
        let bytes = self.take(length)?.to_vec();
        self.push(Node::Bytes(bytes));
        Ok(())
    }

    fn tuple(&mut self, length: usize) -> Result<()> {
        let mut items: Vec<Id> = (0..length).map(|_| self.pop()).collect::<Result<_>>()?;
        items.reverse();
        self.push(Node::List(items));
        Ok(())
    }

    fn remember(&mut self, key: u64) -> Result<()> {
        let top = self.top()?;
        self.memo.insert(key, top);
        Ok(())
    }

    fn recall(&mut self, key: u64) -> Result<()> {
        let Some(id) = self.memo.get(&key) else {
            return self.wrong(format!("memo {key}, which is empty"), "a value that was kept before");
        };
        self.stack.push(*id);
        Ok(())
    }

    fn add_pairs(&mut self, dict: Id, items: &[Id]) -> Result<()> {
        if let Node::Dict(entries) = &mut self.nodes[dict] {
            entries.extend(items.chunks_exact(2).map(|pair| (pair[0], pair[1])));
        }
        if items.len().is_multiple_of(2) { Ok(()) } else { self.wrong("a key without a value", "pairs") }
    }

    fn add_items(&mut self, list: Id, items: &[Id]) {
        if let Node::List(known) = &mut self.nodes[list] {
            known.extend(items);
        }
    }

    fn number_line(&mut self) -> Result<f64> {
        let line = self.line()?;
        let digits = line.trim_end().trim_end_matches('L');
        match digits.parse() {
            Ok(number) => Ok(number),
            Err(_) => self.wrong(format!("{line:?}"), "a number"),
        }
    }

    fn key_line(&mut self) -> Result<u64> {
        let line = self.line()?;
        match line.trim_end().parse() {
            Ok(key) => Ok(key),
            Err(_) => self.wrong(format!("{line:?}"), "a memo's number"),
        }
    }

    /// Runs opcodes until the value is complete.
    fn run(&mut self) -> Result<Id> {
        loop {
            self.op = self.at;
            let op = self.take(1)?[0];
            if op == b'.' {
                return self.pop();
            }
            if !(self.simple(op)? || self.of_containers(op)? || self.of_objects(op)?) {
                return self.wrong(
                    format!("opcode {op:#04x}"),
                    "an opcode of protocols 0 to 5 without foreign objects",
                );
            }
        }
    }

    fn items(&self, id: Id) -> &[Id] {
        match &self.nodes[id] {
            Node::List(items) => items,
            _ => &[],
        }
    }

    fn whole(&self, id: Id) -> Option<usize> {
        match self.nodes[id] {
            Node::Number(n) if n >= 0.0 && n.fract() == 0.0 && n < 1e15 => Some(n as usize),
            _ => None,
        }
    }

    /// The result of a known function.
    fn made(&self, function: Id, arguments: Id) -> Result<Node> {
        let Node::Name(name) = &self.nodes[function] else { return Ok(Node::Opaque) };
        self.pay(name.len())?;
        let arguments = self.items(arguments);
        let argument = |i: usize| arguments.get(i).map(|id| &self.nodes[*id]);
        // numpy 2 moved its modules to `numpy._core`.
        let name = name.replace("numpy._core", "numpy.core");
        Ok(match (name.as_str(), argument(0), argument(1)) {
            ("numpy.core.multiarray._reconstruct", ..) => Node::EmptyArray,
            ("numpy.dtype", Some(Node::Text(text)), _) => element_type(text),
            ("numpy.dtype", Some(Node::Bytes(text)), _) => element_type(&String::from_utf8_lossy(text)),
            ("numpy.core.multiarray.scalar", Some(Node::Type(of)), Some(Node::Bytes(bytes))) => {
                match self.array(&[], of, false, bytes)?.values[..] {
                    [number] => Node::Number(number),
                    _ => Node::Opaque,
                }
            }
            ("numpy.core.numeric._frombuffer", Some(Node::Bytes(bytes)), Some(Node::Type(of))) => {
                let (shape, order) = (self.shape(arguments.get(2))?, argument(3));
                let fortran = matches!(order, Some(Node::Text(order)) if order == "F");
                Node::Array(self.array(&shape, of, fortran, bytes)?)
            }
            // Bytes in the protocols of Python 2, written by Python 3.
            ("_codecs.encode", Some(Node::Text(text)), _) => {
                self.pay(text.len())?;
                Node::Bytes(text.chars().map(|c| c as u32 as u8).collect())
            }
            _ => Node::Opaque,
        })
    }

    fn shape(&self, id: Option<&Id>) -> Result<Vec<usize>> {
        let items = id.map_or(&[][..], |id| self.items(*id));
        if items.len() > MAX_DIMENSIONS {
            return self.wrong(format!("an array of {} dimensions", items.len()), "at most 64");
        }
        match items.iter().map(|side| self.whole(*side)).collect() {
            Some(shape) => Ok(shape),
            None => self.wrong("an array's shape that is none", "whole numbers"),
        }
    }

    fn array(&self, shape: &[usize], of: &ElementType, fortran: bool, bytes: &[u8]) -> Result<Array> {
        self.pay(bytes.len())?;
        match Array::of_bytes(shape, of, fortran, bytes) {
            Some(array) => Ok(array),
            None => {
                let found =
                    format!("{} bytes for an array of {shape:?} with {} bytes each", bytes.len(), of.size);
                self.wrong(found, "as many as the shape has")
            }
        }
    }

    /// Applies a state to arrays and types, as `__setstate__` would.
    fn build(&mut self, object: Id, state: Id) -> Result<()> {
        // Version, shape, type, order and content of an array; version and byte order of a type.
        let items: Vec<Id> = self.items(state).iter().take(5).copied().collect();
        let node = |i: usize| items.get(i).map(|id| &self.nodes[*id]);
        let built = match &self.nodes[object] {
            Node::EmptyArray => match (node(2), node(4)) {
                (Some(Node::Type(of)), Some(Node::Bytes(bytes))) => {
                    let fortran = matches!(node(3), Some(Node::Number(n)) if *n != 0.0);
                    let shape = self.shape(items.get(1))?;
                    Node::Array(self.array(&shape, of, fortran, bytes)?)
                }
                _ => Node::Opaque,
            },
            Node::Type(of) => {
                let big_endian = match node(1) {
                    Some(Node::Text(order)) => order == ">",
                    Some(Node::Bytes(order)) => order == b">",
                    _ => of.big_endian,
                };
                Node::Type(ElementType { big_endian, ..of.clone() })
            }
            _ => return Ok(()),
        };
        self.nodes[object] = built;
        Ok(())
    }
}

/// The type of this name; types of anything but numbers are opaque.
fn element_type(name: &str) -> Node {
    ElementType::named(name).map_or(Node::Opaque, Node::Type)
}
