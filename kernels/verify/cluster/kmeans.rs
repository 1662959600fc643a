use super::{
    kernel,
    nearest::{self, Chosen, host_origin},
};
use crate::prelude::*;
use zipsplat::{gpu::Tensor, ops::Nearest, stages::cluster};
use zipsplat_reference::cluster::{kmeans::kmeans, mean::mean};

const REASON: &str = "coordinates are whole multiples of 2^-6 whose squared distances f32 holds exactly, and clusters have a \
    power of two of members, so that every mean and every tie is as in f64: assignments must be equal. The nearest tokens \
    then as in cluster/nearest";

const WIDTH: usize = 8;

/// Tokens `[_, WIDTH]` and number of clusters.
struct Problem {
    x: Vec<f32>,
    k: usize,
}

struct Found {
    /// Token nearest to each centroid, final assignment.
    runs: Vec<[Vec<u32>; 2]>,
    origin: Option<Vec<f32>>,
}

struct Truth {
    assigned: Vec<u32>,
    centroids: Vec<f32>,
    nearest: nearest::Truth,
}

#[derive(Clone, Copy, Debug)]
enum Fault {
    LastTokenMoved,
    LastOfEqual,
    NextToken,
    LastMember,
    EmptyStays,
    NoRounds,
    OtherEveryRun,
}

impl Problem {
    fn run(&self, device: &Device, mode: Mode) -> Result<[Vec<u32>; 2]> {
        let count = self.x.len() / WIDTH;
        let mut trial = Trial::new(device);
        trial.rec = trial.rec.observing();
        let tokens = Rows::new(trial.input(&self.x), count, WIDTH);
        let initial = trial.input(&cluster::even_indices(count, self.k));
        let nearest = cluster::record(&mut trial.rec, kernel(mode, device), tokens, initial, self.k, cluster::ROUNDS);
        trial.rec.output(nearest);
        let run = trial.run()?;
        let observed = |what: &str| -> Option<Tensor> {
            run.observed().iter().find(|(name, _)| name.ends_with(what)).map(|(_, tensor)| *tensor)
        };
        let assigned = observed("assign").map(|tensor| run.read(tensor)).transpose()?.unwrap_or_default();
        Ok([run.read(nearest)?, assigned])
    }

    fn origin(&self, device: &Device, mode: Mode) -> Result<Option<Vec<f32>>> {
        let mut trial = Trial::new(device);
        let rows = Rows::new(trial.input(&self.x), self.x.len() / WIDTH, WIDTH);
        let Some(origin) = Nearest::among(&mut trial.rec, kernel(mode, device), rows).origin() else {
            return Ok(None);
        };
        Ok(Some(trial.result(origin)?))
    }

    fn nearest_to(&self, centroids: &[f64]) -> Vec<u32> {
        let centroids: Vec<f32> = centroids.iter().map(|&c| c as f32).collect();
        nearest::Truth::new(&centroids, &self.x, WIDTH).first()
    }

    fn initial(&self) -> Vec<f64> {
        let indices = cluster::even_indices(self.x.len() / WIDTH, self.k);
        indices.iter().flat_map(|&i| widen(&self.x[i as usize * WIDTH..][..WIDTH])).collect()
    }

    fn without_last_members(&self, assigned: &[u32]) -> Vec<f64> {
        let mut without = assigned.to_vec();
        for cluster in 0..self.k as u32 {
            if let Some(last) = assigned.iter().rposition(|&a| a == cluster) {
                without[last] = self.k as u32;
            }
        }
        let mut centroids = mean(&widen(&self.x), &without, self.k + 1, WIDTH);
        centroids.truncate(self.k * WIDTH);
        centroids
    }
}

impl case::Problem for Problem {
    type Output = Found;
    type Truth = Truth;
    type Fault = Fault;

    fn compute(&self, device: &Device, mode: Mode) -> Result<Found> {
        let runs = [0; 3].map(|_| self.run(device, mode)).into_iter().collect::<Result<_>>()?;
        Ok(Found { runs, origin: self.origin(device, mode)? })
    }

    fn truth(&self, _: Mode) -> Truth {
        let found = kmeans(&widen(&self.x), WIDTH, self.k);
        let centroids: Vec<f32> = found.centroids.iter().map(|&c| c as f32).collect();
        let nearest = nearest::Truth::new(&centroids, &self.x, WIDTH);
        Truth { assigned: found.assignments.last().cloned().unwrap_or_default(), centroids, nearest }
    }

    fn judge(&self, truth: &Truth, output: &Found, _: Mode) -> Worst {
        let [nearest, assigned] = &output.runs[0];
        let chosen = Chosen { targets: nearest.clone(), origin: output.origin.clone() };
        let equal = output.runs.iter().map(|run| Worst::differing(&run.concat(), &output.runs[0].concat()));
        let worst = Worst::differing(assigned, &truth.assigned).or(truth.nearest.excess(&chosen, WIDTH));
        equal.fold(worst, Worst::or)
    }

    fn faulty(&self, truth: &Truth, fault: Fault, mode: Mode) -> Vec<Found> {
        let (mut nearest, mut assigned) = (truth.nearest.first(), truth.assigned.clone());
        let count = (self.x.len() / WIDTH) as u32;
        // Hidden by matrix-unit rounding.
        if matches!(fault, Fault::LastMember) && mode.matrix {
            return Vec::new();
        }
        match fault {
            Fault::LastTokenMoved => assigned.iter_mut().last().into_iter().for_each(|a| *a += 1),
            Fault::LastOfEqual => {
                let initial = self.initial();
                let same = |a: u32, b: usize| initial[a as usize * WIDTH..][..WIDTH] == initial[b * WIDTH..][..WIDTH];
                for a in &mut assigned {
                    *a = (0..self.k).rev().find(|&b| same(*a, b)).unwrap_or(0) as u32;
                }
            }
            Fault::NextToken => nearest.iter_mut().for_each(|token| *token = (*token + 1) % count),
            Fault::LastMember => nearest = self.nearest_to(&self.without_last_members(&assigned)),
            Fault::EmptyStays => {
                let mut centroids: Vec<f64> = truth.centroids.iter().map(|&c| c.into()).collect();
                for (cluster, initial) in self.initial().chunks(WIDTH).enumerate() {
                    if !assigned.contains(&(cluster as u32)) {
                        centroids[cluster * WIDTH..][..WIDTH].copy_from_slice(initial);
                    }
                }
                nearest = self.nearest_to(&centroids);
            }
            Fault::NoRounds => nearest = cluster::even_indices(count as usize, self.k),
            Fault::OtherEveryRun => {}
        }
        let mut runs = vec![[nearest, assigned]; 3];
        if matches!(fault, Fault::OtherEveryRun) {
            runs[2][1][0] += 1;
        }
        vec![Found { runs, origin: host_origin(mode, &self.x, WIDTH) }]
    }
}

pub fn area() -> Area {
    use Fault::*;
    let mut area = Area::new("cluster", "tokens", Mode::NEAREST, REASON);
    let mut add = |name: &str, count: usize, k: usize, catches: Catches<Fault>, value: fn(usize, f32) -> f32| {
        let make = move || {
            let noise = Noise::new(count as u64).values(count * WIDTH).into_iter().enumerate();
            Problem { x: noise.map(|(i, r)| value(i / WIDTH, (r * 64.0).round() / 64.0)).collect(), k }
        };
        area.add(name, count, catches, make);
    };
    // Well-separated blobs: rounding cannot change an assignment.
    for count in [64, 512, 4096] {
        let blobs = || Catches::from([LastTokenMoved, NextToken, NoRounds, LastMember, OtherEveryRun]);
        add("blobs", count, count / 16, blobs(), |token, r| (token / 16 * 8) as f32 + r);
        add("blobs around 1e4", count, count / 16, blobs(), |token, r| 1e4 + (token / 16 * 8) as f32 + r);
    }
    let each = || Catches::from([LastTokenMoved, NextToken, OtherEveryRun]);
    add("K = 1", 64, 1, each().and(&[NoRounds]), |_, r| r);
    add("K = N", 33, 33, each(), |token, r| token as f32 + r);
    add("K = N - 1", 64, 63, each(), |token, r| (4 * token) as f32 + r);
    let equal = || Catches::from([LastTokenMoved, LastOfEqual, OtherEveryRun]);
    add("duplicates, empty clusters", 128, 40, equal().and(&[EmptyStays]), |token, _| (token % 4) as f32);
    add("all tokens equal", 64, 9, equal().and(&[NextToken]), |_, _| 0.5);
    area
}
