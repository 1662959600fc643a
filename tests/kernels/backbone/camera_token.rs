use crate::case::*;
use zipsplat::kernels::backbone::CameraToken;
use zipsplat_tests::reference::backbone::camera_token::{insert_camera_tokens, learned_camera_tokens};

#[test]
fn equals_the_reference() {
    // The last exceeds 65,535 workgroups.
    for (views, tokens, width) in [(0, 3, 4), (1, 1, 1), (1, 5, 63), (2, 4, 64), (3, 2, 65), (65_537, 1, 65)] {
        for (encoded, chosen) in [(false, false), (false, true), (true, false)] {
            let reference = views / 2;
            let x = random(1, views * tokens * width);
            let camera_tokens = random(2, if encoded { views } else { 2 } * width);
            let mut case = plan();
            let out = case.input(&x);
            let kernel = CameraToken {
                camera_tokens: case.input(&camera_tokens),
                chosen: case.input(&[reference as u32]),
                out,
                views: views as u32,
                tokens: tokens as u32,
                width: width as u32,
                // Unused where the device chooses.
                reference: if chosen { 0 } else { reference as u32 },
                encoded,
                on_device: chosen,
            };
            case.rec.dispatch(kernel, views * width);

            let mut truth = widen(&x);
            let mut cameras = widen(&camera_tokens);
            if !encoded {
                cameras = learned_camera_tokens(&cameras, width, views, reference);
            }
            insert_camera_tokens(&mut truth, tokens, &cameras, width);
            let name = format!("{views} views of {tokens} x {width}, encoded {encoded}, chosen {chosen}");
            assert_same(&name, &case.result::<f32>(out).unwrap(), &rounded(&truth));
        }
    }
}
