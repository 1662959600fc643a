use crate::case::*;
use zipsplat::{kernels::cluster::Mutual, ops::NearestKernel, stages::cluster};
use zipsplat_tests::reference::cluster::mutual::{nearest_by_view, order};

fn selected(x: &[f32], width: usize, views: usize, count: usize, kernel: NearestKernel) -> Vec<u32> {
    let mut case = plan();
    let tokens = Rows::new(case.input(x), x.len() / width, width);
    let chosen = cluster::mutual(&mut case.rec, kernel, tokens, views, count);
    case.result(chosen).unwrap()
}

#[test]
fn keys_order_tokens_as_the_reference() {
    for (views, patches) in [(1, 1), (1, 9), (2, 3), (7, 36), (33, 65)] {
        let (count, pitch) = (views * patches, views * patches + 3);
        let lists = random_below(1, views * pitch, patches as u32);
        let mut case = plan();
        let keys = case.output::<u32>(count);
        let kernel = Mutual {
            nearest: case.input(&lists),
            keys,
            views: views as u32,
            patches: patches as u32,
            pitch: pitch as u32,
            bits: 12,
        };
        case.rec.dispatch(kernel, count);
        let keys: Vec<u32> = case.result(keys).unwrap();
        let mut found: Vec<u32> = (0..count as u32).collect();
        found.sort_by_key(|token| keys[*token as usize]);
        let lists: Vec<Vec<u32>> = lists.chunks(pitch).map(|list| list[..count].to_vec()).collect();
        assert_same(&format!("{views} views of {patches}"), &found, &order(&lists, patches));
    }
}

#[test]
fn selects_the_tokens_of_the_reference() {
    for kernel in nearest_kernels() {
        for (views, patches, width) in [(1, 20, 8), (2, 9, 4), (5, 33, 36), (12, 36, 64)] {
            let x = random(views as u64, views * patches * width);
            let truth = order(&nearest_by_view(&widen(&x), width, patches), patches);
            for count in [1, patches, views * patches - 1] {
                let name = format!("{count} of {views} x {patches}, {kernel:?}");
                assert_same(&name, &selected(&x, width, views, count, kernel), &truth[..count]);
            }
        }
    }
}

/// Copies of the first view add nothing until its tokens are used up.
#[test]
fn copies_come_last() {
    let first = random(3, 30 * 16);
    let x: Vec<f32> = first.iter().chain(&first).chain(&first).copied().collect();
    for kernel in nearest_kernels() {
        let mut found = selected(&x, 16, 3, 30, kernel);
        found.sort_unstable();
        assert_same("the first view", &found, &(0..30).collect::<Vec<u32>>());
    }
}
