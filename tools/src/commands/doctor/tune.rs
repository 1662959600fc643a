use crate::{session::Session, table::Table};
use clap::Args;
use serde::Serialize;
use std::time::Instant;
use zipsplat::{
    Result,
    tune::{Measured, Tuning},
};

/// Measure the fastest tiles of linear layers, attention and k-means on this device, for later runs
#[derive(Args)]
#[command(after_help = "Caches the result per device, driver and kernel version. Results of the network stay
within the same tolerances; those of --precision fp32 keep their bits. Without matrix
units, linear layers run in registers alone by default, or with tiles in shared memory
(named with a depth k). Tiles with wrong results are not timed.

Examples:
  zipsplat doctor tune
  zipsplat doctor tune --device 1")]
pub struct Tune {}

#[derive(Serialize)]
struct Report<'a> {
    device: &'a str,
    measured: &'a [Measured],
    unusable: &'a [String],
}

impl Tune {
    pub fn run(&self, session: &mut Session<'_>) -> Result<()> {
        let device = session.device()?;
        let limits = device.limits();
        limits.check_timestamps()?;
        // Earlier results include failed tiles.
        let mut tuning = Tuning::known(&device).unwrap_or_default();
        let started = Instant::now();
        let outcome = session.stage("tune", |stage| {
            tuning.measure(&device, |what, done| {
                stage.name(what);
                stage.at(done)
            })
        });
        let time = started.elapsed();
        // Also after cancellation or device loss.
        tuning.keep(&device)?;
        let mut table = Table::new(3, &["kernel", "factors", "tile", "values", "ms", ""]);
        for measured in &tuning.measured {
            for (tile, ms) in &measured.tiles {
                let best = if measured.best() == Some(tile) { "fastest" } else { "" };
                table.row([
                    measured.kernel.clone(),
                    measured.factor.name().into(),
                    tile.clone(),
                    measured.values.to_string(),
                    format!("{ms:.3}"),
                    best.into(),
                ]);
            }
        }
        let mut text = format!("{table}{}: measured in {:.1} s", limits.name, time.as_secs_f64());
        for tile in &tuning.unusable {
            text +=
                &format!("\nnot used, as its results are wrong, or the driver refuses it or was lost by it: {tile}");
        }
        let Tuning { measured, unusable } = &tuning;
        session.report(&Report { device: &limits.name, measured, unusable }, text)?;
        outcome.map(drop)
    }
}
