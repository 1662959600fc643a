use crate::case::*;
use zipsplat::kernels::backbone::ReferenceView;
use zipsplat_tests::reference::backbone::reference_view::scores;

/// Returns scores and choice, from the first token of each view.
fn choose(tokens: &[f32], width: usize) -> (Vec<f32>, u32) {
    let (views, tokens_per_view) = (tokens.len() / width, 3);
    let with_patches: Vec<f32> =
        tokens.chunks(width).flat_map(|token| [token, &random(9, (tokens_per_view - 1) * width)].concat()).collect();
    let mut case = plan();
    let (scores, reference) = (case.output::<f32>(4 * views), case.output::<u32>(1));
    let kernel = ReferenceView {
        tokens: case.input(&with_patches),
        direction: case.output::<f32>(width),
        scores,
        reference,
        views: views as u32,
        tokens_per_view: tokens_per_view as u32,
        width: width as u32,
    };
    case.rec.dispatch_groups(kernel, 1u32);
    let run = case.run().unwrap();
    (run.read(scores).unwrap(), run.read::<u32>(reference).unwrap()[0])
}

fn alike(seed: u64, views: usize, width: usize) -> Vec<f32> {
    let (common, own) = (random(seed, width), random(seed + 1, views * width));
    own.iter().enumerate().map(|(i, x)| 3.0 * (common[i % width] + 0.3) + 0.5 * x).collect()
}

#[test]
fn equals_the_reference() {
    for (seed, views, width) in [(1, 3, 64), (3, 4, 128), (5, 24, 96), (7, 7, 1536)] {
        let tokens = alike(seed, views, width);
        let truth = scores(&widen(&tokens), width);
        let (found, chosen) = choose(&tokens, width);
        let distance: Vec<f64> = truth.iter().map(|view| view[3]).collect();
        let name = format!("{views} views of {width}");
        // Ranges of at most a hundredth of the values amplify the order of sums. The bound is half
        // a tie.
        assert_close(&name, &columns(&found, 4, 3, 4), &distance, Tolerance { max: 5e-4, rms: 2.5e-4 });
        let least = (0..views).min_by(|&a, &b| distance[a].total_cmp(&distance[b])).unwrap();
        assert_eq!(chosen as usize, least, "{name}: {distance:?}");
    }
}

#[test]
fn of_views_that_are_equally_good_the_first_is_chosen() {
    let width = 64;
    let tokens = alike(11, 4, width);
    let view = |i: usize| &tokens[i * width..][..width];
    let pairs = [view(0), view(1), view(2), view(3), view(0), view(1), view(2), view(3)].concat();
    let (_, chosen) = choose(&pairs, width);
    assert!(chosen < 4, "view {chosen} has a twin before it");
    // Nor do the last bits of a duplicate count.
    let nudged: Vec<f32> =
        pairs.iter().enumerate().map(|(i, x)| if i < 4 * width { x * (1.0 + 1e-6) } else { *x }).collect();
    assert_eq!(choose(&nudged, width).1, chosen);
    let all_equal = view(0).repeat(5);
    assert_eq!(choose(&all_equal, width).1, 0);
}
