//! The fastest tile of each matrix kernel for results of each size, by measurement on the device at hand.

use super::{COLUMNS, Candidate, OPERATIONS, Operation, cache::cache_file};
use crate::{
    Error, Result,
    gpu::{Device, Element, Limits, Run},
    ops::{Arithmetic, Tiles, Units},
    types::write_atomic,
};
use std::{
    fs,
    ops::ControlFlow,
    time::{Duration, Instant},
};

/// The times that were measured on a device.
#[derive(Clone, Debug, Default, PartialEq, serde::Serialize, serde::Deserialize)]
pub struct Tuning {
    /// The times of each kernel and size.
    pub measured: Vec<Measured>,
    /// Tiles that are not used, because what they compute is wrong or the driver refuses them: kernel, type of factors, name.
    pub unusable: Vec<String>,
}

/// The tiles of one kernel for one size of its result.
#[derive(Clone, Debug, PartialEq, serde::Serialize, serde::Deserialize)]
pub struct Measured {
    /// The operation: `linear`, `attention` or `nearest`.
    pub kernel: String,
    /// Type of its factors.
    pub factor: Element,
    /// Values of the result.
    pub values: usize,
    /// Every tile that computes rightly, by name, and its milliseconds.
    pub tiles: Vec<(String, f64)>,
}

/// A size at which one run takes more milliseconds is the largest that is measured; those above take what is best there.
const LONGEST: f64 = 50.0;
const REPEATS: usize = 5;
/// How long a GPU is kept busy before a measurement.
const WAKING: Duration = Duration::from_millis(100);

impl Measured {
    fn is_of(&self, operation: &dyn Operation, factor: Element) -> bool {
        self.kernel == operation.name() && self.factor == factor
    }

    /// Name of the fastest tile.
    pub fn best(&self) -> Option<&str> {
        self.tiles.iter().min_by(|a, b| a.1.total_cmp(&b.1)).map(|(name, _)| name.as_str())
    }
}

impl Tuning {
    /// The times that were measured on this device before, with this driver and these kernels.
    pub fn known(device: &Device) -> Option<Self> {
        serde_json::from_slice(&fs::read(cache_file(device, "tuning")?).ok()?).ok()
    }

    /// Remembers it for all that follows on this device.
    ///
    /// # Errors
    /// [`Error::Argument`] where there is no cache folder, [`Error::Io`] where it cannot be written.
    pub fn keep(&self, device: &Device) -> Result<()> {
        let file = cache_file(device, "tuning");
        let file = file.ok_or_else(|| Error::argument("cache folder", "none", "ZIPSPLAT_CACHE or HOME"))?;
        file.parent().map_or(Ok(()), fs::create_dir_all).map_err(|e| Error::io(&file, e))?;
        let bytes = serde_json::to_vec(self).unwrap_or_default();
        write_atomic(&file, |out| out.write_all(&bytes))
    }

    /// Measures every tile of every matrix kernel that is not known to be unusable. `progress` gets what comes next and the share
    /// that is done, and may stop. Each time replaces what was known of its tile; the rest stays, also behind an error.
    ///
    /// # Errors
    /// [`Error::DeviceLost`], after which the tile that was at work is unusable; [`Error::Cancelled`].
    pub fn measure(&mut self, device: &Device, mut progress: impl FnMut(&str, f64) -> ControlFlow<()>) -> Result<()> {
        let mut tiles = Vec::new();
        for operation in OPERATIONS {
            let candidates = operation.on_units(device.limits()).into_iter().flat_map(|(_, candidates)| candidates);
            tiles.extend(candidates.filter_map(|candidate| Timed::new(operation, candidate)));
        }
        for (i, tile) in tiles.iter().enumerate() {
            let name = tile.full_name();
            if self.unusable.contains(&name) {
                continue;
            }
            if progress(&name, i as f64 / tiles.len() as f64).is_break() {
                return Err(Error::Cancelled);
            }
            let outcome = tile.times(device);
            if !matches!(outcome, Ok(_) | Err(Error::Memory { .. })) {
                self.unusable.push(name);
                let of_kernel = self.measured.iter_mut().filter(|m| m.is_of(tile.operation, tile.units.factor));
                of_kernel.for_each(|m| m.tiles.retain(|(name, _)| *name != tile.name));
            }
            match outcome {
                Err(Error::DeviceLost) => return Err(Error::DeviceLost),
                Ok(times) => times.into_iter().for_each(|(values, ms)| self.add(tile, values, ms)),
                // A driver may refuse what it offers.
                _ => {}
            }
        }
        Ok(())
    }

    fn add(&mut self, tile: &Timed, values: usize, ms: f64) {
        let Timed { operation, units: Units { factor, .. }, .. } = *tile;
        let is_it = |m: &Measured| m.is_of(operation, factor) && m.values == values;
        let at = self.measured.iter().position(is_it).unwrap_or_else(|| {
            self.measured.push(Measured { kernel: operation.name().into(), factor, values, tiles: Vec::new() });
            self.measured.len() - 1
        });
        let tiles = &mut self.measured[at].tiles;
        match tiles.iter_mut().find(|(name, _)| *name == tile.name) {
            Some(known) => known.1 = ms,
            None => tiles.push((tile.name.clone(), ms)),
        }
    }

    /// An arithmetic with the tiles that were fastest. Names that are no candidate's are left out.
    pub fn applied(&self, mut arithmetic: Arithmetic, limits: &Limits) -> Arithmetic {
        for operation in OPERATIONS {
            for units in operation.chosen(&mut arithmetic).into_iter().flatten() {
                units.tiles = self.fastest(operation, *units, limits);
            }
        }
        arithmetic
    }

    fn fastest(&self, operation: &dyn Operation, units: Units, limits: &Limits) -> Tiles {
        let candidates: Vec<String> = operation.tiles(limits, units).iter().map(ToString::to_string).collect();
        let mut tiles = Tiles::default();
        for class in 0..Tiles::CLASSES {
            let is_it = |m: &&Measured| m.is_of(operation, units.factor) && m.values == Tiles::values(class);
            let best = self.measured.iter().find(is_it).and_then(Measured::best);
            if let Some(index) = best.and_then(|best| candidates.iter().position(|name| name == best)) {
                tiles.set_from(class, index);
            }
        }
        tiles
    }
}

/// A tile to be timed.
struct Timed {
    operation: &'static dyn Operation,
    units: Units,
    name: String,
}

impl Timed {
    fn new(operation: &'static dyn Operation, candidate: Candidate) -> Option<Self> {
        let Candidate::Units(units, tile) = candidate else { return None };
        Some(Self { operation, units, name: tile.to_string() })
    }

    fn full_name(&self) -> String {
        format!("{} {} {}", self.operation.name(), self.units.factor.name(), self.name)
    }

    /// Values of the result and milliseconds, for growing results until one takes long or does not fit.
    fn times(&self, device: &Device) -> Result<Vec<(usize, f64)>> {
        let mut times = Vec::new();
        for values in (0..Tiles::CLASSES).map(Tiles::values) {
            let run = self.operation.timed(device, self.units, values / COLUMNS);
            let ms = match run.and_then(|run| median(device, run)) {
                Err(Error::Memory { .. }) if !times.is_empty() => break,
                ms => ms?,
            };
            times.push((values, ms));
            if ms > LONGEST {
                break;
            }
        }
        Ok(times)
    }
}

/// Median milliseconds of matrix kernels on the device, once it is warm: a GPU whose clock fell while the host prepared the next
/// tile would be measured at a fifth of its speed.
fn median(device: &Device, mut run: Run) -> Result<f64> {
    let mut once = || -> Result<f64> {
        let profile = run.profile()?;
        let kernels = profile.rows.iter().filter(|row| row.kernel.contains("_matrix"));
        Ok(kernels.map(|row| 1e3 * row.time.as_secs_f64()).sum())
    };
    let started = Instant::now();
    once()?;
    while !device.limits().cpu && started.elapsed() < WAKING {
        once()?;
    }
    let mut times = (0..REPEATS).map(|_| once()).collect::<Result<Vec<_>>>()?;
    times.sort_by(f64::total_cmp);
    Ok(times[REPEATS / 2])
}
