//! JSON trees that keep selected keys and count their memory while they are parsed: an empty object of three bytes may take 32 bytes of memory, and an
//! object with one key 700.

use super::Kept;
use serde::de::{DeserializeSeed, Deserializer, Error, IgnoredAny, MapAccess, SeqAccess, Visitor};
use serde_json::{Map, Number, Value};
use std::cell::Cell;
use std::fmt;

/// Size of a value in its container, bytes.
const VALUE: u64 = size_of::<Value>() as u64;
/// Overhead of the allocator for a piece of memory, bytes.
const PIECE: u64 = 16;
/// Number of keys in the first tree node of an object, and the size of the node in bytes.
const NODE_KEYS: usize = 11;
const NODE: u64 = NODE_KEYS as u64 * (size_of::<String>() as u64 + VALUE) + 16 + PIECE;

/// Memory left for the content of a file, and the limits that were exceeded.
pub(super) struct Room<'k> {
    kept: &'k Kept,
    left: Cell<u64>,
    exceeded: Cell<bool>,
    long: Cell<bool>,
}

impl<'k> Room<'k> {
    pub fn new(kept: &'k Kept, left: u64) -> Self {
        Room { kept, left: Cell::new(left), exceeded: Cell::new(false), long: Cell::new(false) }
    }

    /// True if the value needs more memory than was left.
    pub fn is_exceeded(&self) -> bool {
        self.exceeded.get()
    }

    /// True if a list had too many entries.
    pub fn is_long(&self) -> bool {
        self.long.get()
    }

    pub fn read<'de, D: Deserializer<'de>>(&self, reader: D) -> Result<Value, D::Error> {
        reader.deserialize_any(Tree(self))
    }

    fn take<E: Error>(&self, bytes: u64) -> Result<(), E> {
        match self.left.get().checked_sub(bytes) {
            Some(left) => {
                self.left.set(left);
                Ok(())
            }
            None => {
                self.exceeded.set(true);
                Err(E::custom("not enough memory"))
            }
        }
    }
}

/// Parser of a value.
#[derive(Clone, Copy)]
struct Tree<'r>(&'r Room<'r>);

impl<'de> DeserializeSeed<'de> for Tree<'_> {
    type Value = Value;

    fn deserialize<D: Deserializer<'de>>(self, reader: D) -> Result<Value, D::Error> {
        reader.deserialize_any(self)
    }
}

impl<'de> Visitor<'de> for Tree<'_> {
    type Value = Value;

    fn expecting(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("a value of JSON")
    }

    fn visit_unit<E: Error>(self) -> Result<Value, E> {
        Ok(Value::Null)
    }

    fn visit_bool<E: Error>(self, value: bool) -> Result<Value, E> {
        Ok(value.into())
    }

    fn visit_i64<E: Error>(self, value: i64) -> Result<Value, E> {
        Ok(value.into())
    }

    fn visit_u64<E: Error>(self, value: u64) -> Result<Value, E> {
        Ok(value.into())
    }

    fn visit_f64<E: Error>(self, value: f64) -> Result<Value, E> {
        Ok(Number::from_f64(value).map_or(Value::Null, Value::Number))
    }

    fn visit_str<E: Error>(self, text: &str) -> Result<Value, E> {
        self.0.take(text.len() as u64 + PIECE)?;
        Ok(text.into())
    }

    fn visit_seq<A: SeqAccess<'de>>(self, mut entries: A) -> Result<Value, A::Error> {
        let mut list = Vec::new();
        while let Some(value) = entries.next_element_seed(self)? {
            if list.len() == self.0.kept.entries {
                self.0.long.set(true);
                return Err(A::Error::custom("too many entries in a list"));
            }
            // A list has a capacity of four entries, which is doubled when it is full.
            let places = match list.len() {
                0 => 4 * VALUE + PIECE,
                1..4 => 0,
                _ => 2 * VALUE,
            };
            self.0.take(places)?;
            list.push(value);
        }
        Ok(list.into())
    }

    fn visit_map<A: MapAccess<'de>>(self, mut entries: A) -> Result<Value, A::Error> {
        let mut object = Map::new();
        while let Some(key) = entries.next_key_seed(Key(self.0))? {
            let Some(key) = key else {
                entries.next_value::<IgnoredAny>()?;
                continue;
            };
            // Nodes are at least half full.
            let node = match object.len() {
                0 => NODE,
                1..NODE_KEYS => 0,
                _ => 2 * NODE / NODE_KEYS as u64,
            };
            self.0.take(node + key.len() as u64 + PIECE)?;
            object.insert(key, entries.next_value_seed(self)?);
        }
        Ok(object.into())
    }
}

/// Parser of the name of a key, if the key is kept.
struct Key<'r>(&'r Room<'r>);

impl<'de> DeserializeSeed<'de> for Key<'_> {
    type Value = Option<String>;

    fn deserialize<D: Deserializer<'de>>(self, reader: D) -> Result<Self::Value, D::Error> {
        reader.deserialize_str(self)
    }
}

impl Visitor<'_> for Key<'_> {
    type Value = Option<String>;

    fn expecting(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("the name of a key")
    }

    fn visit_str<E: Error>(self, name: &str) -> Result<Self::Value, E> {
        Ok((self.0.kept.keys)(name).then(|| name.to_owned()))
    }
}
