mod list;
mod report;
mod tune;

use crate::{outputs::Overwrite, session::Session, table::Table};
use clap::{Args, Subcommand};
use serde::Serialize;
use std::path::PathBuf;
use zipsplat::{Error, Result, gpu::Limits, types::write_atomic};
use zipsplat_verify::{Finding, Worst, catalog};

const OUTSIDE: u8 = 5;

/// Check this device and driver: kernels on hard inputs against f64
#[derive(Args)]
#[command(
    args_conflicts_with_subcommands = true,
    after_help = "Error bounds follow from the number formats and from the precision that Vulkan
guarantees, so a correct driver passes. Exit code 5: the device computes wrong results.
Prints the worst case of each kernel and mode, and every failed case; --verbose prints
all cases, --json also the faults that each case catches.

Examples:
  zipsplat doctor
  zipsplat doctor --device 1 --report doctor.html
  zipsplat doctor --only ops/attention --json
  zipsplat doctor list
  zipsplat doctor tune"
)]
pub struct Doctor {
    #[command(subcommand)]
    task: Option<Task>,
    /// Only kernels whose name contains this
    #[arg(long, value_name = "KERNEL")]
    only: Option<String>,
    /// Print every case, not only each kernel's worst
    #[arg(long)]
    verbose: bool,
    /// Write a page that plots error and bound over problem size
    #[arg(long, value_name = "FILE.html")]
    report: Option<PathBuf>,
    #[command(flatten)]
    overwrite: Overwrite,
}

#[derive(Subcommand)]
enum Task {
    List(List),
    Tune(tune::Tune),
}

/// List Vulkan devices, and why any is unusable
#[derive(Args)]
struct List {}

#[derive(Serialize)]
struct Report<'a> {
    device: &'a Limits,
    seconds: f64,
    outside: usize,
    findings: &'a [Finding],
}

impl Doctor {
    pub fn run(&self, session: &mut Session<'_>) -> Result<()> {
        match &self.task {
            Some(Task::List(_)) => return list::devices(session),
            Some(Task::Tune(tune)) => return tune.run(session),
            None => {}
        }
        if let Some(path) = &self.report {
            self.overwrite.check_file(path)?;
        }
        let device = session.device()?;
        let wanted = |kernel: &str| self.only.as_ref().is_none_or(|only| kernel.contains(only.as_str()));
        let areas: Vec<_> = catalog().into_iter().filter(|area| wanted(area.kernel)).collect();
        if areas.is_empty() {
            let known = catalog().iter().map(|area| area.kernel).collect::<Vec<_>>().join(", ");
            return Err(Error::argument(
                "--only",
                self.only.as_deref().unwrap_or_default(),
                format!("a part of {known}"),
            ));
        }
        let all: usize = areas.iter().map(|area| area.on(device.limits()).count()).sum();
        let ((findings, lost_by), time) = session.stage("doctor", |stage| {
            let mut findings = Vec::with_capacity(all);
            for area in &areas {
                stage.name(area.kernel);
                for (case, mode) in area.on(device.limits()) {
                    stage.reach(findings.len() as f64 / all as f64)?;
                    match area.examine(case, &device, mode) {
                        Err(Error::DeviceLost) => {
                            let by = format!("{}, {}, {}", area.kernel, case.name, mode.name());
                            return Ok((findings, Some(by)));
                        }
                        finding => findings.push(finding?),
                    }
                }
            }
            Ok((findings, None))
        })?;
        if let Some(path) = &self.report {
            let page = report::page(device.limits(), &areas, &findings);
            write_atomic(path, |out| out.write_all(page.as_bytes()))?;
        }
        let outside = findings.iter().filter(|finding| !finding.holds).count();
        let seconds = time.as_secs_f64();
        session.report(
            &Report { device: device.limits(), seconds, outside, findings: &findings },
            self.text(device.limits(), &findings, outside, seconds),
        )?;
        if let Some(case) = lost_by {
            session.note(format!("the device was lost by {case}: what comes after it has not been tried"));
            return Err(Error::DeviceLost);
        }
        if outside > 0 {
            session.code = OUTSIDE;
        }
        Ok(())
    }

    fn text(&self, limits: &Limits, findings: &[Finding], outside: usize, seconds: f64) -> String {
        let table = if self.verbose { every(findings) } else { worst(findings) };
        let verdict = match outside {
            0 => "every result is within its bound".to_owned(),
            n => format!("{n} OUTSIDE: what this device computes cannot be trusted"),
        };
        format!("{table}{}, {}: {} cases in {seconds:.1} s, {verdict}", limits.name, limits.driver, findings.len())
    }
}

fn every(findings: &[Finding]) -> Table {
    let mut table = Table::new(3, &["kernel", "case", "mode", "size", "worst error", "bound", "share", ""]);
    for finding in findings {
        let [size, error, bound, share, verdict] = cells(finding);
        let (kernel, mode) = (finding.kernel.to_owned(), finding.mode.name().to_owned());
        table.row([kernel, finding.case.clone(), mode, size, error, bound, share, verdict]);
    }
    table
}

fn worst(findings: &[Finding]) -> Table {
    let heads = ["kernel", "mode", "worst case", "cases", "size", "worst error", "bound", "share", ""];
    let mut table = Table::new(3, &heads);
    for alike in findings.chunk_by(|a, b| a.kernel == b.kernel && a.mode == b.mode) {
        let most = alike.iter().reduce(|a, b| if b.worst.share > a.worst.share { b } else { a });
        let shown =
            alike.iter().filter(|&finding| !finding.holds || most.is_some_and(|most| std::ptr::eq(finding, most)));
        for finding in shown {
            let [size, error, bound, share, verdict] = cells(finding);
            let (kernel, mode) = (finding.kernel.to_owned(), finding.mode.name().to_owned());
            let count = alike.len().to_string();
            table.row([kernel, mode, finding.case.clone(), count, size, error, bound, share, verdict]);
        }
    }
    table
}

fn cells(finding: &Finding) -> [String; 5] {
    let Worst { error, bound, share, .. } = finding.worst;
    let number = |x: f64| if x == 0.0 { "0".into() } else { format!("{x:.1e}") };
    let verdict = match &finding.failed {
        Some(failed) => failed.clone(),
        None if finding.holds => String::new(),
        None => "OUTSIDE".into(),
    };
    [finding.size.to_string(), number(error), number(bound), format!("{:.1} %", 100.0 * share), verdict]
}
