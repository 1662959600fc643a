use super::{
    Eval, VIEWS,
    alignment::{Alignment, cells_of},
    evaluator::{Evaluation, Evaluator},
};
use crate::{
    capture::{Choice, Score, ViewSplit},
    options::{Network, refuse},
    outputs, refinement,
    session::{Session, stage_seconds},
    table::Table,
};
use zipsplat::{
    Error, Result,
    types::{Image, SaveOptions, World, contact_sheet},
};

const SCENE: &str = "scene.ply";
const COMPARISON: &str = "comparison.png";
const SHOWN: usize = 12;

pub fn run(eval: &Eval, session: &mut Session<'_>) -> Result<()> {
    eval.csv.as_deref().map_or(Ok(()), |file| eval.overwrite.check_file(file))?;
    if let Some(folder) = &eval.output {
        outputs::check_folder(folder)?;
        eval.overwrite.check_replaced([SCENE, COMPARISON].map(|name| folder.join(name)))?;
    }
    let [folder] = &eval.folders[..] else {
        let expected = "one capture, two sets of pictures, or scenes of a --protocol";
        return Err(Error::argument("folders", eval.folders.len(), expected));
    };
    refuse("--difference", eval.difference.is_some(), "a capture", "two pictures or folders of pictures")?;
    let views = match eval.views[..] {
        [] => VIEWS,
        [views] => views,
        _ => return Err(Error::argument("--views", "a list", "one number, or a --protocol")),
    } as usize;
    let (weights, seeing) = eval.begin(session)?;
    let targets = eval.targets.map(|targets| targets as usize);
    let known = eval.known(folder, session)?;
    let mut choice = match &known {
        Some(known) => Choice::of(known.poses.clone(), folder, views, targets)?,
        None => Choice::new(folder, views, targets).map_err(without_cameras)?,
    };
    choice.masks = eval.finding.masks();
    choice.disturb(eval.pose_noise, eval.length())?;
    if let (None, Network::Tokens(checkpoint)) = (eval.external.given(), &weights) {
        eval.check_shape(checkpoint, seeing, &choice)?;
    }
    session.notes(&choice.poses.warnings);
    let mut evaluator = Evaluator::new(eval, &weights, seeing, session)?;
    let evaluation = evaluator.evaluate(session, &choice, None)?;

    match (&eval.csv, &evaluation.alignment) {
        (Some(path), Some(alignment)) => outputs::save_csv(path, &alignment.rows)?,
        (Some(path), None) => outputs::save_csv(path, &evaluation.scores)?,
        (None, _) => {}
    }
    save(eval, &choice, &evaluation)?;
    let Evaluation { capture, reconstruction, scores, alignment, .. } = &evaluation;
    let mean = Score::mean(scores);
    let table = alignment.as_ref().map_or_else(|| table(scores, &mean), |alignment| alignment.table(&mean));
    alignment.iter().filter_map(Alignment::doubts).for_each(|note| session.note(note));
    if eval.external.given().is_some() && mean.psnr < mean.mean_color_psnr {
        session.note(
            "the scene is further from the photos than one color: --scene-frame, --scene-unit and --scene-cameras say where its \
             world is",
        );
    }
    let refined = reconstruction.refined.as_ref();
    let network = reconstruction.network.as_ref();
    let source = match (network, eval.external.given()) {
        // The points replaced the network's Gaussians.
        _ if reconstruction.started == refinement::Initialization::Points.name() => {
            "of the capture's points".to_owned()
        }
        (Some(network), _) => format!("of {} tokens in {:.2} s", network.tokens, network.took.as_secs_f64()),
        (None, Some(file)) => format!("of {}", file.display()),
        (None, None) => "of the capture's points".to_owned(),
    };
    let text = format!(
        "{table}{} of {} from {} of its photos, {} Gaussians {source}; {}",
        folder.display(),
        seeing.size,
        capture.inputs.len(),
        reconstruction.scene.len(),
        capture.scene_scale
    ) + &alignment.as_ref().map_or_else(String::new, Alignment::summary)
        + &mean.color_corrected_psnr.map_or_else(String::new, |psnr| format!("\ncolor-corrected {psnr:.2} dB (mean)"))
        + &refined.map_or_else(String::new, |refined| {
            format!("\n{}", refinement::summary(refined, reconstruction.started, &capture.training_views().1))
        });
    let json = serde_json::json!({
        "folder": folder.to_string_lossy(), "weights": weights.provenance(), "precision": evaluator.precision.name(),
        "width": seeing.size.0, "height": seeing.size.1, "score_width": seeing.compared.0, "score_height": seeing.compared.1,
        "refined": refined.map(|refined| refinement::as_json(refined, reconstruction.started, &capture.training_views().1)),
        "inputs": capture.inputs.iter().map(|view| &view.name).collect::<Vec<_>>(), "scene_scale": capture.scene_scale.length, "scene_scale_source": capture.scene_scale.source,
        "tokens": network.map(|network| network.tokens), "all_tokens": network.map(|network| network.all_tokens),
        "gaussians": reconstruction.scene.len(), "scene": eval.external.given(), "peak_bytes": network.map(|network| network.peak_bytes),
        "seconds": network.map(|network| network.took.as_secs_f64()),
        "stage_seconds": network.map(|network| stage_seconds(&network.stages.0)),
        "mean": mean, "aligned": alignment, "views": scores,
    });
    session.report(&json, text)
}

fn without_cameras(error: Error) -> Error {
    match error {
        Error::Argument { what, found, expected } if what == "poses" => {
            Error::argument(what, found, format!("{expected}; `--cameras colmap` finds the cameras with COLMAP"))
        }
        error => error,
    }
}

fn save(eval: &Eval, choice: &Choice, evaluation: &Evaluation) -> Result<()> {
    let Some(folder) = &eval.output else { return Ok(()) };
    let Evaluation { capture, reconstruction, drawn, .. } = evaluation;
    outputs::make_folder(folder)?;
    let mut scene = reconstruction.scene.clone();
    // Files use the known cameras' unit.
    if !eval.pose_free {
        scene.scale(capture.scene_scale.length as f32);
    }
    let world = if eval.pose_free { None } else { World::of_first(&choice.input_frames()) };
    outputs::save_scene(&folder.join(SCENE), &scene, &SaveOptions::default(), world.as_ref())?;
    outputs::save_picture(&folder.join(COMPARISON), &comparison(capture, drawn)?)
}

fn table(scores: &[Score], mean: &Score) -> Table {
    let mut table = Table::new(1, &["view", "PSNR", "SSIM", "LPIPS", "nearest photo", "mean color"]);
    scores.iter().chain([mean]).for_each(|score| table.row(cells_of(score)));
    table
}

fn comparison(capture: &ViewSplit, drawn: &[Vec<f32>]) -> Result<Image> {
    let targets = &capture.targets;
    let shown = targets.len().min(SHOWN);
    let mut images = Vec::new();
    for i in (0..shown).map(|i| i * targets.len() / shown) {
        let Image { width, height, .. } = targets[i].image;
        let drawn = Image::from_rgb_f32(width, height, &drawn[i])?;
        images.extend([targets[i].image.clone(), drawn, capture.nearest(&targets[i]).image.clone()]);
    }
    contact_sheet(&images, 6)
}
