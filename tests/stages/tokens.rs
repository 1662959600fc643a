use zipsplat::refine::{FrozenHead, LearningRates, RefineLength, RefineOptions, RefineResult, refine_tokens};
use zipsplat::{gpu::Arena, reconstruct::SceneTokens};
use zipsplat_tests::prelude::*;

const SIZE: [u32; 2] = [56, 42];

fn photo(corner: u32) -> Image {
    let pixel = |x: u32, y: u32| {
        let inside = (corner..corner + 20).contains(&x) && (corner..corner + 16).contains(&y);
        if inside { [230, 120, 40] } else { [30, 60, 90] }
    };
    let rgb = (0..SIZE[1]).flat_map(|y| (0..SIZE[0]).flat_map(move |x| pixel(x, y))).collect();
    Image::new(SIZE[0], SIZE[1], rgb).unwrap()
}

fn photos() -> (Vec<Image>, Vec<Camera>) {
    let moved = |i: u32| {
        let mut camera = camera(SIZE[0], SIZE[1]);
        camera.pose.translation.x = 0.01 * f64::from(i);
        camera
    };
    ((0..2).map(|i| photo(8 + i)).collect(), (0..2).map(moved).collect())
}

fn network() -> (Model, FrozenHead) {
    let model = networks::model("micro", Arithmetic::EXACT);
    let checkpoint = Checkpoint::seeded_architecture(architectures::golden("micro"), "micro").unwrap();
    let head = FrozenHead::load(device(), &checkpoint).unwrap();
    (model, head)
}

fn tokens(model: &Model, scene_scale: f64) -> SceneTokens {
    let request = ReconstructOptions { scene_scale: Some(scene_scale), ..ReconstructOptions::default() };
    let features = model.features(&photos().0, &request, |_| ControlFlow::Continue(())).unwrap();
    model.tokens(&features, &request, |_| ControlFlow::Continue(())).unwrap()
}

fn refine(head: &FrozenHead, tokens: &SceneTokens, request: &RefineOptions) -> RefineResult {
    let (photos, cameras) = photos();
    refine_tokens(&Arena::new(device()), head, tokens, &photos, &cameras, request, |_| ControlFlow::Continue(()))
        .unwrap()
}

#[test]
fn tokens_become_the_photos() {
    let (model, head) = network();
    for scene_scale in [1.0, 0.5] {
        let tokens = tokens(&model, scene_scale);
        // Up to the order of sums.
        let none =
            refine(&head, &tokens, &RefineOptions { length: RefineLength::Steps(0), ..RefineOptions::default() });
        let request = ReconstructOptions { scene_scale: Some(scene_scale), ..ReconstructOptions::default() };
        let made =
            model.reconstruct_views(&photos().0, &request, |_| ControlFlow::Continue(())).unwrap().to_scene().unwrap();
        let close = |a: &[f32; 3], b: &[f32; 3]| a.iter().zip(b).all(|(a, b)| (a - b).abs() < 1e-4 * (1.0 + b.abs()));
        assert!(none.scene.means.iter().zip(&made.means).all(|(a, b)| close(a, b)));
        assert!(none.scene.scales.iter().zip(&made.scales).all(|(a, b)| close(a, b)));

        // Larger rates move random scenes out of the picture.
        let rates = LearningRates { tokens: 1e-2, ..LearningRates::default() };
        let request =
            RefineOptions { length: RefineLength::Steps(60), learning_rates: rates, ..RefineOptions::default() };
        let [first, second] = [(); 2].map(|()| refine(&head, &tokens, &request));
        assert!(first.scene == second.scene && first.losses == second.losses, "other bits the second time");
        assert!(first.losses[59] < 0.97 * first.losses[0], "{:?}", first.losses);
        assert!(first.best_step > 45 && first.stop_reason.is_none());
    }
}

#[test]
fn what_cannot_be_refined_is_refused() {
    let (model, head) = network();
    let (photos, cameras) = photos();
    let tokens = tokens(&model, 1.0);
    let go_on = |_: zipsplat::refine::RefineProgress<'_>| ControlFlow::Continue(());
    let refused = |head: &FrozenHead, cameras: &[Camera], request: &RefineOptions, word: &str| {
        let found = refine_tokens(&Arena::new(device()), head, &tokens, &photos, cameras, request, go_on);
        assert_refused(found, &[word]);
    };
    refused(&head, &cameras[..1], &RefineOptions::default(), "cameras");
    refused(&head, &cameras, &RefineOptions { holdout_views: Some(2), ..RefineOptions::default() }, "held-out photos");
    let other =
        FrozenHead::load(device(), &Checkpoint::seeded_architecture(architectures::golden("tiny"), "tiny").unwrap());
    refused(&other.unwrap(), &cameras, &RefineOptions::default(), "width of the tokens");
}
