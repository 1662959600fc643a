use super::{COLUMNS, Candidate, OPERATIONS, Operation, cache::cache_file};
use crate::{
    Error, Result,
    gpu::{Device, Element, Limits, Run},
    ops::{Arithmetic, Tiles},
    types::write_atomic,
};
use std::{
    fs,
    ops::ControlFlow,
    time::{Duration, Instant},
};

#[derive(Clone, Debug, Default, PartialEq, serde::Serialize, serde::Deserialize)]
pub struct Tuning {
    pub measured: Vec<Measured>,
    /// Wrong or rejected tiles: kernel, factor type, name.
    pub unusable: Vec<String>,
}

#[derive(Clone, Debug, PartialEq, serde::Serialize, serde::Deserialize)]
pub struct Measured {
    /// `linear`, `attention` or `nearest`.
    pub kernel: String,
    pub factor: Element,
    pub values: usize,
    /// Name and milliseconds.
    pub tiles: Vec<(String, f64)>,
}

/// Milliseconds that end a measurement; larger sizes reuse the best tile.
const LONGEST: f64 = 50.0;
const REPEATS: usize = 5;
const WAKING: Duration = Duration::from_millis(100);

impl Measured {
    fn is_of(&self, operation: &Operation, factor: Element) -> bool {
        self.kernel == operation.name && self.factor == factor
    }

    pub fn best(&self) -> Option<&str> {
        self.tiles.iter().min_by(|a, b| a.1.total_cmp(&b.1)).map(|(name, _)| name.as_str())
    }
}

impl Tuning {
    pub fn known(device: &Device) -> Option<Self> {
        serde_json::from_slice(&fs::read(cache_file(device, "tuning")?).ok()?).ok()
    }

    /// [`Error::Argument`] without a cache folder, [`Error::Io`].
    pub fn keep(&self, device: &Device) -> Result<()> {
        let file = cache_file(device, "tuning");
        let file = file.ok_or_else(|| Error::argument("cache folder", "none", "ZIPSPLAT_CACHE or HOME"))?;
        file.parent().map_or(Ok(()), fs::create_dir_all).map_err(|e| Error::io(&file, e))?;
        let bytes = serde_json::to_vec(self).unwrap_or_default();
        write_atomic(&file, |out| out.write_all(&bytes))
    }

    /// Measures every usable tile, keeping earlier results on errors.
    ///
    /// # Errors
    /// [`Error::DeviceLost`], which marks the tile unusable; [`Error::Cancelled`].
    pub fn measure(&mut self, device: &Device, mut progress: impl FnMut(&str, f64) -> ControlFlow<()>) -> Result<()> {
        let mut tiles = Vec::new();
        for operation in &OPERATIONS {
            let on_units = operation.on_units(device.limits()).into_iter().flat_map(|(_, candidates)| candidates);
            let candidates = on_units.chain(operation.on_lanes(device.limits()));
            tiles.extend(candidates.map(|candidate| Timed { operation, candidate, name: candidate.tile() }));
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
            if !matches!(outcome, Ok(Some(_)) | Err(Error::Memory { .. })) {
                self.unusable.push(name);
                let of_kernel = self.measured.iter_mut().filter(|m| m.is_of(tile.operation, tile.candidate.factor()));
                of_kernel.for_each(|m| m.tiles.retain(|(name, _)| *name != tile.name));
            }
            match outcome {
                Err(Error::DeviceLost) => return Err(Error::DeviceLost),
                Ok(Some(times)) => times.into_iter().for_each(|(values, ms)| self.add(tile, values, ms)),
                _ => {}
            }
        }
        Ok(())
    }

    fn add(&mut self, tile: &Timed, values: usize, ms: f64) {
        let (operation, factor) = (tile.operation, tile.candidate.factor());
        let is_it = |m: &Measured| m.is_of(operation, factor) && m.values == values;
        let at = self.measured.iter().position(is_it).unwrap_or_else(|| {
            self.measured.push(Measured { kernel: operation.name.into(), factor, values, tiles: Vec::new() });
            self.measured.len() - 1
        });
        let tiles = &mut self.measured[at].tiles;
        match tiles.iter_mut().find(|(name, _)| *name == tile.name) {
            Some(known) => known.1 = ms,
            None => tiles.push((tile.name.clone(), ms)),
        }
    }

    pub fn applied(&self, mut arithmetic: Arithmetic, limits: &Limits) -> Arithmetic {
        for operation in &OPERATIONS {
            for units in (operation.chosen)(&mut arithmetic).into_iter().flatten() {
                let candidates = (operation.tiles)(limits, *units).iter().map(ToString::to_string).collect();
                units.tiles = self.fastest(operation, units.factor, candidates);
            }
            for (factor, tiles) in (operation.chosen_on_lanes)(&mut arithmetic) {
                let candidates = (operation.lane_tiles)(limits, factor).iter().map(ToString::to_string).collect();
                *tiles = self.fastest(operation, factor, candidates);
            }
        }
        arithmetic
    }

    fn fastest(&self, operation: &Operation, factor: Element, candidates: Vec<String>) -> Tiles {
        let mut tiles = Tiles::default();
        for class in 0..Tiles::CLASSES {
            let is_it = |m: &&Measured| m.is_of(operation, factor) && m.values == Tiles::values(class);
            let best = self.measured.iter().find(is_it).and_then(Measured::best);
            if let Some(index) = best.and_then(|best| candidates.iter().position(|name| name == best)) {
                tiles.set_from(class, index);
            }
        }
        tiles
    }
}

struct Timed {
    operation: &'static Operation,
    candidate: Candidate,
    name: String,
}

impl Timed {
    fn full_name(&self) -> String {
        format!("{} {} {}", self.operation.name, self.candidate.factor().name(), self.name)
    }

    /// Times by size; `None` for wrong lane tiles.
    fn times(&self, device: &Device) -> Result<Option<Vec<(usize, f64)>>> {
        let (operation, candidate) = (self.operation, self.candidate);
        if let Candidate::Lanes(lanes, Some(_)) = candidate {
            for (_, output) in (operation.kernels)(false, lanes.element) {
                if (operation.deviation)(device, candidate, output)?.is_none_or(|deviation| deviation > 1.0) {
                    return Ok(None);
                }
            }
        }
        let mut times = Vec::new();
        for values in (0..Tiles::CLASSES).map(Tiles::values) {
            let run = (operation.timed)(device, candidate, values / COLUMNS);
            let ms = match run.and_then(|run| median(device, operation, run)) {
                Err(Error::Memory { .. }) if !times.is_empty() => break,
                ms => ms?,
            };
            times.push((values, ms));
            if ms > LONGEST {
                break;
            }
        }
        Ok(Some(times))
    }
}

/// Median milliseconds, after a warm-up against lowered GPU clocks.
fn median(device: &Device, operation: &Operation, mut run: Run) -> Result<f64> {
    let mut once = || -> Result<f64> {
        let profile = run.profile()?;
        let kernels = profile.rows.iter().filter(|row| row.kernel.contains(operation.name));
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
