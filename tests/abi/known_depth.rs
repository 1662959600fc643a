use crate::{calls::*, refine::place};
use std::ptr::null_mut;
use zipsplat_c::{zs_status::*, *};
use zipsplat_tests::compare::assert_same;

#[test]
fn known_depth_and_antialiasing_are_passed_on() {
    let place = place(2);
    let (device, scene) = (open_device(), scene_of(&place.moved));
    let depths = vec![vec![2.0f32; 48 * 36]; 2];
    let images: Vec<_> = place.photos.iter().map(image_of).collect();
    let known: Vec<_> =
        images.iter().zip(&depths).map(|(image, depth)| zs_image { depth: depth.as_ptr(), ..*image }).collect();
    let cameras = place.c_cameras();
    let refine = |images: &[zs_image], options: zs_refine_options| {
        let refine = |out| unsafe {
            let (images, cameras) = (images.as_ptr(), cameras.as_ptr());
            zs_refine_scene(device.handle, scene.handle, images, cameras, 2, &options, null_mut(), out)
        };
        Object::try_new(refine).map(|scene| read(&scene))
    };
    let options = zs_refine_options { steps: 9, ..Versioned::new() };
    let [metric, relative] = [zs_depth_loss::ZS_DEPTH_LOSS_METRIC, zs_depth_loss::ZS_DEPTH_LOSS_RELATIVE]
        .map(|kind| zs_refine_options { depth_loss: kind as i32, ..options });
    let [plain, unused] = [&images, &known].map(|images| refine(images, options).expect("a scene"));
    assert_same("depth without a loss", &bits(&unused), &bits(&plain));
    assert_ne!(refine(&known, metric).expect("a scene"), plain);
    // Equal depth of all pixels has no line.
    let colors_only = refine(&known, relative).expect("a scene");
    assert_same("depth without a line", &bits(&colors_only), &bits(&plain));
    let on = zs_refine_options { antialiasing: zs_antialiasing::ZS_ANTIALIASING_ON as i32, ..options };
    assert!(refine(&images, on).expect("a scene").antialiased && !plain.antialiased);
    let refused = |images: &[zs_image], options, words: &[&str]| {
        fails(refine(images, options).expect_err("an error"), ZS_ERROR_ARGUMENT, words);
    };
    refused(&images, metric, &["depth of the images", "NULL in all"]);
    let unaligned = zs_image { depth: depths[0].as_ptr().wrapping_byte_add(1), ..known[0] };
    refused(&[unaligned, known[1]], metric, &["depth", "a multiple of 4"]);
    let wrong = vec![f32::NAN; 48 * 36];
    refused(&[known[0], zs_image { depth: wrong.as_ptr(), ..known[1] }], metric, &["depth of photo 1", "NaN"]);
    refused(&known, zs_refine_options { depth_loss: 3, ..options }, &["depth_loss", "zs_depth_loss"]);
    refused(&known, zs_refine_options { depth_weight: -1.0, ..options }, &["depth_weight", "-1"]);
    refused(&known, zs_refine_options { antialiasing: 3, ..options }, &["antialiasing", "zs_antialiasing"]);
}
