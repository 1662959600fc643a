use super::{Repeats, Spread};
use crate::{
    options::Size,
    session::{Session, Stage},
    table::Table,
};
use serde::Serialize;
use std::{num::NonZeroU32, time::Duration};
use zipsplat::{
    Result,
    gpu::Device,
    stages::render::{Depth, RenderOptions, Renderer},
    types::Scene,
};
use zipsplat_verify::noise;

const GROUP: NonZeroU32 = NonZeroU32::new(32).expect("not 0");

#[derive(Serialize)]
struct Row {
    effect: &'static str,
    off: Spread,
    on: Spread,
}

pub fn run(session: &mut Session<'_>, device: &Device, scene: &Scene, size: Size, repeats: &Repeats) -> Result<()> {
    let stride = scene.sh_coeffs_per_gaussian();
    let sh_coeffs = scene.sh_coeffs.iter().copied().step_by(stride).collect();
    let plain_scene = Scene { sh_degree: 0, sh_coeffs, ..scene.clone() };
    let load = |mut renderer: Renderer, scene: &Scene| renderer.set_scene(scene).map(|()| renderer);
    let mut whole = load(Renderer::new(device), scene)?;
    let mut renderer = load(Renderer::new(device), &plain_scene)?;

    let off = RenderOptions::default();
    let effects = [
        ("view-dependent color", off),
        ("alpha", RenderOptions { alpha: true, ..off }),
        ("depth", RenderOptions { depth: Some(Depth::Expected), ..off }),
        ("normals", RenderOptions { normals: true, ..off }),
        ("token colors", RenderOptions { token_group: Some(GROUP), ..off }),
        ("antialiasing", RenderOptions { antialiased: Some(true), ..off }),
        ("background", RenderOptions { background: [1.0; 3], ..off }),
    ];
    let camera = noise::camera(size.0, size.1);
    let time = |renderer: &mut Renderer, request: &RenderOptions| -> Result<Duration> {
        Ok(renderer.profile(&camera, request)?.total("").0)
    };
    let mut measure = |effect: &'static str, on: &RenderOptions, stage: &Stage<'_>| {
        let mut times = [Vec::new(), Vec::new()];
        for i in 0..repeats.warmup + repeats.repeats {
            stage.reach(f64::from(i) / f64::from(repeats.warmup + repeats.repeats))?;
            let with = if effect == effects[0].0 { &mut whole } else { &mut renderer };
            let on = time(with, on)?;
            let round = [time(&mut renderer, &off)?, on];
            if i >= repeats.warmup {
                times.iter_mut().zip(round).for_each(|(times, time)| times.push(time));
            }
        }
        let [off, on] = times.map(Spread::of);
        Ok(Row { effect, off, on })
    };
    let mut rows = Vec::new();
    for (effect, on) in &effects {
        rows.push(session.stage(effect, |stage| measure(effect, on, stage))?.0);
    }
    let headings = ["effect", "off: ms, median (min..max)", "on"];
    let mut table = Table::new(1, &headings);
    for row in &rows {
        table.row([row.effect.into(), row.off.to_string(), row.on.to_string()]);
    }
    let what = format!("{} Gaussians, {size}, on {}", scene.len(), device.limits().name);
    session.report(&rows, format!("{what}\n{table}"))
}
