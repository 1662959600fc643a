use crate::calls::*;
use std::thread;
use zipsplat_c::*;
use zipsplat_tests::compare::assert_same;

const THREADS: usize = 8;

fn picture(device: &Object<zs_device>, scene: &Object<zs_scene>) -> Vec<u8> {
    let options = render_options(zs_pixel_format::ZS_PIXEL_RGBA_F32);
    draw(&renderer(device, scene), &camera(48, 48, 0.1), &options, 16)
}

#[test]
fn eight_threads_with_a_context_each_and_one_model_give_the_bits_of_one() {
    let photos = photos(2);
    let images = || photos.iter().map(image_of).collect::<Vec<_>>();
    let own = open_device();
    let model = model(&own);
    let scene = reconstruct(&model, &images(), &reconstruct_options());
    let (means, drawn) = (read(&scene).means, picture(&own, &scene));
    thread::scope(|scope| {
        let (model, images) = (&model, &images);
        let work = move || {
            let device = open_device();
            let scene = reconstruct(model, &images(), &reconstruct_options());
            (read(&scene).means, picture(&device, &scene))
        };
        let threads: Vec<_> = (0..THREADS).map(|_| scope.spawn(work)).collect();
        for (i, thread) in threads.into_iter().enumerate() {
            let (found_means, found_drawn) = thread.join().expect("no panic");
            assert_same(&format!("means of thread {i}"), found_means.as_flattened(), means.as_flattened());
            assert_same(&format!("picture of thread {i}"), &found_drawn, &drawn);
        }
    });
}

#[test]
fn threads_share_a_renderer_and_a_context() {
    let photos = photos(1);
    let device = open_device();
    let scene = reconstruct(&model(&device), &[image_of(&photos[0])], &reconstruct_options());
    let renderer = renderer(&device, &scene);
    let options = render_options(zs_pixel_format::ZS_PIXEL_RGBA8);
    let draw_one = |i: usize| draw(&renderer, &camera(32 + 16 * (i as u32 % 3), 32, 0.1 * i as f64), &options, 4);
    let expected: Vec<_> = (0..THREADS).map(draw_one).collect();
    thread::scope(|scope| {
        let threads: Vec<_> = (0..THREADS).map(|i| scope.spawn(move || draw_one(i))).collect();
        for (thread, expected) in threads.into_iter().zip(&expected) {
            assert_same("picture", &thread.join().expect("no panic"), expected);
        }
    });
}

#[test]
fn messages_belong_to_their_threads() {
    let fail = || unsafe { zs_device_count(std::ptr::null_mut()) };
    assert_eq!(fail(), zs_status::ZS_ERROR_ARGUMENT);
    assert!(message().starts_with("count"));
    assert_eq!(thread::spawn(message).join().expect("no panic"), "");
}
