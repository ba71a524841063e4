//! Training runs: settings, data, memory, run folders and metrics. Nothing in this module prints.
//!
//! | module | contents |
//! | --- | --- |
//! | [`settings`] | defaults < preset < file < assignments, resolved to a configuration |
//! | [`data`] | the source of the views, recorded by a run |
//! | [`memory`], [`machine`] | memory estimates; threads, vector instructions and the time |
//! | [`budget`], [`pace`] | time budgets: lengths of the stages for training of a given duration |
//! | [`folder`] | the files of a run, by name |
//! | [`metrics`], [`tensorboard`] | the metrics of training, as JSON lines and as TensorBoard events |
//! | [`training`], [`carving`] | the run itself, reported as events |
//! | [`figures`] | mean test scores with their definitions |
//! | [`visibility`](mod@visibility) | visibility of voxels in the training views |
//!
//! Modules here may read the clock and the system; [`train`](crate::train) may not.

pub mod budget;
pub mod carving;
pub mod data;
pub mod figures;
pub mod folder;
pub mod machine;
pub mod memory;
pub mod metrics;
pub mod pace;
pub mod settings;
pub mod tensorboard;
pub mod training;
pub mod visibility;

/// Program name and version, recorded by runs.
pub const PROGRAM: &str = concat!("plenoxel ", env!("CARGO_PKG_VERSION"));

/// Returns at most `most` indices below `n`, evenly spaced, including the first and the last.
pub fn evenly_spaced(n: usize, most: usize) -> Vec<usize> {
    match n {
        n if n <= most => (0..n).collect(),
        n => (0..most).map(|i| i * (n - 1) / (most - 1).max(1)).collect(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn views_are_chosen_evenly_with_both_ends() {
        assert_eq!(evenly_spaced(3, 25), [0, 1, 2]);
        let chosen = evenly_spaced(200, 25);
        assert_eq!((chosen.len(), chosen[0], chosen[24]), (25, 0, 199));
        assert!(chosen.windows(2).all(|pair| pair[1] > pair[0]));
    }
}
