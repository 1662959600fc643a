use super::Reconstruct;
use crate::{
    blocks,
    cameras::KnownCameras,
    depth::square,
    options::{ArithmeticOption, DEPTH_WEIGHTS, Network as Weights, Quality, Size, refuse_all},
    photos,
    session::{Session, refuse_tokens},
    table::{Table, bytes, counted},
};
use indicatif::HumanCount;
use serde_json::json;
use std::path::PathBuf;
use zipsplat::{
    Error, Result,
    depth::DepthNetwork,
    gpu::{Arena, ArenaRow, Limits, Plan},
    ops::{Arithmetic, Precision},
    reconstruct::{KvPool, Network, NetworkPlan},
    refine::{Moved, RefinePlan, plan_refinement},
    stages::render::{RenderOptions, plan_pictures},
    types::poses::CaptureView,
    weights::{Checkpoint, DepthCheckpoint},
};

/// Tensors shown by default.
const LARGEST: usize = 20;

pub fn show(session: &mut Session<'_>, command: &Reconstruct) -> Result<()> {
    let (photos, _folder) = match command.input.photos[..] {
        [] => (Vec::new(), None),
        _ => command.input.list(session, command.views, command.unposed(), None)?,
    };
    let limit = command.views.filter(|_| photos.is_empty() || command.unposed().is_none());
    let file = command.cameras.as_ref().filter(|_| !photos.is_empty() && command.unposed().is_none());
    let known = file.map(|file| KnownCameras::of(session, file, &photos, &command.finding));
    let mut known = known.transpose()?;
    let photos = photos::kept(session, photos, known.as_mut(), limit)?;
    let views = match (photos.len(), limit) {
        (0, None) => return Err(Error::argument("photos", "none", "photos, or their number by --views")),
        (0, Some(views)) => views as usize,
        (all, _) => all,
    };
    let frames = known.as_ref().map(|known| known.poses.frames_of(&photos)).transpose()?.unwrap_or_default();
    let network = command.weights.open_network()?;
    let posed = command.cameras.is_some() && !command.finds_by_itself(&network);
    match &network {
        Weights::Tokens(checkpoint) => show_tokens(session, command, checkpoint, &photos, &frames, views),
        Weights::Pixels(checkpoint) => show_depth(session, command, checkpoint, views, posed),
    }
}

fn show_tokens(
    session: &mut Session<'_>,
    command: &Reconstruct,
    checkpoint: &Checkpoint,
    photos: &[PathBuf],
    frames: &[&CaptureView],
    views: usize,
) -> Result<()> {
    let (quality, crop) = (&command.quality, command.crop.crop);
    session.notes(checkpoint.notes());
    quality.check(checkpoint.architecture())?;
    command.refine.check_target()?;
    let size = quality.size_for(checkpoint);
    let posed = command.cameras.is_some();
    crop.check(size, posed)?;
    let seen = if photos.is_empty() { views } else { crop.count(photos, frames)? };
    let (limits, precision, arithmetic) = target(session, &quality.arithmetic)?;
    let network = Network::of(checkpoint, &limits, arithmetic)?;
    let shape_of = |views: usize| quality.shape(checkpoint.architecture(), views, size, posed);
    let blocks = network.block_layout(&limits, seen, command.blocks.options(), shape_of)?;
    let shape = shape_of(blocks.size)?;
    let NetworkPlan { plan, tensors, layout } = network.plan(&limits, shape)?;
    let (joined, joined_bytes) = blocks.scene(&limits, shape, *tensors.scene());
    let pictures = |Size(width, height)| plan_pictures(&limits, &joined, [width, height], &RenderOptions::default());
    let pictures = command.picture_size()?.map(pictures).transpose()?;
    let refined = command.refine.steps().map(|steps| {
        let a = checkpoint.architecture();
        let gaussians = Moved::Gaussians(joined.len, joined.sh_degree);
        let passes = if steps.tokens { blocks.count } else { 1 };
        refuse_tokens(passes)?;
        let moved = if steps.tokens { Moved::Tokens(shape.tokens, a) } else { gaussians };
        plan_refinement(
            &limits,
            moved,
            views,
            command.refine.settings.largest(photos)?,
            command.finding.masks().is_some(),
            &command.refine.settings.planned(steps, command.antialiasing),
        )
    });
    let refined = refined.transpose()?;
    let kept = refined.as_ref().map_or(0, |refined| refined.kept_bytes);

    let (weights, scene) = (network.weight_bytes(), layout.bytes() + joined_bytes);
    let of_pictures = pictures.as_ref().map_or(0, Plan::arena_bytes);
    let of_refinement = refined.iter().flat_map(|refined| &refined.plans);
    let first_lane = Arena::lane_bytes([&plan].into_iter().chain(&pictures).chain(of_refinement));
    let arena = first_lane + (Arena::LANES as u64 - 1) * of_pictures;
    // Sum of separate arenas.
    let own = refined.as_ref().map_or(0, RefinePlan::arena_bytes);
    let separate = weights + scene + kept + plan.arena_bytes() + own + Arena::LANES as u64 * of_pictures;
    let peak = weights + scene + arena + kept;
    session.note_excess(peak, &limits);
    let rows = plan.arena_map();
    let (commands, flops) = (blocks.count * plan.len(), blocks.count as u64 * plan.flops());
    let all = seen * shape.grid.patches();
    let tokens = all.min(blocks.count * shape.tokens);
    let json = json!({
        "device": limits.name, "views": views, "tokens": tokens, "commands": commands, "flops": flops,
        "blocks": { "count": blocks.count, "size": blocks.size, "overlap": blocks.overlap },
        "precision": precision.name(), "peak_bytes": peak, "weight_bytes": weights,
        "refine_kept_bytes": refined.as_ref().map(|_| kept), "refine_arena_bytes": refined.as_ref().map(|_| own),
        "scene_bytes": scene, "arena_bytes": arena, "separate_bytes": separate, "rows": rows,
    });
    let (table, smaller) = table(rows, command.explain);
    let mut text = format!(
        "{} of {size}, {} of {}, {} precision, on {}: {} at most\n",
        counted(views, "view"),
        HumanCount(tokens as u64),
        counted(all, "token"),
        precision.name(),
        device_name(&limits),
        bytes(peak)
    );
    text += &blocks::plan_summary(&blocks).map_or(String::new(), |summary| format!("{summary}, a pass each\n"));
    text += &format!(
        "weights {}, Gaussians {}, arena {}{}; {commands} commands, {:.1} GFLOP\n\n{table}",
        bytes(weights),
        bytes(scene),
        bytes(arena),
        if pictures.is_some() || refined.is_some() {
            format!(" (in arenas of their own {} in all)", bytes(separate))
        } else {
            String::new()
        },
        flops as f64 / 1e9
    );
    if refined.is_some() {
        text += &format!(
            "\nrefinement: {} of Gaussians, gradients and moments beside these; of the arena it takes {}\n",
            bytes(kept),
            bytes(own)
        );
    }
    session.report(&json, text + &smaller)
}

fn show_depth(
    session: &mut Session<'_>,
    command: &Reconstruct,
    checkpoint: &DepthCheckpoint,
    views: usize,
    posed: bool,
) -> Result<()> {
    let options = [
        ("--pictures", command.pictures.is_some()),
        ("--refine", command.refine.steps().is_some()),
        ("--kv-pool", command.quality.kv_pool != KvPool::ALL),
    ];
    refuse_all(options, DEPTH_WEIGHTS, "weights of ZipSplat")?;
    let Quality { ratio, token_selection, arithmetic, .. } = &command.quality;
    let size = command.quality.input_size.unwrap_or(square(checkpoint));
    let (limits, precision, arithmetic) = target(session, arithmetic)?;
    let network = DepthNetwork::new(checkpoint.architecture(), &limits, arithmetic);
    let shape = network.shape(views, [size.0, size.1], *ratio, token_selection, posed, None)?;
    let (plan, _) = network.plan(&limits, shape)?;
    let (weights, arena, rows) = (network.weight_bytes(), plan.arena_bytes(), plan.arena_map());
    session.note_excess(weights + arena, &limits);
    let json = json!({
        "device": limits.name, "network": checkpoint.architecture().name, "views": views, "tokens": shape.tokens,
        "commands": plan.len(), "flops": plan.flops(), "precision": precision.name(), "peak_bytes": weights + arena,
        "weight_bytes": weights, "arena_bytes": arena, "rows": rows,
    });
    let (table, smaller) = table(rows, command.explain);
    let text = format!(
        "{}: depth of {} of {size}, {} precision, on {}: {} at most\nweights {}, arena {}; {} commands, {:.1} GFLOP\n\n{table}{smaller}",
        checkpoint.architecture().name,
        counted(views, "view"),
        precision.name(),
        device_name(&limits),
        bytes(weights + arena),
        bytes(weights),
        bytes(arena),
        plan.len(),
        plan.flops() as f64 / 1e9
    );
    session.report(&json, text)
}

fn table(mut rows: Vec<ArenaRow>, all: bool) -> (Table, String) {
    let count = rows.len();
    if !all {
        rows.sort_by_key(|row| std::cmp::Reverse(row.bytes));
        rows.truncate(LARGEST);
    }
    let mut table = Table::new(1, &["tensor", "bytes", "block", "offset", "first use", "last use"]);
    for row in &rows {
        let numbers = [row.bytes, row.block.into(), row.offset, row.first_use.into(), row.last_use.into()];
        let [bytes, block, offset, first, last] = numbers.map(|n| n.to_string());
        table.row([row.name.clone(), bytes, block, offset, first, last]);
    }
    let smaller = match count - rows.len() {
        0 => String::new(),
        left => format!("and {}: --explain shows them", counted(left, "smaller tensor")),
    };
    (table, smaller)
}

fn device_name(limits: &Limits) -> &str {
    if limits.name == Limits::default().name { "an ordinary device" } else { &limits.name }
}

/// Of an ordinary device if there is none, or if so requested.
fn target(session: &mut Session<'_>, option: &ArithmeticOption) -> Result<(Limits, Precision, Arithmetic)> {
    if let Some(device) = session.planned_device()? {
        let (precision, arithmetic) = option.choose(session, &device)?;
        return Ok((device.limits().clone(), precision, arithmetic));
    }
    let limits = session.ordinary_limits();
    let (precision, arithmetic) = option.planned(&limits);
    Ok((limits, precision, arithmetic))
}
