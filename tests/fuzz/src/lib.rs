//! The parsers that the fuzz targets try out: those of `tests/properties.rs`.

#[path = "../../support/memory.rs"]
pub mod memory;
#[path = "../../support/parsers.rs"]
pub mod parsers;
