//! Procedural captures.

mod command;
mod coverage;
mod geometry;
mod pictures;
mod rays;
mod refined;
mod storage;
mod stream;

use zipsplat_cli::procedural::{Capture, Options, Photos, Setup};

fn options(views: usize, side: u32) -> Options {
    Options { views, width: side, height: side, supersample: false, random_first: false }
}

fn setup(seed: u64, options: &Options) -> Setup {
    Setup::new(seed, options, &Photos::default(), &|| Ok(())).expect("the options are usable")
}

fn capture(seed: u64, options: &Options) -> Capture {
    setup(seed, options).shoot(&Photos::default(), &|| Ok(())).expect("nothing stops it")
}
