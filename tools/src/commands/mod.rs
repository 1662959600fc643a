mod bench;
mod cameras;
mod convert;
mod depth;
mod doctor;
mod edit;
mod eval;
mod lift;
mod reconstruct;
mod refine;
mod render;
mod scene;
mod select;
mod view;
mod weights;

use crate::session::Session;
use clap::Subcommand;
use zipsplat::{Error, Result};

#[derive(Subcommand)]
pub enum Command {
    Reconstruct(Box<reconstruct::Reconstruct>),
    Cameras(cameras::Cameras),
    Depth(depth::Depth),
    Refine(refine::Refine),
    Edit(edit::Edit),
    Lift(lift::Lift),
    Select(select::Select),
    Render(render::Render),
    View(Box<view::View>),
    Convert(convert::Convert),
    Eval(Box<eval::Eval>),
    Bench(bench::Bench),
    Doctor(doctor::Doctor),
    #[command(hide = true)]
    Scene(scene::Scene),
    Weights(weights::Weights),
}

impl Command {
    pub fn run(&self, session: &mut Session<'_>) -> Result<()> {
        let plans = match self {
            Command::Reconstruct(command) => command.dry_run,
            Command::Lift(command) => command.dry_run,
            _ => false,
        };
        if session.plans_for_none() && !plans {
            let expected = "a device; none is for --dry-run of reconstruct and lift, which needs no device";
            return Err(Error::argument("--device", "none", expected));
        }
        match self {
            Command::Reconstruct(command) => command.run(session),
            Command::Cameras(command) => command.run(session),
            Command::Depth(command) => command.run(session),
            Command::Refine(command) => command.run(session),
            Command::Edit(command) => command.run(session),
            Command::Lift(command) => command.run(session),
            Command::Select(command) => command.run(session),
            Command::Render(command) => command.run(session),
            Command::View(command) => command.run(session),
            Command::Convert(command) => command.run(session),
            Command::Eval(command) => command.run(session),
            Command::Bench(command) => command.run(session),
            Command::Doctor(command) => command.run(session),
            Command::Scene(command) => command.run(session),
            Command::Weights(command) => command.run(session),
        }
    }
}
