use super::{Tradeoff, point::arithmetic, rounded::OWN};
use crate::{
    capture::ViewSplit,
    refinement::{Initialization, RefineTask},
};
use zipsplat::{
    Result,
    ops::Precision,
    reconstruct::{KvPool, Ratio, ReconstructOptions, Shape, TokenSampling},
    refine::RefineLength,
    types::PointCloud,
    weights::Architecture,
};

#[derive(Clone)]
pub struct Case<'a> {
    pub capture: &'a ViewSplit,
    pub cloud: Option<&'a PointCloud>,
    pub shape: Shape,
    pub request: ReconstructOptions,
    pub precision: &'a str,
    /// Rounded type, or [`OWN`].
    pub weights: &'a str,
    pub select: String,
    pub ratio: String,
    pub settings: String,
    pub keep: &'a [usize],
    pub refine: Vec<(Initialization, RefineTask)>,
}

/// Combinations without equal results, the lists' first values first.
pub fn all<'a>(
    args: &Tradeoff,
    architecture: &Architecture,
    precision: &'a str,
    keep: &'a [usize],
    captures: &'a [ViewSplit],
    clouds: &'a [Option<PointCloud>],
) -> Result<Vec<Case<'a>>> {
    let mut cases: Vec<Case<'a>> = Vec::new();
    for (&ratio, selection) in args.ratio.iter().flat_map(|ratio| args.token_selection.iter().map(move |s| (ratio, s)))
    {
        for (&pool, (capture, cloud)) in
            args.kv_pool.iter().flat_map(|pool| captures.iter().zip(clouds).map(move |capture| (pool, capture)))
        {
            let cameras = Some(capture.views.cameras.clone());
            let request = ReconstructOptions {
                ratio,
                token_selection: selection.clone(),
                cameras,
                scene_scale: Some(1.0),
                kv_pool: pool,
                ..ReconstructOptions::default()
            };
            let image = &capture.views.images[0];
            let (views, size) = (capture.views.images.len(), [image.width, image.height]);
            let shape = Shape::new(architecture, views, size, ratio, selection, true)?.pooled(pool);
            let whole = shape.kept == TokenSampling::All;
            let same = |case: &Case| case.shape == shape && (whole || case.request.token_selection == *selection);
            if cases.iter().any(same) {
                continue;
            }
            let select = if whole { "all".into() } else { selection.to_string() };
            let ratio = match ratio {
                Ratio::Auto => "auto".into(),
                Ratio::Fixed(ratio) => ratio.to_string(),
            };
            let mut settings = format!("--ratio {ratio}");
            settings += &if whole { String::new() } else { format!(" --token-selection {select}") };
            settings += &if pool == KvPool::ALL { String::new() } else { format!(" --kv-pool {pool}") };
            let (cloud, weights, refine) = (cloud.as_ref(), OWN, Vec::new());
            let mut case =
                Case { capture, cloud, shape, request, precision, weights, select, ratio, settings, keep, refine };
            let is_new = !cases.iter().any(|case| std::ptr::eq(case.capture, capture));
            case.refine = case.refinements(args, is_new);
            cases.push(case);
        }
    }
    // Stable: equal cases keep their order.
    cases.sort_by_key(|case| !case.is_first(args));
    Ok(cases)
}

impl Case<'_> {
    pub fn is_first(&self, args: &Tradeoff) -> bool {
        let chosen = self.shape.kept == TokenSampling::All || self.request.token_selection == args.token_selection[0];
        chosen && self.request.kv_pool == args.kv_pool[0]
    }

    /// Refines from points alone only in a capture's first case.
    fn refinements(&self, args: &Tradeoff, is_new: bool) -> Vec<(Initialization, RefineTask)> {
        let default: &[Initialization] = if self.cloud.is_some() {
            &[Initialization::Points, Initialization::Scene]
        } else {
            &[Initialization::Scene]
        };
        let starts = args.init.as_deref().unwrap_or(default);
        let pairs = args.refine.iter().flat_map(|steps| starts.iter().map(move |start| (*start, *steps)));
        let follows = |(start, steps): &(Initialization, RefineTask)| match start {
            _ if steps.length == RefineLength::Steps(0) || !self.is_first(args) => false,
            _ if steps.tokens => *start == Initialization::Scene,
            Initialization::Points => is_new,
            _ => true,
        };
        pairs.filter(follows).collect()
    }

    pub fn is_exact(&self) -> bool {
        self.precision == Precision::Fp32.name() && self.weights == OWN
    }

    pub fn arithmetic(&self) -> String {
        arithmetic(self.precision, self.weights)
    }

    pub fn command(&self, args: &Tradeoff, more: &str) -> String {
        let folder = args.folder.to_string_lossy();
        let mut options = format!("--views {}", self.capture.inputs.len());
        options += &format!(" {more} --precision {} --targets {}", self.precision, args.targets);
        if let Some(size) = args.input_size {
            options += &format!(" --input-size {size}");
        }
        if let Some(unit) = args.scene_scale {
            options += &format!(" --scene-scale {unit}");
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
