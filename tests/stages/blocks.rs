use zipsplat::reconstruct::{Block, BlockLayout, BlockOptions, Network, Seam, Shape};
use zipsplat::{Pose, gpu::Progress};
use zipsplat_tests::prelude::*;

/// Views of 4 x 3 patches.
const SIZE: [u32; 2] = [56, 42];
const PATCHES: usize = 12;
const GAUSSIANS: usize = 4;

fn model() -> Model {
    networks::model("micro", Arithmetic::EXACT)
}

fn photos(count: u32) -> Vec<Image> {
    let photo = |view: u32| {
        let rgb = (0..3 * SIZE[0] * SIZE[1]).map(|i| (i.wrapping_mul(2 * view + 7) >> 3) as u8).collect();
        Image::new(SIZE[0], SIZE[1], rgb).expect("an image")
    };
    (0..count).map(photo).collect()
}

/// Cameras on a line, in the order 0, 3, 1, 4, 2, 5 for six.
fn cameras(count: usize) -> Vec<Camera> {
    let place = |i: usize| (i / 2 + i % 2 * count.div_ceil(2)) as f64;
    let pose = |i: usize| Pose { translation: [0.1 * place(i), 0.0, 0.0].into(), ..Pose::IDENTITY };
    (0..count).map(|i| Camera { pose: pose(i), ..camera(SIZE[0], SIZE[1]) }).collect()
}

fn options(size: usize, overlap: usize, cameras: Option<Vec<Camera>>) -> ReconstructOptions {
    let blocks = BlockOptions { size: Some(size), overlap: Some(overlap) };
    ReconstructOptions { blocks, cameras, scene_scale: Some(1.0), ..ReconstructOptions::default() }
}

fn blocks(model: &Model, options: &ReconstructOptions, views: usize) -> zipsplat::Result<Vec<Block>> {
    model.block_layout(views, SIZE, options)?.blocks(options.cameras.as_deref(), 1.0, |_, _| Ok(1.0))
}

fn in_blocks(model: &Model, photos: &[Image], options: &ReconstructOptions) -> zipsplat::Result<Reconstruction> {
    let blocks = blocks(model, options, photos.len())?;
    model.reconstruct_blocks(photos, options, &blocks, |_| ControlFlow::Continue(()))
}

#[test]
fn blocks_without_cameras_are_in_order_and_overlap() {
    let layout = BlockLayout::new(48, 20, Some(6)).expect("a layout");
    assert_eq!((layout.count, layout.size, layout.overlap), (3, 20, 6));
    let views: Vec<Vec<usize>> = layout
        .blocks(None, 1.0, |_, _| unreachable!("no cameras"))
        .expect("blocks")
        .into_iter()
        .map(|b| b.views)
        .collect();
    assert_eq!(views, [(0..20).collect::<Vec<_>>(), (14..34).collect(), (28..48).collect()]);
    let one = BlockLayout::new(20, 20, None).expect("a layout");
    assert_eq!((one.count, one.size, one.overlap), (1, 20, 0));
    assert_eq!(BlockLayout::new(20, 20, Some(30)).map(|layout| layout.count).expect("a layout"), 1);
    assert_eq!(
        BlockLayout::new(2000, 192, None).map(|layout| (layout.count, layout.overlap)).expect("a layout"),
        (14, 48)
    );
}

#[test]
fn blocks_with_cameras_are_neighbors_and_have_their_own_scale() {
    let (layout, cameras) = (BlockLayout::new(12, 6, Some(2)).expect("a layout"), cameras(12));
    let scale = |cameras: &[Camera], pose: &Pose| {
        assert_eq!((cameras.len(), cameras[0].pose), (6, Pose::IDENTITY));
        Ok(pose.translation.x + 1.0)
    };
    let blocks = layout.blocks(Some(&cameras), 1.0, scale).expect("blocks");
    assert_eq!(blocks.len(), 3);
    let mut owned = Vec::new();
    for block in &blocks {
        let places: Vec<f64> = block.views.iter().map(|view| cameras[*view].pose.translation.x).collect();
        let bounds = places.iter().fold((f64::MAX, f64::MIN), |(low, high), x| (low.min(*x), high.max(*x)));
        assert!(block.views.len() == 6 && bounds.1 - bounds.0 < 0.51, "{places:?}");
        assert_eq!(block.scene_scale, places[0] + 1.0);
        owned.extend(block.views.iter().zip(&block.own).filter(|(_, own)| **own).map(|(view, _)| *view));
    }
    owned.sort_unstable();
    assert!(owned.into_iter().eq(0..12), "each view is one block's own");
}

#[test]
fn unusable_blocks_are_refused() {
    let model = model();
    let refused = |size: usize, overlap: usize, posed: bool, words: &[&str]| {
        let options = options(size, overlap, posed.then(|| cameras(6)));
        assert_refused(blocks(&model, &options, 6), words);
    };
    refused(4, 4, true, &["block overlap", "found 4", "less than the block size, 4"]);
    refused(2, 9, false, &["block overlap", "found 9"]);
    refused(0, 0, true, &["block size", "found 0", "1 to 192"]);
    refused(193, 1, true, &["block size", "found 193"]);
    refused(3, 0, false, &["block overlap", "known cameras", "shared views join"]);
    assert_refused(blocks(&model, &options(4, 1, None), 65_537), &["views", "65537", "1 to 65536"]);
    let few = in_blocks(&model, &photos(5), &options(3, 1, None));
    assert_refused(few, &["patches that block 2", "found 12", "16 or more", "overlap"]);
    let given = TokenSelection::Given(vec![0]);
    let given = ReconstructOptions { token_selection: given, ..options(3, 2, None) };
    assert_refused(in_blocks(&model, &photos(5), &given), &["token selection", "one block"]);
}

#[test]
fn blocks_of_known_cameras_are_their_passes_in_one_world() {
    let (model, photos, cameras) = (model(), photos(6), cameras(6));
    let options = options(3, 0, Some(cameras.clone()));
    let joined = in_blocks(&model, &photos, &options).expect("a reconstruction");
    let mut expected: Option<Scene> = None;
    for views in [[0, 2, 4], [1, 3, 5]] {
        let images = views.map(|view| photos[view].clone());
        let first = cameras[views[0]].pose;
        let of_block = views.map(|view| Camera { pose: cameras[view].pose.relative_to(&first), ..cameras[view] });
        let alone = ReconstructOptions { cameras: Some(of_block.to_vec()), ..options.clone() };
        let mut scene = networks::reconstruct(&model, &images, &alone).to_scene().expect("a scene");
        scene.place(1.0, &first);
        match &mut expected {
            None => expected = Some(scene),
            Some(all) => all.append(scene),
        }
    }
    assert_eq!(Some(joined.to_scene().expect("a scene")), expected);
    let seams = [Seam { shared_patches: 0, scale: 1.0, error: None }];
    assert_eq!((&joined.seams[..], joined.tokens), (&seams[..], 6 * PATCHES));
    let indices = [0, 2, 4, 1, 3, 5].into_iter().flat_map(|view| (0..PATCHES).map(move |patch| view * PATCHES + patch));
    assert!(joined.patches.indices().iter().map(|index| *index as usize).eq(indices));
    let one = BlockOptions { size: Some(6), ..options.blocks };
    let one = in_blocks(&model, &photos, &ReconstructOptions { blocks: one, ..options.clone() }).expect("one block");
    let whole = networks::reconstruct(&model, &photos, &options).to_scene().expect("a scene");
    assert!(one.seams.is_empty() && one.to_scene().expect("a scene") == whole);
}

#[test]
fn a_patch_of_several_blocks_has_its_gaussians_once() {
    let (model, mut photos) = (model(), photos(8));
    for posed in [false, true] {
        let options = options(4, 2, posed.then(|| cameras(8)));
        let [joined, again] = [(); 2].map(|()| in_blocks(&model, &photos, &options).expect("a reconstruction"));
        let scene = joined.to_scene().expect("a scene");
        assert!(scene == again.to_scene().expect("a scene"), "other bits the second time");
        assert_eq!(scene.len(), 8 * PATCHES * GAUSSIANS);
        let mut patches = joined.patches.indices();
        patches.sort_unstable();
        assert!(patches.into_iter().eq(0..8 * PATCHES as u32));
        assert_eq!(joined.seams.len(), 2);
        for Seam { shared_patches, scale, error } in &joined.seams {
            let usable = *shared_patches >= 2 * PATCHES && scale.is_normal() && *scale > 0.0;
            assert!(usable && (posed == (*scale == 1.0)) && error.is_some_and(f64::is_finite), "{:?}", joined.seams);
        }
        assert_eq!(joined.cameras(&scene, None).map(|cameras| cameras.len()).ok(), (!posed).then_some(8));
    }
    photos.iter_mut().take(3).for_each(|photo| photo.mask = Some(vec![0; (SIZE[0] * SIZE[1]) as usize]));
    let joined = in_blocks(&model, &photos, &options(4, 2, Some(cameras(8)))).expect("a reconstruction");
    assert_eq!(joined.to_scene().expect("a scene").len(), 5 * PATCHES * GAUSSIANS, "masked photos have none");
}

#[test]
fn a_pass_of_the_second_block_can_be_canceled() {
    let (model, options, mut stages) = (model(), options(4, 2, None), Vec::new());
    let blocks = blocks(&model, &options, 8).expect("blocks");
    let made = model.reconstruct_blocks(&photos(8), &options, &blocks, |now| {
        stages.push(now.fraction);
        if now.fraction > 0.4 { ControlFlow::Break(()) } else { ControlFlow::Continue(()) }
    });
    assert!(matches!(made, Err(Error::Cancelled)) && stages.is_sorted(), "{stages:?}");
    assert!(in_blocks(&model, &photos(8), &options).is_ok(), "the model stays usable");
}

#[test]
fn a_joined_scene_too_large_fails_before_the_first_pass() {
    let photos = photos(120);
    let options = options(8, 2, Some(cameras(120)));
    let joined = in_blocks(&model(), &photos, &options).expect("a reconstruction").gaussians.bytes();
    let memory = |bytes: u64| DeviceOptions { max_memory_bytes: Some(bytes), ..DeviceOptions::default() };
    let needed = model().weight_bytes() + joined;
    for (bytes, fits) in [(needed, true), (needed - 1, false)] {
        let device = Device::open(&memory(bytes)).expect("a device");
        let model = networks::model_on(&device, "micro", Arithmetic::EXACT);
        let (blocks, mut passes) = (blocks(&model, &options, 120).expect("blocks"), 0);
        let made = model.reconstruct_blocks(&photos, &options, &blocks, |_| {
            passes += 1;
            ControlFlow::Continue(())
        });
        match made {
            Ok(_) => assert!(fits && passes > 0),
            Err(error) => assert!(matches!(error, Error::Memory { .. }) && !fits && passes == 0, "{error}: {passes}"),
        }
    }
}

#[test]
fn kept_memory_does_not_change_the_blocks() {
    let options = ReconstructOptions { scene_scale: Some(1.0), ..ReconstructOptions::default() };
    let (photos, whole) = (photos(12), model().shape(&photos(12), &options).expect("a shape"));
    let needed = model().weight_bytes() + model().plan(whole).expect("a plan").bytes();
    let device = Device::open(&DeviceOptions { max_memory_bytes: Some(needed), ..DeviceOptions::default() });
    let model = networks::model_on(&device.expect("a device"), "micro", Arithmetic::EXACT);
    for _ in 0..2 {
        assert_eq!(model.block_layout(12, SIZE, &options).expect("a layout").count, 1);
        in_blocks(&model, &photos, &options).expect("a reconstruction");
    }
}

#[test]
fn photos_that_are_all_masked_are_refused() {
    let (model, mut photos) = (model(), photos(8));
    photos.iter_mut().for_each(|photo| photo.mask = Some(vec![0; (SIZE[0] * SIZE[1]) as usize]));
    for size in [4, 8] {
        assert_refused(in_blocks(&model, &photos, &options(size, 2, Some(cameras(8)))), &["all masked"]);
    }
    let options = options(8, 0, None);
    let features = model.features(&photos, &options, |_| ControlFlow::Continue(())).expect("features");
    let go_on = |_: Progress<'_>| ControlFlow::Continue(());
    assert_refused(model.reconstruct_features(&features, &options, go_on), &["all masked"]);
    assert_refused(model.tokens(&features, &options, go_on).map(drop), &["all masked"]);
}

#[test]
fn the_memory_decides_the_size() {
    let checkpoint = Checkpoint::seeded_architecture(architectures::golden("micro"), "micro").expect("a network");
    let network = Network::of(&checkpoint, device().limits(), Arithmetic::EXACT).expect("a network");
    let shape =
        |views| Shape::new(checkpoint.architecture(), views, SIZE, Ratio::Fixed(1.0), &TokenSelection::KMEANS, true);
    let whole = network.plan(device().limits(), shape(40).expect("a shape")).expect("a plan").bytes();
    let layout = |memory_bytes: u64| {
        let limits = Limits { memory_bytes, ..device().limits().clone() };
        network.block_layout(&limits, 40, BlockOptions::default(), shape).expect("a layout")
    };
    let needed = network.weight_bytes() + whole;
    assert_eq!(layout(needed).count, 1);
    let split = layout(needed - 1);
    assert!(split.count > 1 && split.size >= 8 && split.size < 40 && split.overlap == split.size / 4, "{split:?}");
    assert_eq!(layout(0).size, 8, "smaller blocks are not worth a pass");
}
