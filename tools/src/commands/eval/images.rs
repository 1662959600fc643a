use super::Eval;
use crate::{
    file_names,
    metrics::{self, masked_ssim, psnr, values},
    options::refuse_all,
    outputs, photos,
    session::{Session, Stage},
    table::{Table, counted},
};
use serde::Serialize;
use serde_json::json;
use std::path::{Path, PathBuf};
use zipsplat::{
    Error, Result,
    perceptual::Perceptual,
    types::{Image, Masks},
};

#[derive(Clone, Serialize)]
struct Row {
    name: String,
    psnr: Option<f64>,
    ssim: f64,
    lpips: Option<f64>,
}

struct Pair {
    name: String,
    files: [PathBuf; 2],
    difference: Option<PathBuf>,
}

/// Pictures, or folders of pictures matched by file name without extension.
pub fn run(eval: &Eval, sets: [&PathBuf; 2], session: &mut Session<'_>) -> Result<()> {
    let options = [
        ("--views", !eval.views.is_empty()),
        ("--targets", eval.targets.is_some()),
        ("--cameras", eval.cameras.is_some()),
        ("--pose-free", eval.pose_free),
        ("--refine", eval.refine.steps().is_some()),
        ("--scene or --from-depth", eval.external.given().is_some()),
        ("--output", eval.output.is_some()),
    ];
    refuse_all(options, "two sets of pictures", "a capture")?;
    let pairs = pairs(eval, sets, session)?;
    let mut written = eval.csv.iter().chain(pairs.iter().filter_map(|pair| pair.difference.as_ref()));
    written.try_for_each(|file| eval.overwrite.check_file(file))?;
    let device = session.device()?;
    let mut lpips = eval.lpips.open(&device, false, false)?;
    if lpips.is_none() && eval.lpips.lpips.is_none() {
        session.note("no LPIPS: its weights are not here; `python3 tools/lpips.py` fetches them (64 MB)");
    }
    let masks = eval.finding.masks();
    let compared = |stage: &Stage<'_>| stage.each(&pairs, |pair| compare(pair, masks.as_ref(), lpips.as_mut()));
    let (rows, _) = session.stage("compare", compared)?;
    let small = rows.iter().filter(|row| row.lpips.is_none()).count();
    if let Some(lpips) = lpips.filter(|_| small > 0) {
        let (side, small) = (lpips.network().least_side(), counted(small, "pair"));
        session.note(format!("{small} without LPIPS, whose network takes pictures of {side}x{side} and larger"));
    }
    if let Some(path) = &eval.csv {
        outputs::save_csv(path, &rows)?;
    }
    let mean = mean(&rows);
    let mut table = Table::new(1, &["picture", "PSNR", "SSIM", "LPIPS"]);
    for row in rows.iter().chain((rows.len() > 1).then_some(&mean)) {
        let psnr = row.psnr.map_or("equal".into(), |psnr| format!("{psnr:.2}"));
        let lpips = row.lpips.map_or("-".into(), |lpips| format!("{lpips:.4}"));
        table.row([row.name.clone(), psnr, format!("{:.4}", row.ssim), lpips]);
    }
    session.report(&json!({ "pictures": rows, "mean": mean }), table.to_string().trim_end())
}

fn pairs(eval: &Eval, [first, second]: [&PathBuf; 2], session: &mut Session<'_>) -> Result<Vec<Pair>> {
    match [first.is_dir(), second.is_dir()] {
        [false, false] => {
            let (files, difference) = ([first.clone(), second.clone()], eval.difference.clone());
            Ok(vec![Pair { name: stem(first), files, difference }])
        }
        [true, true] => pairs_of_folders(eval, [first, second], session),
        [folder, _] => {
            let kind = |folder: bool| if folder { "a folder" } else { "a picture" };
            let found = format!("{} and {}", kind(folder), kind(!folder));
            Err(Error::argument("pictures to compare", found, "two pictures or two folders"))
        }
    }
}

fn pairs_of_folders(eval: &Eval, sets: [&PathBuf; 2], session: &mut Session<'_>) -> Result<Vec<Pair>> {
    let [ours, others] = sets.map(|folder| photos::list(session, std::slice::from_ref(folder), false));
    let (ours, mut others) = (ours?, others?);
    let mut pairs = Vec::new();
    let mut alone = Vec::new();
    for file in ours {
        let name = stem(&file);
        match others.iter().position(|other| stem(other) == name) {
            Some(i) => {
                let difference = eval.difference.as_ref().map(|folder| folder.join(format!("{name}.png")));
                pairs.push(Pair { name, files: [file, others.swap_remove(i)], difference });
            }
            None => alone.push(file),
        }
    }
    alone.extend(others);
    if pairs.is_empty() {
        let found = format!("none in {} and {}", sets[0].display(), sets[1].display());
        return Err(Error::argument("pictures of the same name", found, "at least one"));
    }
    if !alone.is_empty() {
        session.note(format_args!(
            "{} without a partner: {}",
            counted(alone.len(), "picture"),
            file_names::names(&alone)
        ));
    }
    if let Some(folder) = &eval.difference {
        outputs::make_folder(folder)?;
    }
    Ok(pairs)
}

fn stem(path: &Path) -> String {
    path.file_stem().unwrap_or_default().to_string_lossy().into_owned()
}

/// Masks are the second picture's.
fn compare(pair: &Pair, masks: Option<&Masks>, lpips: Option<&mut Perceptual>) -> Result<Row> {
    let a = Image::open(&pair.files[0])?;
    let b = masks.map_or_else(|| Image::open(&pair.files[1]), |masks| masks.open(&pair.files[1], false))?;
    let (width, height) = (a.width, a.height);
    if (b.width, b.height) != (width, height) {
        let found = format!("{width}x{height} and {}x{}", b.width, b.height);
        return Err(Error::argument(format!("sizes of the pictures {}", pair.name), found, "one size"));
    }
    if width.min(height) < 11 {
        return Err(Error::argument(
            &pair.name,
            format!("{width}x{height} pixels"),
            "11x11, a window of SSIM, or more",
        ));
    }
    let [x, y] = metrics::hidden(&b, &values(&a), &values(&b));
    let lpips = metrics::masked_lpips(lpips, &b, &x)?;
    if let Some(path) = &pair.difference {
        let off = a.rgb.iter().zip(&b.rgb).map(|(a, b)| a.abs_diff(*b).saturating_mul(4)).collect();
        outputs::save_picture(path, &Image::new(width, height, off)?)?;
    }
    let psnr = Some(psnr(&b.kept(&x), &b.kept(&y))).filter(|psnr| psnr.is_finite());
    Ok(Row { name: pair.name.clone(), psnr, ssim: masked_ssim(&b, &x, &y), lpips })
}

/// PSNR skips equal pictures.
fn mean(rows: &[Row]) -> Row {
    let mean = |values: Vec<f64>| (!values.is_empty()).then(|| values.iter().sum::<f64>() / values.len() as f64);
    Row {
        name: "mean".into(),
        psnr: mean(rows.iter().filter_map(|row| row.psnr).collect()),
        ssim: mean(rows.iter().map(|row| row.ssim).collect()).unwrap_or_default(),
        lpips: mean(rows.iter().filter_map(|row| row.lpips).collect()),
    }
}
