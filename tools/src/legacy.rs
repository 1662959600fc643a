//! Options by their earlier names, rewritten before parsing; for one release.

use std::ffi::OsString;

/// Options by command, all of them if none is named.
const OPTIONS: [(&[&str], &str, &str); 42] = [
    (&[], "--memory", "--max-memory"),
    (&[], "--select", "--token-selection"),
    (&[], "--pool", "--kv-pool"),
    (&["get"], "--keep", "--keep-download"),
    (&[], "--keep", "--max-gaussians-per-token"),
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
    (&["eval"], "--noise", "--depth-noise"),
    (&["batch"], "--posed", "--cameras=capture"),
];

/// Rewrites the words after the program's name. `is_command` recognizes commands and their
/// subcommands.
pub fn rewritten(args: Vec<OsString>, is_command: impl Fn(&str) -> bool) -> Vec<OsString> {
    let mut words = Vec::with_capacity(args.len());
    let mut command: Vec<String> = Vec::new();
    let mut args = args.into_iter().peekable();
    while let Some(word) = args.next() {
        let Some(text) = word.to_str() else {
            words.push(word);
            continue;
        };
        if !text.starts_with("--") {
            let nested = command.iter().all(|word| word == "bench" || word == "weights");
            command.extend((nested && !words.is_empty() && is_command(text)).then(|| text.to_owned()));
            words.push(word);
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
        let takes = ["--invalid", "--focal-lengths", "--reference"].contains(&name.as_str());
        if takes && value.is_none() {
            value = args.next_if(|word| word.to_str().is_some()).and_then(|word| word.into_string().ok());
        }
        words.extend(renamed(&command, name, value).into_iter().map(OsString::from));
    }
    words
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
