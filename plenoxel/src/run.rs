//! A run without a screen: its settings and its folder, what it needs of the machine, and its figures. Nothing here prints.
//!
//! | module | contents |
//! | --- | --- |
//! | [`settings`] | defaults < preset < file < assignments, resolved to a configuration |

pub mod settings;
