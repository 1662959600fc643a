//! Earlier names of commands and options, rewritten before parsing; for one release.

use std::ffi::OsString;

/// Options of some commands, or of all if none is named. Options that have one meaning are aliases.
const OPTIONS: [(&[&str], &str, &str); 7] = [
    (&["info"], "--poses", "--cameras=capture"),
    (&[], "--poses", "--cameras"),
    (&["batch"], "--posed", "--cameras=capture"),
    (&["refine"], "--size", "--max-image-size"),
    (&SIZED, "--size", "--input-size"),
    (&["info"], "--plan", "--dry-run"),
    (&["info"], "--all", "--explain"),
];

const SIZED: [&str; 9] =
    ["reconstruct", "batch", "eval", "info", "view", "depth", "bench forward", "bench depth", "bench tradeoff"];

pub fn rewritten(args: Vec<OsString>, is_command: impl Fn(&str) -> bool) -> Vec<OsString> {
    let has = |option: &str| args.iter().any(|word| word == option);
    let (plans, needs_cameras) = (has("--plan"), !has("--poses"));
    let names_file = names_file(&args);
    let (mut words, mut last) = (Vec::with_capacity(args.len()), Vec::new());
    let mut command = String::new();
    let mut args = args.into_iter().peekable();
    while let Some(word) = args.next() {
        let text = word.to_string_lossy().into_owned();
        if !text.starts_with("--") {
            let starts = command.is_empty() || command == "bench" || command == "weights";
            let new: &[&str] = match text.as_str() {
                _ if !starts || words.is_empty() => &[],
                "batch" => &["reconstruct", "--each"],
                "compare" => &["eval"],
                "info" if plans => &["reconstruct"],
                "info" if names_file => &["convert"],
                "info" => &["doctor", "list"],
                "tune" => &["doctor", "tune"],
                name if is_command(name) => &[name],
                _ => &[],
            };
            if new.is_empty() {
                words.push(word);
            } else {
                command = format!("{command} {text}").trim_start().to_owned();
                words.extend(new.iter().map(OsString::from));
            }
            continue;
        }
        if text == "--" {
            command = "render".to_owned();
        }
        let (name, inline) = text.split_once('=').map_or((text.as_str(), None), |(name, value)| (name, Some(value)));
        let known = OPTIONS
            .iter()
            .find(|(commands, old, _)| *old == name && (commands.is_empty() || commands.contains(&command.as_str())));
        let name = known.map_or(name, |(_, _, new)| new);
        let mut value = inline.map(str::to_owned);
        let takes = ["--invalid", "--focal-lengths", "--reference"].contains(&name)
            || plans && ["--pictures", "--refine"].contains(&name);
        if takes && value.is_none() {
            value = args.next().map(|word| word.to_string_lossy().into_owned());
        }
        let sizes =
            value.as_deref().filter(|_| plans).map(|value| value.split_once(':').unwrap_or((value, "gaussians")));
        let new = match (name, sizes) {
            ("--pictures", Some((size, _))) => {
                last = ["--pictures=.", "--", "--size", size].map(OsString::from).to_vec();
                Vec::new()
            }
            ("--refine", Some((size, target))) => {
                let cameras = needs_cameras.then(|| "--cameras=capture".to_owned());
                let words =
                    ["--refine".into(), format!("--max-image-size={size}"), format!("--refine-target={target}")];
                words.into_iter().chain(cameras).collect()
            }
            _ if known.is_none() && inline.is_none() && value.is_none() => {
                words.push(word);
                continue;
            }
            _ => renamed(&command, name, value.as_deref()),
        };
        words.extend(new.into_iter().map(OsString::from));
    }
    words.extend(last);
    words
}

/// Replaces options whose values changed, too.
fn renamed(command: &str, name: &str, value: Option<&str>) -> Vec<String> {
    let before = |number: &str| number.parse::<u32>().ok().and_then(|number| number.checked_sub(1));
    match (name, value) {
        ("--invalid", Some("drop")) => vec!["--drop-invalid".into()],
        ("--focal-lengths", Some("own")) => vec!["--per-view-focal".into()],
        ("--invalid", Some("refuse")) | ("--focal-lengths", Some("shared")) => Vec::new(),
        ("--reference", Some(number)) => match before(number) {
            Some(view) => vec![format!("--reference-view={view}")],
            None => vec![name.to_owned(), number.to_owned()],
        },
        ("--refine", Some(value)) if ["reconstruct", "eval", "view"].contains(&command) => {
            match value.split_once(':') {
                Some((steps, target)) => vec![format!("--refine={steps}"), format!("--refine-target={target}")],
                None => vec![format!("{name}={value}")],
            }
        }
        (_, Some(value)) => vec![format!("{name}={value}")],
        (_, None) => vec![name.to_owned()],
    }
}

fn names_file(args: &[OsString]) -> bool {
    let command = args.iter().position(|word| word == "info").unwrap_or(args.len());
    args.windows(2).skip(command).any(|pair| {
        let takes_value = ["--device", "--memory", "--max-memory"].iter().any(|option| pair[0] == *option);
        !takes_value && !pair[1].to_string_lossy().starts_with('-')
    })
}
