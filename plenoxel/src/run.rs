//! A run without a screen: its settings and its folder, what it needs of the machine, and its figures. Nothing here prints.
//!
//! | module | contents |
//! | --- | --- |
//! | [`settings`] | defaults < preset < file < assignments, resolved to a configuration |
//! | [`data`] | the source of the views, as a run records it |
//! | [`memory`], [`machine`] | an estimate of the memory before it is taken; threads, vector instructions, the time |
//! | [`budget`] | a plan of time: lengths of the stages for training of a given duration |
//! | [`folder`] | the files of a run, by name |
//! | [`metrics`], [`tensorboard`] | the figures of each step, on lines of JSON and as TensorBoard reads them |
//! | [`evaluation`], [`figures`] | PSNR and SSIM of each view; their means with the definitions |
//!
//! Modules here may read the clock and the system; [`train`](crate::train) may not.

pub mod budget;
pub mod data;
pub mod evaluation;
pub mod figures;
pub mod folder;
pub mod machine;
pub mod memory;
pub mod metrics;
pub mod settings;
pub mod tensorboard;
