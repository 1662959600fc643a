//! `zipsplat info --plan`: the map of the arena.

use super::Info;
use crate::{
    options::{Quality, Size},
    session::Session,
    table::{Table, bytes, counted},
};
use indicatif::HumanCount;
use serde_json::json;
use zipsplat::{
    Error, Result,
    gpu::{Device, Limits, Recorder},
    reconstruct::{Network, Shape},
};

/// Tensors that are shown where not all are asked for.
const LARGEST: usize = 20;

pub fn show(session: &mut Session<'_>, info: &Info, views: usize) -> Result<()> {
    let Quality { ratio, select, arithmetic, .. } = &info.quality;
    let checkpoint = info.weights.open()?;
    checkpoint.notes().iter().for_each(|note| session.note(note));
    info.quality.check(checkpoint.architecture())?;
    let size = info.quality.size_for(&checkpoint);
    let Size(width, height) = size;
    let shape = Shape::new(checkpoint.architecture(), views, [width, height], (*ratio, select), info.poses)?;
    let device = device(session)?;
    let limits = device.as_ref().map_or_else(Limits::default, |device| device.limits().clone());
    let (precision, arithmetic) = match &device {
        Some(device) => arithmetic.choose(session, device)?,
        None => arithmetic.planned(&limits),
    };
    let network = Network::new(checkpoint.architecture(), &limits, arithmetic);
    let mut rec = Recorder::new(&limits);
    network.record(&mut rec, shape);
    let plan = rec.finish()?;

    let (weights, arena) = (network.weight_bytes(), plan.arena_bytes());
    let mut rows = plan.arena_map();
    let json = json!({
        "device": limits.name, "views": views, "tokens": shape.tokens, "commands": plan.len(), "flops": plan.flops(),
        "precision": precision.name(), "peak_bytes": weights + arena, "weight_bytes": weights, "arena_bytes": arena, "rows": rows,
    });
    let count = rows.len();
    if !info.all {
        rows.sort_by_key(|row| std::cmp::Reverse(row.bytes));
        rows.truncate(LARGEST);
    }
    let mut table = Table::new(1, &["tensor", "bytes", "block", "offset", "first use", "last use"]);
    for row in &rows {
        let numbers = [row.bytes, row.block.into(), row.offset, row.first_use.into(), row.last_use.into()];
        let [bytes, block, offset, first, last] = numbers.map(|n| n.to_string());
        table.row([row.name.clone(), bytes, block, offset, first, last]);
    }
    let mut text = format!(
        "{} of {size}, {} of {}, {} precision, on {}: {} at most\n",
        counted(views, "view"),
        HumanCount(shape.tokens as u64),
        counted(shape.grid.tokens(), "token"),
        precision.name(),
        if limits.name == Limits::default().name { "an ordinary device" } else { &limits.name },
        bytes(weights + arena)
    );
    text += &format!(
        "weights {}, arena {}; {} commands, {:.1} GFLOP\n\n{table}",
        bytes(weights),
        bytes(arena),
        plan.len(),
        plan.flops() as f64 / 1e9
    );
    if rows.len() < count {
        text += &format!("and {}: --all shows them", counted(count - rows.len(), "smaller tensor"));
    }
    session.report(&json, text)
}

/// The device; none where there is none and none was asked for, or where the plan is to be an ordinary device's.
fn device(session: &mut Session<'_>) -> Result<Option<Device>> {
    if session.plans_for_none() {
        return Ok(None);
    }
    match session.device() {
        Ok(device) => Ok(Some(device)),
        Err(Error::NoDevice(why)) if !session.names_device() => {
            session.note(format!("planned for an ordinary device: {why}"));
            Ok(None)
        }
        Err(error) => Err(error),
    }
}
