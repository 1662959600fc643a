//! The reconstructions of a sweep.

use super::{
    Tradeoff,
    point::{arithmetic, name},
    rounded::OWN,
};
use crate::{capture::Capture, refinement::Steps};
use zipsplat::{
    Result,
    ops::Precision,
    reconstruct::{Kept, Model, Ratio, Request, Shape},
};

/// A reconstruction that is to be measured.
pub struct Case<'a> {
    pub capture: &'a Capture,
    pub shape: Shape,
    pub request: Request,
    pub precision: &'a str,
    /// The type that the weights are rounded to, or [`OWN`].
    pub weights: &'a str,
    pub select: String,
    /// The share of tokens as the command line takes it, and all settings.
    pub ratio: String,
    pub settings: String,
    /// Numbers of Gaussians of a token.
    pub keep: &'a [usize],
    /// Steps of the refinements that follow.
    pub refine: Vec<Steps>,
}

/// The combinations, without those that differ only in what does not matter.
pub fn all<'a>(
    args: &Tradeoff,
    model: &Model,
    (precision, weights): (&'a str, &'a str),
    keep: &'a [usize],
    captures: &'a [Capture],
) -> Result<Vec<Case<'a>>> {
    let mut cases: Vec<Case<'a>> = Vec::new();
    for capture in captures {
        for (&ratio, &pool) in args.ratio.iter().flat_map(|ratio| args.pool.iter().map(move |pool| (ratio, pool))) {
            for selection in &args.select {
                let cameras = Some(capture.cameras());
                let request = Request { ratio, selection: selection.clone(), cameras, unit: 1.0, pool };
                let shape = model.shape(&capture.images(), &request)?;
                let whole = shape.kept == Kept::All;
                let same = |case: &Case| case.shape == shape && (whole || case.request.selection == *selection);
                if cases.iter().any(same) {
                    continue;
                }
                let select = if whole { "all".into() } else { name(selection) };
                let ratio = match ratio {
                    Ratio::Auto => "auto".into(),
                    Ratio::Fixed(ratio) => ratio.to_string(),
                };
                let mut settings = format!("--ratio {ratio}");
                settings += &if whole { String::new() } else { format!(" --select {select}") };
                settings += &if pool > 1 { format!(" --pool {pool}") } else { String::new() };
                let refine = Vec::new();
                let mut case =
                    Case { capture, shape, request, precision, weights, select, ratio, settings, keep, refine };
                if case.is_first(args) {
                    case.refine.extend(args.refine.iter().filter(|steps| steps.count > 0));
                }
                cases.push(case);
            }
        }
    }
    Ok(cases)
}

impl Case<'_> {
    /// True where all tokens are taken or the first way to choose chooses, with the first pooling.
    pub fn is_first(&self, args: &Tradeoff) -> bool {
        let chosen = self.shape.kept == Kept::All || self.request.selection == args.select[0];
        chosen && self.request.pool == args.pool[0]
    }

    /// True of what others are compared with.
    pub fn is_exact(&self) -> bool {
        self.precision == Precision::Exact.name() && self.weights == OWN
    }

    pub fn arithmetic(&self) -> String {
        arithmetic(self.precision, self.weights)
    }

    /// The command that shows the case with `more` options.
    pub fn command(&self, args: &Tradeoff, more: &str) -> String {
        let folder = args.folder.to_string_lossy();
        let mut options = format!("--views {} {}", self.capture.inputs.len(), self.settings);
        options += &format!(" {more} --precision {} --targets {}", self.precision, args.targets);
        if let Some(size) = args.size {
            options += &format!(" --size {size}");
        }
        if let Some(unit) = args.unit {
            options += &format!(" --unit {unit}");
        }
        let join = |words: Vec<&str>| shlex::try_join(words).expect("no argument of a command holds a NUL");
        let eval = |weights: Vec<&str>| {
            join(["zipsplat", "eval", &folder].into_iter().chain(options.split(' ')).chain(weights).collect())
        };
        if self.weights == OWN {
            return eval(args.weights.as_arguments());
        }
        let (from, to) = (args.weights.as_input(), format!("{}.safetensors", self.weights));
        let convert = ["zipsplat", "convert"].into_iter().chain(from).chain([&*to, "--dtype", self.weights]);
        format!("{} && {}", join(convert.collect()), eval(vec!["--weights", &to]))
    }
}
