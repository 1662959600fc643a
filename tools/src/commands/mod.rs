//! The commands, one file each.

mod batch;
mod bench;
mod cameras;
mod compare;
mod convert;
mod depth;
mod doctor;
mod eval;
mod info;
mod reconstruct;
mod refine;
mod render;
mod scene;
mod tune;
mod view;
mod weights;

use crate::session::Session;
use clap::Subcommand;
use zipsplat::{Error, Result};

#[derive(Subcommand)]
pub enum Command {
    Reconstruct(reconstruct::Reconstruct),
    Cameras(cameras::Cameras),
    Depth(depth::Depth),
    RefineOptions(refine::RefineOptions),
    Render(render::Render),
    View(view::View),
    Info(info::Info),
    Convert(convert::Convert),
    Eval(eval::Eval),
    Batch(batch::Batch),
    Compare(compare::Compare),
    Bench(bench::Bench),
    Doctor(doctor::Doctor),
    Scene(scene::Scene),
    Tune(tune::Tune),
    Weights(weights::Weights),
}

impl Command {
    pub fn run(&self, session: &mut Session<'_>) -> Result<()> {
        if session.plans_for_none() && !matches!(self, Command::Info(info) if info.plans()) {
            return Err(Error::argument(
                "--device",
                "none",
                "a device; none is for info --plan, which needs no device",
            ));
        }
        match self {
            Command::Reconstruct(command) => command.run(session),
            Command::Cameras(command) => command.run(session),
            Command::Depth(command) => command.run(session),
            Command::RefineOptions(command) => command.run(session),
            Command::Render(command) => command.run(session),
            Command::View(command) => command.run(session),
            Command::Info(command) => command.run(session),
            Command::Convert(command) => command.run(session),
            Command::Eval(command) => command.run(session),
            Command::Batch(command) => command.run(session),
            Command::Compare(command) => command.run(session),
            Command::Bench(command) => command.run(session),
            Command::Doctor(command) => command.run(session),
            Command::Scene(command) => command.run(session),
            Command::Tune(command) => command.run(session),
            Command::Weights(command) => command.run(session),
        }
    }
}
