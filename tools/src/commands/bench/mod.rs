mod depth;
mod effects;
mod forward;
mod parts;
mod peak;
mod python;
mod refine;
mod render;
mod tradeoff;

use crate::session::Session;
use clap::{Args, Subcommand};
use serde::Serialize;
use std::{collections::HashMap, fmt, time::Duration};
use zipsplat::{
    Result,
    gpu::{Device, Profile, ProfileRow},
};

/// Measure speed: network, depth, rendering and refinement, peak rates, and quality over time
#[derive(Args)]
#[command(after_help = "Examples:
  zipsplat bench forward --weights seeded:vits --views 2,4,8 --ratio 1,auto
  zipsplat bench depth --weights seeded:da3-small --views 4,24 --input-size 252x252,504x336
  zipsplat bench peak
  zipsplat bench render --gaussians 36000,102000 --size 252x252,1920x1080
  zipsplat bench refine --gaussians 102000 --size 252x252
  zipsplat bench tradeoff capture/ -o report/

Times by stage and kernel are timestamps around each dispatch, which keep dispatches from
overlapping. Totals are measured on the host, without timestamps.")]
pub struct Bench {
    #[command(subcommand)]
    what: What,
}

#[derive(Subcommand)]
enum What {
    Depth(depth::Depth),
    Forward(forward::Forward),
    Peak(peak::Peak),
    Refine(refine::Refine),
    Render(render::Render),
    Tradeoff(Box<tradeoff::Tradeoff>),
}

const MOST: i64 = 1_000_000;
/// Limit by host memory.
const MOST_GAUSSIANS: i64 = 50_000_000;

#[derive(Args, Clone, Copy)]
struct Repeats {
    /// Untimed runs before the measurement
    #[arg(long, value_name = "N", default_value = "5", value_parser = clap::value_parser!(u32).range(..=MOST))]
    warmup: u32,
    /// Timed runs
    #[arg(long, value_name = "N", default_value = "20", value_parser = clap::value_parser!(u32).range(1..=MOST))]
    repeats: u32,
}

impl Repeats {
    fn words(self) -> [String; 2] {
        [self.warmup, self.repeats].map(|number| number.to_string())
    }
}

impl Bench {
    pub fn run(&self, session: &mut Session<'_>) -> Result<()> {
        match &self.what {
            What::Depth(bench) => bench.run(session),
            What::Forward(bench) => bench.run(session),
            What::Peak(bench) => bench.run(session),
            What::Refine(bench) => bench.run(session),
            What::Render(bench) => bench.run(session),
            What::Tradeoff(bench) => bench.run(session),
        }
    }
}

fn timed_device(session: &mut Session<'_>) -> Result<Device> {
    let device = session.device()?;
    device.limits().check_timestamps()?;
    Ok(device)
}

#[derive(Clone, Copy, Debug, Default, Serialize)]
struct Spread {
    median: f64,
    min: f64,
    max: f64,
}

impl Spread {
    fn of(times: impl IntoIterator<Item = Duration>) -> Self {
        Self::of_ms(times.into_iter().map(|time| 1e3 * time.as_secs_f64()).collect())
    }

    fn of_ms(mut ms: Vec<f64>) -> Self {
        ms.sort_by(f64::total_cmp);
        let middle = |i: usize| ms.get(i).copied().unwrap_or(f64::NAN);
        let median = (middle(ms.len().saturating_sub(1) / 2) + middle(ms.len() / 2)) / 2.0;
        Self { median, min: middle(0), max: middle(ms.len().saturating_sub(1)) }
    }

    /// Billions of operations or bytes per second, at the median.
    fn rate(&self, count: u64) -> f64 {
        count as f64 / (1e6 * self.median.max(1e-6))
    }
}

fn percent(share: Option<f64>) -> String {
    share.map_or_else(String::new, |share| format!("{:.1} %", 100.0 * share))
}

impl fmt::Display for Spread {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{:.3} ({:.3}..{:.3})", self.median, self.min, self.max)
    }
}

struct Group {
    name: String,
    count: u32,
    flops: u64,
    /// Tensor bytes, each once per command.
    bytes: u64,
    ms: Spread,
}

impl Group {
    fn of(name: &str, ms: Spread) -> Self {
        Self { name: name.to_owned(), count: 0, flops: 0, bytes: 0, ms }
    }
}

fn group(profiles: &[Profile], name: impl Fn(&ProfileRow) -> String) -> Vec<Group> {
    let mut order: Vec<String> = Vec::new();
    let mut known: HashMap<String, ([u64; 3], Vec<Duration>)> = HashMap::new();
    for (run, profile) in profiles.iter().enumerate() {
        for row in &profile.rows {
            let (sums, times) = known.entry(name(row)).or_insert_with_key(|name| {
                order.push(name.clone());
                ([0; 3], vec![Duration::ZERO; profiles.len()])
            });
            times[run] += row.time;
            if run == 0 {
                sums.iter_mut().zip([row.count.into(), row.flops, row.bytes]).for_each(|(sum, value)| *sum += value);
            }
        }
    }
    let finish = |name: String| {
        let ([count, flops, bytes], times) = known.remove(&name).unwrap_or_default();
        Group { name, count: count as u32, flops, bytes, ms: Spread::of(times) }
    };
    order.into_iter().map(finish).collect()
}

fn pass(row: &ProfileRow) -> String {
    match row.scope.split('/').nth(1) {
        Some("by_depth") => "sort by depth".into(),
        Some("by_tile") => "sort by tile".into(),
        _ => row.kernel.clone(),
    }
}

fn stage_of(row: &ProfileRow) -> String {
    row.scope.split('/').next().unwrap_or_default().to_owned()
}
