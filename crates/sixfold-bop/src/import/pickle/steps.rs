//! The opcodes of a pickle.

use super::{Id, Machine, Node, Result};

impl Machine<'_> {
    /// Numbers, text and bytes.
    pub(super) fn simple(&mut self, op: u8) -> Result<bool> {
        match op {
            0x80 => _ = self.take(1)?,
            0x95 => _ = self.take(8)?,
            b'N' => self.push(Node::None),
            0x88 => self.push(Node::Number(1.0)),
            0x89 => self.push(Node::Number(0.0)),
            b'I' | b'L' | b'F' => {
                let number = self.number_line()?;
                self.push(Node::Number(number));
            }
            b'J' => {
                let number = self.unsigned(4)? as u32 as i32;
                self.push(Node::Number(f64::from(number)));
            }
            b'K' | b'M' => {
                let number = self.unsigned(if op == b'K' { 1 } else { 2 })?;
                self.push(Node::Number(number as f64));
            }
            0x8a | 0x8b => {
                let length = self.unsigned(if op == 0x8a { 1 } else { 4 })?;
                let bytes = self.take(length)?;
                let value = bytes.iter().rev().fold(0.0, |number, byte| number * 256.0 + f64::from(*byte));
                let negative = bytes.last().is_some_and(|byte| byte & 0x80 != 0);
                let number = if negative { value - 256f64.powi(bytes.len().min(128) as i32) } else { value };
                self.push(Node::Number(number));
            }
            b'G' => {
                let bits = self.take(8)?.iter().fold(0u64, |bits, byte| (bits << 8) | u64::from(*byte));
                self.push(Node::Number(f64::from_bits(bits)));
            }
            b'S' | b'V' => {
                let line = self.line()?;
                let quoted = line.trim_end_matches('\r');
                let inner = quoted.get(1..quoted.len().saturating_sub(1)).unwrap_or_default();
                let node = if op == b'S' {
                    Node::Bytes(unescaped(inner).iter().map(|c| *c as u8).collect())
                } else {
                    Node::Text(unescaped(quoted).into_iter().collect())
                };
                self.push(node);
            }
            b'X' | 0x8c | 0x8d => {
                let length = self.unsigned(if op == b'X' {
                    4
                } else if op == 0x8c {
                    1
                } else {
                    8
                })?;
                self.text(length)?;
            }
            b'T' | b'U' | b'B' | b'C' | 0x8e | 0x96 => {
                let size = match op {
                    b'U' | b'C' => 1,
                    b'T' | b'B' => 4,
                    _ => 8,
                };
                let length = self.unsigned(size)?;
                self.sequence(length)?;
            }
            _ => return Ok(false),
        }
        Ok(true)
    }

    /// Lists, tuples, sets, dictionaries, and the memo.
    pub(super) fn of_containers(&mut self, op: u8) -> Result<bool> {
        match op {
            b'(' => self.push(Node::Mark),
            b'0' => _ = self.stack.pop(),
            b'1' => _ = self.above_mark()?,
            b'2' => {
                let top = self.top()?;
                self.stack.push(top);
            }
            b']' | b')' | 0x8f => self.push(Node::List(vec![])),
            b'l' | b't' | 0x91 => {
                let items = self.above_mark()?;
                self.push(Node::List(items));
            }
            0x85..=0x87 => self.tuple(usize::from(op - 0x84))?,
            b'a' => {
                let item = self.pop()?;
                let list = self.top()?;
                self.add_items(list, &[item]);
            }
            b'e' | 0x90 => {
                let items = self.above_mark()?;
                let list = self.top()?;
                self.add_items(list, &items);
            }
            b'}' => self.push(Node::Dict(vec![])),
            b'd' => {
                let items = self.above_mark()?;
                self.push(Node::Dict(vec![]));
                self.add_pairs(self.nodes.len() - 1, &items)?;
            }
            b's' => {
                let (value, key) = (self.pop()?, self.pop()?);
                let dict = self.top()?;
                self.add_pairs(dict, &[key, value])?;
            }
            b'u' => {
                let items = self.above_mark()?;
                let dict = self.top()?;
                self.add_pairs(dict, &items)?;
            }
            b'p' | b'q' | b'r' | 0x94 => {
                let key = match op {
                    b'p' => self.key_line()?,
                    b'q' => self.unsigned(1)?,
                    b'r' => self.unsigned(4)?,
                    _ => self.memo.len() as u64,
                };
                self.remember(key)?;
            }
            b'g' | b'h' | b'j' => {
                let key = match op {
                    b'g' => self.key_line()?,
                    b'h' => self.unsigned(1)?,
                    _ => self.unsigned(4)?,
                };
                self.recall(key)?;
            }
            _ => return Ok(false),
        }
        Ok(true)
    }

    /// Names, and what would be calls.
    pub(super) fn of_objects(&mut self, op: u8) -> Result<bool> {
        match op {
            b'c' => {
                let name = format!("{}.{}", self.line()?, self.line()?);
                self.push(Node::Name(name));
            }
            0x93 => {
                let (name, module) = (self.pop()?, self.pop()?);
                let part = |id: Id| match &self.nodes[id] {
                    Node::Text(text) => text.as_str(),
                    _ => "",
                };
                let name = format!("{}.{}", part(module), part(name));
                self.pay(name.len())?;
                self.push(Node::Name(name));
            }
            b'R' | 0x81 => {
                let (arguments, function) = (self.pop()?, self.pop()?);
                let made = self.made(function, arguments)?;
                self.push(made);
            }
            0x92 => {
                self.tuple(3)?;
                self.pop()?;
                self.push(Node::Opaque);
            }
            b'o' => {
                self.above_mark()?;
                self.push(Node::Opaque);
            }
            b'i' => {
                self.line()?;
                self.line()?;
                self.above_mark()?;
                self.push(Node::Opaque);
            }
            b'b' => {
                let state = self.pop()?;
                let object = self.top()?;
                self.build(object, state)?;
            }
            0x98 => {}
            _ => return Ok(false),
        }
        Ok(true)
    }
}

/// Text with Python's escapes resolved.
fn unescaped(text: &str) -> Vec<char> {
    let mut out = vec![];
    let mut chars = text.chars();
    while let Some(c) = chars.next() {
        if c != '\\' {
            out.push(c);
            continue;
        }
        let kind = chars.next();
        let digits = match kind {
            Some('x') => 2,
            Some('u') => 4,
            Some('U') => 8,
            _ => 0,
        };
        let resolved = match kind {
            Some('n') => Some('\n'),
            Some('r') => Some('\r'),
            Some('t') => Some('\t'),
            Some(_) if digits > 0 => {
                let code: String = chars.by_ref().take(digits).collect();
                u32::from_str_radix(&code, 16).ok().and_then(char::from_u32)
            }
            other => other,
        };
        out.extend(resolved);
    }
    out
}
