//! Files for other programs.

pub mod ply;
