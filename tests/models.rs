//! Models and their training. One binary compiles the generic code that its modules share once.

#[path = "support/command.rs"]
mod command;
#[path = "support/own_losses.rs"]
mod own_losses;
#[path = "support/mod.rs"]
mod support;

#[path = "added_losses.rs"]
mod added_losses;
#[path = "analytic_scenes.rs"]
mod analytic_scenes;
#[path = "bake.rs"]
mod bake;
#[path = "carving.rs"]
mod carving;
#[path = "checkpoint.rs"]
mod checkpoint;
#[path = "coarse_to_fine.rs"]
mod coarse_to_fine;
#[path = "dvgo.rs"]
mod dvgo;
#[path = "nerf.rs"]
mod nerf;
#[path = "ngp.rs"]
mod ngp;
#[path = "own_model.rs"]
mod own_model;
#[path = "point_clouds.rs"]
mod point_clouds;
#[path = "resuming.rs"]
mod resuming;
#[path = "surfaces.rs"]
mod surfaces;
#[path = "training.rs"]
mod training;
#[path = "viewer.rs"]
mod viewer;
