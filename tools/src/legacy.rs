//! Commands and options by their earlier names, rewritten before parsing; for one release.

use std::ffi::{OsStr, OsString};

/// Options by command, all of them if none is named.
const OPTIONS: [(&[&str], &str, &str); 44] = [
    (&[], "--memory", "--max-memory"),
    (&[], "--select", "--token-selection"),
    (&[], "--pool", "--kv-pool"),
    (&["get"], "--keep", "--keep-download"),
    (&[], "--keep", "--max-gaussians-per-token"),
    (&["info"], "--poses", "--cameras=capture"),
    (&[], "--poses", "--cameras"),
    (&[], "--unit", "--scene-scale"),
    (&[], "--fit", "--crop"),
    (&[], "--start", "--init"),
    (&[], "--hold-out", "--holdout-views"),
    (&[], "--grow", "--max-gaussians"),
    (&[], "--refine-cameras", "--optimize-cameras"),
    (&[], "--refined-cameras", "--cameras-out"),
    (&[], "--refine-size", "--max-image-size"),
    (&[], "--find-size", "--matching-size"),
    (&[], "--pairs", "--matching"),
    (&[], "--by", "--camera-source"),
    (&["cameras"], "--with", "--method"),
    (&["refine"], "--batch", "--views-per-step"),
    (&["refine"], "--size", "--max-image-size"),
    (&["reconstruct"], "--size", "--input-size"),
    (&["batch"], "--size", "--input-size"),
    (&["eval"], "--size", "--input-size"),
    (&["info"], "--size", "--input-size"),
    (&["view"], "--size", "--input-size"),
    (&["depth"], "--size", "--input-size"),
    (&["bench", "forward"], "--size", "--input-size"),
    (&["bench", "depth"], "--size", "--input-size"),
    (&["bench", "tradeoff"], "--size", "--input-size"),
    (&["view"], "--exact", "--lossless"),
    (&[], "--group", "--gaussians-per-token"),
    (&["render"], "--points", "--point-size"),
    (&["depth"], "--points", "--max-points"),
    (&["depth"], "--metres", "--metric"),
    (&["depth"], "--truth", "--ground-truth"),
    (&["eval"], "--world", "--scene-frame"),
    (&["eval"], "--whole", "--full-images"),
    (&["eval"], "--score-size", "--eval-size"),
    (&["eval"], "--gap", "--frame-range"),
    (&["eval"], "--disturb", "--pose-noise"),
    (&["batch"], "--posed", "--cameras=capture"),
    (&["info"], "--plan", "--dry-run"),
    (&["info"], "--all", "--explain"),
];

/// Rewrites the words after the program's name. `is_command` recognizes commands and their
/// subcommands.
pub fn rewritten(args: Vec<OsString>, is_command: impl Fn(&str) -> bool) -> Vec<OsString> {
    let mut words = Vec::with_capacity(args.len());
    let mut command: Vec<String> = Vec::new();
    let plans = args.iter().any(|word| word == "--plan");
    let mut planned = Vec::new();
    let has_file = has_file(&args);
    let mut args = args.into_iter().peekable();
    while let Some(word) = args.next() {
        let Some(text) = word.to_str() else {
            words.push(word);
            continue;
        };
        if !text.starts_with("--") {
            let nested = command.iter().all(|word| word == "bench" || word == "weights");
            let earlier = ["batch", "compare", "info", "tune"].contains(&text);
            if nested && !words.is_empty() && (earlier || is_command(text)) {
                command.push(text.to_owned());
                let new: &[&str] = match text {
                    "batch" => &["reconstruct", "--each"],
                    "compare" => &["eval"],
                    "info" if plans => &["reconstruct"],
                    "info" if has_file => &["convert"],
                    "info" => &["doctor", "list"],
                    "tune" => &["doctor", "tune"],
                    same => &[same],
                };
                words.extend(new.iter().map(OsString::from));
            } else {
                words.push(word);
            }
            continue;
        }
        if text == "--" {
            command = vec!["render".to_owned()];
        }
        let (name, inline) = text.split_once('=').map_or((text, None), |(name, value)| (name, Some(value)));
        let known = |(commands, old, _): &&(&[&str], &str, &str)| {
            let (bench, named) = (command.iter().any(|word| word == "bench"), commands.first() == Some(&"bench"));
            let here = commands.iter().all(|name| command.iter().any(|word| word == name));
            *old == name && here && (commands.is_empty() || bench == named)
        };
        let name = OPTIONS.iter().find(known).map_or(name, |(_, _, new)| new).to_owned();
        let mut value = inline.map(str::to_owned);
        let takes = ["--invalid", "--focal-lengths", "--reference"].contains(&name.as_str())
            || plans && ["--pictures", "--refine"].contains(&name.as_str());
        if takes && value.is_none() {
            value = args.next_if(|word| word.to_str().is_some()).and_then(|word| word.into_string().ok());
        }
        let sizes =
            value.as_deref().filter(|_| plans).map(|value| value.split_once(':').unwrap_or((value, "gaussians")));
        let new = match (name.as_str(), sizes) {
            ("--pictures", Some((size, _))) => {
                planned = ["--pictures=.", "--", "--size", size].map(OsString::from).to_vec();
                continue;
            }
            ("--refine", Some((size, target))) => {
                let target = format!("--refine-target={target}");
                vec!["--refine".into(), format!("--max-image-size={size}"), target]
            }
            _ => renamed(&command, name, value),
        };
        words.extend(new.into_iter().map(OsString::from));
    }
    words.extend(planned);
    words
}

/// Tells `info FILE` from `info`.
fn has_file(args: &[OsString]) -> bool {
    let is_option = |word: &OsStr| word.to_string_lossy().starts_with('-');
    let takes_value = |word: &OsStr| ["--device", "--memory", "--max-memory"].iter().any(|option| word == *option);
    let command = args.iter().position(|word| word == "info").unwrap_or(args.len());
    let mut pairs = args.windows(2).skip(command);
    pairs.any(|pair| !is_option(&pair[1]) && !takes_value(&pair[0]))
}

/// Replaces options whose values changed, too.
fn renamed(command: &[String], name: String, value: Option<String>) -> Vec<String> {
    let of_scene = ["reconstruct", "eval", "view"].iter().any(|name| command.iter().any(|word| word == name));
    let before = |text: &str| text.parse::<u32>().ok().and_then(|number| number.checked_sub(1));
    match (name.as_str(), value.as_deref()) {
        ("--invalid", Some("drop")) => vec!["--drop-invalid".into()],
        ("--focal-lengths", Some("own")) => vec!["--per-view-focal".into()],
        ("--invalid", Some("refuse")) | ("--focal-lengths", Some("shared")) => Vec::new(),
        ("--reference", Some(number)) => match before(number) {
            Some(view) => vec![format!("--reference-view={view}")],
            None => vec![name, number.to_owned()],
        },
        ("--refine", Some(value)) if of_scene => match value.split_once(':') {
            Some((steps, target)) => vec![format!("--refine={steps}"), format!("--refine-target={target}")],
            None => vec![format!("{name}={value}")],
        },
        (_, Some(value)) => vec![format!("{name}={value}")],
        (_, None) => vec![name],
    }
}
