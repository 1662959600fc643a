//! Random valid and invalid calls on changing objects. Successful ones stay bitwise reproducible.

use crate::calls::*;
use std::ptr::{null, null_mut};
use zipsplat_c::*;

struct Random(zipsplat::random::Random);

impl Random {
    fn below(&mut self, bound: usize) -> usize {
        (self.0.bits() % bound as u64) as usize
    }

    fn of<T: Copy>(&mut self, values: &[T]) -> T {
        values[self.below(values.len())]
    }

    fn mostly<T: Copy>(&mut self, good: T, bad: &[T]) -> T {
        if self.below(8) > 0 { good } else { self.of(bad) }
    }

    fn handle<T: Handle>(&mut self, pool: &[Object<T>]) -> *mut T {
        if pool.is_empty() || self.below(8) == 0 { null_mut() } else { pool[self.below(pool.len())].handle }
    }
}

const POOL: usize = 3;

#[derive(Default)]
struct World {
    devices: Vec<Object<zs_device>>,
    models: Vec<Object<zs_model>>,
    reconstructions: Vec<Object<zs_reconstruction>>,
    scenes: Vec<Object<zs_scene>>,
    renderers: Vec<Object<zs_renderer>>,
    succeeded: [u32; 8],
}

fn keep<T: Handle>(
    pool: &mut Vec<Object<T>>,
    random: &mut Random,
    make: impl FnOnce(*mut *mut T) -> zs_status,
) -> bool {
    let made = Object::try_new(make);
    if let Err(status) = made {
        assert!(!message().is_empty() && status != zs_status::ZS_ERROR_INTERNAL, "{status:?}: {}", message());
        return false;
    }
    if pool.len() == POOL {
        pool.swap_remove(random.below(POOL));
    }
    pool.extend(made);
    true
}

impl World {
    fn step(&mut self, random: &mut Random, images: &[zs_image]) {
        let call = random.below(8);
        let done = match call {
            0 => keep(&mut self.devices, random, |out| unsafe { zs_device_create(null(), out) }),
            1 => self.load(random),
            2 => self.reconstruct(random, images),
            3 => {
                let (device, scene) = (random.handle(&self.devices), random.handle(&self.scenes));
                keep(&mut self.renderers, random, |out| unsafe { zs_renderer_create(device, scene, out) })
            }
            4 => {
                let (renderer, scene) = (random.handle(&self.renderers), random.handle(&self.scenes));
                unsafe { zs_renderer_set_scene(renderer, scene) == zs_status::ZS_OK }
            }
            5 | 6 => self.draw(random),
            _ => self.destroy_one(random),
        };
        self.succeeded[call] += u32::from(done);
    }

    fn load(&mut self, random: &mut Random) -> bool {
        let device = random.handle(&self.devices);
        let size = random.mostly(micro().len(), &[0, 1, 8, 100, micro().len() / 2, micro().len() - 1]);
        let mut bytes = micro()[..size].to_vec();
        for _ in 0..random.mostly(0, &[1, 10]) {
            // The header is mostly JSON.
            let at = random.below(bytes.len().clamp(1, 4000));
            if let Some(byte) = bytes.get_mut(at) {
                *byte ^= 1 << random.below(8);
            }
        }
        keep(&mut self.models, random, |out| unsafe {
            zs_model_from_memory(device, bytes.as_ptr().cast(), bytes.len(), null(), out)
        })
    }

    fn reconstruct(&mut self, random: &mut Random, images: &[zs_image]) -> bool {
        let model = random.handle(&self.models);
        let mut image = images[0];
        image.format = random.mostly(image.format, &[-1, 5, 6]);
        image.width = random.mostly(image.width, &[0, 1, u32::MAX]);
        image.stride = random.mostly(0, &[1, -1, i64::MIN]);
        let options = zs_reconstruct_options {
            struct_size: random.mostly(size_of::<zs_reconstruct_options>() as u32, &[0, 4, 63, 65, u32::MAX]),
            ratio: random.mostly(0.5, &[0.0, 1.0, -1.0, f64::NAN]),
            token_selection: random.mostly(0, &[1, 2, 3, 4, -1]),
            input_size: [random.mostly(SIDE, &[0, 1, 14, 28, u32::MAX]), SIDE],
            ..reconstruct_options()
        };
        let list = [image, images[1]];
        let count = random.mostly(2, &[0, 1, 65_537, usize::MAX]);
        let made = keep(&mut self.reconstructions, random, |out| {
            // SAFETY: a live object or NULL; counts beyond the list are rejected before it is read.
            unsafe { zs_reconstruct(model, list.as_ptr(), count, &options, out) }
        });
        let reconstruction = random.handle(&self.reconstructions);
        let read = keep(&mut self.scenes, random, |out| unsafe { zs_reconstruction_to_scene(reconstruction, out) });
        made && read
    }

    fn draw(&mut self, random: &mut Random) -> bool {
        let renderer = random.handle(&self.renderers);
        let mut camera = camera(random.of(&[1, 16, 33]), random.of(&[1, 16, 33]), 0.1);
        camera.fx = random.mostly(camera.fx, &[0.0, -1.0, f64::NAN, 1e-300, 1e300]);
        camera.translation[2] = random.mostly(0.0, &[f64::INFINITY, 1e300, -1e9]);
        let mut pixels = vec![0u8; 16 * 33 * 33];
        let picture = zs_render_buffers {
            stride: random.mostly(0, &[1, i64::MAX, i64::MIN]),
            ..picture_at(random.mostly(pixels.as_mut_ptr(), &[null_mut()]))
        };
        let mut options = render_options(zs_pixel_format::ZS_PIXEL_RGBA8);
        let format = random.below(5) as i32;
        options.format = random.mostly(format, &[-1, 5, i32::MIN]);
        options.background[1] = random.mostly(0.5, &[f32::NAN, f32::INFINITY, 1e38]);
        let status = unsafe { zs_render(renderer, &camera, &picture, 1, &options) };
        assert_ne!(status, zs_status::ZS_ERROR_INTERNAL, "{}", message());
        status == zs_status::ZS_OK
    }

    fn destroy_one(&mut self, random: &mut Random) -> bool {
        fn one<T: Handle>(pool: &mut Vec<Object<T>>, random: &mut Random) -> bool {
            let some = !pool.is_empty();
            if some {
                pool.swap_remove(random.below(pool.len()));
            }
            some
        }
        match random.below(5) {
            0 => one(&mut self.devices, random),
            1 => one(&mut self.models, random),
            2 => one(&mut self.scenes, random),
            3 => one(&mut self.reconstructions, random),
            _ => one(&mut self.renderers, random),
        }
    }
}

#[test]
fn end_in_a_status() {
    let photos = photos(2);
    let images: Vec<_> = photos.iter().map(image_of).collect();
    let (mut random, mut world) = (Random(zipsplat::random::Random::new(1)), World::default());
    (0..400).for_each(|_| world.step(&mut random, &images));
    assert!(world.succeeded.iter().all(|count| *count > 3), "{:?}", world.succeeded);
    assert!(world.succeeded.iter().sum::<u32>() < 370, "{:?}", world.succeeded);
}
