use crate::{
    prelude::*,
    render::backward::rasterize::{self, HEIGHT, Lists, Share, Splat, WIDTH, pixel, pixels, splats, tiles},
};
use zipsplat::{
    gpu::Tensor,
    kernels::{
        features::{Draw, Gather, Lift},
        limits::TILE,
    },
};
use zipsplat_reference::{features, render::backward::Ellipse};

const REASON: &str = "running error analysis of blending, pixel by pixel, times the values, then gamma of the additions; \
    pixels where rounding may move an alpha or a transmittance over a threshold do not count, and may draw any value";

/// Vectors of lifted values, more than a workgroup's lanes, and of drawn ones.
const VECTORS: usize = 37;
const DRAWN: usize = 4;
const LIFTED: usize = 4 * VECTORS;
const CHANNELS: usize = 4 * DRAWN;
const CELLS: [u32; 2] = [20, 12];
/// A cell without values.
const EMPTY: usize = 110;

struct Problem {
    splats: Vec<Splat>,
    group: usize,
    /// `[rows, CHANNELS]`.
    features: Vec<f32>,
    /// `[cells, LIFTED]`.
    values: Vec<f32>,
}

#[derive(Clone, Copy, Debug, PartialEq)]
enum Fault {
    Unwritten,
    HalfResult,
    NeverStops,
    FaintDrawn,
    NeighborRow,
    NeighborChannel,
    NeighborCell,
    EmptyCounts,
    LastPixelRow,
}

impl Problem {
    fn new(splats: Vec<Splat>, group: usize) -> Self {
        let mut noise = Noise::new((splats.len() + group) as u64);
        let features = noise.values(splats.len() / group * CHANNELS);
        let mut values = noise.values((CELLS[0] * CELLS[1]) as usize * LIFTED);
        let unstable = pixels().filter(|(_, at)| shares(&splats, *at, None).is_none()).map(|(_, at)| cell(at));
        for cell in unstable.chain([EMPTY]) {
            values[cell * LIFTED..][..LIFTED].fill(f32::NAN);
        }
        Self { splats, group, features, values }
    }

    fn rows(&self) -> usize {
        self.splats.len() / self.group
    }

    fn ellipses(&self) -> Vec<Ellipse> {
        self.splats.iter().map(Splat::ellipse).collect()
    }

    /// Pictures, lifted values and totals, from the weights at every pixel.
    fn of(&self, weights: impl Fn([f64; 2]) -> Vec<f64>, values: impl Fn(usize) -> Vec<f64>) -> Vec<f64> {
        let (mut pictures, features) = (Vec::new(), widen(&self.features));
        let (mut lifted, mut totals) = (vec![0.0; self.rows() * LIFTED], vec![0.0; self.rows()]);
        for (_, at) in pixels() {
            let weights = weights(at);
            pictures.extend(features::draw(&weights, &features, CHANNELS, self.group));
            features::lift(&weights, &values(cell(at)), self.group, &mut lifted, &mut totals);
        }
        [pictures, lifted, totals].concat()
    }

    fn values_of(&self, cell: usize) -> Vec<f64> {
        widen(&self.values[cell * LIFTED..][..LIFTED])
    }

    fn magnitudes(&self, weights: impl Fn([f64; 2]) -> Vec<f64>) -> Vec<f64> {
        let absolute = |values: &[f32]| values.iter().map(|value| value.abs()).collect();
        let (features, values) = (absolute(&self.features), absolute(&self.values));
        Self { splats: self.splats.clone(), group: self.group, features, values }.sums(weights)
    }

    fn sums(&self, weights: impl Fn([f64; 2]) -> Vec<f64>) -> Vec<f64> {
        self.of(weights, |cell| self.values_of(cell))
    }

    fn record(&self, trial: &mut Trial<'_>, device: &Device) -> [Tensor; 3] {
        let ([columns, rows], count) = (tiles(), self.splats.len() as u32);
        let Lists { pair_indices, tile_offsets, tile_sets, slots } = Lists::record(trial, count);
        let of = |values: &dyn Fn(&Splat) -> [f32; 3]| self.splats.iter().map(values).collect::<Vec<_>>();
        let (capacity, lanes) = (count as usize * columns * rows, device.limits().subgroup_size);
        let xy_opacities = trial.input(&of(&|splat| [splat.place[0], splat.place[1], splat.opacity]));
        let conics = trial.input(&of(&|splat| splat.conic));
        let pictures = trial.output::<f32>((WIDTH * HEIGHT) as usize * CHANNELS);
        let (size, grid, runs) = ([WIDTH, HEIGHT], [columns as u32, rows as u32], TILE * TILE / lanes);
        let draw = Draw {
            pair_indices,
            tile_offsets,
            xy_opacities,
            conics,
            features: trial.input(&self.features),
            pictures,
            size,
            grid,
            first_tile_row: 0,
            group: self.group as u32,
            runs,
            vectors: DRAWN as u32,
        };
        trial.rec.dispatch_groups(draw, [grid[0], grid[1], 1]);
        let (sums, totals) = (trial.output::<f32>(capacity * LIFTED), trial.output::<f32>(capacity));
        let lift = Lift {
            pair_indices,
            tile_offsets,
            tile_sets,
            slots,
            xy_opacities,
            conics,
            values: trial.input(&self.values),
            sums,
            totals,
            size,
            grid,
            cells: CELLS,
            first_tile_row: 0,
            vectors: VECTORS as u32,
            capacity: capacity as u32,
            runs,
        };
        trial.rec.dispatch_groups(lift, [grid[0], grid[1], (VECTORS as u32).div_ceil(lanes)]);
        let (lifted, row_totals) = (trial.output::<f32>(self.rows() * LIFTED), trial.output::<f32>(self.rows()));
        trial.rec.fill(lifted, 0);
        trial.rec.fill(row_totals, 0);
        let gather = Gather {
            slots,
            status: trial.input(&[1u32, 1, 0]),
            sums,
            totals,
            lifted,
            row_totals,
            gaussians: count,
            group: self.group as u32,
            rows: self.rows() as u32,
            vectors: VECTORS as u32,
        };
        trial.rec.dispatch(gather, self.rows() * VECTORS);
        [pictures, lifted, row_totals]
    }
}

fn cell([x, y]: [f64; 2]) -> usize {
    let [x, y] = [x as u32 * CELLS[0] / WIDTH, y as u32 * CELLS[1] / HEIGHT];
    (y * CELLS[0] + x) as usize
}

/// Returns the shares of splats in a pixel's red, which are weights.
fn shares(splats: &[Splat], at: [f64; 2], fault: Option<rasterize::Fault>) -> Option<Vec<Share>> {
    let unit = [1.0, 0.0, 0.0, 0.0, 0.0].map(Bounded::exact);
    pixel(splats, at, [0.0; 5], unit, fault)
}

/// Red, in a pixel's gradients.
const RED: usize = 6;

impl Values for Problem {
    type Fault = Fault;

    fn compute(&self, device: &Device, _: Mode) -> Result<Vec<f32>> {
        let mut trial = Trial::new(device);
        let outputs = self.record(&mut trial, device);
        Ok(trial.results(outputs)?.concat())
    }

    fn truth(&self, _: Mode) -> [Vec<f64>; 2] {
        let ellipses = self.ellipses();
        let truth = self.sums(|at| features::weights(&ellipses, at));
        let count = self.splats.len();
        // Any weight, where rounding may decide.
        let error = |at| shares(&self.splats, at, None).map_or(vec![1.0; count], |all| errors(&all));
        let magnitude = |at| {
            let values = |all: Vec<Share>| all.iter().map(|share| share[RED].value + share[RED].error).collect();
            shares(&self.splats, at, None).map_or(vec![1.0; count], values)
        };
        let additions = gamma((TILE * TILE) as usize + count + tiles()[0] * tiles()[1] * self.group);
        let sums = self.magnitudes(magnitude);
        let bounds = self.magnitudes(error).into_iter().zip(sums).map(|(error, sum)| error + additions * sum + TINY);
        [truth, bounds.collect()]
    }

    fn faulty(&self, truth: &[f64], fault: Fault) -> Vec<f64> {
        let ellipses = self.ellipses();
        let weights = |at: [f64; 2]| features::weights(&ellipses, at);
        let of_fault = |fault: rasterize::Fault| {
            self.sums(|at| shares(&self.splats, at, Some(fault)).into_iter().flatten().map(|s| s[RED].value).collect())
        };
        let pictures = (WIDTH * HEIGHT) as usize * CHANNELS;
        let (drawn, lifted) = truth.split_at(pictures);
        match fault {
            Fault::Unwritten => vec![f64::NAN; truth.len()],
            Fault::HalfResult => halves(truth),
            Fault::NeverStops => of_fault(rasterize::Fault::NeverStops),
            Fault::FaintDrawn => of_fault(rasterize::Fault::FaintDrawn),
            Fault::NeighborRow => [drawn.to_vec(), shifted(lifted, LIFTED)].concat(),
            Fault::NeighborChannel => [shifted(drawn, 1), lifted.to_vec()].concat(),
            Fault::NeighborCell => self.of(weights, |cell| self.values_of(cell ^ 1)),
            Fault::EmptyCounts => {
                let zero = |values: Vec<f64>| if values[0].is_nan() { vec![0.0; LIFTED] } else { values };
                self.of(weights, |cell| zero(self.values_of(cell)))
            }
            Fault::LastPixelRow => self.sums(|at| {
                let last = at[1] + 1.0 > f64::from(HEIGHT);
                if last { vec![0.0; self.splats.len()] } else { weights(at) }
            }),
        }
    }
}

fn errors(shares: &[Share]) -> Vec<f64> {
    shares.iter().map(|share| share[RED].error).collect()
}

pub fn area() -> Area {
    use Fault::*;
    let mut area = Area::new("features", "splats", Mode::ONLY_EXACT, REASON);
    let mut add = |name: &str, catches: Catches<Fault>, count: usize, group: usize, change: fn(usize, &mut Splat)| {
        area.add(name, count, catches, move || Problem::new(splats(count, change), group));
    };
    let all = || Catches::from([Unwritten, HalfResult, NeighborChannel, NeighborCell, LastPixelRow]);
    add("one", all().and(&[EmptyCounts]), 1, 1, |_, splat| (splat.opacity, splat.conic) = (0.8, [0.01, 0.0, 0.01]));
    add("random", all().and(&[NeighborRow, FaintDrawn, EmptyCounts]), 100, 1, |_, _| ());
    add("groups of four", all().and(&[NeighborRow]), 60, 4, |_, _| ());
    add("opaque stacks", all().and(&[NeverStops]), 50, 2, |_, splat| {
        (splat.opacity, splat.conic) = (1.0, [1e-5, 0.0, 1e-5]);
    });
    add("nothing visible", [Unwritten, FaintDrawn].into(), 30, 1, |_, splat| splat.opacity = 0.003);
    area
}
