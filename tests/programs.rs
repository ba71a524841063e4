//! The program, its files and its pages, and the examples. One binary compiles the generic code that its modules share once.

#[path = "support/captures.rs"]
mod capture_folders;
#[path = "support/command.rs"]
mod command;
#[path = "support/events.rs"]
mod events;

#[path = "capture_runs.rs"]
mod capture_runs;
#[path = "captures.rs"]
mod captures;
#[path = "cli.rs"]
mod cli;
#[path = "config.rs"]
mod config;
#[path = "datasets.rs"]
mod datasets;
#[path = "examples.rs"]
mod examples;
#[path = "films.rs"]
mod films;
#[path = "formats.rs"]
mod formats;
#[path = "guide.rs"]
mod guide;
#[path = "imports.rs"]
mod imports;
#[path = "refusals.rs"]
mod refusals;
#[path = "report.rs"]
mod report;
